from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffdisp.texture import (
    Checker,
    Checker2D,
    Solid,
    as_texture,
    covered,
    filtered_square_wave,
    filtered_tiles,
)

RNG = np.random.default_rng(2)
FIRST = RNG.bit_generator.state
WAVE = jax.jit(jax.vmap(filtered_square_wave))
SLOPES = jax.jit(jax.vmap(jax.grad(filtered_square_wave, argnums=(0, 1, 2))))


@pytest.fixture(autouse=True)
def same_numbers():
    """Every test begins with the same random numbers, whichever ran before it."""
    RNG.bit_generator.state = FIRST


def hard_wave(x):
    """+1 on (0, 1), -1 on (1, 2), period 2."""
    return np.where(np.floor(x) % 2 == 0, 1.0, -1.0)


def box_mean(x, width):
    """Mean of the hard wave over boxes, from the length of each that lies on even tiles."""

    def even_length(end):
        return np.floor(end / 2) + np.clip(end - 2 * np.floor(end / 2), 0, 1)

    return 2 * (even_length(x + width / 2) - even_length(x - width / 2)) / width - 1


def brute_force(x, across, down):
    """Mean over the parallelogram x + s·across + t·down, |s|, |t| < 1/2: a sum over t."""
    wide, narrow = np.maximum(abs(across), abs(down)), np.minimum(abs(across), abs(down))
    t = (np.arange(12000) + 0.5) / 12000 - 0.5
    return box_mean(x[:, None] + t * narrow[:, None], wide[:, None]).mean(axis=-1)


def footprints(low, high, least_ratio, count=400):
    """Random x, across and down: edges between `low` and `high` tiles, of any sign and order."""
    x = RNG.uniform(-4, 4, count)
    wide = np.exp(RNG.uniform(np.log(low), np.log(high), count))
    narrow = wide * np.exp(RNG.uniform(np.log(least_ratio), 0, count))
    edges = np.stack([wide, narrow]) * RNG.choice([-1, 1], (2, count))
    return x, *np.where(RNG.random(count) < 0.5, edges, edges[::-1])


@pytest.mark.parametrize(
    ("low", "high"), [(1e-4, 1e-2), (1e-2, 0.5), (0.3, 1.2), (1, 5), (5, 60)], ids=str
)
def test_mean_over_a_parallelogram(low, high):
    where = footprints(low, high, 1e-3)
    # Midpoints across kinks of slope 2/wide: narrow/wide/12000 squared and summed, below 1e-7.
    np.testing.assert_allclose(WAVE(*where), brute_force(*where), rtol=0, atol=1e-7)


@pytest.mark.parametrize(("low", "high"), [(1e-2, 0.5), (0.3, 1.2), (1, 60)], ids=str)
def test_mean_over_a_sliver(low, high):
    where = footprints(low, high, 1e-9)
    # Slivers count as 1/1000 as broad as long: 2/wide · 2 · narrow/8 at a kink.
    np.testing.assert_allclose(WAVE(*where), brute_force(*where), rtol=0, atol=5.1e-4)


@pytest.mark.parametrize("width", [0.0, 1e-30, 1e-9, 1e-3])
def test_a_small_footprint_shows_the_hard_edge(width):
    x = RNG.uniform(-4, 4, 400)
    x = x[np.abs(x - np.round(x)) > 2e-3]
    size = np.full_like(x, width)
    for across, down in ((size, size), (size, 0 * size), (0 * size, -size)):
        np.testing.assert_array_equal(WAVE(x, across, down), hard_wave(x))


@pytest.mark.parametrize("width", [1e3, 1e6])
def test_a_large_footprint_shows_the_mean(width):
    x = RNG.uniform(-4, 4, 400)
    # The second integral of the wave is within ±1/8; four of them over width².
    found = WAVE(x, np.full_like(x, width), np.full_like(x, -0.7 * width))
    np.testing.assert_allclose(found, 0, rtol=0, atol=0.5 / (0.7 * width**2) + 1e-12)


def test_symmetries():
    x, across, down = footprints(1e-2, 5, 1e-3)
    there = WAVE(x, across, down)
    np.testing.assert_array_equal(WAVE(x, down, -across), there)
    # x + 2 is rounded, and the slope is up to 2/wide = 200, times 1/ratio of the areas.
    np.testing.assert_allclose(WAVE(x + 2, across, down), there, rtol=0, atol=1e-10)
    np.testing.assert_allclose(WAVE(-x, across, down), -there, rtol=0, atol=1e-10)
    np.testing.assert_allclose(WAVE(1 - x, across, down), there, rtol=0, atol=1e-10)


def test_the_mean_is_between_the_extremes():
    assert np.abs(WAVE(*footprints(1e-6, 100, 1e-6, 4000))).max() <= 1 + 1e-12  # rounding


EDGES = (-1.0, -0.5, 0.0, 0.25, 0.5, 1.0, 2.0)
SIZES = (0.0, 1e-30, 1e-6, 0.25, 0.5, 1.0, 2.0, 1e6)


@pytest.mark.parametrize("across", SIZES)
def test_gradients_are_finite_everywhere(across):
    x, down = (grid.ravel() for grid in np.meshgrid(EDGES, SIZES))
    slopes = SLOPES(x, np.full_like(x, across), down)
    assert all(np.isfinite(slope).all() for slope in slopes)


@pytest.mark.parametrize(("low", "high"), [(0.1, 0.5), (0.3, 1.2), (1, 5)], ids=str)
def test_gradients_are_those_of_the_mean(low, high):
    where = footprints(low, high, 0.1)
    step = 1e-7
    for axis, slope in enumerate(SLOPES(*where)):
        above, below = (
            WAVE(*(w + sign * step * (k == axis) for k, w in enumerate(where))) for sign in (1, -1)
        )
        # Second derivatives jump by up to 4/(wide·narrow) = 4000 where a kink lies within the
        # step: a quarter of that times the step. Rounding is 1e-16/(wide·narrow)/step, less.
        np.testing.assert_allclose(slope, (above - below) / (2 * step), rtol=0, atol=1.1e-4)


@pytest.mark.parametrize(("low", "high"), [(0.1, 0.5), (0.3, 1.2), (1, 5)], ids=str)
def test_gradients_of_slivers_are_those_of_the_mean(low, high):
    where = footprints(low, high, 1e-7)
    step = 1e-8
    for axis, slope in enumerate(SLOPES(*where)):
        above, below = (
            WAVE(*(w + sign * step * (k == axis) for k, w in enumerate(where))) for sign in (1, -1)
        )
        # As above: second derivatives jump by up to 4000/wide², a quarter of that times the step;
        # and rounding, a fifth of it.
        wide = np.maximum(np.abs(where[1]), np.abs(where[2]))
        apart = np.abs(slope - (above - below) / (2 * step)) * wide**2
        assert apart.max() < 1.2e-5


@pytest.mark.parametrize(("low", "high"), [(1e-4, 1e-2), (1e-2, 0.5), (0.3, 1.2), (1, 60)], ids=str)
@pytest.mark.parametrize("least_ratio", [0.1, 1e-6], ids=["broad", "slivers"])
def test_float32_keeps_its_digits(low, high, least_ratio):
    where = [np.float32(w) for w in footprints(low, high, least_ratio, 4000)]
    expected = WAVE(*(w.astype(np.float64) for w in where))
    with jax.enable_x64(False):
        found = WAVE(*where)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)  # a fortieth of an 8-bit step


GRID = (np.arange(400) + 0.5) / 400 - 0.5


def over_parallelogram(of, where):
    """Mean of `of(coordinate, ...)` over 400 x 400 points of parallelograms of 2 or 3 axes."""
    middle, across, down = (np.asarray(part) for part in where)
    s, t = np.meshgrid(GRID, GRID)
    return np.array(
        [
            of(*(m + a * s + d * t for m, a, d in zip(*one, strict=True))).mean()
            for one in zip(middle.T, across.T, down.T, strict=True)
        ]
    )


def parallelograms(axes, low, high, count=60):
    """Random middles, edges across and down, (axes, count) each."""
    middle = RNG.uniform(-4, 4, (axes, count))
    edges = np.exp(RNG.uniform(np.log(low), np.log(high), (2, axes, count)))
    return middle, *(edges * RNG.choice([-1, 1], edges.shape))


TILES = jax.jit(jax.vmap(filtered_tiles))


def tiles_along_lines(where, lines=2000):
    """Mean of even minus odd over parallelograms: along lines from edge to edge, exactly."""
    middle, across, down = (np.asarray(part) for part in where)
    t = (np.arange(lines) + 0.5) / lines - 0.5
    found = []
    for m, a, d in zip(middle.T, across.T, down.T, strict=True):
        at = m[:, None] + d[:, None] * t
        edges = np.round(m)[:, None]  # the only ones that these may meet
        crossings = np.clip((edges - at) / a[:, None], -0.5, 0.5)
        ends = np.sort(np.concatenate([crossings, [0 * t - 0.5, 0 * t + 0.5]]), axis=0)
        inside = at[:, None] + a[:, None, None] * 0.5 * (ends[1:] + ends[:-1])
        even = np.floor(inside).sum(axis=0) % 2 == 0
        found.append(np.sum(np.where(even, 1, -1) * np.diff(ends, axis=0), axis=0).mean())
    return np.array(found)


@pytest.mark.parametrize("size", [1e-3, 0.1, 0.5])
def test_a_corner_of_four_tiles_within_a_footprint(size):
    middle, across, down = parallelograms(2, 0.01 * size, size, 300)
    middle = np.round(middle) + RNG.uniform(-0.5, 0.5, middle.shape) * size
    found = TILES(tuple(middle), tuple(across), tuple(down))
    # Midpoints across kinks, as above; slivers count as 1/1000 as broad as long.
    expected = tiles_along_lines((middle, across, down))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)
    area = across[0] * down[1] - across[1] * down[0]
    broad = np.abs(area) > 2e-3 * np.sum(across**2 + down**2, axis=0)
    np.testing.assert_allclose(found[broad], expected[broad], rtol=0, atol=2e-5)
    both = [WAVE(*part) for part in zip(middle, across, down, strict=True)]
    assert np.max(np.abs(found - both[0] * both[1])) > 0.2  # so much is in how both go together


@pytest.mark.parametrize("size", [0.3, 2.0])
def test_of_rectangles_along_tiles_the_mean_is_a_product(size):
    middle, across, down = parallelograms(2, 0.1 * size, size, 300)
    across[1], down[0] = 0, 0
    found = TILES(tuple(middle), tuple(across), tuple(down))
    both = [WAVE(*part) for part in zip(middle, across, down, strict=True)]
    np.testing.assert_allclose(found, both[0] * both[1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("width", [0.0, 1e-30, 1e-9])
def test_a_point_shows_its_tile(width):
    middle = RNG.uniform(-4, 4, (2, 400))
    edge = np.full_like(middle, width)
    expected = hard_wave(middle[0]) * hard_wave(middle[1])
    np.testing.assert_array_equal(TILES(tuple(middle), tuple(edge), tuple(-edge)), expected)


@pytest.mark.parametrize("size", [0.1, 0.5, 3.0])
def test_slopes_of_tiles_are_those_of_the_mean(size):
    where = np.concatenate(parallelograms(2, 0.1 * size, size, 300))
    area = np.abs(where[2] * where[5] - where[3] * where[4])
    where = where[:, area > 0.01 * size**2]

    def mean(where):
        return TILES(*(tuple(where[k : k + 2]) for k in (0, 2, 4)))

    slopes = jax.vmap(jax.grad(lambda w: filtered_tiles((w[0], w[1]), (w[2], w[3]), (w[4], w[5]))))(
        where.T
    ).T
    step = 1e-7
    for axis, slope in enumerate(slopes):
        by = step * (np.arange(6) == axis)[:, None]
        differences = (mean(where + by) - mean(where - by)) / (2 * step)
        # Second derivatives jump by 1/(area of the footprint) at most, times its size.
        np.testing.assert_allclose(slope, differences, rtol=0, atol=1e-3)


@pytest.mark.parametrize("along", SIZES)
def test_slopes_of_tiles_are_finite_everywhere(along):
    x, y, other = (grid.ravel() for grid in np.meshgrid(EDGES, EDGES, SIZES))
    edge = np.full_like(x, along)
    for down in ((other, edge), (edge, other), (other, 0 * x), (edge, edge)):
        slopes = jax.vmap(jax.grad(filtered_tiles, argnums=(0, 1, 2)))((x, y), (edge, edge), down)
        assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))


def test_float32_keeps_the_digits_of_corners():
    where = [np.float32(w) for w in parallelograms(2, 0.02, 0.5, 4000)]
    expected = TILES(*(tuple(w.astype(np.float64)) for w in where))
    with jax.enable_x64(False):
        found = TILES(*(tuple(w) for w in where))
    assert found.dtype == np.float32
    # Rounding over the least ratio of the areas; an 8-bit step is 4e-3.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)
    assert np.sqrt(np.mean((np.asarray(found) - np.asarray(expected)) ** 2)) < 3e-5


def test_what_is_covered_of_a_footprint():
    distance, across, down = (part[0] for part in parallelograms(1, 0.1, 8, 200))
    found = jax.vmap(covered)(distance, across, down)
    expected = over_parallelogram(lambda x: x > 0, (distance[None], across[None], down[None]))
    np.testing.assert_allclose(found, expected, rtol=0, atol=3e-3)  # of the sum: 1/400
    assert ((expected > 0) & (expected < 1)).sum() > 10


def test_three_numbers_are_a_solid():
    texture = as_texture((0.1, 0.2, 0.3))
    assert isinstance(texture, Solid)
    np.testing.assert_array_equal(texture.color, [0.1, 0.2, 0.3])
    for checker in (Checker2D([1.0] * 3, [0.0] * 3, 0.5), Checker([1.0] * 3, [0.0] * 3)):
        assert as_texture(checker) is checker
    assert as_texture(texture) is texture


def test_the_numbers_of_a_texture_are_its_leaves():
    assert len(jax.tree.leaves(Checker2D([1, 1, 1], [0, 0, 0], 0.5))) == 3
    assert len(jax.tree.leaves(Checker([1, 1, 1], [0, 0, 0]))) == 3
    assert jnp.result_type(Solid([1, 0, 0]).color) == np.float64


@pytest.mark.parametrize("size", [1e-2, 1e-11, 1e-15])
def test_slopes_on_tiles_much_larger_than_a_footprint_are_finite(size):
    """In float32, whose largest number is 3e38: the fourth power of the last would be beyond."""
    single = partial(jnp.asarray, dtype=jnp.float32)
    across, down = ((single(0.7 * size), single(0.3 * size)), (single(0.2 * size), single(size)))
    middle = (single(0.2), single(0.4))
    mean, slopes = jax.jit(jax.value_and_grad(filtered_tiles, (0, 1, 2)))(middle, across, down)
    assert mean == 1.0
    assert all(np.isfinite(slope) for slope in jax.tree.leaves(slopes))
