"""The guarded touch of a scenario: plan, limits, and what the found height means for a run."""

import dataclasses as dc

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.motion import ConstantSpeed, MotionPlan
from sliceit_drake.diagrams.hardware_station import make_edge_kinematics, make_safety_layer
from sliceit_drake.hardware.checks import Check
from sliceit_drake.hardware.guarded_touch import GuardedTouch, Touch, TouchError
from sliceit_drake.hardware.rtde_link import RobotLink
from sliceit_drake.robot_run.hardware_run import HardwareRun, steady_python
from sliceit_drake.robot_run.plan_check import check_plan, plan_joints
from sliceit_drake.systems.motion_sources import placed_motion

__all__ = ["BoardTouch", "check_height"]

SAMPLE = 1e-3
"""Distance between the postures that the path is made of, m."""


class BoardTouch:
    """A touch that finds the board straight under the start of a scenario.

    Args:
        hardware: Whose robot, start and limits are used.

    Attributes:
        expected: Height of the board that is expected, that of the scenario's, m.
        depth: Farthest way down, m.
        plan: The way down to there in joint space.
        link: Link to the robot, once it ran.
    """

    def __init__(self, hardware: HardwareRun) -> None:
        self.hardware = hardware
        self.link: RobotLink | None = None
        self.expected = hardware.scenario.board.height
        twin, touch = hardware.twin, hardware.config.touch
        start = twin.start_pose
        self.depth = float(start.translation()[2]) - self.expected + touch.below
        way = MotionPlan([ConstantSpeed(distance=self.depth, speed=touch.speed)])
        self.plan = plan_joints(twin, placed_motion(way, start), SAMPLE / touch.speed)

    def checks(self) -> list[Check]:
        """The checks of the way down; under the board it goes on purpose."""
        hardware = self.hardware
        checks = check_plan(self.plan, hardware.twin, hardware.config, hardware.client)
        return [check for check in checks if check.name != "depth at the board"]

    def execute(self) -> Touch:
        """Touches the board and goes back up; always stops the robot's program.

        All limits of the robot's file hold, force and speed as far as the touch needs them, and the
        depth from the lowest height at which it looks.

        Raises:
            TouchError: The board was not found, or a limit stopped the robot.
        """
        hardware, touch = self.hardware, self.hardware.config.touch
        limits = hardware.config.limits
        fastest = 2.0 * max(touch.speed, touch.retract_speed)
        limits = dc.replace(
            limits,
            force=min(limits.force, touch.force_limit),
            knife_speed=min(limits.knife_speed, fastest),
        )
        floor = self.expected - touch.below
        link = self.link = RobotLink(
            hardware.client, make_safety_layer(hardware.twin, limits, floor),
            hardware.config.watchdog, hardware.pace,
        )  # fmt: skip
        link.start()
        depths = touch.speed * self.plan.time

        def path(way: float) -> np.ndarray:
            return np.array([np.interp(way, depths, q) for q in self.plan.q.T])

        reason = "the touch ended by an error"
        try:
            problem = hardware.not_ready(link)
            if problem is not None:
                raise TouchError(problem)
            with steady_python():
                found = GuardedTouch(
                    link, path, self.depth, make_edge_kinematics(hardware.twin), touch,
                    hardware.pace,
                ).run()  # fmt: skip
            reason = "the touch is complete"
        finally:
            link.finish(reason)
        return found


def check_height(found: Touch, expected: float, tolerance: float, field: str) -> None:
    """Compares the height of the board with the expected one, m, which stands in `field`.

    Raises:
        ConfigurationError: They differ by more than the tolerance, m; it names both, and the field.
    """
    if abs(found.height - expected) <= tolerance:
        return
    raise ConfigurationError(
        f"is {expected:.4f} m, but the knife met the board at {found.height:.4f} m (+- "
        f"{1e3 * found.uncertainty:.2f} mm): {1e3 * (found.height - expected):+.2f} mm, allowed "
        f"{1e3 * tolerance:g} mm",
        field=field,
        fix=f"See that nothing lies on the board; then write board_height: {found.height:.4f} in "
        "the robot's file.",
    )
