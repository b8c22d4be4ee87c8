"""How far float32 pictures are from float64 ones of the same samples.

Rounding sends a path elsewhere at the border of a tile or at an outline: then a sample shows
something else, which more samples would average. So the root mean square over all pixels is told,
the part of pixels that differ by more than `TURNED`, and the root mean square of the others.
"""

import argparse
from typing import Any

import numpy as np
from record import ROOT, print_table, write_record
from tolerances import SCENES

from diffdisp import Film, load_scene, render
from diffdisp.tolerance import rms

TURNED = 1e-3
"""Difference over the picture's root mean square from which on a path took another turn: one of
16 samples that sees something else changes a pixel by a hundredth and more, as a rule."""


def measure(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """The row of a scene; of each figure the largest of all seeds."""
    scene, film = load_scene(ROOT / f"fixtures/scenes/{name}.toml"), Film(*options.size)
    found = []
    for seed in range(options.seeds):
        knobs: dict[str, Any] = {"samples": options.samples, "seed": seed}
        single, double = (
            np.asarray(render(scene, film, dtype=dtype, **knobs)).astype(np.float64)
            for dtype in ("float32", "float64")
        )
        size, off = rms(double), single - double
        turned = np.abs(off).max(axis=-1) > TURNED * size
        found.append((rms(off) / size, float(turned.mean()), rms(off[~turned]) / size))
    every, turned_part, others = np.max(found, axis=0).tolist()
    return {"scene": name, "all": every, "turned": turned_part, "others": others}


def main() -> None:
    """Print the table; write results/precision.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), help="pixels")
    parser.add_argument("--samples", type=int, default=16, help="per pixel")
    parser.add_argument("--seeds", type=int, default=3, help="the largest of which is told")
    options = parser.parse_args()
    rows = [measure(name, options) for name in SCENES]
    print_table(("scene", "all", "turned", "others"), [list(row.values()) for row in rows])
    write_record("precision", vars(options), rows)


if __name__ == "__main__":
    main()
