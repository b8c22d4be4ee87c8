"""Random scenes whose numbers spread over many orders of magnitude: what is not as it must be.

Each scene is drawn twice: as it is, with its change along a change of all its numbers, and as a
white furnace, in which all that shines has a radiance of 1 and nothing absorbs. Then no pixel may
show more than 1. Scenes of one kind share one program, which takes long to compile: how many kinds
there are decides how long this takes, not how many scenes. Prints a line of JSON.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import numpy as np

from diffdisp import (
    COMPILER_OPTIONS,
    Background,
    Camera,
    Checker,
    Checker2D,
    Dielectric,
    Emitter,
    Film,
    Lambertian,
    Metal,
    Object,
    Plane,
    Scene,
    Sellmeier,
    Solid,
    Sphere,
    glass_table,
    named_glass,
    render,
)

FILM = Film(6, 6, np.array([0.45, 0.65]))
KNOBS = {"samples": 4, "depth": 20}

KINDS = (
    *("gs", "ggl", "gmcfl"),  # those of tests/test_extremes.py
    *("g", "gl", "gg", "ggs", "gls", "ggg", "s", "l", "ls", ""),
    *("gm", "gc", "gf", "gM", "cf", "ml", "cl", "fl", "gcl", "ggcl", "gMs"),
)
"""Kinds of scenes, a letter for each object: those that `DRAWN` explains."""

SCATTERING = frozenset("mcfM")
"""Letters of what sends paths on by chance: not glass, and not what shines."""

LARGEST = 1.0 + 1e-5
"""Radiance in a white furnace: 1, and rounding in float32."""


@cache
def program(dtype: str) -> Callable[[Scene, Scene], tuple[jax.Array, jax.Array]]:
    """From a scene and a change of it to its picture, and the change of that."""

    def pushed(scene: Scene, change: Scene) -> tuple[jax.Array, jax.Array]:
        of = partial(render, film=FILM, **KNOBS, dtype=dtype)
        return jax.jvp(of, (scene,), (change,))

    return jax.jit(pushed, compiler_options=COMPILER_OPTIONS)


def slanting(scene: Scene) -> Scene:
    """A change of every number of a scene, by about 1."""
    rng = np.random.default_rng(0)

    def step(leaf: np.ndarray) -> np.ndarray:
        return np.asarray(rng.uniform(0.5, 1.5, leaf.shape) * rng.choice([-1.0, 1.0], leaf.shape))

    return jax.tree.map(step, scene)


class Draws:
    """Numbers of one scene. `size` is that of the scene as a whole."""

    def __init__(self, seed: int) -> None:
        """Those of scene number `seed`."""
        self.rng = np.random.default_rng(seed)
        self.size = self.power(4.0)

    def power(self, digits: float) -> float:
        """A number near 1 in half of all cases, else up to so many orders of magnitude off."""
        return float(10.0 ** (self.rng.uniform(-digits, digits) * (self.rng.random() < 0.5)))

    def point(self) -> np.ndarray:
        """A point near the origin, or far off."""
        return np.asarray(self.rng.normal(size=3) * self.size * self.power(3.0))

    def radius(self) -> float:
        """A radius."""
        return float(self.rng.uniform(0.2, 1.5) * self.size * self.power(3.0))

    def color(self) -> np.ndarray:
        """A share of light, which may be 0 or 1."""
        return np.asarray(np.clip(self.rng.uniform(-0.2, 1.2, 3), 0.0, 1.0))

    def radiance(self) -> np.ndarray:
        """A radiance."""
        return self.color() * self.power(10.0)

    def ball(self) -> Sphere:
        """A sphere."""
        return Sphere(self.point(), self.radius())

    def plane(self) -> Plane:
        """A plane, at times along an axis."""
        normal = self.rng.normal(size=3) * self.power(6.0)
        if self.rng.random() < 0.5:
            normal = normal * np.eye(3)[self.rng.integers(3)]
        return Plane(self.point(), normal)

    def glass(self) -> Sellmeier:
        """A glass of the table, or of a constant index; some are air."""
        if self.rng.random() < 0.5:
            glass = named_glass(str(self.rng.choice(list(glass_table()))))
            return Sellmeier(glass.B, glass.C)
        index = 1.0 + self.rng.choice([0.0, 1e-12, 1e-6, 0.01, 0.5, 1.0, 10.0])
        return Sellmeier([index * index - 1.0, 0.0, 0.0], [0.0, 0.0, 0.0])

    def cubes(self, color: Callable[[], np.ndarray]) -> Checker:
        """A 3-D checker."""
        return Checker(color(), color(), 10.0 / self.size * self.power(4.0))

    def tiles(self, color: Callable[[], np.ndarray]) -> Checker2D:
        """A 2-D checker."""
        return Checker2D(color(), color(), 0.5 * self.size * self.power(4.0))

    def camera(self, objects: list[Object]) -> Camera:
        """A camera beside the objects, or within the first sphere, in its centre or on it."""
        look_from = self.point() + self.size * np.array([0.0, 0.0, 4.0])
        look_at = self.rng.normal(size=3) * 0.3 * self.size
        spheres = [obj.shape for obj in objects if isinstance(obj.shape, Sphere)]
        if spheres and self.rng.random() < 0.3:
            out = self.rng.normal(size=3)
            out = out / np.linalg.norm(out) * self.rng.choice([0.0, 1e-9, 0.5, 1.0])
            look_from = spheres[0].center + spheres[0].radius * out
        elif spheres and self.rng.random() < 0.5:
            look_at = np.asarray(spheres[-1].center)
        field = float(self.rng.choice([34.0, 34.0, 34.0, 1e-3, 1.0, 120.0, 179.0]))
        return Camera(look_from, look_at, self.rng.normal(size=3), field)


DRAWN: dict[str, Callable[[Draws], Object]] = {
    "g": lambda d: Object(d.ball(), Dielectric(d.glass())),
    "m": lambda d: Object(d.ball(), Metal(Solid(d.color()), d.rng.choice([0.0, 0.1, 3.0]))),
    "c": lambda d: Object(d.ball(), Lambertian(d.cubes(d.color))),
    "f": lambda d: Object(d.plane(), Lambertian(d.tiles(d.color))),
    "M": lambda d: Object(d.plane(), Metal(d.cubes(d.color), 0.0)),
    "l": lambda d: Object(d.ball(), Emitter(Solid(d.radiance()), d.power(10.0))),
    "s": lambda d: Object(d.plane(), Emitter(d.tiles(d.radiance), d.power(10.0))),
}
"""Glass, metal, chequered matte spheres; matte, metal planes; lamps; screens."""


def random_scene(kinds: str, seed: int) -> Scene:
    """Scene number `seed` of the kinds of objects that the letters stand for."""
    draws = Draws(seed)
    objects = [DRAWN[letter](draws) for letter in kinds]
    return Scene(draws.camera(objects), objects, Background(draws.radiance()))


def whitened(scene: Scene) -> Scene:
    """The scene with all that shines at a radiance of 1, and without absorption."""

    def white(obj: Object) -> Object:
        if isinstance(obj.material, Dielectric):
            return obj
        texture = obj.material.texture
        names = ("color",) if isinstance(texture, Solid) else ("even", "odd")

        def colors(material: Any) -> list[Any]:
            return [getattr(material.texture, name) for name in names]

        material = eqx.tree_at(colors, obj.material, [np.ones(3)] * len(names))
        if isinstance(material, Emitter):
            material = Emitter(material.texture, 1.0)
        return Object(obj.shape, material)

    return Scene(scene.camera, [white(obj) for obj in scene.objects], Background(np.ones(3)))


def faults_of(kinds: str, seed: int, dtype: str) -> Iterator[tuple[str, float]]:
    """What is not as it must be in a scene: the name of each fault, and how large it is."""
    scene = random_scene(kinds, seed)
    for name, of in (("", scene), ("furnace_", whitened(scene))):
        try:
            picture, slope = map(np.asarray, program(dtype)(of, slanting(of)))
        except Exception as error:  # whatever it is, it is to be counted
            yield f"{name}crash: {error}"[:200], 1.0
            continue
        for what, values in (("values", picture), ("slopes", slope)):
            bad = np.mean(~np.isfinite(values))
            if bad:
                yield f"{name}{what}_not_finite", float(bad)
        if name and np.isfinite(picture).all():
            excess = furnace_excess(picture, bool(set(kinds) & SCATTERING))
            if excess > 0:
                yield "furnace_excess", excess


def furnace_excess(picture: np.ndarray, scatters: bool) -> float:
    """By how much a picture of a white furnace shows more light than there is; 0 or less if not.

    Where ways are chosen by chance one of them may count more than 1: then it is the mean that
    must not be above 1, by five standard errors. Both bands draw the same numbers. Most samples
    count a little more than 1 there for a few that count far less: an error of so few pixels that
    have none of those is taken for no less than 0.01.
    """
    if not scatters:
        return float(picture.max() - LARGEST)
    error = max(picture.std() / np.sqrt(picture[..., 0].size), 0.01)
    return float(picture.mean() - 5.0 * error - LARGEST)


def search(
    kinds: tuple[str, ...], scenes: int, dtypes: tuple[str, ...], seed: int
) -> dict[str, Any]:
    """Draw so many scenes of the kinds in turn; how many of them have which fault."""
    counts: dict[str, int] = {}
    found: list[tuple[str, str, int, str, float]] = []
    worst = 0.0
    for number in range(scenes):
        kind = kinds[number % len(kinds)]
        for dtype in dtypes:
            for fault, size in faults_of(kind, seed + number, dtype):
                name = fault.partition(":")[0]
                counts[name] = counts.get(name, 0) + 1
                found.append((fault, kind, seed + number, dtype, size))
                worst = max(worst, size if name == "furnace_excess" else 0.0)
    drawn = scenes * len(dtypes)
    return {"drawn": drawn, "faults": counts, "largest_excess": worst, "found": found}


def main() -> None:
    """Print what was found as a line of JSON; exit status 1 where that is anything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", type=int, default=4, help=f"of scenes, {len(KINDS)} at most")
    parser.add_argument("--first", type=int, default=0, help="number of the first kind")
    parser.add_argument("--scenes", type=int, default=400, help="of all kinds together")
    parser.add_argument("--seed", type=int, default=0, help="number of the first scene")
    parser.add_argument("--dtype", choices=("float32", "float64"), help="both by default")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    kinds = KINDS[options.first : options.first + options.kinds]
    dtypes = (options.dtype,) if options.dtype else ("float32", "float64")
    start = time.perf_counter()
    result = search(kinds, options.scenes, dtypes, options.seed)
    seconds = round(time.perf_counter() - start, 1)
    print(json.dumps({"kinds": kinds, "seconds": seconds, **result}))
    raise SystemExit(bool(result["faults"]))


if __name__ == "__main__":
    main()
