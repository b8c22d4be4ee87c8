"""Glasses of the refractiveindex.info database, where the optional package holds a copy of it."""

import functools
import importlib.util
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffdisp.dispersion import Sellmeier
from diffdisp.glasses import glass_table, read_refractiveindex_yaml

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
    terms = _terms(_optical_glasses(folder)) if folder is not None else np.zeros((0, 6))
    if len(terms) > terms.shape[1]:  # enough to tell how the six vary together
        return RealGlasses(terms, "of the refractiveindex.info database")
    return RealGlasses(_terms(tuple(glass_table().values())), "of the table")


def _database() -> Path | None:
    """The folder of the database, where the package is installed and brings one."""
    package = importlib.util.find_spec(PACKAGE)
    if package is None or package.origin is None:
        return None
    folder = Path(package.origin).parent / "database" / "data"
    return folder if folder.is_dir() else None


@functools.cache
def _optical_glasses(folder: Path) -> tuple[Sellmeier, ...]:
    """The Sellmeier glasses among the makers' optical glasses, 1700 files, read in a second."""
    glasses = []
    for file in sorted(folder.glob("specs/*/optical/*.yml")):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # n in vacuum: its logarithms are the same here
            try:
                glasses.append(read_refractiveindex_yaml(file))
            except ValueError:  # another formula, or a table
                continue
    return tuple(glasses)


def _terms(glasses: tuple[Sellmeier, ...]) -> np.ndarray:
    """B and C (glasses, 6) of those that have three terms above 0, C rising."""
    B, C = (np.array([getattr(glass, name) for glass in glasses]).reshape(-1, 3) for name in "BC")
    order = np.argsort(C, axis=1)
    terms = np.concatenate([np.take_along_axis(part, order, 1) for part in (B, C)], axis=1)
    return np.unique(terms[(terms > 0).all(axis=1)], axis=0)
