"""Whether the presets of `render --quality` are worth their time.

Error and time of pictures over samples and the length of paths; the front is what no other setting
is both faster and nearer than. A preset's excess is its time over that of the fastest setting that
is as near. Their errors are those that `render --plan` tells.
"""

import argparse
from typing import Any

import numpy as np
from record import ROOT, print_table, recorded, write_record
from tolerances import SCENES, Truth, timed

from diffdisp import Film, load_scene, render
from diffdisp.planning import make_plan
from diffdisp.presets import PRESETS

SAMPLES = (1, 2, 4, 8, 16, 32, 64, 128, 256)
DEPTHS = (50, 16, 8)
"""Segments of a path; presets have the first of these."""
WITHIN = 1.2
"""Of the front's time, what a preset's may be."""


def measure(name: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each setting of a scene."""
    scene, film = load_scene(ROOT / f"fixtures/scenes/{name}.toml"), Film(*options.size)
    scattering = make_plan(scene, film, 1, 50, "float64").scattering
    truth = Truth(scene, film, options.by_chance if scattering else options.reference)
    rows = []
    for depth in DEPTHS:
        for samples in SAMPLES:

            def draw(samples: int = samples, depth: int = depth) -> np.ndarray:
                knobs: dict[str, Any] = {"samples": samples, "depth": depth, "dtype": "float32"}
                return np.asarray(render(scene, film, **knobs))

            picture, taken = timed(draw, options.runs)
            row = {"scene": name, "samples": samples, "depth": depth}
            rows.append({**row, "error": truth.error(picture), **taken})
    for row in rows:
        fastest = min(other["wall_s"] for other in rows if other["error"] <= row["error"])
        row["excess"] = row["wall_s"] / fastest
    return rows


def main() -> None:
    """Print the presets' rows; write results/presets.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120), help="pixels")
    parser.add_argument("--reference", type=int, default=256, help="most samples told apart")
    parser.add_argument("--by-chance", type=int, default=2048, help="the same of scattered light")
    parser.add_argument("--runs", type=int, default=7, help="warm ones, for the median")
    parser.add_argument("--only", nargs="+", choices=SCENES, help="and keep the record's others")
    options = parser.parse_args()
    names = options.only or SCENES
    rows = [row for row in recorded("presets") if row["scene"] not in names] if options.only else []
    for name in names:
        rows += measure(name, options)
        print(f"{name} done", flush=True)
    shown = ("scene", "samples", "error", "wall_s", "cpu_s", "excess")
    counts = [preset.samples for preset in PRESETS.values()]
    presets = [row for row in rows if row["samples"] in counts and row["depth"] == DEPTHS[0]]
    print_table(shown, [[row[column] for column in shown] for row in presets])
    near = sum(row["excess"] <= WITHIN for row in presets)
    print(f"{near} of {len(presets)} presets take at most {WITHIN:g} times the front's time")
    write_record("presets", vars(options), rows)


if __name__ == "__main__":
    main()
