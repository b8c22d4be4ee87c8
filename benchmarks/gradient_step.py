"""What a gradient step costs beside Mitsuba 3, and how far off each gradient is.

A glass ball of one index before a wall that shines in a checker; the loss is the mean square of the
picture against one of another index. Mitsuba has no derivative for smooth glass: its glass is
slightly rough (GGX) here, so that its picture is another one. So each program's gradient is held
against its own central difference of the loss, from pictures of many more samples. Both make steps
in turn. Needs `pip install mitsuba`; set DRJIT_LIBLLVM_PATH if it finds no LLVM.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from record import print_table, write_record

from diffdisp import (
    COMPILER_OPTIONS,
    Camera,
    Checker2D,
    Dielectric,
    Emitter,
    Film,
    Object,
    Plane,
    Scene,
    Sellmeier,
    Sphere,
    render,
    with_glass,
)

INDEX, TARGET = 1.5, 1.52
"""Of the glass where the gradient is taken, and of that of the target."""
STEP = 5e-3
"""In the index, of the differences of the loss."""
EYE, WALL, FIELD_OF_VIEW = 5.0, -3.0, 30.0
"""Places of camera and wall along z, the ball of radius 1 at 0; degrees."""
CELLS = 100
"""Of Mitsuba's wall, one unit each; ours has no end."""
ROUGHNESS = 0.05
CONVERGED = 1024
"""Samples a pixel of the pictures whose differences are taken."""

Step = Callable[[int], float]
"""A gradient, from the number of a repeat."""


def ours(size: int, counts: list[int]) -> tuple[list[Step], float]:
    """Steps of diffdisp, for each number of samples, and the difference of its loss."""
    wall = Object(Plane([0, 0, WALL], [0, 0, 1]), Emitter(Checker2D([1.0] * 3, [0.0] * 3, 1.0)))
    ball = Object(Sphere([0.0, 0, 0], 1.0), Dielectric(Sellmeier([1.0, 0, 0], [0.0, 0, 0])))
    scene = Scene(Camera([0.0, 0, EYE], [0.0, 0, 0], vertical_fov=FIELD_OF_VIEW), [ball, wall])
    film = Film(size, size, np.array([0.55]))  # all channels of so grey a scene are this one

    def picture(n: Any, samples: int) -> jax.Array:
        excess = [n * n - 1, 0 * n, 0 * n]
        glass = Sellmeier(jnp.stack(excess) if isinstance(n, jax.Array) else excess, np.zeros(3))
        return render(with_glass(scene, 0, glass), film, samples=samples)

    target, *moved = (
        picture(np.float64(n), CONVERGED) for n in (TARGET, INDEX + STEP, INDEX - STEP)
    )
    losses = [float(np.mean((np.asarray(seen, float) - target) ** 2)) for seen in moved]

    def step(samples: int) -> Step:
        gradient = jax.jit(
            jax.grad(lambda n: jnp.mean((picture(n, samples) - target) ** 2)),
            compiler_options=COMPILER_OPTIONS,
        )
        return lambda _: float(gradient(jnp.asarray(INDEX)))

    return [step(samples) for samples in counts], (losses[0] - losses[1]) / (2 * STEP)


def mitsubas(size: int, samples: int, depth: int) -> tuple[Step, float]:
    """A step of Mitsuba, and the difference of its loss."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    to = mi.ScalarTransform4f()
    cells = np.indices((CELLS, CELLS)).sum(axis=0) % 2
    checker = np.repeat(cells[:, :, None], 3, axis=2).astype(np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(checker), "raw": True, "filter_type": "nearest"}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "rgb", "component_format": "float32"}
    glass = {"type": "roughdielectric", "distribution": "ggx", "alpha": ROUGHNESS}
    glass |= {"int_ior": INDEX, "ext_ior": 1.0}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": depth, "rr_depth": 1000},
            "sensor": {
                "type": "perspective",
                "fov": FIELD_OF_VIEW,
                "fov_axis": "y",
                "to_world": to.look_at(origin=[0, 0, EYE], target=[0, 0, 0], up=[0, 1, 0]),
                "film": film,
                "sampler": {"type": "independent", "sample_count": samples},
            },
            "wall": {
                "type": "rectangle",
                "to_world": to.translate([0, 0, WALL]).scale([CELLS / 2, CELLS / 2, 1]),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
                "emitter": {"type": "area", "radiance": bitmap},
            },
            "glass": {"type": "sphere", "bsdf": glass},
        }
    )
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("eta"))

    def mean(eta: float, repeats: range) -> np.ndarray:
        params[key] = eta
        params.update()
        return np.mean([np.array(mi.render(scene, spp=samples, seed=k)) for k in repeats], axis=0)

    repeats = range(1000, 1000 + -(-CONVERGED // samples))
    target = mean(TARGET, repeats)
    # With fixed weights the variance of the pictures, which moves with the index, adds nothing.
    weights = 2 * (mean(INDEX, repeats) - target)
    more, less = (mean(INDEX + h, range(2000, 2000 + len(repeats))) for h in (STEP, -STEP))
    difference = float(np.mean(weights * (more - less)) / (2 * STEP))
    wanted = mi.TensorXf(target)

    def gradient(number: int) -> float:
        eta = mi.Float(INDEX)
        dr.make_opaque(eta)
        dr.enable_grad(eta)
        params[key] = eta
        params.update()
        image = mi.render(scene, params, spp=samples, seed=number, seed_grad=number + 500)
        dr.backward(dr.mean(dr.square(image - wanted), axis=None))
        return float(np.array(dr.grad(params[key])).ravel()[0])

    return gradient, difference


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--size", type=int, default=128, help="pixels of an edge")
    add("--samples", type=int, nargs="+", default=[4, 16, 64], help="of ours, per pixel")
    add("--its-samples", type=int, default=64, help="of Mitsuba's, per pixel")
    add("--depth", type=int, default=6, help="of Mitsuba's; ours has 50")
    add("--runs", type=int, default=9, help="steps of each, of which medians")
    options = parser.parse_args()
    steps, difference = ours(options.size, options.samples)
    programs = {
        f"diffdisp, {count}": (step, difference)
        for count, step in zip(options.samples, steps, strict=True)
    }
    try:
        its = mitsubas(options.size, options.its_samples, options.depth)
        programs[f"Mitsuba {version('mitsuba')}, {options.its_samples}"] = its
    except ImportError:
        print("Mitsuba is not installed: skipped", file=sys.stderr)
    found: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in programs}
    for run in range(options.runs + 2):  # the first two compile
        for name, (step, _) in programs.items():
            start = time.perf_counter()
            gradient = step(run)
            if run > 1:
                found[name][0].append(time.perf_counter() - start)
                found[name][1].append(gradient)
    rows = []
    for name, (seconds, gradients) in found.items():
        difference = programs[name][1]
        off = np.sqrt(np.mean((np.array(gradients) / difference - 1) ** 2))
        rows.append((name, statistics.median(seconds), float(off), difference))
    head = ("program, samples", "step s", "off by", "difference")
    print_table(head, rows)
    figures = [
        dict(zip(("program", "step_s", "off", "difference"), row, strict=True)) for row in rows
    ]
    write_record("gradient_step", vars(options), figures)


if __name__ == "__main__":
    main()
