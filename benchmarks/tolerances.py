"""Whether pictures drawn to a tolerance are as near as asked, and what that costs.

The measure is a picture of so many samples that its own error is small; what is known of that is
taken off. The cost is compared with that of the fewest samples that reach the tolerance, which
nobody knows who has not measured them.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from record import ROOT, print_table, write_record

from diffdisp import Film, Scene, load_scene, render
from diffdisp.measuring import converged, error_beyond
from diffdisp.planning import make_plan
from diffdisp.sampling import sample_grid
from diffdisp.timing import warm_times
from diffdisp.tolerance import render_to_tolerance, rms

SCENES = ("bench_nbk7", "dispersion", "metal_and_matte", "lamps", "default")
"""The bench and the gallery."""
WITHIN, AS_LONG = 1.2, 1.5
"""Of the tolerance, what a true error may be; and of the best time, what is looked for."""
SEED = 1000
"""Of the first picture of the measure."""
SEEDS = (0, 100, 200)
"""Each tolerance is asked for with each of them: few bright paths make errors differ by chance."""
SHARE = 16
"""Samples of a pass where light scatters: multiples of it do not compile anew."""
LONG_S = 10.0
"""Time from which on a run is not repeated."""


class Truth:
    """A scene's picture, and how far others are from it."""

    def __init__(self, scene: Scene, film: Film, most: int) -> None:
        """By which those of at most so many samples are measured."""
        self.picture, _, self.own = converged(scene, film, most, 50, SEED)

    def error(self, picture: np.ndarray) -> float:
        """Root mean square of a picture's error over that of the picture."""
        return error_beyond(picture, self.picture, self.own)


def timed(draw: Callable[[], Any], runs: int) -> tuple[Any, dict[str, float]]:
    """What is drawn, and the median time of warm runs; the first compiles."""
    start = time.perf_counter()
    draw()
    first = time.perf_counter() - start
    found, wall, cpu = warm_times(draw, runs, LONG_S)
    return found, {"wall_s": wall, "cpu_s": cpu, "first_s": first}


def counts(scattering: bool) -> Iterator[int]:
    """Numbers of samples that are worth trying, about a sixth more each time."""
    last, share = 0, SHARE if scattering else 1
    for power in range(200):
        near = round(2.0 ** (power / 4))
        samples = near if near <= share else share * math.ceil(near / share)
        columns, rows = sample_grid(samples)
        while max(columns, rows) > 2 * min(columns, rows):
            samples += share if near > share else 1
            columns, rows = sample_grid(samples)
        if samples > last:
            last = samples
            yield samples


class Fixed:
    """Pictures of fixed numbers of samples."""

    def __init__(self, scene: Scene, film: Film, truth: Truth, runs: int) -> None:
        """Of a scene whose truth is known."""
        self.scene, self.film, self.truth, self.runs = scene, film, truth, runs
        self.errors: dict[int, float] = {}
        self.times: dict[int, dict[str, float]] = {}
        scattering = make_plan(scene, film, 1, 50, "float32").scattering
        self.samples = [n for n, _ in zip(counts(scattering), range(60), strict=False)]

    def draw(self, samples: int, seed: int = 0) -> np.ndarray:
        """A picture of so many samples."""
        knobs: dict[str, Any] = {"samples": samples, "seed": seed, "dtype": "float32"}
        return np.asarray(render(self.scene, self.film, **knobs))

    def error(self, place: int) -> float:
        """Of pictures with the samples at this place of `samples`, root mean square of `SEEDS`."""
        samples = self.samples[place]
        if samples not in self.errors:
            errors = [self.truth.error(self.draw(samples, seed)) for seed in SEEDS]
            self.errors[samples] = rms(np.array(errors))
        return self.errors[samples]

    def fewest(self, tolerance: float) -> int:
        """Samples that reach a tolerance."""
        high = 0
        while self.error(high) > tolerance:
            high += 4
        low = high - 4
        while high - low > 1 and high > 0:
            middle = (low + high) // 2
            if self.error(middle) > tolerance:
                low = middle
            else:
                high = middle
        return self.samples[high]

    def time(self, samples: int) -> dict[str, float]:
        """Of a picture of so many samples."""
        if samples not in self.times:
            _, self.times[samples] = timed(lambda: self.draw(samples), self.runs)
        return self.times[samples]


def measure(name: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each tolerance of a scene, and for each seed."""
    scene, film = load_scene(ROOT / f"fixtures/scenes/{name}.toml"), Film(*options.size)
    plan = make_plan(scene, film, 1, 50, "float64")
    reference = options.by_chance if plan.scattering else options.reference
    truth = Truth(scene, film, reference)
    fixed = Fixed(scene, film, truth, options.runs)
    for tolerance in options.tolerances:
        fewest = fixed.fewest(tolerance)
        best = fixed.time(fewest)
        for seed in SEEDS:

            def draw(tolerance: float = tolerance, seed: int = seed) -> Any:
                drawn = render_to_tolerance(scene, film, tolerance, seed=seed, dtype="float32")
                *_, last = drawn
                return last

            picture, taken = timed(draw, options.runs)
            yield {
                "scene": name,
                "tolerance": tolerance,
                "seed": seed,
                "error_over_tolerance": truth.error(picture.radiance) / tolerance,
                "estimate_over_tolerance": picture.error / tolerance,
                "samples": picture.samples,
                "dtype": picture.dtype,
                **taken,
                "fewest": fewest,
                "fewest_wall_s": best["wall_s"],
                "fewest_first_s": best["first_s"],
                "wall_ratio": taken["wall_s"] / best["wall_s"],
                "cpu_ratio": taken["cpu_s"] / best["cpu_s"],
                "truth_error": truth.own,
            }


def main() -> None:
    """Print the table; write results/tolerances.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120), help="pixels")
    tolerances = (0.1, 0.03, 0.01, 0.003)
    parser.add_argument("--tolerances", type=float, nargs="+", default=tolerances)
    parser.add_argument("--reference", type=int, default=144, help="most samples told apart")
    parser.add_argument("--by-chance", type=int, default=2048, help="the same of scattered light")
    parser.add_argument("--runs", type=int, default=5, help="warm ones, for the median")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    options = parser.parse_args()
    rows = []
    for name in options.scenes:
        for row in measure(name, options):
            rows.append(row)
            print(f"{name} {row['tolerance']:g} done", flush=True)
    shown = ("scene", "tolerance", "error_over_tolerance", "samples", "fewest", "wall_s")
    shown += ("fewest_wall_s", "wall_ratio", "cpu_ratio", "first_s", "truth_error")
    print_table(shown, [[row[column] for column in shown] for row in rows])
    near = sum(row["error_over_tolerance"] <= WITHIN for row in rows)
    quick = sum(row["wall_ratio"] <= AS_LONG for row in rows)
    print(f"{near} of {len(rows)} true errors are at most {WITHIN:g} times the tolerance;")
    print(f"{quick} of {len(rows)} times are at most {AS_LONG:g} times the shortest")
    settings = {**vars(options), "scenes": list(options.scenes)}
    write_record("tolerances", settings, rows)


if __name__ == "__main__":
    main()
