"""How long something takes, and how much memory."""

import statistics
import sys
import time
from collections.abc import Callable
from typing import Any


def warm_times(
    work: Callable[[], Any], runs: int, longest: float = float("inf")
) -> tuple[Any, float, float]:
    """What some work gives, and how long it takes once all is compiled.

    Args:
        work: what has been done once already.
        runs: how many times it is done, for the median.
        longest: time in s of a run from which on there is no further one.

    Returns:
        What the last run gave; seconds by the clock; seconds of all cores together.
    """
    walls, cpus = [], []
    for _ in range(runs):
        start, start_busy = time.perf_counter(), time.process_time()
        given = work()
        walls.append(time.perf_counter() - start)
        cpus.append(time.process_time() - start_busy)
        if walls[-1] > longest:
            break
    return given, statistics.median(walls), statistics.median(cpus)


def peak_memory_mb() -> float:
    """The most memory that this process has held so far, MB."""
    import resource  # not there on every system

    # Linux counts in KiB, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
