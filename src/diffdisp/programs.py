"""Compiled programs, kept in memory and beside JAX's own compile cache.

JAX's cache of compiled programs is keyed by what has been traced, and tracing takes longer than a
small picture. Here a program is found by what decides it: the source, the static choices, and the
shapes of its arguments.
"""

import functools
import gc
import hashlib
import os
import pickle
import platform
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable

from diffdisp.image import replacing

COMPILER_OPTIONS = {
    "xla_cpu_prefer_vector_width": "512",
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner,cse_barrier_expander",
}
"""Compiler options for programs that trace paths: our own, and `jax.jit`'s of `render`.

Wide vectors take a third less time where the processor has AVX-512. A kernel of a few microseconds
is not shared out among threads: to wait for the other one would take several times as long, and
our own threads fill the cores. Barriers stay where they are, so that the compiler fuses no loop
across them.
"""

QUICK = {
    **COMPILER_OPTIONS,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_copy_insertion_use_region_analysis": True,
}
"""The same for `program`: compiled in four fifths of the time, into programs that are as fast.

A closer look at where loops need copies of what they carry saves many of large arrays.
"""

Program = Callable[..., jax.Array]


_READY: dict[tuple[Any, ...], Program] = {}
_LOCK = threading.Lock()


def program(traced: Callable[..., jax.Array], static: tuple[Any, ...], arguments: Any) -> Program:
    """The compiled program for `traced(*static, *arguments)`, to be called with the arguments.

    Where JAX keeps compiled programs on disk this one is kept there too.

    Args:
        traced: a function of this package that returns one array.
        static: what it is specialised to; hashable, and described by its `repr`.
        arguments: NumPy arrays in trees, of the shapes and types to be called with.
    """
    leaves, structure = jax.tree.flatten((arguments, {}))
    shapes = tuple((leaf.shape, leaf.dtype.name) for leaf in leaves)
    wide = bool(_config().jax_enable_x64)
    key = (traced, static, structure, shapes, wide)
    with _LOCK:
        if key not in _READY:
            described = repr((traced.__name__, static, str(structure), shapes, wide))
            _READY[key] = _loaded_or_compiled(traced, static, arguments, described)
        return _READY[key]


def _config() -> Any:
    return jax.config


def _loaded_or_compiled(
    traced: Callable[..., jax.Array], static: tuple[Any, ...], arguments: Any, described: str
) -> Program:
    """The program from disk, or compiled and then kept there."""
    file = _file(described)
    if file is not None and file.exists():
        try:
            trees = jax.tree.structure((arguments, {})), jax.tree.structure(0)
            stored = pickle.loads(file.read_bytes())
            return serialize_executable.deserialize_and_load(stored, *trees)
        except Exception:  # whatever is wrong with a kept program, there is another way to it
            file.unlink(missing_ok=True)
    # JAX must not find it in its own cache: what comes from there cannot be kept once more. So
    # each compilation has a name that no other has, and is not put there.
    alone = functools.update_wrapper(functools.partial(traced), traced)
    alone.__name__ = f"{traced.__name__}_{secrets.token_hex(8)}"
    jitted = jax.jit(alone, static_argnums=tuple(range(len(static))), compiler_options=QUICK)
    with _no_collection():
        lowered = jitted.lower(*static, *arguments)
    with _not_in_jax_cache():
        compiled = lowered.compile()
    if file is not None:
        _keep(compiled, file)
    return compiled


@contextmanager
def _no_collection() -> Iterator[None]:
    """No search for garbage, which takes a fifth of the time of tracing and finds none."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@contextmanager
def _not_in_jax_cache() -> Iterator[None]:
    """Nothing is written to JAX's own cache, which takes as long as to keep the program here."""
    name = "jax_persistent_cache_min_compile_time_secs"
    least = getattr(_config(), name)
    _config().update(name, float("inf"))
    try:
        yield
    finally:
        _config().update(name, least)


def _keep(compiled: Any, file: Path) -> None:
    """Write a compiled program; a folder that cannot be written costs only the next start."""
    try:
        stored = pickle.dumps(serialize_executable.serialize(compiled)[0])
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as beside:
            beside.write_bytes(stored)
    except (OSError, ValueError, NotImplementedError):
        return


def _file(described: str) -> Path | None:
    """Where a program is kept; None where JAX keeps none."""
    config = _config()
    folder = config.jax_compilation_cache_dir
    if not folder or not config.jax_enable_compilation_cache:
        return None
    if "://" in folder:  # JAX alone knows how to reach it
        return None
    name = hashlib.sha256(f"{described} {surroundings()}".encode()).hexdigest()
    return Path(folder) / "diffdisp" / name


@functools.cache
def surroundings() -> str:
    """All else that decides a program: source, versions, processor and device."""
    source = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        source.update(file.read_bytes())
    device = jax.devices()[0]
    words = (
        source.hexdigest(),
        jax.__version__,
        metadata.version("jaxlib"),
        metadata.version("equinox"),
        np.__version__,
        platform.platform(),
        _processor(),
        device.platform,
        device.device_kind,
        str(os.cpu_count()),
        os.environ.get("XLA_FLAGS", ""),
    )
    return " ".join(words)


def _processor() -> str:
    """What the processor can do, where the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    told = {line for line in lines if line.startswith(("model name", "flags"))}
    return " ".join(sorted(told))
