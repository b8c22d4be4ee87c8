"""How the time of a render grows with the size of the picture and with the number of spheres.

Scenes of 2 to 16 spheres at two fields of view, on one core and on all; beside them what was
published of the C++ ray tracer that diffdisp grew from. A process of its own measures on each
number of cores, and another the memory that the largest picture takes. Also draws
results/size_and_objects.png.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from record import RESULTS, ROOT, print_table, write_record
from seed_scenes import COUNTS, DEPTH, EFFECTIVE_FOV, NOMINAL_FOV, SAMPLES, make_scene

SIZES = (100, 200, 500, 1000, 2000)
"""Pixels along each edge."""
FIELDS_OF_VIEW = (EFFECTIVE_FOV, NOMINAL_FOV)
"""The first one warms up: there most of a picture is sky, which takes less time."""
LARGE = 500
"""From this edge on the fixed costs of a picture hardly count, pixels."""
SHORT = 0.3
"""Renders below this many seconds are repeated more often."""
MORE_RUNS = 2
"""How much more often."""
KNOBS: dict[str, Any] = {"samples": SAMPLES, "depth": DEPTH, "dtype": "float32"}
SERIAL, PARALLEL = "one core", "all cores"

ORIGINAL_SIZE, ORIGINAL_COUNT = 2000, 16
"""What the figures below are of, at `EFFECTIVE_FOV`; 120 million rays of one channel."""
ORIGINAL = {
    "published, on its laptop": {SERIAL: 102.328, PARALLEL: 31.217},
    "compiled with -O3, on 2 cores": {SERIAL: 14.0, PARALLEL: 8.4},
}
"""Seconds of the original: its timing study, and its program run again."""

Rows = list[dict[str, Any]]


# In the processes that measure.


def timed_render(count: int, vertical_fov: float, size: int) -> tuple[float, float]:
    """Seconds of one render: on the wall, and of all cores together."""
    from diffdisp import Film, render

    scene, film = make_scene(count, vertical_fov), Film(size, size)
    wall, cpu = time.perf_counter(), time.process_time()
    render(scene, film, **KNOBS)
    return time.perf_counter() - wall, time.process_time() - cpu


def compile_all(sizes: list[int], counts: list[int]) -> None:
    """Compile what draws these pictures; a program is that of all fields of view."""
    from diffdisp import Film
    from diffdisp.rendering import compile_ahead

    for count in counts:
        for size in sizes:
            compile_ahead(make_scene(count, FIELDS_OF_VIEW[0]), Film(size, size), **KNOBS)


def measure_one(count: int, vertical_fov: float, size: int, runs: int) -> dict[str, Any]:
    """Medians of warm renders of one scene at one size."""
    times = [timed_render(count, vertical_fov, size)]
    wanted = runs + (MORE_RUNS if times[0][0] < SHORT else 0)
    times += [timed_render(count, vertical_fov, size) for _ in range(wanted - 1)]
    wall, cpu = (statistics.median(column) for column in zip(*times, strict=True))
    paths = size * size * SAMPLES
    return {
        "spheres": count,
        "vertical_fov": vertical_fov,
        "size": size,
        "wall_s": wall,
        "cpu_s": cpu,
        "paths_per_s": paths / wall,
        "cpu_ns_per_path": 1e9 * cpu / paths,
        "runs": wanted,
    }


def serve_times(sizes: list[int], counts: list[int], runs: int) -> None:
    """Compile, wait to be asked, and measure: a line of JSON for each scene and size."""
    compile_all(sizes, counts)
    print(json.dumps("compiled"), flush=True)
    sys.stdin.readline()
    for count in counts:
        for size in sizes:
            timed_render(count, FIELDS_OF_VIEW[0], size)  # warms up
            for vertical_fov in FIELDS_OF_VIEW:
                print(json.dumps(measure_one(count, vertical_fov, size, runs)), flush=True)


def serve_memory(size: int, count: int) -> None:
    """Tell what a render takes beyond a JAX that has compiled something, as a line of JSON."""
    import jax

    jax.jit(lambda x: x + 1)(np.float32(0)).block_until_ready()
    before = resident_mib("VmRSS")
    timed_render(count, EFFECTIVE_FOV, size)
    peak = resident_mib("VmHWM")
    print(json.dumps({"jax_mib": before, "peak_mib": peak, "render_mib": peak - before}))


def resident_mib(field: str) -> float:
    """Memory of this process: VmRSS is its present one, VmHWM the most that it has been."""
    # ru_maxrss would not do: a process begins with that of the one that started it.
    lines = Path("/proc/self/status").read_text().splitlines()
    kib = next(line.split()[1] for line in lines if line.startswith(field + ":"))
    return int(kib) / 1024


# In the process that asks.


def start(worker: str, words: list[str], cores: set[int] | None = None) -> subprocess.Popen[str]:
    """This script in a process of its own.

    Args:
        worker: what it does, "times" or "memory".
        words: of the command line.
        cores: those that it may use; None for all.
    """

    def pin() -> None:
        if cores is not None:
            os.sched_setaffinity(0, cores)

    command = [sys.executable, __file__, "--worker", worker, *words]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen(command, text=True, preexec_fn=pin, **pipes)


def answer(process: subprocess.Popen[str]) -> Any:
    """Its next line; None after the last."""
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line and process.wait():
        raise SystemExit(f"the process that measures failed: status {process.returncode}")
    return json.loads(line) if line else None


def measure_times(options: argparse.Namespace) -> Rows:
    """All rows, on one core and on all."""
    words = ["--sizes", *map(str, options.sizes), "--counts", *map(str, options.counts)]
    words += ["--runs", str(options.runs)]
    modes: dict[str, set[int] | None] = {PARALLEL: None}
    if hasattr(os, "sched_setaffinity"):
        modes = {SERIAL: {min(os.sched_getaffinity(0))}, **modes}
    else:
        print("this system ties no process to a core: measured on all cores only")
    # XLA compiles another program for another number of cores. To save time they compile side by
    # side, but then they measure one after the other.
    processes = {mode: start("times", words, cores) for mode, cores in modes.items()}
    for process in processes.values():
        answer(process)
    return [
        {"cores": mode, **row}
        for mode, process in processes.items()
        for row in measured(process, mode)
    ]


def measured(process: subprocess.Popen[str], mode: str) -> Iterator[dict[str, Any]]:
    """The rows of a process, which begins when it is asked."""
    assert process.stdin is not None
    process.stdin.close()
    while row := answer(process):
        tell(f"{mode}: {row['spheres']} spheres, {row['size']} pixels, {row['wall_s']:.3g} s")
        yield row


def tell(message: str) -> None:
    """Say how far the study is, on a terminal."""
    if sys.stderr.isatty():
        print(message, file=sys.stderr)


def measure_memory(options: argparse.Namespace) -> dict[str, Any] | None:
    """Memory of the largest picture of the most spheres; None where the system does not tell."""
    if not Path("/proc/self/status").exists():
        return None
    size, count = max(options.sizes), max(options.counts)
    words = ["--sizes", str(size), "--counts", str(count)]
    found = answer(start("memory", words))
    return {"size": size, "spheres": count, "vertical_fov": EFFECTIVE_FOV, **found}


def groups(rows: Rows, *keys: str) -> Iterator[tuple[tuple[Any, ...], Rows]]:
    """The rows that agree in `keys`, in the order in which they come."""
    found: dict[tuple[Any, ...], Rows] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    yield from found.items()


def slope(x: list[float], y: list[float]) -> float | None:
    """Of the straight line through some points; None of fewer than two."""
    return float(np.polyfit(x, y, 1)[0]) if len(x) > 1 else None


def growth_with_size(rows: Rows) -> Rows:
    """Exponents p of time ∝ pixelsᵖ for each number of spheres, of large pictures and of all."""
    found = []
    for (mode, fov, count), some in groups(rows, "cores", "vertical_fov", "spheres"):
        figures: dict[str, Any] = {"cores": mode, "vertical_fov": fov, "spheres": count}
        for name, least in (("exponent_large", LARGE), ("exponent_all", 0)):
            kept = [row for row in some if row["size"] >= least]
            pixels = [math.log(row["size"] ** 2) for row in kept]
            figures[name] = slope(pixels, [math.log(row["wall_s"]) for row in kept])
        found.append(figures)
    return found


def growth_with_objects(rows: Rows) -> Rows:
    """Time of the cores per path that each further sphere costs, for each size."""
    found = []
    for (mode, fov, size), some in groups(rows, "cores", "vertical_fov", "size"):
        counts = [row["spheres"] for row in some]
        cost = slope(counts, [row["cpu_ns_per_path"] for row in some])
        figures = {"cores": mode, "vertical_fov": fov, "size": size}
        found.append(figures | {"cpu_ns_per_path_and_sphere": cost})
    return found


def beside_original(rows: Rows) -> Rows:
    """Seconds of the original and of diffdisp, where the study holds the same picture."""
    same = {"spheres": ORIGINAL_COUNT, "size": ORIGINAL_SIZE, "vertical_fov": EFFECTIVE_FOV}
    ours = {row["cores"]: row["wall_s"] for row in rows if same.items() <= row.items()}
    return [
        {"original": name, "cores": mode, "original_s": theirs, "ours_s": ours[mode]}
        | {"times_faster": theirs / ours[mode]}
        for name, published in ORIGINAL.items()
        for mode, theirs in published.items()
        if mode in ours
    ]


def print_rows(title: str, rows: Rows) -> None:
    """A table of rows that have the same keys."""
    if rows:
        print(f"\n{title}")
        values = [["–" if value is None else value for value in row.values()] for row in rows]
        print_table(list(rows[0]), values)


def draw(rows: Rows, path: Path) -> None:
    """Two panels for each field of view: time against pixels, and against spheres."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fovs = sorted({row["vertical_fov"] for row in rows})
    figure, axes = plt.subplots(
        len(fovs), 2, figsize=(11, 4.5 * len(fovs)), squeeze=False, layout="constrained"
    )
    for (by_pixels, by_spheres), fov in zip(axes, fovs, strict=True):
        shown = [row for row in rows if row["vertical_fov"] == fov]
        draw_by_pixels(by_pixels, shown)
        draw_by_spheres(by_spheres, shown)
        by_pixels.set_title(f"vertical field of view {fov:.4g}°")
        if fov == EFFECTIVE_FOV:
            draw_original(by_pixels)
        by_pixels.legend(fontsize="small")
        by_spheres.legend(fontsize="small")
    figure.suptitle(
        f"{SAMPLES} samples per pixel, depth {DEPTH}; dashed: {SERIAL}, full: {PARALLEL}"
    )
    figure.savefig(path, dpi=120)
    plt.close(figure)
    print(f"written: {path.relative_to(ROOT)}")


def draw_by_pixels(axes: Any, rows: Rows) -> None:
    """Time against pixels, a line for each number of spheres."""
    colors = {count: f"C{i}" for i, count in enumerate(sorted({r["spheres"] for r in rows}))}
    for (mode, count), some in groups(rows, "cores", "spheres"):
        pixels, seconds = [r["size"] ** 2 for r in some], [r["wall_s"] for r in some]
        label = f"{count} spheres" if mode == PARALLEL else None
        axes.loglog(pixels, seconds, line_style(mode), color=colors[count], label=label)
    axes.set(xlabel="pixels", ylabel="seconds")
    axes.grid(alpha=0.3)


def draw_by_spheres(axes: Any, rows: Rows) -> None:
    """Time against the number of spheres, of the largest pictures."""
    size = max(row["size"] for row in rows)
    for (mode,), some in groups([row for row in rows if row["size"] == size], "cores"):
        counts, seconds = [r["spheres"] for r in some], [r["wall_s"] for r in some]
        axes.plot(counts, seconds, line_style(mode), color="C0", label=mode)
    axes.set(xlabel="spheres", ylabel="seconds", ylim=(0, None), title=f"{size} × {size} pixels")
    axes.grid(alpha=0.3)


def draw_original(axes: Any) -> None:
    """The figures of the original: hollow on one core, full on all."""
    for (name, published), marker in zip(ORIGINAL.items(), "*D", strict=True):
        for mode, seconds in published.items():
            hollow = {"markerfacecolor": "none"} if mode == SERIAL else {}
            label = f"original, 16 spheres: {name}" if mode == PARALLEL else None
            style = {"color": "black", "linestyle": "none", "label": label, **hollow}
            axes.plot([ORIGINAL_SIZE**2], [seconds], marker, **style)


def line_style(mode: str) -> str:
    """How a number of cores is drawn."""
    return "o--" if mode == SERIAL else "o-"


def report(options: argparse.Namespace, rows: Rows, memory: dict[str, Any] | None) -> None:
    """Print, record, draw."""
    figures = {
        "times": rows,
        "growth_with_size": growth_with_size(rows),
        "growth_with_objects": growth_with_objects(rows),
        "beside_original": beside_original(rows),
        "memory": memory,
    }
    print_rows("Time of a render", rows)
    print_rows("Time grows as pixels to the power of", figures["growth_with_size"])
    print_rows("Each further sphere costs", figures["growth_with_objects"])
    print_rows("Beside the original", figures["beside_original"])
    print_rows("Memory beyond an idle JAX", [memory] if memory else [])
    settings = {"sizes": options.sizes, "counts": options.counts, "runs": options.runs, **KNOBS}
    write_record("size_and_objects", settings, figures)
    draw(rows, RESULTS / "size_and_objects.png")


def main() -> None:
    """Measure, print, record, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--sizes", type=int, nargs="+", default=list(SIZES), help="pixels along each edge")
    add("--counts", type=int, nargs="+", default=list(COUNTS), choices=COUNTS, help="spheres")
    add("--runs", type=int, default=3, help="for each median; 2 more of short renders")
    add("--worker", choices=("times", "memory"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        serve(options)
        return
    rows = measure_times(options)
    report(options, rows, measure_memory(options))


def serve(options: argparse.Namespace) -> None:
    """Measure in this process, without what earlier ones compiled."""
    import jax

    jax.config.update("jax_compilation_cache_dir", None)
    if options.worker == "times":
        serve_times(options.sizes, options.counts, options.runs)
    else:
        serve_memory(options.sizes[0], options.counts[0])


if __name__ == "__main__":
    main()
