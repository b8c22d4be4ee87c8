"""Parts of footprints: against points counted one by one, and sums over grids of footprints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ball, bench, furnace

from diffdisp.film import Film
from diffdisp.geometry import Ray
from diffdisp.outline import half_plane, part_within, rest_of, whole_footprint
from diffdisp.rendering import render
from diffdisp.vector import Vec3

GRID = np.meshgrid(np.arange(-6.0, 7.0), np.arange(-6.0, 7.0))
FINE = (np.arange(1000) + 0.5) / 1000 - 0.5
POINTS = (np.arange(200) + 0.5) / 200 - 0.5


def parts_of_grid(radius, place, skew=0.0, scale=1.0, dtype="float64"):
    """What each of a grid of footprints of size `scale` sees of a sphere, (13, 13)."""
    x, y = (jnp.asarray(side, dtype) for side in GRID)
    radius, skew, scale = (jnp.asarray(number, dtype) for number in (radius, skew, scale))
    place = [jnp.asarray(number, dtype) for number in place]

    def of(x, y):
        zero, one = 0.0 * x, 0.0 * x + scale
        still, ahead = Vec3(zero, zero, zero), Vec3(zero, zero, zero + 1.0)
        edges = Ray(Vec3(one, zero, zero), still), Ray(Vec3(skew * one, one, zero), still)
        ray = Ray(Vec3(x + skew * y, y, zero - 50.0) * scale, ahead)
        center = Vec3(zero + place[0], zero + place[1], zero) * scale
        return part_within(ray, edges, center, zero + radius * scale)

    return jax.vmap(jax.vmap(of))(x, y)


def counted(radius, place):
    """The same, of 40 000 points of each."""
    points = np.meshgrid(POINTS, POINTS)
    right, up = (side[..., None, None] + to for side, to in zip(GRID, points, strict=True))
    return (np.hypot(right - place[0], up - place[1]) < radius).mean(axis=(-2, -1))


@pytest.mark.parametrize("skew", [0.0, 0.4])
@pytest.mark.parametrize(
    ("radius", "off"),
    [(1e-3, 1e-9), (0.3, 1e-9), (0.7, 1e-9), (1.0, 0.02), (1.3, 0.02), (2.0, 5e-3), (4.0, 1e-3)],
)
def test_a_grid_of_footprints_sees_all_of_a_sphere(radius, off, skew):
    for place in np.random.default_rng(0).uniform(-0.5, 0.5, (6, 2)):
        seen = parts_of_grid(radius, place, skew)
        assert abs(seen.sum() / (np.pi * radius**2) - 1) < off * (1 + 4 * skew)
        assert seen.min() >= 0
        assert seen.max() <= 1


@pytest.mark.parametrize(("radius", "off"), [(0.3, 0.02), (0.7, 0.06), (1.0, 0.06), (4.0, 0.02)])
def test_each_footprint_sees_its_part(radius, off):
    for place in np.random.default_rng(1).uniform(-0.5, 0.5, (4, 2)):
        np.testing.assert_allclose(
            parts_of_grid(radius, place), counted(radius, place), rtol=0, atol=off
        )


@pytest.mark.parametrize("radius", [0.3, 1.7])
def test_parts_move_as_the_sphere_does(radius):
    def at(move):
        return parts_of_grid(radius + 0.3 * move, (0.11 + move, -0.23 + 0.7 * move))

    _, slope = jax.jvp(at, (jnp.array(0.0),), (jnp.array(1.0),))
    step = 1e-6
    moved = (at(jnp.array(step)) - at(jnp.array(-step))) / (2 * step)
    np.testing.assert_allclose(slope, moved, rtol=0, atol=1e-7)
    if radius < 0.75:  # all of it is seen, and grows as its area does
        np.testing.assert_allclose(slope.sum(), 2 * np.pi * radius * 0.3, rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-12, 1e-3, 1e9])
@pytest.mark.parametrize("radius", [1e-9, 0.5, 3.0, 1e6])
def test_parts_do_not_depend_on_the_unit_of_length(radius, scale):
    def at(radius):
        return parts_of_grid(radius, (0.2, 0.1), scale=scale, dtype="float32")

    one = jnp.ones((), "float32")
    found, slope = jax.jvp(at, (one * np.float32(radius),), (one,))
    assert np.isfinite(slope).all()
    # Next to a large sphere float32 has the places of footprints to a tenth of one.
    expected = parts_of_grid(radius, (0.2, 0.1))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 if radius < 1e6 else 0.2)


def counted_beyond(distance, slopes):
    """Part, middle and variances of a square beyond a line, of a million points."""
    x, y = np.meshgrid(FINE, FINE, indexing="ij")
    beyond = distance + slopes[0] * x + slopes[1] * y > 0
    x, y = x[beyond], y[beyond]
    return beyond.mean(), (x.mean(), y.mean()), np.cov(np.stack([x, y]), bias=True)


def spread_of(piece):
    """Variances of a piece's parallelogram, of two boxes."""
    edges = np.array(piece.edges)
    return edges.T @ edges / 12


@pytest.mark.parametrize("seed", range(12))
def test_a_piece_is_what_lies_beyond_a_line(seed):
    draw = np.random.default_rng(seed)
    slopes = draw.normal(size=2) * 10.0 ** draw.uniform(-3, 0, 2)
    if seed < 4:
        slopes[seed % 2] = 0.0
    distance = 0.45 * draw.uniform(-1, 1) * np.abs(slopes).sum()
    piece = half_plane(jnp.array(distance), tuple(jnp.array(slopes)))
    part, middle, variances = counted_beyond(distance, slopes)
    assert abs(piece.part - part) < 1e-3
    np.testing.assert_allclose(piece.middle, middle, atol=2e-3)
    np.testing.assert_allclose(spread_of(piece), variances, atol=1e-3)


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.1, 0.2), (-0.3, 0.0)])
def test_lines_beside_a_footprint_leave_all_or_nothing(slopes):
    slopes = tuple(map(jnp.array, slopes))
    all_of_it, nothing = (half_plane(jnp.array(d), slopes) for d in (1.0, -1.0))
    for found, expected in zip(jax.tree.leaves(all_of_it), jax.tree.leaves(whole()), strict=True):
        assert abs(found - expected) < 1e-12
    assert all(leaf == 0 for leaf in jax.tree.leaves(nothing))


def whole():
    return whole_footprint(jnp.array(0.0))


@pytest.mark.parametrize("seed", range(4))
def test_derivatives_of_a_piece(seed):
    draw = np.random.default_rng(seed)
    slopes, distance = draw.normal(size=2), 0.3 * draw.normal()
    at = jnp.array([distance, *slopes])

    def numbers(given):
        piece = half_plane(given[0], (given[1], given[2]))
        return jnp.stack([piece.part, *piece.middle])

    slope = jax.jacfwd(numbers)(at)
    steps = 1e-6 * np.eye(3)
    moved = np.stack([(numbers(at + s) - numbers(at - s)) / 2e-6 for s in steps], axis=-1)
    np.testing.assert_allclose(slope, moved, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("left", [1e-1, 1e-3, 1e-5, 1e-7, 0.0])
def test_slivers_stay_within_the_footprint(left, dtype):
    for angle in np.linspace(0, 2 * np.pi, 33):
        slopes = np.cos(angle), np.sin(angle)
        distance = left - 0.5 * np.abs(slopes).sum()
        piece = half_plane(jnp.array(distance, dtype), tuple(jnp.array(s, dtype) for s in slopes))
        assert np.isfinite(jax.tree.leaves(piece)).all()
        assert 0 <= piece.part <= 1.5 * max(left, 1e-6)
        assert np.abs(piece.middle).max() <= 0.5 + 1e-6
        assert np.abs(piece.edges).max() <= 1 + 1e-6


@pytest.mark.parametrize("distance", [-0.2, 0.0, 0.31])
def test_the_rest_is_the_other_side(distance):
    slopes = jnp.array(0.4), jnp.array(-0.7)
    rest = rest_of(half_plane(jnp.array(distance), slopes))
    there = half_plane(jnp.array(-distance), (-slopes[0], -slopes[1]))
    assert abs(rest.part - there.part) < 1e-12
    np.testing.assert_allclose(rest.middle, there.middle, atol=1e-12)
    np.testing.assert_allclose(spread_of(rest), spread_of(there), atol=1e-12)


def crossed(*others):
    """A ball of glass, off the middle, before white."""
    return furnace(ball("N-BK7", (0.3, 0.2, 0.0)), *others, look_from=(0, 0, 6), vertical_fov=40)


@pytest.mark.parametrize("film", [Film(24, 24), Film(24, 24, [0.45, 0.6])])
def test_across_an_outline_no_light_is_lost_or_made(film):
    np.testing.assert_allclose(render(crossed(), film, samples=1), 1.0, atol=2e-5)


def test_a_picture_of_few_samples_knows_the_outline():
    # With points on one side or the other of an outline it is 2 % off.
    film = Film(32, 32, [0.55])
    few, many = (np.asarray(render(bench(), film, samples=n)) for n in (9, 256))
    assert np.sqrt(np.mean((few - many) ** 2) / np.mean(many**2)) < 0.016


def test_one_ball_before_another_loses_no_light():
    picture = render(crossed(ball("N-BK7", (-0.6, -0.3, -3.0))), Film(24, 24, [0.55]), samples=4)
    np.testing.assert_allclose(picture, 1.0, atol=1e-9)


def test_derivatives_of_pictures_know_that_an_outline_moves():
    film = Film(16, 16, [0.55])

    def seen(fov):
        return render(bench(vertical_fov=fov), film, samples=64)

    fov = jnp.array(34.0)
    _, slope = jax.jvp(seen, (fov,), (jnp.ones_like(fov),))
    moved = (seen(fov + 1e-3) - seen(fov - 1e-3)) / 2e-3
    assert np.sqrt(np.mean((slope - moved) ** 2) / np.mean(moved**2)) < 0.1
