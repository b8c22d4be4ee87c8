"""Whether the errors that a fit reports are true: many pictures that differ by their noise alone.

The pictures show the bench, or a ball over a matte ground, drawn with so many samples that their
own error is far below the noise. A deviation over the reported standard deviation, z, should then
have a standard deviation of 1, and 68 % of them should lie within 1.
"""

import argparse
import multiprocessing
import os
import signal
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from record import ROOT, TARGET_GLASS, TARGET_SCENE, keep_record, machine, print_table, recorded

from diffdisp import (
    Dielectric,
    Film,
    FitResult,
    Object,
    Picture,
    Scene,
    Sphere,
    Uncertainty,
    band_middles,
    fit,
    load_scene,
    named_glass,
    render,
    with_glass,
)

NOISE = 0.01
"""Of the radiance; the brightest tiles have 1."""
TRUE_SAMPLES, TRUE_SAMPLES_BY_CHANCE = 4096, 65536
"""Of the pictures before noise; where light scatters their own is then a twentieth of it."""
MATTE_GROUND, START_GLASS = ROOT / "fixtures/scenes/matte_ground.toml", "fused silica"
TRUE = {"center": (0.013, -0.021, 0.03), "radius": 1.012, "gain": 1.1, "black": 0.02}
"""Of the ball and the exposure where they are free; fits start at 0, 1, 1 and 0."""

Noise = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def even(radiance: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """The same noise everywhere."""
    return generator.normal(0.0, NOISE, radiance.shape)


def on_edges(radiance: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Noise in proportion to the local gradient, as of a picture that is not quite sharp."""
    down, across = np.gradient(radiance, axis=(0, 1))
    steepness = np.hypot(down, across)
    return even(radiance, generator) * steepness / np.sqrt(np.mean(steepness**2))


@dataclass(frozen=True)
class Case:
    """A kind of picture, and how it is fitted."""

    name: str
    noise: Noise
    given: float | None
    free: tuple[str, ...]
    scene: Path = TARGET_SCENE
    samples: int = TRUE_SAMPLES

    def start(self) -> Scene:
        """Where fits start."""
        return with_glass(load_scene(str(self.scene)), 0, named_glass(START_GLASS))


CASES = (
    Case("even noise, given", even, NOISE, ()),
    Case("even noise, unknown", even, None, ()),
    Case("noise on edges, unknown", on_edges, None, ()),
    Case("gain and black free", even, NOISE, ("gain", "black")),
    Case("center, radius, gain free", even, NOISE, ("ball.center", "ball.radius", "gain")),
    Case("matte ground", even, NOISE, (), MATTE_GROUND, TRUE_SAMPLES_BY_CHANCE),
)


def displaced(scene: Scene) -> Scene:
    """The bench with its ball as `TRUE` says, for fits that find where it is."""
    ball, *others = scene.objects
    assert isinstance(ball.material, Dielectric)
    shape = Sphere(TRUE["center"], TRUE["radius"])
    return Scene(scene.camera, (Object(shape, ball.material, "ball"), *others), scene.background)


def true_scene(case: Case) -> Scene:
    """What the pictures of a case show."""
    shown = with_glass(case.start(), 0, named_glass(TARGET_GLASS))
    return displaced(shown) if "ball.center" in case.free else shown


def clean_picture(case: Case, film: Film) -> np.ndarray:
    """The picture before noise."""
    picture = render(true_scene(case), film, samples=case.samples, dtype="float64")
    clean = np.asarray(picture) * (TRUE["gain"] if "gain" in case.free else 1.0)
    return clean + (TRUE["black"] if "black" in case.free else 0.0)


def scores(result: FitResult | Uncertainty) -> dict[str, list[float]]:
    """Deviations from the truth over the reported standard deviations."""
    with jax.enable_x64(True):
        glass = named_glass(TARGET_GLASS)
        n_d, V_d = float(glass.n_d), float(glass.V_d)
        n = np.asarray(glass.indices(result.wavelengths))
    true = {f"ball.center.{axis}": x for axis, x in zip("xyz", TRUE["center"], strict=True)}
    true |= {"ball.radius": TRUE["radius"], "black": TRUE["black"]}
    return {
        "n_d": [(result.n_d - n_d) / result.n_d_std],
        "V_d": [(result.V_d - V_d) / result.V_d_std],
        "n": list((result.n - n) / result.n_std),
        "free": [(f.value - true.get(f.name, TRUE["gain"])) / f.std for f in result.free],
    }


class Fitted(NamedTuple):
    """What one fit found.

    Args:
        scores: as `scores` has them.
        n_d_std: the error reported.
        converged: whether it says so.
        seconds: that it took.
    """

    scores: dict[str, list[float]]
    n_d_std: float
    converged: bool
    seconds: float


def repeated(case: Case, clean: np.ndarray, film: Film, seed: int) -> Fitted:
    """A fit of a picture with noise."""
    noisy = clean + case.noise(clean, np.random.default_rng(seed))
    start, begun = case.start(), time.perf_counter()
    result = fit(start, Picture(noisy, film.wavelengths), free=case.free, noise=case.given)
    taken = time.perf_counter() - begun
    return Fitted(scores(result), result.n_d_std, result.converged, taken)


def own_core(cores: "multiprocessing.Queue[int]") -> None:
    """Keep this process to one core, where the system can: two threads of a fit idle a third.

    Ctrl-C is left to the process that collects.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {cores.get()})


def calibrate(
    case: Case, film: Film, repeats: int, before: list[dict[str, Any]]
) -> Iterator[list[dict[str, Any]]]:
    """Figures of the z-scores of one case, after each fit those of all so far; Ctrl-C ends it.

    Args:
        case: the kind of picture.
        film: its size and bands.
        repeats: how many fits there are to be.
        before: rows of those that there are.
    """
    clean = clean_picture(case, film)
    found: dict[str, list[float]] = {"n_d": [], "V_d": [], "n": [], "free": []}
    found |= {row["of"]: list(row["z"]) for row in before}
    failed = before[0]["failed"] if before else 0
    errors: list[float] = []
    seconds: list[float] = []
    # A process that is forked from one with threads may hang.
    context = multiprocessing.get_context("spawn")
    count, cores = machine()["cores"], context.Queue()
    for core in sorted(os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else ()):
        cores.put(core)
    with context.Pool(count, own_core, (cores,)) as pool:
        seeds = range(len(found["n_d"]), repeats)
        fits = pool.imap(partial(repeated, case, clean, film), seeds)
        for seed in seeds:
            try:
                fitted = next(fits)
            except KeyboardInterrupt:
                return
            seconds.append(fitted.seconds)
            failed += not fitted.converged
            errors.append(fitted.n_d_std)
            for name, values in fitted.scores.items():
                found[name] += values
            n_d = np.array(found["n_d"])
            print(
                f"{case.name}: {seed + 1} of {repeats}, z {np.mean(n_d):.2f} ± {np.std(n_d):.2f}",
                file=sys.stderr,
            )
            yield figures(case, film, found, failed, errors, seconds)


def figures(
    case: Case,
    film: Film,
    found: dict[str, list[float]],
    failed: int,
    errors: list[float],
    seconds: list[float],
) -> list[dict[str, Any]]:
    """A row of the record for each kind of z-score.

    Args:
        case: the kind of picture.
        film: its size and bands.
        found: all z-scores.
        failed: how many fits say that they have not converged.
        errors: reported of n_d, in this run.
        seconds: that fits took, in this run.
    """
    return [
        {
            "case": case.name,
            "of": name,
            "mean": float(np.mean(z)),
            "std": float(np.std(z)),
            "within_1": float(np.mean(np.abs(z) < 1)),
            "n_d_std": statistics.median(errors),
            "size": film.width,
            "bands": film.channels,
            "fits": len(found["n_d"]),
            "failed": failed,
            "fit_s": statistics.median(seconds),
            "cores": 1,
            "date": datetime.now(UTC).date().isoformat(),
            "z": [round(x, 4) for x in z],
        }
        for name, z in found.items()
        if z
    ]


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--repeats", type=int, default=200, help="fits of each case")
    add("--size", type=int, default=48, help="pixels along each edge")
    add("--bands", type=int, default=8, help="equal ones from 400 to 700 nm")
    add("--more", action="store_true", help="go on from the fits in the record, of the same code")
    add("--only", nargs="+", choices=[case.name for case in CASES], help="of the cases")
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    film = Film(options.size, options.size, band_middles(400.0, 700.0, options.bands))
    # Hours of work: each fit is kept when it is done, whatever becomes of the rest.
    rows: list[dict[str, Any]] = recorded("calibration")["scores"]
    for case in CASES:
        if options.only and case.name not in options.only:
            continue
        alike = {"case": case.name, "size": options.size, "bands": options.bands}
        before = [row for row in rows if "z" in row and alike.items() <= row.items()]
        found: list[dict[str, Any]] = []
        others = [row for row in rows if row["case"] != case.name]
        for found in calibrate(case, film, options.repeats, before if options.more else []):
            rows = others + found
            keep_record("calibration", vars(options) | {"noise": NOISE}, {"scores": rows})
        if not found:  # stopped before its first fit
            continue
        shown = [{name: x for name, x in row.items() if name != "z"} for row in found]
        print_table(list(shown[0]), [list(row.values()) for row in shown])


if __name__ == "__main__":
    main()
