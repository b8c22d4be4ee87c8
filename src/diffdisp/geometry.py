"""Shapes: where a ray meets them."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from diffdisp.dispersion import real_array
from diffdisp.vector import Array, Real, Triple, Vec3, choose, least_square, normalize, safe_sqrt


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
    root = safe_sqrt(discriminant, least)
    q = b + jnp.where(b < 0, -root, root)
    product = to_origin.dot(to_origin) - radius * radius
    other = product / jnp.where(q == 0, 1.0, q)
    return jnp.minimum(q, other), jnp.maximum(q, other), discriminant > least


def first_distance(ray: Ray, center: Vec3, radius: Real, on: Array) -> tuple[Real, Array]:
    """Distance along the ray to the first point of a sphere ahead of it, and whether there is one.

    A ray that starts on the sphere, or within rounding of it as where two surfaces touch, meets it
    again only at the other end of a chord.

    Args:
        ray: the ray.
        center: the sphere's.
        radius: the sphere's.
        on: whether the ray is known to start on the sphere.

    Source:
        As `sphere_distances`.
    """
    to_origin = ray.origin - center
    b = -to_origin.dot(ray.direction)
    foot = to_origin + ray.direction * b
    squared, inside = to_origin.dot(to_origin), radius * radius
    discriminant = inside - foot.dot(foot)
    root = safe_sqrt(discriminant, least_square(b) * inside)
    product = squared - inside
    margin = (squared + inside) * (1e-13 if jnp.result_type(b) == jnp.float64 else 4e-7)
    product = jnp.where(on | (jnp.abs(product) <= margin), 0.0, product)
    # From outside the nearer root, from inside the farther one; each from the sum that does not
    # cancel, or from the product of both.
    sum_ahead = b + root
    divide = (product > 0) | (b < 0)
    divisor = jnp.where(b < 0, b - root, sum_ahead)
    quotient = product / jnp.where(divisor == 0, 1.0, divisor)
    distance = jnp.where(divide, quotient, sum_ahead)
    return distance, (discriminant > 0) & (distance > 0)


def plane_distance(ray: Ray, point: Vec3, normal: Vec3) -> Real:
    """Distance along the ray to a plane; -1 where they are parallel."""
    cosine = ray.direction.dot(normal)
    parallel = cosine == 0
    distance = (point - ray.origin).dot(normal) / jnp.where(parallel, 1.0, cosine)
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
