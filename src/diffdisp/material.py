"""What surfaces are made of."""

import equinox as eqx

from diffdisp.dispersion import Sellmeier, real_array
from diffdisp.glasses import named_glass
from diffdisp.texture import Texture, as_texture
from diffdisp.vector import Real


class Dielectric(eqx.Module):
    """Smooth glass without absorption; `glass` is a `Sellmeier` or the name of one."""

    glass: Sellmeier = eqx.field(converter=lambda g: named_glass(g) if isinstance(g, str) else g)


class Emitter(eqx.Module):
    """A lamp that shines on both sides: radiance `intensity` × the colour of `texture`.

    Args:
        texture: a texture, or three numbers for one linear sRGB colour.
        intensity: factor, dimensionless, ≥ 0.
    """

    texture: Texture = eqx.field(converter=as_texture)
    intensity: Real = eqx.field(default=1.0, converter=real_array)


Material = Dielectric | Emitter
