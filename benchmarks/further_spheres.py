"""What each further sphere costs: CPU time of a path's segment, against the number of spheres.

The camera is in the middle of a closed matte ball, so that every path has exactly as many segments
as it may. All other spheres are outside: they are tested at each segment and never met, so that
nothing but the test differs.
"""

import argparse
import time

import numpy as np
from record import print_table, write_record

from diffdisp import Background, Camera, Film, Lambertian, Object, Scene, Sphere, render

SPHERES = (2, 4, 8, 16, 32)
"""In the scene, the room included."""
DEPTH = 50
RADIUS = 10.0
"""Of the room, scene units."""


def room(count: int) -> Scene:
    """The room and `count` - 1 spheres around it, no two of them alike."""
    turns = np.arange(1, count) * 2.4
    others = [
        Object(Sphere([30 * np.cos(t), 30 * np.sin(t), 3.0 * k], 1.0), Lambertian([0.5] * 3))
        for k, t in enumerate(turns)
    ]
    walls = Object(Sphere([0.0, 0, 0], RADIUS), Lambertian([0.9] * 3))
    camera = Camera([0.0, 0, 0], [0.0, 0, -1], vertical_fov=60.0)
    return Scene(camera, [walls, *others], Background([1.0, 1, 1]))


def main() -> None:
    """Print and record the time of a segment for each number of spheres, and the slope."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=7, help="pictures of each, of which the median")
    parser.add_argument("--size", type=int, default=200, help="pixels along each edge")
    parser.add_argument("--samples", type=int, default=4, help="per pixel")
    options = parser.parse_args()
    film = Film(options.size, options.size)
    bounces = options.size**2 * options.samples * (DEPTH - 1)
    rows = []
    for count in SPHERES:
        scene, seconds = room(count), []
        for _ in range(options.runs + 1):  # the first one compiles
            start = time.process_time()
            render(scene, film, samples=options.samples, depth=DEPTH, dtype="float32")
            seconds.append(time.process_time() - start)
        rows.append((count, 1e9 * float(np.median(seconds[1:])) / bounces))
    print_table(("spheres", "ns of CPU a segment"), rows)
    slope = float(np.polyfit(*np.transpose(rows), 1)[0])
    print(f"each further sphere: {slope:.2f} ns")
    figures = {"cpu_ns_per_segment": dict(rows), "ns_per_further_sphere": slope}
    write_record("further_spheres", vars(options), figures)


if __name__ == "__main__":
    main()
