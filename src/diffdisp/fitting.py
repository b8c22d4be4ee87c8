"""From a picture to a glass: the coefficients of one ball by least squares, and their errors.

A picture knows a glass only by its index at the film's wavelengths. So each step traces once: the
picture and its slopes there, ∂L/∂n and those along other numbers that are free. The others enter
linearly and are eliminated. What is left, to find B and C whose n(λ) lowers the linearised sum of
squares, has a handful of rows and needs no picture: optimistix solves it, non-linear and
ill-conditioned as it is, in milliseconds.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Float

from diffdisp.camera import camera_ray, project
from diffdisp.chunks import (
    COLOR_RANGE,
    Pixels,
    RunNumbers,
    Spectrum,
    check_glasses,
    chunk_lanes,
    chunk_pixels,
    combine,
    each_chunk,
    film_range,
    film_size,
    film_spectrum,
    glass_indices,
    in_dtype,
    over_chunks,
    run_numbers,
    some_blocks,
)
from diffdisp.color import albedo_basis, wavelength_strata
from diffdisp.dispersion import LINE_C, LINE_D, LINE_F, LINE_G, Sellmeier, domain_error
from diffdisp.film import Film
from diffdisp.glass_database import by_C, real_glasses
from diffdisp.glasses import glass_table
from diffdisp.image import Picture
from diffdisp.integrator import (
    Lanes,
    all_spheres,
    followed_radiance,
    lane_radiance,
    nearest,
    no_surface,
    world_tables,
)
from diffdisp.linearised import Columns, Eliminated, Linearised, linearise
from diffdisp.misfit import Clipped, Robust
from diffdisp.parameters import Parameter, Place, named_parameters, value_at, with_coordinates
from diffdisp.planning import Plan, make_plan
from diffdisp.programs import COMPILER_OPTIONS
from diffdisp.rendering import passes
from diffdisp.scene import Scene, is_glass, object_glass, with_glass, without_names
from diffdisp.vector import Array, Real

ASSUMED_NOISE = 1e-3
"""Noise that errors refer to where a picture shows none: that of a good camera, in radiance."""

INDEX_GRID = np.geomspace(1.2, 2.7, 128)
"""Indices at which a coarse picture is traced to find where to start."""

COARSE_PIXELS = 32
"""Blocks along the longer side of the coarsest picture."""

FEW_SAMPLES = 4
"""Film samples per pixel on the way to the last level."""

SPLITS: tuple[int, ...] = (2, 4, 8, 16, 32)
"""Into how many parts each way the last level splits a pixel where numbers of the scene are free
and the target does not say its own samples: those that show nothing of what is free, all others,
and of those as many as `REFINED` says with each of the next; on outlines see `CELLS`. With
`FEW_SAMPLES` in each part that is 16 samples a pixel to 4096, by one program."""

REFINED: tuple[float, ...] = (1.0, 0.6, 0.2, 0.07)
"""Parts of the pixels that show something that get each of the next, at most, beside outlines."""

OF_GLASS_ALONE, REFINED_OF_GLASS = (2, 8), (0.5,)
"""The same where no number of the scene is free: 16 and 256 samples. With 64, n of the bench in
48² pixels and 8 bands is off by half of what a noise of 1 % makes uncertain, with 256 by a
twentieth."""

FOR_SLOPES = 8
"""The last of these for slopes alone, which need to be known to a part of themselves: with 4 to 32
the errors of the bench's n_d and places are the same to 2 %."""

CELLS = 8
"""Cells along each edge of a pixel that an outline crosses, one of `SPLITS`: those that it crosses,
and those beside them, get the samples of the last one, the others those of this."""

COARSE_BY_CHANCE, SLOPES_BY_CHANCE = 16, (64, 256)
"""Samples of each block or pixel for slopes where light scatters by chance: on the coarse picture,
of the glass alone, and where the scene has free numbers. Measured on a ball over a matte ground,
against 256: slopes in the index are 52 and 9 % off, in a ninth and a third of the time. Those along
the ball's place and size are 8 to 40 % noise with 64 samples, which makes the error of an index
that is mixed up with them 30 % too small; with 256, 4 to 19 % and 3 % too small."""

FIRST_DRAWN, MOST_DRAWN = 256, 1 << 27
"""Where light scatters by chance the picture is one of `render`: samples of each pixel on the way,
and the most paths of a picture, some 20 seconds of two cores. It is far less noisy for its time
than the one that comes with slopes: 0.0018 in 5 s where that has 0.007 in 19 s."""

QUIET = 0.3
"""Part of the target's noise that such a picture may have, within `MOST_DRAWN`: that makes errors
larger by 4 %."""

TOLERATED = 0.1
"""Part that an error of a pixel may be of the noise of its channels' mean, since such errors are
alike in all channels, without still more samples. At 256 samples those on the outline of the
bench's ball are as far off as a noise of 1 % of that mean; at 4096 an eighth of that."""

MARKED = 0.75
"""Part of what pixels leave open of n_d that is held by those of the next refinement, where a
tolerance of n_d says how many samples there are."""

LEFT = 1 / 3
"""Part of a change by four times the samples that is left after it, or less: it falls about as the
area of a footprint. On the bench in 64² pixels n_d is 7.5e-5, 1.9e-5, 7.0e-6 and 1.0e-6 off with
4, 16, 64 and 256 samples; extrapolated by that part, 5e-7, 3e-6 and 1e-6."""

SURE = 1.5
"""Standard deviations of a render by chance that count as its error: 0.93 of them are within 1.2
times that."""

HELD = 1e3
"""Weight against which directions that are held move, where the residual's norm is 1."""

DETERMINED = 0.1
"""A direction of log B, log C counts as determined when its standard deviation is below this."""

WIDEST = 3.0
"""Standard deviation in log B, log C about the start of what a picture says nothing of: a factor
of 20 either way, beyond any glass and beyond what a linear error can mean. It keeps fits from
running away and bounds the errors reported; next to anything that a picture tells it is nothing.
The same holds for other free numbers, in the units of their coordinates."""

CLEAN = 1e-5
"""A residual below this part of the brightest value is no noise of a camera."""

CUTOFF = 1e-4
"""Part of its light with which a path ends; 0 in the last steps on a picture without noise."""

NEGLECTED = 3e-3
"""Change of the fitted index over `CUTOFF`: 3e-4 to 2e-3 measured on the bench of N-BK7."""

LINEAR_STEP = 3.0
"""A step that changes the picture by less than this many times its noise is so nearly linear that
the next one is far below a tenth of the noise: 2.5 times, then 0.06 measured on the bench."""

SMALL_STEP = 0.1
"""A step that changes the picture by less than this part of its noise ends the fit."""

UNDERSTATED = " In this scene derivatives do not know how {} move: these errors may be too small."
"""What has to be said where derivatives are not those of the picture: see `_edges_without`."""

UNFINISHED = " The fit was stopped: its answer may lie many of these errors away."
"""What has to be said of errors that are those about a point, which is no minimum yet."""

PROFILE, WIDE_PROFILE = np.arange(-3.0, 4.0), np.arange(-5.0, 6.0)
"""Places, in errors of n_d, at which the sum of squares is looked at along its way: about where a
fit ends, and about the truth, from which the noise takes that."""

DRAWS = 4096
"""Of noise, for what a fit will see there: the mean is then known to less than 1 %."""

POLISH = 6
"""Steps more, at most, where more than the glass is free: a scene's numbers move the picture less
nearly in straight lines."""

FEW_STEP = 10.0
"""Where numbers of the scene are free, a step that changes the picture of few samples by less than
this many times its noise is the last on it: its outlines are rough, so that steps wander by 3 to 6
times that noise without end, and the last level starts 20 times its own away whether they do or
not."""

NEAR_STEP, ROUGH = 30.0, 1.1
"""A step that changes the picture by less than this many times its noise is taken though the sum
of squares rises a little: some samples jump where a silhouette crosses them, by more than what is
left to gain, but hardly move the point at which the slopes and the residual are at right angles."""

FRUITLESS = 10.0
"""Damping of the third step on a drawn picture that lowers nothing, after a whole one and half of
it: paths that jump over borders then change it more than what is left to gain."""

LEAST_CHANGE = (1e-13, 1e-9)
"""Changes of n below this are rounding; and for colour, whose slopes are along six polynomials and
so not quite those of a glass, as little as steps can still tell."""

EXPOSURE = ("gain", "black")
"""What may be free of a picture beside the scene: one factor for each channel, and what is added
to all of them alike."""

PRIORS = ("none", "catalogue", "fixed-c3")

LOSSES = ("squares", "robust")

SETTLE, SETTLED = 100, 0.01
"""Steps at most, on one traced picture, of what is no least-squares problem: until one changes the
picture by less than this part of its noise."""

COLOR_WAVELENGTHS = np.arange(430, 681, 10) / 1e3
"""Where a fit to a colour picture reports n(λ), µm: beyond, sRGB sees almost nothing."""


CHECKS = ("resample",)

REPEATS = 50
"""Of a check by resampling: its spread is then known to 10 %, in some ten seconds."""

TOGETHER = 3
"""Pixels along each side of the squares whose misfits a check turns together."""

COARSE, FEW, LAST = "the coarse picture", "the whole picture at few samples", "the last level"
"""What the levels of a fit are called."""


class StopFit(Exception):
    """Raised by `progress`, ends a fit, which then returns the best point so far."""


class Resampled(NamedTuple):
    """What a check by resampling found.

    Args:
        repeats: how many.
        n_d_std: standard deviation of their n_d.
        ratio: of that to the one reported.
    """

    repeats: int
    n_d_std: float
    ratio: float


class Rendered(NamedTuple):
    """What a fit's own render leaves open of n_d, where a tolerance was asked for.

    Args:
        tolerance: of n_d.
        error: estimated error of n_d by what so many samples leave open; 0 where the target says
            how it was drawn and is drawn so.
        refinements: how many times samples were raised, after the first for all pixels.
    """

    tolerance: float
    error: float
    refinements: int

    @property
    def met(self) -> bool:
        """Whether the error is within the tolerance."""
        return self.error <= self.tolerance


class FreeValue(NamedTuple):
    """What a fit found of a number that was free beside B and C.

    Args:
        name: as in `ball.center.x`; of the exposure "black", and "gain[0]" for the first channel.
        value: in the units of the scene; a gain is a factor.
        std: one standard deviation.
    """

    name: str
    value: float
    std: float


@dataclass(frozen=True)
class Uncertainty:
    """How well a picture tells a glass.

    Args:
        object_name: name of the ball made of it.
        B: (3,) dimensionless.
        C: (3,) µm².
        B_std: (3,) one standard deviation; 0 where held fixed.
        C_std: (3,) one standard deviation, µm².
        covariance: (6, 6) of B1 B2 B3 C1 C2 C3.
        n_d: index at the d line.
        n_d_std: one standard deviation.
        V_d: Abbe number.
        V_d_std: one standard deviation.
        P_gF: relative partial dispersion.
        P_gF_std: one standard deviation.
        wavelengths: (K,) µm, of `n`.
        n: (K,) index.
        n_std: (K,) one standard deviation.
        singular_values: of the Jacobian in log B, log C over the noise: one over the standard
            deviation of each direction.
        determined: how many of them are known to better than 0.1.
        summary: the same in a sentence.
        prior: "none", "catalogue" or "fixed-c3".
        noise: standard deviation of the picture's values, as given.
        samples: film samples per pixel, the fewest first.
        free: what else is free.
    """

    object_name: str
    B: np.ndarray
    C: np.ndarray
    B_std: np.ndarray
    C_std: np.ndarray
    covariance: np.ndarray
    n_d: float
    n_d_std: float
    V_d: float
    V_d_std: float
    P_gF: float
    P_gF_std: float
    wavelengths: np.ndarray
    n: np.ndarray
    n_std: np.ndarray
    singular_values: np.ndarray
    determined: int
    summary: str
    prior: str
    noise: float
    samples: tuple[int, ...]
    free: tuple[FreeValue, ...] = ()


@dataclass(frozen=True)
class FitResult:
    """What a picture says about a glass.

    Args:
        scene: the scene with the fitted glass, and what else was fitted of it.
        glass: the fitted glass.
        object_name: name of the ball made of it.
        converged: whether a minimum was reached that explains the picture.
        message: why, or why not.
        steps: traced pictures of the last level.
        B: (3,) dimensionless.
        C: (3,) µm².
        B_std: (3,) one standard deviation; 0 where held fixed.
        C_std: (3,) one standard deviation, µm².
        covariance: (6, 6) of B1 B2 B3 C1 C2 C3.
        n_d: index at the d line.
        n_d_std: one standard deviation.
        V_d: Abbe number.
        V_d_std: one standard deviation.
        P_gF: relative partial dispersion.
        P_gF_std: one standard deviation.
        wavelengths: (K,) µm, of `n`.
        n: (K,) fitted index.
        n_std: (K,) one standard deviation.
        singular_values: of the Jacobian in log B, log C over the noise: one over the standard
            deviation of each direction.
        determined: how many of them are known to better than 0.1.
        summary: the same in a sentence.
        rms_residual: root mean square of picture minus target.
        nearest_glasses: names of catalogue glasses and their distance in standard deviations.
        prior: "none", "catalogue" or "fixed-c3".
        noise: the noise that the errors refer to; None where it was estimated from the residual.
        samples: film samples per pixel of the last level, the fewest first.
        picture: (height, width, channels) render with the fitted glass, exposed as the target.
        free: what else was free.
        used: (height, width) pixels that the fit went by; None where it was all of them.
        clipped: how many of their values were cut off and count as "at least that bright".
        loss: "squares" or "robust".
        outliers: how many values the robust loss left out at the end.
        probabilities: of `nearest_glasses`, that the ball is made of each.
        other_probability: that it is of none of the table.
        stopped: whether it was told to stop; all else is then of the best point so far, and
            `picture` is 0 where nothing had been rendered.
        check: of the errors, where one was asked for and something depends on the glass.
        rendering: what the fit's own render leaves open of n_d; None where no tolerance was asked
            for, or the fit was stopped before its last level.
    """

    scene: Scene
    glass: Sellmeier
    object_name: str
    converged: bool
    message: str
    steps: int
    B: np.ndarray
    C: np.ndarray
    B_std: np.ndarray
    C_std: np.ndarray
    covariance: np.ndarray
    n_d: float
    n_d_std: float
    V_d: float
    V_d_std: float
    P_gF: float
    P_gF_std: float
    wavelengths: np.ndarray
    n: np.ndarray
    n_std: np.ndarray
    singular_values: np.ndarray
    determined: int
    summary: str
    rms_residual: float
    nearest_glasses: tuple[tuple[str, float], ...]
    prior: str
    noise: float | None
    samples: tuple[int, ...]
    picture: np.ndarray
    free: tuple[FreeValue, ...] = ()
    used: np.ndarray | None = None
    clipped: int = 0
    loss: str = "squares"
    outliers: int = 0
    probabilities: tuple[float, ...] = ()
    other_probability: float = float("nan")
    stopped: bool = False
    check: Resampled | None = None
    rendering: Rendered | None = None

    @property
    def masked(self) -> int:
        """How many pixels a mask left out."""
        return 0 if self.used is None else int(np.sum(~self.used))


class Coefficients(eqx.Module):
    """Coordinates of B and C without bounds: no value of them puts a pole into the band.

    log |B| keeps the sign; C below the band is low²·sigmoid, above it high²·(1 + exp). What is
    not free keeps its value: B = 0, C ≤ 0, and C₃ under that prior.

    Args:
        B: (3,) start.
        C: (3,) start, µm².
        low: shortest wavelength, µm.
        high: longest wavelength, µm.
        free: which of B1 B2 B3 C1 C2 C3 are free.
    """

    B: np.ndarray
    C: np.ndarray
    low: np.ndarray
    high: np.ndarray
    free: tuple[bool, ...] = eqx.field(static=True)

    def start(self) -> np.ndarray:
        """Coordinates (free,) of the start."""
        below, above = self.C / self.low**2, self.C / self.high**2 - 1
        C = np.where(self.C < self.low**2, _log(below) - _log(1 - below), _log(above))
        return np.concatenate([_log(np.abs(self.B)), C])[list(self.free)]

    def values(self, z: Array) -> tuple[jax.Array, jax.Array]:
        """B and C (3,) at coordinates `z` (free,)."""
        free = np.array(self.free)
        full = jnp.zeros(6).at[np.flatnonzero(free)].set(z)
        below = self.C < self.low**2
        B = jnp.sign(self.B) * jnp.exp(full[:3])
        above = self.high**2 * (1 + jnp.exp(jnp.where(below, 0.0, full[3:])))
        C = jnp.where(below, self.low**2 * jax.nn.sigmoid(full[3:]), above)
        return jnp.where(free[:3], B, self.B), jnp.where(free[3:], C, self.C)

    def index(self, z: Array, wavelengths: jax.Array | np.ndarray) -> jax.Array:
        """N (k,) at `wavelengths` (k,), µm; continued smoothly where n² would fall below 1/4."""
        B, C = self.values(z)
        squared = jnp.asarray(wavelengths)[:, None] ** 2
        zero = (B == 0)[None, :]
        terms = jnp.where(zero, 0.0, B[None] * squared / jnp.where(zero, 1.0, squared - C[None]))
        n_squared = 1 + jnp.sum(terms, axis=-1)
        low = 0.25 / (1 - jnp.minimum(n_squared / 0.25 - 1, 0.0))
        return jnp.sqrt(jnp.where(n_squared > 0.25, n_squared, low))

    def smooth(self) -> np.ndarray:
        """Directions (free, 3) that keep n(λ) smooth.

        Strength of the terms below the band, of those above it, and where those below it are.
        """
        below = np.tile(self.C < self.low**2, 2)
        strength = np.arange(6) < 3
        columns = (strength & below, strength & ~below, ~strength & below)
        return np.stack(columns, axis=1)[list(self.free)].astype(float)

    def logarithms(self, z: Array) -> jax.Array:
        """Log |B| and log C (free,) at `z`, in which results are reported."""
        B, C = self.values(z)
        return jnp.log(jnp.abs(jnp.concatenate([B, C])[np.flatnonzero(self.free)]))


def _log(x: np.ndarray) -> np.ndarray:
    """Log of the positive ones; 0 for the others, which are held fixed."""
    return np.log(np.where(x > 0, x, 1.0))


class Unknowns(NamedTuple):
    """What is looked for: n(λ) through B and C.

    A change of n(λ) has `m` coordinates: its values at the bands, or for a colour film, which
    sees many wavelengths at once, the coefficients of Chebyshev polynomials.

    Args:
        coefficients: coordinates of B and C.
        reference: (k,) µm, wavelengths that represent n(λ).
        project: (m, k) from a change of n at `reference` to its coordinates.
        prior_mean: (rows,) of what a prior knows.
        prior_rows: (rows, free) rows · logarithms - mean has unit variance under the prior.
    """

    coefficients: Coefficients
    reference: np.ndarray
    project: np.ndarray
    prior_mean: np.ndarray
    prior_rows: np.ndarray

    def change(self, z: Array, index: Array) -> Array:
        """Coordinates (m,) of the change from `index` at the reference wavelengths to n at `z`."""
        return self.project @ (self.coefficients.index(z, self.reference) - index)


class Free(NamedTuple):
    """What is free beside B and C: numbers of the scene, then gains, then a black level.

    Args:
        names: as users wrote them.
        parameters: numbers of the scene.
        gains: one for each channel, or none; the coordinate is a logarithm.
        blacks: 1 where the black level is free, else 0.
        brightest: of the target, the black level's unit.
    """

    names: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    gains: int
    blacks: int
    brightest: float

    @property
    def total(self) -> int:
        """How many coordinates they have."""
        return len(self.parameters) + self.gains + self.blacks

    @property
    def places(self) -> tuple[Place, ...]:
        """Where the scene's numbers stand."""
        return tuple(parameter.place for parameter in self.parameters)

    @property
    def units(self) -> np.ndarray:
        """Of the scene's numbers."""
        return np.array([parameter.unit for parameter in self.parameters], float)

    def exposure(self, others: np.ndarray) -> tuple[np.ndarray, float]:
        """The gain of each channel, or one for all, and the black level at some coordinates."""
        start = len(self.parameters)
        gains = np.exp(others[start : start + self.gains]) if self.gains else np.ones(1)
        return gains, float(others[-1] * self.brightest) if self.blacks else 0.0


class Point(NamedTuple):
    """Values of all that is looked for.

    Args:
        z: coordinates (free,) of B and C.
        others: those of what else is free.
    """

    z: np.ndarray
    others: np.ndarray


class Problem(NamedTuple):
    """What stays the same through a fit.

    Args:
        scene: the scene; its ball's glass is replaced.
        number: number of the ball among the objects.
        ball: its number among those of glass.
        film: the target's.
        target: (height, width, channels); 0 where it is not used.
        used: (height, width) pixels that count.
        ceiling: from which on values are clipped; infinity where none are.
        unknowns: what is looked for.
        free: what else is.
        loss: one of `LOSSES`.
        progress: called with the step, the root mean square residual and n_d.
        kept: the best point so far, and its level, once there is one; it is kept up to date.
        tolerance: of n_d, for the error that the fit's own render makes; None for as many samples
            as the target's noise asks for.
    """

    scene: Scene
    number: int
    ball: int
    film: Film
    target: np.ndarray
    used: np.ndarray
    ceiling: float
    unknowns: Unknowns
    free: Free
    loss: str
    progress: Callable[[int, float, float], None]
    kept: "list[tuple[Level, Descent]]"
    tolerance: float | None = None


class Part(NamedTuple):
    """Blocks of pixels that are rendered alike.

    Args:
        plan: static choices of the render.
        spectrum: the film's.
        chunks: the blocks.
        place: (cells,) where the cells of all blocks, one block after the other, stand among the
            chunks' pixels.
        first: (blocks,) which of them is each block's first.
        rows: (blocks,) their rows in the level's target.
        split: each block is divided into split² cells, which are rendered and averaged: more
            samples by the same program. Cells that another part draws count as 0 here.
        share: weight of this render in the sum that those blocks' picture is.
        tangents: (t, *wavelengths) changes of n along which the picture is differentiated.
    """

    plan: Plan
    spectrum: Spectrum
    chunks: Pixels
    place: np.ndarray
    first: np.ndarray
    rows: np.ndarray
    split: int
    share: float
    tangents: np.ndarray


class Level(NamedTuple):
    """One resolution of the problem.

    Args:
        name: what it is called.
        size: of a block, pixels along each side.
        blocks: (blocks,) numbers of those that count, row by row over the film.
        parts: what renders them; the shares of each block's parts sum to 1.
        target: (blocks, channels).
        weights: (blocks, 1) of the squared residuals.
        seed: of the render.
        clipped: values of the target that were cut off; None where there are none.
        robust: the loss; None for squares.
        drawing: the render that the picture is, where light scatters by chance; the parts are then
            for slopes alone. None where the parts are the picture.
        rendering: what its samples leave open of n_d, where a tolerance was asked for.
    """

    name: str
    size: int
    blocks: np.ndarray
    parts: tuple[Part, ...]
    target: np.ndarray
    weights: np.ndarray
    seed: int
    clipped: Clipped | None
    robust: Robust | None
    drawing: "Drawing | None" = None
    rendering: Rendered | None = None


class Drawing(NamedTuple):
    """A picture of `render`.

    Args:
        samples: of each pixel.
        depth: segments of a path.
        seed: of the numbers that paths draw.
        apart: whether each band draws numbers of its own, so that bands err independently, as
            their noise does; else it is the picture that `render` makes of all of them.
    """

    samples: int
    depth: int
    seed: int
    apart: bool


def fit(
    scene: Scene,
    target: Picture,
    *,
    object_name: str | None = None,
    free: Sequence[str] = (),
    prior: str = "none",
    noise: float | None = None,
    start: Sellmeier | None = None,
    mask: np.ndarray | None = None,
    loss: str = "squares",
    check: str | None = None,
    tolerance: float | None = None,
    progress: Callable[[int, float, float], None] | None = None,
) -> FitResult:
    """The Sellmeier coefficients of a glass ball from a picture of it, in float64.

    Args:
        scene: what the picture shows; the ball's glass in it is where the fit starts.
        target: the picture; its film is the fit's. Its `samples`, `depth` and `seed` are used in
            the last level where it has them. Values that reach its `ceiling` were cut off: they
            count as "at least that bright".
        object_name: the ball, where the scene has several of glass.
        free: what is not known well beside the glass and is fitted too, from its value in the
            scene: numbers of the scene by name, such as "ball.center", "ball.center.z",
            "screen.tile" or "camera.vertical_fov"; "gain", a factor for each channel of the
            picture; "black", what is added to all of them. They enter the errors of the glass.
        prior: "none"; "catalogue", a Gaussian in log B, log C over real glasses: those of the
            refractiveindex.info database where the package `refractiveindex` is installed, of the
            table otherwise; "fixed-c3", which holds C₃ at its start.
        noise: standard deviation of the target's values where it is known; otherwise errors are
            estimated from the residual, heteroscedasticity-consistent.
        start: a glass to start from instead of the scene's.
        mask: (height, width) of the target; pixels where it is zero or False are left out of the
            fit and of its errors. They may hold anything, NaN too.
        loss: "squares"; or "robust", by which values far off what most others show, in units of
            their spread, pull no stronger (Huber) on the way and not at all (Tukey) in the end.
            Errors are then those of the M-estimate.
        check: "resample": the last step is repeated with the misfits of squares of pixels turned
            round at random, which shows whether the error reported of n_d is the spread that
            noise of this kind gives it. It takes the picture as linear near the answer, and does
            not know errors of the scene or of the render.
        tolerance: of n_d, for the error that the fit's own render makes: samples are raised, of
            those pixels first that count most for n_d, until the estimate of that error is within
            it. By default there are as many as make it small beside the noise. What the picture's
            noise leaves open is not changed by it. A target that says its `samples` is drawn with
            them all the same.
        progress: called with the step, the root mean square residual and n_d. It may raise
            `StopFit`.

    Returns:
        The glass, its errors and how the fit ended; look at `converged`. After `StopFit`, or
        Ctrl-C once there is a first point, those of the best point so far: `stopped` is true then
        and `converged` false, and `message` says at which level.

    Raises:
        ValueError: no such glass ball, or several and no name; a start with a pole in the band or
            without any free coefficient; an unknown prior; a noise that is not positive; a name
            in `free` that the scene does not have; a mask of another size, or that leaves
            nothing; values that are used and not finite; a tolerance that is not positive.
    """
    _check_known(prior, noise)
    if tolerance is not None and not (np.isfinite(tolerance) and tolerance > 0):
        raise ValueError(f"tolerance {tolerance}: must be a finite number above 0")
    if loss not in LOSSES:
        raise ValueError(f"loss {loss!r}: allowed are {', '.join(LOSSES)}")
    if check is not None and check not in CHECKS:
        raise ValueError(f"check {check!r}: allowed are {', '.join(CHECKS)}")
    number = glass_object(scene, object_name)
    if start is not None:
        scene = with_glass(scene, number, start)
    check_glasses(scene, *film_range(target.film))
    used = _used(target, mask)
    target = replace(target, radiance=np.where(used[..., None], target.radiance, 0.0))
    with jax.enable_x64(True):
        problem = _problem(scene, number, target, used, free, prior, loss, progress or _silent)
        problem = problem._replace(tolerance=tolerance)
        return _fit(problem, target, prior, noise, check)


def _used(target: Picture, mask: np.ndarray | None) -> np.ndarray:
    """Pixels (height, width) of a target that a mask does not leave out."""
    size = target.radiance.shape[:2]
    used = np.ones(size, bool) if mask is None else np.asarray(mask) != 0
    if used.shape != size:
        raise ValueError(f"mask {used.shape}: must be {size}, (height, width) of the target")
    if not used.any():
        raise ValueError("mask: zero everywhere leaves nothing to fit")
    broken = np.count_nonzero(~np.isfinite(target.radiance[used]))
    if broken:
        raise ValueError(
            f"target: {broken} of its values are not finite; a mask may leave them out"
        )
    return used


def expected_uncertainty(
    scene: Scene,
    film: Film,
    *,
    noise: float,
    object_name: str | None = None,
    free: Sequence[str] = (),
    prior: str = "none",
) -> Uncertainty:
    """What a picture of a scene would tell of a glass ball, before anybody takes it; in float64.

    The errors that `fit` would report of such a picture, if it found the scene's own glass: the
    picture and its slopes there are those of its last level. Where numbers of the scene are free,
    what a fit will see along the way least known is the mean over such noise; the residual of one
    picture makes its errors a tenth larger or smaller. What so many samples leave open of each
    pixel counts as noise too; where that is more than the noise, fits report up to 1.6 times these
    errors (measured on the bench at 32 pixels and a noise of 1e-3; at 64 pixels 1.0).

    Args:
        scene: what the picture is to show; the ball's glass in it is what is looked at.
        film: size and bands of the picture.
        noise: standard deviation of its values, the same in all, in units of radiance.
        object_name: the ball, where the scene has several of glass.
        free: what else is not known well and would be fitted, as in `fit`.
        prior: as in `fit`.

    Returns:
        The scene's glass, and its errors.

    Raises:
        ValueError: as of `fit`; a ball that no pixel of the picture depends on.

    Source:
        Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (Prentice Hall,
        1993), sections 3.5 and 3.7: the bound of Cramér and Rao for a signal in white noise, from
        the signal's slopes alone.
    """
    _check_known(prior, noise)
    number = glass_object(scene, object_name)
    check_glasses(scene, *film_range(film))
    bands = None if film.wavelengths is None else np.asarray(film.wavelengths)
    blank = Picture(np.zeros((film.height, film.width, film.channels)), bands)
    used = np.ones((film.height, film.width), bool)
    with jax.enable_x64(True):
        problem = _problem(scene, number, blank, used, free, prior, LOSSES[0], _silent)
        return _expected(problem, prior, noise)


def _expected(problem: Problem, prior: str, noise: float) -> Uncertainty:
    """The last level of a fit to the picture that the scene itself makes."""
    at = Point(problem.unknowns.coefficients.start(), np.zeros(problem.free.total))
    few = _linearise(problem, _level(problem, FEW, 1, FEW_SAMPLES, 50, 0), at, CUTOFF)
    if few.seen == 0:
        raise ValueError("no pixel of such a picture depends on this glass")
    brightest = float(np.max(np.abs(few.picture))) or 1.0
    problem = problem._replace(free=problem.free._replace(brightest=brightest))
    if _by_chance(problem):
        drawing = Drawing(FIRST_DRAWN, 50, 0, apart=True)
        level = _slopes_by_chance(problem, 50, 0)._replace(drawing=drawing)
        seen = _linearise(problem, level, at, CUTOFF)
        level, left = _drawn_enough(problem, level, _own_noise(problem, level, seen, at), noise)
        level = level._replace(weights=level.weights / (1 + (left / noise) ** 2))
    else:
        many = _level(problem, LAST, 1, FEW_SAMPLES, 50, 0, SPLITS[0])
        some = _linearise(problem, many, at, CUTOFF)
        level, slopes = _more_samples(problem, many, few, some, at, 50, noise)
        known = some.columns
        if problem.free.parameters:
            known = _linearise(problem, slopes, at, CUTOFF).columns
        seen = _linearise(problem, level, at, CUTOFF, known, of_index=True)
    # A pixel's weight says how much of its residual is what samples leave open, beside the noise:
    # all residuals, weighed, are to be as large as the noise.
    residual = noise / np.sqrt(np.where(level.weights > 0, level.weights, 1.0))
    lin = linearise(seen.picture, seen.picture + residual, seen.columns, level.weights, WIDEST)
    expected, source = _noise(lin, noise, brightest), f"at a noise of {noise:g}"
    if expected.sigma > noise:
        source += f", with what samples leave open as of {expected.sigma:.2g}"
    expected = expected._replace(source=source)
    opening = "Such a picture would fix"
    if problem.free.parameters and not _clean(level, lin):
        here = Descent(at, lin._replace(q=np.zeros_like(lin.q)), 0, True, 0.0, at.z)
        wider = _wider(problem, level, here, seen.columns)
        expected = expected._replace(meat=expected.meat + np.multiply.outer(wider, wider))
    told = _uncertainty(problem, at, level, lin, expected, prior, opening)
    return replace(told, noise=noise)


def _check_known(prior: str, noise: float | None) -> None:
    """Refuse what cannot be known beforehand.

    Raises:
        ValueError: an unknown prior; a noise that is not positive.
    """
    if prior not in PRIORS:
        raise ValueError(f"prior {prior!r}: allowed are {', '.join(PRIORS)}")
    if noise is not None and not (np.isfinite(noise) and noise > 0):
        raise ValueError(f"noise {noise}: must be a finite number above 0")


def _silent(step: int, rms: float, n_d: float) -> None:
    """No progress wanted."""


def glass_object(scene: Scene, name: str | None) -> int:
    """Number of the glass ball called `name`, or of the only one.

    Raises:
        ValueError: there is none, or several and no name.
    """
    glasses = [i for i, obj in enumerate(scene.objects) if is_glass(obj)]
    if not glasses:
        raise ValueError("the scene has no glass ball to fit")
    names = [scene.objects[i].name or f"object[{i}]" for i in glasses]
    if name is None and len(glasses) > 1:
        raise ValueError(f"the scene has several glass balls, name one: {', '.join(names)}")
    if name is not None and name not in names:
        raise ValueError(f"no glass ball is called {name!r}: allowed are {', '.join(names)}")
    return glasses[0 if name is None else names.index(name)]


def _problem(
    scene: Scene,
    number: int,
    target: Picture,
    used: np.ndarray,
    free: Sequence[str],
    prior: str,
    loss: str,
    progress: Callable[[int, float, float], None],
) -> Problem:
    film = target.film
    glass = object_glass(scene, number)
    low, high = film_range(film)
    B, C = np.asarray(glass.B, np.float64), np.asarray(glass.C, np.float64)
    terms = (B != 0) & (C > 0)
    mask = np.concatenate([terms, terms])
    if prior == "fixed-c3":
        mask[5] = False
    if not mask.any():
        raise ValueError("the start has no term with B ≠ 0 and C > 0: nothing is free")
    coefficients = Coefficients(B, C, np.asarray(low), np.asarray(high), tuple(mask.tolist()))
    if film.wavelengths is None:
        reference = np.linspace(*COLOR_RANGE, 33)
        # Beyond the middle of the visible sRGB sees little: what n does there counts less.
        project = np.linalg.pinv(_polynomials(reference).T)
    else:
        reference = np.asarray(film.wavelengths)
        project = np.eye(len(reference))
    mean, rows = _prior(prior, C, mask)
    ball = [i for i, obj in enumerate(scene.objects) if is_glass(obj)].index(number)
    unknowns = Unknowns(coefficients, reference, project, mean, rows)
    others = _free(scene, number, target, free)
    ceiling = np.inf if target.ceiling is None else target.ceiling
    return Problem(
        scene,
        number,
        ball,
        film,
        target.radiance,
        used,
        ceiling,
        unknowns,
        others,
        loss,
        progress,
        [],
    )


def _free(scene: Scene, number: int, target: Picture, names: Sequence[str]) -> Free:
    """What some names free, of the scene and of the exposure."""
    for name in EXPOSURE:
        if names.count(name) > 1:
            raise ValueError(f"{name} is free twice")
    shape: Any = scene.objects[number].shape
    of_scene = [name for name in names if name not in EXPOSURE]
    return Free(
        tuple(names),
        named_parameters(scene, of_scene, float(shape.radius)),
        target.film.channels if "gain" in names else 0,
        int("black" in names),
        float(np.max(np.abs(target.radiance))) or 1.0,
    )


def _polynomials(wavelengths: np.ndarray) -> np.ndarray:
    """Chebyshev polynomials (6, ...) over the visible: a change of n(λ) needs no more."""
    middle, half = sum(COLOR_RANGE) / 2, (COLOR_RANGE[1] - COLOR_RANGE[0]) / 2
    columns = np.polynomial.chebyshev.chebvander((wavelengths - middle) / half, 5)
    return np.moveaxis(columns, -1, 0)


def _prior(prior: str, C: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and whitening rows of the logarithms under the catalogue; no rows for other priors."""
    if prior != "catalogue":
        return np.zeros(0), np.zeros((0, int(mask.sum())))
    if not mask.all():
        raise ValueError("the catalogue prior needs a start of three terms with B, C above 0")
    logs = np.log(real_glasses().terms)
    mean, whiten = logs.mean(0), np.linalg.inv(np.linalg.cholesky(np.cov(logs.T)))
    order = by_C(C)
    rows = np.zeros((6, 6))
    rows[:, order] = whiten
    return whiten @ mean, rows


def _level(
    problem: Problem,
    name: str,
    size: int,
    samples: int,
    depth: int,
    seed: int,
    split: int = 1,
) -> Level:
    """The problem in blocks of `size` pixels, each with `samples` · `split`² samples.

    What fills no block at the border is left out; where that is all, the blocks are pixels.
    """
    means = partial(block_means, size)
    share = means(problem.used)
    blocks = np.flatnonzero(_counted(share[:, 0]))
    if not len(blocks):
        return _level(problem, name, 1, samples, depth, seed, split)
    share = share[blocks]
    part = _part(problem, size, samples, depth, blocks, np.arange(len(blocks)), split)
    target = means(problem.target)[blocks] / share
    clipped = _clipped(problem, means, blocks, share)
    robust = Robust("huber", problem.free.brightest) if problem.loss == "robust" else None
    return Level(name, size, blocks, (part,), target, share, seed, clipped, robust)


def block_means(size: int, values: np.ndarray) -> Float[np.ndarray, "blocks channels"]:
    """Means of a picture over all blocks of `size` pixels, without what fills none."""
    height, width = (edge // size for edge in values.shape[:2])
    cut = values[: height * size, : width * size]
    return cut.reshape(height, size, width, size, -1).mean((1, 3)).reshape(height * width, -1)


def _clipped(
    problem: Problem,
    means: Callable[[np.ndarray], np.ndarray],
    blocks: np.ndarray,
    share: np.ndarray,
) -> Clipped | None:
    """The values of some blocks that were cut off; a block with one such is at least its mean."""
    over = problem.target >= problem.ceiling
    if not over.any():
        return None
    least = means(np.minimum(problem.target, problem.ceiling))[blocks] / share
    return Clipped(means(over)[blocks] > 0, least, CLEAN * problem.free.brightest)


def _counted(share: np.ndarray) -> np.ndarray:
    """Which blocks count, by the part (blocks,) of each one's pixels that are used.

    The mean of some pixels of a block is not quite what a render of the whole block shows. So
    blocks that are cut count only where the whole ones hold less than half of the used pixels, as
    in a large picture with dead pixels all over: with the mean of their used pixels, weighed by
    their part. At single pixels every block is whole or does not count.
    """
    whole = share == 1
    return whole if 2 * np.sum(share[whole]) >= np.sum(share) else share > 0


def _part(
    problem: Problem,
    size: int,
    samples: int,
    depth: int,
    blocks: np.ndarray,
    rows: np.ndarray,
    split: int = 1,
    share: float = 1.0,
    cells: np.ndarray | None = None,
) -> Part:
    """The blocks of `size` pixels with numbers `blocks`, at `samples` · `split`² samples.

    Of their cells (blocks, split, split) those that `cells` says, where it says any; one at least
    of each block.
    """
    film = problem.film
    plan = replace(make_plan(problem.scene, film, samples, depth, "float64"), dispersive=True)
    plan = replace(plan, filtered=plan.scattering)
    spectrum = film_spectrum(film, plan, seed=0)
    width = film.width // size
    if cells is None:
        cells = np.ones((len(blocks), split, split), bool)
    block, down, right = np.nonzero(cells)
    y, x = np.divmod(blocks[block], width)
    numbers = (y * split + down) * (width * split) + x * split + right
    count = chunk_pixels(film, plan)
    chunks, place = some_blocks(numbers, width * split, size / split, count)
    first = np.searchsorted(block, np.arange(len(blocks)))
    if film.wavelengths is None:
        tangents = _polynomials(np.asarray(spectrum.wavelengths))
    else:
        tangents = np.ones((1, film.channels))
    return Part(plan, spectrum, chunks, place, first, rows, split, share, tangents)


def _traced(
    plan: Plan,
    ball: int,
    places: tuple[Place, ...],
    scene: Scene,
    spectrum: Spectrum,
    size: tuple[Real, Real],
    chunks: Pixels,
    run: RunNumbers,
    index: Array,
    tangents: Array,
    coordinates: Array,
    units: Array,
) -> jax.Array:
    """Pixels (chunks, pixels, 1 + k + t, channels).

    Radiance, and its changes: along the coordinates of k numbers of the scene, and along t changes
    of one ball's index.
    """
    scene, spectrum, size, chunks, run = in_dtype((scene, spectrum, size, chunks, run), plan.dtype)
    indices = glass_indices(scene, spectrum.wavelengths)

    def at(index: Array) -> tuple[Array, ...]:
        return (*indices[:ball], index, *indices[ball + 1 :])

    def chunk(pixels: Pixels) -> Array:
        def lanes(coordinates: Array) -> Lanes:
            changed = with_coordinates(scene, places, units, coordinates)
            return chunk_lanes(plan, changed, spectrum, size, pixels, run)

        def of_scene(coordinates: Array) -> Array:
            return combine(plan, followed_radiance(plan, at(index), lanes(coordinates)), spectrum)

        def of_index(index: Array) -> Array:
            sharp = replace(plan, soft=False)
            return combine(sharp, lane_radiance(sharp, at(index), lanes(coordinates)), spectrum)

        def change(tangent: Array) -> tuple[Array, Array]:
            return jax.jvp(of_index, (index,), (tangent,))

        def along(move: Array) -> Array:
            return jax.jvp(of_scene, (coordinates,), (move,))[1]

        if len(tangents):
            value, slopes = jax.vmap(change, out_axes=(None, 0))(tangents)
        else:
            value = of_index(index)
            slopes = jnp.zeros((0, *value.shape), value.dtype)
        if places:
            moves = jnp.eye(len(places), dtype=plan.dtype)
            slopes = jnp.concatenate([jax.vmap(along)(moves), slopes])
        return jnp.moveaxis(jnp.concatenate([value[None], slopes]), 0, 1)

    return each_chunk(chunk, chunks)


_traced_jit = jax.jit(_traced, static_argnums=(0, 1, 2), compiler_options=COMPILER_OPTIONS)


def _trace(
    problem: Problem,
    part: Part,
    at: Point,
    seed: int,
    cutoff: float,
    along_scene: bool,
    along_index: bool,
) -> Float[np.ndarray, "blocks derivatives channels"]:
    """Radiance of a part's blocks, and its changes as `_traced` has them.

    Those along the scene's numbers cost several times as much as all else, and those along the
    index more than the radiance: only if asked for.
    """
    waves, free = np.asarray(part.spectrum.wavelengths), problem.free
    coefficients = problem.unknowns.coefficients
    index = np.asarray(coefficients.index(at.z, waves.ravel())).reshape(waves.shape)
    size, run = film_size(problem.film), run_numbers(part.plan, seed, cutoff)
    scene, coordinates = problem.scene, at.others[: len(free.parameters)]
    places, units = free.places, free.units
    if not along_scene:
        scene = _with_others(problem, at.others)
        places, units, coordinates = (), units[:0], coordinates[:0]
    scene = without_names(scene)
    tangents = part.tangents if along_index else part.tangents[:0]

    # A ball's outline moves with it; slopes of points of it are far from a pixel's. Of one ball the
    # camera's footprints are cut along it; others are seen through that. Of a picture that is drawn
    # as the target was they are the true ones all the same.
    among_others = part.plan.balls > 1 and not part.plan.nested
    soft = part.plan.scattering or (part.split > 1 and among_others)
    plan = replace(part.plan, soft=soft and bool(places))

    def trace(chunks: Pixels) -> np.ndarray:
        fixed = (scene, part.spectrum, size, chunks, run, index, tangents)
        return np.asarray(_traced_jit(plan, problem.ball, places, *fixed, coordinates, units))

    values = over_chunks(trace, part.chunks, "float64")
    cells = values.reshape(-1, *values.shape[2:])[part.place]
    sums: np.ndarray = np.add.reduceat(cells, part.first, axis=0)
    return sums / part.split**2


def _linearise(
    problem: Problem,
    level: Level,
    at: Point,
    cutoff: float,
    known: Columns | None = None,
    of_index: bool = False,
) -> Linearised:
    """The picture and its slopes at a point, reduced to what a step needs.

    Args:
        problem: what stays the same.
        level: the resolution.
        at: the point.
        cutoff: part of its light with which a path ends.
        known: slopes along the scene's numbers from another point, so near that they still hold,
            or from fewer samples.
        of_index: whether those of the index are taken from there too.
    """
    free, channels = problem.free, problem.film.channels
    count, bands = len(free.parameters), problem.film.wavelengths is not None
    tangents, along = len(level.parts[0].tangents), count if known is None else 0
    traced_tangents = 0 if of_index else tangents
    joined = np.zeros((len(level.target), 1 + along + traced_tangents, channels))
    for part in () if level.drawing and known is not None and of_index else level.parts:
        traced = _trace(problem, part, at, level.seed, cutoff, known is None, not of_index)
        joined[part.rows] += part.share * traced
    if level.drawing:
        drawn = _drawn(problem, level.drawing, at)
        joined[:, 0] = block_means(level.size, drawn)[level.blocks]
    gains, black = free.exposure(at.others)
    joined *= gains
    radiance, slopes = joined[:, :1], joined[:, 1:]
    if known is not None:
        again = known.values.transpose(1, 2, 0)
        of_it = again[:, again.shape[1] - tangents :] if of_index else slopes
        slopes = np.concatenate([again[:, :count], of_it], axis=1)
    # The gains' coordinates are logarithms: the slope along one is what its channel shows.
    levels = np.full((len(joined), free.blacks, channels), free.brightest)
    shown = [slopes[:, :count], radiance[:, : min(free.gains, 1)], levels, slopes[:, count:]]
    own = np.arange(channels)[:, None]
    unknown = [
        np.broadcast_to(np.arange(count), (channels, count)),
        count + own[:, : min(free.gains, 1)],
        np.full((channels, free.blacks), count + free.gains),
        free.total + (own if bands else np.broadcast_to(np.arange(tangents), (channels, tangents))),
    ]
    columns = Columns(
        np.ascontiguousarray(np.concatenate(shown, axis=1).transpose(2, 0, 1)),
        np.concatenate(unknown, axis=1),
        free.total,
        free.total + len(problem.unknowns.project),
    )
    return _reduced(level, radiance[:, 0] + black, columns)


def _drawn(
    problem: Problem, drawing: Drawing, at: Point
) -> Float[np.ndarray, "height width channels"]:
    """The radiance of a render at a point."""
    film, glass = problem.film, Sellmeier(*problem.unknowns.coefficients.values(at.z))
    scene = with_glass(_with_others(problem, at.others), problem.number, glass)
    films = [film]
    if drawing.apart and film.wavelengths is not None:
        waves = np.asarray(film.wavelengths)
        films = [replace(film, wavelengths=wave[None]) for wave in waves]
    pictures = []
    for number, some in enumerate(films):
        settings = drawing.samples, drawing.depth, drawing.seed + number, "float64"
        *_, last = passes(scene, some, *settings)
        pictures.append(last.radiance)
    return np.concatenate(pictures, axis=-1)


def _reduced(level: Level, picture: np.ndarray, columns: Columns) -> Linearised:
    """A level's picture and its slopes, reduced to what a step needs."""
    told = level.clipped, level.robust
    return linearise(picture, level.target, columns, level.weights, WIDEST, *told)


def _rescaled(level: Level, lin: Linearised, brightest: float) -> tuple[Level, Linearised]:
    """A level with the noise that its picture shows, where its misfits have to know it.

    The median for clipped values is that of flat parts of a picture, where most of them are; the
    one for a robust loss goes by what each value tells of the index, since noise on edges, where
    the index shows, is often larger and no outlier.
    """
    if level.clipped is None and level.robust is None:
        return level, lin
    least = CLEAN * brightest
    if level.clipped is not None:
        ordinary = np.abs(lin.score)[~level.clipped.where]
        noise = max(_deviation(ordinary, np.ones_like(ordinary)), least)
        level = level._replace(clipped=level.clipped._replace(noise=noise))
    if level.robust is not None:
        spread = max(_deviation(_weighed(level, lin), lin.weight**2), least)
        level = level._replace(robust=level.robust._replace(spread=spread))
    return level, _reduced(level, lin.picture, lin.columns)


def _weighed(level: Level, lin: Linearised) -> np.ndarray:
    """Size (blocks, channels) of what a robust loss takes."""
    return np.abs(lin.score) * np.sqrt(level.weights)


def _deviation(sizes: np.ndarray, counts: np.ndarray) -> float:
    """Standard deviation of normal noise by the median of its sizes, each as often as it counts.

    1.4826 = 1 / Φ⁻¹(3/4) median deviations are the standard deviation.
    """
    sizes, counts = sizes[counts > 0], counts[counts > 0]
    if not sizes.size:
        return 0.0
    order = np.argsort(sizes)
    part = np.cumsum(counts[order]) / np.sum(counts)
    return float(1.4826 * sizes[order][np.searchsorted(part, 0.5)])


def _settled(
    problem: Problem,
    level: Level,
    at: Point,
    anchor: np.ndarray,
    lin: Linearised,
    smooth: bool = False,
) -> tuple[Level, Point, Linearised]:
    """Where the least misfit lies if the picture is linear: steps without tracing.

    Squares need one step. What clipped values and outliers pull changes on the way.
    """
    for _ in range(SETTLE):
        new, change = _next_point(problem.unknowns, at, anchor, lin, 0.0, smooth)
        if level.clipped is None and level.robust is None:
            return level, new, lin.moved(change)
        visible = np.linalg.norm(lin.r @ change)
        moved = _reduced(level, lin.picture + lin.columns.along(change), lin.columns)
        at, (level, lin) = new, _rescaled(level, moved, problem.free.brightest)
        if visible < SETTLED * lin.noise:
            break
    return level, at, lin


class Step(NamedTuple):
    """A least-squares problem without a picture.

    In the coordinates as they are: whitened ones, in which a unit weighs alike in every direction,
    let the weakest directions run tens of units before the strong ones have moved, and fail.

    Args:
        unknowns: what is looked for.
        z0: (free,) where the picture was linearised.
        n: (k,) index at the reference wavelengths there.
        r: (m, m) as in `Linearised`.
        q: (m,) as in `Linearised`.
        damping: (m,) weights that keep the change of n within what a linear picture can tell.
        anchor: (free,) where z stays if the picture says nothing.
        near: weight of that.
        hold: (free, free) rows that keep z - anchor to some directions.
        prior: weight of the prior's rows.
    """

    unknowns: Unknowns
    z0: Array
    n: Array
    r: Array
    q: Array
    damping: Array
    anchor: Array
    near: Array
    hold: Array
    prior: Array


def _step_rows(dz: Array, step: Step) -> jax.Array:
    """Residuals (rows,) of a step."""
    unknowns, z = step.unknowns, step.z0 + dz
    change = unknowns.change(z, step.n)
    logs = unknowns.prior_rows @ unknowns.coefficients.logarithms(z) - unknowns.prior_mean
    return jnp.concatenate(
        [
            step.r @ change + step.q,
            step.damping * change,
            step.near * (z - step.anchor),
            step.hold @ (z - step.anchor),
            step.prior * logs,
        ]
    )


@jax.jit
def _solve_step(step: Step) -> Array:
    """Coordinates z (free,) that a step leads to.

    The directions in which n(λ) hardly changes are long curved valleys. Levenberg-Marquardt walks
    along one in about a thousand steps of 20 µs, where dogleg steps crawl for tens of thousands.
    Whether the solver met its tolerance does not matter here: a step that is not the best still
    has to lower the picture's own sum of squares, and the next one starts from it.
    """
    solver: Any = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
    solution: Any = optx.least_squares(
        _step_rows, solver, jnp.zeros_like(step.z0), args=step, max_steps=50_000, throw=False
    )
    return step.z0 + solution.value


def _next_point(
    unknowns: Unknowns,
    at: Point,
    anchor: np.ndarray,
    lin: Linearised,
    damping: float,
    smooth: bool = False,
) -> tuple[Point, np.ndarray]:
    """The point that the picture linearised at `at` asks for, and the change (total,) to it."""
    hold = np.zeros((len(at.z), len(at.z)))
    if smooth:
        directions = unknowns.coefficients.smooth()
        hold = HELD * (np.eye(len(hold)) - directions @ np.linalg.pinv(directions))
    left = lin.eliminated(damping)
    index = unknowns.coefficients.index(at.z, unknowns.reference)
    near = lin.noise / WIDEST
    size = max(float(np.linalg.norm(left.q)), 1e-300)
    step = Step(
        unknowns,
        at.z,
        index,
        left.r / size,
        left.q / size,
        np.sqrt(damping) * np.sqrt(np.sum(left.r**2, axis=0)) / size,
        anchor,
        np.asarray(near / size),
        hold,
        np.asarray(lin.noise / size),
    )
    z = np.asarray(_solve_step(step))
    change = np.asarray(unknowns.change(z, index))
    moves = left.others(change)
    return Point(z, at.others + moves), np.concatenate([moves, change])


def _objective(
    unknowns: Unknowns, lin: Linearised, at: Point, anchor: np.ndarray, noise: float
) -> float:
    """What a step has to lower: squared residuals, and what is known besides, in their unit."""
    return lin.cost + noise**2 * _far(unknowns, at, anchor)


def _far(unknowns: Unknowns, at: Point, anchor: np.ndarray) -> float:
    """Squared distance from what is known besides, in its errors."""
    known = unknowns.prior_rows @ np.asarray(unknowns.coefficients.logarithms(at.z))
    far = np.sum(((at.z - anchor) / WIDEST) ** 2) + np.sum((known - unknowns.prior_mean) ** 2)
    return float(far)


class Descent(NamedTuple):
    """Where a level's steps ended.

    Args:
        at: the point.
        lin: the picture linearised there.
        steps: pictures traced.
        converged: whether a next step would change nothing that the picture can tell.
        spread: of misfits that are no outliers, where the loss is robust; else 0.
        anchor: where z stays if the picture says nothing.
        wider: (total,) how far q is open beside the noise, since the picture is not linear.
    """

    at: Point
    lin: Linearised
    steps: int
    converged: bool
    spread: float
    anchor: np.ndarray
    wider: np.ndarray | float = 0.0


def _descend(
    problem: Problem,
    level: Level,
    at: Point,
    cutoff: float,
    most: int,
    small: float,
    along: Level | None = None,
    smooth: bool = False,
    known: Columns | None = None,
) -> Descent:
    """Gauss-Newton steps from a point, `most` at most, until one is small.

    Args:
        problem: what stays the same.
        level: the resolution.
        at: where to start.
        cutoff: part of its light with which a path ends.
        most: pictures to trace at most.
        small: a step that changes the picture by less than this part of its noise is the last.
        along: where slopes are taken; by default on the level itself.
        smooth: whether B and C move along the `Coefficients.smooth` directions alone.
        known: slopes that hold wherever the steps lead; none are taken then.
    """

    def keep() -> None:
        spread = level.robust.spread if level.robust else 0.0
        now = Descent(at, lin, steps, False, spread, anchor)
        # Several starts compete on the coarse picture, and there only.
        others = [end for at_level, end in problem.kept if at_level.name == level.name == COARSE]
        if all(lin.cost <= end.lin.cost for end in others):
            problem.kept[:] = [(level, now)]

    def look(at: Point, near: Columns | None = None) -> Linearised:
        slopes, kept = known or near, known is not None or along is not None
        if slopes is None and along is not None:
            slopes = _linearise(problem, along, at, cutoff).columns
        return _linearise(problem, level, at, cutoff, slopes, of_index=kept)

    unknowns = problem.unknowns
    least = LEAST_CHANGE[0] if problem.film.wavelengths is not None else LEAST_CHANGE[1]
    brightest = problem.free.brightest
    level, lin = _rescaled(level, look(at), brightest)
    damping, converged = 0.0, False
    steps, anchor, before = 1, at.z, 0.0
    keep()
    while steps < most and not converged:
        problem.progress(steps, lin.rms, _n_d(unknowns, at.z))
        # Whether a minimum is near, a step tells that nothing holds back.
        new, change = _next_point(unknowns, at, anchor, lin, 0.0, smooth)
        largest, visible = _largest(unknowns, at, new), np.linalg.norm(lin.r @ change)
        # Near a minimum each step shrinks at least as much as the one before it did.
        following = largest * min(largest / before, 1.0) if before else largest
        if following < least or visible < small * lin.noise:
            # So near the picture is linear: it need not be traced again.
            level, at, lin = _settled(problem, level, at, anchor, lin, smooth)
            converged = True
            break
        if damping:
            new, change = _next_point(unknowns, at, anchor, lin, damping, smooth)
            largest, visible = _largest(unknowns, at, new), np.linalg.norm(lin.r @ change)
        near = visible < NEAR_STEP * lin.noise
        # After so small a step the scene's slopes, which cost most, are still the same.
        tried = look(new, lin.columns if visible < LINEAR_STEP * lin.noise else None)
        steps += 1
        had, has = (
            _objective(unknowns, picture, point, anchor, lin.noise)
            for picture, point in ((lin, at), (tried, new))
        )
        rough = near and has < ROUGH * had and not level.drawing
        if has > had and largest < 100 * least:
            converged = True  # what is left of the residual is rounding
        elif has > had and level.drawing and damping >= FRUITLESS:
            converged = True  # or paths that jump over borders
        elif has <= had or rough:
            before = 0.0 if damping else largest
            at, damping = new, damping / 10 if damping > 1e-2 else 0.0
            level, lin = _rescaled(level, tried, brightest)
            keep()
        else:
            damping = max(10 * damping, 1.0)
    spread = level.robust.spread if level.robust else 0.0
    return Descent(at, lin, steps, converged, spread, anchor)


def _largest(unknowns: Unknowns, at: Point, new: Point) -> float:
    """The largest change of the index, or of another's coordinate, between two points."""
    before, after = (unknowns.coefficients.index(p.z, unknowns.reference) for p in (at, new))
    moves = np.abs(new.others - at.others)
    return max(float(np.max(np.abs(after - before))), float(np.max(moves, initial=0.0)))


def _n_d(unknowns: Unknowns, z: np.ndarray) -> float:
    return float(unknowns.coefficients.index(z, np.array([LINE_D]))[0])


def _refined(
    problem: Problem, few: Descent, level: Level, depth: int
) -> tuple[tuple[Level, Level], Point]:
    """Whole pictures with samples as the noise or the tolerance asks for, and where to go on from.

    Args:
        problem: what stays the same.
        few: where the steps on a whole picture of few samples ended.
        level: the whole picture with as many samples as most pixels get.
        depth: segments of a path.
    """
    some = _linearise(problem, level, few.at, CUTOFF)
    at, _ = _next_point(problem.unknowns, few.at, few.at.z, some, 0.0)
    residual = np.abs(some.score)[some.weight > 0]
    shown = _deviation(residual, np.ones_like(residual))
    choose = _more_samples if problem.tolerance is None else _samples_within
    return choose(problem, level, few.lin, some, few.at, depth, shown), at


def _own_noise(problem: Problem, level: Level, lin: Linearised, at: Point) -> float:
    """Noise of a drawn level's own, in pixels that show something of the glass.

    Args:
        problem: what stays the same.
        level: the whole picture.
        lin: the picture and its slopes.
        at: where they are.
    """
    change = _drawn_twice(problem, level, at)
    return float(np.sqrt(np.mean(change[lin.weight.any(axis=1)] ** 2) / 2))


def _drawn_twice(problem: Problem, level: Level, at: Point) -> np.ndarray:
    """How two drawn pictures of different seeds differ (blocks, channels)."""
    assert level.drawing is not None
    first, second = (
        _drawn(problem, level.drawing._replace(seed=seed, apart=True), at)
        for seed in (level.seed, ~level.seed)
    )
    gains, _ = problem.free.exposure(at.others)
    change: np.ndarray = ((first - second) * gains).reshape(-1, problem.film.channels)
    return change[level.blocks]


def _drawn_enough(problem: Problem, level: Level, own: float, noise: float) -> tuple[Level, float]:
    """A level drawn with as many samples as the target's noise asks for; its own noise then.

    Args:
        problem: what stays the same.
        level: the whole picture, drawn with few.
        own: its own noise.
        noise: of the target's values.
    """
    film = problem.film
    # The channels of a colour picture are drawn by the same paths, and err alike.
    alike = 1 if film.wavelengths is not None else film.channels
    least = CLEAN * problem.free.brightest
    level, left = _drawn_more(problem, level, alike * (own / (QUIET * max(noise, least))) ** 2)
    return level, own * left


def _drawn_within(problem: Problem, level: Level, end: Descent) -> Level:
    """A level drawn with as many samples as the tolerance of n_d asks for.

    Args:
        problem: what stays the same.
        level: the whole picture, drawn with few.
        end: where the steps on it ended.
    """
    assert problem.tolerance is not None
    reach = _reach(problem, level, end.lin, end.at)
    off = np.sum(reach * _drawn_twice(problem, level, end.at), axis=1)
    error = SURE * float(np.linalg.norm(off) / np.sqrt(2))
    drawn, left = _drawn_more(problem, level, (error / problem.tolerance) ** 2)
    raised = int(drawn.drawing != level.drawing)
    return drawn._replace(rendering=Rendered(problem.tolerance, error * left, raised))


def _drawn_more(problem: Problem, level: Level, times: float) -> tuple[Level, float]:
    """A level drawn with so many times the samples, no fewer; the part of its noise that is left.

    No more than `MOST_DRAWN` paths are drawn, though.
    """
    film, drawing = problem.film, level.drawing
    assert drawing is not None
    most = max(MOST_DRAWN // (film.width * film.height * film.channels), 1)
    # Powers of two have divisors to go through them by.
    wanted = np.ceil(np.log2(max(drawing.samples * times, 1.0)))
    samples = max(2 ** int(min(wanted, np.floor(np.log2(most)))), drawing.samples)
    left = float(np.sqrt(drawing.samples / samples))
    return level._replace(drawing=drawing._replace(samples=samples)), left


def _more_samples(
    problem: Problem,
    level: Level,
    few: Linearised,
    some: Linearised,
    at: Point,
    depth: int,
    noise: float,
) -> tuple[Level, Level]:
    """A whole picture with samples as `SPLITS` says, weighed by how well they draw each pixel.

    Near the rim a ball shows the whole scene within a few pixels, where footprints are neither
    small nor straight. The pixels that tell most and change most with the samples get more of
    them, and those of them that still change much still more. Since what is left falls about as
    the area of a footprint, the render of fewer samples, weighed against that of more, cancels
    most of it.

    What a change tells of one pixel is no more than a chance where an outline crosses it and a
    number of the scene moves that: a sample that jumps over the outline is a step in the sum of
    squares. Such pixels go on as long as those along the outline together still change.

    Args:
        problem: what stays the same.
        level: the whole picture with as many samples as most pixels get.
        few: the picture of few samples.
        some: that of as many as most pixels get.
        at: where both are.
        depth: segments of a path.
        noise: of the target's values.

    Returns:
        The picture, and one with no more than `FOR_SLOPES`, for the slopes of a fit's last steps.

    Source:
        Richardson, Phil. Trans. A 210 (1911) 307, extrapolation to a step of zero.
    """
    of_scene, sigma = len(problem.free.parameters), max(noise, CLEAN * problem.free.brightest)
    change, shows = np.abs(some.picture - few.picture), some.weight.any(axis=1)
    changed, outlined = np.max(change, axis=1), np.zeros(len(change), bool)
    if of_scene:
        shows |= np.any(some.columns.values[:, :, :of_scene], axis=(0, 2))
        crossed = _crossed(_with_others(problem, at.others), problem.film)
        outlined = _outlined(problem, level, shows, crossed)
        told = np.where(shows, changed, -1.0)
        splits, most = SPLITS, REFINED
    else:
        told = np.max(change * some.weight, axis=1)
        splits, most = OF_GLASS_ALONE, REFINED_OF_GLASS
    # What a quarter of the samples changes tells the error of these, and that of more.
    error, picture = changed / 3, some.picture.copy()
    tolerated = TOLERATED * sigma / np.sqrt(problem.film.channels)
    gains, black = problem.free.exposure(at.others)
    rows, pairs, cut = np.arange(len(change)), [], np.zeros(0, int)
    for step, (fewer, more) in enumerate(itertools.pairwise(splits)):
        chosen = np.argsort(-told)[: int(np.sum(shows) * most[step])]
        further = outlined[rows]
        further[chosen] = True
        if step:
            further &= error[rows] > tolerated
        pairs.append((rows[~further], splits[: step + 1]))
        if fewer == CELLS:
            cut = rows[further & outlined[rows]]
            further &= ~outlined[rows]
        rows, told = rows[further], told[further]
        error[rows] *= (fewer / more) ** 2
        if len(rows) and more < splits[-1]:
            finer = _split(problem, level, at, depth, rows, more)
            told = np.max(np.abs(finer - picture[rows]), axis=1)
            picture[rows], error[rows] = finer, told / 3
            along = rows[outlined[rows]]
            error[along] = _near(problem, level.blocks[along], error[along])
    pairs.append((rows, splits))
    drawn = partial(_extrapolated, problem, level, depth)
    parts = [part for rows, path in pairs for part in drawn(rows, path)]
    pairs.append((cut, splits))
    short = [(rows, tuple(k for k in path if k <= FOR_SLOPES)) for rows, path in pairs]
    for_slopes = [part for rows, path in short for part in drawn(rows, path)]
    if len(cut):
        near = _in_pixels(_with_neighbours(crossed))[level.blocks[cut]]
        outlines = _outlines(problem, level.blocks[cut], cut, depth, near)
        finer = np.zeros_like(picture)
        for part in outlines:
            traced = _trace(problem, part, at, level.seed, CUTOFF, False, False)
            finer[part.rows] += traced[:, 0] * gains
        told = np.max(np.abs(finer[cut] + black - picture[cut]), axis=1)
        # The samples on an outline fall to either side by chance.
        error[cut] = _near(problem, level.blocks[cut], told) * (CELLS / splits[-1]) ** 1.5
        parts += outlines
    weighed = level._replace(weights=1 / (1 + (error[:, None] / sigma) ** 2))
    return weighed._replace(parts=tuple(parts)), weighed._replace(parts=tuple(for_slopes))


def _samples_within(
    problem: Problem,
    level: Level,
    few: Linearised,
    some: Linearised,
    at: Point,
    depth: int,
    noise: float,
) -> tuple[Level, Level]:
    """A whole picture with as many samples as the tolerance of n_d asks for.

    What more samples change in each pixel, times how far n_d follows it, tells what is left open.
    Those pixels that hold most of it get four times the samples, and so on. All pixels of an
    outline that a number of the scene moves go together: see `_more_samples`, also for the
    arguments and what is returned.

    Source:
        Dörfler, SIAM J. Numer. Anal. 33 (1996) 1106: refining what holds a fixed part of the error;
        Becker and Rannacher, Acta Numerica 10 (2001) 1: errors weighed by what is looked for.
    """
    tolerance, sigma = problem.tolerance, max(noise, CLEAN * problem.free.brightest)
    assert tolerance is not None
    of_scene = len(problem.free.parameters)
    outlined = np.zeros(len(level.blocks), bool)
    if of_scene:
        moves = np.any(some.columns.values[:, :, :of_scene], axis=(0, 2))
        crossed = _crossed(_with_others(problem, at.others), problem.film)
        outlined = _outlined(problem, level, some.weight.any(axis=1) | moves, crossed)
    picture, change = some.picture.copy(), some.picture - few.picture
    splits, refinements = np.full(len(picture), SPLITS[0]), 0
    while True:
        error = LEFT * np.max(np.abs(change), axis=1, keepdims=True)
        level = level._replace(weights=1 / (1 + (error / sigma) ** 2))
        best = _reduced(level, picture + LEFT * change, some.columns)
        off = LEFT * np.sum(_reach(problem, level, best, at) * change, axis=1)
        left, coarse = _together(off), splits < SPLITS[-1]
        if left <= tolerance or _together(off[~coarse]) > tolerance or not np.any(off[coarse]):
            break
        chosen = _marked(off * coarse)
        if np.any(outlined & chosen):
            chosen |= outlined & coarse
        for split in np.unique(splits[chosen]).tolist():
            rows = np.flatnonzero(chosen & (splits == split))
            finer = _split(problem, level, at, depth, rows, 2 * split)
            change[rows], picture[rows] = finer - picture[rows], finer
        splits[chosen] *= 2
        refinements += 1
    level = level._replace(rendering=Rendered(tolerance, left, refinements))

    def drawn(splits: np.ndarray) -> Level:
        parts: list[Part] = []
        for split in np.unique(splits).tolist():
            rows = np.flatnonzero(splits == split)
            parts += _extrapolated(problem, level, depth, rows, (split // 2, split))
        return level._replace(parts=tuple(parts))

    return drawn(splits), drawn(np.minimum(splits, FOR_SLOPES) if of_scene else splits)


def _reach(problem: Problem, level: Level, lin: Linearised, at: Point) -> np.ndarray:
    """How far n_d follows each value (blocks, channels) of the picture, per unit of it."""
    coefficients, left, z = problem.unknowns.coefficients, lin.eliminated(), jnp.asarray(at.z)
    noise = max(lin.noise, CLEAN * problem.free.brightest)
    logs = _answer(problem.unknowns, z, left, noise).logs[:, : len(left.r)]
    of_n_d = _along_logs(coefficients, lambda z: _line_figures(coefficients, z), z)[0]
    told = np.concatenate([np.zeros(problem.free.total), of_n_d @ logs / noise])
    # Least squares: of a band that shows nothing R has a row of zeros.
    change = np.linalg.lstsq(lin.r, told)[0]
    return -level.weights * lin.columns.along(change)


def _together(off: Float[np.ndarray, " blocks"]) -> float:
    """What errors make together: their sum, where they may cancel by chance, and their spread."""
    return float(np.hypot(np.sum(off), np.linalg.norm(off)))


def _marked(off: Float[np.ndarray, " blocks"]) -> np.ndarray:
    """Which errors (blocks,), the largest, hold `MARKED` of all."""
    order = np.argsort(-np.abs(off))
    held = np.cumsum(np.abs(off[order]))
    marked = np.zeros(len(off), bool)
    marked[order[: np.searchsorted(held, MARKED * held[-1]) + 1]] = True
    return marked & (off != 0)


def _split(
    problem: Problem, level: Level, at: Point, depth: int, rows: np.ndarray, split: int
) -> np.ndarray:
    """The picture of some rows, (rows, channels), with a split, as the fit exposes it."""
    part = _part(problem, 1, FEW_SAMPLES, depth, level.blocks[rows], rows, split)
    traced = _trace(problem, part, at, level.seed, CUTOFF, False, False)
    gains, black = problem.free.exposure(at.others)
    picture: np.ndarray = traced[:, 0] * gains + black
    return picture


def _extrapolated(
    problem: Problem, level: Level, depth: int, rows: np.ndarray, path: tuple[int, ...]
) -> list[Part]:
    """What renders some rows with the last of some splits, extrapolated from the one before it."""
    *_, fewer, more = (0, *path)
    ratio = (more / fewer) ** 2 if fewer else np.inf
    shares = (fewer, -1 / (ratio - 1)), (more, 1 + 1 / (ratio - 1))
    few = partial(_part, problem, 1, FEW_SAMPLES, depth, level.blocks[rows], rows)
    return [few(split, share) for split, share in shares if split and len(rows)]


def _outlined(problem: Problem, level: Level, shows: np.ndarray, crossed: np.ndarray) -> np.ndarray:
    """Which blocks hold an outline, one that is near what `shows` (blocks,) something.

    Args:
        problem: what stays the same.
        level: the resolution, of single pixels.
        shows: which blocks show something of what is free.
        crossed: of `_crossed`.
    """
    beside = _near(problem, level.blocks, shows.astype(float)) > 0
    outlined: np.ndarray = beside & np.any(_in_pixels(crossed), axis=(1, 2))[level.blocks]
    return outlined


def _outlines(
    problem: Problem, blocks: np.ndarray, rows: np.ndarray, depth: int, near: np.ndarray
) -> list[Part]:
    """Pixels, with the most samples in those of their cells (blocks, CELLS, CELLS) that are `near`.

    On the bench's outline, 0.0034 off with 256 samples a pixel, 0.00042 with 4096 and 0.00043 with
    the 1400 that these are.
    """
    finer = SPLITS[-1] // CELLS
    rest = np.any(~near, axis=(1, 2))
    few = partial(_part, problem, 1, FEW_SAMPLES, depth)
    parts = [few(blocks, rows, SPLITS[-1], cells=near.repeat(finer, axis=1).repeat(finer, axis=2))]
    if np.any(rest):
        parts.append(few(blocks[rest], rows[rest], CELLS, cells=~near[rest]))
    return parts


def _crossed(scene: Scene, film: Film) -> np.ndarray:
    """Cells (height · CELLS, width · CELLS) of pixels where the camera sees several surfaces.

    An outline passes between samples, or cuts off less of a pixel than one of them stands for: what
    a few samples show does not tell how wrong they are.
    """
    plan = make_plan(scene, film, 1, 1, "float64")
    down, right = (np.arange(count * CELLS + 1) / CELLS for count in (film.height, film.width))
    seen = np.asarray(_surfaces_seen(plan, without_names(scene), film_size(film), right, down))
    corner = seen[:-1, :-1]
    return (corner != seen[:-1, 1:]) | (corner != seen[1:, :-1]) | (corner != seen[1:, 1:])


@partial(jax.jit, static_argnums=0)
def _surfaces_seen(
    plan: Plan, scene: Scene, size: tuple[Real, Real], right: Array, down: Array
) -> jax.Array:
    """Numbers (down, right) of the surfaces that the camera sees at points of the film, pixels."""
    world, projection = world_tables(scene), project(scene.camera, *size)
    spheres = all_spheres(world, plan, None)

    def at(x: Real, y: Real) -> Array:
        return nearest(camera_ray(projection, x, y), world, plan, no_surface(x), spheres)

    return jax.lax.map(lambda y: jax.vmap(at, (0, None))(right, y), down)


def _with_neighbours(cells: np.ndarray) -> np.ndarray:
    """The cells (height, width), and those that share an edge with one of them."""
    wide = np.pad(cells, 1)
    return cells | wide[:-2, 1:-1] | wide[2:, 1:-1] | wide[1:-1, :-2] | wide[1:-1, 2:]


def _in_pixels(cells: np.ndarray) -> np.ndarray:
    """Cells of the film as those of each of its pixels, (pixels, CELLS, CELLS)."""
    height, width = (count // CELLS for count in cells.shape)
    each = cells.reshape(height, CELLS, width, CELLS).transpose(0, 2, 1, 3)
    return each.reshape(-1, CELLS, CELLS)


def _near(problem: Problem, blocks: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Root mean square of the values (blocks,) of those of some pixels that are near each."""
    film, reach = problem.film, 2
    there = np.zeros((2, film.height * film.width))
    there[:, blocks] = values**2, np.ones_like(values)
    wide = np.pad(
        there.reshape(2, film.height, film.width), ((0, 0), (reach, reach), (reach, reach))
    )
    windows = np.lib.stride_tricks.sliding_window_view(wide, (2 * reach + 1,) * 2, axis=(1, 2))
    squares, counts = np.sum(windows, axis=(3, 4)).reshape(2, -1)[:, blocks]
    mean: np.ndarray = np.sqrt(squares / counts)
    return mean


def _starts(problem: Problem, level: Level, most: int) -> list[Point]:
    """Points to start from: those that explain a coarse picture best, at the best exposure.

    The coarse picture is traced once at many indices. Any glass's picture is then an
    interpolation between them, so hundreds of glasses cost nothing: the start with its B scaled
    to other indices and its resonances below the band moved to other dispersions.
    """
    unknowns, film = problem.unknowns, problem.film
    table = _index_table(problem, level)
    waves, weights, columns = _few_wavelengths(film)
    target = level.target[:, columns]
    over = np.zeros(target.shape, bool)
    if level.clipped is not None:
        over = level.clipped.where[:, columns]
    found: list[tuple[float, float, Point]] = []
    variants = np.stack(_variants(unknowns, waves))
    for z, index in zip(
        variants, np.asarray(_indices(unknowns.coefficients, variants, waves)), strict=True
    ):
        if index.min() < INDEX_GRID[0] or index.max() >= INDEX_GRID[-1]:
            continue
        place = np.interp(index, INDEX_GRID, np.arange(len(INDEX_GRID)))
        left = np.minimum(place.astype(int), len(INDEX_GRID) - 2)
        part = (place - left)[:, None, None]
        seen = table[left] * (1 - part) + table[left + 1] * part
        picture = np.einsum("jpc,jcd->pd", seen, weights, optimize=True)
        others = _exposed(problem.free, picture, target, columns, level.weights * ~over)
        gains, black = problem.free.exposure(others)
        some = gains[columns] if problem.free.gains else gains
        residual = some * picture + black - target
        residual[over] = np.minimum(residual[over], 0.0)
        cost = float(np.sum(level.weights * residual**2))
        found.append((cost, float(np.mean(index)), Point(z, others)))
    found.sort(key=lambda entry: entry[0])
    chosen: list[tuple[float, float, Point]] = []
    for entry in found:
        if len(chosen) < most and all(abs(entry[1] - c[1]) > 0.03 for c in chosen):
            chosen.append(entry)
    return [at for _, _, at in chosen] or [
        Point(unknowns.coefficients.start(), np.zeros(problem.free.total))
    ]


@jax.jit
def _indices(coefficients: Coefficients, zs: Array, waves: Array) -> jax.Array:
    """Index (n, k) at many coordinates (n, free) and k wavelengths."""
    return jax.vmap(lambda z: coefficients.index(z, waves))(zs)


def _exposed(
    free: Free,
    picture: np.ndarray,
    target: np.ndarray,
    columns: np.ndarray,
    weights: np.ndarray,
) -> np.ndarray:
    """Coordinates of the others: the scene's as they are, and the exposure that fits best.

    Args:
        free: what is free.
        picture: (blocks, d) some channels of a render.
        target: (blocks, d) of the target.
        columns: (d,) their numbers; between them gains are interpolated.
        weights: (blocks, d) of their squared residuals.
    """
    others = np.zeros(free.total)
    squares, sums = (np.sum(weights * picture**power, axis=0) for power in (2, 1))
    squares = squares + 1e-300
    products, seen = np.sum(weights * picture * target, axis=0), np.sum(weights * target)
    black = (seen - np.sum(sums)) / max(np.sum(weights), 1e-300)
    if free.gains:
        rest = np.sum(weights) - np.sum(sums**2 / squares)
        black = (seen - np.sum(sums * products / squares)) / max(rest, 1e-300)
        black *= free.blacks
        gains = np.log(np.clip((products - black * sums) / squares, 1e-3, 1e3))
        gains = np.where(np.any(weights > 0, axis=0), gains, 0.0)
        start = len(free.parameters)
        others[start : start + free.gains] = np.interp(np.arange(free.gains), columns, gains)
    if free.blacks:
        others[-1] = black / free.brightest
    return others


def _index_table(problem: Problem, level: Level) -> np.ndarray:
    """Linear sRGB (indices, blocks, 3) of a level's picture at each index of the grid."""
    middle = sum(film_range(problem.film)) / 2
    part = level.parts[0]
    plan = replace(part.plan, bands=0, dispersive=False, samples=4)
    # Without dispersion a plan has one path for all wavelengths: here it is one for each index.
    spectrum = Spectrum(np.full(len(INDEX_GRID), middle), None, None)
    size, run = film_size(problem.film), run_numbers(plan, level.seed, 1e-3)
    edge = int(part.chunks.size)
    chunks, place = some_blocks(level.blocks, problem.film.width // edge, float(edge), 4)

    def trace(chunks: Pixels) -> np.ndarray:
        return np.asarray(
            _traced_at_indices(
                plan, problem.ball, without_names(problem.scene), spectrum, size, chunks, run
            )
        )

    values = over_chunks(trace, chunks, "float64")
    return np.moveaxis(values.reshape(-1, len(INDEX_GRID), 3)[place], 1, 0)


@partial(jax.jit, static_argnums=(0, 1), compiler_options=COMPILER_OPTIONS)
def _traced_at_indices(
    plan: Plan,
    ball: int,
    scene: Scene,
    spectrum: Spectrum,
    size: tuple[Real, Real],
    chunks: Pixels,
    run: RunNumbers,
) -> jax.Array:
    """Pixels (chunks, pixels, indices, 3) with one ball at each index of the grid."""
    scene, spectrum, size, chunks, run = in_dtype((scene, spectrum, size, chunks, run), plan.dtype)
    indices = glass_indices(scene, spectrum.wavelengths)
    indices = (*indices[:ball], jnp.asarray(INDEX_GRID), *indices[ball + 1 :])

    def chunk(pixels: Pixels) -> Array:
        lanes = chunk_lanes(plan, scene, spectrum, size, pixels, run)
        return jnp.moveaxis(lane_radiance(plan, indices, lanes)[:, 0], 0, 1)

    return each_chunk(chunk, chunks)


def _few_wavelengths(film: Film) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At most 16 wavelengths (j,) for a coarse picture, how they mix, and into which channels.

    Returns:
        Wavelengths in µm; weights (j, 3, d) from linear sRGB at each into d of the film's
        channels; and the numbers (d,) of those.
    """
    if film.wavelengths is None:
        waves, share = wavelength_strata(16)
        return waves, share[:, :, None] * np.eye(3)[None], np.arange(3)
    columns = np.unique(np.linspace(0, film.channels - 1, 16).round().astype(int))
    waves = np.asarray(film.wavelengths)[columns]
    weights = albedo_basis(waves)[:, :, None] * np.eye(len(columns))[:, None, :]
    return waves, weights, columns


def _variants(unknowns: Unknowns, waves: np.ndarray) -> list[np.ndarray]:
    """Coordinates of the start, and of the start with another index and another dispersion."""
    start = unknowns.coefficients
    middle = np.array([np.sqrt(waves.min() * waves.max())])
    ultraviolet = start.C < start.low**2
    found = [start.start()]
    for factor in (0.3, 0.6, 1.0, 1.5, 2.0, 2.6, 3.3):
        # A resonance stays below the band, as the coordinates demand.
        C = np.where(ultraviolet, np.minimum(start.C * factor, 0.9 * start.low**2), start.C)
        moved = Coefficients(start.B, C, start.low, start.high, start.free)
        excess = float(moved.index(moved.start(), middle)[0]) ** 2 - 1
        for n in np.arange(1.25, 2.6, 0.02):
            scaled = np.where(np.array(start.free[:3]), start.B * (n**2 - 1) / excess, start.B)
            shifted = Coefficients(scaled, C, start.low, start.high, start.free)
            found.append(shifted.start())
    return found


def _fit(
    problem: Problem, target: Picture, prior: str, noise: float | None, check: str | None
) -> FitResult:
    """The result of a search, or of as much of it as there was time for."""
    stopped = False
    try:
        level, best = _search(problem, target)
    except (KeyboardInterrupt, StopFit):
        if not problem.kept:
            raise
        ((level, best),), stopped = problem.kept, True
    said = {"samples": target.samples, "depth": target.depth, "seed": target.seed}
    if level.name != LAST:
        said = {}
    own = ", ".join(f"{name} {value}" for name, value in said.items() if value is not None)
    result = _result(problem, best, level, prior, noise, own, stopped)
    if check is None or stopped or best.lin.seen == 0:
        return result
    return replace(result, check=_resampled(problem, level, best, noise, result.n_d_std))


def _resampled(
    problem: Problem, level: Level, end: Descent, given: float | None, reported: float
) -> Resampled:
    """The spread of n_d when the last step is repeated with other noise.

    The misfits of the fit, their signs turned at random: so their sizes stay where they are, as in
    the sandwich. But those of all channels of a square of pixels are turned together: where
    neighbours or channels err alike, which the sandwich does not know, the spread is larger than
    the error reported. A clean picture shows no noise, and gets as much as its errors refer to.

    Source:
        Liu, Ann. Stat. 16 (1988) 1696, the wild bootstrap; Cameron, Gelbach and Miller, Rev. Econ.
        Stat. 90 (2008) 414, that of clusters.
    """
    lin, generator = end.lin, np.random.default_rng(0)
    brightest = float(np.max(np.abs(problem.target)))
    meat, _, _ = _noise(lin, given, brightest)
    width = problem.film.width
    y, x = np.divmod(level.blocks, width)
    square = (y // TOGETHER) * (width // TOGETHER + 1) + x // TOGETHER
    clean = lin.noise < CLEAN * brightest
    held, anything = (_root(part) for part in (lin.held, meat))
    found = []
    for _ in range(REPEATS):
        normal = generator.normal(size=len(lin.q))
        if clean:
            other = anything @ normal
        else:
            signs = generator.choice([-1.0, 1.0], np.max(square) + 1)[square]
            other = lin.pulled(lin.pulls * signs[:, None]) + held @ normal
        noisy = lin._replace(q=lin.q + other)
        at, _ = _next_point(problem.unknowns, end.at, end.anchor, noisy, 0.0)
        found.append(_n_d(problem.unknowns, at.z))
    spread = float(np.std(found, ddof=1))
    return Resampled(REPEATS, spread, spread / reported)


def _root(covariance: np.ndarray) -> np.ndarray:
    """A matrix that turns numbers of variance 1 into such with a covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _search(problem: Problem, target: Picture) -> "tuple[Level, Descent]":
    """Coarse to fine: the best of several starts, then the whole picture, then its final form."""
    film, depth, seed = problem.film, target.depth or 50, target.seed or 0
    coarse = max(1, -(-max(film.width, film.height) // COARSE_PIXELS))
    chance = _by_chance(problem)
    samples = COARSE_BY_CHANCE if chance else FEW_SAMPLES
    level = _level(problem, COARSE, coarse, samples, depth, seed)
    if chance:
        drawing = Drawing(max(FIRST_DRAWN // coarse**2, 1), depth, seed, apart=True)
        level = level._replace(drawing=drawing)
    # With all six coordinates a band can stay in a minimum of its own, where n is wrong in that
    # band alone, from a resonance that moves next to it.
    ends = [
        _descend(problem, level, at, CUTOFF, 8, 1.0, smooth=True)
        for at in _starts(problem, level, 3)
    ]
    best = min(ends, key=lambda end: end.lin.cost)
    best = _descend(problem, level, best.at, CUTOFF, 8, 1.0)
    along, small = None, LINEAR_STEP
    if chance:
        level, along, best = _drawn_level(problem, target, best, depth, seed)
        finest, at, small = level, best.at, SMALL_STEP
    elif target.samples is None:
        level = _level(problem, FEW, 1, FEW_SAMPLES, depth, seed)
        along = _level(problem, LAST, 1, FEW_SAMPLES, depth, seed, SPLITS[0])
        few_step = FEW_STEP if problem.free.parameters else 1.0
        best = _descend(problem, level, best.at, CUTOFF, 20, few_step)
        (finest, level), at = _refined(problem, best, along, depth)
    else:
        level, at = _level(problem, LAST, 1, target.samples, depth, seed), best.at
        finest = level = _as_told(problem, level)
    best = _descend(problem, level, at, CUTOFF, 30, small, along)
    if level.robust is not None:
        tukey = Robust("tukey", best.spread)
        level, finest = (each._replace(robust=tukey) for each in (level, finest))
        cut = _descend(problem, level, best.at, CUTOFF, 30, small, along)
        best = cut._replace(steps=best.steps + cut.steps)
    if _clean(level, best.lin):
        # So clean a picture shows the light of the paths that were ended early.
        if problem.free.parameters and target.samples is None:
            along = level
        exact = _descend(problem, finest, best.at, 0.0, 30, SMALL_STEP, along)
        best = exact._replace(steps=best.steps + exact.steps)
    elif problem.free.parameters and best.converged and best.lin.seen:
        slopes = level if level.drawing is None else _slopes_by_chance(problem, depth, seed)
        best = _polished(problem, finest, slopes, best)
    return finest, best


def _as_told(problem: Problem, level: Level) -> Level:
    """A level that is drawn as the target says: its render leaves nothing open of n_d."""
    if problem.tolerance is None:
        return level
    return level._replace(rendering=Rendered(problem.tolerance, 0.0, 0))


def _clean(level: Level, lin: Linearised) -> bool:
    """Whether a picture has so little noise that it shows the light of paths ended early."""
    error = lin.noise / max(float(np.max(np.abs(lin.eliminated().r))), 1e-300)
    return NEGLECTED * CUTOFF > SMALL_STEP * error and level.drawing is None


def _by_chance(problem: Problem) -> bool:
    """Whether light scatters, so that pictures are drawn by chance."""
    return make_plan(problem.scene, problem.film, 1, 1, "float64").scattering


def _slopes_by_chance(problem: Problem, depth: int, seed: int) -> Level:
    """The level of the slopes of such pictures."""
    samples = SLOPES_BY_CHANCE[bool(problem.free.parameters)]
    return _level(problem, LAST, 1, samples, depth, seed)


def _drawn_level(
    problem: Problem, target: Picture, coarse: Descent, depth: int, seed: int
) -> tuple[Level, Level, Descent]:
    """The last level where light scatters by chance, the level of its slopes, and where to start.

    A picture that says how it was drawn is drawn so; for others steps on few samples come first,
    that tell how noisy both are.

    Args:
        problem: what stays the same.
        target: as it was given.
        coarse: where the steps on the coarse picture ended.
        depth: segments of a path.
        seed: of the numbers that paths draw.
    """
    along = _slopes_by_chance(problem, depth, seed)
    own = target.samples is not None
    drawing = Drawing(target.samples or FIRST_DRAWN, depth, seed, apart=not own)
    level = along._replace(drawing=drawing)
    if own:
        return _as_told(problem, level), along, coarse
    few = _descend(problem, level._replace(name=FEW), coarse.at, CUTOFF, 20, 1.0, along)
    if problem.tolerance is not None:
        return _drawn_within(problem, level, few), along, few
    drawn = _own_noise(problem, level, few.lin, few.at) if few.lin.seen else 0.0
    rest = np.sqrt(max(few.lin.noise**2 - drawn**2, 0.0))
    return _drawn_enough(problem, level, drawn, rest)[0], along, few


def _polished(problem: Problem, level: Level, slopes: Level, end: Descent) -> Descent:
    """Where steps end that know the slopes well, and then the mean along the least known way.

    Where the scene's numbers are free, n_d may be told much less well than what it is mixed up
    with. Slopes that are a few per cent rough then move it by as much as the noise does; and over
    what is left open a picture is no longer linear: next to its rim a ball shows edges so close
    together that they pass whole pixels. So the sum of squares is looked at along the way that
    n_d and all else go together: its minimum may lie in a ripple of it, but the mean over what it
    makes likely, and the spread about that, know how wide it is.

    Args:
        problem: what stays the same.
        level: the resolution.
        slopes: where slopes are taken.
        end: where the steps ended.

    Source:
        Bates and Watts, Nonlinear Regression Analysis and Its Applications (Wiley, 1988), chapter
        6, profiles; the mean in place of the minimum is Bayes' under an even prior.
    """
    known = _linearise(problem, slopes, end.at, CUTOFF).columns
    best = _descend(problem, level, end.at, CUTOFF, POLISH, SMALL_STEP, known=known)
    level, lin = _rescaled(level, best.lin, problem.free.brightest)
    best = best._replace(lin=lin, steps=end.steps + best.steps, spread=end.spread)
    way, steps, costs = _least_known(problem, best), best.steps, []
    for place in PROFILE:
        at, there = _moved(problem, level, best, place * way, known)
        costs.append(_objective(problem.unknowns, there, at, best.anchor, lin.noise))
        steps += 1
        problem.progress(steps, there.rms, _n_d(problem.unknowns, at.z))
    mean, spread = (float(v) for v in _mean_place(np.array(costs) / lin.noise**2))
    at, there = _moved(problem, level, best, mean * way, known)
    wider = np.sqrt(max(spread**2 - 1, 0.0)) * way
    return best._replace(at=at, lin=there, steps=steps + 1, converged=True, wider=wider)


def _least_known(problem: Problem, end: Descent) -> np.ndarray:
    """The way (total,) in q that n_d and all else go together, as long as their error."""
    coefficients, total, lin = problem.unknowns.coefficients, problem.free.total, end.lin
    z, reference = jnp.asarray(end.at.z), problem.unknowns.reference
    meat = lin.noise**2 * lin.white + lin.held
    covariance = _covariance(problem.unknowns, z, lin, meat, lin.noise)
    index = _along_logs(coefficients, lambda z: coefficients.index(z, reference), z)
    of_index = problem.unknowns.project @ index
    of_n_d = _along_logs(coefficients, lambda z: _line_figures(coefficients, z), z)[0]
    told = covariance[:, total:] @ of_n_d
    told /= np.sqrt(of_n_d @ told[total:])
    return np.asarray(lin.r @ np.concatenate([told[:total], of_index @ told[total:]]))


def _moved(
    problem: Problem, level: Level, end: Descent, by: np.ndarray, known: Columns
) -> tuple[Point, Linearised]:
    """The point that a change (total,) of q leads to, and the picture there."""
    shifted = end.lin._replace(q=end.lin.q - by)
    at, _ = _next_point(problem.unknowns, end.at, end.anchor, shifted, 0.0)
    return at, _linearise(problem, level, at, CUTOFF, known, of_index=True)


def _mean_place(squares: np.ndarray, places: np.ndarray = PROFILE) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (...) over places, from squares (..., places) there.

    The squares are in units of the noise's.
    """
    likely = np.exp(-(squares - np.min(squares, axis=-1, keepdims=True)) / 2)
    likely /= np.sum(likely, axis=-1, keepdims=True)
    mean = np.asarray(likely @ places)
    variance = np.maximum(likely @ places**2 - mean**2, 0.0)
    return mean, np.asarray(np.sqrt(variance))


def _wider(problem: Problem, level: Level, end: Descent, known: Columns) -> np.ndarray:
    """How far q (total,) is open beside the noise, as `_polished` will see it.

    What that sees depends on the noise. What noise adds to the sums of squares along the way has
    the products of the pictures' changes there as its covariance, so that any number of draws of
    noise needs no picture more.

    Args:
        problem: what stays the same.
        level: the resolution.
        end: the point, and the picture there without noise.
        known: slopes there.
    """
    way, pictures, beside = _least_known(problem, end), [], []
    for place in WIDE_PROFILE:
        at, there = _moved(problem, level, end, place * way, known)
        pictures.append(np.ravel(there.picture * np.sqrt(level.weights)) / end.lin.noise)
        beside.append(_far(problem.unknowns, at, end.anchor))
    change = np.array(pictures) - pictures[len(pictures) // 2]
    products = change @ change.T
    generator = np.random.default_rng(0)
    noise = generator.standard_normal((DRAWS, len(products))) @ _root(products).T
    squares = np.diag(products) + np.array(beside) + 2 * noise
    _, spread = _mean_place(squares, WIDE_PROFILE)
    return np.asarray(np.sqrt(np.mean(np.maximum(spread**2 - 1, 0.0))) * way)


class Noise(NamedTuple):
    """The noise of a target.

    Args:
        meat: (total, total) how it enters q.
        sigma: its standard deviation.
        source: where both come from, in words.
    """

    meat: np.ndarray
    sigma: float
    source: str


def _result(
    problem: Problem,
    end: Descent,
    level: Level,
    prior: str,
    given: float | None,
    own: str,
    stopped: bool,
) -> FitResult:
    """The result in the words of the glass, with its errors."""
    lin, total = end.lin, problem.free.total
    noise = _noise(lin, given, float(np.max(np.abs(problem.target))))
    if given is not None and level.robust is not None and noise.meat is not lin.meat:
        # A robust loss pays a little information, and outliers take some.
        noise = noise._replace(meat=noise.meat * (max(lin.noise, given) / given) ** 2)
    noise = noise._replace(meat=noise.meat + np.multiply.outer(end.wider, end.wider))
    known = _uncertainty(problem, end.at, level, lin, noise, prior, "This picture fixes", own)
    glass = Sellmeier(known.B, known.C, object_glass(problem.scene, problem.number).validity)
    converged, message = _verdict(end)
    if stopped:
        converged, message = False, f"stopped in step {end.steps} of {level.name}"
    left, within = lin.eliminated(), noise.meat[total:, total:]
    named, other = _named(problem.unknowns, end.at.z, left, within)
    clipped = int(np.sum(problem.target >= problem.ceiling))
    outliers = 0
    if end.spread and level.robust is not None:
        off = _weighed(level, lin) > end.spread * level.robust.cut
        outliers = int(np.sum(off))
    scene = _with_others(problem, end.at.others)
    return FitResult(
        scene=with_glass(scene, problem.number, glass),
        glass=glass,
        object_name=known.object_name,
        converged=converged,
        message=message,
        steps=end.steps,
        B=known.B,
        C=known.C,
        B_std=known.B_std,
        C_std=known.C_std,
        covariance=known.covariance,
        n_d=known.n_d,
        n_d_std=known.n_d_std,
        V_d=known.V_d,
        V_d_std=known.V_d_std,
        P_gF=known.P_gF,
        P_gF_std=known.P_gF_std,
        wavelengths=known.wavelengths,
        n=known.n,
        n_std=known.n_std,
        singular_values=known.singular_values,
        determined=known.determined,
        summary=known.summary
        + _clipped_words(clipped, problem.ceiling)
        + _outlier_words(outliers)
        + (_rendering_words(level.rendering, known.samples[-1], known.n_d_std) if converged else "")
        + (UNFINISHED if stopped else ""),
        rms_residual=lin.rms,
        nearest_glasses=tuple((name, distance) for name, distance, _ in named[:5]),
        prior=prior,
        noise=given,
        samples=known.samples,
        picture=_whole_picture(problem, level, end, stopped),
        free=known.free,
        used=None if problem.used.all() else problem.used,
        clipped=clipped,
        loss=problem.loss,
        outliers=outliers,
        probabilities=tuple(probability for _, _, probability in named[:5]),
        other_probability=other,
        stopped=stopped,
        rendering=level.rendering,
    )


def _uncertainty(
    problem: Problem,
    at: Point,
    level: Level,
    lin: Linearised,
    noise: Noise,
    prior: str,
    opening: str,
    own: str = "",
) -> Uncertainty:
    """What a picture linearised at a point tells of the glass, in the words of the glass.

    Args:
        problem: what stays the same.
        at: the point.
        level: the resolution.
        lin: the picture there.
        noise: of the target.
        prior: what else is known.
        opening: of the sentence, as in "This picture fixes".
        own: what the target says of how it was drawn.
    """
    unknowns, film, free = problem.unknowns, problem.film, problem.free
    z, source = jnp.asarray(at.z), noise.source
    if free.names:
        source += f", and with {' and '.join(free.names)} free"
    whole = _covariance(unknowns, z, lin, noise.meat, noise.sigma)
    covariance = whole[free.total :, free.total :]

    def with_error(f: Callable[[jax.Array], jax.Array]) -> tuple[np.ndarray, np.ndarray]:
        slope = _along_logs(unknowns.coefficients, f, z)
        return np.asarray(f(z)), np.sqrt(np.sum((slope @ covariance) * slope, axis=-1))

    waves = COLOR_WAVELENGTHS if film.wavelengths is None else np.asarray(film.wavelengths)
    n, n_std = with_error(lambda z: unknowns.coefficients.index(z, waves))
    lines, lines_std = with_error(lambda z: _line_figures(unknowns.coefficients, z))
    B, C = (np.asarray(v) for v in unknowns.coefficients.values(z))
    full = _coefficient_covariance(unknowns.coefficients, B, C, covariance)
    B, C, full = _in_order(unknowns.coefficients, B, C, full)
    std = np.sqrt(np.diag(full))
    singular = 1 / np.sqrt(np.linalg.eigvalsh(covariance))
    singular = np.sort(singular)[::-1]
    determined = int(np.sum(singular > 1 / DETERMINED))
    scene, errors = _with_others(problem, at.others), np.sqrt(np.diag(whole))
    return Uncertainty(
        object_name=problem.scene.objects[problem.number].name,
        B=B,
        C=C,
        B_std=std[:3],
        C_std=std[3:],
        covariance=full,
        n_d=float(lines[0]),
        n_d_std=float(lines_std[0]),
        V_d=float(lines[1]),
        V_d_std=float(lines_std[1]),
        P_gF=float(lines[2]),
        P_gF_std=float(lines_std[2]),
        wavelengths=waves,
        n=n,
        n_std=n_std,
        singular_values=singular,
        determined=determined,
        summary=_summary(opening, waves, n_std, determined, len(singular), source, prior, own)
        + _edges_without(level.parts[0].plan, bool(free.parameters)),
        prior=prior,
        noise=noise.sigma,
        samples=_samples(level),
        free=tuple(_free_values(free, scene, at.others, errors)),
    )


def _samples(level: Level) -> tuple[int, ...]:
    """How many samples a level's pixels have."""
    if level.drawing:
        return (level.drawing.samples,)
    return tuple(sorted({part.plan.samples * part.split**2 for part in level.parts}))


def _whole_picture(problem: Problem, level: Level, end: Descent, stopped: bool) -> np.ndarray:
    """The render (height, width, channels) where a fit ended; of what a mask left out too.

    Who stops a fit does not want to wait for that.
    """
    size, film = level.size, problem.film
    width, height = film.width // size, film.height // size
    blocks = np.zeros((height * width, film.channels))
    blocks[level.blocks] = end.lin.picture
    if size > 1:
        wide = blocks.reshape(height, width, -1).repeat(size, axis=0).repeat(size, axis=1)
        beyond = (0, film.height - height * size), (0, film.width - width * size), (0, 0)
        return np.pad(wide, beyond, mode="edge")
    rest = np.flatnonzero(~problem.used)
    if len(rest) and not stopped:
        like, (gains, black) = level.parts[0], problem.free.exposure(end.at.others)
        if level.drawing:
            shown = block_means(1, _drawn(problem, level.drawing, end.at))[rest]
        else:
            own = np.arange(len(rest))
            part = _part(problem, 1, like.plan.samples, like.plan.depth, rest, own, like.split)
            shown = _trace(problem, part, end.at, level.seed, CUTOFF, False, True)[:, 0]
        blocks[rest] = shown * gains + black
    return blocks.reshape(problem.target.shape)


def _with_others(problem: Problem, others: np.ndarray) -> Scene:
    """The scene with its free numbers at some coordinates."""
    free = problem.free
    coordinates = others[: len(free.parameters)]
    scene = with_coordinates(problem.scene, free.places, free.units, coordinates)
    moved: Scene = jax.tree.map(np.asarray, scene)
    return moved


def _free_values(
    free: Free, scene: Scene, others: np.ndarray, errors: np.ndarray
) -> Iterator[FreeValue]:
    """What was free beside B and C, in the units of the scene."""
    for parameter, error in zip(free.parameters, errors, strict=False):
        value = value_at(scene, parameter.place)
        unit = value if parameter.place.positive else parameter.unit
        yield FreeValue(parameter.name, value, float(unit * error))
    gains, black = free.exposure(others)
    for channel in range(free.gains):
        gain, error = float(gains[channel]), errors[len(free.parameters) + channel]
        yield FreeValue(f"gain[{channel}]", gain, float(gain * error))
    if free.blacks:
        yield FreeValue("black", black, float(free.brightest * errors[free.total - 1]))


def _noise(lin: Linearised, given: float | None, brightest: float) -> Noise:
    """As given, as the residual shows it, or as assumed where it shows none."""
    if given is not None and lin.noise <= 1.1 * given:
        source = f"at the given noise of {given:g}"
        return Noise(given**2 * lin.white + lin.held, given, source)
    if given is None and lin.noise < CLEAN * brightest:
        source = f"the picture is clean; at an assumed noise of {ASSUMED_NOISE:g}"
        return Noise(ASSUMED_NOISE**2 * lin.white + lin.held, ASSUMED_NOISE, source)
    source = f"at the noise of {lin.noise:.2g} estimated from the residual"
    if given is not None:
        source += f", more than the given {given:g}"
    return Noise(lin.meat, lin.noise, source)


def _covariance(
    unknowns: Unknowns, z: Array, lin: Linearised, meat: np.ndarray, noise: float
) -> np.ndarray:
    """Covariance (others + free, others + free) of the others, and of log |B| and log C.

    Source:
        White, Econometrica 48 (1980) 817: the covariance that holds where the noise is not the
        same everywhere, from the residuals themselves; by singular values, so that nothing
        nearly singular is squared.
    """
    left, p = lin.eliminated(), lin.columns.others
    slope, scales, right, logs = _answer(unknowns, z, left, noise)
    count, m, rows = len(scales), len(left.r), logs.shape[1]
    # What comes in: for the others, for the index in units of the noise, and from the prior.
    unit = np.concatenate([np.ones(p), np.full(m, 1 / noise)])
    within = np.eye(p + rows)
    within[: p + m, : p + m] = meat * unit * unit[:, None]
    # The others follow the index.
    follow = -np.linalg.solve(left.own, left.mixed @ slope)
    whole = np.zeros((p + len(z), p + rows))
    whole[p:, p:] = logs
    whole[:p, p:] = follow @ logs
    whole[:p, :p] = np.linalg.inv(left.own)
    # A direction that nothing is known of keeps the widest error that still means anything.
    rest = np.full(len(z), WIDEST**2)
    rest[:count] = (1 / (1 + (scales * WIDEST) ** 2)) * WIDEST**2 / (1 + (scales * WIDEST) ** 2)
    spread = np.concatenate([follow, np.eye(len(z))]) @ right.T
    return whole @ within @ whole.T + (spread * rest) @ spread.T


class Answer(NamedTuple):
    """How log |B| and log C follow what a picture says of the index.

    Args:
        slope: (m, free) of the index's coordinates along them.
        scales: (k,) singular values of what the picture and a prior say of them.
        right: (free, free) the directions these belong to, the first k rows.
        logs: (free, m + prior's rows) how they follow the index's part of q in units of the noise,
            and the prior's rows; with the sign of q.
    """

    slope: np.ndarray
    scales: np.ndarray
    right: np.ndarray
    logs: np.ndarray


def _answer(unknowns: Unknowns, z: Array, left: Eliminated, noise: float) -> Answer:
    """How the coefficients follow q."""
    index = unknowns.coefficients.index(z, unknowns.reference)
    slope = _along_logs(unknowns.coefficients, lambda z: unknowns.change(z, index), z)
    rows = np.concatenate([left.r @ slope / noise, unknowns.prior_rows], axis=0)
    basis, scales, right = np.linalg.svd(rows, full_matrices=True)
    gain, count = scales / (scales**2 + WIDEST**-2), len(scales)
    return Answer(slope, scales, right, right[:count].T @ (gain[:, None] * basis[:, :count].T))


def _along_logs(coefficients: Coefficients, of: Callable[[Any], Array], z: Array) -> np.ndarray:
    """Derivative (k, free) of `of`, (k,) at `z`, along log |B| and log C of the free ones."""
    to_logs = jnp.diag(jax.jacfwd(coefficients.logarithms)(z))
    return np.asarray(jax.jacfwd(of)(z) / to_logs[None, :])


def _edges_without(plan: Plan, moves: bool) -> str:
    """What to say of edges that have no derivative, if any move.

    Args:
        plan: of a render.
        moves: whether numbers of the scene are free.
    """
    if plan.scattering:
        outlines = ", outlines of glass balls" if moves else ""
        return UNDERSTATED.format(f"shadows, caustics{outlines} and what is reflected many times")
    return UNDERSTATED.format("outlines of glass balls") if plan.nested and moves else ""


def _line_figures(coefficients: Coefficients, z: Array) -> jax.Array:
    """n_d, V_d and P_gF (3,)."""
    d, F, C, g = coefficients.index(z, np.array([LINE_D, LINE_F, LINE_C, LINE_G]))
    return jnp.stack([d, (d - 1) / (F - C), (g - F) / (F - C)])


def _coefficient_covariance(
    coefficients: Coefficients, B: np.ndarray, C: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Covariance (6, 6) of B and C from that of the logarithms of the free ones."""
    free = np.flatnonzero(coefficients.free)
    scale = np.concatenate([B, C])[free]
    full = np.zeros((6, 6))
    full[np.ix_(free, free)] = scale[:, None] * covariance * scale[None, :]
    return full


def _in_order(
    coefficients: Coefficients, B: np.ndarray, C: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Terms by rising C, as catalogues print them, where the start had them so."""
    order = by_C(C)
    if np.any(np.diff(coefficients.C) < 0):
        order = np.arange(6)
    return B[order[:3]], C[order[:3]], covariance[np.ix_(order, order)]


def _verdict(end: Descent) -> tuple[bool, str]:
    """Whether a fit may be called converged, and why."""
    if end.lin.seen == 0:
        return False, "no pixel of the picture depends on this glass"
    if not end.converged:
        return False, f"no minimum was reached in {end.steps} steps"
    if end.lin.explained <= 0:
        return False, "the best glass does not explain the picture: is it one of this scene?"
    return True, f"a minimum was reached in {end.steps} steps"


def _named(
    unknowns: Unknowns, z: np.ndarray, left: Eliminated, meat: np.ndarray
) -> tuple[list[tuple[str, float, float]], float]:
    """The glasses of the table, nearest first, and the probability that it is none of them.

    Returns:
        Names, distances in standard deviations of what the picture tells, and probabilities; and
        that of any other glass.
    """
    fitted = np.asarray(unknowns.coefficients.index(z, unknowns.reference))
    low, high = float(unknowns.coefficients.low), float(unknowns.coefficients.high)
    values, vectors = np.linalg.eigh(np.linalg.pinv(meat, hermitian=True))
    whiten = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T @ left.r @ unknowns.project
    table = {
        name: whiten @ (np.asarray(glass.indices(unknowns.reference)) - fitted)
        for name, glass in glass_table().items()
        if not domain_error(glass, low, high)
    }
    if not table:
        return [], 1.0
    probabilities, other = _probabilities(np.stack(list(table.values())))
    distances = (float(np.linalg.norm(off)) for off in table.values())
    found = zip(table, distances, probabilities.tolist(), strict=True)
    return sorted(found, key=lambda entry: entry[1]), other


def _probabilities(
    offsets: Float[np.ndarray, "glasses k"],
) -> tuple[Float[np.ndarray, " glasses"], float]:
    """The probability of each glass, and that it is another one.

    Each glass of the table is as likely beforehand as any other, and one that is not in it as
    likely as all of them together. What is not in it is spread as the table is: normally, with its
    mean and covariance. So another glass explains any picture a little, the less the better the
    picture tells glasses apart.

    Args:
        offsets: of each glass from the fit, in coordinates in which the error is 1 in every
            direction.

    Source:
        MacKay, Information Theory, Inference, and Learning Algorithms (Cambridge, 2003), ch. 28.
    """
    count, k = offsets.shape
    mean, spread = offsets.mean(axis=0), np.eye(k)
    if count > 1:
        spread = spread + np.atleast_2d(np.cov(offsets.T))
    _, size = np.linalg.slogdet(spread)
    logs = np.append(
        -np.sum(offsets**2, axis=1) / 2 - np.log(count),
        -(mean @ np.linalg.solve(spread, mean) + size) / 2,
    )
    likely = np.exp(logs - np.max(logs))
    likely /= np.sum(likely)
    return likely[:-1], float(likely[-1])


def _summary(
    opening: str,
    waves: np.ndarray,
    n_std: np.ndarray,
    determined: int,
    free: int,
    source: str,
    prior: str,
    own: str,
) -> str:
    """What the picture determines, in plain words."""
    known = f"{determined} of the {free} directions of (B, C)"
    text = (
        f"{opening} n to {np.max(n_std):.1e} (1 sigma) between {waves.min() * 1e3:.0f}"
        f" and {waves.max() * 1e3:.0f} nm and {known} to better than 10 %"
        f" ({source}{_prior_words(prior)})."
    )
    if determined < free:
        text += (
            " B and C are not determined one by one: over these wavelengths other values of them"
            " give the same n(λ) within its error."
        )
    if own:
        text += f" The last level used what the picture says of itself: {own}."
    return text


def _prior_words(prior: str) -> str:
    """What was known before the picture, if anything was."""
    if prior == "none":
        return ""
    of = ""
    if prior == "catalogue":
        glasses = real_glasses()
        of = f" of {len(glasses.terms)} glasses {glasses.source}"
    return f", with the prior {prior}{of}"


def _clipped_words(count: int, ceiling: float) -> str:
    """How many values were cut off, if any."""
    if not count:
        return ""
    values = "1 value of the target is" if count == 1 else f"{count} values of the target are"
    return f" {values} clipped: known to be at least {ceiling:.3g}, and no more."


def _outlier_words(count: int) -> str:
    """How many values a robust loss left out, if any."""
    if not count:
        return ""
    values = "1 value of the target is an outlier" if count == 1 else f"{count} values are outliers"
    return f" {values}, and left out by the robust loss."


def _rendering_words(rendering: Rendered | None, most: int, n_d_std: float) -> str:
    """What the fit's own render leaves open of n_d, where a tolerance was asked for.

    Args:
        rendering: what a converged fit chose.
        most: samples of a pixel.
        n_d_std: the error reported of n_d.
    """
    if rendering is None:
        return ""
    tolerance = f"the tolerance of {rendering.tolerance:g}"
    text = f" The fit's own rendering leaves n_d open by an estimated {rendering.error:.1e}"
    if not rendering.met:
        return f"{text} with the most samples allowed, {most} a pixel: {tolerance} is not met."
    if rendering.error == 0:
        text = " The fit drew the picture as the target says: its rendering leaves nothing open"
    if n_d_std > rendering.tolerance:
        text += (
            f". The picture fixes n_d to ±{n_d_std:.1e}: {tolerance} is met by the fit's own"
            " rendering, not by the picture"
        )
    return f"{text}."
