"""Fits to pictures without noise, rendered here: start fused silica, answer N-BK7.

A fit that renders exactly as its target was rendered finds the coefficients themselves. One that
does not know how, at other samples and another seed, has to live with the render's own error.
"""

import argparse
import time
from typing import Any

import jax
import numpy as np
from record import ROOT, TARGET_GLASS, TARGET_SCENE, print_table, write_record

from diffdisp import Film, Picture, band_middles, fit, load_scene, named_glass, render

BENCH = ROOT / "fixtures/scenes/bench_nbk7.toml"
"""The bench of the start, with a ball of the answer."""
RANGES = {"wide": (310.0, 2330.0), "visible": (400.0, 700.0)}
"""Ends in nm; the wide one is that of the data sheet of N-BK7."""
DEPTH = 50


def clean_target(film: Film, samples: int, seed: int, known: bool) -> Picture:
    """A render of the answer; with what it was made with only if `known`."""
    radiance = render(
        load_scene(str(BENCH)), film, samples=samples, depth=DEPTH, seed=seed, dtype="float64"
    )
    made_with = (samples, DEPTH, seed) if known else ()
    return Picture(np.asarray(radiance), np.asarray(film.wavelengths), *made_with)


def measure(target: Picture) -> dict[str, Any]:
    """How far the fitted glass is from the answer."""
    glass = named_glass(TARGET_GLASS)
    start = time.perf_counter()
    result = fit(load_scene(str(TARGET_SCENE)), target)
    seconds = time.perf_counter() - start
    with jax.enable_x64(True):
        delta_n = result.n - np.asarray(glass.indices(result.wavelengths))
        delta_n_d = result.n_d - float(glass.n_d)
    return {
        "B_relative": float(np.max(np.abs(result.B / np.asarray(glass.B) - 1))),
        "C_relative": float(np.max(np.abs(result.C / np.asarray(glass.C) - 1))),
        "n_max": float(np.max(np.abs(delta_n))),
        "n_d": delta_n_d,
        "n_d_z": delta_n_d / result.n_d_std,
        "steps": result.steps,
        "seconds": seconds,
        "converged": result.converged,
        "determined": result.determined,
        "n_d_std": result.n_d_std,
        "rms_residual": result.rms_residual,
        "summary": result.summary,
    }


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=64, help="pixels of an edge")
    parser.add_argument("--bands", type=int, default=16, help="in each range")
    parser.add_argument("--samples", type=int, default=16, help="of the targets made alike")
    parser.add_argument("--other", type=int, nargs=2, default=[36, 5], metavar=("SAMPLES", "SEED"))
    options = parser.parse_args()
    figures = []
    for name, ends in RANGES.items():
        film = Film(options.size, options.size, band_middles(*ends, options.bands))
        made = {"alike": (options.samples, 0, True), "otherwise": (*options.other, False)}
        for how, arguments in made.items():
            target = clean_target(film, *arguments)
            figures.append({"range": name, "target_made": how} | measure(target))
    head = ("range", "made", "B rel.", "C rel.", "max |Δn|", "Δn_d", "z", "steps", "seconds")
    print_table(head, [list(figure.values())[: len(head)] for figure in figures])
    for figure in figures:
        print(f"{figure['range']}, {figure['target_made']}: {figure['summary']}")
    write_record("clean_fit", vars(options), figures)


if __name__ == "__main__":
    main()
