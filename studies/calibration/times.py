"""How long a calibration takes: a first fit with a picture, and the full one.

For each food that ships the command is typed as a user would, one after the other: on its record,
or from published levels where there is none. Processor time is that of the command and its
workers. On cores that do other work the wall time is longer than it would be alone.
"""

import argparse
import dataclasses as dc
import json
import resource
import shlex
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

__all__ = ["Typed", "add_arguments", "commands_for", "run", "typed"]

FOODS = ("cucumber", "tomato", "potato", "apple", "carrot")
FIRST = ("--structure", "setup", "--trials", "4", "--steps", "0", "--starts", "1", "--blocks", "0")
"""Options of a first fit: the setup's values, three more places, and the best of them polished."""
LIMITS = {"first fit": 60.0, "full": 300.0}
"""Aims for the wall time on two cores, s."""


@dc.dataclass(frozen=True)
class Typed:
    """A command that was run.

    Attributes:
        wall, processor: Time that it took, s.
        rms: Error of its fit, N; None without a record.
        picture: Whether it left one.
    """

    wall: float
    processor: float
    rms: float | None
    picture: bool


def commands_for(food: str) -> dict[str, list[str]]:
    """Arguments of `sliceit` for a food, by the stage that they are for."""
    if not (resource_path("calibration/records") / f"{food}.csv").exists():
        return {"full": ["calibrate", "--food", food, "--literature"]}
    full = ["calibrate", f"calibration/records/{food}.csv", "--food", food]
    return {"first fit": [*full, *FIRST], "full": full}


def typed(words: Sequence[str]) -> Typed:
    """Runs `sliceit` with these arguments, its results in a folder of its own.

    Raises:
        subprocess.CalledProcessError: The command failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "sliceit_drake.cli.main", *words, "--output", folder]
        begin, before = time.monotonic(), _children()
        subprocess.run(command, check=True, capture_output=True)
        wall, processor = time.monotonic() - begin, _children() - before
        file = Path(folder) / "calibration.json"
        rms = json.loads(file.read_text(encoding="utf-8"))["rms_N"] if file.exists() else None
        return Typed(wall, processor, rms, (Path(folder) / "fit.png").exists())


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
    todo = [(f, stage, w) for f in options.foods for stage, w in commands_for(f).items()]
    rows, late = [], False
    for food, stage, words in tqdm(todo, desc="commands"):
        found = typed(words)
        late |= found.wall > LIMITS[stage]
        rms = "" if found.rms is None else f"{found.rms:.2f}"
        times = (f"{found.wall:.0f}", f"{found.processor:.0f}", f"{LIMITS[stage]:.0f}")
        picture = "yes" if found.picture else "no"
        rows.append((food, stage, *times, rms, picture))
        tqdm.write(", ".join(rows[-1]))
    titles = "food | stage | wall [s] | processor [s] | aim [s] | RMS error [N] | picture"
    machine = describe_machine()
    page = HEAD.format(command=options.command, machine=machine, first=shlex.join(FIRST))
    publish(f"{page}\n{table(titles, rows)}", options.output)
    return int(late)


HEAD = """\
# How long a calibration takes

For who wants to calibrate a food: how long the command takes for each food that ships. The first
fit polishes the best of four places of the setup's ranges, and draws it:

    sliceit calibrate calibration/records/NAME.csv --food NAME --output DIR {first}

The full one is the same without the options from `--structure` on. Foods that nobody recorded come
from published levels, by `--literature`. The aims are wall times on two cores that do nothing else;
the processor time hardly depends on other work.

{machine}.

    {command}
"""
