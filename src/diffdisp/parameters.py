"""The numbers of a scene by name, as a fit frees them: `ball.center`, `screen.tile`."""

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffdisp.geometry import Sphere
from diffdisp.material import Emitter
from diffdisp.scene import Scene, texture_of
from diffdisp.vector import Array

AXES: tuple[str, ...] = ("x", "y", "z")
"""Components of a vector that may be freed alone, as in `ball.center.x`."""

LENGTHS = ("center", "point", "look_from", "look_at")
"""Vectors whose unit of change is a length; that of all others is 1."""

POSITIVE = ("radius", "tile", "scale", "intensity", "vertical_fov")
"""Numbers above 0: their coordinate is a logarithm, so that no step makes them negative."""


class Place(NamedTuple):
    """Where a number stands in a scene; it is part of a compiled program.

    Args:
        path: attributes, and numbers of objects, that lead to the array.
        component: which of its three numbers; None where it holds one.
    """

    path: tuple[str | int, ...]
    component: int | None

    @property
    def positive(self) -> bool:
        """Whether its coordinate is a logarithm."""
        return self.path[-1] in POSITIVE


class Parameter(NamedTuple):
    """One free number of a scene.

    Args:
        name: as users write it.
        place: where it stands.
        unit: what a coordinate of 1 adds to it; of those above 0, the factor is e.
    """

    name: str
    place: Place
    unit: float


def named_parameters(scene: Scene, names: Sequence[str], length: float) -> tuple[Parameter, ...]:
    """The numbers of a scene that some names stand for.

    Args:
        scene: the scene.
        names: such as "ball.center", all three of its numbers, or "ball.center.x", one of them.
        length: scene units, by which places and points are expected to change at most.

    Raises:
        ValueError: a name that the scene does not have, one that is given twice, or a number
            that has to be above 0 to start from and is not.
    """
    known = dict(_vectors_and_numbers(scene))
    found: dict[Place, Parameter] = {}
    for name in names:
        whole, _, axis = name.rpartition(".")
        if name in known:
            path, axes = known[name], AXES
        elif whole in known and axis in AXES and np.ndim(_leaf(scene, known[whole])):
            path, axes = known[whole], (axis,)
        else:
            allowed = ", ".join((*known, "gain", "black"))
            raise ValueError(
                f"nothing called {name!r} can be free: allowed are {allowed};"
                " of three numbers also one, as in camera.look_from.z"
            )
        for parameter in _parameters(scene, name, path, axes, length):
            if parameter.place in found:
                raise ValueError(f"{parameter.name} is free twice")
            found[parameter.place] = parameter
    return tuple(found.values())


def _vectors_and_numbers(scene: Scene) -> Iterator[tuple[str, tuple[str | int, ...]]]:
    """Names of all that can be free, and where it stands."""
    for field in ("look_from", "look_at", "up", "vertical_fov"):
        yield f"camera.{field}", ("camera", field)
    yield "background.color", ("background", "color")
    for number, obj in enumerate(scene.objects):
        called, path = obj.name or f"object[{number}]", ("objects", number)
        shape = ("center", "radius") if isinstance(obj.shape, Sphere) else ("point", "normal")
        yield from ((f"{called}.{field}", (*path, "shape", field)) for field in shape)
        if isinstance(obj.material, Emitter):
            yield f"{called}.intensity", (*path, "material", "intensity")
        texture = texture_of(obj.material)
        for part in dataclasses.fields(texture) if texture else ():
            yield f"{called}.{part.name}", (*path, "material", "texture", part.name)


def _parameters(
    scene: Scene, name: str, path: tuple[str | int, ...], axes: Sequence[str], length: float
) -> Iterator[Parameter]:
    """The free numbers of one name."""
    if not np.ndim(_leaf(scene, path)):
        place = Place(path, None)
        if place.positive and not float(_leaf(scene, path)) > 0:
            raise ValueError(f"{name} is 0 in the scene: to be free it has to start above 0")
        yield Parameter(name, place, 1.0)
        return
    unit = length if path[-1] in LENGTHS else 1.0
    for axis in axes:
        called = name if name.endswith(f".{axis}") else f"{name}.{axis}"
        yield Parameter(called, Place(path, AXES.index(axis)), unit)


def _leaf(tree: Any, path: tuple[str | int, ...]) -> Any:
    """What stands at a path of a tree."""
    for key in path:
        tree = tree[key] if isinstance(key, int) else getattr(tree, key)
    return tree


def value_at(scene: Scene, place: Place) -> float:
    """The number at a place of a scene."""
    array = np.asarray(_leaf(scene, place.path))
    return float(array if place.component is None else array[place.component])


def with_coordinates(
    scene: Scene,
    places: tuple[Place, ...],
    units: Float[Array, " k"],
    coordinates: Float[Array, " k"],
) -> Scene:
    """The scene with some of its numbers changed; differentiable in the coordinates.

    Args:
        scene: where all coordinates are 0.
        places: of the numbers.
        units: of each, as in `Parameter`.
        coordinates: of each.
    """
    for number, place in enumerate(places):
        old, by = jnp.asarray(_leaf(scene, place.path)), coordinates[number]
        new = (
            old * jnp.exp(by) if place.positive else old.at[place.component].add(units[number] * by)
        )
        scene = eqx.tree_at(partial(_leaf, path=place.path), scene, new)
    return scene
