"""The numbers of (pixel, sample, dimension)."""

import numpy as np

from diffdisp.vector import Array, Real


def sample_grid(samples: int) -> tuple[int, int]:
    """Columns and rows (a, b) of the grid of `samples` points in a pixel: a·b = samples, a ≥ b.

    A grid, because the footprints of its points tile the pixel without gap or overlap.
    """
    rows = next(b for b in range(int(samples**0.5), 0, -1) if samples % b == 0)
    return samples // rows, rows


def mixed(word: Array) -> Array:
    """A 32-bit word with its bits thoroughly mixed.

    Source:
        Ettinger, "lowbias32", in Wellons, Prospecting for Hash Functions (2018).
    """
    word = word ^ (word >> 16)
    word = word * np.uint32(0x7FEB352D)
    word = word ^ (word >> 15)
    word = word * np.uint32(0x846CA68B)
    return word ^ (word >> 16)


def sequence_steps(dimensions: int) -> np.ndarray:
    """Steps (dimensions,) of Richtmyer's sequence: the fractions of √prime, in units of 2⁻³².

    Source:
        Niederreiter, Random Number Generation and Quasi-Monte Carlo Methods (1992), section 3.1:
        multiples of square roots of primes, which are linearly independent over the rationals.
    """
    # The n-th prime is below n (ln n + ln ln n) from the sixth on: Rosser (1941).
    limit = 15 + int(dimensions * (np.log(dimensions + 2) + np.log(np.log(dimensions + 2))))
    prime = np.ones(limit, bool)
    prime[:2] = False
    for factor in range(2, int(limit**0.5) + 1):
        if prime[factor]:
            prime[factor * factor :: factor] = False
    primes = np.flatnonzero(prime)[:dimensions]
    fractions = np.sqrt(primes) % 1.0
    return (fractions * 2.0**32).astype(np.uint32)


def low_discrepancy(
    pixel: Array,
    sample: Array,
    dimension: Array,
    step: Array,
    seed: Array,
    dtype: str,
) -> Real:
    """A number in [0, 1) of a sequence that every pixel and dimension starts elsewhere.

    Args:
        pixel: number of the pixel in the picture, uint32.
        sample: number of the sample in the pixel, uint32.
        dimension: which decision of the path it serves, uint32.
        step: the dimension's entry of `sequence_steps`, uint32.
        seed: of the picture, uint32.
        dtype: of the number.
    """
    start = mixed(pixel ^ mixed(dimension ^ mixed(seed)))
    word = start + sample * step
    # 24 bits fit the significand of float32, so that the number stays below 1.
    return (word >> 8).astype(dtype) * 2.0**-24
