"""What a bench does otherwise than is assumed: sensor, tool, board, arm and the food's mounting.

The defaults change nothing. The functions take whole series; systems of a station that go step by
step take the same numbers from here.
"""

import copy
import dataclasses as dc
from collections.abc import Mapping

import numpy as np

from sliceit_drake.configuration import quantity
from sliceit_drake.cutting.model import GRAVITY

__all__ = [
    "BOARD_FORCE",
    "ArmErrors",
    "BenchErrors",
    "BoardErrors",
    "MountingErrors",
    "SensorErrors",
    "ToolErrors",
    "filter_share",
]

BOARD_FORCE = 5.0
"""Force at which `BoardErrors.exponent` changes nothing, N."""


@dc.dataclass
class SensorErrors:
    """A wrench sensor that shows M w(t - delay) + bias + t drift of a wrench w in the knife's axes,
    moment about Ko; M turns by `tilt`, then scales by 1 + `gain`."""

    gain: list[float] = quantity([0.0, 0.0, 0.0], "", low=-0.9, high=5.0, size=3)
    """Share by which force and moment along Kx, Ky, Kz read too much."""
    tilt: list[float] = quantity([0.0, 0.0], "rad", low=-0.5, high=0.5, size=2)
    """Turn about Kx and Ky, by the length of the vector that they are."""
    force_bias: list[float] = quantity([0.0, 0.0, 0.0], "N", low=-100.0, high=100.0, size=3)
    """Zero that is off, along Kx, Ky, Kz."""
    force_drift_rate: list[float] = quantity([0.0, 0.0, 0.0], "N/s", low=-10.0, high=10.0, size=3)
    """By which the zero drifts from the start."""
    delay: float = quantity(0.0, "s", low=0.0, high=0.2)
    """Mean time that a reading is late."""
    delay_stages: int = quantity(1, "", low=1, high=20)
    """Equal low-pass filters in a row that make the delay."""

    def matrix(self) -> np.ndarray:
        """M [3, 3], for the force and for the moment."""
        turn = np.array([*self.tilt, 0.0])
        angle = float(np.linalg.norm(turn))
        R = np.eye(3)
        if angle > 0.0:
            x, y, z = turn / angle
            K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            R = R + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
        return (1.0 + np.array(self.gain))[:, None] * R

    def readings(self, wrench_K: np.ndarray, time: np.ndarray) -> np.ndarray:
        """What is shown [N, 6] of moments and forces in K [N, 6] at even times [N], s."""
        out = (wrench_K.reshape(-1, 2, 3) @ self.matrix().T).reshape(-1, 6)
        share = filter_share(self, float(time[1] - time[0]))
        keep = 1.0 - share
        for _ in range(self.delay_stages if share < 1.0 else 0):
            out = _filtered(share, out, keep * out[:1])
        since = (time - time[0])[:, None]
        out[:, 3:] += np.array(self.force_bias) + since * np.array(self.force_drift_rate)
        return np.asarray(out)


def _filtered(share: float, values: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Each value and what is left of those before it [N, ...], from a state of the filter [1, ...];
    see `scipy.signal.lfilter`."""
    # Slow to load, and needed only here.
    from scipy.signal import lfilter

    return np.asarray(lfilter([share], [1.0, share - 1.0], values, axis=0, zi=state)[0])


def filter_share(sensor: SensorErrors, period: float) -> float:
    """Share of what is new that each filter of the delay takes in a step of `period`, s; a filter
    y += (x - y) / (n + 1) is n steps late."""
    return 1.0 / (1.0 + sensor.delay / sensor.delay_stages / period)


@dc.dataclass
class ToolErrors:
    """A part of the tool, on Kz, that nothing takes off the readings."""

    mass: float = quantity(0.0, "kg", low=-5.0, high=5.0)
    """Its mass; below zero where too much is taken off."""
    moment: float = quantity(0.0, "kg m", low=-1.0, high=1.0)
    """Mass times its place on Kz, from Ko."""

    def wrench(self, R: np.ndarray, v: np.ndarray, period: float, tared: bool) -> np.ndarray:
        """What it adds [N, 6]: weight and inertia, less what there was at the start if `tared`.

        Args:
            R, v: Rotation of the knife [N, 3, 3] and velocity of Ko [N, 3], m/s, z upwards.
            period: Between rows, s.
            tared: Whether the sensor was zeroed before.
        """
        pull = -np.gradient(v, period, axis=0)
        pull[:, 2] -= GRAVITY
        added = np.stack([self.moment * np.cross(R[:, :, 2], pull), self.mass * pull], axis=1)
        if tared:
            added -= np.einsum("nij,kj->nki", R, added[0] @ R[0])
        return added.reshape(-1, 6)


@dc.dataclass
class BoardErrors:
    """A board that lies higher than was measured, with the food on it, or gives otherwise."""

    height: float = quantity(0.0, "m", low=-5e-3, high=5e-3)
    """By which board and food lie higher."""
    stiffness: float = quantity(0.0, "", low=-0.9, high=10.0)
    """Share by which it is stiffer."""
    exponent: float = quantity(0.0, "", low=-0.5, high=1.0)
    """Its force F becomes F (|F| / 5 N)^exponent: it stiffens as it gives."""

    def wrench(self, wrench: np.ndarray) -> np.ndarray:
        """The board's wrench [N, 6] from that of the board as it was assumed."""
        force = np.abs(wrench[:, 5:])
        grown = np.where(force > 0.0, force / BOARD_FORCE, 1.0) ** self.exponent
        return wrench * ((1.0 + self.stiffness) * grown)


@dc.dataclass
class ArmErrors:
    """An arm that gives vertically under the press, unseen by its encoders."""

    compliance: float = quantity(0.0, "m/N", low=0.0, high=1e-3)
    """At once."""
    creep: float = quantity(0.0, "m/N", low=0.0, high=1e-3)
    """Further, with time."""
    creep_time: float = quantity(0.1, "s", low=1e-3, high=100.0)
    """Time in which the creep comes to 1 - 1/e."""

    def rise(self, height: np.ndarray, period: float, force: np.ndarray, food: bool) -> np.ndarray:
        """By how much the knife stands higher [N + 1], metres: over the bare board by all that
        gives; over food by what creeps, for there the cut finds the balance of the rest.

        Args:
            height: Of the edge over the board as commanded, at the ends of the steps [N + 1].
            period: Duration of a step, s.
            force: Upwards on a knife whose arm does not give [N], N.
            food: Whether there is food.
        """
        pressed = np.concatenate([[0.0], np.maximum(force, 0.0)])
        # On the board the force falls as the arm gives, in food next to nothing.
        stiffness = np.where(height < 0.0, pressed / np.maximum(-height, 1e-9), 0.0)
        keep = np.exp(-period / self.creep_time)
        crept = self.creep * pressed / (1.0 + self.creep * stiffness)
        rise = _filtered(1.0 - keep, crept, np.zeros(1))
        if not food:
            given = self.compliance * stiffness
            rise = rise + np.where(height < 0.0, -height * given / (1.0 + given), 0.0)
        return np.asarray(rise)


@dc.dataclass
class MountingErrors:
    """A holder of the food that gives."""

    compliance: float = quantity(0.0, "m/N", low=0.0, high=1e-3)
    """Along the edge."""


@dc.dataclass
class BenchErrors:
    """What a bench does otherwise than is assumed; the defaults are the bench as assumed."""

    sensor: SensorErrors = dc.field(default_factory=SensorErrors)
    tool: ToolErrors = dc.field(default_factory=ToolErrors)
    board: BoardErrors = dc.field(default_factory=BoardErrors)
    arm: ArmErrors = dc.field(default_factory=ArmErrors)
    mounting: MountingErrors = dc.field(default_factory=MountingErrors)

    def changed(self, added: Mapping[str, float], chosen: Mapping[str, float]) -> "BenchErrors":
        """The same with something added to parameters and others set to a value, by dotted names as
        "sensor.gain", in all axes, or "sensor.gain.2"."""
        out = copy.deepcopy(self)
        for names, keep in ((added, 1.0), (chosen, 0.0)):
            for name, value in names.items():
                group, field, *axis = name.split(".")
                owner = getattr(out, group)
                old = getattr(owner, field)
                if isinstance(old, list):
                    axes = [int(k) for k in axis] or range(len(old))
                    old[:] = [x + value if k in axes else x for k, x in enumerate(old)]
                else:
                    setattr(owner, field, type(old)(keep * old + value))
        return out

    def shown(
        self,
        parts: dict[str, np.ndarray],
        R: np.ndarray,
        v: np.ndarray,
        time: np.ndarray,
        tared: bool,
    ) -> np.ndarray:
        """The wrench that is shown [N, 6], moment about Ko and force, in the axes of the parts.

        Args:
            parts: Wrenches on the knife by mechanism, each [N, 6]; "board" is the board's.
            R, v, tared: See `ToolErrors.wrench`.
            time: Even times of the rows [N], s.
        """
        wrench = np.asarray(sum(parts.values()))
        if self.board != BoardErrors():
            wrench = wrench + self.board.wrench(parts["board"]) - parts["board"]
        if self.tool != ToolErrors():
            wrench = wrench + self.tool.wrench(R, v, float(time[1] - time[0]), tared)
        if self.sensor != SensorErrors():
            in_knife = (wrench.reshape(-1, 2, 3) @ R).reshape(-1, 6)
            seen = self.sensor.readings(in_knife, time).reshape(-1, 2, 3)
            wrench = (seen @ R.swapaxes(1, 2)).reshape(-1, 6)
        return wrench
