"""The pixels of a picture in chunks, each followed to its end: what pictures and fits share."""

import os
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffdisp.camera import project
from diffdisp.color import albedo_basis, wavelength_strata
from diffdisp.dispersion import domain_error
from diffdisp.film import Film
from diffdisp.integrator import Lanes, Paint, lane_radiance, paint_table, world_tables
from diffdisp.planning import Plan
from diffdisp.programs import COMPILER_OPTIONS
from diffdisp.sampling import Numbers, footprints, sample_grid
from diffdisp.scene import Scene, is_glass, object_glass
from diffdisp.vector import Array, Real, module_of

COLOR_RANGE = (0.38, 0.78)
"""Wavelengths that a colour picture is made of, µm."""

CHUNKS_PER_CALL = 8
"""Chunks that one call of the compiled program renders: what stopping and progress wait for."""


class Pixels(NamedTuple):
    """Pixels to render, in rows of one chunk each.

    Args:
        x: pixels to the right of the picture's left edge, of each one's own left edge.
        y: pixels below the picture's upper edge, of each one's own upper edge.
        number: uint32, for the low-discrepancy sequence.
        size: edge of one, in pixels of the film; above 1 for coarse pictures.
    """

    x: Float[jax.Array | np.ndarray, "*chunks pixels"]
    y: Float[jax.Array | np.ndarray, "*chunks pixels"]
    number: jax.Array | np.ndarray
    size: Float[jax.Array | np.ndarray, ""]


class RunNumbers(NamedTuple):
    """What else a run needs: its seed, when a path ends, and a 1 that no compiler knows.

    And of which samples of each pixel it is made: their numbers, from the pixel's edges to those
    of their cells, and the cells' size; the pixel's own is 1.
    """

    seed: np.ndarray
    cutoff: np.ndarray
    one: jax.Array | np.ndarray
    number: np.ndarray
    right: np.ndarray
    down: np.ndarray
    cell: tuple[np.ndarray, np.ndarray]


def run_numbers(
    plan: Plan, seed: int, cutoff: float | None = None, cells: np.ndarray | None = None
) -> RunNumbers:
    """Numbers of a run.

    Args:
        plan: its static choices.
        seed: any whole number.
        cutoff: part of its light with which a path ends; by default what is beneath a last digit.
        cells: (passes, samples) cells of the film of all passes, of which the first is run; by
            default the plan's samples are all.
    """
    least = 4.0 * float(np.finfo(plan.dtype).eps) if cutoff is None else cutoff
    taken = np.arange(plan.samples) if cells is None else cells[0]
    samples = plan.samples if cells is None else cells.size
    count = footprints(samples) if plan.filtered else samples
    columns, rows = sample_grid(count)
    place = taken * count // samples
    return RunNumbers(
        np.asarray(seed % 2**32, np.uint32),
        np.asarray(least),
        np.asarray(1, np.int32),
        taken.astype(np.uint32),
        (place % columns) / columns,
        (place // columns) / rows,
        (np.asarray(1.0 / columns), np.asarray(1.0 / rows)),
    )


def film_size(film: Film) -> tuple[np.ndarray, np.ndarray]:
    """Width and height as numbers, so that another size is no other program."""
    return np.asarray(float(film.width)), np.asarray(float(film.height))


def film_range(film: Film) -> tuple[float, float]:
    """Shortest and longest wavelength that a film sees, µm."""
    if film.wavelengths is None:
        return COLOR_RANGE
    wavelengths = np.asarray(film.wavelengths)
    return float(wavelengths.min()), float(wavelengths.max())


def check_glasses(scene: Scene, low: float, high: float) -> None:
    """Warn of wavelengths outside a glass's validity.

    Args:
        scene: the scene.
        low: shortest wavelength, µm.
        high: longest wavelength, µm.

    Raises:
        ValueError: a pole or n² ≤ 0 within [`low`, `high`].
    """
    for index, obj in enumerate(scene.objects):
        if not is_glass(obj):
            continue
        glass = object_glass(scene, index)
        called = obj.name or f"object[{index}]"
        problem = domain_error(glass, low, high)
        if problem:
            raise ValueError(
                f"{called}: its glass {problem}, within the bands' {low * 1e3:g}-{high * 1e3:g} nm"
            )
        valid = np.asarray(glass.validity) * 1e3
        if low * 1e3 < valid[0] - 1e-6 or high * 1e3 > valid[1] + 1e-6:
            warnings.warn(
                f"{called}: bands {low * 1e3:g}-{high * 1e3:g} nm reach beyond the range"
                f" {valid[0]:g}-{valid[1]:g} nm that its glass was measured on",
                stacklevel=3,
            )


def chunk_pixels(film: Film, plan: Plan) -> int:
    """Pixels of a chunk: enough to fill its blocks, or a GPU; few enough to stay in a cache."""
    lanes = {"cpu": 65536 // np.dtype(plan.dtype).itemsize}.get(jax.default_backend(), 1 << 18)
    waves = plan.wavelengths_per_sample if film.wavelengths is None else film.channels
    return int(np.clip(lanes // (plan.samples * (waves if plan.dispersive else 1)), 1, 1024))


def all_pixels(film: Film, count: int) -> tuple[Pixels, np.ndarray]:
    """Every pixel of a film in chunks of `count` that lie close together.

    Returns:
        The pixels, and for each pixel of the picture, row by row, its place among them. The last
        chunk repeats its last pixel to be as long as the others.
    """
    return some_blocks(np.arange(film.width * film.height), film.width, 1.0, count)


def some_blocks(
    numbers: np.ndarray, width: int, size: float, count: int
) -> tuple[Pixels, np.ndarray]:
    """Square blocks of `size` pixels by their numbers, row by row of `width` blocks.

    Args:
        numbers: (blocks,) which blocks.
        width: blocks in a row of the picture.
        size: edge of a block, pixels.
        count: blocks of a chunk.

    Returns:
        The blocks in chunks, those that lie close together in one, and the place (blocks,) of
        each of `numbers` among them. The last chunk repeats its last block to be full.
    """
    tile = max(1, int(count**0.5))
    y, x = np.divmod(numbers, width)
    # Tiles of a chunk's size: paths that are alike end together.
    order = np.lexsort((x % tile, y % tile, x // tile, y // tile))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    chunks = -(-len(order) // count)
    order = np.append(order, np.repeat(order[-1], chunks * count - len(order)))
    order = order.reshape(chunks, count)
    return Pixels(
        x[order] * size,
        y[order] * size,
        numbers[order].astype(np.uint32),
        np.asarray(size),
    ), place


def parts_of(chunks: Pixels) -> Iterator[Pixels]:
    """The chunks in parts of equal length, so that one program serves all.

    The last part repeats the last chunk.
    """
    total = len(chunks.x)
    for start in range(0, total, CHUNKS_PER_CALL):
        rows = np.minimum(np.arange(start, start + CHUNKS_PER_CALL), total - 1)
        yield Pixels(chunks.x[rows], chunks.y[rows], chunks.number[rows], chunks.size)


def over_chunks(
    run: Callable[[Pixels], np.ndarray],
    chunks: Pixels,
    dtype: str,
    progress: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """`run` over the parts of some chunks, a thread for each core; results joined in order."""
    results = in_threads(run, list(parts_of(chunks)), dtype, progress)
    return np.concatenate(results, axis=0)[: len(chunks.x)]


def in_threads(
    run: Callable[[Any], Any],
    parts: list[Any],
    dtype: str,
    progress: Callable[[int, int], None] | None = None,
    alone: int = 1,
) -> list[Any]:
    """`run` over some parts, a thread for each core; the results in the parts' order.

    XLA's CPU backend keeps to one core what a program does to a few thousand numbers at a time,
    but threads may run it side by side.

    Args:
        run: called with a part.
        parts: at least one.
        dtype: in which `run` computes.
        progress: called with the parts done and their number. An exception ends the work.
        alone: parts to run before the others start: two threads that begin together would compile
            the same program twice.
    """
    stop = threading.Event()

    def work(part: Any) -> Any:
        if stop.is_set():
            return None
        # The switch for float64 belongs to a thread, not to the process.
        with jax.enable_x64(dtype == "float64"):
            return run(part)

    results = []
    with ThreadPoolExecutor(min(workers(), len(parts))) as pool:
        try:
            for together in (parts[:alone], parts[alone:]):
                for result in pool.map(work, together):
                    results.append(result)
                    if progress:
                        progress(len(results), len(parts))
        except BaseException:
            stop.set()
            raise
    return results


def workers() -> int:
    """Threads that render: a core each; one where another device does the work."""
    if jax.default_backend() != "cpu":
        return 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Spectrum(NamedTuple):
    """What a film asks of the spectrum, as numbers.

    Args:
        wavelengths: µm; (K,) one path for each band, (W, samples) wavelengths of colour samples,
            (1,) without dispersion.
        basis: (K, 3) what each band sees of a linear sRGB colour; None for a colour film.
        weights: (W, samples, 3) what colour samples through glass count; None where all count
            alike.
    """

    wavelengths: Float[jax.Array | np.ndarray, "..."]
    basis: Float[jax.Array | np.ndarray, "bands 3"] | None
    weights: Float[jax.Array | np.ndarray, "wavelengths samples 3"] | None


def film_spectrum(film: Film, plan: Plan, seed: int) -> Spectrum:
    """The wavelengths that a film needs under a plan. They are constants, never traced.

    Args:
        film: size, and bands or colour.
        plan: the static choices.
        seed: any whole number. Where light scatters, chance decides which wavelength meets which
            part of the pixel: one pairing for all seeds would be an error that more runs keep.
    """
    basis = None if film.wavelengths is None else albedo_basis(np.asarray(film.wavelengths))
    if not plan.dispersive:
        return Spectrum(np.array([sum(COLOR_RANGE) / 2]), basis, None)
    if film.wavelengths is not None:
        return Spectrum(np.asarray(film.wavelengths), basis, None)
    if not plan.scattering:
        return Spectrum(*_strata(plan.samples, plan.wavelengths_per_sample))
    # Each sample is followed at a middle wavelength in all channels, and where that path meets
    # dispersive glass, by the same numbers at a wavelength of its own: what this one shows
    # otherwise than the middle one is the dispersion, and hardly anything else of it is noise.
    wavelengths, _, weights = _strata(plan.samples, 1, seed)
    middle = np.full_like(wavelengths, np.median(wavelengths))
    return Spectrum(
        np.concatenate([middle, wavelengths]),
        None,
        np.concatenate([1.0 / plan.samples - weights, weights]),
    )


WAVES_OF_ANY_PATH = 2
"""Wavelengths of a sample where light scatters: the middle one, and its own."""


def with_split_paths(spectrum: Spectrum, plan: Plan, seed: int) -> Spectrum:
    """The spectrum with the wavelengths of samples that the camera sees through glass."""
    if spectrum.weights is None:
        return spectrum
    wavelengths, _, weights = _strata(plan.samples, plan.wavelengths_per_sample, seed)
    return Spectrum(
        np.concatenate([spectrum.wavelengths, wavelengths]),
        None,
        np.concatenate([spectrum.weights, weights]),
    )


def _strata(
    samples: int, count: int, seed: int | None = None
) -> tuple[np.ndarray, None, np.ndarray]:
    """Wavelengths (count, samples) of a pixel's samples, and what they count in each channel."""
    wavelengths, weights = wavelength_strata(count * samples)
    # Each sample takes every `samples`-th stratum. A step near the golden section keeps the
    # strata of neighbouring samples far apart.
    step = next(
        k for k in range(round(samples * 0.618) or 1, samples + 1) if np.gcd(k, samples) == 1
    )
    turn = 0 if seed is None else np.random.default_rng(seed % 2**32).integers(samples)
    taken = (np.arange(samples) + turn) * step % samples + np.arange(count)[:, None] * samples
    return wavelengths[taken], None, weights[taken]


def glass_indices(scene: Scene, wavelengths: Array) -> tuple[Array, ...]:
    """The index of each ball's glass at every wavelength, in the order of the tracer's tables."""
    glasses = [object_glass(scene, i) for i, obj in enumerate(scene.objects) if is_glass(obj)]
    flat = wavelengths.reshape(-1)
    return tuple(glass.indices(flat).reshape(wavelengths.shape) for glass in glasses)


def chunk_lanes(
    plan: Plan,
    scene: Scene,
    spectrum: Spectrum,
    size: tuple[Real, Real],
    pixels: Pixels,
    run: RunNumbers,
) -> Lanes:
    """The film samples of one chunk of pixels.

    Args:
        plan: the static choices.
        scene: the scene, in the plan's dtype.
        spectrum: the film's spectrum under the plan.
        size: width and height of the film, pixels.
        pixels: one chunk, without the axis of chunks.
        run: the other numbers.
    """

    def place(edges: Array, axis: int) -> Array:
        """From the left or upper edge of each pixel to its samples (S, P), pixels."""
        within: Array | float = 0.5
        if plan.scattering and not plan.filtered:  # what is not averaged is seen at one point
            numbers = Numbers(plan.numbers_per_bounce, run.seed, plan.dtype)
            by_pixel = jax.vmap(numbers.of_film, (0, None, None))
            within = jax.vmap(by_pixel, (None, 0, None))(
                numbers.start(pixels.number), run.number, axis
            )
        return pixels.size * (edges[:, None] + within * run.cell[axis])

    return Lanes(
        world_tables(scene),
        film_paint(plan, scene, spectrum),
        spectrum.weights,
        project(scene.camera, *size),
        (pixels.size * run.cell[0], pixels.size * run.cell[1]),
        pixels.x[None, :] + place(run.right, 0),
        pixels.y[None, :] + place(run.down, 1),
        pixels.number,
        run.number,
        run.seed,
        run.cutoff,
        run.one,
    )


def film_paint(plan: Plan, scene: Scene, spectrum: Spectrum) -> Paint:
    """What the surfaces show to each wavelength (J,) that lanes are made for.

    In the film's channels, or linear sRGB where only what ends a path has a colour: then the
    bands can be told from the colour when all is summed.
    """
    paint, basis = paint_table(scene), spectrum.basis
    waves = spectrum.wavelengths.shape[0]

    def seen(channels: tuple[Array, ...]) -> tuple[Array, ...]:
        both = module_of(*channels)
        table: Array = both.stack(channels)
        if basis is not None and (plan.dispersive or plan.scattering):
            table = basis @ table
        if plan.channels == 1:
            return (table,)
        return tuple(both.broadcast_to(row, (waves, row.shape[0])) for row in table)

    return paint._replace(mean=seen(paint.mean), half=seen(paint.half))


def combine(
    plan: Plan, lanes: Float[Array, "wavelengths samples pixels channels"], spectrum: Spectrum
) -> Float[Array, "pixels film_channels"]:
    """The film's channels of each pixel, from what its lanes add."""
    if spectrum.weights is not None:
        return jnp.sum(lanes, axis=(0, 1))
    if lanes.shape[-1] == 1:
        return lanes[:, 0, :, 0].T
    if spectrum.basis is None or plan.scattering:
        return lanes[0, 0]
    return lanes[0, 0] @ spectrum.basis.T


def render_chunks(
    plan: Plan,
    scene: Scene,
    spectrum: Spectrum,
    size: tuple[Real, Real],
    chunks: Pixels,
    run: RunNumbers,
) -> Float[jax.Array, "chunks pixels channels"]:
    """Mean radiance of each pixel, one chunk after another."""
    run = run._replace(one=_unknown_one(run.one, scene))
    scene, spectrum, size, chunks, run = in_dtype((scene, spectrum, size, chunks, run), plan.dtype)
    indices = glass_indices(scene, spectrum.wavelengths)

    def chunk(pixels: Pixels) -> Array:
        lanes = chunk_lanes(plan, scene, spectrum, size, pixels, run)
        return combine(plan, lane_radiance(plan, indices, lanes), spectrum)

    return each_chunk(chunk, chunks)


def _unknown_one(one: Array, scene: Scene) -> Array:
    """The 1, or another positive number, as no compiler knows it.

    In a program of the user's own the 1 is a constant; then what is traced of the scene makes one.
    """
    leaves = [one, *jax.tree.leaves(scene)]
    traced = next((leaf for leaf in leaves if isinstance(leaf, jax.core.Tracer)), None)
    if traced is None or traced is one:
        return one
    number = jax.lax.stop_gradient(jnp.ravel(traced)[0]).astype(jnp.float32)
    return jnp.maximum(jax.lax.bitcast_convert_type(number, jnp.int32), 1)


def each_chunk(chunk: Callable[[Pixels], Array], chunks: Pixels) -> jax.Array:
    """`chunk` of one chunk after another."""
    return jax.lax.map(
        lambda row: chunk(Pixels(row[0], row[1], row[2], chunks.size)),
        (chunks.x, chunks.y, chunks.number),
    )


def plain(tree: Any, dtype: str) -> Any:
    """The tree as NumPy's arrays, its real numbers in `dtype`: as a compiled program takes them."""

    def cast(leaf: Array) -> np.ndarray:
        array = np.asarray(leaf)
        return array.astype(dtype) if np.issubdtype(array.dtype, np.floating) else array

    return jax.tree.map(cast, tree)


def in_dtype(tree: Any, dtype: str) -> Any:
    """The tree with its real numbers in `dtype`; whole numbers stay as they are."""

    def cast(leaf: jax.Array | np.ndarray) -> jax.Array:
        real = jnp.issubdtype(leaf.dtype, jnp.floating)
        return jnp.asarray(leaf, dtype) if real else jnp.asarray(leaf)

    return jax.tree.map(cast, tree)


render_chunks_jit = jax.jit(render_chunks, static_argnums=0, compiler_options=COMPILER_OPTIONS)
