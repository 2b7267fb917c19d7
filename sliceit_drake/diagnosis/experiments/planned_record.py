"""Experiments as planned slices, and the records that these would give, without force.

A planned slice is what the station simulates, the stand-in cuts and the robot runs
(`diagrams.planned_scenario`), so a proposal is judged by the motion that it would have.
"""

import copy
import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.cutting.foods.food import Food, make_food_model, shape_facts, start_pose
from sliceit_drake.cutting.foods.shapes import Box, Cylinder, PlainShape
from sliceit_drake.cutting.motion import Motion, MotionPlan, Pose, Segment, Waypoints
from sliceit_drake.cutting.planned_slice import PlannedSlice
from sliceit_drake.diagnosis.experiments.designs import CLEARANCE, Experiment, Scale
from sliceit_drake.prediction.placement import food_of, is_bare, knife_of
from sliceit_drake.records.metadata import PHASE_LABELS, FoodFacts, NominalMotion, Phase, ToolFacts
from sliceit_drake.records.phases import nominal_motion
from sliceit_drake.records.slice_record import SliceRecord

__all__ = [
    "experiment_of_record",
    "next_knife_slice",
    "planned_record",
    "planned_slice",
    "scale_of",
    "template_of",
]

TOLERANCE = 2e-5
"""By which a motion that is read from a record may be off, metres."""
PLANNED = ("p_WK_z", "food.position", "motion.speed")
"""Facts that are known of a planned slice."""


def template_of(records: Sequence[SliceRecord]) -> SliceRecord:
    """The record whose food, knife and sensor stand for all: the first with food."""
    return next((r for r in records if not is_bare(r)), records[0])


def next_knife_slice(records: Sequence[SliceRecord]) -> int:
    """Slices that the knife has cut since it was sharpened."""
    return 1 + max(
        r.metadata.slice_index if r.metadata.knife_slices is None else r.metadata.knife_slices
        for r in records
    )


def scale_of(setup: CalibrationSetup, records: Sequence[SliceRecord]) -> Scale:
    """What the motions of the menu are scaled to."""
    template = template_of(records)
    food, knife = food_of(setup.food, template), knife_of(setup.knife, template)
    width, height = _section(food, setup)
    speeds = [r.metadata.motion.speed for r in records if r.metadata.motion.speed]
    speed = float(np.median(speeds)) if speeds else Scale.speed
    return Scale(height=height, width=width, length=knife.length, speed=speed)


def planned_slice(
    experiment: Experiment, setup: CalibrationSetup, template: SliceRecord, knife_slices: int = 0
) -> PlannedSlice:
    """A slice of an experiment: the model's food, with knife and place as a record has them.

    `knife_slices` have been cut since sharpening.
    """
    food = _scaled(food_of(setup.food, template), experiment.size)
    if experiment.peeled:
        food.effects.skin = dc.replace(food.effects.skin, toughness=0.0)
    facts = template.metadata.food
    return PlannedSlice(
        name=experiment.name,
        food=food if experiment.food else None,
        height=_section(food, setup)[1],
        knife=knife_of(setup.knife, template),
        board=setup.board,
        position=facts.position,
        yaw=facts.yaw or 0.0,
        clearance=experiment.clearance,
        offset=experiment.offset,
        motion=experiment.motion,
        peeled=experiment.peeled,
        weight=experiment.weight,
        knife_slices=0 if experiment.sharpened else knife_slices,
    )


def planned_record(
    plan: PlannedSlice, setup: CalibrationSetup, template: SliceRecord, index: int
) -> SliceRecord:
    """The record that a slice would give at some place in the session, but with a force of zero;
    sensor and columns are those of the template."""
    p_WF = np.array([0.0, 0.0, plan.board.height] if plan.position is None else plan.position)
    c, s = np.cos(plan.yaw), np.sin(plan.yaw)
    R_WF = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    start = _start(plan, setup)
    motion = Motion(plan.motion, Pose(R_WF @ start.R, p_WF + R_WF @ start.p))
    step = float(np.median(np.diff(template.time)))
    time = step * np.arange(max(3, round(motion.duration / step) + 1))
    R, p, w, v = motion.sample(time)
    metadata = copy.deepcopy(template.metadata)
    metadata.name, metadata.condition = f"planned {plan.name}", plan.name
    metadata.slice_index, metadata.knife_slices = index, plan.knife_slices
    metadata.motion = _nominal(motion, time, v, R)
    metadata.board_height = float(p_WF[2])
    metadata.unknown = [field for field in metadata.unknown if field not in PLANNED]
    metadata.food = _food_facts(plan, p_WF, metadata.food)
    if plan.weight > 0.0:
        metadata.tool = ToolFacts(mass=plan.weight, center_of_mass=[0.0, 0.0, 0.0])
        metadata.wrench.includes = [*metadata.wrench.includes, "gravity"]
    nothing = np.zeros_like(p)
    return SliceRecord(
        metadata=metadata,
        time=time,
        position=p,
        rotation=R,
        velocity=v,
        angular_velocity=w,
        force=None if template.force is None else nothing,
        torque=None if template.torque is None else nothing.copy(),
        force_norm=None if template.force_norm is None else np.zeros(len(p)),
        force_vertical=None if template.force_vertical is None else np.zeros(len(p)),
        file=metadata.name,
    )


def experiment_of_record(record: SliceRecord, setup: CalibrationSetup) -> Experiment:
    """The experiment that a record is a slice of, to be repeated."""
    facts = record.metadata.food
    bare = is_bare(record)
    food = food_of(setup.food, record)
    height = _section(food, setup)[1]
    clearance, offset = CLEARANCE, 0.0
    if facts.position is not None:
        R_WF = Rotation.from_euler("z", facts.yaw or 0.0)
        p_FK = R_WF.inv().apply(record.position[0] - np.array(facts.position))
        model = make_food_model(food, setup.knife, setup.numerics, setup.refinement)
        home = start_pose(model, 0.0)
        offset = float(home.R[:, 0] @ (p_FK - home.p))
        clearance = float(p_FK[2]) - height
    elif bare and record.metadata.board_height is not None:
        clearance = float(record.position[0, 2]) - record.metadata.board_height - height
    weight = record.metadata.tool.mass if "gravity" in record.metadata.wrench.includes else None
    by_hand = [
        *(["take the food away"] if bare else []),
        *(["take the skin off the food"] if facts.peeled else []),
        *([f'hang {weight:g} kg on the knife while the phases "weight" last'] if weight else []),
    ]
    return Experiment(
        name=record.metadata.condition or record.name,
        what=f"the motion of {record.name} once more",
        motion=_motion_of_record(record),
        clearance=clearance,
        offset=offset,
        by_hand="; ".join(by_hand),
        food=not bare,
        peeled=bool(facts.peeled),
        weight=weight or 0.0,
    )


def _motion_of_record(record: SliceRecord) -> MotionPlan:
    """The recorded motion by straight legs, phase by phase."""
    phases = record.metadata.motion.phases
    edges = [(phase.label, phase.start, phase.end) for phase in phases]
    if not edges:
        edges = [("slice", float(record.time[0]), float(record.time[-1]))]
    rotation = Rotation.from_matrix(record.rotation)
    bounds = [int(np.searchsorted(record.time, start)) for _, start, _ in edges]
    bounds = [0, *bounds[1:], len(record) - 1]
    segments: list[Segment] = []
    for (label, _, _), a, b in zip(edges, bounds[:-1], bounds[1:], strict=True):
        if b <= a:
            continue
        back = rotation[a].inv()
        time = record.time[a : b + 1] - record.time[a]
        place = back.apply(record.position[a : b + 1] - record.position[a])
        angles = (back * rotation[a : b + 1]).as_euler("xyz")
        # Turns count as the way of a point 0.1 m off.
        kept = _legs(time, np.column_stack([place, 0.1 * angles]))[1:]
        turned = bool(np.abs(angles).max() > 1e-3)
        segments.append(
            Waypoints(
                times=np.round(time[kept], 6).tolist(),
                positions=np.round(place[kept], 7).tolist(),
                rotations=np.round(angles[kept], 6).tolist() if turned else [],
                interpolation="linear",
                label=label,
            )
        )
    return MotionPlan(segments=segments)


def _legs(time: np.ndarray, values: np.ndarray) -> list[int]:
    """Rows between which straight lines are within `TOLERANCE` of all others."""
    kept, open_ = [0, len(time) - 1], [(0, len(time) - 1)]
    while open_:
        a, b = open_.pop()
        share = ((time[a : b + 1] - time[a]) / (time[b] - time[a]))[:, None]
        off = np.linalg.norm(
            values[a : b + 1] - values[a] - share * (values[b] - values[a]), axis=1
        )
        worst = a + int(off.argmax())
        if off.max() > TOLERANCE:
            kept.append(worst)
            open_ += [(a, worst), (worst, b)]
    return sorted(kept)


def _start(plan: PlannedSlice, setup: CalibrationSetup) -> Pose:
    """X_FK at the start."""
    top = plan.height + plan.clearance
    if plan.food is None:
        return Pose(np.diag([1.0, -1.0, -1.0]), np.array([plan.offset, 0.0, top]))
    model = make_food_model(plan.food, plan.knife, setup.numerics, setup.refinement)
    pose = start_pose(model, plan.clearance, plan.offset)
    if isinstance(plan.food.shape, Cylinder | Box):
        # The clearance is over the food, not over a mesh that conserves its volume.
        pose.p[2] = top
    return pose


def _section(food: Food, setup: CalibrationSetup) -> tuple[float, float]:
    """Width and height of the section, metres."""
    if isinstance(food.shape, PlainShape):
        return food.shape.section
    model = make_food_model(food, setup.knife, setup.numerics, setup.refinement)
    low, high = model.span
    return float(high - low), float(start_pose(model, 0.0).p[2])


def _scaled(food: Food, scale: float) -> Food:
    """A copy of another size of section; the same where the shape cannot be scaled."""
    food = copy.deepcopy(food)
    if isinstance(food.shape, PlainShape):
        food.shape = food.shape.scaled(scale)
    return food


def _food_facts(plan: PlannedSlice, p_WF: np.ndarray, facts: FoodFacts) -> FoodFacts:
    if plan.food is None:
        return FoodFacts(name="none")
    shape, size = shape_facts(plan.food)
    return dc.replace(
        facts,
        shape=facts.shape if size is None else shape,
        size=size,
        peeled=plan.peeled,
        position=p_WF.tolist(),
        yaw=plan.yaw,
    )


def _nominal(motion: Motion, time: np.ndarray, v: np.ndarray, R: np.ndarray) -> NominalMotion:
    """Phases, and speed and draw while slicing."""
    phases: list[Phase] = []
    for label, begin, end in motion.phases:
        label = label if label in PHASE_LABELS else "other"
        if phases and phases[-1].label == label:
            phases[-1].end = end
        else:
            phases.append(Phase(label, begin, end))
    slicing = np.array([motion.phase_at(t) == "slice" for t in time])
    draw, _, press = np.einsum("nji,nj->ni", R, v).T
    return nominal_motion(phases, slicing, press, draw)
