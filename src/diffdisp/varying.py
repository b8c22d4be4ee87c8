"""How the errors to expect of a glass change with the bench: one thing at a time is varied."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from diffdisp.film import Film, band_middles
from diffdisp.fitting import Uncertainty, expected_uncertainty, glass_object
from diffdisp.geometry import Plane, Sphere
from diffdisp.material import Emitter
from diffdisp.scene import Scene, texture_of
from diffdisp.texture import Checker2D

FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)
"""By which each thing is varied, about the scene's own value; 1 is one of them."""


@dataclass(frozen=True)
class Variation:
    """The errors to expect while one thing is varied and all else is as it is.

    Args:
        quantity: what is varied, in words.
        unit: of its values; may be empty.
        own: its value as it is.
        values: (k,) rising.
        n_d_std: (k,) one standard deviation of n_d.
        V_d_std: (k,) one standard deviation of V_d.
        counted: the power of it by which the number of values in the picture grows.
    """

    quantity: str
    unit: str
    own: float
    values: Float[np.ndarray, " k"]
    n_d_std: Float[np.ndarray, " k"]
    V_d_std: Float[np.ndarray, " k"]
    counted: int = 0

    @property
    def best(self) -> int:
        """Which of the values has the smallest error of n_d; its own where others are no better."""
        return int(np.lexsort((self.values != self.own, self.n_d_std))[0])


@dataclass(frozen=True)
class Bench:
    """What to expect of a bench as it is, and of others like it.

    Args:
        expected: of the bench as it is.
        film: size and bands of the picture.
        variations: how that changes with what can be varied.
        left_out: what cannot, and why, a sentence each.
    """

    expected: Uncertainty
    film: Film
    variations: tuple[Variation, ...]
    left_out: tuple[str, ...]


class Trial(NamedTuple):
    """A bench that differs in one value.

    Args:
        value: of what is varied.
        scene: with that value.
        film: with that value.
    """

    value: float
    scene: Scene
    film: Film


class Range(NamedTuple):
    """What is varied, as in `Variation`, and the benches with each value."""

    quantity: str
    unit: str
    own: float
    trials: tuple[Trial, ...]
    counted: int = 0


def vary_bench(
    scene: Scene,
    size: tuple[int, int],
    bands: tuple[float, float, int] | None,
    *,
    noise: float,
    object_name: str | None = None,
    free: Sequence[str] = (),
    prior: str = "none",
    only_own: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Bench:
    """What to expect of a bench, and how it changes with screen, picture and bands.

    Varied are the distance of the screen, its tiles, the size of the picture and the number of
    bands, by `FACTORS`. The noise of each value of a picture stays the same.

    Args:
        scene: as in `expected_uncertainty`.
        size: width and height of the picture, pixels.
        bands: lowest and highest wavelength in nm, and the number of bands; None for colour.
        noise: as in `expected_uncertainty`.
        object_name: as in `expected_uncertainty`.
        free: as in `expected_uncertainty`.
        prior: as in `expected_uncertainty`.
        only_own: vary nothing.
        progress: called with how many benches are done, and of how many.

    Raises:
        ValueError: as of `expected_uncertainty`.
    """
    left_out: list[str] = []
    number = glass_object(scene, object_name)
    film = Film(*size, None if bands is None else band_middles(*bands))
    ranges: list[Range] = []
    if not only_own:
        ranges += _screens(scene, number, film, left_out)
        ranges += [_sizes(scene, film), *_band_counts(scene, film, bands, left_out)]
    total = 1 + sum(trial.value != some.own for some in ranges for trial in some.trials)
    done = 0

    def expect(scene: Scene, film: Film) -> Uncertainty:
        nonlocal done
        known = expected_uncertainty(
            scene, film, noise=noise, object_name=object_name, free=free, prior=prior
        )
        done += 1
        if progress is not None:
            progress(done, total)
        return known

    expected = expect(scene, film)

    def vary(some: Range) -> Variation:
        known = [
            expected if trial.value == some.own else expect(trial.scene, trial.film)
            for trial in some.trials
        ]
        return Variation(
            some.quantity,
            some.unit,
            some.own,
            np.array([trial.value for trial in some.trials]),
            np.array([each.n_d_std for each in known]),
            np.array([each.V_d_std for each in known]),
            some.counted,
        )

    return Bench(expected, film, tuple(vary(some) for some in ranges), tuple(left_out))


def _screens(scene: Scene, number: int, film: Film, left_out: list[str]) -> Iterator[Range]:
    """The distance and the tiles of the screen, as far as there is one."""
    shining = [
        i
        for i, obj in enumerate(scene.objects)
        if isinstance(obj.shape, Plane) and isinstance(obj.material, Emitter)
    ]
    tiled = [i for i in shining if isinstance(texture_of(scene.objects[i].material), Checker2D)]
    if not shining:
        left_out.append("distance of the screen and tile width: no plane shines")
        return
    screen = (tiled or shining)[0]
    others = len(tiled or shining) - 1
    if others:
        called = scene.objects[screen].name or f"object[{screen}]"
        left_out.append(f"other screens than {called}: {others} stay as they are")
    yield from _distances(scene, number, screen, film, left_out)
    if not tiled:
        left_out.append("tile width: no screen carries a checker2d")
        return
    path = _tile_of(screen)
    own = float(path(scene))
    yield Range(
        "tile width",
        "scene units",
        own,
        tuple(
            Trial(own * factor, eqx.tree_at(path, scene, np.asarray(own * factor)), film)
            for factor in FACTORS
        ),
    )


def _tile_of(number: int) -> Callable[[Scene], Any]:
    """Leads to the tile width of an object."""

    def tile(scene: Scene) -> Any:
        texture = texture_of(scene.objects[number].material)
        assert isinstance(texture, Checker2D)
        return texture.tile

    return tile


def _distances(
    scene: Scene, number: int, screen: int, film: Film, left_out: list[str]
) -> Iterator[Range]:
    """The screen nearer to the ball and farther away, along its normal.

    What it would meet on its way, a sphere or the camera, limits that.
    """
    shape: Any = scene.objects[screen].shape
    ball: Any = scene.objects[number].shape
    point, normal = (np.asarray(v, np.float64) for v in (shape.point, shape.normal))
    normal = normal / np.linalg.norm(normal)
    spheres: list[Any] = [obj.shape for obj in scene.objects if isinstance(obj.shape, Sphere)]
    centers = np.array([*(sphere.center for sphere in spheres), scene.camera.look_from])
    radii = np.array([*(float(sphere.radius) for sphere in spheres), 0.0])
    away = float(normal @ (point - np.asarray(ball.center)))
    trials, met = [], []
    for factor in FACTORS:
        moved = point + (factor - 1) * away * normal
        before, after = ((at - centers) @ normal for at in (point, moved))
        # What the screen cuts or touches as it is, it may.
        free = np.abs(before) > radii
        value = abs(away) * factor
        if np.any(free & ((np.abs(after) <= radii) | (after * before <= 0))):
            met.append(value)
            continue
        there = scene
        if factor != 1:
            there = eqx.tree_at(lambda s: s.objects[screen].shape.point, scene, moved)
        trials.append(Trial(value, there, film))
    if away == 0:
        left_out.append("distance of the screen: the ball's centre lies on it")
        return
    if met:
        values = ", ".join(f"{value:.4g}" for value in met)
        left_out.append(f"distance of the screen {values}: it would meet a ball or the camera")
    yield Range("distance of the screen from the ball", "scene units", abs(away), tuple(trials))


def _sizes(scene: Scene, film: Film) -> Range:
    """Larger and smaller pictures of the same view."""
    widths = sorted({max(1, round(film.width * factor)) for factor in FACTORS})
    return Range(
        "width of the picture",
        "pixels",
        float(film.width),
        tuple(
            Trial(
                float(width),
                scene,
                Film(width, max(1, round(film.height * width / film.width)), film.wavelengths),
            )
            for width in widths
        ),
        counted=2,
    )


def _band_counts(
    scene: Scene,
    film: Film,
    bands: tuple[float, float, int] | None,
    left_out: list[str],
) -> Iterator[Range]:
    """More and fewer bands over the same wavelengths."""
    if bands is None:
        left_out.append("number of bands: the picture is in colour; see --bands")
        return
    low, high, own = bands
    counts = sorted({max(1, round(own * factor)) for factor in FACTORS})
    yield Range(
        "number of bands",
        "",
        float(own),
        tuple(
            Trial(
                float(count), scene, Film(film.width, film.height, band_middles(low, high, count))
            )
            for count in counts
        ),
        counted=1,
    )
