"""Steps cuts along the paths of their knives: the loop of single slices, batches and jobs."""

import dataclasses as dc
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.coupling_steps import CouplingSteps, run_coupling_steps
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.workspace import Workspace

__all__ = ["Driver", "DriverPool", "Launch", "even_launches"]

Item = TypeVar("Item")
Result = TypeVar("Result")


class Launch(NamedTuple):
    """Coupling steps that are advanced at once.

    Attributes:
        first: Number of the first.
        coupling_steps: How many.
        multiple: Duration of each, and of its sub-step, relative to the shortest.
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

    def workspace(self, models: Sequence[CuttingModel], launch: Launch) -> Workspace:
        """Device arrays for cuts that are all derived from one model."""
        model = models[0]
        size = (len(models), launch.coupling_steps, launch.multiple)
        key = (id(model.split), len(model.relaxing), *size, *dc.astuple(model.numerics))
        ws = self._workspaces.get(key)
        if ws is None:
            period = launch.multiple * self.exchange_period
            ws = self._workspaces[key] = Workspace(models, period, launch.coupling_steps)
        elif any(old is not new for old, new in zip(ws.models, models, strict=True)):
            ws.set_models(models)
        return ws

    def run(
        self,
        paths: Sequence[KnifePath],
        launches: Iterable[Launch] | None = None,
        board: Board | None = None,
    ) -> Iterator[tuple[Launch, list[CouplingSteps]]]:
        """Drives uncut foods side by side.

        Where arm or holder give, a launch is repeated until they hold its force. A launch that
        leaves no cut finite is the last.

        Args:
            paths: Of the knives, one a cut; the cuts are all derived from one model.
            launches: Each is taken once the one before it was yielded; `even_launches` by default.
            board: Board under the knives, its height in F; None for none.

        Yields:
            Each launch and what it gives, one a cut.
        """
        models = {1: [path.model for path in paths]}
        states = None
        for launch in even_launches(paths) if launches is None else launches:
            m, last = launch.multiple, launch.first + launch.coupling_steps
            if m not in models:
                models[m] = [_with_longer_steps(model, m) for model in models[1]]
            ws = self.workspace(models[m], launch)
            if states is None:
                states = np.tile(ws.initial_state(), (len(paths), 1))
            # A knife whose motion is over rests at its end.
            ends = [
                np.minimum(np.arange(launch.first, last + 1), path.coupling_steps) for path in paths
            ]
            R = np.array([path.R_CK[rows] for path, rows in zip(paths, ends, strict=True)])
            steps: list[CouplingSteps] = []
            unbalanced = list(range(len(paths)))
            while unbalanced:
                p = np.array([path.p_CK[rows] for path, rows in zip(paths, ends, strict=True)])
                tried = run_coupling_steps(ws, states, R, p)
                steps = [tried[c] if c in unbalanced else steps[c] for c in range(len(paths))]
                forces = [step.wrenches[-1].sum(0)[3:] for step in steps]
                unbalanced = [
                    c for c in unbalanced if not paths[c].balanced(last, forces[c], board)
                ]
            yield launch, steps
            if not any(step.finite for step in steps):
                return
            states = np.array([step.state for step in steps])


def _with_longer_steps(model: CuttingModel, multiple: int) -> CuttingModel:
    step = multiple * model.numerics.time_step
    return model.derive(numerics=dc.replace(model.numerics, time_step=step))


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
