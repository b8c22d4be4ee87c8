"""Pictures by the wavefront loop: against the direct loop, Mitsuba, and themselves."""

from itertools import pairwise
from pathlib import Path

import colour
import numpy as np
import pytest
from helpers import BK7, N_D, WHITE, ball, direct, matte

from diffdisp import chunks, programs, rendering, wavefront
from diffdisp.camera import Camera
from diffdisp.color import bands_to_rgb
from diffdisp.film import Film, band_middles
from diffdisp.geometry import Plane, Sphere
from diffdisp.material import Lambertian
from diffdisp.rendering import render, render_progressively
from diffdisp.scene import Background, Object, Scene
from diffdisp.scene_file import load_scene
from diffdisp.texture import Checker

FIXTURES = Path(__file__).parents[1] / "fixtures"
ROOM = load_scene(FIXTURES / "references" / "room.toml")
DISPERSION = load_scene(FIXTURES / "scenes" / "dispersion.toml")
REFERENCE = FIXTURES / "references" / "room.npz"
SMALL = Film(64, 48)
SINGLE = {"samples": 32, "depth": 50, "dtype": "float32"}
"""32 samples are one pass: the same program as of 64 and more."""


def blocks(picture, edge=8):
    """Means of blocks of pixels."""
    height, width, channels = picture.shape
    shape = (height // edge, edge, width // edge, edge, channels)
    return np.asarray(picture, float).reshape(shape).mean(axis=(1, 3))


def runs(draw, scene, film, seeds, **options):
    """Block means of independent pictures, and the standard error of their mean."""
    found = [blocks(draw(scene, film, seed=seed, **options)) for seed in seeds]
    return np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(len(found))


def scores(one, other):
    """z scores of the blocks in which there is more noise than rounding."""
    (mean, error), (other_mean, other_error) = one, other
    noisy = (error > 1e-6) & (other_error > 1e-6)
    assert noisy.mean() > 0.5
    z = (mean - other_mean)[noisy] / np.hypot(error, other_error)[noisy]
    print(f"{z.size} z scores: mean {z.mean():.3f}, std {z.std():.3f}")
    return z


# --- what must not matter


@pytest.mark.parametrize(
    ("name", "value"), [("LANES", 256), ("PIXELS", 1 << 12), ("workers", lambda: 1)]
)
def test_a_picture_does_not_depend_on_how_it_is_worked_on(name, value, monkeypatch):
    film = Film(100, 70)
    whole = render(ROOM, film, **SINGLE)
    for module in (rendering, wavefront, chunks):
        if hasattr(module, name):
            monkeypatch.setattr(module, name, value)
    np.testing.assert_array_equal(render(ROOM, film, **SINGLE), whole)


def test_lanes_that_share_a_pixel_draw_the_same(monkeypatch):
    pictures = []
    for shares in (1, 2, 5):
        monkeypatch.setattr(programs, "_READY", {})
        monkeypatch.setattr(wavefront, "SHARES", shares)
        pictures.append(render(DISPERSION, SMALL, **SINGLE))
    # The same samples, added in another order.
    np.testing.assert_allclose(pictures[1:], [pictures[0]] * 2, rtol=0, atol=3e-6)


def test_another_size_seed_or_number_of_passes_compiles_nothing():
    render(ROOM, SMALL, **SINGLE)
    before = len(programs._READY)
    render(ROOM, Film(100, 70), **SINGLE)
    render(ROOM, Film(1, 1), **SINGLE, seed=5)
    render(ROOM, SMALL, **(SINGLE | {"samples": 96}))
    moved = Scene(Camera((0, 1, 7), (0, 0, 0)), ROOM.objects, ROOM.background)
    render(moved, SMALL, **SINGLE)
    assert len(programs._READY) == before


def test_every_bit_of_a_word_is_found():
    bits = np.uint32(1) << np.arange(32, dtype=np.uint32)
    assert np.array_equal(wavefront._bit_number(bits), np.arange(32))


def test_the_background_alone_is_drawn_without_paths():
    view = Camera((0, 0, 4), (0, 0, 9), vertical_fov=30.0)
    scene = Scene(view, (matte(0.5),), Background((0.2, 0.4, 0.6)))
    picture = render(scene, Film(30, 20), samples=4, dtype="float32")
    np.testing.assert_array_equal(
        picture, np.broadcast_to(np.float32([0.2, 0.4, 0.6]), (20, 30, 3))
    )


@pytest.mark.parametrize(
    ("look_from", "look_at"),
    [((0.2, 0.3, 6.0), (0, 0, 0)), ((0, 0, 0.1), (0.1, -0.2, -1)), ((-3, 2, -1), (0, 0, 0))],
)
def test_no_sphere_is_missed_by_a_tile(look_from, look_at):
    # Black spheres large and little: one that a tile leaves out would show what is behind it.
    rng = np.random.default_rng(3)
    places = rng.uniform(-2, 2, (19, 3))
    radii = 10 ** rng.uniform(-1.5, 0.0, 19)
    spheres = [matte(0.0, tuple(p), float(r)) for p, r in zip(places, radii, strict=True)]
    film = Film(144, 144)
    scene = Scene(Camera(look_from, look_at, vertical_fov=70.0), spheres, Background(WHITE))
    picture = render(scene, film, samples=16, depth=2, dtype="float32")[..., 0]
    forward = np.subtract(look_at, look_from)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0, 1, 0))
    right /= np.linalg.norm(right)
    above = np.cross(right, forward)
    step = (np.arange(144) + 0.5 - 72) * 2 * np.tan(np.radians(35)) / 144
    rays = forward + right * step[:, None] - above * step[:, None, None]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    offset = places - np.asarray(look_from)
    along = rays @ offset.T
    beside = (offset**2).sum(-1) - along**2
    within = (offset**2).sum(-1) < radii**2
    pixel = 2 * np.tan(np.radians(35)) / 144 * np.maximum(along, 0)
    well = within | ((along > 0) & (np.sqrt(np.maximum(beside, 0)) < radii - pixel))
    np.testing.assert_array_equal(picture[well.any(-1)], 0)
    far = (np.sqrt(np.maximum(beside, 0)) > radii + 2 * pixel) & ~within
    far |= (along < -radii) & ~within
    np.testing.assert_array_equal(picture[far.all(-1)], 1)
    assert well.any()


def test_a_scene_of_planes_alone():
    # A plane in a white surround: every path leaves it at once.
    plane = Object(Plane([0, -1, 0], [0, 1, 0]), Lambertian([0.5, 0.25, 0.75]))
    scene = Scene(Camera((0, 0, 3), (0, -1, 0)), (plane,), Background(WHITE))
    picture = render(scene, Film(8, 6), samples=2, depth=5, dtype="float32")
    np.testing.assert_allclose(picture[-1, 4], [0.5, 0.25, 0.75], rtol=1e-6)  # float32


# --- the direct loop

GLASS = Scene(
    Camera((0, 0.6, 3.0), (0, -0.05, 0), vertical_fov=45.0),
    (
        ball(BK7),
        Object(Sphere([0, -101, 0], 100.0), Lambertian(Checker([0.1] * 3, [0.9, 0.6, 0.4], 6.0))),
    ),
    Background(WHITE),
)


def test_the_same_numbers_make_the_same_paths():
    # Rounding parts few paths, at the rim of a ball or after many reflections.
    one, other = render(ROOM, SMALL, **SINGLE), direct(ROOM, SMALL, **SINGLE)
    apart = np.abs(one - other).max(axis=-1)
    assert np.mean(apart > 1e-4) < 0.1
    np.testing.assert_allclose(one.mean(axis=(0, 1)), other.mean(axis=(0, 1)), rtol=1e-3)


@pytest.mark.parametrize(
    ("scene", "film", "samples", "seeds"),
    [
        (ROOM, Film(128, 96), 32, 16),
        (GLASS, SMALL, 256, 16),
        (GLASS, Film(SMALL.width, SMALL.height, np.array([0.45, 0.65])), 256, 8),
    ],
    ids=["room", "dispersive", "dispersive bands"],
)
def test_both_loops_expect_the_same(scene, film, samples, seeds):
    options = SINGLE | {"samples": samples}
    one = runs(render, scene, film, range(seeds), **options)
    z = scores(one, runs(direct, scene, film, range(100, 100 + seeds), **options))
    # Some 140 and 40 blocks of three channels that are alike: the mean of their z is known to 0.09
    # and 0.15, their spread to 0.06 and 0.11; of 16 runs each it is √(30/28) = 1.04, of 8 1.08.
    assert abs(z.mean()) < 0.15
    assert 0.8 < z.std() < 1.2


# --- the reference


@pytest.mark.slow
def test_the_room_is_mitsubas():
    # 24 x 32 blocks in three channels, of which the background and the lamps have no noise.
    with np.load(REFERENCE) as file:
        reference = file["mean"], file["standard_error"]
        size, depth = file["radiance"].shape, int(file["depth"])
    film = Film(size[1], size[0])
    options = {"samples": 64, "depth": depth, "dtype": "float32"}
    mean, error = runs(render, ROOM, film, range(16), **options)
    still = (error == 0) & (reference[1] == 0)
    np.testing.assert_allclose(mean[still], reference[0][still], rtol=3e-6)  # float32
    z = scores((mean, error), reference)
    assert abs(z.mean()) < 0.1
    assert 0.9 < z.std() < 1.1


# --- dispersion


def with_textures(*textures):
    """The dispersion scene with another ground."""
    glass, soil = DISPERSION.objects
    return [
        Scene(
            DISPERSION.camera,
            (glass, Object(soil.shape, Lambertian(texture), soil.name)),
            DISPERSION.background,
        )
        for texture in textures
    ]


def test_a_white_furnace_of_glass_and_white_paint():
    # Whatever happens to a path it meets white in the end, but for the wavelengths' weights.
    (scene,) = with_textures(Checker(WHITE, WHITE, 10.0))
    means = [render(scene, SMALL, **SINGLE, seed=k).mean(axis=(0, 1)) for k in range(16)]
    mean, error = np.mean(means, axis=0), np.std(means, axis=0, ddof=1) / 4
    # Paths of 50 segments are cut short between the ball and the ground: hardly one in 1e5.
    assert np.all(np.abs(mean - 1) < 4 * error + 1e-5)
    assert np.all(error < 1e-3)


@pytest.mark.parametrize("samples", [96, 1024])
def test_a_white_furnace_is_white_in_the_end(samples):
    # The weights of all wavelengths sum to 1 in each channel, and those of a pass too.
    (scene,) = with_textures(Checker(WHITE, WHITE, 10.0))
    first, *_, last = render_progressively(scene, SMALL, **(SINGLE | {"samples": samples}))
    np.testing.assert_allclose(first.radiance.mean(axis=(0, 1)), 1, rtol=0, atol=1e-3)  # noise
    np.testing.assert_allclose(last.radiance.mean(axis=(0, 1)), 1, rtol=0, atol=1e-3)  # noise


def test_without_structure_dispersion_is_not_seen():
    (scene,) = with_textures(Checker([0.5] * 3, [0.5] * 3, 10.0))
    plain = Scene(
        scene.camera,
        (ball(N_D), *scene.objects[1:]),
        scene.background,
    )
    luminance = np.array([0.2126, 0.7152, 0.0722])
    found = []
    for which in (scene, plain):
        means = [render(which, SMALL, **SINGLE, seed=k).mean(axis=(0, 1)) for k in range(16)]
        found.append((np.mean(means, axis=0) @ luminance, np.std(means @ luminance, ddof=1) / 4))
    (one, error), (other, other_error) = found
    assert abs(one - other) < 4 * np.hypot(error, other_error)
    assert error < 1e-3


def lab(rgb):
    """CIE Lab of linear sRGB whose white is (1, 1, 1)."""
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    xyz = colour.RGB_to_XYZ(rgb, "sRGB", apply_cctf_decoding=False)
    return colour.XYZ_to_Lab(xyz, white)


def bands_against_colour(scene, film, samples):
    """Mean ΔE 2000 between 41 bands turned to colour, and the colour film."""
    wavelengths = band_middles(380.0, 780.0, 41)
    options = {"samples": samples, "depth": 50, "dtype": "float32"}
    banded = Film(film.width, film.height, wavelengths)
    spectral = bands_to_rgb(np.asarray(render(scene, banded, **options), float), wavelengths)
    picture = np.asarray(render(scene, film, **options), float)
    found = colour.delta_E(lab(picture), lab(spectral), method="CIE 2000").mean()
    print(f"delta E {found:.3f}")
    return found


@pytest.mark.slow
def test_bands_turned_to_colour_are_the_colour_film():
    # Each bounce from paint multiplies three numbers here and spectra there.
    assert bands_against_colour(DISPERSION, Film(32, 24), 256) <= 2.0


@pytest.mark.slow
def test_of_one_coloured_surface_bands_are_nearly_exact():
    # A painted ball before a white sky, beside and behind glass.
    painted = Object(
        Sphere([0.9, 0, -1.5], 1.0), Lambertian(Checker([0.8, 0.3, 0.1], [0.8, 0.3, 0.1]))
    )
    scene = Scene(DISPERSION.camera, (DISPERSION.objects[0], painted), Background(WHITE))
    assert bands_against_colour(scene, Film(32, 24), 256) <= 0.5


# --- progress


def test_progress_is_told_and_may_stop():
    told, options = [], SINGLE | {"samples": 96}
    render(ROOM, Film(100, 70), **options, progress=lambda *parts: told.append(parts))
    assert len({total for _, total in told}) == 1
    assert [done for done, _ in told] == list(range(1, told[0][1] + 1))

    def stop(done, total):
        stopped.append(done)
        raise KeyboardInterrupt

    stopped = []
    with pytest.raises(KeyboardInterrupt):
        render(ROOM, Film(100, 70), **options, progress=stop)
    assert stopped == [1]


@pytest.mark.parametrize("scene", [ROOM, DISPERSION], ids=["room", "dispersion"])
def test_a_growing_picture_becomes_the_picture(scene):
    options = SINGLE | {"samples": 96}
    growing = list(render_progressively(scene, SMALL, **options))
    assert [picture.samples for picture in growing] == [32, 64, 96]
    np.testing.assert_array_equal(growing[-1].radiance, render(scene, SMALL, **options))
    assert not any(np.array_equal(a.radiance, b.radiance) for a, b in pairwise(growing))


@pytest.mark.parametrize(
    ("scene", "least"), [(ROOM, 2e-4), (DISPERSION, 1e-3)], ids=["room", "dispersion"]
)
def test_no_picture_on_the_way_is_biased(scene, least):
    options = SINGLE | {"samples": 96}
    seeds = [
        [
            picture.radiance.mean(axis=(0, 1))
            for picture in render_progressively(scene, SMALL, seed=k, **options)
        ]
        for k in range(16)
    ]
    first, *_, last = np.moveaxis(np.array(seeds, float), 1, 0)
    difference = first - last
    error = difference.std(axis=0, ddof=1) / 4
    # The parts of each pixel that a pass takes lie about its middle to a hundredth or two; so much
    # of a pixel further the mean of the picture is another by 1e-4 or so. And a pass shows fringes
    # at fewer wavelengths than all of them do.
    assert np.all(np.abs(difference.mean(axis=0)) < 4 * error + least)
    assert np.all(error < 1e-3)
