"""How the agent learns: its network, its replay, its update, its training and what that leaves."""

import dataclasses as dc
import io
import itertools
import json
import math
import multiprocessing
import os
import pickle
import textwrap

import numpy as np
import pytest

NEEDS = "of the extra [learn]"
torch = pytest.importorskip("torch", reason=f"torch is {NEEDS}")
pytest.importorskip("stable_baselines3", reason=f"Stable-Baselines3 is {NEEDS}")
pytest.importorskip("torchrl", reason=f"torchrl is {NEEDS}")

import gymnasium  # noqa: E402
from stable_baselines3 import SAC  # noqa: E402
from stable_baselines3.common.logger import Logger  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv  # noqa: E402

from sliceit_drake.cli.main import main  # noqa: E402
from sliceit_drake.configuration import ConfigurationError, dump_yaml, load_yaml  # noqa: E402
from sliceit_drake.cutting.solver import CuttingError  # noqa: E402
from sliceit_drake.diagrams.scenario import Start  # noqa: E402
from sliceit_drake.learning import training  # noqa: E402
from sliceit_drake.learning.network import (  # noqa: E402
    HistoryExtractor,
    TemporalConvolution,
    export_policy,
)
from sliceit_drake.learning.replay import PrioritizedReplayBuffer  # noqa: E402
from sliceit_drake.learning.reward import RewardConfig, reward_potential  # noqa: E402
from sliceit_drake.learning.sac import OverlapVecEnv, PrioritizedSAC  # noqa: E402
from sliceit_drake.learning.task import RandomizationConfig, TaskConfig  # noqa: E402
from sliceit_drake.learning.training import train  # noqa: E402
from sliceit_drake.learning.training_config import TrainingConfig  # noqa: E402
from sliceit_drake.systems.agent import AgentConfig, observation_names  # noqa: E402
from sliceit_drake.systems.agent_rule import AgentRule  # noqa: E402
from sliceit_drake.systems.exported_network import load_network  # noqa: E402

# torch comes with the second tier.
pytestmark = pytest.mark.second_tier

AGENT = AgentConfig(history=3)
SIZE = AGENT.observation_size()
OBSERVATIONS = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
ACTIONS = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)
POLICY = {
    "net_arch": [16],
    "features_extractor_class": HistoryExtractor,
    "features_extractor_kwargs": {"history": 3, "features": 8},
}


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """As in a training: beside busy processes, threads on small networks wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


# --- The temporal convolution.


@pytest.mark.parametrize("length", [1, 2, 3, 10, 12, 13, 24])
def test_the_convolution_is_a_stack_of_dilated_causal_ones_at_its_last_output(length):
    torch.manual_seed(length)
    network = TemporalConvolution(length, 3, width=5, features=7).double()
    stack, channels, dilation = [], 3, 1
    for level in network.levels:
        kernel = level.in_features // channels
        convolution = torch.nn.Conv1d(channels, 5, kernel, dilation=dilation).double()
        with torch.no_grad():
            convolution.weight.copy_(level.weight.view(5, kernel, channels).transpose(1, 2))
            convolution.bias.copy_(level.bias)
        stack += [convolution, torch.nn.ReLU()]
        channels, dilation = 5, dilation * kernel
    assert dilation >= length
    history = torch.randn(4, length, 3, dtype=torch.float64)
    before = torch.zeros(4, dilation - length, 3, dtype=torch.float64)
    everywhere = torch.nn.Sequential(*stack)(torch.cat([before, history], 1).transpose(1, 2))
    expected = torch.relu(network.head(everywhere[:, :, -1]))
    assert torch.allclose(network(history), expected, rtol=0.0, atol=1e-12)
    assert float(expected.detach().abs().max()) > 0.0


def test_the_convolution_sees_each_reading():
    torch.manual_seed(0)
    network = TemporalConvolution(12, 3).double()
    history = torch.randn(1, 12, 3, dtype=torch.float64, requires_grad=True)
    network(history).sum().backward()
    assert (history.grad.abs().sum(dim=2) > 0.0).all()


def test_a_blind_extractor_does_not_see_the_history():
    torch.manual_seed(0)
    seeing, blind = (HistoryExtractor(OBSERVATIONS, 3, blind=b) for b in (False, True))
    one = torch.randn(1, SIZE)
    other = one.clone()
    other[:, -9:] += 1.0
    assert torch.equal(blind(one), blind(other)) and blind(one).shape == (1, 64)
    assert not torch.equal(seeing(one), seeing(other)) and seeing(one).shape == (1, 128)


# --- Replay.


def buffer_of(size, filled, **options):
    buffer = PrioritizedReplayBuffer(size, OBSERVATIONS, ACTIONS, device="cpu", **options)
    for k in range(filled):
        add(buffer, k)
    return buffer


def add(buffer, k, done=False, info=None):
    """A transition whose reward is k."""
    rng = np.random.default_rng(k)
    old, new = rng.normal(size=(2, 1, SIZE)).astype(np.float32)
    action = rng.uniform(-1.0, 1.0, (1, 6)).astype(np.float32)
    buffer.add(old, new, action, np.array([float(k)]), np.array([done]), [info or {}])


@pytest.mark.parametrize("alpha", [0.0, 0.6, 1.0])
def test_transitions_are_drawn_in_proportion_to_a_power_of_their_errors(alpha):
    buffer = buffer_of(16, 10, alpha=alpha, beta=0.5, floor=0.01)
    errors = np.array([0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 10.0])
    buffer.update(np.arange(10), -errors)
    buffer.seed(7)
    share = (errors + 0.01) ** alpha
    share /= share.sum()
    count, draws, batch = np.zeros(16), 0, 64
    for _ in range(400):
        drawn = buffer.sample_prioritized(batch)
        count += np.bincount(drawn.places, minlength=16)
        draws += batch
        weights = share[drawn.places] ** -0.5
        assert drawn.weights.numpy()[:, 0] == pytest.approx(weights / weights.max(), rel=1e-4)
        rewards = drawn.transitions.rewards.numpy()[:, 0]
        assert np.array_equal(rewards, drawn.places)
    assert not count[10:].any(), "an empty place was drawn"
    sigma = np.sqrt(draws * share * (1.0 - share))
    assert np.all(np.abs(count[:10] - draws * share) < 4.5 * sigma)


def test_without_priorities_all_weights_are_one():
    buffer = buffer_of(8, 5, alpha=0.0, beta=1.0)
    buffer.update(np.arange(5), np.array([0.0, 1.0, 10.0, 100.0, 1000.0]))
    assert np.array_equal(buffer.sample_prioritized(32).weights, np.ones((32, 1)))


def test_a_new_transition_has_the_greatest_priority_so_far():
    buffer = buffer_of(8, 3, alpha=1.0, floor=0.0)
    buffer.update(np.arange(3), np.array([4.0, 2.0, 2.0]))
    add(buffer, 3)
    drawn = np.concatenate([buffer.sample_prioritized(64).places for _ in range(100)])
    share = np.bincount(drawn, minlength=8) / len(drawn)
    assert share[:4] == pytest.approx([4 / 12, 2 / 12, 2 / 12, 4 / 12], abs=0.03)


def test_a_full_buffer_overwrites_its_oldest():
    buffer = buffer_of(4, 6, alpha=1.0)
    drawn = np.concatenate(
        [buffer.sample_prioritized(32).transitions.rewards.numpy()[:, 0] for _ in range(10)]
    )
    assert set(drawn) == {2.0, 3.0, 4.0, 5.0}
    assert len(buffer._filled) == 4


def test_transitions_of_several_environments_are_kept_each_for_itself():
    buffer = buffer_of(5, 0, n_envs=2)
    rng = np.random.default_rng(0)
    old, new = rng.normal(size=(2, 2, SIZE)).astype(np.float32)
    action, info = rng.uniform(-1.0, 1.0, (2, 6)).astype(np.float32), {"TimeLimit.truncated": True}
    buffer.add(old, new, action, np.array([3.0, 4.0]), np.array([True, True]), [{}, info])
    batch = buffer.sample_prioritized(64)
    assert set(batch.places) == {0, 1}
    for place, *row in zip(batch.places, *batch.transitions[:5], strict=True):
        found = [part.numpy() for part in row]
        expected = old[place], action[place], new[place], place == 0, 3.0 + place
        for one, other in zip(found, expected, strict=True):
            assert np.array_equal(one.squeeze(), np.asarray(other, np.float32))
    for _ in range(2):
        buffer.add(old, new, action, np.array([5.0, 6.0]), np.zeros(2, bool), [{}, {}])
    # The sixth overwrote the first.
    assert buffer.rewards[:, 0].tolist() == [6.0, 4.0, 5.0, 6.0, 5.0]


def test_a_transition_that_the_time_limit_ended_is_not_an_end():
    buffer = buffer_of(4, 0)
    add(buffer, 0, done=True)
    add(buffer, 1, done=True, info={"TimeLimit.truncated": True})
    batch = buffer.sample_prioritized(32)
    assert np.array_equal(batch.transitions.dones.numpy()[:, 0], batch.places == 0)


def test_a_buffer_goes_on_from_its_state_as_if_nothing_had_happened():
    buffer = buffer_of(8, 11)
    buffer.update(np.arange(8), np.arange(8.0))
    buffer.set_beta(0.7)
    file = io.BytesIO()
    torch.save(buffer.state(), file)
    file.seek(0)
    other = buffer_of(8, 2)
    other.set_state(torch.load(file, weights_only=True))
    for each in (buffer, other):
        add(each, 20)
    for _ in range(3):
        one, two = buffer.sample_prioritized(16), other.sample_prioritized(16)
        assert np.array_equal(one.places, two.places)
        assert torch.equal(one.weights, two.weights)
        for left, right in zip(one.transitions[:5], two.transitions[:5], strict=True):
            assert torch.equal(left, right)


# --- The update.


class Still(gymnasium.Env):
    """Observations of the agent's size, and nothing happens."""

    observation_space, action_space = OBSERVATIONS, ACTIONS

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(SIZE, np.float32), {}

    def step(self, action):
        return np.zeros(SIZE, np.float32), 0.0, False, False, {}


def algorithm(kind, **options):
    return kind(
        "MlpPolicy",
        DummyVecEnv([Still]),
        learning_rate=0.01,
        buffer_size=64,
        batch_size=32,
        policy_kwargs=POLICY,
        seed=0,
        device="cpu",
        **options,
    )


def numbers(model):
    parts = {name: value.detach().clone() for name, value in model.policy.state_dict().items()}
    return parts | {"log_ent_coef": model.log_ent_coef.detach().clone()}


def test_with_equal_weights_the_update_is_that_of_stable_baselines3():
    ours = algorithm(PrioritizedSAC, replay_buffer_kwargs={"alpha": 0.0})
    theirs = algorithm(SAC)
    theirs.policy.load_state_dict(ours.policy.state_dict())
    for k in range(48):
        add(ours.replay_buffer, k % 7, done=k % 5 == 0)
    batch = ours.replay_buffer.sample_prioritized(32)
    ours.replay_buffer.sample_prioritized = lambda _: batch
    theirs.replay_buffer.sample = lambda *_, **__: batch.transitions
    before = numbers(ours)
    for model in (ours, theirs):
        # A step of gradient descent shows the gradient itself; Adam's first, its sign alone.
        for holder in (model.actor, model.critic):
            holder.optimizer = torch.optim.SGD(holder.parameters(), lr=0.01)
        model.ent_coef_optimizer = torch.optim.SGD([model.log_ent_coef], lr=0.01)
        model.set_logger(training.configure(None, []))
        torch.manual_seed(5)
        model.train(1, 32)
    one, two, moved = numbers(ours), numbers(theirs), 0
    for name, value in one.items():
        change = (value - before[name]).double(), (two[name] - before[name]).double()
        scale = float(change[1].abs().max())
        moved += scale > 0.0
        # Single precision, and the 1e-6 within Stable-Baselines3's logarithm.
        assert float((change[0] - change[1]).abs().max()) <= 1e-3 * scale + 1e-7, name
    assert moved == len(one)


def test_importance_weights_scale_the_critics_gradient():
    def gradient(weights):
        model = algorithm(PrioritizedSAC)
        for k in range(40):
            add(model.replay_buffer, k)
        batch = model.replay_buffer.sample_prioritized(32)
        model.replay_buffer.sample_prioritized = lambda _: batch._replace(weights=weights)
        before = [p.detach().clone() for p in model.critic.parameters()]
        model.critic.optimizer = torch.optim.SGD(model.critic.parameters(), lr=1e-4)
        torch.manual_seed(1)
        model._train_batch(32)
        after = list(model.critic.parameters())
        return torch.cat([(a - b).detach().ravel() for a, b in zip(after, before, strict=True)])

    first = torch.zeros(32, 1)
    first[:16] = 1.0
    whole, one, two = gradient(torch.ones(32, 1)), gradient(first), gradient(1.0 - first)
    assert torch.allclose(one + two, whole, rtol=0.0, atol=2e-3 * float(whole.abs().max()))
    assert not torch.allclose(one, two, rtol=0.0, atol=0.01 * float(whole.abs().max()))


def test_the_errors_of_a_batch_become_its_priorities():
    model = algorithm(PrioritizedSAC, replay_buffer_kwargs={"alpha": 1.0, "floor": 0.01})
    for k in range(40):
        add(model.replay_buffer, k, done=True)
    batch = model.replay_buffer.sample_prioritized(32)
    model.replay_buffer.sample_prioritized = lambda _: batch
    with torch.no_grad():
        values = torch.cat(
            model.critic(batch.transitions.observations, batch.transitions.actions), 1
        )
        errors = (values - batch.transitions.rewards).abs().mean(dim=1)
    model._train_batch(32)
    found = model.replay_buffer._sampler._sum_tree[torch.as_tensor(batch.places)]
    assert np.asarray(found) == pytest.approx(errors.numpy() + 0.01, rel=1e-4)


def test_no_value_outgrows_what_an_episode_can_give():
    def value(**options):
        model = algorithm(PrioritizedSAC, gamma=0.99, tau=0.05, ent_coef=1e-6, **options)
        for _ in range(40):
            still, action = np.zeros((1, SIZE), np.float32), np.zeros((1, 6), np.float32)
            model.replay_buffer.add(still, still, action, np.array([0.5]), np.array([False]), [{}])
        for _ in range(300):
            model._train_batch(32)
        return float(torch.cat(model.critic(torch.zeros(1, SIZE), torch.zeros(1, 6))).mean())

    # It lingers for ever: 0.5 / (1 - 0.99) = 50.
    assert value(value_limit=lambda o: torch.full((len(o), 1), 3.0)) == pytest.approx(3.4, abs=0.5)
    assert value() > 4.0


def test_a_training_starts_with_little_entropy_and_its_discount():
    config = training_of(entropy=0.25)
    model = training.make_model(config, OverlapVecEnv(DummyVecEnv([Still])))
    assert float(model.log_ent_coef.detach().exp()) == pytest.approx(0.25, rel=1e-6)
    assert model.gamma == config.task.reward.discount


def test_what_corrects_a_rule_begins_with_no_correction():
    environments = OverlapVecEnv(DummyVecEnv([Still]))
    seen = np.random.default_rng(0).normal(size=SIZE).astype(np.float32)
    for rule, is_still in ((AgentRule(), True), (None, False)):
        config = training_of()
        config.task.agent = dc.replace(config.task.agent, rule=rule)
        action, _ = training.make_model(config, environments).predict(seen, deterministic=True)
        assert (action == 0.0).all() == is_still


def test_each_decision_has_its_updates(monkeypatch):
    model = training.make_model(training_of(updates=3), OverlapVecEnv(DummyVecEnv([Still] * 2)))
    made = []
    monkeypatch.setattr(model, "_train_batch", made.append)
    model.set_logger(Logger(None, []))
    for model.num_timesteps in (20, 21):
        model.update()
    assert made == [16] * 6


def test_no_slice_gets_more_than_what_is_left_to_get():
    reward = RewardConfig(goal=15.0, way=15.0, hold=5.0)
    names = observation_names(3)
    observations = torch.zeros(3, SIZE)
    observations[0, names.index("error_z")] = 0.5  # 30 mm
    observations[1, names.index("at_goal")] = 0.8
    observations[2, names.index("error_z")] = -0.01
    observations[2, names.index("at_goal")] = 1.1
    found = training.value_limit(reward)(observations).ravel()
    assert found.tolist() == pytest.approx([15.0 - 17.5, 15.0 - 29.0, 15.0 - 30.0])
    for row, limit in zip(observations.tolist(), found.tolist(), strict=True):
        height, count = 0.06 * row[names.index("error_z")], row[names.index("at_goal")]
        assert limit == pytest.approx(reward.goal - reward_potential(reward, height, count))


# --- Training.


def training_of(**values):
    task = TaskConfig(
        simulator="spring",
        foods=["cucumber"],
        agent=AGENT,
        randomization=RandomizationConfig(variants=1),
        start=Start(clearance=0.003),
        reward=RewardConfig(schedule="gaussian"),
        decisions=15,
    )
    settings = {"steps": 120, "warm_up": 20, "batch": 16, "layers": [16], "seed": 3}
    settings |= {"validation_interval": 25, "validation_slices": 1}
    return TrainingConfig(task=task, **(settings | values))


@pytest.fixture
def one_process(monkeypatch):
    """Environments in this process: the start of another takes seconds."""
    monkeypatch.setattr(training, "SubprocVecEnv", lambda makers, _: DummyVecEnv(makers))


def after(decisions):
    """What says to a training that it shall stop after so many decisions."""
    count = itertools.count()
    return lambda: next(count) >= decisions


def lines(folder, name=training.EPISODES):
    return [json.loads(line) for line in (folder / name).read_text().splitlines()]


@pytest.mark.parametrize("environments", [1, 2, 3])
def test_a_training_that_was_stopped_goes_on_as_if_it_had_not(environments, tmp_path, one_process):
    config = training_of(checkpoint_interval=25, environments=environments)
    straight = train(config, tmp_path / "straight")
    steps = [line["steps"] for line in lines(tmp_path / "straight", training.VALIDATION)]
    # A policy is validated before the stop, and compared with those after it.
    assert len(steps) >= 4 and steps[0] < 50 and steps[-1] == 120
    # In the midst of a slice.
    first = train(config, tmp_path / "halves", is_stopped=after(7))
    assert first.episodes == 0 and first.steps == 7 * environments
    left = math.ceil((50 - first.steps) / environments)
    half = train(config, tmp_path / "halves", is_stopped=after(left))
    assert 50 <= half.steps < 50 + environments
    assert not (tmp_path / "halves" / training.POLICY).exists()
    # What was logged after the checkpoint is dropped.
    for name in (training.EPISODES, training.VALIDATION):
        with (tmp_path / "halves" / name).open("a") as file:
            file.write('{"steps": 99}\n')
    whole = train(config, tmp_path / "halves")
    policies = [(tmp_path / name / training.POLICY).read_bytes() for name in ("straight", "halves")]
    assert policies[0] == policies[1]
    for name in (training.EPISODES, training.VALIDATION):
        assert lines(tmp_path / "straight", name) == lines(tmp_path / "halves", name)
    assert dc.replace(straight, wall_time=0.0) == dc.replace(whole, wall_time=0.0)
    assert straight.steps == 120 and straight.failed is None
    assert straight.episodes == environments * (120 // environments // 15)


def test_another_seed_gives_another_policy(tmp_path, one_process):
    for seed in (3, 4):
        train(training_of(seed=seed, steps=40), tmp_path / str(seed))
    one, other = ((tmp_path / str(seed) / training.POLICY).read_bytes() for seed in (3, 4))
    assert one != other


def test_stable_baselines3_loads_the_policy_that_is_exported(tmp_path, one_process):
    config = training_of(steps=60)
    train(config, tmp_path)
    model = SAC.load(tmp_path / training.MODEL, device="cpu")
    decide = load_network(dc.replace(config.task.agent, network=str(tmp_path / training.POLICY)))
    observation = np.random.default_rng(0).normal(size=SIZE).astype(np.float32)
    expected, _ = model.predict(observation, deterministic=True)
    assert decide(observation) == pytest.approx(expected, abs=1e-6)


def test_a_policys_card_has_its_validation_and_runs_it(tmp_path, one_process):
    config = training_of(steps=60)
    config.task.agent = dc.replace(AGENT, rule=AgentRule(12.0))
    outcome = train(config, tmp_path)
    card = (tmp_path / training.CARD).read_text(encoding="utf-8")
    rows = lines(tmp_path, training.VALIDATION)
    found = next(row for row in rows if row["steps"] == outcome.best_steps)
    assert f"| {found['return']:.2f} |" in card and f"learned after {found['steps']}." in card
    text = textwrap.dedent(card.split("AgentConfig\n")[1].split("\n\n")[0])
    agent = load_yaml(AgentConfig, None, overrides_text=text)
    assert agent.network == training.POLICY
    load_network(dc.replace(agent, network=str(tmp_path / training.POLICY)))


def test_a_stop_at_the_last_step_is_the_end(tmp_path, one_process):
    outcome = train(training_of(steps=30, warm_up=20), tmp_path, is_stopped=after(30))
    assert outcome.steps == 30
    assert (tmp_path / training.POLICY).exists()


def test_a_checkpoint_of_another_training_is_refused(tmp_path, one_process):
    train(training_of(steps=60), tmp_path, is_stopped=after(15))
    before = (tmp_path / training.CONFIGURATION).read_text()
    with pytest.raises(ConfigurationError, match="other settings") as caught:
        train(training_of(steps=60, learning_rate=2e-3), tmp_path)
    assert "another folder" in str(caught.value)
    assert (tmp_path / training.CONFIGURATION).read_text() == before


class MakesFolder:
    """An object whose pickle makes a folder when it is read."""

    def __init__(self, folder):
        self._folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self._folder,)


def as_pickle(value):
    return pickle.dumps(value)


def as_checkpoint(value):
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


@pytest.mark.parametrize(
    ("write", "content"),
    [
        (as_pickle, lambda trap: trap),
        (as_pickle, lambda trap: {"config": trap}),
        (as_checkpoint, lambda trap: trap),
        (as_checkpoint, lambda trap: {"config": "{}", "model": trap}),
        (as_checkpoint, lambda trap: {"model": {}}),
        (as_checkpoint, lambda trap: [1, 2]),
        (lambda _: b"", lambda trap: None),
        (lambda _: b"no checkpoint", lambda trap: None),
    ],
    ids=["a pickle", "a pickle of a dict", "a saved object", "an object among others",
         "no configuration", "a list", "an empty file", "a text"],
)  # fmt: skip
def test_a_checkpoint_that_would_run_code_is_refused_and_runs_none(
    write, content, tmp_path, one_process, capsys
):
    config, folder, made = tmp_path / "training.yaml", tmp_path / "out", tmp_path / "made"
    dump_yaml(training_of(), config)
    folder.mkdir()
    data = write(content(MakesFolder(made)))
    (folder / training.CHECKPOINT).write_bytes(data)
    if write is as_pickle:
        pickle.loads(data)
        assert made.is_dir(), "read carelessly it would run"
        made.rmdir()
    assert main(["train", str(config), "--output", str(folder)]) == 2
    said = capsys.readouterr().err
    assert "checkpoint.pt: output: is no checkpoint of this version" in said
    assert "Give another folder, or delete it" in said
    assert not made.exists()
    assert [file.name for file in folder.iterdir()] == [training.CHECKPOINT]
    assert (folder / training.CHECKPOINT).read_bytes() == data


def test_a_training_whose_environment_dies_says_so_and_goes_on(tmp_path):
    config = training_of(steps=40, checkpoint_interval=15, environments=2)

    def kill(steps: int, _: str) -> None:
        if steps >= 20:
            for process in multiprocessing.active_children():
                process.kill()

    with pytest.raises(RuntimeError, match="environment ended.*last checkpoint"):
        train(config, tmp_path, kill)
    before = torch.load(tmp_path / training.CHECKPOINT, weights_only=True)
    assert before["watch"]["steps"] == 16 and before["watch"]["episodes"] == 0
    assert train(config, tmp_path).steps == 40
    straight = tmp_path / "straight"
    train(config, straight)
    assert (straight / training.POLICY).read_bytes() == (tmp_path / training.POLICY).read_bytes()


def test_a_training_whose_guards_end_episodes_has_failed(tmp_path, one_process, monkeypatch):
    def fail(*_):
        raise CuttingError("an element is inverted")

    monkeypatch.setattr("sliceit_drake.systems.spring_cutter.SpringCutter.advance", fail)
    outcome = train(training_of(steps=5), tmp_path)
    assert outcome.guard_errors == {"CuttingError": 5} and outcome.ends == {"guard": 5}
    assert "5 of 5 episodes" in outcome.failed and "0.1 %" in outcome.failed
    assert json.loads((tmp_path / "summary.json").read_text())["failed"] == outcome.failed
    assert all("an element is inverted" in line["guard"] for line in lines(tmp_path))


@pytest.mark.parametrize(
    ("guards", "episodes", "failed"),
    # At 0.1 % one of 52 has a probability of 5.07 %, and two of 356 of 5.01 %.
    [(0, 1, False), (1, 52, False), (1, 51, True), (2, 356, False), (2, 355, True)],
)
def test_guards_fail_a_training_where_they_are_no_chance(tmp_path, guards, episodes, failed):
    watch = training._Watch(training_of(), tmp_path, "", None, None)
    watch.episodes = episodes
    watch._guards.update({"CuttingError": guards})
    assert (watch.outcome(1.0).failed is not None) == failed


def watch_of(output, config):
    """A training's watch of a model that has learned nothing."""
    model = training.make_model(config, OverlapVecEnv(DummyVecEnv([Still])))
    model.set_logger(Logger(None, []))
    watch = training._Watch(config, output, "", None, lambda: False)
    watch.init_callback(model)
    return watch


def test_the_policy_is_that_with_the_greatest_return_on_the_validation_slices(
    tmp_path, monkeypatch
):
    watch, found = watch_of(tmp_path, training_of()), {"length": 9.0, "force": 5.0}
    for number, value in enumerate([1.0, 4.0, 3.0], 1):
        monkeypatch.setattr(
            training, "cut_fixed_slices", lambda *_, value=value: {"return": value} | found
        )
        watch.num_timesteps = 100 * number
        with torch.no_grad():
            watch.model.actor.mu.bias.fill_(float(number))
        watch.validate()
        watch.validate()  # Once in a place.
    outcome = watch.outcome(1.0)
    assert (outcome.best_return, outcome.best_steps) == (4.0, 200)
    # Not the one that learned on since.
    assert watch.best_actor["mu.bias"].tolist() == [2.0] * 6
    assert watch.model.actor.mu.bias.tolist() == [3.0] * 6
    rows = [{"steps": 100 * k, "return": v} | found for k, v in ((1, 1.0), (2, 4.0), (3, 3.0))]
    assert lines(tmp_path, training.VALIDATION) == rows


def test_a_validation_is_the_discounted_return_of_fixed_slices_without_randomness(tmp_path):
    config = training_of()
    watch = watch_of(tmp_path, config)
    env = training.SlicingEnv(config.task)
    random = torch.get_rng_state()

    def cut(count):
        return training.cut_fixed_slices(watch._decide, env, count, 10**6)

    found = cut(2)
    assert torch.equal(torch.get_rng_state(), random)
    env.reset(seed=5)
    assert cut(2) == found
    assert cut(1)["return"] != found["return"]
    env.progress, returns = 1.0, []
    for k in (0, 1):
        observation, done, worth, weight = env.reset(seed=10**6 + k)[0], False, 0.0, 1.0
        while not done:
            action, _ = watch.model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            worth, weight = worth + weight * reward, weight * config.task.reward.discount
            done = terminated or truncated
        returns.append(worth)
    assert found["return"] == pytest.approx(np.mean(returns), rel=1e-9)


def test_the_return_of_an_episode_is_discounted_as_it_is_trained(tmp_path):
    config = training_of()
    config.task.reward = RewardConfig(discount=0.5)
    watch = watch_of(tmp_path, config)
    for k, reward in enumerate([1.0, 2.0, 4.0]):
        info = {"end": "goal", "force": 1.0, "cut_progress": 1.0, "reward_terms": {}}
        watch.locals = {"infos": [info], "rewards": [reward], "dones": [k == 2]}
        watch._on_step()
    assert [line["return"] for line in lines(tmp_path)] == [3.0]


def test_a_training_without_a_validation_chooses_no_policy(tmp_path):
    watch = watch_of(tmp_path, training_of())
    watch.num_timesteps = 20
    watch.validate()
    assert watch.outcome(1.0).best_return is None and watch.best_actor is None


@pytest.mark.parametrize("is_chosen", [True, False])
def test_the_policy_that_was_chosen_is_exported_else_the_last(
    is_chosen, tmp_path, one_process, monkeypatch
):
    def learn(model, steps, callback, **_):
        if is_chosen:
            chosen = model.actor.state_dict()
            callback.best_actor = chosen | {"mu.bias": torch.full((6,), 7.0)}
        with torch.no_grad():
            model.actor.mu.bias.fill_(9.0)

    exported = []
    monkeypatch.setattr(training, "check_task", lambda _: None)
    monkeypatch.setattr(PrioritizedSAC, "learn", learn)
    monkeypatch.setattr(
        training, "export_policy", lambda actor, *_: exported.append(actor.mu.bias.tolist())
    )
    train(training_of(), tmp_path)
    assert exported == [[7.0 if is_chosen else 9.0] * 6]


def test_updates_are_made_while_the_environment_steps():
    order = []

    class Noted(Still):
        def step(self, action):
            order.append("step")
            return super().step(action)

    environments = OverlapVecEnv(DummyVecEnv([Noted]))
    environments.reset()
    environments.meanwhile = lambda: order.append("update")
    environments.step_async(np.zeros((1, 6)))
    environments.step_wait()
    assert order == ["update", "step"]


# --- What is left.


@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("history", [3, 12])
def test_an_exported_policy_decides_as_the_actor(tmp_path, history):
    agent = AgentConfig(history=history, network=str(tmp_path / "policy.onnx"))
    size = agent.observation_size()

    class Sized(Still):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)

    policy = POLICY | {"features_extractor_kwargs": {"history": history}}
    model = SAC("MlpPolicy", DummyVecEnv([Sized]), buffer_size=1, policy_kwargs=policy, seed=1)
    export_policy(model.actor, agent, tmp_path / "policy.onnx")
    decide = load_network(agent)
    rng = np.random.default_rng(0)
    for scale in (0.1, 1.0, 5.0):
        observation = (scale * rng.normal(size=size)).astype(np.float32)
        expected, _ = model.predict(observation, deterministic=True)
        assert decide(observation) == pytest.approx(expected, abs=1e-6)
        assert np.ptp(expected) > 1e-3
