"""A scene: data only."""

from collections.abc import Iterable

import equinox as eqx

from diffdisp.camera import Camera
from diffdisp.dispersion import Sellmeier, real_array
from diffdisp.geometry import Plane, Sphere
from diffdisp.material import Dielectric, Material
from diffdisp.texture import Checker2D, Texture
from diffdisp.vector import Triple


class Background(eqx.Module):
    """Constant radiance from everywhere; `color` is linear sRGB."""

    color: Triple = eqx.field(default=(0.0, 0.0, 0.0), converter=real_array)


class Object(eqx.Module):
    """A shape made of a material.

    Args:
        shape: a `Sphere` or a `Plane`.
        material: what it is made of.
        name: how fits and messages refer to it; may be empty.

    Raises:
        ValueError: glass on a plane, or a 2-D checker on a sphere.
    """

    shape: Sphere | Plane
    material: Material
    name: str = eqx.field(static=True, default="")

    def __check_init__(self) -> None:
        """Refuse the pairs that mean nothing."""
        problem = pairing_error(self.shape, self.material)
        if problem:
            raise ValueError(problem)


class Scene(eqx.Module):
    """Camera, objects and background. Every real number is an array leaf.

    Args:
        camera: the camera.
        objects: any number of objects.
        background: constant radiance behind them; black by default.
    """

    camera: Camera
    objects: tuple[Object, ...] = eqx.field(converter=lambda objects: as_tuple(objects))
    background: Background = Background()


def as_tuple(objects: Iterable[Object]) -> tuple[Object, ...]:
    """The objects as a tuple, whatever holds them."""
    return tuple(objects)


def pairing_error(shape: object, material: object) -> str | None:
    """Why this shape cannot be made of this material; None where it can."""
    if isinstance(shape, Plane) and isinstance(material, Dielectric):
        return "a plane cannot be glass: allowed on a plane are lambertian, metal and emitter"
    if isinstance(shape, Sphere) and isinstance(texture_of(material), Checker2D):
        return "a sphere cannot carry a checker2d: allowed on a sphere are solid and checker"
    return None


def texture_of(material: object) -> Texture | None:
    """The texture of a material; None of glass, which has none."""
    return getattr(material, "texture", None)


def is_glass(obj: Object) -> bool:
    """Whether an object is a ball of glass."""
    return isinstance(obj.material, Dielectric)


def object_glass(scene: Scene, index: int) -> Sellmeier:
    """The glass of object number `index`.

    Raises:
        ValueError: the object is not glass.
    """
    material = scene.objects[index].material
    if not isinstance(material, Dielectric):
        raise ValueError(f"object[{index}] is not glass")
    return material.glass


def with_glass(scene: Scene, index: int, glass: Sellmeier) -> Scene:
    """The scene with object number `index` made of `glass`."""
    objects = list(scene.objects)
    old = objects[index]
    objects[index] = Object(old.shape, Dielectric(glass), old.name)
    return Scene(scene.camera, tuple(objects), scene.background)


def without_names(scene: Scene) -> Scene:
    """The scene without names: they are static, but no other program."""
    return Scene(
        scene.camera,
        tuple(Object(obj.shape, _nameless(obj.material)) for obj in scene.objects),
        scene.background,
    )


def _nameless(material: Material) -> Material:
    if not isinstance(material, Dielectric):
        return material
    glass = material.glass
    return Dielectric(Sellmeier(glass.B, glass.C, glass.validity))
