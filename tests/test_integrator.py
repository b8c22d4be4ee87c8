import itertools
from dataclasses import replace
from pathlib import Path as FilePath
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import AIR, N_D, ball, deviation, furnace, numbers, reflectance

from diffdisp import integrator
from diffdisp.camera import project
from diffdisp.dispersion import LINE_C, LINE_D, LINE_F
from diffdisp.film import Film
from diffdisp.fresnel import cos_transmitted, fresnel_reflectance
from diffdisp.geometry import Ray
from diffdisp.glasses import named_glass
from diffdisp.integrator import (
    Path,
    Setting,
    Tables,
    bounce,
    once,
    paint_table,
    through_ball,
    unentered,
    world_tables,
)
from diffdisp.planning import Plan, make_plan
from diffdisp.programs import COMPILER_OPTIONS, QUICK
from diffdisp.scene import Scene
from diffdisp.scene_file import load_scene
from diffdisp.vector import Vec3, vec3

FIXTURES = FilePath(__file__).parents[1] / "fixtures"
WATER = 1.33340
FILM = Film(1, 1, wavelengths=[0.5875618])
IMPACTS = (0.1, 0.5, 0.8, 0.95)
TURN = (np.cos(0.4), np.sin(0.4))


class Bench(NamedTuple):
    """A scene as the tracer wants it."""

    scene: Scene
    plan: Plan

    def bounce(self, path, n, chooses=0.0, inside=None):
        """One bounce; every ball but the first has index 1."""
        one = jnp.ones(())
        indices = jnp.stack([jnp.asarray(n), *[one] * (self.plan.balls - 1)])
        setting = Setting(
            tables=Tables(world_tables(self.scene), paint_table(self.scene)),
            plan=self.plan,
            draw=lambda bounces, decision: jnp.asarray(chooses),
            index_of=lambda ball: indices[ball],
            weights=None,
            always=None,
            split=None,
            cutoff=jnp.zeros(()),
            one=None,
            differentiable=True,
        )
        return bounce(path, setting, inside)


def tracer_bench(*objects, depth=50):
    scene = furnace(*objects)
    plan = make_plan(scene, FILM, 1, depth, "float64")
    return Bench(jax.tree.map(jnp.asarray, scene), plan)


@pytest.mark.parametrize("name", ["references/room", "scenes/default", "targets/ball_nbk7"])
def test_numpy_lays_out_what_jax_does(name):
    scene = load_scene(FIXTURES / f"{name}.toml")
    size = np.asarray(64.0), np.asarray(48.0)

    def tables(scene):
        return world_tables(scene), paint_table(scene), project(scene.camera, *size)

    found = tables(scene)
    assert not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(found))
    jax.tree.map(
        lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-15, atol=1e-15),
        found,
        jax.jit(tables)(scene),
    )


ALONE = tracer_bench(ball(N_D))
SURROUNDED = tracer_bench(ball(N_D), ball(AIR, radius=50.0))
"""What leaves the unit ball always meets the second: so its ray is kept."""


def path_at(impact):
    """A path that will meet the unit ball `impact` beside its centre, in a slanting plane."""
    still = Vec3(*[jnp.zeros(())] * 3)
    impact = jnp.asarray(impact)
    origin = Vec3(impact * TURN[0], impact * TURN[1], jnp.array(4.0))
    return Path(
        ray=Ray(origin, vec3(jnp.array([0, 0, -1.0]))),
        footprint=(Ray(still, still), Ray(still, still)),
        surface=jnp.array(0, jnp.int32),
        last=jnp.array(-1, jnp.int32),
        throughput=(jnp.ones(()),),
        radiance=(jnp.zeros(()),) * 3,
        bounces=jnp.array(0, jnp.int32),
        alive=jnp.array(True),
        spectral=None,
        reflected=None,
    )


@jax.jit
def leave(impact, n, order):
    """The ray of `order` that leaves the unit ball; order -1 is the outer reflection."""
    inner = path_at(impact)
    inner = jax.lax.fori_loop(0, order + 1, lambda _, p: SURROUNDED.bounce(p, n, 1 - 1e-12), inner)
    outer = SURROUNDED.bounce(inner, n, 0.0)
    return outer.ray, outer.surface


@jax.jit
def turned(impact, n, order):
    """Angle by which the path has been turned towards the axis, modulo a whole turn."""
    direction = leave(impact, n, order)[0].direction
    return jnp.arctan2(-direction.x * TURN[0] - direction.y * TURN[1], -direction.z)


SLOPES = jax.jit(jax.jacfwd(turned, argnums=(0, 1)))


def same_angle(found, expected, tolerance):
    apart = (found - expected + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(apart, 0, rtol=0, atol=tolerance)


@pytest.mark.parametrize("impact", IMPACTS)
@pytest.mark.parametrize("order", [-1, 0, 1, 2, 3])
@pytest.mark.parametrize("n", [WATER, N_D, 2.4175])
def test_deviation_of_an_order(impact, order, n):
    expected = deviation(np.arcsin(impact), n, order)
    # Some 1e-15 of rounding a surface, over cos r > 0.3.
    same_angle(turned(jnp.array(impact), jnp.array(n), order), expected, 1e-12)


@pytest.mark.parametrize("impact", IMPACTS)
@pytest.mark.parametrize("order", [-1, 0, 1, 2, 3])
def test_a_path_stays_in_its_plane_and_leaves_outwards(impact, order):
    ray, _ = leave(jnp.array(impact), jnp.array(N_D), order)
    origin, direction = numbers(ray.origin), numbers(ray.direction)
    across = np.array([-TURN[1], TURN[0], 0.0])
    # Rounding, as for all lengths below.
    np.testing.assert_allclose([origin @ across, direction @ across], 0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(origin), 1, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(direction), 1, rtol=0, atol=1e-13)
    assert origin @ direction > 0


@pytest.mark.parametrize("impact", IMPACTS)
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_derivative_of_the_deviation_in_the_index(impact, order):
    _, found = SLOPES(jnp.array(impact), jnp.array(N_D), order)
    refraction = np.arcsin(impact / N_D)
    expected = 2 * (order + 1) * np.tan(refraction) / N_D
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)  # rounding, as of the deviation


@pytest.mark.parametrize(("order", "degrees"), [(1, 137.981), (2, 230.996)])
def test_rainbows_of_water(order, degrees):
    # Descartes' ray: cos² i = (n² - 1) / (p (p + 2)).
    impact = float(np.sqrt(1 - (WATER**2 - 1) / (order * (order + 2))))
    arguments = jnp.array(impact), jnp.array(WATER)
    found = np.degrees(turned(*arguments, order)) % 360
    # The printed digits of the angle, and of the index: 5e-6 of it make 0.7 and 1.3 thousandths.
    np.testing.assert_allclose(found, degrees, rtol=0, atol=5.1e-4 + order * 7.3e-4)
    slope, _ = SLOPES(*arguments, order)
    np.testing.assert_allclose(slope, 0, rtol=0, atol=1e-12)  # least deviation, to rounding


def test_focal_length_of_a_ball_and_its_chromatic_shift():
    n_F, n_d, n_C = named_glass("N-BK7").indices(np.array([LINE_F, LINE_D, LINE_C]))
    np.testing.assert_allclose(
        paraxial_focus(n_d), 1.467492, rtol=0, atol=6e-7
    )  # the printed digits
    shift = paraxial_focus(n_F) - paraxial_focus(n_C)
    np.testing.assert_allclose(shift, -0.014989, rtol=0, atol=6e-7)  # the printed digits


def paraxial_focus(n):
    """Distance from the centre to where a ray close to the axis crosses it."""
    # Spherical aberration is of the order of impact² = 1e-8.
    ray, _ = leave(jnp.array(1e-4), jnp.array(float(n)), 0)
    beside = ray.origin.x * TURN[0] + ray.origin.y * TURN[1]
    slope = ray.direction.x * TURN[0] + ray.direction.y * TURN[1]
    return float(-(ray.origin.z - ray.direction.z * beside / slope))


@pytest.mark.parametrize("impact", IMPACTS)
@pytest.mark.parametrize("order", [-1, 0, 1, 2, 3])
def test_angular_momentum_of_what_leaves(impact, order):
    ray, caught = leave(jnp.array(impact), jnp.array(N_D), order)
    assert caught == 1
    momentum = np.linalg.norm(np.cross(numbers(ray.origin), numbers(ray.direction)))
    np.testing.assert_allclose(momentum, impact, rtol=0, atol=1e-13)  # rounding


ORIGIN = vec3(jnp.zeros(3))


@pytest.mark.parametrize("impact", [1e-9, *IMPACTS])
@pytest.mark.parametrize("order", [-1, 0, 1, 2, 3])
def test_a_ball_in_one_step(impact, order):
    expected, _ = leave(jnp.array(impact), jnp.array(N_D), order)
    found, meets = through_ball(
        path_at(impact).ray, ORIGIN, jnp.array(1.0), jnp.array(N_D), jnp.array(order + 2)
    )
    assert meets
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(numbers(one), numbers(other), rtol=0, atol=1e-12)


def slope_in_the_place(ray, center):
    """How the direction of what leaves the ball changes with all numbers of its centre."""

    def leaving(change):
        moved = Vec3(*(x + change for x in center))
        return through_ball(ray, moved, jnp.array(1.0), jnp.array(N_D), jnp.array(2))[0]

    return numbers(jax.jvp(leaving, (0.0,), (1.0,))[1].direction)


def test_a_ball_in_one_step_has_a_slope_on_its_axis():
    ray = path_at(0.0).ray
    close = slope_in_the_place(path_at(1e-7).ray, ORIGIN)
    np.testing.assert_allclose(slope_in_the_place(ray, ORIGIN), close, rtol=0, atol=1e-6)


@pytest.mark.parametrize("center", [(1.1, 0, 0), (0, 0, 9.0), (0, 0, 3.5)])
def test_a_ball_that_is_not_met_from_outside_in_one_step(center):
    ray, center = path_at(0.0).ray, vec3(jnp.array(center))
    assert not through_ball(ray, center, jnp.array(1.0), jnp.array(N_D), jnp.array(2))[1]
    assert np.isfinite(slope_in_the_place(ray, center)).all()


@jax.jit
def chords(impact, n):
    """The path within the ball alone after each of five bounces."""
    path = ALONE.bounce(unentered(path_at(impact)), n, inside=False)
    paths = [path]
    for _ in range(4):
        paths.append(ALONE.bounce(paths[-1], n, inside=True))
    return paths


def within(path):
    """Where a path within the unit ball is, and its direction."""
    a, b, r, s = (float(x) for x in path.chord.place)
    normal, direction = numbers(path.ray.origin), numbers(path.ray.direction)
    return a * normal + b * direction, r * normal + s * direction


@pytest.mark.parametrize("impact", [0.0, 1e-9, *IMPACTS, 1 - 1e-12])
def test_chords_of_a_ball_alone(impact):
    refraction = np.arcsin(impact / N_D)
    paths = chords(jnp.array(impact), jnp.array(N_D))
    rays = [within(path) for path in paths]
    for origin, direction in rays:
        momentum = N_D * np.linalg.norm(np.cross(origin, direction))
        np.testing.assert_allclose(momentum, impact, rtol=0, atol=1e-13)  # rounding, as below
        np.testing.assert_allclose(origin @ direction, -np.cos(refraction), rtol=0, atol=1e-13)
    for (_, here), (_, there) in itertools.pairwise(rays):
        turn = here @ there
        np.testing.assert_allclose(turn, -np.cos(2 * refraction), rtol=0, atol=1e-13)


EDGES = (
    Ray(vec3(jnp.array([0.3, 0.1, 0.0])), vec3(jnp.array([0.02, -0.01, 0.0]))),
    Ray(vec3(jnp.array([-0.1, 0.2, 0.0])), vec3(jnp.array([0.0, 0.03, 0.0]))),
)


@pytest.fixture
def ways(monkeypatch):
    """Ways from a ball, as bounces send them out."""
    found = []

    def arrive(way, path, radiance, *_):
        found.append(way)
        return path.surface, radiance

    monkeypatch.setattr(integrator, "_arrive", arrive)
    return found


@pytest.mark.parametrize("impact", [1e-9, *IMPACTS])
def test_footprints_of_what_leaves_a_ball_alone(impact, ways):
    path = unentered(path_at(impact)._replace(footprint=EDGES))
    for order in range(-1, 4):
        path = ALONE.bounce(path, jnp.array(N_D), inside=order >= 0)

        def left(ray, order=order):
            place = jnp.array(order + 2)
            return through_ball(ray, ORIGIN, jnp.array(1.0), jnp.array(N_D), place)[0]

        for edge, found in zip(EDGES, ways[-1].footprint, strict=True):
            _, expected = jax.jvp(left, (path_at(impact).ray,), (edge,))
            for one, other in zip(found, expected, strict=True):
                np.testing.assert_allclose(numbers(one), numbers(other), rtol=0, atol=1e-10)


@pytest.mark.parametrize("impact", [0.5, 0.95, 1.02])
def test_soft_outlines_of_a_ball_alone_and_among_others(impact, ways):
    soft = ALONE._replace(plan=replace(ALONE.plan, soft=True))
    entered = path_at(impact)._replace(footprint=EDGES)
    inner, chord = entered, unentered(entered)
    for order in range(-1, 3):
        inner, chord = (
            soft.bounce(inner, jnp.array(N_D)),
            soft.bounce(chord, jnp.array(N_D), inside=order >= 0),
        )
        among, alone = ways[-2:]
        jax.tree.map(
            lambda one, other: np.testing.assert_allclose(one, other, rtol=0, atol=1e-11),
            alone,
            among,
        )


@pytest.mark.parametrize("impact", IMPACTS)
def test_weights_of_the_orders(impact):
    R = reflectance(np.arcsin(impact), N_D)
    paths = chords(jnp.array(impact), jnp.array(N_D))
    light = np.diff([0.0, *(path.radiance[0] for path in paths)])
    # R outside, then (1 - R)² Rᵖ; what is left in the ball after them is (1 - R) Rᵖ.
    powers = R ** np.arange(5)
    np.testing.assert_allclose(
        light, [R, *(1 - R) ** 2 * powers[:4]], rtol=0, atol=1e-12
    )  # rounding
    throughput = [path.throughput[0] for path in paths]
    np.testing.assert_allclose(throughput, (1 - R) * powers, rtol=0, atol=1e-12)
    np.testing.assert_allclose(light.sum() + throughput[-1], 1, rtol=0, atol=1e-12)
    assert [int(path.bounces) for path in paths] == [1, 2, 3, 4, 5]


def reflected(impact, n):
    """Reflectance where a ray meets the unit ball."""
    cos_i = jnp.sqrt(1 - impact**2)
    return fresnel_reflectance(cos_i, cos_transmitted(cos_i, n), n)


def collected(impact, n):
    """Light after each of five bounces."""
    return jnp.stack([path.radiance[0] for path in chords(impact, n)])


COLLECTED_SLOPE = jax.jit(jax.jacfwd(collected, argnums=1))


@pytest.mark.parametrize("impact", IMPACTS)
def test_slope_of_the_weights_in_the_index(impact):
    arguments = jnp.array(impact), jnp.array(N_D)
    R, slope = float(reflected(*arguments)), float(jax.grad(reflected, argnums=1)(*arguments))
    # The sum up to order p is 1 - (1 - R) Rᵖ⁺¹; the outer reflection stands first.
    p = np.arange(5.0)
    expected = slope * (R**p - (1 - R) * p * R ** np.maximum(p - 1, 0))
    np.testing.assert_allclose(
        COLLECTED_SLOPE(*arguments), expected, rtol=0, atol=1e-12
    )  # rounding


def test_the_last_order_ends_the_path():
    shallow = tracer_bench(ball(N_D), depth=3)
    entered = jax.jit(lambda path: shallow.bounce(path, N_D, inside=False))(unentered(path_at(0.5)))
    assert entered.alive
    ended = jax.jit(lambda path: shallow.bounce(path, N_D, inside=True))(entered)
    assert not ended.alive
    np.testing.assert_array_equal(numbers(ended.ray.origin), numbers(entered.ray.origin))


def test_a_path_that_has_ended_collects_nothing():
    ended = unentered(path_at(jnp.array(0.5))._replace(alive=jnp.array(False)))
    after = jax.jit(lambda path: ALONE.bounce(path, N_D, inside=False))(ended)
    jax.tree.map(np.testing.assert_array_equal, after, ended)


def test_once_is_the_stage_itself():
    def stage():
        return jnp.arange(3.0), jnp.array(2, jnp.int32)

    repeated = once(stage, jnp.array(1, jnp.int32))
    jax.tree.map(np.testing.assert_array_equal, repeated, stage())
    jax.tree.map(np.testing.assert_array_equal, once(stage, None), stage())


@pytest.mark.parametrize("one", [None, jnp.array(1, jnp.int32)], ids=["barrier", "branch"])
@pytest.mark.parametrize("options", [COMPILER_OPTIONS, QUICK], ids=["options", "quick"])
def test_what_is_computed_once_is_not_fused_with_its_users(one, options):
    def staged(x, one):
        return jnp.cos(once(lambda: jnp.sin(x), one))

    compiled = jax.jit(staged, compiler_options=options).lower(jnp.ones(100), one).compile()
    functions = compiled.as_text().split("\n\n")
    sines, cosines = ({f for f in functions if f" {name}(" in f} for name in ("sine", "cosine"))
    assert sines
    assert cosines
    assert not sines & cosines
