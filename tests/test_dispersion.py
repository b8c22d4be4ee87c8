import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from diffdisp.dispersion import Sellmeier, domain_error
from diffdisp.glasses import named_glass

BK7_B = np.array([1.03961212, 0.231792344, 1.01046945])
BK7_C = np.array([0.00600069867, 0.0200179144, 103.560653])
BK7 = Sellmeier(BK7_B, BK7_C)  # Source: Schott data sheet N-BK7
AIR = Sellmeier(np.zeros(3), np.zeros(3))


@pytest.mark.parametrize(
    ("wavelength", "n"),
    [  # Source: Schott data sheet N-BK7, lines i, h, g, F', F, e, d, C', C, r, s, t
        (0.3650146, 1.53627),
        (0.4046561, 1.53024),
        (0.4358343, 1.52668),
        (0.4799914, 1.52283),
        (0.4861327, 1.52238),
        (0.5460740, 1.51872),
        (0.5875618, 1.51680),
        (0.6438469, 1.51472),
        (0.6562725, 1.51432),
        (0.7065188, 1.51289),
        (0.8521100, 1.50980),
        (1.0139800, 1.50731),
    ],
)
def test_index_at_published_lines(wavelength, n):
    found = BK7.refractive_index(np.asarray(wavelength))
    np.testing.assert_allclose(found, n, rtol=0, atol=5.5e-6)  # the printed digits


@pytest.mark.parametrize(
    ("glass", "n_d", "V_d", "P_gF"),
    [  # Source: DESIGN section 9; P_gF of the Schott and Heraeus data sheets
        ("N-BK7", 1.516800, 64.167, 0.5349),
        ("N-SF11", 1.784720, 25.680, 0.6156),
        ("N-BAF10", 1.670030, 47.112, 0.5629),
        ("fused silica", 1.458464, 67.821, None),
    ],
)
def test_catalogue_numbers(glass, n_d, V_d, P_gF):
    found = named_glass(glass)
    np.testing.assert_allclose(found.n_d, n_d, rtol=0, atol=6e-7)  # the printed digits, as below
    np.testing.assert_allclose(found.V_d, V_d, rtol=0, atol=6e-4)
    if P_gF:
        np.testing.assert_allclose(found.P_gF, P_gF, rtol=0, atol=6e-5)


def test_a_vacuum_has_index_one_everywhere():
    np.testing.assert_array_equal(AIR.indices(np.array([0.1, 0.5, 5.0])), 1.0)
    assert np.isinf(AIR.V_d) or np.isnan(AIR.V_d)


def test_many_glasses_are_one_glass_mapped():
    B, C = np.stack([BK7_B, 2 * BK7_B]), np.stack([BK7_C, BK7_C])
    many = jax.vmap(lambda b, c: Sellmeier(b, c).n_d)(jnp.asarray(B), jnp.asarray(C))
    single = [float(Sellmeier(b, c).n_d) for b, c in zip(B, C, strict=True)]
    np.testing.assert_allclose(many, single, rtol=1e-15)


def test_index_on_and_next_to_a_resonance():
    assert np.isinf(Sellmeier([1.0, 0, 0], [0.25, 0, 0]).refractive_index(jnp.array(0.5)))
    assert np.isnan(BK7.refractive_index(jnp.array(0.14)))


@pytest.mark.parametrize("wavelength", [0.31, 0.5876, 2.3])
def test_derivatives_by_hand(wavelength):
    def index(B, C):
        return Sellmeier(B, C).refractive_index(jnp.asarray(wavelength))

    by_B, by_C = jax.grad(index, argnums=(0, 1))(jnp.asarray(BK7_B), jnp.asarray(BK7_C))
    squared, n = wavelength**2, float(BK7.refractive_index(np.asarray(wavelength)))
    # A dozen roundings.
    np.testing.assert_allclose(by_B, squared / (squared - BK7_C) / (2 * n), rtol=1e-14)
    expected = BK7_B * squared / (squared - BK7_C) ** 2 / (2 * n)
    np.testing.assert_allclose(by_C, expected, rtol=1e-14)


def test_gradients_of_the_abbe_number():
    def abbe(B, C):
        return Sellmeier(B, C).V_d

    # A step of 1e-6 moves the smallest C, 0.006, by 2e-4 of it; differences keep seven digits.
    arguments = jnp.asarray(BK7_B), jnp.asarray(BK7_C)
    check_grads(jax.jit(abbe), arguments, order=1, eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("edge", [0.2, 0.3, 0.4, 0.41, 0.5, 0.55, 0.7])
def test_a_pole_on_an_edge_is_within(edge):
    squared = float(f"{edge**2:.6g}")  # as a user writes it: 0.04 for an edge of 0.2
    for c in (squared, edge**2):
        glass = Sellmeier([1.0, 0, 0], [c, 0, 0])
        assert "pole" in domain_error(glass, edge, 0.8)
        assert "pole" in domain_error(glass, 0.1, edge)


@pytest.mark.parametrize("pole", [0.3799, 0.7801, 0.1, 10.0])
def test_a_pole_outside_is_no_matter(pole):
    # B so small that n² > 0 right up to the pole.
    assert domain_error(Sellmeier([1e-9, 0, 0], [pole**2, 0, 0]), 0.38, 0.78) is None


@pytest.mark.parametrize("pole", [0.38000001, 0.5, 0.77999999])
def test_a_weak_pole_inside_is_found(pole):
    assert "pole" in domain_error(Sellmeier([1e-30, 0, 0], [pole**2, 0, 0]), 0.38, 0.78)


@pytest.mark.parametrize(
    ("low", "high"), [(0.135, 0.14), (9.0, 9.5), (0.5, 9.5), (9.5, 9.5)], ids=str
)
def test_a_range_without_index_is_found(low, high):
    # BK7's poles are at 77, 141 and 10 177 nm; n² < 0 just below each.
    assert "n² ≤ 0" in domain_error(BK7, low, high)


def test_n_squared_of_zero_is_no_index():
    assert "n² ≤ 0" in domain_error(Sellmeier([-1.0, 0, 0], [0, 0, 0]), 0.4, 0.7)


@pytest.mark.parametrize("glass", [BK7, AIR, Sellmeier([0, 0, 0], [0.25, 0.3, 0.2])])
def test_a_glass_with_an_index_has_no_error(glass):
    assert domain_error(glass, 0.38, 0.78) is None


def test_negative_C_has_no_pole():
    assert domain_error(Sellmeier([1.0, 0, 0], [-0.25, 0, 0]), 0.38, 0.78) is None


def test_a_term_without_strength_has_no_pole():
    glass = Sellmeier([0.0, 0.5, 0.0], [0.25, 0.0, 0.0])
    on_its_pole = np.array([0.5])
    np.testing.assert_allclose(glass.indices(on_its_pole), np.sqrt(1.5))
    slopes = jax.grad(lambda glass: glass.refractive_index(jnp.asarray(0.5)))(
        jax.tree.map(jnp.asarray, glass)
    )
    assert all(np.isfinite(leaf).all() for leaf in (slopes.B, slopes.C))
