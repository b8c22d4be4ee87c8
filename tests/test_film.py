import numpy as np
import pytest

from diffdisp.film import Film, band_middles


@pytest.mark.parametrize(("width", "height"), [(0, 4), (4, 0), (-1, 4)])
def test_an_empty_picture_is_refused(width, height):
    with pytest.raises(ValueError, match=f"{width}x{height}.*at least 1"):
        Film(width, height)


def test_no_bands_are_refused():
    with pytest.raises(ValueError, match="at least one wavelength"):
        Film(4, 4, wavelengths=[])


def test_channels():
    assert Film(4, 3).channels == 3
    assert Film(4, 3, wavelengths=[0.5]).channels == 1
    assert Film(4, 3, wavelengths=np.linspace(0.4, 0.7, 7)).channels == 7


def test_wavelengths_keep_all_their_digits():
    film = Film(4, 3, wavelengths=[0.1, 0.2])
    assert film.wavelengths.dtype == np.float64
    np.testing.assert_array_equal(film.wavelengths, [0.1, 0.2])


@pytest.mark.parametrize(
    ("low", "high", "count", "middles"),
    [
        (400.0, 700.0, 1, [0.55]),
        (400.0, 700.0, 3, [0.45, 0.55, 0.65]),
        (310.0, 330.0, 2, [0.315, 0.325]),
    ],
)
def test_middles_of_bands(low, high, count, middles):
    np.testing.assert_allclose(band_middles(low, high, count), middles, rtol=1e-15)


@pytest.mark.parametrize(
    ("low", "high", "count"),
    [
        (700.0, 400.0, 3),
        (400.0, 400.0, 3),
        (0.0, 700.0, 3),
        (-1.0, 700.0, 3),
        (400.0, 700.0, 0),
        (np.nan, 700.0, 3),
        (400.0, np.nan, 3),
        (400.0, np.inf, 3),
    ],
)
def test_impossible_bands_are_refused(low, high, count):
    with pytest.raises(ValueError, match="need 0 < low < high"):
        band_middles(low, high, count)
