"""From a scene to a picture: chunks of pixels, threads, progress."""

import itertools
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

from diffdisp.color import albedo_basis, wavelength_strata
from diffdisp.dispersion import domain_error
from diffdisp.film import Film
from diffdisp.integrator import Lanes, emission_table, lane_radiance, world_tables
from diffdisp.planning import Plan, make_plan
from diffdisp.sampling import sample_grid
from diffdisp.scene import Scene, is_glass, object_glass, without_names
from diffdisp.vector import Array, Real

COLOR_RANGE = (0.38, 0.78)
"""Wavelengths that a colour picture is made of, µm."""

CHUNKS_PER_CALL = 16
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
    """What else a run needs: its seed, when a path ends, and a 1 that no compiler knows."""

    seed: np.ndarray
    cutoff: np.ndarray
    one: np.ndarray


def run_numbers(plan: Plan, seed: int, cutoff: float | None = None) -> RunNumbers:
    """Numbers of a run; without `cutoff` a path ends beneath the last digit of its light."""
    least = 0.1 * float(np.finfo(plan.dtype).eps) if cutoff is None else cutoff
    return RunNumbers(
        np.asarray(seed % 2**32, np.uint32), np.asarray(least), np.asarray(1, np.int32)
    )


def render(
    scene: Scene,
    film: Film,
    *,
    samples: int = 16,
    depth: int = 50,
    seed: int = 0,
    dtype: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Float[jax.Array | np.ndarray, "height width channels"]:
    """A picture of `scene`: radiance in bands, or linear sRGB.

    A function of the scene that can be differentiated and jitted: inside a transformation it
    traces into it and returns a traced array; outside it runs on all cores and returns NumPy's.

    Args:
        scene: what is seen.
        film: size, and bands or colour. Its wavelengths are constants.
        samples: film samples per pixel.
        depth: segments a path may have, the one from the camera included.
        seed: of the choices that paths make among several glass balls; others make none.
        dtype: "float32" or "float64"; by default JAX's present one.
        progress: called with the chunks done and their number after some have been done. An
            exception that it raises stops the work.

    Returns:
        (height, width, K or 3), row 0 on top.

    Raises:
        ValueError: samples or depth below 1, or a glass without an index at some wavelength.
    """
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(scene))
    if traced:
        return _picture(scene, film, samples, depth, seed, dtype)
    dtype = dtype or jnp.result_type(float).name
    check_glasses(scene, *film_range(film))
    plan = make_plan(scene, film, samples, depth, dtype)
    chunks, place = all_pixels(film, chunk_pixels(film, plan))
    values = render_pixels(scene, film, plan, chunks, seed, progress)
    return values.reshape(-1, film.channels)[place].reshape(film.height, film.width, film.channels)


def _picture(
    scene: Scene, film: Film, samples: int, depth: int, seed: int, dtype: str | None
) -> jax.Array:
    """`render` inside a transformation."""
    plan = make_plan(scene, film, samples, depth, dtype or jnp.result_type(float).name)
    chunks, place = all_pixels(film, chunk_pixels(film, plan))
    values = _render_chunks(
        plan, scene, film_spectrum(film, plan), film_size(film), chunks, run_numbers(plan, seed)
    )
    return values.reshape(-1, film.channels)[place].reshape(film.height, film.width, film.channels)


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
    """Pixels of a chunk: few enough that its paths stay in the cache, enough to fill a GPU."""
    lanes = {"cpu": 2048}.get(jax.default_backend(), 1 << 18)
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


def render_pixels(
    scene: Scene,
    film: Film,
    plan: Plan,
    chunks: Pixels,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Float[np.ndarray, "chunks pixels channels"]:
    """The pixels of a scene without traced numbers, on all cores."""
    fixed = (plan, without_names(scene), film_spectrum(film, plan), film_size(film))

    def run(part: Pixels) -> np.ndarray:
        return np.asarray(_render_chunks_jit(*fixed, part, run_numbers(plan, seed)))

    return over_chunks(run, chunks, plan.dtype, progress)


def compile_ahead(scene: Scene, film: Film, *, samples: int, depth: int, dtype: str) -> None:
    """Compile what `render` would run, without running it; for measuring how long that takes.

    Args:
        scene: as in `render`, without traced numbers.
        film: as in `render`.
        samples: as in `render`.
        depth: as in `render`.
        dtype: "float32" or "float64".
    """
    plan = make_plan(scene, film, samples, depth, dtype)
    chunks, _ = all_pixels(film, chunk_pixels(film, plan))
    fixed = (plan, without_names(scene), film_spectrum(film, plan), film_size(film))
    with jax.enable_x64(dtype == "float64"):
        first = next(parts_of(chunks))
        _render_chunks_jit.lower(*fixed, first, run_numbers(plan, 0)).compile()


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
    """`run` over the parts of some chunks, a thread for each core; results joined in order.

    XLA's CPU backend keeps to one core what a program does to a few thousand numbers at a time,
    but threads may run it side by side.
    """
    stop = threading.Event()

    def work(part: Pixels) -> np.ndarray:
        if stop.is_set():
            return np.empty(0)
        # The switch for float64 belongs to a thread, not to the process.
        with jax.enable_x64(dtype == "float64"):
            return run(part)

    parts, total, results = list(parts_of(chunks)), len(chunks.x), []
    with ThreadPoolExecutor(min(_workers(), len(parts))) as pool:
        try:
            # The first alone: two threads at once would compile the same program twice.
            first = [pool.submit(work, parts[0]).result()]
            for result in itertools.chain(first, pool.map(work, parts[1:])):
                results.append(result)
                if progress:
                    progress(min(len(results) * len(parts[0].x), total), total)
        except BaseException:
            stop.set()
            raise
    return np.concatenate(results, axis=0)[:total]


def _workers() -> int:
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


def film_spectrum(film: Film, plan: Plan) -> Spectrum:
    """The wavelengths that a film needs under a plan. They are constants, never traced."""
    basis = None if film.wavelengths is None else albedo_basis(np.asarray(film.wavelengths))
    if not plan.dispersive:
        return Spectrum(np.array([sum(COLOR_RANGE) / 2]), basis, None)
    if film.wavelengths is not None:
        return Spectrum(np.asarray(film.wavelengths), basis, None)
    count, samples = plan.wavelengths_per_sample, plan.samples
    wavelengths, weights = wavelength_strata(count * samples)
    # Each sample takes every `samples`-th stratum. A step near the golden section keeps the
    # strata of neighbouring samples far apart.
    step = next(
        k for k in range(round(samples * 0.618) or 1, samples + 1) if np.gcd(k, samples) == 1
    )
    taken = np.arange(samples) * step % samples + np.arange(count)[:, None] * samples
    return Spectrum(wavelengths[taken], None, weights[taken])


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
    columns, rows = sample_grid(plan.samples)
    sample = np.arange(plan.samples)
    cell = (pixels.size / columns, pixels.size / rows)
    right = jnp.asarray(sample % columns + 0.5, plan.dtype)[:, None] * cell[0]
    down = jnp.asarray(sample // columns + 0.5, plan.dtype)[:, None] * cell[1]
    emission = emission_table(scene)
    if plan.dispersive and spectrum.basis is not None:
        emission = jax.tree.map(lambda table: (spectrum.basis @ table.T)[:, :, None], emission)
    else:
        waves = spectrum.wavelengths.shape[0]
        emission = jax.tree.map(
            lambda table: jnp.broadcast_to(table[None], (waves, *table.shape)), emission
        )
    return Lanes(
        world_tables(scene),
        emission,
        spectrum.weights,
        scene.camera,
        size[1],
        (0.5 * size[0], 0.5 * size[1]),
        cell,
        pixels.x[None, :] + right,
        pixels.y[None, :] + down,
        pixels.number,
        jnp.asarray(sample, jnp.uint32),
        run.seed,
        run.cutoff,
        run.one,
    )


def combine(
    lanes: Float[Array, "wavelengths samples pixels channels"], spectrum: Spectrum
) -> Float[Array, "pixels film_channels"]:
    """The film's channels of each pixel, from what its lanes add."""
    if spectrum.weights is not None:
        return jnp.sum(lanes, axis=(0, 1))
    if lanes.shape[-1] == 1:
        return lanes[:, 0, :, 0].T
    return lanes[0, 0] if spectrum.basis is None else lanes[0, 0] @ spectrum.basis.T


def _render_chunks(
    plan: Plan,
    scene: Scene,
    spectrum: Spectrum,
    size: tuple[Real, Real],
    chunks: Pixels,
    run: RunNumbers,
) -> Float[jax.Array, "chunks pixels channels"]:
    """Mean radiance of each pixel, one chunk after another."""
    scene, spectrum, size, chunks, run = in_dtype((scene, spectrum, size, chunks, run), plan.dtype)
    indices = glass_indices(scene, spectrum.wavelengths)

    def chunk(pixels: Pixels) -> Array:
        lanes = chunk_lanes(plan, scene, spectrum, size, pixels, run)
        return combine(lane_radiance(plan, indices, lanes), spectrum)

    return each_chunk(chunk, chunks)


def each_chunk(chunk: Callable[[Pixels], Array], chunks: Pixels) -> jax.Array:
    """`chunk` of one chunk after another."""
    return jax.lax.map(
        lambda row: chunk(Pixels(row[0], row[1], row[2], chunks.size)),
        (chunks.x, chunks.y, chunks.number),
    )


def in_dtype(tree: Any, dtype: str) -> Any:
    """The tree with its real numbers in `dtype`; whole numbers stay as they are."""

    def cast(leaf: jax.Array | np.ndarray) -> jax.Array:
        real = jnp.issubdtype(leaf.dtype, jnp.floating)
        return jnp.asarray(leaf, dtype) if real else jnp.asarray(leaf)

    return jax.tree.map(cast, tree)


WIDE_VECTORS = {"xla_cpu_prefer_vector_width": "512"}
"""Compiler option for our own programs: a third less time where the processor has AVX-512."""

_render_chunks_jit = jax.jit(_render_chunks, static_argnums=0, compiler_options=WIDE_VECTORS)
