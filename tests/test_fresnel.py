import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import N_D, numbers, reflectance
from jax.test_util import check_grads

from diffdisp.fresnel import cos_transmitted, fresnel_reflectance, reflection, refraction
from diffdisp.glasses import named_glass
from diffdisp.vector import vec3

CRITICAL = float(np.sqrt((N_D - 1.0) * (N_D + 1.0)) / N_D)  # cosine, from the glass into air
SPECIAL = [0.0, 1e-9, 0.3, np.nextafter(CRITICAL, 0), CRITICAL, np.nextafter(CRITICAL, 1), 0.9, 1.0]
ANGLES = np.linspace(0.01, np.pi / 2 - 0.01, 23)
INDICES = [1.0003, 1.3334, N_D, 1.78472, 2.4175]


@jax.jit
def surface(cos_i, eta):
    """Reflectance and cosine of the refracted ray."""
    cos_t = cos_transmitted(cos_i, eta)
    return fresnel_reflectance(cos_i, cos_t, eta), cos_t


def made_of(weights, direction, normal):
    """A direction by its weights."""
    return direction * weights[0] + normal * weights[1]


def both(angles, eta):
    """`surface` at many angles."""
    return jax.vmap(surface, (0, None))(jnp.cos(angles), jnp.asarray(eta))


@pytest.mark.parametrize(
    ("glass", "percent"), [("N-BK7", 4.2165), ("N-SF11", 7.9408), ("diamond", 17.2038)]
)
def test_normal_reflectance(glass, percent):
    R, _ = surface(jnp.array(1.0), named_glass(glass).n_d)
    np.testing.assert_allclose(100 * R, percent, rtol=0, atol=5.1e-5)  # the printed digits


def test_brewster_angle():
    brewster = np.arctan(N_D)
    np.testing.assert_allclose(
        np.degrees(brewster), 56.6038, rtol=0, atol=5.1e-5
    )  # the printed digits
    R, cos_t = surface(jnp.cos(brewster), jnp.array(N_D))
    # p-polarised light is not reflected, and reflected and refracted ray are at right angles.
    s = ((1 - N_D**2) / (1 + N_D**2)) ** 2
    np.testing.assert_allclose(R, 0.5 * s, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.arccos(cos_t), np.pi / 2 - brewster, rtol=0, atol=1e-15)


@pytest.mark.parametrize("n", INDICES)
def test_reflectance_in_sines_and_tangents(n):
    # Near normal incidence the sines of differences lose a few digits.
    np.testing.assert_allclose(both(ANGLES, n)[0], reflectance(ANGLES, n), rtol=0, atol=1e-13)


@pytest.mark.parametrize("n", INDICES)
def test_reflection_and_transmission_add_up(n):
    R, cos_t = both(ANGLES, n)
    cos_i = np.cos(ANGLES)
    s = 2 * cos_i / (cos_i + n * cos_t)
    p = 2 * cos_i / (n * cos_i + cos_t)
    T = n * cos_t / cos_i * 0.5 * (s**2 + p**2)
    np.testing.assert_allclose(
        R + T, 1.0, rtol=0, atol=1e-14
    )  # some 30 roundings of numbers up to 1


@pytest.mark.parametrize("n", INDICES)
def test_reflectance_is_the_same_from_behind(n):
    R, cos_t = both(ANGLES, n)
    back, cos_i = jax.vmap(surface, (0, None))(cos_t, jnp.asarray(1 / n))
    # Rounding of cos_t weighs by n·cos_t/cos_i, at most 220 here, and by R's slope, at most 10.
    np.testing.assert_allclose(back, R, rtol=0, atol=5e-13)
    np.testing.assert_allclose(cos_i, np.cos(ANGLES), rtol=0, atol=1e-13)


@pytest.mark.parametrize("n", INDICES)
def test_total_reflection_begins_at_the_critical_angle(n):
    critical = np.arcsin(1 / n)
    beyond, before = critical * (1 + 1e-6), critical * (1 - 1e-6)
    R, cos_t = both(np.array([before, beyond, np.pi / 2]), 1 / n)
    assert R[0] < 1
    assert cos_t[0] > 0
    np.testing.assert_array_equal(R[1:], 1)
    np.testing.assert_array_equal(cos_t[1:], 0)


def test_equal_media_reflect_nothing():
    np.testing.assert_array_equal(both(ANGLES, 1.0)[0], 0)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.1, 1.5])
@pytest.mark.parametrize("eta", [N_D, 1 / N_D])
def test_directions_obey_the_laws(angle, eta):
    direction = vec3(jnp.array([np.sin(angle), 0, -np.cos(angle)]))
    normal = vec3(jnp.array([0, 0, 1.0]))
    cos_i = jnp.cos(angle)
    mirrored = numbers(made_of(reflection(cos_i), direction, normal))
    np.testing.assert_allclose(mirrored, [np.sin(angle), 0, np.cos(angle)], rtol=0, atol=1e-15)
    cos_t = cos_transmitted(cos_i, jnp.asarray(eta))
    if cos_t == 0:
        assert np.sin(angle) / eta > 1
        return
    weights = refraction(cos_i, cos_t, jnp.asarray(eta))
    bent = numbers(made_of(weights, direction, normal))
    sin_t = np.sin(angle) / eta
    np.testing.assert_allclose(bent, [sin_t, 0, -np.sqrt(1 - sin_t**2)], rtol=0, atol=1e-14)


@pytest.mark.parametrize("seed", range(3))
def test_a_refracted_path_is_reversible(seed):
    normal, direction = np.random.default_rng(seed).normal(size=(2, 3))
    normal, direction = normal / np.linalg.norm(normal), direction / np.linalg.norm(direction)
    direction = direction if direction @ normal < 0 else -direction
    n, eta, back = vec3(jnp.asarray(normal)), jnp.array(N_D), jnp.array(1 / N_D)
    cos_i = jnp.asarray(-direction @ normal)
    cos_t = cos_transmitted(cos_i, eta)
    bent = made_of(refraction(cos_i, cos_t, eta), vec3(jnp.asarray(direction)), n)
    back_weights = refraction(cos_t, cos_transmitted(cos_t, back), back)
    again = made_of(back_weights, -bent, -n)
    # Back from the denser side errors grow by n·cos_t / cos_i, below 50 for these seeds.
    np.testing.assert_allclose(numbers(again), -direction, rtol=0, atol=1e-13)


@pytest.mark.parametrize("cos_i", SPECIAL)
@pytest.mark.parametrize("eta", [N_D, 1 / N_D, 1.0])
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_value_and_gradient_are_finite_everywhere(cos_i, eta, mode):
    arguments = jnp.array(cos_i), jnp.array(eta)
    R, cos_t = surface(*arguments)
    assert 0 <= R <= 1
    assert 0 <= cos_t <= 1
    slopes = mode(surface, argnums=(0, 1))(*arguments)
    assert all(jnp.isfinite(slope) for slope in jax.tree.leaves(slopes))


@pytest.mark.parametrize("cos_i", [0.2, 0.55, 0.95])
def test_gradients_are_right(cos_i):
    check_grads(surface, (jnp.array(cos_i), jnp.array(N_D)), order=2, modes=["fwd", "rev"])


def test_float32_keeps_its_digits_at_grazing_incidence():
    cos_i = np.float32(np.geomspace(1e-4, 0.1, 200))
    for eta in (np.float32(N_D), np.float32(1.0003)):
        truth = jax.vmap(surface, (0, None))(jnp.asarray(cos_i, float), jnp.asarray(eta, float))
        with jax.enable_x64(False):
            found = jax.vmap(surface, (0, None))(jnp.asarray(cos_i), jnp.asarray(eta))
        assert found[0].dtype == np.float32
        # Ten units in the last place; the usual form of cos_t is wrong by 1.7e-4 here.
        np.testing.assert_allclose(found[1], truth[1], rtol=6e-7)
        np.testing.assert_allclose(found[0], truth[0], rtol=0, atol=6e-7)
