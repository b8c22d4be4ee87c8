"""Glasses of the refractiveindex.info database, where the optional package holds a copy of it."""

import functools
import importlib.util
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffdisp.dispersion import Sellmeier
from diffdisp.glasses import glass_table, read_refractiveindex_yaml
from diffdisp.vector import Array

PACKAGE = "refractiveindex"
"""Holds the database itself since its version 1.2; earlier ones fetched it at first use."""


class RealGlasses(NamedTuple):
    """Glasses that are made, by which the coefficients of an unknown one are judged.

    Args:
        terms: (glasses, 6) B1 B2 B3 and C1 C2 C3 in µm², all above 0, C rising; each row once.
        source: what lists them, in words.
    """

    terms: np.ndarray
    source: str


def real_glasses() -> RealGlasses:
    """The optical glasses of all makers in the database; those of our table without the package."""
    folder = _database()
    terms = _optical_terms(folder) if folder is not None else np.zeros((0, 6))
    if len(terms) > terms.shape[1]:  # enough to tell how the six vary together
        return RealGlasses(terms, "of the refractiveindex.info database")
    return RealGlasses(_terms(list(glass_table().values())), "of the table")


def _database() -> Path | None:
    """The folder of the database, where the package is installed and brings one."""
    package = importlib.util.find_spec(PACKAGE)
    if package is None or package.origin is None:
        return None
    folder = Path(package.origin).parent / "database" / "data"
    return folder if folder.is_dir() else None


@functools.cache
def _optical_terms(folder: Path) -> np.ndarray:
    """`RealGlasses.terms` of the makers' optical glasses: 1700 files, read in a second."""
    glasses = []
    for file in sorted(folder.glob("specs/*/optical/*.yml")):
        with warnings.catch_warnings():
            # An index or a wavelength in vacuum: 3e-4 is nothing beside how glasses differ.
            warnings.simplefilter("ignore")
            try:
                glasses.append(read_refractiveindex_yaml(file))
            except ValueError:  # another formula, or a table
                continue
    return _terms(glasses)


def _terms(glasses: list[Sellmeier]) -> np.ndarray:
    """B and C (glasses, 6) of those that have three terms above 0, C rising."""
    rows = [np.concatenate([glass.B, glass.C])[by_C(glass.C)] for glass in glasses]
    terms = np.reshape(rows, (-1, 6))
    return np.unique(terms[(terms > 0).all(axis=1)], axis=0)


def by_C(C: Array) -> np.ndarray:
    """Order (6,) of B1 B2 B3 C1 C2 C3 in which C rises."""
    order = np.argsort(C)
    return np.concatenate([order, order + 3])
