"""Numbers as large, as small and as close together as they come: values and derivatives.

Each kind of scene is one program, whatever numbers are in it. Beside the picture that program
gives its change along a change of all numbers of the scene, which one infinite or undefined
derivative would spoil.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ORIGIN,
    WHITE,
    ball,
    glass_of_index,
    incidence_on_unit_ball,
    lamp,
    matte,
    metal,
    part_in_unit_ball,
    reflectance,
    whole_samples,
)

from diffdisp.camera import Camera
from diffdisp.dispersion import Sellmeier
from diffdisp.film import Film
from diffdisp.geometry import Plane, Sphere
from diffdisp.glasses import glass_table, named_glass
from diffdisp.material import Emitter, Lambertian, Metal
from diffdisp.rendering import render
from diffdisp.scene import Background, Object, Scene
from diffdisp.scene_file import load_scene
from diffdisp.texture import Checker, Checker2D, filtered_tiles
from diffdisp.tolerance import rms

sys.path.append(str(Path(__file__).parent.parent / "benchmarks"))
from fuzz import FILM, KNOBS, program, search, slanting

SCENES = Path(__file__).parent.parent / "fixtures/scenes"
TYPES = pytest.mark.parametrize("dtype", ["float32", "float64"])
ROUNDING = {"float32": 2e-6, "float64": 1e-14}
"""Of sums of some ten numbers up to 1."""


def pushed(scene, change, dtype):
    """The picture and its change."""
    return [np.asarray(part) for part in program(dtype)(scene, change)]


def changed(scene, of_object, of_camera, of_color):
    """A change of some numbers of a scene."""
    camera = Camera(
        *(of_camera * v for v in (scene.camera.look_from, scene.camera.look_at)),
        np.zeros(3),
        np.zeros(()),
    )
    objects = [of_object(obj) for obj in scene.objects]
    return Scene(camera, objects, Background(of_color * scene.background.color))


def growing(scene):
    """The change by which a scene grows as a whole."""

    def of_object(obj):
        shape, material = obj.shape, obj.material
        still = jax.tree.map(np.zeros_like, material)
        if isinstance(shape, Plane):
            shape = Plane(shape.point, np.zeros(3))
        texture = getattr(material, "texture", None)
        if isinstance(texture, Checker2D):
            still = with_texture(still, Checker2D(np.zeros(3), np.zeros(3), texture.tile))
        if isinstance(texture, Checker):
            still = with_texture(still, Checker(np.zeros(3), np.zeros(3), -texture.scale))
        return Object(shape, still)

    return changed(scene, of_object, 1.0, 0.0)


def with_texture(material, texture):
    """The material with another texture."""
    rest = {"fuzz": material.fuzz} if isinstance(material, Metal) else {}
    if isinstance(material, Emitter):
        rest = {"intensity": material.intensity}
    return type(material)(texture, **rest)


def brightening(scene):
    """The change by which all that shines shines more."""

    def of_object(obj):
        still = jax.tree.map(np.zeros_like, obj)
        if not isinstance(obj.material, Emitter):
            return still
        texture = obj.material.texture
        if isinstance(texture, Checker2D):
            texture = Checker2D(texture.even, texture.odd, np.zeros(()))
        return Object(still.shape, Emitter(texture, np.zeros(())))

    return changed(scene, of_object, 0.0, 1.0)


# --- three kinds of scene


def bench(
    glass=1.5,
    center=ORIGIN,
    radius=1.0,
    look_from=(0, 0, 4),
    look_at=ORIGIN,
    fov=34.0,
    z=-3.1,
    tile=0.5,
    even=1.0,
    odd=1.0,
    intensity=1.0,
    background=1.0,
    scale=1.0,
):
    """A ball before a screen; white, unless told otherwise."""
    view = Camera(scale * np.array(look_from), scale * np.array(look_at), vertical_fov=fov)
    body = ball(glass, scale * np.array(center), scale * radius)
    tiles = Emitter(Checker2D([even] * 3, [odd] * 3, scale * tile), intensity)
    wall = Object(Plane([0, 0, scale * z], [0, 0, 1]), tiles)
    return Scene(view, (body, wall), Background([background] * 3))


def pair(first, second, glowing=((0, 9, 0), 1.0), look_from=(0, 0, 4), fov=34.0, scale=1.0):
    """Two balls of glass (index, centre, radius) and a lamp in a white furnace."""
    balls = [
        ball(n, scale * np.array(center), scale * radius) for n, center, radius in (first, second)
    ]
    view = Camera(scale * np.array(look_from), ORIGIN, vertical_fov=fov)
    where, radius = glowing
    return Scene(view, (*balls, lamp(scale * np.array(where), scale * radius)), Background(WHITE))


def crowd(
    glass=(1.5, (0, 0, 0), 1.0),
    mirror=((-2.2, 0, 0), 1.0),
    chalk=((2.2, 0, 0), 1.0),
    glowing=((0, 5, 2), 1.0),
    ground=-1.0,
    albedo=1.0,
    fuzz=0.0,
    cubes=10.0,
    tile=0.5,
    color=1.0,
    intensity=1.0,
    look_from=(0, 0.5, 6),
    look_at=ORIGIN,
    fov=45.0,
    scale=1.0,
):
    """A body of each kind on a ground, in a furnace."""
    n, center, radius = glass
    both = [albedo] * 3
    sized = [Sphere(scale * np.array(c), scale * r) for c, r in (mirror, chalk, glowing)]
    objects = (
        ball(n, scale * np.array(center), scale * radius),
        Object(sized[0], Metal(both, fuzz)),
        Object(sized[1], Lambertian(Checker(both, both, cubes / scale))),
        Object(
            Plane([0, scale * ground, 0], [0, 1, 0]),
            Lambertian(Checker2D(both, both, scale * tile)),
        ),
        Object(sized[2], Emitter([color] * 3, intensity)),
    )
    view = Camera(scale * np.array(look_from), scale * np.array(look_at), vertical_fov=fov)
    return Scene(view, objects, Background([color] * 3))


def check(scene, dtype, sizes=1e-12, least=None):
    """The picture of a white scene, with all that is true of any: energy, and three derivatives.

    Every number's derivative is finite. A scene that grows as a whole looks the same, and what
    shines more is brighter by as much: two derivatives that are known in closed form.

    Args:
        scene: the scene.
        dtype: float32 or float64.
        sizes: tolerance of the derivative in the size of the whole in float64; in float32 it is
            larger by the ratio of their roundings.
        least: the mean of the picture is more than that; None where it is not white.
    """
    picture, slope = pushed(scene, slanting(scene), dtype)
    assert np.isfinite(picture).all()
    assert np.isfinite(slope).all()
    if least is not None:
        assert picture.max() <= 1 + 1e-5
        assert picture.min() >= 0
        assert picture.mean() > least
    _, grown = pushed(scene, growing(scene), dtype)
    rounding = 1.0 if dtype == "float64" else 2.0**29
    np.testing.assert_allclose(grown, 0, rtol=0, atol=sizes * rounding)
    _, brighter = pushed(scene, brightening(scene), dtype)
    largest = np.abs(picture).max()
    np.testing.assert_allclose(brighter, picture, rtol=0, atol=ROUNDING[dtype] * largest)
    return picture


# --- the index of a glass


def known_furnace(n, depth=KNOBS["depth"]):
    """What `bench` shows at a constant index: 1 - (1 - R) Rᴺ in the ball, from N orders within."""
    fine = Film(2 * FILM.width, 2 * FILM.height)  # a sample each
    incidence = incidence_on_unit_ball(fine, 4.0, 34.0)
    seen = ~np.isnan(incidence)
    R = np.zeros(seen.shape)
    if n != 1:
        R = reflectance(np.where(seen, incidence, 0.5), n)
        R = np.where(seen, R, 0.0)
    left = (1 - R) * R ** (depth - 2) * seen
    return 1 - left.reshape(FILM.height, 2, FILM.width, 2).mean(axis=(1, 3))


WHOLE = whole_samples(FILM, 2, 4.0, 34.0)
"""Pixels in which the ball of `bench` cuts no sample: 12 of 36 within it, and 4 beside it."""


def assert_furnace(picture, n, tolerance, depth=KNOBS["depth"]):
    """A band is what `known_furnace` tells, wherever samples are not cut."""
    np.testing.assert_allclose(
        picture[WHOLE], known_furnace(n, depth)[WHOLE], rtol=0, atol=tolerance
    )


@TYPES
@pytest.mark.parametrize("n", [1.0, 1.0 + 1e-12, 1.0 + 1e-6, 4.0, 1e3, 0.5])
def test_a_furnace_of_any_index_is_its_truncated_sum(n, dtype):
    # What grows by 1 with the ball changes by n within it, times rounding, at each of two surfaces.
    sizes = 1e-10 if n == 1e3 else 1e-12
    picture = check(bench(glass_of_index(n)), dtype, sizes, least=0.99)
    # The root of 1 + (n² - 1) has n = 1e3 to 1e-13, and float32 has R = 0.996 to 1e-7, R¹⁸ to 2e-6.
    tolerance = {"float32": 1e-3 if n == 1e3 else 1e-5, "float64": 1e-10}[dtype]
    if n >= 1:
        for band in range(2):
            assert_furnace(picture[..., band], n, tolerance)


def glass_seen_at(glass, wavelength, band):
    """A glass that has at the film's band the index that another has at a wavelength.

    n depends on B and C / λ² alone: so the film, which is a constant, can stay.
    """
    return Sellmeier(glass.B, glass.C * (FILM.wavelengths[band] / wavelength) ** 2)


@TYPES
@pytest.mark.parametrize("name", glass_table())
def test_every_glass_over_its_range(name, dtype):
    glass = named_glass(name)
    for band, wavelength in enumerate(glass.validity):
        n = float(glass.indices(np.array([wavelength]))[0])
        assert 1 < n < 5
        scene = bench(glass_seen_at(glass, wavelength, band))
        picture, slope = pushed(scene, slanting(scene), dtype)
        assert np.isfinite(slope[..., band]).all()
        # Rounding; at the rim of a glass of n = 4 R is 0.9, and float32 has cos i to 1e-6.
        tolerance = {"float32": 1e-5, "float64": 1e-12}[dtype]
        assert_furnace(picture[..., band], n, tolerance)


ON = FILM.wavelengths[0] ** 2
POLES = {
    "on the pole": (1.0, ON),
    "one bit beyond": (1.0, np.nextafter(ON, 1.0)),
    "beyond": (1.0, ON * (1 + 1e-3)),
    "between the bands": (1.0, 0.3),
    "n² = 0": (-1.0, 0.0),
    "n² < 0": (-2.0, 0.0),
}


@TYPES
@pytest.mark.parametrize("name", POLES)
def test_a_band_without_an_index_is_undefined_and_no_other(name, dtype):
    B, C = POLES[name]
    glass = Sellmeier([B, 0, 0], [C, 0, 0])
    with pytest.raises(ValueError, match=r"its glass has (a pole|n² ≤ 0) at .* nm"):
        render(bench(glass), FILM, **KNOBS, dtype=dtype)
    # Inside a transformation nothing can be refused: the band, picture and slopes, is NaN.
    picture, slope = pushed(bench(glass), slanting(bench(glass)), dtype)
    assert np.isnan(picture[..., 0]).all()
    assert np.isnan(slope[..., 0]).all()
    n = glass.indices(FILM.wavelengths)[1]
    if n > 0:
        tolerance = {"float32": 1e-5, "float64": 1e-12}[dtype]
        assert_furnace(picture[..., 1], n, tolerance)
        assert np.isfinite(slope[..., 1]).all()
    else:
        assert np.isnan(picture[..., 1]).all()


@TYPES
@pytest.mark.parametrize("part", [1e-3, 1e-6])
def test_next_to_a_pole_an_index_is_as_large_as_it_is(part, dtype):
    glass = Sellmeier([1.0, 0, 0], [ON * (1 - part), 0, 0])
    scene = bench(glass)
    picture, slope = pushed(scene, slanting(scene), dtype)
    n = float(glass.indices(FILM.wavelengths)[0])
    # λ² - C keeps a digit or two in float32.
    tolerance = {"float32": 2e-3, "float64": 1e-8}[dtype]
    assert_furnace(picture[..., 0], n, tolerance)
    assert np.isfinite(slope).all()


# --- where the camera is, how much it sees, and the size of all


PLACES = {
    "in the glass": {"look_from": (0, 0, 0.5)},
    "in the centre": {"look_from": (0, 0, 0), "look_at": (0, 0, -1)},
    "on the ball": {"look_from": (0, 0, 1)},
    "a bit outside": {"look_from": (0, 0, np.nextafter(1, 2))},
    "a bit inside": {"look_from": (0, 0, np.nextafter(1, 0))},
    "on its far side": {"look_from": (0, 0, -1), "look_at": (0, 0, -2)},
    "on the screen": {"look_from": (0, 0, -3.1), "look_at": (0, 0, 0)},
    "screen through the ball": {"z": 0.0},
    "screen touching the ball": {"z": -1.0},
    "screen through the camera": {"z": 4.0},
    "a ball of 1e-9": {"radius": 1e-9},
    "around all, of 1e9": {"radius": 1e9},
    "before it a ball of 1e9": {"radius": 1e9, "center": (0, 0, -1e9)},
    "at a distance of 1e6": {"center": (0, 0, -1e6), "z": -2e6, "fov": 1e-4},
    "1e-3 degrees": {"fov": 1e-3},
    "179 degrees": {"fov": 179.0},
    "tiles of 1e-6": {"tile": 1e-6},
    "tiles of 1e6": {"tile": 1e6},
}


@TYPES
@pytest.mark.parametrize("name", PLACES)
def test_all_is_white_wherever_things_are(name, dtype):
    # N orders within leave R¹⁸ at most, 1e-6 in pixels on the rim.
    picture = check(bench(1.5, **PLACES[name]), dtype, least=1 - 1e-6)
    np.testing.assert_allclose(picture, 1, rtol=0, atol=1e-5)


@TYPES
@pytest.mark.parametrize("scale", [1e-9, 1e-5, 1e-2, 1e3, 1e6, 1e9])
def test_a_scene_of_any_size_looks_the_same(scale, dtype):
    numbers = {"even": 0.1, "odd": 0.8, "background": 0.3}
    plain = check(bench(1.5, **numbers), "float64", 1e-11)
    picture = check(bench(1.5, **numbers, scale=scale), dtype, 1e-11)
    # Rounding of the ray, magnified by the ball, over tiles of 0.5.
    tolerance = {"float32": 1e-5, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(picture, plain, rtol=0, atol=tolerance)


@TYPES
@pytest.mark.parametrize(("tile", "mean"), [(1e-9, 0.45), (1e-6, 0.45), (1e6, None)])
def test_tiles_far_below_a_pixel_and_far_above(tile, mean, dtype):
    # Off the axis: the screen's corner of four tiles is seen there, however large they are.
    aside = {
        "look_from": (0.4, 0.3, 4),
        "look_at": (0.4, 0.3, 0),
        "radius": 1e-9,
        "background": 0.0,
    }
    aside |= {"fov": 1.0}
    picture, slope = pushed(
        scene := bench(tile=tile, even=0.8, odd=0.1, **aside), slanting(scene), dtype
    )
    assert np.isfinite(slope).all()
    # A footprint of n tiles is off their mean by 1/n² at most; 1e-3 is the width of a sliver.
    expected = 0.8 if mean is None else mean
    np.testing.assert_allclose(picture, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("dtype", "length"),
    [
        ("float32", 1e-9),
        ("float64", 1e-70),
        ("float32", 1e-15),
        ("float64", 1e-140),
    ],
)
def test_a_footprint_far_smaller_than_its_tile_has_a_slope(dtype, length):
    def mean(length):
        none = jnp.zeros_like(length)
        return filtered_tiles((none + 0.3, none + 0.2), (length, none), (none, length))

    value, slope = jax.jvp(mean, (jnp.asarray(length, dtype),), (jnp.ones((), dtype),))
    np.testing.assert_array_equal((value, slope), (1.0, 0.0))


@TYPES
def test_slopes_on_tiles_of_1e9_are_finite(dtype):
    scene = bench(tile=1e9, even=0.8, odd=0.1)
    _, slope = pushed(scene, slanting(scene), dtype)
    assert np.isfinite(slope).all()


@TYPES
def test_slopes_of_a_camera_on_a_ball_are_finite(dtype):
    # From there footprints are very small where light leaves: those of some of 30 cameras.
    rng = np.random.default_rng(0)
    for out in rng.normal(size=(30, 3)):
        look_at = 0.3 * rng.normal(size=3)
        scene = bench(look_from=out / np.linalg.norm(out), look_at=look_at, tile=1e4)
        _, slope = pushed(scene, slanting(scene), dtype)
        assert np.isfinite(slope).all()


@TYPES
@pytest.mark.parametrize("intensity", [1e-30, 1e-9, 1e9, 1e30])
def test_a_screen_shows_its_intensity(intensity, dtype):
    scene = bench(1.5, intensity=intensity, background=0.0, radius=1e-9)
    picture = check(scene, dtype, sizes=1e-12 * intensity)
    tolerance = {"float32": 1e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(picture, intensity, rtol=tolerance)


# --- two balls


SHAPES = {
    "touching": ((1.5, (-1, 0, 0), 1.0), (1.8, (1, 0, 0), 1.0)),
    "touching, one behind the other": ((1.5, (0, 0, 1), 1.0), (1.8, (0, 0, -1), 1.0)),
    "overlapping": ((1.5, ORIGIN, 1.0), (1.8, (0, 0.9, 0.2), 0.5)),
    "overlapping, of one glass": ((1.5, (-0.5, 0, 0), 1.0), (1.5, (0.5, 0, 0), 1.0)),
    "concentric": ((1.5, ORIGIN, 1.0), (1.8, ORIGIN, 0.5)),
    "the same": ((1.5, ORIGIN, 1.0), (1.5, ORIGIN, 1.0)),
    "the same, of two glasses": ((1.5, ORIGIN, 1.0), (1.8, ORIGIN, 1.0)),
    "hollow": ((1.5, ORIGIN, 1.0), (1.0, ORIGIN, 0.6)),
    "a thin shell": ((1.5, ORIGIN, 1.0), (1.0, ORIGIN, 0.999)),
    "a ball of 1e-9 within": ((1.5, ORIGIN, 1.0), (1.8, (0, 0, 0.2), 1e-9)),
    "a ball of 1e5 far behind": ((1.5, ORIGIN, 1.0), (1.8, (0, 0, -1e6), 1e5)),
}


@TYPES
@pytest.mark.parametrize("name", SHAPES)
def test_two_balls_in_a_furnace(name, dtype):
    # A few paths go round within, 20 segments long and longer.
    picture = check(pair(*SHAPES[name]), dtype, least=0.998)
    if name.startswith("the same"):
        np.testing.assert_allclose(picture, 1, rtol=0, atol=1e-5)


@TYPES
@pytest.mark.parametrize(
    "where", [(0, 0, 1e-9), (0, 0, 0.4), (0, 0, 1.0), (0, 0, np.nextafter(1, 0))]
)
def test_a_camera_in_and_on_a_hollow_ball(where, dtype):
    hollow = (1.5, ORIGIN, 1.0), (1.0, (0, 0, 0.4), 0.6)
    check(pair(*hollow, look_from=where), dtype, least=0.998)


@TYPES
@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1e3, 1e9])
def test_two_balls_of_any_size_look_the_same(scale, dtype):
    # Which of two ways a path goes is a number's being less than another: no rounding may count.
    balls = (1.5, ORIGIN, 1.0), (1.0, (0.2, 0.1, 0.3), 0.5)
    picture = check(pair(*balls, scale=scale), dtype, 1e-11)
    plain = check(pair(*balls), "float64", 1e-11)
    tolerance = {"float32": 2e-4, "float64": 1e-11}[dtype]
    np.testing.assert_allclose(picture, plain, rtol=0, atol=tolerance)


THIN = "glass thinner than 1e-4 of its radius, 1e-8 in float64, is not there"


@pytest.mark.parametrize(
    ("thickness", "dtype"),
    [
        (1e-3, "float32"),
        (1e-3, "float64"),
        (1e-6, "float64"),
        pytest.param(1e-6, "float32", marks=pytest.mark.xfail(strict=True, reason=THIN)),
        pytest.param(1e-9, "float64", marks=pytest.mark.xfail(strict=True, reason=THIN)),
    ],
)
def test_a_shell_reflects_as_two_surfaces_however_thin(thickness, dtype):
    # Without interference a thin plate reflects 2R / (1 + R); seen along the axis, before a lamp.
    shell = (1.5, ORIGIN, 1.0), (1.0, ORIGIN, 1.0 - thickness)
    scene = pair(*shell, glowing=((0, 0, -30), 20.0), fov=0.1)
    scene = Scene(scene.camera, scene.objects, Background([0.0] * 3))
    picture, _ = pushed(scene, slanting(scene), dtype)
    R = (0.5 / 2.5) ** 2
    once = 1 - 2 * R / (1 + R)
    # The shell is met twice. Which way is taken is chosen by chance: 144 samples.
    np.testing.assert_allclose(picture.mean(), once / (1 + (1 - once)), rtol=0, atol=0.05)


# --- a lamp far away, or smaller than a pixel


def alone(radius, distance, place, fov):
    """A lamp before black, and the glass balls far off the view."""
    aside = 1e3 * distance
    scene = pair((1.5, (aside, 0, 0), 1.0), (1.5, (-aside, 0, 0), 1.0), (ORIGIN, radius))
    x, y = place
    view = Camera([x, y, distance], [x, y, 0], vertical_fov=fov)
    return Scene(view, scene.objects, Background([0.0] * 3))


def light_of_lamp(size, distance, fov, dtype):
    """Sum of the pixels over its true value, of a lamp of a size in pixels; a mean over places."""
    focal = 0.5 * FILM.height / np.tan(np.radians(0.5 * fov))
    sine = size / focal
    true = np.pi * focal**2 * sine**2 / (1 - sine**2)
    sums = []
    for place in np.random.default_rng(0).uniform(-0.5, 0.5, (8, 2)) / focal * distance:
        scene = alone(sine * distance, distance, place, fov)
        picture, slope = pushed(scene, slanting(scene), dtype)
        assert np.isfinite(slope).all()
        sums.append(picture[..., 0].sum())
    return np.mean(sums) / true


@TYPES
@pytest.mark.parametrize(("distance", "fov"), [(4.0, 20.0), (1e6, 1e-3), (1e-6, 20.0)])
def test_a_lamp_covers_its_solid_angle(distance, fov, dtype):
    assert abs(light_of_lamp(2.0, distance, fov, dtype) - 1) < 0.01


@TYPES
@pytest.mark.parametrize("size", [0.5, 0.25, 0.01, 1e-4])
def test_a_lamp_smaller_than_a_pixel_covers_its_solid_angle(size, dtype):
    assert abs(light_of_lamp(size, 4.0, 20.0, dtype) - 1) < 0.02


# --- bodies of all kinds on a ground


CROWDS = {
    "plain": {},
    "fuzz of 1e-9": {"fuzz": 1e-9},
    "cubes of 1e-9": {"cubes": 1e9},
    "cubes of 1e9": {"cubes": 1e-9},
    "tiles of 1e-9": {"tile": 1e-9},
    "tiles of 1e9": {"tile": 1e9},
    "1e-3 degrees": {"fov": 1e-3},
    "179 degrees": {"fov": 179.0},
    "n = 1": {"glass": (1.0, ORIGIN, 1.0)},
    "n = 4": {"glass": (4.0, ORIGIN, 1.0)},
    "camera in the glass": {"look_from": (0, 0, 0.5)},
    "camera on the glass": {"look_from": (0, 0, 1.0)},
    "camera in the centre of the glass": {"look_from": ORIGIN, "look_at": (0, 0, -1)},
    "camera in the lamp": {"look_from": (0, 5, 2)},
    "camera on the ground": {"look_from": (0, -1, 6)},
    "camera on the mirror": {"look_from": (-2.2, 0, 1)},
    "camera on the chalk": {"look_from": (2.2, 0, 1)},
    "ground through the glass": {"ground": 0.0},
    "lamp in the glass": {"glowing": (ORIGIN, 0.3)},
    "lamp on the glass": {"glowing": (ORIGIN, 1.0)},
    "lamp of 1e-9": {"glowing": ((0, 5, 2), 1e-9)},
    "lamp of 1e9 around all": {"glowing": (ORIGIN, 1e9)},
    "lamp touching the glass": {"glowing": ((0, 2, 0), 1.0)},
    "chalk and glass the same": {"chalk": (ORIGIN, 1.0)},
    "mirror within the glass": {"mirror": (ORIGIN, 0.5)},
    "all three the same": {"chalk": (ORIGIN, 1.0), "mirror": (ORIGIN, 1.0)},
    "on chalk of 1e5": {"chalk": ((0, -1e5 - 1, 0), 1e5), "ground": -2.0},
    "glass of 1e-9": {"glass": (1.5, ORIGIN, 1e-9)},
    "a mirror of 1e-9": {"mirror": (ORIGIN, 1e-9)},
    "glass of 1e-3 on chalk of 1e5": {
        "glass": (1.5, (0, 1e-3, 0), 1e-3),
        "chalk": ((0, -1e5, 0), 1e5),
        "ground": -2.0,
        "look_from": (0, 0.01, 0.02),
        "glowing": ((0, 0.05, 0), 0.01),
    },
}


def drawn(scene, dtype):
    """The picture by the loop for pictures: with derivatives this kind takes minutes to compile."""
    return render(scene, FILM, **KNOBS, dtype=dtype)


@TYPES
@pytest.mark.parametrize("name", CROWDS)
def test_a_crowd_in_a_furnace(name, dtype):
    film = Film(24, 24, FILM.wavelengths)
    picture = render(crowd(**CROWDS[name]), film, **KNOBS, dtype=dtype)
    assert np.isfinite(picture).all()
    assert picture.min() >= 0
    # Lamps are aimed at beside what chance finds: most samples count a little more than 1, for a
    # few that count far less. It is the mean that must not be above 1.
    error = picture.std() / 24  # both bands draw the same numbers
    assert picture.mean() <= 1 + 4 * error + 1e-5


@TYPES
@pytest.mark.parametrize("intensity", [1e-30, 1e30])
def test_lamplight_is_as_bright_as_its_lamp(intensity, dtype):
    lit, plain = (crowd(albedo=0.5, fuzz=0.2, intensity=i) for i in (intensity, 1.0))
    lit, plain = (Scene(s.camera, s.objects, Background([0.0] * 3)) for s in (lit, plain))
    picture, expected = drawn(lit, dtype) / intensity, drawn(plain, dtype)
    assert expected.max() > 0
    tolerance = {"float32": 1e-5, "float64": 1e-13}[dtype] * expected.max()
    np.testing.assert_allclose(picture, expected, rtol=0, atol=tolerance)


@TYPES
@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1e3, 1e9])
def test_a_crowd_of_any_size_looks_the_same(scale, dtype):
    numbers = {"albedo": 0.5, "fuzz": 0.2, "intensity": 5.0}
    picture = drawn(crowd(**numbers, scale=scale), dtype)
    # Rounding may lead a path elsewhere where it is chosen: a few of 144.
    differ = np.abs(picture - drawn(crowd(**numbers), dtype)) > 1e-4
    assert differ.mean() <= {"float32": 0.05, "float64": 0.0}[dtype]


# --- pictures and scenes of one, of none and of very many


@TYPES
def test_nothing_but_a_background(dtype):
    scene = Scene(Camera((0, 0, 4), ORIGIN), (), Background([0.25] * 3))
    picture, slope = pushed(scene, brightening(scene), dtype)
    tolerance = ROUNDING[dtype]
    np.testing.assert_allclose(picture, 0.25, rtol=0, atol=tolerance)
    np.testing.assert_allclose(slope, 0.25, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(pushed(scene, growing(scene), dtype)[1], 0)


@TYPES
@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 4096), (4096, 1)])
def test_pictures_of_one_pixel_and_of_one_line(width, height, dtype):
    picture = render(bench(), Film(width, height, FILM.wavelengths), **KNOBS, dtype=dtype)
    assert picture.shape == (height, width, 2)
    assert picture.max() <= 1 + 1e-5
    # Of 4096 pixels some lie on the rim, where R is near 1 and 18 orders leave (1 - R) R¹⁸ < 2 %.
    assert picture.min() > 0.98
    assert picture.mean() > 1 - 1e-4


@TYPES
def test_a_thousand_bands_are_each_their_own(dtype):
    n = np.linspace(1.2, 2.5, 1000)
    # n² - 1 = B λ² / (λ² - C) is turned round to the wavelengths that have these indices.
    B, C = 0.4, 0.15
    squared = (n**2 - 1) * C / (n**2 - 1 - B)
    glass = Sellmeier([B, 0, 0], [C, 0, 0])
    view = Camera((0, 0, 4), ORIGIN, vertical_fov=1e-6)
    scene = Scene(view, bench(glass).objects, Background(WHITE))
    for some in (slice(None), slice(500, 501)):
        picture = render(
            scene, Film(1, 1, np.sqrt(squared[some])), **KNOBS | {"depth": 3}, dtype=dtype
        )
        # Along the axis: the outer reflection and one order from within.
        R = ((n[some] - 1) / (n[some] + 1)) ** 2
        tolerance = {"float32": 1e-6, "float64": 1e-12}[dtype]
        np.testing.assert_allclose(picture[0, 0], 1 - (1 - R) * R, rtol=0, atol=tolerance)


@pytest.mark.parametrize("radius", [1e1, 1e3, 1e5])
def test_a_tiny_ball_on_a_very_large_one_is_the_same_in_float32(radius):
    ground = Object(Sphere([0, -radius, 0], radius), Lambertian([0.5] * 3))
    balls = matte(0.8, (0, 1e-3, 0), 1e-3), metal(0.9, (2.5e-3, 1e-3, 0), 1e-3)
    view = Camera([0, 2e-3, 8e-3], [0, 1e-3, 0], vertical_fov=40.0)
    scene = Scene(view, (ground, *balls), Background(WHITE))
    single, double = (
        render(scene, Film(24, 24), samples=16, depth=6, dtype=dtype)
        for dtype in ("float32", "float64")
    )
    np.testing.assert_allclose(single, double, rtol=0, atol=1e-5)


@TYPES
@pytest.mark.parametrize("depth", [1, 500])
def test_paths_of_one_segment_and_of_very_many(depth, dtype):
    # R = 0.996: after 498 orders an eighth of what entered is still on its way.
    picture = render(bench(1e3), FILM, samples=4, depth=depth, dtype=dtype)
    if depth > 1:
        tolerance = {"float32": 1e-6, "float64": 1e-14}[dtype]
        assert_furnace(picture[..., 0], 1e3, tolerance, depth)
    else:
        missed = 1 - part_in_unit_ball(FILM, 4.0, 34.0)
        np.testing.assert_allclose(picture[..., 0], missed, rtol=0, atol=2e-3)


@TYPES
def test_a_thousand_objects_in_a_furnace(dtype):
    places = np.random.default_rng(0).normal(size=(1022, 3)) * 3.0 - [0, 0, 3]
    chalk = [Object(Sphere(place, 0.2), Lambertian(WHITE)) for place in places]
    objects = *chalk, ball(1.5, ORIGIN, 0.3), Object(Sphere([0, 1.5, 1], 0.1), Metal(WHITE))
    scene = Scene(Camera((0, 0, 8), ORIGIN), objects, Background(WHITE))
    picture = render(scene, FILM, samples=4, depth=500, dtype=dtype)
    # Without lamps every way of a path counts alike.
    np.testing.assert_allclose(picture, 1, rtol=0, atol=1e-6 if dtype == "float32" else 1e-14)


@TYPES
def test_a_hundred_shells_of_one_glass_are_one_ball(dtype):
    shells = [ball(1.5, ORIGIN, 1 - k / 101) for k in range(100)]
    scene = Scene(bench().camera, shells, Background(WHITE))
    picture = render(scene, FILM, **KNOBS, dtype=dtype)
    tolerance = {"float32": 1e-5, "float64": 1e-13}[dtype]
    for band in range(2):
        assert_furnace(picture[..., band], 1.5, tolerance)


@pytest.mark.parametrize("name", ["dispersion", "metal_and_matte", "bench_nbk7"])
def test_the_gallery_is_the_same_in_float32(name):
    # Rounding sends few paths to the other side of a border; the rest are the same paths.
    scene, film = load_scene(SCENES / f"{name}.toml"), Film(96, 72)
    single, double = (render(scene, film, samples=16, dtype=dtype) for dtype in ROUNDING)
    size, off = rms(double), single - double
    assert rms(off) < 2e-3 * size
    same = np.abs(off).max(axis=-1) < 1e-3 * size
    assert same.mean() > 0.998
    assert rms(off[same]) < 1e-4 * size


@pytest.mark.parametrize("kinds", ["gs", "ggl"])
def test_random_scenes_have_no_faults(kinds):
    # 15 scenes of each kind and type, of which both programs are those of the tests above.
    assert search((kinds,), 15, ("float32", "float64"), seed=0)["found"] == []
