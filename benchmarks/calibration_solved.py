"""What `calibration` finds of thousands of draws of noise, if the picture is taken for linear.

A fit with places free takes a minute or more, so `calibration` has 200 of each kind, too few to
tell a wrong error bar from the luck of their draws. Here the picture is traced once, at the truth,
and taken for linear about it. A draw of noise then takes half a second: the fit's own solve finds
the Sellmeier sum, from the fit's start, and its own formula the errors.

So this has the noise, the weights of pixels, what else is free, and all that Sellmeier sums make of
it. It does not have that the picture is not linear: the way through the fit's levels, the mean
along the way least known, and how much that widens the errors. The first draws are those of
`calibration`'s fits, whose z tell how much of them this is. The plainly linear answer, with n(λ)
linear in log B and log C too, has a normal z with a standard deviation of 1 by making: what it
shows over some draws is their luck alone.
"""

import argparse
import signal
import sys
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from calibration import CASES, NOISE, TRUE, clean_picture, scores, true_scene
from record import print_table, recorded, write_record

from diffdisp import Film, Picture, Uncertainty, band_middles, fitting
from diffdisp.linearised import Linearised, linearise

CASE = next(case for case in CASES if case.name == "center, radius, gain free")
DEPTH = 50
"""Segments of a path, as in a fit to a picture that does not say its own."""
SOLVES = 3
"""The start's anchor, and then anew where the last one ended, as a fit's levels do. A fourth moves
V_d by 0.02 errors at most."""
OF = ("n_d", "V_d")
"""What is compared."""


class Traced(NamedTuple):
    """The picture at the truth, and the fit's problem about it.

    Args:
        clean: (height, width, channels) before noise.
        problem: the fit's, of the true scene; its glass is where fits start.
        level: the last one.
        seen: what the fit's last level has at the truth, with its slopes.
        at: the truth, in coordinates of its own glass.
        unknowns: which have that glass.
    """

    clean: np.ndarray
    problem: fitting.Problem
    level: fitting.Level
    seen: Linearised
    at: fitting.Point
    unknowns: fitting.Unknowns

    def linearised(self, target: np.ndarray) -> Linearised:
        """About the truth, against a target (blocks, channels)."""
        picture, columns = self.seen.picture, self.seen.columns
        return linearise(picture, target, columns, self.level.weights, fitting.WIDEST)

    def told(self, problem: fitting.Problem, at: fitting.Point, lin: Linearised) -> Uncertainty:
        """What a fit that ends there reports."""
        noise = fitting._noise(lin, CASE.given, problem.free.brightest)
        return fitting._uncertainty(problem, at, self.level, lin, noise, "none", "")


def traced(film: Film) -> Traced:
    """The truth as the last level of a fit sees it."""
    clean, scene = clean_picture(CASE, film), true_scene(CASE)
    target, used = Picture(clean, film.wavelengths), np.ones(clean.shape[:2], bool)
    settings = (target, used, CASE.free, "none", "squares", fitting._silent)
    number = fitting.glass_object(scene, None)
    truth = fitting._problem(scene, number, *settings)
    start = fitting._problem(CASE.start(), number, *settings)
    others = np.zeros(truth.free.total)
    others[len(truth.free.parameters) :] = np.log(TRUE["gain"])
    at = fitting.Point(truth.unknowns.coefficients.start(), others)
    few = fitting._level(truth, fitting.FEW, 1, fitting.FEW_SAMPLES, DEPTH, 0)
    many = fitting._level(truth, fitting.LAST, 1, fitting.FEW_SAMPLES, DEPTH, 0, fitting.SPLITS[0])
    rough, some = (fitting._linearise(truth, x, at, fitting.CUTOFF) for x in (few, many))
    level, slopes = fitting._more_samples(truth, many, rough, some, at, DEPTH, NOISE)
    known = fitting._linearise(truth, slopes, at, fitting.CUTOFF).columns
    seen = fitting._linearise(truth, level, at, fitting.CUTOFF, known, of_index=True)
    problem = truth._replace(unknowns=start.unknowns)
    return Traced(clean, problem, level, seen, at, truth.unknowns)


def solved(picture: Traced, lin: Linearised) -> dict[str, list[float]]:
    """The z of the fit's solve of a linear picture."""
    unknowns, others = picture.problem.unknowns, picture.at.others
    truth = picture.unknowns.coefficients.index(picture.at.z, unknowns.reference)
    z = unknowns.coefficients.start()
    for _ in range(SOLVES):
        change = np.asarray(unknowns.change(z, truth))
        here = lin.moved(np.concatenate([np.zeros(len(others)), change]))
        at, _ = fitting._next_point(unknowns, fitting.Point(z, others), z, here, 0.0)
        z = at.z
    return scores(picture.told(picture.problem, at, lin))


class Plain(NamedTuple):
    """The plainly linear answer: n(λ), n_d and V_d linear in log B and log C about the truth.

    Args:
        follow: (2, m) how n_d and V_d follow the index's part of q.
        std: (2,) of these, at the truth.
    """

    follow: np.ndarray
    std: np.ndarray

    def scores(self, lin: Linearised) -> np.ndarray:
        """The z (2,) of n_d and V_d."""
        return -self.follow @ lin.eliminated().q / self.std


def plain(picture: Traced) -> Plain:
    """The slopes at the truth, and the errors of a residual that is as large as the noise."""
    unknowns, z = picture.unknowns, jnp.asarray(picture.at.z)
    coefficients = unknowns.coefficients
    lines = fitting._along_logs(coefficients, lambda z: fitting._line_figures(coefficients, z), z)
    lin = picture.linearised(picture.seen.picture + NOISE / np.sqrt(picture.level.weights))
    logs = fitting._answer(unknowns, z, lin.eliminated(), NOISE).logs
    told = picture.told(picture.problem._replace(unknowns=unknowns), picture.at, lin)
    return Plain(lines[: len(OF)] @ logs / NOISE, np.array([told.n_d_std, told.V_d_std]))


def drawn(picture: Traced, seeds: range) -> Iterator[dict[str, np.ndarray]]:
    """The z (2,) of each draw of noise, by either way."""
    linear, shape = plain(picture), picture.seen.picture.shape
    for seed in seeds:
        noise = CASE.noise(picture.clean, np.random.default_rng(seed))
        lin = picture.linearised((picture.clean + noise).reshape(shape))
        of = solved(picture, lin)
        yield {"solved": np.array([of[name][0] for name in OF]), "plain": linear.scores(lin)}


def fits(options: argparse.Namespace) -> np.ndarray:
    """The z (fits, 2) that `calibration` recorded, from seed 0 on; none of another film."""
    alike = {"case": CASE.name, "size": options.size, "bands": options.bands}
    rows = [row for row in recorded("calibration")["scores"] if alike.items() <= row.items()]
    known = {row["of"]: row["z"] for row in rows}
    return np.array([known.get(name, []) for name in OF]).T


def rows_of(first: int, kinds: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Rows of the record.

    Args:
        first: seed of the first draw.
        kinds: z (draws, 2) by each way.
    """
    return [
        {
            "of": name,
            "by": kind,
            "first_seed": first,
            "draws": len(z),
            "mean": float(np.mean(z[:, i])),
            "std": float(np.std(z[:, i])),
            "within_1": float(np.mean(np.abs(z[:, i]) < 1)),
        }
        for i, name in enumerate(OF)
        for kind, z in kinds.items()
        if len(z)
    ]


def agreement(kind: str, found: np.ndarray, fitted: np.ndarray) -> list[dict[str, Any]]:
    """How far z (draws, 2) follow those of true fits to the same pictures."""
    if len(found) < 2:
        return []
    return [
        {
            "of": name,
            "by": kind,
            "correlation": float(np.corrcoef(x, z)[0, 1]),
            "mean_apart": float(np.mean(x - z)),
            "rms_apart": float(np.sqrt(np.mean((x - z) ** 2))),
            "most_apart": float(np.max(np.abs(x - z))),
        }
        for name, x, z in zip(OF, found.T, fitted.T, strict=True)
    ]


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--draws", type=int, default=1400, help="of noise")
    add("--first", type=int, default=0, help="seed of the first")
    add("--size", type=int, default=48, help="pixels along each edge")
    add("--bands", type=int, default=8, help="equal ones from 400 to 700 nm")
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    film = Film(options.size, options.size, band_middles(400.0, 700.0, options.bands))
    begun = time.perf_counter()
    draws: list[dict[str, np.ndarray]] = []
    with jax.enable_x64(True):
        picture = traced(film)
        tracing, begun = time.perf_counter() - begun, time.perf_counter()
        print(f"picture traced in {tracing:.0f} s", file=sys.stderr, flush=True)
        try:
            for found in drawn(picture, range(options.first, options.first + options.draws)):
                draws.append(found)
                if len(draws) % 100 == 0:
                    print(f"{len(draws)} of {options.draws}", file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            print(f"stopped after {len(draws)} draws", file=sys.stderr)
    if not draws:
        return
    taken = time.perf_counter() - begun
    times = {"tracing_s": tracing, "draw_s": taken / len(draws)}
    every = {kind: np.stack([found[kind] for found in draws]) for kind in draws[0]}
    fitted = fits(options)[options.first :][: len(draws)]
    same = {kind: z[: len(fitted)] for kind, z in every.items()}
    more = {kind: z[len(fitted) :] for kind, z in every.items()}
    z = rows_of(options.first, {"fits": fitted, **same})
    z += rows_of(options.first + len(fitted), more)
    against = [row for kind in same for row in agreement(kind, same[kind], fitted)]
    for rows in (row for row in (z, against) if row):
        print_table(list(rows[0]), [list(row.values()) for row in rows])
        print()
    figures = {"z": z, "against_fits": against, **times}
    write_record("calibration_solved", vars(options) | {"noise": NOISE}, figures)


if __name__ == "__main__":
    main()
