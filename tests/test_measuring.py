import signal
import subprocess
from dataclasses import replace

import colour
import numpy as np
import pytest
from helpers import BK7, bench, camera, furnace, lamp, matte

from diffdisp import measuring
from diffdisp.film import Film
from diffdisp.measuring import Measured, Setting, Tradeoff, delta_e, knob_grid, tradeoff
from diffdisp.scene import Scene

SIZE = (8, 6)
LIT = Scene(camera(), [matte(0.8), lamp([2.0, 3.0, 2.0], 0.5)])


def measured(error, seconds):
    return Measured(error, 1.0, 2.0, 3.0, seconds, seconds, 500.0)


def of_samples(rows, reference_error=1e-4):
    """Settings of 1, 4, 16, ... samples, of which each row is error and time."""
    settings = tuple(Setting(4**power, 50) for power in range(len(rows)))
    return Tradeoff(
        settings, tuple(measured(*row) for row in rows), reference_error, 64, Film(4, 4)
    )


def test_the_front_is_what_nothing_beats():
    rows = [(0.4, 1.0), (0.2, 3.0), (0.3, 2.0), (0.25, 4.0), (0.1, 9.0)]
    assert of_samples(rows).front == (0, 2, 1, 4)


def test_the_fastest_within_an_error():
    found = of_samples([(0.4, 1.0), (0.2, 3.0), (0.3, 2.0)])
    assert found.fastest(0.35) == 2
    assert found.fastest(0.2) == 1
    assert found.fastest(0.1) is None


def test_fall_and_price_are_the_powers():
    # An error of samples^-0.6 and a time of samples^1.
    found = of_samples([(4.0 ** (-0.6 * power), 4.0**power) for power in range(5)])
    assert found.fall == pytest.approx(0.6)
    assert found.price == pytest.approx(2.0 ** (1 / 0.6))


def test_what_the_reference_cannot_tell_is_left_out():
    rows = [(0.4, 1.0), (0.2, 2.0), (0.1, 4.0), (0.1, 8.0)]
    found = of_samples(rows, reference_error=0.04)
    assert found.sweep == (0, 1)
    assert found.fall == pytest.approx(0.5)
    assert np.isnan(of_samples(rows, reference_error=0.2).fall)


def test_another_knob_is_not_in_the_sweep():
    found = of_samples([(0.4, 1.0), (0.2, 2.0)])
    other = (*found.settings, Setting(16, 4))
    found = found._replace(settings=other, measured=(*found.measured, measured(0.3, 1.0)))
    assert found.sweep == (0, 1)


def turned(scene, film, **usual):
    """The knobs that differ from the usual in any setting, and their values."""
    grid = knob_grid(scene, film, 64, 50)
    base = Setting(1, 50)
    return {
        name: {getattr(setting, name) for setting in grid} - {getattr(base, name)}
        for name in ("depth", "dtype", "bands", "shrink")
    }


def test_only_knobs_that_change_something_are_turned():
    film = Film(*SIZE)
    every = turned(bench(), film)
    assert every == {
        "depth": {2, 4, 8, 16},
        "dtype": {"float64"},
        "bands": {4, 8, 16, 32},
        "shrink": {2, 4},
    }
    assert turned(LIT, film)["bands"] == set()
    assert turned(bench(), Film(*SIZE, np.array([0.5, 0.6])))["bands"] == set()
    assert turned(furnace(), film)["depth"] == set()
    assert turned(LIT, Film(3, 3))["shrink"] == {2}


def test_samples_are_doubled_up_to_the_most():
    alone = [s.samples for s in knob_grid(LIT, Film(*SIZE), 20, 50) if s == Setting(s.samples, 50)]
    assert alone == [1, 2, 4, 8, 16]
    assert all(setting.samples <= 2 for setting in knob_grid(LIT, Film(*SIZE), 2, 50))


@pytest.fixture
def two_settings(monkeypatch):
    grid = (Setting(1, 4), Setting(2, 4, shrink=2))
    monkeypatch.setattr(measuring, "knob_grid", lambda *_: grid)
    return grid


def test_settings_are_measured_once(two_settings, tmp_path, monkeypatch):
    told = []
    knobs = {"most": 2, "depth": 4, "progress": lambda *parts: told.append(parts)}
    found = tradeoff(LIT, SIZE, None, tmp_path, **knobs)
    assert told == [(0, 2), (1, 2), (2, 2)]
    assert found.settings == two_settings
    assert found.reference_samples == 16  # two pictures of 4 · 2
    for row in found.measured:
        assert 0 < row.error < 1
        assert 0 < row.delta_e_mean < row.delta_e_p99
        assert row.compile_s > row.render_s > 0
        assert row.cpu_s > 0
        assert row.peak_memory_mb > 50

    def no_more(*_args, **_options):
        pytest.fail("measured again")

    monkeypatch.setattr(measuring, "render", no_more)
    monkeypatch.setattr(subprocess, "run", no_more)
    assert tradeoff(LIT, SIZE, None, tmp_path, **knobs) == found
    # Another scene is another measurement.
    brighter = Scene(camera(), [matte(0.8), lamp([2.0, 3.0, 2.0], 0.6)])
    with pytest.raises(pytest.fail.Exception):
        tradeoff(brighter, SIZE, None, tmp_path, **knobs)


def ended(status, told=""):
    return lambda words, **_: subprocess.CompletedProcess(words, status, "", told)


def test_what_was_measured_before_an_interruption_stays(two_settings, tmp_path, monkeypatch):
    run, calls = subprocess.run, []

    def second_interrupted(words, **options):
        calls.append(words)
        return ended(130)(words) if len(calls) == 2 else run(words, **options)

    monkeypatch.setattr(subprocess, "run", second_interrupted)
    with pytest.raises(KeyboardInterrupt):
        tradeoff(LIT, SIZE, None, tmp_path, most=2, depth=4)
    assert len((tmp_path / "tradeoff.csv").read_text().splitlines()) == 2
    tradeoff(LIT, SIZE, None, tmp_path, most=2, depth=4)
    assert len(calls) == 3


def test_a_process_that_fails_is_told_with_its_words(two_settings, tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess, "run", ended(-signal.SIGKILL, "no luck"))
    with pytest.raises(RuntimeError, match=r"render .*scene.toml .*--samples 1 .*: no luck"):
        tradeoff(LIT, SIZE, None, tmp_path, most=2, depth=4)


def test_a_file_that_is_no_record_is_measured_anew(two_settings, tmp_path, monkeypatch):
    (tmp_path / "tradeoff.csv").write_text("samples,key\nmany,\n")
    (tmp_path / "reference.npz").write_bytes(b"nothing")
    monkeypatch.setattr(subprocess, "run", ended(1))
    with pytest.raises(RuntimeError):
        tradeoff(LIT, SIZE, None, tmp_path, most=2, depth=4)


def test_wavelengths_outside_a_glass_are_refused(tmp_path):
    with pytest.raises(ValueError, match="pole"):
        tradeoff(bench(BK7), SIZE, (90.0, 200.0, 2), tmp_path)


def test_colour_difference_of_white_and_black_is_the_whole_lightness():
    # Both lie on the grey axis, ΔL = 100; its weight there is 1 + 0.015·0/√20.
    white, black = np.ones((1, 1, 3)), np.zeros((1, 1, 3))
    assert delta_e(white, black) == pytest.approx(100.0, abs=0.05)
    assert delta_e(white, 7.0 * white) == pytest.approx(0.0, abs=1e-9)


def test_colour_difference_is_that_of_lab():
    one, other = np.array([[[0.2, 0.4, 0.1]]]), np.array([[[0.25, 0.35, 0.1]]])
    # By way of encoded values, which colour-science turns to Lab itself.
    lab = [
        colour.XYZ_to_Lab(colour.sRGB_to_XYZ(colour.cctf_encoding(rgb, "sRGB")))
        for rgb in (one, other)
    ]
    known = colour.delta_E(*lab, method="CIE 2000")
    assert delta_e(one, other) == pytest.approx(known, rel=1e-3)


def test_settings_are_told_apart():
    assert replace(Setting(16, 50), bands=8) != Setting(16, 50)
