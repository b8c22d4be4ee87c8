import json
import warnings
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
from fake_fit import BANDS, blurred_ring, fake_expected, fake_result, fake_target

from diffdisp.dispersion import Sellmeier
from diffdisp.film import Film
from diffdisp.fit_measuring import FitMeasured, FitSetting
from diffdisp.fitting import FreeValue, Rendered, Resampled
from diffdisp.glasses import named_glass
from diffdisp.image import Picture
from diffdisp.measuring import Measured, Setting, Tradeoff
from diffdisp.report import (
    bench_json,
    bench_table,
    fit_json,
    result_table,
    tradeoff_summary,
    tradeoff_table,
    write_bench_json,
    write_bench_plot,
    write_fit_json,
    write_glass_plot,
    write_report,
    write_tradeoff_plot,
)
from diffdisp.varying import Bench, Variation

KEYS = {
    *("converged", "message", "steps", "B", "C", "B_std", "C_std", "covariance", "n_d"),
    *("n_d_std", "V_d", "V_d_std", "P_gF", "wavelength", "n", "n_std", "singular_values"),
    *("determined", "summary", "rms_residual", "nearest_glasses"),
    *("object", "prior", "P_gF_std", "free", "left_out", "loss", "other_glass_probability"),
    *("stopped", "check", "rendering"),
}
LEFT_OUT = ("masked_pixels", "clipped_values", "outlying_values")


def size_of(path):
    """Width and height of a .png that is not blank."""
    pixels = iio.imread(path)
    assert pixels.std() > 5
    return pixels.shape[1], pixels.shape[0]


def test_json_has_the_promised_keys():
    assert fit_json(fake_result()).keys() == KEYS


def test_json_holds_the_numbers(tmp_path):
    result = fake_result()
    write_fit_json(tmp_path / "fit.json", result)
    read = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    assert read["B"] == result.B.tolist()
    assert read["wavelength"] == BANDS.tolist()
    assert np.shape(read["covariance"]) == (6, 6)
    assert read["nearest_glasses"][0] == {
        "name": "N-BK7",
        "distance": pytest.approx(result.nearest_glasses[0][1]),
    }
    assert read["converged"] is True
    assert [file.name for file in tmp_path.iterdir()] == ["fit.json"]


def test_what_was_free_is_told():
    free = (FreeValue("ball.center.x", 0.0125, 3e-4), FreeValue("black", 0.02, float("nan")))
    free += tuple(FreeValue(f"gain[{i}]", 1.1 + i / 100, 2e-3) for i in range(4))
    result = fake_result(free=free)
    assert fit_json(result)["free"][0] == {"name": "ball.center.x", "value": 0.0125, "std": 3e-4}
    assert fit_json(result)["free"][1]["std"] is None
    table = result_table(result)
    assert "ball.center.x  0.01250 ± 0.00030\n" in table
    assert "black          0.02 ± unknown\n" in table
    assert "gain           1.1000 ± 0.0020 to 1.1300 ± 0.0020\n" in table
    assert "gain[" not in table
    one = result_table(fake_result(free=(FreeValue("gain[0]", 1.1, 2e-3),)))
    assert "gain       1.1000 ± 0.0020\n" in one


def test_how_likely_the_nearest_glasses_are(tmp_path):
    likely = (0.91, 0.0849, 3e-4, 0.0, 0.0)
    result = fake_result(probabilities=likely, other_probability=0.0048)
    told = fit_json(result)
    assert [entry["probability"] for entry in told["nearest_glasses"]] == list(likely)
    assert [set(entry) for entry in told["nearest_glasses"]] == [
        {"name", "distance", "probability"}
    ] * 5
    assert told["other_glass_probability"] == 0.0048
    first, second = (name for name, _ in result.nearest_glasses[:2])
    line = f"glass      {first} 0.910, {second} 0.085, none of the table 0.005\n"
    assert line in result_table(result)
    assert "glass  " not in result_table(fake_result())
    write_report(tmp_path / "a.png", result, fake_target())
    write_report(tmp_path / "b.png", fake_result(), fake_target())
    assert (tmp_path / "a.png").read_bytes() != (tmp_path / "b.png").read_bytes()


def test_what_a_tolerance_chose_is_told():
    assert fit_json(fake_result())["rendering"] is None
    assert "rendering" not in result_table(fake_result())
    result = fake_result(rendering=Rendered(1e-5, 4e-6, 2))
    told = {"tolerance": 1e-5, "error": 4e-6, "refinements": 2, "samples": [16, 144]}
    assert fit_json(result)["rendering"] == told
    words = "n_d to an estimated 4.0e-06 by 16 to 144 samples a pixel, 2 refinements; tolerance"
    assert f"rendering  {words} 1e-05\n" in result_table(result)
    assert "by 16 samples a pixel" in result_table(replace(result, samples=(16,)))


def test_a_check_is_told():
    assert fit_json(fake_result())["check"] is None
    assert "check" not in result_table(fake_result())
    result = fake_result(check=Resampled(51, 4e-6, 1.3))
    assert fit_json(result)["check"] == {"repeats": 51, "n_d_std": 4e-6, "ratio": 1.3}
    # A standard deviation of 51 is known to a tenth.
    assert "check      resampled n_d spreads 1.30 ± 0.13 times its error\n" in result_table(result)


def test_json_has_null_for_what_is_not_finite(tmp_path):
    unknown = np.array([1.0, np.inf, np.nan])
    result = fake_result(
        C_std=unknown,
        covariance=np.full((6, 6), np.inf),
        V_d=float("nan"),
        rms_residual=np.float64("inf"),
        nearest_glasses=(("N-BK7", float("inf")),),
    )
    write_fit_json(tmp_path / "fit.json", result)

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    text = (tmp_path / "fit.json").read_text(encoding="utf-8")
    read = json.loads(text, parse_constant=refuse)
    assert read["C_std"] == [1.0, None, None]
    assert read["covariance"] == [[None] * 6] * 6
    assert read["V_d"] is None
    assert read["rms_residual"] is None
    assert read["nearest_glasses"] == [{"name": "N-BK7", "distance": None}]


def test_failed_write_leaves_the_old_file(tmp_path):
    (tmp_path / "fit.json").write_text("old")
    with pytest.raises(TypeError):
        write_fit_json(tmp_path / "fit.json", fake_result(message=object()))
    assert (tmp_path / "fit.json").read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["fit.json"]


def test_table_of_a_converged_fit():
    lines = result_table(fake_result()).splitlines()
    assert "converged  yes, 7 steps" in lines
    assert "n_d        1.5168049 ± 0.0000032" in lines
    assert "V_d        64.171 ± 0.021" in lines
    assert "B2         0.23 ± 0.95   undetermined" in lines
    assert "determined 3 of 6 directions" in lines
    assert any(line.startswith("nearest    N-BK7 254 σ, ") for line in lines)
    assert "residual   0.00103 rms" in lines
    assert lines[-1].endswith("alone.")
    assert max(map(len, lines)) <= 79


def test_table_of_what_is_fixed_unknown_or_failed():
    result = fake_result(
        converged=False,
        message="too many steps",
        steps=1,
        B_std=np.array([0.0, np.inf, 1e-4]),
        V_d=float("inf"),
        n_d_std=float("nan"),
    )
    lines = result_table(result).splitlines()
    assert "converged  NO, 1 step" in lines
    assert "message    too many steps" in lines
    assert any(line.startswith("B1  ") and line.endswith("held fixed") for line in lines)
    assert "B2         0.2317947 ± unknown   undetermined" in lines
    assert "B3         1.01048 ± 0.00010" in lines
    assert "V_d        not defined" in lines
    assert "n_d        1.516805 ± unknown" in lines


INFRARED = np.array([1.0, 1.5, 2.3])


@pytest.mark.parametrize(
    ("target", "result"),
    [
        (fake_target(), fake_result()),
        (fake_target(None), fake_result(channels=3)),
        (fake_target(INFRARED), fake_result(INFRARED, 3)),
        (fake_target(np.array([0.55])), fake_result(np.array([0.55]), 1)),
        (fake_target(BANDS[::-1]), fake_result(BANDS[::-1].copy())),
        (
            Picture(np.zeros((32, 32, 16)), BANDS),
            fake_result(
                picture=np.zeros((32, 32, 16)),
                n_std=np.full(16, np.inf),
                nearest_glasses=(),
                summary="costs $1 or $2",
                object_name="a $name$ " + "that does not end " * 5,
                converged=False,
                message="it did not reach a minimum within the 60 steps that it may take " * 2,
            ),
        ),
    ],
    ids=["bands", "colour", "infrared", "one band", "falling", "nothing known"],
)
def test_report_is_drawn(tmp_path, target, result):
    write_report(tmp_path / "report.png", result, target)
    assert size_of(tmp_path / "report.png") == (1620, 984)
    assert [file.name for file in tmp_path.iterdir()] == ["report.png"]


def test_report_leaves_matplotlib_alone(tmp_path):
    import matplotlib
    import matplotlib.pyplot

    before = dict(matplotlib.rcParams), matplotlib.pyplot.get_fignums()
    write_report(tmp_path / "report.png", fake_result(), fake_target())
    assert (dict(matplotlib.rcParams), matplotlib.pyplot.get_fignums()) == before


def test_report_shows_the_residual(tmp_path):
    """Another fit, another picture: the panels are drawn from the data."""
    write_report(tmp_path / "a.png", fake_result(), fake_target())
    shifted = np.roll(blurred_ring(32, 16), 3, axis=1)
    write_report(tmp_path / "b.png", fake_result(picture=shifted), fake_target())
    assert (tmp_path / "a.png").read_bytes() != (tmp_path / "b.png").read_bytes()


def test_what_a_mask_left_out_is_told_and_not_drawn(tmp_path):
    used = np.ones((32, 32), bool)
    assert fit_json(fake_result())["left_out"] == dict.fromkeys(LEFT_OUT, 0)
    assert "left out" not in result_table(fake_result())
    used[4:8, 4:8] = False
    result = fake_result(used=used, clipped=7, outliers=9)
    assert fit_json(result)["left_out"] == dict(zip(LEFT_OUT, (16, 7, 9), strict=True))
    assert "left out   16 pixels by the mask\n" in result_table(result)
    write_report(tmp_path / "a.png", result, fake_target())
    # What a masked pixel holds changes neither the picture of the residual nor its scale.
    spoiled = fake_target().radiance.copy()
    spoiled[4:8, 4:8] = np.nan
    write_report(tmp_path / "b.png", result, Picture(spoiled, BANDS))
    drawn, again = (iio.imread(tmp_path / name)[:480, 1080:] for name in ("a.png", "b.png"))
    np.testing.assert_array_equal(drawn, again)


@pytest.mark.parametrize(
    "glass",
    [
        named_glass("N-BK7"),
        Sellmeier([1.0, 0.2, 0.9], [0.006, 0.02, 103.0]),
        Sellmeier([1.0, 0.2, 0.9], [0.006, 0.02, 103.0], (0.0, 1e9), "$wide$"),
        Sellmeier([1.0, 0.2, 0.9], [0.006, 0.02, 103.0], (3.0, np.inf)),
        Sellmeier([1.0, 0.2, 0.9], [0.006, 0.02, 103.0], (60.0, 70.0)),
        Sellmeier([1.0, 0.2, 0.9], [0.006, 0.02, 103.0], (0.01, 0.02)),
        Sellmeier([1.0, 0.0, 0.0], [0.25, 0.0, 0.0]),  # a pole at 0.5 µm
        Sellmeier([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
    ],
)
def test_glass_plot(tmp_path, glass):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_glass_plot(tmp_path / "n.png", glass)
    assert size_of(tmp_path / "n.png") == (840, 540)


@pytest.mark.parametrize("suffix", [".pdf", ".svg", ".PNG"])
def test_other_formats_of_plots(tmp_path, suffix):
    write_glass_plot(tmp_path / f"n{suffix}", named_glass("N-BK7"))
    assert [file.name for file in tmp_path.iterdir()] == [f"n{suffix}"]


@pytest.mark.parametrize(
    ("name", "message"), [("n.jpeg", r"one of \.png"), ("no/n.png", "no folder"), ("", "ends in")]
)
def test_plots_that_cannot_be_written(tmp_path, name, message):
    with pytest.raises(ValueError, match=message):
        write_glass_plot(tmp_path / name, named_glass("N-BK7"))
    assert list(tmp_path.iterdir()) == []


# --- what to expect of a bench


def fake_bench(count: int = 4) -> Bench:
    """A bench whose tiles are best as they are, and whose pictures had better be large."""
    values, errors = np.array([0.25, 0.5, 1.0]), np.array([5e-6, 3.2e-6, 6e-6])
    variations = (
        Variation("tile width", "scene units", 0.5, values, errors, errors * 1e4),
        Variation("width of the picture", "pixels", 32.0, 64 * values, 2e-4 * values, values, 2),
        Variation("number of bands", "", 8.0, 16 * values, errors[::-1], errors, 1),
        Variation("distance", "scene units", 0.5, values[1:2], errors[1:2], errors[1:2]),
    )
    film = Film(32, 32, BANDS)
    return Bench(fake_expected(), film, variations[:count], ("a screen: there is none",))


def test_what_to_expect_as_a_table():
    table = bench_table(fake_bench())
    assert table.startswith("object     ball\npicture    32 x 32 pixels, 16 bands\n")
    assert "noise      0.001 in each value\n" in table
    for line in result_table(fake_result()).split("\n"):
        # All that a fit says of the glass and its errors is said of one to come as well.
        if not line.startswith(("converged", "nearest", "residual")):
            assert f"{line}\n" in table
    assert "  tile width: 0.5 scene units, as it is\n" in table
    assert "  width of the picture: 16 pixels instead of 32; σ of n_d 5e-05 instead of " in table
    assert "  number of bands: 8, as it is\n" in table
    assert table.endswith("Left out: a screen: there is none.")
    assert "Best" not in bench_table(fake_bench(0))


def test_what_to_expect_as_json(tmp_path):
    write_bench_json(tmp_path / "plan.json", fake_bench())
    read = json.loads((tmp_path / "plan.json").read_text(encoding="utf-8"))
    of_fits_alone = {"converged", "message", "stopped", "steps", "rms_residual", "loss"}
    of_fits_alone |= {"nearest_glasses", "other_glass_probability", "check", "rendering"}
    own = {"noise", "size", "variations", "left_out"}
    assert read.keys() == (KEYS - of_fits_alone) | own == bench_json(fake_bench()).keys()
    assert read["variations"][0] == {
        "quantity": "tile width",
        "unit": "scene units",
        "own": 0.5,
        "values": [0.25, 0.5, 1.0],
        "n_d_std": [5e-6, 3.2e-6, 6e-6],
        "V_d_std": pytest.approx([0.05, 0.032, 0.06]),
        "best": 0.5,
    }
    assert (read["noise"], read["size"]) == (1e-3, [32, 32])
    assert [file.name for file in tmp_path.iterdir()] == ["plan.json"]


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_variations_are_drawn(tmp_path, count):
    write_bench_plot(tmp_path / "plan.png", fake_bench(count))
    width, height = size_of(tmp_path / "plan.png")
    assert width > 1000
    assert height > (400 if count < 3 else 800)
    with pytest.raises(ValueError, match=r"found '\.doc'"):
        write_bench_plot(tmp_path / "plan.doc", fake_bench(count))


def fake_tradeoff():
    """Measured settings: an error of samples^-0.5 and a time of samples^1, and other knobs."""
    settings = [Setting(4**power, 50) for power in range(5)]
    rows = [
        Measured(0.2 * 0.5**power, 1.0, 2.5, 3.0, 0.1 * 4.0**power, 0.2, 512.3)
        for power in range(5)
    ]
    settings += [Setting(16, 2), Setting(16, 50, "float64"), Setting(16, 50, bands=8)]
    settings += [Setting(16, 50, shrink=2)]
    rows += [Measured(error, 1.0, 2.5, 3.0, 2.0, 0.2, 512.3) for error in (0.06, 0.05, 0.004, 0.3)]
    return Tradeoff(tuple(settings), tuple(rows), 0.005, 1024, Film(8, 6))


def test_a_tradeoff_as_a_table():
    lines = tradeoff_table(fake_tradeoff()).split("\n")
    assert lines[0].split() == [
        "setting",
        "error",
        "ΔE",
        "99",
        "%",
        "compile",
        "s",
        "s",
        "CPU",
        "s",
        "MB",
    ]
    assert (
        lines[1]
        == "*  1 sample, depth 50                 0.2  1.00  2.50          3   0.1    0.2  512"
    )
    # Two that are worse than another one, and one beyond what the reference tells.
    assert lines[6].startswith("   16 samples, depth 2 ")
    assert lines[7].startswith("   16 samples, depth 50, float64 ")
    assert lines[8].startswith("*  16 samples, depth 50, 8 bands   <0.005 ")
    assert lines[9].startswith("   16 samples, depth 50, 1/2 size ")
    assert lines[11:] == [
        "For 10% take 4 samples, depth 50: 0.4 s.",
        "For 3% take 16 samples, depth 50, 8 bands: 2 s.",
        "For 1% take 16 samples, depth 50, 8 bands: 2 s.",
        "The error falls as samples^-0.50; halving it costs 4.0 times the time.",
        "The reference has 1024 samples a pixel and an error of 0.005 of its own.",
    ]


def test_of_one_setting_no_fall_is_said():
    found = fake_tradeoff()
    one = found._replace(settings=found.settings[:1], measured=found.measured[:1])
    assert "falls" not in tradeoff_summary(one)


def fake_fit_tradeoff():
    """The same of fits: errors of samples^-1, the fit's own choice, and other knobs."""
    settings = [FitSetting(4**power, 50) for power in range(4)] + [FitSetting(0, 50)]
    settings += [FitSetting(4, 8), FitSetting(4, 50, every=2), FitSetting(4, 50, shrink=4)]
    costs = [(1e-3 * 0.25**power, 4.0**power) for power in range(4)]
    costs += [(2e-5, 12.0), (2e-4, 3.0), (4e-4, 2.0), (9e-4, 1.5)]
    rows = [
        FitMeasured(1.5168, 3e-5, error, 2 * error, 0.1, 1, 30.0, seconds, seconds, 900.2)
        for error, seconds in costs
    ]
    rows[4] = replace(rows[4], slope_error=float("nan"))
    rows[7] = replace(rows[7], converged=0)
    return Tradeoff(tuple(settings), tuple(rows), 3e-6, 256, Film(96, 96, np.array([0.5, 0.6])))


def test_a_tradeoff_of_fits_as_a_table():
    lines = tradeoff_table(fake_fit_tradeoff()).split("\n")
    assert " ".join(lines[0].split()) == (
        "setting of n_d of n of slopes n_d +- compile s s CPU s MB"
    )
    told = [" ".join(line.split()) for line in lines[1:9]]
    assert told[0] == "* 1 sample, depth 50 0.001 0.002 0.1 1.5168000 3e-05 30 1 1 900"
    assert told[4] == "* samples of its choice, depth 50 2e-05 4e-05 1.5168000 3e-05 30 12 12 900"
    assert told[5].startswith("* 4 samples, depth 8 ")
    assert told[6].startswith("* 4 samples, depth 50, 1 of 2 bands ")
    assert told[7].startswith("* 4 samples, depth 50, 1/4 size 0.0009 0.0018 0.1 1.5168000 failed")
    assert lines[10:] == [
        "For n_d to 1e-04 take samples of its choice, depth 50: 12 s.",
        "The error falls as samples^-1.00; halving it costs 2.0 times the time.",
        "The fit's own choice of samples: 2e-05 in 12 s.",
        "What the picture leaves open of n_d in any case: 3e-05.",
        "The reference has 256 samples a pixel and an error of 3e-06 of its own.",
    ]


@pytest.mark.parametrize("found", [fake_tradeoff(), fake_fit_tradeoff()])
def test_a_tradeoff_is_drawn(tmp_path, found):
    write_tradeoff_plot(tmp_path / "tradeoff.png", found)
    width, height = size_of(tmp_path / "tradeoff.png")
    assert width > 900
    assert height > 600
    with pytest.raises(ValueError, match=r"found '\.doc'"):
        write_tradeoff_plot(tmp_path / "tradeoff.doc", fake_tradeoff())
