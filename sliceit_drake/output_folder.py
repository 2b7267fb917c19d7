"""Where results go: refused before anything is computed for them, and cleared of older ones."""

import errno
import os
import tempfile
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError

__all__ = ["check_folder", "check_output", "remove_results", "results_in", "set_aside", "unused"]

RESULTS = (
    "replay.html",
    "slice.gif",
    "force.png",
    "record.csv",
    "summary.json",
    "scenario.yaml",
    "robot.csv",
    "retreat.csv",
    "slice.csv",
    "slice.yaml",
)
"""What a run writes, a robot's too; in the order in which a person would look at it."""
SERIES = ("run.pvd", "*.xdmf", "food_*.vtu", "knife_*.vtu", "force_*.vtu")
"""What it writes to paraview/."""


def results_in(folder: Path) -> list[str]:
    """Names of the files of a run in a folder; empty where none was saved there."""
    if not (folder / "record.csv").is_file():
        return []
    series = ["paraview"] if (folder / "paraview").is_dir() else []
    return [name for name in RESULTS if (folder / name).is_file()] + series


def remove_results(folder: Path) -> None:
    """Removes what an earlier run wrote to a folder, and nothing else in it."""
    if not results_in(folder):
        return
    for name in RESULTS:
        (folder / name).unlink(missing_ok=True)
    series = folder / "paraview"
    for pattern in SERIES:
        for file in series.glob(pattern):
            file.unlink()
    if series.is_dir() and not any(series.iterdir()):
        series.rmdir()


def set_aside(folder: Path) -> None:
    """Moves what earlier runs wrote to a folder into a new one in it: earlier, earlier_2 and so on.

    What a robot has measured is not removed: no command makes it again.
    """
    names = [name for name in (*RESULTS, "paraview") if (folder / name).exists()]
    if not names:
        return
    earlier = unused(folder / "earlier")
    earlier.mkdir()
    for name in names:
        (folder / name).rename(earlier / name)


def unused(path: Path, *suffixes: str) -> Path:
    """A path that nothing has: this one, or else with _2, _3 and so on at its end.

    Args:
        path: The first to try, without suffix.
        suffixes: Of the files that will be written by that name; none for a folder.
    """
    free, number = path, 1
    while any(free.with_name(free.name + suffix).exists() for suffix in suffixes or ("",)):
        number += 1
        free = path.with_name(f"{path.name}_{number}")
    return free


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


def check_output(output: Path, field: str = "--output", is_folder: bool = False) -> None:
    """Refuses a file or folder that cannot be written or made; makes nothing.

    Args:
        output: What a command will write, a file or a folder.
        field: Option that names it.
        is_folder: Whether it shall be a folder, so that a file is refused.

    Raises:
        ConfigurationError: Naming the folder in which it fails, and the reason.
    """
    if output.is_file() and not is_folder:
        try:
            output.open("ab").close()
        except OSError as error:
            raise _refusal(output, error, field, "another file") from error
        return
    place = output.absolute()
    while not place.exists():
        place = place.parent
    if place.is_file():
        refused = NotADirectoryError(errno.ENOTDIR, "it is a file, and results go to a folder")
        raise _refusal(place, refused, field, f"a folder, such as {place.with_suffix('')}_results")
    check_folder(place, field)


def _refusal(place: Path, error: OSError, field: str, instead: str) -> ConfigurationError:
    return ConfigurationError(
        f"cannot be written to ({error.strerror or error})",
        source=str(place),
        field=field,
        fix=f"Give {instead}.",
    )
