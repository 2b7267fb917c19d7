"""Experiments as scenarios, and scenarios as the slice records that they would give, without force.

A scenario is what the station simulates, the stand-in cuts and the robot runs, so a proposal is
judged by the motion that it would have and by no other.
"""

import copy
import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.cutting.foods.effects import Compliance, Slip
from sliceit_drake.cutting.foods.food import (
    Box,
    Cylinder,
    Ellipsoid,
    Food,
    make_food_model,
    start_pose,
)
from sliceit_drake.cutting.motion import Motion, MotionPlan, Pose, Segment, Waypoints
from sliceit_drake.diagnosis.experiments.designs import Experiment, Scale
from sliceit_drake.diagrams.record_facts import shape_facts
from sliceit_drake.diagrams.scenario import Placement, Preparation, Scenario, Start
from sliceit_drake.prediction.placement import food_of, is_bare, knife_of
from sliceit_drake.records.metadata import PHASE_LABELS, FoodFacts, NominalMotion, Phase, ToolFacts
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.systems.analytic_cutter import AnalyticFood

__all__ = [
    "experiment_of_record",
    "next_knife_slice",
    "planned_record",
    "scale_of",
    "scenario_of",
    "template_of",
]

TOLERANCE = 2e-5
"""By which a motion that is read from a record may be off, metres."""
REACH = (0.3, 0.7)
"""Distances from the base at which the arm cuts, metres."""
GAINS = 200.0
"""Of the controller in motion mode, as scenarios/cucumber.yaml has it."""


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


def scenario_of(
    experiment: Experiment,
    setup: CalibrationSetup,
    template: SliceRecord,
    knife_slices: int = 0,
) -> Scenario:
    """What the station runs: the model's food as the records have it, and the experiment.

    Args:
        experiment: The experiment.
        setup: The model.
        template: Record with the food, the knife and the place.
        knife_slices: Slices since sharpening, before the first.
    """
    food = _scaled(food_of(setup.food, template), experiment.size)
    # An arm and a holder that give belong to the station, not to the food.
    food.effects = dc.replace(food.effects, compliance=Compliance(), slip=Slip())
    if experiment.peeled:
        food.effects.skin = dc.replace(food.effects.skin, toughness=0.0)
    facts, scenario = template.metadata.food, Scenario(name=experiment.name)
    scenario.board = dc.replace(setup.board)
    if facts.position is not None and _in_reach(facts.position, scenario):
        scenario.placement = Placement(position=facts.position[:2], yaw=facts.yaw or 0.0)
        scenario.board.height = facts.position[2]
    scenario.controller.mode = "motion"
    scenario.controller.error_scale = 1.0
    scenario.controller.p_gains = [GAINS] * 6
    scenario.knife = knife_of(setup.knife, template)
    scenario.numerics.flank_stiffness = setup.numerics.flank_stiffness
    scenario.food = food
    if not experiment.food:
        # Of no toughness, it is a height to start from and no force.
        scenario.food = AnalyticFood(diameter=_section(food, setup)[1], toughness=0.0)
    scenario.start = Start(clearance=experiment.clearance, offset=experiment.offset)
    scenario.motion = copy.deepcopy(experiment.motion)
    scenario.preparation = Preparation(
        peeled=experiment.peeled,
        weight=experiment.weight,
        knife_slices=0 if experiment.sharpened else knife_slices,
    )
    return scenario


def planned_record(
    scenario: Scenario, setup: CalibrationSetup, template: SliceRecord, name: str, index: int
) -> SliceRecord:
    """The record that a slice of a scenario would give, but with a force of zero.

    Args:
        scenario: From `scenario_of`.
        setup: The model.
        template: Record whose sensor and columns it has.
        name: Of the record.
        index: Place in the session.
    """
    X_WF = scenario.X_WF()
    R_WF, p_WF = X_WF.rotation().matrix(), X_WF.translation()
    start = _start(scenario, setup)
    motion = Motion(scenario.motion, Pose(R_WF @ start.R, p_WF + R_WF @ start.p))
    step = float(np.median(np.diff(template.time)))
    time = step * np.arange(max(3, round(motion.duration / step) + 1))
    R, p, w, v = motion.sample(time)
    metadata = copy.deepcopy(template.metadata)
    metadata.name, metadata.condition = name, scenario.name
    prepared = scenario.preparation or Preparation()
    metadata.slice_index, metadata.knife_slices = index, prepared.knife_slices
    metadata.motion = _nominal(motion, time, v, R)
    metadata.board_height = scenario.board.height
    metadata.unknown = [
        field
        for field in metadata.unknown
        if field not in ("p_WK_z", "food.position", "motion.speed")
    ]
    metadata.food = _food_facts(scenario, metadata.food)
    if prepared.weight > 0.0:
        metadata.tool = ToolFacts(mass=prepared.weight, center_of_mass=[0.0, 0.0, 0.0])
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
        force_norm=np.zeros(len(p)) if template.force is None else None,
        file=f"{name} (planned)",
    )


def experiment_of_record(record: SliceRecord, setup: CalibrationSetup) -> Experiment:
    """The experiment that a record is a slice of, to be repeated."""
    facts = record.metadata.food
    bare = is_bare(record)
    food = food_of(setup.food, record)
    height = _section(food, setup)[1]
    clearance, offset = 3e-3, 0.0
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


def _in_reach(position: Sequence[float], scenario: Scenario) -> bool:
    """Whether the station's arm reaches a place; records of others have their own origin."""
    away = np.array(position) - scenario.robot.base_position
    low, high = REACH
    return bool(low <= np.hypot(*away[:2]) <= high and abs(away[2]) <= low)


def _start(scenario: Scenario, setup: CalibrationSetup) -> Pose:
    """X_FK at the start."""
    food, start = scenario.food, scenario.start
    if isinstance(food, Food):
        model = make_food_model(food, scenario.knife, setup.numerics, setup.refinement)
        pose = start_pose(model, start.clearance, start.offset)
        if isinstance(food.shape, Cylinder | Box):
            # The clearance is over the food, not over a mesh that conserves its volume.
            pose.p[2] = _section(food, setup)[1] + start.clearance
        return pose
    assert isinstance(food, AnalyticFood)
    R = np.diag([1.0, -1.0, -1.0])
    return Pose(R, np.array([start.offset, 0.0, food.diameter + start.clearance]))


def _section(food: Food, setup: CalibrationSetup) -> tuple[float, float]:
    """Width and height of the section, metres."""
    if isinstance(food.shape, Cylinder | Box | Ellipsoid):
        return food.shape.section
    model = make_food_model(food, setup.knife, setup.numerics, setup.refinement)
    low, high = model.span
    return float(high - low), float(start_pose(model, 0.0).p[2])


def _scaled(food: Food, scale: float) -> Food:
    """A copy of another size of section; the same where the shape cannot be scaled."""
    food = copy.deepcopy(food)
    if isinstance(food.shape, Cylinder | Box | Ellipsoid):
        food.shape = food.shape.scaled(scale)
    return food


def _food_facts(scenario: Scenario, facts: FoodFacts) -> FoodFacts:
    food, prepared = scenario.food, scenario.preparation or Preparation()
    if not isinstance(food, Food):
        return FoodFacts(name="none")
    shape, size = shape_facts(food)
    return dc.replace(
        facts,
        shape=facts.shape if size is None else shape,
        size=size,
        peeled=prepared.peeled,
        position=scenario.X_WF().translation().tolist(),
        yaw=scenario.placement.yaw,
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
    out = NominalMotion(phases=phases)
    labels = np.array([motion.phase_at(t) for t in time])
    in_knife = np.einsum("nji,nj->ni", R, v)
    slicing = (labels == "slice") & (in_knife[:, 2] > 1e-5)
    if slicing.any():
        press = float(np.median(in_knife[slicing, 2]))
        out.speed = round(press, 6)
        out.draw_ratio = round(float(np.median(in_knife[slicing, 0])) / press, 4)
    return out
