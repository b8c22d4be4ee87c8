"""Parts of footprints: against points counted one by one, and sums over grids of footprints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffdisp.geometry import Ray
from diffdisp.outline import part_within
from diffdisp.vector import Vec3

GRID = np.meshgrid(np.arange(-6.0, 7.0), np.arange(-6.0, 7.0))
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
