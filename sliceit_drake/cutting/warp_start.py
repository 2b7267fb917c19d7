"""Start of Warp as a program wants it: without its messages, with a place for compiled kernels."""

import atexit
import contextlib
import functools
import os
import shutil
import sys
import tempfile
import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

__all__ = [
    "CACHE",
    "CPU_FLAGS",
    "LAUNCH_LOCK",
    "VERBOSE",
    "load_modules",
    "shared",
    "start_loading",
    "start_warp",
]

LAUNCH_LOCK = threading.RLock()
"""Held while kernels are made, in a capture, which takes in the launches of all threads, and in
launches outside of one."""

VERBOSE = "SLICEIT_VERBOSE"
"""Environment variable that lets Warp say what it does; worker processes have it too."""

CACHE = "WARP_CACHE_PATH"
NO_GPU = b"NVIDIA CUDA driver"
"""Words of the line that Warp's library prints on a machine without one, whatever its log level."""
CPU_FLAGS = (
    "-march=native -ffp-contract=fast"
    " -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
)
"""Warp's own, with products and sums fused and the search for vectors as deep as Clang's own. All
modules have them: LLVM compiles side by side only what has the same flags."""

_LOADING: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)
"""Held while a module is loaded: Warp would compile it twice."""


@functools.cache
def start_warp() -> None:
    """Starts Warp without its banner and its lines about modules; called where it is first used.

    A log level that the user has set stays, and with `VERBOSE` all messages pass. Where Warp cannot
    keep compiled kernels it would end with an error; they are then compiled for this process and
    those that it starts, which is said.
    """
    _find_cache()
    import warp

    if VERBOSE in os.environ:
        warp.init()
        return
    if warp.config.log_level == warp.LOG_INFO:
        warp.config.log_level = warp.LOG_ERROR
    with _without_line(NO_GPU):
        warp.init()


def load_modules(names: Sequence[str], device: Any, block: int | None = None) -> None:
    """Compiles modules of kernels side by side, once a machine, and loads them, once a process.

    Where another thread is at one of them it is waited for.

    Args:
        names: Of the modules; `start_warp` was called.
        device: One of Warp's, or its name.
        block: Threads of a block on a GPU, as they are launched; Warp's own by default.
    """
    for loaded in start_loading(names, device, block):
        loaded.result()


def start_loading(
    names: Sequence[str], device: Any, block: int | None = None
) -> list[Future[None]]:
    """Starts what `load_modules` does, and comes back at once; arguments as there.

    Returns:
        The loads, in the order of `names`; a program that ends meanwhile waits for them.
    """
    threads = ThreadPoolExecutor(2)
    loads = [threads.submit(_load_module, name, device, block) for name in names]
    threads.shutdown(wait=False)
    return loads


def shared(values: Any, dtype: Any = float) -> Any:
    """A Warp array in the memory of a NumPy array, on the CPU; `float` are double."""
    import warp as wp

    dtype = wp.float64 if dtype is float else dtype
    return wp.array(values, dtype=dtype, device="cpu", copy=False)


def _load_module(name: str, device: Any, block: int | None) -> None:
    import warp as wp

    with _LOADING[name]:
        wp.load_module(name, device=device, block_dim=block)


def _find_cache() -> None:
    """Sets Warp's variable, for child processes too, if its own folder cannot be written."""
    if CACHE in os.environ:
        return
    usual = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "warp"
    try:
        usual.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=usual).close()
    except OSError as error:
        folder = tempfile.mkdtemp(prefix="sliceit_kernels_")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ[CACHE] = folder
        print(
            f"Compiled kernels cannot be kept in {usual} ({error.strerror}): this run compiles its "
            f"own. To keep them, set {CACHE} to a folder of yours.",
            file=sys.stderr,
        )


@contextlib.contextmanager
def _without_line(words: bytes) -> Iterator[None]:
    """Drops lines with `words` from what libraries print to the standard error meanwhile."""
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        saved = os.dup(2)
    except OSError:  # There is none.
        yield
        return
    reading, writing = os.pipe()
    # What is more than a pipe holds is lost rather than waited for.
    os.set_blocking(writing, False)
    os.dup2(writing, 2)
    os.close(writing)
    try:
        yield
    finally:
        if sys.stderr is not None:
            sys.stderr.flush()
        os.dup2(saved, 2)
        os.close(saved)
        with open(reading, "rb") as caught:
            for line in caught:
                if words not in line:
                    os.write(2, line)
