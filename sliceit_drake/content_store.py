"""Computed arrays, found again by the content of what they were computed from.

A key is the hash of the inputs and of the code: the source of the module that computes, of all
modules of ours that it imports, and the versions of the numerical libraries. So an edit elsewhere
leaves what was computed where it is.
"""

import ast
import functools
import hashlib
import importlib.metadata
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

__all__ = ["ContentStore", "content_key", "source_files", "source_key"]

PACKAGE = Path(__file__).parent

LIBRARIES = ("numpy", "scipy", "warp-lang")
"""Whose versions stand for their code."""


class ContentStore:
    """Named arrays by key, in a folder and, the last of them, in memory.

    Several processes may share a folder.

    Args:
        folder: Of the files; None for memory alone.
        kept: How many memory keeps.
    """

    def __init__(self, folder: Path | None = None, kept: int = 0) -> None:
        self._folder, self._kept = folder, kept
        self._memory: dict[str, dict[str, np.ndarray]] = {}
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def load(self, key: str) -> dict[str, np.ndarray] | None:
        """The arrays of a key; None where nothing is kept under it."""
        if key in self._memory:
            return self._memory[key]
        if self._folder is None or not (self._folder / f"{key}.npz").exists():
            return None
        with np.load(self._folder / f"{key}.npz") as file:
            return self._remember(key, dict(file))

    def save(self, key: str, arrays: Mapping[str, np.ndarray], in_folder: bool = True) -> None:
        """Keeps arrays, if not wanted in the folder then in memory alone."""
        self._remember(key, dict(arrays))
        if self._folder is None or not in_folder:
            return
        # A file that is half written must not be found by another process.
        part = self._folder / f"{key}.{os.getpid()}.part"
        with open(part, "wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
        os.replace(part, self._folder / f"{key}.npz")

    def _remember(self, key: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        self._memory[key] = arrays
        while len(self._memory) > self._kept:
            self._memory.pop(next(iter(self._memory)))
        return arrays


def content_key(*parts: object) -> str:
    """Hash of arrays by their bytes and of all else by its `repr`, 40 hexadecimal digits."""
    h = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            h.update(repr((part.shape, part.dtype.str)).encode())
            h.update(np.ascontiguousarray(part).tobytes())
        else:
            h.update(repr(part).encode())
    return h.hexdigest()[:40]


def source_key(*files: str | Path, package: Path = PACKAGE) -> str:
    """Hash of `source_files` and of the versions of the libraries, as `source_key(__file__)`."""
    sources = [file.read_bytes() for file in source_files(*files, package=package)]
    return content_key(*sources, *map(importlib.metadata.version, LIBRARIES))


def source_files(*files: str | Path, package: Path = PACKAGE) -> list[Path]:
    """Files of modules and of all modules of ours that they import, directly or not.

    What a package's `__init__.py` holds does not count.

    Args:
        files: Of the modules.
        package: Folder of our package.
    """
    found: set[Path] = set()
    waiting = [Path(file) for file in files]
    while waiting:
        file = waiting.pop()
        if file not in found and file.is_file():
            found.add(file)
            parts = [name.split(".") for name in _imported(file.read_bytes())]
            own = [rest for top, *rest in parts if top == package.name and rest]
            waiting += [package.joinpath(*rest).with_suffix(".py") for rest in own]
    return sorted(found)


@functools.lru_cache(1000)
def _imported(source: bytes) -> tuple[str, ...]:
    """Full names of all that a module imports, of modules and of what is in them."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return tuple(names)
