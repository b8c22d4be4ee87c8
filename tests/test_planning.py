import jax
import numpy as np
import pytest
from helpers import AIR, ball, bench, camera, furnace, ground, lamp, matte, metal, screen

from diffdisp.film import Film
from diffdisp.geometry import Plane, Sphere
from diffdisp.integrator import surfaces_of
from diffdisp.material import Emitter, Lambertian, Metal
from diffdisp.planning import make_plan
from diffdisp.scene import Background, Object, Scene
from diffdisp.texture import Checker, Checker2D

BANDS, COLOR = Film(8, 8, wavelengths=[0.45, 0.55, 0.65]), Film(8, 8)
SIDE = (2.5, 0, 0)


def plan_of(*objects, film=BANDS, look_from=(0, 0, 4), samples=4, depth=10):
    scene = Scene(camera(look_from), objects, Background([1.0, 1.0, 1.0]))
    return make_plan(scene, film, samples, depth, "float64")


def test_a_scene_without_glass_needs_nothing():
    plan = plan_of(lamp((0, 0, 0), 1), Object(Plane([0, 0, 0], [0, 0, 1]), Emitter([1, 1, 1])))
    assert (plan.balls, plan.lamps, plan.screens) == (0, 1, 1)
    assert not any((plan.dispersive, plan.nested, plan.random, plan.scattering, plan.lit))
    assert plan.tiled == plan.cubed == (False, False)


def test_the_bench():
    plan = make_plan(bench(), BANDS, 4, 10, "float64")
    assert (plan.balls, plan.lamps, plan.screens) == (1, 0, 1)
    assert plan.dispersive
    assert (plan.tiled, plan.cubed) == ((False, True), (False, False))
    assert not any((plan.nested, plan.random, plan.scattering))
    assert plan.bands == 3


# One of each kind that sends paths on, and two that end them, in no order.
EVERYTHING = (
    lamp((0, 9, 0), 1),
    ground(Metal([0.5] * 3), -2.0),
    matte(0.5, (5, 0, 0)),
    screen(z=-9.0),
    metal(0.5, (0, 5, 0)),
    ground(Lambertian([0.5] * 3), -1.5),
    ball("N-BK7"),
)


def test_surfaces_are_numbered_by_what_becomes_of_a_path():
    plan, scene = plan_of(*EVERYTHING), Scene(camera(), EVERYTHING)
    order = [(type(o.material).__name__, type(o.shape).__name__) for o in surfaces_of(scene)]
    assert order == [
        ("Dielectric", "Sphere"),
        ("Metal", "Sphere"),
        ("Lambertian", "Sphere"),
        ("Lambertian", "Plane"),
        ("Metal", "Plane"),
        ("Emitter", "Sphere"),
        ("Emitter", "Plane"),
    ]
    assert plan.mattes == (2, 4)
    assert (plan.first_plane, plan.first_lamp, plan.background) == (3, 5, 7)
    assert (plan.spheres, plan.planes, plan.metals) == (4, 3, 2)


@pytest.mark.parametrize(
    ("objects", "lit", "random", "numbers"),
    [
        ((matte(0.5), lamp(SIDE, 1)), True, True, 5),
        ((matte(0.5),), False, True, 2),
        ((metal(0.5), lamp(SIDE, 1)), False, False, 0),
        ((metal(0.5, fuzz=0.1),), False, True, 3),
        ((metal(0.5), ball(1.5, SIDE)), False, True, 1),
    ],
)
def test_what_bounces_draw_numbers_for(objects, lit, random, numbers):
    plan = plan_of(*objects)
    assert plan.scattering
    assert (plan.lit, plan.random, plan.numbers_per_bounce) == (lit, random, numbers)


def test_textures_are_told_apart_by_where_they_are():
    cubes, tiles = Checker([1] * 3, [0] * 3), Checker2D([1] * 3, [0] * 3, 0.5)
    shining = Object(Sphere(SIDE, 1.0), Emitter(cubes))
    assert plan_of(ground(Lambertian(cubes))).cubed == (True, False)
    assert plan_of(matte(0.5), shining).cubed == (False, True)
    assert plan_of(ground(Metal(tiles)), screen(z=-9.0)).tiled == (True, True)
    assert plan_of(ground(Metal(tiles))).tiled == (True, False)


def test_two_balls_choose_branches():
    plan = plan_of(ball("N-BK7"), ball("N-SF11", SIDE))
    assert plan.random
    assert not plan.nested


@pytest.mark.parametrize(
    "inner",
    [
        ball(AIR, (0.2, 0, 0), 0.4),  # a bubble
        ball(1.5, (0.9, 0, 0), 0.4),  # across the surface
        ball(1.5, (2, 0, 0), 1.0),  # touching
        ball(1.5, (0, 0, 0), 3.0),  # around
        lamp((0.2, 0, 0), 0.1),
        lamp((0.9, 0, 0), 0.4),
        screen(z=-0.5),
        screen(z=-1.0),  # touching
    ],
)
def test_what_meets_a_ball_makes_it_nested(inner):
    assert plan_of(ball("N-BK7"), inner).nested


@pytest.mark.parametrize(
    "outer", [ball(1.5, SIDE), lamp(SIDE, 1), lamp((0, 0, 0), 50), screen(z=-1.01)]
)
def test_what_keeps_apart_does_not(outer):
    assert not plan_of(ball("N-BK7"), outer).nested


@pytest.mark.parametrize(("z", "nested"), [(0.5, True), (1.0, True), (1.01, False)])
def test_a_camera_within_glass_is_nested(z, nested):
    assert plan_of(ball("N-BK7"), look_from=(0, 0, z)).nested is nested


def test_two_planes_within_a_lamp_are_not_nested_without_glass():
    assert not plan_of(lamp((0, 0, 0), 9), screen(z=-1), screen(z=-2)).nested


def test_a_constant_index_does_not_disperse():
    assert not plan_of(ball(1.5)).dispersive
    assert plan_of(ball(1.5), ball("N-BK7", SIDE)).dispersive
    assert plan_of(ball(1.5), film=COLOR).wavelengths_per_sample == 1


def test_colour_samples_carry_several_wavelengths():
    plan = plan_of(ball("N-BK7"), film=COLOR)
    assert plan.bands == 0
    assert plan.wavelengths_per_sample > 1
    assert plan_of(ball("N-BK7")).wavelengths_per_sample == 1
    assert plan_of(ball("N-BK7"), matte(0.5, SIDE), film=COLOR).wavelengths_per_sample > 1


def test_a_path_carries_what_its_film_needs():
    glass, dull = ball("N-BK7"), matte(0.5, SIDE)
    assert plan_of(glass).channels == plan_of(glass, dull).channels == 1  # a path for each band
    assert plan_of(ball(1.5), dull, film=Film(8, 8, wavelengths=[0.5] * 5)).channels == 5
    assert plan_of(glass, film=COLOR).channels == plan_of(dull, film=COLOR).channels == 3


def test_of_traced_numbers_the_general_case_is_assumed():
    plans = []

    def traced(scene):
        plans.append(make_plan(scene, BANDS, 4, 10, "float64"))
        return scene.camera.look_from

    jax.jit(traced)(furnace(ball(1.5), metal(0.5, (0, 5, 0))))
    assert plans[0].dispersive
    assert plans[0].nested
    assert plans[0].fuzzy


@pytest.mark.parametrize(
    ("radius", "height", "dtype", "fine"),
    [
        (49.0, 1.0, "float32", False),  # beside a ball of 1
        (51.0, 1.0, "float32", True),
        (51.0, 1.0, "float64", False),
        (25.0, 0.6, "float32", False),  # to a camera so far above it
        (25.0, 0.4, "float32", True),
    ],
)
def test_very_large_spheres_take_more_digits(radius, height, dtype, fine):
    objects = ball(1.5, (9, 9, 0)), matte(0.5, (0, -radius, 0), radius)
    scene = furnace(*objects, look_from=(0, height, 0))
    plan = make_plan(scene, COLOR, 4, 10, dtype)
    assert plan.fine == fine
    assert ("distances with more digits" in str(plan)) == fine


def test_equal_plans_are_one_program():
    assert plan_of(ball("N-BK7")) == plan_of(ball("N-SF11", (0.1, 0, 0), 1.1))
    assert hash(plan_of(ball("N-BK7"))) == hash(plan_of(ball("N-SF11")))


@pytest.mark.parametrize(("samples", "depth"), [(0, 5), (-1, 5), (4, 0)])
def test_nothing_to_trace_is_refused(samples, depth):
    with pytest.raises(ValueError, match="at least 1"):
        plan_of(ball("N-BK7"), samples=samples, depth=depth)


def test_printed_plan_of_the_bench():
    assert str(make_plan(bench(), BANDS, 6, 10, "float32")).splitlines() == [
        "objects    1 glass, 1 shining plane",
        "samples    6 a pixel, 3 x 2 grid",
        "depth      10 segments",
        "dtype      float32",
        "spectrum   one path for each band",
        "checker    2-D, over the footprint",
        "media      separate balls",
        "branches   summed, no noise",
    ]


@pytest.mark.parametrize(
    ("objects", "film", "lines"),
    [
        (
            (lamp((0, 0, 0), 1),),
            BANDS,
            [
                "objects    1 lamp",
                "depth      1: nothing sends light on",
                "spectrum   none: no glass",
            ],
        ),
        ((), BANDS, ["objects    none"]),
        (
            EVERYTHING[:3] + EVERYTHING[4:],
            COLOR,
            [
                "objects    1 glass, 2 matte, 2 metal, 1 lamp",
                "depth      10 segments",
                "spectrum   2 wavelengths a sample, 8 strata",
                "branches   chosen",
                "lamps      sampled directly",
            ],
        ),
        (
            (metal(0.5), lamp(SIDE, 1)),
            COLOR,
            ["objects    1 metal, 1 lamp", "branches   none", "lamps      found by chance"],
        ),
        (
            (ground(Lambertian(Checker([1] * 3, [0] * 3))), screen(z=-9.0)),
            COLOR,
            ["objects    1 matte, 1 shining plane", "checker    2-D and 3-D, at points"],
        ),
        ((ball(1.5),), COLOR, ["spectrum   none: nothing disperses", "checker    not compiled"]),
        (
            (ball("N-BK7"), ball(1.5, SIDE)),
            BANDS,
            ["branches   chosen", "media      separate balls"],
        ),
        ((ball("N-BK7"), ball(AIR, radius=0.5)), BANDS, ["media      nested or overlapping"]),
        ((ball("N-BK7"),), COLOR, ["spectrum   8 wavelengths a sample, 32 strata"]),
    ],
)
def test_lines_of_other_plans(objects, film, lines):
    printed = str(plan_of(*objects, film=film)).splitlines()
    assert all(line in printed for line in lines)


def test_numpy_and_jax_numbers_plan_alike():
    jaxed = jax.tree.map(jax.numpy.asarray, bench())
    assert make_plan(jaxed, BANDS, 4, 10, "float64") == make_plan(bench(), BANDS, 4, 10, "float64")
    assert isinstance(np.asarray(jaxed.camera.look_from), np.ndarray)
