"""Checks before a robot may move: each says what it found and what to do."""

import dataclasses as dc
import math
from collections.abc import Sequence

from sliceit_drake.hardware.client import RobotFacts, RobotState
from sliceit_drake.hardware.edge_kinematics import EdgeKinematics
from sliceit_drake.hardware.hardware_config import HardwareConfig
from sliceit_drake.hardware.readings import pose_difference, weight_in_flange

__all__ = [
    "Check",
    "check_facts",
    "check_kinematics",
    "check_payload",
    "check_sensor",
    "check_start",
    "check_unzeroed",
]


POLYSCOPE = 5
"""Generation of the robot's software that is known: of e-Series robots."""


@dc.dataclass(frozen=True)
class Check:
    """One check.

    Attributes:
        name: What is checked.
        passed: Whether it allows motion.
        found: What was found, with what was wanted.
        fix: What to do if it did not pass.
    """

    name: str
    passed: bool
    found: str
    fix: str = ""

    def __str__(self) -> str:
        line = f"[{'ok' if self.passed else 'NO'}] {self.name}: {self.found}"
        return line if self.passed or not self.fix else f"{line}. {self.fix}"


def check_facts(facts: RobotFacts, config: HardwareConfig) -> list[Check]:
    """The robot itself: model, serial, software, state, payload, tool, speed slider."""
    checks = [
        Check(
            "model",
            facts.model == config.model,
            f"{facts.model or 'unknown'}, wanted {config.model}",
            "The plan is for another arm. Give the address of the right robot.",
        ),
        Check(
            "serial number",
            not config.serial or facts.serial == config.serial,
            f"{facts.serial}, wanted {config.serial or 'any'}",
            "This is not the robot that the file is for.",
        ),
        Check(
            "software",
            _version(config.software) <= _version(facts.software) < [POLYSCOPE + 1],
            f"{_polyscope(facts.software)}, wanted PolyScope {POLYSCOPE}, {config.software} or "
            "later",
            "Other software answers otherwise, and nothing here was written for it.",
        ),
        Check(
            "robot mode",
            facts.robot_mode == "RUNNING",
            f"{facts.robot_mode}, wanted RUNNING",
            "Switch the arm on and release its brakes on the pendant.",
        ),
        Check(
            "safety mode",
            facts.safety_mode in ("NORMAL", "REDUCED"),
            f"{facts.safety_mode}, wanted NORMAL or REDUCED",
            "Clear the stop on the pendant, after finding its cause.",
        ),
        Check(
            "remote control",
            facts.remote_control is True,
            {True: "on", False: "off", None: "the robot cannot say"}[facts.remote_control],
            "Switch the pendant to remote control; PolyScope 5.6 and later can say.",
        ),
        Check(
            "speed slider",
            facts.speed_scaling >= 0.999,
            f"{100.0 * facts.speed_scaling:.0f} %, wanted 100 %",
            "Below it the controller stretches time and the arm trails its targets.",
        ),
        Check(
            "tool centre point",
            len(facts.tcp) == 6 and all(abs(x) < 1e-4 for x in facts.tcp),
            f"{[round(x, 4) for x in facts.tcp]}, wanted zero",
            "Set it to the flange on the pendant: the wrench is taken there.",
        ),
    ]
    return checks + check_payload((facts.payload, *facts.payload_cog), config)


def check_payload(payload: Sequence[float] | None, config: HardwareConfig) -> list[Check]:
    """Payload that the controller subtracts: mass, kg, and centre in the flange, m [4]."""
    wanted, centre = config.payload, config.payload_cog
    if wanted is None or centre is None:
        fix = "Weigh all beyond the flange; write payload and payload_cog in the file."
        return [Check("payload", False, "the robot's file gives none", fix)]
    mass = distance = math.nan
    if payload is not None and len(payload) == 4:
        mass, distance = payload[0], math.dist(payload[1:], centre)
    return [
        Check(
            "payload",
            abs(mass - wanted) <= config.payload_tolerance,
            f"{mass:.3f} kg, wanted {wanted:.3f}",
            "Set it on the pendant (Installation, Payload): the force readings depend on it.",
        ),
        Check(
            "centre of gravity",
            distance <= config.cog_tolerance,
            f"{1e3 * distance:.1f} mm from the robot's file, allowed "
            f"{1e3 * config.cog_tolerance:.1f}",
            "Set it on the pendant (Installation, Payload).",
        ),
    ]


def check_sensor(
    states: Sequence[RobotState], config: HardwareConfig, least: int = 1
) -> list[Check]:
    """The force sensor, zeroed, in the air, by the mean of some states.

    Args:
        states: Each of another cycle.
        config: The robot's file.
        least: Number of states without which the robot's data do not go on.
    """
    count = len(states)
    if count < least or any(len(state.wrench) != 6 for state in states):
        fix = "Check the network; the readings may be old."
        return [Check("force after zeroing", False, f"{count} of {least} readings came", fix)]
    mean = [math.fsum(state.wrench[k] for state in states) / count for k in range(6)]
    force, torque = math.hypot(*mean[:3]), math.hypot(*mean[3:])
    fix = "Does the knife touch something? Is the payload right? Then zero it again."
    return [
        Check(
            "force after zeroing",
            force <= config.sensor_force,
            f"{force:.2f} N, allowed {config.sensor_force:g}",
            fix,
        ),
        Check(
            "torque after zeroing",
            torque <= config.sensor_torque,
            f"{torque:.3f} Nm, allowed {config.sensor_torque:g}",
            fix,
        ),
    ]


def check_unzeroed(
    states: Sequence[RobotState], kinematics: EdgeKinematics, config: HardwareConfig, least: int
) -> Check:
    """The force before zeroing, which would hide a contact: the raw one less the payload's weight.

    Where the robot does not show it, the force that counts is taken. For `least` see
    `check_sensor`.
    """
    name, count, total = "force before zeroing", len(states), [0.0] * 3
    if count < least:
        fix = "Check the network; the readings may be old."
        return Check(name, False, f"{count} of {least} readings came", fix)
    for state in states:
        force, weight = state.raw_wrench or state.wrench, [0.0] * 3
        if state.raw_wrench is not None and state.payload is not None:
            weight = weight_in_flange(state, kinematics)
        total = [total[k] + (force[k] - weight[k]) / count for k in range(3)]
    return Check(
        name,
        math.hypot(*total) <= config.unzeroed_force,
        f"{math.hypot(*total):.2f} N without the payload's weight, allowed "
        f"{config.unzeroed_force:g}",
        "Does the knife touch something? Is the payload right? Zeroing would hide it.",
    )


def check_kinematics(state: RobotState, config: HardwareConfig) -> Check:
    """The robot's own pose of its flange against the nominal kinematics, by which we plan."""
    doubt = pose_difference(state, config.limits.kinematics)
    found = "they agree" if doubt is None else doubt.detail
    if state.tcp_pose is None:
        found = "the robot does not say"
    return Check(
        "kinematics",
        doubt is None,
        found,
        "Set the tool centre point to the flange; measure the board with the same arm.",
    )


def check_start(state: RobotState, start: Sequence[float], config: HardwareConfig) -> list[Check]:
    """Whether the arm is at the start, with its cables on the side that the plan assumes."""
    # A NaN among numbers is neither the least nor the greatest of them.
    if (len(state.q), len(state.qd)) != (6, 6) or not all(map(math.isfinite, state.q + state.qd)):
        found = "the robot's joint data are no 6 finite numbers each"
        return [Check("start pose", False, found, "Check the network, and the robot's log.")]
    off = [a - b for a, b in zip(state.q, start, strict=True)]
    worst = max(range(6), key=lambda j: abs(off[j]))
    near = abs(off[worst]) <= config.start_tolerance
    # Where all are near, rounding alone decides which of them is the worst.
    named = f"joints are at most {abs(off[worst]):.4f}"
    if not near:
        named = f"joint {worst + 1} is {off[worst]:+.4f}"
    turns = [j + 1 for j in range(6) if abs(abs(off[j]) - 2.0 * math.pi) < 0.5]
    fix = "Move it there with --move-to-start, or on the pendant."
    if turns:
        fix = f"Joint {turns[0]} is a whole turn off: turn it back by hand, and look at the cables."
    fastest = max(map(abs, state.qd))
    return [
        Check(
            "start pose",
            near,
            f"{named} rad off, allowed {config.start_tolerance:g}",
            fix,
        ),
        Check("at rest", fastest < 0.01, f"fastest joint {fastest:.4f} rad/s", "Wait."),
    ]


def _polyscope(version: str) -> str:
    major = (_version(version) or [0])[0]
    names = {0: "unknown", 3: "PolyScope 3 of a CB3", POLYSCOPE: "PolyScope 5", 10: "PolyScope X"}
    return f"{names.get(major, 'a PolyScope of no known name')} ({version or 'no version'})"


def _version(text: str) -> list[int]:
    return [int(part) for part in text.split(".") if part.isdigit()]
