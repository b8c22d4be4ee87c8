"""Against the laws of likelihoods, with integrals over the noise."""

import jax
import numpy as np
import pytest
from jax.scipy.stats import norm

from diffdisp.misfit import Clipped, Robust, misfit

SIGMA, LEAST = 0.02, 0.9
RENDERS = LEAST + SIGMA * np.array([-3.0, -1.0, -0.2, 0.0, 0.3, 1.0, 3.0])


def values(array):
    """As the channels of one block."""
    return np.atleast_1d(np.asarray(array, float))[None]


def of(render, target, where, noise=SIGMA):
    """What a render misses: a Misfit of (values,)."""
    render, target, where = np.broadcast_arrays(values(render), values(target), where)
    clipped = Clipped(where, np.full(where.shape, LEAST), noise)
    return [part[0] for part in misfit(render, target, clipped)]


def test_ordinary_values_are_squares():
    score, residual, curvature, cost = of([0.3, 0.5], [0.1, 0.9], False)
    np.testing.assert_array_equal(score, residual)
    np.testing.assert_allclose(residual, [0.2, -0.4], rtol=1e-14)
    np.testing.assert_array_equal(curvature, 1.0)
    np.testing.assert_allclose(cost, residual**2, rtol=1e-15)


@pytest.mark.parametrize("render", RENDERS)
def test_slope_and_curvature_are_those_of_the_probability(render):
    def cost(x):
        return -2 * SIGMA**2 * norm.logcdf((x - LEAST) / SIGMA)

    score, residual, curvature, height = of(render, 1.0, True)
    # One formula against automatic derivatives of another: rounding, where nothing cancels much.
    np.testing.assert_allclose(height, cost(render), rtol=1e-12)
    np.testing.assert_allclose(score, jax.grad(cost)(render) / 2, rtol=1e-10)
    np.testing.assert_allclose(curvature, jax.hessian(cost)(render) / 2, rtol=1e-8)
    np.testing.assert_allclose(curvature * residual, score, rtol=1e-12)


def expected(what, render):
    """The mean of what a value of true radiance `render` says of it, over the noise."""
    noise = np.linspace(-9, 9, 20001)
    seen = render + SIGMA * noise
    told = what(*of(render, np.minimum(seen, LEAST), seen >= LEAST))
    return np.sum(told * np.exp(-(noise**2) / 2)) * (noise[1] - noise[0]) / np.sqrt(2 * np.pi)


@pytest.mark.parametrize("render", RENDERS)
def test_a_true_render_is_pulled_nowhere(render):
    # The bound falls between points of the sum: 1e-3 · σ of a jump of σ at most.
    assert abs(expected(lambda score, *_: score, render)) < 1e-3 * SIGMA
    # And the spread of the pull is the information: so errors come out right.
    spread = expected(lambda score, *_: score**2, render)
    known = expected(lambda score, residual, curvature, cost: curvature, render)
    np.testing.assert_allclose(spread, SIGMA**2 * known, rtol=2e-3)


@pytest.mark.parametrize("noise", [1e-12, 1e-5, 0.02])
def test_far_from_the_bound_it_is_a_bound(noise):
    render = LEAST + np.array([-0.8, -51.0 * noise, -49.0 * noise, 0.5, 90.0])
    score, residual, curvature, cost = of(render, 1.0, True, noise)
    assert np.all(np.isfinite([score, residual, curvature, cost]))
    # Below, by at least 40 sigma here, it is an ordinary value but for one part in the square of
    # that; above nothing is wrong with it.
    np.testing.assert_allclose(score[:3], (render - LEAST)[:3], rtol=1.1 / 40**2)
    np.testing.assert_allclose(curvature[:3], 1.0, rtol=1.1 / 40**2)
    assert np.all(np.abs(score[3:]) < 1e-100)
    np.testing.assert_array_equal(curvature[3:] < 1e-100, True)


KINDS = ["huber", "tukey"]


def pull(kind, misfits):
    """ψ(u), ψ'(u) and 2 ρ(u) of misfits at a spread of 1."""
    part, slope, height = Robust(kind, 1.0).influence(values(misfits))
    return part[0] * misfits, slope[0], height[0] * misfits**2


@pytest.mark.parametrize("kind", KINDS)
def test_pulls_are_slopes_of_the_loss(kind):
    u, h = np.concatenate([-np.geomspace(0.01, 60, 40), np.geomspace(0.01, 60, 40)]), 1e-5
    ahead, behind = pull(kind, u + h), pull(kind, u - h)
    psi, slope, _ = pull(kind, u)
    # Central differences: h² = 1e-10 of the third derivative, rounding of 60² · 1e-16 / h.
    np.testing.assert_allclose((ahead[2] - behind[2]) / (4 * h), psi, atol=3e-8)
    np.testing.assert_allclose((ahead[0] - behind[0]) / (2 * h), slope, atol=3e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_normal_noise_costs_a_twentieth(kind):
    u = np.linspace(-9, 9, 20001)
    density = np.exp(-(u**2) / 2) / np.sum(np.exp(-(u**2) / 2))
    psi, slope, _ = pull(kind, u)
    efficiency = np.sum(slope * density) ** 2 / np.sum(psi**2 * density)
    # The constants of Holland and Welsch are rounded to three decimals.
    assert efficiency == pytest.approx(0.95, abs=1e-3)


def test_what_is_far_off():
    far = np.array([1e3, -1e6])
    np.testing.assert_allclose(pull("huber", far)[0], [1.345, -1.345], rtol=1e-12)
    np.testing.assert_array_equal(pull("tukey", far)[0], 0.0)
    np.testing.assert_allclose(pull("tukey", far)[2], 4.685**2 / 3, rtol=1e-12)
