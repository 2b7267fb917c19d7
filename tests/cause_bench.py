"""Slices of a coarse cucumber in which each cause leaves its signature."""

import functools

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.cutting.motion import (
    ConstantSpeed,
    Hold,
    MotionPlan,
    PressAndDraw,
    Retract,
    Waypoints,
)
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.protocol import Condition, Protocol, load_protocol
from studies.diagnosis.identifiability import nominal_records, protocol_setup

TURN, MASS = 0.5, 1.0


def push(speed: float) -> MotionPlan:
    """Down to the middle, held, on to 0.2 mm below the board's top, withdrawn."""
    return MotionPlan(
        [
            Hold(0.1, label="air"),
            ConstantSpeed(distance=0.0165, speed=speed, acceleration=2.0, label="slice"),
            Hold(0.6, label="hold"),
            ConstantSpeed(distance=0.0137, speed=speed, acceleration=2.0, label="slice"),
            Retract(distance=0.0302, speed=0.06, acceleration=2.0, label="retract"),
            Hold(0.1, label="air"),
        ]
    )


DRAW = MotionPlan(
    [
        Hold(0.1, label="air"),
        PressAndDraw(press_speed=0.03, distance=0.0302, draw_ratio=1.0, label="slice"),
        Retract(distance=0.0302, speed=0.06, acceleration=2.0, label="retract"),
    ]
)
TURNED = MotionPlan(
    [
        Hold(0.1, label="air"),
        Hold(0.3, label="weight"),
        Waypoints(times=[0.4], positions=[[0.0] * 3], rotations=[[TURN, 0.0, 0.0]], label="air"),
        Hold(0.3, label="weight"),
    ]
)
BOARD = MotionPlan(
    [
        Hold(0.1, label="air"),
        ConstantSpeed(distance=0.0075, speed=0.02, acceleration=0.5, label="board_press"),
        Hold(0.2, label="board_press"),
    ]
)
CONDITIONS = [
    Condition("slow", push(0.012), 1),
    Condition("fast", push(0.04), 1),
    Condition("peeled", push(0.04), 1, peeled=True),
    Condition("draw", DRAW, 1, offset=-0.015),
    Condition("board", BOARD, 1, clearance=-0.02, without_food=True),
    Condition("weight", TURNED, 1, clearance=0.08, without_food=True, weight=MASS),
]


@functools.cache
def bench() -> tuple[CalibrationSetup, list[SliceRecord]]:
    """Slices of a coarse cucumber."""
    protocol = load_protocol(str(resource_path("calibration/protocols/poor.yaml")))
    protocol = Protocol(food=protocol.food, conditions=CONDITIONS, random_order=False)
    return protocol_setup(protocol, refinement=0.5), nominal_records(protocol)
