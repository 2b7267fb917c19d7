"""Back on the last way after a breach of force, slowly: only at the operator's word."""

import dataclasses as dc
import math
from collections.abc import Callable, Sequence

import numpy as np

from sliceit_drake.diagrams.hardware_station import make_edge_kinematics, make_safety_layer
from sliceit_drake.hardware.checks import Check
from sliceit_drake.hardware.edge_kinematics import EdgePose
from sliceit_drake.hardware.rtde_link import RobotLink
from sliceit_drake.interruption import raise_if_interrupted
from sliceit_drake.robot_run.hardware_run import NO_DATA, HardwareRun, steady_python

__all__ = ["SPEED", "Retreat"]

SPEED = 0.01
"""Speed of the knife's faster end, m/s."""
ACCELERATION = 0.1
"""Its acceleration, m/s2."""
DISTANCE = 0.03
"""Farthest that it goes, m."""
MORE_FORCE, MORE_TORQUE = 5.0, 1.0
"""How much more than at the beginning stops it, N and Nm."""
STEP = 2e-4
"""Least distance of two postures of the way, m: an arm at rest adds none."""
HELD = 0.1
"""Time at the end, s."""


class Retreat:
    """The way that the arm came, backwards.

    What the sensor says is believed, as the stop was its doing: after any other stop there is no
    retreat. The sensor is not zeroed, as the knife is in contact.

    Args:
        hardware: Of the run that was stopped, with a client that is connected anew.

    Attributes:
        limits: What is allowed: those of the run, slower, and a little more than what is felt now.
        force: What is felt now, N.
        distance: How far the knife's faster end goes, m.
        link: To the robot; its log is whole after `execute`.
    """

    def __init__(self, hardware: HardwareRun) -> None:
        assert hardware.link is not None
        self.hardware, state = hardware, hardware.client.read()
        self._kinematics = make_edge_kinematics(hardware.twin)
        self._q, self._distances = _backwards(hardware.link.way(), self._kinematics.edge)
        self._off = [a - b for a, b in zip(state.q, self._q[0], strict=True)]
        self.force, torque = math.hypot(*state.wrench[:3]), math.hypot(*state.wrench[3:])
        limits = hardware.config.limits
        self.limits = dc.replace(
            limits,
            knife_speed=min(limits.knife_speed, 2.0 * SPEED),
            force=min(250.0, self.force + MORE_FORCE),
            torque=min(50.0, torque + MORE_TORQUE),
        )
        self.distance = min(DISTANCE, float(self._distances[-1]))
        edge = self._kinematics.edge(state.q)
        # It may press into the board a little, and goes nowhere deeper.
        floor = min(hardware.scenario.board.height, edge.heel[2], edge.tip[2])
        self.link = RobotLink(
            hardware.client, make_safety_layer(hardware.twin, self.limits, floor),
            hardware.config.watchdog, hardware.pace,
        )  # fmt: skip

    @staticmethod
    def is_offered_after(hardware: HardwareRun) -> bool:
        """Whether a motion ended by a breach of force, and nothing speaks against the sensor."""
        stop, link = hardware.stop, hardware.link
        if stop is None or link is None or stop.limit not in ("force", "torque"):
            return False
        return stop.sends and link.stop_error is None and bool(link.way())

    def checks(self) -> list[Check]:
        """What must be true before it moves."""
        off = max(map(abs, self._off))
        return [
            Check(
                "where the arm stopped",
                off <= self.hardware.config.start_tolerance,
                f"a joint is {off:.4f} rad off, allowed {self.hardware.config.start_tolerance:g}",
                "Somebody moved it. Move it away on the pendant.",
            ),
            Check(
                "way back",
                self.distance > 1e-3,
                f"{1e3 * self.distance:.1f} mm",
                "The arm had hardly moved. Move it away on the pendant.",
            ),
        ]

    def execute(self) -> str | None:
        """Goes back; always stops the robot's program.

        Returns:
            Why it stopped early, or None.
        """
        link = self.link
        link.start()
        reason = "the retreat ended by an error"
        try:
            with steady_python():
                reason = self._follow(link) or "the retreat is complete"
        finally:
            stop = link.finish(reason)
        if stop.limit != "end":
            return str(stop)
        return None if reason == "the retreat is complete" else reason

    def _follow(self, link: RobotLink) -> str | None:
        stop = link.arm()
        if stop is not None:
            return str(stop)
        status, way, speed, ending = link.latest(), 0.0, 0.0, math.inf
        while status.state.time < ending:
            raise_if_interrupted()
            newer = link.wait(status, NO_DATA / self.hardware.pace)
            if newer is None:
                return "no data from the robot"
            if newer.stop is not None:
                return str(newer.stop)
            is_new, status = newer.state is not status.state, newer
            if not is_new:
                continue
            left = self.distance - way
            wanted = min(SPEED, math.sqrt(2.0 * ACCELERATION * max(0.0, left)))
            speed = min(wanted, speed + ACCELERATION * status.period)
            way = min(self.distance, way + speed * status.period)
            if left < 1e-5 and ending == math.inf:
                ending = status.state.time + HELD
            q = [np.interp(way, self._distances, column) for column in self._q.T]
            link.put([a + b for a, b in zip(q, self._off, strict=True)], status.state.time)
        return None


def _backwards(
    way: list[list[float]], edge_at: Callable[[Sequence[float]], EdgePose]
) -> tuple[np.ndarray, np.ndarray]:
    """A way from its end on: joints [n, 6], rad, and distance of the edge's farther end [n], m."""
    joints, distances = [way[-1]], [0.0]
    last = edge_at(way[-1])
    for q in reversed(way):
        edge = edge_at(q)
        step = max(math.dist(edge.heel, last.heel), math.dist(edge.tip, last.tip))
        if step >= STEP:
            joints.append(q)
            distances.append(distances[-1] + step)
            last = edge
    return np.array(joints), np.array(distances)
