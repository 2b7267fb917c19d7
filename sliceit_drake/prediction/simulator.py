"""Simulates slices, many in parallel, each only once."""

import dataclasses as dc
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.content_store import ContentStore, content_key, source_key
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.driver import Driver, DriverPool, Launch
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.workspace import parameter_row
from sliceit_drake.prediction.clock import BLOCK, Clock, Stretches

__all__ = ["Executor", "Job", "JobResult", "Simulator", "Workers", "run_job"]

KEPT = 4000
"""Results that are kept in memory."""


@dc.dataclass
class Job:
    """A slice to be simulated.

    Attributes:
        model: The cut; its numerics hold the sub-step of coupling steps of one period.
        R, p: Poses X_FK of the knife relative to the food at the ends of the coupling steps
            [E + 1, 3, 3] and [E + 1, 3], metres.
        stretches: Which coupling steps these are.
        name: For messages.
        precision: That the result is kept in, float32 or float64.
        substeps: Numbers of sub-steps of the coupling steps that are taken [E]: those of a job from
            which this one differs a little. None, or those of one that broke down, for those by
            need.
    """

    model: CuttingModel
    R: np.ndarray
    p: np.ndarray
    stretches: Stretches
    name: str = ""
    precision: str = "float32"
    substeps: np.ndarray | None = None

    @property
    def duration(self) -> float:
        """Number of coupling steps, the unit of time in which a job is a motion of the knife."""
        return float(len(self.p) - 1)

    def pose(self, t: float) -> Pose:
        """X_FK after `t` coupling steps."""
        return Pose(self.R[round(t)], self.p[round(t)])


@dc.dataclass
class JobResult:
    """What a job gives.

    Attributes:
        parts: Mean wrenches on the knife by edge, flank pressure, friction, moment about Ko and
            force, in F [E, 3, 6]; none of them is finite where the slice broke down.
        rise: By which an arm that gives stood higher than its command, at the ends [E], metres.
        cut: Fraction of the section that is cut [E]; NaN from where the slice broke down.
        substeps: Of each coupling step [E]; 0 from where the slice broke down.
    """

    parts: np.ndarray
    rise: np.ndarray
    cut: np.ndarray
    substeps: np.ndarray


Executor = Callable[[Sequence[Job], float, Board], Iterable[tuple[int, JobResult]]]
"""Runs jobs, given the period of the shortest coupling step, s, and the board under the knife;
gives their numbers and results, in any order. Jobs of one mesh come in a row."""
Workers = int | Executor | None
"""What simulates: so many threads, as many as there are processors, or an executor of jobs, as
that of a cluster (`prediction.cluster`)."""


def run_job(driver: Driver, job: Job, board: Board) -> JobResult:
    """Simulates a slice."""
    path = KnifePath(job.model, job, 1.0)
    count = path.coupling_steps
    together, multiples = BLOCK if path.rigid else 1, job.stretches.multiples.tolist()
    launches = [Launch(k, together, multiples[k // BLOCK]) for k in range(0, count, together)]
    wrenches, cut = np.zeros((count, 3, 6)), np.full(count, np.nan)
    rise, substeps = np.zeros(count), np.zeros(count, int)
    given = None if job.substeps is None or not job.substeps.all() else [job.substeps]
    for launch, (step,) in driver.run([path], launches, board, given):
        at = slice(launch.first, launch.first + launch.coupling_steps)
        # The last launch may go on beyond the job, with a knife that rests.
        wrenches[at] = step.wrenches[: count - launch.first]
        if step.finite:
            cut[at], substeps[at] = step.cut[: count - launch.first], step.substeps
        else:
            wrenches[:] = np.nan
    if np.isfinite(wrenches).all():
        rise = path.p_FK[1:, 2] - job.p[1:, 2]
    parts = (wrenches.reshape(-1, 3, 2, 3) @ job.model.X_FC_rotation.T).reshape(-1, 3, 6)
    parts, rise, cut = (series.astype(job.precision) for series in (parts, rise, cut))
    return JobResult(parts, rise, cut, substeps)


class Simulator:
    """Runs jobs; keeps what was run, in memory and on disk, by what goes into it.

    Not to be called from several threads at once.

    Args:
        clock: Of the jobs.
        board: Under the knife, its height in F: an arm that gives rests on it, too.
        cache: Folder of results; None for none.
        workers: What simulates.
        kept: Results that are kept in memory.
    """

    def __init__(
        self,
        clock: Clock,
        board: Board,
        cache: Path | None = None,
        workers: Workers = None,
        kept: int = KEPT,
    ) -> None:
        self._clock, self._board = clock, board
        self._store, self._code = ContentStore(cache, kept), source_key(__file__)
        self._geometry: dict[int, tuple[object, str]] = {}
        self.simulated = 0
        if callable(workers):
            self._executor: Executor = workers
        else:
            pool = DriverPool(clock.period, workers)
            self._executor = lambda some, _, board: enumerate(
                pool.map(lambda driver, job: run_job(driver, job, board), some, _threads(some))
            )

    def run(
        self, jobs: Sequence[Job], progress: Callable[[int, int], None] | None = None
    ) -> list[JobResult]:
        """Runs jobs; equal ones once.

        Args:
            jobs: What to simulate.
            progress: Called with the number of jobs done and in all, those found not counted.
        """
        keys = [self._key(job) for job in jobs]
        by_key = dict(zip(keys, jobs, strict=True))
        known = {key: self._store.load(key) for key in by_key}
        results = {key: JobResult(**arrays) for key, arrays in known.items() if arrays is not None}
        missing = [key for key in by_key if key not in results]
        # Those of one mesh in a row, so that few device arrays change hands.
        missing.sort(key=lambda key: id(by_key[key].model.split))
        some = [by_key[key] for key in missing]
        finished = self._executor(some, self._clock.period, self._board) if some else ()
        for done, (number, result) in enumerate(finished, 1):
            results[missing[number]] = result
            self._store.save(missing[number], vars(result), bool(np.isfinite(result.parts).all()))
            self.simulated += 1
            if progress is not None:
                progress(done, len(some))
        return [results[key] for key in keys]

    def _key(self, job: Job) -> str:
        """Hash of all that the result depends on."""
        model = job.model
        known = self._geometry.get(id(model.split))
        if known is None or known[0] is not model.split:
            known = self._geometry[id(model.split)] = (model.split, _geometry_key(model))
        settings = (model.effects, model.knife, model.numerics, self._clock, self._board)
        stretches = job.stretches.ends, job.stretches.multiples
        return content_key(
            *(self._code, known[1], parameter_row(model), model.inertia.matrix.data),
            *(settings, job.R, job.p, *stretches, job.precision, job.substeps),
        )


def _geometry_key(model: CuttingModel) -> str:
    parts = [model.nodes, model.tetrahedra, model.split.points, model.tables.width]
    return content_key(*parts, model.moving, model.board, model.X_FC_rotation, model.X_FC_position)


def _threads(jobs: Sequence[Job]) -> int | None:
    """Threads for jobs: a GPU is busy with one; None for the pool's."""
    return None if all(job.model.numerics.device == "cpu" for job in jobs) else 1
