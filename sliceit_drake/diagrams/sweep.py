"""Many simulated slices that differ in fields of the scenario, and what came of each."""

import csv
import dataclasses as dc
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sliceit_drake.configuration import ConfigurationError, unit_of
from sliceit_drake.cutting.batch import simulate_batch
from sliceit_drake.cutting.bench_errors import BenchErrors
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.mesh.tetrahedra import MeshError
from sliceit_drake.cutting.model import CuttingModel, TimeStepError
from sliceit_drake.cutting.motion import Motion
from sliceit_drake.cutting.parameters import with_parameters
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.cutting.workers import worker_processes
from sliceit_drake.diagrams.outputs.run_log import Record
from sliceit_drake.diagrams.prepared_food import motion_of
from sliceit_drake.diagrams.run import prepare_run
from sliceit_drake.diagrams.scenario import Scenario, load_scenario
from sliceit_drake.overrides import Overrides, plain

if TYPE_CHECKING:
    from distributed import Client
    from matplotlib.figure import Figure

__all__ = ["Sweep", "SweptSlice", "sweep"]

SHARED = ("food.material.", "food.effects.")
"""Fields that may differ among cuts of one mesh, which then share what is prepared of it."""
REFUSALS = (ConfigurationError, CuttingError, MeshError, TimeStepError)
WIDE = 30.0
"""Ratio of the greatest to the least value from which they are drawn on a logarithmic axis."""


@dc.dataclass
class SweptSlice:
    """One slice of a sweep, row by row at the ends of the coupling steps.

    Attributes:
        values: Its values of the fields that were swept.
        time: s [n].
        depth: Of the edge below the top of the food [n], metres.
        force: Of the food on the knife, in W [n, 3], N.
        cut: Fraction of the section that is cut [n].
        stopped: Why it ended early or did not start, or None.
    """

    values: dict[str, Any]
    time: np.ndarray = dc.field(default_factory=lambda: np.zeros(0))
    depth: np.ndarray = dc.field(default_factory=lambda: np.zeros(0))
    force: np.ndarray = dc.field(default_factory=lambda: np.zeros((0, 3)))
    cut: np.ndarray = dc.field(default_factory=lambda: np.zeros(0))
    stopped: str | None = None

    @property
    def peak(self) -> float:
        """Largest norm of the force, N; NaN where there is none."""
        return float(np.linalg.norm(self.force, axis=1).max()) if len(self.force) else np.nan


@dc.dataclass
class Sweep:
    """Slices over a grid of values of a scenario's fields; plots and saves itself.

    Attributes:
        scenario: What they have in common.
        parameters: Values by field, the axes of the grid.
        slices: One for each point of the grid; the last field changes fastest.
        robot: Whether they were cut by the robot, or on the prescribed motion.
    """

    scenario: Scenario
    parameters: dict[str, list]
    slices: list[SweptSlice]
    robot: bool

    @property
    def peaks(self) -> np.ndarray:
        """Largest force of each slice, N, with one axis for each field."""
        shape = [len(values) for values in self.parameters.values()]
        return np.array([each.peak for each in self.slices]).reshape(shape)

    def rows(self) -> list[dict[str, Any]]:
        """One dictionary for each slice: its values, peak_force_N, cut_progress, stopped."""
        return [
            each.values
            | {
                "peak_force_N": each.peak,
                "cut_progress": float(each.cut[-1]) if len(each.cut) else 0.0,
                "stopped": each.stopped,
            }
            for each in self.slices
        ]

    def plot(self) -> "Figure":
        """Force over depth, coloured by the first field, and the peak over that field."""
        from matplotlib import colormaps
        from matplotlib.figure import Figure

        first, *others = self.parameters
        values = self.parameters[first]
        is_number = all(isinstance(value, int | float) for value in values)
        at = np.array(values, float) if is_number else np.arange(len(values), dtype=float)
        colours = colormaps["viridis"](np.linspace(0.0, 0.92, len(values)))
        figure = Figure(figsize=(10.0, 4.2), layout="constrained")
        over_depth, over_value = figure.subplots(1, 2)
        shown = {0, len(values) // 2, len(values) - 1} if len(values) > 6 else range(len(values))
        for each in self.slices:
            k = values.index(each.values[first])
            down = int(np.argmax(each.depth)) + 1 if len(each.depth) else 0
            norm = np.linalg.norm(each.force[:down], axis=1)
            is_named = k in shown and all(each.values[o] == self.parameters[o][0] for o in others)
            label = _text(each.values[first]) if is_named else None
            over_depth.plot(1e3 * each.depth[:down], norm, color=colours[k], lw=1.1, label=label)
        legend = over_depth.legend(title=first, frameon=False, fontsize=8.5)
        legend.get_title().set_fontsize(8.5)
        over_depth.set_xlim(left=-1.0)
        over_depth.set_xlabel("depth of the edge below the food's top [mm]")
        over_depth.set_ylabel("norm of the food's force on the knife [N]")
        name = self.scenario.name.replace("_", " ")
        over_depth.set_title(f"{name}: on the way down", loc="left", fontsize=11)

        peaks = self.peaks.reshape(len(values), -1)
        points = list(itertools.product(*(self.parameters[name] for name in others)))
        for point, peak in zip(points, peaks.T, strict=True):
            label = ", ".join(f"{n} {_text(v)}" for n, v in zip(others, point, strict=True))
            over_value.plot(at, peak, "o-" if is_number else "o", lw=1.1, ms=4, label=label or None)
        if others:
            over_value.legend(frameon=False, fontsize=8.5)
        if is_number and at.min() > 0.0 and at.max() > WIDE * at.min():
            over_value.set_xscale("log")
        if not is_number:
            over_value.set_xticks(at, [_text(value) for value in values])
        unit = unit_of(self.scenario, first)
        over_value.set_xlabel(f"{first} [{unit}]" if unit else first)
        over_value.set_ylabel("peak force [N]")
        over_value.set_title("largest force of each slice", loc="left", fontsize=11)
        for axes in (over_depth, over_value):
            axes.grid(alpha=0.25)
            axes.spines[["top", "right"]].set_visible(False)
        return figure

    def save(self, folder: str | Path) -> None:
        """Writes sweep.csv, a row for each slice, curves.csv with their forces, and sweep.png."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "sweep.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(self.rows()[0]))
            writer.writeheader()
            writer.writerows(self.rows())
        columns = ["slice", "time", "depth", "force_x", "force_y", "force_z", "cut_progress"]
        table = [
            np.column_stack([np.full(len(s.time), k), s.time, s.depth, s.force, s.cut])
            for k, s in enumerate(self.slices)
        ]
        Record(columns, np.concatenate(table)).write_csv(folder / "curves.csv")
        self.plot().savefig(folder / "sweep.png", dpi=150)


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def sweep(
    scenario: str | Path | Scenario,
    parameters: Mapping[str, Iterable[Any]],
    overrides: Overrides = None,
    *,
    robot: bool = True,
    workers: int = 1,
    client: "Client | None" = None,
    progress: Callable[[int, int], None] | None = None,
) -> Sweep:
    """Slices simulated over all combinations of values of a scenario's fields.

    Args:
        scenario: Name of one that ships, such as "cucumber"; a YAML file; or a `Scenario`.
        parameters: Values by field, as `{"food.material.toughness": [200.0, 400.0]}`. Fields are
            paths as for `load_scenario`.
        overrides: What all slices have in common, see `load_scenario`.
        robot: True cuts each slice in the station, as `simulate` does. False moves the knife on
            the scenario's motion exactly, without a robot: several times as fast.
        workers: Processes of the station (a script that asks for several needs Python's
            `if __name__ == "__main__":`), threads without a robot.
        client: Of a Dask cluster that simulates the stations, in place of processes.
        progress: Called with the number of slices done, and that of all.

    Raises:
        ConfigurationError: A field does not exist or a value is out of its range, or the scenario
            has no prescribed cut of finite elements and `robot` is False.
    """
    base = load_scenario(scenario, overrides)
    axes = {name: [plain(value) for value in values] for name, values in parameters.items()}
    if not axes or not all(axes.values()):
        raise ConfigurationError(
            "has no values",
            field="parameters",
            fix='Give some for each field, as {"food.material.toughness": [200.0, 400.0]}.',
        )
    points = [dict(zip(axes, point, strict=True)) for point in itertools.product(*axes.values())]
    scenarios = [load_scenario(base, point) for point in points]
    if not robot:
        found = _on_motion(base, points, scenarios, workers, progress)
    else:
        found = _in_stations(points, scenarios, workers, client, progress)
    return Sweep(base, axes, found, robot)


def _in_stations(
    points: Sequence[dict],
    scenarios: Sequence[Scenario],
    workers: int,
    client: "Client | None",
    progress: Callable[[int, int], None] | None,
) -> list[SweptSlice]:
    with worker_processes(workers) if client is None and workers > 1 else nullcontext() as pool:
        slices: Iterable[SweptSlice]
        if client is not None:
            futures = client.map(_in_station, points, scenarios, pure=False)
            slices = (future.result() for future in futures)
        elif pool is not None:
            slices = pool.map(_in_station, points, scenarios)
        else:
            slices = map(_in_station, points, scenarios)
        done = []
        for each in slices:
            done.append(each)
            if progress is not None:
                progress(len(done), len(points))
        return done


def _in_station(values: dict, scenario: Scenario) -> SweptSlice:
    """A slice that the robot cuts."""
    try:
        run = prepare_run(scenario)
    except REFUSALS as error:
        return SweptSlice(values, stopped=str(error))
    run.advance()
    record = run.record()
    return SweptSlice(
        values,
        record["time"],
        run.station.food_top() - record["knife_pose_p_z"],
        record.vector("food_wrench_f"),
        record["cut_progress"],
        run.stopped,
    )


def _on_motion(
    base: Scenario,
    points: Sequence[dict],
    scenarios: Sequence[Scenario],
    workers: int,
    progress: Callable[[int, int], None] | None,
) -> list[SweptSlice]:
    """Slices of a knife that follows the motion exactly, many at once."""
    for field, stands in (("policy", base.policy), ("sequence", base.sequence)):
        if stands is not None:
            raise ConfigurationError(
                "needs the robot", field=f"scenario.{field}", fix="Leave robot=False out."
            )
    for scenario in scenarios:
        if scenario.bench != BenchErrors():
            raise ConfigurationError(
                "is of a station", field="scenario.bench", fix="Leave it or robot=False out."
            )
    prepared: dict[int, tuple[CuttingModel, Motion]] = {}
    found = [SweptSlice(point) for point in points]
    shared: CuttingModel | None = None
    for k, scenario in enumerate(scenarios):
        food, start = scenario.food, scenario.start
        if not isinstance(food, Food):
            raise ConfigurationError(
                "has no finite elements",
                field="scenario.food",
                fix="Leave robot=False out, or give a food with a shape and a material.",
            )
        try:
            if all(name.startswith(SHARED) for name in points[k]):
                shared = shared or make_food_model(food, scenario.knife, scenario.numerics)
                values = {name.removeprefix("food."): v for name, v in points[k].items()}
                model = with_parameters(shared, values)
            else:
                model = make_food_model(food, scenario.knife, scenario.numerics)
        except REFUSALS as error:
            found[k].stopped = str(error)
            continue
        pose = start_pose(model, start.clearance, start.offset)
        prepared[k] = (model, Motion(motion_of(scenario, model.top), pose))
    # Slices side by side have the period and the board in common.
    groups: dict[str, list[int]] = {}
    for k in prepared:
        key = repr((scenarios[k].exchange_period, scenarios[k].board))
        groups.setdefault(key, []).append(k)
    done = len(points) - len(prepared)
    for members in groups.values():
        scenario = scenarios[members[0]]
        slices = simulate_batch(
            [prepared[k][0] for k in members],
            [prepared[k][1] for k in members],
            scenario.exchange_period,
            dc.replace(scenario.board, height=0.0),
            workers,
            progress and (lambda count, done=done: progress(done + count, len(points))),
        )
        done += len(members)
        R_WF = scenario.X_WF().rotation().matrix()
        for k, cut in zip(members, slices, strict=True):
            depth = prepared[k][0].top - cut.position[:, 2]
            force = cut.food_wrench[:, 3:] @ R_WF.T
            found[k] = SweptSlice(points[k], cut.time, depth, force, cut.cut, cut.failure)
    return found
