"""How the time of the gallery's scenes grows with the number of pixels: p of time ∝ pixelsᵖ.

Warm renders on all cores; sizes take turns, so that a busy spell of the machine meets all of them.
"""

import argparse
import statistics
import time

import numpy as np
from compile_times import SCENES
from record import ROOT, print_table, write_record

from diffdisp import Film, load_scene, render

SIZES = (500, 1000, 2000)
"""Pixels along each edge."""
SAMPLES, DEPTH = 10, 50
"""As in the study of size and objects."""


def seconds(name: str, size: int) -> float:
    """Of one render."""
    scene = load_scene(ROOT / f"fixtures/scenes/{name}.toml")
    start = time.perf_counter()
    render(scene, Film(size, size), samples=SAMPLES, depth=DEPTH, dtype="float32")
    return time.perf_counter() - start


def main() -> None:
    """Print and record the times of each scene and the slope of their logarithms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5, help="of each, of which the median")
    options = parser.parse_args()
    rows = []
    for name in SCENES:
        turns = [[seconds(name, size) for size in SIZES] for _ in range(options.runs + 1)]
        # The first turn compiles.
        times = [statistics.median(column) for column in zip(*turns[1:], strict=True)]
        exponent = float(np.polyfit(2 * np.log(SIZES), np.log(times), 1)[0])
        rows.append((name, *times, exponent))
    print_table(("scene", *(f"{size}²: s" for size in SIZES), "exponent"), rows)
    figures = {
        name: {"seconds": dict(zip(map(str, SIZES), times, strict=True)), "exponent": exponent}
        for name, *times, exponent in rows
    }
    write_record("growth", {**vars(options), "samples": SAMPLES, "depth": DEPTH}, figures)


if __name__ == "__main__":
    main()
