"""The first hours with a robot, step by step: from checks and a push by hand to the first cut."""

import copy
import csv
import dataclasses as dc
import json
import math
import time as clock
from collections.abc import Callable
from pathlib import Path

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.motion import ConstantSpeed, MotionPlan, Retract
from sliceit_drake.diagrams.hardware_station import make_edge_kinematics
from sliceit_drake.diagrams.run import Run
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.hardware.client import PLAYING, RobotClient
from sliceit_drake.hardware.readings import pose_difference
from sliceit_drake.interruption import raise_if_interrupted
from sliceit_drake.output_folder import unused
from sliceit_drake.robot_run.hardware_run import prepare_hardware_run
from sliceit_drake.robot_run.operated_robot import OperatedRobot

__all__ = ["RECORD", "Commissioning", "StepResult"]

RECORD = "commissioning.json"
HIGHER = 0.10
"""How much higher than the scenario's start the motion is tried in the air, m."""
FOAM_DEPTH, FOAM_SPEED, ACCELERATION = 0.005, 0.01, 0.1
"""How deep the edge goes into the foam, m, and how fast, m/s and m/s2."""
FOAM_FORCE = (0.5, 15.0)
"""Least and greatest force of that, N."""
PUSH, RELEASED = 5.0, 2.0
"""Force that counts as a push by hand, and as none, N."""
PUSH_TIME = 30.0
"""How long a push is waited for, s."""
MISSED = 0.05
"""Greatest share of missed cycles."""
SHARE = 0.8
"""Of the limit of force that the first cut may use."""
PRESSED = "pressed"
"""Word for having pressed the stop: who ended a program, the robot's data do not tell."""
SAFETY_STOPS = ("emergency stop", "safeguard stop")
"""Safety bits that nobody but a person sets."""
PROGRAM_STOPS = ("the robot's program is stopped", "the robot's program is paused")
SILENT = 0.5
"""Of the watchdog's time, without a target, after which it may have ended the program itself."""


@dc.dataclass
class StepResult:
    """What came of a step.

    Attributes:
        passed: Whether the walk goes on.
        criterion: What was asked, in words.
        measured: What was found, by name and unit.
    """

    passed: bool
    criterion: str
    measured: dict[str, float | str] = dc.field(default_factory=dict)


class Commissioning:
    """A walk whose next step begins only if the one before has passed; it always begins anew.

    Each step begins with the word "ready". Each motion is asked for by its own word, as in any run,
    and keeps every limit.

    Args:
        robot: Its operator's terminal asks for the words.
        scenario: The cut at the end; it has a motion.
        directory: Folder of the record and of each step's outputs.

    Raises:
        ConfigurationError: The scenario has no motion of its own.
    """

    def __init__(self, robot: OperatedRobot, scenario: Scenario, directory: Path) -> None:
        if scenario.policy is not None or scenario.sequence is not None:
            raise ConfigurationError(
                "has a policy or a sequence: the first cut is one prescribed motion",
                field="scenario",
                fix="Give one like cucumber_measured.",
            )
        self._robot, self._scenario, self._directory = robot, scenario, directory
        self._steps: list[tuple[str, str, Callable[[Path], StepResult]]] = [
            (
                "push",
                "No food. The arm goes to its start, high over the board: stay away. Only after "
                "the word push, when it stands still, press the knife straight up by its handle "
                "with about 10 N, and let go.",
                self._push,
            ),
            (
                "air",
                f"The knife makes the motion {1e3 * HIGHER:g} mm over the food's place and touches "
                "nothing. It should be smooth, without noise.",
                self._air,
            ),
            (
                "stop",
                "The same once more. Press the stop on the pendant while it moves: the arm should "
                "stand at once, and stay.",
                self._stop,
            ),
            (
                "touch",
                "Take everything off the board. The knife goes down slowly until it touches it, "
                "and back up.",
                self._touch,
            ),
            (
                "foam",
                "Put a block of soft foam, as high as the food, under the knife. It is pressed by "
                f"{1e3 * FOAM_DEPTH:g} mm, and the force points up.",
                self._foam,
            ),
            ("cut", "Put the food under the knife and stand back: the first cut.", self._cut),
        ]

    def walk(self) -> bool:
        """Walks; whether all steps passed. The record is written after each; an earlier one is
        kept by another name."""
        self._directory.mkdir(parents=True, exist_ok=True)
        if (self._directory / RECORD).exists():
            earlier = unused(self._directory / "commissioning_earlier", ".json")
            (self._directory / RECORD).rename(earlier.with_suffix(".json"))
        rows: list[dict] = []
        for number, (name, see, run) in enumerate(self._steps, 1):
            print(f"\nSTEP {number} of {len(self._steps)}, {name}. {see}\n", flush=True)
            if not self._robot.asks("ready"):
                return False
            result = run(self._directory / f"{number}_{name}")
            rows.append({"step": name, "see": see, **dc.asdict(result)})
            text = json.dumps({"finished": clock.strftime("%F %T"), "steps": rows}, indent=1)
            (self._directory / RECORD).write_text(text + "\n", encoding="utf-8")
            found = ", ".join(f"{key} {_shown(value)}" for key, value in result.measured.items())
            print(f"{'PASSED' if result.passed else 'NOT PASSED'}: {name}: {found or 'not begun'}.")
            print(f"  wanted: {result.criterion}")
            if not result.passed:
                print("The walk ends here. Find the cause, and begin anew.")
                return False
        print(f"\nAll {len(self._steps)} steps passed. Record: {self._directory / RECORD}")
        return True

    def _push(self, directory: Path) -> StepResult:
        criterion = (
            f"a force of {PUSH:g} N or more, up within 30 degrees, that goes away again, and the "
            "robot's own pose where its joints have the flange"
        )
        if not self._robot.move_to_start(self._in_the_air()):
            return StepResult(False, criterion)
        with self._robot.connected() as client:
            hardware = prepare_hardware_run(
                self._in_the_air(), self._robot.config, client, self._robot.pace
            )
            if not self._robot.report("Robot and plan", hardware.check_before()):
                return StepResult(False, criterion)
            if not self._robot.report("Start", hardware.check_at_start()):
                return StepResult(False, criterion)
            if not self._robot.asks("push"):
                return StepResult(False, criterion)
            push, left = _watch_push(client, self._robot.pace)
            agrees = pose_difference(client.read(), self._robot.config.limits.kinematics) is None
        down = make_edge_kinematics(hardware.twin).gravity
        up = -sum(a * b for a, b in zip(push, down, strict=True)) / math.hypot(*down)
        sideways = math.sqrt(max(0.0, math.hypot(*push) ** 2 - up**2))
        passed = up >= PUSH and sideways <= up * math.tan(math.radians(30.0))
        measured: dict[str, float | str] = {
            "force_up_N": up, "force_sideways_N": sideways, "force_left_N": left,
        }  # fmt: skip
        return StepResult(passed and left < RELEASED and agrees, criterion, measured)

    def _air(self, directory: Path) -> StepResult:
        most = self._robot.config.sensor_force
        made = self._run(self._in_the_air(), directory)
        criterion = f"it ends by itself, under {most:g} N, with at most {MISSED:.0%} missed"
        return self._judged(made, directory, criterion, 0.0, most)

    def _stop(self, directory: Path) -> StepResult:
        criterion = (
            f"an emergency or safeguard stop, or a program that you ended, as you say ({PRESSED}), "
            "while it got its targets in time"
        )
        made = self._run(self._in_the_air(), directory)
        if made is None:
            return StepResult(False, criterion)
        stopped = made.stopped or "nothing stopped it"
        measured: dict[str, float | str] = {"stopped by": stopped}
        if stopped.startswith("safety_status"):
            return StepResult(any(s in stopped for s in SAFETY_STOPS), criterion, measured)
        if not (stopped.startswith("program ") and stopped.endswith(PROGRAM_STOPS)):
            return StepResult(False, criterion, measured)
        silence = _silence_before_stop(directory / "robot.csv")
        measured["without_target_s"] = silence
        # Written so that what is not known does not pass.
        if not silence < SILENT / self._robot.config.watchdog:
            return StepResult(False, criterion, measured)
        print("\nThe robot's program ended. Its watchdog or another program may have done that.")
        return StepResult(self._robot.asks(PRESSED), criterion, measured)

    def _touch(self, directory: Path) -> StepResult:
        config = self._robot.config
        criterion = f"the board within {1e3 * config.touch.tolerance:g} mm of where it should be"
        scenario = copy.deepcopy(self._scenario)
        try:
            passed = self._robot.move_to_start(scenario) and self._robot.find_board(scenario)
        except ConfigurationError as error:  # The board is somewhere else.
            return StepResult(False, criterion, {"refused": str(error)})
        found = self._robot.found
        if found is None:
            return StepResult(False, criterion)
        measured: dict[str, float | str] = {
            "height_m": found.height, "uncertainty_m": found.uncertainty,
            "peak_force_N": found.peak_force,
        }  # fmt: skip
        return StepResult(passed, criterion, measured)

    def _foam(self, directory: Path) -> StepResult:
        scenario = copy.deepcopy(self._scenario)
        depth = scenario.start.clearance + FOAM_DEPTH
        scenario.motion = MotionPlan(
            [
                ConstantSpeed(distance=depth, speed=FOAM_SPEED, acceleration=ACCELERATION),
                Retract(distance=depth, speed=FOAM_SPEED, acceleration=ACCELERATION),
            ]
        )
        scenario.measurement = None
        made = self._run(scenario, directory)
        least, most = FOAM_FORCE
        criterion = f"it ends by itself, with {least:g} to {most:g} N"
        return self._judged(made, directory, criterion, least, most)

    def _cut(self, directory: Path) -> StepResult:
        most = SHARE * self._robot.config.limits.force
        made = self._run(copy.deepcopy(self._scenario), directory)
        criterion = f"it ends by itself, under {most:g} N, with at most {MISSED:.0%} missed"
        return self._judged(made, directory, criterion, 0.0, most)

    def _in_the_air(self) -> Scenario:
        scenario = copy.deepcopy(self._scenario)
        scenario.start.clearance += HIGHER
        scenario.measurement = None
        return scenario

    def _run(self, scenario: Scenario, directory: Path) -> Run | None:
        return self._robot.run(scenario, directory, move_to_start=True)

    def _judged(
        self, made: Run | None, directory: Path, criterion: str, least: float, most: float
    ) -> StepResult:
        """Judges a run by its summary: force, N, and missed cycles."""
        if made is None:
            return StepResult(False, criterion)
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
        force, timing = float(summary["peak_force_N"]), summary["robot"]
        missed = timing["missed_cycles"] / max(1, timing["cycles"])
        measured: dict[str, float | str] = {"peak_force_N": force, "missed": missed}
        if made.stopped:
            measured["stopped by"] = made.stopped
        passed = not made.stopped and least <= force <= most and missed <= MISSED
        return StepResult(passed, criterion, measured)


def _shown(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def _silence_before_stop(log: Path) -> float:
    """Controller time from the last target to the program's end, s; NaN without either.

    Args:
        log: Written by `RobotLink.write_log`.
    """
    sent = math.nan
    with log.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            time = float(row["time"])
            if int(row["runtime_state"]) != PLAYING:
                return time - sent
            if row["sent_1"]:
                sent = time
    return math.nan


def _watch_push(client: RobotClient, pace: float) -> tuple[list[float], float]:
    """The greatest force of a push [3], N, in the base's axes, and what is left of it, N."""
    push, left, deadline = [0.0] * 3, 0.0, clock.perf_counter() + PUSH_TIME / pace
    while clock.perf_counter() < deadline:
        raise_if_interrupted()
        client.kick()
        force = client.read().wrench[:3]
        left = math.hypot(*force)
        if left > math.hypot(*push):
            push = list(force)
        if math.hypot(*push) >= PUSH and left < RELEASED:
            break
        clock.sleep(5e-3)
    return push, left
