"""How often a fit to a noisy picture names the right glass of the table first.

One picture of each glass, with noise. Two glasses whose pictures differ by less than three
standard deviations of that noise cannot be told apart by any fit and count as one: to first order
the difference of two pictures over the noise is their distance under the fit's covariance.
"""

import argparse
import statistics
import sys
import time
from typing import Any

import jax
import numpy as np
from record import TARGET_SCENE, print_table, write_record

from diffdisp import (
    Film,
    Picture,
    band_middles,
    fit,
    glass_table,
    load_scene,
    named_glass,
    render,
    with_glass,
)

BALL = 0
"""Number of the ball among the objects of the bench."""
ALIKE = 3.0
"""Glasses closer than so many standard deviations count as one."""


def names(count: int) -> list[str]:
    """Glasses of three terms, as the table has them."""
    found = [name for name, glass in glass_table().items() if np.all(glass.B != 0)]
    return found[:count]


def drawn(name: str, film: Film, samples: int) -> np.ndarray:
    """The bench with a ball of one glass."""
    scene = with_glass(load_scene(str(TARGET_SCENE)), BALL, named_glass(name))
    return np.asarray(render(scene, film, samples=samples, dtype="float64"))


def ranked(name: str, clean: np.ndarray, film: Film, noise: float, seed: int) -> dict[str, Any]:
    """What a fit to one noisy picture says."""
    noisy = clean + np.random.default_rng(seed).normal(0.0, noise, clean.shape)
    target = Picture(noisy, np.asarray(film.wavelengths))
    begun, cpu = time.perf_counter(), time.process_time()
    result = fit(load_scene(str(TARGET_SCENE)), target, noise=noise)
    seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu
    order = [other for other, _ in result.nearest_glasses]
    with jax.enable_x64(True):
        n_d = float(named_glass(name).n_d)
    return {
        "glass": name,
        "first": order[0],
        "distance": result.nearest_glasses[0][1],
        "place": order.index(name) + 1 if name in order else None,
        "own": dict(result.nearest_glasses).get(name),
        "converged": result.converged,
        "n_d_z": (result.n_d - n_d) / result.n_d_std,
        "n_d_std": result.n_d_std,
        "seconds": seconds,
        "cpu_s": cpu,
    }


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--glasses", type=int, default=50, help="how many of the table")
    add("--size", type=int, default=48, help="pixels along each edge")
    add("--bands", type=int, default=8, help="equal ones from 400 to 700 nm")
    add("--noise", type=float, default=0.01, help="standard deviation; the brightest tile has 1")
    add("--samples", type=int, default=256, help="per pixel, of the pictures before noise")
    options = parser.parse_args()
    jax.config.update("jax_compilation_cache_dir", None)  # so that a first fit compiles
    film = Film(options.size, options.size, band_middles(400.0, 700.0, options.bands))
    chosen = names(options.glasses)
    clean = {}
    begun = time.perf_counter()
    for name in chosen:
        clean[name] = drawn(name, film, options.samples)
    drawing = time.perf_counter() - begun
    print(f"{len(chosen)} pictures drawn in {drawing:.0f} s", file=sys.stderr, flush=True)
    rows = []
    for seed, name in enumerate(chosen):
        row = ranked(name, clean[name], film, options.noise, seed)
        first = row["first"]
        if first not in clean:  # the table holds more than were asked for
            clean[first] = drawn(first, film, options.samples)
        apart = float(np.linalg.norm(clean[first] - clean[name])) / options.noise
        row |= {"apart": apart, "right": first == name, "as_one": apart < ALIKE}
        rows.append(row)
        print(f"{seed + 1}: {name}: {first}, {row['seconds']:.1f} s", file=sys.stderr, flush=True)
    others = [row for row in rows if not row["right"]]
    if others:
        head = ("glass", "first", "distance", "place", "own", "apart", "as_one")
        print_table(head, [[row[key] for key in head] for row in others])
    share, alike = (float(np.mean([row[key] for row in rows])) for key in ("right", "as_one"))
    warm = rows[1:] or rows
    figures = {
        "right": share,
        "right_or_alike": alike,
        "glasses": len(rows),
        "table": len(glass_table()),
        "converged": sum(row["converged"] for row in rows),
        "n_d_z_std": float(np.std([row["n_d_z"] for row in rows])),
        "first_s": rows[0]["seconds"],
        "warm_s": statistics.median(row["seconds"] for row in warm),
        "warm_cpu_s": statistics.median(row["cpu_s"] for row in warm),
        "drawing_s": drawing,
    }
    print_table(("figure", "value"), list(figures.items()))
    write_record("naming", vars(options), figures | {"fits": rows})


if __name__ == "__main__":
    main()
