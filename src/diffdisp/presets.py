"""Numbers of samples that have a name, and what was measured of them."""

from typing import NamedTuple

MEASURED = "2026-12-03"
"""When `benchmarks/presets.py` measured the errors: colour pictures, 160 x 120 pixels, float32."""


class Preset(NamedTuple):
    """A point where error and time are traded well for each other.

    Args:
        samples: per pixel.
        bench: measured relative root mean square error of the bench's picture.
        gallery: the smallest and the largest of the gallery's, where light scatters.
    """

    samples: int
    bench: float
    gallery: tuple[float, float]

    def __str__(self) -> str:
        """What was measured."""
        low, high = self.gallery
        return (
            f"measured {MEASURED}: errors of {100 * self.bench:.2g} % on the bench,"
            f" {100 * low:.2g} to {100 * high:.2g} % in the gallery"
        )


PRESETS = {
    "draft": Preset(4, 0.0075, (0.069, 0.14)),
    "standard": Preset(16, 0.0035, (0.028, 0.055)),
    "reference": Preset(256, 0.00069, (0.0047, 0.0096)),
}

MOST_FITTED = 64
"""Samples per pixel up to which fits are measured, unless others are asked for."""
