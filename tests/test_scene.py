import jax
import numpy as np
import pytest
from helpers import AIR, BK7, ball, bench, camera, lamp, screen

from diffdisp.dispersion import Sellmeier
from diffdisp.geometry import Plane, Sphere
from diffdisp.glasses import named_glass
from diffdisp.material import Dielectric, Emitter, Lambertian, Metal
from diffdisp.scene import (
    Object,
    Scene,
    is_glass,
    object_glass,
    texture_of,
    with_glass,
    without_names,
)
from diffdisp.texture import Checker, Checker2D, Solid

CHECKER = Checker2D([1.0] * 3, [0.0] * 3, 0.5)


def test_every_real_number_is_a_leaf():
    leaves = jax.tree.leaves(bench())
    assert all(leaf.dtype == np.float64 for leaf in leaves)
    # Camera 3 + 3 + 3 + 1, ball 3 + 1 + 3 + 3 + 2, screen 3 + 3 + 3 + 3 + 1 + 1, background 3.
    assert sum(leaf.size for leaf in leaves) == 39


def test_numbers_are_no_structure():
    assert jax.tree.structure(bench(tile=0.5)) == jax.tree.structure(bench(tile=0.7))
    assert jax.tree.structure(bench()) != jax.tree.structure(Scene(camera(), ()))


@pytest.mark.parametrize(
    ("shape", "material", "message"),
    [
        (Plane([0, 0, 0], [0, 0, 1]), Dielectric(AIR), "plane cannot be glass"),
        (Sphere([0, 0, 0], 1), Emitter(CHECKER), "sphere cannot carry a checker2d"),
        (Sphere([0, 0, 0], 1), Lambertian(CHECKER), "sphere cannot carry a checker2d"),
        (Sphere([0, 0, 0], 1), Metal(CHECKER), "sphere cannot carry a checker2d"),
    ],
)
def test_pairs_that_mean_nothing_are_refused(shape, material, message):
    with pytest.raises(ValueError, match=message):
        Object(shape, material)


@pytest.mark.parametrize("material", [Lambertian, Metal, Emitter])
def test_other_pairs_are_scenes(material):
    cubes = Checker([1.0] * 3, [0.0] * 3)
    for shape, texture in [
        (Plane([0, 0, 0], [0, 0, 1]), CHECKER),
        (Plane([0, 0, 0], [0, 0, 1]), cubes),
        (Sphere([0, 0, 0], 1), cubes),
        (Sphere([0, 0, 0], 1), Solid([1.0, 0.5, 0.0])),
    ]:
        assert texture_of(Object(shape, material(texture)).material) is texture
    assert texture_of(Dielectric(AIR)) is None


def test_a_named_glass_is_looked_up():
    np.testing.assert_array_equal(Dielectric("N-BK7").glass.B, named_glass("N-BK7").B)


def test_glass_objects():
    objects = [screen(), ball(AIR, name="a"), lamp((0, 3, 0), 1), ball(1.5, (5, 0, 0), name="b")]
    scene = Scene(camera(), objects)
    assert isinstance(scene.objects, tuple)
    assert [is_glass(obj) for obj in scene.objects] == [False, True, False, True]
    assert object_glass(scene, 1) is AIR
    with pytest.raises(ValueError, match=r"object\[0\] is not glass"):
        object_glass(scene, 0)


def test_exchanging_the_glass_leaves_the_rest():
    old, glass = bench(), Sellmeier([1.0, 0, 0], [0.01, 0, 0])
    new = with_glass(old, 0, glass)
    assert object_glass(new, 0) is glass
    assert object_glass(old, 0) is BK7
    assert new.objects[0].name == "ball"
    assert new.objects[1] is old.objects[1]
    assert new.camera is old.camera
    assert new.background is old.background


def test_defaults():
    np.testing.assert_array_equal(Scene(camera(), ()).background.color, 0)
    assert lamp((0, 0, 0), 1).material.intensity == 1
    assert Metal([1, 1, 1]).fuzz == 0
    assert Checker([1, 1, 1], [0, 0, 0]).scale == 10


def test_without_names_a_surface_is_the_same():
    matte = Object(Sphere([0, 0, 0], 1), Lambertian([1, 1, 1]), "ground")
    (nameless,) = without_names(Scene(camera(), [matte])).objects
    assert nameless.name == ""
    assert nameless.material is matte.material
