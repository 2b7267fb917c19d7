"""How long a calibration takes: until the picture of its first fit is there, and until its end.

For each food that ships the command is typed as a user would, one after the other: on its record,
or from published levels where there is none. Processor time is that of the command and its
workers. On cores that do other work the wall time is longer than it would be alone.
"""

import argparse
import dataclasses as dc
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from sliceit_drake.resources import resource_path
from studies.pages import publish, table
from studies.results import describe_machine

__all__ = ["Typed", "add_arguments", "command_for", "run", "typed"]

FOODS = ("cucumber", "tomato", "potato", "apple", "carrot")
FIRST_LIMIT, LIMIT = 60.0, 300.0
"""Aims for the wall time on two cores: to the first picture, and in all, s."""


@dc.dataclass(frozen=True)
class Typed:
    """A command that was run.

    Attributes:
        first: Time until the picture of a first fit was there, s; None without a record.
        wall, processor: Time that it took, s.
        rms: Error of its fit, N; None without a record.
    """

    first: float | None
    wall: float
    processor: float
    rms: float | None


def command_for(food: str) -> list[str]:
    """Arguments of `sliceit` for a food."""
    if (resource_path("calibration/records") / f"{food}.csv").exists():
        return ["calibrate", f"calibration/records/{food}.csv", "--food", food]
    return ["calibrate", "--food", food, "--literature"]


def typed(words: Sequence[str]) -> Typed:
    """Runs `sliceit` with these arguments, its results in a folder of its own.

    Raises:
        subprocess.CalledProcessError: The command failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "sliceit_drake.cli.main", *words, "--output", folder]
        begin, before = time.time(), _children()
        subprocess.run(command, check=True, capture_output=True)
        wall, processor = time.time() - begin, _children() - before
        file, picture = (Path(folder) / name for name in ("calibration.json", "first_fit.png"))
        rms = json.loads(file.read_text(encoding="utf-8"))["rms_N"] if file.exists() else None
        first = picture.stat().st_mtime - begin if picture.exists() else None
        return Typed(first, wall, processor, rms)


def _children() -> float:
    """Processor time of all processes that were run and have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the study's arguments."""
    parser.add_argument("--foods", nargs="+", choices=FOODS, default=FOODS, help="default: all")
    parser.add_argument("--output", type=Path, metavar="PAGE", help="write the page")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    rows, late = [], False
    for food in tqdm(options.foods, desc="commands"):
        found = typed(command_for(food))
        late |= found.wall > LIMIT or (found.first or 0.0) > FIRST_LIMIT
        first = "" if found.first is None else f"{found.first:.0f}"
        rms = "" if found.rms is None else f"{found.rms:.2f}"
        rows.append((food, first, f"{found.wall:.0f}", f"{found.processor:.0f}", rms))
        tqdm.write(", ".join(rows[-1]))
    titles = "food | first picture [s] | in all [s] | processor [s] | RMS error [N]"
    page = HEAD.format(command=options.command, machine=describe_machine())
    publish(f"{page}\n{table(titles, rows)}", options.output)
    return int(late)


HEAD = """\
# How long a calibration takes

For who wants to calibrate a food: how long the command takes for each food that ships, and after
how long it has drawn its first fit.

    sliceit calibrate calibration/records/NAME.csv --food NAME --output DIR

Foods that nobody recorded come from published levels, by `--literature`. The aims are 60 s and
300 s, as wall times on two cores that do nothing else; the processor time hardly depends on other
work.

{machine}.

    {command}
"""
