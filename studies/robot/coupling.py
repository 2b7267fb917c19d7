"""Error of a run against coupling period and plant step.

Runs a scenario at several of both and prints the difference from the finest. Force and path errors
are RMS while the food is cut; the path's is relative to the tracking error.
"""

import argparse
import copy
import dataclasses as dc
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.cli.arguments import add_scenario_arguments, scenario_of
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Scenario
from studies.pages import publish, table

__all__ = ["CouplingCase", "add_arguments", "coupling_study", "coupling_table", "run"]

BIN = 4e-3
COMBINATIONS = (
    (4e-3, 1e-3),
    (2e-3, 1e-3),
    (2e-3, 2.5e-4),
    (1e-3, 1e-3),
    (5e-4, 5e-4),
    (2.5e-4, 2.5e-4),
)
"""Coupling step period and plant step, s; the last is the reference."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    add_scenario_arguments(parser)
    parser.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    scenario = scenario_of(options)
    with tqdm(total=len(COMBINATIONS), desc="runs") as bar:
        cases = coupling_study(scenario, COMBINATIONS, lambda done, _: bar.update(done - bar.n))
    publish(coupling_table(cases), options.output, cases)
    return 0


@dc.dataclass
class CouplingCase:
    """One combination and its difference from the reference, the finest one.

    Attributes:
        exchange_period: s.
        plant_time_step: s.
        force_error: RMS difference of the force on the knife over its RMS, while the food is cut.
        motion_error: RMS difference of the knife's path over the RMS of the tracking error.
        work_error: Largest coupling work error over the work of cutting.
        board_peak: N.
        real_time_factor: Simulated over wall time.
    """

    exchange_period: float
    plant_time_step: float
    force_error: float
    motion_error: float
    work_error: float
    board_peak: float
    real_time_factor: float


def coupling_study(
    scenario: Scenario,
    combinations: Sequence[tuple[float, float]],
    progress: Callable[[int, int], None] | None = None,
) -> list[CouplingCase]:
    """Runs a scenario at several coupling step periods and plant steps.

    The controller keeps its own period, and the food one sub-step, that of the finest coupling
    step, so that only the coupling differs. Forces are compared as means over bins of 4 ms.

    Args:
        scenario: A cut.
        combinations: Coupling step period and plant step, s; the last is the reference.
        progress: Called with the number of runs done and their total.

    Raises:
        ConfigurationError: A run broke off.
    """
    sub_step = min(
        [scenario.numerics.time_step, *(coupling_step for coupling_step, _ in combinations)]
    )
    results: list[tuple[Record, float]] = []
    for done, (coupling_step, step) in enumerate(combinations):
        case = copy.deepcopy(scenario)
        case.measurement = None
        case.exchange_period = coupling_step
        case.robot.plant_time_step = step
        case.numerics.time_step = sub_step
        run = prepare_run(case)
        run.advance()
        if run.stopped:
            raise ConfigurationError(
                f"the run with a coupling step of {coupling_step:g} s broke off: {run.stopped}",
                field="scenario",
                fix="Give a scenario that `sliceit simulate` runs to its end with this step.",
            )
        record = run.record()
        results.append((record, float(record["time"][-1] / run.wall_time)))
        if progress is not None:
            progress(done + 1, len(combinations))
    reference = results[-1][0]
    return [
        _compare(coupling_step, step, record, reference, speed)
        for (coupling_step, step), (record, speed) in zip(combinations, results, strict=True)
    ]


def _compare(
    coupling_step: float, step: float, record: Record, reference: Record, speed: float
) -> CouplingCase:
    bins = np.arange(0.0, reference["time"][-1], BIN)

    def binned(source: Record, values: np.ndarray) -> np.ndarray:
        # A row holds what acted over the coupling step that ends at its time.
        index = np.maximum(np.searchsorted(bins, source["time"] - 1e-9) - 1, 0)
        total = np.zeros((len(bins), values.shape[1]))
        np.add.at(total, index, values)
        return total / np.maximum(np.bincount(index, minlength=len(bins)), 1)[:, None]

    force = binned(record, record.vector("food_wrench_f"))
    true_force = binned(reference, reference.vector("food_wrench_f"))
    cutting = np.linalg.norm(true_force, axis=1) > 0.5
    path = binned(record, record.vector("knife_pose_p"))
    true_path = binned(reference, reference.vector("knife_pose_p"))
    target = binned(reference, reference.vector("target_pose_p"))

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean(values[cutting] ** 2)))

    return CouplingCase(
        exchange_period=coupling_step,
        plant_time_step=step,
        force_error=rms(force - true_force) / rms(true_force),
        motion_error=rms(path - true_path) / rms(true_path - target),
        work_error=float(np.abs(record["coupling_work_error"]).max() / record["energy_work"].max()),
        board_peak=float(record["board_wrench_f_z"].max()),
        real_time_factor=speed,
    )


def coupling_table(cases: Sequence[CouplingCase]) -> str:
    """The cases as a table for people."""
    return table(
        "coupling step [ms] | plant step [ms] | force error | path error | work error"
        " | board peak [N] | x real time",
        (
            (f"{1e3 * c.exchange_period:g}", f"{1e3 * c.plant_time_step:g}")
            + (f"{100 * c.force_error:.2f} %", f"{100 * c.motion_error:.2f} %")
            + (f"{100 * c.work_error:.2f} %", f"{c.board_peak:.2f}", f"{c.real_time_factor:.2f}")
            for c in cases
        ),
    )
