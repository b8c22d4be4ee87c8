"""Shapes: where a ray meets them."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from diffdisp.dispersion import real_array
from diffdisp.vector import (
    Array,
    Real,
    Triple,
    Vec3,
    choose,
    inverse,
    least_square,
    normalize,
    root,
    safe_sqrt,
)


class Ray(NamedTuple):
    """Half-line from `origin` (scene units) along the unit vector `direction`."""

    origin: Vec3
    direction: Vec3


class Sphere(eqx.Module):
    """Ball or hollow lamp: `center` and `radius` in scene units, radius > 0."""

    center: Triple = eqx.field(converter=real_array)
    radius: Real = eqx.field(converter=real_array)


class Plane(eqx.Module):
    """Infinite plane through `point` (scene units), at right angles to `normal` (any length)."""

    point: Triple = eqx.field(converter=real_array)
    normal: Triple = eqx.field(converter=real_array)


def sphere_distances(ray: Ray, center: Vec3, radius: Real) -> tuple[Real, Real, Array]:
    """Distances t₁ ≤ t₂ along the ray to its line's two points on a sphere, and whether it has any.

    Source:
        Haines, Günther, Akenine-Möller, "Precision Improvements for Ray/Sphere Intersection",
        Ray Tracing Gems (2019), ch. 7: the discriminant from the foot of the perpendicular, which
        far small spheres keep in float32, and the second root from the product of both.
    """
    to_origin = ray.origin - center
    b = -to_origin.dot(ray.direction)
    foot = to_origin + ray.direction * b
    discriminant = radius * radius - foot.dot(foot)
    least = least_square(b) * radius * radius
    half = safe_sqrt(discriminant, least)
    q = b + jnp.where(b < 0, -half, half)
    product = to_origin.dot(to_origin) - radius * radius
    other = product * inverse(jnp.where(q == 0, 1.0, q))
    return jnp.minimum(q, other), jnp.maximum(q, other), discriminant > least


def first_distance(ray: Ray, center: Vec3, squared_radius: Real, on: Array) -> tuple[Real, Array]:
    """Distance along the ray to the first point of a sphere ahead of it, and whether there is one.

    A ray that starts on the sphere, or within rounding of it as where two surfaces touch, meets it
    again only at the other end of a chord.

    Args:
        ray: the ray.
        center: the sphere's.
        squared_radius: the sphere's.
        on: whether the ray is known to start on the sphere.

    Source:
        As `sphere_distances`.
    """
    to_origin = ray.origin - center
    b = -to_origin.dot(ray.direction)
    foot = to_origin + ray.direction * b
    squared, inside = to_origin.dot(to_origin), squared_radius
    discriminant = inside - foot.dot(foot)
    # A limit would be a number of the sphere alone, for which XLA makes a loop of its own.
    meets = discriminant * (1.0 / least_square(b)) > inside
    half = jnp.where(meets, root(jnp.where(meets, discriminant, 1.0)), 0.0)
    product = squared - inside
    margin = (squared + inside) * (1e-13 if jnp.result_type(b) == jnp.float64 else 4e-7)
    product = jnp.where(on | (jnp.abs(product) <= margin), 0.0, product)
    return _first_ahead(b, half, product, meets)


def _first_ahead(b: Real, half: Real, product: Real, meets: Array) -> tuple[Real, Array]:
    """The least of both roots b ± `half` that is ahead, by their product, and whether one is."""
    # From outside the nearer root, from inside the farther one; each from the sum that does not
    # cancel, or from the product of both.
    sum_ahead = b + half
    divide = (product > 0) | (b < 0)
    divisor = jnp.where(b < 0, b - half, sum_ahead)
    quotient = product * inverse(jnp.where(divisor == 0, 1.0, divisor))
    distance = jnp.where(divide, quotient, sum_ahead)
    return distance, meets & (distance > 0)


def fine_first_distance(ray: Ray, center: Vec3, radius: Real, on: Array) -> tuple[Real, Array]:
    """`first_distance` in float32 of spheres that are very large beside their distance, too.

    There |o|² and r² are each rounded by more than is left of their difference. Here that is summed
    with what each of its steps rounds off.

    Args:
        ray: the ray.
        center: the sphere's.
        radius: the sphere's.
        on: whether the ray is known to start on the sphere.

    Source:
        Dekker, "A floating-point technique for extending the available precision", Numer. Math. 18
        (1971) 224, with a mask for the split: no compiler undoes that. Knuth, The Art of Computer
        Programming 2 (1997), section 4.2.2, theorem B: the sum.
    """
    parts = [_exact_sum(o, -c) for o, c in zip(ray.origin, center, strict=True)]
    to_origin = Vec3(*(whole for whole, _ in parts))
    squares = [_exact_square(component) for component in to_origin]
    inside, inside_off = _exact_square(radius)
    product, product_off = -inside, -inside_off
    for (whole, off), (square, square_off) in zip(parts, squares, strict=True):
        product, rounded = _exact_sum(product, square)
        product_off = product_off + (rounded + square_off + 2.0 * whole * off)
    product = product + product_off
    rest = Vec3(*(off for _, off in parts))
    b = -(to_origin.dot(ray.direction) + rest.dot(ray.direction))
    squared, foot = radius * radius, to_origin + ray.direction * b
    # Beside a large sphere the one cancels, far from a small one the other.
    beside = b * b + jnp.abs(product) < squared
    discriminant = jnp.where(beside, b * b - product, squared - foot.dot(foot))
    meets = discriminant * (1.0 / least_square(b)) > squared
    half = jnp.where(meets, root(jnp.where(meets, discriminant, 1.0)), 0.0)
    margin = (to_origin.dot(to_origin) + squared) * MARGIN
    product = jnp.where(on | (jnp.abs(product) <= margin), 0.0, product)
    return _first_ahead(b, half, product, meets)


MARGIN = 1e-10
"""Part of |o|² + r² within which a ray starts on a sphere, where the difference is known well."""


def _exact_sum(a: Real, b: Real) -> tuple[Real, Real]:
    """The sum of two numbers, and what it rounds off."""
    total = a + b
    second = total - a
    return total, (a - (total - second)) + (b - second)


def _exact_square(x: Real) -> tuple[Real, Real]:
    """Two numbers of float32 whose sum is x², the first without rounding; the second is small."""
    bits = jax.lax.bitcast_convert_type(x, jnp.int32) & np.int32(~0xFFF)
    high = jax.lax.bitcast_convert_type(bits, jnp.float32)
    return high * high, (high + x) * (x - high)


def sphere_depth(
    ray: Ray, footprint: tuple[Ray, Ray], center: Vec3, radius: Real
) -> tuple[Real, Real, tuple[Real, Real]]:
    """How deep a ray's line goes into a sphere, and what the edges of a footprint add to that.

    Args:
        ray: the ray.
        footprint: its changes along both edges of a footprint.
        center: the sphere's.
        radius: the sphere's.

    Returns:
        Distance along the ray to the line's point next to the centre. The line's depth there, 1
        minus the square of its distance from the centre in radii: below 0 it misses the sphere,
        else its cosine to the sphere is the square root. And the changes of the depth along both
        edges.
    """
    to_origin = ray.origin - center
    along = -to_origin.dot(ray.direction)
    foot, squared = to_origin + ray.direction * along, radius * radius
    scale = inverse(squared)
    across, down = (
        foot.dot(edge.origin + edge.direction * along) * (-2.0 * scale) for edge in footprint
    )
    return along, (squared - foot.dot(foot)) * scale, (across, down)


def box_width(edges: tuple[Real, Real]) -> Real:
    """Width of a box of the variance that a sum of two boxes has, of the widths `edges`."""
    across, down = edges
    # A hypotenuse has no derivative at zero.
    return safe_sqrt(across * across + down * down, 1e-30)


def mean_root(middle: Real, width: Real) -> Real:
    """Mean of √x, and of 0 where x is negative, over a box; its derivatives are finite.

    Args:
        middle: of the box, more than half of the width below 0 at most.
        width: of the box, ≥ 0.
    """
    half = 0.5 * width
    least = least_square(middle)
    high, low = safe_sqrt(middle + half, least), safe_sqrt(middle - half, least)
    whole = middle > half
    total = jnp.where(high > 0, high + low, 1.0)
    # ∫√x as a difference of cubes over one of squares, without what both have in common.
    inside = (high * high + high * low + low * low) * (2.0 / 3.0) * inverse(total)
    cut = high * high * high * (1.0 / 3.0) * inverse(jnp.where(whole | (half == 0), 1.0, half))
    return jnp.where(whole, inside, cut)


def soft_offset(ray: Ray, center: Vec3, radius: Real, width: Real, inside: Array | bool) -> Vec3:
    """From a ball's centre to where a footprint meets it, which moves smoothly at its outline too.

    Next to its outline a ball turns away within less than a footprint. The point is then the
    mean of where the footprint meets the ball, and of where the part of it that passes beside
    the ball comes nearest: reflectance and directions are linear in the cosine so near to
    grazing, so that what is seen from there is about the mean of what is seen. It lies on the
    ray, and a little off the ball; the path goes on as in a ball on which it lies.

    Args:
        ray: the ray, from outside unless it begins on the ball.
        center: the ball's.
        radius: the ball's.
        width: of a box in which the depth of `sphere_depth` has the variance that it has over
            the footprint.
        inside: whether the ray begins on the ball and goes through it.
    """
    to_origin = ray.origin - center
    along = -to_origin.dot(ray.direction)
    foot = to_origin + ray.direction * along
    squared = radius * radius
    depth = (squared - foot.dot(foot)) * inverse(squared)
    met = foot - ray.direction * (radius * mean_root(depth, width))
    return choose(inside, to_origin + ray.direction * (2.0 * along), met)


def plane_distance(ray: Ray, point: Vec3, normal: Vec3) -> Real:
    """Distance along the ray to a plane; -1 where they are parallel."""
    cosine = ray.direction.dot(normal)
    parallel = cosine == 0
    distance = (point - ray.origin).dot(normal) * inverse(jnp.where(parallel, 1.0, cosine))
    return jnp.where(parallel, -1.0, distance)


def plane_axes(normal: Vec3) -> tuple[Vec3, Vec3]:
    """The plane's own unit axes u and v.

    u = (0, 1, 0) × normal, normalised, or (1, 0, 0) where the normal is along y; v = normal × u.
    """
    unit = normalize(normal)
    zero = unit.x * 0.0
    upright = (unit.x == 0) & (unit.z == 0)
    across = choose(upright, Vec3(zero + 1.0, zero, zero), Vec3(unit.z, zero, -unit.x))
    u = choose(upright, Vec3(zero + 1.0, zero, zero), normalize(across))
    return u, unit.cross(u)
