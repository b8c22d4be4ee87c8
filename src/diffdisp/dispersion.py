"""How the index of a glass depends on the wavelength."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffdisp.vector import Real, Triple, module_of

LINE_D = 0.5875618
"""Helium d line, µm. Source: Schott TIE-29 (2016), table 1."""
LINE_F = 0.4861327
"""Hydrogen F line, µm. Source: Schott TIE-29 (2016), table 1."""
LINE_C = 0.6562725
"""Hydrogen C line, µm. Source: Schott TIE-29 (2016), table 1."""
LINE_G = 0.4358343
"""Mercury g line, µm. Source: Schott TIE-29 (2016), table 1."""


class Sellmeier(eqx.Module):
    """Three-term Sellmeier glass: `B` dimensionless, `C` in µm².

    Args:
        B: three oscillator strengths, dimensionless.
        C: three squared resonance wavelengths, µm².
        validity: shortest and longest wavelength the coefficients were fitted on, µm, in air.
        name: catalogue name; empty where the glass has none.
    """

    B: Triple = eqx.field(converter=lambda v: real_array(v))
    C: Triple = eqx.field(converter=lambda v: real_array(v))
    validity: Float[jax.Array | np.ndarray, "2"] = eqx.field(
        default=(0.0, np.inf), converter=lambda v: real_array(v)
    )
    name: str = eqx.field(static=True, default="")

    def refractive_index(self, wavelength: Real) -> Real:
        """Index relative to air: n² = 1 + Σᵢ Bᵢ λ² / (λ² - Cᵢ).

        Args:
            wavelength: λ in air, µm, within the range the coefficients were fitted on.

        Returns:
            n, dimensionless; NaN where n² < 0, next to a resonance; infinite on it.

        Source:
            Hartmann, Optical Glass (SPIE Press, 2014), eq. 3.12.
        """
        return jnp.sqrt(self._squared_index(wavelength))

    def _squared_index(self, wavelength: Any) -> Any:
        squared = wavelength * wavelength
        # Term by term: the tracer calls this for one glass at a time.
        first, *others = (self._term(i, squared) for i in range(3))
        return 1.0 + (first + (others[0] + others[1]))

    def _term(self, number: int, squared: Any) -> Any:
        """One of the terms; one of no strength has no pole."""
        B, gap = self.B[number], squared - self.C[number]
        both = module_of(B, gap)
        return B * squared / both.where((B == 0) & (gap == 0), 1.0, gap)

    def indices(
        self, wavelengths: Float[jax.Array | np.ndarray, " k"]
    ) -> Float[jax.Array | np.ndarray, " k"]:
        """`refractive_index` at each of `wavelengths` (K,), µm."""
        with np.errstate(divide="ignore", invalid="ignore"):
            squared = self._squared_index(wavelengths)
            return module_of(squared).sqrt(squared)

    @property
    def n_d(self) -> Real:
        """Index at the helium d line."""
        return self.refractive_index(np.asarray(LINE_D))

    @property
    def V_d(self) -> Real:
        """Abbe number (n_d - 1) / (n_F - n_C), dimensionless; infinite without dispersion."""
        n_F, n_C = (
            self.refractive_index(np.asarray(LINE_F)),
            self.refractive_index(np.asarray(LINE_C)),
        )
        return (self.n_d - 1.0) / (n_F - n_C)

    @property
    def P_gF(self) -> Real:
        """Relative partial dispersion (n_g - n_F) / (n_F - n_C), dimensionless."""
        n_F, n_C = (
            self.refractive_index(np.asarray(LINE_F)),
            self.refractive_index(np.asarray(LINE_C)),
        )
        return (self.refractive_index(np.asarray(LINE_G)) - n_F) / (n_F - n_C)


def real_array(value: object) -> np.ndarray | jax.Array:
    """A float64 NumPy array of `value`; arrays that JAX traces or holds pass unchanged.

    NumPy keeps all 53 bits whatever the state of JAX's x64 switch, which decides only later,
    when a program runs, in what precision it runs.
    """
    if isinstance(value, jax.Array):
        return value
    return np.asarray(value, dtype=np.float64)


def domain_error(glass: Sellmeier, low: float, high: float) -> str | None:
    """Why `glass` has no index somewhere in [`low`, `high`] µm, edges included; else None.

    Between two poles every term with B > 0 falls with the wavelength or is monotone, but terms
    of either sign may be mixed: n² is looked at on a fine grid and at both edges.
    """
    B, C = np.asarray(glass.B, np.float64), np.asarray(glass.C, np.float64)
    for b, c in zip(B, C, strict=True):
        if b != 0 and c >= 0 and low <= np.sqrt(c) <= high:
            return f"has a pole at {np.sqrt(c) * 1e3:.6g} nm"
    squared = np.linspace(low, high, 2001) ** 2
    squared[0], squared[-1] = low**2, high**2
    n_squared = np.ones_like(squared)
    for b, c in zip(B, C, strict=True):
        n_squared += b * squared / (squared - c) if b != 0 else 0.0
    bad = np.flatnonzero(~(n_squared > 0) | ~np.isfinite(n_squared))
    if len(bad):
        return f"has n² ≤ 0 at {np.sqrt(squared[bad[0]]) * 1e3:.6g} nm"
    return None
