"""What accuracy costs: error and time of a picture over the knobs of the renderer."""

import csv
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from diffdisp.chunks import check_glasses, film_range
from diffdisp.color import VISIBLE
from diffdisp.film import Film, band_middles
from diffdisp.image import Picture, linear_rgb, read_picture, replacing
from diffdisp.planning import make_plan
from diffdisp.presets import PRESETS
from diffdisp.programs import surroundings
from diffdisp.rendering import render
from diffdisp.scene import Scene
from diffdisp.scene_file import save_scene
from diffdisp.tolerance import FALL, correlation, difference, relative, rms

MIDDLE = 16
"""Samples per pixel at which, and at four times which, the other knobs are turned."""

DEPTHS = (2, 4, 8, 16)
BANDS = (4, 8, 16, 32)
"""Numbers of bands over the visible range that stand for colour."""
SHRINKS = (2, 4)
"""By which a picture is smaller that is blown up again."""

REFERENCE = 4
"""Times as many samples as the best picture has, of the reference; where light scatters, of each
of two whose mean it is."""

KNOWN = 3.0
"""An error is known if it is so many times the reference's own."""


@dataclass(frozen=True)
class Setting:
    """Where the knobs are.

    Args:
        samples: per pixel.
        depth: segments a path may have.
        dtype: float32 or float64.
        bands: that stand for colour; 0 for the film's own bands or colour.
        shrink: by which the picture's edges are shorter, before it is blown up again.
    """

    samples: int
    depth: int
    dtype: str = "float32"
    bands: int = 0
    shrink: int = 1


@dataclass(frozen=True)
class Measured:
    """What one setting gives and takes.

    Args:
        error: root mean square of the picture's error over that of the reference, whose own share
            is taken off.
        delta_e_mean: mean colour difference of the pixels as a screen shows them, CIE ΔE2000; NaN
            for bands that are not visible.
        delta_e_p99: the colour difference that one pixel in a hundred exceeds.
        compile_s: time to compile, once for each kind of scene.
        render_s: time of a render after that, median of five.
        cpu_s: the same of all cores together.
        peak_memory_mb: of a process that does this alone.
    """

    error: float
    delta_e_mean: float
    delta_e_p99: float
    compile_s: float
    render_s: float
    cpu_s: float
    peak_memory_mb: float

    @property
    def cost(self) -> tuple[float, float]:
        """Time and error."""
        return self.render_s, self.error


class Tradeoff(NamedTuple):
    """The measured settings of a scene, or of fits of a picture.

    Args:
        settings: in the order of measuring: `Setting`, or `FitSetting`.
        measured: of each: `Measured`, or `FitMeasured`.
        reference_error: of the reference, over its root mean square; of fits, of its n_d.
        reference_samples: per pixel.
        film: of the pictures.
    """

    settings: tuple[Any, ...]
    measured: tuple[Any, ...]
    reference_error: float
    reference_samples: int
    film: Film

    @property
    def front(self) -> tuple[int, ...]:
        """Numbers of the settings than which none is both faster and nearer, the fastest first."""
        costs, best, found = [row.cost for row in self.measured], np.inf, []
        for number in sorted(range(len(costs)), key=lambda i: costs[i]):
            if costs[number][1] < best:
                best = costs[number][1]
                found.append(number)
        return tuple(found)

    @property
    def sweep(self) -> tuple[int, ...]:
        """Numbers of the settings in which the samples alone differ, and whose errors are known."""
        first = replace(self.settings[0], samples=0)
        return tuple(
            number
            for number, (setting, row) in enumerate(zip(self.settings, self.measured, strict=True))
            if setting.samples
            and replace(setting, samples=0) == first
            and row.cost[1] > KNOWN * self.reference_error
        )

    @property
    def fall(self) -> float:
        """Power of the number of samples by which the error falls."""
        rows = [(float(self.settings[i].samples), self.measured[i].cost[1]) for i in self.sweep]
        return -_slope(rows)

    @property
    def price(self) -> float:
        """Times as long a picture takes whose error is half as large."""
        rows = [self.measured[i].cost[::-1] for i in self.sweep]
        return float(2.0 ** -_slope(rows[len(rows) // 2 :]))  # few samples cost less than the rest

    def fastest(self, error: float) -> int | None:
        """Number of the fastest setting with at most this error, if there is one."""
        return next((i for i in self.front if self.measured[i].cost[1] <= error), None)


def _slope(rows: Sequence[tuple[float, float]]) -> float:
    """Slope of the second over the first of pairs, in logarithms; NaN of fewer than two."""
    if len(rows) < 2:
        return float("nan")
    x, y = np.log(np.array(rows, float)).T
    return float(np.polyfit(x, y, 1)[0])


def knob_grid(scene: Scene, film: Film, most: int, depth: int) -> tuple[Setting, ...]:
    """The settings to measure: the samples at which all else is best, then one knob at a time.

    Args:
        scene: as in `tradeoff`.
        film: as in `tradeoff`.
        most: as in `tradeoff`.
        depth: as in `tradeoff`.
    """
    plan = make_plan(scene, film, 1, depth, "float32")
    counts = [1 << power for power in range(most.bit_length()) if 1 << power <= most]
    middles = [count for count in (MIDDLE, 4 * MIDDLE) if count <= most] or counts[-1:]
    found = [Setting(samples, depth) for samples in counts]
    for samples in middles:
        base = Setting(samples, depth)
        found.append(replace(base, dtype="float64"))
        if plan.first_lamp > 0:  # something sends light on
            found += [replace(base, depth=few) for few in DEPTHS if few < depth]
        if plan.dispersive and film.wavelengths is None:
            found += [replace(base, bands=bands) for bands in BANDS]
        found += [
            replace(base, shrink=shrink)
            for shrink in SHRINKS
            if min(film.width, film.height) >= shrink
        ]
    return tuple(found)


def tradeoff(
    scene: Scene,
    size: tuple[int, int],
    bands: tuple[float, float, int] | None,
    folder: str | os.PathLike[str],
    *,
    most: int = PRESETS["reference"].samples,
    depth: int = 50,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Tradeoff:
    """Measure what the accuracy of a scene's picture costs.

    Each setting is drawn by a process of its own, which compiles it anew. What has been measured is
    kept in the folder, and is not measured again when the same is asked for on the same machine.

    Args:
        scene: as in `render`.
        size: width and height, pixels.
        bands: lowest and highest wavelength in nm, and the number of bands; None for colour.
        folder: exists; `tradeoff.csv` and `reference.npz` go there.
        most: samples per pixel of the best pictures.
        depth: segments of the best pictures' paths.
        seed: of the pictures; the reference takes the next ones.
        progress: called with the settings done and their number. An exception that it raises stops
            the work.

    Raises:
        ValueError: as in `render`.
        RuntimeError: a process that measures failed.
    """
    folder = Path(folder)
    film = Film(*size, None if bands is None else band_middles(*bands))
    check_glasses(scene, *film_range(film))
    settings = knob_grid(scene, film, most, depth)
    with tempfile.TemporaryDirectory() as scratch:
        saved = Path(scratch) / "scene.toml"
        save_scene(scene, saved)
        asked = json.dumps([saved.read_text(encoding="utf-8"), size, bands, most, depth, seed])
        key = hashlib.sha256(f"{asked} {surroundings()}".encode()).hexdigest()
        drawing = _Drawing(saved, size, bands, seed)

        def draw_reference() -> tuple[Picture, float]:
            return _reference(scene, film, folder, key, most, depth, seed)

        def measure(setting: Setting, best: tuple[Picture, float]) -> Measured:
            picture, timing = _drawn(drawing, setting, Path(scratch))
            return Measured(*_errors(picture, *best), **timing)

        (reference, own_error), measured = each_once(
            folder, key, settings, Measured, draw_reference, measure, progress
        )
    assert reference.samples is not None
    return Tradeoff(settings, measured, own_error, reference.samples, film)


# The reference.


def _reference(
    scene: Scene, film: Film, folder: Path, key: str, most: int, depth: int, seed: int
) -> tuple[Picture, float]:
    """A converged picture, and the root mean square of its error over its own."""
    path = folder / "reference.npz"
    kept = _kept_reference(path, key)
    if kept is not None:
        return kept
    radiance, samples, own_error = converged(scene, film, most, depth, seed + 1)
    wavelengths = None if film.wavelengths is None else np.asarray(film.wavelengths)
    arrays: dict[str, Any] = {"radiance": radiance, "samples": samples}
    arrays |= {"error": own_error, "key": key}
    if wavelengths is not None:
        arrays["wavelength"] = wavelengths
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez(file, **arrays)
    return Picture(radiance, wavelengths, samples), own_error


def converged(
    scene: Scene, film: Film, most: int, depth: int, seed: int
) -> tuple[Float[np.ndarray, "height width channels"], int, float]:
    """A picture by which others of at most so many samples are measured.

    Args:
        scene: as in `tradeoff`.
        film: of the picture.
        most: samples per pixel of the others.
        depth: segments of its paths.
        seed: of the first of the two pictures that it takes, the other has the next.

    Returns:
        The radiance; its samples per pixel; the root mean square of its error over its own.
    """
    plan, finest = make_plan(scene, film, most, depth, "float64"), REFERENCE * most
    counts = (finest if plan.scattering else most, finest)
    one, other = (
        np.asarray(render(scene, film, samples=n, depth=depth, seed=seed + k, dtype="float64"))
        for k, n in enumerate(counts)
    )
    apart = rms(one - other)
    if plan.scattering:
        radiance, samples, error = (one + other) / 2, 2 * finest, apart / 2
    else:
        of_first = apart / difference(most, finest, correlation(plan))
        radiance, samples, error = other, finest, of_first * REFERENCE**-FALL
    return radiance, samples, relative(error, rms(radiance))


def _kept_reference(path: Path, key: str) -> tuple[Picture, float] | None:
    """The reference that was drawn for the same before."""
    try:
        with np.load(path) as stored:
            if str(stored["key"]) != key:
                return None
            return read_picture(path), float(stored["error"])
    except Exception:  # whatever is wrong with a kept reference, it can be drawn again
        return None


# One setting.


class _Drawing(NamedTuple):
    """What every setting draws."""

    scene: Path
    size: tuple[int, int]
    bands: tuple[float, float, int] | None
    seed: int


def _drawn(drawing: _Drawing, setting: Setting, scratch: Path) -> tuple[Picture, dict[str, float]]:
    """The picture of a setting, in full size, and what it took.

    Raises:
        RuntimeError: the process that draws it failed.
    """
    output = scratch / "picture.npz"
    width, height = drawing.size
    size = f"{-(-width // setting.shrink)}x{-(-height // setting.shrink)}"
    words: list[object] = ["render", drawing.scene, "-o", output, "--size", size, "--timing"]
    words += ["--samples", setting.samples, "--depth", setting.depth, "--seed", drawing.seed]
    bands = (*VISIBLE, setting.bands) if setting.bands else drawing.bands
    if bands:
        words += ["--bands", ":".join(map(str, bands))]
    if setting.dtype == "float64":
        words.append("--float64")
    command = ["diffdisp", *map(str, words)]
    told = json.loads(alone(" ".join(command), ["-m", *command], scratch))
    picture = read_picture(output)
    if setting.bands:
        picture = Picture(linear_rgb(picture))
    rows, columns = (np.arange(edge) // setting.shrink for edge in (height, width))
    whole = Picture(picture.radiance[rows][:, columns], picture.wavelengths)
    names = [field.name for field in fields(Measured) if field.name in told]
    return whole, {name: told[name] for name in names}


def alone(what: str, words: Sequence[str], scratch: Path, given: str = "") -> str:
    """What a Python process prints that compiles all it runs anew.

    Args:
        what: it does, for the message where it fails.
        words: its arguments.
        scratch: a folder.
        given: its standard input.

    Raises:
        RuntimeError: it failed.
        KeyboardInterrupt: it was interrupted.
    """
    with tempfile.TemporaryDirectory(dir=scratch) as empty:  # there is nothing kept here
        done = subprocess.run(
            [sys.executable, *words],
            input=given,
            env={**os.environ, "JAX_COMPILATION_CACHE_DIR": empty},
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode == 130:
        raise KeyboardInterrupt
    if done.returncode:
        raise RuntimeError(f"{what}: {done.stderr.strip()}")
    return done.stdout


def _errors(picture: Picture, reference: Picture, own_error: float) -> tuple[float, float, float]:
    """The errors of a picture, as in `Measured`."""
    error = error_beyond(picture.radiance, reference.radiance, own_error)
    try:
        seen, true = linear_rgb(picture), linear_rgb(reference)
    except ValueError:
        return error, float("nan"), float("nan")
    difference = delta_e(seen, true)
    return error, float(difference.mean()), float(np.percentile(difference, 99))


def error_beyond(
    radiance: Float[np.ndarray, "height width channels"],
    reference: Float[np.ndarray, "height width channels"],
    own_error: float,
) -> float:
    """Root mean square of a picture's error over that of the reference, less the reference's own.

    Args:
        radiance: of the picture.
        reference: a better one.
        own_error: of that, over its root mean square.
    """
    size, apart = rms(reference), rms(radiance - reference)
    return relative(math.sqrt(max(apart**2 - (own_error * size) ** 2, 0.0)), size)


def delta_e(
    one: Float[np.ndarray, "height width 3"], other: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width"]:
    """Colour difference of each pixel on a screen that shows (1, 1, 1) as its white.

    Args:
        one: linear sRGB; what a screen cannot show is clipped.
        other: the same.

    Returns:
        CIE ΔE2000, dimensionless.

    Source:
        CIE 142-2001, by colour-science.
    """
    import colour

    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]

    def lab(rgb: np.ndarray) -> Any:
        shown = np.clip(rgb.astype(np.float64), 0.0, 1.0)
        xyz = colour.RGB_to_XYZ(shown, "sRGB", apply_cctf_decoding=False)
        return colour.XYZ_to_Lab(xyz, white)

    return np.asarray(colour.delta_E(lab(one), lab(other), method="CIE 2000"))


# Rows that are kept.


def each_once(
    folder: Path,
    key: str,
    settings: Sequence[Any],
    kind: Any,
    find_reference: Callable[[], Any],
    measure: Callable[[Any, Any], Any],
    progress: Callable[[int, int], None] | None,
) -> tuple[Any, tuple[Any, ...]]:
    """What is measured of each setting, unless the folder's tradeoff.csv holds it already.

    Args:
        folder: where that file is kept.
        key: of all that the rows depend on beside the setting; it stands in each.
        settings: dataclasses of numbers and words, all of one kind.
        kind: the dataclass of what is measured.
        find_reference: gives what each is compared with.
        measure: gives the row of a setting, beside the reference.
        progress: as in `tradeoff`.

    Returns:
        The reference; the row of each setting.
    """
    rows = dict(_kept_rows(folder, key, type(settings[0]), kind))
    tell = progress or (lambda done, of: None)
    tell(len(rows), len(settings))
    reference = find_reference()
    for setting in settings:
        if setting not in rows:
            rows[setting] = measure(setting, reference)
            _keep_rows(folder, key, rows)
            tell(len(rows), len(settings))
    return reference, tuple(rows[setting] for setting in settings)


def _keep_rows(folder: Path, key: str, rows: Mapping[Any, Any]) -> None:
    """Write tradeoff.csv, whole or not at all."""
    lines = [{**asdict(setting), **asdict(row), "key": key} for setting, row in rows.items()]
    with (
        replacing(folder / "tradeoff.csv") as beside,
        beside.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)


def _kept_rows(folder: Path, key: str, setting: Any, measured: Any) -> Iterator[tuple[Any, Any]]:
    """What tradeoff.csv holds that was measured for the same."""
    try:
        with (folder / "tradeoff.csv").open(encoding="utf-8", newline="") as file:
            kept = [row for row in csv.DictReader(file) if row.get("key") == key]
        for row in kept:
            yield _of_row(setting, row), _of_row(measured, row)
    except (OSError, ValueError, KeyError, TypeError):
        return


def _of_row(kind: Any, row: dict[str, str]) -> Any:
    """A setting, or what was measured of one, from a line of the file."""
    types: dict[str, Any] = {field.name: field.type for field in fields(kind)}
    return kind(**{name: parse(row[name]) for name, parse in types.items()})
