"""What a scene requires: the static choices of a render, printable."""

from dataclasses import dataclass

import jax
import numpy as np

from diffdisp.film import Film
from diffdisp.geometry import Plane, Sphere
from diffdisp.sampling import sample_grid
from diffdisp.scene import Object, Scene, is_glass, object_glass
from diffdisp.texture import Checker2D

WAVELENGTHS_PER_SAMPLE = 8
"""Wavelengths that one film sample carries through glass in a colour picture."""


@dataclass(frozen=True)
class Plan:
    """The static choices: whatever differs here is another compiled program.

    Args:
        samples: film samples per pixel.
        depth: segments a path may have.
        dtype: float32 or float64.
        colour: linear sRGB instead of bands.
        balls: number of glass balls.
        lamps: number of spheres that emit.
        planes: number of planes.
        dispersive: whether any index depends on the wavelength.
        checkered: whether any plane carries a checker.
        nested: whether anything, the camera too, may lie within or across a glass ball.
    """

    samples: int
    depth: int
    dtype: str
    colour: bool
    balls: int
    lamps: int
    planes: int
    dispersive: bool
    checkered: bool
    nested: bool

    @property
    def random(self) -> bool:
        """Whether a path has to choose its branch: both may meet glass again."""
        return self.balls > 1

    @property
    def wavelengths_per_sample(self) -> int:
        """How many wavelengths a colour sample carries; 1 where nothing disperses."""
        return WAVELENGTHS_PER_SAMPLE if self.colour and self.dispersive else 1

    def __str__(self) -> str:
        """The plan in words, a line each."""
        columns, rows = sample_grid(self.samples)
        spectrum = "none: nothing disperses"
        if self.dispersive:
            spectrum = "one path for each band"
        if self.dispersive and self.colour:
            strata = self.samples * self.wavelengths_per_sample
            spectrum = f"{self.wavelengths_per_sample} wavelengths a sample, {strata} strata"
        return "\n".join(
            (
                f"objects    {self.balls} glass, {self.lamps} lamps, {self.planes} planes",
                f"samples    {self.samples} a pixel, {columns} x {rows} grid",
                f"depth      {self.depth} segments" if self.balls else "depth      1: no glass",
                f"dtype      {self.dtype}",
                f"spectrum   {spectrum if self.balls else 'none: no glass'}",
                f"checker    {'over the footprint' if self.checkered else 'not compiled'}",
                f"media      {'nested or overlapping' if self.nested else 'separate balls'}",
                f"branches   {'chosen' if self.random else 'summed, no noise'}",
            )
        )


def make_plan(scene: Scene, film: Film, samples: int, depth: int, dtype: str) -> Plan:
    """What `scene` on `film` requires; of numbers that JAX traces, the general case.

    Raises:
        ValueError: samples or depth below 1.
    """
    if samples < 1 or depth < 1:
        raise ValueError(f"samples {samples}, depth {depth}: both must be at least 1")
    balls = [obj for obj in scene.objects if is_glass(obj)]
    planes = [obj for obj in scene.objects if isinstance(obj.shape, Plane)]
    return Plan(
        samples=samples,
        depth=depth,
        dtype=dtype,
        colour=film.wavelengths is None,
        balls=len(balls),
        lamps=len(scene.objects) - len(balls) - len(planes),
        planes=len(planes),
        dispersive=any(_dispersive(scene, i) for i, o in enumerate(scene.objects) if is_glass(o)),
        checkered=any(_checkered(obj) for obj in planes),
        nested=_nested(scene, balls),
    )


def _known(*leaves: object) -> bool:
    """Whether the numbers can be looked at: not while JAX traces them."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def _dispersive(scene: Scene, index: int) -> bool:
    glass = object_glass(scene, index)
    if not _known(glass.B, glass.C):
        return True
    return bool(np.any((np.asarray(glass.B) != 0) & (np.asarray(glass.C) != 0)))


def _checkered(obj: Object) -> bool:
    return isinstance(getattr(obj.material, "texture", None), Checker2D)


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
