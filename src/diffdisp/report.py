"""What a fit found, and what to expect of one: as JSON, as a table, as plots; plots of a glass."""

import json
import math
import os
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

from diffdisp.color import encode_srgb
from diffdisp.dispersion import Sellmeier
from diffdisp.fit_measuring import FitMeasured, FitSetting
from diffdisp.fitting import FitResult, Rendered, Resampled, Uncertainty
from diffdisp.glasses import named_glass
from diffdisp.image import Picture, linear_rgb, replacing
from diffdisp.measuring import Measured, Setting, Tradeoff
from diffdisp.varying import Bench, Variation

UNDETERMINED = 0.1
"""Relative standard error of a coefficient from which on the picture does not determine it."""

LEAST_PROBABILITY = 5e-4
"""What the table shows of a probability is rounded to 0.001."""

TRADED, FIT_TRADED = (0.1, 0.03, 0.01), (1e-4, 1e-5, 1e-6)
"""Errors, of pictures and of n_d, for which the fastest setting is said."""

PLOT_LIMITS = (0.1, 50.0)
"""Wavelengths that a plot of a glass shows at most, µm."""
UNSTATED_RANGE = (0.3, 2.5)
"""Ends of a plot where a glass states none, µm: the range of optical glass catalogues."""
HIGHEST_INDEX = 5.0
"""Indices above are next to a pole, and left out of a plot: no transparent solid has more."""


# The fit as JSON.


def fit_json(result: FitResult) -> dict[str, Any]:
    """The result as the content of `fit.json`.

    Args:
        result: of `fit`.

    Returns:
        Plain numbers, texts and lists; null in the place of NaN and infinity, which JSON has not.
    """
    return {
        "object": result.object_name,
        "prior": result.prior,
        "converged": bool(result.converged),
        "message": result.message,
        "stopped": bool(result.stopped),
        "steps": int(result.steps),
        **_known_json(result),
        "rms_residual": _plain(result.rms_residual),
        "loss": result.loss,
        "left_out": {
            "masked_pixels": result.masked,
            "clipped_values": result.clipped,
            "outlying_values": result.outliers,
        },
        "nearest_glasses": list(_nearest_entries(result)),
        "other_glass_probability": _plain(result.other_probability),
        "check": None if result.check is None else _plain_tuple(result.check),
        "rendering": None if result.rendering is None else _plain_rendering(result),
    }


def _known_json(known: FitResult | Uncertainty) -> dict[str, Any]:
    """What is known of the glass, or will be."""
    return {
        "B": _plain(known.B),
        "C": _plain(known.C),
        "B_std": _plain(known.B_std),
        "C_std": _plain(known.C_std),
        "covariance": _plain(known.covariance),
        "n_d": _plain(known.n_d),
        "n_d_std": _plain(known.n_d_std),
        "V_d": _plain(known.V_d),
        "V_d_std": _plain(known.V_d_std),
        "P_gF": _plain(known.P_gF),
        "P_gF_std": _plain(known.P_gF_std),
        "wavelength": _plain(known.wavelengths),
        "n": _plain(known.n),
        "n_std": _plain(known.n_std),
        "singular_values": _plain(known.singular_values),
        "determined": int(known.determined),
        "summary": known.summary,
        "free": [
            {"name": name, "value": _plain(value), "std": _plain(std)}
            for name, value, std in known.free
        ],
    }


def _plain_tuple(told: Resampled | Rendered) -> dict[str, Any]:
    return {name: _plain(value) for name, value in told._asdict().items()}


def _plain_rendering(result: FitResult) -> dict[str, Any]:
    """What was chosen for a tolerance, and what it leaves open."""
    assert result.rendering is not None
    return {**_plain_tuple(result.rendering), "samples": list(result.samples)}


def _nearest_entries(result: FitResult) -> Iterator[dict[str, Any]]:
    """Name, distance and, where it is known, probability of each near glass."""
    for i, (name, distance) in enumerate(result.nearest_glasses):
        known = [("probability", _plain(p)) for p in result.probabilities[i : i + 1]]
        yield {"name": name, "distance": _plain(distance), **dict(known)}


def write_fit_json(path: str | os.PathLike[str], result: FitResult) -> None:
    """Write `fit_json(result)`: beside, then renamed, so that an older file stays whole."""
    _write_json(path, fit_json(result))


def _write_json(path: str | os.PathLike[str], content: dict[str, Any]) -> None:
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    with replacing(path) as beside:
        beside.write_text(text + "\n", encoding="utf-8")


def _plain(values: Any) -> Any:
    """Numbers and nested lists of them; None for what is not finite."""
    if isinstance(values, list):
        return [_plain(value) for value in values]
    if isinstance(values, float | int):
        return values if math.isfinite(values) else None
    return _plain(np.asarray(values).tolist())


# The fit as a table.


def result_table(result: FitResult) -> str:
    """The result as a short table, ending in the summary.

    Args:
        result: of `fit`.

    Returns:
        Lines without a newline after the last one; errors are 1 sigma.
    """
    rows = [
        ("object", result.object_name or "(unnamed)"),
        ("converged", f"{'yes' if result.converged else 'NO'}, {_count(result.steps, 'step')}"),
        *([] if result.converged else [("message", result.message)]),
        ("prior", result.prior),
        *_known_rows(result),
        ("nearest", _nearest(result)),
        *([("glass", _probable(result))] if result.probabilities else []),
        ("residual", f"{result.rms_residual:.3g} rms"),
        *([("check", _checked(result.check))] if result.check else []),
        *([("rendering", rendering_words(result))] if result.rendering else []),
        *([("left out", f"{_count(result.masked, 'pixel')} by the mask")] if result.masked else []),
    ]
    return _table(rows, result)


def _table(rows: list[tuple[str, str]], known: FitResult | Uncertainty) -> str:
    """Rows of two columns, and the summary."""
    width = max([11, *(len(value.name) + 2 for value in known.free)])
    table = "\n".join(f"{name:<{width}}{text}" for name, text in rows)
    return f"{table}\n\n{textwrap.fill(known.summary, 79)}"


def _known_rows(known: FitResult | Uncertainty) -> Iterator[tuple[str, str]]:
    """What is known of the glass, or will be."""
    yield "n_d", _with_error(known.n_d, known.n_d_std)
    yield "V_d", _with_error(known.V_d, known.V_d_std)
    yield "P_gF", _with_error(known.P_gF, known.P_gF_std)
    yield from _coefficient_rows(known)
    yield from _free_rows(known)
    yield "determined", f"{known.determined} of {len(known.singular_values)} directions"


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _coefficient_rows(result: FitResult | Uncertainty) -> Iterator[tuple[str, str]]:
    """A line for each of B and C."""
    for name, unit, values, errors in (
        ("B", "", result.B, result.B_std),
        ("C", " µm²", result.C, result.C_std),
    ):
        for i, (value, error) in enumerate(zip(values, errors, strict=True), 1):
            yield f"{name}{i}{unit}", _coefficient(float(value), float(error))


def _free_rows(result: FitResult | Uncertainty) -> Iterator[tuple[str, str]]:
    """A line for each number that was free beside B and C; one for all gains."""
    gains = [value for value in result.free if value.name.startswith("gain[")]
    for value in result.free:
        if value not in gains:
            yield value.name, _with_error(value.value, value.std)
    if gains:
        gains.sort(key=lambda gain: gain.value)
        low, high = (_with_error(gain.value, gain.std) for gain in (gains[0], gains[-1]))
        yield "gain", low if len(gains) == 1 else f"{low} to {high}"


def _coefficient(value: float, error: float) -> str:
    """A coefficient with its error, or why it has none."""
    if error == 0:
        return f"{value:.7g}   held fixed"
    determined = error < UNDETERMINED * abs(value)
    return f"{_with_error(value, error)}{'' if determined else '   undetermined'}"


def _with_error(value: float, error: float) -> str:
    """The value down to the second digit of its error."""
    if not math.isfinite(value):
        return "not defined"
    if not math.isfinite(error) or error <= 0:
        return f"{value:.7g} ± {'unknown' if error else '0'}"
    decimals = min(max(1 - math.floor(math.log10(error)), 0), 12)
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"


def _nearest(result: FitResult) -> str:
    """The catalogue glasses next to the result, with their distances."""
    return ", ".join(
        f"{name} {distance:.{0 if distance >= 100 else 2}f} σ"
        for name, distance in result.nearest_glasses[:3]
    )


def _checked(check: Resampled) -> str:
    """What resampling found."""
    margin = check.ratio / math.sqrt(2 * (check.repeats - 1))
    return f"resampled n_d spreads {check.ratio:.2f} ± {margin:.2f} times its error"


def rendering_words(result: FitResult) -> str:
    """What a fit to a tolerance chose for its own render, and what that leaves open of n_d.

    Args:
        result: of `fit` with a tolerance.
    """
    assert result.rendering is not None
    fewest, most = result.samples[0], result.samples[-1]
    samples = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    return (
        f"n_d to an estimated {result.rendering.error:.1e} by {samples} samples a pixel,"
        f" {_count(result.rendering.refinements, 'refinement')}; tolerance"
        f" {result.rendering.tolerance:g}"
    )


def _probable(result: FitResult) -> str:
    """The catalogue glasses that it may be, with their probabilities."""
    names = [name for name, _ in result.nearest_glasses]
    each = zip(names, result.probabilities, strict=False)
    shown = [f"{name} {p:.3f}" for name, p in each if p >= LEAST_PROBABILITY]
    return ", ".join([*shown[:3], f"none of the table {result.other_probability:.3f}"])


# The fit as a page of plots.


def write_report(path: str | os.PathLike[str], result: FitResult, target: Picture) -> None:
    """Draw what a fit found: target, fit, residual, n(λ), its error, and the table.

    The file is written beside and renamed.

    Args:
        path: where to; the suffix says the format: .png, .pdf or .svg.
        result: of `fit`.
        target: what was fitted.

    Raises:
        ValueError: a suffix that cannot be drawn, or a folder that does not exist.
    """
    check_plot_output(path)
    figure = Figure(figsize=(13.5, 8.2), layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=(1, 1.05), width_ratios=(1, 1, 1.15))
    _draw_pictures([figure.add_subplot(grid[0, i]) for i in range(3)], result, target)
    _draw_index(figure.add_subplot(grid[1, 0]), result)
    _draw_difference(figure.add_subplot(grid[1, 1]), result)
    _draw_text(figure.add_subplot(grid[1, 2]), result)
    _save(figure, path)


def _draw_pictures(axes: list[Axes], result: FitResult, target: Picture) -> None:
    """Target and fit with the same exposure, and what lies between."""
    shown, seen_as = _displayed(target.radiance, target)
    fitted, _ = _displayed(result.picture, target)
    for axis, picture, title in zip(axes, (shown, fitted), ("target", "fit"), strict=False):
        axis.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axis.set_title(f"{title} ({seen_as})")
    residual = np.mean(np.asarray(result.picture, np.float64) - target.radiance, axis=-1)
    told = residual if result.used is None else residual[result.used]
    limit = float(np.percentile(np.abs(told), 99.5)) or float(np.abs(told).max()) or 1.0
    if result.used is not None:
        residual = np.where(result.used, residual, np.nan)
        axes[2].set_facecolor("0.6")
    drawn = axes[2].imshow(
        residual, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest"
    )
    axes[2].set_title(f"residual (fit − target){'' if result.used is None else ', grey: masked'}")
    bar = axes[2].figure.colorbar(drawn, ax=axes[2], extend="both", shrink=0.9)
    bar.set_label(f"radiance, mean over {_channels(target)}")
    bar.formatter.set_powerlimits((-2, 3))  # type: ignore[attr-defined]
    for axis in axes:
        axis.set_xlabel("x (pixels)")
        axis.set_ylabel("y (pixels)")


def _channels(target: Picture) -> str:
    if target.wavelengths is None:
        return "red, green, blue"
    return _bands(len(target.wavelengths))


def _bands(count: int) -> str:
    return "1 band" if count == 1 else f"{count} bands"


def _displayed(
    radiance: Float[np.ndarray, "height width channels"], target: Picture
) -> tuple[Float[np.ndarray, "height width *rgb"], str]:
    """What the eye would see of `radiance`, exposed for `target`, and what that is called."""
    try:
        light = linear_rgb(Picture(radiance, target.wavelengths))
        exposed_for, seen_as = linear_rgb(target), "as the eye sees it"
    except ValueError:  # bands that have no colour
        assert target.wavelengths is not None
        middle = len(target.wavelengths) // 2
        light, exposed_for = radiance[..., middle], target.radiance[..., middle]
        seen_as = f"{target.wavelengths[middle] * 1e3:.4g} nm"
    # A few glints may saturate; the picture behind them should not be dark.
    white = float(np.nanpercentile(exposed_for, 99))
    return encode_srgb(np.asarray(light, np.float64) / (white if white > 0 else 1.0)), seen_as


def _draw_index(axis: Axes, result: FitResult) -> None:
    """n(λ) of the fit with its band, among the nearest catalogue glasses."""
    wavelengths, n, error = _sorted_index(result)
    axis.plot(wavelengths, n, "o-", color="C0", markersize=3, zorder=3, label="fit")
    _band(axis, wavelengths, n - error, n + error)
    margin = 0.3 * float(np.ptp(n)) or 1e-4
    axis.set_ylim(float(n.min()) - margin, float(n.max()) + margin)
    for i, (name, difference) in enumerate(_nearest_differences(result, wavelengths, n), 1):
        _glass_curve(axis, wavelengths, n + difference, name, i)
    axis.set_title("refractive index")
    axis.set_xlabel("wavelength λ (µm)")
    axis.set_ylabel("n")
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")


def _draw_difference(axis: Axes, result: FitResult) -> None:
    """The band enlarged, and the catalogue glasses that lie beside it."""
    wavelengths, n, error = _sorted_index(result)
    _band(axis, wavelengths, -error * 1e5, error * 1e5)
    axis.axhline(0, color="C0", linewidth=1.5, label="fit")
    glasses = _nearest_differences(result, wavelengths, n)
    limit = 1e5 * _limit(error, [difference for _, difference in glasses])
    axis.set_ylim(-limit, limit)
    for i, (name, difference) in enumerate(glasses, 1):
        _glass_curve(axis, wavelengths, 1e5 * difference, name, i)
    axis.set_title("difference from the fit")
    axis.set_xlabel("wavelength λ (µm)")
    axis.set_ylabel("n − n_fit (1e-5)")
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")


def _nearest_differences(
    result: FitResult, wavelengths: Float[np.ndarray, " k"], n: Float[np.ndarray, " k"]
) -> list[tuple[str, Float[np.ndarray, " k"]]]:
    """The nearest catalogue glasses and how far their index lies from `n`."""
    names = [name for name, _ in result.nearest_glasses[:3]]
    return [(name, _indices(named_glass(name), wavelengths) - n) for name in names]


def _glass_curve(
    axis: Axes,
    wavelengths: Float[np.ndarray, " k"],
    values: Float[np.ndarray, " k"],
    name: str,
    number: int,
) -> None:
    """A catalogue glass; where the limits leave it out, the legend says so."""
    low, high = axis.get_ylim()
    inside = np.any((values >= low) & (values <= high))
    label = name if inside else f"{name} (outside)"
    axis.plot(wavelengths, values, ".--", color=f"C{number}", markersize=3, lw=1, label=label)


def _limit(error: Float[np.ndarray, " k"], glasses: list[Float[np.ndarray, " k"]]) -> float:
    """Half the height that shows the band and, unless that flattens the band, the nearest glass."""
    band = 3 * float(np.max(error, initial=0.0, where=np.isfinite(error)))
    glass = 1.2 * float(np.nanmax(np.abs(glasses[0]), initial=0.0)) if glasses else 0.0
    return (max(band, glass) if glass <= 10 * band or not band else band) or 1e-5


def _sorted_index(result: FitResult) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Wavelengths in rising order, with n and its error."""
    order = np.argsort(result.wavelengths)
    return result.wavelengths[order], result.n[order], result.n_std[order]


def _band(
    axis: Axes,
    wavelengths: Float[np.ndarray, " k"],
    low: Float[np.ndarray, " k"],
    high: Float[np.ndarray, " k"],
) -> None:
    """±1 sigma: an area, or a bar where a single wavelength spans none."""
    known = np.isfinite(low) & np.isfinite(high)
    if len(wavelengths) == 1 and known.all():
        middle = (low + high) / 2
        axis.errorbar(wavelengths, middle, (high - low) / 2, color="C0", capsize=4, label="±1σ")
    elif known.any():
        axis.fill_between(
            wavelengths, low, high, where=known, color="C0", alpha=0.25, linewidth=0, label="±1σ"
        )


def _draw_text(axis: Axes, result: FitResult) -> None:
    """The table of the result, as printed."""
    axis.axis("off")
    table, _, summary = result_table(result).partition("\n\n")
    lines = [part for line in table.split("\n") for part in textwrap.wrap(line, 50, **_HANGING)]
    lines += ["", *textwrap.wrap(" ".join(summary.split()), 52)]
    axis.text(
        0,
        1,
        "\n".join(lines).replace("$", r"\$"),
        transform=axis.transAxes,
        va="top",
        family="monospace",
        fontsize=8.5,
        linespacing=1.25,
    )


_HANGING: dict[str, Any] = {
    "subsequent_indent": " " * 11,
    "drop_whitespace": True,
    "replace_whitespace": False,
}
"""How a line of the table is broken: what follows stands under the second column."""


# What to expect of a bench.


def bench_table(bench: Bench) -> str:
    """What to expect as a short table, the summary, and the best of what was varied.

    Args:
        bench: of `vary_bench`.

    Returns:
        Lines without a newline after the last one; errors are 1 sigma.
    """
    expected, film = bench.expected, bench.film
    channels = "colour" if film.wavelengths is None else _bands(film.channels)
    rows = [
        ("object", expected.object_name or "(unnamed)"),
        ("picture", f"{film.width} x {film.height} pixels, {channels}"),
        ("noise", f"{expected.noise:g} in each value"),
        ("prior", expected.prior),
        *_known_rows(expected),
    ]
    return "\n".join([_table(rows, expected), *_variation_lines(bench)])


def _variation_lines(bench: Bench) -> Iterator[str]:
    """The best value of each thing that was varied, and what was left out, a line each."""
    if bench.variations:
        yield "\nBest of the values tried, one thing changed at a time:"
    for some in bench.variations:
        value, error = some.values[some.best], some.n_d_std[some.best]
        said = f"  {some.quantity}: {value:.4g}{f' {some.unit}' if some.unit else ''}"
        if value == some.own:
            yield f"{said}, as it is"
        else:
            change = f"{error:.2g} instead of {bench.expected.n_d_std:.2g}"
            yield f"{said} instead of {some.own:.4g}; σ of n_d {change}"
    for text in bench.left_out:
        yield f"Left out: {text}."


def bench_json(bench: Bench) -> dict[str, Any]:
    """What to expect as the content of `plan.json`.

    Args:
        bench: of `vary_bench`.

    Returns:
        As of `fit_json`.
    """
    return {
        "object": bench.expected.object_name,
        "prior": bench.expected.prior,
        "noise": _plain(bench.expected.noise),
        "size": [bench.film.width, bench.film.height],
        **_known_json(bench.expected),
        "variations": [
            {
                "quantity": some.quantity,
                "unit": some.unit,
                "own": _plain(some.own),
                "values": _plain(some.values),
                "n_d_std": _plain(some.n_d_std),
                "V_d_std": _plain(some.V_d_std),
                "best": _plain(some.values[some.best]),
            }
            for some in bench.variations
        ],
        "left_out": list(bench.left_out),
    }


def write_bench_json(path: str | os.PathLike[str], bench: Bench) -> None:
    """Write `bench_json(bench)`: beside, then renamed, so that an older file stays whole."""
    _write_json(path, bench_json(bench))


def write_bench_plot(path: str | os.PathLike[str], bench: Bench) -> None:
    """Draw how the errors of n_d and V_d change with each thing that was varied.

    The file is written beside and renamed.

    Args:
        path: where to; the suffix says the format: .png, .pdf or .svg.
        bench: of `vary_bench`.

    Raises:
        ValueError: a suffix that cannot be drawn, or a folder that does not exist.
    """
    check_plot_output(path)
    rows = -(-len(bench.variations) // 2)
    figure = Figure(figsize=(10.5, 3.9 * rows), layout="constrained")
    known = bench.expected
    title = (
        f"What a picture would tell of {known.object_name or 'the ball'} at a noise of"
        f" {known.noise:g}; as it is, n_d to {known.n_d_std:.2g} and V_d to {known.V_d_std:.2g}"
    )
    figure.suptitle(title.replace("$", r"\$"))
    axes = figure.subplots(rows, 2, sharey=True, squeeze=False).ravel()
    for axis, some in zip(axes, bench.variations, strict=False):
        _draw_variation(axis, some, known)
    for axis in axes[len(bench.variations) :]:
        axis.remove()
    _save(figure, path)


def _draw_variation(axis: Axes, some: Variation, known: Uncertainty) -> None:
    """One thing varied. On the right the scale of V_d, so that both meet at the bench as it is."""
    ratio = known.V_d_std / known.n_d_std
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.axvline(some.own, color="0.6", linewidth=1, linestyle=":", zorder=1)
    if some.counted:
        more = known.n_d_std * (some.own / some.values) ** (some.counted / 2)
        axis.plot(some.values, more, color="0.6", linewidth=1, label="1/√(number of values)")
    axis.plot(some.values, some.n_d_std, "o-", color="C0", markersize=5, label="n_d")
    axis.plot(some.values, some.V_d_std / ratio, "s--", color="C1", markersize=4, label="V_d")
    axis.plot(some.own, known.n_d_std, "o", color="k", markersize=9, mfc="none", label="as it is")
    axis.set_xlabel(f"{some.quantity}{f' ({some.unit})' if some.unit else ''}")
    axis.xaxis.set_major_locator(FixedLocator(list(some.values)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.xaxis.set_minor_locator(NullLocator())
    to_V_d: tuple[Any, Any] = (lambda y: y * ratio, lambda y: y / ratio)
    right = axis.secondary_yaxis("right", functions=to_V_d)
    scales = ((axis.yaxis, "σ of n_d", "C0"), (right.yaxis, "σ of V_d", "C1"))
    for scale, text, color in scales:
        scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
        scale.set_minor_locator(NullLocator())
        scale.set_label_text(text, color=color)
    axis.tick_params(labelleft=True)
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")


# What accuracy costs.


def tradeoff_table(found: Tradeoff) -> str:
    """The measured settings, the ones that nothing beats marked, and what they say in a sentence.

    Args:
        found: of `tradeoff`.

    Returns:
        Lines without a newline after the last one.
    """
    fits = isinstance(found.settings[0], FitSetting)
    columns, describe = (FIT_COLUMNS, _fit_cells) if fits else (COLUMNS, _picture_cells)
    rows = [["", "setting", *columns, "MB"]]
    for number, (setting, row) in enumerate(zip(found.settings, found.measured, strict=True)):
        mark = "*" if number in found.front else ""
        memory = f"{row.peak_memory_mb:.0f}"
        rows.append([mark, setting_words(setting), *describe(row, found), memory])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for mark, name, *told in rows:
        right = (text.rjust(width) for text, width in zip(told, widths[2:], strict=True))
        lines.append("  ".join([mark.ljust(widths[0]), name.ljust(widths[1]), *right]))
    return "\n".join([*lines, "", tradeoff_summary(found)])


COLUMNS = ("error", "ΔE", "99 %", "compile s", "s", "CPU s")
FIT_COLUMNS = ("of n_d", "of n", "of slopes", "n_d", "+-", "compile s", "s", "CPU s")
"""Head of the tables of pictures and of fits, between the setting and the memory."""


def _picture_cells(row: Measured, found: Tradeoff) -> list[str]:
    """The columns of a picture's row."""
    told = [_error_words(row, found), f"{row.delta_e_mean:.2f}", f"{row.delta_e_p99:.2f}"]
    return told + [f"{value:.3g}" for value in (row.compile_s, row.render_s, row.cpu_s)]


def _fit_cells(row: FitMeasured, found: Tradeoff) -> list[str]:
    """The columns of a fit's row."""
    slopes = "" if math.isnan(row.slope_error) else f"{row.slope_error:.2g}"
    told = [_error_words(row, found), f"{row.n_error:.2g}", slopes]
    told += [f"{row.n_d:.7f}", f"{row.n_d_std:.2g}" if row.converged else "failed"]
    return told + [f"{value:.3g}" for value in (row.compile_s, row.fit_s, row.cpu_s)]


def _error_words(row: Measured | FitMeasured, found: Tradeoff) -> str:
    """The error, or that it is smaller than what the reference can tell."""
    _, error = row.cost
    if error > found.reference_error:
        return f"{error:.2g}"
    return f"<{found.reference_error:.1g}"


def setting_words(setting: Setting | FitSetting) -> str:
    """A setting, of which the samples are always said and the rest where it is not as usual."""
    words = [_count(setting.samples, "sample") if setting.samples else "samples of its choice"]
    words += [f"depth {setting.depth}"]
    if isinstance(setting, FitSetting):
        words += [f"1 of {setting.every} bands"] if setting.every > 1 else []
    else:
        words += [setting.dtype] if setting.dtype != "float32" else []
        words += [_bands(setting.bands)] if setting.bands else []
    words += [f"1/{setting.shrink} size"] if setting.shrink > 1 else []
    return ", ".join(words)


def tradeoff_summary(found: Tradeoff) -> str:
    """What to take for some errors, and what half of an error costs."""
    fits = isinstance(found.settings[0], FitSetting)
    said = []
    for error in FIT_TRADED if fits else TRADED:
        number = found.fastest(error)
        if number is not None:
            seconds, _ = found.measured[number].cost
            wanted = f"n_d to {error:.0e}" if fits else f"{error:.0%}"
            said.append(
                f"for {wanted} take {setting_words(found.settings[number])}: {seconds:.2g} s"
            )
    sentences = [*said]
    if math.isfinite(found.fall) and math.isfinite(found.price):
        sentences.append(
            f"the error falls as samples^-{found.fall:.2f}; halving it costs"
            f" {found.price:.1f} times the time"
        )
    if fits:
        sentences += _choice_words(found)
    sentences.append(
        f"the reference has {found.reference_samples} samples a pixel and an error of"
        f" {found.reference_error:.1g} of its own"
    )
    return "\n".join(f"{text[0].upper()}{text[1:]}." for text in sentences)


def _choice_words(found: Tradeoff) -> list[str]:
    """What the fit's own choice of samples gives, and what noise leaves open anyway."""
    number = next(i for i, setting in enumerate(found.settings) if not setting.samples)
    row = found.measured[number]
    choice = f"the fit's own choice of samples: {row.n_d_error:.1g} in {row.fit_s:.2g} s"
    return [choice, f"what the picture leaves open of n_d in any case: {row.n_d_std:.1g}"]


def write_tradeoff_plot(path: str | os.PathLike[str], found: Tradeoff) -> None:
    """Draw error over time of each setting, and the line of those that nothing beats.

    The file is written beside and renamed.

    Args:
        path: where to; the suffix says the format: .png, .pdf or .svg.
        found: of `tradeoff`.

    Raises:
        ValueError: a suffix that cannot be drawn, or a folder that does not exist.
    """
    check_plot_output(path)
    figure = Figure(figsize=(8.5, 5.8), layout="constrained")
    axis = figure.subplots()
    axis.set_xscale("log")
    axis.set_yscale("log")
    kinds: dict[str, list[int]] = {}
    for number, setting in enumerate(found.settings):
        kinds.setdefault(_turned(setting, found.settings[0]), []).append(number)
    for (kind, numbers), marker in zip(kinds.items(), "osD^v<>P", strict=False):
        rows = [found.measured[number] for number in numbers]
        seconds, errors = zip(*(row.cost for row in rows), strict=True)
        line = "-" if kind == "samples alone" else ""
        axis.plot(seconds, errors, marker, linestyle=line, markersize=6, label=kind, alpha=0.8)
        for number, x, y in zip(numbers, seconds, errors, strict=True):
            text = _mark_words(found.settings[number], kind)
            axis.annotate(text, (x, y), (4, 4), textcoords="offset points", fontsize=8)
    front = [found.measured[number] for number in found.front]
    axis.step(
        *zip(*(row.cost for row in front), strict=True),
        where="post",
        color="0.6",
        zorder=0,
        label="nothing is faster and nearer",
    )
    axis.axhline(found.reference_error, color="0.6", linestyle=":", label="error of the reference")
    fits = isinstance(found.settings[0], FitSetting)
    axis.set_xlabel(f"time of a {'fit' if fits else 'render'} (s)")
    axis.set_ylabel("error of n_d" if fits else "relative root mean square error")
    film = found.film
    channels = "colour" if film.wavelengths is None else _bands(film.channels)
    axis.set_title(f"{film.width} x {film.height} pixels, {channels}")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize="small")
    _save(figure, path)


def _turned(setting: Setting | FitSetting, usual: Setting | FitSetting) -> str:
    """Which knob a setting turns beside the samples."""
    if setting.shrink > 1:
        return "smaller picture"
    if isinstance(setting, FitSetting):
        if not setting.samples:
            return "the fit's own choice"
        if setting.every > 1:
            return "fewer bands"
    elif setting.bands:
        return "bands for colour"
    elif isinstance(usual, Setting) and setting.dtype != usual.dtype:
        return setting.dtype
    return "shorter paths" if setting.depth != usual.depth else "samples alone"


def _mark_words(setting: Setting | FitSetting, kind: str) -> str:
    """What tells a point from the others of its kind."""
    if kind == "smaller picture":
        return f"1/{setting.shrink}"
    if kind == "shorter paths":
        return str(setting.depth)
    if isinstance(setting, FitSetting):
        return f"1/{setting.every}" if setting.every > 1 else str(setting.samples or "")
    return str(setting.bands or setting.samples)


# One glass.


def write_glass_plot(path: str | os.PathLike[str], glass: Sellmeier) -> None:
    """Draw n(λ) of a glass over its range of validity.

    The file is written beside and renamed.

    Args:
        path: where to; the suffix says the format: .png, .pdf or .svg.
        glass: what to draw. Where it states no range, that of optical catalogues is shown.

    Raises:
        ValueError: a suffix that cannot be drawn, or a folder that does not exist.
    """
    check_plot_output(path)
    low, high = _plot_range(glass)
    wavelengths = np.geomspace(low, high, 1001)
    n = _indices(glass, wavelengths)
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axis = figure.add_subplot()
    axis.plot(wavelengths, np.where(n < HIGHEST_INDEX, n, np.nan), color="C0")
    axis.set_title(f"{glass.name or 'glass'}, {low:.4g}–{high:.4g} µm".replace("$", r"\$"))
    axis.set_xlabel("wavelength λ (µm)")
    axis.set_ylabel("refractive index n")
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.grid(alpha=0.3)
    _save(figure, path)


def _plot_range(glass: Sellmeier) -> tuple[float, float]:
    """The range of validity, where it is one that can be drawn."""
    low, high = (float(edge) for edge in np.asarray(glass.validity))
    low = max(low, PLOT_LIMITS[0]) if low > 0 else min(UNSTATED_RANGE[0], high / 10)
    high = min(high, PLOT_LIMITS[1]) if high < np.inf else max(UNSTATED_RANGE[1], 10 * low)
    # A range that lies beyond the limits altogether is shown from its beginning.
    return (low, high) if low < high else (low, 10 * low)


def _indices(glass: Sellmeier, wavelengths: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """The index in double precision, whatever the state of JAX's switch; NaN where none is."""
    with jax.enable_x64(True):
        return np.asarray(glass.indices(wavelengths))


# Files.


def check_plot_output(path: str | os.PathLike[str]) -> None:
    """Raise now what writing a plot would raise later.

    Args:
        path: where the plot will go.

    Raises:
        ValueError: a suffix that cannot be drawn; a folder that does not exist.
    """
    suffix, folder = Path(path).suffix.lower(), Path(path).parent
    if suffix not in (".png", ".pdf", ".svg"):
        raise ValueError(f"{path}: a plot ends in one of .png, .pdf, .svg; found {suffix!r}")
    if not folder.is_dir():
        raise ValueError(f"{path}: there is no folder {folder}")
    if Path(path).is_dir():
        raise ValueError(f"{path}: is a folder")


def _save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure beside `path` and rename it."""
    FigureCanvasAgg(figure)
    with replacing(path) as beside:
        figure.savefig(beside, dpi=120)
