"""How a run of `sliceit hardware` keeps up with the controller's clock: emulator and client, paced.

  python -m studies hardware_pace scenarios/cucumber_measured.yaml --pace 0.5 0.2 --repeats 5

For each pace and repeat it starts `sliceit emulate` and `sliceit hardware`, each in a process of
its own, which talk over loopback TCP through ur_rtde, and reads what the run wrote. `sliceit
simulate` gives the force to compare with. Close all else before: the clock does not wait, so other
work on the machine stops runs. The default scenario computes little (a spring for the food); with
finite elements the emulator itself may not keep a pace, and `emulator late` says so.

The table has a row for each pace:
  completed       runs that came to the motion's end, of those that were started
  cycles, missed  controller cycles from the first target to the last, of all runs; those unseen
  late, 99 %, max wall time between two states less the period at that pace: median, 99 %, greatest
  emulator late   cycles that the emulator began more than half a period late while the client ran
  force           RMS difference of the sensor's force from `sliceit simulate`, mean and greatest of
                  the completed runs, and as a fraction of the simulated RMS
  stops           why runs ended early, as the operator reads it, each reason with its count
"""

import argparse
import collections
import dataclasses as dc
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.emulator.process import EmulatorError, EmulatorProcess
from studies.marked_page import Place
from studies.results import describe_machine

__all__ = ["PLACE", "PacedRun", "add_arguments", "run"]

PERIOD = 0.002
PLACE = Place("hardware_pace")
SCENARIO = "scenarios/cucumber_spring.yaml"
ROBOT = "hardware/emulated.yaml"


@dc.dataclass
class PacedRun:
    """What came of one run.

    Attributes:
        stop: Why it ended early; empty if it did not.
        cycles: Cycles of the controller between the first and the last target.
        missed: Those of which no state was seen.
        lateness: Of the states seen meanwhile [n], s.
        emulator_late: Cycles that the emulator began late.
        force_error: RMS difference from the simulation, N; NaN if it did not end by itself.
        force_share: The same over the RMS of the simulation.
    """

    stop: str
    cycles: int = 0
    missed: int = 0
    lateness: np.ndarray = dc.field(default_factory=lambda: np.empty(0))
    emulator_late: int = 0
    force_error: float = np.nan
    force_share: float = np.nan


def sliceit(
    *arguments: str, typed: str = "", timeout: float = 600.0
) -> subprocess.CompletedProcess:
    """Runs the command line in a process of its own; `typed` is what its operator types."""
    command = [sys.executable, "-m", "sliceit_drake.cli.main", *arguments]
    return subprocess.run(command, input=typed, capture_output=True, text=True)


def sensor_force(record: np.ndarray) -> np.ndarray:
    """Force of a record.csv [n, 3], N."""
    return np.column_stack([record[f"sensor_wrench_f_{axis}"] for axis in "xyz"])


def force_error(real: np.ndarray, simulated: np.ndarray) -> tuple[float, float]:
    """RMS difference of two records' sensor forces, N, and over the RMS of the second."""
    times = real["time"], simulated["time"]
    wanted = np.column_stack([np.interp(*times, f) for f in sensor_force(simulated).T])
    difference = sensor_force(real) - wanted
    rms = float(np.sqrt((difference**2).sum(1).mean()))
    return rms, rms / float(np.sqrt((wanted**2).sum(1).mean()))


def timing(log: np.ndarray) -> tuple[int, int, np.ndarray]:
    """Cycles, missed cycles and lateness [n], s, of a robot.csv while targets were sent."""
    sent = np.flatnonzero(np.isfinite(log["sent_1"]))
    if len(sent) < 2:
        return 0, 0, np.empty(0)
    moving = log[sent[0] : sent[-1] + 1]
    passed = np.round(np.diff(moving["time"]) / PERIOD).astype(int)
    return int(passed.sum()) + 1, int((passed - 1).sum()), moving["lateness"]


def stop_of(printed: str) -> str:
    """Why a run ended early, in the words printed, without what differs from run to run."""
    said = re.search(r"STOPPED: (.*)", printed) or re.search(r"(Not ready: .*)", printed)
    text = said[1] if said else (printed.strip().splitlines() or ["it said nothing"])[-1]
    return re.sub(r" at controller time [\d.]+ s|: .*", "", text)


def paced_run(
    options: argparse.Namespace,
    scenario: Sequence[str],
    pace: float,
    simulated: np.ndarray,
    directory: Path,
) -> PacedRun:
    """One run of a scenario, as arguments, against an emulator of its own."""
    with EmulatorProcess(
        scenario[0], options.address, pace, options=scenario[1:], timeout=120.0
    ) as emulator:
        before = emulator.pendant.status()["late_cycles"]
        arguments = [*scenario, "--host", options.address, "--pace", str(pace), "--robot", ROBOT]
        arguments += ["--set-robot", options.set_robot] if options.set_robot else []
        arguments += ["--no-replay", "--output", str(directory)]
        done = sliceit("hardware", *arguments, typed="slice\n")
        late = emulator.pendant.status()["late_cycles"] - before
    if not (directory / "robot.csv").exists():
        return PacedRun(stop_of(done.stdout + done.stderr), emulator_late=late)
    summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    cycles, missed, lateness = timing(read(directory / "robot.csv"))
    run = PacedRun("", cycles, missed, lateness, late)
    if summary["stopped"]:
        run.stop = stop_of(done.stdout)
    else:
        run.force_error, run.force_share = force_error(read(directory / "record.csv"), simulated)
    return run


def read(file: Path) -> np.ndarray:
    """A CSV with names; empty cells are NaN."""
    return np.genfromtxt(file, delimiter=",", names=True)


def row(pace: float, runs: Sequence[PacedRun]) -> list[str]:
    """A row of the table."""
    cycles, missed = sum(run.cycles for run in runs), sum(run.missed for run in runs)
    lateness = np.concatenate([run.lateness for run in runs])
    late = ["-"] * 3
    if len(lateness):
        late = [f"{1e3 * x:.2f} ms" for x in (*np.percentile(lateness, (50, 99)), lateness.max())]
    done = [run for run in runs if not run.stop]
    force = "-"
    if done:
        errors, share = [run.force_error for run in done], max(run.force_share for run in done)
        force = f"{np.mean(errors):.3f} N, at most {max(errors):.3f} ({100 * share:.2f} %)"
    stops = collections.Counter(run.stop for run in runs if run.stop)
    return [
        f"{pace:g}",
        f"{len(done)} of {len(runs)}",
        str(cycles),
        f"{missed} ({100 * missed / cycles:.2f} %)" if cycles else "-",
        *late,
        str(sum(run.emulator_late for run in runs)),
        force,
        "; ".join(f"{count} {reason}" for reason, count in stops.items()) or "-",
    ]


def measure(options: argparse.Namespace) -> list[list[str]]:
    """Rows of the table.

    Raises:
        ConfigurationError, EmulatorError: The scenario cannot be simulated or emulated.
    """
    scenario = [options.scenario, *(["--set", options.set] if options.set else [])]
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder)
        done = sliceit("simulate", *scenario, "--no-replay", "--output", str(directory))
        if done.returncode:
            raise ConfigurationError(done.stderr.strip(), field=options.scenario)
        simulated = read(directory / "record.csv")
        # In turns, so that what else the machine does falls on all paces alike.
        turns = [(turn, pace) for turn in range(options.repeats) for pace in options.pace]
        runs: dict[float, list[PacedRun]] = {pace: [] for pace in options.pace}
        for turn, pace in tqdm(turns, desc="runs"):
            output = directory / f"{pace:g}_{turn}"
            runs[pace].append(paced_run(options, scenario, pace, simulated, output))
    return [row(pace, made) for pace, made in runs.items()]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "scenario", nargs="?", default=SCENARIO, help=f"as of sliceit simulate, default {SCENARIO}"
    )
    parser.add_argument("--set", metavar="YAML", help="fields that replace those of the scenario")
    parser.add_argument("--set-robot", metavar="YAML", help=f"likewise of {ROBOT}, as its limits")
    parser.add_argument(
        "--pace", type=float, nargs="+", default=[1.0, 0.5, 0.2], help="default 1 0.5 0.2"
    )
    parser.add_argument("--repeats", type=int, default=5, help="runs at each pace (default 5)")
    parser.add_argument(
        "--address", default="127.0.0.77", help="of the emulator (default 127.0.0.77)"
    )
    PLACE.add_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    if options.repeats < 1:
        raise ConfigurationError("is below 1", field="--repeats", fix="Give 1 or more.")
    PLACE.check(options.output)
    machine = describe_machine()
    try:
        rows = measure(options)
    except EmulatorError as error:
        raise ConfigurationError(str(error), field=options.scenario) from error
    PLACE.publish(options.output, rows=rows, command=options.command, machine=machine)
    return 0
