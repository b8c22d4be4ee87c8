import numpy as np
import pytest
from helpers import ORIGIN, ball, bench, camera, furnace, ground, lamp, matte, screen

from diffdisp.film import Film
from diffdisp.material import Lambertian
from diffdisp.rendering import Growing, render
from diffdisp.scene import Scene
from diffdisp.tolerance import SHARE, difference, render_to_tolerance, rms

SMALL = Film(32, 24)
LIT = Scene(
    camera([0, 1, 5]),
    [matte(0.8), ground(Lambertian([0.5] * 3)), lamp([2.0, 3.0, 2.0], 0.5, [9.0] * 3)],
)
SUMMED = bench()
CHOSEN = Scene(camera(), [ball(1.5, [-0.6, 0, 0], 0.5), ball(1.7, [0.6, 0, 0], 0.5), screen()])


def true_error(picture, scene, samples):
    """Of a picture against one of many samples, and of another seed."""
    truth = render(scene, SMALL, samples=samples, seed=77, dtype="float64")
    return rms(picture.radiance - truth) / rms(truth)


@pytest.mark.parametrize(
    ("scene", "tolerance", "samples"),
    [(LIT, 0.1, 1024), (LIT, 0.02, 4096), (SUMMED, 0.05, 256), (CHOSEN, 0.05, 256)],
)
def test_the_error_is_as_estimated(scene, tolerance, samples):
    *_, last = render_to_tolerance(scene, SMALL, tolerance, dtype="float32")
    found = true_error(last, scene, samples)
    assert last.error <= tolerance
    assert found <= 1.2 * tolerance
    # So few pixels lie along edges that their number is good to a fifth.
    assert 0.6 * last.error < found < 1.4 * last.error


def test_no_more_samples_than_are_needed():
    *_, last = render_to_tolerance(LIT, SMALL, 0.02, dtype="float32")
    fewer = render(LIT, SMALL, samples=last.samples // 3, dtype="float32")
    truth = render(LIT, SMALL, samples=4096, seed=77, dtype="float64")
    assert rms(fewer - truth) > 0.02 * rms(truth)


def test_pictures_grow():
    found = list(render_to_tolerance(LIT, SMALL, 0.02, dtype="float32"))
    samples = [picture.samples for picture in found]
    assert samples == sorted(set(samples))
    assert len(samples) > 2
    assert all(picture.error > 0.02 for picture in found[:-1])
    assert found[-1].error <= 0.02


def test_a_picture_by_comparison_can_be_drawn_again():
    *_, last = render_to_tolerance(CHOSEN, SMALL, 0.05, seed=5, dtype="float32")
    assert last.seed == 5
    again = render(CHOSEN, SMALL, samples=last.samples, seed=5, dtype="float32")
    np.testing.assert_array_equal(again, last.radiance)


def test_a_mean_of_several_seeds_says_so():
    *_, last = render_to_tolerance(LIT, SMALL, 0.1, dtype="float32")
    assert last.seed is None
    assert last.samples > 2 * SHARE or last.samples in (4, 8, 12, 20, 36)


@pytest.mark.parametrize("color", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.1)])
@pytest.mark.parametrize("objects", [(), (matte(0.0),)])
def test_what_has_no_error_needs_no_samples(color, objects):
    # A black ball that hides all of the picture, or the background alone.
    scene = furnace(*objects, color=color, vertical_fov=5.0)
    found = list(render_to_tolerance(scene, SMALL, 1e-3, dtype="float32"))
    assert len(found) == 1
    assert found[0].error == 0


def test_single_precision_is_given_up_where_it_is_not_enough():
    scene = furnace(ball(1.5))
    coarse, fine = (
        list(render_to_tolerance(scene, Film(6, 6), tolerance, dtype="float32"))[-1]
        for tolerance in (1e-2, 3e-8)
    )
    assert coarse.dtype == "float32"
    assert fine.dtype == "float64"
    assert fine.radiance.dtype == np.float64


def test_where_light_scatters_only_very_fine_tolerances_take_double_precision():
    scene = furnace(matte(1.0, ORIGIN, 1.0), vertical_fov=5.0)
    dtypes = [
        next(render_to_tolerance(scene, Film(4, 4), tolerance, dtype="float32")).dtype
        for tolerance in (1e-4, 1e-5)
    ]
    assert dtypes == ["float32", "float64"]


@pytest.mark.parametrize("tolerance", [1e-9, 1e-300])
def test_what_is_out_of_reach_is_refused_at_once(tolerance):
    drawn = []
    with pytest.raises(ValueError, match=r"out of reach: about \S+ samples a pixel"):
        drawn.extend(render_to_tolerance(LIT, SMALL, tolerance, dtype="float64"))
    assert len(drawn) == 1


@pytest.mark.parametrize("tolerance", [0.0, -1.0, float("nan")])
def test_tolerances_are_positive(tolerance):
    with pytest.raises(ValueError, match="must be above 0"):
        next(render_to_tolerance(SUMMED, SMALL, tolerance))


@pytest.mark.parametrize("scene", [LIT, CHOSEN])
def test_progress_counts_the_parts_of_all_pictures_at_hand(scene):
    told = []
    drawn = render_to_tolerance(
        scene, SMALL, 0.05, dtype="float32", progress=lambda *parts: told.append(parts)
    )
    *_, _last = drawn
    assert told[-1][0] == told[-1][1]
    assert all(0 < done <= total for done, total in told)


def test_a_picture_that_may_be_all_noise_takes_more_samples(monkeypatch):
    """Light that one sample in a hundred finds; of the first few one alone, in one place."""
    rng = np.random.default_rng(0)

    def drawn(_scene, film, samples, _depth, seed, *_rest):
        found = rng.binomial(samples, 0.01, (film.height, film.width, 3)) / samples
        first = np.zeros((film.height, film.width, 3))
        first[0, 0] = seed == 0
        yield Growing(found if samples > 2 else first, samples)

    monkeypatch.setattr("diffdisp.tolerance.passes", drawn)
    pictures = list(render_to_tolerance(LIT, SMALL, 0.5, dtype="float64"))
    assert np.isinf(pictures[0].error)
    assert pictures[-1].error <= 0.5
    # One in a hundred: a relative error of 1/2 takes some 400 samples.
    assert 200 < pictures[-1].samples < 1600


def test_of_a_picture_with_many_more_samples_the_difference_is_the_first_ones_error():
    assert difference(1, 1 << 40, alike=0.4) == pytest.approx(1.0, abs=1e-4)
    # Independent errors that are as large: the square root of 2.
    assert difference(100, 101, alike=0.0) == pytest.approx(2**0.5, rel=0.01)
