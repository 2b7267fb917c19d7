"""Time of one decision of the safety layer.

Prints the least mean of five runs that pass every command.
"""

import argparse
import timeit

import numpy as np

from sliceit_drake.hardware.client import PLAYING, RobotState
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics
from sliceit_drake.hardware.hardware_config import SafetyLimits
from sliceit_drake.hardware.safety import SafetyLayer

__all__ = ["add_arguments", "run"]

START = [1.35559, -1.48188, 1.94802, -2.03694, -1.57079, 1.35559]
CYCLES = 20_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds nothing: the study has no arguments."""


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    X_TK = np.eye(4)
    X_TK[2, 3] = 0.21
    kinematics = EdgeKinematics(np.eye(4), X_TK, 0.15)

    def decide_all() -> None:
        layer = SafetyLayer(SafetyLimits(), kinematics, 0.05, START)
        state = RobotState(0.0, START, [0.0] * 6, [0.0] * 6, PLAYING, 1)
        layer.arm(state)
        q = list(START)
        for k in range(1, CYCLES):
            q[0] += 1e-7
            layer.step(state._replace(time=0.002 * k), q, 0.002 * k)
        assert layer.stop is None, layer.stop

    best = min(timeit.repeat(decide_all, number=1, repeat=5)) / CYCLES
    print(f"{1e6 * best:.1f} us a decision")
    return 0
