"""Differentiable dispersion renderer: draws dispersive glass, and recovers it from pictures.

Names are looked up when they are first used, so that `import diffdisp` takes no time: JAX alone
takes 0.8 s.
"""

import importlib
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffdisp.camera import Camera
    from diffdisp.color import encode_srgb
    from diffdisp.dispersion import Sellmeier
    from diffdisp.film import Film, band_middles
    from diffdisp.fit_measuring import fit_tradeoff
    from diffdisp.fitting import (
        FitResult,
        FreeValue,
        Rendered,
        Resampled,
        StopFit,
        Uncertainty,
        expected_uncertainty,
        fit,
    )
    from diffdisp.geometry import Plane, Sphere
    from diffdisp.glasses import glass_source, glass_table, load_glass, named_glass
    from diffdisp.image import Picture, linear_rgb, read_picture, write_picture
    from diffdisp.material import Dielectric, Emitter, Lambertian, Metal
    from diffdisp.measuring import tradeoff
    from diffdisp.planning import Plan, make_plan
    from diffdisp.programs import COMPILER_OPTIONS
    from diffdisp.rendering import render
    from diffdisp.report import (
        result_table,
        tradeoff_table,
        write_fit_json,
        write_report,
        write_tradeoff_plot,
    )
    from diffdisp.scene import Background, Object, Scene, with_glass
    from diffdisp.scene_file import SceneError, load_scene, save_scene, scene_schema
    from diffdisp.texture import Checker, Checker2D, Solid
    from diffdisp.tolerance import render_to_tolerance

__all__ = [
    "COMPILER_OPTIONS",
    "Background",
    "Camera",
    "Checker",
    "Checker2D",
    "Dielectric",
    "Emitter",
    "Film",
    "FitResult",
    "FreeValue",
    "Lambertian",
    "Metal",
    "Object",
    "Picture",
    "Plan",
    "Plane",
    "Rendered",
    "Resampled",
    "Scene",
    "SceneError",
    "Sellmeier",
    "Solid",
    "Sphere",
    "StopFit",
    "Uncertainty",
    "band_middles",
    "encode_srgb",
    "expected_uncertainty",
    "fit",
    "fit_tradeoff",
    "glass_source",
    "glass_table",
    "linear_rgb",
    "load_glass",
    "load_scene",
    "make_plan",
    "named_glass",
    "read_picture",
    "render",
    "render_to_tolerance",
    "result_table",
    "save_scene",
    "scene_schema",
    "tradeoff",
    "tradeoff_table",
    "with_glass",
    "write_fit_json",
    "write_picture",
    "write_report",
    "write_tradeoff_plot",
]


def _disable_tiled_emitter() -> None:
    """Have XLA write loops of sums and products as it writes all others.

    In float64 it writes each vector to the stack in two halves and reads it back whole, for which
    the processor waits: programs take a third longer. XLA takes this choice from the environment
    alone, when the first program is compiled. Who chooses there what XLA is to do keeps the choice.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        ours = "--xla_backend_extra_options=xla_cpu_disable_tiled_emitter"
        os.environ["XLA_FLAGS"] = f"{flags} {ours}".strip()


_disable_tiled_emitter()

_NAMES = {
    "camera": ("Camera",),
    "color": ("encode_srgb",),
    "dispersion": ("Sellmeier",),
    "film": ("Film", "band_middles"),
    "fit_measuring": ("fit_tradeoff",),
    "fitting": (
        "FitResult",
        "FreeValue",
        "Rendered",
        "Resampled",
        "StopFit",
        "Uncertainty",
        "expected_uncertainty",
        "fit",
    ),
    "geometry": ("Plane", "Sphere"),
    "glasses": ("glass_source", "glass_table", "load_glass", "named_glass"),
    "image": ("Picture", "linear_rgb", "read_picture", "write_picture"),
    "material": ("Dielectric", "Emitter", "Lambertian", "Metal"),
    "measuring": ("tradeoff",),
    "planning": ("Plan", "make_plan"),
    "programs": ("COMPILER_OPTIONS",),
    "rendering": ("render",),
    "report": (
        "result_table",
        "tradeoff_table",
        "write_fit_json",
        "write_report",
        "write_tradeoff_plot",
    ),
    "scene": ("Background", "Object", "Scene", "with_glass"),
    "scene_file": ("SceneError", "load_scene", "save_scene", "scene_schema"),
    "texture": ("Checker", "Checker2D", "Solid"),
    "tolerance": ("render_to_tolerance",),
}
_MODULE = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> object:
    """The public name, from the module that defines it."""
    if name not in _MODULE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(importlib.import_module(f"{__name__}.{_MODULE[name]}"), name)
    globals()[name] = value  # found at once from now on
    return value


def __dir__() -> list[str]:
    """The public names too, imported or not."""
    return sorted({*globals(), *__all__})
