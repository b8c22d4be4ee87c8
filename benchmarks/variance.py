"""What noise costs: the variance of a pixel times the time of the picture.

Through glass: the scene *dispersion* against itself with glass of a constant index, over the
pixels that the ball covers. Lamps: *lamps* and *default* with lamps sampled directly against the
same found by chance alone, over all pixels. The two pictures of a pair are drawn in turn, each
pair of the same seed, and their ratio of times is the median over the pairs.
"""

import argparse
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any
from unittest import mock

import jax
import numpy as np
from record import ROOT, print_table, write_record

from diffdisp import Film, Scene, Sellmeier, Sphere, load_scene, programs, render, with_glass
from diffdisp.dispersion import LINE_D
from diffdisp.planning import Plan

Draw = Callable[[int], np.ndarray]


def gallery_scene(name: str) -> Scene:
    """A scene of the gallery."""
    return load_scene(str(ROOT / "fixtures/scenes" / f"{name}.toml"))


def glass_number(scene: Scene) -> int:
    """Number of the scene's only glass object."""
    (number,) = (i for i, obj in enumerate(scene.objects) if hasattr(obj.material, "glass"))
    return number


def without_dispersion(scene: Scene) -> Scene:
    """The scene with glass that has its index at the d line everywhere."""
    number = glass_number(scene)
    n_d = float(scene.objects[number].material.glass.indices(np.array([LINE_D]))[0])
    return with_glass(scene, number, Sellmeier([n_d**2 - 1, 0, 0], [0, 0, 0]))


def sphere_pixels(scene: Scene, sphere: Sphere, film: Film) -> np.ndarray:
    """Mask (height, width) of the pixels whose middle shows a sphere that nothing hides."""
    camera = scene.camera
    forward = np.asarray(camera.look_at) - np.asarray(camera.look_from)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right = right / np.linalg.norm(right)
    pixel = 2 * np.tan(np.radians(camera.vertical_fov) / 2) / film.height
    y, x = np.mgrid[: film.height, : film.width] + 0.5
    across, down = (x - film.width / 2) * pixel, (y - film.height / 2) * pixel
    ray = forward + across[..., None] * right - down[..., None] * np.cross(right, forward)
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    offset = np.asarray(sphere.center) - np.asarray(camera.look_from)
    along = ray @ offset
    return (offset @ offset - along**2 < sphere.radius**2) & (along > 0)


def compare(first: Draw, second: Draw, mask: np.ndarray, runs: int) -> dict[str, float]:
    """Variance, time and their product of the first way over those of the second."""
    first(0), second(0)  # compiles
    pictures: list[list[np.ndarray]] = [[], []]
    seconds: list[list[float]] = [[], []]
    for seed in range(runs):
        for way, draw in enumerate((first, second)):
            start = time.perf_counter()
            pictures[way].append(draw(seed)[mask])
            seconds[way].append(time.perf_counter() - start)
    variances = [float(np.var(np.array(p), axis=0, ddof=1).mean()) for p in pictures]
    ratio = float(np.median(np.array(seconds[0]) / np.array(seconds[1])))
    return {
        "variance": variances[0],
        "variance_ratio": variances[0] / variances[1],
        "seconds": float(np.median(seconds[0])),
        "time_ratio": ratio,
        "at_equal_time": variances[0] / variances[1] * ratio,
    }


def main() -> None:
    """Print and record both comparisons."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=12, help="pictures of each way")
    parser.add_argument("--samples", type=int, default=16, help="per pixel")
    options = parser.parse_args()
    film = Film(480, 360)

    def drawing(scene: Scene, **patched: Any) -> Draw:
        own: dict[Any, Any] = {}  # a patched plan is equal to another, its program is not

        def draw(seed: int) -> np.ndarray:
            if not own:
                jax.clear_caches()
            with (
                mock.patch.object(programs, "_READY", own),
                mock.patch.multiple(Plan, **patched) if patched else nullcontext(),
            ):
                return render(scene, film, samples=options.samples, seed=seed, dtype="float32")

        return draw

    figures = {}
    scene = gallery_scene("dispersion")
    ball = sphere_pixels(scene, scene.objects[glass_number(scene)].shape, film)
    dispersive, constant = drawing(scene), drawing(without_dispersion(scene))
    figures["dispersion, in the ball"] = compare(dispersive, constant, ball, options.runs)
    figures["dispersion, beside it"] = compare(dispersive, constant, ~ball, options.runs)
    for name in ("lamps", "default"):
        scene = gallery_scene(name)
        direct, chance = drawing(scene), drawing(scene, lit=False)
        everywhere = np.ones((film.height, film.width), bool)
        figures[f"{name}, lamps directly"] = compare(direct, chance, everywhere, options.runs)
    head = ("against constant index, or chance", "variance", "ratio", "s", "ratio", "equal time")
    print_table(head, [(name, *row.values()) for name, row in figures.items()])
    write_record("variance", vars(options), figures)


if __name__ == "__main__":
    main()
