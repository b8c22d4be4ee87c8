"""Scenes and closed forms that several tests share. The closed forms are NumPy's, in float64."""

from collections.abc import Sequence

import numpy as np

from diffdisp.camera import Camera
from diffdisp.chunks import (
    all_pixels,
    chunk_pixels,
    film_size,
    film_spectrum,
    over_chunks,
    render_chunks_jit,
    run_numbers,
)
from diffdisp.dispersion import Sellmeier
from diffdisp.film import Film
from diffdisp.geometry import Plane, Sphere
from diffdisp.material import Dielectric, Emitter, Lambertian, Material, Metal
from diffdisp.planning import make_plan
from diffdisp.scene import Background, Object, Scene, without_names
from diffdisp.texture import Checker2D
from diffdisp.vector import Vec3

WHITE = (1.0, 1.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0)
N_D = 1.516800
"""N-BK7 at the d line. Source: Schott data sheet."""


def glass_of_index(n: float) -> Sellmeier:
    """A glass without dispersion: C = 0 makes each term the constant B."""
    return Sellmeier([n * n - 1.0, 0.0, 0.0], [0.0, 0.0, 0.0])


AIR = glass_of_index(1.0)
BK7 = Sellmeier([1.03961212, 0.231792344, 1.01046945], [0.00600069867, 0.0200179144, 103.560653])
"""N-BK7 without its name, which a scene's structure would hold. Source: Schott data sheet."""


def ball(
    glass: Sellmeier | str | float,
    center: Sequence[float] = ORIGIN,
    radius: float = 1.0,
    name: str = "",
) -> Object:
    """A ball of a glass, of a named glass, or of a constant index."""
    glass = glass_of_index(glass) if isinstance(glass, float) else glass
    return Object(Sphere(center, radius), Dielectric(glass), name)


def lamp(center: Sequence[float], radius: float, color: Sequence[float] = WHITE) -> Object:
    """A shining sphere."""
    return Object(Sphere(center, radius), Emitter(color))


def matte(albedo: float, center: Sequence[float] = ORIGIN, radius: float = 1.0) -> Object:
    """A grey matte sphere."""
    return Object(Sphere(center, radius), Lambertian([albedo] * 3))


def metal(
    share: float, center: Sequence[float] = ORIGIN, radius: float = 1.0, fuzz: float = 0.0
) -> Object:
    """A grey metal sphere."""
    return Object(Sphere(center, radius), Metal([share] * 3, fuzz=fuzz))


def ground(material: Material, y: float = -1.0) -> Object:
    """A level plane."""
    return Object(Plane([0.0, y, 0.0], [0.0, 1.0, 0.0]), material)


def screen(z: float = -3.1, tile: float = 0.5, even: float = 0.1, odd: float = 1.0) -> Object:
    """A plane across the z axis that shines in a checker pattern."""
    texture = Checker2D([even] * 3, [odd] * 3, tile)
    return Object(Plane([0.0, 0.0, z], [0.0, 0.0, 1.0]), Emitter(texture), "screen")


def camera(look_from: Sequence[float] = (0, 0, 4), vertical_fov: float = 34.0) -> Camera:
    """A camera that looks at the origin."""
    return Camera(look_from, ORIGIN, vertical_fov=vertical_fov)


def bench(glass: Sellmeier | str = BK7, tile: float = 0.5, vertical_fov: float = 34.0) -> Scene:
    """The optical bench of fixtures/scenes/bench_nbk7.toml."""
    objects = (ball(glass, name="ball"), screen(tile=tile))
    return Scene(camera(vertical_fov=vertical_fov), objects)


def furnace(
    *objects: Object,
    look_from: Sequence[float] = (0, 0, 4),
    vertical_fov: float = 34.0,
    color: Sequence[float] = WHITE,
) -> Scene:
    """The objects before a background that shines alike from everywhere."""
    return Scene(camera(look_from, vertical_fov), objects, Background(color))


def numbers(vector: Vec3) -> np.ndarray:
    """The vector's components in the last axis."""
    return np.stack([np.asarray(component) for component in vector], axis=-1)


def reflectance(incidence: np.ndarray, n: np.ndarray | float) -> np.ndarray:
    """Unpolarised reflectance at an angle of incidence > 0, from sines and tangents.

    Source: Born and Wolf, Principles of Optics (7th ed.), section 1.5.2, eq. 21.
    """
    refraction = np.arcsin(np.sin(incidence) / n)
    s = np.sin(incidence - refraction) / np.sin(incidence + refraction)
    p = np.tan(incidence - refraction) / np.tan(incidence + refraction)
    return 0.5 * (s**2 + p**2)


def incidence_on_unit_ball(film: Film, distance: float, vertical_fov: float) -> np.ndarray:
    """Angle (height, width) at which the middle ray of each pixel meets the unit ball.

    The camera looks at the ball's centre from `distance`. NaN where the ball is missed.
    """
    pixel = 2.0 * np.tan(np.radians(vertical_fov) / 2.0) / film.height
    x = (np.arange(film.width) + 0.5 - film.width / 2.0) * pixel
    y = (np.arange(film.height) + 0.5 - film.height / 2.0) * pixel
    off_axis = np.hypot(*np.meshgrid(x, y))
    impact = distance * off_axis / np.hypot(off_axis, 1.0)
    return np.arcsin(np.where(impact < 1.0, impact, np.nan))


def part_in_unit_ball(film: Film, distance: float, vertical_fov: float) -> np.ndarray:
    """Part (height, width) of each pixel that sees the ball of `incidence_on_unit_ball`."""
    return _in_unit_ball(film, 200, distance, vertical_fov).mean(axis=(1, 3))


def whole_samples(film: Film, across: int, distance: float, vertical_fov: float) -> np.ndarray:
    """Pixels (height, width) of which that ball's outline cuts no sample, of `across` squared."""
    fine = Film(film.width * across, film.height * across)
    seen = _in_unit_ball(fine, 100, distance, vertical_fov)
    whole = seen.min(axis=(1, 3)) == seen.max(axis=(1, 3))
    return whole.reshape(film.height, across, film.width, across).all(axis=(1, 3))


def _in_unit_ball(film: Film, points: int, distance: float, vertical_fov: float) -> np.ndarray:
    """Whether points (height, points, width, points) of a film see the ball."""
    fine = Film(film.width * points, film.height * points)
    seen = ~np.isnan(incidence_on_unit_ball(fine, distance, vertical_fov))
    return seen.reshape(film.height, points, film.width, points)


def deviation(incidence: float, n: float, order: int) -> float:
    """D_p = 2(i - r) + p(π - 2r): p = 0 is straight through, p = -1 the outer reflection."""
    refraction = np.arcsin(np.sin(incidence) / n)
    return 2.0 * (incidence - refraction) + order * (np.pi - 2.0 * refraction)


def direct(
    scene: Scene, film: Film, *, samples: int, depth: int, seed: int = 0, dtype: str = "float64"
) -> np.ndarray:
    """The picture by the loop that fits and transformations use, for any scene."""
    plan = make_plan(scene, film, samples, depth, dtype)
    pixels, place = all_pixels(film, chunk_pixels(film, plan))
    fixed = plan, without_names(scene), film_spectrum(film, plan, seed), film_size(film)
    run = run_numbers(plan, seed)
    values = over_chunks(
        lambda part: np.asarray(render_chunks_jit(*fixed, part, run)), pixels, dtype
    )
    return values.reshape(-1, film.channels)[place].reshape(film.height, film.width, film.channels)
