"""Spectra as seen by a colour film: CIE 1931, linear sRGB, encoded sRGB.

All constants are NumPy's. Those that are published tables come from colour-science, by way of
`tables.npz`, which `fixtures/make_tables.py` writes: importing the package itself costs 0.75 s.
"""

import functools
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

VISIBLE = (380.0, 780.0)
"""Ends of the visible range, nm. Source: CIE 15:2018 has it suffice for colorimetry; beyond it lie
0.05 % of the blue response and less of the others."""

SRGB_SLOPE, SRGB_OFFSET, SRGB_EXPONENT = 12.92, 0.055, 2.4
"""Constants of the sRGB transfer curve. Source: IEC 61966-2-1:1999."""
SRGB_LINEAR_KNEE, SRGB_ENCODED_KNEE = 0.0031308, 0.04045
"""Where the curve's straight part ends, linear and encoded. Source: IEC 61966-2-1:1999."""

ROUNDING_NM = 1e-3
"""How far outside `VISIBLE` a wavelength may lie: float32 µm are good to 3e-5 nm."""


def channel_responses() -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """How strongly each linear sRGB channel answers to each wavelength.

    The colour-matching functions times the XYZ-to-sRGB matrix, each channel scaled so that its
    values sum to 1 over the table's steps of 1 nm: equal-energy white of radiance 1 is (1, 1, 1).

    Returns:
        Wavelengths in nm, 360 to 830 in steps of 1; responses in 1/nm, partly negative.
        Read-only, made once.

    Source:
        CIE 1931 2° standard observer (CIE 15:2018) and the matrix of IEC 61966-2-1:1999, both
        as tabulated by colour-science.
    """
    return _channel_responses()


@functools.cache
def _channel_responses() -> tuple[np.ndarray, np.ndarray]:
    tables = _tables()
    response = tables["observer"] @ tables["xyz_to_srgb"].T
    return _frozen(tables["observer_nm"]), _frozen(response / response.sum(axis=0))


def albedo_basis(
    wavelengths_um: Float[jax.Array | np.ndarray, " k"],
) -> Float[np.ndarray, "k 3"]:
    """Reflectance at each wavelength of a surface that is pure red, green or blue.

    A colour's reflectance spectrum is `albedo_basis(wavelengths) @ color`. Lit by equal-energy
    white it has exactly that colour, and a grey is the same grey at every wavelength. Both need
    a basis slightly outside [0, 1] (-0.015 to 1.014) near the pure colours.

    Args:
        wavelengths_um: µm; outside 380-780 nm the end values are held.

    Returns:
        Dimensionless; the three sum to 1 at each wavelength.

    Source:
        Mallett and Yuksel, Spectral Primary Decomposition for Rendering with sRGB Reflectance
        (EGSR 2019), as tabulated by colour-science.
    """
    table_nm, basis = _albedo_table()
    return _interpolate(np.asarray(wavelengths_um, np.float64) * 1e3, table_nm, basis)


@functools.cache
def _albedo_table() -> tuple[np.ndarray, np.ndarray]:
    """The published basis (every 5 nm), made exact under `channel_responses`."""
    table_nm, basis = _tables()["basis_nm"], _tables()["basis"]
    # The published sums are 1 to 1e-5. Made exact first, each row of the matrix below sums to 1,
    # so each row of its inverse does, and the product keeps both properties to rounding.
    basis = basis / basis.sum(axis=1, keepdims=True)
    wavelength_nm, response = channel_responses()
    # Channel c of the light that basis function j reflects; the identity for D65 white.
    channels = response.T @ _interpolate(wavelength_nm, table_nm, basis)
    return _frozen(table_nm), _frozen(basis @ np.linalg.inv(channels))


def wavelength_strata(
    count: int,
) -> tuple[Float[np.ndarray, " count"], Float[np.ndarray, "count 3"]]:
    """One wavelength, and its weight in each channel, for each of `count` samples of a pixel.

    The strata divide 380-780 nm into parts of equal probability under p(λ) ∝ Σ_c |r_c(λ)|. A
    stratum's wavelength halves its probability; its weight is its whole integral of r_c, negative
    lobes included, so that white stays white at any count.

    Args:
        count: number of strata, at least 1.

    Returns:
        Wavelengths in µm, rising; weights, dimensionless, each channel summing to 1. Read-only.

    Raises:
        ValueError: `count` below 1.
    """
    if count < 1:
        raise ValueError(f"{count} strata of the spectrum: need at least 1")
    return _wavelength_strata(count)


@functools.cache
def _wavelength_strata(count: int) -> tuple[np.ndarray, np.ndarray]:
    knots_nm, response = _visible_knots()
    positions_nm = _quantiles(
        knots_nm, np.abs(response).sum(axis=1), np.linspace(0.0, 1.0, 2 * count + 1)
    )
    # Edges at the even positions, medians between them at the odd ones.
    weights = np.diff(_integral(knots_nm, response, positions_nm[::2]), axis=0)
    # What the range cuts off (5e-4 of blue) is given back, else white would turn darker.
    return _frozen(positions_nm[1::2] / 1e3), _frozen(weights / weights.sum(axis=0))


def _visible_knots() -> tuple[np.ndarray, np.ndarray]:
    """The responses over `VISIBLE`, with each zero crossing a knot: |r_c| is linear between."""
    wavelength_nm, response = channel_responses()
    left, right = response[:-1], response[1:]
    segment, channel = np.nonzero(left * right < 0)
    below, above = left[segment, channel], right[segment, channel]
    step = np.diff(wavelength_nm)[segment]
    crossings = wavelength_nm[segment] + step * below / (below - above)
    knots = np.union1d(wavelength_nm, crossings)
    knots = knots[(knots >= VISIBLE[0]) & (knots <= VISIBLE[1])]
    return knots, _interpolate(knots, wavelength_nm, response)


def _integral(knots: np.ndarray, values: np.ndarray, upto: np.ndarray) -> np.ndarray:
    """∫ (m, c) of piecewise-linear columns (n, c) from the first knot to each of `upto` (m,)."""
    step = np.diff(knots)[:, None]
    whole = np.zeros_like(values)
    np.cumsum((values[:-1] + values[1:]) / 2 * step, axis=0, out=whole[1:])
    i = _segment(knots, upto)
    along = (upto - knots[i])[:, None]
    slope = (values[i + 1] - values[i]) / step[i]
    return np.asarray(whole[i] + along * (values[i] + slope * along / 2))


def _quantiles(knots: np.ndarray, density: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Where the integral of a positive piecewise-linear density reaches `levels` of its total."""
    reached = _integral(knots, density[:, None], knots)[:, 0]
    mass = levels * reached[-1]
    i = _segment(reached, mass)
    missing = mass - reached[i]
    slope = (density[i + 1] - density[i]) / (knots[i + 1] - knots[i])
    # The root of density·t + slope·t²/2 = missing that stays exact as the slope vanishes; its
    # square lies between those of the segment's two ends, but for rounding.
    root = np.sqrt(np.maximum(density[i] ** 2 + 2 * slope * missing, 0.0))
    return np.asarray(np.clip(knots[i] + 2 * missing / (density[i] + root), knots[0], knots[-1]))


def _segment(rising: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Index of the last of `rising`, but for its end, that `at` has reached."""
    return np.clip(np.searchsorted(rising, at, side="right") - 1, 0, len(rising) - 2)


def bands_to_rgb(
    radiance: Float[np.ndarray, "*batch k"],
    wavelengths_um: Float[jax.Array | np.ndarray, " k"],
) -> Float[np.ndarray, "*batch 3"]:
    """Linear sRGB of a spectrum known in bands, by a sum over their middles.

    Each channel is scaled by the sum of its responses at the bands, so that equal-energy white
    is (1, 1, 1) for any choice of bands. Few bands within one part of the spectrum can make
    that sum small, and colours far from white then large.

    Args:
        radiance: one value per band.
        wavelengths_um: middles of equal bands, µm, within 380-780 nm.

    Raises:
        ValueError: a wavelength outside 380-780 nm, or a channel that none of the bands reaches.
    """
    check_visible(wavelengths_um)
    wavelengths_nm = np.asarray(wavelengths_um, np.float64) * 1e3
    response = _interpolate(wavelengths_nm, *channel_responses())
    white = response.sum(axis=0)
    if np.any(white == 0):
        raise ValueError("these bands give no colour: one channel's responses to them sum to 0")
    return np.asarray(np.asarray(radiance, np.float64) @ (response / white))


def check_visible(wavelengths_um: Float[jax.Array | np.ndarray, " k"]) -> None:
    """Refuse bands that have no colour.

    Args:
        wavelengths_um: µm.

    Raises:
        ValueError: a wavelength outside 380-780 nm; the message names the range of both.
    """
    wavelengths_nm = np.asarray(wavelengths_um, np.float64) * 1e3
    low, high = VISIBLE
    inside = (wavelengths_nm >= low - ROUNDING_NM) & (wavelengths_nm <= high + ROUNDING_NM)
    if not inside.all():
        found = f"{wavelengths_nm.min():.6g} to {wavelengths_nm.max():.6g} nm"
        raise ValueError(f"bands have a colour within {low:g}-{high:g} nm only; found {found}")


def encode_srgb(linear: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The sRGB transfer curve, of `linear` clipped to 0..1.

    Args:
        linear: linear sRGB, dimensionless.

    Returns:
        0..1, to be scaled to the integers of a file.

    Source:
        IEC 61966-2-1:1999.
    """
    clipped = np.clip(linear, 0.0, 1.0)
    curved = (1 + SRGB_OFFSET) * clipped ** (1 / SRGB_EXPONENT) - SRGB_OFFSET
    return np.asarray(np.where(clipped <= SRGB_LINEAR_KNEE, SRGB_SLOPE * clipped, curved))


def decode_srgb(encoded: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Linear sRGB of `encoded`: the inverse of `encode_srgb`.

    Args:
        encoded: 0..1.

    Returns:
        0..1.

    Source:
        IEC 61966-2-1:1999.
    """
    straight = encoded <= SRGB_ENCODED_KNEE
    # Guarded: the power of a negative base is NaN, and its warning an error to some callers.
    base = (np.where(straight, 1.0, encoded) + SRGB_OFFSET) / (1 + SRGB_OFFSET)
    return np.where(straight, encoded / SRGB_SLOPE, base**SRGB_EXPONENT)


@functools.cache
def _tables() -> dict[str, np.ndarray]:
    """The published tables by name."""
    with np.load(Path(__file__).with_name("tables.npz")) as file:
        return {name: file[name] for name in file.files}


def _interpolate(at: np.ndarray, table: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Each column linearly at `at`; end values held outside the table."""
    return np.stack([np.interp(at, table, column) for column in columns.T], axis=-1)


def _frozen(array: np.ndarray) -> np.ndarray:
    """The array, read-only: it is cached, and whoever wrote into it would change it for all."""
    array.flags.writeable = False
    return array
