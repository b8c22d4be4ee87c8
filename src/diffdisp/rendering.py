"""From a scene to a picture: passes, loops, progress."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from diffdisp.camera import project
from diffdisp.chunks import (
    WAVES_OF_ANY_PATH,
    RunNumbers,
    Spectrum,
    all_pixels,
    check_glasses,
    chunk_pixels,
    film_paint,
    film_range,
    film_size,
    film_spectrum,
    glass_indices,
    in_threads,
    over_chunks,
    parts_of,
    plain,
    render_chunks,
    render_chunks_jit,
    run_numbers,
    some_blocks,
    with_split_paths,
    workers,
)
from diffdisp.color import wavelength_strata
from diffdisp.film import Film
from diffdisp.integrator import world_tables
from diffdisp.planning import Plan, make_plan
from diffdisp.programs import Program, program
from diffdisp.scene import Scene, without_names
from diffdisp.wavefront import (
    MOST_SAMPLES,
    FilmSamples,
    Tiles,
    View,
    lanes_for,
    tile_edge,
    trace_tiles,
    visible_tiles,
)

PASS_PATHS = 1 << 26
"""Film samples of a pass over the picture, which a growing picture grows by: a second or a few."""

ENOUGH_STRATA = 16
"""Wavelengths of a pass of which every channel sees its part: fewer may leave one without any."""

Progress = Callable[[int, int], None]


def render(
    scene: Scene,
    film: Film,
    *,
    samples: int = 16,
    depth: int = 50,
    seed: int = 0,
    dtype: str | None = None,
    progress: Progress | None = None,
) -> Float[jax.Array | np.ndarray, "height width channels"]:
    """A picture of `scene`: radiance in bands, or linear sRGB.

    A function of the scene that can be differentiated and jitted: inside a transformation it
    traces into it and returns a traced array; outside it runs on all cores and returns NumPy's.

    Args:
        scene: what is seen.
        film: size, and bands or colour. Its wavelengths are constants.
        samples: film samples per pixel.
        depth: segments a path may have, the one from the camera included.
        seed: of the numbers that paths draw. A scene of lamps and one glass ball needs none.
        dtype: "float32" or "float64"; by default JAX's present one.
        progress: called with the parts done and their number after some have been done. An
            exception that it raises stops the work.

    Returns:
        (height, width, K or 3), row 0 on top.

    Raises:
        ValueError: samples or depth below 1, or a glass without an index at some wavelength.
    """
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(scene))
    if traced:
        return _picture(scene, film, samples, depth, seed, dtype)
    knobs: dict[str, Any] = {"samples": samples, "depth": depth, "seed": seed, "dtype": dtype}
    *_, last = render_progressively(scene, film, progress=progress, **knobs)
    return last.radiance


class Growing(NamedTuple):
    """A picture on its way: its radiance (height, width, channels), and of how many samples."""

    radiance: Float[np.ndarray, "height width channels"]
    samples: int


def render_progressively(
    scene: Scene,
    film: Film,
    *,
    samples: int = 16,
    depth: int = 50,
    seed: int = 0,
    dtype: str | None = None,
    progress: Progress | None = None,
) -> Iterator[Growing]:
    """The pictures that `render` passes through, each of more samples; the last is its own.

    Each pass over the picture takes as many samples of every pixel as the others. A small picture
    of few samples is done in one.

    Args:
        scene: as in `render`, without traced numbers.
        film: as in `render`.
        samples: as in `render`.
        depth: as in `render`.
        seed: as in `render`.
        dtype: as in `render`.
        progress: as in `render`, over all passes.

    Raises:
        ValueError: as in `render`.
    """
    dtype = dtype or jnp.result_type(float).name
    check_glasses(scene, *film_range(film))
    yield from passes(scene, film, samples, depth, seed, dtype, progress)


def passes(
    scene: Scene,
    film: Film,
    samples: int,
    depth: int,
    seed: int,
    dtype: str,
    progress: Progress | None = None,
    most: int = MOST_SAMPLES,
) -> Iterator[Growing]:
    """`render_progressively` of glasses that have been checked, or have no index somewhere.

    And of passes of `most` samples at most.
    """
    work = _lay_out(scene, film, samples, depth, dtype, seed, most)
    total, count = np.zeros((), dtype), len(work.cells)
    for number in range(count):

        def tell(done: int, of: int, number: int = number) -> None:
            if progress:
                progress(number * of + done, count * of)

        shown = _one_pass(work, film, seed, number, tell)
        total = total + shown if number else shown
        mean = total / (number + 1) if number else total
        yield Growing(mean, (number + 1) * work.plan.samples)


def _picture(
    scene: Scene, film: Film, samples: int, depth: int, seed: int, dtype: str | None
) -> jax.Array:
    """`render` inside a transformation."""
    plan = make_plan(scene, film, samples, depth, dtype or jnp.result_type(float).name)
    plan = replace(plan, filtered=plan.scattering)
    chunks, place = all_pixels(film, chunk_pixels(film, plan))
    fixed = plan, scene, film_spectrum(film, plan, seed), film_size(film)
    values = render_chunks(*fixed, chunks, run_numbers(plan, seed))
    return values.reshape(-1, film.channels)[place].reshape(film.height, film.width, film.channels)


class _Work(NamedTuple):
    """What there is to do for a picture: passes, each of the plan's samples of every pixel.

    Args:
        plan: of one pass.
        scene: without names, which would make another program of the direct loop.
        spectrum: of the samples of all passes.
        cells: (passes, samples) of the film, the samples' numbers.
        tiles: what the wavefront goes through, in parts; None for the direct loop.
    """

    plan: Plan
    scene: Scene
    spectrum: Spectrum
    cells: np.ndarray
    tiles: list[Tiles] | None


def _lay_out(
    scene: Scene,
    film: Film,
    samples: int,
    depth: int,
    dtype: str,
    seed: int,
    most: int = MOST_SAMPLES,
) -> _Work:
    """The work for a picture, in passes of `most` samples at most."""
    whole = make_plan(scene, film, samples, depth, dtype)
    most = min(most, PASS_PATHS // (film.width * film.height))
    share = max(count for count in range(1, max(most, 1) + 1) if samples % count == 0)
    plan = replace(whole, samples=share)
    # Each pass takes cells from all over the pixel: a step that is no divisor of their number
    # leads through all of them, and one near 0.382 of it keeps neighbours apart.
    step = next(
        k for k in range(round(samples * 0.382) or 1, samples + 1) if np.gcd(k, samples) == 1
    )
    cells = np.arange(samples) * (step if share < samples else 1) % samples
    spectrum = film_spectrum(film, whole, seed)
    tiles = None
    if plan.scattering:
        if plan.bands and plan.dispersive:  # each band is a picture of its own
            plan = replace(plan, bands=1)
        tiles = visible_tiles(scene, film, plan, tile_edge(share), workers())
        spectrum = with_split_paths(spectrum, whole, seed)
    nameless = scene if plan.scattering else without_names(scene)
    return _Work(plan, nameless, spectrum, cells.reshape(-1, share), tiles)


def _one_pass(
    work: _Work, film: Film, seed: int, number: int, progress: Progress
) -> Float[np.ndarray, "height width channels"]:
    """The mean of the samples of one pass over the picture."""
    if work.tiles is not None:
        run, spectrum = _of_pass(work, seed, number)
        return _wavefront_pass(work, film, spectrum, run, progress)
    every = np.arange(film.width * film.height)
    values = _pixels_of_pass(work, film, seed, number, every, progress)
    return values.reshape(film.height, film.width, film.channels)


def some_pixels(
    scene: Scene,
    film: Film,
    numbers: Int[np.ndarray, " pixels"],
    samples: int,
    depth: int,
    seed: int,
    dtype: str,
) -> Float[np.ndarray, "pixels channels"]:
    """What `render` shows at some pixels of a scene in which nothing but glass sends light on.

    Args:
        scene: as in `render`, without traced numbers, of glasses that have been checked.
        film: as in `render`.
        numbers: of the pixels, row by row of the picture.
        samples: as in `render`.
        depth: as in `render`.
        seed: as in `render`.
        dtype: as in `render`.
    """
    work = _lay_out(scene, film, samples, depth, dtype, seed)
    shown = [_pixels_of_pass(work, film, seed, part, numbers) for part in range(len(work.cells))]
    return np.mean(shown, axis=0)


def _pixels_of_pass(
    work: _Work,
    film: Film,
    seed: int,
    number: int,
    pixels: Int[np.ndarray, " pixels"],
    progress: Progress | None = None,
) -> Float[np.ndarray, "pixels channels"]:
    """The mean of the samples of one pass by the direct loop, of some pixels."""
    plan, (run, spectrum) = work.plan, _of_pass(work, seed, number)
    chunks, place = some_blocks(pixels, film.width, 1.0, chunk_pixels(film, plan))
    fixed = (plan, work.scene, spectrum, film_size(film))
    values = over_chunks(
        lambda part: np.asarray(render_chunks_jit(*fixed, part, run)), chunks, plan.dtype, progress
    )
    return values.reshape(-1, film.channels)[place]


def _of_pass(work: _Work, seed: int, number: int) -> tuple[RunNumbers, Spectrum]:
    """The numbers and the spectrum of one pass."""
    cells = np.roll(work.cells, -number, axis=0)
    run = run_numbers(work.plan, seed, cells=cells)
    return run, _spectrum_of(work, cells[0])


def _spectrum_of(work: _Work, cells: np.ndarray) -> Spectrum:
    """The spectrum of the samples of one pass; what they count is over these alone."""
    spectrum, passes = work.spectrum, len(work.cells)
    if spectrum.weights is None:
        return spectrum
    weights = spectrum.weights[:, cells] * passes
    # Where light scatters, the wavelengths of any path come first: these sum to 1 anyway.
    first = WAVES_OF_ANY_PATH if work.plan.scattering else 0
    through = weights[first:]
    if passes > 1 and through.shape[0] * through.shape[1] >= ENOUGH_STRATA:
        # What is seen through glass is white in each pass, not only in their sum.
        whole = np.sum(through, axis=(0, 1), keepdims=True)
        weights = np.concatenate([weights[:first], through / whole])
    return Spectrum(spectrum.wavelengths[:, cells], None, weights)


def _wavefront_pass(
    work: _Work, film: Film, spectrum: Spectrum, run: RunNumbers, progress: Progress
) -> Float[np.ndarray, "height width channels"]:
    """One pass by the wavefront loop."""
    plan, edge = work.plan, tile_edge(work.plan.samples)
    row = np.tile(_background(work.scene, spectrum).astype(plan.dtype), film.width)
    picture = np.empty((film.height, film.width, film.channels), plan.dtype)
    picture.reshape(film.height, -1)[...] = row
    calls = _calls(work, film, spectrum, run)

    def one(call: _Call) -> None:
        part = call.arguments[-1]
        tiles = np.asarray(trace(*call.arguments)).reshape(len(part.x), edge, edge, -1)
        # Tile by tile: one assignment for all of them takes ten times as long.
        for x, y, tile in zip(part.x[: part.filled], part.y, tiles, strict=False):
            place = picture[y : y + edge, x : x + edge, call.channels]
            place[...] = tile[: place.shape[0], : place.shape[1]]

    if calls:
        trace = _trace_program(plan, calls[0].arguments)
        in_threads(one, calls, plan.dtype, progress, alone=0)
    return picture


class _Call(NamedTuple):
    """Arguments of the compiled program, and the film's channels that it fills."""

    arguments: tuple[Any, ...]
    channels: slice


def _calls(work: _Work, film: Film, spectrum: Spectrum, run: RunNumbers) -> list[_Call]:
    """The calls of the compiled program that make a pass: one for each part, and for each band."""
    assert work.tiles is not None
    bands, channels = [spectrum], [slice(None)]
    if work.plan.dispersive and spectrum.basis is not None:
        pairs = zip(np.asarray(spectrum.wavelengths), np.asarray(spectrum.basis), strict=True)
        bands = [Spectrum(wavelength[None], basis[None], None) for wavelength, basis in pairs]
        channels = [slice(band, band + 1) for band in range(len(bands))]
    scene, size = plain(work.scene, "float64"), film_size(film)
    world, projection = world_tables(scene), project(scene.camera, *size)
    width, height = (edge.astype(np.int32) for edge in size)
    calls = []
    for band, fills in zip(bands, channels, strict=True):
        paint = film_paint(work.plan, scene, band)
        mean, half = (tuple(channel[0] for channel in part) for part in paint[:2])
        paint = paint._replace(mean=mean, half=half)
        view = View(world, paint, projection, width, height, run.seed, run.cutoff)
        fixed = plain((view, _film_samples(work.plan, scene, band, run)), work.plan.dtype)
        calls += [_Call((*fixed, part), fills) for part in work.tiles]
    return calls


def _film_samples(plan: Plan, scene: Scene, spectrum: Spectrum, run: RunNumbers) -> FilmSamples:
    """The samples of every pixel of a scene that holds NumPy's arrays."""
    indices = glass_indices(scene, np.atleast_2d(spectrum.wavelengths))
    weights = ratios = None
    if spectrum.weights is not None:
        ratios = _channel_ratios(scene, np.asarray(spectrum.wavelengths)[0, :1])
        weights = tuple(np.asarray(spectrum.weights).T * plan.samples)
    return FilmSamples(
        run.number,
        run.right,
        run.down,
        run.cell,
        np.stack(indices, axis=-1).swapaxes(0, 1) if indices else np.zeros((1, 1, 0)),
        weights,
        ratios,
    )


def _channel_ratios(scene: Scene, middle: np.ndarray) -> tuple[np.ndarray, ...]:
    """For each channel, each ball's mean index over what the channel sees, over the middle one."""
    wavelengths, weights = wavelength_strata(64)
    seen, one = (np.stack(glass_indices(scene, at)) for at in (wavelengths, middle))
    return tuple((seen @ weights / one).T)


def _trace_program(plan: Plan, arguments: tuple[Any, ...]) -> Program:
    """The compiled program of the wavefront loop."""
    with jax.enable_x64(plan.dtype == "float64"):
        edge = tile_edge(plan.samples)
        return program(trace_tiles, (plan, edge, lanes_for(arguments[-1], edge)), arguments)


def _background(scene: Scene, spectrum: Spectrum) -> np.ndarray:
    """The background in the film's channels."""
    color = np.asarray(scene.background.color)
    return color if spectrum.basis is None else np.asarray(spectrum.basis) @ color


def compile_ahead(scene: Scene, film: Film, *, samples: int, depth: int, dtype: str) -> None:
    """Compile what `render` would run, without running it; for measuring how long that takes.

    Args:
        scene: as in `render`, without traced numbers.
        film: as in `render`.
        samples: as in `render`.
        depth: as in `render`.
        dtype: "float32" or "float64".
    """
    work = _lay_out(scene, film, samples, depth, dtype, seed=0)
    plan, (run, spectrum) = work.plan, _of_pass(work, seed=0, number=0)
    if work.tiles is None:
        chunks, _ = all_pixels(film, chunk_pixels(film, plan))
        fixed = (plan, work.scene, spectrum, film_size(film))
        with jax.enable_x64(dtype == "float64"):
            render_chunks_jit.lower(*fixed, next(parts_of(chunks)), run).compile()
    elif work.tiles:
        _trace_program(plan, _calls(work, film, spectrum, run)[0].arguments)
