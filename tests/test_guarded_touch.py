"""The guarded touch: what its readings mean, and the word that starts it."""

import io

import numpy as np
import pytest
from fake_robot import FakeRobot

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.hardware.guarded_touch import Touch, TouchError, contact_of
from sliceit_drake.hardware.hardware_config import HardwareConfig, TouchConfig
from sliceit_drake.resources import resource_path
from sliceit_drake.robot_run.board_touch import check_height
from sliceit_drake.robot_run.operated_robot import OperatedRobot

BOARD, STIFFNESS, CYCLE = 0.05, 3e4, 0.002


def touch_rows(noise=0.0, delay=0.0, bottom=BOARD - 3e-4, seed=0):
    """Readings of a touch at 5 mm/s, down to `bottom` and up, with a force that comes late, s."""
    step = 0.005 * CYCLE
    down = np.arange(BOARD + 2e-3, bottom, -step)
    height = np.concatenate([down, down[::-1]])
    time = CYCLE * np.arange(len(height))
    seen = np.interp(time - delay, time, height)
    force = STIFFNESS * np.maximum(0.0, BOARD - seen)
    # The norm of a noisy force is never negative.
    force = np.abs(force + noise * np.random.default_rng(seed).standard_normal(len(force)))
    return np.column_stack([height, force])


def test_a_clean_contact_is_found_exactly_with_its_stiffness():
    found = contact_of(touch_rows(), 0.0, TouchConfig())
    assert found.height == pytest.approx(BOARD, abs=1e-6)
    assert found.stiffness == pytest.approx(STIFFNESS, rel=1e-3)
    assert found.peak_force == pytest.approx(9.0, rel=0.05)
    assert 1e-5 <= found.uncertainty < 2e-5


def test_a_delay_of_the_force_shows_in_the_uncertainty_and_not_in_the_height():
    found = contact_of(touch_rows(delay=0.01), 0.0, TouchConfig())
    assert found.height == pytest.approx(BOARD, abs=1e-5)
    assert found.uncertainty == pytest.approx(0.005 * (0.01 + CYCLE), rel=0.1)


def test_noise_moves_the_height_by_less_than_the_uncertainty():
    misses = []
    for seed in range(20):
        found = contact_of(touch_rows(noise=0.3, seed=seed), 0.3, TouchConfig())
        misses.append(abs(found.height - BOARD) / found.uncertainty)
    assert np.max(misses) < 1.0


def test_no_contact_and_a_contact_too_short_are_named():
    with pytest.raises(TouchError, match="nothing was touched"):
        contact_of(touch_rows(bottom=BOARD + 1e-3), 0.0, TouchConfig())
    rows = touch_rows()[::15]
    with pytest.raises(TouchError, match="too short"):
        contact_of(rows, 0.0, TouchConfig())


@pytest.mark.parametrize("noise", [2.5, 4.0])
def test_a_force_that_scatters_as_much_as_the_contact_is_named(noise):
    with pytest.raises(TouchError, match="scatters by"):
        contact_of(touch_rows(), noise, TouchConfig())


def test_a_height_that_is_not_the_expected_one_is_refused_with_both_and_the_field():
    found = Touch(0.0512, 2e-5, STIFFNESS, 9.0)
    check_height(found, 0.0510, 1e-3, "board_height")
    with pytest.raises(ConfigurationError, match=r"0\.0500 m.*0\.0512 m.*0\.02 mm") as error:
        check_height(found, 0.05, 1e-3, "scenario.board.height")
    assert error.value.field == "scenario.board.height"


@pytest.mark.parametrize("typed", ["", "\n", "y\n", "slice\n"])
def test_only_its_own_word_starts_the_touch(typed, monkeypatch, capsys):
    scenario = load_scenario(resource_path("scenarios/cucumber_spring.yaml"))
    robot = FakeRobot(MakeStation(scenario).start_joints.tolist())
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))
    config = HardwareConfig(payload=1.2, payload_cog=[0.0, 0.0, 0.06])
    try:
        assert not OperatedRobot("127.0.0.1", config, pace=0.2).touch_board(scenario, robot)
    finally:
        robot.close()
    assert "Nothing was moved" in capsys.readouterr().out
    assert robot.sent == [] and robot.watchdog is None
    assert config.board_height is None, "nobody has measured it"
