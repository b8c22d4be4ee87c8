"""The pinned versions: every dependency, with hashes, from wherever pip is set to look."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
CONSTRAINTS = (ROOT / "constraints.txt").read_text(encoding="utf-8")
PINNED = {
    match["name"]: match
    for match in re.finditer(
        r"^(?P<name>\S+)==(?P<version>\S+)(?P<hashes>(?: \\\n +--hash=sha256:[0-9a-f]{64})*)$",
        CONSTRAINTS,
        re.MULTILINE,
    )
}


def direct_dependencies() -> list[Requirement]:
    """What `make` installs by name: the core, the `io` and `test` extras, the build backend."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        pyproject = tomllib.load(file)
    extras = pyproject["project"]["optional-dependencies"]
    lines = [
        *pyproject["build-system"]["requires"],
        *pyproject["project"]["dependencies"],
        *extras["io"],
        *extras["test"],
    ]
    return [r for r in map(Requirement, lines) if r.name != pyproject["project"]["name"]]


@pytest.mark.parametrize(
    "address", ["http", "file:", "--find-links", "-f ", "--index-url", "--extra-index-url", "@"]
)
def test_constraints_hold_no_address(address):
    assert not [line for line in CONSTRAINTS.splitlines() if address in line]


def test_constraints_are_only_pins_hashes_and_comments():
    rest = [
        line
        for line in CONSTRAINTS.splitlines()
        if not re.fullmatch(r"\S+==\S+ \\|    --hash=sha256:[0-9a-f]{64}( \\)?|    #.*", line)
    ]
    assert rest == []


@pytest.mark.parametrize("requirement", direct_dependencies(), ids=lambda r: r.name)
def test_dependency_is_pinned_within_its_range(requirement):
    pin = PINNED[canonicalize_name(requirement.name)]
    assert requirement.specifier.contains(pin["version"])


def test_every_pin_has_hashes():
    assert [name for name, pin in PINNED.items() if not pin["hashes"]] == []
