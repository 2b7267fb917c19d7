"""Steps cuts along the paths of their knives: the loop of single slices, batches and jobs."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import numpy as np

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.coupling_steps import CouplingSteps, run_coupling_steps
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.stepping import Stepping
from sliceit_drake.cutting.workspace import Workspace

__all__ = ["Driver", "DriverPool", "Launch", "even_launches"]

Item = TypeVar("Item")
Result = TypeVar("Result")


class Launch(NamedTuple):
    """Coupling steps that are advanced at once.

    Attributes:
        first: Number of the first.
        coupling_steps: How many.
        multiple: Duration of each, and of its longest sub-step, relative to the shortest.
    """

    first: int
    coupling_steps: int
    multiple: int = 1


def even_launches(paths: Sequence[KnifePath]) -> Iterator[Launch]:
    """Launches of coupling steps of one duration, as many at once as all paths allow."""
    k, count = 0, max(path.coupling_steps for path in paths)
    while k < count:
        launch = Launch(k, min(path.block(k) for path in paths))
        yield launch
        k += launch.coupling_steps


class Driver:
    """Drives cuts, keeping the device arrays of each mesh for the cuts that come after.

    Not to be used by several threads at once.

    Args:
        exchange_period: Duration of the shortest coupling step, s.
    """

    def __init__(self, exchange_period: float) -> None:
        self.exchange_period = exchange_period
        self._workspaces: dict[tuple, Workspace] = {}

    def workspace(
        self,
        models: Sequence[CuttingModel],
        coupling_steps: int = 1,
        multiple: int = 1,
        substeps: int | None = None,
    ) -> Workspace:
        """Device arrays for cuts that are all derived from one model.

        Args:
            models: The cuts.
            coupling_steps: That are launched at once.
            multiple: Their duration relative to the shortest.
            substeps: Of each; by default as the longest sub-step asks for.

        Raises:
            TimeStepError: The time step does not divide the coupling period.
        """
        period = multiple * self.exchange_period
        step = multiple * models[0].numerics.time_step if substeps is None else period / substeps
        models = [model.with_step(step) for model in models]
        model = models[0]
        size = (len(models), coupling_steps, multiple)
        key = (id(model.split), len(model.relaxing), *size, *vars(model.numerics).values())
        ws = self._workspaces.get(key)
        if ws is None:
            ws = self._workspaces[key] = Workspace(models, period, coupling_steps)
        elif any(old is not new for old, new in zip(ws.models, models, strict=True)):
            ws.set_models(models)
        return ws

    def run(
        self,
        paths: Sequence[KnifePath],
        launches: Iterable[Launch] | None = None,
        board: Board | None = None,
    ) -> Iterator[tuple[Launch, list[CouplingSteps]]]:
        """Drives uncut foods side by side, each with the sub-steps that `Stepping` asks for.

        Where arm or holder give, a launch is repeated until they hold its force. A launch that
        leaves no cut finite is the last.

        Args:
            paths: Of the knives, one a cut; the cuts are all derived from one model.
            launches: Each is taken once the one before it was yielded; `even_launches` by default.
            board: Board under the knives, its height in F; None for none.

        Yields:
            Each launch and what it gives, one a cut. Where sub-steps are shorter than the longest,
            each coupling step is a launch.
        """
        states = np.empty(0)
        for whole in even_launches(paths) if launches is None else launches:
            coarse = self.workspace([path.model for path in paths], multiple=whole.multiple)
            if not len(states):
                states = np.tile(coarse.initial_state(), (len(paths), 1))
            for launch, numbers, stepping in self._parts(paths, whole, states, coarse):
                steps = self._advance(paths, launch, numbers, states, board)
                for step, values in zip(steps, stepping, strict=True):
                    step.state[coarse.layout["stepping"]] = values
                states = np.array([step.state for step in steps])
                yield launch, steps
                if not any(step.finite for step in steps):
                    return

    @staticmethod
    def _parts(
        paths: Sequence[KnifePath], whole: Launch, states: np.ndarray, coarse: Workspace
    ) -> list[tuple[Launch, list[int], np.ndarray]]:
        """A launch, or each of its coupling steps where a cut needs shorter sub-steps.

        Returns:
            Launches, the number of sub-steps of each cut [C], and `stepping` after it
            [C, STEPPING].
        """
        first, count, multiple = whole
        plans = []
        for path, state in zip(paths, states, strict=True):
            rule = Stepping.of(path.model, coarse.substeps)
            before = state[coarse.layout["stepping"]]
            poses = path.poses(first, count, commanded=True)
            plans.append(rule.plan(before, *poses, coarse.exchange_period))
        numbers = [plan[0] for plan in plans]
        after = np.array([plan[1] for plan in plans])
        if all(number == coarse.substeps for some in numbers for number in some):
            return [(whole, [coarse.substeps] * len(paths), after[:, -1])]
        each = zip(*numbers, strict=True)
        return [
            (Launch(first + k, 1, multiple), list(some), after[:, k]) for k, some in enumerate(each)
        ]

    def _advance(
        self,
        paths: Sequence[KnifePath],
        launch: Launch,
        numbers: Sequence[int],
        states: np.ndarray,
        board: Board | None,
    ) -> list[CouplingSteps]:
        """Advances each cut by a launch, with its number of sub-steps."""
        first, count, multiple = launch
        models = [path.model for path in paths]
        steps: list[Any] = [None] * len(paths)
        unbalanced = set(range(len(paths)))
        while unbalanced:
            poses = [path.poses(first, count) for path in paths]
            R, p = (np.array(some) for some in zip(*poses, strict=True))
            for number in sorted({numbers[c] for c in unbalanced}):
                ws = self.workspace(models, count, multiple, number)
                tried = run_coupling_steps(ws, states, R, p)
                for c in unbalanced:
                    if numbers[c] == number:
                        steps[c] = tried[c]
            forces = [step.wrenches[-1].sum(0)[3:] for step in steps]
            last = first + count
            unbalanced = {c for c in unbalanced if not paths[c].balanced(last, forces[c], board)}
        return steps


class DriverPool:
    """Threads that drive cuts, each with a `Driver` that it keeps from one call to the next.

    Args:
        exchange_period: As `Driver`.
        threads: The number of processors by default.
    """

    def __init__(self, exchange_period: float, threads: int | None = None) -> None:
        self.exchange_period = exchange_period
        self.threads = threads or os.cpu_count() or 1
        self._idle: list[Driver] = []

    def map(
        self,
        work: Callable[[Driver, Item], Result],
        items: Sequence[Item],
        threads: int | None = None,
    ) -> Iterator[Result]:
        """Does work on items, in their order, at most as many at once as there are threads."""
        threads = max(1, min(threads or self.threads, len(items)))
        # The last are taken first: those that have device arrays.
        self._idle[:0] = [Driver(self.exchange_period) for _ in range(len(self._idle), threads)]

        def one(item: Item) -> Result:
            driver = self._idle.pop()
            try:
                return work(driver, item)
            finally:
                self._idle.append(driver)

        with ThreadPoolExecutor(threads) as pool:
            yield from pool.map(one, items)
