from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffdisp.sampling import (
    DIMENSIONS,
    Numbers,
    circle,
    mixed,
    sample_grid,
    sequence_steps,
    uniform_direction,
)

STEPS = sequence_steps(50)


@partial(jax.jit, static_argnums=(0, 1, 2))
def bounce_numbers(per_bounce, decision, dtype, pixel, sample, bounce, seed):
    """The numbers of many samples."""
    numbers = Numbers(per_bounce, seed, dtype)
    start = numbers.start(pixel)
    return jax.vmap(lambda s: numbers.of_bounce(start, s, bounce, decision))(sample)


def drawn(bounce, decision, pixel=3, count=1000, seed=0, per_bounce=5):
    """The first `count` numbers of a pixel for one decision of a bounce."""
    pixel, seed, bounce = (np.asarray(word, np.uint32) for word in (pixel, seed, bounce))
    sample, dtype = np.arange(count, dtype=np.uint32), jnp.result_type(float).name
    return np.asarray(bounce_numbers(per_bounce, decision, dtype, pixel, sample, bounce, seed))


def points(pixel, count, dimension, seed=0):
    """The first `count` numbers of a pixel in one dimension."""
    return drawn(dimension, -3, pixel, count, seed, per_bounce=1)


def star_discrepancy(u):
    """How far the empirical distribution departs from the uniform one.

    Source: Niederreiter (1992), theorem 2.6.
    """
    u, n = np.sort(u), len(u)
    return np.max(np.abs(u - (np.arange(n) + 0.5) / n)) + 0.5 / n


@pytest.mark.parametrize(
    ("samples", "grid"),
    [(1, (1, 1)), (2, (2, 1)), (4, (2, 2)), (6, (3, 2)), (7, (7, 1)), (12, (4, 3)), (64, (8, 8))],
)
def test_grid(samples, grid):
    assert sample_grid(samples) == grid


def test_grids_hold_their_samples_as_squarely_as_they_can():
    for samples in range(1, 200):
        columns, rows = sample_grid(samples)
        assert columns * rows == samples
        assert columns >= rows
        assert not any(samples % b == 0 for b in range(rows + 1, int(samples**0.5) + 1))


@pytest.mark.parametrize("x64", [True, False])
def test_numbers_are_below_one(x64):
    with jax.enable_x64(x64):
        u = points(pixel=3, count=20000, dimension=4)
    assert u.dtype == (np.float64 if x64 else np.float32)
    assert u.min() >= 0
    assert u.max() < 1


def test_both_precisions_take_the_same_branches():
    with jax.enable_x64(False):
        single = points(pixel=3, count=1000, dimension=4)
    np.testing.assert_array_equal(single, points(pixel=3, count=1000, dimension=4))


@pytest.mark.parametrize("dimension", [0, 1, 2, 7, 48])
@pytest.mark.parametrize("count", [64, 1024])
def test_samples_of_a_pixel_are_spread_evenly(dimension, count):
    # The steps' continued fractions begin with terms up to 17: at most (17 + 2) log(n) / n or so;
    # independent numbers depart by 0.87/√n, the limit here at n = 64 and seven times it at 1024.
    u = points(11, count, dimension)
    assert star_discrepancy(u) < max(4.0 * np.log(count) / count, 1e-3)


def test_pixels_dimensions_and_seeds_start_elsewhere():
    first = [
        [points(pixel, 1, dimension, seed)[0] for pixel in range(40)]
        for dimension in range(5)
        for seed in range(2)
    ]
    assert len(np.unique(first)) == 400
    # Uniform over pixels: Kolmogorov-Smirnov at 1e-4 for 400 numbers is 2.2/√400.
    assert star_discrepancy(np.ravel(first)) < 0.11
    # Uncorrelated rows of 40: five standard errors.
    assert np.abs(np.corrcoef(first)[np.triu_indices(10, 1)]).max() < 5 / np.sqrt(40)


def test_mixing_loses_nothing():
    words = mixed(jnp.arange(1 << 16, dtype=jnp.uint32))
    assert len(np.unique(words)) == 1 << 16  # a bijection


def test_mixing_flips_half_of_the_bits():
    # Avalanche: each input bit changes each output bit with probability 1/2; 4096 words give
    # a standard error of 0.008, and lowbias32's own bias is far less.
    words = np.random.default_rng(0).integers(0, 2**32, 4096, dtype=np.uint32)
    for bit in range(32):
        changed = np.asarray(
            mixed(jnp.asarray(words)) ^ mixed(jnp.asarray(words ^ np.uint32(1 << bit)))
        )
        flipped = (changed[:, None] >> np.arange(32, dtype=np.uint32)) & 1
        assert np.abs(flipped.mean(axis=0) - 0.5).max() < 0.045


def test_steps_are_fractions_of_roots_of_primes():
    fractions = STEPS[:5] / 2.0**32
    np.testing.assert_allclose(fractions, np.sqrt([2, 3, 5, 7, 11]) % 1, rtol=0, atol=2.0**-32)
    assert len(np.unique(STEPS)) == len(STEPS)


# --- the numbers of a path


def test_equal_keys_draw_equal_numbers():
    np.testing.assert_array_equal(drawn(2, 1), drawn(2, 1))
    np.testing.assert_array_equal(drawn(2, 1)[:10], drawn(2, 1, count=10))
    # A decision is one number of the path's, whichever bounce it is counted to.
    np.testing.assert_array_equal(drawn(2, 1), drawn(11, 0, per_bounce=1))
    first = [drawn(2, 1, **key)[0] for key in ({}, {"pixel": 4}, {"seed": 1})]
    assert len({drawn(3, 1)[0], drawn(2, 2)[0], *first}) == 5


def test_a_films_numbers_are_no_bounces():
    word = jnp.zeros((), jnp.uint32)
    numbers = Numbers(5, word, "float64")
    key = numbers.start(word), word
    film = [float(numbers.of_film(*key, axis)) for axis in (0, 1, 2)]
    bounces = [float(numbers.of_bounce(*key, jnp.asarray(b), d)) for b in (0, 1) for d in range(5)]
    assert len({*film, *bounces}) == 13


@pytest.mark.parametrize("bounce", [13, 25, 200])
def test_late_decisions_are_independent_of_those_with_the_same_step(bounce):
    late = 3 + 2 + 5 * bounce
    assert late >= DIMENSIONS
    early = late % DIMENSIONS
    u, v = drawn(late, -3, per_bounce=1), drawn(early, -3, per_bounce=1)
    np.testing.assert_array_equal(u, drawn(bounce, 2))
    # Of one step their difference would be a constant. Kolmogorov-Smirnov at 1e-4: 2.2/√1000.
    assert star_discrepancy(u) < 0.07
    assert star_discrepancy((u - v) % 1) < 0.07
    neighbour = drawn(bounce, 3)
    assert star_discrepancy((u - neighbour) % 1) < 0.07
    assert abs(np.corrcoef(u, neighbour)[0, 1]) < 5 / np.sqrt(1000)  # five standard errors


# --- directions

TURNS = np.concatenate(
    [
        np.random.default_rng(0).uniform(size=100_000),
        [0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1],
        np.nextafter([0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1], 0),
    ]
)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 2e-7), ("float64", 1e-15)])
def test_cosine_and_sine_of_a_turn(dtype, tolerance):
    # Three or four roundings of numbers up to 1.
    turns = np.append(TURNS.astype(dtype), np.nextafter(np.ones(1, dtype), np.zeros(1, dtype)))
    with jax.enable_x64(dtype == "float64"):
        cosine, sine = jax.jit(jax.vmap(circle))(turns)
    assert cosine.dtype == sine.dtype == dtype
    # In float64 the angle would itself be rounded, by 4e-16.
    angle = 2 * np.longdouble("3.14159265358979323846264338327950288") * turns
    np.testing.assert_allclose(cosine, np.cos(angle), rtol=0, atol=tolerance)
    np.testing.assert_allclose(sine, np.sin(angle), rtol=0, atol=tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 4e-7), ("float64", 1e-15)])
def test_directions_are_uniform(dtype, tolerance):
    middles = ((np.arange(64) + 0.5) / 64).astype(dtype)
    u, v = (part.ravel() for part in np.meshgrid(middles, middles))
    with jax.enable_x64(dtype == "float64"):
        found = np.stack(jax.jit(jax.vmap(uniform_direction))(u, v)).astype(float)
    np.testing.assert_array_equal(found[0], 1 - 2 * u)
    # Rounding of a few terms up to 1; in the mean less.
    np.testing.assert_allclose(np.sum(found**2, axis=0), 1, rtol=0, atol=2 * tolerance)
    np.testing.assert_allclose(found.mean(axis=1), 0, rtol=0, atol=tolerance)
    # A grid of 64 x 64 integrates a polynomial of second degree to 1/64² / 12 times its curvature.
    np.testing.assert_allclose(found @ found.T / 4096, np.eye(3) / 3, rtol=0, atol=2e-4)
    for axis in found:  # Archimedes: each coordinate is uniform; a grid's steps are 2/64
        assert star_discrepancy(0.5 * (axis + 1)) < 1 / 64


@pytest.mark.parametrize("v", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("u", [0.0, 1.0])
def test_directions_at_the_poles(u, v):
    found = np.stack(uniform_direction(jnp.asarray(u), jnp.asarray(v)))
    np.testing.assert_array_equal(np.abs(found), [1, 0, 0])
