"""The film: how large the picture is and what its last axis means."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from diffdisp.dispersion import real_array


class Film(eqx.Module):
    """Size of a picture, and its bands or colour.

    Args:
        width: pixels in a row.
        height: rows.
        wavelengths: (K,) µm in air for K monochromatic bands; None for linear sRGB under CIE 1931
            with equal-energy white at (1, 1, 1).

    Raises:
        ValueError: a size below 1, or no bands at all.
    """

    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    wavelengths: Float[jax.Array | np.ndarray, " k"] | None = eqx.field(
        default=None, converter=lambda w: None if w is None else real_array(w)
    )

    def __check_init__(self) -> None:
        """Refuse an empty picture."""
        if self.width < 1 or self.height < 1:
            raise ValueError(
                f"size {self.width}x{self.height}: width and height must be at least 1"
            )
        if self.wavelengths is not None and self.wavelengths.shape[0] < 1:
            raise ValueError("a film of bands needs at least one wavelength")

    @property
    def channels(self) -> int:
        """Length of the picture's last axis: K bands, or 3."""
        return 3 if self.wavelengths is None else self.wavelengths.shape[0]


def band_middles(low: float, high: float, count: int) -> np.ndarray:
    """Middles (count,) in µm of `count` equal bands between `low` and `high` nm.

    Raises:
        ValueError: `high` not above `low`, `low` not positive, or no band.
    """
    if not (0 < low < high < np.inf) or count < 1:
        raise ValueError(
            f"bands {low:g}:{high:g}:{count}: need 0 < low < high in nm and a count of at least 1"
        )
    return (low + (np.arange(count) + 0.5) * (high - low) / count) / 1e3
