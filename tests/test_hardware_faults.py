"""What happens to the network and to the controller in the middle of a motion, over TCP.

The faults without a network are in tests/test_rtde_system.py and tests/test_safety.py.
"""

import re
import threading
import time

import numpy as np
import pytest
from emulator_bench import wait_until
from hardware_bench import emulated, run_hardware

from sliceit_drake.resources import resource_path
from sliceit_drake.robot_run.hardware_run import HardwareRun

pytestmark = [pytest.mark.second_tier, pytest.mark.usefixtures("no_test_hangs")]

SPRING = resource_path("scenarios/cucumber_spring.yaml")
# Two seconds in the air: no fault may come after the end.
OVERRIDES = """{start: {clearance: 0.02}, measurement: null, motion: {segments: [
  !ConstantSpeed {speed: 0.02, distance: 0.019, acceleration: 0.5, label: other},
  !Retract {speed: 0.02, distance: 0.019, acceleration: 0.5, label: retract}]}}"""


def injected_in_motion(emulator, *faults):
    """A thread that injects faults as soon as the arm moves."""

    def inject():
        end = time.monotonic() + 60.0
        while np.abs(emulator.pendant.status()["velocities"]).max() < 0.02:
            if time.monotonic() > end:
                return
            time.sleep(0.02)
        for fault in faults:
            emulator.pendant.inject(fault)

    thread = threading.Thread(target=inject)
    thread.start()
    return thread


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("silence:0.1", "STOPPED: state_age"),
        ("silence:1", "STOPPED: state_age"),
        ("silence:4", "STOPPED: state_age"),
        ("wrong_payload:2", r"STOPPED: payload .* 1\.199 kg at .* now 2\.000 kg"),
    ],
)
def test_it_stops_the_robot_for_good(fault, said, tmp_path, monkeypatch, capsys):
    with emulated(SPRING, OVERRIDES) as emulator:
        thread = injected_in_motion(emulator, fault)
        code = run_hardware(
            emulator, tmp_path, monkeypatch, ["slice"], scenario=SPRING, overrides=OVERRIDES,
            pace=0.05,
        )  # fmt: skip
        thread.join()
        printed = capsys.readouterr().out
        assert code == 1 and re.search(said, printed), printed
        assert "RETREAT" not in printed, "only after a breach of force"
        log = emulator.pendant.status()["log"]
        at = next(when for when, text in log if text.startswith("injected"))
        # When the network is there again nothing moves; after 4 s it did not either, in a minute.
        silence = float(fault.partition(":")[2]) if fault.startswith("silence") else 0.0
        status = wait_until(emulator.pendant, at + min(silence, 1.0) + 0.2, timeout=120.0)
        stopped = re.search(r"STOPPED: \w+ at controller time ([\d.]+) s", printed)
    assert status["runtime_state"] == "STOPPED" and status["safety_mode"] == "NORMAL"
    assert np.abs(status["velocities"]).max() < 1e-3
    assert float(stopped[1]) - at < 0.05
    if silence > 0.1:
        # Until the network is there again the controller's own watchdog, 10 Hz here, is all.
        watchdog = next(when for when, text in status["log"] if "RTDE watchdog: no" in text)
        assert watchdog - at < 0.1 + 0.02


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        # The client has its connections: only who comes anew is turned away.
        (["refuse:1"], None),
        # It would take a lost one up again by itself, if it could.
        (["refuse:1", "close:rtde"], "STOPPED: (state_age|link)"),
    ],
)
def test_refused_connections_matter_only_to_who_connects_anew(
    faults, said, tmp_path, monkeypatch, capsys
):
    with emulated(SPRING, OVERRIDES) as emulator:
        thread = injected_in_motion(emulator, *faults)
        code = run_hardware(
            emulator, tmp_path, monkeypatch, ["slice"], scenario=SPRING, overrides=OVERRIDES,
            pace=0.05,
        )  # fmt: skip
        thread.join()
        status = emulator.pendant.status()
    printed = capsys.readouterr().out
    log = [text for _, text in status["log"] if text.startswith("injected")]
    assert log == [f"injected: {fault}" for fault in faults]
    assert status["safety_mode"] == "NORMAL" and np.abs(status["velocities"]).max() < 1e-3
    if said is None:
        assert code == 0, printed
    else:
        assert code == 1 and re.search(said, printed), printed


def test_a_dry_run_in_which_the_robot_stops_ends_without_success(tmp_path, monkeypatch, capsys):
    with emulated(SPRING, OVERRIDES) as emulator:
        prepare = HardwareRun._prepare

        def then_stop(hardware, station):
            made = prepare(hardware, station)
            emulator.pendant.inject("emergency_stop")
            return made

        monkeypatch.setattr(HardwareRun, "_prepare", then_stop)
        code = run_hardware(
            emulator, tmp_path, monkeypatch, [], "--dry-run", scenario=SPRING,
            overrides=OVERRIDES, pace=0.05,
        )  # fmt: skip
    printed = capsys.readouterr().out
    assert code == 1 and "NOT READY: safety_status" in printed, printed
