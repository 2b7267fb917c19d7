"""`sliceit hardware` against an emulated controller that is the clock and waits for each command.

The pace that the client is told lets the machine pause for two seconds: a slow machine makes tests
slow, not wrong.
"""

import io

from emulator_bench import free_address

from sliceit_drake.cli.main import main
from sliceit_drake.emulator.process import EmulatorProcess
from sliceit_drake.resources import resource_path

ROBOT = resource_path("hardware/emulated.yaml")
CUCUMBER = resource_path("scenarios/cucumber_measured.yaml")
# A whole slice, board included, of 432 tetrahedra, in 1.4 s.
SLICE = """{
  food: {shape: !Cylinder
    {diameter: 0.027, length: 0.12, rings: 2, layers: [0.0, 0.006, 0.0095, 0.012]}},
  start: {clearance: 0.002}, measurement: null,
  motion: {segments: [
    !ConstantSpeed {distance: 0.0292, speed: 0.04, acceleration: 0.5, label: slice},
    !Hold {duration: 0.1, label: hold},
    !Retract {distance: 0.03, speed: 0.1, acceleration: 0.5, label: retract}]}}"""
PATIENT = "watchdog: 10.0, limits: {state_age: 0.04, command_age: 0.04, joint_step: 0.04}"
EMULATED_PACE, CLIENT_PACE = 0.1, 0.02


def emulated(scenario=CUCUMBER, overrides=SLICE, **options):
    return EmulatorProcess(
        scenario,
        free_address(),
        EMULATED_PACE,
        lockstep=True,
        options=["--set", overrides],
        **options,
    )


def run_hardware(
    emulator,
    directory,
    monkeypatch,
    typed,
    *options,
    scenario=CUCUMBER,
    overrides=SLICE,
    robot="serial: ''",
    pace=CLIENT_PACE,
):
    """Exit code of `sliceit hardware` with the words that an operator types."""
    monkeypatch.setattr("sys.stdin", io.StringIO("".join(f"{word}\n" for word in typed)))
    arguments = ["hardware", str(scenario), "--set", overrides, "--host", emulator.address]
    arguments += ["--pace", str(pace), "--robot", str(ROBOT)]
    arguments += [
        "--set-robot",
        f"{{{PATIENT}, {robot}}}",
        "--no-replay",
        "--output",
        str(directory),
    ]
    return main([*arguments, *options])
