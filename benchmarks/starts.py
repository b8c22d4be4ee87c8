"""Whether a fit ends at the same glass from any start, and what going from coarse to fine saves.

Each picture is rendered as the fit renders (it says its samples, depth and seed), so that its
minimum is the answer itself, and another end is another minimum or none. Starts are glasses of the
table with three terms: one of two cannot reach the index of all others.

What coarse to fine saves is measured against ways that stay on the finest level, that of the last
steps: all pixels, all samples, paths followed to their end. One searches as the fit does (many
indices, three descents); one ends paths early as the fit's coarser levels do, so that only pixels
and samples are the finest; one descends from the start without any search.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
from record import ROOT, print_table, write_record

from diffdisp import (
    Film,
    Picture,
    Sellmeier,
    band_middles,
    fit,
    fitting,
    glass_table,
    load_scene,
    named_glass,
    render,
    with_glass,
)

BENCH = ROOT / "fixtures/scenes/bench_nbk7.toml"
BALL = 0
"""Number of the ball among the objects of the bench."""
DEPTH = 50
SAME = 1e-6
"""Ends whose indices differ by less at every band are one."""
METHODS = ("coarse to fine", "finest alone", "finest, paths ended early", "finest, no search")


def spread(count: int) -> list[str]:
    """Names of glasses of three terms, evenly by n_d from the lowest to the highest."""
    glasses = {name: glass for name, glass in glass_table().items() if np.all(glass.B != 0)}
    with jax.enable_x64(True):
        names = sorted(glasses, key=lambda name: float(glasses[name].n_d))
    if count > len(names):
        raise SystemExit(f"the table has {len(names)} glasses of three terms")
    return [names[i] for i in np.linspace(0, len(names) - 1, count).round().astype(int)]


def drawn(answer: str, film: Film, samples: int) -> Picture:
    """The bench with a ball of one glass, and how it was rendered."""
    scene = with_glass(load_scene(str(BENCH)), BALL, named_glass(answer))
    radiance = render(scene, film, samples=samples, depth=DEPTH, seed=0, dtype="float64")
    return Picture(np.asarray(radiance), np.asarray(film.wavelengths), samples, DEPTH, 0)


@contextmanager
def one_level(method: str, samples: int) -> Iterator[None]:
    """Fits whose first level is the last one, for as long as this is entered."""

    def unsearched(problem: Any, level: Any, most: int) -> list[Any]:
        return [fitting.Point(problem.unknowns.coefficients.start(), np.zeros(problem.free.total))]

    whole: dict[str, Any] = {"COARSE_PIXELS": sys.maxsize, "FEW_SAMPLES": samples}
    changes: dict[str, Any] = {
        METHODS[0]: {},
        METHODS[1]: whole | {"CUTOFF": 0.0},
        METHODS[2]: whole,
        METHODS[3]: whole | {"CUTOFF": 0.0, "_starts": unsearched},
    }[method]
    before = {name: getattr(fitting, name) for name in changes}
    for name, value in changes.items():
        setattr(fitting, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(fitting, name, value)


def fitted(target: Picture, answer: str, start: str) -> dict[str, Any]:
    """Where one fit ended, and its seconds."""
    scene, glass = load_scene(str(BENCH)), named_glass(start)
    traced = 0

    def count(step: int, rms: float, n_d: float) -> None:
        nonlocal traced
        traced += 1

    begun, cpu = time.perf_counter(), time.process_time()
    result = fit(scene, target, start=glass, progress=count)
    seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu
    off = float(np.max(np.abs(result.n - indices(named_glass(answer), result.wavelengths))))
    return {
        "answer": answer,
        "start": start,
        "converged": result.converged,
        "n_max": off,
        "n": result.n.tolist(),
        "pictures": traced,
        "seconds": seconds,
        "cpu_s": cpu,
    }


def indices(glass: Sellmeier, wavelengths: np.ndarray) -> np.ndarray:
    """In float64."""
    with jax.enable_x64(True):
        return np.asarray(glass.indices(wavelengths))


def same_minimum(fits: Sequence[dict[str, Any]]) -> int:
    """The most fits of one picture that converged within `SAME` of one another's indices."""
    ends = np.array([f["n"] for f in fits if f["converged"]])
    if not len(ends):
        return 0
    apart = np.max(np.abs(ends[:, None] - ends[None]), axis=-1)
    return int(np.max(np.sum(apart < SAME, axis=1)))


def every_start(options: argparse.Namespace, film: Film) -> list[dict[str, Any]]:
    """Fits of each answer from each start."""
    fits = []
    starts = spread(options.starts)
    for answer in spread(options.answers):
        target = drawn(answer, film, options.samples)
        for start in starts:
            fits.append(fitted(target, answer, start))
            last = fits[-1]
            print(
                f"{len(fits)}: {answer} from {start}: {last['n_max']:.1e}, {last['seconds']:.1f} s",
                file=sys.stderr,
                flush=True,
            )
    return fits


def by_answer(fits: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each picture."""
    rows = []
    for answer in dict.fromkeys(f["answer"] for f in fits):
        own = [f for f in fits if f["answer"] == answer]
        right = [f for f in own if f["converged"] and f["n_max"] < SAME]
        rows.append(
            {
                "answer": answer,
                "starts": len(own),
                "converged": sum(f["converged"] for f in own),
                "same minimum": same_minimum(own),
                "the answer": len(right),
                "worst of these": max((f["n_max"] for f in right), default=float("nan")),
                "lost from": [f["start"] for f in own if f not in right],
            }
        )
    return rows


def levels(options: argparse.Namespace) -> list[dict[str, Any]]:
    """What the ways to the finest level cost, warm, each from the same starts."""
    rows = []
    answers, starts = spread(options.answers), spread(options.starts)
    # Starts far from the answer and near to it alike.
    pairs = [
        (answers[i % len(answers)], starts[(7 * i + 3) % len(starts)]) for i in range(options.pairs)
    ]
    for size in options.level_sizes:
        film = Film(size, size, band_middles(400.0, 700.0, options.bands))
        targets = {answer: drawn(answer, film, options.level_samples) for answer, _ in pairs}
        found: dict[str, list[dict[str, Any]]] = {method: [] for method in METHODS}
        cold = {}
        for method in METHODS:
            with one_level(method, options.level_samples):
                cold[method] = fitted(targets[pairs[0][0]], *pairs[0])["seconds"]
        # The ways take turns, so that all meet the same machine.
        for answer, start in pairs:
            for method in METHODS:
                with one_level(method, options.level_samples):
                    found[method].append(fitted(targets[answer], answer, start))
        for method, fits in found.items():
            ratios = {
                clock: statistics.median(
                    f[clock] / first[clock]
                    for f, first in zip(fits, found[METHODS[0]], strict=True)
                )
                for clock in ("seconds", "cpu_s")
            }
            rows.append(
                {
                    "size": size,
                    "way": method,
                    "right": sum(f["converged"] and f["n_max"] < SAME for f in fits),
                    "fits": len(fits),
                    "warm s": statistics.median(f["seconds"] for f in fits),
                    "ratio": ratios["seconds"],
                    "warm CPU s": statistics.median(f["cpu_s"] for f in fits),
                    "CPU ratio": ratios["cpu_s"],
                    "pictures": statistics.median(f["pictures"] for f in fits),
                    "first s": cold[method],
                }
            )
            print(rows[-1], file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--starts", type=int, default=20, help="glasses to start from")
    add("--answers", type=int, default=10, help="glasses to find")
    add("--size", type=int, default=32, help="pixels along each edge")
    add("--bands", type=int, default=8, help="equal ones from 400 to 700 nm")
    add("--samples", type=int, default=16, help="per pixel")
    add("--level-sizes", type=int, nargs="*", default=[64], help="pixels, for the ways compared")
    add("--level-samples", type=int, default=16, help="per pixel, for the ways compared")
    add("--pairs", type=int, default=5, help="answer and start, for the ways compared")
    options = parser.parse_args()
    jax.config.update("jax_compilation_cache_dir", None)  # so that a first fit compiles
    film = Film(options.size, options.size, band_middles(400.0, 700.0, options.bands))
    fits = every_start(options, film)
    rows = by_answer(fits)
    head = list(rows[0])[:-1]
    print_table(head, [list(row.values())[:-1] for row in rows])
    same = sum(row["same minimum"] for row in rows) / len(fits)
    right = sum(row["the answer"] for row in rows) / len(fits)
    warm = statistics.median(f["seconds"] for f in fits[1:]) if fits[1:] else float("nan")
    print(f"{same:.1%} of {len(fits)} fits end at one minimum for each picture, {right:.1%} at it")
    print(f"first fit {fits[0]['seconds']:.1f} s, the others {warm:.2f} s (median)")
    compared = levels(options)
    if compared:
        print_table(list(compared[0]), [list(row.values()) for row in compared])
    figures = {
        "same_minimum": same,
        "right": right,
        "first_s": fits[0]["seconds"],
        "warm_s": warm,
        "warm_cpu_s": statistics.median(f["cpu_s"] for f in fits[1:] or fits),
        "answers": rows,
        "levels": compared,
    }
    write_record("starts", vars(options), figures)


if __name__ == "__main__":
    main()
