"""Many paths at once: lanes that are kept busy, for pictures of scenes that scatter light.

A few thousand lanes advance together, so that their numbers stay in the cache. A first pass finds
what each film sample meets, tile by tile, among the spheres that the tile can see; what ends there
is done. Each lane then owns a pixel until its other samples are done, and takes the next pixel of
a queue when enough lanes have nothing left to do.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt32

from diffdisp.camera import Camera, Projection, camera_ray
from diffdisp.film import Film
from diffdisp.geometry import Ray, Sphere
from diffdisp.integrator import (
    MOST_TOGETHER,
    Candidates,
    Paint,
    Path,
    Setting,
    Split,
    Tables,
    World,
    all_spheres,
    bounce,
    emitted,
    first_places,
    look_up,
    nearest,
    new_path,
    no_surface,
    once,
    surface_numbers,
    surfaces_of,
)
from diffdisp.planning import Plan
from diffdisp.sampling import Numbers
from diffdisp.scene import Scene
from diffdisp.vector import Array, Real, Vec3, choose, vec3

LANES = 1024
"""Lanes that advance together: their state stays in the cache of a core. Half as many where a part
of a picture is small: a larger share of its time goes to waiting for the last path."""

IDLE = 1 / 4
"""Share of lanes that may idle before they are given new pixels."""

GROUP = 4
"""Spheres that the first pass takes together."""

MOST_SAMPLES = 32
"""Samples of a pixel in one pass: those that wait are bits of a word."""


PIXELS = 1 << 17
"""Pixels that one call of the compiled program has room for, in a large picture."""

STRIPS = 16
"""Strips of a picture, at least, that are dealt out to its parts."""

SHARES = 2
"""Lanes that share a pixel of long paths, which a small picture would wait for."""


class Tiles(NamedTuple):
    """Square tiles of a picture to render, and what each can see.

    Args:
        x: pixels to the right of the picture's left edge.
        y: pixels below its upper edge.
        candidates: rows of the table of spheres that a tile can see, filled up with one past its
            last row.
        groups: how many groups of four candidates count.
        filled: how many tiles there are; the others fill the table.
    """

    x: Int[Array, " tiles"]
    y: Int[Array, " tiles"]
    candidates: Int[Array, "tiles rows"]
    groups: Int[Array, " tiles"]
    filled: Int[Array, ""]


class FilmSamples(NamedTuple):
    """The samples of every pixel in one pass.

    Args:
        number: which of the pixel's samples, of all passes.
        right: from the pixel's left edge to that of the sample's cell, pixels.
        down: from its upper edge to that of the cell, pixels.
        cell: width and height of a cell, pixels.
        indices: of each ball's glass, for each sample's wavelengths; of one where all have one.
        weights: what the paths at each of a sample's wavelengths count, for each channel, once
            they have met dispersive glass; None where there is none.
        ratios: index of each ball's glass in each channel over that at the first wavelength; None
            where there are no weights.
    """

    number: UInt32[Array, " samples"]
    right: Float[Array, " samples"]
    down: Float[Array, " samples"]
    cell: tuple[Real, Real]
    indices: Float[Array, "samples wavelengths balls"]
    weights: tuple[Float[Array, "samples wavelengths"], ...] | None
    ratios: tuple[Float[Array, " balls"], ...] | None


class View(NamedTuple):
    """A scene and a film, as the wavefront sees them; sizes in pixels."""

    world: World
    paint: Paint
    projection: Projection
    width: Int[Array, ""]
    height: Int[Array, ""]
    seed: Array
    cutoff: Real


class Lane(NamedTuple):
    """A lane: the pixel that it owns, and the path of one of its samples.

    Args:
        slot: where the pixel's result belongs.
        x: the pixel's column.
        y: its row.
        waiting: a bit for each sample that is still to come.
        sample: the present one.
        wave: the present one of the sample's wavelengths; None where none has any. The first is
            the middle one; the second follows if the first one's path has met dispersive glass.
        way: what the sample meets first: glass, through which its paths go at all but these two
            wavelengths; glass that reflects it; or nothing of glass. None as before.
        path: the present path; its radiance is that of all the pixel's paths.
    """

    slot: Int[Array, " lanes"]
    x: Int[Array, " lanes"]
    y: Int[Array, " lanes"]
    waiting: UInt32[Array, " lanes"]
    sample: Int[Array, " lanes"]
    wave: Int[Array, " lanes"] | None
    way: Int[Array, " lanes"] | None
    path: Path


NO_GLASS, THROUGH, REFLECTED = 0, 1, 2
"""The ways of a lane. What has gone through glass is reflected by it after that."""

FIRST_THROUGH = 2
"""The first of a sample's wavelengths that go through glass."""


def tile_edge(samples: int) -> int:
    """Pixels along the edge of a tile: a power of two, for two or three thousand samples."""
    return 1 << max(round(np.log2(4096 / samples) / 2), 2)


def visible_tiles(scene: Scene, film: Film, plan: Plan, edge: int, workers: int) -> list[Tiles]:
    """The tiles of a picture in which there is more to see than the background, in parts.

    Args:
        scene: without traced numbers.
        film: the picture's size.
        plan: the static choices.
        edge: of a tile, pixels.
        workers: how many parts are worked on at a time.
    """
    spheres = [obj.shape for obj in surfaces_of(scene) if isinstance(obj.shape, Sphere)]
    columns, rows_down = np.arange(0, film.width, edge), np.arange(0, film.height, edge)
    x, y = np.tile(columns, len(rows_down)), np.repeat(rows_down, len(columns))
    seen = _in_view(scene.camera, film, spheres, x, y, edge)
    some = np.flatnonzero(seen.any(axis=1) | (plan.planes > 0))
    counts = seen.sum(axis=1)
    # The rows of those that are seen come first, the others after them.
    rows = np.argsort(~seen, axis=1, kind="stable")
    width = -(-len(spheres) // GROUP) * GROUP
    rows = np.where(np.arange(len(spheres)) < counts[:, None], rows, len(spheres))
    rows = np.pad(rows, ((0, 0), (0, width - len(spheres))), constant_values=len(spheres))
    # A small picture is laid out in small arrays.
    capacities = [max(1, (PIXELS >> shift) // edge**2) for shift in (5, 3, 1, 0)]
    capacity = next((c for c in capacities if len(some) <= workers * c), capacities[-1])
    # Equal parts, a multiple of the workers', each with room for all lanes.
    parts = min(-(-len(some) // (capacity * workers)) * workers, len(some))

    def part(of: np.ndarray) -> Tiles:
        spare = (0, capacity - len(of))
        return Tiles(
            np.pad(x[of], spare).astype(np.int32),
            np.pad(y[of], spare).astype(np.int32),
            np.pad(rows[of], (spare, (0, 0))).astype(np.int32),
            np.pad(-(-counts[of] // GROUP), spare).astype(np.int32),
            np.asarray(len(of), np.int32),
        )

    # Each part takes from all over the picture, for sky takes less time than what is under it; but
    # in whole strips, for paths that are alike take less than others.
    turns = [*range(parts), *reversed(range(parts))]
    turns *= -(-STRIPS // max(len(turns), 1))
    strips = np.array_split(some, len(turns)) if parts else []
    shares = [[s for s, of in zip(strips, turns, strict=True) if of == k] for k in range(parts)]
    return [part(np.concatenate(share)) for share in shares]


def lanes_for(part: Tiles, edge: int) -> int:
    """Lanes that follow the paths of a part of a picture."""
    return LANES if part.x.shape[0] >= PIXELS // edge**2 else LANES // 2


def _in_view(
    camera: Camera, film: Film, spheres: list[Sphere], x: np.ndarray, y: np.ndarray, edge: int
) -> np.ndarray:
    """Whether each sphere may be seen in each tile: a cone around the tile meets one around it."""
    look_from = np.asarray(camera.look_from)
    forward = _unit(np.asarray(camera.look_at) - look_from)
    right = _unit(np.cross(forward, np.asarray(camera.up)))
    upward = np.cross(right, forward)
    pixel = np.tan(np.radians(np.asarray(camera.vertical_fov)) / 2) * 2 / film.height

    def toward(dx: float, dy: float) -> np.ndarray:
        across = (x + dx - film.width / 2) * pixel
        down = (y + dy - film.height / 2) * pixel
        return _unit(forward + right * across[:, None] - upward * down[:, None])

    axis = toward(edge / 2, edge / 2)
    corners = [toward(dx, dy) for dx in (0.0, float(edge)) for dy in (0.0, float(edge))]
    cosine = np.min([np.sum(axis * corner, axis=1) for corner in corners], axis=0)[:, None]
    if not spheres:
        return np.zeros((len(x), 0), bool)
    offset = np.stack([np.asarray(s.center) for s in spheres]) - look_from
    distance = np.linalg.norm(offset, axis=1)
    radius = np.array([float(np.asarray(s.radius)) for s in spheres]) * (1 + 1e-4)
    around = distance <= radius
    sine = np.where(around, 1.0, radius / np.where(around, 1.0, distance))
    # Both cones meet where the angle between their axes is at most the sum of their own.
    widest = cosine * np.sqrt(1 - sine**2) - np.sqrt(1 - cosine**2) * sine
    behind = np.arccos(cosine) + np.arcsin(sine) >= np.pi
    # BLAS would share this out to threads of its own, which then keep the cores busy for as long
    # as a small picture takes.
    along = np.einsum("ti,si->ts", axis, offset)
    return around | behind | (along >= distance * (widest - 1e-6))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


class Queue(NamedTuple):
    """What waits for a lane, the longest first: all lanes have to wait for the last path.

    The longest paths are those of pixels that see balls of glass or metal. They are shared out to
    several lanes, and come before all others. What waits is told by its slot: a share of a pixel.

    Args:
        slots: of such pixels, and of the others; of each those that wait first.
        lengths: how many of them wait.
    """

    slots: tuple[Int[Array, " places"], ...]
    lengths: tuple[Int[Array, ""], ...]

    @property
    def length(self) -> Array:
        """How many slots wait."""
        return self.lengths[0] + self.lengths[1]

    def at(self, place: Array) -> Array:
        """The slots at some places, which may be past the end."""
        places = place, place - self.lengths[0]
        shared, whole = (
            look_up(slots, jnp.clip(at, 0, slots.shape[0] - 1))
            for slots, at in zip(self.slots, places, strict=True)
        )
        return jnp.where(place < self.lengths[0], shared, whole)


def trace_tiles(
    plan: Plan, edge: int, lanes: int, view: View, samples: FilmSamples, tiles: Tiles
) -> Float[jax.Array, "tiles pixels channels"]:
    """The mean radiance of each pixel of some tiles over the samples of one pass.

    Args:
        plan: the static choices; `plan.samples` are those of a pass.
        edge: of a tile, pixels.
        lanes: how many advance together. They change nothing but the time.
        view: scene and film.
        samples: of each pixel.
        tiles: which pixels.
    """
    shown, waiting, hits, queue = _first_hits(plan, edge, view, samples, tiles)
    collected = _follow(plan, edge, lanes, view, samples, tiles, waiting, hits, queue)
    pixels = waiting.shape[0]
    total = [
        s + jnp.sum(c[:-1].reshape(-1, pixels), axis=0)
        for s, c in zip(shown, collected, strict=True)
    ]
    return jnp.stack(total, axis=-1).reshape(-1, edge * edge, len(total)) * (1.0 / plan.samples)


def _sample_ray(plan: Plan, view: View, samples: FilmSamples, x: Array, y: Array, s: Array) -> Ray:
    """The camera ray of sample `s` of the pixel in column `x` and row `y`."""
    numbers, start = _numbers(plan, view, x, y)
    word = look_up(samples.number, s)
    across, down = once(lambda: tuple(numbers.of_film(start, word, axis) for axis in (0, 1)), None)
    return camera_ray(
        view.projection,
        x.astype(plan.dtype) + (look_up(samples.right, s) + across * samples.cell[0]),
        y.astype(plan.dtype) + (look_up(samples.down, s) + down * samples.cell[1]),
    )


def _numbers(plan: Plan, view: View, x: Array, y: Array) -> tuple[Numbers, Array]:
    """The numbers of a picture, and the word from which those of a pixel start."""
    numbers = Numbers(plan.numbers_per_bounce, view.seed, plan.dtype)
    pixel = (y * view.width + x).astype(jnp.uint32)
    return numbers, once(lambda: numbers.start(pixel))


def _first_hits(
    plan: Plan, edge: int, view: View, samples: FilmSamples, tiles: Tiles
) -> tuple[list[Array], Array, Array, Queue]:
    """What the camera sees.

    Returns:
        For each pixel the sum of what its samples see that end at once, a list of channels; a bit
        for each sample that goes on; for (tile, sample, pixel) the surface it meets; and the
        pixels with samples that go on.
    """
    size, capacity, shares = edge * edge, tiles.x.shape[0], _shares(plan)
    pixels = capacity * size
    y, x = np.divmod(np.arange(size, dtype=np.int32), np.int32(edge))
    world, tables = view.world, Tables(view.world, view.paint)
    # So few take less time than to look up which of them a tile can see.
    every = all_spheres(world, plan, None) if plan.spheres <= MOST_TOGETHER else None

    def candidates(tile: Array) -> Candidates:
        rows = tiles.candidates[tile]
        # A sphere of no size for the rows that only fill the groups.
        centers = Vec3(*(jnp.append(axis, 0.0) for axis in world.centers))
        radii = jnp.append(world.radii, 0.0)
        numbers = jnp.asarray(np.append(surface_numbers(plan)[0], np.int32(0)))
        return Candidates(
            Vec3(*(axis[rows] for axis in centers)),
            radii[rows],
            numbers[rows],
            tiles.groups[tile],
            GROUP,
            True,
            None,
        )

    def see(tile: Array) -> tuple[tuple[Any, Array, Array], Array]:
        spheres = every or candidates(tile)
        # Arrays (samples, pixels): what is summed over samples is alike along a row.
        column, row = (tiles.x[tile] + x)[None], (tiles.y[tile] + y)[None]
        sample = np.arange(plan.samples, dtype=np.int32)[:, None]
        ray = once(lambda: _sample_ray(plan, view, samples, column, row, sample))
        surface = nearest(ray, world, plan, no_surface(ray.direction.x), spheres)
        path = new_path(ray, None, surface, plan)
        ends = surface >= plan.first_lamp
        light = emitted(surface, path, tables, plan, None)
        shown = tuple(jnp.sum(jnp.where(ends, channel, 0.0), axis=0) for channel in light)
        inside = (column < view.width) & (row < view.height)
        bits = np.uint32(1) << np.arange(plan.samples, dtype=np.uint32)[:, None]
        goes_on = path.alive & inside
        waiting = jnp.sum(jnp.where(goes_on, bits, np.uint32(0)), axis=0, dtype=jnp.uint32)
        shiny = jnp.any(goes_on & (surface < plan.mattes[0]), axis=0)
        return (shown, waiting, surface.reshape(-1)), shiny

    def put(tile: Array, state: Any) -> Any:
        def at(whole: Array, part: Array) -> Array:
            return jax.lax.dynamic_update_slice(whole, part, (tile * part.shape[0],))

        results, queue = state
        found, shiny = see(tile)
        waiting, slots, lengths = found[1], list(queue.slots), list(queue.lengths)
        for row, masks in enumerate((shares[1:], shares[:1])):
            if not len(masks):
                continue
            chosen = ((waiting[None] & masks[:, None]) != 0) & (~shiny if row else shiny)[None]
            place = first_places(chosen.reshape(-1))
            # All of a tile's pixels are written; the next ones take the places of those that do
            # not wait.
            slot = (place // size + (1 - row)) * pixels + (tile * size + place % size)
            slots[row] = jax.lax.dynamic_update_slice(slots[row], slot, (lengths[row],))
            lengths[row] = lengths[row] + jnp.sum(chosen, dtype=jnp.int32)
        queue = Queue(tuple(slots), tuple(lengths))
        return jax.tree.map(at, results, found), queue

    empty = (
        tuple(jnp.zeros(capacity * size, plan.dtype) for _ in range(plan.channels)),
        jnp.zeros(capacity * size, jnp.uint32),
        jnp.zeros(capacity * size * plan.samples, jnp.int32),
    )
    none = jnp.zeros((), jnp.int32)
    rows = (len(shares) - 1) * pixels + len(shares) * size, pixels + size
    nobody = Queue(tuple(jnp.zeros(row, jnp.int32) for row in rows), (none, none))
    (shown, waiting, hits), queue = jax.lax.fori_loop(0, tiles.filled, put, (empty, nobody))
    return list(shown), waiting, hits.reshape(capacity, plan.samples, size), queue


def _shares(plan: Plan) -> np.ndarray:
    """Bits of a pixel's samples: of all, and of each share where pixels are shared out."""
    masks = [(1 << plan.samples) - 1]
    shares = min(SHARES, plan.samples) if plan.mattes[0] else 0
    masks += [sum(1 << k for k in range(n, plan.samples, shares)) for n in range(shares)]
    return np.array(masks, np.uint32)


def _follow(
    plan: Plan,
    edge: int,
    lanes: int,
    view: View,
    samples: FilmSamples,
    tiles: Tiles,
    waiting: UInt32[Array, " pixels"],
    hits: Int[Array, "tiles samples size"],
    queue: Queue,
) -> tuple[Array, ...]:
    """The sum of each pixel's samples that went on, a channel each, with a place to spare."""
    pixels, waves, length = waiting.shape[0], samples.indices.shape[1], queue.length
    shares = _shares(plan)
    sink = len(shares) * pixels
    advance = partial(_advance, plan=plan, view=view, samples=samples, hits=hits)

    def busy(lane: Lane) -> Array:
        return lane.path.alive | (lane.waiting != 0) | _splits(lane, waves)

    def collect(lane: Lane, results: tuple[Array, ...]) -> tuple[Array, ...]:
        slot = jnp.where(busy(lane), sink, lane.slot)
        pairs = zip(results, lane.path.radiance, strict=True)
        return tuple(
            jnp.asarray(whole)
            .at[slot]
            .set(value, mode="promise_in_bounds", wrap_negative_indices=False)
            for whole, value in pairs
        )

    def refill(lane: Lane, taken: Array) -> tuple[Lane, Array]:
        idle = ~busy(lane)
        place = taken + jnp.cumsum(idle, dtype=jnp.int32) - 1
        fresh = idle & (place < length)
        slot = queue.at(place)
        share, number = slot // pixels, slot % pixels
        tile, pixel = number // (edge * edge), number % (edge * edge)
        renewed = lane._replace(
            slot=slot,
            x=look_up(tiles.x, tile) + pixel % edge,
            y=look_up(tiles.y, tile) + pixel // edge,
            waiting=look_up(waiting, number) & look_up(shares, share),
            path=lane.path._replace(radiance=tuple(jnp.zeros_like(r) for r in lane.path.radiance)),
        )
        # What idles for good writes its result once more, to a place that nobody reads.
        rested = lane._replace(slot=jnp.where(idle, sink, lane.slot))
        taken = jnp.minimum(taken + jnp.sum(idle, dtype=jnp.int32), length)
        return choose(fresh, renewed, rested), taken

    def turn(state: Any) -> Any:
        lane, results, taken = state
        lane, taken = refill(lane, taken)
        least = jnp.where(taken < length, int(lanes * (1 - IDLE)), 0)
        lane = jax.lax.while_loop(
            lambda lane: jnp.sum(busy(lane), dtype=jnp.int32) > least, advance, lane
        )
        return lane, collect(lane, results), taken

    def unfinished(state: Any) -> Array:
        return (state[2] < length) | jnp.any(busy(state[0]))

    results = tuple(jnp.zeros(sink + 1, plan.dtype) for _ in range(plan.channels))
    none = jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(
        unfinished, turn, (_idle_lanes(plan, lanes, sink, view), results, none)
    )[1]


def _idle_lanes(plan: Plan, lanes: int, sink: int, view: View) -> Lane:
    """Lanes without a pixel, as if they had followed the last wavelength of a sample."""
    zero, real = jnp.zeros((), jnp.int32), jnp.zeros((), plan.dtype)
    still = vec3(jnp.zeros(3, plan.dtype))
    path = new_path(Ray(still, still._replace(z=real - 1.0)), None, zero + plan.background, plan)
    lane = Lane(
        zero + sink,
        zero,
        zero,
        jnp.zeros((), jnp.uint32),
        zero,
        None if path.spectral is None or plan.bands else zero + 1,
        None if path.spectral is None or plan.bands else zero + NO_GLASS,
        path,
    )
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (lanes, *leaf.shape)), lane)


def _advance(lane: Lane, plan: Plan, view: View, samples: FilmSamples, hits: Array) -> Lane:
    """The lane's path advanced by one surface; where it has ended, that of its next sample."""
    lane = once(lambda: _next_sample(lane, plan, view, samples, hits))
    numbers, start = _numbers(plan, view, lane.x, lane.y)
    word = look_up(samples.number, lane.sample)
    place: Array | int = 0
    weights = always = split = None
    if samples.weights is not None:
        assert lane.wave is not None
        assert lane.way is not None
        assert samples.ratios is not None
        # Tables are looked up by one number: two would be put into an array of pairs first.
        place = lane.sample * samples.indices.shape[1] + lane.wave
        weights = tuple(look_up(channel.reshape(-1), place) for channel in samples.weights)
        always = jnp.asarray(lane.wave == 0)
        ball = jnp.minimum(lane.path.surface, plan.balls - 1)
        split = Split(
            (lane.way != NO_GLASS) & (lane.path.last < 0),
            lane.way == REFLECTED,
            tuple(look_up(ratio, ball) for ratio in samples.ratios),
        )
    setting = Setting(
        Tables(view.world, view.paint),
        plan,
        lambda bounces, decision: numbers.of_bounce(start, word, bounces, decision),
        lambda ball: look_up(samples.indices.reshape(-1), place * plan.balls + ball),
        weights,
        always,
        split,
        view.cutoff,
        None,
        differentiable=False,
    )
    return lane._replace(path=bounce(lane.path, setting))


def _splits(lane: Lane, waves: int) -> Array:
    """Whether a path has ended that others of its sample have to follow."""
    if lane.wave is None:
        return jnp.zeros_like(lane.path.alive)
    assert lane.way is not None
    assert lane.path.spectral is not None
    assert lane.path.reflected is not None
    more = lane.path.spectral & (lane.wave == 0)
    through = (lane.way == THROUGH) & ((lane.wave + 1 < waves) | (lane.path.reflected > 0))
    return ~lane.path.alive & (more | through)


def _next_sample(lane: Lane, plan: Plan, view: View, samples: FilmSamples, hits: Array) -> Lane:
    """The lane with the path of its next sample or wavelength, where the present one has ended."""
    waves = samples.indices.shape[1]

    def following() -> tuple[Array, Array, Array]:
        """The bit of the next sample, whether the present one goes on, and which comes."""
        lowest = lane.waiting & (~lane.waiting + np.uint32(1))
        again = _splits(lane, waves)
        return lowest, again, jnp.where(again, lane.sample, _bit_number(lowest))

    lowest, again, sample = once(following)
    starts = ~lane.path.alive & (again | (lane.waiting != 0))
    ray = _sample_ray(plan, view, samples, lane.x, lane.y, sample)
    tiles, _, size = hits.shape
    number = lane.slot % (tiles * size)
    place = (number // size * plan.samples + sample) * size + number % size
    surface = look_up(hits.reshape(-1), place)
    path = new_path(ray, None, surface, plan)._replace(radiance=lane.path.radiance)
    new = lane._replace(
        waiting=jnp.where(again, lane.waiting, lane.waiting & ~lowest), sample=sample, path=path
    )
    if lane.wave is not None:
        assert lane.way is not None
        assert lane.path.reflected is not None
        counts = jnp.where(again, lane.path.reflected, 0.0)
        new = new._replace(path=path._replace(reflected=counts))
        turns = again & (lane.wave + 1 == waves)
        at_glass = surface < plan.balls
        first, way = jnp.where(at_glass, FIRST_THROUGH, 0), jnp.where(at_glass, THROUGH, NO_GLASS)
        new = new._replace(
            wave=jnp.where(again, jnp.where(turns, 0, lane.wave + 1), first),
            way=jnp.where(again, jnp.where(turns, REFLECTED, lane.way), way),
        )
    return choose(starts, new, lane)


def _bit_number(bit: UInt32[Array, " lanes"]) -> Int[Array, " lanes"]:
    """Which bit of a word is set, 0 if none is: the exponent of the word as a number.

    To count the bits below it takes ten times as long where a processor counts word by word.
    """
    word = bit.astype(jnp.int32).astype(jnp.float32)
    exponent = (jax.lax.bitcast_convert_type(word, jnp.int32) >> 23) & np.int32(255)
    return jnp.maximum(exponent - 127, 0)
