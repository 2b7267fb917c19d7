"""Cost of a training and of a decision: python benchmarks/learning_speed.py [--output FILE].

All in one process or one after the other on one machine: compare rows, not machines. The steps of
the environment and the updates are timed alone first; then both overlap as in `sliceit train`, for
the cutting simulator and the spring-only baseline, with one environment and with two side by side,
and 80,000 steps are extrapolated from the rate after the warm-up. A decision is timed with the
exported network, torch not imported.

--output puts the tables into a Markdown file, between the lines
  <!-- learning_speed -->
  <!-- end of learning_speed -->
"""

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import warp
from marked_page import Place
from results import write_results

warp.config.log_level = warp.LOG_ERROR
PLACE = Place("learning_speed")
WARM_UP, STEPS = 300, 2000
ENVIRONMENTS = (1, 2)
DECISION = """
import sys, time, numpy as np
from sliceit_drake.systems.agent import AgentConfig
from sliceit_drake.systems.network import load_network
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
    from sliceit_drake.learning.training import TrainingConfig, train

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
    from sliceit_drake.learning.training import TrainingConfig, make_model

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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, help="Markdown file with the two lines")
    parser.add_argument("--json", type=Path, help="also write the values there")
    options = parser.parse_args()
    PLACE.check(options.output)
    command = shlex.join(["python", "benchmarks/learning_speed.py", *sys.argv[1:]])
    import torch

    torch.set_num_threads(1)
    update, rates, lines = update_time(), {}, []
    lines = [
        "| simulator | simulating a decision | an update | environments | training "
        "| 80,000 decisions |",
        "|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for simulator in ("cutting", "spring"):
            step = environment_step(simulator)
            for count in ENVIRONMENTS:
                output = Path(folder) / f"{simulator}_{count}"
                rates[simulator, count] = rate = training_rate(simulator, count, output)
                lines.append(
                    f"| {simulator} | {step:.1f} ms | {update:.1f} ms | {count} "
                    f"| {rate:.1f} decisions/s | {80_000 / rate / 60:.0f} min |"
                )
        printed = subprocess.run(
            [sys.executable, "-c", DECISION, str(Path(folder) / "cutting_1" / "policy.onnx")],
            check=True,
            capture_output=True,
            text=True,
        ).stdout
    median, late = map(float, printed.split()[-2:])
    ratios = {count: rates["spring", count] / rates["cutting", count] for count in ENVIRONMENTS}
    if options.json is not None:
        found = {f"{name}_{n}_decisions_a_second": rate for (name, n), rate in rates.items()}
        found |= {f"{name}_{n}_80000_min": 80_000 / rate / 60 for (name, n), rate in rates.items()}
        write_results(
            options.json, found | {f"{n}_cutting_over_spring": r for n, r in ratios.items()}
        )
    taken = " and ".join(f"{r:.2f} with {n}" for n, r in ratios.items())
    lines += [
        "",
        f"The cutting simulator takes {taken} times as long as the spring. A decision of the "
        f"exported network takes {median:.3f} ms (99 %: {late:.3f} ms).",
        "",
        f"`{command}`, {os.cpu_count()} cores.",
    ]
    text = "\n".join(lines)
    print(text)
    PLACE.write(options.output, text)


if __name__ == "__main__":
    main()
