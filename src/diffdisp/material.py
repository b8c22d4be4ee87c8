"""What surfaces are made of."""

import equinox as eqx

from diffdisp.dispersion import Sellmeier, real_array
from diffdisp.glasses import named_glass
from diffdisp.texture import Texture, as_texture
from diffdisp.vector import Real


class Dielectric(eqx.Module):
    """Smooth glass without absorption; `glass` is a `Sellmeier` or the name of one."""

    glass: Sellmeier = eqx.field(converter=lambda g: named_glass(g) if isinstance(g, str) else g)


class Lambertian(eqx.Module):
    """Matte: scatters light evenly, whatever way it is looked at.

    Args:
        texture: its albedo; a texture, or three numbers for one linear sRGB colour. Above 1 in a
            channel a surface would give off more light than falls on it.
    """

    texture: Texture = eqx.field(converter=as_texture)


class Metal(eqx.Module):
    """A mirror, smooth or brushed.

    Args:
        texture: its reflectance; a texture, or three numbers for one linear sRGB colour.
        fuzz: radius, ≥ 0, of the ball of which a uniform point is added to the unit vector of
            the mirror direction. What then points below the surface is absorbed.
    """

    texture: Texture = eqx.field(converter=as_texture)
    fuzz: Real = eqx.field(default=0.0, converter=real_array)


class Emitter(eqx.Module):
    """A lamp that shines on both sides: radiance `intensity` × the colour of `texture`.

    Args:
        texture: a texture, or three numbers for one linear sRGB colour.
        intensity: factor, dimensionless, ≥ 0.
    """

    texture: Texture = eqx.field(converter=as_texture)
    intensity: Real = eqx.field(default=1.0, converter=real_array)


Material = Lambertian | Metal | Dielectric | Emitter
