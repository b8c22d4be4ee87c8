"""How fast diffdisp renders beside Mitsuba 3 and raysect, and whether `--timing` tells the truth.

Each peer runs in an interpreter of its own (`pip install mitsuba`, `pip install raysect`), which
may be another than this one: it stays alive and renders when it is asked, so that both programs
meet the same state of the machine. A peer that is not installed is skipped. Set
DRJIT_LIBLLVM_PATH if Mitsuba finds no LLVM.

Mitsuba: the scenes of `seed_scenes.json`, with and without dispersion in diffdisp; Mitsuba knows
one index only. Its rough metal and its checker differ as well: GGX, and squares on the sphere.
raysect: a glass ball on ground that shines in a checker pattern, in 16 bands. Its ground ends at
20 units; ours has no end.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from record import RESULTS, machine, print_table, versions, write_record
from seed_scenes import (
    CONSTANT_INDEX,
    DATA,
    DEPTH,
    EFFECTIVE_FOV,
    NOMINAL_FOV,
    SAMPLES,
    has_glass,
    make_scene,
    material_of,
)

if TYPE_CHECKING:
    from diffdisp import Film, Scene

NAME = "against_peers"
VARIANT = "llvm_ad_rgb"
"""Mitsuba's: compiled for the processor, as ours is."""
MITSUBA_COUNTS = (16, 2)
FIELDS_OF_VIEW = (NOMINAL_FOV, EFFECTIVE_FOV)

BALL_SAMPLES = 16
"""Per pixel, before raysect splits each into a ray for every band."""
BANDS = (380.0, 740.0, 16)
"""Of the glass ball's picture: nm, nm, count."""
BALL_HEIGHT = 1.001
"""Of the middle of the ball, radius 1, above the ground: they do not touch."""
EYE = (0.0, 2.6, -5.0)
"""Where the camera of the ball is; it looks along +z and downwards."""
DOWN_DEG, BALL_FOV = 18.0, 40.0
TILE, BRIGHT, DARK = 0.5, 1.0, 0.05
"""Of the ground: scene units, and the radiance of its tiles."""
RAYSECT_PROCESSES = 2
OURS_RUNS, RAYSECT_RUNS = 5, 2
"""Renders of the ball: ours before and again after, raysect's between them."""

MANY_SAMPLES, TIMING_REPEATS = 40, 3
"""What is compared with `SAMPLES` on the command line, and how often."""


# Mitsuba, in its own interpreter.


def rgb(color: list[float]) -> dict[str, Any]:
    """A linear sRGB colour for Mitsuba."""
    return {"type": "rgb", "value": color}


def mitsuba_bsdf(sphere: dict[str, Any]) -> dict[str, Any]:
    """The nearest that Mitsuba has to the material of a sphere."""
    import mitsuba as mi

    entry = material_of(sphere)
    match entry:
        case {"kind": "lambertian", "texture": "checker"}:
            # Of two tiles along each edge, repeated so that those at the equator are as wide as
            # the cubes of the file: π / frequency. Once around are twice the tiles of pole to pole.
            across = sphere["radius"] * entry["frequency"]
            repeat = mi.ScalarTransform4f().scale([across, across / 2, 1])
            colors = {"color0": rgb(entry["even"]), "color1": rgb(entry["odd"])}
            tiles = {"type": "checkerboard", "to_uv": repeat, **colors}
            return {"type": "diffuse", "reflectance": tiles}
        case {"kind": "lambertian"}:
            return {"type": "diffuse", "reflectance": rgb(entry["albedo"])}
        case {"kind": "metal", "fuzz": fuzz}:
            # "none" is a perfect mirror: no Fresnel term beside the colour.
            mirror = {"material": "none", "specular_reflectance": rgb(entry["albedo"])}
            if fuzz == 0:
                return {"type": "conductor", **mirror}
            return {"type": "roughconductor", "distribution": "ggx", "alpha": fuzz, **mirror}
        case {"kind": "dielectric"}:
            return {"type": "dielectric", "int_ior": CONSTANT_INDEX, "ext_ior": 1.0}
    raise ValueError(f"no such material: {entry}")


def mitsuba_scene(count: int, vertical_fov: float, size: int) -> Any:
    """Mitsuba's scene of `count` spheres; its variant must have been set."""
    import mitsuba as mi

    camera = DATA["camera"]
    to_world = mi.ScalarTransform4f().look_at(
        origin=camera["look_from"], target=camera["look_at"], up=camera["up"]
    )
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb"}
    film |= {"component_format": "float32", "rfilter": {"type": "box"}}
    spheres = {
        f"sphere_{i}": {
            "type": "sphere",
            "center": sphere["center"],
            "radius": float(sphere["radius"]),
            "bsdf": mitsuba_bsdf(sphere),
        }
        for i, sphere in enumerate(DATA["scenes"][str(count)])
    }
    return mi.load_dict(
        {
            "type": "scene",
            # Russian roulette, which starts at `rr_depth`, never does.
            "integrator": {"type": "path", "max_depth": DEPTH, "rr_depth": 100_000},
            "sensor": {
                "type": "perspective",
                "fov": vertical_fov,
                "fov_axis": "y",
                "to_world": to_world,
                "film": film,
                "sampler": {"type": "independent"},
            },
            "sky": {"type": "constant", "radiance": rgb(DATA["background"])},
            **spheres,
        }
    )


def mitsuba_renderer() -> tuple[Callable[[dict[str, Any]], dict[str, Any]], dict[str, str]]:
    """What renders a job of Mitsuba's, and versions."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    mi.set_variant(VARIANT)
    scenes: dict[tuple[int, float, int], Any] = {}
    seeds = iter(range(1 << 31))

    def render(job: dict[str, Any]) -> dict[str, Any]:
        key = (job["count"], job["vertical_fov"], job["size"])
        if key not in scenes:
            scenes.clear()  # of one scene after another
            scenes[key] = mitsuba_scene(*key)
        start = time.perf_counter()
        picture = mi.render(scenes[key], spp=SAMPLES, seed=next(seeds))
        dr.eval(picture)
        dr.sync_thread()
        radiance = np.asarray(picture)
        seconds = time.perf_counter() - start
        return {"seconds": seconds, "mean": radiance.mean(axis=(0, 1)).tolist()}

    return render, {"mitsuba": mi.__version__, "drjit": dr.__version__}


# Raysect, in its own interpreter.


def raysect_camera() -> Any:
    """The camera before the glass ball."""
    from raysect.core.workflow import MulticoreEngine
    from raysect.optical import Point3D, World, d65_white, rotate, translate
    from raysect.optical.library import schott
    from raysect.optical.material import Checkerboard
    from raysect.optical.observer import FullFrameSampler2D, PinholeCamera, RGBPipeline2D
    from raysect.primitive import Box, Sphere

    low, high, count = BANDS
    world = World()
    ground = Checkerboard(TILE, d65_white, d65_white, DARK, BRIGHT)
    Box(Point3D(-20, -0.2, -20), Point3D(20, 0, 20), world, material=ground)
    Sphere(1.0, world, translate(0, BALL_HEIGHT, 0), schott("N-BK7"))
    pipeline = RGBPipeline2D(display_progress=False, accumulate=False)
    # Its cameras look along +z.
    place = translate(*EYE) * rotate(0, -DOWN_DEG, 0)
    camera = PinholeCamera(
        (8, 8), fov=BALL_FOV, pipelines=[pipeline], parent=world, transform=place
    )
    camera.frame_sampler = FullFrameSampler2D()
    camera.min_wavelength, camera.max_wavelength = low, high
    camera.spectral_bins = camera.spectral_rays = count
    camera.ray_extinction_prob = 0.0
    camera.ray_extinction_min_depth = camera.ray_max_depth = DEPTH
    camera.quiet = True
    camera.render_engine = MulticoreEngine(RAYSECT_PROCESSES)
    return camera


def raysect_renderer() -> tuple[Callable[[dict[str, Any]], dict[str, Any]], dict[str, str]]:
    """What renders a job of raysect's, and its version."""
    camera = raysect_camera()

    def render(job: dict[str, Any]) -> dict[str, Any]:
        camera.pixels = (job["size"], job["size"])
        camera.pixel_samples = job["samples"]
        start = time.perf_counter()
        camera.observe()
        return {"seconds": time.perf_counter() - start}

    return render, {"raysect": version("raysect")}


# Processes of peers.


RENDERERS = {"mitsuba": mitsuba_renderer, "raysect": raysect_renderer}
TITLES = {"mitsuba": "Mitsuba", "raysect": "raysect"}


def serve(name: str) -> None:
    """Tell the versions, then answer each job, a line of JSON, with another."""
    answers = private_output()
    render, found = RENDERERS[name]()
    print(json.dumps(found), file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(render(json.loads(line))), file=answers, flush=True)


def private_output() -> TextIO:
    """The standard output, for us alone: what libraries print goes to the standard error."""
    ours = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return ours


class Peer:
    """A peer in a process of its own; `versions` are those that it tells."""

    def __init__(self, name: str, python: str) -> None:
        """Start it."""
        command = [python, __file__, "--worker", name]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self._process = subprocess.Popen(command, text=True, **pipes)
        self.versions = self._answer()

    def render(self, **job: Any) -> dict[str, Any]:
        """What it answers to a job."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> dict[str, Any]:
        """The next line."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"the peer has ended: status {self._process.wait()}")
        return json.loads(line)


def start_peer(name: str, python: str) -> Peer | None:
    """The peer, or None with a message where it is not installed."""
    asked = subprocess.run([python, "-c", f"import {name}"], stderr=subprocess.DEVNULL)
    if asked.returncode:
        print(f"{TITLES[name]} is not installed: skipped")
        return None
    return Peer(name, python)


# The measurements.


def our_seconds(scene: "Scene", film: "Film", samples: int) -> tuple[float, list[float]]:
    """Seconds of our render, and its mean over the pixels."""
    from diffdisp import render

    start = time.perf_counter()
    picture = render(scene, film, samples=samples, depth=DEPTH, dtype="float32")
    return time.perf_counter() - start, picture.mean(axis=(0, 1)).tolist()


def mitsuba_cases() -> Iterator[tuple[int, float, bool]]:
    """Spheres, vertical field of view, and whether our glass disperses; where there is some."""
    for count in MITSUBA_COUNTS:
        for vertical_fov in FIELDS_OF_VIEW:
            for dispersive in (True, False) if has_glass(count) else (False,):
                yield count, vertical_fov, dispersive


def compare_mitsuba(peer: Peer, options: argparse.Namespace) -> dict[str, Any]:
    """Pairs of renders, ours and Mitsuba's in turn."""
    cases = [mitsuba_pairs(peer, *case, options) for case in mitsuba_cases()]
    print_rows("Mitsuba: ratio of paths per second, ours over its", cases)
    return {"versions": peer.versions, "size": options.size, "cases": cases}


def mitsuba_pairs(
    peer: Peer, count: int, vertical_fov: float, dispersive: bool, options: argparse.Namespace
) -> dict[str, Any]:
    """One scene: medians of some pairs, after one that warms up."""
    from diffdisp import Film

    size, paths = options.size, options.size**2 * SAMPLES
    scene, film = make_scene(count, vertical_fov, dispersive=dispersive), Film(size, size)
    pairs = []
    for _ in range(options.pairs + 1):
        ours, mean = our_seconds(scene, film, SAMPLES)
        theirs = peer.render(count=count, vertical_fov=vertical_fov, size=size)
        pairs.append((ours, theirs["seconds"]))
    ratios = [theirs / ours for ours, theirs in pairs[1:]]
    ours, theirs_s = (statistics.median(column) for column in zip(*pairs[1:], strict=True))
    return {
        "spheres": count,
        "vertical_fov": vertical_fov,
        "our_glass": ("N-BK7" if dispersive else "constant") if has_glass(count) else "none",
        "ratio": statistics.median(ratios),
        "least": min(ratios),
        "most": max(ratios),
        "our_paths_per_s": paths / ours,
        "its_paths_per_s": paths / theirs_s,
        "our_mean": statistics.mean(mean),
        "its_mean": statistics.mean(theirs["mean"]),
    }


def ball_scene() -> "Scene":
    """Our scene of the glass ball."""
    from diffdisp import Camera, Checker2D, Dielectric, Emitter, Object, Plane, Scene, Sphere

    down = math.radians(DOWN_DEG)
    look_at = (EYE[0], EYE[1] - math.sin(down), EYE[2] + math.cos(down))
    ground = Emitter(Checker2D([BRIGHT] * 3, [DARK] * 3, TILE))
    return Scene(
        Camera(EYE, look_at, vertical_fov=BALL_FOV),
        [
            Object(Sphere([0, BALL_HEIGHT, 0], 1), Dielectric("N-BK7")),
            Object(Plane([0, 0, 0], [0, 1, 0]), ground),
        ],
    )


def compare_raysect(peer: Peer, options: argparse.Namespace) -> dict[str, Any]:
    """Renders of the glass ball: ours, raysect's, ours."""
    from diffdisp import Film, band_middles

    size = options.ball_size
    scene, film = ball_scene(), Film(size, size, band_middles(*BANDS))

    def ours(runs: int) -> list[float]:
        return [our_seconds(scene, film, BALL_SAMPLES)[0] for _ in range(runs)]

    ours(1)  # compiles
    peer.render(size=8, samples=1)  # builds its tree of the scene
    before = ours(OURS_RUNS)
    theirs = [peer.render(size=size, samples=BALL_SAMPLES)["seconds"] for _ in range(RAYSECT_RUNS)]
    after = ours(OURS_RUNS)
    rays = size * size * BALL_SAMPLES * BANDS[2]
    our_s, its_s = statistics.median(before + after), statistics.median(theirs)
    case = {
        "ratio": its_s / our_s,
        "least": min(theirs) / max(before + after),
        "most": max(theirs) / min(before + after),
        "our_rays_per_s": rays / our_s,
        "its_rays_per_s": rays / its_s,
    }
    print_rows("raysect: ratio of rays per second, ours over its", [case])
    return {"versions": peer.versions, "size": size, "processes": RAYSECT_PROCESSES, **case}


def check_timing(options: argparse.Namespace) -> dict[str, Any]:
    """The speed that `--timing` tells, and that of the time that more samples take."""
    from diffdisp import save_scene

    size = f"{options.size}x{options.size}"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_scene(make_scene(16, NOMINAL_FOV), folder / "scene.toml")
        told = {
            samples: json.loads(run_render(folder, size, samples, "--timing")[1])
            for samples in (SAMPLES, MANY_SAMPLES)
        }
        extra = [
            run_render(folder, size, MANY_SAMPLES)[0] - run_render(folder, size, SAMPLES)[0]
            for _ in range(TIMING_REPEATS)
        ]
    measured = options.size**2 * (MANY_SAMPLES - SAMPLES) / statistics.median(extra)
    figures = [
        {
            "samples": samples,
            "told_paths_per_s": timing["paths_per_s"],
            "measured_paths_per_s": measured,
            "told_over_measured": timing["paths_per_s"] / measured,
        }
        for samples, timing in told.items()
    ]
    print_rows("--timing, beside the time of whole processes", figures)
    return {"size": options.size, "extra_s": extra, "cases": figures}


def run_render(folder: Path, size: str, samples: int, *more: str) -> tuple[float, str]:
    """Seconds and output of `diffdisp render`, with a cache folder of its own."""
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    env["XDG_CACHE_HOME"] = str(folder)
    command = [sys.executable, "-m", "diffdisp", "render", str(folder / "scene.toml")]
    command += ["-o", str(folder / "out.png"), "--size", size, "--samples", str(samples), *more]
    start = time.perf_counter()
    done = subprocess.run(command, check=True, env=env, stdout=subprocess.PIPE, text=True)
    return time.perf_counter() - start, done.stdout


def print_rows(title: str, rows: list[dict[str, Any]]) -> None:
    """A table of rows that have the same keys."""
    print(f"\n{title}")
    print_table(list(rows[0]), [list(row.values()) for row in rows])


# All of it.


def earlier_figures() -> dict[str, Any]:
    """Those of the parts recorded before, if on the same machine and of the same versions."""
    path = RESULTS / f"{NAME}.json"
    if not path.exists():
        return {}
    record = json.loads(path.read_text())
    same = record["machine"] == machine() and record["versions"] == versions()
    return record["figures"] if same else {}


def measure(part: str, options: argparse.Namespace) -> dict[str, Any] | None:
    """The figures of a part; None if its peer is not installed."""
    if part == "timing":
        return check_timing(options)
    peer = start_peer(part, getattr(options, f"{part}_python"))
    if peer is None:
        return None
    compare = {"mitsuba": compare_mitsuba, "raysect": compare_raysect}[part]
    try:
        return compare(peer, options)
    finally:
        peer.close()


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    parts = (*RENDERERS, "timing")
    add("--only", choices=parts, help="this part alone; what is recorded of the others stays")
    for name, title in TITLES.items():
        add(f"--{name}-python", metavar="PATH", default=sys.executable, help=f"that has {title}")
    add("--size", type=int, default=1000, help="pixels along each edge, beside Mitsuba")
    add("--pairs", type=int, default=7, help="of renders, ours and Mitsuba's")
    add("--ball-size", type=int, default=256, help="pixels along each edge, beside raysect")
    add("--worker", choices=RENDERERS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        serve(options.worker)
        return
    date = datetime.now(UTC).date().isoformat()
    found = {
        part: {"date": date, **figures}
        for part in ([options.only] if options.only else parts)
        if (figures := measure(part, options))
    }
    if found:
        settings = {"samples": SAMPLES, "depth": DEPTH, "dtype": "float32", "pairs": options.pairs}
        settings |= {"ball_samples": BALL_SAMPLES, "variant": VARIANT}
        write_record(NAME, settings, earlier_figures() | found)


if __name__ == "__main__":
    main()
