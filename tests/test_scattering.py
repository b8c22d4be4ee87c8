"""What surfaces do to light: closed forms. The scenes of most tests are one program."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import BK7, WHITE, ball, direct, furnace, ground, lamp, matte, metal

from diffdisp import programs
from diffdisp.camera import Camera
from diffdisp.film import Film
from diffdisp.geometry import Plane, Sphere
from diffdisp.material import Emitter, Lambertian, Metal
from diffdisp.rendering import render
from diffdisp.scene import Background, Object, Scene
from diffdisp.texture import Checker, Checker2D, Solid

FILM = Film(12, 8)
ONE_BOUNCE = {"samples": 16, "depth": 2}
COLOR = np.array([0.8, 0.5, 0.1])
EVEN, ODD = np.array([0.9, 0.6, 0.3]), np.array([0.2, 0.1, 0.05])
CUBES, TILES = Checker(EVEN, ODD, 2.0), Checker2D(EVEN, ODD, 1.2)


def hollow(radius=50.0, center=(0, 0, 0)):
    """A white lamp around everything: within it nothing else is seen of the world."""
    return lamp(center, radius)


def patterned(obj):
    """The object; where it has one colour and scatters, with that as a checker's both."""
    texture = obj.material.texture
    if isinstance(obj.material, Emitter) or not isinstance(texture, Solid):
        return obj
    both = Checker(texture.color, texture.color)
    return replace(obj, material=replace(obj.material, texture=both))


KINDS = [(s, m) for m in (Lambertian, Metal, Emitter) for s in (Sphere, Plane)]


def kind(obj):
    """Where an object stands among the kinds."""
    return KINDS.index((type(obj.shape), type(obj.material)))


def of_all_kinds(*objects):
    """The objects, and one of each other kind beneath and outside of all that they can see.

    In one order and with one kind of texture, so that most scenes are one program.
    """
    grey = [0.5] * 3
    spare = (
        matte(0.5, (5, -1000, 0)),
        ground(Lambertian(grey), -990.0),
        metal(0.5, (0, -1000, 0), fuzz=0.5),
        ground(Metal(grey), -995.0),
        lamp((9, -1000, 0), 1.0),
    )
    there = {kind(o) for o in objects}
    return sorted(map(patterned, (*objects, *(o for o in spare if kind(o) not in there))), key=kind)


def seen(*objects, look_from=(0, 0, 4), look_at=(0, 0, 0), fov=20.0, up=(0, 1, 0), **options):
    """The picture of the objects, a bounce deep, by the wavefront loop."""
    view = Camera(look_from, look_at, up, fov)
    return render(Scene(view, of_all_kinds(*objects)), FILM, **(ONE_BOUNCE | options))


def spread(picture):
    """Mean of a picture's pixels and its standard error."""
    return picture.mean(axis=(0, 1)), picture.std(axis=(0, 1)) / np.sqrt(FILM.width * FILM.height)


def shown(material, what):
    """The material on a sphere or a plane that fills the picture."""
    return Object(Sphere([0, 0, 0], 2.0), material) if what == "sphere" else ground(material)


LOOKS = {
    "sphere": {},
    "plane": {"look_from": (0, 3, 1), "look_at": (0, -1, 0)},
}


# --- uniform surroundings: no noise


@pytest.mark.parametrize("what", LOOKS)
@pytest.mark.parametrize("material", [Lambertian(COLOR), Metal(COLOR)], ids=["matte", "metal"])
def test_a_convex_body_in_a_white_furnace_shows_its_colour(what, material):
    # Every path leaves after its only bounce: not even noise.
    picture = seen(shown(material, what), hollow(), **LOOKS[what])
    np.testing.assert_allclose(picture, np.broadcast_to(COLOR, picture.shape), rtol=0, atol=1e-14)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("loop", [render, direct])
@pytest.mark.parametrize("body", [matte, metal])
def test_a_ball_before_a_white_background_shows_its_colour(body, loop, dtype):
    scene = furnace(body(0.3), vertical_fov=10.0, color=COLOR)
    picture = loop(scene, FILM, **ONE_BOUNCE, dtype=dtype)
    # 0.3 · COLOR, and in float32 the mean of 16 of them.
    tolerance = 1e-6 if dtype == "float32" else 1e-14
    expected = np.broadcast_to(0.3 * COLOR, picture.shape)
    np.testing.assert_allclose(picture, expected, rtol=0, atol=tolerance)


def test_bands_show_the_spectrum_of_a_colour():
    # A grey is the same in each band.
    film = Film(12, 8, wavelengths=[0.42, 0.55, 0.68])
    picture = render(furnace(matte(0.3), vertical_fov=10.0), film, **ONE_BOUNCE)
    np.testing.assert_allclose(picture, 0.3, rtol=0, atol=1e-14)  # rounding


def test_a_depth_of_one_shows_scatterers_black():
    bodies = matte(0.8), metal(0.8, (2.5, 0, 0))
    for look_at, expected in (((0, 0, 0), 0), ((2.5, 0, 0), 0), ((0, 9, 0), 1)):
        view = Camera((0, 0, 4), look_at, vertical_fov=10.0)
        picture = render(Scene(view, bodies, Background(WHITE)), FILM, samples=4, depth=1)
        np.testing.assert_array_equal(picture, expected)


@pytest.mark.parametrize("loop", [render, direct])
def test_what_meets_no_glass_counts_once_in_colour(loop):
    # Dispersive glass hides behind the matte ball, whose front does not see it.
    scene = furnace(matte(0.3), ball(BK7, (0, 0, -50)), vertical_fov=60.0)
    picture = loop(scene, FILM, **ONE_BOUNCE)
    np.testing.assert_allclose(picture[:, 0], 1, rtol=0, atol=1e-14)  # the weights' rounding
    np.testing.assert_allclose(picture[3:5, 5:7], 0.3, rtol=0, atol=1e-14)


@pytest.mark.parametrize("depth", [2, 6])
def test_an_integrating_sphere(depth):
    # A lamp in the middle of a matte sphere: from each point of the wall it fills s = (r/R)² of
    # what is seen by the cosine, the wall the rest. After d - 1 bounces the wall's radiance is
    # a s (1 + q + q² + ... ), q = a (1 - s).
    wall = Object(Sphere([0, 0, 0], 2.0), Lambertian(COLOR))
    bright = lamp((0, 0, 0), 0.8)
    picture = seen(wall, bright, look_from=(0, 1.4, 0), look_at=(2, 1.5, 0), depth=depth)
    s = 0.4**2
    expected = COLOR * s * sum((COLOR * (1 - s)) ** k for k in range(depth - 1))
    mean, error = spread(picture)
    assert np.all(np.abs(mean - expected) < 5 * error + 1e-12)  # five standard errors
    # By chance alone a sample's error is √(s (1 - s)). With the lamp aimed at, what is met by
    # chance weighs Ω/π / (1 + Ω/π) of that, Ω = 2π (1 - √(1 - s)), and all else is even.
    if depth == 2:
        aimed = 2 * (1 - np.sqrt(1 - s))
        by_chance = COLOR * np.sqrt(s * (1 - s)) * aimed / (1 + aimed)
        assert np.all(picture.std(axis=(0, 1)) < 1.1 * by_chance / np.sqrt(16))


# --- lamps


def lamplight(point, normal, center, radius):
    """E/(πL) of a spherical lamp wholly above the horizon: sin² of its half angle times cosine."""
    offset = np.asarray(center) - point
    squared = offset @ offset
    cosine = offset @ normal / np.sqrt(squared)
    assert cosine > radius / np.sqrt(squared)
    return radius**2 / squared * cosine


NARROW = 0.01
"""A field of view in which light hardly changes, degrees."""


@pytest.mark.parametrize("x", [0.0, 1.0, 2.5, 6.0])
@pytest.mark.parametrize("loop", [render, direct])
def test_ground_under_a_lamp(x, loop):
    at, center, radius, L = np.array([x, -1.0, 0.0]), (0.2, 1.5, 0.3), 0.7, np.array([3, 2, 0.5])
    bright = lamp(center, radius, L)
    view = Camera(at + np.array([0, 5, 5]), at, vertical_fov=NARROW)
    objects = of_all_kinds(bright, ground(Lambertian(COLOR)))
    expected = COLOR * L * lamplight(at, np.array([0, 1, 0]), center, radius)
    picture = loop(Scene(view, objects), FILM, **ONE_BOUNCE)
    mean, error = spread(picture)
    # The picture is 0.002 wide, and about its middle light changes evenly.
    assert np.all(np.abs(mean - expected) < 5 * error + 1e-6 * expected)
    # By chance alone one sample is √(1/s) = 4 to 15 times as noisy as the light is strong.
    assert np.all(error * np.sqrt(96 * 16) < 0.6 * expected)


def test_two_lamps_shine_as_the_sum_of_each():
    at, normal = np.array([0.5, -1.0, 0.0]), np.array([0, 1, 0])
    lamps = [((0.2, 1.5, 0.3), 0.7, 1.0), ((2.0, 0.5, -1.0), 0.3, 20.0)]
    objects = [lamp(c, r, [L] * 3) for c, r, L in lamps]
    view = Camera(at + np.array([0, 5, 5]), at, vertical_fov=NARROW)
    scene = Scene(view, (*objects, ground(Lambertian(COLOR))))
    expected = COLOR * sum(L * lamplight(at, normal, c, r) for c, r, L in lamps)
    mean, error = spread(render(scene, FILM, **ONE_BOUNCE))
    assert np.all(np.abs(mean - expected) < 5 * error + 1e-6 * expected)  # as above


def test_a_lamp_half_below_the_horizon_gives_half_of_its_light():
    # Its middle on the horizon: the integral of the cosine over half a cap of half angle α is
    # (α - sin α cos α): of a cap seen edge-on, over π.
    at, radius, distance = np.array([0.0, -1.0, 0.0]), 0.7, 2.0
    bright = lamp((distance, -1.0, 0.0), radius)
    view = Camera(at + np.array([0, 5, 5]), at, vertical_fov=NARROW)
    scene = Scene(view, of_all_kinds(bright, ground(Lambertian(COLOR))))
    alpha = np.arcsin(radius / distance)
    expected = COLOR * (alpha - np.sin(alpha) * np.cos(alpha)) / np.pi
    mean, error = spread(np.mean([render(scene, FILM, **ONE_BOUNCE, seed=k) for k in range(8)], 0))
    assert np.all(np.abs(mean - expected) < 5 * error)


def test_a_lamp_behind_the_surface_gives_nothing():
    body = Object(Sphere([0, 0, 0], 2.0), Lambertian(COLOR))
    # From the point nearest to the camera, and far around it, the lamp is below the horizon.
    np.testing.assert_array_equal(seen(body, lamp((0, 0, -6), 1.0, [100.0] * 3)), 0)
    sunken = lamp((0, -4, 0), 1.0, [100.0] * 3)
    picture = seen(ground(Lambertian(COLOR)), sunken, **LOOKS["plane"])
    np.testing.assert_array_equal(picture, 0)


def test_a_lamp_in_the_shade_gives_nothing():
    screening = metal(0.5, (0, 0.5, 0), 1.0, fuzz=0.5)
    bright = lamp((0, 4, 0), 0.5, [100.0] * 3)
    at = np.array([0.0, -1.0, 0.0])
    view = Camera(at + np.array([3, 0.5, 0]), at, vertical_fov=NARROW)
    scene = Scene(view, of_all_kinds(ground(Lambertian(COLOR)), screening, bright))
    np.testing.assert_array_equal(render(scene, FILM, **ONE_BOUNCE), 0)


def test_a_mirror_shows_a_lamp_where_the_law_of_reflection_puts_it():
    at = np.array([0.0, -1.0, 0.0])
    toward = np.array([0.0, 3.0, 4.0])
    bright = lamp(at + toward * [1, 1, -1] * 2, 0.5, COLOR)
    mirror = ground(Metal(Checker2D(ODD, ODD, 1.0)))
    view = {"look_from": at + toward, "look_at": at}
    narrow = seen(mirror, bright, fov=NARROW, **view)
    np.testing.assert_allclose(narrow, np.broadcast_to(ODD * COLOR, narrow.shape), atol=1e-14)
    # As large as from the mirrored camera: 15 off, half angle arcsin(0.5/15).
    wide = seen(mirror, bright, fov=8.0, **view)[..., 0] / (ODD * COLOR)[0]
    pixel = 2 * np.tan(np.radians(4.0)) / 8
    expected = np.pi * np.tan(np.arcsin(0.5 / 15)) ** 2 / pixel**2
    # The outline crosses some 2 π 4 pixels, of which 16 samples on a grid measure a part each.
    np.testing.assert_allclose(wide.sum(), expected, rtol=0.02)


# --- fuzz


@pytest.mark.parametrize("fuzz", [0.3, 1.0])
def test_fuzzy_metal_at_normal_incidence_absorbs_nothing(fuzz):
    # The added ball touches the surface at most.
    mirror = ground(Metal(COLOR, fuzz=fuzz))
    view = {"look_from": (0, 3, 0), "look_at": (0, -1, 0), "up": (0, 0, 1)}
    picture = seen(mirror, hollow(), fov=NARROW, **view)
    np.testing.assert_allclose(picture, np.broadcast_to(COLOR, picture.shape), atol=1e-14)


@pytest.mark.parametrize("fuzz", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("cosine", [0.1, 0.4])
def test_fuzzy_metal_absorbs_what_points_below(fuzz, cosine):
    # Of the ball of radius f around the mirror direction the part below: a cap from h = cos/f on,
    # (1 - h)² (2 + h) / 4 of its volume.
    h = min(cosine / fuzz, 1.0)
    goes_on = 1 - (1 - h) ** 2 * (2 + h) / 4
    toward = np.array([0.0, cosine, np.sqrt(1 - cosine**2)])
    mirror = ground(Metal(COLOR, fuzz=fuzz))
    view = {"look_from": 4 * toward - [0, 1, 0], "look_at": (0, -1, 0)}
    picture = seen(mirror, hollow(), fov=NARROW, **view)
    # Binomial: five standard errors of 96 · 16 paths.
    error = np.sqrt(goes_on * (1 - goes_on) / (96 * 16))
    np.testing.assert_allclose(picture.mean(axis=(0, 1)) / COLOR, goes_on, atol=5 * error + 1e-12)


@pytest.mark.parametrize(("fuzz", "degrees"), [(0.3, 10.0), (0.8, 15.0), (0.8, 40.0)])
def test_fuzzy_metal_spreads_around_the_mirror_direction(fuzz, degrees):
    # Of points of the ball of radius f around the mirror direction, as many as are in the cone.
    rng = np.random.default_rng(5)
    points = rng.uniform(-1, 1, (400_000, 3))
    points = fuzz * points[(points**2).sum(-1) < 1] + [0, 0, 1]
    inside = points[:, 2] / np.linalg.norm(points, axis=1) > np.cos(np.radians(degrees))
    expected = inside.mean()
    # A lamp that fills the cone, seen by the mirror at 45°.
    at, toward = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.5, 0.5]) ** 0.5
    bright = lamp(at + 10 * toward * [1, 1, -1], 10 * np.sin(np.radians(degrees)))
    view = {"look_from": at + 4 * toward, "look_at": at}
    picture = seen(ground(Metal(COLOR, fuzz=fuzz)), bright, fov=NARROW, **view)
    error = np.sqrt(expected * (1 - expected) * (1 / (96 * 16) + 1 / len(points)))
    np.testing.assert_allclose(picture.mean(axis=(0, 1)) / COLOR, expected, atol=5 * error)


# --- checkers


def met_points(surface, look_from, look_at, fov, up=(0, 1, 0)):
    """Where rays through 25 points of each pixel meet a surface (25, H, W, 3)."""
    forward = np.subtract(look_at, look_from) / np.linalg.norm(np.subtract(look_at, look_from))
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    above = np.cross(right, forward)
    pixel = 2 * np.tan(np.radians(fov / 2)) / FILM.height
    offsets = np.array([(i, j) for i in range(5) for j in range(5)])[:, :, None, None] / 4
    y, x = np.mgrid[: FILM.height, : FILM.width]
    across = (x + offsets[:, 0] - FILM.width / 2) * pixel
    down = (y + offsets[:, 1] - FILM.height / 2) * pixel
    directions = forward + right * across[..., None] - above * down[..., None]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return look_from + directions * surface(np.asarray(look_from, float), directions)[..., None]


def to_sphere(radius):
    """Distance to a sphere around the origin."""

    def distance(origin, direction):
        b = direction @ origin
        return -b - np.sqrt(b * b - origin @ origin + radius**2)

    return distance


def to_plane(y):
    """Distance to a level plane."""
    return lambda origin, direction: (y - origin[1]) / direction[..., 1]


def check_tiles(picture, even, tolerance=1e-14):
    """Pixels of which no part that was looked at is of another tile show their tile's colour."""
    sure = even.all(axis=0) | ~even.any(axis=0)
    both = even[0][sure]
    assert both.any()
    assert not both.all()
    assert sure.mean() > 0.25
    expected = np.where(both[:, None], EVEN, ODD)
    np.testing.assert_allclose(picture[sure], expected, rtol=0, atol=tolerance)
    mixed = picture[~sure]
    assert (mixed > ODD - 1e-12).all()
    assert (mixed < EVEN + 1e-12).all()


def cubes_even(points):
    """The rule of `Checker` with scale 2, a thousandth of a cube or more from where it matters."""
    return np.prod(np.sin(2.0 * points), axis=-1) >= 0


CLOSE = {
    "sphere": {"look_from": (0.3, 0.2, 4.0), "look_at": (0.1, 0.1, 0), "fov": 30.0},
    "plane": {"look_from": (0.3, 3.0, 1.0), "look_at": (0.1, -1.0, 0), "fov": 30.0},
}
SURFACES = {"sphere": to_sphere(2.0), "plane": to_plane(-1.0)}


@pytest.mark.parametrize("what", CLOSE)
@pytest.mark.parametrize("kind", [Lambertian, Metal])
def test_cubes_on_what_scatters(what, kind):
    picture = seen(shown(kind(CUBES), what), hollow(), **CLOSE[what])
    check_tiles(picture, cubes_even(met_points(SURFACES[what], **CLOSE[what])))


@pytest.mark.parametrize("kind", [Lambertian, Metal])
def test_tiles_on_what_scatters(kind):
    # The plane's axes for a normal along y: x, and -z; even where both coordinates are positive.
    picture = seen(shown(kind(TILES), "plane"), hollow(), **CLOSE["plane"])
    points = met_points(SURFACES["plane"], **CLOSE["plane"])
    even = np.sin(points[..., 0] * np.pi / 1.2) * np.sin(-points[..., 2] * np.pi / 1.2) >= 0
    check_tiles(picture, even)


def test_a_plane_on_a_zero_of_the_sine_shows_the_cubes_beneath():
    # On y = 0 rounding would choose between the cubes above and below.
    level = Object(Plane([0, 0, 0], [0, 1, 0]), Lambertian(CUBES))
    points = met_points(to_plane(0.0), **CLOSE["plane"])
    picture = seen(level, hollow(), **CLOSE["plane"])
    check_tiles(picture, cubes_even(points - [0, 1e-6, 0]))


SHINING = {
    "sphere": (
        Object(Sphere([0, 0, 0], 2.0), Emitter(CUBES)),
        ground(Emitter(CUBES), -900.0),
    ),
    "plane": (
        Object(Sphere([0, 900, 0], 2.0), Emitter(CUBES)),
        ground(Emitter(CUBES)),
    ),
}


@pytest.mark.parametrize("scattering", [False, True])
@pytest.mark.parametrize("what", SHINING)
def test_cubes_on_what_shines(what, scattering):
    extra = (matte(0.5, (0, -1000, 0)),) if scattering else ()
    look = CLOSE[what]
    view = Camera(look["look_from"], look["look_at"], vertical_fov=look["fov"])
    picture = render(Scene(view, SHINING[what] + extra), FILM, samples=16, depth=2)
    # A footprint counts as a thousandth broader than it is, of which a corner may reach beyond.
    even = cubes_even(met_points(SURFACES[what], **look))
    check_tiles(picture, even, 1e-14 if scattering else 1e-6)


@pytest.mark.parametrize(("height", "expected"), [(3e-4, EVEN), (-3e-4, ODD)])
def test_cubes_just_above_a_border(height, expected):
    # In cubes' edges. What a level ground showed was once that of a thousandth beneath it, which
    # moves the borders of a ground that is almost level by far more.
    plane = ground(Emitter(CUBES), height * np.pi / 2)
    view = Camera((0.8, 3, 0.8), (0.8, 0, 0.81), vertical_fov=10.0)
    scene = Scene(view, (plane, matte(0.5, (0, -1000, 0))))
    assert np.allclose(render(scene, FILM, samples=1, depth=2), expected)


@pytest.mark.parametrize("radius", [5e3, 2e4])
def test_cubes_on_a_sphere_whose_points_are_rounded_by_more_than_their_depth(radius):
    # In float32 its top, on a border of cubes, was once the cube above it, or speckled.
    globe = Object(Sphere([0, -radius, 0], radius), Emitter(Checker(EVEN, ODD, 10.0)))
    view = Camera((0.16, 3, 0.16), (0.16, 0, 0.161), vertical_fov=0.5)
    shown = render(Scene(view, (globe,)), FILM, samples=1, depth=2, dtype="float32")
    assert np.allclose(shown, ODD)


def test_a_lamp_with_cubes_lights_what_is_around_it():
    # An integrating sphere. Cubes of 0.08 on a lamp 0.8 large: half of those in view are even,
    # to a hundredth or so.
    wall = Object(Sphere([0, 0, 0], 2.0), Lambertian(WHITE))
    bright = Object(Sphere([0, 0, 0], 0.8), Emitter(Checker(EVEN, ODD, 40.0)))
    view = Camera((0, 1.4, 0), (2, 1.5, 0), vertical_fov=20.0)
    scene = Scene(view, (wall, bright, ground(Emitter(CUBES), -900.0)))
    mean, error = spread(np.mean([render(scene, FILM, **ONE_BOUNCE, seed=k) for k in range(4)], 0))
    expected = 0.16 * 0.5 * (EVEN + ODD)
    assert np.all(np.abs(mean - expected) < 5 * error)
    assert np.all(error < 0.02 * expected)


def test_these_scenes_are_few_programs():
    before = len(programs._READY)
    for body in (Lambertian(CUBES), Lambertian(COLOR)):
        seen(shown(body, "plane"), hollow(), **LOOKS["plane"])
        seen(shown(body, "plane"), hollow(), **LOOKS["sphere"], seed=4)
    assert len(programs._READY) <= before + 2
