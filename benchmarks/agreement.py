"""How well a render of the true glass agrees with another renderer's picture of the bench.

Where that picture's standard error is above 1e-3 its noise is known well enough to compare with:
there, a robust reduced χ², median(z²) over the median of χ² with one degree of freedom, is 1 for
a render without an error of its own. Elsewhere, the root mean square of the difference.
"""

import argparse
import time

import numpy as np
from record import TARGET_GLASS, TARGET_PICTURE, TARGET_SCENE, print_table, write_record

from diffdisp import Scene, load_scene, named_glass, read_picture, render, with_glass

CHI2_MEDIAN = 0.455
"""Median of χ² with one degree of freedom. Source: Abramowitz and Stegun, table 26.8."""
LEAST_ERROR = 1e-3
"""Standard errors below this are estimated from too few different samples to divide by."""
BALL = 0
"""Number of the ball among the objects of the bench."""


def ball_disc(scene: Scene, height: int, width: int) -> np.ndarray:
    """Mask (height, width) of the pixels whose middle shows the ball."""
    look_from, look_at = np.asarray(scene.camera.look_from), np.asarray(scene.camera.look_at)
    sphere = scene.objects[BALL].shape
    assert np.array_equal(look_at, sphere.center), "the camera must look at the ball's centre"
    half_angle = np.arcsin(sphere.radius / np.linalg.norm(look_from - look_at))
    edge = np.tan(np.radians(scene.camera.vertical_fov) / 2)
    radius = np.tan(half_angle) / edge * height / 2
    y, x = np.mgrid[:height, :width] + 0.5
    return np.hypot(x - width / 2, y - height / 2) < radius


def compare(
    picture: np.ndarray, target: np.ndarray, error: np.ndarray, disc: np.ndarray
) -> dict[str, float]:
    """Agreement of one band, all arrays (height, width)."""
    noisy = error > LEAST_ERROR
    residual = picture - target
    z = residual[noisy] / error[noisy]
    return {
        "chi2": float(np.median(z**2) / CHI2_MEDIAN),
        "rms_elsewhere": float(np.sqrt(np.mean(residual[~noisy] ** 2))),
        "disc_percent": float(100 * (picture[disc].mean() / target[disc].mean() - 1)),
    }


def measure(samples: int, depth: int) -> dict[str, object]:
    """Agreement of every band at `samples` per pixel, and the time of the render."""
    target = read_picture(str(TARGET_PICTURE))
    with np.load(TARGET_PICTURE) as stored:
        error = stored["standard_error"]
    scene = with_glass(load_scene(str(TARGET_SCENE)), BALL, named_glass(TARGET_GLASS))
    seconds = []
    for _ in range(2):  # the first compiles
        start = time.perf_counter()
        picture = render(scene, target.film, samples=samples, depth=depth, dtype="float64")
        seconds.append(time.perf_counter() - start)
    disc = ball_disc(scene, *picture.shape[:2])
    bands = [
        {"nm": float(1e3 * wavelength)}
        | compare(picture[..., k], target.radiance[..., k], error[..., k], disc)
        for k, wavelength in enumerate(target.film.wavelengths)
    ]
    return {
        "samples": samples,
        "chi2_median_band": float(np.median([band["chi2"] for band in bands])),
        "rms_elsewhere_worst": max(band["rms_elsewhere"] for band in bands),
        "disc_percent_worst": max((band["disc_percent"] for band in bands), key=abs),
        "first_s": seconds[0],
        "warm_s": seconds[1],
        "bands": bands,
    }


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, nargs="+", default=[16, 64], help="per pixel")
    parser.add_argument("--long", action="store_true", help="also 256 samples")
    parser.add_argument("--depth", type=int, default=50, help="segments of a path")
    options = parser.parse_args()
    counts = [*options.samples, 256] if options.long else options.samples
    figures = [measure(samples, options.depth) for samples in counts]
    bands = [(figure["samples"], *band.values()) for figure in figures for band in figure["bands"]]
    print_table(("samples", "nm", "χ²", "RMS elsewhere", "disc %"), bands)
    print()
    head = (
        "samples",
        "χ² median band",
        "RMS elsewhere, worst",
        "disc %, worst",
        "first s",
        "warm s",
    )
    print_table(head, [list(figure.values())[:-1] for figure in figures])
    settings = {"samples": counts, "depth": options.depth, "dtype": "float64"}
    write_record("agreement", settings, figures)


if __name__ == "__main__":
    main()
