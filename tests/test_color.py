import subprocess
import sys
from pathlib import Path

import colour
import numpy as np
import pytest

from diffdisp import color
from diffdisp.color import (
    albedo_basis,
    bands_to_rgb,
    channel_responses,
    check_visible,
    decode_srgb,
    encode_srgb,
    wavelength_strata,
)
from diffdisp.film import band_middles

# IEC 61966-2-1:1999, XYZ to linear sRGB.
XYZ_TO_RGB = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
# CIE 15:2018, 2° observer, in steps of 1 nm: the sums of the columns, and some rows.
XYZ_SUMS = (106.8655, 106.8569, 106.8922)
OBSERVER = {
    450: (0.3362, 0.0380, 1.77211),
    555: (0.512050, 1.0, 0.005750),
    600: (1.0622, 0.6310, 0.0008),
    700: (0.011359, 0.004102, 0.0),
}


def test_equal_energy_white_is_one():
    wavelength_nm, response = channel_responses()
    np.testing.assert_array_equal(wavelength_nm, np.arange(360, 831))
    np.testing.assert_allclose(response.sum(axis=0), 1, rtol=1e-14)


@pytest.mark.parametrize("row", OBSERVER.items())
def test_responses_are_the_published_observer(row):
    at, xyz = row
    wavelength_nm, response = channel_responses()
    expected = XYZ_TO_RGB @ xyz / (XYZ_TO_RGB @ XYZ_SUMS)
    # The printed values have 6 decimals, against responses of 1e-3 to 2e-2.
    np.testing.assert_allclose(response[wavelength_nm == at][0], expected, rtol=1e-4, atol=1e-8)


def test_daylight_is_the_white_of_srgb():
    # D65 is (1, 1, 1) in sRGB; here each channel is scaled to equal-energy white instead. The
    # matrix and its D65 (0.3127, 0.3290) are printed with four digits.
    wavelength_nm, response = channel_responses()
    daylight = colour.SDS_ILLUMINANTS["D65"]
    values = np.interp(wavelength_nm, daylight.wavelengths, daylight.values)
    rgb = values @ response * (XYZ_TO_RGB @ XYZ_SUMS)
    np.testing.assert_allclose(rgb / rgb[1], 1, atol=5e-4)


def test_tables_are_those_of_colour_science():
    with np.load(Path(color.__file__).with_name("tables.npz")) as kept:
        observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
        np.testing.assert_array_equal(kept["observer_nm"], observer.wavelengths)
        np.testing.assert_array_equal(kept["observer"], observer.values)
        basis = colour.recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019
        np.testing.assert_array_equal(kept["basis_nm"], basis.wavelengths)
        np.testing.assert_array_equal(kept["basis"], basis.values)
        np.testing.assert_array_equal(
            kept["xyz_to_srgb"], colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB
        )


def test_constants_cannot_be_written_to():
    with pytest.raises(ValueError, match="read-only"):
        channel_responses()[1][0] = 0
    with pytest.raises(ValueError, match="read-only"):
        wavelength_strata(4)[1][0] = 0


def test_colour_science_is_not_imported():
    program = """
import sys, numpy as np
import diffdisp.color
diffdisp.color.channel_responses()
diffdisp.color.albedo_basis(np.array([0.5]))
assert "colour" not in sys.modules
"""
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)


@pytest.mark.parametrize("color", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.8, 0.3, 0.05), (1, 1, 1)])
def test_one_bounce_has_the_color(color):
    wavelength_nm, response = channel_responses()
    reflectance = albedo_basis(wavelength_nm / 1e3) @ np.array(color, float)
    # Equal to rounding over the whole table, where the basis was made exact.
    np.testing.assert_allclose(reflectance @ response, color, atol=1e-14)
    # The range of bands and strata leaves out 5e-4 of the blue response.
    strata = wavelength_strata(4000)
    np.testing.assert_allclose(
        albedo_basis(strata[0]) @ np.array(color, float) @ strata[1], color, atol=4e-4
    )


def test_grey_stays_grey_in_each_band():
    basis = albedo_basis(np.linspace(0.3, 2.5, 1000))
    np.testing.assert_allclose(basis.sum(axis=1), 1, atol=1e-14)
    assert basis.min() > -0.015
    assert basis.max() < 1.015


def test_basis_is_near_the_published_one():
    # Mallett and Yuksel (2019) made theirs for D65; equal-energy white moves it by 3 %.
    published = colour.recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019
    ours = albedo_basis(published.wavelengths / 1e3)
    np.testing.assert_allclose(ours, published.values, atol=0.06)


def test_basis_holds_its_end_values():
    ends = albedo_basis(np.array([0.38, 0.78]))
    np.testing.assert_array_equal(albedo_basis(np.array([0.2, 5.0])), ends)


@pytest.mark.parametrize("count", [1, 2, 3, 16, 64])
def test_strata_against_direct_sums(count):
    wavelength_nm, response = channel_responses()
    # Middles of steps of 0.2 pm: none of the analytic integrals is used here.
    grid = np.linspace(380, 780, 2_000_001)
    middles = (grid[1:] + grid[:-1]) / 2
    fine = np.stack([np.interp(middles, wavelength_nm, r) for r in response.T], axis=-1)
    mass = np.abs(fine).sum(axis=-1).cumsum()
    part = mass / mass[-1]

    wavelength_um, weights = wavelength_strata(count)
    median = np.interp((np.arange(count) + 0.5) / count, part, grid[1:])
    np.testing.assert_allclose(wavelength_um * 1e3, median, atol=1e-6)

    stratum = np.minimum((part * count).astype(int), count - 1)
    sums = np.stack([np.bincount(stratum, column, count) for column in fine.T], axis=-1)
    # A step that straddles two strata is counted in one of them: 2e-4 nm of up to 2e-2 per nm.
    np.testing.assert_allclose(weights, sums / sums.sum(axis=0), atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 7, 16, 1024])
def test_white_stays_white_at_any_count(count):
    wavelength_um, weights = wavelength_strata(count)
    np.testing.assert_allclose(weights.sum(axis=0), 1, rtol=1e-14)
    assert np.all(np.diff(wavelength_um) > 0)
    assert wavelength_um.min() > 0.38
    assert wavelength_um.max() < 0.78


def test_strata_have_negative_weights():
    # Around 500 nm the red response is negative: no light of one wavelength is inside sRGB.
    wavelength_um, weights = wavelength_strata(16)
    assert weights[np.argmin(np.abs(wavelength_um - 0.5)), 0] < 0


@pytest.mark.parametrize("count", [0, -1])
def test_no_strata_is_refused(count):
    with pytest.raises(ValueError, match=f"{count} strata"):
        wavelength_strata(count)


@pytest.mark.parametrize(
    "bands", [(400.0, 700.0, 8), (380.0, 780.0, 41), (500.0, 600.0, 1), (400.0, 700.0, 1)]
)
def test_white_bands_are_white(bands):
    rgb = bands_to_rgb(np.full((2, 3, bands[2]), 0.5), band_middles(*bands))
    np.testing.assert_allclose(rgb, np.full((2, 3, 3), 0.5), rtol=1e-13)


def test_bands_against_colour_science():
    # A smooth spectrum through the package's own integration, then the published matrix.
    domain = np.arange(360, 781)
    spectrum = 0.2 + 0.6 * np.exp(-(((domain - 560) / 60) ** 2))
    distribution = colour.SpectralDistribution(spectrum, domain)
    xyz = colour.sd_to_XYZ(distribution, method="Integration", k=1)
    expected = XYZ_TO_RGB @ xyz / (XYZ_TO_RGB @ XYZ_SUMS)
    middles = band_middles(380.0, 780.0, 40)
    rgb = bands_to_rgb(np.interp(middles * 1e3, domain, spectrum), middles)
    # 40 bands of 10 nm, and the ends that the visible range leaves out.
    np.testing.assert_allclose(rgb, expected, atol=5e-4)


@pytest.mark.parametrize("outside", [[0.379, 0.5], [0.5, 0.7801], [1.0]])
def test_bands_outside_the_visible_are_refused(outside):
    with pytest.raises(ValueError, match=r"380-780 nm only; found .* to .* nm"):
        bands_to_rgb(np.ones(len(outside)), np.array(outside))


def test_edges_of_the_visible_in_float32_are_inside():
    check_visible(np.array([0.38, 0.78], np.float32))


@pytest.mark.parametrize(
    ("linear", "encoded"),
    [
        (0.0, 0.0),
        (1.0, 1.0),
        (0.0031308, 0.040449936),  # the knee, 12.92 times
        (0.18, 118 / 255),  # mid grey, to the nearest of 255
        (0.214041, 0.5),
        (-1.0, 0.0),
        (7.0, 1.0),
    ],
)
def test_published_points_of_the_curve(linear, encoded):
    assert encode_srgb(np.array(linear)) == pytest.approx(
        encoded, abs=0.5 / 255 if linear == 0.18 else 1e-6
    )


def test_decoding_undoes_encoding():
    linear = np.linspace(0, 1, 4001)
    # The knee is printed with five digits: the two branches miss each other by 3e-8.
    np.testing.assert_allclose(decode_srgb(encode_srgb(linear)), linear, atol=1e-7)
    assert np.isfinite(decode_srgb(np.array([-3.0, 2.0]))).all()
