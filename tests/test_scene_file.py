import dataclasses
import json
import math
import pickle
import random
import tomllib
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from diffdisp.camera import Camera
from diffdisp.dispersion import Sellmeier
from diffdisp.geometry import Plane, Sphere
from diffdisp.glasses import named_glass
from diffdisp.material import Dielectric, Emitter, Lambertian, Metal
from diffdisp.scene import Background, Object, Scene
from diffdisp.scene_file import SceneError, load_scene, save_scene, scene_from_toml, scene_schema
from diffdisp.texture import Checker, Checker2D, Solid

FIXTURES = Path(__file__).parents[1] / "fixtures"
SAMPLES = [*sorted((FIXTURES / "scenes").glob("*.toml")), FIXTURES / "targets" / "ball_nbk7.toml"]

GOOD = """\
[camera]
look_from = [0, 0, 4]
look_at = [0, 0, 0]
up = [0, 1, 0]
vertical_fov = 34
[background]
color = [0, 0, 0]
[[object]]
name = "ball"
shape = { type = "sphere", center = [0, 0, 0], radius = 1 }
material = { type = "dielectric", glass = "N-BK7" }
[[object]]
name = "screen"
shape = { type = "plane", point = [0, 0, -3], normal = [0, 0, 1] }
[object.material]
type = "emitter"
intensity = 2
[object.material.texture]
type = "checker2d"
even = [1, 1, 1]
odd = [0.1, 0.1, 0.1]
tile = 0.5
"""
CAMERA = "[camera]\nlook_from = [0, 0, 4]\nlook_at = [0, 0, 0]\n"


def with_line(number: int, text: str) -> str:
    """The good scene with one line replaced."""
    lines = GOOD.splitlines()
    lines[number - 1] = text
    return "\n".join(lines)


def problems(text: str) -> list[str]:
    with pytest.raises(SceneError) as caught:
        scene_from_toml(text, "bad.toml")
    assert str(caught.value) == "\n".join(caught.value.problems)
    return caught.value.problems


def emitter(texture) -> Emitter:
    return Emitter(texture, 3.0)


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.name)
def test_saved_scene_loads_equal(path, tmp_path):
    scene = load_scene(path)
    save_scene(scene, tmp_path / "saved.toml")
    assert eqx.tree_equal(load_scene(tmp_path / "saved.toml"), scene)
    assert [file.name for file in tmp_path.iterdir()] == ["saved.toml"]


@pytest.mark.parametrize(
    "glass",
    [
        named_glass("N-BK7"),
        Sellmeier([1.1, 0.2, 1 / 3], [0.006, 0.02, 103.0]),
        Sellmeier([1.1, 0.2, 0.9], [0.006, 0.02, 103.0], (0.3, 2.5), "my own"),
        Sellmeier([1.1, 0.2, 0.9], [0.006, 0.02, 103.0], name="N-BK7"),
        Sellmeier(named_glass("N-BK7").B, named_glass("N-BK7").C),
        Sellmeier(named_glass("N-BK7").B, named_glass("N-BK7").C, (0.4, 0.7), "N-BK7"),
    ],
)
def test_every_glass_survives_saving(glass, tmp_path):
    ball = Object(Sphere([0, 0.1, 1e-30], 1e20), Dielectric(glass), 'a "name"\n[\n 1,\n] µ')
    save_scene(Scene(Camera([0, 0, 4], [0, 0, 0]), [ball]), tmp_path / "s.toml")
    assert eqx.tree_equal(load_scene(tmp_path / "s.toml").objects, (ball,))


def test_only_an_equal_glass_is_written_by_name(tmp_path):
    own = Sellmeier([1.0, 0.2, 0.9], [0.006, 0.02, 103.0], name="N-BK7")
    balls = [Object(Sphere([0, 0, 0], 1.0), Dielectric(g)) for g in (named_glass("N-BK7"), own)]
    save_scene(Scene(Camera([0, 0, 4], [0, 0, 0]), balls), tmp_path / "s.toml")
    saved = tomllib.loads((tmp_path / "s.toml").read_text(encoding="utf-8"))
    by_name, by_number = (table["material"] for table in saved["object"])
    assert by_name == {"type": "dielectric", "glass": "N-BK7"}
    assert by_number.keys() == {"type", "B", "C", "name"}


def test_jax_arrays_are_saved(tmp_path):
    ball = Object(Sphere(jnp.zeros(3), jnp.array(2.0)), emitter(Solid(jnp.ones(3))))
    save_scene(Scene(Camera([0, 0, 4], [0, 0, 0]), [ball]), tmp_path / "s.toml")
    assert load_scene(tmp_path / "s.toml").objects[0].shape.radius == 2.0


@pytest.mark.parametrize(
    "texture",
    [
        Solid([0.2, 1 / 3, 1]),
        Checker([0, 0, 0], [1, 1, 1]),
        Checker([0, 0.1, 0], [1, 1, 1], 1 / 3),
        Checker2D([0, 0, 0.5], [1, 1, 1], 1 / 3),
    ],
)
def test_every_surface_survives_saving(texture, tmp_path):
    shapes = [Plane([0, 0, 0], [0, 1, 0]), Sphere([0, 0, 0], 1.0)]
    if isinstance(texture, Checker2D):
        shapes.pop()
    materials = [Lambertian(texture), Metal(texture), Metal(texture, 1 / 3), Emitter(texture, 1e9)]
    objects = tuple(Object(shape, material) for shape in shapes for material in materials)
    save_scene(Scene(Camera([0, 0, 4], [0, 0, 0]), objects), tmp_path / "s.toml")
    assert eqx.tree_equal(load_scene(tmp_path / "s.toml").objects, objects)


def test_triples_are_saved_on_one_line(tmp_path):
    save_scene(scene_from_toml(GOOD), tmp_path / "s.toml")
    saved = (tmp_path / "s.toml").read_text(encoding="utf-8")
    assert "\nlook_from = [0.0, 0.0, 4.0]\n" in saved


def test_defaults():
    scene = scene_from_toml(
        CAMERA + '[[object]]\nshape = {type = "sphere", center = [1, 2, 3], '
        'radius = 1}\nmaterial = {type = "emitter", texture = [1, 1, 0]}'
    )
    expected = Scene(
        Camera([0, 0, 4], [0, 0, 0], [0, 1, 0], 45.0),
        [Object(Sphere([1, 2, 3], 1.0), Emitter(Solid([1, 1, 0]), 1.0), "")],
        Background([0, 0, 0]),
    )
    assert eqx.tree_equal(scene, expected)


def test_a_scene_may_be_empty(tmp_path):
    scene = scene_from_toml(CAMERA)
    assert scene.objects == ()
    save_scene(scene, tmp_path / "empty.toml")
    assert eqx.tree_equal(load_scene(tmp_path / "empty.toml"), scene)


def test_defaults_of_surfaces():
    ground = (
        f'{CAMERA}[[object]]\nshape = {{type = "plane", point = [0, 1, 0], normal = [0, 1, 0]}}\n'
    )
    checker = '{type = "checker", even = [0, 0, 0], odd = [1, 1, 1]}'
    (matte,) = scene_from_toml(
        f'{ground}material = {{type = "lambertian", texture = {checker}}}'
    ).objects
    (metal,) = scene_from_toml(
        f'{ground}material = {{type = "metal", texture = [1, 0.5, 0]}}'
    ).objects
    assert eqx.tree_equal(matte.material, Lambertian(Checker([0, 0, 0], [1, 1, 1], 10.0)))
    assert eqx.tree_equal(metal.material, Metal(Solid([1, 0.5, 0]), 0.0))


def test_only_a_lamp_may_be_brighter_than_white():
    texture = '{type = "checker", even = [2, 3, 4], odd = [0, 0, 0], scale = 20}'
    text = f'{CAMERA}[[object]]\n{BALL % 1}\nmaterial = {{type = "emitter", texture = {texture}}}'
    (lamp,) = scene_from_toml(text).objects
    assert eqx.tree_equal(lamp.material, Emitter(Checker([2, 3, 4], [0, 0, 0], 20.0)))
    with pytest.raises(SceneError, match=r"texture\.even\[2\]: found 4; allowed: .* from 0 to 1"):
        scene_from_toml(text.replace("emitter", "lambertian"))


def test_all_kinds_are_read():
    scene = scene_from_toml(GOOD)
    expected = Scene(
        Camera([0, 0, 4], [0, 0, 0], [0, 1, 0], 34.0),
        [
            Object(Sphere([0, 0, 0], 1.0), Dielectric("N-BK7"), "ball"),
            Object(
                Plane([0, 0, -3], [0, 0, 1]),
                Emitter(Checker2D([1, 1, 1], [0.1, 0.1, 0.1], 0.5), 2.0),
                "screen",
            ),
        ],
    )
    assert eqx.tree_equal(scene, expected)


def test_coefficients_with_validity_and_name():
    material = (
        '{type = "dielectric", B = [1, 0, 0], C = [0.01, 0, 0], validity = [0.3, 2], name = "x"}'
    )
    glass = scene_from_toml(with_line(11, f"material = {material}")).objects[0].material.glass
    assert eqx.tree_equal(glass, Sellmeier([1, 0, 0], [0.01, 0, 0], (0.3, 2.0), "x"))


BALL = 'shape = { type = "sphere", center = [0, 0, 0], radius = %s }'
GLASS = 'material = { type = "dielectric", %s }'
THREE = "three finite numbers"

BAD = [
    # replaced line, its new text, path, line told, phrase
    (1, "[kamera]", "camera", 1, "missing; required: a [camera] table"),
    (1, "[kamera]", "kamera", 1, "unknown field; allowed: camera, background, object"),
    (2, "", "camera.look_from", 1, "missing; required: three finite numbers"),
    (2, "look_from = [0, 0]", "camera.look_from", 2, "found [0, 0]; allowed: three"),
    (2, "look_from = [0, 0, 4, 1]", "camera.look_from", 2, "found [0, 0, 4, 1]; allowed: three"),
    (2, "look_from = [0, nan, 4]", "camera.look_from[1]", 2, "found nan; allowed: " + THREE),
    (2, "look_from = [0,\n0,\n-inf\n]", "camera.look_from[2]", 4, "found -inf; allowed: " + THREE),
    (2, 'look_from = [0, 0, "4"]', "camera.look_from[2]", 2, 'found "4"; allowed: ' + THREE),
    (2, "look_from = [0, 0, true]", "camera.look_from[2]", 2, "found true; allowed: " + THREE),
    (2, "look_from = 4", "camera.look_from", 2, "found 4; allowed: " + THREE),
    (2, "look_from.x = 4", "camera.look_from", 2, "found a table; allowed: " + THREE),
    (3, "look_at = [0, 0.0, 4]", "camera.look_at", 3, "the same point as look_from"),
    (4, "up = [0, 0, -2]", "camera.up", 4, "parallel to the view"),
    (4, "up = [0, 0, 0]", "camera.up", 4, "not all zero"),
    (2, "look_from = [0, 5, 0]", "camera.up", 4, "parallel to the view"),
    (5, "vertical_fov = 0", "camera.vertical_fov", 5, "found 0; allowed: degrees, above 0"),
    (5, "vertical_fov = 180.0", "camera.vertical_fov", 5, "found 180.0; allowed: degrees"),
    (5, "vertical_fov = 2024-02-01", "camera.vertical_fov", 5, "found 2024-02-01; allowed:"),
    (5, "vfov = 30", "camera.vfov", 5, "allowed: look_from, look_at, up, vertical_fov"),
    (5, '"v fov" = 30', 'camera."v fov"', 5, "unknown field"),
    (7, "color = [0, -0.1, 0]", "background.color[1]", 7, "found -0.1; allowed: three finite"),
    (7, "colour = [0, 0, 0]", "background.colour", 7, "unknown field; allowed: color"),
    (9, "name = 3", "object[0].name", 9, "found 3; allowed: a text"),
    (10, "", "object[0].shape", 8, "missing; required: a table whose type is one of sphere, plane"),
    (10, "shape = 'ball'", "object[0].shape", 10, 'found "ball"; allowed: a table'),
    (10, "shape = [1, 2]", "object[0].shape", 10, "found [1, 2]; allowed: a table"),
    (10, "shape = {}", "object[0].shape.type", 10, "missing; required: sphere or plane"),
    (10, "shape = {type = 1}", "object[0].shape.type", 10, "found 1; allowed: sphere or plane"),
    (10, "shape.type = 'cube'", "object[0].shape.type", 10, 'found "cube"; allowed: sphere or pl'),
    (10, BALL % 0, "object[0].shape.radius", 10, "found 0; allowed: a finite number > 0"),
    (10, BALL % -2.5, "object[0].shape.radius", 10, "found -2.5; allowed: a finite number > 0"),
    (10, BALL % "inf", "object[0].shape.radius", 10, "found inf; allowed: a finite number > 0"),
    (10, BALL % '"1"', "object[0].shape.radius", 10, 'found "1"; allowed: a finite number'),
    (10, BALL % "true", "object[0].shape.radius", 10, "found true; allowed: a finite number"),
    (10, BALL % ("0x" + 400 * "f"), "object[0].shape.radius", 10, "an integer of 1600 bits"),
    (10, BALL % "1, fuzz = 1", "object[0].shape.fuzz", 10, "allowed: type, center, radius"),
    (11, "", "object[0].material", 8, "one of lambertian, metal, dielectric, emitter"),
    (
        11,
        'material.type = "velvet"',
        "object[0].material.type",
        11,
        'found "velvet"; allowed: lambertian, metal, dielectric or emitter',
    ),
    (
        11,
        'material = { type = "dielectric" }',
        "object[0].material.glass",
        11,
        "missing; required: the name of a glass",
    ),
    (11, GLASS % 'glass = "N-BK8"', "object[0].material.glass", 11, "similar are N-BK7"),
    (11, "material.type='glass by name'", "object[0].material.type", 11, "allowed: lambertian"),
    (11, GLASS % "glass = 7", "object[0].material.glass", 11, "found 7; allowed: the name"),
    (11, GLASS % "B = [1, 1, 1]", "object[0].material.C", 11, "missing; required: three finite"),
    (11, GLASS % "C = [1, 1, 1]", "object[0].material.B", 11, "missing; required: three finite"),
    (11, GLASS % "B = [1, 1], C = [1, 1, 1]", "object[0].material.B", 11, "found [1, 1]"),
    (11, GLASS % "B = [1, 1, 1], C = [1, 1, nan]", "object[0].material.C[2]", 11, "found nan"),
    (11, GLASS % 'glass = "N-BK7", B = [1, 1, 1]', "object[0].material.B", 11, "either glass, or"),
    (11, GLASS % 'glass = "N-BK7", name = "x"', "object[0].material.name", 11, "not together with"),
    (11, GLASS % 'glass = "N-BK7", n = 1.5', "object[0].material.n", 11, "unknown field; allowed"),
    (
        11,
        GLASS % "B = [1, 0, 0], C = [0, 0, 0], validity = [2, 1]",
        "object[0].material.validity",
        11,
        "low < high",
    ),
    (
        11,
        GLASS % "B = [1, 0, 0], C = [0, 0, 0], validity = [1]",
        "object[0].material.validity",
        11,
        "found [1]; allowed: [low, high] in µm",
    ),
    (13, 'name = "ball"', "object[1].name", 13, 'found "ball", the name of object[0]'),
    (
        14,
        'shape = { type = "plane", point = [0, 0, -3], normal = [0, 0, 0] }',
        "object[1].shape.normal",
        14,
        "found [0, 0, 0]; allowed: three numbers, not all zero",
    ),
    (14, BALL % 1, "object[1].material", 15, "a sphere cannot carry a checker2d"),
    (16, 'type = "wax"', "object[1].material.type", 16, 'found "wax"; allowed: lambertian, metal'),
    (16, 'type = "metal"', "object[1].material.intensity", 17, "allowed: type, texture, fuzz"),
    (17, "intensity = -1", "object[1].material.intensity", 17, "found -1; allowed: a finite"),
    (
        19,
        'type = "marble"',
        "object[1].material.texture.type",
        19,
        'found "marble"; allowed: solid, checker or checker2d',
    ),
    (
        19,
        'type="checker"',
        "object[1].material.texture.tile",
        22,
        "allowed: type, even, odd, scale",
    ),
    (20, "even = [1, 1, -1]", "object[1].material.texture.even[2]", 20, "found -1"),
    (21, "", "object[1].material.texture.odd", 18, "missing; required: three finite numbers ≥ 0"),
    (
        22,
        "tile = 0",
        "object[1].material.texture.tile",
        22,
        "found 0; allowed: a finite number > 0",
    ),
    (22, "tile = -0.5", "object[1].material.texture.tile", 22, "found -0.5; allowed"),
]


@pytest.mark.parametrize(("replaced", "new", "path", "line", "phrase"), BAD)
def test_a_mistake_is_told_with_line_path_and_what_is_allowed(replaced, new, path, line, phrase):
    found = problems(with_line(replaced, new))
    matching = [text for text in found if text.startswith(f"bad.toml:{line}: {path}: ")]
    assert len(matching) == 1, found
    assert phrase in matching[0]
    # Only the misspelt [kamera] is two mistakes: one table too many and one too few.
    assert len(found) == (2 if new == "[kamera]" else 1)


@pytest.mark.parametrize(
    ("texture", "path", "phrase"),
    [
        ("[1, -2, 3]", "texture[1]", "found -2; allowed: three finite numbers ≥ 0"),
        ("[1, 2]", "texture", "found [1, 2]; allowed: three finite numbers ≥ 0"),
        ("true", "texture", "found true; allowed: three finite numbers ≥ 0, or a table"),
        ('{ type = "solid", color = [1, nan, 1] }', "texture.color[1]", "found nan"),
    ],
)
def test_a_bad_texture_is_told(texture, path, phrase):
    shape = 'shape = { type = "sphere", center = [0, 0, 0], radius = 1 }'
    material = f'material = {{ type = "emitter", texture = {texture} }}'
    (found,) = problems(f"{CAMERA}[[object]]\n{shape}\n{material}\n")
    assert found.startswith(f"bad.toml:6: object[0].material.{path}: {phrase}")


COLOR = "three finite numbers ≥ 0"
ALBEDO = "three finite numbers from 0 to 1"
MATTE = 'type = "lambertian", texture = %s'
METAL = 'type = "metal", texture = [1, 1, 1]'
CHECKER = '{ type = "checker", even = [0, 0, 0], odd = [1, 1, 1]%s }'


@pytest.mark.parametrize(
    ("material", "told"),
    [
        ('type = "lambertian"', [f"texture: missing; required: {ALBEDO}, or a table"]),
        ('type = "metal"', [f"texture: missing; required: {ALBEDO}, or a table"]),
        ('type = "emitter"', [f"texture: missing; required: {COLOR}, or a table"]),
        (MATTE % "true", [f"texture: found true; allowed: {ALBEDO}, or a table whose type is one"]),
        (MATTE % '"red"', ['texture: found "red"; allowed: three']),
        (MATTE % "[1, 2]", [f"texture: found [1, 2]; allowed: {ALBEDO}"]),
        (MATTE % "[1, nan, -1]", [f"texture[{i}]: found {x}; allowed: {ALBEDO}" for i, x in
                                  [(1, "nan"), (2, "-1")]]),
        (MATTE % "[inf, 0, 0]", [f"texture[0]: found inf; allowed: {ALBEDO}"]),
        (MATTE % f"[0x{400 * 'f'}, 0, 0]", ["texture[0]: found an integer of 1600 bits; allowed:"]),
        (MATTE % "[true, 0, 0]", ["texture[0]: found true; allowed: "]),
        (MATTE % '[1, "0.5", 1]', ['texture[1]: found "0.5"; allowed: ']),
        (MATTE % "[0, 0, 1.5]", [f"texture[2]: found 1.5; allowed: {ALBEDO}"]),
        (MATTE % "[1, 1, 1], fuzz = 0", ["fuzz: unknown field; allowed: type, texture"]),
        (MATTE % '{ type = "solid", color = [0, 2, 0] }',
         [f"texture.color[1]: found 2; allowed: {ALBEDO}"]),
        (MATTE % '{ type = "solid", color = [0, -2, 0] }',
         [f"texture.color[1]: found -2; allowed: {ALBEDO}"]),
        (MATTE % '{ type = "checker", even = [1, 1, 7], odd = [1.1, 0, 0], scale = 0 }',
         ["texture.scale: found 0; allowed: a finite number > 0",
          f"texture.even[2]: found 7; allowed: {ALBEDO}",
          f"texture.odd[0]: found 1.1; allowed: {ALBEDO}"]),
        (MATTE % CHECKER % ", scale = -10", ["texture.scale: found -10; allowed: a finite number"]),
        (MATTE % CHECKER % ", scale = nan", ["texture.scale: found nan; allowed: a finite number"]),
        (MATTE % CHECKER % ', scale = "1"', ['texture.scale: found "1"; allowed: a finite number']),
        (MATTE % CHECKER % ", scale = [2, 2, 2]", ["texture.scale: found [2, 2, 2]; allowed: a f"]),
        (MATTE % CHECKER % ", tile = 1", ["texture.tile: unknown field; allowed: type, even, odd"]),
        (MATTE % '{ type = "checker", odd = [1, 1, 1] }',
         [f"texture.even: missing; required: {ALBEDO}"]),
        ('type = "emitter", texture = { type = "checker", even = [9, 9, -9] }',
         [f"texture.even[2]: found -9; allowed: {COLOR}", "texture.odd: missing; required: three"]),
        (METAL + ", fuzz = -0.1", ["fuzz: found -0.1; allowed: a finite number ≥ 0"]),
        (METAL + ", fuzz = nan", ["fuzz: found nan; allowed: a finite number ≥ 0"]),
        (METAL + ", fuzz = inf", ["fuzz: found inf; allowed: a finite number ≥ 0"]),
        (METAL + ', fuzz = "0"', ['fuzz: found "0"; allowed: a finite number ≥ 0']),
        (METAL + ", roughness = 0", ["roughness: unknown field; allowed: type, texture, fuzz"]),
        ('type = "metal", texture = [1.01, 1, 1], fuzz = -1',
         ["fuzz: found -1; allowed: ", f"texture[0]: found 1.01; allowed: {ALBEDO}"]),
    ],
)  # fmt: skip
def test_a_bad_surface_is_told(material, told):
    found = problems(f"{CAMERA}[[object]]\n{BALL % 1}\nmaterial = {{ {material} }}\n")
    assert len(found) == len(told), found
    for text, phrase in zip(found, told, strict=True):
        assert text.startswith(f"bad.toml:6: object[0].material.{phrase}")


@pytest.mark.parametrize("kind", ["lambertian", "metal", "emitter"])
def test_a_checker2d_on_a_sphere_is_refused(kind):
    texture = '{ type = "checker2d", even = [1, 1, 1], odd = [0, 0, 0], tile = 1 }'
    material = f'material = {{ type = "{kind}", texture = {texture} }}'
    (found,) = problems(f"{CAMERA}[[object]]\n{BALL % 1}\n{material}\n")
    assert found.startswith("bad.toml:6: object[0].material: a sphere cannot carry a checker2d")


def test_glass_on_a_plane_is_refused():
    plane = 'shape = { type = "plane", point = [0, 0, 0], normal = [0, 0, 1] }'
    (found,) = problems(with_line(10, plane))
    assert found.startswith("bad.toml:11: object[0].material: a plane cannot be glass")


def test_the_default_up_may_be_the_wrong_one():
    (found,) = problems("[camera]\nlook_from = [0, 1, 0]\nlook_at = [0, 0, 0]\n")
    assert found.startswith("bad.toml:1: camera.up: found [0.0, 1.0, 0.0]; parallel to the view")


def test_empty_names_may_be_equal():
    text = GOOD.replace('"ball"', '""').replace('"screen"', '""')
    assert [obj.name for obj in scene_from_toml(text).objects] == ["", ""]


def test_all_mistakes_are_told_in_the_order_of_the_file():
    text = GOOD
    for right, wrong in [
        ("look_at = [0, 0, 0]", "look_at = [0, 0, 4]"),
        ("vertical_fov = 34", "vertical_fov = 340\nzoom = 1"),
        ("color = [0, 0, 0]", 'color = [0, "0", nan]'),
        ("radius = 1", "radius = -1, colour = 1"),
        ('"N-BK7"', '"Bakelite"'),
        ('name = "screen"', 'name = "ball"'),
        ('type = "plane"', 'type = "sphere"'),
        ("tile = 0.5", "tile = 0"),
    ]:
        assert right in text
        text = text.replace(right, wrong)
    assert [found.split(": ")[:2] for found in problems(text)] == [
        ["bad.toml:3", "camera.look_at"],
        ["bad.toml:5", "camera.vertical_fov"],
        ["bad.toml:6", "camera.zoom"],
        ["bad.toml:8", "background.color[1]"],
        ["bad.toml:8", "background.color[2]"],
        ["bad.toml:11", "object[0].shape.radius"],
        ["bad.toml:11", "object[0].shape.colour"],
        ["bad.toml:12", "object[0].material.glass"],
        ["bad.toml:14", "object[1].name"],
        ["bad.toml:15", "object[1].shape.center"],
        ["bad.toml:15", "object[1].shape.radius"],
        ["bad.toml:15", "object[1].shape.point"],
        ["bad.toml:15", "object[1].shape.normal"],
        ["bad.toml:16", "object[1].material"],
        ["bad.toml:23", "object[1].material.texture.tile"],
    ]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[camera]\nlook_from = [0, 0, 4\nlook_at = [0, 0, 0]\n", 3),
        ("[camera]\nlook_from = [0, 0, 4],\n", 2),
        ("[camera]\n[camera]\n", 2),
        ("a = 1\n\n\na = 2", 4),
        ("x = 1\ny = 2021-13-45\n", 2),
        ("x = 1\ny = [1,\n\n", 2),
        ("x = " + 5000 * "9", 1),
        ("x = " + 5000 * "[", 1),
    ],
)
def test_a_syntax_error_has_its_line(text, line):
    (found,) = problems(text)
    assert found.startswith(f"bad.toml:{line}: is not TOML: ")


@pytest.mark.parametrize(
    ("text", "path", "line"),
    [
        # An array of inline tables instead of headers, over several lines.
        (
            'object = [\n  { name = 1 }, # ]\n  { name = "]" },\n\n  { name = 2 },\n]\n',
            "object[2]",
            5,
        ),
        # Nested arrays and texts that hold what looks like a header or the end of an array.
        ('[a]\nx = """\n[[object]]\nname = 3\n"""\n[[object]]\nname = 4\n', "object[0]", 7),
        ("x = [[\n1], [\n2\n]]\n[[object]]\n# [[object]]\n[[object]]\nname=1", "object[1]", 8),
        # Sub-tables belong to the last table of the array, whatever stands between.
        ("[[object]]\n[background]\n[[object]]\n[background.x]\n[object.name]", "object[1]", 5),
        ('["object"]\n"name"  = 1\r\n', "object", 1),
    ],
)
def test_lines_are_found_in_any_toml(text, path, line):
    wanted = [found for found in problems(text) if f": {path}.name: " in found or path == "object"]
    assert any(found.startswith(f"bad.toml:{line}: {path}") for found in wanted), wanted


def test_a_huge_array_has_the_line_of_its_key_at_least():
    found = problems("\n\nobject = [\n" + "1,\n" * 20_000 + "]\n")
    assert found[0].startswith("bad.toml:1: camera: missing")
    assert "bad.toml:4: object[0]: found 1; allowed: [[object]] tables" in "\n".join(found)
    assert "bad.toml:3: object[19999]: found 1; allowed: [[object]] tables" in "\n".join(found)


def test_a_broken_file_only_ever_raises_scene_error():
    rng = random.Random(0)
    for _ in range(400):
        text = list(GOOD)
        for _ in range(rng.randrange(1, 4)):
            start = rng.randrange(len(text))
            piece = rng.choice(["", "\n", "[", "]", '"', "{", "nan", "-1", "=", "object", "1e999"])
            text[start : start + rng.randrange(12)] = piece
        try:
            scene_from_toml("".join(text))
        except SceneError as error:
            assert all(problem.startswith("<text>:") for problem in error.problems)  # noqa: PT017


def test_files_that_cannot_be_read(tmp_path):
    not_text = tmp_path / "latin.toml"
    not_text.write_bytes('[camera]\nname = "Jenä"\n'.encode("latin-1"))
    for path, reason in [
        (tmp_path / "none.toml", "none.toml: cannot be read: No such file"),
        (tmp_path, "cannot be read: Is a directory"),
        (tmp_path / "a\0b", "cannot be read: "),
        (not_text, "latin.toml:2: is not UTF-8 text"),
    ]:
        with pytest.raises(SceneError) as caught:
            load_scene(path)
        assert reason in str(caught.value)
        assert len(caught.value.problems) == 1


def test_windows_files_are_read(tmp_path):
    path = tmp_path / "windows.toml"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert eqx.tree_equal(load_scene(path), scene_from_toml(GOOD))


def test_a_load_error_names_the_file(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text(with_line(22, "tile = 0"), encoding="utf-8")
    with pytest.raises(SceneError, match="tile: found 0") as caught:
        load_scene(path)
    assert str(caught.value).startswith(f"{path}:22: ")


def test_a_scene_that_no_file_may_hold_is_not_written(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text("old", encoding="utf-8")
    bad = [
        Object(Sphere([0, 0, np.nan], -1.0), Dielectric("N-BK7")),
        Object(Sphere([0, 0, 0], 1.0), Lambertian([0, 0, 1.5])),
    ]
    with pytest.raises(SceneError) as caught:
        save_scene(Scene(Camera([0, 0, 4], [0, 0, 0]), bad), path)
    assert [text.split(": ")[1] for text in caught.value.problems] == [
        "object[0].shape.center[2]",
        "object[0].shape.radius",
        "object[1].material.texture.color[2]",
    ]
    assert path.read_text(encoding="utf-8") == "old"


def test_a_failed_save_leaves_nothing(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("", encoding="utf-8")
    for path in ["none/s.toml", "folder", "file/s.toml"]:
        with pytest.raises(SceneError, match="cannot be written"):
            save_scene(scene_from_toml(CAMERA), tmp_path / path)
    assert sorted(file.name for file in tmp_path.rglob("*")) == ["file", "folder"]


def test_scene_error_survives_pickling():
    error = pickle.loads(pickle.dumps(SceneError(["one", "two"])))
    assert error.problems == ["one", "two"]
    assert str(error) == "one\ntwo"


def test_the_schema_is_json_and_accepts_the_samples():
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(json.dumps(scene_schema(), allow_nan=False))
    checker = jsonschema.Draft202012Validator(schema)
    checker.check_schema(schema)
    for path in SAMPLES:
        checker.validate(tomllib.loads(path.read_text(encoding="utf-8")))
    for replaced, new, *_ in [row for row in BAD if row[4].startswith(("missing", "unknown"))]:
        assert not checker.is_valid(tomllib.loads(with_line(replaced, new)))


def test_the_defaults_of_the_schema_are_those_of_the_modules():
    tables = scene_schema()["$defs"]
    for table, module in [
        ("_Camera", Camera),
        ("_Background", Background),
        ("_Checker", Checker),
        ("_Metal", Metal),
        ("_Emitter", Emitter),
    ]:
        defaults = {field.name: field.default for field in dataclasses.fields(module)}
        shown = {k: p["default"] for k, p in tables[table]["properties"].items() if "default" in p}
        assert shown
        for name, default in shown.items():
            assert np.array_equal(defaults[name], default)
    assert math.isinf(Sellmeier([0, 0, 0], [0, 0, 0]).validity[1])
