from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffdisp.sampling import low_discrepancy, mixed, sample_grid, sequence_steps

STEPS = sequence_steps(50)


def points(pixel, count, dimension, seed=0):
    """The first `count` numbers of a pixel in one dimension."""
    words = [jnp.asarray(v, jnp.uint32) for v in (pixel, dimension, STEPS[dimension], seed)]
    sample = jnp.arange(count, dtype=jnp.uint32)
    dtype = jnp.result_type(float).name
    each = jax.vmap(partial(low_discrepancy, dtype=dtype), (None, 0, None, None, None))
    return np.asarray(each(words[0], sample, *words[1:]))


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
