"""At which size each effect has a wanted strength against the noise, protocol by protocol.

The strength delta of an effect is the root mean square, over samples in contact and channels, of
what is left of its noise-free change of the readings once base parameters and what is each slice's
own (material, height, the sensor's zero and drift) are refitted to it, over the noise in contact.
In short:

    size_for("rich", "skin", 2.5)          # J/m, or None where no sensible size is that strong
"""

import argparse
import dataclasses as dc
import functools
import inspect
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.content_store import content_key, source_key
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.diagnose import BASE, setup_of_food
from sliceit_drake.diagnosis.evidence.columns import Column, Sensitivities
from sliceit_drake.diagnosis.evidence.linear import USUAL, LinearProblem
from sliceit_drake.diagnosis.evidence.screen import screen
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.registry import all_causes, open_causes
from sliceit_drake.records.slice_record import SliceRecord, write_record
from sliceit_drake.records.validation import load_record, record_files
from sliceit_drake.stand_in import effect as effect_module
from sliceit_drake.stand_in import finite_element_world, sensor_model, session, world
from sliceit_drake.stand_in.effect_registry import EFFECTS, make_effect
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
from sliceit_drake.stand_in.session import Session
from studies.hidden_effects import bench, quiet
from studies.hidden_effects.bench import (
    DIAGNOSIS_REFINEMENT,
    WORLD,
    QuietBench,
    model_food,
    protocol_named,
)
from studies.pages import publish, table

__all__ = [
    "ProtocolSizes",
    "SizeCurve",
    "add_arguments",
    "angles_for",
    "run",
    "size_for",
    "sizes_as_markdown",
]

DELTAS = (0.5, 1.0, 2.0, 2.5, 3.0, 4.0)
"""Strengths that a table shows."""

SEED = 20
"""Seed of the session that noise and variation are taken from."""

LARGEST = 8.0
"""Largest size, of the typical one."""

LIMITS = {
    "stiffness": 0.85,
    "core": 0.9,
    "juice_film": 0.95,
    "section_shape": 0.5,
    "sensor_tilt": 0.5,
    "sensor_gain": 0.6,
    "slice_push_law": 2.0,
    "rate_toughness": 0.35,
    "bulk_relaxation": 0.4,
    "board_height": 1.5e-3,
    "sensor_delay": 0.05,
    "arm_compliance": 2e-4,
}
"""Largest sizes that have a meaning, where these are less than `LARGEST` times the typical one."""

MIDDLE = 2.5
"""Strength at which an effect is compared with the causes."""

ROUNDS = 3
"""In which sizes are tried nearer and nearer to the strengths that are wanted."""
CLOSE = 0.08
"""Relative distance of a size that was computed from one that is wanted, to be good enough."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument(
        "--protocols",
        nargs="+",
        metavar="NAME",
        default=["poor", "rich", "full"],
        help="default: all",
    )
    parser.add_argument("--effects", nargs="+", metavar="NAME", help="default: all")
    parser.add_argument("--cache", metavar="DIR", type=Path, help="keep what was computed there")
    parser.add_argument("--output", metavar="FILE", type=Path, help="also write the table there")


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    effects = options.effects or list(EFFECTS)
    protocols = [ProtocolSizes(name, options.cache) for name in options.protocols]
    with tqdm(total=len(effects) * len(protocols), desc="sizes") as bar:
        text = sizes_as_markdown(protocols, effects, bar.update)
    curves = {sizes.name: [sizes.curve(effect) for effect in effects] for sizes in protocols}
    publish(text, options.output, curves)
    return 0


@dc.dataclass(frozen=True)
class SizeCurve:
    """Strengths of an effect in a protocol.

    Attributes:
        effect: Its name.
        sizes: Increasing, in the effect's unit.
        deltas: Strengths at the sizes.
    """

    effect: str
    sizes: tuple[float, ...]
    deltas: tuple[float, ...]

    @property
    def greatest(self) -> float:
        """Greatest strength at a sensible size."""
        return max(self.deltas, default=0.0)

    def size(self, delta: float) -> float | None:
        """The size of a strength; None where no sensible size reaches it."""
        strengths = np.maximum.accumulate(self.deltas) if self.deltas else np.zeros(0)
        at = int(np.searchsorted(strengths, delta))
        if at == len(strengths):
            return None
        x1, y1 = self.sizes[at], float(strengths[at])
        if at == 0:
            return float(x1 * delta / y1)
        x0, y0 = self.sizes[at - 1], float(strengths[at - 1])
        share = np.log(delta / y0) / np.log(y1 / y0)
        return float(x0 * (x1 / x0) ** share)


class ProtocolSizes:
    """Sizes of effects in a protocol; what was computed is found again by its content.

    Args:
        name: Of a protocol that ships.
        cache: Folder for curves and simulations; None for none.
        settings: How finely the world is computed.
    """

    def __init__(
        self,
        name: str,
        cache: Path | None = None,
        settings: FiniteElementSettings = WORLD,
    ) -> None:
        self.name, self.protocol = name, protocol_named(name)
        self.cache, self.settings = cache, settings
        self._bench = QuietBench(self.protocol, SEED, settings)
        self._curves: dict[str, SizeCurve] = {}

    def curve(self, effect: str) -> SizeCurve:
        """Strengths of an effect at some sizes.

        Raises:
            ConfigurationError: There is no such effect.
        """
        if effect not in EFFECTS:
            raise ConfigurationError(
                f"{effect!r} is no effect", field="effect", fix=f"Give one of {', '.join(EFFECTS)}."
            )
        if effect not in self._curves:
            file = self._file(effect)
            if file is not None and file.exists():
                facts = json.loads(file.read_text(encoding="utf-8"))
                curve = SizeCurve(effect, tuple(facts["sizes"]), tuple(facts["deltas"]))
            else:
                curve = self._compute(effect)
                if file is not None:
                    file.parent.mkdir(parents=True, exist_ok=True)
                    file.write_text(json.dumps(dc.asdict(curve), indent=2) + "\n", encoding="utf-8")
            self._curves[effect] = curve
        return self._curves[effect]

    def _file(self, effect: str) -> Path | None:
        if self.cache is None:
            return None
        modules = (bench, effect_module, finite_element_world, quiet, sensor_model, session, world)
        key = content_key(
            source_key(*map(inspect.getfile, modules), inspect.getfile(EFFECTS[effect])),
            inspect.getsource(ProtocolSizes.strengths),
            *(self.protocol, self.settings, DIAGNOSIS_REFINEMENT),
            *(effect, EFFECTS[effect].typical, LIMITS.get(effect)),
        )
        return self.cache / "sizes" / f"{self.name}_{effect}_{key[:12]}.json"

    @functools.cached_property
    def _null(self) -> tuple[Sensitivities, LinearProblem]:
        """Sensitivities without causes, and the problem of a session with nothing hidden."""
        return self._problem([c for c in all_causes() if c.name in {name for name, *_ in USUAL}])

    @functools.cached_property
    def _plain(self) -> list[SliceRecord]:
        return self._bench.records()

    def _change(self, effect: str, size: float) -> list[np.ndarray]:
        """Change of the channels of each slice [m, c], N and Nm."""
        hidden = self._bench.records([effect], [make_effect(f"{effect}:{size!r}")])
        found, _ = self._null
        turn = Rotation.from_euler("z", -self.protocol.placement.yaw)
        out = []
        for record, changed, plain in zip(found.records, hidden, self._plain, strict=True):
            assert changed.force is not None and plain.force is not None
            columns = turn.apply(changed.force - plain.force)
            if changed.torque is not None and plain.torque is not None:
                torque = turn.apply(changed.torque - plain.torque)
                columns = np.column_stack([columns, torque[:, 1]])
            out.append(columns[:, : len(record.channels)])
        return out

    def strengths(self, effect: str, sizes: Sequence[float]) -> list[float]:
        """Strength of an effect at each size; not finite where the cut breaks down."""
        found, null = self._null
        out = []
        for size in sizes:
            try:
                changes = self._change(effect, size)
            except CuttingError:
                out.append(float("nan"))
                continue
            problem = LinearProblem(_with_column(found, changes), *null.slice_levels)
            column = len(found.columns)
            out.append(effect_in_noise(problem, [column], np.ones(1))[0])
        return out

    @functools.cached_property
    def _full(self) -> tuple[Sensitivities, LinearProblem]:
        """The same session with the sensitivities of all causes."""
        return self._problem(open_causes([p.name for p in BASE]))

    @functools.cached_property
    def _noisy(self) -> list[SliceRecord]:
        """The slices of a session with nothing hidden, as files hold them: a diagnosis of other
        slices then finds what was simulated here."""
        real = Session(self.protocol, seed=SEED, settings=self.settings)
        with tempfile.TemporaryDirectory() as folder:
            for k in range(len(real)):
                write_record(real.record(k), Path(folder) / f"{k:04d}")
            return [load_record(file) for file in record_files(Path(folder))]

    def _problem(self, causes: Sequence[Cause]) -> tuple[Sensitivities, LinearProblem]:
        setup = setup_of_food(model_food(self.protocol), DIAGNOSIS_REFINEMENT)
        found = sensitivities(setup, self._noisy, causes, cache=self.cache, workers=1)
        return found, LinearProblem(found)

    def size_about(self, effect: str, delta: float) -> float:
        """The size of a strength if strength were in proportion to size, from one simulation at the
        typical one; at most the largest that has a meaning."""
        typical = EFFECTS[effect].typical
        (there,) = self.strengths(effect, [typical])
        return min(typical * delta / there, LARGEST * typical, LIMITS.get(effect, np.inf))

    def angles(self, effect: str) -> dict[str, float]:
        """`angles_at` the size of strength `MIDDLE`; of an effect that is never so strong, at its
        greatest."""
        file = self._file(effect)
        if file is not None:
            causes = open_causes([p.name for p in BASE])
            key = content_key([(c.name, c.parameters, c.scan) for c in causes])
            file = file.with_name(f"angles_{file.stem}_{key[:8]}.json")
            if file.exists():
                known: dict[str, float] = json.loads(file.read_text(encoding="utf-8"))
                return known
        curve = self.curve(effect)
        size = curve.size(MIDDLE) or (curve.sizes[-1] if curve.sizes else None)
        if size is None:
            return {}
        out = self.angles_at(effect, size)
        if file is not None:
            file.write_text(json.dumps(out, indent=2) + "\n", encoding="utf-8")
        return out

    def angles_at(self, effect: str, size: float) -> dict[str, float]:
        """Angles in degrees between what an effect of a size leaves and all that each cause of the
        list can do, what is free in any case taken off both: a cause that is near can mimic it."""
        found, null = self._full
        problem = LinearProblem(
            _with_column(found, self._change(effect, size)),
            *null.slice_levels,
        )
        screening = screen(problem, 2)
        hidden = dc.replace(screening.evidence("hidden"), coefficients=[1.0], scan=None)
        return {
            name: screening.angle_to(problem, hidden, name)
            for name in screening.names
            if name != "hidden"
        }

    def _compute(self, effect: str) -> SizeCurve:
        typical = EFFECTS[effect].typical
        largest = min(LARGEST * typical, LIMITS.get(effect, np.inf))
        known: dict[float, float] = {}

        def add(size: float) -> None:
            nonlocal largest
            (delta,) = self.strengths(effect, [size])
            if np.isfinite(delta):
                known[size] = delta
            else:
                largest = min(largest, 0.8 * size)

        add(min(typical, largest))
        for _ in range(ROUNDS):
            curve = _curve(effect, known)
            if curve.greatest <= 1e-6:
                break
            wanted = [self._guess(curve, delta, largest) for delta in (0.5, 1.0, 2.0, 4.0)]
            new: list[float] = []
            for size in wanted:
                near = [*known, *new]
                if all(abs(size / other - 1.0) > CLOSE for other in near):
                    new.append(size)
            for size in new:
                if size <= largest:
                    add(size)
            if not new:
                break
        return _curve(effect, {s: d for s, d in known.items() if s <= largest})

    def _guess(self, curve: SizeCurve, delta: float, largest: float) -> float:
        size = curve.size(delta)
        if size is None:
            # Beyond what is known strength is taken to grow as size.
            size = curve.sizes[-1] * max(delta / curve.greatest, 1.2)
        return min(size, largest)


def _with_column(found: Sensitivities, changes: Sequence[np.ndarray]) -> Sensitivities:
    """With a cause "hidden" that changes records so [m, c]."""
    return dc.replace(
        found,
        columns=[*found.columns, Column("cause", "hidden")],
        records=[
            dc.replace(r, columns=np.concatenate([r.columns, change[:, :, None]], axis=2))
            for r, change in zip(found.records, changes, strict=True)
        ],
    )


def _curve(effect: str, known: dict[float, float]) -> SizeCurve:
    sizes = sorted(known)
    return SizeCurve(effect, tuple(sizes), tuple(known[s] for s in sizes))


@functools.cache
def _sizes(name: str, cache: Path | None) -> ProtocolSizes:
    return ProtocolSizes(name, cache)


def size_for(protocol: str, effect: str, delta: float, cache: Path | None = None) -> float | None:
    """The size at which an effect has a strength in a protocol.

    Args:
        protocol: Name of a protocol that ships.
        effect: Name of an effect.
        delta: Strength.
        cache: Folder in which what was computed is found again.

    Returns:
        In the effect's unit; None where no sensible size reaches it.

    Raises:
        ConfigurationError: There is no such protocol or effect.
    """
    return _sizes(protocol, cache).curve(effect).size(delta)


def angles_for(protocol: str, effect: str, cache: Path | None = None) -> dict[str, float]:
    """`ProtocolSizes.angles` of a protocol that ships."""
    return _sizes(protocol, cache).angles(effect)


def sizes_as_markdown(
    protocols: Sequence[ProtocolSizes],
    effects: Sequence[str],
    progress: Callable[[], object] | None = None,
) -> str:
    """A table of the sizes of effects for `DELTAS`, protocol by protocol."""
    deltas = (f"delta {delta:g}" for delta in DELTAS)
    head = " | ".join(["effect", "unit", "typical", "at typical", *deltas])
    parts = []
    for sizes in protocols:
        rows = []
        for effect in effects:
            curve, kind = sizes.curve(effect), EFFECTS[effect]
            found = (curve.size(delta) for delta in DELTAS)
            at = np.interp(kind.typical, curve.sizes, curve.deltas) if curve.sizes else np.nan
            rows.append(
                (f"`{effect}`", kind.unit, f"{kind.typical:g}", f"{at:.2f}")
                + tuple("not visible" if size is None else f"{size:.3g}" for size in found)
            )
            if progress is not None:
                progress()
        parts.append(f"### {sizes.name}\n\n{table(head, rows)}\n")
    return "\n".join(parts)


def effect_in_noise(
    problem: LinearProblem,
    columns: list[int],
    coefficients: np.ndarray,
    refit_slices: bool = True,
) -> tuple[float, np.ndarray]:
    """Root mean square of what is left of an effect over the in-contact noise.

    Base parameters and what is each record's own are refitted to the noise-free effect, weighted as
    to data; what they cannot take is left. The mean is over all in-contact samples and channels.

    Args:
        problem: The records' moments.
        columns: Numbers of the effect's columns [n].
        coefficients: Of the columns [n], or of each record [R, n].
        refit_slices: Whether what is each record's own is refitted as well. Without, an effect that
            differs between records as slices may differ keeps its size.

    Returns:
        The ratio, and that of each record [R].
    """
    own = problem.own
    variance = problem.variation**2 if refit_slices else np.full(len(own), 1e-12)
    base = problem.base
    moments = problem.moments.gram
    coefficients = np.broadcast_to(coefficients, (len(moments), len(columns)))
    factors, A, b = [], np.zeros((len(base), len(base))), np.zeros(len(base))
    targets = [G[:, columns] @ g for G, g in zip(moments, coefficients, strict=True)]
    for G, target in zip(moments, targets, strict=True):
        factor = cho_factor(G[np.ix_(own, own)] + np.diag(1.0 / np.maximum(variance, 1e-12)))
        factors.append(factor)
        inner = cho_solve(factor, np.column_stack([G[np.ix_(own, base)], target[own]]))
        A += G[np.ix_(base, base)] - G[np.ix_(base, own)] @ inner[:, :-1]
        b += target[base] - G[np.ix_(base, own)] @ inner[:, -1]
    shared = np.linalg.lstsq(A, b, rcond=1e-10)[0] if base else b
    deviation = np.array([noise.deviation for noise in problem.noise])
    squares, counts = np.zeros(len(moments)), np.zeros(len(moments))
    for r, record in enumerate(problem.found.records):
        G, target = moments[r], targets[r]
        of_own = cho_solve(factors[r], target[own] - G[np.ix_(own, base)] @ shared)
        rest = record.columns[:, :, columns] @ coefficients[r]
        rest = rest - record.columns[:, :, base] @ shared - record.columns[:, :, own] @ of_own
        inside = rest[record.in_contact] / deviation
        squares[r], counts[r] = float((inside**2).sum()), inside.size
    by_record = np.sqrt(squares / np.maximum(counts, 1))
    return float(np.sqrt(squares.sum() / max(counts.sum(), 1.0))), by_record
