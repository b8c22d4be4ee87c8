import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import BK7, ball, bench, camera, ground

from diffdisp.film import Film
from diffdisp.material import Lambertian
from diffdisp.parameters import named_parameters, value_at, with_coordinates
from diffdisp.rendering import render
from diffdisp.scene import Scene
from diffdisp.texture import Checker

LENGTH = 2.0


def test_names_stand_for_all_their_numbers():
    found = named_parameters(bench(), ("ball.center", "screen.tile", "camera.look_at.z"), LENGTH)
    assert [parameter.name for parameter in found] == [
        *("ball.center.x", "ball.center.y", "ball.center.z"),
        *("screen.tile", "camera.look_at.z"),
    ]
    assert [value_at(bench(), p.place) for p in found] == [0.0, 0.0, 0.0, 0.5, 0.0]
    assert [parameter.unit for parameter in found] == [LENGTH] * 3 + [1.0, LENGTH]


def test_objects_without_a_name_go_by_their_number():
    earth = ground(Lambertian(Checker([1.0] * 3, [0.0] * 3, 3.0)))
    scene = Scene(camera(), (ball(BK7), earth))
    names = ("object[0].radius", "object[1].normal", "object[1].scale", "object[1].even.y")
    found = named_parameters(scene, names, LENGTH)
    assert [value_at(scene, p.place) for p in found] == [1.0, 0.0, 1.0, 0.0, 3.0, 1.0]


EVERYTHING = (
    *("camera.look_from", "camera.look_at", "camera.up", "camera.vertical_fov"),
    *("background.color", "ball.center", "ball.radius"),
    *("screen.point", "screen.normal", "screen.intensity"),
    *("screen.even", "screen.odd", "screen.tile"),
)


def test_each_coordinate_changes_its_own_number_alone():
    scene = bench()
    found = named_parameters(scene, EVERYTHING, LENGTH)
    places, units = tuple(p.place for p in found), np.array([p.unit for p in found])
    before = np.array([value_at(scene, place) for place in places])
    for number, parameter in enumerate(found):
        moved = with_coordinates(scene, places, units, 0.1 * np.eye(len(found))[number])
        after = np.array([value_at(moved, place) for place in places])
        expected = before.copy()
        expected[number] += 0.1 * parameter.unit
        if parameter.name.rpartition(".")[2] in ("radius", "tile", "intensity", "vertical_fov"):
            expected[number] = before[number] * np.exp(0.1)
        np.testing.assert_allclose(after, expected, rtol=1e-15, atol=1e-16)
    # All leaves are reached but the ball's B, C and validity, three each bar the last's two.
    leaves = sum(np.size(leaf) for leaf in jax.tree.leaves(scene))
    assert len(found) == leaves - 8


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["ball.centre"], "'ball.centre' can be free: allowed are camera.look_from"),
        (["center"], "'center'"),
        (["ball"], "'ball'"),
        (["ball.radius.x"], "'ball.radius.x'"),
        (["ball.center.w"], "'ball.center.w'"),
        (["ball.tile"], "'ball.tile'"),
        ([""], "''"),
        (["ball.center", "ball.center.y"], "ball.center.y is free twice"),
        (["ball.radius", "ball.radius"], "ball.radius is free twice"),
    ],
)
def test_a_name_that_means_nothing_is_refused(names, words):
    with pytest.raises(ValueError, match=words.replace("[", r"\[")):
        named_parameters(bench(), names, LENGTH)


def test_what_is_above_0_has_to_start_there():
    dark = with_coordinates(bench(), (), np.zeros(0), np.zeros(0))
    texture = dark.objects[1].material
    dark = jax.tree.map(lambda leaf: leaf * 0 if leaf is texture.intensity else leaf, dark)
    with pytest.raises(ValueError, match=r"screen.intensity is 0 in the scene"):
        named_parameters(dark, ["screen.intensity"], LENGTH)


def test_pictures_can_be_differentiated_in_coordinates():
    found = named_parameters(
        bench(), ["ball.center.x", "screen.tile", "camera.vertical_fov"], LENGTH
    )
    places, units = tuple(p.place for p in found), np.array([p.unit for p in found])
    film = Film(6, 6, np.array([0.55]))

    @jax.jit
    def picture(coordinates: jax.Array) -> jax.Array:
        scene = with_coordinates(bench(), places, units, coordinates)
        return render(scene, film, samples=4, dtype="float64")

    # Not at 0: there all is symmetric, and where footprints begin to touch an edge slopes jump.
    at, h = jnp.asarray([0.0065, 0.001, 0.002]), 1e-6
    slopes = jax.jit(jax.jacfwd(picture))(at)
    for number, move in enumerate(h * np.eye(len(found))):
        difference, slope = (picture(at + move) - picture(at - move)) / (2 * h), slopes[..., number]
        assert np.max(np.abs(difference)) > 0.05
        # Values near 1 over 2e-6 are rounded to 1e-10; a difference errs by the square of 1e-6.
        np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-6 * np.max(np.abs(slope)))
