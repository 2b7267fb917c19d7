"""The station as a Gymnasium environment: what repeats, how an episode ends, what is rewarded."""

import copy
import dataclasses as dc
import pickle

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from sliceit_drake.configuration import ConfigurationError, validate  # noqa: E402
from sliceit_drake.cutting.foods.calibrated_food import load_calibrated_food  # noqa: E402
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver  # noqa: E402
from sliceit_drake.diagrams.outputs import animation  # noqa: E402
from sliceit_drake.diagrams.scenario import Start  # noqa: E402
from sliceit_drake.learning.environment import SlicingEnv  # noqa: E402
from sliceit_drake.learning.reward import (  # noqa: E402
    TERMS,
    RewardConfig,
    failed_potential,
    reward_potential,
    reward_terms,
    reward_weights,
)
from sliceit_drake.learning.task import RandomizationConfig, TaskConfig, make_agent_station  # noqa: E402
from sliceit_drake.systems.agent import AgentConfig  # noqa: E402
from sliceit_drake.systems.agent_rule import AgentRule  # noqa: E402
from sliceit_drake.systems.wrench_sensor import WrenchSensorConfig  # noqa: E402

PRESS = np.array([0.2, 0.1, 1.0, 0.3, 0.4, 1.0])


def task_of(simulator="spring", agent=None, randomization=None, **values):
    """A cheap task whose knife is at the food after a few decisions."""
    values = {"foods": ["cucumber"], "refinement": 0.5, "start": Start(clearance=0.003)} | values
    return TaskConfig(
        simulator=simulator,
        agent=AgentConfig(history=3, **(agent or {})),
        randomization=RandomizationConfig(
            **({"variants": 2, "height": [0.0, 0.001]} | (randomization or {}))
        ),
        **values,
    )


def rollout(env, steps, seed=None):
    """Observations and rewards of an episode with actions of their own seed."""
    observation, _ = env.reset(seed=seed)
    rng, seen = np.random.default_rng(5), [observation]
    for _ in range(steps):
        action = np.clip(PRESS + rng.uniform(-0.5, 0.5, 6), -1.0, 1.0)
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append(np.append(observation, reward))
        if terminated or truncated:
            break
    return np.concatenate(seen)


@pytest.fixture(scope="module")
def spring():
    return SlicingEnv(task_of())


def test_it_is_an_environment_as_gymnasium_has_them():
    check_env(SlicingEnv(task_of()), skip_render_check=True)


NAME = "sliceit_drake.learning:sliceit_drake/Slicing-v0"


def test_it_is_registered():
    env = gymnasium.make(NAME, task=task_of())
    assert isinstance(env.unwrapped, SlicingEnv)
    observation, info = env.reset(seed=0)
    assert observation.shape == (28,) and info == {"food": "cucumber"}


@pytest.mark.parametrize("food", ["apple", "carrot", "cucumber", "potato", "tomato"])
def test_each_calibrated_food_has_a_name_of_its_own(food):
    name = NAME.replace("Slicing-", f"Slicing{food.title()}-")
    assert gymnasium.make(name, simulator="spring").unwrapped.task == TaskConfig("spring", [food])


def test_the_station_of_a_name_is_drawn_and_a_guest_of_vector_environments():
    vector = gymnasium.make_vec(NAME, 2, vectorization_mode="sync", task=task_of())
    first, _ = vector.reset(seed=3)
    alone = [gymnasium.make(NAME, task=task_of()).reset(seed=seed)[0] for seed in (3, 4)]
    np.testing.assert_array_equal(first, alone)
    if not animation.can_draw():
        with pytest.raises(ConfigurationError, match="EGL"):
            gymnasium.make(NAME, task=task_of(), render_mode="rgb_array")
        return
    env = gymnasium.make(NAME, task=task_of(), render_mode="rgb_array")
    check_env(env.unwrapped)
    env.reset(seed=0)
    before = env.render()
    for _ in range(8):
        env.step(PRESS)
    after = env.render()
    assert before.shape == after.shape == (480, 640, 3)
    # The knife has moved, and nothing else; it is not most of the picture.
    changed = (before != after).any(axis=2).mean()
    assert 0.005 < changed < 0.5


def test_a_wrong_simulator_is_refused():
    with pytest.raises(ConfigurationError, match=r"task\.simulator"):
        SlicingEnv(simulator="springs")


@pytest.mark.parametrize("copied", [lambda env: pickle.loads(pickle.dumps(env)), copy.deepcopy])
def test_a_copy_goes_on_from_the_same_moment(copied):
    env = SlicingEnv(task_of())
    rollout(env, 3, seed=5)
    other = copied(env)
    assert other.task == env.task
    for _ in range(2):
        (found, *rest), (expected, *others) = other.step(PRESS), env.step(PRESS)
        np.testing.assert_array_equal(found, expected)
        assert rest == others
    np.testing.assert_array_equal(env.reset()[0], other.reset()[0])
    copied(SlicingEnv(task_of()))  # Without an episode there is nothing to repeat.


@pytest.mark.parametrize("simulator", ["spring", "cutting"])
def test_a_seed_fixes_an_episode_whatever_came_before(simulator):
    task, steps = task_of(simulator), 12
    used, fresh = SlicingEnv(task), SlicingEnv(task)
    first = rollout(used, steps, seed=11)
    others = [rollout(used, steps, seed=seed) for seed in (12, 13, None)]
    again = rollout(used, steps, seed=11)
    assert np.array_equal(first, again)
    assert np.array_equal(first, rollout(fresh, steps, seed=11))
    assert all(not np.array_equal(first, other) for other in others)
    # The knife has met the food.
    force = used._output("food_wrench_vector")[3:] + used._output("board_wrench_vector")[3:]
    assert np.ptp(first.reshape(-1)[-27:-1]) > 0.0 and np.linalg.norm(force) > 0.5


def test_the_foods_before_do_not_matter_either():
    task = task_of(foods=["cucumber", "potato"])
    used, fresh = SlicingEnv(task), SlicingEnv(task)
    for seed in range(3):
        rollout(used, 2, seed=seed)
    assert np.array_equal(rollout(used, 4, seed=9), rollout(fresh, 4, seed=9))


@pytest.mark.parametrize("options", [None, {"food": "tomato"}])
def test_an_episode_goes_on_from_a_moment_of_it(options):
    env, other = (SlicingEnv(task_of(foods=["cucumber", "tomato"])) for _ in range(2))
    env.reset(seed=3)
    env.reset(options=options)
    actions = np.random.default_rng(5).uniform(-1.0, 1.0, (5, 6))
    seen = [env.step(action)[0] for action in actions[:3]]
    moment = env.moment()
    expected = [env.step(action)[:4] for action in actions[3:]]
    following, info = env.reset()
    other.reset(seed=77)
    assert np.array_equal(other.return_to(moment), seen[-1])
    for action, (observation, *rest) in zip(actions[3:], expected, strict=True):
        found = other.step(action)
        assert np.array_equal(found[0], observation) and list(found[1:4]) == rest
    # And so does all after it.
    again, its = other.reset()
    assert np.array_equal(again, following) and its == info


def test_an_environment_without_an_episode_has_no_moment():
    with pytest.raises(RuntimeError, match="reset"):
        SlicingEnv(task_of()).moment()


def test_the_time_limit_truncates():
    env = SlicingEnv(task_of(decisions=3))
    env.reset(seed=0)
    for k in range(3):
        _, reward, terminated, truncated, info = env.step(np.zeros(6))
        assert (terminated, truncated) == (False, k == 2)
        assert ("end" in info) == (k == 2)
    assert (info["end"], info["is_success"]) == ("time", False)
    assert reward == pytest.approx(weighted(info), abs=1e-6)


def weighted(info, config=None):
    weights = reward_weights(config or RewardConfig())
    return float(weights @ [info["reward_terms"][name] for name in TERMS]) + info["shaping"]


@pytest.mark.parametrize(
    ("values", "end", "bonus"),
    [
        ({"agent": {"goal": [1.0, 1.0, 1.0], "goal_decisions": 0}}, "goal", 15.0),
        ({"workspace": [1.0, 0.001, 1.0]}, "workspace", -15.0),
        ({"force_limit": 0.1}, "force", -15.0),
        ({"torque_limit": 0.1}, "torque", -15.0),
    ],
)
def test_an_end_terminates_with_its_reward(values, end, bonus):
    env = SlicingEnv(task_of(**values))
    env.reset(seed=0)
    for _ in range(40):
        _, reward, terminated, truncated, info = env.step(PRESS)
        if terminated or truncated:
            break
        assert reward == pytest.approx(weighted(info), abs=1e-6)
    assert (terminated, truncated, info["end"]) == (True, False, end)
    assert info["is_success"] == (end == "goal")
    assert reward == pytest.approx(weighted(info) + bonus, abs=1e-6)


def test_a_guard_of_the_simulation_terminates_with_the_reward_of_a_collision(monkeypatch):
    env = SlicingEnv(task_of("cutting"))
    env.reset(seed=0)
    env.step(PRESS)

    def fail(*_):
        raise CuttingError("an element is inverted")

    with monkeypatch.context() as patch:
        patch.setattr(CuttingSolver, "move", fail)
        observation, reward, terminated, truncated, info = env.step(PRESS)
    assert (terminated, truncated, info["end"]) == (True, False, "guard")
    assert info["guard_error"] == "CuttingError"
    assert "an element is inverted" in info["guard_message"]
    assert reward == pytest.approx(weighted(info) - 15.0, abs=1e-6)
    assert np.isfinite(observation).all()
    # The next episode is as if nothing had happened.
    expected = rollout(SlicingEnv(env.task), 3, seed=4)
    assert np.array_equal(rollout(env, 3, seed=4), expected)


def test_each_variant_may_owe_the_work_that_the_task_says():
    station = make_agent_station(TaskConfig(work_error=0.07), "potato", np.random.default_rng(0))
    solvers = station.station.cutting.solvers
    assert {solver.model.numerics.work_error for solver in solvers} == {0.07}


@pytest.mark.parametrize("seed", [6, 117], ids=["tomato", "cucumber"])
def test_sawing_at_random_ends_by_no_guard(seed):
    """The food moves with the knife, and the edge does a little less work than it should."""
    env = SlicingEnv(TaskConfig())
    env.reset(seed=seed)
    rng, ended = np.random.default_rng(seed), False
    while not ended:
        *_, terminated, truncated, info = env.step(rng.uniform(-1.0, 1.0, 6).astype(np.float32))
        ended = terminated or truncated
    assert info["end"] == "goal", info.get("guard_message")


def test_no_variant_is_softer_than_its_mesh_follows():
    task = TaskConfig()
    for which in range(task.randomization.stations):
        station = make_agent_station(task, "tomato", np.random.default_rng(which), which=which)
        for model in (solver.model for solver in station.station.cutting.solvers):
            assert model.skin_fold <= 1.0
            assert model.wide_spread <= model.numerics.edge_spread


def test_any_other_error_ends_the_training(monkeypatch, spring):
    spring.reset(seed=0)

    def fail(*_):
        raise ZeroDivisionError("a bug")

    with monkeypatch.context() as patch:
        patch.setattr("sliceit_drake.systems.spring_cutter.SpringCutter.advance", fail)
        with pytest.raises(ZeroDivisionError, match="a bug"):
            spring.step(PRESS)


@pytest.mark.parametrize("action", [[np.nan] * 6, [0, 0, 0, 0, 0, np.inf], [0.0] * 5])
def test_an_action_that_is_none_is_refused(spring, action):
    spring.reset(seed=0)
    with pytest.raises(ValueError, match="six finite numbers"):
        spring.step(np.array(action))


def test_a_step_without_an_episode_is_refused():
    env = SlicingEnv(task_of(decisions=1))
    with pytest.raises(RuntimeError, match=r"before reset.*call reset"):
        env.step(np.zeros(6))
    with pytest.raises(RuntimeError, match=r"before reset.*call reset"):
        env.render()
    env.reset(seed=0)
    env.step(np.zeros(6))
    # The goal is not paid twice.
    with pytest.raises(RuntimeError, match=r"has ended.*call reset"):
        env.step(np.zeros(6))


def test_starts_are_within_their_ranges_and_fill_them():
    ranges = {"height": [0.001, 0.006], "offset": 0.01, "tilt": 0.02}
    env = SlicingEnv(task_of(randomization=ranges))
    env.reset(seed=0)
    station, simulator = env._current
    descent, errors = station.agent._config.descent, []
    for _ in range(40):
        observation, _ = env.reset()
        errors.append(observation[:3] * [0.1, 0.06, 0.785] - [0.0, descent, 0.0])
        assert observation[3:9] == pytest.approx(np.zeros(6), abs=1e-6)
    low, high = np.min(errors, axis=0), np.max(errors, axis=0)
    wanted_low, wanted_high = np.array([-0.01, 0.001, -0.02]), np.array([0.01, 0.006, 0.02])
    assert np.all(low >= wanted_low - 1e-5) and np.all(high <= wanted_high + 1e-5)
    assert np.all(high - low > 0.8 * (wanted_high - wanted_low))


def test_foods_are_drawn_or_asked_for():
    env = SlicingEnv(task_of(foods=["cucumber", "tomato"]))
    drawn = {env.reset(seed=seed)[1]["food"] for seed in range(8)}
    assert drawn == {"cucumber", "tomato"}
    assert env.reset(seed=0, options={"food": "tomato"})[1] == {"food": "tomato"}
    moment = env.moment()
    with pytest.raises(ValueError, match="no food 'carrot'; it has cucumber, tomato"):
        env.reset(options={"food": "carrot"})
    with pytest.raises(ValueError, match="there is no option \\['fod'\\]"):
        env.reset(options={"fod": "tomato"})
    assert env.moment() == moment  # A reset that is refused changes nothing.


THEIRS = RewardConfig(force_shape="sigmoid", force_scale=2.0)


def test_the_terms_of_the_reward_are_those_of_sliceit():
    height, force, jerk = 0.012, np.array([6.0, 8.0]), np.array([0.3, 0.0, 0.4])
    # -tanh(1), -1 / (1 + e^-2), the norm, and the step.
    expected = [-0.761594156, -0.880797078, -0.5, -1.0]
    assert reward_terms(THEIRS, height, force, jerk) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("force", "term"), [(0.0, -0.0474259), (6.0, -0.5), (30.0, -0.9999939)])
def test_their_term_of_the_force_is_s_shaped(force, term):
    found = reward_terms(THEIRS, 0.0, np.array([0.0, -force]), np.zeros(3))[1]
    assert found == pytest.approx(term, 1e-5)


@pytest.mark.parametrize(
    ("force", "term"), [(0.0, 0.0), (10.0, -0.0625), (20.0, -0.25), (90.0, -1)]
)
def test_half_of_the_force_for_twice_the_time_costs_half(force, term):
    config = RewardConfig(force_scale=40.0)
    found = reward_terms(config, 0.0, np.array([0.6 * force, -0.8 * force]), np.zeros(3))[1]
    assert found == pytest.approx(term, abs=1e-12)


def test_the_term_of_the_jerk_ends_at_one():
    assert reward_terms(RewardConfig(), 0.0, np.zeros(2), np.array([3.0, -4.0, 0.0]))[2] == -1.0


def test_the_potential_tells_what_is_left_and_pays_no_policy():
    config = RewardConfig(way=15.0, hold=5.0)
    assert reward_potential(config, 0.1, 0.0) == 0.0
    assert reward_potential(config, 0.04, 0.0) == pytest.approx(15.0)
    assert reward_potential(config, 1e-4, 0.5) == pytest.approx(27.475)
    assert reward_potential(config, -1e-4, 1.1) == 30.0
    # A failure costs what was left.
    assert failed_potential(config, 1e-4, 0.5) == pytest.approx(-2.525)
    # What is paid on the way depends on where it begins and ends alone.
    env = SlicingEnv(task_of("spring"))
    config = env.task.reward
    for actions in ([PRESS] * 12, [PRESS] * 6 + [-PRESS] * 6):
        potential = reward_potential(config, 0.06 * env.reset(seed=3)[0][1], 0.0)
        paid = 0.0
        for k, action in enumerate(actions):
            *_, info = env.step(action)
            paid += config.discount**k * info["shaping"]
        after = config.discount ** len(actions) * reward_potential(config, info["height"], 0.0)
        assert paid == pytest.approx(after - potential, abs=1e-5)


@pytest.mark.parametrize("at_goal", [0.0, 0.5, 1.1])
@pytest.mark.parametrize("height", [-1e-3, 0.0, 1e-3, 0.03, 0.1, 0.2])
def test_standing_still_pays_nothing(height, at_goal):
    config = RewardConfig()
    potential = reward_potential(config, height, at_goal)
    assert config.discount * potential - potential <= 0.0


def test_weights_are_ratios():
    assert reward_weights(RewardConfig(weights=[2.0, 4.0, 1.0, 1.0])) == pytest.approx(
        [0.25, 0.5, 0.125, 0.125]
    )


@pytest.mark.parametrize(
    ("progress", "raw"),
    [
        (0.0, [1.0, 0.135335283, 0.1, 1.0]),
        (0.25, [1.0, 0.606530660, 0.1, 1.0]),
        (0.5, [1.0, 1.0, 0.135335283, 1.0]),
        (1.0, [1.0, 1.0, 1.0, 1.0]),
    ],
)
def test_a_schedule_lets_the_weights_of_force_and_jerk_rise(progress, raw):
    config = RewardConfig(weights=[1.0] * 4, schedule="gaussian")
    weights = reward_weights(config, progress)
    assert weights == pytest.approx(np.array(raw) / np.sum(raw), abs=1e-8)


def test_the_environment_takes_the_progress_for_its_schedule():
    reward = RewardConfig(schedule="gaussian")
    env = SlicingEnv(task_of(reward=reward))
    rewards = []
    for progress in (0.0, 1.0):
        env.progress = progress
        env.reset(seed=0)
        _, value, _, _, info = env.step(PRESS)
        terms = [info["reward_terms"][name] for name in TERMS]
        expected = reward_weights(reward, progress) @ terms + info["shaping"]
        assert value == pytest.approx(expected, abs=1e-6)
        rewards.append(value)
    assert rewards[0] != rewards[1]


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"foods": []}, "task.foods"),
        ({"reward": RewardConfig(weights=[0.0] * 4)}, "task.reward.weights"),
        ({"randomization": {"height": [0.01, 0.0]}}, "task.randomization.height"),
        ({"workspace": [0.1, 0.1]}, "task.workspace"),
    ],
)
def test_a_task_that_cannot_be_is_named(values, field):
    validate(task_of(), "task")
    with pytest.raises(ConfigurationError) as caught:
        validate(task_of(**values), "task")
    assert caught.value.field == field


def test_all_variants_of_a_food_are_the_same_in_every_environment_of_a_task():
    randomization = RandomizationConfig(variants=4, stations=2)
    task = dc.replace(task_of("cutting"), randomization=randomization)
    pairs = []
    for env in (SlicingEnv(task), SlicingEnv(task)):
        stations = [env._station("cucumber", which)[0].station for which in range(2)]
        pairs.append([s.model.material for each in stations for s in each.cutting.solvers])
    assert pairs[0] == pairs[1]
    assert len({repr(material) for material in pairs[0]}) == 4
    # Twice as tough and half as soft, at most, than the posterior has them.
    calibrated = load_calibrated_food("cucumber").food.material
    for name in ("toughness", "youngs_modulus"):
        factors = [getattr(each, name) / getattr(calibrated, name) for each in pairs[0]]
        assert 0.4 < min(factors) < 0.8 < 1.25 < max(factors) < 2.5


def test_a_training_meets_the_boards_sensors_and_servos_of_an_evaluation():
    env = SlicingEnv(task_of(randomization={"stations": 6}))
    scenarios = [env._station("cucumber", which)[0].station.scenario for which in range(6)]
    stiffness = [each.board.stiffness for each in scenarios]
    assert min(stiffness) < 1e4 < 1e5 < max(stiffness) < 3e5
    for each in scenarios:
        # As many steps of the plant in an impact as on the default board.
        assert each.robot.plant_time_step <= 1e-3 * min(1.0, (3e4 / each.board.stiffness) ** 0.5)
        assert each.sensor.force_noise > 0.0 and 0.0 < each.sensor.delay < 8e-3
    biases = np.array([each.sensor.force_bias for each in scenarios])
    assert 0.15 < biases.std() < 0.6
    assert len({each.robot.servo.delay for each in scenarios}) > 2
    taken = {env.reset(seed=seed) and env._current[0] for seed in range(40)}
    assert len(taken) == 6


def test_a_task_without_variation_is_one_bench():
    fixed = {name: [1.0, 1.0] for name in ("board", "toughness", "modulus")}
    fixed |= {name: [0.0, 0.0] for name in ("delay", "servo_delay")}
    fixed |= {"stations": 1, "force_bias": 0.0, "moment_bias": 0.0}
    task = task_of(randomization=fixed, sensor=WrenchSensorConfig())
    scenario = SlicingEnv(task)._station("cucumber", 0)[0].station.scenario
    assert (scenario.board, scenario.sensor) == (task.board, task.sensor)
    assert scenario.robot.plant_time_step == 1e-3 and scenario.robot.servo.delay == 0.0


def test_no_training_cuts_a_carrot_by_default():
    assert TaskConfig().foods == ["cucumber", "tomato", "potato"]


@pytest.mark.second_tier
def test_food_that_asks_for_more_than_a_rules_level_is_cut_by_one_that_does_not_wait_for_ever():
    rule, task = AgentRule(16.0), TaskConfig()
    agent = dc.replace(task.agent, draw_increment=7.5e-3, press_increment=6e-3, rule=rule)
    env = SlicingEnv(dc.replace(task, agent=agent))
    ends = {}
    # A potato that is tougher than most, of the same draw for both.
    for rule.patience in (0.0, 0.5):
        env.reset(seed=2_000_008, options={"food": "potato"})
        for _ in range(160):
            info = env.step(np.zeros(6))[-1]
            if "end" in info:
                break
        ends[rule.patience] = info.get("end"), info["height"]
    assert ends[0.0][0] is None and ends[0.0][1] > 1e-3
    assert ends[0.5][0] == "goal"
    env.close()
