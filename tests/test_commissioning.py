"""The walk from a push by hand to the first cut, on the emulated controller."""

import json

import numpy as np
import pytest
from hardware_bench import emulated, run_hardware

from sliceit_drake.resources import resource_path

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
            ("ready",), ("move",), ("slice", stop_in_motion),
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
