"""The glasses that the prior of real glasses is made of."""

import numpy as np
import pytest
from helpers import BK7

from diffdisp import fitting
from diffdisp.glass_database import real_glasses
from diffdisp.glasses import glass_table

SOLD = [glass for glass in glass_table().values() if np.all(np.r_[glass.B, glass.C] > 0)][:10]
"""Glasses of three terms, C rising."""


def page(kind, *terms):
    """A file of the database."""
    numbers = " ".join(repr(float(x)) for x in np.ravel(terms))
    return (
        f"DATA:\n  - type: {kind}\n    wavelength_range: 0.3 2.5\n    coefficients: 0 {numbers}\n"
    )


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Writes a package like the optional one, with a database of some pages."""

    def write(pages):
        folder = tmp_path / "refractiveindex"
        folder.mkdir()
        (folder / "__init__.py").write_text("raise AssertionError('its code is not wanted')\n")
        for name, text in pages.items():
            file = folder / "database" / "data" / "specs" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
        monkeypatch.syspath_prepend(tmp_path)

    return write


def optical(glasses):
    """A page for each glass, as a maker's optical glasses are kept."""
    return {
        f"maker/optical/{glass.name}.yml": page("formula 2", np.stack([glass.B, glass.C], axis=1))
        for glass in glasses
    }


def test_optical_glasses_of_all_makers_count_once(package):
    first = SOLD[0]
    by_length = np.stack([first.B, np.sqrt(first.C)], axis=1)[::-1]
    others = {
        "other/optical/again.yml": page("formula 2", np.stack([first.B, first.C], axis=1)),
        # By falling C, and C as the resonance's wavelength.
        "other/optical/turned.yml": page("formula 1", by_length * [1.5, 1.0]),
        "other/optical/negative.yml": page("formula 2", 1.16, 0.0125, 0.32, -0.0032, 1.35, 119.2),
        "other/optical/two.yml": page("formula 2", 1.16, 0.0125, 1.35, 119.2),
        "other/optical/polynomial.yml": page("formula 3", 0.01, 2, 0.01, -2),
        "other/infrared/IRG.yml": page("formula 2", 3.6, 0.2, 1.9, 0.1, 0.9, 1400),
    }
    package(optical(SOLD) | others)
    found = real_glasses()
    assert found.source == "of the refractiveindex.info database"
    terms = [np.r_[glass.B, glass.C] for glass in SOLD] + [np.r_[first.B * 1.5, first.C]]
    expected = np.array(sorted(map(list, terms)))
    np.testing.assert_allclose(found.terms, expected, rtol=1e-12)  # squares of roots


@pytest.mark.parametrize("glasses", [[], SOLD[:6]])
def test_too_few_glasses_leave_the_table(package, glasses):
    package(optical(glasses))
    found = real_glasses()
    assert found.source == "of the table"
    # Lithium fluoride and diamond have two terms.
    assert len(found.terms) == len(glass_table()) - 2


def test_the_prior_is_the_spread_of_these_glasses(package):
    package(optical(SOLD))
    mean, rows = fitting._prior("catalogue", np.asarray(BK7.C), np.ones(6, bool))
    known = np.log([np.r_[glass.B, glass.C] for glass in SOLD]) @ rows.T - mean
    np.testing.assert_allclose(known.mean(axis=0), 0, atol=1e-9)  # of logarithms whitened by 1e3
    np.testing.assert_allclose(np.cov(known.T), np.eye(6), atol=1e-6)  # as before, squared
