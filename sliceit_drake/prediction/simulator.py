"""Simulates slices, many in parallel, each only once."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sliceit_drake.content_store import ContentStore, content_key, source_key
from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.driver import DriverPool
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.workspace import parameter_row
from sliceit_drake.prediction import jobs as job_module
from sliceit_drake.prediction.clock import Clock
from sliceit_drake.prediction.jobs import Executor, Job, JobResult, run_job

__all__ = ["Simulator", "Workers"]

KEPT = 4000
"""Results that are kept in memory."""

Workers = int | Executor | None
"""What simulates: so many threads, as many as there are processors, or an executor of jobs, as
that of a cluster (`prediction.cluster`)."""


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
        self._store, self._code = ContentStore(cache, kept), source_key(job_module.__file__)
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
        return content_key(
            self._code,
            known[1],
            parameter_row(model),
            (model.effects, model.knife, model.numerics, self._clock, self._board),
            *(
                model.outline,
                job.R,
                job.p,
                job.stretches.ends,
                job.stretches.multiples,
                job.precision,
            ),
        )


def _geometry_key(model: CuttingModel) -> str:
    parts = [model.nodes, model.tetrahedra, model.split.points, model.tables.width]
    return content_key(*parts, model.moving, model.board, model.X_FC_rotation, model.X_FC_position)


def _threads(jobs: Sequence[Job]) -> int | None:
    """Threads for jobs: a GPU is busy with one; None for the pool's."""
    return None if all(job.model.numerics.device == "cpu" for job in jobs) else 1
