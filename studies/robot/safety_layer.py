"""Time of one decision of the safety layer.

Prints the least mean of five runs that pass every command: readings as an honest robot shows them,
of an arm that turns slowly, and with the distances of the bodies as well, as in a run.
"""

import argparse
import timeit
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.diagrams.hardware_station import make_edge_kinematics, make_safety_layer
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.hardware.client import PLAYING, RUNNING, RobotState
from sliceit_drake.hardware.edge_kinematics import flange_pose
from sliceit_drake.hardware.hardware_config import SafetyLimits
from sliceit_drake.hardware.safety import SafetyLayer
from sliceit_drake.resources import resource_path

__all__ = ["add_arguments", "run"]

CYCLES, PERIOD, RUNS = 5_000, 0.002, 5
SPEED = 1e-6
"""Way of the first joint in a cycle, rad."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds nothing: the study has no arguments."""


def _states(start: list[float]) -> list[RobotState]:
    """What the robot shows in each cycle."""
    rng, out = np.random.default_rng(0), []
    for k in range(CYCLES):
        q = [start[0] + SPEED * k, *start[1:]]
        X = flange_pose(q)
        R = np.array(X[:9]).reshape(3, 3).T
        force = rng.normal(scale=0.05, size=3)
        raw = [*(R.T @ force), 0.0, 0.0, 0.0]
        pose = [*X[9:], *Rotation.from_matrix(R).as_rotvec()]
        wrench = [*force.tolist(), 0.0, 0.0, 0.0]
        out.append(
            RobotState(
                PERIOD * k, q, [0.0] * 6, wrench, PLAYING, 1, None, q, raw, pose, 1.0, RUNNING
            )
        )
    return out


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    twin = SimulatedStation(load_scenario(resource_path("scenarios/cucumber_measured.yaml")))
    states = _states(twin.start_joints.tolist())

    def decide_all(bodies: bool) -> None:
        layer: SafetyLayer = make_safety_layer(twin, SafetyLimits())
        if not bodies:
            layer = SafetyLayer(
                SafetyLimits(), make_edge_kinematics(twin), twin.scenario.board.height, states[0].q
            )
        layer.arm(states[0])
        for state, after in zip(states[1:], states[2:], strict=False):
            layer.step(state, after.q, state.time)
        assert layer.stop is None, layer.stop

    plain, whole = (
        1e6 * min(timeit.repeat(partial(decide_all, bodies), number=1, repeat=RUNS)) / CYCLES
        for bodies in (False, True)
    )
    print(f"{plain:.1f} us a decision, {whole:.1f} us with the distances of the bodies")
    return 0
