"""Derivatives where paths scatter, against differences of hard-edged pictures by the other loop."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import WHITE, ball, ground, matte

from diffdisp.camera import Camera
from diffdisp.dispersion import Sellmeier
from diffdisp.film import Film
from diffdisp.geometry import Sphere
from diffdisp.material import Lambertian
from diffdisp.rendering import render
from diffdisp.scene import Background, Object, Scene, with_glass
from diffdisp.texture import Checker, Checker2D

N, STEP = 1.52, 4e-3
FILM = Film(24, 24, np.array([0.55]))


def glass(n):
    """A glass of one index."""
    return Sellmeier(jnp.zeros(3).at[0].set(n * n - 1), jnp.zeros(3))


def scene(camera, *objects):
    """A glass ball before white, and what else there is."""
    return Scene(camera, (ball(glass(N)), *objects), Background(WHITE))


TILES = ground(Lambertian(Checker2D([0.9] * 3, [0.1] * 3, 0.6)), -1.0)
FROM_ABOVE = scene(Camera((0, 5, 2), (0, -0.4, 0), vertical_fov=27.0), TILES)
BEHIND = scene(Camera((0, 0, 4), (0, 0, 0), vertical_fov=34.0), matte(0.2, (0.25, 0.2, -3), 0.5))


def picture(of, n, samples, dtype, seed=0):
    """Radiance (24, 24)."""
    seen = with_glass(of, 0, glass(n))
    return render(seen, FILM, samples=samples, dtype=dtype, seed=seed)[..., 0]


def differences(of, seed):
    """The slope in the index by the hard-edged pictures on both sides."""
    more, less = (
        np.asarray(picture(of, np.asarray(N + h), 16384, "float32", seed), float)
        for h in (STEP, -STEP)
    )
    return (more - less) / (2 * STEP)


@pytest.mark.parametrize(
    ("of", "most"), [(FROM_ABOVE, 0.2), (BEHIND, 0.2)], ids=["tiles", "outline"]
)
def test_slopes_in_the_index(of, most):
    slope = jax.jit(lambda n: jax.jvp(lambda n: picture(of, n, 256, "float64"), (n,), (1.0,)))
    value, found = (np.asarray(part) for part in slope(jnp.asarray(N)))
    assert np.isfinite(found).all()
    pair = np.stack([differences(of, seed) for seed in (1, 2)])
    # Two pictures with errors of their own: in the product there is no noise of either.
    square = np.sum(np.prod(found - pair, axis=0)) / np.sum(np.prod(pair, axis=0))
    print(f"slope off by {np.sqrt(abs(square)):.3f}")
    assert square < most**2
    hard = np.asarray(picture(of, np.asarray(N), 4096, "float32"))
    print(f"value off by {np.abs(value - hard).mean():.4f} in the mean")
    assert np.abs(value - hard).mean() < 0.01


def test_a_horizon_on_the_axis_of_camera_and_ball():
    # Exactly between two parts of a pixel: rounding alone tells whether a part's ray is level.
    level = scene(Camera((0, 0, 4), (0, 0, 0), vertical_fov=42.0), TILES)
    film = Film(15, 15, np.array([0.55]))

    def seen(n):
        of = with_glass(level, 0, glass(n))
        return render(of, film, samples=16, dtype="float64")[..., 0]

    value, slope = jax.jit(lambda n: jax.jvp(seen, (n,), (1.0,)))(jnp.asarray(N))
    assert np.isfinite(value).all()
    assert np.isfinite(slope).all()


def test_a_white_ball_before_white_is_not_seen():
    # A footprint that grazes it scatters from its outside: from its inside half of them saw no
    # light, and the picture was 2e-3 too dark. The noise of its mean is 5e-4.
    white = scene(BEHIND.camera, matte(1.0, (0.25, 0.2, -3), 0.5))
    value = jax.jit(lambda n: jax.jvp(lambda n: picture(white, n, 256, "float64"), (n,), (1.0,))[0])
    assert abs(np.mean(value(jnp.asarray(N))) - 1) < 1.2e-3


def test_a_horizon_that_the_camera_sees():
    # Black ground below a white sky: of a pixel the part above the horizon, which the camera's
    # tilt moves, is white.
    black, edge, tilt = ground(Lambertian([0.0] * 3), -1.0), np.tan(np.pi / 9), 0.15

    def column(tilt):
        target = jnp.stack([0.0 * tilt, tilt, -1.0 + 0.0 * tilt])
        camera = Camera((0, 0, 0), target, vertical_fov=40.0)
        seen = Scene(camera, (black,), Background(WHITE))
        film = Film(8, 8, np.array([0.55]))
        return jnp.mean(render(seen, film, samples=256, dtype="float64")[..., 0], axis=1)

    found, slope = jax.jit(lambda tilt: jax.jvp(column, (tilt,), (1.0,)))(jnp.asarray(tilt))
    horizon = 4 * (1 + tilt / edge)
    assert np.asarray(found) == pytest.approx(np.clip(horizon - np.arange(8), 0, 1), abs=2e-3)
    assert np.asarray(slope) == pytest.approx(4 / edge * (np.arange(8) == 5), rel=0.02, abs=1e-9)


def test_cubes_near_a_horizon_seen_through_a_ball():
    # A row of pixels that each show four cubes and a horizon. The scene is its own mirror image
    # but for the colours of its cubes, so that the difference of both halves is of those alone.
    checker = Checker([0.1] * 3, [0.9] * 3, 6.0)
    globe = Object(Sphere((0, -101, 0), 100.0), Lambertian(checker))
    level = scene(Camera((0, 0.6, 3.2), (0, -0.1, 0), vertical_fov=21.73), globe)

    def row(loop, samples, dtype, seed):
        seen = partial(picture, level, samples=samples, dtype=dtype, seed=seed)
        return np.asarray(loop(seen)(jnp.asarray(N)), float)[12]

    def of_derivatives(seen):
        return jax.jit(lambda n: jax.jvp(seen, (n,), (1.0,))[0])

    found = row(of_derivatives, 1024, "float64", 1)
    off = found - row(jax.jit, 16384, "float32", 2)
    odd = 0.5 * (off - off[::-1])
    print(f"{np.sqrt(np.mean(odd**2)):.4f}")
    assert np.sqrt(np.mean(odd**2)) < 0.003


def test_bands_whose_paths_fill_no_block():
    # What is followed together is filled up with copies; they are none of the picture's paths.
    def slopes(bands):
        def seen(n):
            return render(with_glass(FROM_ABOVE, 0, glass(n)), Film(24, 24, bands), samples=4)

        return jax.jit(lambda n: jax.jvp(seen, (n,), (1.0,)))(jnp.asarray(N))

    together, alone = slopes(np.array([0.45, 0.55, 0.65])), slopes(np.array([0.55]))
    # A glass of one index: all bands are the same picture, drawn by the same numbers.
    for found, expected in zip(together, alone, strict=True):
        np.testing.assert_allclose(found, expected.repeat(3, axis=-1), rtol=1e-9, atol=1e-9)
