"""The fit to another renderer's picture: how right it is, and how long it takes.

In this process nothing compiled is kept between runs, so the first fit compiles and the second
does not. The command line keeps what it compiled: it is timed twice on a fresh cache folder.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from record import ROOT, TARGET_GLASS, TARGET_PICTURE, TARGET_SCENE, print_table, write_record

from diffdisp import FitResult, fit, load_scene, named_glass, read_picture


def timed_fit() -> tuple[FitResult, float]:
    """The fit, and its seconds in this process."""
    scene, target = load_scene(str(TARGET_SCENE)), read_picture(str(TARGET_PICTURE))
    start = time.perf_counter()
    result = fit(scene, target)
    return result, time.perf_counter() - start


def errors(result: FitResult) -> dict[str, float]:
    """Deviations from the true glass; z is a deviation over its reported standard deviation."""
    with jax.enable_x64(True):
        glass = named_glass(TARGET_GLASS)
        n_d, V_d = float(glass.n_d), float(glass.V_d)
        delta_n = result.n - np.asarray(glass.indices(result.wavelengths))
    return {
        "n_max": float(np.max(np.abs(delta_n))),
        "n_max_z": float(np.max(np.abs(delta_n) / result.n_std)),
        "n_d": result.n_d - n_d,
        "n_d_std": result.n_d_std,
        "n_d_z": (result.n_d - n_d) / result.n_d_std,
        "V_d": result.V_d - V_d,
        "V_d_std": result.V_d_std,
        "V_d_z": (result.V_d - V_d) / result.V_d_std,
    }


def process_seconds(arguments: list[str], cache: Path) -> float:
    """Wall time of `python -m diffdisp` with a cache folder of its own."""
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    env["XDG_CACHE_HOME"] = str(cache)
    command = [sys.executable, "-m", "diffdisp", *arguments]
    start = time.perf_counter()
    subprocess.run(command, check=True, env=env, cwd=ROOT, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def process_times(help_runs: int) -> dict[str, float]:
    """Seconds of whole processes: the fit on a cold and on a warm cache, and the help."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arguments = ["fit", str(TARGET_SCENE), str(TARGET_PICTURE), "-o", str(folder / "fit")]
        cold, warm = (process_seconds(arguments, folder / "cache") for _ in range(2))
        helps = [process_seconds(["--help"], folder / "cache") for _ in range(help_runs)]
    return {
        "process_cold_s": cold,
        "process_warm_s": warm,
        "help_s": statistics.median(helps),
    }


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--help-runs", type=int, default=5, help="of --help, for the median")
    options = parser.parse_args()
    jax.config.update("jax_compilation_cache_dir", None)
    result, cold = timed_fit()
    again, warm = timed_fit()
    figures = {
        **errors(result),
        "converged": result.converged,
        "message": result.message,
        "steps": result.steps,
        "samples": list(result.samples),
        "rms_residual": result.rms_residual,
        "same_again": bool(np.array_equal(result.n, again.n)),
        "fit_cold_s": cold,
        "fit_warm_s": warm,
        **process_times(options.help_runs),
    }
    print_table(("figure", "value"), list(figures.items()))
    write_record("fit_target", {"help_runs": options.help_runs}, figures)


if __name__ == "__main__":
    main()
