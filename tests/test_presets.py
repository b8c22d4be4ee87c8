import json
from pathlib import Path

import pytest

from diffdisp.presets import MEASURED, PRESETS

RECORD = Path(__file__).parents[1] / "benchmarks/results/presets.json"


@pytest.mark.parametrize("name", PRESETS)
def test_errors_are_those_of_the_record(name):
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    preset = PRESETS[name]
    errors = {
        row["scene"]: row["error"]
        for row in record["figures"]
        if row["samples"] == preset.samples and row["depth"] == 50
    }
    bench, gallery = errors.pop("bench_nbk7"), errors.values()
    assert len(gallery) == 4
    assert preset.bench == pytest.approx(bench, rel=0.06)
    assert preset.gallery == pytest.approx((min(gallery), max(gallery)), rel=0.06)
    assert record["date"] == MEASURED
    assert MEASURED in str(preset)
