"""What is varied about a bench, and what is left as it is."""

import numpy as np
import pytest
from fake_fit import fake_expected
from helpers import BK7, ball, bench, camera, screen

from diffdisp import varying
from diffdisp.film import Film
from diffdisp.fitting import expected_uncertainty
from diffdisp.geometry import Plane
from diffdisp.material import Emitter
from diffdisp.scene import Background, Object, Scene
from diffdisp.varying import FACTORS, Bench, vary_bench

SMALL, BANDS = (20, 10), (400.0, 700.0, 5)


@pytest.fixture
def asked(monkeypatch):
    """The scenes and films that errors were asked of."""
    found = []

    def expect(scene, film, **_options):
        found.append((scene, film))
        return fake_expected(n_d_std=1e-6 * len(found))

    monkeypatch.setattr(varying, "expected_uncertainty", expect)
    return found


def named(plan: Bench) -> dict[str, list[float]]:
    return {some.quantity: some.values.tolist() for some in plan.variations}


def test_four_things_are_varied(asked):
    told = []
    plan = vary_bench(
        bench(), SMALL, BANDS, noise=1e-3, progress=lambda *numbers: told.append(numbers)
    )
    assert plan.left_out == ()
    values = named(plan)
    np.testing.assert_allclose(
        values["distance of the screen from the ball"], 3.1 * np.array(FACTORS)
    )
    np.testing.assert_allclose(values["tile width"], 0.5 * np.array(FACTORS))
    assert values["width of the picture"] == [10, 14, 20, 28, 40]
    assert values["number of bands"] == [2, 4, 5, 7, 10]  # 2.5 and 3.5 to the even neighbour
    # The bench as it is is looked at once, and first.
    assert told == [(i, 17) for i in range(1, 18)]
    for some in plan.variations:
        assert some.own in some.values
        assert some.n_d_std[some.values == some.own] == plan.expected.n_d_std
    scenes, films = zip(*asked, strict=True)
    depths = [float(scene.objects[1].shape.point[2]) for scene in scenes]
    np.testing.assert_allclose(depths[1:5], -3.1 * np.array([0.5, 0.7, 1.4, 2.0]))
    np.testing.assert_array_equal(np.delete(depths, range(1, 5)), -3.1)
    tiles = [float(scene.objects[1].material.texture.tile) for scene in scenes]
    np.testing.assert_allclose(tiles[5:9], 0.5 * np.array([0.5, 0.7, 1.4, 2.0]))
    np.testing.assert_array_equal(np.delete(tiles, range(5, 9)), 0.5)
    sizes = [(film.width, film.height) for film in films]
    assert sizes[9:13] == [(10, 5), (14, 7), (28, 14), (40, 20)]
    assert set(sizes[:9] + sizes[13:]) == {SMALL}
    assert [film.channels for film in films[13:]] == [2, 4, 7, 10]
    # The same wavelengths in other parts.
    np.testing.assert_allclose(films[13].wavelengths, [0.475, 0.625])


def test_the_best_value_is_that_of_the_smallest_error(asked):
    plan = vary_bench(bench(), SMALL, BANDS, noise=1e-3)
    for some in plan.variations:
        assert some.values[some.best] == some.own  # the first one asked of


def test_nothing_is_varied_unless_it_is_asked_for(asked):
    plan = vary_bench(bench(), SMALL, BANDS, noise=1e-3, only_own=True)
    assert (plan.variations, plan.left_out, len(asked)) == ((), (), 1)


def test_the_screen_does_not_meet_a_ball_nor_the_camera(asked):
    near = Scene(camera(), (ball(BK7, name="ball"), screen(z=-1.5)))
    plan = vary_bench(near, SMALL, None, noise=1e-3)
    np.testing.assert_allclose(
        named(plan)["distance of the screen from the ball"], [1.05, 1.5, 2.1, 3.0]
    )
    assert plan.left_out[0] == "distance of the screen 0.75: it would meet a ball or the camera"
    behind = Scene(camera(), (ball(BK7, name="ball"), screen(z=5.0)))
    values = named(vary_bench(behind, SMALL, None, noise=1e-3))
    np.testing.assert_allclose(values["distance of the screen from the ball"], [5.0, 7.0, 10.0])


def test_what_a_scene_does_not_have_is_left_out(asked):
    sky = Scene(camera(), (ball(BK7, name="ball"),), Background([1.0, 0.5, 0.2]))
    plan = vary_bench(sky, SMALL, None, noise=1e-3)
    assert list(named(plan)) == ["width of the picture"]
    assert "no plane shines" in plan.left_out[0]
    assert "in colour" in plan.left_out[1]
    plain = Object(Plane([0.0, 0.0, -3.0], [0.0, 0.0, 2.0]), Emitter([1.0, 1.0, 1.0]))
    plan = vary_bench(Scene(camera(), (ball(BK7), plain)), SMALL, BANDS, noise=1e-3)
    assert "tile width" not in named(plan)
    np.testing.assert_allclose(
        named(plan)["distance of the screen from the ball"], 3.0 * np.array(FACTORS)
    )
    assert plan.left_out == ("tile width: no screen carries a checker2d",)


def test_the_first_of_several_screens_is_varied(asked):
    two = Scene(camera(), (ball(BK7, name="ball"), screen(), screen(z=-9.0)))
    plan = vary_bench(two, SMALL, BANDS, noise=1e-3)
    assert plan.left_out == ("other screens than screen: 1 stay as they are",)
    assert all(float(scene.objects[2].shape.point[2]) == -9.0 for scene, _ in asked)


def test_a_varied_bench_is_as_one_made_so():
    plan = vary_bench(bench(), (8, 8), None, noise=0.01)
    tiles = next(some for some in plan.variations if some.quantity == "tile width")
    made = expected_uncertainty(bench(tile=0.25), Film(8, 8), noise=0.01)
    assert tiles.n_d_std[0] == pytest.approx(made.n_d_std, rel=1e-12)
    assert tiles.V_d_std[0] == pytest.approx(made.V_d_std, rel=1e-12)
    own = expected_uncertainty(bench(), Film(8, 8), noise=0.01)
    assert plan.expected.n_d_std == pytest.approx(own.n_d_std, rel=1e-12)
