"""What the outline of a sphere cuts off a footprint."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffdisp.geometry import Ray
from diffdisp.texture import Pair, covered
from diffdisp.vector import Array, Real, Vec3, choose, inverse, least_square, safe_sqrt


class Piece(NamedTuple):
    """A piece of a footprint, as a footprint of its own.

    Args:
        part: of the whole, from 0 to 1.
        middle: of the piece, from that of the whole, in its edges.
        edges: of a parallelogram that is spread as the piece is, in those of the whole.
    """

    part: Real
    middle: Pair
    edges: tuple[Pair, Pair]


def whole_footprint(like: Real) -> Piece:
    """All of a footprint, in the shape of `like`."""
    zero = jnp.zeros_like(like)
    unit = zero + 1.0
    return Piece(unit, (zero, zero), ((unit, zero), (zero, unit)))


SMALL = 0.75
"""Radius of a sphere, over the root of a footprint's area there, below which it is taken for a
square of its area: what footprints side by side see of it is then all of it, however it lies among
them. From here on a straight line is the better outline. Parts of a grid of footprints are as far
off by the one as by the other at this size; sums are exact by squares, and by lines 5 % off at 0.9,
0.8 % at 1 and 0.1 % at 3."""


SLANT = 1e-6
"""Least slope of a line to the side of a square: what it cuts off changes by no more than that."""

GAUSS = (-((1 / 3) ** 0.5), (1 / 3) ** 0.5)
"""Places in [-1, 1] whose mean is that of any polynomial of the third degree."""


class _Seen(NamedTuple):
    """A sphere to a footprint, in units of the footprint's size.

    Args:
        along: distance along the ray to its line's point next to the centre, scene units.
        radius: of the sphere.
        foot: from the sphere's centre to that point.
        edges: of the footprint there.
        distance: from the outline, as a straight line, to the footprint's middle.
        slopes: changes of that along both edges.
        squares: of the one edge, the product of both, of the other.
        area: of the footprint; 1 where the sphere is not small.
        small: whether it is.
    """

    along: Real
    radius: Real
    foot: Vec3
    edges: tuple[Vec3, Vec3]
    distance: Real
    slopes: Pair
    squares: tuple[Real, Real, Real]
    area: Real
    small: Array


def _seen(ray: Ray, footprint: tuple[Ray, Ray], center: Vec3, radius: Real) -> _Seen:
    to_origin = ray.origin - center
    along = -to_origin.dot(ray.direction)
    edges = [edge.origin + edge.direction * along for edge in footprint]
    # In units of the footprint's size: squares of a sphere's need not be numbers of float32.
    size = jax.lax.stop_gradient(safe_sqrt(edges[0].dot(edges[0]) + edges[1].dot(edges[1])))
    unit = inverse(jnp.where(size > 0, size, 1.0))
    foot = (to_origin + ray.direction * along) * unit
    across, down = (edge * unit for edge in edges)
    squares = across.dot(across), across.dot(down), down.dot(down)
    radius, least = radius * unit, least_square(along)
    away = safe_sqrt(foot.dot(foot), least)
    outward = foot * inverse(jnp.where(away > 0, away, 1.0))
    slopes = -across.dot(outward), -down.dot(outward)
    # The outline bends away from its tangent by what the footprint spreads along that.
    aside = squares[0] + squares[2] - (slopes[0] * slopes[0] + slopes[1] * slopes[1])
    bent = safe_sqrt(foot.dot(foot) + jnp.maximum(aside, 0.0) * (1.0 / 12.0), least)
    area = safe_sqrt(squares[0] * squares[2] - squares[1] * squares[1], least)
    small = radius * radius < SMALL**2 * area
    area = jnp.where(small, area, 1.0)
    return _Seen(along, radius, foot, (across, down), radius - bent, slopes, squares, area, small)


def part_within(ray: Ray, footprint: tuple[Ray, Ray], center: Vec3, radius: Real) -> Real:
    """Part of a footprint, from outside a sphere and towards it, that meets the sphere.

    Args:
        ray: the footprint's middle.
        footprint: its changes along both edges.
        center: the sphere's.
        radius: the sphere's.

    Returns:
        The part, within [0, 1].
    """
    seen = _seen(ray, footprint, center, radius)
    return jnp.where(seen.small, _of_square(seen).part, covered(seen.distance, *seen.slopes))


def sphere_pieces(
    ray: Ray, footprint: tuple[Ray, Ray], center: Vec3, radius: Real
) -> tuple[Real, Piece, Piece]:
    """What the outline of a sphere makes of a footprint that comes from outside the sphere.

    Args:
        ray: the footprint's middle.
        footprint: its changes along both edges.
        center: the sphere's.
        radius: the sphere's.

    Returns:
        Distance along the ray to its line's point next to the centre. What lies within the outline,
        its middle where what grows as the root of the distance from the outline is its mean, as
        does the cosine to a sphere, and all that a ball of glass makes of it: of a strip along the
        outline a ninth nearer to it. And the rest.
    """
    seen = _seen(ray, footprint, center, radius)
    inner = choose(seen.small, _of_square(seen), half_plane(seen.distance, seen.slopes))
    x, y = inner.middle
    within = jnp.maximum(seen.distance + x * seen.slopes[0] + y * seen.slopes[1], 0.0)
    steep = seen.slopes[0] * seen.slopes[0] + seen.slopes[1] * seen.slopes[1]
    cut = (inner.part < 1) & (steep > 0) & ~seen.small
    back = jnp.where(cut, within * inverse(jnp.where(steep > 0, 9.0 * steep, 1.0)), 0.0)
    alike = inner._replace(middle=(x - back * seen.slopes[0], y - back * seen.slopes[1]))
    return seen.along, alike, rest_of(inner)


def rest_of(piece: Piece) -> Piece:
    """What a piece leaves of its footprint."""
    part = 1.0 - piece.part
    per = inverse(jnp.where(part > 0, part, 1.0))
    x, y = (jnp.clip(-m * piece.part * per, -0.5, 0.5) for m in piece.middle)
    (a, b), (c, d) = piece.edges
    taken = (a * a + c * c, a * b + c * d, b * b + d * d)
    own = _products(*piece.middle)
    twelfths = [
        jnp.where(part > 0, (all_of - piece.part * (spread + moved)) * per - off, 0.0)
        for all_of, spread, moved, off in zip(
            (1.0, 0.0, 1.0), taken, own, _products(x, y), strict=True
        )
    ]
    return Piece(part, (x, y), _parallelogram(*twelfths))


def _products(x: Real, y: Real) -> tuple[Real, Real, Real]:
    """Twelve times the products of two numbers."""
    return 12.0 * x * x, 12.0 * x * y, 12.0 * y * y


def _parallelogram(xx: Real, xy: Real, yy: Real) -> tuple[Pair, Pair]:
    """The one of these variances, times twelve, that has an edge along y."""
    least = least_square(xx)
    wide = safe_sqrt(xx, least)
    lean = xy * inverse(jnp.where(wide > 0, wide, 1.0))
    return (wide, lean), (0.0 * xx, safe_sqrt(yy - lean * lean, least))


def _of_square(seen: _Seen) -> Piece:
    """The piece of a footprint that a sphere covers which is taken for a square along its edges."""
    of_across, of_both, of_down = seen.squares
    across, down = (-edge.dot(seen.foot) for edge in seen.edges)
    per = inverse(seen.area * seen.area)
    centers = (across * of_down - down * of_both) * per, (down * of_across - across * of_both) * per
    square = seen.radius * safe_sqrt(np.pi * inverse(seen.area))
    of_across, of_down = (jnp.where(length > 0, length, 1.0) for length in (of_across, of_down))
    slender = safe_sqrt(safe_sqrt(of_down * inverse(of_across)))
    lengths, middles = [], []
    for center, width in zip(centers, (square * slender, square * inverse(slender)), strict=True):
        low = jnp.clip(center - 0.5 * width, -0.5, 0.5)
        high = jnp.clip(center + 0.5 * width, -0.5, 0.5)
        lengths.append(high - low)
        middles.append(0.5 * (high + low))
    x, y = lengths
    edges = (x, 0.0 * x), (0.0 * y, y)
    return Piece(lengths[0] * lengths[1], (middles[0], middles[1]), edges)


def half_plane(distance: Real, slopes: Pair) -> Piece:
    """The piece of a unit square on the positive side of a straight line.

    Args:
        distance: from the line to the square's middle, in any unit.
        slopes: its changes along both edges.
    """
    # As if the steeper edge came first, and both rose.
    rises = jnp.abs(slopes[0]), jnp.abs(slopes[1])
    swap = rises[1] > rises[0]
    steep, flat = choose(swap, rises[::-1], rises)
    level = steep <= 0
    per = inverse(jnp.where(level, 1.0, steep))
    border = jnp.where(level, jnp.where(distance > 0, -1.0, 1.0), -distance * per)
    strips = _strips(border, jnp.maximum(flat * per, SLANT))
    signs = [jnp.where(slope < 0, -1.0, 1.0) for slope in slopes]
    x, y = choose(swap, (strips.y, strips.x), (strips.x, strips.y))
    xx, yy = choose(swap, (strips.yy, strips.xx), (strips.xx, strips.yy))
    edges = _parallelogram(xx, strips.xy * (signs[0] * signs[1]), yy)
    return Piece(strips.part, (x * signs[0], y * signs[1]), edges)


class _Spread(NamedTuple):
    """Area, middle, and twelve times the variances, of a piece of a square."""

    part: Real
    x: Real
    y: Real
    xx: Real
    xy: Real
    yy: Real


def _strips(border: Real, slant: Real) -> _Spread:
    """What lies beyond x = `border` - `slant` · y, of the square from -½ to ½ both ways.

    Nothing where y is so small that the line is past the square, a polynomial of y where it is
    within, and all from where it is before it.
    """
    reach = inverse(slant)
    first = jnp.clip((border - 0.5) * reach, -0.5, 0.5)
    last = jnp.clip((border + 0.5) * reach, -0.5, 0.5)
    half, between, after = 0.5 * (last - first), 0.5 * (last + first), 0.5 - last
    zero, twelfth = 0.0 * after, 1.0 / 12.0
    # Each strip's area, its middle, and the variances about that.
    strips = [(after, zero, 0.5 * (0.5 + last), zero + twelfth, after * after * twelfth)]
    for node in GAUSS:
        y = between + node * half
        start = jnp.clip(border - slant * y, -0.5, 0.5)
        length = 0.5 - start
        strips.append((half * length, 0.5 * (0.5 + start), y, length * length * twelfth, zero))
    areas, *rest = (list(column) for column in zip(*strips, strict=True))
    part: Real = areas[0] + areas[1] + areas[2]
    shares = [area * inverse(jnp.where(part > 0, part, 1.0)) for area in areas]

    def mean(values: list[Real]) -> Real:
        products = [share * value for share, value in zip(shares, values, strict=True)]
        return products[0] + products[1] + products[2]

    x, y = mean(rest[0]), mean(rest[1])
    by, aside = [at - x for at in rest[0]], [at - y for at in rest[1]]
    xx = mean([b * b + own for b, own in zip(by, rest[2], strict=True)])
    yy = mean([a * a + own for a, own in zip(aside, rest[3], strict=True)])
    xy = mean([b * a for b, a in zip(by, aside, strict=True)])
    return _Spread(part, x, y, 12.0 * xx, 12.0 * xy, 12.0 * yy)
