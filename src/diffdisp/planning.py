"""What a scene requires: the static choices of a render, printable."""

from collections import Counter
from dataclasses import dataclass

import jax
import numpy as np

from diffdisp.film import Film
from diffdisp.geometry import Plane, Sphere
from diffdisp.material import Emitter, Lambertian, Material, Metal
from diffdisp.sampling import sample_grid
from diffdisp.scene import Object, Scene, is_glass, object_glass, texture_of
from diffdisp.texture import Checker, Checker2D, Texture

WAVELENGTHS_PER_SAMPLE = 8
"""Wavelengths that one film sample carries through glass in a colour picture."""

SCATTERED_WAVELENGTHS = 2
"""The same where paths go on from matte or metal surfaces: beside that of a path for all."""


@dataclass(frozen=True)
class Plan:
    """The static choices: whatever differs here is another compiled program.

    Surfaces are numbered by what happens to a path that meets them. First those that send it on:
    glass balls, metal spheres, matte spheres, matte planes, metal planes; then those that end it:
    lamps, shining planes; one past the last is the background.

    Args:
        samples: film samples per pixel.
        depth: segments a path may have.
        dtype: float32 or float64.
        bands: number of bands; 0 for linear sRGB.
        balls: number of glass balls.
        metal_spheres: number of metal spheres.
        matte_spheres: number of matte spheres.
        matte_planes: number of matte planes.
        metal_planes: number of metal planes.
        lamps: number of spheres that emit.
        screens: number of planes that emit.
        dispersive: whether any index depends on the wavelength.
        tiled: whether any plane carries a `Checker2D`: one that sends paths on, one that emits.
        cubed: the same of a `Checker`, on any surface.
        fuzzy: whether any metal is not smooth.
        nested: whether anything, the camera too, may lie within or across a glass ball.
        soft: whether a ball's outline is averaged over footprints, as what moves it asks for.
        fine: whether a sphere is so large beside what is near it that float32 has to take its
            distances with more digits than its own.
        filtered: whether what a path meets before anything scatters it is averaged over its
            footprint although paths scatter, as derivatives ask for.
    """

    samples: int
    depth: int
    dtype: str
    bands: int
    balls: int
    metal_spheres: int
    matte_spheres: int
    matte_planes: int
    metal_planes: int
    lamps: int
    screens: int
    dispersive: bool
    tiled: tuple[bool, bool]
    cubed: tuple[bool, bool]
    fuzzy: bool
    nested: bool
    fine: bool = False
    soft: bool = False
    filtered: bool = False

    @property
    def first_plane(self) -> int:
        """Number of the first plane that sends paths on; below it are spheres."""
        return self.balls + self.metal_spheres + self.matte_spheres

    @property
    def first_lamp(self) -> int:
        """Number of the first surface that ends paths."""
        return self.first_plane + self.matte_planes + self.metal_planes

    @property
    def background(self) -> int:
        """The background's number: that of the surfaces."""
        return self.first_lamp + self.lamps + self.screens

    @property
    def spheres(self) -> int:
        """How many surfaces are spheres."""
        return self.first_plane + self.lamps

    @property
    def planes(self) -> int:
        """How many surfaces are planes."""
        return self.background - self.spheres

    @property
    def mattes(self) -> tuple[int, int]:
        """Numbers of the first matte surface, and of the first one after the last."""
        first = self.balls + self.metal_spheres
        return first, first + self.matte_spheres + self.matte_planes

    @property
    def metals(self) -> int:
        """How many surfaces are metal."""
        return self.metal_spheres + self.metal_planes

    @property
    def scattering(self) -> bool:
        """Whether paths go on from anything but glass; then none of their branches are summed."""
        return self.first_lamp > self.balls

    @property
    def cut(self) -> bool:
        """Whether the camera's footprints are cut in two along the outlines of balls.

        Paths that scatter are points at the camera, or choose one of both sides; soft outlines have
        no other side; and of balls within or across each other an outline may be no border at all.
        """
        among_others = self.nested and self.balls > 1
        return self.balls > 0 and not (self.scattering or self.soft or among_others)

    @property
    def lit(self) -> bool:
        """Whether lamps are sampled directly: there are some, and something for them to light."""
        first, last = self.mattes
        return self.lamps > 0 and last > first

    @property
    def numbers_per_bounce(self) -> int:
        """How many random numbers a bounce may ask for."""
        if self.lit:
            return 5
        if self.fuzzy:
            return 3
        first, last = self.mattes
        return 2 if last > first else int(self.random)

    @property
    def random(self) -> bool:
        """Whether a path has to choose: its branch, or a direction of many."""
        first, last = self.mattes
        if last > first or self.fuzzy:
            return True
        return self.balls > (0 if self.scattering else 1)

    @property
    def wavelengths_per_sample(self) -> int:
        """How many wavelengths a colour sample carries; 1 where nothing disperses."""
        if self.bands or not self.dispersive:
            return 1
        return SCATTERED_WAVELENGTHS if self.scattering else WAVELENGTHS_PER_SAMPLE

    @property
    def channels(self) -> int:
        """Numbers that a path carries: one where each band has paths of its own."""
        if self.bands and self.dispersive:
            return 1
        return self.bands if self.bands and self.scattering else 3

    def __str__(self) -> str:
        """The plan in words, a line each."""
        columns, rows = sample_grid(self.samples)
        spectrum = "none: nothing disperses" if self.balls else "none: no glass"
        if self.dispersive:
            spectrum = "one path for each band"
        if self.dispersive and not self.bands:
            strata = self.samples * self.wavelengths_per_sample
            spectrum = f"{self.wavelengths_per_sample} wavelengths a sample, {strata} strata"
        first, last = self.mattes
        counts = {
            "glass": self.balls,
            "matte": last - first,
            "metal": self.metals,
            "lamp" if self.lamps == 1 else "lamps": self.lamps,
            "shining plane" if self.screens == 1 else "shining planes": self.screens,
        }
        shown = [name for name, there in (("2-D", self.tiled), ("3-D", self.cubed)) if any(there)]
        # Where branches are chosen the samples are points; else they stand for their footprint.
        checker = "at points" if self.scattering else "over the footprint"
        branches = "chosen" if self.random else "none" if self.scattering else "summed, no noise"
        bouncing = self.first_lamp > 0
        lines = {
            "objects": ", ".join(f"{n} {kind}" for kind, n in counts.items() if n) or "none",
            "samples": f"{self.samples} a pixel, {columns} x {rows} grid",
            "depth": f"{self.depth} segments" if bouncing else "1: nothing sends light on",
            "dtype": f"{self.dtype}{', distances with more digits' if self.fine else ''}",
            "spectrum": spectrum,
            "checker": f"{' and '.join(shown)}, {checker}" if shown else "not compiled",
            "media": "nested or overlapping" if self.nested else "separate balls",
            "branches": branches,
            "lamps": "sampled directly" if self.lit else "found by chance",
        }
        if not self.balls:
            del lines["media"]
        if not self.lamps or not self.scattering:
            del lines["lamps"]
        return "\n".join(f"{name:<11}{text}" for name, text in lines.items())


def make_plan(scene: Scene, film: Film, samples: int, depth: int, dtype: str) -> Plan:
    """What `scene` on `film` requires; of numbers that JAX traces, the general case.

    Raises:
        ValueError: samples or depth below 1.
    """
    if samples < 1 or depth < 1:
        raise ValueError(f"samples {samples}, depth {depth}: both must be at least 1")
    balls = [obj for obj in scene.objects if is_glass(obj)]
    kinds = Counter((type(obj.material), type(obj.shape)) for obj in scene.objects)
    return Plan(
        samples=samples,
        depth=depth,
        dtype=dtype,
        bands=0 if film.wavelengths is None else film.channels,
        balls=len(balls),
        metal_spheres=kinds[Metal, Sphere],
        matte_spheres=kinds[Lambertian, Sphere],
        matte_planes=kinds[Lambertian, Plane],
        metal_planes=kinds[Metal, Plane],
        lamps=kinds[Emitter, Sphere],
        screens=kinds[Emitter, Plane],
        dispersive=any(_dispersive(scene, i) for i, o in enumerate(scene.objects) if is_glass(o)),
        tiled=_carried(scene, Checker2D),
        cubed=_carried(scene, Checker),
        fuzzy=any(_fuzzy(obj.material) for obj in scene.objects),
        nested=_nested(scene, balls),
        fine=dtype == "float32" and _large(scene),
    )


LARGE = 50.0
"""Radius of a sphere over that of another, or over the camera's distance from it, from which on it
is large: on a chequered ground of radius 100 float32 rounds so many points to the other side of a
border that the picture is 2.4e-3 off, root mean square (`benchmarks/precision.py`), with more
digits 0.6e-3. From 1 above one of 1e3 distances are 2e-5 off, at worst 1.4e-4, and ten times that
for each ten times its radius. More digits take 7 to 12 % more time in the gallery."""


def _large(scene: Scene) -> bool:
    """Whether a sphere is very much larger than another, or than the camera is away from it."""
    spheres = [obj.shape for obj in scene.objects if isinstance(obj.shape, Sphere)]
    if not spheres or not _known(scene.camera.look_from, *jax.tree.leaves(spheres)):
        return False
    radii = np.array([float(np.asarray(sphere.radius)) for sphere in spheres])
    centers = np.stack([np.asarray(sphere.center, np.float64) for sphere in spheres])
    apart = np.linalg.norm(centers - np.asarray(scene.camera.look_from, np.float64), axis=-1)
    least = np.minimum(radii.min(), np.abs(apart - radii))
    return bool(np.any(radii > LARGE * least))


def _known(*leaves: object) -> bool:
    """Whether the numbers can be looked at: not while JAX traces them."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def _dispersive(scene: Scene, index: int) -> bool:
    glass = object_glass(scene, index)
    if not _known(glass.B, glass.C):
        return True
    return bool(np.any((np.asarray(glass.B) != 0) & (np.asarray(glass.C) != 0)))


def _carried(scene: Scene, kind: type[Texture]) -> tuple[bool, bool]:
    """Whether any surface that sends paths on carries a texture, and whether any emitter does."""
    carriers = {
        isinstance(obj.material, Emitter)
        for obj in scene.objects
        if isinstance(texture_of(obj.material), kind)
    }
    return False in carriers, True in carriers


def _fuzzy(material: Material) -> bool:
    if not isinstance(material, Metal):
        return False
    return not _known(material.fuzz) or bool(np.asarray(material.fuzz) > 0)


def _nested(scene: Scene, balls: list[Object]) -> bool:
    """Whether any object or the camera lies in, across or against a glass ball."""
    leaves = [leaf for obj in scene.objects for leaf in jax.tree.leaves(obj.shape)]
    if not _known(scene.camera.look_from, *leaves):
        return bool(balls)
    return any(
        _camera_within(scene, ball) or any(_meets(ball, o) for o in scene.objects if o is not ball)
        for ball in balls
    )


def _camera_within(scene: Scene, ball: Object) -> bool:
    assert isinstance(ball.shape, Sphere)
    distance = np.linalg.norm(np.asarray(scene.camera.look_from) - np.asarray(ball.shape.center))
    return bool(distance <= np.asarray(ball.shape.radius) * (1 + 1e-6))


def _meets(ball: Object, other: Object) -> bool:
    """Whether `other` comes nearer to the ball's middle than its surface, with a margin."""
    assert isinstance(ball.shape, Sphere)
    center, radius = np.asarray(ball.shape.center), float(np.asarray(ball.shape.radius))
    if isinstance(other.shape, Plane):
        normal = np.asarray(other.shape.normal)
        offset = (np.asarray(other.shape.point) - center) @ normal
        return bool(abs(offset) / np.linalg.norm(normal) <= radius * (1 + 1e-6))
    apart = np.linalg.norm(np.asarray(other.shape.center) - center)
    if not is_glass(other) and np.asarray(other.shape.radius) - apart > radius * (1 + 1e-6):
        return False  # a hollow lamp around the ball
    gap = apart - np.asarray(other.shape.radius)
    return bool(gap <= radius * (1 + 1e-6))
