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
)

RNG = np.random.default_rng(2)
WAVE = jax.jit(jax.vmap(filtered_square_wave))
SLOPES = jax.jit(jax.vmap(jax.grad(filtered_square_wave, argnums=(0, 1, 2))))


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
    t = (np.arange(4000) + 0.5) / 4000 - 0.5
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
    # Midpoints across kinks of slope 2/wide: narrow/wide/4000 squared and summed, below 1e-7.
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
