import jax
import numpy as np
import pytest
from helpers import AIR, ball, bench, camera, furnace, lamp, screen

from diffdisp.film import Film
from diffdisp.geometry import Plane
from diffdisp.material import Emitter
from diffdisp.planning import make_plan
from diffdisp.scene import Background, Object, Scene

BANDS, COLOR = Film(8, 8, wavelengths=[0.45, 0.55, 0.65]), Film(8, 8)
SIDE = (2.5, 0, 0)


def plan_of(*objects, film=BANDS, look_from=(0, 0, 4), samples=4, depth=10):
    scene = Scene(camera(look_from), objects, Background([1.0, 1.0, 1.0]))
    return make_plan(scene, film, samples, depth, "float64")


def test_a_scene_without_glass_needs_nothing():
    plan = plan_of(lamp((0, 0, 0), 1), Object(Plane([0, 0, 0], [0, 0, 1]), Emitter([1, 1, 1])))
    assert (plan.balls, plan.lamps, plan.planes) == (0, 1, 1)
    assert not any((plan.dispersive, plan.checkered, plan.nested, plan.random))


def test_the_bench():
    plan = make_plan(bench(), BANDS, 4, 10, "float64")
    assert (plan.balls, plan.lamps, plan.planes) == (1, 0, 1)
    assert plan.dispersive
    assert plan.checkered
    assert not plan.nested
    assert not plan.random
    assert not plan.colour


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
    assert plan.colour
    assert plan.wavelengths_per_sample > 1
    assert plan_of(ball("N-BK7")).wavelengths_per_sample == 1


def test_of_traced_numbers_the_general_case_is_assumed():
    plans = []

    def traced(scene):
        plans.append(make_plan(scene, BANDS, 4, 10, "float64"))
        return scene.camera.look_from

    jax.jit(traced)(furnace(ball(1.5)))
    assert plans[0].dispersive
    assert plans[0].nested


def test_equal_plans_are_one_program():
    assert plan_of(ball("N-BK7")) == plan_of(ball("N-SF11", (0.1, 0, 0), 1.1))
    assert hash(plan_of(ball("N-BK7"))) == hash(plan_of(ball("N-SF11")))


@pytest.mark.parametrize(("samples", "depth"), [(0, 5), (-1, 5), (4, 0)])
def test_nothing_to_trace_is_refused(samples, depth):
    with pytest.raises(ValueError, match="at least 1"):
        plan_of(ball("N-BK7"), samples=samples, depth=depth)


def test_printed_plan_of_the_bench():
    assert str(make_plan(bench(), BANDS, 6, 10, "float32")).splitlines() == [
        "objects    1 glass, 0 lamps, 1 planes",
        "samples    6 a pixel, 3 x 2 grid",
        "depth      10 segments",
        "dtype      float32",
        "spectrum   one path for each band",
        "checker    over the footprint",
        "media      separate balls",
        "branches   summed, no noise",
    ]


@pytest.mark.parametrize(
    ("objects", "film", "lines"),
    [
        ((lamp((0, 0, 0), 1),), BANDS, ["depth      1: no glass", "spectrum   none: no glass"]),
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
