"""Fits to pictures of our own, clean and noisy, and to one of another renderer."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import BK7, ball, bench, camera, glass_of_index, screen

from diffdisp.dispersion import Sellmeier, domain_error
from diffdisp.film import Film, band_middles
from diffdisp.fitting import (
    COLOR_WAVELENGTHS,
    CUTOFF,
    FOR_SLOPES,
    PROFILE,
    Coefficients,
    Descent,
    Drawing,
    FitResult,
    Level,
    Point,
    Problem,
    Rendered,
    StopFit,
    Unknowns,
    _counted,
    _covariance,
    _crossed,
    _drawn_within,
    _in_order,
    _in_pixels,
    _level,
    _linearise,
    _marked,
    _mean_place,
    _more_samples,
    _n_d,
    _next_point,
    _probabilities,
    _problem,
    _reach,
    _reduced,
    _rendering_words,
    _samples_within,
    _slopes_by_chance,
    _together,
    expected_uncertainty,
    fit,
)
from diffdisp.glasses import glass_table, named_glass
from diffdisp.image import Picture, read_picture, write_picture
from diffdisp.linearised import Columns, Linearised, linearise
from diffdisp.rendering import render
from diffdisp.scene import Scene, with_glass
from diffdisp.scene_file import load_scene

FIXTURES = Path(__file__).parents[1] / "fixtures"
TARGETS = FIXTURES / "targets"
SILICA = named_glass("fused silica")

# One size, one number of bands, of samples and of segments: one compiled program for most tests.
SIZE, SAMPLES, DEPTH = 22, 4, 50
VISIBLE = Film(SIZE, SIZE, band_middles(400.0, 700.0, 8))
WIDE = Film(SIZE, SIZE, band_middles(310.0, 2330.0, 8))
COLOR = Film(16, 16)

NOISE = 0.01
REPEATS = 6


def own_target(scene: Scene, film: Film, seed: int = 0) -> Picture:
    """A render that says how it was made: the fit can see exactly the same."""
    radiance = render(scene, film, samples=SAMPLES, depth=DEPTH, seed=seed, dtype="float64")
    return Picture(np.asarray(radiance), film.wavelengths, SAMPLES, DEPTH, seed)


def with_noise(target: Picture, seed: int, sigma: float = NOISE) -> Picture:
    noise = np.random.default_rng(seed).normal(0.0, sigma, target.radiance.shape)
    radiance = target.radiance + noise
    return Picture(radiance, target.wavelengths, target.samples, target.depth, target.seed)


def index_error(result: FitResult, truth: Sellmeier) -> float:
    return float(np.max(np.abs(result.n - np.asarray(truth.indices(result.wavelengths)))))


def relative_error(result: FitResult, truth: Sellmeier) -> float:
    found, true = np.r_[result.B, result.C], np.r_[truth.B, truth.C]
    return float(np.max(np.abs(found / true - 1)))


@pytest.fixture(scope="module")
def visible() -> Picture:
    return own_target(bench(BK7), VISIBLE)


@pytest.fixture(scope="module")
def visible_fit(visible: Picture) -> FitResult:
    return fit(bench(SILICA), visible)


# --- clean pictures


def test_a_wide_clean_picture_gives_back_every_coefficient():
    result = fit(bench(SILICA), own_target(bench(BK7), WIDE))
    assert result.converged, result.message
    # The rounding of a picture, 1e-15, times the problem's condition of 3e5: 1e-9. The task
    # allows 1e-6.
    assert relative_error(result, BK7) < 1e-6
    assert result.nearest_glasses[0][0] == "N-BK7"


def test_a_visible_clean_picture_gives_the_index_and_says_what_it_does_not_give(visible_fit):
    result = visible_fit
    assert result.converged, result.message
    # A picture changes by about its own size when n changes by 1: rounding would allow 1e-15.
    assert index_error(result, BK7) < 1e-9
    assert abs(result.n_d - float(BK7.n_d)) < 1e-9
    assert abs(result.V_d - float(BK7.V_d)) < 1e-5  # 1e-9 twice, in n_F - n_C = 8e-3, times 64
    assert abs(result.P_gF - float(BK7.P_gF)) < 1e-6  # the same, and g lies between bands too
    assert 2 <= result.determined < 6
    assert "assumed noise" in result.summary
    assert "B and C are not determined one by one" in result.summary
    assert f"{result.determined} of the 6" in result.summary


def test_a_clean_fit_ends_where_its_steps_say_that_the_next_would_be_nothing(visible_fit):
    # One picture whose paths end early and two with all their light, which costs three times as
    # much: the second step from there changes n by 1e-11, after one of 1e-7.
    assert visible_fit.steps == 3
    assert index_error(visible_fit, BK7) < 1e-14


def test_no_band_of_a_low_index_stays_in_a_minimum_of_its_own():
    # So few samples draw a ball of low index roughly: single bands have minima up to 1e-2 from
    # the right index, and a resonance next to the band reaches them without moving the others.
    answer = named_glass("MgF2")
    result = fit(bench(named_glass("N-SF66")), own_target(bench(answer), VISIBLE))
    assert result.converged, result.message
    assert index_error(result, answer) < 1e-9


def test_a_result_agrees_with_itself(visible, visible_fit):
    result = visible_fit
    assert result.object_name == "ball"
    assert result.samples == (SAMPLES,)
    np.testing.assert_array_equal(result.wavelengths, VISIBLE.wavelengths)
    # Sums of six terms and square roots of them: rounding only.
    np.testing.assert_allclose(
        np.sqrt(np.diag(result.covariance)), np.r_[result.B_std, result.C_std], rtol=1e-12
    )
    np.testing.assert_allclose(result.n, result.glass.indices(result.wavelengths), rtol=1e-14)
    np.testing.assert_array_equal(result.glass.B, result.B)
    np.testing.assert_array_equal(result.scene.objects[0].material.glass.C, result.C)
    assert result.determined == np.sum(result.singular_values > 10)
    assert np.all(np.diff(result.singular_values) <= 0)
    residual = result.picture - visible.radiance
    # Each is the rounding of values up to 1 that were summed in different order.
    assert abs(result.rms_residual - np.sqrt(np.mean(residual**2))) < 1e-15
    assert result.rms_residual < 1e-12


@pytest.mark.parametrize(
    ("start", "answer"),
    [
        ("fused silica", "N-SF11"),
        ("fused silica", "N-LASF9"),
        ("SF11", "fused silica"),
        ("diamond", "N-BK7"),
    ],
)
def test_a_start_far_away_converges(start, answer):
    truth = named_glass(answer)
    result = fit(bench(SILICA), own_target(bench(truth), VISIBLE), start=named_glass(start))
    assert result.converged, result.message
    # Clean, so as near as the start's number of terms allows: two terms with resonances below
    # the band (diamond's) miss the infrared term of N-BK7, whose part in n bends by some 1e-4.
    assert index_error(result, truth) < (1e-9 if start != "diamond" else 1e-3)
    if start == "diamond":
        np.testing.assert_array_equal([result.B[2], result.C[2]], 0.0)
        assert result.B_std[2] == result.C_std[2] == 0.0
        assert len(result.singular_values) == 4
    else:
        assert result.nearest_glasses[0][0] == answer


def test_terms_come_out_in_the_order_of_their_resonances(visible_fit):
    assert np.all(np.diff(visible_fit.C) > 0)
    # N-BK7's B1 and B2 differ by a factor of 4. Weakly determined directions are found to 5e-9
    # in a clean picture; 1e-3 is far below that factor and far above rounding.
    assert abs(visible_fit.B[0] / BK7.B[0] - 1) < 1e-3


def test_terms_keep_the_order_of_a_start_that_has_another(visible):
    turned = Sellmeier(SILICA.B[[2, 0, 1]], SILICA.C[[2, 0, 1]])
    result = fit(bench(SILICA), visible, start=turned)
    assert result.converged, result.message
    assert index_error(result, BK7) < 1e-9  # as without the other order
    assert np.argmax(result.C) == 0


# --- noisy pictures


@pytest.mark.parametrize("given", [NOISE, None], ids=["noise given", "noise unknown"])
def test_reported_errors_are_true(visible, given):
    z = {"n_d": [], "V_d": []}
    for seed in range(REPEATS):
        result = fit(bench(SILICA), with_noise(visible, seed), noise=given)
        assert result.converged, result.message
        z["n_d"].append((result.n_d - float(BK7.n_d)) / result.n_d_std)
        z["V_d"].append((result.V_d - float(BK7.V_d)) / result.V_d_std)
        # A standard deviation from 3872 values is known to 1.1 %.
        assert abs(result.rms_residual / NOISE - 1) < 0.05
    # Normal errors exceed 4 sigma once in 16 000.
    assert np.max(np.abs(z["n_d"])) < 4
    assert np.max(np.abs(z["V_d"])) < 4
    # The sum of six squares lies between 0.38 and 22.5 in 998 of 1000 cases, for normal errors
    # of the reported size: RMS 0.25 to 1.94. Errors of half or four times the true size leave it.
    for name, scores in z.items():
        assert 0.25 < np.sqrt(np.mean(np.square(scores))) < 1.94, (name, scores)


def test_errors_grow_with_the_noise(visible):
    at = {s: fit(bench(SILICA), with_noise(visible, 1, s), noise=s) for s in (1e-3, 3e-3)}
    # n_d rests on what is determined: its error is the noise's, but for the little that the
    # limit of WIDEST holds of the rest at the larger noise.
    assert 2.0 < at[3e-3].n_d_std / at[1e-3].n_d_std < 3.05
    assert "given noise of 0.001" in at[1e-3].summary


def test_too_small_a_noise_is_not_believed(visible):
    result = fit(bench(SILICA), with_noise(visible, 2), noise=NOISE / 10)
    assert "more than the given 0.001" in result.summary
    # Six sigma, by a spread that the residual shows: as in the fits whose noise is unknown.
    assert abs(result.n_d - float(BK7.n_d)) < 4 * result.n_d_std


# --- before a picture is taken


@pytest.mark.parametrize(
    ("size", "noise", "prior"),
    [(64, 3e-3, "none"), (32, 1e-2, "catalogue")],
    ids=["without a prior", "with a prior"],
)
def test_what_to_expect_is_what_fits_report(size, noise, prior):
    film = Film(size, size, VISIBLE.wavelengths)
    expected = expected_uncertainty(bench(BK7), film, noise=noise, prior=prior)
    clean = Picture(
        np.asarray(render(bench(BK7), film, samples=256, dtype="float64")), film.wavelengths
    )
    result = fit(bench(SILICA), with_noise(clean, 0, noise), noise=noise, prior=prior)
    assert result.converged, result.message
    assert result.determined == expected.determined
    assert result.samples == expected.samples
    # What is not determined, B and C one by one, differs from fit to fit, and where they end the
    # slopes differ a little: by 3.5 % in n_d_std at 64 pixels, from seed to seed.
    told, wanted = ([told.n_d_std, told.V_d_std, np.max(told.n_std)] for told in (result, expected))
    np.testing.assert_allclose(told, wanted, rtol=0.05)
    # The glass is the scene's own.
    np.testing.assert_allclose(expected.n, BK7.indices(film.wavelengths), rtol=1e-13)
    assert expected.summary.startswith("Such a picture would fix n to ")
    assert f"(at a noise of {noise:g}" in expected.summary
    assert ("with the prior catalogue" in expected.summary) == (prior == "catalogue")


def test_what_else_is_free_costs():
    film = Film(32, 32, VISIBLE.wavelengths)
    known = expected_uncertainty(bench(BK7), film, noise=NOISE)
    dark = expected_uncertainty(bench(BK7), film, noise=NOISE, free=("gain", "black"))
    assert [value.name for value in dark.free] == [*(f"gain[{i}]" for i in range(8)), "black"]
    assert [value.value for value in dark.free] == [1.0] * 8 + [0.0]
    # A mean over 32 x 32 pixels of a brightness of about 0.5: 0.01 / 0.5 / 32 = 6e-4, and some
    # more for the black level, which the dark tiles tell from the gain.
    assert all(3e-4 < value.std < 2e-3 for value in dark.free[:8])
    assert known.n_d_std < dark.n_d_std < 1.5 * known.n_d_std
    assert "and with gain and black free" in dark.summary


def test_a_colour_picture_to_expect():
    expected = expected_uncertainty(bench(BK7), COLOR, noise=NOISE)
    np.testing.assert_array_equal(expected.wavelengths, COLOR_WAVELENGTHS)
    # As of a fit to such a picture above: 1e-4.
    assert 3e-5 < expected.n_d_std < 3e-4


def test_expecting_leaves_the_switch_of_precision():
    with jax.enable_x64(False):
        expected_uncertainty(bench(BK7), COLOR, noise=NOISE)
        assert jnp.ones(1).dtype == jnp.float32


# --- the picture of another renderer


@pytest.mark.slow
def test_a_picture_of_another_renderer():
    target = read_picture(TARGETS / "ball_nbk7.npz")
    result = fit(load_scene(TARGETS / "ball_nbk7.toml"), target)
    truth = named_glass("N-BK7")
    assert result.converged, result.message
    # The task's limits: three times what the target's noise of 0.003 leaves open in one band.
    error = np.abs(result.n - np.asarray(truth.indices(result.wavelengths)))
    assert error.max() <= 1e-4
    assert abs(result.n_d - float(truth.n_d)) <= 3e-5
    assert abs(result.V_d - float(truth.V_d)) <= 0.4
    # And the errors are admitted: within three reported standard deviations.
    assert np.all(error <= 3 * result.n_std)
    assert abs(result.n_d - float(truth.n_d)) <= 3 * result.n_d_std
    assert abs(result.V_d - float(truth.V_d)) <= 3 * result.V_d_std
    assert result.nearest_glasses[0][0] == "N-BK7"
    assert result.samples == (16, 256)  # the file does not say its own


# --- colour


@pytest.fixture(scope="module")
def color() -> Picture:
    return own_target(bench(BK7), COLOR)


def check_color(result: FitResult, tolerance: float) -> None:
    assert result.converged, result.message
    np.testing.assert_allclose(result.wavelengths * 1e3, np.arange(430, 681, 10), rtol=1e-12)
    np.testing.assert_array_equal(result.wavelengths, COLOR_WAVELENGTHS)
    assert index_error(result, BK7) < tolerance
    assert abs(result.n_d - float(BK7.n_d)) < tolerance
    assert result.picture.shape == (16, 16, 3)


def test_a_clean_colour_picture(color):
    # Six polynomials leave 2e-9 of the change of n between two glasses out of a step; a few
    # 1e-5 is what the task allows.
    check_color(fit(bench(SILICA), color), 1e-7)


def test_a_noisy_colour_picture(color):
    result = fit(bench(SILICA), with_noise(color, 3), noise=NOISE)
    # 1e-5 in n_d at a noise of 1e-3, so 1e-4 at this one; the ends of the range, where sRGB sees
    # little, seven times that. Four standard deviations of it.
    check_color(result, 4 * float(np.max(result.n_std)))
    assert result.n_d_std < 3e-4
    assert abs(result.n_d - float(BK7.n_d)) < 4 * result.n_d_std


# --- priors


def test_a_fixed_third_resonance_is_held(visible):
    result = fit(bench(SILICA), with_noise(visible, 4, 1e-3), prior="fixed-c3", noise=1e-3)
    assert result.converged, result.message
    assert result.C[2] == SILICA.C[2]
    assert result.C_std[2] == 0.0
    np.testing.assert_array_equal(result.covariance[5], 0.0)
    np.testing.assert_array_equal(result.covariance[:, 5], 0.0)
    assert len(result.singular_values) == 5
    assert "with the prior fixed-c3" in result.summary
    # C3 of fused silica, 98 µm², is another infrared than N-BK7's 104: B3 makes up for it.
    assert abs(result.n_d - float(BK7.n_d)) < 4 * result.n_d_std


def test_the_catalogue_narrows_the_coefficients(visible):
    noisy = with_noise(visible, 4, 1e-3)
    free = fit(bench(SILICA), noisy, noise=1e-3)
    known = fit(bench(SILICA), noisy, prior="catalogue", noise=1e-3)
    assert known.converged, known.message
    # Logarithms of B spread by less than 0.5 over real glasses, against a limit of 3 without.
    assert np.all(known.B_std / np.abs(known.B) < free.B_std / np.abs(free.B))
    assert np.all(known.B_std / known.B < 1)
    assert "with the prior catalogue" in known.summary
    # A prior this wide must not move what the picture knows: four standard deviations.
    assert abs(known.n_d - float(BK7.n_d)) < 4 * known.n_d_std


# --- refusals


ONE = Picture(np.full((2, 2, 1), 0.5), np.array([0.55]))
NOTHING = Sellmeier([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])


def two_balls(glass: Sellmeier = BK7) -> Scene:
    """A ball on the left, and one of another glass on the right."""
    left = ball(glass, (-0.75, 0.0, 0.0), 0.6, "left")
    right = ball(named_glass("N-SF11"), (0.75, 0.0, 0.0), 0.6, "right")
    return Scene(camera(), (left, right, screen()))


@pytest.mark.parametrize(
    ("scene", "options", "words"),
    [
        (bench(), {"prior": "guess"}, "prior 'guess': allowed are none, catalogue, fixed-c3"),
        (bench(), {"loss": "cubes"}, "loss 'cubes': allowed are squares, robust"),
        (bench(), {"check": "twice"}, "check 'twice': allowed are resample"),
        (bench(), {"noise": 0.0}, "noise 0.0: must be a finite number above 0"),
        (bench(), {"noise": -1e-3}, "noise -0.001: must be a finite number above 0"),
        (bench(), {"noise": float("nan")}, "noise nan: must be a finite number above 0"),
        (bench(), {"noise": float("inf")}, "noise inf: must be a finite number above 0"),
        (Scene(camera(), (screen(),)), {}, "no glass ball to fit"),
        (two_balls(), {}, "several glass balls, name one: left, right"),
        (two_balls(), {"object_name": "middle"}, "'middle': allowed are left, right"),
        (bench(), {"object_name": "screen"}, "no glass ball is called 'screen'"),
        (bench(), {"free": ["ball.weight"]}, "nothing called 'ball.weight' can be free"),
        (bench(), {"free": ["gain", "gain"]}, "gain is free twice"),
        (bench(), {"tolerance": 0.0}, "tolerance 0.0: must be a finite number above 0"),
        (bench(), {"tolerance": np.inf}, "tolerance inf: must be a finite number above 0"),
        (bench(NOTHING), {}, "nothing is free"),
        (bench(), {"start": glass_of_index(1.5)}, "nothing is free"),
        (bench(), {"start": Sellmeier([1.0] * 3, [0.01, 0.3025, 100.0])}, "pole at 550 nm"),
        (bench(), {"start": named_glass("diamond"), "prior": "catalogue"}, "three terms"),
    ],
)
def test_what_cannot_be_fitted_is_refused(scene, options, words):
    with pytest.raises(ValueError, match=words):
        fit(scene, ONE, **options)
    if not options.keys() & {"start", "loss", "check", "tolerance"}:  # of a picture that is there
        with pytest.raises(ValueError, match=words):
            expected_uncertainty(scene, ONE.film, **{"noise": NOISE, **options})


def test_nothing_can_be_expected_of_a_ball_outside_the_view():
    behind = Scene(camera(), (ball(BK7, (0.0, 0.0, 20.0), name="ball"), screen()))
    with pytest.raises(ValueError, match="no pixel of such a picture depends on this glass"):
        expected_uncertainty(behind, COLOR, noise=NOISE)


# --- other scenes


def test_one_of_two_balls():
    target = own_target(two_balls(), VISIBLE, seed=7)
    result = fit(two_balls(SILICA), target, object_name="left")
    assert result.object_name == "left"
    # Paths choose their branch by a probability that the index moves: at the truth the choices
    # are the target's own, but on the way there some differ and the residual has little steps.
    # One choice in 10⁴ shifts n by about 1e-5.
    assert result.converged, result.message
    assert abs(result.n_d - float(BK7.n_d)) < 5e-5
    right = result.scene.objects[1].material.glass
    np.testing.assert_array_equal(right.B, named_glass("N-SF11").B)


def test_a_ball_outside_the_view_is_no_fit(visible):
    behind = Scene(camera(), (ball(SILICA, (0.0, 0.0, 20.0), name="ball"), screen()))
    result = fit(behind, visible)
    assert not result.converged
    assert "no pixel of the picture depends on this glass" in result.message


def test_a_ball_outside_a_picture_that_does_not_say_how_it_was_drawn_is_no_fit():
    behind = Scene(camera(), (ball(SILICA, (0.0, 0.0, 20.0), name="ball"), screen()))
    dark = np.full((SIZE, SIZE, 8), 0.5)
    result = fit(behind, Picture(dark, VISIBLE.wavelengths))
    assert not result.converged
    assert "no pixel of the picture depends on this glass" in result.message


def test_a_picture_of_another_scene_is_no_fit(visible):
    tiles = Scene(camera(), (ball(BK7, name="ball"), screen(even=1.0, odd=0.1)))
    result = fit(bench(SILICA), own_target(tiles, VISIBLE))
    assert not result.converged
    assert result.message


def test_noise_alone_is_no_fit(visible):
    radiance = np.random.default_rng(5).normal(0.0, 0.3, visible.radiance.shape)
    result = fit(bench(SILICA), Picture(radiance, visible.wavelengths, SAMPLES, DEPTH, 0))
    assert not result.converged
    assert result.message


# --- clipped values


def test_an_overexposed_picture(tmp_path):
    clean = own_target(bench(BK7), Film(24, 24))
    exposed = with_noise(replace(clean, radiance=1.5 * clean.radiance), 1)
    write_picture(tmp_path / "a.png", exposed)
    target = replace(read_picture(tmp_path / "a.png"), samples=SAMPLES, depth=DEPTH, seed=0)
    result = fit(bench(SILICA), target, free=("gain",))
    assert result.converged, result.message
    assert result.clipped == np.sum(exposed.radiance >= target.ceiling) > 500
    assert f" {result.clipped} values of the target are clipped" in result.summary
    assert abs(result.n_d - float(BK7.n_d)) < 3 * result.n_d_std < 6e-4
    assert abs(result.V_d - float(BK7.V_d)) < 3 * result.V_d_std
    for _, gain, std in result.free:  # 32 reported errors off where clipped values are believed
        assert abs(gain - 1.5) < 4 * std < 0.01


def test_what_is_just_as_bright_as_white_is_not_clipped_away(tmp_path, color):
    # Bright tiles shine with radiance 1, the top code; a few pixels see nothing else.
    write_picture(tmp_path / "a.png", color)
    target = replace(read_picture(tmp_path / "a.png"), samples=SAMPLES, depth=DEPTH, seed=0)
    result = fit(bench(SILICA), target, free=("gain",))
    assert result.converged, result.message
    assert result.clipped > 10
    # Rounding to 8 bits is no independent noise, yet leaves errors of the reported size.
    assert abs(result.n_d - float(BK7.n_d)) < 3 * result.n_d_std < 3e-4
    for _, gain, _ in result.free:
        assert abs(gain - 1) < 2e-3  # half a code at the top is 4.5e-3


@pytest.mark.slow
def test_a_png_of_another_renderer():
    result = fit(load_scene(TARGETS / "ball_nbk7.toml"), read_picture(TARGETS / "ball_nbk7.png"))
    truth = named_glass("N-BK7")
    assert result.converged, result.message
    assert result.clipped == 3023 + 3022 + 3024  # the tiles beside the ball
    # What 8 bits of three channels leave open; and the errors are admitted.
    assert abs(result.n_d - float(truth.n_d)) <= min(2e-4, 3 * result.n_d_std)
    assert abs(result.V_d - float(truth.V_d)) <= min(1.0, 3 * result.V_d_std)
    assert result.nearest_glasses[0][0] == "N-BK7"


# --- outliers


def test_spoiled_pixels(visible):
    target = with_noise(visible, 0)
    spoiled = np.random.default_rng(100).random((SIZE, SIZE)) < 0.02
    target.radiance[spoiled] += 0.5
    squares, robust = (fit(bench(SILICA), target, loss=loss) for loss in ("squares", "robust"))
    assert (squares.outliers, robust.outliers) == (0, 8 * np.sum(spoiled))
    assert robust.converged, robust.message
    assert robust.loss == "robust"
    assert abs(robust.n_d - float(BK7.n_d)) < 3 * robust.n_d_std
    assert abs(robust.V_d - float(BK7.V_d)) < 3 * robust.V_d_std
    # Nearly as well known as without spoiled pixels, and by squares far off.
    assert robust.n_d_std < 1.2e-4
    assert abs(squares.n_d - float(BK7.n_d)) > 10 * robust.n_d_std
    assert f" {robust.outliers} values are outliers" in robust.summary


def test_a_robust_loss_costs_little_without_outliers(visible):
    target = with_noise(visible, 3)
    squares, robust = (
        fit(bench(SILICA), target, loss=loss, noise=NOISE) for loss in ("squares", "robust")
    )
    # 5 % of the information is 2.6 % of the error. The spread and the mean slope of the loss rest
    # on the few hundred values that show most of the index: 5 % each.
    assert 0.96 < robust.n_d_std / squares.n_d_std < 1.1
    assert "given noise of 0.01" in robust.summary
    assert abs(robust.n_d - squares.n_d) < robust.n_d_std
    assert robust.outliers < 10  # normal noise is beyond 4.685 sigma once in 360 000


def test_a_robust_loss_on_a_clean_picture(visible):
    spoiled = replace(visible, radiance=visible.radiance.copy())
    spoiled.radiance[9, 12] += 0.5
    result = fit(bench(SILICA), spoiled, loss="robust")
    assert result.converged, result.message
    # The noise taken is 1e-5 at least, of which a linear step leaves little.
    assert abs(result.n_d - float(BK7.n_d)) < 1e-6
    assert result.outliers == 8
    assert "the picture is clean" in result.summary


# --- a mask


def test_what_a_mask_leaves_out_is_not_seen(visible):
    mask = np.ones((SIZE, SIZE), bool)
    mask[:, : SIZE // 3] = False
    results = []
    for rubbish in (0.0, 9.0, np.nan):
        radiance = with_noise(visible, 7).radiance
        radiance[~mask] = rubbish
        results.append(fit(bench(SILICA), replace(visible, radiance=radiance), mask=mask))
    first = results[0]
    assert first.converged, first.message
    assert first.masked == SIZE * (SIZE // 3)
    # Normal errors exceed 4 sigma once in 16 000.
    assert abs(first.n_d - float(BK7.n_d)) < 4 * first.n_d_std
    assert abs(first.V_d - float(BK7.V_d)) < 4 * first.V_d_std
    # A standard deviation from 2640 values is known to 1.4 %; six polynomials are fitted.
    assert abs(first.rms_residual / NOISE - 1) < 0.06
    for other in results[1:]:
        np.testing.assert_array_equal(other.n, first.n)
        np.testing.assert_array_equal(other.covariance, first.covariance)
    # The picture is whole, of the fitted glass: n is off by some 1e-4 in so noisy a picture.
    assert first.picture.shape == visible.radiance.shape
    assert np.max(np.abs(first.picture - visible.radiance)) < 0.05


def test_what_two_halves_know_is_what_the_whole_knows(visible):
    left = np.broadcast_to(np.arange(SIZE) < SIZE // 2, (SIZE, SIZE))
    known = [
        fit(bench(SILICA), visible, noise=NOISE, mask=mask).singular_values[0] ** 2
        for mask in (None, left, ~left)
    ]
    # Information adds, and clean pictures end at the same coefficients. Only the best known
    # direction turns a little from half to half.
    assert known[1] + known[2] == pytest.approx(known[0], rel=0.02)


def test_blocks_that_a_mask_cuts_count_only_where_few_are_whole():
    cut = np.array([1.0, 1.0, 0.5, 0.2, 0.0])  # whole ones hold 2 of 2.7
    np.testing.assert_array_equal(_counted(cut), [True, True, False, False, False])
    few = np.array([1.0, 0.6, 0.5, 0.2, 0.0])  # 1 of 2.3
    np.testing.assert_array_equal(_counted(few), [True, True, True, True, False])


def test_dead_pixels_all_over_do_not_hide_the_ball():
    film = Film(70, 70, VISIBLE.wavelengths)
    target = with_noise(own_target(bench(BK7), film), 9)
    dead = np.random.default_rng(1).random((70, 70)) < 0.5
    target.radiance[dead] = 5.0
    # Blocks of 3 x 3 pixels are whole once in 2⁹: the means of what is left have to do.
    result = fit(bench(SILICA), target, mask=~dead)
    assert result.converged, result.message
    assert result.masked == np.sum(dead)
    assert abs(result.n_d - float(BK7.n_d)) < 4 * result.n_d_std


def test_a_mask_goes_with_a_picture_that_does_not_say_how_it_was_drawn():
    film = Film(32, 32, VISIBLE.wavelengths)
    clean = render(displaced(BK7), film, samples=256, dtype="float64")
    noisy = with_noise(Picture(np.asarray(clean), film.wavelengths), 11)
    mask = np.ones((32, 32), np.uint8)
    mask[20:26, 10:20] = 0
    noisy.radiance[mask == 0] = 3.0
    free = ("ball.center", "ball.radius")
    result = fit(bench(SILICA), noisy, free=free, noise=NOISE, mask=mask)
    assert result.converged, result.message
    assert result.samples == (16, 64, 256, 1024, 4096)
    # As without a mask, in `test_place_and_size_from_a_picture_...`.
    assert abs(result.n_d - float(BK7.n_d)) < 4 * result.n_d_std < 0.025


def test_a_mask_that_shows_no_glass_is_no_fit(visible):
    mask = np.zeros((SIZE, SIZE))
    mask[0, 0] = 1
    result = fit(bench(SILICA), visible, mask=mask)
    assert not result.converged
    assert "no pixel of the picture depends on this glass" in result.message


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.ones((2, 3)), r"mask \(2, 3\): must be \(2, 2\)"),
        (np.ones((2, 2, 1)), r"mask \(2, 2, 1\): must be \(2, 2\)"),
        (np.zeros((2, 2), bool), "mask: zero everywhere leaves nothing"),
        (np.array([[1, 0], [1, 1]]), "target: 1 of its values are not finite"),
    ],
)
def test_masks_that_do_not_fit_are_refused(mask, words):
    radiance = np.array([[0.5, 0.5], [np.nan, 0.5]])[..., None]
    with pytest.raises(ValueError, match=words):
        fit(bench(), Picture(radiance, np.array([0.55])), mask=mask)


# --- what else is free


def displaced(glass: Sellmeier) -> Scene:
    """The bench with a ball that is not quite where the scene says, nor as large."""
    return Scene(camera(), (ball(glass, (0.01, -0.02, 0.03), 1.01, "ball"), screen()))


FREE_TRUTH = {
    **{"ball.center.x": 0.01, "ball.center.y": -0.02, "ball.center.z": 0.03},
    **{"ball.radius": 1.01, "black": 0.02},
}


def test_place_size_and_exposure_are_found_with_the_glass():
    clean = own_target(displaced(BK7), VISIBLE)
    exposed = with_noise(replace(clean, radiance=1.2 * clean.radiance + 0.02), 6, 1e-3)
    free = ("ball.center", "ball.radius", "gain", "black")
    result = fit(bench(SILICA), exposed, free=free, noise=1e-3)
    assert result.converged, result.message
    assert [value.name for value in result.free] == [
        *list(FREE_TRUTH)[:-1],
        *(f"gain[{band}]" for band in range(8)),
        "black",
    ]
    # Normal errors exceed 4 sigma once in 16 000.
    for name, value, std in result.free:
        assert abs(value - FREE_TRUTH.get(name, 1.2)) < 4 * std, (name, value, std)
        assert std < 0.05
    assert abs(result.n_d - float(BK7.n_d)) < 4 * result.n_d_std
    shape = result.scene.objects[0].shape
    assert [*shape.center, shape.radius] == [value.value for value in result.free[:4]]
    assert "and with ball.center and ball.radius and gain and black free" in result.summary
    assert "too small" not in result.summary
    # What is not known costs: with all the rest known the same noise leaves a tenth of that error.
    known = fit(displaced(SILICA), with_noise(clean, 6, 1e-3), noise=1e-3)
    assert known.free == ()
    assert known.n_d_std < result.n_d_std / 5


def test_place_and_size_from_a_picture_that_does_not_say_how_it_was_drawn():
    film = Film(32, 32, VISIBLE.wavelengths)
    clean = render(displaced(BK7), film, samples=2304, dtype="float64")  # at the rim too
    noisy = with_noise(Picture(np.asarray(clean), film.wavelengths), 11)
    result = fit(bench(SILICA), noisy, free=("ball.center", "ball.radius"), noise=NOISE)
    assert result.converged, result.message
    assert result.samples == (16, 64, 256, 1024, 4096)
    # As above.
    for name, value, std in result.free:
        assert abs(value - FREE_TRUTH[name]) < 4 * std, (name, value, std)
    assert abs(result.n_d - float(BK7.n_d)) < 4 * result.n_d_std < 0.02
    # All of that could have been known before.
    expected = expected_uncertainty(displaced(BK7), film, noise=NOISE, free=tuple(FREE_TRUTH)[:4])
    both = [(result.n_d_std, expected.n_d_std)]
    both += [
        (found.std, known.std)
        for found, known in zip(result.free[2:], expected.free[2:], strict=True)
    ]
    # Of z and the radius too. The fit's errors are from one residual: 9 % measured, 2 % elsewhere.
    np.testing.assert_allclose(*zip(*both, strict=True), rtol=0.15)
    assert "too small" not in expected.summary


def on_matte_ground(glass: Sellmeier) -> Scene:
    return with_glass(load_scene(str(FIXTURES / "scenes/matte_ground.toml")), 0, glass)


FEW_BANDS = Film(24, 24, band_middles(450.0, 650.0, 3))


@pytest.fixture(scope="module")
def matte_ground() -> np.ndarray:
    return np.asarray(render(on_matte_ground(BK7), FEW_BANDS, samples=8192, dtype="float64"))


def test_a_glass_over_a_matte_ground(matte_ground):
    noisy = with_noise(Picture(matte_ground, FEW_BANDS.wavelengths), 4)
    used = np.ones(noisy.radiance.shape[:2], bool)
    used[3:6, 10:14] = False  # within the ball
    noisy.radiance[~used] = 9.0
    result = fit(on_matte_ground(SILICA), noisy, noise=NOISE, mask=used)
    assert result.converged, result.message
    # Where edges had no slopes this was 12 errors off, and those 40 times as large.
    assert abs(result.n_d - float(BK7.n_d)) < 4 * result.n_d_std < 8e-4
    assert np.all(abs(result.n - np.asarray(BK7.indices(result.wavelengths))) < 4 * result.n_std)
    expected = expected_uncertainty(on_matte_ground(BK7), FEW_BANDS, noise=NOISE)
    # Without the masked pixels, a quarter of what the picture tells, errors are a sixth larger.
    np.testing.assert_allclose(result.n_d_std, expected.n_d_std, rtol=0.25)
    assert result.samples == expected.samples
    # The picture is drawn there too, its own noise a third of the target's.
    assert np.abs(result.picture - matte_ground)[~used].max() < 2 * NOISE


def test_a_glass_over_a_matte_ground_in_a_picture_of_our_own():
    film, knobs = Film(16, 16, FEW_BANDS.wavelengths), {"samples": 64, "depth": DEPTH, "seed": 3}
    shown = np.asarray(render(on_matte_ground(BK7), film, dtype="float64", **knobs))
    target = Picture(shown, film.wavelengths, **knobs)
    result = fit(on_matte_ground(SILICA), target)
    assert result.converged, result.message
    # The same paths, but for those that a border of tiles still lies between.
    other = np.asarray(render(on_matte_ground(BK7), film, dtype="float64", **knobs | {"seed": 4}))
    assert result.rms_residual < np.sqrt(np.mean((other - shown) ** 2)) / 4
    assert abs(result.n_d - float(BK7.n_d)) < 4 * result.n_d_std < 3e-4


def test_slopes_know_how_the_outline_moves_over_a_matte_ground():
    # Two by two pixels of the far rim, where the ball shows a border of tiles.
    narrow = {"look_at": (0.0, 0.676, -0.72), "vertical_fov": 2.29}
    film = Film(2, 2, FEW_BANDS.wavelengths)

    def rim(x: float) -> Scene:
        scene = on_matte_ground(BK7)
        ball, ground = scene.objects
        shape = replace(ball.shape, center=(x, 0.0, 0.0))
        objects = (replace(ball, shape=shape), ground)
        return Scene(replace(scene.camera, **narrow), objects, scene.background)

    step, many = 1e-3, {"samples": 1 << 14, "dtype": "float64"}
    after, before = (np.asarray(render(rim(x), film, **many)) for x in (step, -step))
    truth = (after - before).reshape(4, 3) / (2 * step)
    blank = Picture(np.zeros((2, 2, 3)), film.wavelengths)
    used, free = np.ones((2, 2), bool), ("ball.center.x",)
    with jax.enable_x64(True):
        fixed = used, free, "none", "squares", lambda *_: None
        problem = _problem(rim(0.0), 0, blank, *fixed)
        at = Point(problem.unknowns.coefficients.start(), np.zeros(1))
        slopes = _linearise(problem, _slopes_by_chance(problem, DEPTH, 0), at, CUTOFF)
        found = slopes.columns.values[:, :, 0].T
    assert np.max(np.abs(truth)) > 10
    # 6 % measured; 113 % where the ball's outline is that of points.
    assert np.linalg.norm(found - truth) < 0.2 * np.linalg.norm(truth)


def test_outlines_are_where_a_ball_ends():
    seen = _in_pixels(_crossed(bench(BK7), VISIBLE)).any(axis=(1, 2)).reshape(SIZE, SIZE)
    # A ball on the axis ends at a circle about the middle of the picture.
    half = SIZE / 2
    view = camera()
    distance = float(np.linalg.norm(view.look_from))
    edge = np.tan(np.radians(float(view.vertical_fov) / 2)) / half
    circle = np.tan(np.arcsin(1.0 / distance)) / edge
    first = np.abs(np.arange(SIZE) - half + 0.5) - 0.5  # of a pixel, from the middle
    nearest, farthest = np.hypot(first, first[:, None]), np.hypot(first + 1, first[:, None] + 1)
    np.testing.assert_array_equal(seen, (nearest < circle) & (circle < farthest))
    assert np.sum(seen) > 4 * circle


def without_target(scene: Scene, film: Film, free: tuple[str, ...] = ()) -> Problem:
    """What a fit to a black picture starts from."""
    blank = Picture(np.zeros((film.height, film.width, film.channels)), film.wavelengths)
    used = np.ones((film.height, film.width), bool)
    return _problem(scene, 0, blank, used, free, "none", "squares", lambda *_: None)


class Drawn(NamedTuple):
    """A displaced ball, its place and size free: as many samples show it, and few."""

    truth: np.ndarray
    problem: Problem
    at: Point
    few: Linearised
    level: Level
    some: Linearised


@pytest.fixture(scope="module")
def places_free() -> Drawn:
    truth = np.asarray(render(displaced(BK7), VISIBLE, samples=4096, dtype="float64"))
    with jax.enable_x64(True):
        problem = without_target(displaced(BK7), VISIBLE, ("ball.center", "ball.radius"))
        at = Point(problem.unknowns.coefficients.start(), np.zeros(4))
        few = _linearise(problem, _level(problem, "", 1, 4, DEPTH, 0), at, CUTOFF)
        level = _level(problem, "", 1, 4, DEPTH, 0, 2)
        some = _linearise(problem, level, at, CUTOFF)
    return Drawn(truth, problem, at, few, level, some)


def test_a_fit_draws_every_pixel_as_well_as_the_noise_asks(places_free):
    truth, problem, at, few, level, some = places_free
    with jax.enable_x64(True):
        level, _ = _more_samples(problem, level, few, some, at, DEPTH, NOISE)
        drawn = _linearise(problem, level, at, CUTOFF, some.columns, of_index=True).picture
    off = (drawn.reshape(truth.shape) - truth) / NOISE
    weights = level.weights.reshape(SIZE, SIZE, 1)
    # What 4096 samples leave open on an outline, here and in the truth: 0.04 each.
    assert np.max(np.sqrt(weights) * np.abs(off)) < 0.5
    # Of 3872 values: far below what noise makes of them by chance, which is 90.
    assert np.sum(weights * off**2) < 10
    assert np.min(weights) > 0.9


# --- a tolerance of n_d


def test_with_places_free_n_d_is_drawn_to_a_tolerance(places_free):
    truth, problem, at, few, level, some = places_free
    with jax.enable_x64(True):
        problem = problem._replace(tolerance=2e-4)
        level, slopes = _samples_within(problem, level, few, some, at, DEPTH, NOISE)
        drawn = _linearise(problem, level, at, CUTOFF, some.columns, of_index=True)
        reach = _reach(problem, level, drawn, at)
    off = np.sum(reach * (drawn.picture - truth.reshape(drawn.picture.shape)), axis=1)
    # n_d is mixed up with the place: 16 samples leave an estimated 8e-4 open.
    assert level.rendering.met
    assert level.rendering.refinements > 0
    assert abs(np.sum(off)) < 1.2 * 2e-4
    finest, of_slopes = (max(part.split for part in each.parts) for each in (level, slopes))
    assert of_slopes == min(finest, FOR_SLOPES)


@pytest.fixture(scope="module")
def many_samples() -> Picture:
    """A picture that does not say how it was drawn: its own error of n_d is some 1e-6."""
    radiance = render(bench(BK7), VISIBLE, samples=1024, dtype="float64")
    return Picture(np.asarray(radiance), VISIBLE.wavelengths)


def test_a_fit_to_a_tolerance_is_within_it(many_samples):
    rough, fine = (fit(bench(SILICA), many_samples, tolerance=T) for T in (1e-3, 3e-5))
    for result in (rough, fine):
        assert result.converged, result.message
        assert result.rendering.met
        assert abs(result.n_d - float(BK7.n_d)) < 1.2 * result.rendering.tolerance
    # All pixels with 16 samples, extrapolated from 4, are enough for the one and not for the other.
    assert rough.rendering.refinements == 0
    assert rough.samples == (4, 16)
    assert fine.rendering.refinements > 0
    assert fine.samples[:2] == (4, 16) < fine.samples
    assert fine.rendering.error < rough.rendering.error
    assert "rendering leaves n_d open by an estimated" in fine.summary


def test_a_tolerance_out_of_reach_is_said(many_samples, monkeypatch):
    monkeypatch.setattr("diffdisp.fitting.SPLITS", (2, 4))
    result = fit(bench(SILICA), many_samples, tolerance=1e-9)
    assert result.converged, result.message
    assert not result.rendering.met
    assert result.samples == (4, 16, 64)
    assert "samples allowed, 64 a pixel: the tolerance of 1e-09 is not met." in result.summary


def test_a_target_that_says_its_samples_is_drawn_with_them(visible, visible_fit):
    result = fit(bench(SILICA), visible, tolerance=1e-2)
    assert result.rendering == Rendered(1e-2, 0.0, 0)
    assert result.n_d == visible_fit.n_d
    assert "The fit drew the picture as the target says" in result.summary
    assert visible_fit.rendering is None


def test_what_the_picture_leaves_open_is_told_apart():
    words = _rendering_words(Rendered(1e-5, 4e-6, 2), 256, 2e-4)
    assert words.endswith(
        "The picture fixes n_d to ±2.0e-04: the tolerance of 1e-05 is met by the fit's own"
        " rendering, not by the picture."
    )
    assert "±" not in _rendering_words(Rendered(1e-5, 4e-6, 2), 256, 9e-6)
    assert _rendering_words(None, 256, 1e-5) == ""


def test_what_holds_most_is_refined():
    off = np.array([1.0, -4.0, 0.0, 0.5, 3.0])
    np.testing.assert_array_equal(_marked(off), [False, True, False, False, True])
    np.testing.assert_array_equal(_marked(0 * off), [False] * 5)
    # Those that cancel do so by chance.
    assert _together(np.array([3.0, -3.0])) == pytest.approx(np.sqrt(18))
    assert _together(np.array([3.0, 1.0])) == pytest.approx(np.sqrt(16 + 10))


def test_n_d_follows_the_picture_as_foreseen(visible):
    with jax.enable_x64(True):
        problem = without_target(bench(BK7), VISIBLE)
        problem = problem._replace(target=visible.radiance)
        at = Point(problem.unknowns.coefficients.start(), np.zeros(0))
        level = _level(problem, "", 1, SAMPLES, DEPTH, 0)
        weights = np.random.default_rng(0).uniform(0.2, 1.0, level.weights.shape)
        level = level._replace(weights=weights)
        lin = _linearise(problem, level, at, CUTOFF)
        change = np.random.default_rng(1).normal(0.0, 1e-4, lin.picture.shape)
        moved = _reduced(level, lin.picture + change, lin.columns)
        new, _ = _next_point(problem.unknowns, at, at.z, moved, 0.0)
        foreseen = np.sum(_reach(problem, level, lin, at) * change)
        found = _n_d(problem.unknowns, new.z) - float(BK7.n_d)
    # n_d is hardly bent within so little.
    assert abs(found) > 1e-8
    assert foreseen == pytest.approx(found, rel=0.05)


def test_a_picture_by_chance_is_drawn_to_a_tolerance(monkeypatch):
    with jax.enable_x64(True):
        problem = without_target(on_matte_ground(BK7), FEW_BANDS)
        at = Point(problem.unknowns.coefficients.start(), np.zeros(0))
        level = _slopes_by_chance(problem, DEPTH, 0)
        level = level._replace(drawing=Drawing(256, DEPTH, 0, apart=True))
        lin = _linearise(problem, level, at, CUTOFF)
        end = Descent(at, lin, 1, True, 0.0, at.z)

        def drawn(tolerance: float) -> tuple[int, Rendered]:
            found = _drawn_within(problem._replace(tolerance=tolerance), level, end)
            return found.drawing.samples, found.rendering

        samples, rough = drawn(1.0)
        assert (samples, rough.refinements) == (256, 0)
        samples, fine = drawn(0.6 * rough.error)
        assert (samples, fine.refinements) == (1024, 1)  # a power of two above 256 / 0.36
        assert fine.error == pytest.approx(rough.error / 2)
        monkeypatch.setattr("diffdisp.fitting.MOST_DRAWN", 600 * 24 * 24 * 3)
        samples, out_of_reach = drawn(1e-9)
        assert samples == 512
        assert not out_of_reach.met


@pytest.mark.parametrize("middle", [0.0, 0.4, -1.1])
@pytest.mark.parametrize("width", [0.8, 1.0, 1.15])
def test_a_parabola_of_squares_gives_back_its_middle_and_width(middle, width):
    mean, spread = _mean_place(((PROFILE - middle) / width) ** 2)
    # Places end at 3, where a width of 1.15 about -1.1 has lost its last 5 %.
    assert abs(mean - middle) < 0.11 * width
    assert abs(spread / width - 1) < 0.11


def test_a_second_minimum_beside_the_first_widens_and_draws():
    squares = PROFILE**2
    squares[-2] = 0.5  # a ripple at 2
    mean, spread = _mean_place(squares)
    assert 0.4 < mean < 1
    assert 1.1 < spread < 1.3


def test_a_colour_picture_of_another_exposure(color):
    exposed = replace(color, radiance=color.radiance * np.array([0.5, 0.6, 0.7]))
    result = fit(bench(SILICA), exposed, free=("gain",))
    assert result.converged, result.message
    assert abs(result.n_d - float(BK7.n_d)) < 1e-6
    np.testing.assert_allclose([v.value for v in result.free], [0.5, 0.6, 0.7], rtol=1e-6)


def test_what_nothing_tells_is_said_to_be_unknown(visible):
    # The camera looks along z: how far "up" leans that way changes nothing.
    result = fit(bench(SILICA), visible, free=("camera.up.z",), noise=1e-3)
    assert result.converged, result.message
    (lean,) = result.free
    assert (lean.name, lean.value) == ("camera.up.z", 0.0)
    assert lean.std == pytest.approx(3.0, rel=1e-9)
    assert index_error(result, BK7) < 1e-9  # as without it


# --- a check by resampling


def test_noise_of_single_values_spreads_as_reported(visible):
    target = with_noise(visible, 3)
    result = fit(bench(SILICA), target, check="resample")
    assert result.check.repeats == 50
    assert result.check.ratio == result.check.n_d_std / result.n_d_std
    # 10 % from 50 repeats, 6 % from the number of squares that show most of the index: 3 sigma.
    assert 0.65 < result.check.ratio < 1.35
    again = fit(bench(SILICA), target, check="resample")
    assert again.check == result.check
    assert fit(bench(SILICA), target).check is None


def test_noise_that_hangs_together_spreads_more(visible):
    each = np.random.default_rng(4).normal(0.0, NOISE, (SIZE, SIZE, 1))
    target = replace(visible, radiance=visible.radiance + each)
    result = fit(bench(SILICA), target, check="resample")
    # The same error in 8 bands counts for 8 independent ones to the sandwich: the square root of
    # 8 for what all bands tell alike.
    assert 1.7 < result.check.ratio < 3.5


@pytest.mark.parametrize("noise", [None, NOISE])
def test_a_clean_picture_is_checked_at_the_noise_of_its_errors(visible, noise):
    result = fit(bench(SILICA), visible, check="resample", noise=noise)
    assert 0.65 < result.check.ratio < 1.35  # as above


def test_what_shows_no_glass_is_not_checked(visible):
    behind = Scene(camera(), (ball(SILICA, (0.0, 0.0, 20.0), name="ball"), screen()))
    assert fit(behind, visible, check="resample").check is None


# --- naming


def test_one_glass_of_two():
    # In one dimension, by hand: N(0; a, 1) of each, and N(0; 0, 1 + 2 a²) of any other.
    offsets = np.array([[-1.5], [1.5]])
    at, other = np.exp(-(1.5**2) / 2), 1 / np.sqrt(1 + 2 * 1.5**2)
    likely, left = _probabilities(offsets)
    np.testing.assert_allclose(likely, np.full(2, at / 2 / (at + other)), rtol=1e-12)
    assert left == pytest.approx(other / (at + other), rel=1e-12)


def test_another_glass_is_spread_as_the_table():
    offsets = np.random.default_rng(1).normal(size=(9, 2)) * [4.0, 0.7] + [1.0, -2.0]
    likely, left = _probabilities(offsets)
    mean, precision = offsets.mean(0), np.linalg.inv(np.cov(offsets.T))
    x = np.stack(np.meshgrid(np.linspace(-30, 30, 1201), np.linspace(-8, 8, 641)), -1)
    off = x - mean
    spread = np.exp(-np.sum((off @ precision) * off + x**2, axis=-1) / 2)
    other = np.sum(spread) * 0.05 * 0.025 * np.sqrt(np.linalg.det(precision)) / (2 * np.pi)
    each = np.exp(-np.sum(offsets**2, axis=1) / 2) / 9
    # A sum over a grid much finer than the widths of smooth functions is the integral.
    np.testing.assert_allclose(likely, each / (np.sum(each) + other), rtol=1e-6)
    np.testing.assert_allclose(left, other / (np.sum(each) + other), rtol=1e-6)


def test_who_knows_nothing_says_so():
    likely, other = _probabilities(np.zeros((4, 3)))
    np.testing.assert_allclose(likely, 1 / 8, rtol=1e-15)
    assert other == 0.5
    assert _probabilities(np.array([[1e9, 1e9], [1e9, -1e9]]))[1] == 1.0


def test_a_glass_of_the_table_and_one_that_is_not(visible):
    result = fit(bench(SILICA), with_noise(visible, 0))
    assert len(result.probabilities) == len(result.nearest_glasses) == 5
    assert result.probabilities[0] > 0.99  # its neighbours are hundreds of sigma away
    assert sum(result.probabilities) + result.other_probability == pytest.approx(1, abs=1e-9)
    # A melt that is off by 0.001, ten sigma.
    melt = Sellmeier(np.asarray(BK7.B) * 1.0024, BK7.C)
    other = fit(bench(SILICA), with_noise(own_target(bench(melt), VISIBLE), 0))
    assert other.nearest_glasses[0][0] == "N-BK7"
    assert other.other_probability > 0.99


# --- progress, and JAX's switches


def test_progress_is_told(visible):
    told = []
    fit(bench(SILICA), visible, progress=lambda *numbers: told.append(numbers))
    assert told
    assert all([type(number) for number in row] == [int, float, float] for row in told)
    # The last step told of is one step before the end: n_d to the square root of the last digits.
    assert abs(told[-1][2] - float(BK7.n_d)) < 1e-4


def test_an_exception_in_progress_ends_the_fit(visible):
    class StopError(Exception):
        pass

    def stop(step: int, rms: float, n_d: float) -> None:
        raise StopError

    with pytest.raises(StopError):
        fit(bench(SILICA), visible, progress=stop)


def stopped_at(calls: int, error: type[BaseException]) -> Callable[[int, float, float], None]:
    """A `progress` that raises when it is called so often."""
    left = [calls]

    def progress(step: int, rms: float, n_d: float) -> None:
        left[0] -= 1
        if not left[0]:
            raise error

    return progress


@pytest.mark.parametrize("error", [StopFit, KeyboardInterrupt])
def test_a_fit_that_is_stopped_returns_the_best_so_far(visible, visible_fit, error):
    told: list[float] = []
    fit(bench(SILICA), visible, progress=lambda step, rms, n_d: told.append(rms))
    for calls in (1, len(told)):
        result = fit(bench(SILICA), visible, progress=stopped_at(calls, error))
        assert result.stopped
        assert not result.converged
        where = "the coarse picture" if calls == 1 else "the last level"
        assert result.message.startswith("stopped in step ")
        assert "The fit was stopped: its answer may lie many of these errors away" in result.summary
        assert result.message.endswith(f" of {where}")
        # Of the point that progress was told of last, or of a better one of another start.
        assert result.rms_residual <= told[calls - 1]
        assert result.picture.shape == visible.radiance.shape
        assert np.isfinite(result.n_d_std)
    assert abs(result.n_d - float(BK7.n_d)) < 1e-4  # as in `test_progress_is_told`
    assert not visible_fit.stopped
    assert "stopped" not in visible_fit.summary


def test_a_fit_that_is_stopped_on_blocks_shows_them():
    target = own_target(bench(BK7), Film(70, 70, VISIBLE.wavelengths))
    result = fit(bench(SILICA), target, progress=stopped_at(2, StopFit))
    assert result.message.endswith(" of the coarse picture")
    assert result.picture.shape == (70, 70, 8)
    # Blocks of 3 pixels, and the last one continued to the border.
    last = np.broadcast_to(result.picture[3, 66], (3, 4, 8))
    np.testing.assert_array_equal(result.picture[3:6, 66:70], last)
    # The means of the target's, which 4 samples instead of 36 show a little otherwise.
    means = target.radiance[:69, :69].reshape(23, 3, 23, 3, 8).mean((1, 3))
    assert np.median(np.abs(result.picture[:69:3, :69:3] - means)) < 0.03
    assert "The last level used" not in result.summary


def test_a_fit_without_a_point_has_nothing_to_return(visible, monkeypatch):
    def interrupted(*_args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("diffdisp.fitting._starts", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(bench(SILICA), visible)


def test_precision_is_double_and_the_switch_stays(visible, visible_fit):
    with jax.enable_x64(False):
        assert jnp.ones(1).dtype == jnp.float32
        result = fit(bench(SILICA), visible)
        assert jnp.ones(1).dtype == jnp.float32
    assert jnp.ones(1).dtype == jnp.float64
    # The same programs on the same numbers; threads join their results in order.
    np.testing.assert_array_equal(result.n, visible_fit.n)


# --- coordinates


def limits(waves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.array(np.min(waves)), np.array(np.max(waves))


def coordinates(glass: Sellmeier, film: Film = VISIBLE, fixed_c3: bool = False) -> Coefficients:
    free = (glass.B != 0) & (glass.C > 0)
    mask = np.array([*free, *free[:2], free[2] and not fixed_c3])
    return Coefficients(glass.B, glass.C, *limits(film.wavelengths), tuple(mask.tolist()))


@pytest.mark.parametrize("name", ["N-BK7", "N-SF66", "CaF2", "LiF", "diamond"])
def test_the_start_gives_back_its_coefficients(name):
    glass = named_glass(name)
    coefficients = coordinates(glass)
    B, C = coefficients.values(jnp.asarray(coefficients.start()))
    # Logarithms of up to 6, exponentiated: a few last digits.
    np.testing.assert_allclose(B, glass.B, rtol=1e-14)
    np.testing.assert_allclose(C, glass.C, rtol=1e-14)


@pytest.mark.parametrize("film", [VISIBLE, WIDE], ids=["visible", "wide"])
def test_the_index_is_sellmeiers(film):
    seen = 0
    for glass in glass_table().values():
        if domain_error(glass, float(film.wavelengths.min()), float(film.wavelengths.max())):
            continue  # no index within these bands
        coefficients = coordinates(glass, film)
        n = coefficients.index(jnp.asarray(coefficients.start()), film.wavelengths)
        # As above, and λ² - C may lose a digit next to a resonance.
        np.testing.assert_allclose(n, glass.indices(film.wavelengths), rtol=1e-13)
        seen += 1
    assert seen > 30


@pytest.mark.parametrize("film", [VISIBLE, WIDE], ids=["visible", "wide"])
def test_no_coordinates_put_a_pole_into_the_band(film):
    coefficients = coordinates(BK7, film)
    waves = np.linspace(coefficients.low, coefficients.high, 101)
    # A standard deviation of 10 reaches C = low² · (1 - 1e-12), and B of e³⁰.
    for z in np.random.default_rng(6).normal(0.0, 10.0, (200, 6)):
        B, C = (np.asarray(v) for v in coefficients.values(jnp.asarray(z)))
        assert np.all(np.sign(B) == 1)
        assert np.all((C[:2] > 0) & (C[:2] < coefficients.low**2))
        assert np.all(C[2] > coefficients.high**2)
        assert np.all(np.isfinite(coefficients.index(jnp.asarray(z), waves)))


def test_index_and_slope_are_finite_wherever_a_step_may_try():
    coefficients = coordinates(BK7)
    slope = jax.jit(jax.jacfwd(lambda z: coefficients.index(z, VISIBLE.wavelengths)))
    # The spread that a fit allows about its start, WIDEST = 3; and twice it towards a strong
    # infrared resonance next to the band, where n² falls to -400.
    changes = np.random.default_rng(10).normal(0.0, 3.0, (50, 6))
    for change in [*changes, np.array([0.0, 0.0, 6.0, 0.0, 0.0, -6.0])]:
        z = jnp.asarray(coefficients.start() + change)
        assert np.all(coefficients.index(z, VISIBLE.wavelengths) > 0)
        assert np.all(np.isfinite(slope(z)))


def test_signs_and_what_is_held_are_kept():
    glass = Sellmeier([1.3, -0.05, 0.9], [0.01, 0.02, 100.0])
    coefficients = coordinates(glass, fixed_c3=True)
    z = coefficients.start() + np.random.default_rng(8).normal(0.0, 1.0, 5)
    B, C = coefficients.values(jnp.asarray(z))
    np.testing.assert_array_equal(np.sign(B), [1, -1, 1])
    assert C[2] == 100.0
    np.testing.assert_allclose(
        coefficients.logarithms(jnp.asarray(z)),
        np.log(np.abs([*B, *C[:2]])),
        rtol=1e-14,  # two logarithms of the same numbers
    )


def test_terms_that_changed_places_are_put_in_order():
    swapped = [1, 0, 2]
    variances = np.arange(1.0, 7.0)
    B, C, covariance = _in_order(
        coordinates(SILICA), BK7.B[swapped], BK7.C[swapped], np.diag(variances)
    )
    np.testing.assert_array_equal(B, BK7.B)
    np.testing.assert_array_equal(C, BK7.C)
    np.testing.assert_array_equal(covariance, np.diag([2.0, 1.0, 3.0, 5.0, 4.0, 6.0]))


# --- covariance


def slopes_in_logarithms(glass: Sellmeier, waves: np.ndarray) -> np.ndarray:
    """∂n/∂(log B, log C) (k, 6), by hand from n² = 1 + Σ B λ² / (λ² - C)."""
    squared = waves[:, None] ** 2
    by_B = glass.B * squared / (squared - glass.C)
    by_C = glass.B * squared * glass.C / (squared - glass.C) ** 2
    return np.concatenate([by_B, by_C], axis=1) / (2 * np.asarray(glass.indices(waves))[:, None])


def synthetic(
    glass: Sellmeier, noise: float, prior: Callable[[int], np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The covariance of `_covariance`, and the inverse of JᵀJ/σ² + what a prior adds."""
    waves = np.linspace(0.31, 2.33, 16)
    coefficients = Coefficients(glass.B, glass.C, *limits(waves), (True,) * 6)
    rows = np.zeros((0, 6)) if prior is None else prior(6)
    unknowns = Unknowns(coefficients, waves, np.eye(16), np.zeros(len(rows)), rows)
    r = np.diag(np.random.default_rng(9).uniform(50.0, 150.0, 16))
    z, one = jnp.asarray(coefficients.start()), np.zeros((1, 16))
    # A picture of one pixel in 16 bands, each with a slope in its own index alone.
    columns = Columns(np.diag(r)[:, None, None], np.arange(16)[:, None], 0, 16)
    lin = linearise(one, one, columns, np.ones((1, 1)), 3.0)
    covariance = _covariance(unknowns, z, lin, noise**2 * lin.white, noise)
    J = r @ slopes_in_logarithms(glass, waves)
    return covariance, np.linalg.inv(J.T @ J / noise**2 + rows.T @ rows)


@pytest.mark.parametrize("noise", [1e-6, 1e-7])
def test_a_covariance_is_the_inverse_of_the_information(noise):
    covariance, expected = synthetic(BK7, noise)
    spread = np.sqrt(np.diag(expected))
    assert spread.max() < 0.02  # well determined: WIDEST = 3 takes (0.02 / 3)² = 4e-5 of it
    # The inverse of JᵀJ, of condition (3e5)² = 1e11, keeps 1e-5.
    np.testing.assert_allclose(
        covariance / np.outer(spread, spread), expected / np.outer(spread, spread), atol=1e-4
    )


def test_a_prior_adds_its_information():
    strong = 1e3  # rows that know the first logarithm to 1e-3, better than the picture does
    covariance, expected = synthetic(BK7, 1e-6, lambda count: strong * np.eye(count)[:1])
    spread = np.sqrt(np.diag(expected))
    assert spread[0] < 1e-3
    np.testing.assert_allclose(  # as without a prior
        covariance / np.outer(spread, spread), expected / np.outer(spread, spread), atol=1e-4
    )


def test_what_nothing_is_known_of_keeps_the_widest_error():
    covariance, _ = synthetic(BK7, 1e6)
    # All that is left is the limit, a standard deviation of 3; the picture adds 1e-7 of it.
    np.testing.assert_allclose(covariance, 9.0 * np.eye(6), atol=1e-5)
