"""Pictures of a stated accuracy: samples are added until the estimated error is small enough."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from diffdisp.chunks import check_glasses, film_range
from diffdisp.film import Film
from diffdisp.planning import Plan, make_plan
from diffdisp.rendering import Growing, Progress, passes, some_pixels
from diffdisp.sampling import sample_grid
from diffdisp.scene import Scene
from diffdisp.wavefront import MOST_SAMPLES

SHARE = 16
"""Samples of a pass over a picture of chance: few different numbers are few different programs."""

PILOT = 2
"""Samples of each of the first two pictures of a scene of chance, by which others are planned."""

FALL = 0.6
"""Power of the number of samples by which errors fall: 0.59 to 0.78 in the gallery."""

ALIKE = 0.4
"""Correlation of the errors of two pictures that nothing random tells apart.

0.34 to 0.59 on the bench between 4, 16, 36, 64 and 144 samples.
"""

REFINED = 4
"""Times as many samples as a picture has, of the one that it is compared with."""

SOME_PIXELS = 1 << 10
SOME_PART = 1 / 16
"""Pixels by which a picture is judged before it is drawn: so many, and this part of all."""

ROUNDED = 4
"""Samples of the pictures that tell the rounding of float32."""

MOST_GROWTH = 16
"""Times as many samples as before, at most: what is foreseen from afar is foreseen badly."""

MOST_FORESEEN = 1e12
"""Times as large as the tolerance that an error counts at most: out of reach by far."""

MOST_PLANNED = 1 << 12
"""Samples that a picture is planned with at most; where that is too few another one follows."""

MOST_ASPECT = 2.0
"""Of a sample's part of a pixel: slender ones see edges worse."""

OUT_OF_REACH = 1 << 22
"""Samples of a pixel from which on a tolerance counts as out of reach."""

SURELY_SINGLE = 2e-3
"""Tolerance from which on float32 is not doubted where nothing is scattered."""
SURELY_SINGLE_BY_CHANCE = 1e-4
"""The same where light scatters: there rounding sends single paths elsewhere, at random."""


class Estimated(NamedTuple):
    """A picture on its way, and how far it is from what endlessly many samples would show.

    Args:
        radiance: (height, width, channels).
        samples: of each pixel so far.
        error: estimated: the root mean square of its error over that of the picture; infinite
            before there is anything to estimate it by.
        seed: with which `render` draws it again; None where it is the mean of several pictures.
        dtype: float32 or float64.
    """

    radiance: Float[np.ndarray, "height width channels"]
    samples: int
    error: float
    seed: int | None
    dtype: str


Draw = Callable[[int, int, Progress | None], Iterator[Growing]]
"""The growing picture of so many samples, of a seed, telling its progress."""


def render_to_tolerance(
    scene: Scene,
    film: Film,
    tolerance: float,
    *,
    depth: int = 50,
    seed: int = 0,
    dtype: str | None = None,
    progress: Progress | None = None,
) -> Iterator[Estimated]:
    """Pictures of ever more samples, until the estimated error is within a tolerance.

    Where light scatters two pictures are drawn at a time, of seeds of their own: how much they
    differ tells the error of their mean. Elsewhere hardly anything is left to chance: there some
    pixels are drawn with more and more samples first, and tell how many the picture needs. What no
    sample has met yet neither of them knows, nor what `depth` leaves out.

    Args:
        scene: as in `render`, without traced numbers.
        film: as in `render`.
        tolerance: for the root mean square of the error over that of the picture, above 0.
        depth: as in `render`.
        seed: the first of those that are used.
        dtype: as in `render`; float32 is given up where its rounding would be a large part of the
            tolerance.
        progress: called with the parts done of the present pictures and their number. An exception
            that it raises stops the work.

    Raises:
        ValueError: a tolerance that is not above 0, or takes more than `OUT_OF_REACH`; or as in
            `render`.
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance {tolerance:g}: must be above 0")
    check_glasses(scene, *film_range(film))
    dtype = dtype or jnp.result_type(float).name
    plan = make_plan(scene, film, ROUNDED, depth, dtype)
    if plan.scattering:
        fine_enough = dtype if tolerance >= SURELY_SINGLE_BY_CHANCE else "float64"

        def draw(samples: int, seed: int, tell: Progress | None) -> Iterator[Growing]:
            return passes(scene, film, samples, depth, seed, fine_enough, tell, SHARE)

        for found in _in_pairs(draw, tolerance, seed, progress):
            yield Estimated(*found, None, fine_enough)
        return
    pixels = _some_pixels(film)

    def shown(samples: int, seed: int, dtype: str) -> np.ndarray:
        return some_pixels(scene, film, pixels, samples, depth, seed, dtype)

    if dtype == "float32" and tolerance < SURELY_SINGLE:
        single, double = (shown(ROUNDED, seed, name) for name in ("float32", "float64"))
        if relative(rms(single - double), rms(double)) > tolerance / 3:
            dtype = "float64"
    samples, error = _enough(partial(shown, dtype=dtype), tolerance, seed, correlation(plan))
    for picture in passes(scene, film, samples, depth, seed, dtype, progress):
        whole = picture.samples == samples
        yield Estimated(*picture, error if whole else math.inf, seed, dtype)


def rms(values: Float[np.ndarray, "*shape"]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def _in_pairs(
    draw: Draw, tolerance: float, seed: int, progress: Progress | None
) -> Iterator[tuple[np.ndarray, int, float]]:
    """Means of pairs of pictures of independent seeds, and of more and more samples.

    Yields:
        The radiance, its samples and its error.
    """
    seeds, planned = count(seed), PILOT
    total: np.ndarray | float = 0.0  # of all pictures, each times its samples
    squared, samples = 0.0, 0  # of the error of `total`; samples of all pictures
    while True:
        tell, tell_other = _together(progress)
        pair = draw(planned, next(seeds), tell), draw(planned, next(seeds), tell_other)
        for one, other in zip(*pair, strict=True):
            drawn = one.samples
            both = drawn * (one.radiance.astype(np.float64) + other.radiance)
            # Two that are independent differ by as much as their sum is off.
            off = squared + (drawn * rms(one.radiance - other.radiance)) ** 2
            now = samples + 2 * drawn
            mean, error = (total + both) / now, math.sqrt(off) / now
            # The error itself makes the picture's square larger.
            size = math.sqrt(max(rms(mean) ** 2 - error**2, 0.0))
            found = relative(error, size)
            yield mean.astype(one.radiance.dtype), now, found
            if found <= tolerance or now >= OUT_OF_REACH:
                return
        wanted = _wanted(now, found, tolerance)
        if not samples:
            _check_reach(wanted)
        total, squared, samples = total + both, off, now
        planned = _planned(min(math.ceil((wanted - now) / 2), MOST_PLANNED), SHARE)


def _together(progress: Progress | None) -> tuple[Progress | None, Progress | None]:
    """Two that tell of their parts what `progress` is told of both."""
    if progress is None:
        return None, None
    parts = [0, 0]

    def tell(which: int, done: int, of: int) -> None:
        parts[which] = done
        progress(sum(parts), 2 * of)

    return partial(tell, 0), partial(tell, 1)


def _some_pixels(film: Film) -> Int[np.ndarray, " pixels"]:
    """Numbers of pixels from all over the picture."""
    whole = film.width * film.height
    some = min(max(SOME_PIXELS, round(whole * SOME_PART)), whole)
    # Steps near the golden section of the whole leave no part of it out.
    step = next(k for k in count(round(0.618 * whole) or 1) if math.gcd(k, whole) == 1)
    return np.sort(np.arange(some) * step % whole)


def _enough(
    shown: Callable[[int, int], np.ndarray], tolerance: float, seed: int, alike: float
) -> tuple[int, float]:
    """How many samples make an error within the tolerance, and the error with them.

    Args:
        shown: what so many samples show at some pixels, with a seed.
        tolerance: as in `render_to_tolerance`.
        seed: as in `render_to_tolerance`.
        alike: as in `difference`.

    Raises:
        ValueError: as in `render_to_tolerance`.
    """
    drawn: dict[int, np.ndarray] = {}

    def of(samples: int) -> np.ndarray:
        if samples not in drawn:  # each with a seed of its own, as far as one counts
            drawn[samples] = shown(samples, seed + len(drawn))
        return drawn[samples]

    samples = 1
    while True:
        finer = _planned(REFINED * samples, MOST_SAMPLES)
        squares = np.square(of(samples) - of(finer), dtype=np.float64).mean(axis=-1)
        # A few pixels along edges hold most of it: how many of them are seen is left to chance.
        square = squares.mean() + squares.std() / math.sqrt(len(squares))
        error = math.sqrt(square) / difference(samples, finer, alike)
        error = relative(error, rms(of(finer)))
        if error <= tolerance:
            return samples, error
        wanted = _wanted(samples, error, tolerance)
        _check_reach(wanted)
        growing = min(math.ceil(wanted), MOST_GROWTH * samples)
        samples = max(_planned(growing, MOST_SAMPLES), 2 * samples)


def correlation(plan: Plan) -> float:
    """Of the errors of two pictures that differ in samples and seed; of no scattered light."""
    return 0.0 if plan.random else ALIKE


def difference(samples: int, finer: int, alike: float) -> float:
    """Difference of two pictures over the error of the first of them.

    Args:
        samples: of the first.
        finer: of the second, more than that.
        alike: `correlation` of both errors.
    """
    later = (samples / finer) ** FALL
    return math.sqrt(1.0 + later**2 - 2.0 * alike * later)


def relative(error: float, size: float) -> float:
    """An error over the size of a picture; black pictures without error have none."""
    if error == 0:
        return 0.0
    return error / size if size > 0 else math.inf


def _wanted(samples: int, error: float, tolerance: float) -> float:
    """Samples that an error within the tolerance takes, where so many have this one."""
    if math.isinf(error):  # all that is seen yet may be noise
        return float(MOST_GROWTH * samples)
    return samples * min(error / tolerance, MOST_FORESEEN) ** (1.0 / FALL)


def _check_reach(wanted: float) -> None:
    """Refuse, before any long work, what would take too many samples.

    Raises:
        ValueError: it would.
    """
    if wanted > OUT_OF_REACH:
        raise ValueError(
            f"the tolerance is out of reach: about {wanted:.1g} samples a pixel, where"
            f" {OUT_OF_REACH} are the most"
        )


def _planned(wanted: int, share: int) -> int:
    """So many samples or a few more: as many as divide a pixel into parts that are not slender.

    Beyond a few those of a pass, `share`, are a divisor.
    """
    if wanted <= share:
        return next(n for n in (1, 2, 4, 8, 16, share) if n >= wanted)
    whole = count(-(-wanted // share) * share, share)
    return next(samples for samples in whole if _aspect(samples) <= MOST_ASPECT)


def _aspect(samples: int) -> float:
    """Width of a sample's part of a pixel over its height, or the other way round."""
    columns, rows = sample_grid(samples)
    return columns / rows
