"""Where float32 puts the point at which a ray meets a sphere, against float64 on the same rays.

Three forms: the one of the tracer, whose discriminant is that of the foot of the perpendicular; the
one that it takes where spheres are very large; and the quadratic of textbooks, b² - c. Small
spheres far away and large spheres close by are what they are bad at.
"""

import argparse
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from record import print_table, write_record

from diffdisp.geometry import Ray, fine_first_distance, first_distance
from diffdisp.vector import Vec3

BESIDE = 1e-4
"""Of the radius: rays that pass the silhouette this closely may be told either way."""


class Rays(NamedTuple):
    """Rays (n, 3), as float32 holds them, to a sphere."""

    origins: np.ndarray
    directions: np.ndarray
    center: np.ndarray
    radius: float


def towards_far(distance: float, count: int, generator: np.random.Generator) -> Rays:
    """Rays to the unit sphere from afar, half of them past it."""
    impact = np.sqrt(generator.uniform(0, 2, count))
    turn = generator.uniform(0, 2 * np.pi, count)
    out = _unit(generator.normal(size=(count, 3)))
    across, up = _across(out)
    targets = impact[:, None] * (np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * up)
    origins = (distance * out).astype(np.float32)
    return Rays(origins, _unit(targets - origins).astype(np.float32), np.zeros(3), 1.0)


def onto_ground(radius: float, count: int, generator: np.random.Generator) -> Rays:
    """Rays from about 1 above a large sphere beneath, down to a cosine of 0.01 with it."""
    turn, cosine = generator.uniform(0, 2 * np.pi, count), generator.uniform(0.01, 1, count)
    sine = np.sqrt(1 - cosine**2)
    directions = np.stack([np.cos(turn) * sine, -cosine, np.sin(turn) * sine], axis=-1)
    origins = generator.uniform(-0.3, 0.3, (count, 3)) + np.array([0.0, 1.0, 0.0])
    center = np.array([0.0, -radius, 0.0])
    return Rays(origins.astype(np.float32), directions.astype(np.float32), center, radius)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _across(out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (n, 3) at right angles to each of `out`, and to each other."""
    least = np.eye(3)[np.argmin(np.abs(out), axis=-1)]
    across = _unit(np.cross(out, least))
    return across, np.cross(out, across)


def exact(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Distance (n,) to the first point, NaN without one, and from the silhouette, in radii."""
    origins, directions = rays.origins - rays.center, rays.directions.astype(np.float64)
    squared = np.sum(directions**2, axis=-1)
    along = -np.sum(origins * directions, axis=-1) / squared
    foot = origins + directions * along[:, None]
    impact = np.linalg.norm(foot, axis=-1)
    beside = impact / rays.radius - 1
    half = np.sqrt(np.where(beside < 0, (rays.radius - impact) * (rays.radius + impact), np.nan))
    outside = np.sum(origins**2, axis=-1) - rays.radius**2
    # Of both roots the one nearer to 0 by the product of both.
    far = along + half / np.sqrt(squared)
    return outside / squared / far, beside


def by_tracer(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Distance in float32, and whether the sphere is met, by the tracer's form."""
    return _met(lambda ray, c, r: first_distance(ray, c, r * r, r < 0), rays)


def by_fine(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """The same by the form for scenes with very large spheres."""
    return _met(lambda ray, c, r: fine_first_distance(ray, c, r, r < 0), rays)


def by_quadratic(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """The same by b - √(b² - c)."""

    def of(ray: Ray, center: Vec3, radius: jax.Array) -> tuple[jax.Array, jax.Array]:
        origin = ray.origin - center
        b = -origin.dot(ray.direction)
        discriminant = b * b - (origin.dot(origin) - radius * radius)
        return b - jnp.sqrt(jnp.maximum(discriminant, 0)), discriminant > 0

    return _met(of, rays)


def _met(of: Callable[..., Any], rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """What a form tells of a ray, its sphere's centre and radius, of all rays."""
    alike = jnp.zeros(len(rays.origins), jnp.float32)
    center = Vec3(*(alike + np.float32(x) for x in rays.center))
    ray = Ray(_vector(rays.origins), _vector(rays.directions))
    distance, meets = jax.jit(of)(ray, center, alike + np.float32(rays.radius))
    return np.asarray(distance), np.asarray(meets)


def _vector(array: np.ndarray) -> Vec3:
    return Vec3(*(jnp.asarray(array[:, axis], jnp.float32) for axis in range(3)))


FORMS: dict[str, Callable[[Rays], tuple[np.ndarray, np.ndarray]]] = {
    "tracer": by_tracer,
    "fine": by_fine,
    "quadratic": by_quadratic,
}
SCENES: dict[str, tuple[Callable[[float, int, np.random.Generator], Rays], tuple[float, ...]]] = {
    "unit sphere at": (towards_far, (1e1, 1e2, 1e3, 1e4, 1e5, 1e6)),
    "from 1 above radius": (onto_ground, (1e1, 1e2, 1e3, 1e4, 1e5, 1e6)),
}


def compared(rays: Rays, found: tuple[np.ndarray, np.ndarray]) -> dict[str, float]:
    """How often a form is wrong about a hit, and how far off its distances are."""
    distance, meets = found
    true, beside = exact(rays)
    wrong = meets != (beside < 0)
    clear = np.abs(beside) > BESIDE
    sure = clear & meets & (beside < 0)
    off = np.abs(distance[sure] / true[sure] - 1)
    return {
        "misjudged": int(wrong.sum()),
        "beyond_1e-4": int((wrong & clear).sum()),
        "worst_off": float(off.max()) if len(off) else float("nan"),
        "median_off": float(np.median(off)) if len(off) else float("nan"),
    }


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rays", type=int, default=1_000_000, help="of each row")
    options = parser.parse_args()
    rows = []
    for scene, (rays_of, numbers) in SCENES.items():
        for number in numbers:
            rays = rays_of(number, options.rays, np.random.default_rng(0))
            for form, of in FORMS.items():
                rows.append({"scene": scene, "number": number, "form": form})
                rows[-1] |= compared(rays, of(rays))
    print_table(list(rows[0]), [list(row.values()) for row in rows])
    write_record("intersections", vars(options), rows)


if __name__ == "__main__":
    main()
