"""What a surface shows at a point, averaged over the footprint of a sample."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from diffdisp.dispersion import real_array
from diffdisp.vector import Real, Triple, choose, inverse

Pair = tuple[Real, Real]


class Solid(eqx.Module):
    """One colour everywhere; `color` is linear sRGB, each channel ≥ 0."""

    color: Triple = eqx.field(converter=real_array)


class Checker2D(eqx.Module):
    """Square tiles on a plane, in the plane's own axes; a corner of four lies on its `point`.

    Args:
        even: linear sRGB of the tile with both coordinates positive, and of every second one.
        odd: linear sRGB of the others.
        tile: width of a tile, scene units, > 0.
    """

    even: Triple = eqx.field(converter=real_array)
    odd: Triple = eqx.field(converter=real_array)
    tile: Real = eqx.field(converter=real_array)


class Checker(eqx.Module):
    """Cubes in space: `even` where sin(s·x)·sin(s·y)·sin(s·z) ≥ 0, else `odd`.

    Args:
        even: linear sRGB.
        odd: linear sRGB.
        scale: s, radians per scene unit, > 0; a cube's edge is π/s.
    """

    even: Triple = eqx.field(converter=real_array)
    odd: Triple = eqx.field(converter=real_array)
    scale: Real = eqx.field(default=10.0, converter=real_array)


Texture = Solid | Checker | Checker2D


def as_texture(value: Any) -> Texture:
    """A texture as it is; three numbers as the `Solid` they abbreviate."""
    if isinstance(value, Texture):
        return value
    return Solid(value)


@jax.custom_jvp
def filtered_square_wave(x: Real, across: Real, down: Real) -> Real:
    """Mean of a square wave under two boxes convolved: the marginal of a parallelogram.

    The wave is +1 on (0, 1), -1 on (1, 2) and has period 2.

    Args:
        x: the middle of the footprint, in tiles.
        across: how far the footprint's one edge reaches, in tiles; any sign.
        down: the same for its other edge.

    Returns:
        The mean, within [-1, 1]; its derivatives are finite everywhere and continuous but where
        a footprint begins to touch a second edge.
    """
    return _mean_wave(x, _boxes(across, down))


@filtered_square_wave.defjvp
def _filtered_square_wave_jvp(
    primals: tuple[Real, Real, Real], tangents: tuple[Real, Real, Real]
) -> tuple[Real, Real]:
    """The slope in closed form, which takes a fraction of what following the mean's steps does."""
    x, across, down = primals
    move, *changes = tangents
    widens, other = (
        jnp.where(edge < 0, -change, change)
        for edge, change in zip((across, down), changes, strict=True)
    )
    boxes = _boxes(across, down)
    widens, other = choose(jnp.abs(down) > jnp.abs(across), (other, widens), (widens, other))
    sliver = jnp.minimum(jnp.abs(across), jnp.abs(down)) <= SLIVER * boxes.wide
    grows = jnp.where(sliver, SLIVER * widens, other)
    mean = _mean_wave(x, boxes)
    many = _slope_of_many(x, move, boxes, widens, grows, mean)
    near = _slope_near(x, move, boxes, widens, grows)
    return mean, jnp.where(boxes.wide + boxes.narrow <= 1.0, near, many)


def _slope_near(x: Real, move: Real, boxes: "_Boxes", widens: Real, grows: Real) -> Real:
    """That of the mean where one edge is met at most, with these changes of its place and boxes."""
    wide, narrow, of_wide, of_narrow = boxes
    edge = jnp.round(x)
    offset = x - edge
    distance, away = jnp.abs(offset), jnp.where(offset < 0, -move, move)
    over = distance - 0.5 * (wide - narrow)
    # Of the narrow box this part is on the far side of the edge.
    part = jnp.maximum(over, 0.0) * of_narrow
    further = away - 0.5 * (widens - grows)
    slope = 2.0 * away - part * (2.0 * further - part * grows)
    slope = (slope - (2.0 * distance - part * part * narrow) * (of_wide * widens)) * of_wide
    rising = _parity(edge)
    slope = jnp.where(over < narrow, rising * slope, 0.0)
    return jnp.where(offset < 0, -slope, slope)


def _slope_of_many(
    x: Real, move: Real, boxes: "_Boxes", widens: Real, grows: Real, mean: Real
) -> Real:
    """The same wherever. The mean is a second difference; this is one of the integrated wave."""
    wide, narrow, of_wide, of_narrow = boxes
    x = x - 2.0 * jnp.round(0.5 * x)
    total = 0.0 * x
    for end in (0.5, -0.5):
        for side in (0.5, -0.5):
            place = x + (end * wide + side * narrow)
            height = jnp.abs(place - 2.0 * jnp.round(0.5 * place))
            term = height * (move + (end * widens + side * grows))
            total = total + term if end == side else total - term
    return total * (of_wide * of_narrow) - mean * (of_wide * widens + of_narrow * grows)


def filtered_tiles(middle: Pair, across: Pair, down: Pair) -> Real:
    """Mean over a parallelogram of the product of two square waves: +1 on even tiles, -1 on odd.

    The product of both means, which is that of a rectangle along the tiles; but where no more than
    one edge each way is met, exact, with the corner of four tiles that may lie within.

    Args:
        middle: of the footprint, in tiles along both axes.
        across: the footprint's one edge, in tiles.
        down: its other edge.

    Returns:
        The mean, within [-1, 1].
    """
    waves = [filtered_square_wave(*wave) for wave in zip(middle, across, down, strict=True)]
    reaches = [jnp.abs(a) + jnp.abs(b) for a, b in zip(across, down, strict=True)]
    met = _around_corner(middle, across, down)
    return jnp.where((reaches[0] <= 1.0) & (reaches[1] <= 1.0), met, waves[0] * waves[1])


def _around_corner(middle: Pair, across: Pair, down: Pair) -> Real:
    """The mean of the product of both signs about the nearest corner of four tiles."""
    corner = [jnp.round(x) for x in middle]
    cells = corner[0] + corner[1]
    even = _parity(cells)
    at = (middle[0] - corner[0], middle[1] - corner[1])
    swap = _dot(down, down) > _dot(across, across)
    long, short = choose(swap, (down, across), (across, down))
    # In units of the long edge: on large tiles the fourth power of a footprint, which is in the
    # slope of what is divided, is not a number of float32.
    reach = jax.lax.stop_gradient(jnp.abs(long[0]) + jnp.abs(long[1]))
    unit = inverse(jnp.where(reach <= 0, 1.0, reach))
    along, aside = ((edge[0] * unit, edge[1] * unit) for edge in (long, short))
    square, area = _dot(along, along), _cross(along, aside)
    wider = jnp.maximum(SLIVER - jnp.abs(area) * inverse(jnp.where(square <= 0, 1.0, square)), 0.0)
    wider = jnp.where(area < 0, -wider, wider)
    short = (short[0] - wider * long[1], short[1] + wider * long[0])
    return even * _product_over(at, long, short)


@jax.custom_jvp
def _product_over(at: Pair, long: Pair, short: Pair) -> Real:
    """Mean of the product of both coordinates' signs over a parallelogram.

    By Green's theorem: the product is constant along rays from the corner, so the integral of it
    over the parallelogram is half of that of it times (x dy - y dx) along the border, and
    x dy - y dx is constant on each edge.

    Args:
        at: its middle.
        long: one of its edges.
        short: the other.
    """
    return _mean_of(_sides(at, long, short), _over_edges(at, long, short))


@_product_over.defjvp
def _product_over_jvp(
    primals: tuple[Pair, Pair, Pair], tangents: tuple[Pair, Pair, Pair]
) -> tuple[Real, Real]:
    """What the means along the sides tell of the slopes: what crosses a side counts as it does.

    With p + s·long + t·short a point, and a change of it made up of both edges, the integral over
    one of s and t is that of a derivative; where the change grows with s or t itself, by parts.
    """
    _, long, short = primals
    sides = _sides(*primals)
    along, aside = sides
    mean = _mean_of(sides, _over_edges(*primals))
    (move_long, move_short), (long_long, long_short), (short_long, short_short) = (
        _over_edges(change, long, short) for change in tangents
    )
    slope = (
        move_long * (aside[1].mean - aside[0].mean)
        + move_short * (along[1].mean - along[0].mean)
        + long_long * (0.5 * (aside[0].mean + aside[1].mean) - mean)
        + long_short * (along[1].moment - along[0].moment)
        + short_long * (aside[1].moment - aside[0].moment)
        + short_short * (0.5 * (along[0].mean + along[1].mean) - mean)
    )
    return mean, slope


class _Side(NamedTuple):
    """Mean of the product of both signs along a line, and of that times the place from -½ to ½."""

    mean: Real
    moment: Real


_Sides = tuple[tuple[_Side, _Side], tuple[_Side, _Side]]
"""Of a parallelogram: those along its one edge, before and after its middle; then the others."""


def _sides(at: Pair, long: Pair, short: Pair) -> _Sides:
    before, after = (
        (
            _along((at[0] + sign * short[0], at[1] + sign * short[1]), long),
            _along((at[0] + sign * long[0], at[1] + sign * long[1]), short),
        )
        for sign in (-0.5, 0.5)
    )
    return (before[0], after[0]), (before[1], after[1])


def _over_edges(vector: Pair, long: Pair, short: Pair) -> Pair:
    """A vector as so much of both edges of a parallelogram; of a point, which has none, nothing."""
    area = _cross(long, short)
    of_area = inverse(jnp.where(area == 0, 1.0, area))
    return _cross(vector, short) * of_area, _cross(long, vector) * of_area


def _mean_of(sides: _Sides, place: Pair) -> Real:
    along, aside = sides
    border = along[0].mean + along[1].mean + aside[0].mean + aside[1].mean
    tilt = place[0] * (aside[1].mean - aside[0].mean) + place[1] * (along[1].mean - along[0].mean)
    return 0.25 * border + 0.5 * tilt


def _along(middle: Pair, edge: Pair) -> _Side:
    """The product of both coordinates' signs along a line of some middle and extent."""
    signs, places = [], []
    for x, extent in zip(middle, edge, strict=True):
        crosses = jnp.abs(x) < 0.5 * jnp.abs(extent)
        start = jnp.where(crosses, -extent, x)
        signs.append(jnp.where(start < 0, -1.0, 1.0))
        # What does not change its sign might as well do so at the very end.
        # Divided by whether it does or not: both sides of a parallelogram share the quotient.
        places.append(jnp.where(crosses, -x * inverse(jnp.where(extent == 0, 1.0, extent)), 0.5))
    sign, apart = signs[0] * signs[1], jnp.abs(places[0] - places[1])
    return _Side(sign * (1.0 - 2.0 * apart), -sign * apart * (places[0] + places[1]))


def _parity(whole: Real) -> Real:
    """+1 of an even number, -1 of an odd one."""
    return 1.0 - 2.0 * jnp.abs(whole - 2.0 * jnp.round(0.5 * whole))


def _dot(a: Pair, b: Pair) -> Real:
    return a[0] * b[0] + a[1] * b[1]


def _cross(a: Pair, b: Pair) -> Real:
    return a[0] * b[1] - a[1] * b[0]


SLIVER = 1e-3
"""A box narrower than this part of the other counts as so wide: it smooths nothing, but dividing by
less would cancel digits."""


def covered(distance: Real, across: Real, down: Real) -> Real:
    """Part of a footprint that lies on the positive side of a straight edge.

    Args:
        distance: from the edge to the middle of the footprint, in any unit.
        across: what the footprint's one edge adds to it; any sign.
        down: the same for its other edge.

    Returns:
        The part, within [0, 1].
    """
    return 0.5 + 0.5 * _filtered_sign(distance, _boxes(across, down))


class _Boxes(NamedTuple):
    """Widths of the wider and of the narrower of two boxes, and one over each."""

    wide: Real
    narrow: Real
    of_wide: Real
    of_narrow: Real


def _boxes(across: Real, down: Real) -> _Boxes:
    """The boxes that the edges of a footprint are along one axis; a sliver counts as wider."""
    across, down = jnp.abs(across), jnp.abs(down)
    wide = jnp.maximum(across, down)
    narrow = jnp.maximum(jnp.minimum(across, down), SLIVER * wide)
    sharp = wide <= 0
    of_wide, of_narrow = (inverse(jnp.where(sharp, 1.0, width)) for width in (wide, narrow))
    return _Boxes(wide, narrow, of_wide, of_narrow)


def _mean_wave(x: Real, boxes: _Boxes) -> Real:
    """The filtered wave."""
    return jnp.where(boxes.wide + boxes.narrow <= 1.0, _near_edge(x, boxes), _many_edges(x, boxes))


def _near_edge(x: Real, boxes: _Boxes) -> Real:
    """The filtered wave where the footprint meets one edge at most; exact in float32 too."""
    edge = jnp.round(x)
    rising = _parity(edge)
    return rising * _filtered_sign(x - edge, boxes)


def _filtered_sign(x: Real, boxes: _Boxes) -> Real:
    """Mean of the sign of x under two boxes convolved."""
    wide, narrow, of_wide, of_narrow = boxes
    reach, flat, distance = 0.5 * (wide + narrow), 0.5 * (wide - narrow), jnp.abs(x)
    inner = 2.0 * distance * of_wide
    short = jnp.maximum(reach - distance, 0.0)
    outer = 1.0 - (short * of_wide) * (short * of_narrow)
    mean = jnp.where(distance >= reach, 1.0, jnp.where(distance <= flat, inner, outer))
    return jnp.where(x < 0, -mean, mean)


def _many_edges(x: Real, boxes: _Boxes) -> Real:
    """The filtered wave as a difference, over the wide box, of its integral under the narrow one.

    A second difference over both would cancel digits where the narrow box is a sliver.
    """
    high, low = (_mean_ramp(x + sign * boxes.wide, boxes) for sign in (0.5, -0.5))
    return (high - low) * boxes.of_wide


def _mean_ramp(x: Real, boxes: _Boxes) -> Real:
    """Mean over the narrow box of the integrated wave, which rises and falls between 0 and 1."""
    width = boxes.narrow
    half = 0.5 * width
    kink = jnp.round(x)
    rising = _parity(kink)
    distance = jnp.abs(x - kink)
    rounded = (distance * distance + half * half) * boxes.of_narrow
    one_kink = rising * jnp.where(distance < half, rounded, distance) + 0.5 * (1.0 - rising)
    difference = (_integrated(x + half) - _integrated(x - half)) * boxes.of_narrow
    return jnp.where(width <= 1.0, one_kink, difference + 0.5)


def _integrated(x: Real) -> Real:
    """A periodic second integral of the square wave: a chain of parabolas."""
    inside = x - 2.0 * jnp.floor(0.5 * x)
    half = jnp.where(inside < 1.0, inside, inside - 1.0)
    return 0.5 * half * (half - 1.0) * jnp.where(inside < 1.0, 1.0, -1.0)
