"""Finds the files that ship beside the code: models, calibrations, robot configurations, scenarios.

In a checkout (or an editable install) they stand at the top of the repository; in a wheel they
stand inside the package, under ``_resources``. Everything else asks here and does not care.
"""

import importlib.util
import inspect
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from sliceit_drake.configuration import ConfigurationError, did_you_mean

if TYPE_CHECKING:
    from pydrake.multibody.parsing import Parser

__all__ = [
    "add_package_map",
    "file_or_resource",
    "here_or_shipped",
    "known_yaml",
    "load_subclasses",
    "named_yaml",
    "resource_path",
    "shipped_names",
]

_Base = TypeVar("_Base")

_MODEL_PACKAGE = "sliceit_drake_models"
FOLDERS = ("calibration", "hardware", "models", "scenarios")

_PACKAGE = Path(__file__).resolve().parent


def resource_path(relative: str) -> Path:
    """Returns the absolute path of a file or folder that ships with the project.

    Args:
        relative: Path that begins with one of ``models``, ``calibration``, ``hardware`` or
            ``scenarios``, with forward slashes, such as ``"scenarios/cucumber.yaml"``.

    Raises:
        ValueError: If `relative` does not begin with one of these folders or leaves it.
        FileNotFoundError: If there is no such file or folder.
    """
    parts = Path(relative).parts
    if not parts or parts[0] not in FOLDERS or ".." in parts:
        raise ValueError(
            f'resource_path("{relative}"): give a path that begins with one of '
            f"{', '.join(FOLDERS)} and does not go up, such as "
            '"models/ur5e/ur5e.urdf".'
        )
    root = _resource_root()
    path = root / relative
    if not path.exists():
        raise FileNotFoundError(
            f'resource_path("{relative}"): there is no {path}. Check the spelling; if it is right, '
            "the installation is incomplete: reinstall sliceit_drake."
        )
    return path


def here_or_shipped(path: str | Path) -> Path:
    """A file or folder from the working directory, or else from the resources.

    Args:
        path: As a user writes it; it is returned where there is none at either.
    """
    path = Path(os.path.expanduser(path))
    if path.exists():
        return path
    try:
        return resource_path(path.as_posix())
    except (FileNotFoundError, ValueError):
        return path


def file_or_resource(path: str) -> Path | None:
    """As `here_or_shipped`, of files alone; None where there is none."""
    file = here_or_shipped(path)
    return file if file.is_file() else None


def named_yaml(name: str | Path, folder: str) -> Path | None:
    """The YAML file that a user means by a file name, or by the name of one that ships.

    Args:
        name: A file that ends in .yaml or .yml, or a name.
        folder: Where the files that ship lie, as for `resource_path`.

    Returns:
        The file, or None where no file of that name ships.
    """
    file = Path(name)
    if file.suffix in (".yaml", ".yml"):
        return here_or_shipped(file)
    file = resource_path(folder) / f"{name}.yaml"
    return file if file.is_file() and file.parent == resource_path(folder) else None


def known_yaml(name: str | Path, folder: str, unknown: str, field: str, otherwise: str) -> Path:
    """As `named_yaml`, for a name that is given.

    Args:
        name, folder: See there.
        unknown: What is wrong with a name that does not ship, up to the names that do.
        field: Path of what names it.
        otherwise: What to do where no name is alike.

    Raises:
        ConfigurationError: No file of that name ships.
    """
    file = named_yaml(name, folder)
    if file is None:
        names = shipped_names(folder)
        raise ConfigurationError(
            f"{unknown} {', '.join(names)}",
            field=field,
            fix=did_you_mean(str(name), names, otherwise),
        )
    return file


def shipped_names(folder: str) -> list[str]:
    """Names of the YAML files that ship in a folder, as `named_yaml` takes them."""
    return sorted(path.stem for path in resource_path(folder).glob("*.yaml"))


def add_package_map(parser: "Parser") -> None:
    """Lets `parser` resolve ``package://sliceit_drake_models/...`` to our models.

    Args:
        parser: A Drake parser; its package map gains our package unless it has it already.
    """
    package_map = parser.package_map()
    if not package_map.Contains(_MODEL_PACKAGE):
        package_map.Add(_MODEL_PACKAGE, str(resource_path("models")))


def _resource_root() -> Path:
    # A wheel is tried first: beside its package lie other packages, whose folder "models" is not
    # ours.
    for root in (_PACKAGE / "_resources", _PACKAGE.parent):
        if (root / "models" / "package.xml").is_file():
            return root
    raise FileNotFoundError(
        f"The models of sliceit_drake are neither in {_PACKAGE / '_resources'} (wheel) nor in "
        f"{_PACKAGE.parent} (checkout). Install the wheel, or run "
        '"pip install -e ." in a complete checkout.'
    )


def load_subclasses(name: str, file: Path, base: type[_Base]) -> list[type[_Base]] | None:
    """Runs a user's Python file as a module of a name; None where there is no such file.

    What its code raises is not caught.

    Returns:
        The subclasses of `base` that the file defines.
    """
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None or not file.is_file():
        return None
    module = importlib.util.module_from_spec(spec)
    # Where the source of a class is looked up.
    sys.modules[name] = module
    # Not by the loader: its bytecode is stale where a file was written twice in a second.
    exec(compile(file.read_bytes(), str(file), "exec"), module.__dict__)
    kinds = (kind for _, kind in inspect.getmembers(module, inspect.isclass))
    return [kind for kind in kinds if issubclass(kind, base) and kind.__module__ == name]
