"""`sliceit evaluate`: lets policies cut slices in worlds that no training has seen."""

import argparse
import dataclasses as dc
import json
from collections.abc import Iterator
from concurrent.futures import as_completed
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sliceit_drake.learning.evaluation import SliceTrace
    from sliceit_drake.systems.agent import AgentConfig, Decide

__all__ = ["Case", "add_parser", "cut", "trace"]

DESCRIPTION = """\
Let trained policies cut slices, and measure contact force, duration and completion.

Each POLICY is a folder that `sliceit train` wrote. Worlds, none of which a training sees:
  stand_in   finite elements on a finer mesh, effects that no training has, a noisy, late sensor
  curves     measured force-depth curves with laws of speed and draw; no code of either simulator
Slices are the paper's unless --slices is given: cucumber 15, tomato 5, potato 10, carrot 5. All
policies cut the same slices. Everything here is simulated.

Writes a line for each slice to --output, a .jsonl file, and goes on where it is.
`python -m studies slicing` compares the policies of both simulators.
"""
SLICES = 25
"""That a process cuts: pydrake frees no station that it has built (studies/robot/endurance.py)."""
WORLDS = ("stand_in", "curves")
FOODS = ("cucumber", "tomato", "potato", "carrot")


@dc.dataclass(frozen=True)
class Case:
    """One slice to cut: all that the process which cuts it needs."""

    policy: str
    world: str
    food: str
    slice: int
    board_stiffness: float
    seed: int


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the command."""
    parser = commands.add_parser(
        "evaluate",
        help="let trained policies cut slices in unseen worlds",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "policies", nargs="+", metavar="POLICY", type=Path, help="folder of a training"
    )
    parser.add_argument(
        "--world", nargs="+", choices=WORLDS, default=list(WORLDS), help="default: both"
    )
    parser.add_argument(
        "--foods", nargs="+", choices=FOODS, default=list(FOODS), help="default: all"
    )
    parser.add_argument("--slices", metavar="N", type=int, help="of each food")
    parser.add_argument(
        "--board-stiffness",
        nargs="+",
        metavar="K",
        type=float,
        default=[3e4],
        help="N/m; several to vary it; default: 30000",
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the slices; 0")
    parser.add_argument("--workers", metavar="N", type=int, default=2, help="processes; 2")
    parser.add_argument(
        "--output", metavar="FILE", type=Path, required=True, help=".jsonl file of slices"
    )
    parser.set_defaults(run=_run, resumes=True)


def _run(options: argparse.Namespace) -> int:
    """Runs the command."""
    from tqdm import tqdm

    from sliceit_drake.cli.extras import needs_extra

    with needs_extra("learn"):
        from sliceit_drake.learning.metrics import COMPLETE  # noqa: F401
    from sliceit_drake.cutting.workers import worker_processes

    for policy in options.policies:
        _policy(str(policy))
    cases = list(_cases(options))
    done = _done(options.output)
    left = [case for case in cases if case not in done]
    options.output.parent.mkdir(parents=True, exist_ok=True)
    with tqdm(total=len(cases), initial=len(cases) - len(left), desc="slices") as bar:
        # New processes for each batch: Python 3.11's own renewal of a pool's processes hangs.
        batch = SLICES * options.workers
        for first in range(0, len(left), batch):
            with worker_processes(options.workers, "forkserver") as pool:
                tasks = [pool.submit(cut, case) for case in left[first : first + batch]]
                for task in as_completed(tasks):
                    with options.output.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(task.result()) + "\n")
                    bar.update(1)
    print(_table(options.output, cases))
    return 0


def cut(case: Case) -> dict:
    """Cuts one slice; returns its row."""
    _, _, simulator, seed = _policy(case.policy)
    metrics = dc.asdict(trace(case).metrics)
    return dc.asdict(case) | {"simulator": simulator, "policy_seed": seed} | metrics


def trace(case: Case) -> "SliceTrace":
    """Cuts one slice."""
    from sliceit_drake.learning.evaluation import cut_slice
    from sliceit_drake.stand_in.slicing_worlds import CurvesWorld, SlicingWorld, StandInWorld

    agent, decide, _, _ = _policy(case.policy)
    world: SlicingWorld = {"stand_in": StandInWorld, "curves": CurvesWorld}[case.world](case.seed)
    scenario, cutting = world.scenario(case.food, case.slice, case.board_stiffness)
    return cut_slice(scenario, agent, decide, cutting)


@lru_cache
def _policy(folder: str) -> "tuple[AgentConfig, Decide, str, int]":
    """Agent, network, simulator and seed of a training's folder."""
    from sliceit_drake.learning.training import POLICY, load_policy_folder
    from sliceit_drake.systems.exported_network import load_network

    config = load_policy_folder(Path(folder))
    agent = dc.replace(config.task.agent, network=str(Path(folder) / POLICY))
    return agent, load_network(agent), config.task.simulator, config.seed


def _cases(options: argparse.Namespace) -> Iterator[Case]:
    from sliceit_drake.stand_in.slicing_worlds import paper_slices

    for policy in options.policies:
        for world in options.world:
            for board in options.board_stiffness:
                for food in options.foods:
                    for k in range(options.slices or paper_slices(food)):
                        yield Case(str(policy), world, food, k, board, options.seed)


def _done(file: Path) -> set[Case]:
    if not file.exists():
        return set()
    return {case for case, _ in _rows(file)}


def _rows(file: Path) -> Iterator[tuple[Case, dict]]:
    names = [field.name for field in dc.fields(Case)]
    for line in file.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        yield Case(**{name: row[name] for name in names}), row


def _table(file: Path, cases: list[Case]) -> str:
    """Means over slices, a row for each policy, world, board and food."""
    asked = set(cases)
    groups: dict[tuple, list[dict]] = {}
    for case, row in _rows(file):
        if case in asked:
            key = (case.policy, case.world, case.board_stiffness, case.food)
            groups.setdefault(key, []).append(row)
    rows = []
    for (policy, world, board, food), found in groups.items():
        mean = {
            name: sum(row[name] for row in found) / len(found)
            for name in ("median_force", "peak_force", "board_peak", "duration")
        }
        rows.append(
            [
                policy,
                world,
                f"{board:g}",
                food,
                f"{sum(row['completed'] for row in found)} of {len(found)}",
                *(f"{value:.2f}" for value in mean.values()),
            ]
        )
    head = ["policy", "world", "board [N/m]", "food", "completed", "median |F| [N]", "peak [N]"]
    head += ["board [N]", "duration [s]"]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
