"""A slice record as a diagnosis compares it: all its rows, by component, with or without food."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.board import Board, board_wrenches
from sliceit_drake.cutting.foods.food import make_food_model, start_pose
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import GRAVITY, CuttingModel, Numerics
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.prediction.clock import Clock, Stretches
from sliceit_drake.prediction.placement import food_of, is_bare, knife_of, poses_in_food
from sliceit_drake.prediction.series import ForceSeries, SharedFacts, SliceFacts
from sliceit_drake.prediction.simulator import Run
from sliceit_drake.records.preprocessing import as_measured
from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["CHANNELS", "Meshing", "SliceTarget", "make_targets"]

CHANNELS = ("force_x", "force_y", "force_z", "torque_y")
"""Compared components, in F: along the edge, normal to the blade, vertical, N; moment about Ko and
Fy, which a draw and a turned sensor change, Nm."""
WRENCH_ROWS = (3, 4, 5, 1)

MARGIN = 2e-3
"""Height of the edge over the food from which on the food is computed, metres."""
CLEAR = 6e-4
"""Height of the edge over the food above which nothing moves fast, metres."""


@dc.dataclass(frozen=True)
class Meshing:
    """How finely the food is computed.

    Attributes:
        refinement: Elements along an edge, relative to the food's mesh.
        time_step: Sub-step of the shortest exchange, s.
    """

    refinement: float = 1.0
    time_step: float = 5e-4


class SliceTarget:
    """One record: its motion relative to the food and what of it is compared.

    Attributes:
        record: The record.
        facts: What causes see of it.
        models: Its cut by meshing; empty without food.
        knife: The knife.
        clock: Of the grid.
        home: Ko where the edge first touches the food, in F [3], metres; 0 without food.
        channels: Names of the compared channels: `CHANNELS`, the first three without a torque, or
            "force_norm".
        time: Of the rows [m], s.
        measured: Channels at the rows [m, c].
        depth: Of the edge below the top of the food at the rows [m], metres.
        phase: Label at the rows [m]; "" for none.
        grid: Even times of the exchanges [N + 1], s; row 0 is the first row of the record.
        R, p: Pose X_FK at `grid`.
        stretches: Exchanges that are simulated; None without food in reach.
        height_unknown: Whether the height of the whole record is only known from its force.
        speed_unknown: Whether its speed is known but for a factor.
    """

    def __init__(
        self,
        record: SliceRecord,
        setup: CalibrationSetup,
        models: dict[Meshing, CuttingModel],
        frame: tuple[Rotation, np.ndarray],
        clock: Clock,
        first: Meshing,
    ) -> None:
        self.record, self.models, self.clock = record, models, clock
        self.knife: Knife = knife_of(setup.knife, record)
        metadata = record.metadata
        unknown = set(metadata.unknown)
        self.height_unknown = "p_WK_z" in unknown or "food.position" in unknown
        self.speed_unknown = "motion.speed" in unknown
        if models:
            model = models[first]
            R_FW, rotation, p = poses_in_food(record, model)
            self.height_unknown = self.height_unknown or metadata.food.position is None
            home = start_pose(model, 0.0).p
            top, width = float(home[2]), float(np.ptp(model.span))
        else:
            R_FW, origin = frame
            rotation, p = (
                R_FW * Rotation.from_matrix(record.rotation),
                R_FW.apply(record.position - origin),
            )
            home, top, width = np.zeros(3), 0.0, 0.0
        self.home = home
        T = clock.period
        # Not beyond the last row: a knife that stopped there would show weight and speed that it
        # never had.
        count = max(2, int((record.time[-1] - record.time[0]) / T + 1e-6))
        self.grid = record.time[0] + T * np.arange(count + 1)
        at = np.minimum(self.grid, record.time[-1])
        self.p = np.column_stack([np.interp(at, record.time, column) for column in p.T])
        self.R = Slerp(record.time, rotation)(at).as_matrix()
        self.time = record.time
        self.depth = top - p[:, 2]
        self.phase = np.array([""] * len(record), dtype="<U16")
        for phase in metadata.motion.phases:
            self.phase[(record.time >= phase.start) & (record.time < phase.end)] = phase.label
        if len(metadata.motion.phases) and record.time[-1] >= metadata.motion.phases[-1].end:
            self.phase[-1] = metadata.motion.phases[-1].label
        self._top = top
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
            height=top,
            width=width,
            speed=metadata.motion.speed or 0.0,
            draw_ratio=metadata.motion.draw_ratio or 0.0,
            tared=metadata.wrench.tared != "no",
        )
        if record.force is None:
            self.channels: tuple[str, ...] = ("force_norm",)
            self.measured = record.force_magnitude[:, None]
        else:
            force = R_FW.apply(record.force)
            self.channels, self.measured = CHANNELS[:3], force
            if record.torque is not None:
                self.channels = CHANNELS
                self.measured = np.column_stack([force, R_FW.apply(record.torque)[:, 1]])

    def seen_by(self, cause: Cause) -> SliceFacts:
        """The facts, without those that a cause does not go by."""
        return self.facts if cause.by_slice else SharedFacts.of(self.facts)

    def _stretches(self) -> Stretches | None:
        height = self.p[:, 2] - self._top
        low = np.flatnonzero(height < MARGIN)
        if low.size == 0:
            return None
        if low[0] == 0 and height[0] < 0.0:
            raise ConfigurationError(
                f"the knife starts {-1e3 * height[0]:.3g} mm in the food",
                source=self.record.file or self.record.name,
                field="p_WK_z",
                fix="Record from before the first contact, or correct food.position.",
            )
        moved = np.linalg.norm(np.diff(self.p, axis=0), axis=1)
        turned = np.linalg.norm(np.diff(self.R, axis=0), axis=(1, 2)) * 0.5 * self.knife.length
        near = np.minimum(height[:-1], height[1:]) < CLEAR
        way = np.where(near, moved + turned, 0.0)
        last = min(int(low[-1]) + 1, len(self.p) - 1)
        return self.clock.stretches(way, max(int(low[0]) - 1, 0), last)

    def poses(
        self, stretches: Stretches, R: np.ndarray, p: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses at the ends of exchanges; a knife whose record is over rests."""
        rows = np.minimum(stretches.ends, len(p) - 1)
        return R[rows], p[rows]

    def series(self, run: Run | None, board_wrench: np.ndarray) -> ForceSeries:
        """The predicted slice on the even grid.

        Args:
            run: Of the food; None where the knife never comes near any.
            board_wrench: Of the board, from `board` [N, 6].
        """
        T, n = self.clock.period, len(self.grid) - 1
        parts = {name: np.zeros((n, 6)) for name in ("edge", "normal", "friction")}
        if run is not None:
            assert self.stretches is not None
            ends = self.stretches.ends.astype(float)
            middle = 0.5 * (ends[:-1] + ends[1:])
            wanted = np.arange(n) + 0.5
            known = run.parts.reshape(len(run.parts), 18)
            inside = (wanted > ends[0]) & (wanted < ends[-1])
            values = np.column_stack([np.interp(wanted, middle, c) for c in known.T])
            values = np.where(inside[:, None], values, 0.0)
            for k, name in enumerate(parts):
                parts[name] = values[:, 6 * k : 6 * k + 6]
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

    def rise(self, run: Run | None) -> np.ndarray:
        """By which an arm that gives stands higher at the grid [N + 1], metres."""
        if run is None or not run.rise.any():
            return np.zeros(len(self.grid))
        assert self.stretches is not None
        ends = self.stretches.ends.astype(float)
        return np.interp(np.arange(len(self.grid)), ends[1:], run.rise)

    def board(self, board: Board, R: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Wrench of a board, its height in F, with the knife at poses at the grid [N, 6], Nm, N.

        Args:
            board: The board.
            R, p: Poses X_FK [N + 1, 3, 3] and [N + 1, 3], metres.
        """
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
        if self.channels == ("force_norm",):
            picked = wrench[:, 3:]
        else:
            picked = wrench[:, list(WRENCH_ROWS[: len(self.channels)])]
        columns = picked.reshape(len(picked), -1)
        T = self.clock.period
        before = np.zeros((2, columns.shape[1])) + columns[:1]
        after = np.zeros((2, columns.shape[1])) + columns[-1:]
        ends = self.grid[0] + T * np.arange(-1, len(columns) + 3)
        time, rows = as_measured(
            self.record.metadata, ends, np.concatenate([before, columns, after])
        )
        at = np.clip(np.searchsorted(time, self.time, side="right"), 1, len(time) - 1)
        share = np.clip((self.time - time[at - 1]) / (time[at] - time[at - 1]), 0.0, 1.0)
        seen = rows[at - 1] + share[:, None] * (rows[at] - rows[at - 1])
        seen = seen.reshape(len(self.time), -1, *rest)
        if self.channels == ("force_norm",):
            return np.linalg.norm(seen, axis=1, keepdims=True)
        return seen

    def at_rows(self, mask: np.ndarray) -> np.ndarray:
        """A mask on the grid [N] at the rows [m]."""
        k = np.ceil((self.time - self.grid[0]) / self.clock.period - 1e-6).astype(int) - 1
        return np.asarray(mask[np.clip(k, 0, len(mask) - 1)])


def make_targets(
    setup: CalibrationSetup,
    records: Sequence[SliceRecord],
    meshings: Sequence[Meshing],
    clock: Clock,
) -> list[SliceTarget]:
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
            food, knife = food_of(setup.food, record), knife_of(setup.knife, record)
            if record.metadata.food.peeled:
                food.effects.skin.toughness = 0.0
            key = repr((food, knife))
            if key not in cuts:
                cuts[key] = {
                    m: make_food_model(
                        food,
                        knife,
                        _numerics(setup.numerics, m.time_step),
                        setup.refinement * m.refinement,
                    )
                    for m in meshings
                }
            models = cuts[key]
        targets.append(SliceTarget(record, setup, models, frame, clock, meshings[0]))
    return targets


def _numerics(numerics: Numerics, time_step: float) -> Numerics:
    return dc.replace(numerics, time_step=time_step, precision="float32", device="cpu")
