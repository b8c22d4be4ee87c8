"""From a point of the film to a ray."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from diffdisp.dispersion import real_array
from diffdisp.geometry import Ray
from diffdisp.vector import Real, Triple, normalize, vec3


class Camera(eqx.Module):
    """Pinhole camera.

    Args:
        look_from: the pinhole, scene units.
        look_at: the point in the middle of the picture.
        up: a direction that points upwards in the picture, not along the view.
        vertical_fov: full vertical field of view, degrees, within (0, 180).
    """

    look_from: Triple = eqx.field(converter=real_array)
    look_at: Triple = eqx.field(converter=real_array)
    up: Triple = eqx.field(default=(0.0, 1.0, 0.0), converter=real_array)
    vertical_fov: Real = eqx.field(default=45.0, converter=real_array)


def camera_ray(camera: Camera, height: Real, x: Real, y: Real, middle: tuple[Real, Real]) -> Ray:
    """The ray through a point of the film.

    Args:
        camera: the camera.
        height: rows of the picture, over which the vertical field of view spreads.
        x: pixels to the right of the picture's left edge.
        y: pixels below its upper edge.
        middle: the picture's middle (x, y) in the same pixels.
    """
    forward = normalize(vec3(camera.look_at) - vec3(camera.look_from))
    right = normalize(forward.cross(vec3(camera.up)))
    upward = right.cross(forward)
    pixel = jnp.tan(camera.vertical_fov * (np.pi / 360.0)) * (2.0 / height)
    direction = forward + right * ((x - middle[0]) * pixel) + upward * ((middle[1] - y) * pixel)
    return Ray(vec3(camera.look_from), normalize(direction))
