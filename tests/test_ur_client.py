"""The client's last means to stop a robot whose control link does not answer."""

import threading
import time

import numpy as np
import pytest
from emulator_bench import free_address

from sliceit_drake.emulator.process import EmulatorProcess
from sliceit_drake.hardware.client import RUNTIME_STATES, RobotUnavailableError
from sliceit_drake.hardware.rtde_link import HALT_TIME
from sliceit_drake.hardware.supervisor import Supervisor
from sliceit_drake.hardware.ur_client import ATTEMPT, UrClient

pytestmark = pytest.mark.usefixtures("no_test_hangs")


class DeafControl:
    """Takes a motion, but never comes back from what shall end it."""

    def __init__(self, control, fails):
        self._control, self._fails = control, fails
        self.released = threading.Event()

    def stopJ(self, _):  # noqa: N802
        if self._fails:
            raise RuntimeError("the control link is gone")
        self.released.wait(60.0)

    def stopScript(self):  # noqa: N802
        pass

    def disconnect(self):
        self.released.set()
        self._control.disconnect()

    def __getattr__(self, name):
        return getattr(self._control, name)


@pytest.mark.parametrize("fails", [False, True], ids=["waits for ever", "fails"])
def test_the_dashboard_stops_a_robot_whose_control_link_does_not(fails):
    with EmulatorProcess(address=free_address(), pace=1.0) as emulator:
        client = UrClient(emulator.address, 0.03, 2000.0)
        try:
            client._control = DeafControl(client._control, fails)
            begin = client.read().q
            client.start_move((np.array(begin) + [0.5, 0, 0, 0, 0, 0]).tolist(), 0.1, 0.5)
            end = time.monotonic() + 20.0
            while abs(client.read().q[0] - begin[0]) < 0.01:
                assert time.monotonic() < end, "it does not move"
            client.stop()
            status = emulator.pendant.status()
            assert status["runtime_state"] == "STOPPED"
            assert any("stopped by the dashboard" in text for _, text in status["log"])
        finally:
            client.close()


def test_where_no_data_come_the_dashboard_can_confirm_that_the_program_has_stopped():
    with EmulatorProcess(address=free_address(), pace=1.0) as emulator:
        client = UrClient(emulator.address, 0.03, 2000.0)
        try:
            emulator.pendant.inject("shows:timestamp:frozen")
            time.sleep(0.1)
            client.stop()
        finally:
            client.close()
        assert emulator.pendant.status()["runtime_state"] == "STOPPED"


def test_both_ways_to_stop_are_tried_before_the_operator_is_told_that_none_did():
    assert 2.0 * ATTEMPT < HALT_TIME


@pytest.mark.parametrize("fault", ["safeguard_stop", "protective_stop", "program_paused"])
def test_a_paused_program_is_stopped_so_that_nobody_can_resume_it(fault):
    with EmulatorProcess(address=free_address(), pace=1.0) as emulator:
        client = UrClient(emulator.address, 0.03, 2000.0)
        try:
            emulator.pendant.inject(fault)
            end = time.monotonic() + 20.0
            while client.read().runtime_state != RUNTIME_STATES.index("paused"):
                assert time.monotonic() < end, "it is not paused"
            client.stop()
            assert emulator.pendant.status()["runtime_state"] == "STOPPED"
            emulator.pendant.inject("normal")
            emulator.pendant.inject("program_resumed")
            assert emulator.pendant.status()["runtime_state"] == "STOPPED"
        finally:
            client.close()


def test_a_program_that_stays_paused_is_not_told_to_be_stopped(monkeypatch):
    with EmulatorProcess(address=free_address(), pace=1.0) as emulator:
        client = UrClient(emulator.address, 0.03, 2000.0)
        try:
            emulator.pendant.inject("program_paused")
            # A robot in local control refuses what its dashboard is asked to do.
            monkeypatch.setattr(client, "_stop_by_dashboard", client._has_ended)
            with pytest.raises(RuntimeError, match="plays or is paused"):
                client.stop()
        finally:
            client.close()


def test_a_stop_that_is_not_confirmed_is_told_and_tried_once_more(monkeypatch, capfd):
    with EmulatorProcess(address=free_address(), pace=1.0) as emulator:
        with Supervisor(emulator.address) as supervisor:
            client = UrClient(emulator.address, 0.03, 2000.0, supervisor=supervisor)
            monkeypatch.setattr(client, "_ends", lambda *_: False)
            client.close()
        status = emulator.pendant.status()
    assert status["runtime_state"] == "STOPPED"
    assert any("stopped by the dashboard" in text for _, text in status["log"])
    told = capfd.readouterr().err
    assert "NOT CONFIRMED THAT ITS PROGRAM IS STOPPED. Stay away" in told
    assert "ENDS WITHOUT A CONFIRMED STOP OF THE ROBOT. The robot's program was stopped" in told


def test_without_a_supervisor_a_stop_that_is_not_confirmed_is_an_error(monkeypatch):
    with EmulatorProcess(address=free_address(), pace=1.0) as emulator:
        client = UrClient(emulator.address, 0.03, 2000.0)
        monkeypatch.setattr(client, "_ends", lambda *_: False)
        with pytest.raises(RuntimeError, match="plays or is paused"):
            client.close()


def test_a_confirmed_stop_leaves_the_supervisor_nothing_to_say(capfd):
    with EmulatorProcess(address=free_address(), pace=1.0) as emulator:
        with Supervisor(emulator.address) as supervisor:
            UrClient(emulator.address, 0.03, 2000.0, supervisor=supervisor).close()
        log = [text for _, text in emulator.pendant.status()["log"]]
    assert capfd.readouterr().err == "" and not any("by the dashboard" in text for text in log)


def test_ctrl_c_while_control_is_taken_stops_the_program(monkeypatch):
    def interrupted(client, _):
        while not client._control.isProgramRunning():
            time.sleep(0.01)
        raise KeyboardInterrupt

    monkeypatch.setattr(UrClient, "_await_program", interrupted)
    with EmulatorProcess(address=free_address(), pace=1.0) as emulator:
        with pytest.raises(KeyboardInterrupt):
            UrClient(emulator.address, 0.03, 2000.0)
        status = emulator.pendant.status()
    assert any(text.startswith("program started") for _, text in status["log"])
    assert status["runtime_state"] == "STOPPED"


def test_a_paused_program_of_somebody_else_is_not_replaced():
    with EmulatorProcess(address=free_address(), pace=1.0) as emulator:
        theirs = UrClient(emulator.address, 0.03, 2000.0)
        try:
            emulator.pendant.inject("program_paused")
            with pytest.raises(RobotUnavailableError, match="runs on the robot, or is paused"):
                UrClient(emulator.address, 0.03, 2000.0)
            status = emulator.pendant.status()
            assert status["runtime_state"] == "PAUSED"
            assert not any("replaced" in text for _, text in status["log"])
        finally:
            theirs.close()
