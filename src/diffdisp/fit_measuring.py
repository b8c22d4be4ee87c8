"""What accuracy costs a fit: error and time of its answer over the knobs of the renderer."""

import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffdisp.chunks import check_glasses, film_range
from diffdisp.dispersion import Sellmeier
from diffdisp.fitting import COLOR_WAVELENGTHS, FitResult, block_means, fit, glass_object
from diffdisp.image import Picture, read_picture, replacing, write_picture
from diffdisp.measuring import REFERENCE, Tradeoff, alone, each_once
from diffdisp.planning import make_plan
from diffdisp.presets import MOST_FITTED
from diffdisp.programs import COMPILER_OPTIONS, surroundings
from diffdisp.rendering import render
from diffdisp.scene import Scene, object_glass, with_glass
from diffdisp.scene_file import load_scene, save_scene
from diffdisp.timing import peak_memory_mb, warm_times
from diffdisp.tolerance import FALL, correlation, difference, relative, rms

MIDDLE = 4
"""Samples per pixel at which, and at four times which, the other knobs are turned."""

DEPTHS, EVERY, SHRINKS = (4, 8), (2, 4), (2, 4)
"""Segments of a path; of how many bands one is used; by which a picture's edges are shorter."""

LEAST_BANDS = 3
"""That are left where not every band is used."""

WARM_FITS, LONG_S = 3, 20.0
"""Fits whose median is told as the time of one; a longer one is not repeated."""


@dataclass(frozen=True)
class FitSetting:
    """Where the knobs of a fit are.

    Args:
        samples: per pixel; 0 for what the fit chooses.
        depth: segments a path may have.
        every: of how many bands of the target one is used.
        shrink: by which the target's edges are shorter: its pixels are averaged.
    """

    samples: int
    depth: int
    every: int = 1
    shrink: int = 1


@dataclass(frozen=True)
class FitMeasured:
    """What one setting gives and takes.

    Args:
        n_d: the answer.
        n_d_std: its error, as the fit tells it: mostly what the target's noise leaves open.
        n_d_error: difference of n_d from the reference's, a fit of the same target.
        n_error: the same of n(λ), root mean square over the target's bands.
        slope_error: of the picture's derivative in n² − 1, relative root mean square; NaN where
            the fit chooses the samples.
        converged: 1, or 0.
        compile_s: time of the first fit beyond that of a later one.
        fit_s: time of a fit, median of three.
        cpu_s: the same of all cores together.
        peak_memory_mb: of a process that does this alone.
    """

    n_d: float
    n_d_std: float
    n_d_error: float
    n_error: float
    slope_error: float
    converged: int
    compile_s: float
    fit_s: float
    cpu_s: float
    peak_memory_mb: float

    @property
    def cost(self) -> tuple[float, float]:
        """Time and error."""
        return self.fit_s, self.n_d_error


class _Fitted(NamedTuple):
    """What a fit found.

    Args:
        n_d: the answer.
        n: at the wavelengths of the comparison.
        slope: (height, width, channels) of the picture; empty where it is not known.
        told: the rest of a row.
    """

    n_d: float
    n: np.ndarray
    slope: np.ndarray
    told: dict[str, float]


def fit_grid(scene: Scene, target: Picture, most: int, depth: int) -> tuple[FitSetting, ...]:
    """The settings to measure: samples, the fit's own choice, and one knob at a time.

    Args:
        scene: as in `fit`.
        target: as in `fit`.
        most: as in `fit_tradeoff`.
        depth: as in `fit_tradeoff`.
    """
    counts = [1 << power for power in range(most.bit_length()) if 1 << power <= most]
    middles = [count for count in (MIDDLE, 4 * MIDDLE) if count <= most] or counts[-1:]
    found = [FitSetting(samples, depth) for samples in counts] + [FitSetting(0, depth)]
    height, width, channels = target.radiance.shape
    whole = target.ceiling is None or not np.any(target.radiance >= target.ceiling)
    for samples in middles:
        base = FitSetting(samples, depth)
        found += [replace(base, depth=few) for few in DEPTHS if few < depth]
        if target.wavelengths is not None:
            found += [
                replace(base, every=every) for every in EVERY if channels >= every * LEAST_BANDS
            ]
        found += [
            replace(base, shrink=shrink)
            for shrink in SHRINKS
            # A mean says nothing of values that were cut off.
            if whole and height % shrink == 0 and width % shrink == 0
        ]
    return tuple(found)


def fit_tradeoff(
    scene: Scene,
    target: Picture,
    folder: str | os.PathLike[str],
    *,
    object_name: str | None = None,
    most: int = MOST_FITTED,
    depth: int = 50,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Tradeoff:
    """Measure what the accuracy of a fit costs.

    All fits are of the same target, and so is the one that they are compared with: what differs is
    what the settings do to the answer, not what the target's noise does. Each is done by a process
    of its own, and kept in the folder, as in `measuring.tradeoff`.

    Args:
        scene: as in `fit`: with the glass to start from.
        target: as in `fit`. How it says that it was drawn does not matter here.
        folder: exists; `tradeoff.csv` and `reference.npz` go there.
        object_name: as in `fit`.
        most: samples per pixel of the best fits.
        depth: segments of the best fits' paths.
        seed: of their pictures.
        progress: called with the settings done and their number. An exception that it raises stops
            the work.

    Raises:
        ValueError: as in `fit`.
        RuntimeError: a process that measures failed.
    """
    folder = Path(folder)
    glass_object(scene, object_name)
    check_glasses(scene, *film_range(target.film))
    settings = fit_grid(scene, target, most, depth)
    with tempfile.TemporaryDirectory() as scratch:
        saved = Path(scratch) / "scene.toml"
        save_scene(scene, saved)
        held = hashlib.sha256(np.ascontiguousarray(target.radiance).tobytes())
        held.update(repr((target.wavelengths, target.ceiling)).encode())
        text = saved.read_text(encoding="utf-8")
        asked = [text, object_name, held.hexdigest(), most, depth, seed]
        key = hashlib.sha256(f"{json.dumps(asked)} {surroundings()}".encode()).hexdigest()
        fitting = _Fitting(saved, replace(target, seed=seed), object_name, Path(scratch))

        def fit_reference() -> _Fitted:
            return _reference(fitting, folder / "reference.npz", key, REFERENCE * most, depth)

        def measure(setting: FitSetting, best: _Fitted) -> FitMeasured:
            return _compared(fitting.alone(setting, WARM_FITS), setting, best)

        _, measured = each_once(
            folder, key, settings, FitMeasured, fit_reference, measure, progress
        )
    finest = 1 << most.bit_length() - 1  # the most that stand among the settings
    alike = correlation(make_plan(scene, target.film, most, depth, "float64"))
    apart = measured[settings.index(FitSetting(finest, depth))].n_d_error
    own = apart / difference(finest, REFERENCE * most, alike) * (REFERENCE * most / finest) ** -FALL
    return Tradeoff(settings, measured, own, REFERENCE * most, target.film)


def _compared(found: _Fitted, setting: FitSetting, best: _Fitted) -> FitMeasured:
    """A row: what a setting finds beside the reference."""
    slope_error = float("nan")
    if found.slope.size:
        true = _shrunk(best.slope[..., :: setting.every], setting.shrink)
        slope_error = relative(rms(found.slope - true), rms(true))
    n_error = rms(found.n - best.n)
    errors = {"n_d_error": abs(found.n_d - best.n_d), "n_error": n_error}
    told: dict[str, Any] = {**errors, "slope_error": slope_error, **found.told}
    return FitMeasured(n_d=found.n_d, **told)


def _shrunk(
    values: Float[np.ndarray, "height width channels"], shrink: int
) -> Float[np.ndarray, "rows columns channels"]:
    """Means of squares of pixels."""
    height, width, channels = values.shape
    return block_means(shrink, values).reshape(height // shrink, width // shrink, channels)


def _reference(fitting: "_Fitting", path: Path, key: str, samples: int, depth: int) -> _Fitted:
    """The fit that all others are compared with."""
    try:
        with np.load(path) as stored:
            if str(stored["key"]) == key:
                return _Fitted(float(stored["n_d"]), stored["n"], stored["slope"], {})
    except Exception:  # whatever is wrong with what was kept, it can be found again
        pass
    best = fitting.alone(FitSetting(samples, depth), 0)
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez(file, n_d=best.n_d, n=best.n, slope=best.slope, key=key)
    return best


class _Fitting(NamedTuple):
    """What every setting fits.

    Args:
        scene: a file.
        target: the whole of it.
        object_name: as in `fit`.
        scratch: a folder.
    """

    scene: Path
    target: Picture
    object_name: str | None
    scratch: Path

    def alone(self, setting: FitSetting, warm: int) -> _Fitted:
        """The fit of a setting by a process of its own, and so many more for its time.

        Raises:
            RuntimeError: the process failed.
        """
        target, output = self.scratch / "target.npz", self.scratch / "found.npz"
        waves = self.target.wavelengths
        used = replace(
            self.target,
            radiance=_shrunk(self.target.radiance, setting.shrink)[..., :: setting.every],
            wavelengths=None if waves is None else waves[:: setting.every],
            samples=setting.samples or None,
            depth=setting.depth,
        )
        write_picture(target, used)
        at = COLOR_WAVELENGTHS if waves is None else waves
        files = {"scene": str(self.scene), "target": str(target), "output": str(output)}
        asked = files | {
            "object": self.object_name,
            "ceiling": self.target.ceiling,
            "warm": warm,
            "at": np.asarray(at).tolist(),
        }
        program = "from diffdisp.fit_measuring import main; main()"
        what = f"a fit with {setting}"
        told = json.loads(alone(what, ["-c", program], self.scratch, json.dumps(asked)))
        with np.load(output) as stored:
            return _Fitted(told.pop("n_d"), stored["n"], stored["slope"], told)


def main() -> None:
    """One setting, as `_Fitting.alone` asks for on standard input; its times go to the output."""
    asked = json.load(sys.stdin)
    try:
        told = _one(asked)
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    print(json.dumps(told))


def _one(asked: dict[str, Any]) -> dict[str, float]:
    """The numbers of a row that a setting's fit tells; the rest goes to a file."""
    scene, target = load_scene(asked["scene"]), read_picture(asked["target"])
    target = replace(target, ceiling=asked["ceiling"])
    name = asked["object"]

    def fitted() -> FitResult:
        result = fit(scene, target, object_name=name)
        if result.stopped:  # by Ctrl-C: it is no row
            raise KeyboardInterrupt
        return result

    start = time.perf_counter()
    result = fitted()
    told = {"n_d": result.n_d}
    if asked["warm"]:
        first = time.perf_counter() - start
        _, wall, cpu = warm_times(fitted, asked["warm"], LONG_S)
        told |= {
            "n_d_std": result.n_d_std,
            "converged": int(result.converged),
            "compile_s": max(first - wall, 0.0),
            "fit_s": wall,
            "cpu_s": cpu,
            "peak_memory_mb": peak_memory_mb(),
        }
    slope = np.zeros(0)
    if target.samples is not None:
        slope = _slope(scene, target, glass_object(scene, name))
    with jax.enable_x64(True):
        n = np.asarray(result.glass.indices(np.array(asked["at"])))
    np.savez(asked["output"], n=n, slope=slope)
    return told


def _slope(
    scene: Scene, target: Picture, number: int
) -> Float[np.ndarray, "height width channels"]:
    """How the picture of the start changes as n² − 1 grows by a part, at all wavelengths alike."""
    glass = object_glass(scene, number)

    def picture(part: jax.Array) -> jax.Array:
        more = Sellmeier(jnp.asarray(glass.B) * (1.0 + part), glass.C)
        knobs: dict[str, Any] = {"samples": target.samples, "depth": target.depth or 50}
        return jnp.asarray(
            render(with_glass(scene, number, more), target.film, dtype="float64", **knobs)
        )

    def pushed(part: jax.Array) -> jax.Array:
        return jax.jvp(picture, (part,), (jnp.ones_like(part),))[1]

    with jax.enable_x64(True):
        compiled = jax.jit(pushed, compiler_options=COMPILER_OPTIONS)
        return np.asarray(compiled(jnp.zeros(())))
