"""Refuses a place that results cannot be written to, before anything is computed for it."""

import os
import tempfile
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError

__all__ = ["check_folder", "check_output"]


def check_folder(folder: Path, field: str) -> None:
    """Makes a folder, and refuses one that cannot be written to.

    Args:
        folder: It is made if it is not there.
        field: Option that names it.

    Raises:
        ConfigurationError: Naming folder and reason.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder)
        os.close(handle)
        os.unlink(name)
    except OSError as error:
        raise _refusal(folder, error, field, "a folder of yours on a disk with room") from error


def check_output(output: Path, field: str = "--output") -> None:
    """Refuses a file or folder that cannot be written or made; makes nothing.

    Args:
        output: What a command will write, a file or a folder.
        field: Option that names it.

    Raises:
        ConfigurationError: Naming the folder in which it fails, and the reason.
    """
    if output.is_file():
        try:
            output.open("ab").close()
        except OSError as error:
            raise _refusal(output, error, field, "another file") from error
        return
    place = output.absolute()
    while not place.exists():
        place = place.parent
    check_folder(place, field)


def _refusal(place: Path, error: OSError, field: str, instead: str) -> ConfigurationError:
    return ConfigurationError(
        f"cannot be written to ({error.strerror or error})",
        source=str(place),
        field=field,
        fix=f"Give {instead}.",
    )
