"""The command line. What is heavy is imported by the command that needs it: help comes at once."""

import argparse
import contextlib
import json
import math
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from diffdisp.presets import MOST_FITTED, PRESETS

DONE, BAD_INPUT, NOT_CONVERGED, INTERRUPTED = 0, 2, 3, 130
"""Exit statuses; 130 is what shells give for Ctrl-C."""

PRIORS, LOSSES = ("none", "catalogue", "fixed-c3"), ("squares", "robust")
"""Those of `fitting`, which is too heavy to be asked."""

PLAN_SIZE = (96, 96)
"""Pixels of a picture that is only thought of: a few seconds a bench."""
TRADEOFF_SIZE = (160, 120)
"""Pixels of a picture that is drawn with many settings."""
PLAN_COLUMNS = 8
"""Pictures that its slopes are: six, of a colour picture, and those along what else is free."""

WARM_RENDERS = 5
"""Renders whose median is told as the time of one."""

PICTURES = 4
"""Held at once: a pass in the order of chunks and in that of rows, the sum, the picture so far."""
PIXEL_BYTES = 128
"""Beside the radiance: places of a pixel and their order, while chunks are laid out."""
SAMPLE_BYTES = 1200
"""Of a film sample, for all pixels: its wavelengths and what they count, while laid out."""
PATH_BYTES = 1024
"""Of one path: its state of some hundred numbers. All of a pixel in a pass are traced at once."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after the program's name; by default those of the process.

    Returns:
        The exit status: 0 done, 2 bad input, 3 a fit that did not converge, 130 interrupted.
    """
    try:
        options = _parser().parse_args(arguments)
        with _plain_warnings():
            status: int = options.run(options)
            return status
    except SystemExit as stop:  # of --help and --version
        return stop.code if isinstance(stop.code, int) else 0
    except KeyboardInterrupt:
        return _complain("interrupted, nothing written", INTERRUPTED)
    except MemoryError as error:
        return _complain(f"not enough memory: {error}".removesuffix(": "))
    except OSError as error:
        return _complain(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except (ValueError, ImportError) as error:
        return _complain(str(error))
    except RuntimeError as error:
        # How JAX tells that an allocation failed. Any other is a fault of ours.
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return _complain(f"not enough memory: {str(error).splitlines()[0]}")


def _complain(message: str, status: int = BAD_INPUT) -> int:
    """Tell what is wrong."""
    print(f"diffdisp: {message}", file=sys.stderr)
    return status


@contextlib.contextmanager
def _plain_warnings() -> Iterator[None]:
    """Warnings for users as one line each, and the same one only once."""
    import logging

    told = set()

    def show(message: Warning | str, *_place: object, **_line: object) -> None:
        if str(message) not in told:
            told.add(str(message))
            print(f"diffdisp: warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        # Of a folder that is full, say: the program is compiled again, and no result differs.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
        warnings.showwarning = show
        # Tells of each folder that it cannot keep its lists of fonts in.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        yield


# Options.


class _Parser(argparse.ArgumentParser):
    """A parser whose mistakes are told in one line, as all others are."""

    def __init__(self, **options: Any) -> None:
        """As any parser; but a later option must not change what an abbreviation means."""
        super().__init__(**options, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        """Raise `ValueError` in the place of printing the usage and leaving."""
        raise ValueError(f"{message}; see {self.prog} --help")


class _Version(argparse.Action):
    """`--version`: looked up only when asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_rest: object) -> NoReturn:
        """Print the version and leave."""
        metadata = import_module("importlib.metadata")
        try:
            version = metadata.version("diffdisp")
        except metadata.PackageNotFoundError:
            version = "(not installed)"
        print(f"diffdisp {version}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    """The command line's grammar."""
    parser = _Parser(
        prog="diffdisp",
        description="Draw dispersive glass, and recover its Sellmeier coefficients from a picture.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_render(commands.add_parser("render", help="draw a scene"))
    _add_fit(commands.add_parser("fit", help="recover the glass of a ball from a picture"))
    _add_plan_fit(commands.add_parser("plan-fit", help="what a picture of a scene would tell"))
    _add_tradeoff(commands.add_parser("tradeoff", help="measure what accuracy costs"))
    _add_glass(commands.add_parser("glass", help="print what is known of a glass"))
    return parser


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.description = "Draw a scene: in linear sRGB, or the radiance in bands of wavelength."
    parser.set_defaults(run=_render)
    presets = ", ".join(f"{name} = {preset.samples}" for name, preset in PRESETS.items())
    add = parser.add_argument
    add("scene", metavar="SCENE", help="a scene file, .toml")
    add("-o", dest="output", metavar="OUT", help=".png (sRGB), .tiff or .exr (float32), .npz")
    add("--size", type=_size, default=(480, 480), metavar="WxH", help="pixels (default 480x480)")
    accuracy = parser.add_mutually_exclusive_group()
    quality = f"samples per pixel: {presets} (default standard)"
    accuracy.add_argument("--quality", choices=PRESETS, help=quality)
    accuracy.add_argument("--tolerance", type=_positive, metavar="T", help=_TOLERANCE_HELP)
    add("--samples", type=_count, metavar="N", help="samples per pixel (default: by --quality)")
    add("--depth", type=_depth, default=50, metavar="N", help="segments of a path (default 50)")
    add("--bands", type=_bands, metavar="LOW:HIGH:COUNT", help=_BANDS_HELP)
    add("--float64", action="store_true", help="compute in double precision (default: single)")
    add("--seed", type=_seed, default=0, metavar="N", help="of random choices (default 0)")
    add("--plan", action="store_true", help="print what the scene requires; draw only with -o")
    add("--timing", action="store_true", help="also print how long it takes, as a line of JSON")


_TOLERANCE_HELP = (
    "as many samples as make the estimated error, root mean square over that of the picture, "
    "at most this"
)
_BANDS_HELP = "nm; equal bands, seen at their middles, as 400:700:16 (default: colour)"


def _add_fit(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Recover B and C of a glass ball from a picture. The scene says where everything is and "
        "which glass to start from. Exit status 3: it did not converge, or not within the "
        "tolerance; the files are written. "
        "Ctrl-C writes the best point so far; the exit status is 130 then."
    )
    parser.set_defaults(run=_fit)
    add = parser.add_argument
    add("scene", metavar="SCENE", help="a scene file, .toml")
    add("target", metavar="TARGET", help="the picture: .npz, .tiff, .exr or .png")
    add("-o", dest="output", metavar="DIR", required=True, help="for fit.json and report.png")
    add("--object", metavar="NAME", help="the ball, where the scene has several of glass")
    add("--free", action="append", default=[], metavar="NAME", help=_FREE_HELP)
    add("--prior", choices=PRIORS, default="none", help="what is known beforehand (default none)")
    add("--loss", choices=LOSSES, default="squares", help="robust: outliers do not count")
    add("--check", action="store_true", help="of n_d's error, by resampling the residual")
    add("--noise", type=_positive, metavar="SIGMA", help="of the radiance (default: estimated)")
    add("--tolerance", type=_positive, metavar="T", help=_FIT_TOLERANCE_HELP)
    add("--start", metavar="GLASS", help="glass to start from (default: that of the scene)")
    add(
        "--mask", metavar="FILE", help="a picture of TARGET's size; where it is 0 nothing is fitted"
    )


_FIT_TOLERANCE_HELP = (
    "as many samples as make the error that the fit's own rendering leaves in n_d an estimated T "
    "at most (default: by the noise)"
)
_FREE_HELP = (
    "fit this too, from its value in the scene: ball.center, ball.radius, ball.center.z, "
    "screen.point, screen.tile, camera.vertical_fov, ...; gain, a factor for each band; black, "
    "a level added to all. May be given several times"
)


def _add_plan_fit(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Say what a picture of the scene would tell of its glass ball, before it is taken; with "
        "-o also how that changes with the screen's distance and tiles, with the picture's size "
        "and with the number of bands."
    )
    parser.set_defaults(run=_plan_fit)
    add = parser.add_argument
    add("scene", metavar="SCENE", help="a scene file, .toml, with the glass to expect")
    add("--noise", type=_positive, required=True, metavar="SIGMA", help="of the radiance")
    add("-o", dest="output", metavar="DIR", help="for plan.json and plan.png")
    add("--size", type=_size, default=PLAN_SIZE, metavar="WxH", help="pixels (default 96x96)")
    add("--bands", type=_bands, metavar="LOW:HIGH:COUNT", help=_BANDS_HELP)
    add("--object", metavar="NAME", help="the ball, where the scene has several of glass")
    add("--free", action="append", default=[], metavar="NAME", help=_PLAN_FREE_HELP)
    add("--prior", choices=PRIORS, default="none", help="what is known beforehand (default none)")


_PLAN_FREE_HELP = "would be fitted too, as in fit; may be given several times"


def _add_tradeoff(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Draw a scene with many settings, and measure the error and the time of each; with "
        "--target fit its glass with them instead. Ctrl-C "
        "keeps what has been measured; the same command goes on from there."
    )
    parser.set_defaults(run=_tradeoff)
    add = parser.add_argument
    add("scene", metavar="SCENE", help="a scene file, .toml")
    add("-o", dest="output", metavar="DIR", required=True, help="for tradeoff.csv and .png")
    add("--target", metavar="FILE", help="a picture whose fit is measured, from the scene's glass")
    add("--object", metavar="NAME", help="the ball to fit, where the scene has several of glass")
    size = "pixels (default {}x{}, or the target's)".format(*TRADEOFF_SIZE)
    add("--size", type=_size, metavar="WxH", help=size)
    add("--bands", type=_bands, metavar="LOW:HIGH:COUNT", help=_BANDS_HELP)
    usual = PRESETS["reference"].samples
    most = f"most samples per pixel (default {usual}, of fits {MOST_FITTED})"
    add("--samples", type=_count, metavar="N", help=most)
    add("--depth", type=_depth, default=50, metavar="N", help="most segments (default 50)")
    add("--seed", type=_seed, default=0, metavar="N", help="of random choices (default 0)")


def _add_glass(parser: argparse.ArgumentParser) -> None:
    parser.description = "Print coefficients, n_d, V_d, P_gF, validity and source of a glass."
    parser.set_defaults(run=_glass)
    add = parser.add_argument
    add("glass", metavar="GLASS", help="a name such as N-BK7, FILE.agf, FILE.agf:NAME or FILE.yml")
    add("-o", dest="output", metavar="PLOT", help="draw n(λ) over the range of validity")


def _whole(text: str, low: int, high: int) -> int:
    """A whole number in plain digits from `low` to below `high`."""
    # Python refuses to read thousands of digits, in words of its own.
    number = int(text) if re.fullmatch(r"-?[0-9]{1,18}", text) else None
    if number is None or not low <= number < high:
        raise argparse.ArgumentTypeError(
            f"must be a whole number of at least {low}, below {high}; found {text[:40]!r}"
        )
    return number


def _count(text: str) -> int:
    """A number of things that 32 bits can count."""
    return _whole(text, 1, 2**31)


def _depth(text: str) -> int:
    """Segments of a path: no light is left of it long before the last of these."""
    return _whole(text, 1, 2**16)


def _seed(text: str) -> int:
    """Any 32 bits."""
    return _whole(text, 0, 2**32)


def _size(text: str) -> tuple[int, int]:
    """Width and height."""
    width, times, height = text.partition("x")
    if not times:
        raise argparse.ArgumentTypeError(f"must be WxH, as 480x480; found {text!r}")
    return _count(width), _count(height)


def _real(text: str) -> float:
    """A finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"must be a finite number; found {text!r}")
    return number


def _positive(text: str) -> float:
    """A standard deviation, say."""
    number = _real(text)
    if not number > 0:
        raise argparse.ArgumentTypeError(f"must be above 0; found {text!r}")
    return number


def _bands(text: str) -> tuple[float, float, int]:
    """Ends in nm and a count."""
    parts = text.split(":")
    if len(parts) != 3:
        raise argparse.ArgumentTypeError(
            f"must be LOW:HIGH:COUNT in nm, as 400:700:16; found {text!r}"
        )
    low, high, count = _real(parts[0]), _real(parts[1]), _count(parts[2])
    if not 0 < low < high:
        raise argparse.ArgumentTypeError(f"must rise from above 0; found {text!r}")
    return low, high, count


# Commands.


def _render(options: argparse.Namespace) -> int:
    """`diffdisp render`."""
    if not options.output and (options.timing or not options.plan):
        raise ValueError("render needs -o OUT; only --plan goes without a picture")
    if options.tolerance and options.samples:
        raise ValueError("--tolerance chooses the samples; leave out --samples")
    from diffdisp.image import check_output
    from diffdisp.planning import make_plan
    from diffdisp.scene_file import load_scene

    scene = load_scene(options.scene)
    preset = PRESETS[options.quality or "standard"]
    samples = options.samples or preset.samples
    dtype = "float64" if options.float64 else "float32"
    film = _film(options.size, options.bands, samples, dtype)
    if options.output:
        check_output(options.output, film.wavelengths)
    _check_glasses(scene, options.bands)
    if options.plan:
        print(make_plan(scene, film, samples, options.depth, dtype))
        if options.tolerance:
            print(f"tolerance  {options.tolerance:g}: other samples, chosen while drawing")
        elif not options.samples:
            print(f"quality    {options.quality or 'standard'}, {preset}")
    if not options.output:
        return DONE
    _keep_compiled()
    knobs = {"depth": options.depth, "seed": options.seed, "dtype": dtype}
    if options.tolerance:
        return _draw_to_tolerance(options, scene, film, knobs)
    return _draw_samples(options, scene, film, samples, knobs)


def _draw_samples(
    options: argparse.Namespace, scene: Any, film: Any, samples: int, knobs: dict[str, Any]
) -> int:
    """A picture of so many samples."""
    from diffdisp.rendering import Growing, compile_ahead, render, render_progressively

    def write(picture: Growing) -> None:
        _write_picture(options, film, *picture, options.seed)

    if options.timing:
        static = {"samples": samples, "depth": options.depth, "dtype": knobs["dtype"]}
        build = partial(compile_ahead, scene, film, **static)
        radiance, timing = _timed(build, partial(render, scene, film, samples=samples, **knobs))
        write(Growing(radiance, samples))
        _print_timing(timing, film, samples)
        return DONE
    draw = partial(render_progressively, scene, film, samples=samples, **knobs)

    def tell(picture: Growing | None) -> str:
        return f"{picture.samples if picture else 0} of {samples} samples"

    picture = _grow(draw, write, tell, options.output)
    return INTERRUPTED if picture is None else DONE


def _draw_to_tolerance(
    options: argparse.Namespace, scene: Any, film: Any, knobs: dict[str, Any]
) -> int:
    """A picture of an estimated error within the tolerance."""
    from diffdisp.tolerance import Estimated, render_to_tolerance

    draw = partial(render_to_tolerance, scene, film, options.tolerance, **knobs)

    def last() -> Estimated:
        *_, picture = draw()
        return picture

    def write(picture: Estimated) -> None:
        _write_picture(options, film, picture.radiance, picture.samples, picture.seed)

    if options.timing:
        picture, timing = _timed(last, last)
        # The samples are not known beforehand: the first picture compiles, and is drawn.
        timing["compile_s"] = max(timing["compile_s"] - timing["render_s"], 0.0)
        write(picture)
        timing |= {"samples": picture.samples, "estimated_error": picture.error}
        _print_timing(timing, film, picture.samples)
    else:
        picture = _grow(draw, write, _estimate, options.output)
        if picture is None:
            return INTERRUPTED
    if picture.error > options.tolerance:
        return _complain(f"not reached: {options.output} holds {_estimate(picture)}", NOT_CONVERGED)
    if not options.timing:
        print(_estimate(picture))
    return DONE


def _estimate(picture: Any | None) -> str:
    """What was chosen for a picture, and how good it is."""
    if picture is None:
        return "0 samples"
    error = "not known" if math.isinf(picture.error) else f"{picture.error:.2g}"
    return f"{picture.samples} samples a pixel in {picture.dtype}, estimated error {error}"


def _write_picture(
    options: argparse.Namespace, film: Any, radiance: Any, samples: int, seed: int | None
) -> None:
    """Write radiance of so many samples."""
    from diffdisp.image import Picture, write_picture

    picture = Picture(radiance, film.wavelengths, samples, options.depth, seed)
    write_picture(options.output, picture)


def _print_timing(timing: dict[str, float], film: Any, samples: int) -> None:
    """The times, and how many paths there were of them, as a line of JSON."""
    paths = film.width * film.height * samples
    rate = {"paths": paths, "paths_per_s": paths / timing["render_s"]}
    print(json.dumps(timing | rate))


def _film(
    size: tuple[int, int], bands: tuple[float, float, int] | None, samples: int, dtype: str
) -> Any:
    """The film asked for, if there is memory for it."""
    from diffdisp.film import Film, band_middles

    _check_memory(*size, bands[2] if bands else 3, samples, 8 if dtype == "float64" else 4)
    return Film(*size, band_middles(*bands) if bands else None)


def _check_glasses(scene: Any, bands: tuple[float, float, int] | None) -> None:
    """Check the range asked for, not the bands' middles: what is legal depends on no count."""
    from diffdisp.chunks import COLOR_RANGE, check_glasses

    low, high = (bands[0] / 1e3, bands[1] / 1e3) if bands else COLOR_RANGE
    check_glasses(scene, low, high)
    # `render` would say it again, of the middles.
    warnings.filterwarnings("ignore", ".* reach beyond the range")


def _grow(
    draw: Callable[..., Iterator[Any]],
    write: Callable[[Any], None],
    tell: Callable[[Any | None], str],
    output: str,
) -> Any:
    """Draw and write a picture, with a progress bar; on Ctrl-C what there is of it by then.

    Args:
        draw: given what is told the progress, the pictures on the way.
        write: one of them.
        tell: how far one of them is; of None, how far the work is before the first.
        output: what is written.

    Returns:
        The last picture, or None if there was Ctrl-C.
    """
    picture = None
    try:
        with _progress_bar("rendering", "part") as bar:
            bar.set_postfix_str(tell(None), refresh=False)
            for picture in draw(progress=lambda done, total: _advance(bar, done, total)):
                bar.set_postfix_str(tell(picture))
        assert picture is not None
        write(picture)
    except KeyboardInterrupt:
        if picture is None:
            raise
        # Once more where the first was cut short. A second Ctrl-C leaves the old file whole.
        write(picture)
        _complain(f"interrupted: {output} holds {tell(picture)}")
        return None
    return picture


def _timed(build: Callable[[], object], draw: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """The picture, and how long it takes to compile and to draw, by the clock and on all cores."""
    from diffdisp.timing import peak_memory_mb, warm_times

    start = time.perf_counter()
    build()
    compiled = time.perf_counter() - start
    draw()
    picture, seconds, busy = warm_times(draw, WARM_RENDERS)
    return picture, {
        "compile_s": compiled,
        "render_s": seconds,
        "cpu_s": busy,
        "peak_memory_mb": peak_memory_mb(),
    }


def _fit(options: argparse.Namespace) -> int:
    """`diffdisp fit`."""
    folder = Path(options.output)
    _check_folder(folder, ("fit.json", "report.png"))
    from diffdisp.fitting import fit
    from diffdisp.glasses import load_glass
    from diffdisp.image import read_mask, read_picture
    from diffdisp.report import rendering_words, result_table, write_fit_json, write_report
    from diffdisp.scene_file import load_scene

    scene, target = load_scene(options.scene), read_picture(options.target)
    start = None if options.start is None else load_glass(options.start)
    mask = None if options.mask is None else read_mask(options.mask)
    _keep_compiled()
    with _progress_bar("fitting", "step") as bar:

        def progress(step: int, residual: float, n_d: float) -> None:
            bar.set_postfix_str(f"residual {residual:.3g}, n_d {n_d:.6f}", refresh=False)
            _advance(bar, step, None)

        result = fit(
            scene,
            target,
            object_name=options.object,
            free=options.free,
            prior=options.prior,
            noise=options.noise,
            start=start,
            mask=mask,
            loss=options.loss,
            check="resample" if options.check else None,
            tolerance=options.tolerance,
            progress=progress,
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_report(folder / "report.png", result, target)
    write_fit_json(folder / "fit.json", result)
    print(result_table(result))
    if result.stopped:
        return _complain(f"interrupted: {folder} holds the fit so far", INTERRUPTED)
    if result.rendering and not result.rendering.met:
        return _complain(f"not reached: {rendering_words(result)}", NOT_CONVERGED)
    return DONE if result.converged else NOT_CONVERGED


def _plan_fit(options: argparse.Namespace) -> int:
    """`diffdisp plan-fit`."""
    if options.output:
        folder = Path(options.output)
        _check_folder(folder, ("plan.json", "plan.png"))
    from diffdisp.report import bench_table, write_bench_json, write_bench_plot
    from diffdisp.scene_file import load_scene
    from diffdisp.varying import FACTORS, vary_bench

    scene = load_scene(options.scene)
    width, height = options.size
    channels, most = options.bands[2] if options.bands else 3, max(FACTORS)
    _check_memory(int(most * width), int(most * height), PLAN_COLUMNS * channels, 1, 8)
    _check_glasses(scene, options.bands)
    _keep_compiled()
    ask = partial(
        vary_bench,
        scene,
        options.size,
        options.bands,
        noise=options.noise,
        object_name=options.object,
        free=options.free,
        prior=options.prior,
        only_own=not options.output,
    )
    with _progress_bar("planning", "bench") as bar:
        _advance(bar, 0, 1)
        bench = ask(progress=lambda done, total: _advance(bar, done, total))
    if options.output:
        folder.mkdir(parents=True, exist_ok=True)
        write_bench_plot(folder / "plan.png", bench)
        write_bench_json(folder / "plan.json", bench)
    print(bench_table(bench))
    return DONE


def _tradeoff(options: argparse.Namespace) -> int:
    """`diffdisp tradeoff`."""
    folder = Path(options.output)
    _check_folder(folder, ("tradeoff.csv", "tradeoff.png", "reference.npz"))
    from diffdisp.report import tradeoff_table, write_tradeoff_plot
    from diffdisp.scene_file import load_scene

    scene = load_scene(options.scene)
    measure = (_measuring_fits if options.target else _measuring_pictures)(options, scene)
    _keep_compiled()
    folder.mkdir(parents=True, exist_ok=True)
    told = (0, 0)
    try:
        with _progress_bar("measuring", "setting") as bar:

            def progress(done: int, total: int) -> None:
                nonlocal told
                told = done, total
                _advance(bar, done, total)

            found = measure(folder=folder, depth=options.depth, progress=progress)
    except KeyboardInterrupt:
        holds = f"{folder} holds {told[0]} of {told[1]} settings"
        return _complain(f"interrupted: {holds}; the same command goes on", INTERRUPTED)
    write_tradeoff_plot(folder / "tradeoff.png", found)
    print(tradeoff_table(found))
    return DONE


def _measuring_pictures(options: argparse.Namespace, scene: Any) -> Callable[..., Any]:
    """What measures pictures of a scene.

    Raises:
        ValueError: options that belong to fits, or a picture that cannot be drawn.
    """
    from diffdisp.measuring import tradeoff

    if options.object:
        raise ValueError("--object names the ball of a fit: it goes with --target")
    size, samples = options.size or TRADEOFF_SIZE, options.samples or PRESETS["reference"].samples
    _film(size, options.bands, samples, "float64")
    _check_glasses(scene, options.bands)
    return partial(tradeoff, scene, size, options.bands, most=samples, seed=options.seed)


def _measuring_fits(options: argparse.Namespace, scene: Any) -> Callable[..., Any]:
    """What measures fits of a picture.

    Raises:
        ValueError: options that the target decides, or a target or ball that cannot be used.
    """
    from diffdisp.chunks import check_glasses, film_range
    from diffdisp.fit_measuring import fit_tradeoff
    from diffdisp.fitting import glass_object
    from diffdisp.image import read_picture

    for name in ("size", "bands"):
        if getattr(options, name):
            raise ValueError(f"--{name} is that of the target; leave it out with --target")
    target = read_picture(options.target)
    glass_object(scene, options.object)
    check_glasses(scene, *film_range(target.film))
    most = options.samples or MOST_FITTED
    knobs = {"most": most, "seed": options.seed}
    return partial(fit_tradeoff, scene, target, object_name=options.object, **knobs)


def _glass(options: argparse.Namespace) -> int:
    """`diffdisp glass`."""
    import jax

    from diffdisp.glasses import load_glass, load_glasses

    # A catalogue is printed whole, but a plot is of one glass.
    if not options.output:
        glasses = load_glasses(options.glass)
    else:
        from diffdisp.report import check_plot_output, write_glass_plot

        check_plot_output(options.output)
        glasses = [load_glass(options.glass)]
    with jax.enable_x64(True):
        print("\n\n".join(_glass_text(glass, options.glass) for glass in glasses))
    if options.output:
        write_glass_plot(options.output, glasses[0])
    return DONE


def _glass_text(glass: Any, asked_for: str) -> str:
    """What is known of a glass, a line each."""
    low, high = (float(edge) for edge in glass.validity)
    rows = {
        "glass": glass.name or "(unnamed)",
        "B": _numbers(glass.B),
        "C (µm²)": _numbers(glass.C),
        "n_d": _number(glass.n_d, "{:.6f}"),
        "V_d": _number(glass.V_d, "{:.3f}"),
        "P_gF": _number(glass.P_gF, "{:.4f}"),
        "validity": f"{low:g}-{high:g} µm" if math.isfinite(high) else "not stated",
        "source": _source(asked_for),
    }
    return "\n".join(f"{name:<10}{text}" for name, text in rows.items())


def _numbers(values: Any) -> str:
    return "  ".join(f"{float(value):.9g}" for value in values)


def _number(value: Any, form: str) -> str:
    """A value, or why there is none."""
    return form.format(float(value)) if math.isfinite(float(value)) else "not defined"


def _source(asked_for: str) -> str:
    """Where a glass of the table was published; of any other, the file it was read from."""
    from diffdisp.glasses import glass_source

    try:
        return glass_source(asked_for)
    except ValueError:
        return asked_for


# What the machine can do.


def _check_memory(width: int, height: int, channels: int, samples: int, real_bytes: int) -> None:
    """Refuse, before any work, a picture that cannot be held.

    Raises:
        MemoryError: it cannot.
    """
    from diffdisp.wavefront import MOST_SAMPLES

    pixels = width * height * (PICTURES * real_bytes * channels + PIXEL_BYTES)
    paths = min(samples, MOST_SAMPLES) * channels * PATH_BYTES
    needed, available = pixels + paths + samples * SAMPLE_BYTES, _available_memory()
    if needed > available:
        raise MemoryError(
            f"{width}x{height} pixels of {channels} channels with {samples} samples need about "
            f"{needed / 1e9:.3g} GB; available are {available / 1e9:.3g} GB"
        )


def _available_memory() -> int:
    """Bytes that this process may still take, as far as the system says."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    with contextlib.suppress(OSError, ValueError):  # "max" where a container sets no limit
        limits.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    with contextlib.suppress(OSError):
        found = re.search(r"MemAvailable: +(\d+) kB", Path("/proc/meminfo").read_text())
        limits += [int(found[1]) * 1024] if found else []
    return min(limits)


def _check_folder(folder: Path, names: tuple[str, ...]) -> None:
    """Raise now what making a folder and writing files of some names would raise after a long fit.

    Raises:
        ValueError: something on the way is no folder, or may not be written to.
    """
    nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not nearest.is_dir():
        raise ValueError(f"{folder}: {nearest} is no folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ValueError(f"{folder}: the folder {nearest} may not be written to")
    for name in names:
        if (folder / name).is_dir():
            raise ValueError(f"{folder / name}: is a folder")


def _keep_compiled() -> None:
    """Let JAX keep compiled programs between runs, which saves most of a short run's time."""
    import jax

    config: Any = jax.config
    if config.jax_compilation_cache_dir is None:
        home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
        folder = Path(home).expanduser() / "diffdisp" / "jax"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except (OSError, RuntimeError):  # RuntimeError: nobody knows where home is
            return
        if not os.access(folder, os.W_OK | os.X_OK):
            return
        config.update("jax_compilation_cache_dir", str(folder))
    # JAX keeps only what took a second to compile; what somebody has set already stays.
    if config.jax_persistent_cache_min_compile_time_secs == 1.0:
        config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if config.jax_persistent_cache_min_entry_size_bytes == 0:
        config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _progress_bar(title: str, unit: str) -> Any:
    """A bar on a terminal; nothing elsewhere."""
    from tqdm import tqdm

    return tqdm(desc=title, unit=unit, leave=False, file=sys.stderr, disable=None)


def _advance(bar: Any, done: int, total: int | None) -> None:
    """Set a bar to `done` of `total`."""
    bar.total = total
    bar.update(done - bar.n)


if __name__ == "__main__":
    sys.exit(main())
