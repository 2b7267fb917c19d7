"""Slices to be simulated on an uneven clock."""

import dataclasses as dc
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.driver import Driver, Launch
from sliceit_drake.cutting.knife_path import KnifePath
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.prediction.clock import BLOCK, Stretches

__all__ = ["Executor", "Job", "JobResult", "run_job"]


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
    """

    model: CuttingModel
    R: np.ndarray
    p: np.ndarray
    stretches: Stretches
    name: str = ""
    precision: str = "float32"

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
    """

    parts: np.ndarray
    rise: np.ndarray
    cut: np.ndarray


Executor = Callable[[Sequence[Job], float, Board], Iterable[tuple[int, JobResult]]]
"""Runs jobs, given the period of the shortest coupling step, s, and the board under the knife;
gives their numbers and results, in any order. Jobs of one mesh come in a row."""


def run_job(driver: Driver, job: Job, board: Board) -> JobResult:
    """Simulates a slice."""
    path = KnifePath(job.model, job, 1.0)
    count = path.coupling_steps
    together, multiples = BLOCK if path.rigid else 1, job.stretches.multiples.tolist()
    launches = [Launch(k, together, multiples[k // BLOCK]) for k in range(0, count, together)]
    wrenches, cut = np.zeros((count, 3, 6)), np.full(count, np.nan)
    rise = np.zeros(count)
    for launch, (step,) in driver.run([path], launches, board):
        at = slice(launch.first, launch.first + launch.coupling_steps)
        # The last launch may go on beyond the job, with a knife that rests.
        wrenches[at] = step.wrenches[: count - launch.first]
        if step.finite:
            cut[at] = step.cut[: count - launch.first]
        else:
            wrenches[:] = np.nan
    if np.isfinite(wrenches).all():
        rise = path.p_FK[1:, 2] - job.p[1:, 2]
    parts = (wrenches.reshape(-1, 3, 2, 3) @ job.model.X_FC_rotation.T).reshape(-1, 3, 6)
    return JobResult(*(series.astype(job.precision) for series in (parts, rise, cut)))
