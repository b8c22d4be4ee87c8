"""The list of modules is the architecture: a module imports only from those above it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "diffdisp"
ORDER = (
    "presets",
    "timing",
    "vector",
    "dispersion",
    "glasses",
    "glass_database",
    "fresnel",
    "geometry",
    "texture",
    "outline",
    "material",
    "camera",
    "scene",
    "parameters",
    "color",
    "film",
    "image",
    "sampling",
    "planning",
    "integrator",
    "programs",
    "chunks",
    "wavefront",
    "rendering",
    "tolerance",
    "misfit",
    "linearised",
    "fitting",
    "varying",
    "scene_file",
    "measuring",
    "fit_measuring",
    "report",
    "__main__",
)


def faults(source: str, allowed: tuple[str, ...]) -> Iterator[str]:
    """What `source` may not import, inside functions too, when only `allowed` stand above it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "diffdisp":
                    yield f"line {node.lineno}: write `from diffdisp.x import y`"
        elif isinstance(node, ast.ImportFrom):
            top, _, module = (node.module or "").partition(".")
            if node.level or (top == "diffdisp" and not module):
                yield f"line {node.lineno}: write `from diffdisp.x import y`"
            elif top == "diffdisp" and module not in allowed:
                yield f"line {node.lineno}: {module} does not stand above it"


def test_the_list_is_the_folder():
    found = {path.relative_to(PACKAGE).with_suffix("").as_posix() for path in PACKAGE.rglob("*.py")}
    assert found - {"__init__"} == set(ORDER)


@pytest.mark.parametrize("module", ORDER)
def test_imports_only_from_above(module):
    source = (PACKAGE / f"{module}.py").read_text(encoding="utf-8")
    assert list(faults(source, ORDER[: ORDER.index(module)])) == []


@pytest.mark.parametrize(
    "statement",
    [
        "import diffdisp",
        "import diffdisp.vector",
        "import numpy, diffdisp.vector as v",
        "from diffdisp import vector",
        "from . import vector",
        "from .vector import Vec3",
        "from diffdisp.scene import Scene",
        "from diffdisp.vector.deep import x",
        "def f():\n    from diffdisp.scene import Scene",
    ],
)
def test_a_wrong_import_is_found(statement):
    assert len(list(faults(statement, ("vector",)))) == 1


@pytest.mark.parametrize(
    "statement", ["import jax", "from diffdisp.vector import Vec3", "from diffdispx import y"]
)
def test_a_right_import_is_none(statement):
    assert list(faults(statement, ("vector",))) == []
