"""Bodies that must not meet: tool, arm, board, table and holder."""

import numpy as np
import pytest
from fake_station import CONFIG

from sliceit_drake.diagrams.hardware_station import make_clearance, make_edge_kinematics
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.station import MakeStation
from sliceit_drake.hardware.hardware_config import HardwareConfig, SafetyLimits
from sliceit_drake.resources import resource_path
from sliceit_drake.robot_run.plan_check import check_plan, plan_joints


@pytest.fixture(scope="module")
def twin():
    small = "{food: {shape: {rings: 2, layers: [0.0, 0.006, 0.0095, 0.012]}}}"
    return MakeStation(load_scenario(resource_path("scenarios/cucumber_measured.yaml"), small))


@pytest.fixture(scope="module")
def clearance(twin):
    return make_clearance(twin)


def test_the_distance_to_the_holder_is_what_the_arm_moves(twin, clearance):
    # The holder's jaws are beside the plane of the cut, along Fy.
    away = twin.scenario.X_WF().rotation().matrix()[:, 1]
    kinematics, start = make_edge_kinematics(twin), twin.start_joints
    distance, bodies = clearance.nearest(start, 0.1)
    assert bodies.startswith("edge and holder jaw")
    turned = start + [0.005, 0.0, 0.0, 0.0, 0.0, 0.0]
    tip, moved = (np.array(kinematics.edge(q).tip) for q in (start, turned))
    nearer, _ = clearance.nearest(turned, 0.1)
    assert distance - nearer == pytest.approx((moved - tip) @ away, abs=1e-3)
    assert nearer - distance > 2e-3


def test_the_tool_is_found_near_the_arm_and_the_gripper_at_the_board(twin, clearance):
    folded = twin.start_joints + [0.0, -0.5, 0.0, 1.75, 0.0, 0.0]
    distance, bodies = clearance.nearest(folded, 0.05)
    assert distance < 0.0 and bodies == "upper arm and edge"
    low = twin.start_joints + [0.0, 0.25, 0.0, 0.0, 0.0, 0.0]
    assert clearance.nearest(low, 0.0)[0] < 0.0


def test_the_edge_may_come_to_the_board(twin, clearance):
    plan = plan_joints(twin)
    lowest = min(plan.q, key=lambda q: make_edge_kinematics(twin).edge(q.tolist()).heel[2])
    found = clearance.nearest(lowest, 0.02)
    assert found is None or "edge and board" not in found[1]


def test_a_plan_that_comes_too_near_is_refused(twin):
    plan = plan_joints(twin)

    def check(limits):
        config = HardwareConfig(**(CONFIG | {"limits": limits}))
        return next(c for c in check_plan(plan, twin, config, None) if c.name == "clearance")

    assert check(SafetyLimits()).passed
    refused = check(SafetyLimits(clearance=0.015))
    assert not refused.passed and "gripper and holder jaw" in refused.found
