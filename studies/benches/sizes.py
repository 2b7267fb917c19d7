"""How large an effect is on a bench, and what an oracle that knows the law could not tell from it.

The standardised size of an effect is the root mean square, over the rows and channels in which it
acts, of its noise-free change of the records over sqrt(noise^2 + misfit^2), once the base
parameters and each slice's own toughness, modulus, friction and height are refitted to it, by the
law's own derivatives. What goes with speed, draw, slice number or height is as slices themselves
differ (`HiddenEffect.trend`): it is compared with the differences among slices, in the root beside
noise and misfit, in place of being refitted by them.
"""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.stand_in.effect import Effect
from sliceit_drake.stand_in.protocol import section_size
from studies.benches.calibrated import Misfit
from studies.benches.draw import Draw
from studies.benches.effects import HIDDEN
from studies.benches.noise import LEVER
from studies.benches.variation import LEVEL

__all__ = ["Signature", "Sizes"]

ACTS, GREAT = 0.1, 99.0
"""An effect acts in a row and channel from this share of this percentile of its weighted changes
on: a few rows in which the force jumps are not all of it."""
LARGEST = 12.0
"""Greatest size, in typical ones."""
OWN = {"toughness": 0.05, "stiffness": 0.05, "friction": 0.05, "height": 2e-4}
"""Changes by which each slice's own parameters are differentiated: shares, and metres."""
AMBIGUOUS = 20.0
"""Angle of two effects' changes up to which nobody can tell them apart, degrees."""


@dc.dataclass(frozen=True)
class Signature:
    """What is left of an effect's change once what is free is refitted.

    Attributes:
        left: Over sqrt(noise^2 + misfit^2), in all rows and channels of all records [M].
        size: Its standardised size.
        over_noise: The same with the noise alone.
    """

    left: np.ndarray
    size: float
    over_noise: float


class Sizes:
    """Standardised sizes of effects on a bench.

    Args:
        draw: The bench.
        misfit: Of the calibrated simulation there.
    """

    def __init__(self, draw: Draw, misfit: Misfit) -> None:
        self.draw, self.misfit = draw, misfit
        self._plain: dict[tuple[bool, bool], list[np.ndarray]] = {}
        self._free: dict[bool, list[list[np.ndarray]]] = {}
        self._scales: dict[bool, list[np.ndarray]] = {}
        self._signatures: dict[tuple[str, float], Signature] = {}

    def _slices(self, by_slice: bool) -> list[int]:
        """Numbers of the slices that are compared: of each condition the middle one, or all of two
        conditions."""
        if not by_slice:
            return list(self.draw.middle.values())
        kept = [c.label for c in self.draw.protocol.conditions[1:4:2]]
        specimens = self.draw.session(quiet=True).specimens
        return [s.index for s in specimens if s.condition.label in kept]

    def _known(self, by_slice: bool) -> None:
        """Computes plain slices and derivatives of what is free, once."""
        if by_slice in self._free:
            return
        only = self._slices(by_slice)
        plain = self._channels(only)
        self._free[by_slice] = [
            [
                (change - none) / step
                for change, none in zip(
                    self._channels(only, **{name: _moved(name, step)}),
                    plain,
                    strict=True,
                )
            ]
            for name, step in OWN.items()
        ]
        deviation = self.draw.noise.deviation
        noise = deviation * np.array([1.0, 1.0, 1.0, LEVER])
        wrong = np.array(self.misfit.channels)
        # The calibrated simulation is compared in contact; in the air it is right.
        self._scales[by_slice] = [
            np.sqrt(noise**2 + np.outer(np.abs(none).max(1) > 1e-6, wrong**2)) for none in plain
        ]

    def _channels(self, only: Sequence[int], *effects: Effect, **own: float) -> list[np.ndarray]:
        """Forces along x, y, z of F and the torque about its y of slices [m, 4], N and Nm."""
        turn = Rotation.from_euler("z", -self.draw.protocol.placement.yaw)
        out = []
        for record in self.draw.quiet(effects, only, **own):
            assert record.force is not None and record.torque is not None
            out.append(np.column_stack([turn.apply(record.force), turn.apply(record.torque)[:, 1]]))
        return out

    def _change(self, name: str, size: float) -> list[np.ndarray]:
        kind = HIDDEN[name]
        key = kind.by_slice, kind.every_coupling_step
        only = self._slices(kind.by_slice)
        if key not in self._plain:
            # An effect of no size is seen as often as one of some.
            self._plain[key] = self._channels(only, kind(0.0))
        hidden = self._channels(only, kind(size))
        return [a - b for a, b in zip(hidden, self._plain[key], strict=True)]

    def signature(self, name: str, size: float) -> Signature:
        """What an effect of a size leaves; computed once.

        Raises:
            CuttingError: A cut broke down.
        """
        if (name, size) not in self._signatures:
            self._signatures[name, size] = self._signature(name, size)
        return self._signatures[name, size]

    def _signature(self, name: str, size: float) -> Signature:
        kind = HIDDEN[name]
        self._known(kind.by_slice)
        changes, free = self._change(name, size), self._free[kind.by_slice]
        scales = self._scales[kind.by_slice]
        _, height = section_size(self.draw.protocol.food)
        spread = self.draw.variation * np.array([1.0, 1.0, 1.0, LEVEL * height])
        if kind.trend:
            own = [np.stack(columns) for columns in zip(*free, strict=True)]
            varies = [(spread[:, None, None] * c) ** 2 for c in own]
            scales = [np.sqrt(s**2 + v.sum(0)) for s, v in zip(scales, varies, strict=True)]
        weighted = np.concatenate([(d / s).ravel() for d, s in zip(changes, scales, strict=True)])
        columns = [[(c / s).ravel() for c, s in zip(f, scales, strict=True)] for f in free]
        stacked = np.array([np.concatenate(c) for c in columns])
        # The base is material alone: a height that all slices share is nobody's.
        left = _without(weighted, stacked[:3])
        if not kind.trend:
            ends = np.cumsum([0, *(c.size for c in columns[0])])
            left = np.concatenate(
                [
                    _without(weighted[a:b], stacked[:, a:b])
                    for a, b in zip(ends[:-1], ends[1:], strict=True)
                ]
            )
        sizes = np.abs(weighted)
        changed = sizes[sizes > 1e-3 * sizes.max(initial=1e-9)]
        acts = sizes > ACTS * np.percentile(changed, GREAT) if changed.size else sizes > 0.0
        noise = self.draw.noise.deviation * np.array([1.0, 1.0, 1.0, LEVER])
        ratio = np.concatenate([(s / noise).ravel() for s in scales])
        return Signature(left, _rms(left[acts]) if acts.any() else 0.0, _rms((left * ratio)[acts]))

    def size_for(self, name: str, wanted: float) -> tuple[float, Signature] | None:
        """The size at which an effect has a standardised size; None where no sensible one has.

        Args:
            name: Of an effect.
            wanted: Standardised size.
        """
        kind = HIDDEN[name]
        size, limit = kind.typical, min(LARGEST * kind.typical, kind.most)
        found: tuple[float, Signature] | None = None
        for _ in range(6):
            try:
                signature = self.signature(name, size)
            except CuttingError:
                limit = size = 0.7 * size
                continue
            found = size, signature
            if signature.size < 1e-9:
                return None
            if abs(signature.size / wanted - 1.0) < 0.05:
                break
            size = min(size * wanted / signature.size, limit)
        if found is None or abs(found[1].size / wanted - 1.0) > 0.15:
            return None
        return found

    def group(self, name: str, signature: Signature) -> set[str]:
        """Causes whose effects, at their typical sizes, nobody could tell from this one.

        Args:
            name: Of the effect.
            signature: What it leaves.
        """
        kind, out = HIDDEN[name], set(HIDDEN[name].right)
        for other, candidate in HIDDEN.items():
            alike = candidate.by_slice == kind.by_slice and candidate.trend == kind.trend
            if other == name or not candidate.right or not alike:
                continue
            try:
                left = self.signature(other, candidate.typical).left
            except CuttingError:
                continue
            cosine = abs(float(left @ signature.left)) / max(
                float(np.linalg.norm(left) * np.linalg.norm(signature.left)), 1e-12
            )
            if np.degrees(np.arccos(min(cosine, 1.0))) < AMBIGUOUS:
                out |= candidate.right
        return out


def _moved(name: str, step: float) -> float:
    return step if name == "height" else 1.0 + step


def _without(values: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """What least squares with columns [k, M] leave of values [M]."""
    norms = np.linalg.norm(columns, axis=1)
    columns = columns[norms > 1e-9] / norms[norms > 1e-9, None]
    return np.asarray(
        values - columns.T @ (np.linalg.pinv(columns @ columns.T, rcond=1e-10) @ (columns @ values))
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
