"""What an operator reads before a robot moves, and the words that they type."""

import sys
import termios
from collections.abc import Sequence

from sliceit_drake.hardware.checks import Check
from sliceit_drake.hardware.hardware_config import differing
from sliceit_drake.hardware.rtde_link import RobotLink
from sliceit_drake.robot_run.hardware_run import HardwareRun

__all__ = ["ask", "plan_text", "report", "stopped_text"]


def ask(word: str, is_emulated: bool) -> bool:
    """Whether the operator types the word; Enter alone, an end of input or Ctrl-C do not.

    What was typed before the question does not count, and a robot is not moved by a pipe.

    Args:
        word: The word that goes on.
        is_emulated: Whether the robot is emulated on this machine, so that a pipe may answer.
    """
    if sys.stdin.isatty():
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    elif not is_emulated:
        print(f'The word "{word}" must be typed at a terminal. Nothing was moved.')
        return False
    try:
        answer = input(f'Type "{word}" to go on, anything else to leave: ')
    except EOFError:
        answer = ""
    if answer.strip() == word:
        return True
    print("Not confirmed. Nothing was moved.")
    return False


def report(title: str, checks: Sequence[Check]) -> bool:
    """Prints checks; whether all passed."""
    print(f"{title}:")
    for check in checks:
        print(f"  {check}")
    failed = [check.name for check in checks if not check.passed]
    if failed:
        print(f"Not ready: {', '.join(failed)}. Nothing was moved.")
    return not failed


def plan_text(hardware: HardwareRun, duration: float) -> str:
    """What is about to happen, for the operator to read."""
    scenario, plan, limits = hardware.scenario, hardware.plan, hardware.config.limits
    board = scenario.board.height
    changed = differing(hardware.config)
    phases = ", ".join(
        f"{label} {end - begin:.2f} s" for label, begin, end in hardware.motion.phases
    )
    policy = scenario.policy
    if policy is not None:
        phases = f"{policy.describe()}; up to there"
    low, high = plan.edge_low[2] - board, plan.edge_high[2] - board
    lines = [
        "",
        f"PLAN: {scenario.name}, {duration:.2f} s: {phases}",
        f"  knife up to {1e3 * plan.fastest:.0f} mm/s; edge between "
        f"{1e3 * low:+.2f} and {1e3 * high:+.1f} mm over the board at {board:.4f} m",
        f"  stops at {limits.force:g} N, {limits.torque:g} Nm, {limits.knife_speed:g} m/s of the "
        f"knife, {1e3 * limits.board_depth:g} mm below the board, {limits.tracking_error:g} rad "
        "off the target",
        f"  settings that differ from the defaults: {'; '.join(changed) if changed else 'none'}",
        "",
    ]
    return "\n".join(lines)


def stopped_text(link: RobotLink | None) -> str:
    """What an operator must know about the robot after a stop."""
    if link is None or link.stop_error is None:
        return "The robot's program is stopped. Find the cause before you start again."
    return (
        f"THE ROBOT DID NOT CONFIRM THAT ITS PROGRAM IS STOPPED ({link.stop_error}). Use the "
        "emergency stop before you go near it."
    )
