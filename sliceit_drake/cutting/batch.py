"""Many slices at once: side by side on a GPU, one a thread on a CPU."""

import dataclasses as dc
import os
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sliceit_drake.cutting.board import Board, board_wrenches
from sliceit_drake.cutting.knife_path import KnifePath, PosedMotion
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.solver import NOT_FINITE, Exchanges, run_exchanges
from sliceit_drake.cutting.workspace import Workspace

__all__ = ["BatchSimulator", "BatchSlice", "simulate_batch"]


@dc.dataclass
class BatchSlice:
    """One slice of a batch. Row k holds the mean over the exchange that ends at time[k].

    Attributes:
        time: s [n].
        position: Of Ko in F [n, 3], metres.
        food_wrench, board_wrench: On the knife, moment about Ko and force, in F [n, 6]; not finite
            from where the slice failed.
        cut: Share of the section that is cut [n].
        failure: Why it failed, or None.
    """

    time: np.ndarray
    position: np.ndarray
    food_wrench: np.ndarray
    board_wrench: np.ndarray
    cut: np.ndarray
    failure: str | None


def simulate_batch(
    models: Sequence[CuttingModel],
    motions: Sequence[PosedMotion],
    exchange_period: float,
    board: Board | None = None,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[BatchSlice]:
    """Simulates slices with parameters and motions of their own; see `BatchSimulator.run`.

    Args:
        models, motions, progress: As `BatchSimulator.run`.
        exchange_period, board, workers: As `BatchSimulator`.

    Raises:
        ValueError: The numbers of models and motions differ.
    """
    return BatchSimulator(exchange_period, board, workers).run(models, motions, progress)


class BatchSimulator:
    """Simulates many slices, keeping device arrays and captured graphs from one call to the next.

    Not to be called from several threads at once.

    Args:
        exchange_period: s.
        board: Board under the knife, its height in F; None for none.
        workers: Threads on a CPU; the number of processors by default.
    """

    def __init__(
        self, exchange_period: float, board: Board | None = None, workers: int | None = None
    ) -> None:
        self._period, self._board = exchange_period, board
        self._workers = workers or os.cpu_count() or 1
        self._runners: dict[tuple, list[_Runner]] = {}

    def run(
        self,
        models: Sequence[CuttingModel],
        motions: Sequence[PosedMotion],
        progress: Callable[[int], None] | None = None,
    ) -> list[BatchSlice]:
        """Simulates slices with parameters and motions of their own.

        Energies are not balanced and the knife's start is not checked, as in `simulate_slice`; a
        slice that breaks down is reported and does not disturb the others. Results do not depend on
        the number of workers.

        Args:
            models: The cuts [C]. Those derived from one model share their device arrays.
            motions: Poses X_FK of the knife [C], or one for all.
            progress: Called with the number of slices done.

        Raises:
            ValueError: The numbers of models and motions differ.
        """
        if len(motions) == 1:
            motions = [motions[0]] * len(models)
        if len(motions) != len(models):
            raise ValueError(f"{len(models)} models and {len(motions)} motions")
        groups: dict[tuple, list[int]] = {}
        for c, model in enumerate(models):
            key: tuple = (id(model.split), len(model.relaxing), *dc.astuple(model.numerics))
            if model.numerics.device != "cpu":
                # Cuts that advance side by side share the skin's tables, and their number is fixed.
                key += (model.effects.skin.thickness,)
            groups.setdefault(key, []).append(c)
        results: list[BatchSlice | None] = [None] * len(models)
        done = 0
        for key, members in groups.items():
            on_cpu = models[members[0]].numerics.device == "cpu"
            jobs = [[c] for c in members] if on_cpu else [members]
            threads = min(len(jobs), self._workers)
            runners = self._runners.setdefault((*key, 1 if on_cpu else len(members)), [])
            while len(runners) < threads:
                runners.append(_Runner(self._period, self._board))
            spare: queue.SimpleQueue[_Runner] = queue.SimpleQueue()
            for runner in runners:
                spare.put(runner)

            def run(job: list[int], spare: "queue.SimpleQueue[_Runner]" = spare) -> None:
                runner = spare.get()
                try:
                    slices = runner.run([models[c] for c in job], [motions[c] for c in job])
                finally:
                    spare.put(runner)
                for c, result in zip(job, slices, strict=True):
                    results[c] = result

            with ThreadPoolExecutor(threads) as pool:
                for job, _ in zip(jobs, pool.map(run, jobs), strict=True):
                    done += len(job)
                    if progress is not None:
                        progress(done)
        return [result for result in results if result is not None]


class _Runner:
    """Runs cuts of one mesh, keeping the device arrays from one call to the next."""

    def __init__(self, exchange_period: float, board: Board | None) -> None:
        self._period = exchange_period
        self._board = board
        self._workspaces: dict[int, Workspace] = {}

    def _workspace(self, models: Sequence[CuttingModel], exchanges: int) -> Workspace:
        ws = self._workspaces.get(exchanges)
        if ws is None:
            ws = self._workspaces[exchanges] = Workspace(models, self._period, exchanges)
        elif any(old is not new for old, new in zip(ws.models, models, strict=True)):
            ws.set_models(models)
        return ws

    def run(
        self, models: Sequence[CuttingModel], motions: Sequence[PosedMotion]
    ) -> list[BatchSlice]:
        """The slices of cuts that advance together."""
        T = self._period
        paths = [KnifePath(m, x, T) for m, x in zip(models, motions, strict=True)]
        count = max(path.exchanges for path in paths)
        states = np.tile(self._workspace(models, 1).initial_state(), (len(models), 1))
        wrenches = np.full((len(models), count, 6), np.nan)
        cut = np.full((len(models), count), np.nan)
        k = 0
        while k < count:
            block = min(path.block(k) for path in paths)
            # A knife whose motion is over rests at its end.
            ends = [np.minimum(np.arange(k, k + block + 1), path.exchanges) for path in paths]
            R = np.array([path.R_CK[e] for path, e in zip(paths, ends, strict=True)])
            ws = self._workspace(models, block)
            steps: dict[int, Exchanges] = {}
            unbalanced = list(range(len(models)))
            while unbalanced:
                p = np.array([path.p_CK[e] for path, e in zip(paths, ends, strict=True)])
                tried = run_exchanges(ws, states, R, p)
                steps |= {c: tried[c] for c in unbalanced}
                unbalanced = [
                    c
                    for c in unbalanced
                    if not paths[c].balanced(
                        k + block, tried[c].wrenches[-1].sum(0)[3:], self._board
                    )
                ]
            for c, step in steps.items():
                states[c] = step.state
                wrenches[c, k : k + block] = step.wrenches.sum(1)
                # Limits on forces can hide a state that is not finite.
                if not np.isfinite(step.state).all():
                    wrenches[c, k : k + block] = np.nan
                cut[c, k : k + block] = step.cut
            k += block
            if not np.isfinite(wrenches[:, k - 1]).any():
                break
        return [
            self._slice(model, path, wrench, share)
            for model, path, wrench, share in zip(models, paths, wrenches, cut, strict=True)
        ]

    def _slice(
        self, model: CuttingModel, path: KnifePath, wrench: np.ndarray, cut: np.ndarray
    ) -> BatchSlice:
        n, T = path.exchanges, self._period
        R_FC = model.X_FC_rotation
        food = (wrench[:n].reshape(n, 2, 3) @ R_FC.T).reshape(n, 6)
        board = np.zeros((n, 6))
        if self._board is not None:
            board = board_wrenches(self._board, model.knife, path.R_FK, path.p_FK, T)
        finite = np.isfinite(food).all(1)
        failure = None
        if not finite.all():
            failure = f"at {(int(finite.argmin()) + 1) * T:.4g} s {NOT_FINITE}"
        time = np.arange(1, n + 1) * T
        return BatchSlice(time, path.p_FK[1:], food, board, cut[:n], failure)
