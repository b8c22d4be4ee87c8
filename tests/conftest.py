from pathlib import Path

import jax
import pytest

MOST_MAPS = 20_000

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled programs between runs; `--cache-clear` drops them."""
    jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("jax")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    # An entry cut short by an interrupted run is compiled again: no fault of the code under test.
    config.addinivalue_line(
        "filterwarnings", "ignore:Error (reading|writing) persistent compilation cache entry"
    )


def pytest_runtest_teardown(nextitem: pytest.Item | None) -> None:
    """Drop compiled programs before their memory maps run out.

    Each program takes some; at 65 530, Linux's limit (`vm.max_map_count`), compilation crashes.
    """
    maps = Path("/proc/self/maps")
    if nextitem is not None and maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
