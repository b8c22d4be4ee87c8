import signal
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from helpers import BK7, ball, bench, camera, screen

from diffdisp import fit_measuring
from diffdisp.film import Film, band_middles
from diffdisp.fit_measuring import FitMeasured, FitSetting, fit_grid, fit_tradeoff
from diffdisp.glasses import named_glass
from diffdisp.image import Picture
from diffdisp.rendering import render
from diffdisp.scene import Scene

BANDS = Film(16, 12, np.array([0.42, 0.48, 0.55, 0.65]))
START = bench(named_glass("fused silica"))
TARGET = Picture(np.ones((12, 16, 4)), BANDS.wavelengths)


def turned(target, **usual):
    """The values of each knob."""
    grid = fit_grid(START, target, 16, 50)
    return {
        name: {getattr(s, name) for s in grid} for name in ("samples", "depth", "every", "shrink")
    }


def test_only_knobs_that_change_something_are_turned():
    every = {"samples": {0, 1, 2, 4, 8, 16}, "depth": {4, 8, 50}, "shrink": {1, 2, 4}}
    eight = replace(
        TARGET, radiance=np.ones((12, 16, 8)), wavelengths=band_middles(400.0, 700.0, 8)
    )
    assert turned(eight) == {**every, "every": {1, 2}}
    assert turned(TARGET) == {**every, "every": {1}}
    color = Picture(np.full((12, 16, 3), 0.5), ceiling=0.9)
    assert turned(color) == {**every, "every": {1}}
    # The mean of pixels of which one was cut off is not known.
    assert turned(Picture(np.ones((12, 16, 3)), ceiling=1.0))["shrink"] == {1}
    assert turned(Picture(np.ones((11, 16, 3))))["shrink"] == {1}


def fake_alone(fitting, setting, warm):
    """A fit that is off by 1e-3 over its samples."""
    off = 1e-3 / (setting.samples or 100)
    told = {"n_d_std": 1e-5, "converged": 1, "compile_s": 9.0, "fit_s": float(setting.samples)}
    told |= {"cpu_s": 1.0, "peak_memory_mb": 500.0} if warm else {}
    slope = np.zeros(0)
    if setting.samples:
        whole = np.arange(12 * 16 * 4.0).reshape(12, 16, 4) * (1 + 10 * off)
        slope = fit_measuring._shrunk(whole[..., :: setting.every], setting.shrink)
    return fit_measuring._Fitted(1.5 + off, np.full(4, 1.5 - off), slope, told)


@pytest.fixture
def faked(monkeypatch):
    calls = []

    def alone(*arguments):
        calls.append(arguments[1])
        return fake_alone(*arguments)

    monkeypatch.setattr(fit_measuring._Fitting, "alone", alone)
    return calls


def test_answers_are_compared_with_that_of_many_samples(faked, tmp_path):
    found = fit_tradeoff(START, TARGET, tmp_path, most=8)
    assert found.reference_samples == 32
    for setting, row in zip(found.settings, found.measured, strict=True):
        off = 1e-3 / (setting.samples or 100) - 1e-3 / 32
        assert row.n_d_error == pytest.approx(abs(off))
        assert row.n_error == pytest.approx(abs(off))
        if setting.samples:
            # Blocks and bands are compared with those of the reference.
            assert row.slope_error == pytest.approx(10 * off, rel=1e-3)
        else:
            assert np.isnan(row.slope_error)
    # Rows of the same samples are as good and as fast; what the fit chooses costs nothing here.
    assert found.settings[found.front[0]].samples == 0
    assert found.sweep == (0, 1, 2)
    assert found.fastest(1e-3) is not None


def test_settings_are_measured_once(faked, tmp_path):
    told = []
    found = fit_tradeoff(START, TARGET, tmp_path, most=2, progress=lambda *p: told.append(p))
    assert told == [(k, len(found.settings)) for k in range(len(found.settings) + 1)]
    assert len(faked) == len(found.settings) + 1
    again = fit_tradeoff(START, TARGET, tmp_path, most=2)
    assert len(faked) == len(found.settings) + 1
    assert str(again) == str(found)  # NaN is not equal to itself
    darker = replace(TARGET, radiance=0.5 * TARGET.radiance)
    fit_tradeoff(START, darker, tmp_path, most=2)
    assert len(faked) == 2 * len(found.settings) + 2


def ended(status, told=""):
    return lambda words, **_: subprocess.CompletedProcess(words, status, "", told)


def test_a_process_that_fails_is_told_with_its_words(tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess, "run", ended(-signal.SIGKILL, "no luck"))
    with pytest.raises(RuntimeError, match=r"samples=8.*: no luck"):
        fit_tradeoff(START, TARGET, tmp_path, most=2)
    monkeypatch.setattr(subprocess, "run", ended(130))
    with pytest.raises(KeyboardInterrupt):
        fit_tradeoff(START, TARGET, tmp_path, most=2)


def test_two_balls_without_a_name_are_refused(tmp_path):
    two = Scene(camera(), [ball(BK7, [-1.2, 0, 0]), ball(BK7, [1.2, 0, 0]), screen()])
    with pytest.raises(ValueError, match="several"):
        fit_tradeoff(two, TARGET, tmp_path)


def test_fits_are_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(fit_measuring, "fit_grid", lambda *_: (FitSetting(1, 8),))
    monkeypatch.setattr(fit_measuring, "WARM_FITS", 1)
    radiance = np.asarray(render(bench(BK7), BANDS, samples=64, dtype="float64"))
    noise = np.random.default_rng(0).normal(0.0, 0.003, radiance.shape)
    target = Picture(radiance + noise, BANDS.wavelengths)
    found = fit_tradeoff(START, target, tmp_path, most=1, depth=8)
    (row,) = found.measured
    assert isinstance(row, FitMeasured)
    assert row.converged == 1
    assert row.n_d == pytest.approx(1.5168, abs=5e-3)
    assert 0 < row.n_d_error < 5e-3
    assert 0 < row.n_error < 5e-3
    assert 0 < row.slope_error < 1
    assert row.compile_s > row.fit_s > 0
    assert row.cpu_s > 0
    assert row.peak_memory_mb > 50
    assert 0 < found.reference_error < row.n_d_error
