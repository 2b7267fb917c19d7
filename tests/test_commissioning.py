"""The walk from a push by hand to the first cut, on the emulated controller."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest
from hardware_bench import emulated, run_hardware

from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.hardware.client import PLAYING
from sliceit_drake.hardware.hardware_config import HardwareConfig
from sliceit_drake.resources import resource_path
from sliceit_drake.robot_run.commissioning import Commissioning

pytestmark = [pytest.mark.second_tier, pytest.mark.usefixtures("no_test_hangs")]

SPRING = resource_path("scenarios/cucumber_spring.yaml")
MOTION = """{start: {clearance: 0.005}, measurement: null, motion: {segments: [
  !ConstantSpeed {speed: 0.04, distance: 0.02, acceleration: 0.5, label: slice},
  !Retract {speed: 0.08, distance: 0.02, acceleration: 0.5, label: retract}]}}"""
BARE = "food: !AnalyticFood {toughness: 0.0}"


class Operator:
    """Types words, and does something before some of them."""

    def __init__(self, *words):
        self._words = list(words)

    def readline(self):
        if not self._words:
            return ""
        word, *actions = self._words.pop(0)
        for action in actions:
            action()
        return word + "\n"

    def isatty(self):
        return False


def walk(emulator, directory, monkeypatch, *words):
    patched = monkeypatch.setattr
    operator = Operator(*words)

    def typing(name, value):
        patched(name, operator if name == "sys.stdin" else value)

    monkeypatch.setattr = typing
    code = run_hardware(
        emulator, directory, monkeypatch, [], "--commission", scenario=SPRING, overrides=MOTION
    )
    return code, json.loads((directory / "commissioning.json").read_text())["steps"]


def pushed(emulator, force):
    def push():
        now = emulator.pendant.status()["time"]
        # The sensor's axis points down, along the knife.
        emulator.pendant.inject(f"sensor_bias:{-force}", now + 0.1)
        emulator.pendant.inject("sensor_bias:0", now + 0.4)

    return push


def test_the_walk_ends_with_the_first_cut(tmp_path, monkeypatch, capsys):
    # How many cycles are missed is this machine's affair.
    monkeypatch.setattr("sliceit_drake.robot_run.commissioning.MISSED", 1.0)
    with emulated(SPRING, MOTION) as emulator:
        pendant = emulator.pendant

        def stop_in_motion():
            pendant.inject("program_stopped", after=0.3)

        food = SPRING.read_text(encoding="utf-8")
        code, steps = walk(
            emulator, tmp_path, monkeypatch,
            ("ready",), ("move",), ("push", pushed(emulator, 10.0)),
            ("ready",), ("move",), ("slice",),
            ("ready",), ("move",), ("slice", stop_in_motion), ("pressed",),
            ("ready", lambda: pendant.put_fresh_food(BARE)), ("move",), ("touch",),
            ("ready", lambda: pendant.put_fresh_food(food)), ("move",), ("slice",),
            ("ready",), ("move",), ("slice",),
        )  # fmt: skip
        status = pendant.status()
    printed = capsys.readouterr().out
    assert code == 0, printed
    assert [step["step"] for step in steps] == ["push", "air", "stop", "touch", "foam", "cut"]
    found = [step["measured"] for step in steps]
    assert all(step["passed"] for step in steps)
    assert found[0]["force_up_N"] == pytest.approx(10.0, abs=0.5)
    assert found[1]["peak_force_N"] < 3.0
    assert found[2]["stopped by"].startswith("program")
    assert found[3]["height_m"] == pytest.approx(0.05, abs=2e-4)
    assert 0.5 < found[4]["peak_force_N"] < found[5]["peak_force_N"] < 40.0
    assert status["runtime_state"] == "STOPPED" and np.abs(status["velocities"]).max() < 1e-3


@pytest.mark.parametrize("force", [-10.0, 1.0], ids=["wrong sign", "not felt"])
def test_a_sensor_that_feels_a_push_otherwise_ends_the_walk(force, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sliceit_drake.robot_run.commissioning.PUSH_TIME", 0.6)
    with emulated(SPRING, MOTION) as emulator:
        code, steps = walk(
            emulator, tmp_path, monkeypatch,
            ("ready",), ("move",), ("push", pushed(emulator, force)), ("ready",), ("move",),
        )  # fmt: skip
    assert code == 1 and [step["passed"] for step in steps] == [False]
    assert "The walk ends here" in capsys.readouterr().out


def test_a_force_in_the_air_ends_the_walk_at_its_second_step(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sliceit_drake.robot_run.commissioning.MISSED", 1.0)
    with emulated(SPRING, MOTION) as emulator:
        pendant = emulator.pendant

        def pull():
            pendant.inject("sensor_bias:4.5", after=0.2)

        code, steps = walk(
            emulator, tmp_path, monkeypatch,
            ("ready",), ("move",), ("push", pushed(emulator, 10.0)),
            ("ready",), ("move",), ("slice", pull), ("ready",), ("move",), ("slice",),
        )  # fmt: skip
    assert code == 1 and "The walk ends here" in capsys.readouterr().out
    assert [(step["step"], step["passed"]) for step in steps] == [("push", True), ("air", False)]
    assert set(steps[1]["measured"]) == {"peak_force_N", "missed"}, "nothing stopped it"
    # The inertia of the tool comes on top.
    assert 4.4 < steps[1]["measured"]["peak_force_N"] < 6.0


# Steps whose runs are written here, as an `OperatedRobot` leaves them.

PROGRAM = "program at controller time 1.000 s: the robot's program is "
SAFETY = "safety_status at controller time 1.000 s: the robot reports "


class WrittenRuns:
    """An operated robot whose runs leave what is given here.

    Args:
        stopped: What stops each run; None for its end.
        force: Its peak force, N.
        missed: Cycles missed of a thousand.
        silence: Controller time without a target before the robot's program ended, s.
        words: What the operator types.
        is_ready: Whether there is a run at all.
    """

    def __init__(self, stopped=None, force=2.0, missed=0, silence=0.002, words=(), is_ready=True):
        self.config, self.found = HardwareConfig(), None
        self._stopped, self._force, self._missed = stopped, force, missed
        self._silence, self._words, self._is_ready = silence, list(words), is_ready

    def asks(self, word):
        return bool(self._words) and self._words.pop(0) == word

    def run(self, scenario, directory, move_to_start):
        if not self._is_ready:
            return None
        directory.mkdir(parents=True)
        timing = {"missed_cycles": self._missed, "cycles": 1000}
        summary = {"peak_force_N": self._force, "robot": timing}
        (directory / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
        with (directory / "robot.csv").open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["time", "sent_1", "runtime_state"])
            end, last = 1.0, 1.0 - self._silence
            for k in range(100):
                time = end - 0.002 * (100 - k)
                writer.writerow([time, "0.5" if time < last + 1e-9 else "", PLAYING])
            writer.writerow([end, "", 1])
        return SimpleNamespace(stopped=self._stopped)


STEPS = ["push", "air", "stop", "touch", "foam", "cut"]


def result_of(step, robot, directory):
    """What a step makes of a robot's run; the steps before it have passed."""
    overrides = "start.clearance=0.005,measurement=null"
    commissioning = Commissioning(robot, load_scenario(SPRING, overrides), directory)
    steps = {name: run for name, _, run in commissioning._steps}
    assert list(steps) == STEPS
    return steps[step](directory / step)


@pytest.mark.parametrize(
    ("step", "run"),
    [
        ("air", {"force": 3.5}),
        ("air", {"missed": 60}),
        ("air", {"stopped": PROGRAM + "stopped"}),
        ("air", {"is_ready": False}),
        ("stop", {}),
        ("stop", {"is_ready": False}),
        ("stop", {"stopped": "force at controller time 1.000 s: the tool meets a force"}),
        ("stop", {"stopped": "link at controller time 1.000 s: the robot's program is stopped"}),
        ("stop", {"stopped": "interrupted by the user", "words": ["pressed"]}),
        ("stop", {"stopped": PROGRAM + "in an unknown state", "words": ["pressed"]}),
        # A protective stop comes from a collision, too.
        ("stop", {"stopped": SAFETY + "protective stop, stopped due to safety"}),
        ("stop", {"stopped": SAFETY + "recovery mode", "words": ["pressed"]}),
        # Its watchdog ended the program, whatever the operator says.
        ("stop", {"stopped": PROGRAM + "stopped", "silence": 0.024, "words": ["pressed"]}),
        ("stop", {"stopped": PROGRAM + "stopped", "silence": 1.0, "words": ["pressed"]}),
        # Something else did: the operator has pressed nothing.
        ("stop", {"stopped": PROGRAM + "stopped", "words": ["no"]}),
        ("stop", {"stopped": PROGRAM + "paused"}),
        ("foam", {"force": 0.3}),
        ("foam", {"force": 16.0}),
        ("foam", {"stopped": "force at controller time 1.000 s: the tool meets a force"}),
        ("cut", {"force": 45.0}),
        ("cut", {"missed": 60}),
        ("cut", {"stopped": "tilt at controller time 1.000 s: the blade's tilt"}),
    ],
)
def test_a_step_whose_criterion_is_not_met_does_not_pass(step, run, tmp_path):
    assert not result_of(step, WrittenRuns(**run), tmp_path).passed


@pytest.mark.parametrize(
    ("step", "run"),
    [
        ("air", {}),
        ("stop", {"stopped": PROGRAM + "stopped", "words": ["pressed"]}),
        ("stop", {"stopped": PROGRAM + "paused", "words": ["pressed"]}),
        ("stop", {"stopped": SAFETY + "robot emergency stop, emergency stop"}),
        ("stop", {"stopped": SAFETY + "safeguard stop, stopped due to safety"}),
        ("foam", {}),
        ("cut", {"force": 30.0}),
    ],
)
def test_a_step_whose_criterion_is_met_passes(step, run, tmp_path):
    assert result_of(step, WrittenRuns(**run), tmp_path).passed


def test_foam_that_is_not_felt_ends_the_walk_before_the_cut(tmp_path, monkeypatch, capsys):
    robot = WrittenRuns(force=0.2, words=["ready"] * 6)
    commissioning = Commissioning(robot, load_scenario(SPRING, "measurement=null"), tmp_path)
    commissioning._steps = commissioning._steps[STEPS.index("foam") :]
    assert not commissioning.walk()
    steps = json.loads((tmp_path / "commissioning.json").read_text())["steps"]
    assert [(step["step"], step["passed"]) for step in steps] == [("foam", False)]
    assert "NOT PASSED: foam: peak_force_N 0.2" in capsys.readouterr().out
    assert not (tmp_path / "2_cut").exists()
