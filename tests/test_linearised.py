"""Against the same least squares by dense matrices, with all unknowns side by side."""

import numpy as np
import pytest

from diffdisp.linearised import Columns, linearise
from diffdisp.misfit import Clipped, Robust, misfit

CHANNELS, BLOCKS, WIDEST = 3, 40, 3.0
OTHERS, TOTAL = 6, 9
"""Two numbers of the scene, a gain for each channel, a black level; an index for each channel."""


def random_columns(generator: np.random.Generator) -> Columns:
    """Columns as those of a picture in bands: scene, gain, black and index."""
    channel = np.arange(CHANNELS)
    unknown = np.stack([0 * channel, 0 * channel + 1, 2 + channel, 0 * channel + 5, 6 + channel], 1)
    return Columns(generator.normal(size=(CHANNELS, BLOCKS, 5)), unknown, OTHERS, TOTAL)


def dense(columns: Columns) -> np.ndarray:
    """The Jacobian (blocks · channels, total), rows as in a flattened picture."""
    jacobian = np.zeros((BLOCKS, CHANNELS, TOTAL))
    for channel in range(CHANNELS):
        for column, unknown in enumerate(columns.unknown[channel]):
            jacobian[:, channel, unknown] += columns.values[channel, :, column]
    return jacobian.reshape(-1, TOTAL)


class Example:
    """A random picture, its columns, and the same as one dense problem."""

    def __init__(self, seed: int) -> None:
        """Draw the numbers."""
        generator = np.random.default_rng(seed)
        self.columns = random_columns(generator)
        self.picture, self.target = generator.normal(size=(2, BLOCKS, CHANNELS))
        self.weights = generator.uniform(0.1, 1.0, (BLOCKS, 1))
        self.lin = linearise(self.picture, self.target, self.columns, self.weights, WIDEST)
        roots = np.repeat(np.sqrt(self.weights), CHANNELS, axis=1).ravel()
        self.root = roots
        self.jacobian = dense(self.columns) * roots[:, None]
        self.residual = (self.picture - self.target).ravel() * roots
        # Beneath it, what holds the others: 1/3 of the noise over their unit.
        held = np.zeros((OTHERS, TOTAL))
        held[:, :OTHERS] = np.eye(OTHERS) * self.lin.noise / WIDEST
        self.whole = np.concatenate([self.jacobian, held])
        self.right = np.concatenate([self.residual, np.zeros(OTHERS)])


@pytest.fixture(params=[0, 1])
def example(request) -> Example:
    return Example(request.param)


def test_the_step_is_that_of_all_unknowns_together(example):
    expected = np.linalg.lstsq(example.whole, -example.right, rcond=None)[0]
    left = example.lin.eliminated()
    index = np.linalg.lstsq(left.r, -left.q, rcond=None)[0]
    # Well-conditioned sums of 120 products: rounding.
    np.testing.assert_allclose(index, expected[OTHERS:], rtol=1e-11)
    np.testing.assert_allclose(left.others(index), expected[:OTHERS], rtol=1e-11)


def test_damping_holds_the_others_back(example):
    held = np.zeros((OTHERS, TOTAL))
    norms = np.linalg.norm(example.whole, axis=0)[:OTHERS]
    held[:, :OTHERS] = np.diag(norms) * np.sqrt(0.7)
    rows = np.concatenate([example.whole, held])
    right = np.concatenate([example.right, np.zeros(OTHERS)])
    expected = np.linalg.lstsq(rows, -right, rcond=None)[0]
    left = example.lin.eliminated(0.7)
    index = np.linalg.lstsq(left.r, -left.q, rcond=None)[0]
    np.testing.assert_allclose(index, expected[OTHERS:], rtol=1e-11)
    np.testing.assert_allclose(left.others(index), expected[:OTHERS], rtol=1e-11)


@pytest.mark.parametrize("given", [True, False], ids=["noise given", "noise unknown"])
def test_the_spread_is_the_sandwich(example, given):
    variances = example.root**2 if given else example.residual**2
    # What is held has the noise that makes its error the widest.
    variances = np.append(variances, np.full(OTHERS, example.lin.noise**2))
    bread = np.linalg.inv(example.whole.T @ example.whole)
    expected = bread @ (example.whole * variances[:, None]).T @ example.whole @ bread
    inverse = np.linalg.inv(example.lin.r)
    meat = example.lin.white + example.lin.held if given else example.lin.meat
    np.testing.assert_allclose(inverse @ meat @ inverse.T, expected, rtol=1e-9, atol=1e-13)


def test_a_change_moves_picture_and_cost(example):
    change = np.random.default_rng(2).normal(size=TOTAL)
    moved = example.lin.moved(change)
    shift = (dense(example.columns) @ change).reshape(BLOCKS, CHANNELS)
    np.testing.assert_allclose(moved.picture, example.picture + shift, rtol=1e-12, atol=1e-13)
    whole = example.whole @ change + example.right  # with what holds the others
    np.testing.assert_allclose(moved.cost, np.sum(whole**2), rtol=1e-11)


def test_what_no_pixel_shows_keeps_the_widest_error():
    example = Example(3)
    values = example.columns.values.copy()
    values[..., 1] = 0.0
    columns = example.columns._replace(values=values)
    lin = linearise(example.picture, example.target, columns, example.weights, WIDEST)
    inverse = np.linalg.inv(lin.r)
    for meat in (lin.meat, 1e-6 * lin.white + lin.held):
        np.testing.assert_allclose((inverse @ meat @ inverse.T)[1, 1], WIDEST**2, rtol=1e-12)
    # And it stays where it is.
    left = lin.eliminated()
    assert left.others(np.zeros(3))[1] == 0.0


def test_what_weighs_nothing_does_not_count():
    example = Example(4)
    weights = np.where(np.arange(BLOCKS)[:, None] < 25, 1.0, 0.0)
    lin = linearise(example.picture, example.target, example.columns, weights, WIDEST)
    some = example.columns._replace(values=example.columns.values[:, :25])
    alone = linearise(example.picture[:25], example.target[:25], some, np.ones((25, 1)), WIDEST)
    assert abs(lin.noise / alone.noise - 1) < 1e-13
    np.testing.assert_allclose(np.abs(lin.q), np.abs(alone.q), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(lin.rms, np.sqrt(np.mean((example.picture - example.target) ** 2)))


def test_clipped_values_pull_by_their_likelihood():
    example = Example(5)
    where = np.random.default_rng(6).random((BLOCKS, CHANNELS)) < 0.3
    clipped = Clipped(where, example.target, 0.5)
    lin = linearise(
        example.picture, example.target, example.columns, example.weights, WIDEST, clipped
    )
    told = misfit(example.picture, example.target, clipped)
    jacobian = dense(example.columns)
    weights = np.broadcast_to(example.weights, where.shape).ravel()
    score = weights * told.score.ravel()
    information = (jacobian * (weights * told.curvature.ravel())[:, None]).T @ jacobian
    near = np.diag([(lin.noise / WIDEST) ** 2] * OTHERS + [0.0] * (TOTAL - OTHERS))
    # Sums of 120 products: rounding.
    np.testing.assert_allclose(lin.r.T @ lin.r, information + near, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(lin.r.T @ lin.q, jacobian.T @ score, rtol=1e-10, atol=1e-12)
    spread = (jacobian * (score**2)[:, None]).T @ jacobian
    meat = lin.r.T @ (lin.meat - lin.held) @ lin.r
    np.testing.assert_allclose(meat, spread, rtol=1e-9, atol=1e-11)
    # At a noise of 1 the spread of the score is the information, but for what weighs less.
    white = (jacobian * (weights**2 * told.curvature.ravel())[:, None]).T @ jacobian
    np.testing.assert_allclose(lin.r.T @ lin.white @ lin.r, white, rtol=1e-9, atol=1e-11)


def test_no_value_is_clipped_where_none_is_marked(example):
    nowhere = Clipped(np.zeros((BLOCKS, CHANNELS), bool), example.target, 0.1)
    fixed = example.picture, example.target, example.columns, example.weights, WIDEST
    for had, has in zip(example.lin, linearise(*fixed, nowhere), strict=True):
        if not isinstance(had, Columns):
            np.testing.assert_allclose(has, had, rtol=1e-12)


@pytest.mark.parametrize("robust", [Robust("huber", 0.4), Robust("tukey", 0.6)], ids=str)
def test_a_robust_step_and_its_spread_are_those_of_an_m_estimate(robust):
    example = Example(7)
    fixed = example.picture, example.target, example.columns, example.weights, WIDEST
    lin = linearise(*fixed, robust=robust)
    part, slope, height = robust.influence(example.residual.reshape(BLOCKS, CHANNELS))
    pulls = part.ravel() * example.residual
    of_index = np.max(np.abs(example.jacobian[:, OTHERS:]), axis=1) ** 2
    mean = np.average(slope.ravel(), weights=of_index)
    assert 0.1 < mean < 0.9  # some are outliers
    information = example.jacobian.T @ example.jacobian
    near = np.diag([(lin.noise / WIDEST) ** 2] * OTHERS + [0.0] * (TOTAL - OTHERS))
    # Sums of 120 products: rounding.
    np.testing.assert_allclose(lin.r.T @ lin.r, information + near, rtol=1e-10, atol=1e-11)
    right = example.jacobian.T @ pulls / mean
    np.testing.assert_allclose(lin.r.T @ lin.q, right, rtol=1e-10, atol=1e-11)
    spread = (example.jacobian * (pulls**2)[:, None]).T @ example.jacobian / mean**2
    meat = lin.r.T @ (lin.meat - lin.held) @ lin.r
    np.testing.assert_allclose(meat, spread, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(lin.cost, np.sum(height.ravel() * example.residual**2), rtol=1e-12)
    np.testing.assert_array_equal(lin.score, example.picture - example.target)


def test_pulls_are_the_slope_of_the_cost(example):
    lin = example.lin
    np.testing.assert_allclose(lin.pulled(lin.pulls), lin.q, rtol=1e-9, atol=1e-12)
    # One value alone, weighed.
    one = np.zeros((BLOCKS, CHANNELS))
    one[3, 1] = lin.pulls[3, 1]
    row = np.ravel_multi_index((3, 1), one.shape)
    expected = example.jacobian[row] * example.residual[row]
    np.testing.assert_allclose(lin.r.T @ lin.pulled(one), expected, rtol=1e-9, atol=1e-12)
