import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import diffdisp
from diffdisp.programs import COMPILER_OPTIONS


def typed_imports() -> list[tuple[str, str]]:
    """Module and name of each import that only type checkers see."""
    tree = ast.parse(Path(diffdisp.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return [
        (node.module, alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]


CONSTANTS = {"COMPILER_OPTIONS": COMPILER_OPTIONS}


@pytest.mark.parametrize("name", sorted({*diffdisp.__all__} - {*CONSTANTS}))
def test_every_public_name_resolves(name):
    value = getattr(diffdisp, name)
    assert callable(value)
    assert value.__name__ == name
    assert vars(diffdisp)[name] is value  # the second look-up is an ordinary one


@pytest.mark.parametrize("name", CONSTANTS)
def test_public_constants_are_those_of_their_modules(name):
    assert getattr(diffdisp, name) is CONSTANTS[name]


def test_type_checkers_see_the_same_names():
    assert sorted(name for _, name in typed_imports()) == sorted(diffdisp.__all__)
    for module, name in typed_imports():
        assert diffdisp._MODULE[name] == module.removeprefix("diffdisp.")


def test_dir_lists_them():
    assert set(diffdisp.__all__) <= set(dir(diffdisp))


def test_unknown_name():
    with pytest.raises(AttributeError, match="no attribute 'renderer'"):
        diffdisp.renderer  # noqa: B018


def test_no_module_hides_a_public_name():
    modules = {path.stem for path in Path(diffdisp.__file__).parent.glob("*.py")}
    assert modules.isdisjoint(diffdisp.__all__)


@pytest.mark.parametrize(
    "statement",
    [
        "import diffdisp",
        "from diffdisp.__main__ import main; assert main(['--help']) == 0",
        "from diffdisp.__main__ import main; assert main(['render', '--help']) == 0",
        "from diffdisp.__main__ import main; assert main(['--version']) == 0",
    ],
)
def test_import_and_help_load_nothing_heavy(statement):
    heavy = ["jax", "numpy", "equinox", "pydantic", "matplotlib"]
    check = f"import sys; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", f"{statement}\n{check}"], capture_output=True, text=True
    )
    assert done.stderr == ""
    assert done.stdout.splitlines()[-1] == "[]"


OURS = "xla_backend_extra_options=xla_cpu_disable_tiled_emitter"


@pytest.mark.parametrize(
    ("flags", "kept"),
    [
        (None, f"--{OURS}"),
        ("--xla_cpu_enable_fast_math=false", f"--xla_cpu_enable_fast_math=false --{OURS}"),
        ("--xla_backend_extra_options=x", "--xla_backend_extra_options=x"),
    ],
)
def test_xla_is_told_how_to_write_loops_by_who_asks_first(flags, kept):
    surroundings = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    if flags is not None:
        surroundings["XLA_FLAGS"] = flags
    check = "import diffdisp, os; print(os.environ['XLA_FLAGS'])"
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, env=surroundings
    )
    assert done.stdout.strip() == kept
