"""What stops the emulated robot when something fails: one row for each fault and its time.

  python -m studies faults --output docs/results

Each row is a slice of a spring-backed food by `sliceit emulate` and `sliceit hardware`, each in a
process of its own, in lockstep and with every limit at its default, with one fault in the middle.
It is compared with the same slice without a fault, by the true joints and the true force that the
emulator keeps:
  after   controller time from the fault to the arm's rest
  way     how far the farther end of the edge moved meanwhile
  beyond  farthest that an end of the edge came off the path of the slice without the fault, and the
          true force over the greatest up to then in the slice without it
A fault is held if that is less than 1 mm and 5 N. With --free N it also makes slices without a
fault, of other foods and sensors and beside other work, and counts those that stop.

DIR/robot_faults.jsonl keeps every result. Called again the study goes on where it ended; take lines
out of the file to measure them again.
"""

import argparse
import dataclasses as dc
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.diagrams.hardware_station import make_edge_kinematics
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.emulator.process import EmulatorProcess, PendantClient
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics
from sliceit_drake.resources import resource_path
from studies.pages import publish, render
from studies.robot.fault_list import Case, cases

__all__ = ["add_arguments", "await_rest", "measure", "page", "run"]

SCENARIO = "scenarios/cucumber_spring.yaml"
MOTION = """motion: {segments: [
  !ConstantSpeed {distance: 0.03, speed: 0.04, acceleration: 0.5, label: slice},
  !Hold {duration: 0.1, label: hold},
  !Retract {distance: 0.03, speed: 0.08, acceleration: 0.5, label: retract}]}, measurement: null"""
PACE, CLIENT_PACE = 0.1, 0.04
"""Of the emulator, and what the client takes it for: a busy machine makes no data come late."""
ATTEMPTS = 4
"""How often a slice is made that had stopped before its fault came."""
BEYOND, FORCE_BEYOND = 1e-3, 5.0
"""What a fault may add to the edge's way, m, and to the true force, N."""
FIGURE = "robot_faults.png"
REST = 1e-3
"""A joint slower than this is at rest, rad/s."""
CYCLE = 0.002
MARK = "remote_control_on"
"""A fault that is none, at the first target: it says when that was."""
SERVO = "11"
PATIENCE = 60.0
"""Wall time for which a client or an arm is waited for, s."""


@dc.dataclass
class Slice:
    """A slice on the emulator.

    Attributes:
        said: What the program printed.
        code: Its exit status.
        log: The controller's log: time and words.
        trace: Controller time since the first target, joints [6], force [3], of each cycle.
        at: When the fault came, on the same clock; NaN for none.
    """

    said: str
    code: int
    log: list[tuple[float, str]]
    trace: np.ndarray
    at: float


def slice_with(case: Case, address: str, overrides: str, set_robot: str = "") -> Slice:
    """Slices with a fault."""
    options = ["--set", f"{{{overrides}}}"]
    with (
        tempfile.TemporaryDirectory() as folder,
        EmulatorProcess(
            SCENARIO, address, PACE, lockstep=True, options=options, timeout=300.0
        ) as emulator,
    ):
        pendant = emulator.pendant
        for fault, at in ((MARK, 0.0), *((fault, case.at) for fault in case.faults)):
            pendant.inject(fault, after=at)
        command = [sys.executable, "-m", "sliceit_drake.cli.main", "hardware", SCENARIO, *options]
        command += [
            "--host",
            address,
            "--pace",
            str(CLIENT_PACE),
            "--robot",
            "hardware/emulated.yaml",
        ]
        command += ["--set-robot", f"{{{set_robot}}}"] if set_robot else []
        command += ["--no-replay", "--output", f"{folder}/out"]
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        try:
            assert process.stdin is not None
            process.stdin.write(b"slice\n")
            process.stdin.flush()
            at = _send_signal(process, case, pendant) if case.signal else np.nan
            said = _output(process, case)
        finally:
            process.kill()
            process.wait()
        status = await_rest(pendant)
        log = [(float(when), str(text)) for when, text in status["log"]]
        begin = next((when for when, text in log if text == f"injected: {MARK}"), np.nan)
        trace = np.array(pendant.trace(begin if np.isfinite(begin) else 0.0))
    if case.faults:
        done = [when for when, text in log if text == f"injected: {case.faults[0]}"]
        at = done[0] if done else np.nan
    trace[:, 0] -= begin
    return Slice(said, process.returncode, log, trace, at - begin)


def _send_signal(process: subprocess.Popen, case: Case, pendant: PendantClient) -> float:
    """Sends the case's signal at its time; the controller's time of that, s."""
    wanted, end = round(case.at / CYCLE), time.monotonic() + PATIENCE
    while True:
        status = pendant.status()
        if status["rtde"]["commands"].get(SERVO, 0) >= wanted:
            process.send_signal(getattr(signal, case.signal))
            return status["time"]
        if process.poll() is not None or time.monotonic() > end:
            return np.nan
        time.sleep(0.002)


def _output(process: subprocess.Popen, case: Case) -> str:
    """What the program, and who watches over it, say to their end."""
    patience = 10.0 if case.signal == "SIGSTOP" else 2.0 * PATIENCE
    try:
        printed = process.communicate(timeout=patience)[0]
    except subprocess.TimeoutExpired:
        process.kill()
        printed = process.communicate()[0]
    return printed.decode("utf-8", "replace")


def await_rest(pendant: PendantClient) -> dict:
    """Status of the controller when its arm is at rest, or after `PATIENCE`."""
    end = time.monotonic() + PATIENCE
    while True:
        status = pendant.status()
        still = np.abs(status["velocities"]).max() < REST and status["runtime_state"] != "PLAYING"
        if still or time.monotonic() > end:
            return status
        time.sleep(0.05)


def _edges(trace: np.ndarray, kinematics: EdgeKinematics) -> np.ndarray:
    """Both ends of the edge at each row [n, 2, 3], m."""
    return np.array([kinematics.edge(row[1:7].tolist())[:2] for row in trace])


def compare(made: Slice, base: Slice, kinematics: EdgeKinematics) -> dict[str, float]:
    """How a slice with a fault differs from the one without: after, way, beyond, force."""
    after = made.trace[:, 0] >= made.at - 0.5 * CYCLE
    ends, wanted = _edges(made.trace[after], kinematics), _edges(base.trace, kinematics)
    time_, q = made.trace[after, 0], made.trace[after, 1:7]
    moving = np.flatnonzero(np.abs(np.diff(q, axis=0)).max(axis=1) > REST * CYCLE)
    rest = moving[-1] + 1 if len(moving) else 0
    # In chunks: all pairs of rows would take much memory.
    off = [np.linalg.norm(wanted - pair, axis=2).max(axis=1).min() for pair in ends[: rest + 1]]
    force = np.linalg.norm(made.trace[after, 7:], axis=1)
    greatest = np.maximum.accumulate(np.linalg.norm(base.trace[:, 7:], axis=1))
    allowed = np.interp(time_, base.trace[:, 0], greatest)
    way = np.linalg.norm(np.diff(ends[: rest + 1], axis=0), axis=2).sum(axis=0)
    return {
        "after": float(time_[rest] - made.at),
        "way": float(way.max(initial=0.0)),
        "beyond": float(max(off)),
        "force": float(max(0.0, (force - allowed).max())),
    }


def _moves_at_fault(made: Slice) -> bool:
    """Whether the arm moved when the fault came: a busy machine can stop it before."""
    near = np.abs(made.trace[:, 0] - made.at) < 2.5 * CYCLE
    q = made.trace[near, 1:7]
    return len(q) > 1 and bool(np.abs(np.diff(q, axis=0)).max() > REST * CYCLE)


def stopped_by(made: Slice) -> str:
    """What stopped the robot, as the operator or the controller has it; empty if nothing did."""
    words = re.search(r"STOPPED: (\w+)", made.said)
    if words:
        return words[1]
    # A slice that is done ends its program too; late packages leave that to the watchdog.
    for _, text in made.log if made.code != 0 else ():
        for sign, name in (
            ("RTDE watchdog: no", "the controller's watchdog"),
            ("by the dashboard", "the supervisor"),
        ):
            if sign in text:
                return name
    return "" if made.code == 0 else "nothing that it said"


def said_by(made: Slice) -> str:
    """The line that an operator reads."""
    for line in reversed(made.said.splitlines()):
        if re.match(r"STOPPED|THE |Stopped", line):
            return re.sub(r" at controller time [\d.]+ s", "", line)
    return ""


def measure(case: Case, base: Slice, kinematics: EdgeKinematics, address: str) -> dict:
    """The result of a fault."""
    made, attempts = slice_with(case, address, MOTION), 1
    while not _moves_at_fault(made) and attempts < ATTEMPTS:
        made, attempts = slice_with(case, address, MOTION), attempts + 1
    result: dict = {
        "key": case.key,
        "fault": case.name,
        "where": case.key.rpartition(", ")[2],
        "injected": _moves_at_fault(made),
        "attempts": attempts,
        "by": stopped_by(made),
        "said": said_by(made),
    }
    if result["injected"]:
        result |= compare(made, base, kinematics)
    return result


def is_held(row: dict) -> bool:
    """Whether a fault added less than what is allowed."""
    return row["injected"] and row["beyond"] < BEYOND and row["force"] < FORCE_BEYOND


NOISE = "sensor: {force_noise: 0.3, moment_noise: 0.02}"
FOODS = {"spring": ""} | {
    name: f"food: !Food {{name: {name}, shape: !Cylinder {{diameter: 0.027, rings: 3}}}}, "
    f"calibration: {name}"
    for name in ("apple", "carrot", "cucumber", "potato", "tomato")
}
"""The spring, and a stick of each calibrated food."""


def free_runs(count: int) -> Iterator[tuple[str, str, bool]]:
    """Name, overrides and whether other work goes on, of slices without a fault."""
    kinds = itertools.product(FOODS.items(), ("", NOISE), (False, True))
    for k, kind in zip(range(count), itertools.cycle(kinds), strict=False):
        (food, fields), noise, is_busy = kind
        words = [food, "noise" if noise else "", "beside other work" if is_busy else ""]
        # Another height of the start each time: no two slices are the same.
        parts = [MOTION, fields, noise, f"start: {{clearance: {0.01 + 2e-5 * k:.6g}}}"]
        name = f"none, {k}: {', '.join(word for word in words if word)}"
        yield name, ", ".join(part for part in parts if part), is_busy


@contextmanager
def busy(is_busy: bool) -> Iterator[None]:
    """Another process that never waits, on each core."""
    code = "while True: pass"
    count = (os.cpu_count() or 1) if is_busy else 0
    others = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--output", metavar="DIR", type=Path, required=True, help="of results, page and figure"
    )
    parser.add_argument("--first", type=int, metavar="N", help="make N results at most, then end")
    parser.add_argument(
        "--free", type=int, default=0, metavar="N", help="slices without a fault (default 0)"
    )
    parser.add_argument("--address", default="127.0.0.78", help="of the emulator")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    options.output.mkdir(parents=True, exist_ok=True)
    file = options.output / "robot_faults.jsonl"
    done = {row["key"]: row for row in read(file)}
    left = [case for case in cases() if case.key not in done]
    free = [run for run in free_runs(options.free) if run[0] not in done]
    left, free = left[: options.first], free[: max(0, (options.first or 10**9) - len(left))]

    def keep(row: dict) -> None:
        done[row["key"]] = row
        with file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")

    if left:
        scenario = load_scenario(resource_path(SCENARIO), f"{{{MOTION}}}")
        kinematics = make_edge_kinematics(MakeStation(scenario))
        base = slice_with(Case("none"), options.address, MOTION)
        if base.code != 0:
            raise RuntimeError(f"the slice without a fault did not end by itself: {base.said}")
        for case in tqdm(left, desc="faults"):
            keep(measure(case, base, kinematics, options.address))
    for name, overrides, is_busy in tqdm(free, desc="slices without a fault"):
        with busy(is_busy):
            made = slice_with(Case(name), options.address, overrides)
        by = stopped_by(made)
        keep({"key": name, "free": True, "by": by, "said": said_by(made)})
    rows = list(done.values())
    draw(rows, options.output / "figures" / FIGURE)
    publish(page(rows), options.output / "robot_faults.md")
    return 0 if all(is_held(row) for row in rows if "free" not in row) else 1


def read(file: Path) -> list[dict]:
    """Stored results."""
    if not file.exists():
        return []
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]


def page(rows: list[dict]) -> str:
    """The page of stored results."""
    made = [row for row in rows if "free" not in row]
    order = {case.key: k for k, case in enumerate(cases())}
    reasons = {case.key: case.unseen for case in cases()}
    made.sort(key=lambda row: order.get(row["key"], len(order)))
    held = [row for row in made if is_held(row)]
    stopped = [row for row in made if row["by"]]
    free = [row for row in rows if "free" in row]
    return render(
        "robot_faults",
        figure=FIGURE,
        planned=len(order),
        stopped=[_cells(row) for row in stopped],
        going=[
            [row["fault"], row["where"], *_excess(row), reasons[row["key"]] or "**not explained**"]
            for row in made
            if not row["by"]
        ],
        count=len(made),
        held=len(held),
        worst_way=max((1e3 * row["beyond"] for row in stopped if row["injected"]), default=0.0),
        worst_force=max((row["force"] for row in stopped if row["injected"]), default=0.0),
        not_held=[row["fault"] for row in made if not is_held(row)],
        free=len(free),
        needless=[f"{row['key']}: {row['said'] or row['by']}" for row in free if row["by"]],
        busy=sum("beside other work" in row["key"] for row in free),
        noisy=sum("noise" in row["key"] for row in free),
    )


def draw(rows: list[dict], file: Path) -> None:
    """Draws how far the edge moved from each fault that stopped the robot to the arm's rest."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.add_subplot()
    stopped = [row for row in rows if row.get("by") and row.get("injected")]
    for where, marker, colour in (("food", "o", "#0072b2"), ("air", "^", "#d55e00")):
        found = [row for row in stopped if row["where"] == where]
        after = [1e3 * row["after"] for row in found]
        way = [1e3 * row["way"] for row in found]
        label = f"fault in the {where}, {len(found)}"
        axes.plot(after, way, marker, color=colour, alpha=0.6, label=label)
    axes.set(
        xlabel="time from the fault to rest (ms)", ylabel="way of the edge (mm)",
        title="From a fault to rest, at 40 mm/s",
    )  # fmt: skip
    axes.legend()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=150)


def _excess(row: dict) -> list[str]:
    if not row["injected"]:
        return ["-", "-"]
    return [f"{1e3 * row['beyond']:.2f} mm", f"{row['force']:.2f} N"]


def _cells(row: dict) -> list[str]:
    moved = ["-", "-"]
    if row["injected"]:
        moved = [f"{1e3 * row['after']:.0f} ms", f"{1e3 * row['way']:.2f} mm"]
    said = row["said"].removeprefix(f"STOPPED: {row['by']}: ").replace("|", "/")
    return [row["fault"], row["where"], row["by"], *moved, *_excess(row), said]
