"""Cost of a training and of a decision.

All in one process or one after the other on one machine: compare rows, not machines. In each of
--rounds the steps of the environment and the updates are timed alone; then both overlap as in
`sliceit train`, for the cutting simulator and the spring-only baseline, with one environment and
with two side by side, and 80,000 steps are extrapolated from the rate after the warm-up. Medians of
the rounds are shown, and of the rounds' ratios, since other work on a machine comes and goes. A
decision is timed with the exported network, torch not imported.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from studies.marked_page import Place
from studies.results import add_json_argument, write_results
from studies.watch import Watch

__all__ = ["PLACE", "add_arguments", "run"]

PLACE = Place("learning_speed")
WARM_UP, STEPS = 300, 900
ENVIRONMENTS = (1, 2)
SIMULATORS = ("cutting", "spring")
DECISION = """
import sys, time, numpy as np
from sliceit_drake.systems.agent import AgentConfig
from sliceit_drake.systems.exported_network import load_network
config = AgentConfig(network=sys.argv[1])
decide = load_network(config)
rows = np.random.default_rng(0).normal(size=(2000, config.observation_size()))
times = []
for row in rows:
    begin = time.perf_counter(); decide(row); times.append(time.perf_counter() - begin)
assert "torch" not in sys.modules
print(1e3 * np.median(times), 1e3 * np.quantile(times, 0.99))
"""


def environment_step(simulator: str, count: int = 400) -> float:
    """Time of a decision's simulation with random actions, ms."""
    from sliceit_drake.learning.environment import SlicingEnv
    from sliceit_drake.learning.task import TaskConfig

    env, rng = SlicingEnv(TaskConfig(simulator=simulator)), np.random.default_rng(0)
    env.reset(seed=0)
    for food in env.task.foods:  # Stations are built when they are first needed.
        env.reset(options={"food": food})
    begin = time.perf_counter()
    for _ in range(count):
        *_, terminated, truncated, _ = env.step(rng.uniform(-1.0, 1.0, 6))
        if terminated or truncated:
            env.reset()
    return 1e3 * (time.perf_counter() - begin) / count


def training_rate(simulator: str, environments: int, output: Path) -> float:
    """Decisions in a second, learning included."""
    from sliceit_drake.learning.task import TaskConfig
    from sliceit_drake.learning.training import train
    from sliceit_drake.learning.training_config import TrainingConfig

    config = TrainingConfig(
        task=TaskConfig(simulator=simulator),
        steps=WARM_UP + STEPS,
        warm_up=WARM_UP,
        environments=environments,
    )
    marks: list[tuple[float, int]] = []
    outcome = train(config, output, lambda n, _: marks.append((time.perf_counter(), n)))
    learning = [mark for mark in marks if mark[1] > WARM_UP + 100]
    (t0, n0), (t1, n1) = learning[0], learning[-1]
    assert outcome.steps == config.steps
    return (n1 - n0) / (t1 - t0)


def update_time(count: int = 200) -> float:
    """Time of an update alone, ms."""
    from stable_baselines3.common.logger import configure
    from stable_baselines3.common.vec_env import DummyVecEnv

    from sliceit_drake.learning.environment import SlicingEnv
    from sliceit_drake.learning.sac import OverlapVecEnv
    from sliceit_drake.learning.task import TaskConfig
    from sliceit_drake.learning.training import make_model
    from sliceit_drake.learning.training_config import TrainingConfig

    config = TrainingConfig(task=TaskConfig(simulator="spring", foods=["cucumber"]))
    model = make_model(config, OverlapVecEnv(DummyVecEnv([lambda: SlicingEnv(config.task)])))
    model.set_logger(configure(None, []))
    rng, buffer = np.random.default_rng(0), model.replay_buffer
    size = config.task.agent.observation_size()
    for _ in range(2000):
        one, two = rng.normal(size=(2, 1, size))
        action, reward = rng.uniform(-1.0, 1.0, (1, 6)), rng.normal(size=1)
        buffer.add(one, two, action, reward, np.zeros(1), [{}])
    model.train(20, config.batch)
    begin = time.perf_counter()
    model.train(count, config.batch)
    return 1e3 * (time.perf_counter() - begin) / count


def shares(rounds: int) -> list[tuple[str, ...]]:
    """Where the time of a decision goes, in %. The last thing done: it changes methods."""
    from sliceit_drake.cutting.workspace import Workspace
    from sliceit_drake.learning.environment import SlicingEnv
    from sliceit_drake.systems.agent import AgentSystem
    from sliceit_drake.systems.compliance_controller import ComplianceController
    from sliceit_drake.systems.contact_monitor import ContactMonitor
    from sliceit_drake.systems.knife_force import KnifeForceSystem
    from sliceit_drake.systems.wrench_sensor import WrenchSensor

    watch = Watch()
    for owner, name, part in (
        (SlicingEnv, "step", "plant, servo, Drake"),
        (SlicingEnv, "reset", "start of a slice"),
        (Workspace, "advance", "kernels of the food"),
        (KnifeForceSystem, "_update", "rest of the food, or the spring"),
        (ComplianceController, "_update", "compliance control"),
        (WrenchSensor, "_update", "sensor"),
        (ContactMonitor, "_update", "contact monitor"),
        (AgentSystem, "_decide", "agent"),
        (AgentSystem, "_read", "agent"),
        (AgentSystem, "_calc_target_pose", "agent"),
        (AgentSystem, "observe", "agent"),
    ):
        watch.method(owner, name, part)
    found: dict[str, dict[str, list[float]]] = {name: {} for name in SIMULATORS}
    for _ in range(rounds):
        for name in SIMULATORS:
            watch.spent = dict.fromkeys(watch.spent, 0.0)
            environment_step(name)
            whole = sum(watch.spent.values())
            for part, spent in watch.spent.items():
                found[name].setdefault(part, []).append(spent / whole)
    rows = [(part, [np.median(found[name][part]) for name in SIMULATORS]) for part in watch.spent]
    return [
        (part, *(f"{100 * share:.0f} %" for share in both))
        for part, both in sorted(rows, key=lambda row: -row[1][0])
    ]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    PLACE.add_argument(parser)
    parser.add_argument("--rounds", type=int, default=3, help="of everything; 3")
    add_json_argument(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    if options.rounds < 1:
        raise ConfigurationError("is below 1", field="--rounds", fix="Give 1 or more.")
    PLACE.check(options.output)
    import torch

    torch.set_num_threads(1)
    updates: list[float] = []
    alone: dict[str, list[float]] = {name: [] for name in SIMULATORS}
    rates: dict[tuple[str, int], list[float]] = {
        (name, count): [] for name in SIMULATORS for count in ENVIRONMENTS
    }
    with tempfile.TemporaryDirectory() as folder:
        for k in range(options.rounds):
            updates.append(update_time())
            for name in SIMULATORS:
                alone[name].append(environment_step(name))
            for count in ENVIRONMENTS:
                for name in SIMULATORS:
                    output = Path(folder) / f"{name}_{count}_{k}"
                    rates[name, count].append(training_rate(name, count, output))
        printed = subprocess.run(
            [sys.executable, "-c", DECISION, str(Path(folder) / "cutting_1_0" / "policy.onnx")],
            check=True,
            capture_output=True,
            text=True,
        ).stdout
    median, late = map(float, printed.split()[-2:])
    rows = []
    found: dict[str, float] = {}
    for (name, count), measured in rates.items():
        rate = float(np.median(measured))
        minutes = 80_000 / rate / 60
        found[f"{name}_{count}_decisions_a_second"] = rate
        found[f"{name}_{count}_80000_min"] = minutes
        rows.append(
            (name, f"{np.median(alone[name]):.1f} ms", f"{np.median(updates):.1f} ms", count)
            + (f"{rate:.1f} decisions/s ({min(measured):.1f} to {max(measured):.1f})",)
            + (f"{minutes:.0f} min",)
        )
    cutting, spring = SIMULATORS
    taken = []
    for count in ENVIRONMENTS:
        ratios = np.divide(rates[spring, count], rates[cutting, count])
        found[f"{count}_cutting_over_spring"] = float(np.median(ratios))
        taken.append(
            f"{np.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}) with {count}"
        )
    write_results(options, found)
    PLACE.publish(
        options.output,
        rows=rows,
        rounds=options.rounds,
        taken=" and ".join(taken),
        decision=median,
        late=late,
        parts=shares(options.rounds),
        command=options.command,
        cores=os.cpu_count(),
    )
    return 0
