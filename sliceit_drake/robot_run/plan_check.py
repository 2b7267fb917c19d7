"""The motion of a scenario in joint space, before anything moves: is it within reach and limits?"""

import dataclasses as dc
import math

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting.motion import Motion
from sliceit_drake.diagrams.hardware_station import make_clearance, make_edge_kinematics
from sliceit_drake.diagrams.simulated_station import SimulatedStation
from sliceit_drake.diagrams.station_interface import Station
from sliceit_drake.hardware.checks import Check
from sliceit_drake.hardware.client import RobotClient
from sliceit_drake.hardware.hardware_config import HardwareConfig
from sliceit_drake.systems.motion_sources import placed_motion

__all__ = ["JointPlan", "check_plan", "plan_joints"]

SAMPLE = 0.01
ITERATIONS = 20
POSITION_MISS = 1e-4
ASKED_OF_ROBOT = 12
SEEN = 0.05
"""Distance of bodies up to which it is said how near they come, m."""


@dc.dataclass
class JointPlan:
    """What the joints do if the knife follows its target exactly.

    Attributes:
        time: [n], s.
        q: Joint positions [n, 6], rad.
        miss: Greatest distance of the knife from its target, m.
        singular_value: Least singular value of the knife's Jacobian on the way (rad, m).
        fastest: Greatest speed of an end of the edge, m/s.
        tilt: Greatest tilt of the blade, rad.
        edge_low, edge_high: Box that the ends of the edge stay in [3], m.
    """

    time: np.ndarray
    q: np.ndarray
    miss: float
    singular_value: float
    fastest: float
    tilt: float
    edge_low: np.ndarray
    edge_high: np.ndarray


def plan_joints(
    station: Station, motion: Motion | None = None, sample: float = SAMPLE
) -> JointPlan:
    """Follows a motion by inverse kinematics from the start.

    Args:
        station: Whose arm, knife and start are used.
        motion: From the start on; None for the scenario's.
        sample: Longest time between two postures, s.
    """
    if motion is None:
        motion = placed_motion(station.motion_plan, station.start_pose)
    time = np.linspace(0.0, motion.duration, max(2, math.ceil(motion.duration / sample) + 1))
    R, p, _, _ = motion.sample(time)
    plant, knife = station.plant, station.robot.knife
    context, frame, world = plant.CreateDefaultContext(), knife.body_frame(), plant.world_frame()
    kinematics = make_edge_kinematics(station)
    q, path, ends = np.array(station.start_joints, float), [], []
    least, miss, tilt = math.inf, 0.0, 0.0
    for R_WK, p_WK in zip(R, p, strict=True):
        for _ in range(ITERATIONS):
            plant.SetPositions(context, q)
            pose = plant.EvalBodyPoseInWorld(context, knife)
            turn = Rotation.from_matrix(R_WK @ pose.rotation().matrix().T).as_rotvec()
            error = np.concatenate([turn, p_WK - pose.translation()])
            J = plant.CalcJacobianSpatialVelocity(
                context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world
            )
            if np.abs(error).max() < 1e-8:
                break
            q = q + J.T @ np.linalg.solve(J @ J.T + 1e-8 * np.eye(6), error)
        least = min(least, float(np.linalg.svd(J, compute_uv=False)[-1]))
        miss = max(miss, float(np.linalg.norm(error[3:])))
        edge = kinematics.edge(q.tolist())
        tilt = max(tilt, math.acos(max(-1.0, min(1.0, edge.down))))
        path.append(q)
        ends.append([edge.heel, edge.tip])
    edges = np.array(ends)
    speed = np.linalg.norm(np.diff(edges, axis=0), axis=2) / np.diff(time)[:, None]
    return JointPlan(
        time=time,
        q=np.array(path),
        miss=miss,
        singular_value=least,
        fastest=float(speed.max()),
        tilt=tilt,
        edge_low=edges.min(axis=(0, 1)),
        edge_high=edges.max(axis=(0, 1)),
    )


def check_plan(
    plan: JointPlan, station: SimulatedStation, config: HardwareConfig, client: RobotClient | None
) -> list[Check]:
    """Compares a station's plan with the limits of the robot's file.

    Asks the robot that `client` controls for its own limits, too, unless it is None.
    """
    limits, board = config.limits, station.scenario.board.height
    speed = np.abs(np.diff(plan.q, axis=0) / np.diff(plan.time)[:, None])
    window = np.abs(plan.q - station.start_joints).max()
    low = (plan.q - limits.joint_lower).min()
    high = (np.array(limits.joint_upper) - plan.q).min()
    inside = (plan.edge_low >= limits.workspace_lower).all() and (
        plan.edge_high <= limits.workspace_upper
    ).all()
    miss = f"{1e3 * plan.miss:.3f} mm" if plan.miss < 0.1 else f"{plan.miss:.2f} m"
    change = "Change the scenario, or name the limit in the robot's file"
    checks = [
        Check("reach", plan.miss <= POSITION_MISS, f"{miss} off the target"),
        Check(
            "singularity",
            plan.singular_value >= config.singularity,
            f"least singular value {plan.singular_value:.3f}, wanted {config.singularity:g}",
            "Place the food elsewhere, or start in another posture.",
        ),
        Check(
            "joint limits and cables",
            min(low, high) >= 0.0 and window <= limits.joint_window,
            f"joints turn by {window:.3f} rad, allowed {limits.joint_window:g}; "
            f"{min(low, high):.3f} rad from a limit",
            change,
        ),
        Check(
            "joint speed",
            bool((speed <= limits.joint_speed).all()),
            f"{speed.max():.3f} rad/s, allowed {min(limits.joint_speed):g}",
            change,
        ),
        Check(
            "knife speed",
            plan.fastest <= limits.knife_speed,
            f"{plan.fastest:.3f} m/s, allowed {limits.knife_speed:g}",
            change,
        ),
        Check("tilt", plan.tilt <= limits.tilt, f"{plan.tilt:.3f} rad, allowed {limits.tilt:g}"),
        Check(
            "workspace",
            bool(inside),
            f"edge from {np.round(plan.edge_low, 3).tolist()} to "
            f"{np.round(plan.edge_high, 3).tolist()} m",
            change,
        ),
        Check(
            "board height",
            config.board_height is not None,
            f"{board:.4f} m" + ("" if config.board_height is not None else ", not measured"),
            "Measure it and write board_height in the robot's file (docs/how_to/hardware.md).",
        ),
        Check(
            "depth at the board",
            bool(plan.edge_low[2] >= board - limits.board_depth),
            f"edge down to {1e3 * (plan.edge_low[2] - board):+.2f} mm over the board, allowed "
            f"{-1e3 * limits.board_depth:+.2f}",
            change,
        ),
    ]
    clearance = make_clearance(station)
    near = [found for q in plan.q if (found := clearance.nearest(q, SEEN)) is not None]
    least, bodies = min(near, default=(SEEN, "all bodies"))
    checks.append(
        Check(
            "clearance",
            least >= limits.clearance,
            f"{bodies} {1e3 * least:.1f} mm apart" + ("" if near else " or more")
            + f", wanted {1e3 * limits.clearance:g}",
            "Hold the food farther from the cut, or cut it elsewhere.",
        )
    )  # fmt: skip
    if client is not None:
        chosen = np.unique(np.linspace(0, len(plan.q) - 1, ASKED_OF_ROBOT).astype(int))
        refused = [k for k in chosen if not client.allows_joints(plan.q[k].tolist())]
        where = f", refuses the one at {plan.time[refused[0]]:.2f} s" if refused else ""
        checks.append(
            Check(
                "the robot's own safety limits",
                not refused,
                f"asked for {len(chosen)} postures{where}",
                "Its safety configuration (planes, joint limits) stands on the pendant.",
            )
        )
    return checks
