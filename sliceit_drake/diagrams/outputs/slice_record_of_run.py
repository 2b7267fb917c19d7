"""The slice record (docs/reference/records.md) of a run, simulated or on a robot."""

import datetime

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.diagrams.outputs.record_facts import food_facts, knife_facts
from sliceit_drake.diagrams.run import Run
from sliceit_drake.records.metadata import (
    PHASE_LABELS,
    FoodFacts,
    NominalMotion,
    Phase,
    SensorFacts,
    SliceMetadata,
    WrenchFacts,
    slice_name,
)
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["slice_record_of"]


def slice_record_of(
    run: Run, provenance: str, *, index: int = 0, condition: str = ""
) -> SliceRecord:
    """Makes the record of what the wrist sensor and the joints showed.

    The wrench is the sensor's, after taring, moved to Ko and turned to W: food and board, and what
    of the tool's weight and inertia taring leaves.

    Args:
        run: After it ran.
        provenance: Where the numbers come from.
        index: Order in a session.
        condition: Records with the same label were nominally the same cut.
    """
    table, scenario = run.record(), run.scenario
    time, p = table["time"], table.vector("knife_pose_p")
    quaternion = table.vector("knife_pose_quat", "wxyz")
    R_WK = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    X_KS = scenario.robot.X_TK().inverse()  # The sensor has the flange's frame.
    R_WS = R_WK @ X_KS.rotation().matrix()
    force = np.einsum("nij,nj->ni", R_WS, table.vector("sensor_wrench_f"))
    moment = np.einsum("nij,nj->ni", R_WS, table.vector("sensor_wrench_m"))
    arm = R_WK @ X_KS.translation()
    motion = NominalMotion(
        phases=[
            Phase(label if label in PHASE_LABELS else "other", begin, min(end, float(time[-1])))
            for label, begin, end in run.motion.phases
            if begin < min(end, float(time[-1]))
        ]
    )
    for segment in run.station.motion_plan.segments:
        if segment.label == "slice":
            motion.speed = getattr(segment, "speed", getattr(segment, "press_speed", None))
            motion.draw_ratio = getattr(segment, "draw_ratio", 0.0)
            break
    metadata = SliceMetadata(
        name=slice_name(index),
        date=datetime.date.today().isoformat(),
        provenance=provenance + (f" Ended early: {run.stopped}" if run.stopped else ""),
        food=_food_facts(run),
        board_height=scenario.board.height,
        knife=knife_facts(scenario.knife),
        motion=motion,
        wrench=WrenchFacts(includes=["food", "board", "inertia"], tared="yes"),
        sensor=SensorFacts(
            name="wrist sensor",
            rate=1.0 / scenario.exchange_period,
            position=X_KS.translation().tolist(),
            rotation=Rotation.from_matrix(X_KS.rotation().matrix()).as_euler("xyz").tolist(),
        ),
        slice_index=index,
        knife_slices=(scenario.preparation.knife_slices if scenario.preparation else 0) + index,
        condition=condition or scenario.name,
        unknown=["food.slice_thickness", "tool"],
    )
    return SliceRecord(
        metadata=metadata,
        time=time,
        position=p,
        rotation=R_WK,
        velocity=table.vector("knife_velocity_v"),
        angular_velocity=table.vector("knife_velocity_w"),
        force=force,
        torque=moment + np.cross(arm, force),
        joints=table.vector("q", "123456"),
    )


def _food_facts(run: Run) -> FoodFacts:
    scenario, food = run.scenario, run.scenario.food
    if own := run.own.get("cutting"):
        return FoodFacts(name=own)
    if not isinstance(food, Food):
        return FoodFacts(name="none")
    peeled = scenario.preparation.peeled if scenario.preparation else False
    return food_facts(food, peeled, scenario.X_WF().translation(), scenario.placement.yaw)
