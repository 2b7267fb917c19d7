"""Policies that cut slices in worlds which no training has seen, in several processes."""

import dataclasses as dc
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from functools import lru_cache
from itertools import product
from pathlib import Path

from sliceit_drake.cutting.workers import worker_processes
from sliceit_drake.learning.evaluation import SliceTrace, cut_slice
from sliceit_drake.learning.training_config import POLICY, load_policy_folder
from sliceit_drake.stand_in.slicing_worlds import (
    CurvesWorld,
    SlicingWorld,
    StandInWorld,
    paper_slices,
)
from sliceit_drake.systems.agent import AgentConfig, Decide
from sliceit_drake.systems.exported_network import load_network

__all__ = ["WORLDS", "Case", "cases_of", "cut", "evaluate", "results_table", "trace"]

WORLDS: dict[str, type[SlicingWorld]] = {world.name: world for world in (StandInWorld, CurvesWorld)}
SLICES = 25
"""Slices that a process cuts: pydrake frees no station that it has built
(studies/robot/endurance.py)."""


@dc.dataclass(frozen=True)
class Case:
    """One slice to cut: all that the process which cuts it needs.

    Attributes:
        policy: Folder of a training.
        world: One of `WORLDS`.
        food: One of `stand_in.slicing_worlds.SLICING_FOODS`.
        slice: Index of the slice, from 0.
        board_stiffness: N/m.
        seed: Seed of the world's slices.
    """

    policy: str
    world: str
    food: str
    slice: int
    board_stiffness: float
    seed: int


def cases_of(
    policies: Sequence[Path],
    worlds: Sequence[str],
    foods: Sequence[str],
    board_stiffness: Sequence[float],
    seed: int,
    slices: int | None = None,
) -> list[Case]:
    """The slices of all policies, worlds, boards and foods.

    Args:
        policies: Folders of trainings.
        worlds, foods, board_stiffness, seed: See `Case`.
        slices: Slices of each food; None for as many as the SliceIt! paper cuts.

    Raises:
        ConfigurationError: A folder has no policy, or one that cannot be run.
    """
    for policy in policies:
        _policy(str(policy))
    return [
        Case(str(policy), world, food, k, board, seed)
        for policy, world, board, food in product(policies, worlds, board_stiffness, foods)
        for k in range(slices or paper_slices(food))
    ]


def evaluate(
    cases: Sequence[Case],
    output: Path,
    workers: int,
    progress: Callable[[int], None] | None = None,
    cut_case: Callable[[Case], dict] | None = None,
) -> None:
    """Cuts the slices that a file does not have yet, and adds a line for each.

    Args:
        cases: What to cut.
        output: File of lines of JSON, one for each slice.
        workers: Processes.
        progress: Called with how many of the cases are done.
        cut_case: Cuts a slice and returns its row, in another process; None for `cut`.
    """
    done = {case for case, _ in _rows(output)} if output.exists() else set()
    left = [case for case in cases if case not in done]
    count = len(cases) - len(left)
    output.parent.mkdir(parents=True, exist_ok=True)
    # New processes for each batch: Python 3.11's own renewal of a pool's processes hangs.
    batch = SLICES * workers
    for first in range(0, len(left), batch):
        with worker_processes(workers, "forkserver") as pool:
            tasks = [pool.submit(cut_case or cut, case) for case in left[first : first + batch]]
            for task in as_completed(tasks):
                with output.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(task.result()) + "\n")
                count += 1
                if progress is not None:
                    progress(count)


def cut(case: Case, world: SlicingWorld | None = None) -> dict:
    """Cuts one slice, in the world that it names or in another; returns its row."""
    _, _, simulator, seed = _policy(case.policy)
    metrics = dc.asdict(trace(case, world).metrics)
    return dc.asdict(case) | {"simulator": simulator, "policy_seed": seed} | metrics


def trace(case: Case, world: SlicingWorld | None = None) -> SliceTrace:
    """Cuts one slice; see `cut`."""
    agent, decide, _, _ = _policy(case.policy)
    world = world or WORLDS[case.world](case.seed)
    scenario, make_cutting = world.scenario(case.food, case.slice, case.board_stiffness)
    return cut_slice(scenario, agent, decide, make_cutting)


@lru_cache
def _policy(folder: str) -> tuple[AgentConfig, Decide, str, int]:
    """Agent, network, simulator and seed of a training's folder."""
    config = load_policy_folder(Path(folder))
    agent = dc.replace(config.task.agent, network=str(Path(folder) / POLICY))
    return agent, load_network(agent), config.task.simulator, config.seed


def _rows(file: Path) -> Iterator[tuple[Case, dict]]:
    names = [field.name for field in dc.fields(Case)]
    for line in file.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        yield Case(**{name: row[name] for name in names}), row


def results_table(file: Path, cases: Sequence[Case]) -> str:
    """Means over slices, a row for each policy, world, board and food."""
    asked = set(cases)
    groups: dict[tuple, list[dict]] = {}
    for case, row in _rows(file):
        if case in asked:
            key = (case.policy, case.world, case.board_stiffness, case.food)
            groups.setdefault(key, []).append(row)
    rows = []
    for (policy, world, board, food), found in groups.items():
        completed = f"{sum(row['completed'] for row in found)} of {len(found)}"
        means = (
            f"{sum(row[name] for row in found) / len(found):.2f}"
            for name in ("median_force", "peak_force", "board_peak", "duration")
        )
        rows.append([policy, world, f"{board:g}", food, completed, *means])
    head = ["policy", "world", "board [N/m]", "food", "completed", "median |F| [N]", "peak [N]"]
    head += ["board [N]", "duration [s]"]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
