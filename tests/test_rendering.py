import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    AIR,
    BK7,
    N_D,
    ORIGIN,
    WHITE,
    ball,
    bench,
    camera,
    furnace,
    glass_of_index,
    incidence_on_unit_ball,
    lamp,
    part_in_unit_ball,
    reflectance,
    screen,
    whole_samples,
)

from diffdisp import chunks, integrator, rendering
from diffdisp.camera import Camera
from diffdisp.dispersion import Sellmeier
from diffdisp.film import Film
from diffdisp.geometry import Plane, Sphere
from diffdisp.material import Dielectric, Emitter
from diffdisp.rendering import render, render_progressively
from diffdisp.scene import Background, Object, Scene, with_glass
from diffdisp.texture import Checker2D

BANDS = Film(12, 10, wavelengths=[0.45, 0.65])
COLOR = Film(12, 10)
BANDS_SHAPE = (10, 12, 2)
FEW = {"samples": 4, "depth": 6}


def known_furnace(incidence, n, orders):
    """1 - (1 - R) Rᴺ where the ball is seen, 1 beside it."""
    R = reflectance(np.where(np.isnan(incidence), 0.5, incidence), n)
    return np.where(np.isnan(incidence), 1.0, 1 - (1 - R) * R**orders)


# --- one ball, closed forms


@pytest.mark.parametrize(
    ("dtype", "depth", "tolerance"),
    [("float64", depth, 1e-12) for depth in (2, 3, 5, 50)]
    + [("float32", depth, 1e-5) for depth in (3, 50)],
)
def test_white_furnace_is_its_truncated_sum(dtype, depth, tolerance):
    # A path of `depth` segments: the outer reflection and `depth` - 2 orders from within.
    # A ray's 1e-16 of rounding is divided by cos i > 0.05 at the outermost of these pixels.
    picture = render(furnace(ball(BK7)), BANDS, samples=1, depth=depth, dtype=dtype)
    incidence = incidence_on_unit_ball(BANDS, 4.0, 34.0)
    whole = whole_samples(BANDS, 1, 4.0, 34.0)
    for band, n in enumerate(BK7.indices(BANDS.wavelengths)):
        expected = known_furnace(incidence, n, depth - 2)[whole]
        np.testing.assert_allclose(picture[whole, band], expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-12), ("float32", 1e-5)])
def test_a_ball_of_index_one_is_gone(dtype, tolerance):
    # Nothing is reflected, so that three segments are all.
    picture = render(furnace(ball(AIR)), BANDS, samples=4, depth=3, dtype=dtype)
    np.testing.assert_allclose(picture, 1, rtol=0, atol=tolerance)  # rounding


@pytest.mark.parametrize("samples", [32, 64, 96])
def test_glass_alone_is_white_in_every_pass(samples):
    # A pass takes 32 samples at most; light that a ball does not absorb is white at any number.
    scene = furnace(ball(BK7))
    for growing in render_progressively(scene, COLOR, samples=samples, depth=50, dtype="float64"):
        mean = growing.radiance.mean(axis=(0, 1))
        np.testing.assert_allclose(mean, 1, rtol=0, atol=5e-3)  # pixels partly on glass


def test_a_ball_of_index_one_hides_nothing():
    film = Film(12, 10, wavelengths=[0.55])
    scene = bench(AIR)
    behind = Scene(scene.camera, scene.objects[1:])
    picture, plain = (render(s, film, samples=4, depth=3) for s in (scene, behind))
    # The footprint through the ball is the one beside it; rounding at a distance of 7.
    whole = whole_samples(film, 2, 4.0, 34.0)
    np.testing.assert_allclose(picture[whole], plain[whole], rtol=0, atol=1e-12)
    # Two pieces of a footprint see the borders within it a little otherwise.
    np.testing.assert_allclose(picture, plain, rtol=0, atol=0.03)


def test_depth_of_one_shows_no_glass():
    picture = render(furnace(ball(BK7)), BANDS, samples=1, depth=1)
    missed = 1 - part_in_unit_ball(BANDS, 4.0, 34.0)
    for band in (0, 1):
        # An outline counts as straight within a sample, here a pixel.
        np.testing.assert_allclose(picture[..., band], missed, rtol=0, atol=1e-2)
        assert abs(picture[..., band].mean() - missed.mean()) < 1e-3


def test_a_lamp_within_a_ball_looks_larger_by_the_index():
    # All chords of a ray pass the centre at b/n; where that is within the lamp, 1 - R is seen.
    size, film = 0.3, Film(24, 24, wavelengths=[0.55])
    scene = Scene(camera(), (ball(N_D), lamp(ORIGIN, size)))
    incidence = incidence_on_unit_ball(film, 4.0, 34.0)
    expected = np.where(np.sin(incidence) < N_D * size, 1 - reflectance(incidence, N_D), 0)
    picture = render(scene, film, samples=1, depth=20)
    np.testing.assert_allclose(picture[..., 0], expected, rtol=0, atol=1e-12)  # rounding


def test_a_screen_through_the_centre_of_a_ball():
    # Refracted light ends on the screen within the ball. A ray off axis by α, mirrored, travels
    # on at α + π - 2i to the axis, and meets the screen outside if that is below a right angle.
    film = Film(24, 24, wavelengths=[0.55])
    white = screen(z=0.0, even=1.0, odd=1.0)
    incidence = incidence_on_unit_ball(film, 4.0, 34.0)
    R = reflectance(incidence, N_D)
    travels = np.arcsin(np.sin(incidence) / 4.0) + np.pi - 2.0 * incidence
    expected = np.where(np.isnan(incidence), 1, np.where(travels < np.pi / 2, 1, 1 - R))
    picture = render(Scene(camera(), (ball(N_D), white)), film, samples=1, depth=20)
    np.testing.assert_allclose(picture[..., 0], expected, rtol=0, atol=1e-12)  # rounding


def test_a_camera_in_the_centre_sees_straight_out():
    # Light leaves at normal incidence: (1 - R) (1 + R² + ...) of what lies before, and
    # R (1 - R) (1 + R² + ...) of what lies behind.
    R = ((N_D - 1) / (N_D + 1)) ** 2
    before, behind = lamp((0, 0, -30), 20, WHITE), lamp((0, 0, 30), 20, [0.5] * 3)
    scene = Scene(Camera(ORIGIN, [0, 0, -1], vertical_fov=20.0), (ball(N_D), before, behind))
    picture = render(scene, Film(4, 4, wavelengths=[0.55]), samples=1, depth=30)
    np.testing.assert_allclose(picture, (1 + 0.5 * R) / (1 + R), rtol=0, atol=1e-12)  # rounding


def test_a_camera_near_the_surface_sees_out_through_the_critical_cone_only():
    # Basic radiance: 1 within the cone n |x × d| < 1. Beyond it light is trapped.
    look_from, film = np.array([0.0, 0.0, 0.9]), Film(24, 24, wavelengths=[0.55])
    white = lamp((0, 0, -30), 20), lamp((0, 0, 30), 20)
    scene = furnace(ball(N_D), *white, look_from=look_from, vertical_fov=120.0)
    picture = render(scene, film, samples=1, depth=200)[..., 0]
    pixel = 2 * np.tan(np.radians(60)) / 24
    off_axis = np.hypot(*np.meshgrid(*[(np.arange(24) - 11.5) * pixel] * 2))
    sine = N_D * look_from[2] * off_axis / np.hypot(off_axis, 1)
    assert (sine > 1).any()
    np.testing.assert_array_equal(picture[sine > 1], 0)
    # Next to the critical angle R is 0.85 at most in these pixels: Rᴺ is rounding.
    np.testing.assert_allclose(picture[sine < 1], 1, rtol=0, atol=1e-12)


# --- several balls, and whatever is within them, in a furnace

SF11 = Sellmeier([1.73759695, 0.313747346, 1.89878101], [0.013188707, 0.0623068142, 155.23629])
FAR = (lamp((0, 9, 0), 1), screen(z=-20.0, even=1.0, odd=1.0))
SEPARATE = {
    "apart": (ball(BK7, (-1.1, 0, 0)), ball(SF11, (1.1, 0, -0.3)), *FAR),
    "one behind the other": (ball(BK7, (0, 0, 0)), ball(SF11, (0, 0, -2.5)), *FAR),
}
NESTED = {
    "touching": (ball(BK7, (-1, 0, 0)), ball(SF11, (1, 0, 0)), *FAR),
    "bubble": (ball(BK7), ball(AIR, (0.25, 0.2, 0.1), 0.4), *FAR),
    "bubble first": (ball(AIR, (0.25, 0.2, 0.1), 0.4), ball(BK7), *FAR),
    "bubble touching the surface": (ball(BK7), ball(AIR, (0, 0, 0.6), 0.4), *FAR),
    "overlap of one glass": (ball(BK7, (-0.5, 0, 0)), ball(BK7, (0.5, 0, 0)), *FAR),
    "overlap of two": (ball(BK7), ball(SF11, (0, 0.9, 0.2), 0.5), *FAR),
    "the same ball twice": (ball(BK7), ball(BK7), *FAR),
    "lamp in the glass": (ball(BK7), ball(SF11, (0, 0, 0.5), 0.4), lamp((0, -0.4, 0), 0.3), FAR[1]),
    "lamp in a bubble": (ball(BK7), ball(AIR, (0, 0, 0.5), 0.4), lamp((0, 0, 0.5), 0.3), FAR[1]),
    "lamp across": (ball(BK7), ball(AIR, (0, 0, 0.5), 0.4), lamp((1, 0, 0), 0.3), FAR[1]),
    "lamp around": (ball(BK7), ball(SF11, (0, 0.3, 0), 0.5), lamp((0, 0, 0), 3.5), FAR[1]),
    "screen across": (ball(BK7), ball(SF11, (0, 0, 0.3), 0.5), FAR[0], screen(-0.4, 0.5, 1, 1)),
}


def check_energy(picture, least_mean):
    """Every path adds what it has spent: 1 less what its truncated end still carries."""
    assert picture.max() <= 1 + 1e-12  # rounding
    assert picture.min() > 0.5
    assert picture.mean() > least_mean


@pytest.mark.parametrize("name", SEPARATE)
def test_balls_apart_in_a_white_furnace(name):
    picture = render(furnace(*SEPARATE[name]), BANDS, samples=4, depth=50)
    # Paths go on between the balls with a probability of at most the larger R, so that hardly
    # one in a million is still under way.
    check_energy(picture, 1 - 1e-6)


@pytest.mark.parametrize("name", NESTED)
def test_nested_balls_in_a_white_furnace(name):
    picture = render(furnace(*NESTED[name]), BANDS, samples=4, depth=50)
    # Within a bubbly ball light can be trapped: a few paths in a thousand do not come to an end.
    check_energy(picture, 1 - 5e-3)


@pytest.mark.parametrize("look_from", [(0.3, 0.25, 0.2), (0.0, -0.35, 0.1)])
@pytest.mark.parametrize("name", ["bubble", "overlap of two", "lamp in a bubble", "screen across"])
def test_a_camera_within_glass_in_a_white_furnace(name, look_from):
    scene = furnace(*NESTED[name], look_from=look_from, vertical_fov=90.0)
    # Nearer to the centre than 1/n no chord is beyond the critical angle of the outer ball.
    check_energy(render(scene, BANDS, samples=4, depth=50), 0.995)


def test_the_order_of_the_objects_does_not_matter():
    checkered = lamp((0, 9, 0), 1), screen(z=-20.0, tile=1.0, even=0.1, odd=1.0)
    one, other = (
        render(furnace(*NESTED[name][:2], *checkered, color=(0.2,) * 3), BANDS, samples=4, depth=50)
        for name in ("bubble", "bubble first")
    )
    # Sums in another order, magnified at each surface.
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


def test_a_lamp_in_a_bubble_in_the_centre_looks_as_large_as_it_is():
    # n |x × d| is conserved: in the bubble every chord passes the centre at b again. Of the ball's
    # index or the bubble's, the surrounding one must be taken each time.
    size, dark = 0.42, screen(z=-20.0, even=0.0, odd=0.0)
    objects = ball(BK7), ball(AIR, radius=0.6), lamp(ORIGIN, size), dark
    scene = furnace(*objects, color=(0.0, 0.0, 0.0))
    picture = render(scene, Film(12, 10, wavelengths=[0.45, 0.65]), samples=4, depth=50)
    seen = np.nan_to_num(np.sin(incidence_on_unit_ball(BANDS, 4.0, 34.0)), nan=2.0)
    pixel = 4.0 * 2.0 * np.tan(np.radians(17.0)) / 10  # width of a pixel at the ball
    np.testing.assert_array_equal(picture[seen > size + pixel], 0)
    # What the ball and the bubble reflect is lost, some 5 % at each of three surfaces.
    assert picture[seen < size - 0.71 * pixel].min() > 0.8


@pytest.mark.parametrize("n", [BK7, SF11])
def test_a_ball_within_a_ball_of_the_same_glass_is_invisible(n):
    objects = bench(n).objects
    for center, radius in (((0, 0, 0), 0.5), ((0.2, -0.3, 0.1), 0.6)):
        scene = Scene(camera(), (*objects, ball(n, center, radius)))
        picture = render(scene, BANDS, samples=4, depth=60)
        # Rounding at each surface, magnified by up to 1e4 near the critical edge of the ball.
        plain = render(bench(n), BANDS, samples=4, depth=60)
        # Of balls within each other no outline cuts a sample in two.
        whole = whole_samples(BANDS, 2, 4.0, 34.0)
        np.testing.assert_allclose(picture[whole], plain[whole], rtol=0, atol=1e-9)


# --- colour, bands and the shape of the picture


def test_a_white_furnace_is_white_in_colour():
    picture = render(furnace(ball(BK7), vertical_fov=16.0), COLOR, samples=4, depth=50)
    # Negative lobes and all, a pixel's weights sum to 1; the truncation is 1e-16 of that.
    np.testing.assert_allclose(picture, 1, rtol=0, atol=1e-6)


def test_pixels_half_on_glass_are_nearly_white():
    picture = render(furnace(ball(BK7)), COLOR, samples=4, depth=50)
    seen = incidence_on_unit_ball(COLOR, 4.0, 34.0)
    np.testing.assert_allclose(picture[~np.isnan(seen)].mean(axis=0), 1, rtol=0, atol=0.02)
    np.testing.assert_array_equal(picture[0, 0], 1)


@pytest.mark.parametrize("color", [(1.0, 1.0, 1.0), (0.8, 0.3, 0.05), (0.0, 0.0, 2.5)])
def test_a_colour_fills_a_colour_film(color):
    wall = Object(Plane([0, 0, -1], [0, 0, 1]), Emitter(color))
    picture = render(Scene(camera(), (wall,)), COLOR, samples=4)
    np.testing.assert_allclose(picture, np.broadcast_to(color, picture.shape), rtol=0, atol=1e-14)
    background = render(Scene(camera(), (), Background(color)), COLOR, samples=4)
    np.testing.assert_allclose(background, picture, rtol=0, atol=1e-14)  # a mean of four


def test_bands_of_a_grey_scene_are_grey():
    # The basis sums to 1 at each wavelength, to rounding.
    picture = render(bench(glass_of_index(N_D)), BANDS, **FEW)
    np.testing.assert_allclose(picture[..., 0], picture[..., 1], rtol=0, atol=1e-14)
    same = render(bench(), Film(12, 10, wavelengths=[0.55, 0.55]), **FEW)
    np.testing.assert_array_equal(same[..., 0], same[..., 1])


def test_bands_of_a_glassless_grey_scene_show_its_grey():
    scene = furnace(lamp(ORIGIN, 1.0, [0.25] * 3), color=[0.25] * 3)
    film = Film(12, 10, wavelengths=[0.3, 0.55, 0.9])
    np.testing.assert_allclose(render(scene, film, samples=4), 0.25, rtol=0, atol=1e-14)  # as above


def test_row_zero_is_on_top_and_x_runs_to_the_right():
    scene = Scene(camera(), (lamp((0.6, 0.4, 0), 0.15, [1.0, 0.2, 0.0]),))
    picture = render(scene, Film(40, 20), samples=4)
    row, column = np.unravel_index(np.argmax(picture[..., 0]), picture.shape[:2])
    pixel = 2 * np.tan(np.radians(17.0)) / 20 * 4
    np.testing.assert_allclose(row + 0.5, 10 - 0.4 / pixel, rtol=0, atol=1.5)  # the lamp's own size
    np.testing.assert_allclose(column + 0.5, 20 + 0.6 / pixel, rtol=0, atol=1.5)
    np.testing.assert_array_equal(picture[row, column], [1.0, 0.2, 0.0])


def test_a_ball_turns_the_picture_upside_down():
    # A lens of focal length 1.47 shows what lies 4 behind it turned round, 8/3 times larger.
    dot, view = lamp((0.1, 0.1, -4.0), 0.08), camera(vertical_fov=12.0)
    film = Film(24, 24, wavelengths=[0.5])
    alone = render(Scene(view, (dot,)), film, samples=4)
    through = render(Scene(view, (ball(N_D), dot)), film, samples=4, depth=20)
    assert alone[:12, 12:].sum() > 0
    assert not alone[12:].any()
    assert not alone[:, :12].any()
    # All but the weak reflections.
    assert through[12:, :12].sum() > 0.99 * through.sum() > 0
    assert through.sum() > 2 * alone.sum()


def test_brighter_tile_lies_where_both_axes_are_positive():
    scene = Scene(camera(), (screen(z=0.0, tile=5.0, even=1.0, odd=0.25),))
    picture = render(scene, Film(4, 4, wavelengths=[0.5]), samples=1)[..., 0]
    even, odd = np.ones((2, 2)), np.full((2, 2), 0.25)
    # A footprint along the axes is a sliver, which counts as 1/1000 as broad as long.
    np.testing.assert_allclose(picture, np.block([[odd, even], [even, odd]]), rtol=0, atol=3e-4)


# --- derivatives and transformations


def of_coefficients(theta):
    """The bench's picture as a function of B and C."""
    return render(with_glass(bench(), 0, Sellmeier(theta[:3], theta[3:])), BANDS, **FEW)


THETA = jnp.concatenate([jnp.asarray(BK7.B), jnp.asarray(BK7.C)])
PICTURE = jax.jit(of_coefficients)
PUSH = jax.jit(jax.jacfwd(of_coefficients))
PULL = jax.jit(lambda theta, weight: jax.vjp(of_coefficients, theta)[1](weight)[0])


@pytest.mark.parametrize("column", range(6))
def test_columns_are_central_differences(column):
    # Steps that change n by about 1e-7: rounding of 1e-15 / 1e-7 against slopes of about 1.
    n_slope = jax.jacfwd(lambda t: Sellmeier(t[:3], t[3:]).n_d)(THETA)[column]
    step = jnp.zeros(6).at[column].set(1e-7 / abs(n_slope))
    difference = (PICTURE(THETA + step) - PICTURE(THETA - step)) / (2 * step[column])
    error = np.linalg.norm(PUSH(THETA)[..., column] - difference) / np.linalg.norm(difference)
    assert error < 1e-6


def test_reverse_mode_is_forward_mode():
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(10, 12, 2)))
    expected = jnp.tensordot(weight, PUSH(THETA), 3)
    # The same products summed in another order.
    np.testing.assert_allclose(PULL(THETA, weight), expected, rtol=1e-10)


def test_derivatives_are_finite_everywhere():
    assert np.isfinite(PUSH(THETA)).all()
    assert np.abs(PUSH(THETA)).max() > 0


def posed(center, radius, look_from, vertical_fov, tile):
    """A bench with nothing but the inside of the ball in view."""
    screen_of = screen(tile=1.0)
    texture = screen_of.material.texture
    checker = type(texture)(texture.even, texture.odd, tile)
    scene = Scene(
        Camera(look_from, jnp.zeros(3), vertical_fov=vertical_fov),
        (
            Object(Sphere(center, radius), Dielectric(BK7)),
            Object(screen_of.shape, Emitter(checker)),
        ),
    )
    return render(scene, BANDS, samples=4, depth=4)


POSE = (jnp.zeros(3), jnp.array(1.0), jnp.array([0.1, 0.2, 4.0]), jnp.array(8.0), jnp.array(0.1))
POSE_NAMES = ("center", "radius", "look_from", "vertical_fov", "tile")
POSED = jax.jit(posed)
POSE_PUSH = jax.jit(lambda pose, tangent: jax.jvp(posed, pose, tangent)[1])
POSE_PULL = jax.jit(lambda pose, weight: jax.vjp(posed, *pose)[1](weight))
SLANTING = jnp.array([0.6, 0.48, 0.64])


def tangent(which):
    """Change of one of the five; of a vector, in a slanting direction."""
    return tuple(
        jnp.zeros(leaf.shape) if k != which else SLANTING if leaf.shape else jnp.ones(())
        for k, leaf in enumerate(POSE)
    )


@pytest.mark.parametrize("which", range(5), ids=POSE_NAMES)
def test_derivatives_in_the_geometry_are_central_differences(which):
    change = tangent(which)
    above, below = (
        POSED(*(p + sign * 1e-7 * t for p, t in zip(POSE, change, strict=True))) for sign in (1, -1)
    )
    difference = (above - below) / 2e-7
    # Kinks of the filter within a step, and rounding of 1e-15 / 1e-7 against slopes of 1.
    error = np.linalg.norm(POSE_PUSH(POSE, change) - difference) / np.linalg.norm(difference)
    assert error < 1e-6


def test_reverse_mode_in_the_geometry_is_forward_mode():
    weight = jnp.asarray(np.random.default_rng(0).normal(size=BANDS_SHAPE))
    pulled = POSE_PULL(POSE, weight)
    for which in range(5):
        change = tangent(which)
        expected = jnp.sum(weight * POSE_PUSH(POSE, change))
        found = sum(jnp.sum(p * t) for p, t in zip(pulled, change, strict=True))
        # The same products summed in another order.
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_derivatives_in_the_geometry_are_finite_with_outlines_in_view():
    wide = (*POSE[:3], jnp.array(50.0), POSE[4])
    for which in range(5):
        assert np.isfinite(POSE_PUSH(wide, tangent(which))).all()
    pulled = POSE_PULL(wide, jnp.ones(BANDS_SHAPE))
    assert all(np.isfinite(leaf).all() for leaf in pulled)


FOCAL = 12 / np.tan(np.radians(17))
"""Of a film of 24 pixels and a field of view of 34 degrees, pixels."""


def summed(scene):
    """The sum of a small picture's pixels."""
    return jnp.sum(render(scene, Film(24, 24, wavelengths=[0.5]), samples=4))


def test_a_lamp_grows_smoothly_by_its_outline():
    def light(radius):
        return summed(Scene(camera(), (Object(Sphere([0.0, 0, 0], radius), Emitter([1.0] * 3)),)))

    found, slope = jax.jit(jax.value_and_grad(light))(jnp.array(0.6))
    # A sphere of angle α around the axis is a disc of radius f tan α, sin α = r / d.
    sine = 0.6 / 4
    expected = np.pi * FOCAL**2 * sine**2 / (1 - sine**2)
    growth = 2 * np.pi * FOCAL**2 * sine / 4 / (1 - sine**2) ** 2
    # Straight edges for a circle of six pixels, in cells of half a pixel.
    np.testing.assert_allclose(found, expected, rtol=2e-3)
    np.testing.assert_allclose(slope, growth, rtol=1e-2)


def test_a_lamp_before_a_lamp_hides_it_by_its_part():
    def light(radius):
        near = Object(Sphere([0.0, 0, 1], radius), Emitter([0.25] * 3))
        far = Object(Sphere([0.0, 0, -2], 3.0), Emitter([1.0] * 3))
        return summed(Scene(camera(), (far, near)))

    slope = jax.jit(jax.grad(light))(jnp.array(0.6))
    sine = 0.6 / 3
    growth = 2 * np.pi * FOCAL**2 * sine / 3 / (1 - sine**2) ** 2
    np.testing.assert_allclose(slope, -0.75 * growth, rtol=1e-2)  # as for the lamp alone


def test_tiles_far_away_are_seen_in_perspective():
    tiles = Emitter(Checker2D([1.0] * 3, [0.0] * 3, 1.0))
    above = Camera([0.0, 1, 0], [0.0, 0.3, -3], vertical_fov=20.0)
    scene = Scene(above, (Object(Plane([0.0, 0, 0], [0.0, 1, 0]), tiles),))
    few, many = (render(scene, Film(24, 24), samples=count, dtype="float64") for count in (4, 2500))
    # 0.0102 with footprints that are parallelograms, and without what happens at corners of tiles.
    assert np.sqrt(np.mean((few - many) ** 2)) < 0.004


def test_outlines_seen_through_a_ball_move_with_its_index():
    lamp_of = Object(Sphere([0.25, 0.2, -3.0], 0.5), Emitter([1.0] * 3))

    def picture(n, samples):
        glass = Sellmeier(jnp.zeros(3).at[0].set(n * n - 1), jnp.zeros(3))
        scene = Scene(camera(), (Object(Sphere([0.0, 0, 0], 1.0), Dielectric(glass)), lamp_of))
        return render(scene, Film(16, 16, wavelengths=[0.5]), samples=samples)

    slope = jax.jit(lambda n: jax.jvp(lambda n: picture(n, 16), (n,), (jnp.ones(()),))[1])(1.5)
    # Of so many samples a step crosses several of each pixel on the outline.
    sharp = jax.jit(lambda n: picture(n, 900))
    difference = (sharp(1.502) - sharp(1.498)) / 0.004
    assert np.linalg.norm(slope - difference) < 0.05 * np.linalg.norm(difference)


def test_outlines_move_as_the_picture_does():
    film = Film(24, 24, wavelengths=[0.55])
    aside = eqx.tree_at(lambda s: s.objects[0].shape.center, bench(), np.array([0.01, 0.02, 0]))

    def swollen(by, samples):
        scene = eqx.tree_at(lambda s: s.objects[0].shape.radius, aside, 1.0 + by)
        return render(scene, film, samples=samples, dtype="float64")

    difference = (swollen(np.array(1e-3), 1600) - swollen(np.array(-1e-3), 1600)) / 2e-3
    _, slope = jax.jvp(lambda by: swollen(by, 64), (jnp.zeros(()),), (jnp.ones(()),))
    # On points next to the rim the ball turns away within less than a sample's footprint.
    assert np.linalg.norm(slope - difference) < 0.12 * np.linalg.norm(difference)


def scenes():
    """Two benches that differ in every number."""
    other = jax.tree.map(lambda leaf: leaf * 1.03 + 0.01, bench())
    return bench(), other


def test_mapped_scenes_are_scenes_one_by_one():
    jitted = jax.jit(jax.vmap(lambda scene: render(scene, BANDS, **FEW)))
    stacked = jitted(jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes()))
    for found, scene in zip(stacked, scenes(), strict=True):
        # Of traced numbers another program comes: other rounding, magnified at the ball's rim.
        np.testing.assert_allclose(found, render(scene, BANDS, **FEW), rtol=0, atol=1e-11)


def test_under_jit_a_render_is_the_same():
    np.testing.assert_allclose(
        PICTURE(THETA), of_coefficients(THETA), rtol=0, atol=1e-12
    )  # rounding


# --- programs, chunks, threads


def programs():
    return chunks.render_chunks_jit._cache_size()


def test_other_numbers_are_no_other_program():
    first, other = scenes()
    render(first, BANDS, **FEW)
    before = programs()
    render(other, BANDS, **FEW, seed=5)
    render(first, Film(12, 10, wavelengths=[0.4, 0.5]), **FEW)
    render(first, Film(31, 17, wavelengths=[0.4, 0.5]), **FEW)
    assert programs() == before


def test_another_name_is_no_other_program():
    render(bench("N-BK7"), BANDS, **FEW)
    before = programs()
    render(bench("N-SF11"), BANDS, **FEW)
    renamed = [Object(o.shape, o.material, o.name + "!") for o in bench("N-BK7").objects]
    render(Scene(camera(), renamed), BANDS, **FEW)
    assert programs() == before


def test_another_structure_is_another_program():
    render(bench(), BANDS, **FEW)
    before = programs()
    render(bench(), BANDS, samples=4, depth=7)
    assert programs() == before + 1


@pytest.mark.parametrize("length", [7, 64])
def test_the_picture_does_not_depend_on_chunks(length, monkeypatch):
    scene = furnace(*SEPARATE["apart"], color=[0.1, 0.2, 0.3])
    whole = render(scene, BANDS, samples=4, depth=50)
    monkeypatch.setattr(rendering, "chunk_pixels", lambda film, plan: length)
    # Loops of another length are vectorised in other places.
    np.testing.assert_allclose(render(scene, BANDS, samples=4, depth=50), whole, rtol=0, atol=1e-12)


@pytest.mark.parametrize("block", [50, 1 << 20])
def test_the_picture_does_not_depend_on_which_paths_move_up(block, monkeypatch):
    scene = furnace(*SEPARATE["apart"], color=[0.1, 0.2, 0.3])
    whole = render(scene, BANDS, samples=4, depth=50)
    monkeypatch.setattr(integrator, "BLOCK_BYTES", 8 * block)
    jax.clear_caches()
    blocks = render(scene, BANDS, samples=4, depth=50)
    jax.clear_caches()
    np.testing.assert_allclose(blocks, whole, rtol=0, atol=1e-12)  # as above


def test_the_picture_does_not_depend_on_threads(monkeypatch):
    film = Film(64, 64, wavelengths=[0.45, 0.65])
    scene = furnace(*SEPARATE["apart"], color=[0.1, 0.2, 0.3])
    many = render(scene, film, samples=4, depth=50)
    monkeypatch.setattr(chunks, "workers", lambda: 1)
    np.testing.assert_array_equal(render(scene, film, samples=4, depth=50), many)


def test_the_seed_chooses_the_branches_of_two_balls_only():
    dull = furnace(*SEPARATE["apart"], color=[0.1, 0.2, 0.3])
    one, two = (render(dull, BANDS, samples=4, depth=50, seed=seed) for seed in (1, 2))
    assert np.abs(one - two).max() > 1e-6
    one, two = (render(bench(), BANDS, **FEW, seed=seed) for seed in (1, 2))
    np.testing.assert_array_equal(one, two)


# --- the border


def test_progress_is_told_and_may_stop():
    told, film = [], Film(64, 64, wavelengths=[0.45, 0.65])
    render(bench(), film, **FEW, progress=lambda done, total: told.append((done, total)))
    assert told[-1][0] == told[-1][1]
    assert [done for done, _ in told] == sorted({done for done, _ in told})

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render(bench(), film, **FEW, progress=stop)


@pytest.mark.parametrize("options", [{"samples": 0}, {"depth": 0}])
def test_nothing_to_trace_is_refused(options):
    with pytest.raises(ValueError, match="at least 1"):
        render(bench(), BANDS, **options)


def test_bands_without_an_index_are_refused():
    with pytest.raises(ValueError, match="ball: its glass has a pole at 550 nm"):
        render(bench(Sellmeier([1.0, 0, 0], [0.55**2, 0, 0])), BANDS)


def test_bands_beyond_the_validity_warn():
    glass = Sellmeier(BK7.B, BK7.C, validity=(0.5, 2.0))
    with pytest.warns(UserWarning, match="450-650 nm reach beyond the range 500-2000 nm"):
        render(bench(glass), BANDS, **FEW)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("film", [BANDS, COLOR])
def test_shape_and_type(dtype, film):
    picture = render(Scene(camera(), (lamp(ORIGIN, 1.0),)), film, samples=1, dtype=dtype)
    assert picture.shape == (10, 12, film.channels)
    assert picture.dtype == dtype


def test_float32_is_near_float64():
    single = render(bench(), BANDS, **FEW, dtype="float32")
    # Rounding of 1e-6 of a tile at the screen, over footprints of a tenth of one.
    np.testing.assert_allclose(single, render(bench(), BANDS, **FEW), rtol=0, atol=1e-3)
