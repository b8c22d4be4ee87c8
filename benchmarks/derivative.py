"""How right the derivative of the bench's picture in the index is, and what it costs.

The measure is another picture, computed here in closed form and without any filter: a ball on the
camera's axis keeps each ray in the plane through that axis, so a ray leaves it after p internal
reflections turned by D_p, as far from the centre as it came, and meets the screen at a radius
that needs no tracing. Its central differences in n are those of hard edges. Points that jump
over an edge are few, so they are noisy; but two pictures A and B of different points make
independent errors, and the mean of (S - A)(S - B) has none of either's noise in it.

Of the outline of a lamp that is seen through the ball, the measure is central differences of
renders of so many samples that a step crosses several of each pixel on the outline. Where paths
scatter, it is those of `hard_ground`, which draws none by chance.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from datetime import date
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from hard_ground import HardGround
from record import ROOT, machine, print_table, recorded, write_record

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
    Object,
    Plane,
    Scene,
    Sellmeier,
    Sphere,
    band_middles,
    load_scene,
    named_glass,
    render,
    with_glass,
)

BENCH = ROOT / "fixtures/scenes/bench_nbk7.toml"
BALL, SCREEN = 0, 1
"""Numbers of the objects of the bench; a matte ground under the ball has the screen's."""
WAVELENGTH = 0.55
"""The band whose derivative is compared, µm."""
NEGLECTED = 1e-9
"""Part of its light with which a ray of the closed form ends."""
MOST_ORDERS = 2000
"""For rays so close to grazing that they hardly lose light: fewer than one in a million."""
OUTLINE_SAMPLES, OUTLINE_STEP = (1600, 2116), 2e-3
"""Of the pictures whose differences tell how a lamp's outline moves, and the step in n."""
SCATTERED_SIZE, SCATTERED_STEP = 48, 1.25e-4
"""Of the pictures whose differences tell how the edges of a matte ground move, and the step: with
one of 5e-4 images next to the rim move so far that the square of what such differences are off is
0.001 of theirs, as much as the derivative's own."""
SCATTERED_PARTS, SCATTERED_ENOUGH = 256, 0.01
"""Of a pixel's edge, the finest; and the change of the differences below which that is enough."""
PLASTIC = 1.32471795724474602596
"""Root of x³ = x + 1, for evenly spread points. Source: Roberts, The unreasonable effectiveness
of quasirandom sequences (2018)."""


# The picture in closed form.


def fresnel(incidence: np.ndarray, refraction: np.ndarray) -> np.ndarray:
    """Unpolarised reflectance from outside.

    Source: Born and Wolf, Principles of Optics (7th ed.), section 1.5.2, eq. 21.
    """
    total, difference = incidence + refraction, incidence - refraction
    s = np.sin(difference) / np.sin(total)
    p = np.tan(difference) / np.tan(total)
    return 0.5 * (s**2 + p**2)


class HardBench:
    """The bench of a unit ball at the origin, as numbers."""

    def __init__(self, scene: Scene) -> None:
        """Take the numbers of `scene`, which has to be such a bench."""
        ball, screen = (scene.objects[i] for i in (BALL, SCREEN))
        camera, texture = scene.camera, screen.material.texture
        placed = (*ball.shape.center, *camera.look_at, *camera.look_from[:2])
        assert ball.shape.radius == 1, "the ball must be of radius 1"
        assert not np.any(placed), "ball and camera must be on the z axis"
        self.distance = float(camera.look_from[2])
        self.edge = float(np.tan(np.radians(camera.vertical_fov) / 2))
        self.screen = float(screen.shape.point[2])
        self.tile = float(texture.tile)
        self.mean = float(texture.even[0] + texture.odd[0]) / 2
        self.half = float(texture.even[0] - texture.odd[0]) / 2

    def picture(self, n: float, size: int, points: int, seed: int) -> np.ndarray:
        """Radiance (size, size) through the ball, 0 beside it.

        Args:
            n: index of the ball.
            size: pixels of an edge, even.
            points: of each pixel.
            seed: of where each pixel's points begin.
        """
        assert size % 2 == 0, "the picture is put together from quadrants"
        quadrant = np.stack([self._row(n, row, size, points, seed) for row in range(size // 2)])
        # (row, column, 2) from the middle: light, and light times the sign of its tile, which
        # changes its own sign in the mirror.
        right, lower = quadrant * [1, 1], quadrant * [1, -1]
        below = np.concatenate([lower[:, ::-1], right], axis=1)
        above = np.concatenate([right[::-1, ::-1], lower[::-1]], axis=1)
        return np.concatenate([above, below], axis=0) @ [self.mean, self.half]

    def _row(self, n: float, row: int, size: int, points: int, seed: int) -> np.ndarray:
        """One row (size/2, 2) of the quadrant to the lower right."""
        shift = np.random.default_rng([points, seed, row]).random((2, size // 2, 1))
        numbers = np.arange(points)
        across, down = ((shift[k - 1] + numbers / PLASTIC**k) % 1 for k in (1, 2))
        pixel = 2 * self.edge / size
        x = (np.arange(size // 2)[:, None] + across) * pixel
        y = np.broadcast_to((row + down) * pixel, x.shape)
        off_axis = np.hypot(x, y)
        angle = np.arctan(off_axis)
        hit = self.distance * np.sin(angle) < 1
        light = np.zeros((*x.shape, 2))
        light[hit] = self._rays(n, angle[hit], x[hit] / off_axis[hit], -y[hit] / off_axis[hit])
        return light.mean(axis=1)

    def _rays(self, n: float, angle: np.ndarray, cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
        """Light (rays, 2) of rays at `angle` to the axis, in the plane towards (cos, sin)."""
        incidence = np.arcsin(self.distance * np.sin(angle))
        refraction = np.arcsin(np.sin(incidence) / n)
        reflected = fresnel(incidence, refraction)
        light = self._screen(angle, angle + np.pi - 2 * incidence, cos, sin, reflected)
        leaving = angle - 2 * (incidence - refraction)
        weight, rays = (1 - reflected) ** 2, np.arange(len(angle))
        for _ in range(MOST_ORDERS):
            light[rays] += self._screen(angle[rays], leaving, cos[rays], sin[rays], weight)
            leaving = leaving - (np.pi - 2 * refraction[rays])
            weight = weight * reflected[rays]
            kept = weight > NEGLECTED * (1 - reflected[rays])  # all orders that are left
            rays, leaving, weight = rays[kept], leaving[kept], weight[kept]
            if not len(rays):
                break
        return light

    def _screen(
        self,
        angle: np.ndarray,
        leaving: np.ndarray,
        cos: np.ndarray,
        sin: np.ndarray,
        weight: np.ndarray,
    ) -> np.ndarray:
        """Light (rays, 2) of rays that leave at angle `leaving` to the axis."""
        impact, along = self.distance * np.sin(angle), np.cos(leaving)
        meets = along > 1e-9
        radius = (impact - self.screen * np.sin(leaving)) / np.where(meets, along, 1.0)
        tiles = np.floor(radius * cos / self.tile) + np.floor(radius * sin / self.tile)
        arriving = np.where(meets, weight, 0.0)
        return np.stack([arriving, np.where(tiles % 2 == 0, arriving, -arriving)], axis=-1)

    def slopes(self, n: float, step: float, size: int, grid: int) -> np.ndarray:
        """Central differences (2, size, size) in n, each of grid² points a pixel of its own."""

        def slope(half: int) -> np.ndarray:
            more, less = (self.picture(n + s, size, grid**2, half) for s in (step, -step))
            return (more - less) / (2 * step)

        return np.stack([slope(half) for half in range(2)])


def apart(found: np.ndarray, pair: np.ndarray) -> float:
    """Relative L2 difference from what a noisy pair agrees on; negative where noise hides it."""
    square = np.sum(np.prod(found - pair, axis=0)) / np.sum(np.prod(pair, axis=0))
    return float(np.copysign(np.sqrt(np.abs(square)), square))


def noise(pair: np.ndarray) -> float:
    """Relative L2 error of each of a pair."""
    return float(np.sqrt(np.sum((pair[0] - pair[1]) ** 2) / 2 / np.sum(np.prod(pair, axis=0))))


# The derivative of the render.


def index_picture(
    scene: Scene, size: int, samples: int, seed: int = 0
) -> Callable[[Any], jax.Array | np.ndarray]:
    """The picture (size, size) of one band, in float64, as a function of the index."""
    film = Film(size, size, np.array([WAVELENGTH]))

    def picture(n: Any) -> jax.Array | np.ndarray:
        B = jnp.zeros(3).at[0].set(n * n - 1)  # with C = 0 a glass of index n everywhere
        glass = Sellmeier(B, jnp.zeros(3))
        seen = with_glass(scene, BALL, glass)
        return render(seen, film, samples=samples, seed=seed, dtype="float64")[..., 0]

    return picture


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    """Relative L2 difference over the whole picture."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def accuracy(scene: Scene, options: argparse.Namespace) -> dict[str, Any]:
    """The derivative against both kinds of central differences."""
    n = float(scene.objects[BALL].material.glass.refractive_index(np.asarray(WAVELENGTH)))
    bench = HardBench(scene)
    variants = [
        (step, grid) for grid in sorted(options.grids) for step in sorted(options.steps)[::-1]
    ]
    start = time.perf_counter()
    hard = [bench.slopes(n, step, options.size, grid) for step, grid in variants]
    seconds = time.perf_counter() - start
    best = hard[-1]
    rendered = [_rendered(scene, n, hard, samples, options) for samples in options.samples]
    return {
        "n": n,
        "hard_edges": [
            {
                "step": step,
                "grid": grid,
                "noise": noise(slopes),
                "from_last": apart(slopes, best),
            }
            for (step, grid), slopes in zip(variants, hard, strict=True)
        ],
        "hard_edges_s": seconds,
        "render": rendered,
    }


def _rendered(
    scene: Scene, n: float, hard: list[np.ndarray], samples: int, options: argparse.Namespace
) -> dict[str, Any]:
    """How far the derivative at `samples` is from `hard` and from the render's differences."""
    picture = index_picture(scene, options.size, samples)
    both = jax.jit(lambda n: jax.jvp(picture, (n,), (jnp.ones_like(n),)))
    value = {at: np.asarray(both(jnp.asarray(n + at))[0]) for at in (-options.h, options.h)}
    slope = np.asarray(both(jnp.asarray(n))[1])
    differences = (value[options.h] - value[-options.h]) / (2 * options.h)
    return {
        "samples": samples,
        "from_hard_edges": apart(slope, hard[-1]),
        "from_own_differences": relative(slope, differences),
        "largest": float(np.max(np.abs(slope))),
        "largest_from_own": float(np.max(np.abs(slope - differences))),
        "from_each_hard_edges": [apart(slope, pair) for pair in hard],
    }


def outline(options: argparse.Namespace) -> list[dict[str, Any]]:
    """The derivative where a lamp's outline is seen through the ball, against differences."""
    lamp = Object(Sphere([0.25, 0.2, -3.0], 0.5), Emitter([1.0, 1, 1]), "lamp")
    ball = Object(Sphere([0.0, 0, 0], 1.0), Dielectric("N-BK7"), "ball")
    camera = Camera([0.0, 0, 4], [0.0, 0, 0], vertical_fov=34.0)
    scene = Scene(camera, [ball, lamp], Background([0.2, 0.2, 0.2]))
    n = float(named_glass("N-BK7").refractive_index(np.asarray(WAVELENGTH)))
    pair = []
    for samples in OUTLINE_SAMPLES:
        picture = jax.jit(index_picture(scene, options.size // 2, samples))
        more, less = (
            np.asarray(picture(jnp.asarray(n + h))) for h in (OUTLINE_STEP, -OUTLINE_STEP)
        )
        pair.append((more - less) / (2 * OUTLINE_STEP))
    truth, rows = np.stack(pair), []
    for samples in options.samples:
        picture = index_picture(scene, options.size // 2, samples)
        both = jax.jit(lambda n, of=picture: jax.jvp(of, (n,), (jnp.ones_like(n),))[1])
        slope = np.asarray(both(jnp.asarray(n)))
        rows.append(
            {"samples": samples, "from_hard_edges": apart(slope, truth), "noise": noise(truth)}
        )
    return rows


def scattered(samples: list[int], seeds: int) -> list[dict[str, Any]]:
    """The derivative of a ball over a matte chequered ground, against hard-edged differences.

    What is left is noise of the paths: its root mean square over so many seeds of the fewest
    samples, and one seed of more.
    """
    ball = Object(Sphere([0.0, 0, 0], 1.0), Dielectric("N-BK7"), "ball")
    globe = Object(
        Sphere([0.0, -101, 0], 100.0), Lambertian(Checker([0.1] * 3, [0.9] * 3, 6.0)), "ground"
    )
    flat = Object(
        Plane([0.0, -1, 0], [0.0, 1, 0]), Lambertian(Checker2D([0.9] * 3, [0.1] * 3, 0.6)), "ground"
    )
    level = Camera([0.0, 0.6, 3.2], [0.0, -0.1, 0], vertical_fov=42.0)
    above = Camera([0.0, 5.0, 2.0], [0.0, -0.4, 0], vertical_fov=27.0)
    views = {
        "ground of radius 100": (level, globe),
        "plane": (level, flat),
        "plane from above": (above, flat),
    }
    n = float(named_glass("N-BK7").refractive_index(np.asarray(WAVELENGTH)))
    rows = []
    for name, (camera, ground) in views.items():
        scene = Scene(camera, [ball, ground], Background([1.0, 1, 1]))
        truth = HardGround(scene, BALL, SCREEN).slope(
            n, SCATTERED_STEP, SCATTERED_SIZE, SCATTERED_PARTS, SCATTERED_ENOUGH
        )
        for count in samples:
            errors, firsts, warms = [], [], []
            for seed in range(seeds if count == min(samples) else 1):
                picture = index_picture(scene, SCATTERED_SIZE, count, seed)
                both = jax.jit(lambda n, of=picture: jax.jvp(of, (n,), (jnp.ones_like(n),))[1])
                start, slope = time.perf_counter(), np.asarray(both(jnp.asarray(n)))
                firsts.append(time.perf_counter() - start)
                warms.append(timed(both, jnp.asarray(n))[0])
                errors.append(relative(slope, truth))
            rows.append(
                {
                    "scene": name,
                    "samples": count,
                    "from_hard_edges": float(np.sqrt(np.mean(np.square(errors)))),
                    "worst": max(errors),
                    "warm_s": statistics.median(warms),
                    "first_s": firsts[0],
                    "each": errors,
                }
            )
    return rows


# What it costs.


def cost_functions(scene: Scene) -> tuple[dict[str, Callable[[Any], Any]], jax.Array]:
    """Forward render, six columns and gradient, jitted; and the coefficients (6,) they take.

    And the forward render once more, as XLA compiles it if it is told nothing.
    """
    film = Film(64, 64, band_middles(400, 700, 8))

    def picture(coefficients: jax.Array) -> jax.Array:
        glass = Sellmeier(coefficients[:3], coefficients[3:])
        return render(with_glass(scene, BALL, glass), film, samples=16)

    functions = {
        "forward": picture,
        "six columns": jax.jacfwd(picture),
        "gradient": jax.grad(lambda coefficients: jnp.mean(picture(coefficients) ** 2)),
    }
    glass = scene.objects[BALL].material.glass
    start = jnp.asarray(np.concatenate([glass.B, glass.C]))
    jitted = {
        name: jax.jit(function, compiler_options=COMPILER_OPTIONS)
        for name, function in functions.items()
    }
    return {**jitted, "forward, no options": jax.jit(picture)}, start


def timed(function: Callable[[Any], Any], argument: Any) -> tuple[float, float]:
    """Wall and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    jax.block_until_ready(function(argument))
    return time.perf_counter() - wall, time.process_time() - cpu


def cost(scene: Scene, runs: int) -> list[dict[str, Any]]:
    """Median times of warm runs, which take turns so that all meet the same machine."""
    functions, argument = cost_functions(scene)
    compiling = {name: timed(function, argument)[0] for name, function in functions.items()}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in functions}
    for _ in range(runs):
        for name, function in functions.items():
            times[name].append(timed(function, argument))
    rows: list[dict[str, Any]] = []
    for name in functions:
        wall, cpu = (statistics.median(column) for column in zip(*times[name], strict=True))
        first = rows[0] if rows else {"wall_s": wall, "cpu_s": cpu}
        ratios = {"wall_ratio": wall / first["wall_s"], "cpu_ratio": cpu / first["cpu_s"]}
        rows.append(
            {"what": name, "wall_s": wall, "cpu_s": cpu, **ratios, "first_s": compiling[name]}
        )
    return rows


PARTS = ("cost", "accuracy", "outline", "scattered")


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=96, help="pixels of an edge, even")
    parser.add_argument("--samples", type=int, nargs="+", default=[16, 64], help="per pixel")
    parser.add_argument(
        "--grids", type=int, nargs="+", default=[48, 160], help="√points of a pixel"
    )
    parser.add_argument("--steps", type=float, nargs="+", default=[1e-3, 5e-4], help="in n, hard")
    parser.add_argument("--h", type=float, default=1e-6, help="step in n of the render")
    parser.add_argument("--scattered", type=int, nargs="+", default=[256, 1024], help="samples")
    parser.add_argument("--seeds", type=int, default=4, help="of the fewest of those")
    parser.add_argument("--runs", type=int, default=7, help="warm ones, for the median")
    parser.add_argument("--only", nargs="+", choices=PARTS, help="and keep the rest of the record")
    options = parser.parse_args()
    scene = load_scene(str(BENCH))
    figures: dict[str, Any] = recorded("derivative") if options.only else {}
    for part in options.only or PARTS:
        with jax.enable_x64(True):
            if part == "cost":
                for dtype in ("float32", "float64"):
                    with jax.enable_x64(dtype == "float64"):
                        figures[f"cost_{dtype}"] = cost(scene, options.runs)
            elif part == "accuracy":
                figures |= accuracy(scene, options)
            elif part == "outline":
                figures["outline"] = outline(options)
            else:
                figures["scattered"] = scattered(options.scattered, options.seeds)
        measured = {"date": str(date.today()), "cpu": machine()["cpu"]}
        figures["measured"] = {**figures.get("measured", {}), part: measured}
    for dtype in ("float32", "float64"):
        head = (dtype, "wall s", "CPU s", "wall ratio", "CPU ratio", "first s")
        print_table(head, [list(row.values()) for row in figures[f"cost_{dtype}"]])
        print()
    head = ("step in n", "√points", "noise of each", "apart from the last")
    print_table(head, [list(row.values()) for row in figures["hard_edges"]])
    print()
    head = ("samples", "to hard edges", "to own differences", "largest", "its difference")
    print_table(head, [list(row.values())[: len(head)] for row in figures["render"]])
    print()
    head = ("samples", "outline: to hard edges", "noise of those")
    print_table(head, [list(row.values()) for row in figures["outline"]])
    print()
    # Rows that are kept may lack what later ones have.
    told = ("scene", "samples", "from_hard_edges", "worst", "warm_s", "first_s")
    head = [name for name in told if name in figures["scattered"][0]]
    print_table(head, [[row[name] for name in head] for row in figures["scattered"]])
    settings = {name: value for name, value in vars(options).items() if name != "only"}
    write_record("derivative", settings, figures)


if __name__ == "__main__":
    main()
