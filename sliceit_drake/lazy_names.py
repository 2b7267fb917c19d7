"""Names of a package that are loaded when they are first used, so that importing it stays light."""

import functools
import importlib
import sys
from collections.abc import Callable
from typing import Any

__all__ = ["lazy_names"]


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package: its names are those that type checkers see.

    Below `if TYPE_CHECKING:` it has `from MODULE import NAME as NAME`, `from PACKAGE import MODULE
    as MODULE` for its own modules, and `NAME = PATH.OF.MODULE` for others.
    """

    def load(name: str) -> Any:
        homes = _homes(package)
        if name == "__all__":
            return sorted(homes)
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home, attribute = homes[name]
        module = importlib.import_module(home)
        return getattr(module, attribute) if attribute else module

    return load, lambda: sorted(_homes(package))


@functools.cache
def _homes(package: str) -> dict[str, tuple[str, str]]:
    """Module and attribute of each name of a package; no attribute where it is the module."""
    import ast
    from pathlib import Path

    source = Path(str(sys.modules[package].__file__)).read_text(encoding="utf-8")
    homes: dict[str, tuple[str, str]] = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module == package:
            homes |= {alias.name: (f"{package}.{alias.name}", "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            homes |= {a.name: (str(node.module), a.name) for a in node.names if a.asname}
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Attribute):
            homes[ast.unparse(node.targets[0])] = (ast.unparse(node.value), "")
    return homes
