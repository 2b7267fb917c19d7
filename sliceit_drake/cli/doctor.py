"""Check this machine: what `sliceit` needs, what it finds, and the command that installs the rest.

Looks at Python, the packages, the folder of compiled kernels, the folder for results, drawing
without a display, the GPU as Warp sees it, and the optional packages. Ends with status 0 if
`sliceit simulate` can run.
"""

import argparse
import importlib.metadata
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.output_folder import check_output

__all__ = ["add_arguments", "run"]

PACKAGE = "sliceit_drake"
SHOWN = (PACKAGE, "drake", "warp-lang", "numpy")
EXTRAS = {
    "learn": "train policies",
    "hardware": "run a UR5e, or its emulator",
    "notebooks": "open the notebooks",
    "docs": "build the documentation",
    "cluster": "use a Dask cluster",
    "database": "share a calibration's trials in a database",
    "ros": "read ROS bags",
}
"""Extras of the package, and what each is for."""
WIDTH = 13


class _Finding(NamedTuple):
    """What was looked at.

    Attributes:
        name: What it is.
        found: What was found.
        fix: What to type or do, where something is missing; else "".
        is_needed: Whether `sliceit simulate` cannot run without it.
    """

    name: str
    found: str
    fix: str = ""
    is_needed: bool = False


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments: there are none."""


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    can_run = True
    for finding in _findings():
        mark = "ok" if not finding.fix else "MISSING" if finding.is_needed else "none"
        print(f"{mark:8}{finding.name:{WIDTH}}{finding.found}", flush=True)
        if finding.fix:
            print(f"{'':{8 + WIDTH}}{finding.fix}")
        can_run = can_run and not (finding.fix and finding.is_needed)
    if can_run:
        print("\n`sliceit simulate` can run here.")
        return 0
    print("\n`sliceit simulate` cannot run here: see MISSING above.")
    return 1


def _findings() -> Iterator[_Finding]:
    """Checks in turn, the quick ones first."""
    yield _python()
    lacking = _lacking("")
    versions = [f"{name} {importlib.metadata.version(name)}" for name in SHOWN]
    yield _Finding(
        "packages",
        f"lacking: {', '.join(lacking)}" if lacking else ", ".join(versions),
        f"pip install --upgrade {PACKAGE}" if lacking else "",
        True,
    )
    yield _folder("results", Path("output"), "Change to a folder of yours.", is_needed=True)
    if lacking:
        return
    yield _kernels()
    yield _drawing()
    yield _gpu()
    for extra, purpose in EXTRAS.items():
        lacking = _lacking(extra)
        yield _Finding(
            extra,
            f"to {purpose}; lacking: {', '.join(lacking)}" if lacking else f"to {purpose}",
            f"pip install -e '.[{extra}]'" if lacking else "",
        )


def _python() -> _Finding:
    wanted = importlib.metadata.metadata(PACKAGE)["Requires-Python"]
    least = tuple(int(part) for part in re.findall(r"\d+", wanted)[:2])
    found = ".".join(map(str, sys.version_info[:3]))
    fix = "" if sys.version_info[:2] >= least else f"Install Python {wanted} and the package in it."
    return _Finding("Python", f"{found} (needs {wanted})", fix, True)


def _lacking(extra: str) -> list[str]:
    """What an extra asks for, and of "" the package itself, that is missing or too old."""
    lacking = []
    for line in importlib.metadata.requires(PACKAGE) or ():
        wanted = Requirement(line)
        is_of_extra = wanted.marker is not None and wanted.marker.evaluate({"extra": extra})
        if not (is_of_extra if extra else wanted.marker is None):
            continue
        try:
            found = importlib.metadata.version(wanted.name)
        except importlib.metadata.PackageNotFoundError:
            lacking.append(wanted.name)
            continue
        if not wanted.specifier.contains(found, prereleases=True):
            lacking.append(f"{wanted.name}{wanted.specifier} (found {found})")
    return lacking


def _folder(name: str, folder: Path, fix: str, *, is_needed: bool) -> _Finding:
    """Whether a folder can be written to, or made."""
    try:
        check_output(folder, is_folder=True)
    except ConfigurationError as error:
        return _Finding(name, f"{error.source} {error.problem}", fix, is_needed)
    return _Finding(name, f"{folder.absolute()} can be written to")


def _kernels() -> _Finding:
    from sliceit_drake.cutting.warp_start import CACHE, start_warp

    start_warp()
    import warp

    return _folder(
        "kernels",
        Path(str(warp.config.kernel_cache_dir)),
        f"Set {CACHE} to a folder of yours: export {CACHE}=~/kernels",
        is_needed=False,
    )


def _drawing() -> _Finding:
    from sliceit_drake.diagrams.outputs.animation import NEEDED, can_draw

    if can_draw():
        return _Finding("drawing", "without a display works: slice.gif can be drawn")
    packages = " ".join(re.findall(r"lib[\w-]+", NEEDED))
    return _Finding(
        "drawing", f"no slice.gif: {NEEDED}", f"apt install {packages} (as root), or --no-animation"
    )


def _gpu() -> _Finding:
    import warp

    devices = [f"{device.name} ({device})" for device in warp.get_cuda_devices()]
    if devices:
        return _Finding("GPU", ", ".join(devices))
    driver = os.path.exists("/proc/driver/nvidia/version")
    found = "its driver is too old for Warp" if driver else "none, which nothing needs"
    return _Finding("GPU", found, "Update the NVIDIA driver to use it." if driver else "")
