"""From a point of the film to a ray."""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from diffdisp.dispersion import real_array
from diffdisp.geometry import Ray
from diffdisp.vector import Real, Triple, Vec3, module_of, normalize, vec3


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


class Projection(NamedTuple):
    """How a camera sees a picture: a plane at a distance of 1 before its pinhole.

    Args:
        pinhole: scene units.
        forward: unit vector to the plane.
        right: one pixel of the picture, on the plane.
        down: one pixel of the picture, on the plane.
        middle: pixels from the picture's left and upper edges to where `forward` points.
    """

    pinhole: Vec3
    forward: Vec3
    right: Vec3
    down: Vec3
    middle: tuple[Real, Real]


def project(camera: Camera, width: Real, height: Real) -> Projection:
    """How the camera sees a picture of so many pixels; by NumPy if it holds NumPy's arrays.

    The vertical field of view spreads over the picture's height.
    """
    forward = normalize(vec3(camera.look_at) - vec3(camera.look_from))
    right = normalize(forward.cross(vec3(camera.up)))
    half = camera.vertical_fov * (np.pi / 360.0)
    pixel = module_of(half).tan(half) * (2.0 / height)
    down = forward.cross(right) * pixel
    middle = (0.5 * width, 0.5 * height)
    return Projection(vec3(camera.look_from), forward, right * pixel, down, middle)


def camera_ray(projection: Projection, x: Real, y: Real) -> Ray:
    """The ray through a point of the film.

    Args:
        projection: the camera and the picture's size.
        x: pixels to the right of the picture's left edge.
        y: pixels below its upper edge.
    """
    pinhole, forward, right, down, middle = projection
    direction = forward + right * (x - middle[0]) + down * (y - middle[1])
    return Ray(pinhole, normalize(direction))
