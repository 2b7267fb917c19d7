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
        substeps: Sequence[np.ndarray] | None = None,
    ) -> Iterator[tuple[Launch, list[CouplingSteps]]]:
        """Drives uncut foods side by side, each with the sub-steps that `Stepping` asks for.

        Where arm or holder give, a launch is repeated until they hold its force. A launch that
        leaves no cut finite is the last.

        Args:
            paths: Of the knives, one a cut; the cuts are all derived from one model.
            launches: Each is taken once the one before it was yielded; `even_launches` by default.
            board: Board under the knives, its height in F; None for none.
            substeps: Numbers that are taken instead, one a coupling step [E] of each cut: those of
                a run from which this one differs a little.

        Yields:
            Each launch and what it gives, one a cut. Where the number of sub-steps changes, each
            coupling step is a launch.
        """
        states = np.empty(0)
        by_substeps: dict[int, list[Stepping]] = {}
        for whole in even_launches(paths) if launches is None else launches:
            coarse = self.workspace([path.model for path in paths], multiple=whole.multiple)
            if not len(states):
                states = np.tile(coarse.initial_state(), (len(paths), 1))
            waiting = [whole]
            if (n := coarse.substeps) not in by_substeps:
                by_substeps[n] = [Stepping.of(path.model, n) for path in paths]
            while waiting:
                launch = waiting.pop(0)
                rules = by_substeps[n]
                steps = self._advance(paths, launch, states, coarse, rules, board, substeps)
                if steps is None:
                    first, count, multiple = launch
                    fewer = 5 if count > 5 and count % 5 == 0 else 1
                    starts = range(first, first + count, fewer)
                    waiting[:0] = [Launch(k, fewer, multiple) for k in starts]
                    continue
                states = np.array([step.state for step in steps])
                yield launch, steps
                if not any(step.finite for step in steps):
                    return

    def _advance(
        self,
        paths: Sequence[KnifePath],
        launch: Launch,
        states: np.ndarray,
        coarse: Workspace,
        rules: Sequence[Stepping],
        board: Board | None,
        substeps: Sequence[np.ndarray] | None,
    ) -> list[CouplingSteps] | None:
        """Advances each cut by a launch; None where several coupling steps need other numbers of
        sub-steps in a cut."""
        first, count, _ = launch
        place, T = coarse.layout["stepping"], coarse.exchange_period
        numbers, after = [], []
        for c, (rule, path) in enumerate(zip(rules, paths, strict=True)):
            poses, given = path.poses(first, count, commanded=True), None
            if substeps is not None:
                # Those of a knife whose motion is over do not matter.
                rows = np.minimum(np.arange(first, first + count), len(substeps[c]) - 1)
                given = substeps[c][rows].tolist()
            planned, stepping = rule.plan(states[c, place], *poses, T, given)
            if count > 1 and any(number != planned[0] for number in planned):
                return None
            numbers.append(planned[-1])
            after.append(stepping[-1])
        steps: list[Any] = [None] * len(paths)
        repeated = set(range(len(paths)))
        while repeated:
            self._balance(paths, launch, numbers, states, board, steps, set(repeated))
            if substeps is not None:
                break
            for c in list(repeated):
                unchanged = list(after[c])
                wanted = rules[c].again(numbers[c], steps[c].added_force.tolist(), after[c])
                if count > 1 and after[c] != unchanged:
                    return None
                if wanted == numbers[c]:
                    repeated.remove(c)
                else:
                    numbers[c] = wanted
                    paths[c].undo(first + 1)
        for step, values in zip(steps, after, strict=True):
            step.state[place] = values
        return steps

    def _balance(
        self,
        paths: Sequence[KnifePath],
        launch: Launch,
        numbers: Sequence[int],
        states: np.ndarray,
        board: Board | None,
        steps: list[Any],
        unbalanced: set[int],
    ) -> None:
        """Advances some cuts by a launch, each with its number of sub-steps, into `steps`."""
        first, count, multiple = launch
        models = [path.model for path in paths]
        while unbalanced:
            poses = [path.poses(first, count) for path in paths]
            R, p = (np.array(some) for some in zip(*poses, strict=True))
            for number in sorted({numbers[c] for c in unbalanced}):
                ws = self.workspace(models, count, multiple, number)
                tried = run_coupling_steps(ws, states, R, p)
                for c in unbalanced:
                    if numbers[c] == number:
                        steps[c] = tried[c]
            last = first + count
            unbalanced = {
                c for c in unbalanced if not paths[c].balanced(last, steps[c].wrench[3:], board)
            }


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
