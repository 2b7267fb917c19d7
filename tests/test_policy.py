"""The policy's system: when it decides, what it sees, and what it may do at most."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.motion import Motion, Pose
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.resources import resource_path
from sliceit_drake.systems.policy import (
    PolicyAction,
    PolicyConfig,
    PolicyObservation,
    PolicySystem,
    PressByForce,
)

START = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.1, 0.2, 0.3])
STIFFNESS, GAINS = np.arange(6.0), 10.0 + np.arange(6.0)
SPRING = resource_path("scenarios/cucumber_spring.yaml")
POLICY = resource_path("scenarios/cucumber_policy.yaml")


class Scripted:
    """Gives the actions of a list, one after the other by the time, and notes what it saw."""

    def __init__(self, *actions):
        self.actions, self.seen = actions, []

    def decide(self, observation):
        self.seen.append(observation)
        return self.actions[min(round(observation.time / 0.05), len(self.actions) - 1)]


def system_of(policy, **config):
    config = PolicyConfig(decide=policy, **({"press": 0.02, "draw": 0.01} | config))
    system = PolicySystem(config, START, STIFFNESS, GAINS)
    simulator = Simulator(system)
    system.GetInputPort("sensor_wrench").FixValue(
        simulator.get_mutable_context(), SpatialForce([1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
    )
    return system, simulator


def offset_at(system, simulator, time):
    simulator.AdvanceTo(time)
    return system.GetOutputPort("target_offset").Eval(simulator.get_context())


def test_it_decides_at_its_period_and_the_target_follows_with_its_acceleration():
    policy = Scripted(PolicyAction(0.0, 0.02), PolicyAction(0.0, 0.02), PolicyAction(0.0, 0.0))
    system, simulator = system_of(policy)
    # Up to 20 mm/s in 40 ms, on until 0.1 s, and down in 40 ms.
    for time, press in ((0.02, 0.0001), (0.04, 0.0004), (0.1, 0.0016), (0.3, 0.0020)):
        assert offset_at(system, simulator, time) == pytest.approx([0.0, press], abs=1e-12)
    pose = system.GetOutputPort("target_pose").Eval(simulator.get_context())
    assert pose.translation() == pytest.approx([0.1, 0.2, 0.3 - 0.002])
    assert np.array_equal(pose.rotation().matrix(), START.rotation().matrix())
    assert [o.time for o in policy.seen] == pytest.approx(np.arange(len(policy.seen)) * 0.05)


def test_it_sees_the_last_wrenches_the_newest_last():
    policy = Scripted(PolicyAction(0.0, 0.0))
    system, simulator = system_of(policy, history=3)
    simulator.AdvanceTo(0.06)
    wrench = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert policy.seen[1].wrenches == pytest.approx(np.array([[0.0] * 6, wrench, wrench]))


def test_the_target_stays_within_the_bounds_whatever_is_decided():
    policy = Scripted(*[PolicyAction(1.0, 1.0)] * 20, *[PolicyAction(-1.0, -1.0)] * 60)
    system, simulator = system_of(policy)
    offsets = np.array([offset_at(system, simulator, t) for t in np.arange(0.0, 3.0, 0.01)])
    assert offsets.max(axis=0) == pytest.approx([0.01, 0.02])
    assert offsets.min(axis=0) == pytest.approx([-0.01, 0.0])
    assert np.linalg.norm(np.diff(offsets, axis=0), axis=1).max() <= 0.05 * 0.01 * (1 + 1e-9)


def test_stiffness_and_gains_are_the_configured_ones_where_it_leaves_them_alone():
    policy = Scripted(PolicyAction(0.0, 0.0, stiffness=np.ones(6)), PolicyAction(0.0, 0.0))
    system, simulator = system_of(policy)
    for time, stiffness in ((0.04, np.ones(6)), (0.09, STIFFNESS)):
        simulator.AdvanceTo(time)
        context = simulator.get_context()
        assert np.array_equal(system.GetOutputPort("stiffness").Eval(context), stiffness)
        assert np.array_equal(system.GetOutputPort("p_gains").Eval(context), GAINS)


@pytest.mark.parametrize(
    ("decision", "message"),
    [
        (PolicyAction(0.0, np.nan), "policy: at t = 0 s the policy decided for speeds"),
        (None, "policy: at t = 0 s Scripted.decide returned None"),
        (PolicyAction(0.0, 0.0, stiffness=np.ones(2)), "the policy's stiffness are"),
    ],
)
def test_a_decision_that_is_none_stops_the_run_and_names_the_system(decision, message):
    builder = DiagramBuilder()
    config = PolicyConfig(decide=Scripted(decision))
    policy = builder.AddNamedSystem("policy", PolicySystem(config, START, STIFFNESS, GAINS))
    builder.ExportInput(policy.GetInputPort("sensor_wrench"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    diagram.get_input_port(0).FixValue(simulator.get_mutable_context(), SpatialForce.Zero())
    with pytest.raises(RuntimeError, match=message):
        simulator.AdvanceTo(0.1)


def test_it_presses_slower_against_a_force_and_turns_round_beyond():
    policy = PressByForce(fastest=0.02, force=10.0, cut_time=1.0, lift_speed=0.03)

    def press(force, time=0.5):
        wrenches = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, force], (3, 1))
        return policy.decide(PolicyObservation(time, np.zeros(2), wrenches)).press

    assert [press(f) for f in (0.0, 5.0, 10.0, 20.0)] == pytest.approx([0.02, 0.01, 0.0, -0.02])
    assert press(0.0, time=1.0) == -0.03


def test_its_envelope_reaches_all_corners_in_the_duration_of_the_run():
    config = PolicyConfig(press=0.03, draw=0.01, duration=4.0)
    motion = Motion(config.envelope(), Pose(np.eye(3), np.zeros(3)))
    assert motion.duration == pytest.approx(4.0)
    _, p, _, _ = motion.sample(np.linspace(0.0, 4.0, 2001))
    for corner in ((0.01, 0.03), (-0.01, 0.03), (-0.01, 0.0), (0.01, 0.0)):
        assert np.abs(p[:, [0, 2]] - corner).max(axis=1).min() < 1e-4
    with pytest.raises(ConfigurationError, match="duration"):
        load_scenario(POLICY, "{policy: {duration: 0.1}}")


def test_a_scenario_with_a_policy_has_no_motion_beside_it():
    with pytest.raises(ConfigurationError, match=r"scenario\.motion"):
        load_scenario(SPRING, "{policy: {}}")


def test_a_scenario_runs_by_a_policy_and_its_record_has_the_target_of_the_run():
    overrides = """{food: !AnalyticFood {stiffness: 3.0e+3}, start: {clearance: 0.002},
      policy: {duration: 1.4, draw: 0.0, decide: {draw_ratio: 0.0, cut_time: 0.8}}}"""
    run = prepare_run(load_scenario(POLICY, overrides))
    run.advance()
    record = run.record()
    depth = record["target_pose_p_z"][0] - record["target_pose_p_z"]
    assert depth[0] == 0.0 and 0.01 < depth.max() < 0.03 * 0.8
    assert depth[-1] == pytest.approx(0.0, abs=1e-3), "it lifts at the end"
    knife = record["knife_pose_p_z"][0] - record["knife_pose_p_z"]
    assert np.abs(knife - depth).max() < 0.006
    # Slower in the food than in the air, where the sensor feels the tool's inertia alone.
    speed = np.gradient(depth, record["time"])
    assert speed[40] == pytest.approx(0.03, rel=0.01) and speed[350] < 0.85 * 0.03


def test_the_summary_of_a_policys_run_estimates_no_error_on_a_motion_that_was_not_run(tmp_path):
    overrides = """{food: {shape: !Cylinder {rings: 2, layers: [0.0, 0.006, 0.0125]}},
      policy: {press: 0.001, draw: 0.0, duration: 0.05}}"""
    run = prepare_run(load_scenario(POLICY, overrides))
    run.advance()
    assert run.stopped is None
    summary = run.save(tmp_path)
    assert summary["elements"] > 0 and summary["discretization_error"] is None
    (warning,) = summary["warnings"]
    assert "not cut through: 0 %" in warning and "policy.duration" in warning
