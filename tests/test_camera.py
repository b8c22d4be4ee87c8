import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffdisp.camera import Camera, camera_ray, project

WIDTH, HEIGHT, FOV = 12, 8, 40.0
HALF = np.tan(np.radians(FOV / 2))


@jax.jit
def ray(camera, x, y):
    """Origin and direction (3,) of the ray through a film point."""
    size = jnp.array(float(WIDTH)), jnp.array(float(HEIGHT))
    found = camera_ray(project(camera, *size), x, y)
    return jnp.stack(found.origin), jnp.stack(found.direction)


def direction(camera, x, y):
    return np.asarray(ray(camera, jnp.array(float(x)), jnp.array(float(y)))[1])


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


FRONT = Camera([0, 0, 4], [0, 0, 0], vertical_fov=FOV)


@pytest.mark.parametrize(
    ("x", "y", "right", "up"),
    [
        (WIDTH / 2, HEIGHT / 2, 0, 0),
        (0, 0, -WIDTH / HEIGHT, 1),
        (WIDTH, 0, WIDTH / HEIGHT, 1),
        (0, HEIGHT, -WIDTH / HEIGHT, -1),
        (WIDTH, HEIGHT, WIDTH / HEIGHT, -1),
        (WIDTH / 2, 0, 0, 1),
    ],
)
def test_rays_of_the_corners(x, y, right, up):
    # Row 0 is on top, x runs to the right: tangents of the half angles, rounded a few times.
    expected = unit([right * HALF, up * HALF, -1])
    np.testing.assert_allclose(direction(FRONT, x, y), expected, rtol=0, atol=1e-15)


def test_vertical_field_of_view_is_from_edge_to_edge():
    top, bottom = direction(FRONT, WIDTH / 2, 0), direction(FRONT, WIDTH / 2, HEIGHT)
    np.testing.assert_allclose(np.degrees(np.arccos(top @ bottom)), FOV, rtol=1e-14)


@pytest.mark.parametrize("seed", range(3))
def test_any_camera_is_the_front_one_turned(seed):
    look_from, look_at, up = np.random.default_rng(seed).normal(size=(3, 3))
    camera = Camera(look_from, look_at, 7 * up, FOV)
    forward = unit(look_at - look_from)
    right = unit(np.cross(forward, up))
    axes = np.stack([right, np.cross(right, forward), -forward])
    np.testing.assert_allclose(
        direction(camera, 1, 2), direction(FRONT, 1, 2) @ axes, rtol=0, atol=1e-14
    )
    assert axes[1] @ up > 0
    np.testing.assert_array_equal(ray(camera, jnp.array(1.0), jnp.array(2.0))[0], look_from)


def test_the_length_of_the_view_does_not_matter():
    far = Camera([0, 0, 4], [0, 0, -4000], vertical_fov=FOV)
    np.testing.assert_allclose(direction(far, 0, 0), direction(FRONT, 0, 0), rtol=0, atol=1e-15)


def test_a_view_along_up_has_no_direction():
    assert np.isnan(direction(Camera([0, 4, 0], [0, 0, 0]), 0, 0)).all()


def test_defaults():
    camera = Camera([0, 0, 4], [0, 0, 0])
    np.testing.assert_array_equal(camera.up, [0, 1, 0])
    assert camera.vertical_fov == 45


def test_gradient_by_the_field_of_view():
    def tangent(fov):
        camera = Camera([0, 0, 4], [0, 0, 0], vertical_fov=fov)
        found = ray(camera, jnp.array(WIDTH / 2), jnp.array(0.0))[1]
        return -found[1] / found[2]

    # d tan(θ/2) / dθ, θ in degrees.
    expected = np.radians(0.5) * (1 + HALF**2)
    np.testing.assert_allclose(jax.grad(tangent)(jnp.array(FOV)), expected, rtol=1e-13)
