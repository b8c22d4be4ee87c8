import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import numbers

from diffdisp.vector import (
    Vec3,
    choose,
    inverse,
    inverse_root,
    least_square,
    normalize,
    root,
    safe_sqrt,
    vec3,
)

RNG = np.random.default_rng(0)
PAIRS = RNG.normal(size=(5, 2, 3))
EPS = np.finfo(np.float64).eps


@pytest.mark.parametrize("pair", PAIRS)
def test_operators_are_those_of_vectors(pair):
    a, b = vec3(jnp.asarray(pair[0])), vec3(jnp.asarray(pair[1]))
    np.testing.assert_array_equal(numbers(a + b), pair[0] + pair[1])
    np.testing.assert_array_equal(numbers(a - b), pair[0] - pair[1])
    np.testing.assert_array_equal(numbers(-a), -pair[0])
    np.testing.assert_array_equal(numbers(a * jnp.asarray(pair[1, 0])), pair[0] * pair[1, 0])


@pytest.mark.parametrize("pair", PAIRS)
def test_products_are_numpys(pair):
    a, b = vec3(jnp.asarray(pair[0])), vec3(jnp.asarray(pair[1]))
    # Sums of three products in another order: a few units in the last place of terms near 1.
    np.testing.assert_allclose(a.dot(b), np.dot(*pair), rtol=0, atol=8 * EPS)
    np.testing.assert_allclose(numbers(a.cross(b)), np.cross(*pair), rtol=0, atol=8 * EPS)


def test_cross_product_is_right_handed():
    x, y = vec3(jnp.array([1.0, 0, 0])), vec3(jnp.array([0, 1.0, 0]))
    np.testing.assert_array_equal(numbers(x.cross(y)), [0, 0, 1])


@pytest.mark.parametrize("length", [1e-100, 1e-3, 1.0, 1e100])
def test_a_normalized_vector_has_length_one(length):
    v = PAIRS[0, 0] * length
    unit = numbers(normalize(vec3(jnp.asarray(v))))
    # One root, one quotient, one product, each rounded once.
    np.testing.assert_allclose(np.linalg.norm(unit), 1.0, rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(np.cross(unit, v / length), 0, rtol=0, atol=8 * EPS)


def test_the_zero_vector_has_no_direction():
    assert np.isnan(numbers(normalize(vec3(jnp.zeros(3))))).all()


POWERS = [(inverse, -1.0), (root, 0.5), (inverse_root, -0.5)]


@pytest.mark.parametrize("order", range(4))
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize(("power_of", "power"), POWERS)
def test_powers_have_all_their_derivatives(power_of, power, mode, order):
    x = np.array([1e-3, 0.7, 40.0])
    slope = power_of
    for _ in range(order):
        slope = mode(slope)
    # d/dx of x^p is p x^(p - 1): a dozen products at most, each rounded once.
    true = np.prod(power - np.arange(order)) * x ** (power - order)
    np.testing.assert_allclose(jax.vmap(slope)(x), true, rtol=16 * EPS)


@pytest.mark.parametrize(("power_of", "power"), POWERS)
def test_a_power_and_its_derivatives_divide_once(power_of, power):
    def slopes(x):
        along = (jnp.ones_like(x),)
        return jax.jvp(lambda x: jax.jvp(power_of, (x,), along), (x,), along)

    compiled = jax.jit(slopes).lower(jnp.array(3.0)).compile().as_text()
    assert compiled.count(" divide(") == 1
    assert compiled.count(" sqrt(") == (0 if power == -1 else 1)


@pytest.mark.parametrize(
    ("x", "above", "value"),
    [(4.0, 0.0, 2.0), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (1e-21, 1e-20, 0.0), (4.0, 1.0, 2.0)],
)
def test_safe_root(x, above, value):
    assert safe_sqrt(jnp.array(x), above) == value


@pytest.mark.parametrize("x", [-np.inf, -1.0, -0.0, 0.0])
@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd])
def test_safe_root_is_flat_where_there_is_none(x, mode):
    assert mode(safe_sqrt)(jnp.array(x)) == 0


@pytest.mark.parametrize("x", [1e-20, 0.25, 9.0])
def test_slope_of_the_safe_root(x):
    # 1 / (2√x), one rounding for each operation.
    np.testing.assert_allclose(jax.grad(safe_sqrt)(jnp.array(x)), 0.5 / np.sqrt(x), rtol=4 * EPS)


def test_safe_root_of_nonsense_is_not_zero_but_infinite_or_nan():
    assert np.isinf(safe_sqrt(jnp.array(np.inf)))


@pytest.mark.parametrize(("x64", "largest"), [(True, 1e12), (False, 1e6)])
def test_slopes_at_the_least_square_stay_small(x64, largest):
    with jax.enable_x64(x64):
        least = least_square(jnp.zeros(()))
        slope = jax.grad(lambda x: safe_sqrt(x, least))(jnp.asarray(2.0 * least))
    assert 0 < slope < largest


def test_choose_takes_leaf_by_leaf():
    a, b = Vec3(*jnp.arange(3.0)), Vec3(*jnp.arange(3.0) + 10)
    assert choose(True, a, b) is a
    assert choose(False, a, b) is b
    picked = jax.vmap(lambda c: choose(c, a, b))(jnp.array([True, False]))
    np.testing.assert_array_equal(numbers(picked), [[0, 1, 2], [10, 11, 12]])
