"""The program on the robot: what its text allows, and what of it the emulated controller plays."""

import re

import numpy as np
import pytest
from emulator_bench import ScriptBench

from sliceit_drake.emulator.control_script import ControlScript, read_script
from sliceit_drake.emulator.robot_model import START
from sliceit_drake.hardware.control_script import control_script

SERVO, STEP, SPEED = 11, 0.01, 0.5
TEXT = control_script(STEP, SPEED)
SERVO_ARGUMENTS = [0.0, 0.0, 0.002, 0.03, 2000.0]


def playing(text):
    bench = ScriptBench()
    bench.controller.start_program(ControlScript(bench.controller, read_script(text)).step, "test")
    bench.step()
    return bench


def servo(bench, angle):
    bench.write(SERVO, [START[0] + angle, *START[1:], *SERVO_ARGUMENTS])
    bench.step()


def moved(bench):
    return float(np.abs(bench.positions - START).max())


def test_its_text_checks_each_target_before_the_arm_gets_it():
    body = TEXT[TEXT.index("cmd == 11:") : TEXT.index("cmd == 16:")]
    assert body.index("check_step(q)\n") < body.index("servo_q = q\n")
    assert len(re.findall(r"servo_q = q\n", TEXT)) == 1
    assert "global most_in_a_step = 0.01\n" in TEXT and "global most_in_a_cycle = 0.0011\n" in TEXT
    assert "global most_move_speed = 0.5\n" in TEXT
    found = read_script(TEXT)
    assert (found.most_in_a_step, found.most_in_a_cycle) == (STEP, 0.0011)
    assert found.commands == {0, 1, 8, 11, 16, 34, 35, 37, 40, 255}
    # URScript has an end for whatever begins.
    words = [line.split()[0].rstrip(":") for line in TEXT.splitlines() if line.split()]
    assert sum(w in ("def", "thread", "while", "if") for w in words) == words.count("end")


@pytest.mark.parametrize("jump", [0.1, 0.004, float("nan")])
def test_a_target_that_jumps_ends_the_program_before_the_arm_moves(jump):
    bench = playing(TEXT)
    servo(bench, 0.0)
    servo(bench, jump)
    bench.step(50)
    assert bench.controller.runtime.name == "STOPPED" and moved(bench) < 1e-9
    assert "jumps by" in bench.texts()


def test_without_the_check_the_arm_follows_the_jump():
    bench = playing(TEXT.replace("check_step(q)\n", ""))
    servo(bench, 0.0)
    servo(bench, 0.1)
    bench.step(50)
    assert moved(bench) > 0.05


def test_the_greatest_speed_passes_and_so_does_what_a_gap_holds_up():
    bench = playing(TEXT)
    angles = 0.001 * np.arange(60)
    for k, angle in enumerate(angles):
        if 20 <= k < 28:
            bench.step()  # Nothing comes for 8 cycles.
        else:
            servo(bench, angle)
    assert bench.controller.runtime.name == "PLAYING"
    assert bench.controller.target[0] == pytest.approx(START[0] + angles[-1])


def test_a_steady_way_that_is_too_fast_ends_it():
    for speed, goes_on in ((1.05, True), (1.3, False), (2.0, False)):
        bench = playing(TEXT)
        for angle in 0.001 * speed * np.arange(200):
            servo(bench, angle)
        assert (bench.controller.runtime.name == "PLAYING") == goes_on, speed


@pytest.mark.parametrize(("speed", "goes_on"), [(0.5, True), (0.6, False), (float("nan"), False)])
def test_a_planned_motion_that_is_too_fast_ends_it(speed, goes_on):
    bench = playing(TEXT)
    bench.write(1, [START[0] + 0.3, *START[1:], speed, 0.5, 1.0])
    bench.step(100)
    assert (bench.controller.runtime.name == "PLAYING") == goes_on
    assert (moved(bench) > 1e-3) == goes_on


def test_a_command_that_it_does_not_have_ends_it():
    bench = playing(TEXT)
    bench.write(9, [1.0] * 8)  # speedJ.
    bench.step(20)
    assert bench.controller.runtime.name == "STOPPED" and moved(bench) < 1e-9
