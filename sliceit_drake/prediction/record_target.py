"""A slice record as a prediction is compared with it: the knife's motion relative to the food, the
force, and what the sensor would show of a predicted one."""

import dataclasses as dc
import functools
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.board import Board, board_wrenches
from sliceit_drake.cutting.foods.effects import Effects
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import GRAVITY, CuttingModel, Numerics
from sliceit_drake.cutting.parameters import get_parameter, with_parameters
from sliceit_drake.prediction.clock import Clock, Stretches
from sliceit_drake.prediction.placement import food_of, is_bare, knife_of, poses_in_food
from sliceit_drake.prediction.series import ForceSeries, SliceFacts
from sliceit_drake.prediction.simulator import JobResult
from sliceit_drake.records.preprocessing import as_measured
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.records.spikes import without_spikes
from sliceit_drake.tables import interpolated

__all__ = ["CHANNELS", "Bench", "Meshing", "RecordTarget", "make_targets"]

CHANNELS = ("force_x", "force_y", "force_z", "torque_y")
"""Compared components, in F: along the edge, normal to the blade, vertical, N; moment about Ko and
Fy, which a draw and a turned sensor change, Nm."""
WRENCH_ROWS = (3, 4, 5, 1)
NORM, VERTICAL = ("force_norm",), ("force_z",)

CLEARANCE = 5e-4
"""Height of the edge over the food from which on the food is computed, beside the range of the
record's own height, metres."""
START, SLOWEST = 0.02, 1e-3
"""Time at a record's start over which its speed is taken, s, and the least that brings the knife
from above the food, m/s."""
CLEAR = 6e-4
"""Height of the edge over the food above which nothing moves fast, metres."""


class Bench(Protocol):
    """What cuts what, as a `calibration.setup.CalibrationSetup` says it."""

    food: Food
    knife: Knife
    numerics: Numerics
    refinement: float
    height_offset: list[float]


@dc.dataclass(frozen=True)
class Meshing:
    """How finely the food is computed, and where.

    Attributes:
        refinement: Elements along an edge, relative to the food's mesh.
        time_step: Sub-step of the shortest coupling step, s.
        precision, device: As in `cutting.model.Numerics`.
    """

    refinement: float = 1.0
    time_step: float = 5e-4
    precision: str = "float32"
    device: str = "cpu"


class RecordTarget:
    """One record: its motion relative to the food and what of it is compared.

    The force is compared by component in F where the record has them, else by its norm or by the
    vertical one. Prediction and measurement went through the same filters:
    `records.preprocessing.as_measured`.

    Args:
        bench: Of which the knife is taken, but for what the record says of it, and the range of the
            record's height: the food is computed wherever a knife within it may touch.
        models: Its cut by meshing; empty without food.
        frame: R_FW and p_WF of a record without food.
        clock: How time is divided.
        near_food: Whether rows are compared only from the first to the last in which the edge comes
            near the food. A zero of the sensor shows in the air; a fit to food has nothing there.

    Raises:
        ConfigurationError: The knife starts in the food, is upside down at it, or never comes near
            it and `near_food` is set.

    Attributes:
        record, models, clock: As given.
        facts: What causes see of it.
        knife: The knife.
        home: Ko where the edge first touches the food, in F [3], metres; 0 without food.
        channels: Names of the compared channels: `CHANNELS`, the first three without a torque,
            "force_z" alone, or "force_norm".
        time: Of the rows [m], s.
        measured: Channels at the rows [m, c], without spikes.
        doubt: Standard deviation by which each of them is doubted, see `without_spikes` [m, c].
        depth: Of the edge below the top of the food at the rows [m], metres.
        phase: Label at the rows [m]; "" for none.
        grid: Even times of the coupling steps [N + 1], s; they begin with the record, or before it
            where that may begin in the food.
        R, p: Pose X_FK at `grid`.
        stretches: Coupling steps that are simulated; None without food in reach.
        height_unknown: Whether the height of the whole record is only known from its force.
        speed_unknown: Whether its speed is known but for a factor.
    """

    def __init__(
        self,
        record: SliceRecord,
        bench: Bench,
        models: dict[Meshing, CuttingModel],
        frame: tuple[Rotation, np.ndarray],
        clock: Clock,
        near_food: bool = False,
    ) -> None:
        self.record, self.models, self.clock = record, models, clock
        self._margin = CLEARANCE + max(abs(v) for v in bench.height_offset)
        self.knife = knife_of(bench.knife, record)
        metadata, unknown = record.metadata, set(record.metadata.unknown)
        self.height_unknown = "p_WK_z" in unknown or "food.position" in unknown
        self.speed_unknown = "motion.speed" in unknown
        if models:
            model = self.model
            R_FW, rotation, p = poses_in_food(record, model)
            self.height_unknown = self.height_unknown or metadata.food.position is None
            self.home = start_pose(model, 0.0).p
            self._top, width = float(self.home[2]), float(np.ptp(model.span))
        else:
            R_FW, origin = frame
            rotation = R_FW * Rotation.from_matrix(record.rotation)
            p = R_FW.apply(record.position - origin)
            self.home, self._top, width = np.zeros(3), 0.0, 0.0
        height = p[:, 2] - self._top
        rows = self._near(height) if near_food else slice(None)
        self.time, self.depth = record.time[rows], -height[rows]
        # It ends with the last row: a knife that stopped there would show weight and speed that it
        # never had.
        first, last = record.time[0], record.time[-1]
        count = max(2, int((last - first) / clock.period + 1e-6))
        before = self._run_in(height[0], p) if models and self.height_unknown else 0
        self.grid = first + clock.period * np.arange(-before, count + 1)
        at = np.clip(self.grid, first, last)
        self.p = interpolated(at, record.time, p)
        self.p += np.minimum(self.grid - first, 0.0)[:, None] * self._first_velocity(p)
        self.R = Slerp(record.time, rotation)(at).as_matrix()
        phase = np.array([""] * len(record), dtype="<U16")
        for label in metadata.motion.phases:
            phase[(record.time >= label.start) & (record.time < label.end)] = label.label
        if len(metadata.motion.phases) and record.time[-1] >= metadata.motion.phases[-1].end:
            phase[-1] = metadata.motion.phases[-1].label
        self.phase = phase[rows]
        self.stretches = self._stretches() if models else None
        self.facts = SliceFacts(
            name=record.name,
            condition=metadata.condition,
            slice_index=metadata.slice_index,
            knife_slices=(
                metadata.slice_index if metadata.knife_slices is None else metadata.knife_slices
            ),
            peeled=bool(metadata.food.peeled),
            food=bool(models),
            height=self._top,
            width=width,
            speed=metadata.motion.speed or 0.0,
            draw_ratio=metadata.motion.draw_ratio or 0.0,
            tared=metadata.wrench.tared != "no",
        )
        if record.force is None:
            self.channels: tuple[str, ...] = NORM if record.force_vertical is None else VERTICAL
            groups = [record.measured_force]
        else:
            self.channels, groups = CHANNELS[:3], [R_FW.apply(record.force)]
            if record.torque is not None:
                self.channels = CHANNELS
                groups.append(R_FW.apply(record.torque)[:, 1:2])
        cleaned = zip(*map(without_spikes, groups), strict=True)
        self.measured, self.doubt = (np.column_stack(parts)[rows] for parts in cleaned)

    @property
    def model(self) -> CuttingModel:
        """The cut, in the first meshing; there is food."""
        return next(iter(self.models.values()))

    @property
    def path(self) -> np.ndarray:
        """Way of the knife so far at the rows [m], metres."""
        steps = np.linalg.norm(np.diff(self.p, axis=0), axis=1)
        return np.interp(self.time, self.grid, np.append(0.0, np.cumsum(steps)))

    def _near(self, height: np.ndarray) -> slice:
        """Rows from before the first to after the last near the food, of heights over it [n]."""
        low = np.flatnonzero(height < self._margin)
        if low.size == 0:
            raise ConfigurationError(
                f"the knife stays {1e3 * height.min():.3g} mm or more above the food",
                source=self.record.source,
                field="p_WK_z",
                fix="Correct food.position or the heights; both are in the world frame, in metres.",
            )
        return slice(max(int(low[0]) - 1, 0), int(low[-1]) + 2)

    def _first_velocity(self, p: np.ndarray) -> np.ndarray:
        """Mean velocity of Ko over the first `START` of the record [3], m/s, of its positions."""
        time = self.record.time
        row = max(1, int(np.searchsorted(time, time[0] + START)))
        row = min(row, len(time) - 1)
        return np.asarray((p[row] - p[0]) / (time[row] - time[0]))

    def _run_in(self, height: float, p: np.ndarray) -> int:
        """Coupling steps before the record, in which a knife whose first height is only known from
        its force comes from above the food as fast as it is then."""
        speed = -float(self._first_velocity(p)[2])
        if height >= self._margin or speed < SLOWEST:
            return 0
        return int(np.ceil((self._margin - height) / (speed * self.clock.period)))

    def _stretches(self) -> Stretches | None:
        height = self.p[:, 2] - self._top
        low = np.flatnonzero(height < self._margin)
        if low.size == 0:
            return None
        if low[0] == 0 and height[0] < 0.0:
            raise ConfigurationError(
                f"the knife starts {-1e3 * height[0]:.3g} mm in the food",
                source=self.record.source,
                field="p_WK_z",
                fix="Record from before the first contact, or correct food.position.",
            )
        upright = self.R[low, 2, 2] < 0.0
        if not upright.all():
            raise ConfigurationError(
                f"the knife is upside down at the food, {self.grid[low[upright.argmin()]]:.4g} s",
                source=self.record.source,
                field="quat_WK_w",
                fix="z of K points from the spine to the edge, down in a cut: correct quat_WK.",
            )
        moved = np.linalg.norm(np.diff(self.p, axis=0), axis=1)
        turned = np.linalg.norm(np.diff(self.R, axis=0), axis=(1, 2)) * 0.5 * self.knife.length
        near = np.minimum(height[:-1], height[1:]) < CLEAR
        way = np.where(near, moved + turned, 0.0)
        last = min(int(low[-1]) + 1, len(self.p) - 1)
        return self.clock.stretches(way, max(int(low[0]) - 1, 0), last)

    def as_cut(self, model: CuttingModel) -> CuttingModel:
        """A cut of the record's food, peeled as it was, by a knife that has cut as many slices."""
        effects, changes = model.effects, {}
        if self.facts.peeled:
            skins = ("effects.skin.toughness", "effects.outside.toughness")
            changes = {name: 0.0 for name in skins if get_parameter(model, name)}
        if effects.entry.dulling and effects.entry.slices != self.facts.knife_slices:
            changes["effects.entry.slices"] = self.facts.knife_slices
        return with_parameters(model, changes) if changes else model

    def moved(self, lower: float, faster: float) -> np.ndarray:
        """Positions of Ko at the grid [N + 1, 3], metres, of a knife that stood lower, metres, and
        moved faster by a factor."""
        return self.home + faster * (self.p - self.home) - np.array([0.0, 0.0, lower])

    def series(
        self, result: JobResult | None, board_wrench: np.ndarray, effects: Effects
    ) -> ForceSeries:
        """The predicted slice on the even grid.

        Args:
            result: Of the food; None where the knife never comes near any.
            board_wrench: From `board` [N, 6].
            effects: Of the food; those that change the force of the cut are not in the result.
        """
        T, n = self.clock.period, len(self.grid) - 1
        parts = {name: np.zeros((n, 6)) for name in ("edge", "normal", "friction")}
        if result is not None:
            assert self.stretches is not None
            ends = self.stretches.ends.astype(float)
            middle = 0.5 * (ends[:-1] + ends[1:])
            wanted = np.arange(n) + 0.5
            known = result.parts.reshape(len(result.parts), 18)
            inside = (wanted > ends[0]) & (wanted < ends[-1])
            values = interpolated(wanted, middle, known)
            values = np.where(inside[:, None], values, 0.0).reshape(n, 3, 6)
            if effects.changes_force:
                speed = np.linalg.norm(np.diff(self.p, axis=0), axis=1) / T
                values, _ = effects.changed(values, self.R[1:, :, 0], speed, T)
            for k, name in enumerate(parts):
                parts[name] = values[:, k]
        parts["board"] = board_wrench
        parts["weight"] = self._weight()
        turn = self.R[1:] @ self.R[:-1].transpose(0, 2, 1)
        turn = turn - turn.transpose(0, 2, 1)
        touching = np.abs(sum(parts[k][:, 3:] for k in ("edge", "normal", "friction", "board")))
        return ForceSeries(
            time=self.grid[1:],
            R=self.R[1:],
            p=self.p[1:],
            v=np.diff(self.p, axis=0) / T,
            w=turn[:, (2, 0, 1), (1, 2, 0)] * (0.5 / T),
            parts=parts,
            depth=self._top - self.p[1:, 2],
            in_contact=touching.max(1) > 1e-9,
            wrench=np.asarray(sum(parts.values())),
        )

    def rise(self, result: JobResult | None) -> np.ndarray:
        """By which an arm that gives stands higher at the grid [N + 1], metres."""
        if result is None or not result.rise.any():
            return np.zeros(len(self.grid))
        assert self.stretches is not None
        ends = self.stretches.ends.astype(float)
        return np.interp(np.arange(len(self.grid)), ends[1:], result.rise)

    def board(self, board: Board, R: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Wrench of a board, its height in F, with the knife at poses X_FK [N + 1, 3, 3] and
        [N + 1, 3], metres, at even times [N, 6], Nm, N."""
        return board_wrenches(board, self.knife, R, p, self.clock.period)

    def _weight(self) -> np.ndarray:
        """Weight of what hangs on the knife, where the record says that it was measured."""
        metadata, n = self.record.metadata, len(self.grid) - 1
        wrench = np.zeros((n, 6))
        mass, center = metadata.tool.mass, metadata.tool.center_of_mass
        if "gravity" not in metadata.wrench.includes or mass is None:
            return wrench
        hangs = np.ones(n, bool)
        if metadata.wrench.tared != "no":
            hangs[:] = False
            middle = self.grid[1:] - 0.5 * self.clock.period
            for phase in metadata.motion.phases:
                if phase.label == "weight":
                    hangs |= (middle >= phase.start) & (middle < phase.end)
        wrench[hangs, 5] = -GRAVITY * mass
        arm = self.R[1:] @ np.array(center or [0.0, 0.0, 0.0])
        wrench[:, :3] = np.cross(arm, wrench[:, 3:])
        return wrench

    def compare(self, wrench: np.ndarray) -> np.ndarray:
        """Channels at the rows [m, c, ...] of wrenches on the grid [N, 6, ...].

        They go through the sensor's filter and the steps of the record, as the measurement did.
        """
        rest = wrench.shape[2:]
        if self.channels == NORM:
            picked = wrench[:, 3:]
        else:
            rows = dict(zip(CHANNELS, WRENCH_ROWS, strict=True))
            picked = wrench[:, [rows[name] for name in self.channels]]
        seen = self._seen(picked.reshape(len(picked), -1))
        seen = seen.reshape(len(self.time), -1, *rest)
        if self.channels == NORM:
            return np.linalg.norm(seen, axis=1, keepdims=True)
        return seen

    def _seen(self, columns: np.ndarray) -> np.ndarray:
        """What would have been measured at the rows [m, k] of series on the grid [N, k].

        A reading stands for the mean over the coupling step that ends with it. Before the first and
        after the last coupling step a force is taken to stay as it is.
        """
        before = np.zeros((2, columns.shape[1])) + columns[:1]
        after = np.zeros((2, columns.shape[1])) + columns[-1:]
        ends = self.grid[0] + self.clock.period * np.arange(-1, len(columns) + 3)
        time, rows = as_measured(
            self.record.metadata, ends, np.concatenate([before, columns, after])
        )
        at = np.clip(np.searchsorted(time, self.time, side="right"), 1, len(time) - 1)
        share = np.clip((self.time - time[at - 1]) / (time[at] - time[at - 1]), 0.0, 1.0)
        return np.asarray(rows[at - 1] + share[:, None] * (rows[at] - rows[at - 1]))

    @property
    def coupling_steps(self) -> np.ndarray:
        """Rows of the grid at which the coupling steps of an even clock end [E + 1]."""
        assert self.stretches is not None
        return self.stretches.ends[self.stretches.ends < len(self.grid)]

    @functools.cached_property
    def operator(self) -> np.ndarray:
        """From forces of `coupling_steps` to what would have been measured at the rows [m, E].

        Filters are linear, so that their effect on each coupling step's force is all there is to
        know."""
        rows = self.coupling_steps[1:] - 1
        series = np.zeros((len(self.grid) - 1, len(rows)))
        series[rows, np.arange(len(rows))] = 1.0
        return self._seen(series)

    @functools.cached_property
    def _weight_seen(self) -> np.ndarray:
        """Force at the rows [m, 3], N, of what hangs on the knife."""
        return self._seen(self._weight()[:, 3:])

    def compare_forces(self, force: np.ndarray) -> np.ndarray:
        """Channels at the rows [m, c] from forces in F of simulated coupling steps [E, 3], N."""
        seen = self.operator @ force + self._weight_seen
        if self.channels == NORM:
            return np.linalg.norm(seen, axis=1)[:, None]
        return seen[:, 2:] if self.channels == VERTICAL else seen

    def adjoint(self, force: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Adjoint of `compare_forces` at `force`: of the channels [m, c] to forces [E, 3]."""
        if self.channels == NORM:
            seen = self.operator @ force + self._weight_seen
            norm = np.maximum(np.linalg.norm(seen, axis=1), 1e-9)[:, None]
            weights = weights * seen / norm
        elif self.channels == VERTICAL:
            weights = weights * np.array([0.0, 0.0, 1.0])
        return np.asarray(self.operator.T @ weights)

    def at_rows(self, mask: np.ndarray) -> np.ndarray:
        """A mask on the grid [N] at the rows [m]."""
        k = np.ceil((self.time - self.grid[0]) / self.clock.period - 1e-6).astype(int) - 1
        return np.asarray(mask[np.clip(k, 0, len(mask) - 1)])

    def rms_error(self, predicted: np.ndarray) -> float:
        """Root mean square over the channels [m, c], N."""
        return float(np.sqrt(np.mean((predicted - self.measured) ** 2)))


def make_targets(
    bench: Bench,
    records: Sequence[SliceRecord],
    meshings: Sequence[Meshing],
    clock: Clock,
    near_food: bool = False,
) -> list[RecordTarget]:
    """Prepares records; those of equal food and knife share their cuts.

    A record without food is placed by the yaw of the others and its own height of the board.

    Raises:
        ConfigurationError: A record cannot be compared, naming file and field.
    """
    known = [r for r in records if r.metadata.food.position is not None]
    cuts: dict[str, dict[Meshing, CuttingModel]] = {}
    targets = []
    for record in records:
        models: dict[Meshing, CuttingModel] = {}
        frame = (Rotation.identity(), np.zeros(3))
        if is_bare(record):
            facts = known[0].metadata.food if known else record.metadata.food
            x, y, z = facts.position or [0.0, 0.0, record.metadata.board_height or 0.0]
            z = z if record.metadata.board_height is None else record.metadata.board_height
            frame = (Rotation.from_euler("z", -(facts.yaw or 0.0)), np.array([x, y, z]))
        else:
            food, knife = food_of(bench.food, record), knife_of(bench.knife, record)
            if record.metadata.food.peeled:
                food.effects.skin.toughness = 0.0
            key = repr((food, knife))
            if key not in cuts:
                cuts[key] = {m: _cut(bench, food, knife, m) for m in meshings}
            models = cuts[key]
        targets.append(RecordTarget(record, bench, models, frame, clock, near_food))
    return targets


def _cut(bench: Bench, food: Food, knife: Knife, meshing: Meshing) -> CuttingModel:
    numerics = dc.replace(
        bench.numerics,
        time_step=meshing.time_step,
        precision=meshing.precision,
        device=meshing.device,
    )
    return make_food_model(food, knife, numerics, bench.refinement * meshing.refinement)
