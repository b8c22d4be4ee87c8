"""What a surface shows at a point, averaged over the footprint of a sample."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from diffdisp.dispersion import real_array
from diffdisp.vector import Real, Triple


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
    wide, narrow = _widths(across, down)
    return jnp.where(
        0.5 * (wide + narrow) <= 0.5, _near_edge(x, wide, narrow), _many_edges(x, wide, narrow)
    )


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
    return 0.5 + 0.5 * _filtered_sign(distance, *_widths(across, down))


def _widths(across: Real, down: Real) -> tuple[Real, Real]:
    """Widths of the wider and of the narrower of two boxes."""
    wide = jnp.maximum(jnp.abs(across), jnp.abs(down))
    return wide, jnp.maximum(jnp.minimum(jnp.abs(across), jnp.abs(down)), SLIVER * wide)


def _near_edge(x: Real, wide: Real, narrow: Real) -> Real:
    """The filtered wave where the footprint meets one edge at most; exact in float32 too."""
    edge = jnp.round(x)
    rising = 1.0 - 2.0 * jnp.abs(edge - 2.0 * jnp.round(0.5 * edge))
    return rising * _filtered_sign(x - edge, wide, narrow)


def _filtered_sign(x: Real, wide: Real, narrow: Real) -> Real:
    """Mean of the sign of x under two boxes convolved."""
    reach, flat, distance = 0.5 * (wide + narrow), 0.5 * (wide - narrow), jnp.abs(x)
    sharp = wide <= 0
    inner = 2.0 * distance / jnp.where(sharp, 1.0, wide)
    short = jnp.maximum(reach - distance, 0.0)
    outer = 1.0 - short * short / jnp.where(sharp, 1.0, wide * narrow)
    mean = jnp.where(sharp | (distance >= reach), 1.0, jnp.where(distance <= flat, inner, outer))
    return jnp.where(x < 0, -mean, mean)


def _many_edges(x: Real, wide: Real, narrow: Real) -> Real:
    """The filtered wave as a difference, over the wide box, of its integral under the narrow one.

    A second difference over both would cancel digits where the narrow box is a sliver.
    """
    size = jnp.where(wide > 0, wide, 1.0)
    return (_mean_ramp(x + 0.5 * wide, narrow) - _mean_ramp(x - 0.5 * wide, narrow)) / size


def _mean_ramp(x: Real, width: Real) -> Real:
    """Mean over a box of the integrated wave, which rises and falls between 0 and 1."""
    small = width <= 1.0
    half = 0.5 * jnp.where(small, width, 1.0)
    kink = jnp.round(x)
    rising = 1.0 - 2.0 * jnp.abs(kink - 2.0 * jnp.round(0.5 * kink))
    distance = jnp.abs(x - kink)
    near = distance < half
    rounded = (distance * distance + half * half) / jnp.where(near, 2.0 * half, 1.0)
    one_kink = rising * jnp.where(near, rounded, distance) + 0.5 * (1.0 - rising)
    broad = jnp.where(small, 1.0, width)
    difference = (_integrated(x + 0.5 * broad) - _integrated(x - 0.5 * broad)) / broad
    return jnp.where(small, one_kink, difference + 0.5)


def _integrated(x: Real) -> Real:
    """A periodic second integral of the square wave: a chain of parabolas."""
    inside = x - 2.0 * jnp.floor(0.5 * x)
    half = jnp.where(inside < 1.0, inside, inside - 1.0)
    return 0.5 * half * (half - 1.0) * jnp.where(inside < 1.0, 1.0, -1.0)
