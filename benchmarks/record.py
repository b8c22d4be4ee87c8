"""What every benchmark needs: the files it measures on, its table, and its record.

Run alone it prints the machine and the versions that records name.
"""

import importlib.metadata
import json
import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
TARGET_SCENE = ROOT / "fixtures/targets/ball_nbk7.toml"
"""The bench of the shared target; its glass is the start of a fit."""
TARGET_PICTURE = ROOT / "fixtures/targets/ball_nbk7.npz"
TARGET_GLASS = "N-BK7"
"""What the ball of the shared target is made of."""
RESULTS = ROOT / "benchmarks/results"

PACKAGES = ("jax", "numpy", "optimistix", "diffdisp")


def machine() -> dict[str, Any]:
    """System, processor and the number of cores this process may use."""
    usable = getattr(os, "sched_getaffinity", None)
    return {
        "platform": platform.platform(),
        "cpu": _cpu_model(),
        "cores": len(usable(0)) if usable else os.cpu_count(),
    }


def _cpu_model() -> str:
    """The processor's name where the system gives one."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def versions() -> dict[str, str]:
    """Of Python and of the packages that the figures depend on."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"python": platform.python_version(), **found}


def write_record(name: str, settings: dict[str, Any], figures: Any) -> None:
    """`keep_record`, and say so."""
    path = keep_record(name, settings, figures)
    print(f"written: {path.relative_to(ROOT)}")


def keep_record(name: str, settings: dict[str, Any], figures: Any) -> Path:
    """Write results/`name`.json, whole or not at all.

    Args:
        name: of the benchmark.
        settings: the options it ran with.
        figures: what it measured, as JSON can hold it.
    """
    record = {
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
        "versions": versions(),
        "settings": settings,
        "figures": figures,
    }
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps(record, indent=2, ensure_ascii=False) + "\n")
    return fresh.replace(path)


def recorded(name: str) -> Any:
    """The figures of results/`name`.json."""
    return json.loads((RESULTS / f"{name}.json").read_text())["figures"]


def print_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print rows under their head; numbers with four digits."""
    cells = [list(head)] + [[_cell(value) for value in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        first, *others = (text.ljust(w) for text, w in zip(row, widths, strict=True))
        right = (text.strip().rjust(w) for text, w in zip(others, widths[1:], strict=True))
        print("  ".join([first, *right]))


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main() -> None:
    """Print the machine and the versions."""
    print_table(("what", "value"), [*machine().items(), *versions().items()])


if __name__ == "__main__":
    main()
