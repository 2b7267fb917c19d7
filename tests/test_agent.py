"""The SliceIt! agent's system: what it observes, and what its six numbers do."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from sliceit_drake.configuration import ConfigurationError, validate
from sliceit_drake.systems.agent import ACTIONS, AgentConfig, AgentSystem, observation_names
from sliceit_drake.systems.agent_rule import AgentRule
from sliceit_drake.systems.motion_sources import placed_motion

START = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.1, 0.2, 0.3])
STIFFNESS, GAINS = 10.0 + np.arange(6.0), 20.0 + np.arange(6.0)
NO_WRENCH = np.zeros(6)
T = 0.05


class Knife(LeafSystem):
    """A knife on a given path, and what its sensor reads.

    Args:
        place: From time to [x, z, angle about Ky], from the start.
        wrench: From time to moment and force at So, in S [6].
    """

    def __init__(self, place, wrench):
        super().__init__()

        def pose(context, output):
            x, z, angle = place(context.get_time())
            turn = RotationMatrix.MakeYRotation(angle)
            output.set_value(START @ RigidTransform(turn, [x, 0.0, z]))

        def force(context, output):
            read = np.asarray(wrench(context.get_time()), float)
            output.set_value(SpatialForce(read[:3], read[3:]))

        self.DeclareAbstractOutputPort("knife_pose", lambda: Value(RigidTransform()), pose)
        self.DeclareAbstractOutputPort("sensor_wrench", lambda: Value(SpatialForce.Zero()), force)


class Follower(LeafSystem):
    """A knife that goes a quarter of its way to the target each 10 ms, and is pushed back."""

    def __init__(self):
        super().__init__()
        self._target = self.DeclareVectorInputPort("target", 2)
        place = self._place = self.DeclareDiscreteState(2)
        ticket = {self.discrete_state_ticket(place)}
        self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, self._update)
        self.DeclareAbstractOutputPort(
            "knife_pose", lambda: Value(RigidTransform()), self._pose, ticket
        )
        self.DeclareAbstractOutputPort(
            "sensor_wrench", lambda: Value(SpatialForce.Zero()), self._force, ticket
        )

    def _update(self, context, state):
        place = context.get_discrete_state(self._place).value()
        state.set_value(self._place, place + 0.25 * (self._target.Eval(context) - place))

    def _pose(self, context, output):
        x, z = context.get_discrete_state(self._place).value()
        output.set_value(START @ RigidTransform([x, 0.0, z]))

    def _force(self, context, output):
        x, z = context.get_discrete_state(self._place).value()
        output.set_value(SpatialForce([0.0, 0.1, 0.0], [30.0 * x, 0.0, 500.0 * max(z, 0.0)]))


def at_rest(x=0.0, z=0.0, angle=0.0):
    return lambda time: (x, z, angle)


def agent_of(place, config=None, wrench=None, X_KS=None, decide=lambda _: np.zeros(6), knife=None):
    """A simulator of an agent beside a knife, and the agent."""
    builder = DiagramBuilder()
    knife = builder.AddSystem(knife or Knife(place, wrench or (lambda _: NO_WRENCH)))
    agent = builder.AddNamedSystem(
        "agent",
        AgentSystem(
            config or AgentConfig(), START, X_KS or RigidTransform(), STIFFNESS, GAINS, decide
        ),
    )
    for name in ("knife_pose", "sensor_wrench"):
        builder.Connect(knife.GetOutputPort(name), agent.GetInputPort(name))
    if isinstance(knife, Follower):
        builder.Connect(agent.GetOutputPort("target_offset"), knife.GetInputPort("target"))
    if decide is None:
        builder.ExportInput(agent.GetInputPort("action"), "action")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    if decide is not None:
        simulator.Initialize()
    return simulator, agent


def out(simulator, agent, name, context=None):
    root = context or simulator.get_context()
    value = agent.GetOutputPort(name).Eval(agent.GetMyContextFromRoot(root))
    return value.copy() if isinstance(value, np.ndarray) else value


def observed(simulator, agent, config=None):
    """The observation as a dictionary."""
    names = observation_names((config or AgentConfig()).history)
    return dict(zip(names, out(simulator, agent, "observation"), strict=True))


def part(observation, name):
    return np.array([observation[f"{name}_{axis}"] for axis in ("x", "z", "ry")])


def test_an_observation_has_the_order_of_sliceit():
    names = observation_names(3)
    assert names[:9] == [
        f"{p}_{a}" for p in ("error", "velocity", "jerk") for a in ("x", "z", "ry")
    ]
    assert names[9:15] == [f"last_{name}" for name in ACTIONS]
    assert names[15:17] == ["target_x", "target_z"]
    assert names[17:19] == ["near", "at_goal"]
    assert names[19:22] == ["force_x_-2", "force_z_-2", "moment_y_-2"]
    assert names[-3:] == ["force_x_0", "force_z_0", "moment_y_0"]
    assert AgentConfig(history=3).observation_size() == len(names) == 28


def test_the_error_is_that_to_the_final_pose_in_sliceits_scale():
    simulator, agent = agent_of(at_rest(0.02, 0.007, 0.1))
    error = [-0.02, 0.037 - 0.007, -0.1]
    assert out(simulator, agent, "error") == pytest.approx(error, abs=1e-12)
    scaled = part(observed(simulator, agent), "error")
    assert scaled == pytest.approx(np.array(error) / [0.1, 0.06, 0.785], abs=1e-12)


@pytest.mark.parametrize(
    ("v", "a", "j"),
    [
        ([0.03, 0.05, 0.2], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.0, 0.02, 0.0], [0.3, 0.4, -0.5], [0.0, 0.0, 0.0]),
        ([0.01, -0.02, 0.1], [0.1, 0.2, 0.3], [20.0, -30.0, 10.0]),
    ],
)
def test_velocity_and_jerk_are_differences_of_the_last_decisions(v, a, j):
    v, a, j = np.array(v), np.array(a), np.array(j)
    simulator, agent = agent_of(lambda t: v * t + a * t**2 / 2 + j * t**3 / 6)
    simulator.AdvanceTo(4 * T)
    observation, t = observed(simulator, agent), 4 * T
    difference = v + a * (t - T / 2) + j * (3 * t**2 - 3 * t * T + T**2) / 6
    assert part(observation, "velocity") == pytest.approx(difference / [0.5, 0.5, 0.785], abs=1e-10)
    assert part(observation, "jerk") == pytest.approx(j / 500.0, abs=1e-8)


def test_a_knife_that_rests_beside_its_place_has_no_velocity_and_no_jerk():
    simulator, agent = agent_of(at_rest(0.01, -0.008, 0.02))
    for decisions in range(5):
        simulator.AdvanceTo(decisions * T)
        observation = observed(simulator, agent)
        assert part(observation, "velocity") == pytest.approx(np.zeros(3), abs=1e-12)
        assert part(observation, "jerk") == pytest.approx(np.zeros(3), abs=1e-9)


def test_the_wrench_is_moved_from_the_sensor_to_the_knife():
    X_KS = RigidTransform(
        RotationMatrix.MakeZRotation(0.4) @ RotationMatrix.MakeXRotation(-0.9), [0.02, -0.03, -0.11]
    )
    tau, f = np.array([0.5, -0.4, 0.3]), np.array([3.0, -7.0, 11.0])
    simulator, agent = agent_of(at_rest(), wrench=lambda _: [*tau, *f], X_KS=X_KS)
    R = X_KS.rotation().matrix()
    F_Ko_K = SpatialForce(R @ tau, R @ f).Shift(-X_KS.translation())
    expected = [*F_Ko_K.translational()[[0, 2]], F_Ko_K.rotational()[1]]
    observation = observed(simulator, agent)
    newest = [observation[f"{name}_0"] for name in ("force_x", "force_z", "moment_y")]
    assert newest == pytest.approx(np.array(expected) / [50.0, 50.0, 10.0], abs=1e-12)
    simulator.AdvanceTo(1.0)
    assert out(simulator, agent, "wrench") == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("history", [1, 2, 12])
def test_readings_are_a_reading_period_apart_the_newest_last(history):
    config = AgentConfig(history=history)
    simulator, agent = agent_of(
        at_rest(), config, wrench=lambda t: [0.0, t, 0.0, 100.0 + t, 0.0, 1.0 + t]
    )
    simulator.AdvanceTo(0.2)
    seen = out(simulator, agent, "observation")[19:].reshape(history, 3)
    times = 0.2 - 0.01 * np.arange(history)[::-1]
    expected = np.stack([100.0 + times, 1.0 + times, times], axis=1)
    assert seen == pytest.approx(expected / [50.0, 50.0, 10.0], abs=1e-10)
    assert out(simulator, agent, "wrench") == pytest.approx(expected.mean(axis=0), abs=1e-10)


def test_before_the_start_all_readings_are_zero():
    simulator, agent = agent_of(at_rest(), wrench=lambda _: np.ones(6))
    seen = out(simulator, agent, "observation")[19:].reshape(12, 3)
    assert np.all(seen[:-1] == 0.0) and np.all(seen[-1] > 0.0)


@pytest.mark.parametrize(
    ("mapping", "action", "share"),
    [
        ("whole", -1.0, 0.0),
        ("whole", 0.0, 0.5),
        ("whole", 0.5, 0.75),
        ("whole", 1.0, 1.0),
        ("whole", 7.0, 1.0),
        ("upper", -1.0, 0.0),
        ("upper", 0.0, 0.0),
        ("upper", 0.5, 0.5),
        ("upper", 1.0, 1.0),
    ],
)
def test_four_actions_choose_within_their_ranges_and_leave_the_rest_alone(mapping, action, share):
    config = AgentConfig(mapping=mapping)
    simulator, agent = agent_of(at_rest(), config, decide=lambda _: np.array([action] * 4 + [0, 0]))
    simulator.AdvanceTo(0.01)
    stiffness, gains = STIFFNESS.copy(), GAINS.copy()
    stiffness[[0, 4]] = 1000.0 + share * 9000.0, 40.0 + share * 160.0
    gains[[2, 4]] = 0.02 + share * 0.08, 0.2 + share * 2.8
    assert out(simulator, agent, "stiffness") == pytest.approx(stiffness, rel=1e-12)
    assert out(simulator, agent, "p_gains") == pytest.approx(gains, rel=1e-12)


def test_before_the_first_decision_the_controllers_own_gains_hold():
    simulator, agent = agent_of(at_rest())
    assert np.array_equal(out(simulator, agent, "stiffness"), STIFFNESS)
    assert np.array_equal(out(simulator, agent, "p_gains"), GAINS)
    assert out(simulator, agent, "target_offset") == pytest.approx([0.0, 0.0])


def test_the_target_moves_by_each_decision_as_far_as_it_may_and_is_aimed_at_by_its_lead():
    config = AgentConfig(draw=0.005, overtravel=0.003)
    actions = iter([np.array([0, 0, 0, 0, d, p]) for d, p in 4 * [(1, 0.5)] + 9 * [(-1, -1)]])
    simulator, agent = agent_of(at_rest(0.001, 0.002), config, decide=lambda _: next(actions))
    for k in range(13):
        simulator.AdvanceTo(k * T + 0.01)
        if k < 4:
            draw, press = min(0.002 * (k + 1), 0.005), min(0.001 * (k + 1), 0.003)
        else:
            draw, press = max(0.005 - 0.002 * (k - 3), -0.005), max(0.003 - 0.002 * (k - 3), 0.0)
        place, final = np.array([0.001, 0.002]), np.array([draw, 0.037 + press])
        target = place + 0.8 * (final - place)
        assert out(simulator, agent, "target_offset") == pytest.approx(target, abs=1e-12)
        X_WK = out(simulator, agent, "target_pose")
        assert X_WK.IsNearlyEqualTo(START @ RigidTransform([target[0], 0.0, target[1]]), 1e-12)
        observation = observed(simulator, agent, config)
        reached = [observation["target_x"], observation["target_z"]]
        assert reached == pytest.approx([draw / 0.005, press / 0.003], abs=1e-12)
        assert observation["last_draw"] == (1.0 if k < 4 else -1.0)


def test_a_network_corrects_the_rule_by_what_it_may():
    rule = AgentRule(10.0, gain=1.0, softness=0.5, reach=0.5, correction=0.25)
    config = AgentConfig(rule=rule)
    found = {}
    for name, action in (("rule", np.zeros(6)), ("both", np.array([1, -1, 1, 0.4, -1, -1.0]))):
        # It feels 8 N, and is 30 mm over the board.
        simulator, agent = agent_of(
            at_rest(0.0, 0.007),
            config,
            wrench=lambda _: [0, 0, 0, 0, 0, -8.0],
            decide=lambda _, a=action: a,
        )
        simulator.AdvanceTo(0.21)
        last = observed(simulator, agent)
        found[name] = np.array([last[f"last_{each}"] for each in ACTIONS])
    assert found["rule"] == pytest.approx([1.0, 0.0, 0.7, 0.0, 1.0, 0.2])
    assert found["both"] == pytest.approx([1.0, -0.25, 0.95, 0.1, 0.75, -0.05])


def test_the_rule_presses_harder_while_the_knife_comes_no_lower():
    def place(time):
        """On its way down it stays from 1 to 2 s, up and down by 0.1 mm, as where a draw turns."""
        stays = min(max(time - 1.0, 0.0), 1.0)
        return 0.0, 0.01 * (time - stays) + 1e-4 * np.sin(30.0 * stays), 0.0

    rule = AgentRule(10.0, gain=1.0, softness=0.0, reach=0.0, approach=0.0, patience=0.5)
    simulator, agent = agent_of(
        place, AgentConfig(rule=rule), wrench=lambda _: [0, 0, 0, 0, 0, -5.0]
    )
    presses = {}
    for time in (0.9, 1.53, 1.98, 2.4):
        simulator.AdvanceTo(time)
        presses[time] = observed(simulator, agent)["last_press"]
    # It has waited for half a second, which doubles the level, and for nearly one.
    level = {0.9: 10.0, 1.53: 20.0, 1.98: 29.0, 2.4: 10.0}
    assert presses == {t: pytest.approx(1.0 - 5.0 / N, abs=0.03) for t, N in level.items()}


def test_an_action_beyond_its_range_counts_as_the_nearest_within():
    simulator, agent = agent_of(at_rest(), decide=lambda _: np.array([0, 0, 0, 0, 5.0, -3.0]))
    simulator.AdvanceTo(0.01)
    observation = observed(simulator, agent)
    assert (observation["last_draw"], observation["last_press"]) == (1.0, -1.0)
    assert observation["target_x"] == pytest.approx(0.002 / 0.035)


@pytest.mark.parametrize(
    ("place", "distance"), [((0.003, 0.033), 0.005), ((0.0, 0.037), 0.0), ((0.0, 0.0), 0.037)]
)
def test_the_error_scale_grows_towards_the_final_pose(place, distance):
    simulator, agent = agent_of(at_rest(*place))
    simulator.AdvanceTo(0.01)
    expected = 0.15 + (0.25 - 0.15) * (1.0 - np.tanh(100.0 * distance))
    assert out(simulator, agent, "error_scale") == pytest.approx([expected], abs=1e-12)


def test_a_slice_ends_after_more_than_so_many_decisions_at_the_goal_and_the_knife_is_lifted():
    config = AgentConfig(goal_decisions=3, lift_speed=0.1)
    times = []

    def decide(_):
        times.append(len(times) * T)
        return np.zeros(6)

    simulator, agent = agent_of(at_rest(0.004, 0.0369), config, decide=decide)
    for k in range(4):
        simulator.AdvanceTo(k * T + 0.01)
        assert out(simulator, agent, "at_goal") == [k + 1]
        assert agent.is_done(agent.GetMyContextFromRoot(simulator.get_context())) == (k == 3)
    # It goes up from where the knife was at t = 0.15 s, and stays at the start's height.
    for time, down in ((0.165, 0.0354), (0.17, 0.0349), (0.35, 0.0169), (0.6, 0.0)):
        simulator.AdvanceTo(time)
        assert out(simulator, agent, "target_offset") == pytest.approx([0.004, down], abs=1e-12)
        X_WK = out(simulator, agent, "target_pose")
        assert X_WK.IsNearlyEqualTo(START @ RigidTransform([0.004, 0.0, down]), 1e-12)
    assert len(times) == 4


@pytest.mark.parametrize(("risen", "counts"), [(0.007, (1, 2, 0, 1, 2)), (5e-4, (1, 2, 2, 3, 3))])
def test_decisions_at_the_goal_count_anew_after_a_lift_and_not_where_a_draw_turns(risen, counts):
    def place(time):
        return (0.0, 0.037 - risen if 0.075 < time < 0.125 else 0.037, 0.0)

    simulator, agent = agent_of(place, AgentConfig(goal_decisions=2))
    for k, count in enumerate(counts):
        simulator.AdvanceTo(k * T + 0.01)
        assert out(simulator, agent, "at_goal") == [count]
        assert observed(simulator, agent)["at_goal"] == 0.5 * count


def test_decisions_at_the_goal_count_anew_beside_it():
    simulator, agent = agent_of(lambda time: (0.05 if 0.075 < time < 0.125 else 0.0, 0.037, 0.0))
    for k, count in enumerate((1, 2, 0, 1)):
        simulator.AdvanceTo(k * T + 0.01)
        assert out(simulator, agent, "at_goal") == [count]


@pytest.mark.parametrize(("height", "near"), [(0.03, 1.0), (1e-3, 0.5), (-1e-4, -0.05)])
def test_the_last_millimetres_are_seen_on_a_scale_of_their_own(height, near):
    simulator, agent = agent_of(at_rest(0.0, 0.037 - height))
    simulator.AdvanceTo(0.01)
    assert observed(simulator, agent)["near"] == pytest.approx(near, abs=1e-9)


@pytest.mark.parametrize(
    ("place", "is_near"),
    [
        ((0.0, 0.0369, 0.0), True),
        ((0.0, 0.0367, 0.0), False),
        ((0.0, 0.0390, 0.0), True),  # A board gives.
        ((0.041, 0.037, 0.0), False),
        ((-0.041, 0.037, 0.0), False),
        ((0.0, 0.037, 0.041), False),
        ((0.039, 0.037, -0.039), True),
    ],
)
def test_the_goal_is_the_cut_through_food(place, is_near):
    simulator, agent = agent_of(at_rest(*place))
    simulator.AdvanceTo(0.01)
    assert out(simulator, agent, "at_goal") == [float(is_near)]


@pytest.mark.parametrize("action", [[0, 0, np.nan, 0, 0, 0], [np.inf, 0, 0, 0, 0, 0], [0.0] * 5])
def test_an_action_that_is_none_ends_the_run_and_names_the_time(action):
    answers = iter([np.zeros(6), np.zeros(6), np.array(action)])
    simulator, _ = agent_of(at_rest(), decide=lambda _: next(answers))
    with pytest.raises(RuntimeError, match=r"agent: at t = 0\.1 s the policy decided for"):
        simulator.AdvanceTo(0.2)


def test_two_contexts_of_one_agent_do_not_disturb_each_other():
    simulator, agent = agent_of(at_rest(), decide=None, knife=Follower())
    diagram = simulator.get_system()

    def run(other=None):
        context = diagram.CreateDefaultContext()
        diagram.GetInputPort("action").FixValue(context, [0.1, 0.2, 0.3, 0.4, 0.7, 0.9])
        one, seen = Simulator(diagram, context), []
        for k in range(1, 8):
            one.AdvanceTo(k * T)
            if other is not None:
                other.AdvanceTo(k * T)
            seen.append(out(one, agent, "observation", one.get_context()))
        return np.array(seen)

    alone = run()
    context = diagram.CreateDefaultContext()
    diagram.GetInputPort("action").FixValue(context, [-1.0, 1.0, -1.0, 1.0, -1.0, 0.2])
    assert np.array_equal(alone, run(Simulator(diagram, context)))


def test_decisions_through_the_port_and_within_give_the_same_bit_for_bit():
    weights = np.random.default_rng(3).normal(size=(6, AgentConfig().observation_size()))

    def decide(observation):
        return np.tanh(weights @ observation)

    names = ("observation", "target_offset", "stiffness", "p_gains", "error_scale", "error")

    def row(simulator, agent):
        return np.concatenate([out(simulator, agent, name) for name in names])

    within, agent = agent_of(None, decide=decide, knife=Follower())
    port, other = agent_of(None, decide=None, knife=Follower())
    action = port.get_system().GetInputPort("action")
    action.FixValue(port.get_mutable_context(), np.zeros(6))
    port.Initialize()
    for k in range(1, 30):
        action.FixValue(port.get_mutable_context(), decide(out(port, other, "observation")))
        within.AdvanceTo(k * T)
        port.AdvanceTo(k * T)
        assert np.array_equal(row(within, agent), row(port, other))
    assert np.ptp(row(within, agent)[:19]) > 0.1


def test_watch_is_entered_around_each_decision():
    inside = []

    class Watch:
        def __enter__(self):
            inside.append("in")

        def __exit__(self, *_):
            inside.append("out")

    def decide(_):
        inside.append("decide")
        return np.zeros(6)

    simulator, agent = agent_of(at_rest(), decide=decide)
    agent.watch = Watch
    simulator.AdvanceTo(0.06)
    assert inside == 2 * ["in", "decide", "out"]


def test_the_envelope_goes_through_all_corners_and_no_farther_in_the_runs_duration():
    config = AgentConfig(draw=0.02, descent=0.03, duration=6.0)
    motion = placed_motion(config.envelope(), START)
    assert motion.duration == pytest.approx(6.0, abs=1e-9)
    poses = [
        START.inverse() @ RigidTransform(RotationMatrix(p.R), p.p)
        for p in (motion.pose(t) for t in np.linspace(0.0, 6.0, 601))
    ]
    places = np.array([X.translation() for X in poses])
    assert places.min(axis=0) == pytest.approx([-0.02, 0.0, 0.0], abs=1e-9)
    assert places.max(axis=0) == pytest.approx([0.02, 0.0, 0.03], abs=1e-9)
    for corner in ((0.02, 0.03), (-0.02, 0.03), (0.02, 0.0), (-0.02, 0.0)):
        assert np.hypot(*(places[:, [0, 2]] - corner).T).min() < 5e-4


@pytest.mark.parametrize(
    ("values", "field", "fix"),
    [
        ({"reading_period": 0.03}, "agent.reading_period", "whole number"),
        ({"reading_period": 0.1}, "agent.reading_period", "whole number"),
        ({"stiffness_x": [5000.0, 1000.0]}, "agent.stiffness_x", "Swap"),
        ({"p_ry": [3.0, 0.2]}, "agent.p_ry", "Swap"),
        ({"duration": 1.0}, "agent.duration", "Lengthen"),
        ({"goal": [0.04, 2e-4]}, "agent.goal", "3 values"),
        ({"lead": 1.5}, "agent.lead", "within"),
        ({"mapping": "lower"}, "agent.mapping", "whole"),
    ],
)
def test_a_wrong_value_is_named_with_its_fix(values, field, fix):
    validate(AgentConfig(), "agent")
    with pytest.raises(ConfigurationError) as caught:
        validate(AgentConfig(**values), "agent")
    assert caught.value.field == field
    assert fix in str(caught.value)
