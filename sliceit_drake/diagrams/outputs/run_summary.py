"""What a run came to in numbers, with what a user should be warned of: summary.json."""

import dataclasses as dc
import importlib.metadata
import platform
from typing import Protocol

import numpy as np

from sliceit_drake.cutting.foods.food import Food
from sliceit_drake.cutting.mesh.tetrahedra import MeshError
from sliceit_drake.cutting.motion import Motion
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagrams.outputs.figures import CONTACT_THRESHOLD
from sliceit_drake.diagrams.outputs.measurement_comparison import Comparison
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.outputs.sequence_report import slice_reports
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
from sliceit_drake.diagrams.stability import ContactMargin
from sliceit_drake.diagrams.station_interface import Station
from sliceit_drake.systems.contact_monitor import UNSTABLE_GAINS

__all__ = ["FinishedRun", "add_discretization_error", "run_summary", "slice_areas"]

CUT_THROUGH = 0.99
"""Share of a section from which it counts as cut."""
BOARD_REACHED = 5e-4
"""Height of the edge over the board below which a longer way down would not help, m."""


class FinishedRun(Protocol):
    """What a summary needs of a `diagrams.run.Run`."""

    @property
    def scenario(self) -> Scenario: ...
    @property
    def diagram(self) -> ScenarioDiagram: ...
    @property
    def station(self) -> Station: ...
    @property
    def motion(self) -> Motion: ...
    @property
    def contact_margin(self) -> ContactMargin | None: ...
    @property
    def own(self) -> dict[str, str]: ...
    @property
    def wall_time(self) -> float: ...
    @property
    def stopped(self) -> str | None: ...
    @property
    def warnings(self) -> list[str]: ...


def _phase_times(mask: np.ndarray, time: np.ndarray) -> list[float] | None:
    touching = np.flatnonzero(mask)
    return [float(time[touching[0]]), float(time[touching[-1]])] if len(touching) else None


def run_summary(run: FinishedRun, record: Record, comparison: Comparison | None) -> dict:
    """What summary.json says of a run, with None for the discretisation error.

    Args:
        run: Where it is now.
        record: Of the run until now.
        comparison: With a measured force, or None.
    """
    scenario, station = run.scenario, run.station
    time = record["time"]
    food, board = record.vector("food_wrench_f"), record.vector("board_wrench_f")
    norm = np.linalg.norm(food + board, axis=1)
    on_food = np.linalg.norm(food, axis=1) > CONTACT_THRESHOLD
    on_board = np.linalg.norm(board, axis=1) > CONTACT_THRESHOLD
    contact = norm[on_food | on_board]
    summary: dict = {
        "scenario": scenario.name,
        "stopped": run.stopped,
        "contact_margin": run.contact_margin and dc.asdict(run.contact_margin),
        "simulated_time_s": float(time[-1]),
        "wall_time_s": run.wall_time,
        "real_time_factor": float(time[-1] / run.wall_time) if run.wall_time else None,
        "peak_force_N": float(norm.max()),
        "mean_contact_force_N": float(contact.mean()) if len(contact) else 0.0,
        "board_peak_N": float(np.linalg.norm(board, axis=1).max()),
        "board_peak_loss_of_an_impact": station.board_peak_loss,
        "cut_progress": float(record["cut_progress"][-1]),
        "phase_times_s": {
            "food": _phase_times(on_food, time),
            "board": _phase_times(on_board, time),
            "motion": _motion_times(run.motion),
        },
        "settings": {
            "exchange_period_s": scenario.exchange_period,
            "plant_time_step_s": scenario.robot.plant_time_step,
            "seed": scenario.seed,
        },
        "versions": {
            name: importlib.metadata.version(name)
            for name in ("sliceit_drake", "drake", "warp-lang", "numpy")
        }
        | {"python": platform.python_version()},
    }
    if run.own:
        summary["own"] = run.own
    summary |= station.cutting.summary(record)
    if areas := slice_areas(run):
        summary["slices"] = [dc.asdict(report) for report in slice_reports(record, areas)]
    warnings = [*summary.get("warnings", ()), *run.warnings]
    warnings += [each for each in (_not_cut_through(run, record), _clamped(run)) if each]
    warnings += run.scenario.not_simulated()
    if warnings:
        summary["warnings"] = warnings
    if station.estimate_error is not None:
        summary["discretization_error"] = None
    measurement = scenario.measurement
    if comparison is not None and measurement is not None:
        used = np.isfinite(comparison.simulated)
        summary["measurement"] = {
            "file": measurement.file,
            "rms_N": comparison.rms,
            "measured_peak_N": comparison.measured_peak,
            "simulated_peak_N": comparison.simulated_peak,
            "fitted_contact_time_s": comparison.contact_time,
            "height_offset_mm": 1e3 * comparison.contact_time * measurement.speed,
            "compared_to_depth_mm": 1e3 * float(comparison.depth[used].max()),
        }
    return summary


def _motion_times(motion: Motion) -> dict[str, list]:
    """Begin and end of each phase, s; of a phase that occurs again, a list of them."""
    times: dict[str, list] = {}
    for label, begin, end in motion.phases:
        times.setdefault(label, []).append([begin, end])
    return {label: spans[0] if len(spans) == 1 else spans for label, spans in times.items()}


def slice_areas(run: FinishedRun) -> list[float]:
    """Sections of a sequence's slices, m^2; empty without a sequence."""
    return run.station.cutting.section_areas() if run.scenario.sequence is not None else []


def add_discretization_error(run: FinishedRun, summary: dict) -> None:
    """What the estimate says; None stays where the run ended early or a policy led."""
    estimate = run.station.estimate_error
    # A policy would decide otherwise on another mesh.
    if estimate is None or run.stopped is not None or run.diagram.policy is not None:
        return
    try:
        summary["discretization_error"] = dc.asdict(estimate())
    except (CuttingError, MeshError) as problem:
        summary["discretization_error"] = {"relative_rms": None, "problem": str(problem)}


def _clamped(run: FinishedRun) -> str | None:
    """Says that a blade shook in a food which clamps it, and what to change; else None."""
    food = run.scenario.food
    if not (run.stopped or "").startswith(UNSTABLE_GAINS) or not isinstance(food, Food):
        return None
    if food.held_sides != "both":
        return None
    return (
        "the food is held on both sides of the cut and clamps the blade: with "
        "food.held_sides=plus one half can give way"
    )


def _not_cut_through(run: FinishedRun, record: Record) -> str | None:
    """Says that a motion's end left the food uncut, and what to change; None where it did not."""
    scenario, station = run.scenario, run.station
    # Without an estimate the food has no finite elements, or a robot cuts a real one.
    if run.stopped or station.estimate_error is None:
        return None
    if record["time"][-1] < run.motion.duration - 2.0 * scenario.exchange_period:
        return None
    if scenario.sequence is not None:
        shares = [report.cut_share for report in slice_reports(record, slice_areas(run))]
    else:
        shares = [float(record["cut_progress"].max())]
    uncut = [k for k, share in enumerate(shares) if share < CUT_THROUGH]
    if not uncut:
        return None
    which = f"slice {uncut[0] + 1} is" if len(shares) > 1 else "the food is"
    edge = record["knife_pose_p_z"].min() - scenario.board.height
    if scenario.policy is not None or run.diagram.policy is not None:
        fix = "give the policy more time (policy.duration) or depth (policy.press)"
    elif edge > BOARD_REACHED:
        fix = (
            f"lengthen the way down by {1e3 * edge:.1f} mm (motion.segments.0.distance), or leave "
            "motion out, which cuts through"
        )
    else:
        fix = "draw the knife along its edge as it presses (!PressAndDraw), or refine food.shape"
    return (
        f"{which} not cut through: {100 * shares[uncut[0]]:.0f} % of the section is cut, and the "
        f"edge came to {1e3 * max(edge, 0.0):.1f} mm above the board. To cut through, {fix}."
    )
