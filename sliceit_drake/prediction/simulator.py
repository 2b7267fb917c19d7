"""Simulates slices on an uneven clock, many in parallel, each only once."""

import dataclasses as dc
import functools
import hashlib
import os
import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import sliceit_drake.cutting
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.solver import NOT_FINITE, run_exchanges
from sliceit_drake.cutting.workspace import Workspace, parameter_row
from sliceit_drake.prediction import cluster
from sliceit_drake.prediction.clock import BLOCK, Clock, Stretches

__all__ = ["Job", "Run", "Runner", "Simulator", "cutting_source"]

KEPT = 4000
"""Runs that are kept in memory."""


@dc.dataclass
class Job:
    """A slice to be simulated.

    Attributes:
        model: The cut; its numerics hold the sub-step of exchanges of one period.
        R, p: Poses X_FK of the knife relative to the food at the ends of the exchanges
            [E + 1, 3, 3] and [E + 1, 3], metres.
        stretches: Which exchanges these are.
        name: For messages.
    """

    model: CuttingModel
    R: np.ndarray
    p: np.ndarray
    stretches: Stretches
    name: str = ""


@dc.dataclass
class Run:
    """What a job gives.

    Attributes:
        parts: Mean wrenches on the knife by edge, flank pressure, friction, moment about Ko and
            force, in F [E, 3, 6], single precision.
        rise: By which an arm that gives stood higher than its command, at the ends [E], metres.
        failure: Why the slice broke down, or None; nothing is finite then.
    """

    parts: np.ndarray
    rise: np.ndarray
    failure: str | None = None


@dc.dataclass(frozen=True)
class _Poses:
    """Poses by number, as `KnifePath` asks for them with a period of 1."""

    R: np.ndarray
    p: np.ndarray

    @property
    def duration(self) -> float:
        return float(len(self.p) - 1)

    def pose(self, t: float) -> Pose:
        k = round(t)
        return Pose(self.R[k], self.p[k])


class Simulator:
    """Runs jobs; keeps what was run, in memory and on disk, by what goes into it.

    They run in threads; within `cluster.on_cluster`, on the cluster. Not to be called from several
    threads at once.

    Args:
        clock: Of the jobs.
        board: Under the knife, its height in F: an arm that gives rests on it, too.
        cache: Folder of finished runs; None for none.
        workers: Threads.
    """

    def __init__(
        self,
        clock: Clock,
        board: Board,
        cache: Path | None = None,
        workers: int | None = None,
    ) -> None:
        self._clock, self._board, self._cache = clock, board, cache
        self._workers = workers or os.cpu_count() or 1
        self._runners: list[Runner] = []
        self._memory: dict[str, Run] = {}
        self._geometry: dict[int, tuple[object, bytes]] = {}
        self.simulated = 0
        if cache is not None:
            cache.mkdir(parents=True, exist_ok=True)

    def run(
        self, jobs: Sequence[Job], progress: Callable[[int, int], None] | None = None
    ) -> list[Run]:
        """Runs jobs; equal ones once.

        Args:
            jobs: What to simulate.
            progress: Called with the number of runs done and in all, those found not counted.
        """
        keys = [self._key(job) for job in jobs]
        missing: dict[str, Job] = {}
        for key, job in zip(keys, jobs, strict=True):
            if key not in self._memory and key not in missing:
                found = self._load(key)
                if found is None:
                    missing[key] = job
                else:
                    self._memory[key] = found
        # Those of one mesh in a row, so that few device arrays change hands.
        order = sorted(missing.items(), key=lambda item: id(item[1].model.split))
        finished = (
            cluster.run_jobs(order, self._clock.period, self._board)
            if cluster.active()
            else self._in_threads(order)
        )
        for done, (key, run) in enumerate(finished, 1):
            self._memory[key] = run
            if run.failure is None:
                self._save(key, run)
            self.simulated += 1
            if progress is not None:
                progress(done, len(order))
        runs = [self._memory[key] for key in keys]
        while len(self._memory) > KEPT:
            self._memory.pop(next(iter(self._memory)))
        return runs

    def _in_threads(self, order: Sequence[tuple[str, Job]]) -> Iterator[tuple[str, Run]]:
        threads = max(1, min(self._workers, len(order)))
        while len(self._runners) < threads:
            self._runners.append(Runner(self._clock.period, self._board))
        spare: queue.SimpleQueue[Runner] = queue.SimpleQueue()
        for runner in self._runners:
            spare.put(runner)

        def work(item: tuple[str, Job]) -> tuple[str, Run]:
            runner = spare.get()
            try:
                return item[0], runner.run(item[1])
            finally:
                spare.put(runner)

        with ThreadPoolExecutor(threads) as pool:
            yield from pool.map(work, order)

    def _key(self, job: Job) -> str:
        """Hash of all that the result depends on, the cutting code included."""
        model = job.model
        known = self._geometry.get(id(model.split))
        if known is None or known[0] is not model.split:
            parts = [model.nodes, model.tetrahedra, model.split.points, model.tables.width]
            parts += [model.moving, model.board, model.X_FC_rotation, model.X_FC_position]
            digest = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in parts))
            known = self._geometry[id(model.split)] = (model.split, digest.digest())
        h = hashlib.sha256(cutting_source())
        h.update(known[1])
        h.update(parameter_row(model).tobytes())
        h.update(repr((model.effects, model.knife, model.numerics)).encode())
        h.update(repr((self._clock, self._board)).encode())
        for array in (model.outline, job.R, job.p, job.stretches.ends, job.stretches.multiples):
            h.update(np.ascontiguousarray(array).tobytes())
        return h.hexdigest()[:40]

    def _load(self, key: str) -> Run | None:
        if self._cache is None:
            return None
        file = self._cache / f"{key}.npy"
        if not file.exists():
            return None
        rows = np.load(file)
        return Run(rows[:, :18].reshape(-1, 3, 6), rows[:, 18])

    def _save(self, key: str, run: Run) -> None:
        if self._cache is None:
            return
        rows = np.column_stack([run.parts.reshape(len(run.parts), 18), run.rise])
        # A file that is half written must not be found by another process.
        part = self._cache / f"{key}.{os.getpid()}.part"
        with open(part, "wb") as stream:
            np.save(stream, rows)
        os.replace(part, self._cache / f"{key}.npy")


@functools.cache
def cutting_source() -> bytes:
    """Digest of the code that a simulation runs through."""
    folder = Path(sliceit_drake.cutting.__file__).parent
    h = hashlib.sha256()
    for file in (*sorted(folder.rglob("*.py")), Path(__file__)):
        h.update(file.read_bytes())
    return h.digest()


class Runner:
    """Runs one job at a time, keeping the device arrays from one to the next."""

    def __init__(self, period: float, board: Board) -> None:
        self._period, self._board = period, board
        self._workspaces: dict[tuple, Workspace] = {}

    def _workspace(self, model: CuttingModel, multiple: int, exchanges: int) -> Workspace:
        key = (id(model.split), len(model.relaxing), exchanges, *dc.astuple(model.numerics))
        ws = self._workspaces.get(key)
        if ws is None:
            ws = Workspace([model], multiple * self._period, exchanges)
            self._workspaces[key] = ws
        elif ws.models[0] is not model:
            ws.set_models([model])
        return ws

    def run(self, job: Job) -> Run:
        """Runs a job."""
        step = job.model.numerics.time_step
        models = {1: job.model}
        for m in np.unique(job.stretches.multiples).tolist():
            if m not in models:
                numerics = dc.replace(job.model.numerics, time_step=m * step)
                models[m] = job.model.derive(numerics=numerics)
        path = KnifePath(job.model, _Poses(job.R, job.p), 1.0)
        giving = job.model.effects.compliance
        block = 1 if giving.arm > 0.0 or giving.holder > 0.0 else BLOCK
        state = self._workspace(job.model, 1, block).initial_state()
        wrenches = np.zeros((path.exchanges, 3, 6))
        for k in range(0, path.exchanges, block):
            m = int(job.stretches.multiples[k // BLOCK])
            ws = self._workspace(models[m], m, block)
            at = slice(k, k + block + 1)
            balanced = False
            while not balanced:
                (step_,) = run_exchanges(ws, state[None], path.R_CK[None, at], path.p_CK[None, at])
                force = step_.wrenches[-1].sum(0)[3:]
                balanced = path.balanced(k + block, force, self._board)
            state = step_.state
            # Limits on forces can hide a state that is not finite.
            if not (np.isfinite(step_.wrenches).all() and np.isfinite(state).all()):
                nothing = np.full((path.exchanges, 3, 6), np.nan, np.float32)
                return Run(nothing, np.zeros(path.exchanges, np.float32), NOT_FINITE)
            wrenches[k : k + block] = step_.wrenches
        R_FC = job.model.X_FC_rotation
        parts = (wrenches.reshape(-1, 3, 2, 3) @ R_FC.T).reshape(-1, 3, 6)
        rise = path.p_FK[1:, 2] - job.p[1:, 2]
        return Run(parts.astype(np.float32), rise.astype(np.float32))
