"""A glass ball on a matte chequered ground before white, without a path being drawn by chance.

A ray that meets a ball stays in the plane through its centre. What leaves the ball after p internal
reflections has turned by D_p there, and passes the centre as far as it did before (van de Hulst,
Light Scattering by Small Particles (1957), section 12.2). It meets nothing then but white and the
ground, which is lit by white and, a little less, by what the ball shows instead.

So a picture is an integral over the film alone. That is taken by triangles, on each of which what
is met is straight: their borders of tiles are hard, and move as steadily as the index does.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffdisp import Checker2D, Plane, Scene

Vector = tuple[jax.Array, ...]
"""Two or three numbers of each of many."""
Seen = Callable[[Any, jax.Array, Vector, Vector], Any]
"""From a sum, a weight, a ray's origin and its direction to the sum with what the ray sees."""

ORDERS = 40
"""Internal reflections that are followed; what has had more is left out."""
RADII, TURNS, ANGLES = 33, 16, 64
"""Where on the ground its light is known: distances from the ball's foot, the mean of directions;
and angles each way of the rays to the ball that it is summed over."""
INDEX_STEP = 0.02
"""For how the ground's light changes with the index: little and steadily."""
BOUNCES = 4
"""Of light between ground and ball; the last changes the ground's light by 1e-5."""
STRIP = 64
"""Lines of triangles that are followed at once."""


def _dot(a: Vector, b: Vector) -> jax.Array:
    return sum((p * q for p, q in zip(a, b, strict=True)), jnp.zeros(()))


def _turned(a: Vector, b: Vector, cosine: jax.Array, sine: jax.Array) -> Vector:
    return tuple(cosine * p + sine * q for p, q in zip(a, b, strict=True))


def leaving(n: jax.Array, origin: Vector, direction: Vector, seen: Seen, total: Any) -> Any:
    """The sum of what is seen along all rays that a unit ball at the origin makes of one.

    Args:
        n: index of the ball.
        origin: of a ray that meets it.
        direction: of the same, of length 1.
        seen: adds what one of them sees.
        total: the sum before.
    """
    along = _dot(origin, direction)
    foot = tuple(p - along * q for p, q in zip(origin, direction, strict=True))
    away = jnp.sqrt(_dot(foot, foot))
    aside = tuple(p / jnp.where(away > 0, away, 1.0) for p in foot)
    sine = jnp.minimum(away, 1 - 1e-12)
    cosine, within = jnp.sqrt(1 - sine * sine), sine / n
    refracted = jnp.sqrt(1 - within * within)
    s = (cosine - n * refracted) / (cosine + n * refracted)
    p = (n * cosine - refracted) / (n * cosine + refracted)
    reflected = 0.5 * (s * s + p * p)

    def add(total: Any, weight: jax.Array, cos: jax.Array, sin: jax.Array) -> Any:
        """What is seen along the ray that has turned so far, against where it was aside."""
        turned, beside = _turned(direction, aside, cos, -sin), _turned(aside, direction, cos, sin)
        return seen(total, weight, _turned(beside, turned, sine, cosine), turned)

    # Cosine and sine of twice the angle of incidence, and of refraction.
    cos_2i, sin_2i = 1 - 2 * sine * sine, 2 * sine * cosine
    cos_2r, sin_2r = 1 - 2 * within * within, 2 * within * refracted
    total = add(total, reflected, -cos_2i, -sin_2i)

    def order(_: int, state: Any) -> Any:
        cos, sin, weight, total = state
        total = add(total, weight, cos, sin)
        return -cos * cos_2r - sin * sin_2r, cos * sin_2r - sin * cos_2r, weight * reflected, total

    cos, sin = cos_2i * cos_2r + sin_2i * sin_2r, sin_2i * cos_2r - cos_2i * sin_2r
    state = (cos, sin, (1 - reflected) ** 2, total)
    return jax.lax.fori_loop(0, ORDERS, order, state)[-1]


class HardGround:
    """A unit ball of glass at the origin, and the ground that it lies on, as numbers."""

    def __init__(self, scene: Scene, ball: int, ground: int) -> None:
        """Take the numbers of `scene`, which has to be such a one, before white.

        Args:
            scene: of a ball and a ground.
            ball: number of the ball.
            ground: number of the ground.
        """
        sphere, under = scene.objects[ball].shape, scene.objects[ground].shape
        assert sphere.radius == 1, "the ball must be of radius 1"
        assert not np.any(sphere.center), "the ball must be at the origin"
        camera, texture = scene.camera, scene.objects[ground].material.texture
        if isinstance(under, Plane):
            assert np.array_equal(under.normal, [0, 1, 0]), "the ground must be level"
            assert np.array_equal(under.point, [0, -1, 0]), "the ball must lie on the ground"
            self.radius = np.inf
        else:
            self.radius = float(under.radius)
            assert np.array_equal(under.center, [0, -1 - self.radius, 0]), (
                "the ball must lie on the ground"
            )
        self.flat = isinstance(texture, Checker2D)
        self.scale = 1 / float(texture.tile) if self.flat else float(texture.scale) / np.pi
        self.mean = float(texture.even[0] + texture.odd[0]) / 2
        self.half = float(texture.even[0] - texture.odd[0]) / 2
        self.origin = np.asarray(camera.look_from, float)
        forward = np.asarray(camera.look_at, float) - self.origin
        self.forward = forward / np.linalg.norm(forward)
        right = np.cross(self.forward, [0, 1, 0])
        self.right = right / np.linalg.norm(right)
        self.up = np.cross(self.right, self.forward)
        self.edge = float(np.tan(np.radians(camera.vertical_fov) / 2))

    def slope(self, n: float, step: float, size: int, most: int, enough: float) -> np.ndarray:
        """Central differences (size, size) in the index, of a picture of hard edges.

        Args:
            n: the index.
            step: in it.
            size: pixels of an edge.
            most: triangles' edges along one of a pixel, a power of 2.
            enough: change of the whole, relative L2, below which no row is made finer.
        """
        light = [self._light(n + change) for change in (0, INDEX_STEP, -INDEX_STEP)]
        change = (light[1] - light[2]) / (2 * INDEX_STEP)

        def row(number: int, parts: int) -> np.ndarray:
            more, less = (
                np.asarray(self._row(size, parts, number, n + h, light[0] + h * change))
                for h in (step, -step)
            )
            return (more - less) / (2 * step)

        rows, parts = list(range(size)), most // 16
        slope = np.stack([row(number, parts) for number in rows])
        bound = enough * np.linalg.norm(slope) / np.sqrt(size)
        while rows and parts < most:
            parts *= 2
            before = slope.copy()
            slope[rows] = np.stack([row(number, parts) for number in rows])
            rows = [k for k in rows if np.linalg.norm(slope[k] - before[k]) > bound]
        return slope

    def _ground(self, origin: Vector, direction: Vector) -> tuple[jax.Array, Vector]:
        """How far within its horizon a ray meets the ground, below 0 if it does not; and where."""
        if self.radius == np.inf:
            within = -direction[1]
            distance = (-1 - origin[1]) / jnp.where(within > 0, direction[1], 1.0)
        else:
            above = (origin[0], origin[1] + 1 + self.radius, origin[2])
            along = _dot(above, direction)
            within = along**2 - (_dot(above, above) - self.radius**2)
            within = jnp.where(along < 0, within, -1.0)
            distance = -along - jnp.sqrt(jnp.where(within > 0, within, 0.0))
        distance = jnp.where(within > 0, distance, 0.0)
        return within, tuple(p + distance * q for p, q in zip(origin, direction, strict=True))

    def _tiles(self, point: Vector) -> Vector:
        """Coordinates in tiles: even ones where the product of their square waves is 1."""
        if self.flat:
            return point[0] * self.scale, -point[2] * self.scale
        return tuple(p * self.scale for p in point)

    @partial(jax.jit, static_argnums=0)
    def _lit(self, n: jax.Array, light: jax.Array) -> jax.Array:
        """The ground's light (RADII,), if before the last bounce it is `light`."""
        part = jnp.minimum(jnp.arange(RADII) / (RADII - 1), 1 - 1e-6)
        radii = jnp.clip(part / (1 - part), 1e-4, 0.99 * self.radius)
        turns = (jnp.arange(TURNS) + 0.3) * (2 * np.pi / TURNS)
        number = jnp.arange(ANGLES * ANGLES)
        line, column = number // ANGLES, number % ANGLES
        incidence = (line + 0.5) * (np.pi / 2 / ANGLES)
        around = (column + line * 0.618033988749895 % 1) * (2 * np.pi / ANGLES)

        def at(place: tuple[jax.Array, jax.Array]) -> jax.Array:
            radius, turn = place
            depth = 0.0
            if self.radius != np.inf:
                depth = self.radius - jnp.sqrt(self.radius**2 - radius**2)
            point = jnp.stack([radius * jnp.cos(turn), -1.0 - depth, radius * jnp.sin(turn)])
            normal = jnp.array([0.0, 1, 0])
            if self.radius != np.inf:
                normal = (point + jnp.array([0.0, 1 + self.radius, 0])) / self.radius
            far = jnp.linalg.norm(point)
            axis = -point / far
            first = jnp.cross(axis, jnp.array([0.0, 1, 0]))
            first = first / jnp.linalg.norm(first)
            second = jnp.cross(axis, first)
            sine = jnp.sin(incidence) / far
            cosine = jnp.sqrt(1 - sine * sine)
            beside = first[:, None] * jnp.cos(around) + second[:, None] * jnp.sin(around)
            direction = axis[:, None] * cosine + beside * sine
            # Of the solid angle, sin θ dθ dφ with sin θ = sin i / far.
            solid = jnp.sin(incidence) * jnp.cos(incidence) / (far * far * cosine)
            solid = solid * (np.pi / 2) * (2 * np.pi) / ANGLES**2
            upward = jnp.maximum(normal @ direction, 0.0)
            origin = tuple(jnp.broadcast_to(q, sine.shape) for q in point)
            seen = leaving(n, origin, tuple(direction), partial(self._point, light), 0.0 * sine)
            return 1 - jnp.sum(solid * upward * (1 - seen)) / np.pi

        grid = jnp.meshgrid(radii, turns, indexing="ij")
        return jax.lax.map(at, tuple(g.ravel() for g in grid)).reshape(RADII, TURNS).mean(1)

    def _light(self, n: float) -> jax.Array:
        """Irradiance (RADII,) of the ground over that of one below white alone."""
        light = jnp.ones(RADII)
        for _ in range(BOUNCES):
            light = self._lit(n, light)
        return light

    def _light_at(self, light: jax.Array, point: Vector) -> jax.Array:
        radius = jnp.hypot(point[0], point[2])
        place = radius / (1 + radius) * (RADII - 1)
        below = jnp.minimum(jnp.floor(place).astype(int), RADII - 2)
        return light[below] + (light[below + 1] - light[below]) * (place - below)

    def _point(
        self, light: jax.Array, total: jax.Array, weight: jax.Array, origin: Vector, to: Vector
    ) -> jax.Array:
        """The sum with what is seen along single rays."""
        within, point = self._ground(origin, to)
        sign = jnp.ones(())
        for wave in self._tiles(point):
            sign = sign * jnp.where(jnp.floor(wave) % 2 == 0, 1.0, -1.0)
        shown = (self.mean + self.half * sign) * self._light_at(light, point)
        return total + weight * jnp.where(within > 0, shown, 1.0)

    def _triangles(
        self, light: jax.Array, total: jax.Array, weight: jax.Array, origin: Vector, to: Vector
    ) -> jax.Array:
        """The sum over pairs of triangles with what is seen between the rays at their corners."""
        within, point = self._ground(origin, to)
        numbers = (weight, within, self._light_at(light, point), *self._tiles(point))
        for corners in zip(*map(_corners, numbers), strict=True):
            weights, inside, lights, *waves = corners
            part = _positive(*_in_order(inside))
            meet = [jnp.where(i > 0, 1.0, 0.0) for i in inside]
            met = meet[0] + meet[1] + meet[2]
            lit = _dot(tuple(meet), lights) / jnp.maximum(met, 1.0)
            # A triangle across the horizon has its tiles too far away to be told apart.
            sign = jnp.where(met == 3, 1.0, 0.0)
            for wave in waves:
                sign = sign * _mean_wave(*_in_order(wave))
            shown = 1 - part + part * lit * (self.mean + self.half * sign)
            total = total + 0.5 * (weights[0] + weights[1] + weights[2]) / 3 * shown
        return total

    @partial(jax.jit, static_argnums=(0, 1, 2))
    def _row(
        self, size: int, parts: int, number: jax.Array, n: jax.Array, light: jax.Array
    ) -> jax.Array:
        """Radiance (size,) of a row of pixels, each of 2 parts² triangles."""
        lines = min(parts, STRIP)
        across = (jnp.arange(size * parts + 1) / (size * parts) * 2 - 1) * self.edge

        def strip(begin: jax.Array) -> jax.Array:
            down = (1 - (number + (begin + jnp.arange(lines + 1)) / parts) / size * 2) * self.edge
            x, y = jnp.meshgrid(across, down)
            axes = zip(self.forward, self.right, self.up, strict=True)
            to = tuple(f + r * x + u * y for f, r, u in axes)
            length = jnp.sqrt(_dot(to, to))
            to = tuple(q / length for q in to)
            origin = tuple(jnp.full_like(x, q) for q in self.origin)
            along = _dot(origin, to)
            hits = (_dot(origin, origin) - along**2 < 1) & (along < 0)
            total = jnp.zeros((lines, size * parts))
            total = self._triangles(light, total, jnp.where(hits, 0.0, 1.0), origin, to)

            def through(total: jax.Array) -> jax.Array:
                def seen(total: Any, weight: jax.Array, origin: Vector, to: Vector) -> Any:
                    weight = jnp.where(hits, weight, 0.0)
                    return self._triangles(light, total, weight, origin, to)

                # What misses the ball counts nothing, and is sent where all numbers are finite.
                aim = (-self.origin + 0.1 * self.right) / np.linalg.norm(self.origin)
                aim = aim / np.linalg.norm(aim)
                met = tuple(jnp.where(hits, q, a) for q, a in zip(to, aim, strict=True))
                return leaving(n, origin, met, seen, total)  # type: ignore[no-any-return]

            total = jax.lax.cond(jnp.any(hits), through, lambda total: total, total)
            return jnp.sum(total.reshape(lines, size, parts), axis=(0, 2))

        begins = jnp.arange(0, parts, lines)
        return jnp.sum(jax.lax.map(strip, begins), axis=0) / parts**2


def _corners(values: jax.Array) -> Iterator[tuple[jax.Array, jax.Array, jax.Array]]:
    """Both triangles of each square of a grid."""
    yield values[:-1, :-1], values[1:, :-1], values[:-1, 1:]
    yield values[1:, 1:], values[1:, :-1], values[:-1, 1:]


def _in_order(corners: tuple[jax.Array, jax.Array, jax.Array]) -> Vector:
    a, b, c = corners
    low, high = jnp.minimum(jnp.minimum(a, b), c), jnp.maximum(jnp.maximum(a, b), c)
    return low, a + b + c - low - high, high


def _positive(low: jax.Array, middle: jax.Array, high: jax.Array) -> jax.Array:
    """Part of a triangle where a linear function is positive; of its values at the corners."""

    def tip(at: jax.Array, a: jax.Array, b: jax.Array, cut: jax.Array) -> jax.Array:
        return jnp.where(cut, at * at / jnp.where(cut, (at - a) * (at - b), 1.0), 0.0)

    above = tip(high, low, middle, (middle <= 0) & (high > 0))
    below = tip(low, high, middle, (middle > 0) & (low < 0))
    return jnp.where(middle > 0, 1.0 - below, above)


def _mean_wave(low: jax.Array, middle: jax.Array, high: jax.Array) -> jax.Array:
    """Mean over a triangle of the square wave of a linear function: +1 on (0, 1), -1 on (1, 2).

    Source:
        Hermite and Genocchi: the mean of f'' is twice the second divided difference of f.
    """
    edge = jnp.floor(high)
    above = jnp.where(edge % 2 == 0, 1.0, -1.0)
    one = above * (2 * _positive(low - edge, middle - edge, high - edge) - 1)
    close = 1e-6
    middle = jnp.where(middle - low < close, low, middle)
    middle = jnp.where(high - middle < close, high, middle)

    def difference(a: jax.Array, b: jax.Array) -> jax.Array:
        inside = a - 2 * jnp.floor(0.5 * a)
        slope = 0.5 - jnp.abs(inside - 1)
        quotient = (_twice(b) - _twice(a)) / jnp.where(b > a, b - a, 1.0)
        return jnp.where(b > a, quotient, slope)

    far = high - low > 1
    many = 2 * (difference(middle, high) - difference(low, middle))
    return jnp.where(far, many / jnp.where(far, high - low, 1.0), one)


def _twice(x: jax.Array) -> jax.Array:
    """The square wave integrated twice: a chain of parabolas."""
    inside = x - 2 * jnp.floor(0.5 * x)
    half = jnp.where(inside < 1, inside, inside - 1)
    return 0.5 * half * (half - 1) * jnp.where(inside < 1, 1.0, -1.0)
