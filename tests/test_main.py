import contextlib
import itertools
import json
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import threading
import warnings
from pathlib import Path

import imageio.v3 as iio
import jax
import numpy as np
import pytest
from fake_fit import fake_expected, fake_result

from diffdisp import __main__ as command_line
from diffdisp import fitting
from diffdisp.__main__ import main
from diffdisp.film import Film
from diffdisp.fit_measuring import FitMeasured, FitSetting
from diffdisp.fitting import Rendered
from diffdisp.image import Picture, read_picture, write_picture
from diffdisp.measuring import Setting, Tradeoff
from diffdisp.rendering import Growing, render_progressively
from diffdisp.scene_file import load_scene
from diffdisp.tolerance import Estimated, render_to_tolerance

ROOT = Path(__file__).parents[1]
FIXTURES = ROOT / "fixtures"
GALLERY = FIXTURES / "scenes"

CAMERA = """\
[camera]
look_from = [0, 0, 4]
look_at = [0, 0, 0]
vertical_fov = 34
"""
BALL = """\
[[object]]
name = "ball"
shape = { type = "sphere", center = [0, 0, 0], radius = 1 }
material = { type = "dielectric", glass = "N-BK7" }
"""
SCREEN = """\
[[object]]
name = "screen"
shape = { type = "plane", point = [0, 0, -3], normal = [0, 0, 1] }
material = { type = "emitter", texture = { type = "checker2d", even = [1, 1, 1], \
odd = [0.1, 0.1, 0.1], tile = 0.5 }, intensity = 1 }
"""
SCENE = CAMERA + BALL + SCREEN
MATTE_AND_LAMP = """\
[[object]]
shape = { type = "sphere", center = [0, 0, 0], radius = 1 }
material = { type = "lambertian", texture = [0.8, 0.8, 0.8] }
[[object]]
shape = { type = "sphere", center = [2, 3, 2], radius = 0.5 }
material = { type = "emitter", texture = [1, 1, 1] }
"""


def own_glass(B, C):
    return SCENE.replace('glass = "N-BK7"', f"B = {B}, C = {C}")


@pytest.fixture
def out(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE, encoding="utf-8")
    return str(path)


@pytest.fixture
def target(tmp_path):
    path = tmp_path / "target.npz"
    radiance = np.random.default_rng(1).uniform(0, 1, (6, 8, 2))
    write_picture(path, Picture(radiance, np.array([0.5, 0.6])))
    return str(path)


@pytest.fixture
def lit(tmp_path):
    """A scene that scatters light: a matte ball and a lamp."""
    path = tmp_path / "lit.toml"
    path.write_text(CAMERA + MATTE_AND_LAMP, encoding="utf-8")
    return str(path)


def refused(capsys, arguments, phrase):
    """Check the exit status, and that one message holds the phrase."""
    assert main(arguments) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("diffdisp: ")
    assert told.err.endswith("\n")
    assert told.err.count("diffdisp: ") == 1
    assert "Traceback" not in told.err
    assert phrase in told.err


# Bad scenes: what is replaced in a good one, by what, and what the message must say.
BAD_SCENES = {
    "no camera": (CAMERA, "", "camera: missing"),
    "no look_from": ("look_from = [0, 0, 4]\n", "", "camera.look_from: missing"),
    "unknown table": ("[camera]", "[lens]\nf = 1\n[camera]", "lens: unknown field"),
    "unknown field": ("vertical_fov", "vertical_fof", "camera.vertical_fof: unknown field"),
    "unknown field of an object": ("radius = 1", "radius = 1, mass = 2", "mass: unknown field"),
    "unknown shape": ('"sphere"', '"cube"', "sphere or plane"),
    "unknown material": ('"dielectric"', '"wood"', "lambertian, metal, dielectric or emitter"),
    "unknown texture": ('"checker2d"', '"marble"', "solid, checker or checker2d"),
    "unknown glass": ("N-BK7", "N-BK77", "unknown glass 'N-BK77'"),
    "NaN": ("radius = 1", "radius = nan", "radius: found nan"),
    "infinity": ("look_from = [0, 0, 4]", "look_from = [0, 0, inf]", "found inf"),
    "negative radius": ("radius = 1", "radius = -1", "a finite number > 0"),
    "no radius": ("radius = 1", "radius = 0", "radius: found 0"),
    "no tile": ("tile = 0.5", "tile = 0", "tile: found 0"),
    "negative tile": ("tile = 0.5", "tile = -0.5", "tile: found -0.5"),
    "zero normal": ("normal = [0, 0, 1]", "normal = [0, 0, 0]", "not all zero"),
    "zero up": ("vertical_fov = 34", "up = [0, 0, 0]", "not all zero"),
    "up along the view": ("vertical_fov = 34", "up = [0, 0, 1]", "parallel to the view"),
    "negative colour": ("even = [1, 1, 1]", "even = [1, -1, 1]", "≥ 0"),
    "negative emission": ("intensity = 1", "intensity = -1", "intensity: found -1"),
    "negative background": (CAMERA, CAMERA + "[background]\ncolor = [0, 0, -1]\n", "≥ 0"),
    "two numbers": ("center = [0, 0, 0]", "center = [0, 0]", "three finite numbers"),
    "four numbers": ("center = [0, 0, 0]", "center = [0, 0, 0, 0]", "three finite numbers"),
    "text for a number": ("radius = 1", 'radius = "1"', 'found "1"'),
    "truth for a number": ("radius = 1", "radius = true", "found true"),
    "number for a name": ('name = "ball"', "name = 7", "name: found 7"),
    "field of view 0": ("vertical_fov = 34", "vertical_fov = 0", "below 180"),
    "field of view 180": ("vertical_fov = 34", "vertical_fov = 180", "below 180"),
    "looks at itself": ("look_at = [0, 0, 0]", "look_at = [0, 0, 4]", "same point as look_from"),
    "duplicate name": ('"screen"', '"ball"', "the name of object[0] too"),
    "glass plane": ('type = "sphere", center = [0, 0, 0], radius = 1', 'type = "plane", '
                    "point = [0, 0, 0], normal = [0, 0, 1]", "a plane cannot be glass"),
    "tiles on a ball": ('type = "dielectric", glass = "N-BK7"', 'type = "lambertian", texture = '
                        '{ type = "checker2d", even = [1, 1, 1], odd = [0, 0, 0], tile = 1 }',
                        "a sphere cannot carry a checker2d"),
    "matte without a texture": ('type = "dielectric", glass = "N-BK7"', 'type = "lambertian"',
                                "texture: missing"),
    "albedo above 1": ('type = "dielectric", glass = "N-BK7"',
                       'type = "lambertian", texture = [1, 1, 1.5]', "from 0 to 1"),
    "reflectance above 1": ('type = "dielectric", glass = "N-BK7"',
                            'type = "metal", texture = [2, 1, 1]', "from 0 to 1"),
    "negative fuzz": ('type = "dielectric", glass = "N-BK7"',
                      'type = "metal", texture = [1, 1, 1], fuzz = -1', "fuzz: found -1"),
    "scale 0": ('type = "dielectric", glass = "N-BK7"', 'type = "metal", texture = { type = '
                '"checker", even = [1, 1, 1], odd = [0, 0, 0], scale = 0 }', "scale: found 0"),
    "glass and coefficients": ('glass = "N-BK7"', 'glass = "N-BK7", B = [1, 0, 0]', "either"),
    "B without C": ('glass = "N-BK7"', "B = [1, 0, 0]", "C: missing"),
    "two coefficients": ('glass = "N-BK7"', "B = [1, 0], C = [0, 0, 0]", "three finite numbers"),
    "no TOML": ("[camera]", "[camera", "is not TOML"),
    "a key twice": ("vertical_fov = 34", "vertical_fov = 3\nvertical_fov = 4", "is not TOML"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "phrase"), BAD_SCENES.values(), ids=BAD_SCENES)
def test_bad_scene(tmp_path, out, capsys, old, new, phrase):
    assert old in SCENE
    (tmp_path / "bad.toml").write_text(SCENE.replace(old, new), encoding="utf-8")
    refused(capsys, ["render", str(tmp_path / "bad.toml"), "-o", str(out / "a.png")], phrase)
    assert list(out.iterdir()) == []


def test_all_mistakes_of_a_scene_are_in_one_message(tmp_path, out, capsys):
    bad = SCENE.replace("radius = 1", "radius = -1").replace("tile = 0.5", "tile = 0")
    (tmp_path / "bad.toml").write_text(bad, encoding="utf-8")
    refused(capsys, ["render", str(tmp_path / "bad.toml"), "-o", str(out / "a.png")], "radius")
    refused(capsys, ["render", str(tmp_path / "bad.toml"), "-o", str(out / "a.png")], "tile")


# Glasses without an index in the bands: coefficients, bands, and what the message must say. The
# poles lie exactly on an edge of the range asked for, where no middle of a band is.
BAD_GLASSES = {
    "pole in colour": ("[1, 0, 0]", "[0.25, 0, 0]", None, "pole at 500 nm"),
    "pole at 380 nm": ("[1, 0, 0]", f"[{0.38**2!r}, 0, 0]", None, "pole at 380 nm"),
    "pole at 780 nm": ("[0, 1, 0]", f"[0, {0.78**2!r}, 0]", None, "pole at 780 nm"),
    "pole in bands": ("[1, 0, 0]", "[1, 0, 0]", "900:1100:3", "pole at 1000 nm"),
    "pole at low": ("[1, 0, 0]", "[0.25, 0, 0]", "500:700:2", "pole at 500 nm"),
    "pole at high": ("[1, 0, 0]", "[0.25, 0, 0]", "300:500:2", "pole at 500 nm"),
    "n² negative": ("[-3, 0, 0]", "[0, 0, 0]", None, "n² ≤ 0"),
    "n² zero": ("[-1, 0, 0]", "[0, 0, 0]", None, "n² ≤ 0"),
    "n² negative at high": ("[0.5, 0, 1]", "[0.01, 0, 2]", "600:1390:3", "n² ≤ 0"),
}


@pytest.mark.parametrize(("B", "C", "bands", "phrase"), BAD_GLASSES.values(), ids=BAD_GLASSES)
def test_bad_glass(tmp_path, out, capsys, B, C, bands, phrase):
    (tmp_path / "bad.toml").write_text(own_glass(B, C), encoding="utf-8")
    options = [] if bands is None else ["--bands", bands]
    output = str(out / "a.npz")
    refused(capsys, ["render", str(tmp_path / "bad.toml"), "-o", output, *options], phrase)
    assert list(out.iterdir()) == []


# Bad options of `render`; {out} is an empty folder.
BAD_OPTIONS = {
    "no output": ("", "-o OUT"),
    "timing without output": ("--plan --timing", "-o OUT"),
    "tolerance 0": ("-o {out}/a.png --tolerance 0", "must be above 0; found '0'"),
    "tolerance and samples": ("-o {out}/a.png --tolerance 1 --samples 4", "leave out --samples"),
    "tolerance and quality": ("-o {out}/a.png --tolerance 1 --quality draft", "not allowed with"),
    "unknown suffix": ("-o {out}/a.jpg", "found '.jpg'"),
    "no suffix": ("-o {out}/a", ".npz, .png"),
    "missing folder": ("-o {out}/no/a.png", "there is no folder"),
    "output is a folder": ("-o {out}", ".npz, .png"),
    "size 0": ("-o {out}/a.png --size 0x4", "--size"),
    "height 0": ("-o {out}/a.png --size 4x0", "at least 1"),
    "negative size": ("-o {out}/a.png --size 4x-4", "at least 1"),
    "size in words": ("-o {out}/a.png --size large", "must be WxH"),
    "one number of a size": ("-o {out}/a.png --size 480", "must be WxH"),
    "three numbers of a size": ("-o {out}/a.png --size 4x4x4", "whole number"),
    "size not whole": ("-o {out}/a.png --size 4.5x4", "whole number"),
    "size beyond memory": ("-o {out}/a.png --size 9999999x9999999", "not enough memory"),
    "size beyond any": (f"-o {{out}}/a.png --size 4x{'9' * 5000}", "whole number"),
    "samples 0": ("-o {out}/a.png --samples 0", "at least 1"),
    "negative samples": ("-o {out}/a.png --samples -4", "at least 1"),
    "samples not whole": ("-o {out}/a.png --samples 1.5", "whole number"),
    "samples beyond memory": ("-o {out}/a.png --samples 2000000000", "not enough memory"),
    "depth 0": ("-o {out}/a.png --depth 0", "at least 1"),
    "depth beyond any": ("-o {out}/a.png --depth 65536", "below 65536"),
    "negative seed": ("-o {out}/a.png --seed -1", "at least 0"),
    "seed beyond any": ("-o {out}/a.png --seed 4294967296", "below 4294967296"),
    "bands reversed": ("-o {out}/a.npz --bands 700:400:4", "must rise"),
    "bands of one end": ("-o {out}/a.npz --bands 500:500:4", "must rise"),
    "no bands": ("-o {out}/a.npz --bands 400:700:0", "at least 1"),
    "bands from 0": ("-o {out}/a.npz --bands 0:700:4", "must rise from above 0"),
    "bands to infinity": ("-o {out}/a.npz --bands 400:inf:4", "a finite number"),
    "bands from NaN": ("-o {out}/a.npz --bands nan:700:4", "a finite number"),
    "bands in words": ("-o {out}/a.npz --bands visible", "LOW:HIGH:COUNT"),
    "bands without a count": ("-o {out}/a.npz --bands 400:700", "LOW:HIGH:COUNT"),
    "bands beyond memory": ("-o {out}/a.npz --bands 400:700:2000000000", "not enough memory"),
    "infrared to .png": ("-o {out}/a.png --bands 700:900:4", "380-780 nm only"),
    "unknown quality": ("-o {out}/a.png --quality best", "--quality"),
    "unknown option": ("-o {out}/a.png --fast", "--fast"),
    "an abbreviation": ("-o {out}/a.png --sam 4", "--sam"),
    "a second scene": ("other.toml -o {out}/a.png", "other.toml"),
}


@pytest.mark.parametrize(("options", "phrase"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_bad_option(scene, out, capsys, options, phrase):
    refused(capsys, ["render", scene, *options.format(out=out).split()], phrase)
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "phrase"),
    [
        ("", "COMMAND"),
        ("paint", "paint"),
        ("render", "SCENE"),
        ("render nosuch.toml -o a.png", "nosuch.toml: cannot be read"),
        ("render . -o a.png", "cannot be read"),
        ("fit scene.toml", "required"),
        ("fit nosuch.toml nosuch.npz -o a", "nosuch.toml"),
        ("fit a.toml a.npz -o a --tolerance 0", "must be above 0"),
        ("fit a.toml a.npz -o a --tolerance nan", "must be a finite number"),
        ("plan-fit scene.toml -o a", "--noise"),
        ("plan-fit nosuch.toml --noise 1e-3 -o a", "nosuch.toml"),
        ("glass", "GLASS"),
        ("glass N-BK77", "similar are"),
        ("glass nosuch.yml", "nosuch.yml: No such file"),
        ("glass nosuch.agf", "nosuch.agf: No such file"),
        ("glass N-BK7 -o n.doc", "found '.doc'"),
        ("glass N-BK7 -o no/n.png", "there is no folder"),
        (f"glass {FIXTURES}/glasses/sample.agf:NOSUCH", "has no glass 'NOSUCH'"),
        (f"glass {FIXTURES}/README.yml", "README.yml"),
        ("explore", "explore"),
        ("tradeoff nosuch.toml -o a", "nosuch.toml: cannot be read"),
    ],
)
def test_bad_command(out, monkeypatch, capsys, arguments, phrase):
    monkeypatch.chdir(out)
    refused(capsys, arguments.split(), phrase)
    assert list(out.iterdir()) == []


def test_a_catalogue_of_several_glasses_has_no_plot(out, capsys):
    catalogue = str(FIXTURES / "glasses" / "sample.agf")
    assert main(["glass", catalogue, "-o", str(out / "n.png")]) == 2
    assert "one is wanted" in capsys.readouterr().err
    assert list(out.iterdir()) == []


# Bad targets: the keys of an .npz file, and what the message must say.
BAD_TARGETS = {
    "no radiance": ({"image": np.ones((2, 2, 3))}, "no radiance"),
    "two axes": ({"radiance": np.ones((2, 2))}, "(height, width, channels)"),
    "no pixels": ({"radiance": np.ones((0, 2, 3))}, "(height, width, channels)"),
    "bands without wavelengths": ({"radiance": np.ones((2, 2, 4))}, "last axis must be 3"),
    "wavelengths disagree": (
        {"radiance": np.ones((2, 2, 4)), "wavelength": np.array([0.5, 0.6])},
        "disagree",
    ),
    "NaN": ({"radiance": np.full((2, 2, 3), np.nan)}, "not finite"),
    "infinity": ({"radiance": np.full((2, 2, 3), np.inf)}, "not finite"),
    "negative wavelength": (
        {"radiance": np.ones((2, 2, 1)), "wavelength": np.array([-0.5])},
        "positive and finite",
    ),
    "text": ({"radiance": np.full((2, 2, 3), "white")}, "real numbers"),
}


@pytest.mark.parametrize(("keys", "phrase"), BAD_TARGETS.values(), ids=BAD_TARGETS)
def test_bad_target(scene, tmp_path, out, capsys, keys, phrase):
    np.savez(tmp_path / "bad.npz", **keys)
    refused(capsys, ["fit", scene, str(tmp_path / "bad.npz"), "-o", str(out / "fit")], phrase)
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("name", ["bad.npz", "bad.png", "bad.tiff", "bad.exr", "bad.txt"])
def test_a_target_that_is_no_picture(scene, tmp_path, out, capsys, name):
    (tmp_path / name).write_text("not a picture")
    refused(capsys, ["fit", scene, str(tmp_path / name), "-o", str(out / "fit")], name)
    assert list(out.iterdir()) == []


TWO_BALLS = BALL.replace('"ball"', '"other"').replace("[0, 0, 0]", "[3, 0, 0]")

# Bad fits: the scene, options, and what the message must say.
BAD_FITS = {
    "no glass": (CAMERA + SCREEN, "", "no glass"),
    "two balls": (SCENE + TWO_BALLS, "", "ball, other"),
    "not glass": (SCENE, "--object screen", "screen"),
    "no such object": (SCENE + TWO_BALLS, "--object third", "third"),
    "nothing of that name": (SCENE, "--free ball.centre", "'ball.centre'"),
    "unknown prior": (SCENE, "--prior strong", "--prior"),
    "unknown loss": (SCENE, "--loss cubes", "--loss"),
    "no noise": (SCENE, "--noise 0", "above 0"),
    "negative noise": (SCENE, "--noise -1", "above 0"),
    "noise not finite": (SCENE, "--noise nan", "finite"),
    "noise in words": (SCENE, "--noise little", "finite"),
    "unknown start": (SCENE, "--start N-BK77", "unknown glass"),
    "missing start": (SCENE, "--start nosuch.yml", "nosuch.yml"),
    "pole in the target's bands": (own_glass("[1, 0, 0]", "[0.3025, 0, 0]"), "", "pole at 550"),
    "no index in the target's bands": (own_glass("[-3, 0, 0]", "[0, 0, 0]"), "", "n² ≤ 0"),
}


@pytest.mark.parametrize(("text", "options", "phrase"), BAD_FITS.values(), ids=BAD_FITS)
def test_bad_fit(tmp_path, target, out, capsys, text, options, phrase):
    (tmp_path / "bad.toml").write_text(text, encoding="utf-8")
    arguments = ["fit", str(tmp_path / "bad.toml"), target, "-o", str(out / "fit")]
    refused(capsys, arguments + options.split(), phrase)
    assert list(out.iterdir()) == []


# Bad masks: the keys of an .npz file, and what the message must say.
BAD_MASKS = {
    "another size": ({"radiance": np.ones((8, 6, 3))}, "mask (8, 6): must be (6, 8)"),
    "all zero": ({"radiance": np.zeros((6, 8, 3))}, "leaves nothing to fit"),
    "no picture": ({"other": np.ones((6, 8))}, "it has no mask"),
}


@pytest.mark.parametrize(("keys", "phrase"), BAD_MASKS.values(), ids=BAD_MASKS)
def test_bad_mask(scene, target, tmp_path, out, capsys, keys, phrase):
    np.savez(tmp_path / "mask.npz", **keys)
    arguments = ["fit", scene, target, "-o", str(out / "fit"), "--mask"]
    refused(capsys, [*arguments, str(tmp_path / "mask.npz")], phrase)
    refused(capsys, [*arguments, str(tmp_path / "nosuch.png")], "nosuch.png: there is no such")
    refused(capsys, [*arguments, str(tmp_path / "mask.txt")], "a picture ends in one of")
    assert list(out.iterdir()) == []


# Bad plans: the scene, options, and what the message must say.
BAD_PLANS = {
    **{
        name: BAD_FITS[name]
        for name in ("no glass", "two balls", "not glass", "no such object", "nothing of that name")
    },
    **{name: BAD_FITS[name] for name in ("unknown prior", "no noise", "noise not finite")},
    "nothing to see": (SCENE.replace("center = [0, 0, 0]", "center = [0, 0, 9]"), "", "no pixel"),
    "pole at low": (own_glass("[1, 0, 0]", "[0.25, 0, 0]"), "--bands 500:700:2", "pole at 500"),
    "pole in colour": (own_glass("[1, 0, 0]", "[0.25, 0, 0]"), "", "pole at 500"),
    "bands reversed": (SCENE, "--bands 700:400:4", "must rise"),
    "size 0": (SCENE, "--size 0x4", "at least 1"),
    "size beyond memory": (SCENE, "--size 9999999x9999999", "not enough memory"),
    "bands beyond memory": (SCENE, "--bands 400:700:2000000000", "not enough memory"),
    "a target": (SCENE, "target.npz", "target.npz"),
}


@pytest.mark.parametrize(("text", "options", "phrase"), BAD_PLANS.values(), ids=BAD_PLANS)
def test_bad_plan(tmp_path, out, capsys, text, options, phrase):
    (tmp_path / "bad.toml").write_text(text, encoding="utf-8")
    arguments = ["plan-fit", str(tmp_path / "bad.toml"), "--noise", "1e-3", "--size", "6x4"]
    arguments += ["-o", str(out / "plan"), *options.split()]
    refused(capsys, arguments, phrase)
    assert list(out.iterdir()) == []


def test_a_plan_whose_folder_cannot_be_written(scene, out, capsys):
    (out / "plan.json").mkdir()
    plan = ["plan-fit", scene, "--noise", "1e-3", "-o", str(out)]
    refused(capsys, plan, "plan.json: is a folder")


@pytest.mark.parametrize(
    ("folder", "phrase"),
    [("file", "no folder"), ("file/fit", "no folder"), ("taken", "report.png: is a folder")],
)
def test_a_folder_that_cannot_be_written(scene, target, out, capsys, folder, phrase):
    (out / "file").write_text("a file")
    (out / "taken" / "report.png").mkdir(parents=True)
    refused(capsys, ["fit", scene, target, "-o", str(out / folder)], phrase)
    assert (out / "file").read_text() == "a file"


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("RESOURCE_EXHAUSTED: 8 GB\nmore")])
def test_memory_that_runs_out(scene, out, capsys, monkeypatch, error):
    def fail(*args, **options):
        raise error

    monkeypatch.setattr("diffdisp.rendering.render_progressively", fail)
    refused(capsys, ["render", scene, "-o", str(out / "a.png")], "not enough memory")
    assert list(out.iterdir()) == []


def test_a_fault_of_ours_is_not_bad_input(scene, out, monkeypatch):
    def fail(*args, **options):
        raise RuntimeError("a fault")

    monkeypatch.setattr("diffdisp.rendering.render_progressively", fail)
    with pytest.raises(RuntimeError, match="a fault"):
        main(["render", scene, "-o", str(out / "a.png")])


def test_a_missing_package_is_named(scene, out, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    refused(capsys, ["render", scene, "-o", str(out / "a.exr")], "pip install 'diffdisp[io]'")


# Ctrl-C.

SMALL = ["--size", "8x6", "--samples", "2", "--depth", "4"]
THREE_PASSES = ["--size", "8x6", "--samples", "96", "--depth", "4"]
"""A pass takes 32 samples, of so few pixels in one part."""


@pytest.fixture
def interrupt(monkeypatch):
    """Let the renderer be interrupted when it tells that so many parts are done."""

    def at_part(number):
        def draw(*args, progress, **options):
            def tell(done, total):
                progress(done, total)
                if done == number:
                    raise KeyboardInterrupt

            return render_progressively(*args, progress=tell, **options)

        monkeypatch.setattr("diffdisp.rendering.render_progressively", draw)

    return at_part


def test_ctrl_c_before_the_first_pass_leaves_the_old_file(scene, out, capsys, interrupt):
    interrupt(1)
    (out / "a.png").write_text("old")
    assert main(["render", scene, "-o", str(out / "a.png"), *THREE_PASSES]) == 130
    assert capsys.readouterr() == ("", "diffdisp: interrupted, nothing written\n")
    assert [file.name for file in out.iterdir()] == ["a.png"]
    assert (out / "a.png").read_text() == "old"


@pytest.mark.parametrize("name", ["a.npz", "a.png", "a.tiff", "a.exr"])
def test_ctrl_c_keeps_the_picture_so_far(scene, out, capsys, interrupt, name):
    film = Film(8, 6)
    passes = list(
        render_progressively(load_scene(scene), film, samples=96, depth=4, dtype="float32")
    )
    interrupt(3)
    (out / name).write_text("old")
    assert main(["render", scene, "-o", str(out / name), *THREE_PASSES]) == 130
    told = f"diffdisp: interrupted: {out / name} holds 64 of 96 samples\n"
    assert capsys.readouterr() == ("", told)
    assert [file.name for file in out.iterdir()] == [name]
    picture = read_picture(out / name)
    if name == "a.png":
        write_picture(out / "b.png", Picture(passes[1].radiance))
        np.testing.assert_array_equal(picture.radiance, read_picture(out / "b.png").radiance)
        return
    assert (picture.samples, picture.depth, picture.seed) == (64, 4, 0)
    np.testing.assert_array_equal(picture.radiance, passes[1].radiance)
    assert np.any(picture.radiance != passes[2].radiance)


@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_while_writing(scene, out, capsys, monkeypatch, times):
    """The first writes again; the second gives up, and the old file is whole."""
    whole, interrupts = np.savez_compressed, []

    def save(path, **fields):
        whole(path, **fields)
        if len(interrupts) < times:
            path.write_bytes(path.read_bytes()[:100])
            interrupts.append(path)
            raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", save)
    (out / "a.npz").write_text("old")
    assert main(["render", scene, "-o", str(out / "a.npz"), *SMALL]) == 130
    assert len(interrupts) == times
    assert [file.name for file in out.iterdir()] == ["a.npz"]
    told = capsys.readouterr().err
    if times == 1:
        assert told == f"diffdisp: interrupted: {out / 'a.npz'} holds 2 of 2 samples\n"
        assert read_picture(out / "a.npz").samples == 2
    else:
        assert told == "diffdisp: interrupted, nothing written\n"
        assert (out / "a.npz").read_text() == "old"


def test_ctrl_c_at_a_terminal(out):
    """A process at work, a core in each of its threads, is told to stop."""
    samples, path = 100_000, out / "a.npz"
    command = [sys.executable, "-m", "diffdisp", "render", str(GALLERY / "default.toml")]
    command += ["-o", str(path), "--size", "400x400", "--samples", str(samples)]
    cache = {"JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir}
    terminal, its_end = pty.openpty()
    termios.tcsetwinsize(its_end, (24, 100))  # in one without columns there is no bar
    # A process whose parent ignores the signal ignores it too.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        process = subprocess.Popen(command, stderr=its_end, env={**os.environ, **cache})
    finally:
        signal.signal(signal.SIGINT, before)
        os.close(its_end)
    told, stopped = "", False
    giving_up = threading.Timer(300, process.kill)
    giving_up.start()
    try:
        with contextlib.suppress(OSError):  # how Linux tells of the other end that it is closed
            while heard := os.read(terminal, 4096):
                told += heard.decode(errors="replace")
                if not stopped and re.search(rf"\b[1-9][0-9]* of {samples} samples", told):
                    process.send_signal(signal.SIGINT)
                    stopped = True
        process.wait()
    finally:
        giving_up.cancel()
        process.kill()
        process.wait()
        os.close(terminal)
    assert stopped, told
    assert process.returncode == 130
    assert "Traceback" not in told
    last = re.search(
        rf"diffdisp: interrupted: {re.escape(str(path))} holds (\d+) of {samples} samples\s*$", told
    )
    assert last, told
    picture = read_picture(path)
    assert picture.radiance.shape == (400, 400, 3)
    assert 0 < picture.samples < samples
    assert picture.samples == int(last[1])
    assert 0.1 < picture.radiance.mean() < 1
    assert [file.name for file in out.iterdir()] == ["a.npz"]


def test_ctrl_c_keeps_what_there_is_on_the_way_to_a_tolerance(lit, out, capsys, monkeypatch):
    def draw(*args, progress, **options):
        yield from itertools.islice(render_to_tolerance(*args, progress=progress, **options), 2)
        raise KeyboardInterrupt

    monkeypatch.setattr("diffdisp.tolerance.render_to_tolerance", draw)
    path = out / "a.npz"
    assert main(["render", lit, "-o", str(path), *SMALL[:2], "--tolerance", "0.01"]) == 130
    told = capsys.readouterr()
    picture = read_picture(path)
    holds = f"{path} holds {picture.samples} samples a pixel in float32, estimated error 0"
    assert (told.out, told.err[: len(holds) + 23]) == ("", f"diffdisp: interrupted: {holds}")


# Good renders.


@pytest.mark.parametrize("name", ["a.npz", "a.png", "a.tiff", "a.exr"])
@pytest.mark.parametrize("bands", [None, "400:700:2"])
def test_render(scene, out, capsys, name, bands):
    options = [] if bands is None else ["--bands", bands]
    assert main(["render", scene, "-o", str(out / name), *SMALL, *options]) == 0
    assert capsys.readouterr() == ("", "")
    assert [file.name for file in out.iterdir()] == [name]
    picture = read_picture(out / name)
    assert picture.radiance.shape[:2] == (6, 8)
    assert 0.1 < picture.radiance.mean() < 1
    if name != "a.png":
        assert (picture.samples, picture.depth, picture.seed) == (2, 4, 0)
        if bands:
            np.testing.assert_allclose(picture.wavelengths, [0.475, 0.625], rtol=1e-6)


@pytest.mark.parametrize("name", ["default", "dispersion", "lamps", "metal_and_matte"])
def test_gallery(out, capsys, name):
    scene, output = str(GALLERY / f"{name}.toml"), str(out / "a.npz")
    assert main(["render", scene, "-o", output, "--size", "24x18", "--samples", "2"]) == 0
    assert capsys.readouterr() == ("", "")
    radiance = read_picture(output).radiance
    assert radiance.shape == (18, 24, 3)
    # Something is lit and something is not; saturated colours and noise may be below 0.
    assert 0.01 < radiance.mean() < 10
    assert radiance.std() > 0.1 * radiance.mean()


def test_a_tolerance_chooses_the_samples(lit, out, capsys):
    words = ["render", lit, "-o", str(out / "a.npz"), *SMALL[:2], "--tolerance", "0.1"]
    assert main(words) == 0
    told = re.fullmatch(
        r"(\d+) samples a pixel in float32, estimated error (0\.\d+)\n", capsys.readouterr().out
    )
    picture = read_picture(out / "a.npz")
    assert picture.samples == int(told[1])
    assert picture.seed is None  # a mean over pictures of several
    assert float(told[2]) <= 0.1
    assert main([*words, "--timing"]) == 0
    timing = json.loads(capsys.readouterr().out)
    assert timing.keys() == TIMING | {"samples", "estimated_error"}
    assert timing["samples"] == picture.samples
    assert timing["paths"] == 8 * 6 * picture.samples
    assert timing["estimated_error"] == pytest.approx(float(told[2]), rel=0.05)


def test_the_plan_of_a_tolerance_says_that_samples_are_chosen(lit, capsys):
    assert main(["render", lit, "--plan", "--tolerance", "0.1"]) == 0
    assert capsys.readouterr().out.endswith(
        "\ntolerance  0.1: other samples, chosen while drawing\n"
    )


def test_a_tolerance_that_is_not_reached(lit, out, capsys, monkeypatch):
    picture = Estimated(np.ones((6, 8, 3)), 4, 0.5, None, "float64")
    monkeypatch.setattr("diffdisp.tolerance.render_to_tolerance", lambda *_, **__: iter([picture]))
    assert main(["render", lit, "-o", str(out / "a.npz"), "--tolerance", "0.1"]) == 3
    holds = f"{out / 'a.npz'} holds 4 samples a pixel in float64, estimated error 0.5"
    assert capsys.readouterr() == ("", f"diffdisp: not reached: {holds}\n")
    assert read_picture(out / "a.npz").samples == 4


def test_float64_and_seed(scene, out):
    options = ["--float64", "--seed", "7", "--bands", "500:600:1"]
    assert main(["render", scene, "-o", str(out / "a.npz"), *SMALL, *options]) == 0
    picture = read_picture(out / "a.npz")
    assert picture.radiance.dtype == np.float64
    assert picture.seed == 7
    assert main(["render", scene, "-o", str(out / "b.npz"), *SMALL, *options[1:]]) == 0
    single = read_picture(out / "b.npz").radiance
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, picture.radiance, atol=1e-3)


@pytest.mark.parametrize(
    ("options", "samples"),
    [
        ([], 16),
        (["--quality", "draft"], 4),
        (["--quality", "reference"], 256),
        (["--quality", "draft", "--samples", "9"], 9),
    ],
)
def test_quality_and_defaults(scene, capsys, options, samples):
    assert main(["render", scene, "--plan", *options]) == 0
    told = capsys.readouterr()
    assert f"samples    {samples} a pixel" in told.out
    assert "depth      50 segments" in told.out
    assert "dtype      float32" in told.out
    assert ("\nquality    " in told.out) == ("--samples" not in options)
    assert told.err == ""


def test_default_size(scene, out, monkeypatch):
    asked = {}

    def draw(scene, film, **options):
        asked.update(options, size=(film.width, film.height), bands=film.wavelengths)
        yield Growing(np.zeros((film.height, film.width, 3), np.float32), 16)

    monkeypatch.setattr("diffdisp.rendering.render_progressively", draw)
    assert main(["render", scene, "-o", str(out / "a.png")]) == 0
    asked.pop("progress")
    assert asked == {
        "size": (480, 480),
        "bands": None,
        "samples": 16,
        "depth": 50,
        "seed": 0,
        "dtype": "float32",
    }
    assert iio.imread(out / "a.png").shape == (480, 480, 3)


def test_plan_with_output_also_renders(scene, out, capsys):
    assert main(["render", scene, "--plan", "-o", str(out / "a.png"), *SMALL]) == 0
    assert "1 glass, 1 shining plane\n" in capsys.readouterr().out
    assert [file.name for file in out.iterdir()] == ["a.png"]


TIMING = {"compile_s", "render_s", "cpu_s", "paths", "paths_per_s", "peak_memory_mb"}


def test_timing_is_one_line_of_json(scene, out, capsys):
    assert main(["render", scene, "--timing", "-o", str(out / "a.png"), *SMALL]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    timing = json.loads(line)
    assert timing.keys() == TIMING
    assert timing["cpu_s"] > 0
    assert timing["paths"] == 8 * 6 * 2
    assert timing["paths_per_s"] == pytest.approx(timing["paths"] / timing["render_s"])
    assert timing["compile_s"] >= 0
    assert 10 < timing["peak_memory_mb"] < 1e5
    assert (out / "a.png").is_file()


def test_bands_beyond_validity_warn_once(scene, out, capsys):
    options = ["--bands", "250:650:2"]
    assert main(["render", scene, "-o", str(out / "a.npz"), *SMALL, *options]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("diffdisp: warning: ball: bands 250-650 nm")
    assert "300-2500 nm" in line


def test_warnings_are_told_once_and_as_before_afterwards(capsys):
    shown = warnings.showwarning
    with command_line._plain_warnings():
        for _ in range(2):
            warnings.warn("of interest", stacklevel=1)
        warnings.warn("Error writing persistent compilation cache entry for x", stacklevel=1)
        warnings.warn("for developers", DeprecationWarning, stacklevel=1)
    assert capsys.readouterr().err == "diffdisp: warning: of interest\n"
    assert warnings.showwarning is shown


# Glass.


def test_glass_by_name(capsys):
    assert main(["glass", "n-bk7"]) == 0
    lines = capsys.readouterr().out.splitlines()
    # Source: Schott, data sheet of N-BK7.
    for expected in ("glass     N-BK7", "n_d       1.516800", "V_d       64.167"):
        assert expected in lines
    assert "B         1.03961212  0.231792344  1.01046945" in lines
    assert "C (µm²)   0.00600069867  0.0200179144  103.560653" in lines
    assert "P_gF      0.5349" in lines
    assert "validity  0.3-2.5 µm" in lines
    assert re.search("source    Schott", "\n".join(lines))


def test_glass_file_and_plot(out, capsys):
    path = str(FIXTURES / "glasses" / "N-BK7.yml")
    assert main(["glass", path, "-o", str(out / "n.png")]) == 0
    told = capsys.readouterr().out
    assert "n_d       1.516800" in told
    assert f"source    {path}" in told
    assert [file.name for file in out.iterdir()] == ["n.png"]


def test_glass_catalogue_is_printed_whole(capsys):
    assert main(["glass", str(FIXTURES / "glasses" / "sample.agf")]) == 0
    told = capsys.readouterr()
    assert len(told.out.split("\n\n")) > 1
    assert told.err.startswith("diffdisp: warning: ")


def test_glass_of_a_catalogue(out, capsys):
    catalogue = str(FIXTURES / "glasses" / "sample.agf")
    assert main(["glass", f"{catalogue}:N-SF11", "-o", str(out / "n.png")]) == 0
    assert "n_d       1.784720" in capsys.readouterr().out
    assert (out / "n.png").is_file()


def test_glass_without_an_index_in_the_visible(tmp_path, capsys):
    (tmp_path / "pole.yml").write_text(
        "DATA:\n  - type: formula 2\n    coefficients: 0 -2 0.01\n", encoding="utf-8"
    )
    assert main(["glass", str(tmp_path / "pole.yml")]) == 0
    told = capsys.readouterr().out
    assert "n_d       not defined" in told
    assert "validity  not stated" in told


# Fit.


@pytest.fixture
def fitted(monkeypatch):
    """What `fit` was asked for; it answers `converged`."""
    asked = {"converged": True, "rendering": None}

    def fit(scene, target, *, progress, **options):
        asked.update(options, shape=target.radiance.shape)
        progress(1, 0.1, 1.5)
        progress(2, 0.01, 1.51)
        told = {name: asked[name] for name in ("converged", "rendering")}
        return fake_result(target.wavelengths, 2, picture=target.radiance, **told)

    monkeypatch.setattr("diffdisp.fitting.fit", fit)
    return asked


def test_fit(scene, target, out, capsys, fitted):
    folder = out / "deep" / "fit"
    assert main(["fit", scene, target, "-o", str(folder)]) == 0
    told = capsys.readouterr()
    assert "n_d        1.5168049 ± 0.0000032" in told.out
    assert told.err == ""
    assert {file.name for file in folder.iterdir()} == {"fit.json", "report.png"}
    assert json.loads((folder / "fit.json").read_text(encoding="utf-8"))["converged"] is True
    assert iio.imread(folder / "report.png").std() > 5
    assert fitted["shape"] == (6, 8, 2)
    assert (fitted["object_name"], fitted["prior"], fitted["free"]) == (None, "none", [])
    assert fitted["noise"] is None
    assert fitted["start"] is None
    assert fitted["mask"] is None
    assert (fitted["loss"], fitted["check"]) == ("squares", None)
    assert fitted["tolerance"] is None


def test_fit_options(scene, target, out, fitted):
    options = ["--object", "ball", "--prior", "fixed-c3", "--noise", "1e-3", "--start", "f2"]
    options += ["--free", "ball.center", "--free", "gain", "--loss", "robust", "--check"]
    assert main(["fit", scene, target, "-o", str(out), *options]) == 0
    assert (fitted["object_name"], fitted["prior"], fitted["noise"]) == ("ball", "fixed-c3", 1e-3)
    assert fitted["start"].name == "F2"
    assert fitted["free"] == ["ball.center", "gain"]
    assert (fitted["loss"], fitted["check"]) == ("robust", "resample")


def test_fit_to_a_tolerance(scene, target, out, capsys, fitted):
    fitted["rendering"] = Rendered(1e-4, 3e-5, 1)
    assert main(["fit", scene, target, "-o", str(out), "--tolerance", "1e-4"]) == 0
    assert fitted["tolerance"] == 1e-4
    told = capsys.readouterr()
    assert "rendering  n_d to an estimated 3.0e-05 by 16 to 144 samples a pixel" in told.out
    assert told.err == ""


def test_fit_to_a_tolerance_out_of_reach(scene, target, out, capsys, fitted):
    fitted["rendering"] = Rendered(1e-9, 3e-8, 5)
    assert main(["fit", scene, target, "-o", str(out), "--tolerance", "1e-9"]) == 3
    assert "diffdisp: not reached: n_d to an estimated 3.0e-08" in capsys.readouterr().err
    assert {file.name for file in out.iterdir()} == {"fit.json", "report.png"}


def test_fit_with_a_mask(scene, target, tmp_path, out, fitted):
    mask = np.zeros((6, 8, 3), np.uint8)
    mask[1:5, 2:6] = 255
    iio.imwrite(tmp_path / "mask.png", mask)
    options = ["--mask", str(tmp_path / "mask.png")]
    assert main(["fit", scene, target, "-o", str(out), *options]) == 0
    np.testing.assert_array_equal(fitted["mask"], mask[..., 0] > 0)


def test_fit_that_does_not_converge(scene, target, out, capsys, fitted):
    fitted["converged"] = False
    assert main(["fit", scene, target, "-o", str(out)]) == 3
    assert "converged  NO" in capsys.readouterr().out
    assert {file.name for file in out.iterdir()} == {"fit.json", "report.png"}


def test_ctrl_c_keeps_the_fit_so_far(scene, target, out, capsys, monkeypatch):
    whole = fitting.fit

    def interrupted(*args, progress, **options):
        def tell(step, residual, n_d):
            progress(step, residual, n_d)
            raise KeyboardInterrupt

        return whole(*args, progress=tell, **options)

    monkeypatch.setattr("diffdisp.fitting.fit", interrupted)
    assert main(["fit", scene, target, "-o", str(out / "fit")]) == 130
    told = capsys.readouterr()
    assert told.err == f"diffdisp: interrupted: {out / 'fit'} holds the fit so far\n"
    assert "message    stopped in step 1 of the coarse picture" in told.out
    written = json.loads((out / "fit" / "fit.json").read_text(encoding="utf-8"))
    assert (written["converged"], written["stopped"]) == (False, True)
    assert (out / "fit" / "report.png").is_file()


def test_ctrl_c_before_a_fit_has_a_point(scene, target, out, capsys, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("diffdisp.fitting._starts", interrupted)
    assert main(["fit", scene, target, "-o", str(out / "fit")]) == 130
    assert capsys.readouterr() == ("", "diffdisp: interrupted, nothing written\n")
    assert list(out.iterdir()) == []


# What to expect of a fit.


@pytest.fixture
def expected(monkeypatch):
    """What was asked of each bench; the error of n_d falls with the picture's width."""
    asked = []

    def expect(scene, film, **options):
        asked.append((scene, film, options))
        return fake_expected(n_d_std=1e-4 / film.width)

    monkeypatch.setattr("diffdisp.varying.expected_uncertainty", expect)
    return asked


def test_plan_fit_prints(scene, out, monkeypatch, capsys, expected):
    monkeypatch.chdir(out)
    assert main(["plan-fit", scene, "--noise", "2e-3"]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert "picture    96 x 96 pixels, colour\n" in told.out
    assert "n_d        1.5168049 ± 0.0000010\n" in told.out
    assert "determined 3 of 6 directions" in told.out
    assert "one by one are not determined" in told.out
    assert "Best" not in told.out
    assert list(out.iterdir()) == []
    ((_, film, options),) = expected
    assert film.wavelengths is None
    assert options == {"noise": 2e-3, "object_name": None, "free": [], "prior": "none"}


def test_plan_fit_draws(scene, out, capsys, expected):
    folder = out / "deep" / "plan"
    options = ["--size", "40x30", "--bands", "400:700:8", "--object", "ball"]
    options += ["--free", "gain", "--free", "ball.center", "--prior", "fixed-c3"]
    assert main(["plan-fit", scene, "--noise", "1e-3", "-o", str(folder), *options]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert "width of the picture: 80 pixels instead of 40; σ of n_d 1.3e-06" in told.out
    assert "number of bands: 8, as it is" in told.out
    assert {file.name for file in folder.iterdir()} == {"plan.json", "plan.png"}
    plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    assert [len(some["values"]) for some in plan["variations"]] == [5, 5, 5, 5]
    assert plan["size"] == [40, 30]
    assert iio.imread(folder / "plan.png").std() > 5
    assert len(expected) == 17
    for _, _, asked in expected:
        assert asked["object_name"] == "ball"
        assert asked["free"] == ["gain", "ball.center"]
        assert (asked["noise"], asked["prior"]) == (1e-3, "fixed-c3")


def test_ctrl_c_while_planning(scene, out, capsys, monkeypatch):
    def interrupted(*_args, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr("diffdisp.varying.expected_uncertainty", interrupted)
    assert main(["plan-fit", scene, "--noise", "1e-3", "-o", str(out / "plan")]) == 130
    assert capsys.readouterr() == ("", "diffdisp: interrupted, nothing written\n")
    assert list(out.iterdir()) == []


# The process.


@pytest.fixture
def fresh_cache_settings():
    """JAX without a compile cache, as in a fresh process; afterwards as it was."""
    names = [
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    ]
    before = {name: getattr(jax.config, name) for name in names}
    for name, default in zip(names, (None, 1.0, 0), strict=True):
        jax.config.update(name, default)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.usefixtures("fresh_cache_settings")
@pytest.mark.parametrize(
    ("XDG_CACHE_HOME", "expected"), [("{}/x", "{}/x/diffdisp/jax"), ("", "{}/.cache/diffdisp/jax")]
)
def test_compile_cache_is_the_users(monkeypatch, tmp_path, XDG_CACHE_HOME, expected):
    monkeypatch.setenv("XDG_CACHE_HOME", XDG_CACHE_HOME.format(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    command_line._keep_compiled()
    assert jax.config.jax_compilation_cache_dir == expected.format(tmp_path)
    assert os.path.isdir(expected.format(tmp_path))
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0
    assert jax.config.jax_persistent_cache_min_entry_size_bytes == -1


@pytest.mark.usefixtures("fresh_cache_settings")
def test_compile_cache_that_cannot_be_written(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    command_line._keep_compiled()
    assert jax.config.jax_compilation_cache_dir is None


@pytest.mark.usefixtures("fresh_cache_settings")
def test_compile_cache_of_somebody_else_is_kept(monkeypatch, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    command_line._keep_compiled()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "own")
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0.5
    assert not (tmp_path / "other").exists()


def test_choices_are_those_of_the_fit():
    assert command_line.PRIORS == fitting.PRIORS
    assert command_line.LOSSES == fitting.LOSSES


def test_help_and_version(capsys):
    for command in ([], ["render"], ["fit"], ["plan-fit"], ["glass"]):
        assert main([*command, "--help"]) == 0
        assert "usage: diffdisp" in capsys.readouterr().out
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("diffdisp ")


def test_as_a_process():
    """The status reaches the shell, and a bad option loads nothing heavy."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "diffdisp", "render", "s.toml", "--size", "0x0"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert "diffdisp: argument --size: must be a whole number of at least 1" in done.stderr
    assert not re.search(r"\| +(jax|numpy)\n", done.stderr)


# What accuracy costs.


def test_tradeoff(lit, out, capsys, monkeypatch):
    settings = (Setting(1, 4), Setting(2, 4))
    monkeypatch.setattr("diffdisp.measuring.knob_grid", lambda *_: settings)
    folder = out / "new"
    words = ["tradeoff", lit, "-o", str(folder), *SMALL]
    assert main(words) == 0
    told = capsys.readouterr().out
    # Which of the two is the faster is the machine's own matter; one is on the front.
    marks = re.findall(r"^([* ])  [12] samples?, depth 4 ", told, re.MULTILINE)
    assert len(marks) == 2
    assert "*" in marks
    assert "The reference has 16 samples a pixel" in told
    assert {file.name for file in folder.iterdir()} == {
        "tradeoff.csv",
        "tradeoff.png",
        "reference.npz",
    }
    rows = (folder / "tradeoff.csv").read_text(encoding="utf-8").splitlines()
    assert rows[0].startswith("samples,depth,dtype,bands,shrink,error,delta_e_mean,delta_e_p99,")
    assert len(rows) == 3


def test_tradeoff_of_fits(scene, target, out, capsys, monkeypatch):
    asked = {}

    def measured(*_args, folder, **knobs):
        asked.update(knobs)
        settings = (FitSetting(1, 50), FitSetting(0, 50))
        row = FitMeasured(1.5, 1e-5, 1e-4, 1e-4, 0.1, 1, 9.0, 1.0, 1.0, 500.0)
        return Tradeoff(settings, (row, row), 1e-6, 64, Film(4, 4))

    monkeypatch.setattr("diffdisp.fit_measuring.fit_tradeoff", measured)
    words = ["tradeoff", scene, "--target", target, "-o", str(out / "new"), "--samples", "16"]
    assert main([*words, "--seed", "3"]) == 0
    del asked["progress"]
    assert asked == {"object_name": None, "most": 16, "seed": 3, "depth": 50}
    assert "The fit's own choice of samples: 0.0001 in 1 s" in capsys.readouterr().out
    assert (out / "new" / "tradeoff.png").is_file()


def test_a_target_beyond_the_glass_is_refused_before_anything_is_made(scene, out, tmp_path, capsys):
    path = tmp_path / "ultraviolet.npz"
    write_picture(path, Picture(np.ones((6, 8, 2)), np.array([0.09, 0.2])))
    words = ["tradeoff", scene, "--target", str(path), "-o", str(out / "new")]
    refused(capsys, words, "a pole")
    assert list(out.iterdir()) == []


def test_ctrl_c_in_a_tradeoff_says_how_far_it_came(lit, out, capsys, monkeypatch):
    def interrupted(*_args, progress, **_options):
        progress(3, 7)
        raise KeyboardInterrupt

    monkeypatch.setattr("diffdisp.measuring.tradeoff", interrupted)
    assert main(["tradeoff", lit, "-o", str(out / "new")]) == 130
    told = f"diffdisp: interrupted: {out / 'new'} holds 3 of 7 settings; the same command goes on\n"
    assert capsys.readouterr() == ("", told)


@pytest.mark.parametrize(
    ("options", "phrase"),
    [
        ("", "required: -o"),
        ("-o {out}/new --samples 0", "at least 1"),
        ("-o {out}/new --bands 90:200:2", "a pole"),
        ("-o {out}/new --size 1000000x1000000", "not enough memory"),
        ("-o {out}/file/new", "is no folder"),
        ("-o {out}/new --object ball", "--object"),
        ("-o {out}/new --target {out}/no.npz", "no.npz"),
        ("-o {out}/new --target {out}/no.npz --size 4x4", "--size is that of the target"),
        ("-o {out}/new --target {out}/no.npz --bands 400:700:4", "--bands is that of the target"),
    ],
)
def test_a_tradeoff_that_cannot_be(scene, out, capsys, options, phrase):
    (out / "file").write_text("a file")
    refused(capsys, ["tradeoff", scene, *options.format(out=out).split()], phrase)
    assert [file.name for file in out.iterdir()] == ["file"]
