"""How long the scenes of the gallery take to compile: with nothing kept, and from the cache.

Each time is what `diffdisp render --timing` tells of a process of its own.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from record import ROOT, print_table, write_record

SCENES = ("dispersion", "metal_and_matte", "lamps", "default")
SIZE, SAMPLES = "640x480", "16"


def compile_seconds(scene: str, folder: Path) -> float:
    """Seconds that a process takes to compile, with a cache in `folder`."""
    told = subprocess.run(
        [
            *(sys.executable, "-m", "diffdisp", "render", f"{ROOT}/fixtures/scenes/{scene}.toml"),
            *("-o", str(folder / "picture.npz"), "--size", SIZE, "--samples", SAMPLES),
            "--timing",
        ],
        env={**os.environ, "XDG_CACHE_HOME": str(folder)},
        check=True,
        capture_output=True,
        text=True,
    )
    return float(json.loads(told.stdout.splitlines()[-1])["compile_s"])


def main() -> None:
    """Print and record both times of each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3, help="of each, of which the median")
    options = parser.parse_args()
    rows = []
    for scene in SCENES:
        cold, kept = [], []
        for _ in range(options.runs):
            with tempfile.TemporaryDirectory() as folder:
                cold.append(compile_seconds(scene, Path(folder)))
                kept.append(compile_seconds(scene, Path(folder)))
        rows.append((scene, statistics.median(cold), max(cold), statistics.median(kept), max(kept)))
    print_table(("scene", "cold_s", "cold_most_s", "kept_s", "kept_most_s"), rows)
    figures = {
        scene: {"cold_s": cold, "cold_most_s": most, "kept_s": kept, "kept_most_s": longest}
        for scene, cold, most, kept, longest in rows
    }
    write_record("compile_times", {**vars(options), "size": SIZE, "samples": SAMPLES}, figures)


if __name__ == "__main__":
    main()
