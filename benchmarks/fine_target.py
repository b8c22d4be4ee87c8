"""How right a fit to a large noisy picture is: 256 x 256 pixels, 16 bands, 1 % noise.

The picture before noise is drawn once, with samples of another grid than the fit's, and kept in
`out/` for later runs. At this size the noise leaves a few 1e-6 of n_d, so that errors of the
fit's own render show: each noise seed adds a deviation over its reported standard deviation, z.
"""

import argparse
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from record import ROOT, TARGET_GLASS, TARGET_SCENE, print_table, write_record

from diffdisp import Film, Picture, band_middles, fit, load_scene, named_glass, render, with_glass

BALL = 0
"""Number of the ball among the objects of the bench."""
WANTED = 1e-5
"""Of |Δn_d|."""


def clean_picture(film: Film, samples: int) -> tuple[np.ndarray, float]:
    """The picture before noise, and the seconds to draw it; 0 where it was kept."""
    name = f"fine_target_{film.width}x{film.height}x{film.channels}_{samples}.npy"
    kept = ROOT / "out" / name
    if kept.exists():
        return np.load(kept), 0.0
    scene = with_glass(load_scene(str(TARGET_SCENE)), BALL, named_glass(TARGET_GLASS))
    begun = time.perf_counter()
    radiance = np.asarray(render(scene, film, samples=samples, dtype="float64"))
    seconds = time.perf_counter() - begun
    _keep(kept, radiance)
    return radiance, seconds


def _keep(path: Path, radiance: np.ndarray) -> None:
    """Write beside and rename, so that an interrupted run leaves nothing half written."""
    path.parent.mkdir(exist_ok=True)
    beside = path.with_name("unfinished_" + path.name)
    np.save(beside, radiance)
    beside.rename(path)


def fitted(clean: np.ndarray, film: Film, options: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Deviations of one fit from the truth, and its seconds."""
    noisy = clean + np.random.default_rng(seed).normal(0.0, options.noise, clean.shape)
    target = Picture(noisy, np.asarray(film.wavelengths))
    glass = named_glass(TARGET_GLASS)
    begun, cpu = time.perf_counter(), time.process_time()
    result = fit(load_scene(str(TARGET_SCENE)), target, noise=options.noise)
    seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu
    with jax.enable_x64(True):
        n_d, V_d = float(glass.n_d), float(glass.V_d)
        off = result.n - np.asarray(glass.indices(result.wavelengths))
    return {
        "seed": seed,
        "n_d": result.n_d - n_d,
        "n_d_std": result.n_d_std,
        "n_d_z": (result.n_d - n_d) / result.n_d_std,
        "V_d": result.V_d - V_d,
        "V_d_z": (result.V_d - V_d) / result.V_d_std,
        "n_max": float(np.max(np.abs(off))),
        "n_z_rms": float(np.sqrt(np.mean((off / result.n_std) ** 2))),
        "converged": result.converged,
        "steps": result.steps,
        "samples": list(result.samples),
        "rms_residual": result.rms_residual,
        "seconds": seconds,
        "cpu_s": cpu,
    }


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--size", type=int, default=256, help="pixels along each edge")
    add("--bands", type=int, default=16, help="equal ones from 400 to 700 nm")
    add("--noise", type=float, default=0.01, help="standard deviation; the brightest tile has 1")
    add("--samples", type=int, default=1024, help="per pixel, of the picture before noise")
    add("--repeats", type=int, default=5, help="noise seeds")
    options = parser.parse_args()
    jax.config.update("jax_compilation_cache_dir", None)  # so that a first fit compiles
    film = Film(options.size, options.size, band_middles(400.0, 700.0, options.bands))
    clean, drawing = clean_picture(film, options.samples)
    print(f"drawn in {drawing:.0f} s", file=sys.stderr, flush=True)
    fits = []
    for seed in range(options.repeats):
        fits.append(fitted(clean, film, options, seed))
        last = fits[-1]
        print(
            f"seed {seed}: Δn_d {last['n_d']:.2e}, z {last['n_d_z']:.2f}, {last['seconds']:.0f} s",
            file=sys.stderr,
            flush=True,
        )
    head = ("seed", "n_d", "n_d_std", "n_d_z", "V_d_z", "n_max", "n_z_rms", "steps", "seconds")
    print_table(head, [[f[key] for key in head] for f in fits])
    figures = {
        "within_wanted": sum(f["converged"] and abs(f["n_d"]) <= WANTED for f in fits),
        "fits": len(fits),
        "n_d_median": statistics.median(abs(f["n_d"]) for f in fits),
        "n_d_worst": max(abs(f["n_d"]) for f in fits),
        "n_d_mean": statistics.mean(f["n_d"] for f in fits),
        "n_d_std": statistics.median(f["n_d_std"] for f in fits),
        "drawing_s": drawing,
        "first_s": fits[0]["seconds"],
        "warm_s": statistics.median(f["seconds"] for f in fits[1:]) if fits[1:] else None,
        "cpu_s": statistics.median(f["cpu_s"] for f in fits),
    }
    print_table(("figure", "value"), list(figures.items()))
    write_record("fine_target", vars(options), figures | {"each": fits})


if __name__ == "__main__":
    main()
