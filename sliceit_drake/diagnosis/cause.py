"""What a cause is: a small class that changes the prediction of a slice in one way.

A user's own cause is a file with one subclass (docs/reference/causes.md has a complete example).
"""

import dataclasses as dc
from collections.abc import Mapping, Sequence

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.bench_errors import BenchErrors
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.parameters import get_parameter, with_parameters
from sliceit_drake.diagnosis.evidence.columns import RecordSensitivity
from sliceit_drake.prediction.series import ForceSeries, SharedFacts, SliceFacts

__all__ = ["EXPERIMENTS", "FAMILIES", "Cause", "CauseParameter", "Scan", "Values", "check_cause"]

FAMILIES = (
    "material",
    "knife and contact",
    "board, holder, geometry",
    "sensor",
    "robot",
    "numerical",
)

EXPERIMENTS = {
    "air": "move without contact at two speeds in two orientations",
    "speeds": "cut at three speeds over a decade",
    "draw": "cut with a draw of 0, 1 and 3 times the press",
    "hold": "stop half way for some seconds",
    "retract": "withdraw the knife through the cut",
    "second_pass": "pass once more through the open cut",
    "repeats": "repeat the cut in random order",
    "board_press": "press the bare board at two speeds",
    "weight": "hang a known weight on the knife in two orientations",
    "skinned": "cut skinned food, or food of another width",
    "finer": "compute again with half the step and a finer mesh",
}
"""What a cause may name as the experiment that reveals it."""
BENCH = "bench."
MOVING = ("bench.board.height", "bench.arm.", "bench.mounting.")
"""Parameters of the bench that change how the knife moves in the food."""
Values = Mapping[str, float]
"""Parameters of a cause by name and, where there is a scan, its value by its name."""


@dc.dataclass(frozen=True)
class CauseParameter:
    """A number of a cause.

    Attributes:
        name, unit: Of the number.
        size: A size that matters and is plausible before any measurement, from the null.
        low, high: Range.
        null: Value at which the cause is absent.
        adds_to: Dotted name of the parameter of the cut to which it is added, or of the bench, as
            "bench.sensor.gain", in all axes; "" for none.
    """

    name: str
    unit: str
    size: float
    low: float = -np.inf
    high: float = np.inf
    null: float = 0.0
    adds_to: str = ""

    @property
    def one_sided(self) -> bool:
        """Whether the null is a bound, so that the cause can act in one direction alone."""
        return self.null in (self.low, self.high)

    @property
    def step(self) -> float:
        """Its size, in a direction in which it can go from the null."""
        return -self.size if self.null == self.high else self.size

    def within(self, value: float) -> float:
        """The value in the range that is nearest to another."""
        return float(np.clip(value, self.low, self.high))


@dc.dataclass(frozen=True)
class Scan:
    """A number without a meaning where the cause is absent: it is tried at some values.

    Attributes:
        name, unit: Of the number.
        values: What is tried.
        sets: Dotted name of the parameter that it is where the cause is there, as `adds_to`; ""
            for none.
    """

    name: str
    unit: str
    values: tuple[float, ...]
    sets: str = ""


class Cause:
    """One way in which measured slices may differ from the base model.

    Hooks change nothing where all values are at their null. Unless they are overridden, `model` and
    `bench` add each parameter to the one that its `adds_to` names, and the others do nothing. What
    these two change an extended food holds; what `motion` and `wrench` do it cannot.

    Attributes:
        name: Short and unique, with underscores.
        family: One of `FAMILIES`.
        parameters: Its numbers.
        scan: A number that exists only where the cause does, or None.
        per_record: Whether each record has values of its own, as the phase of a vibration.
        alone: Whether it is what a slice has for itself: what its replicates share is not of it.
        searched: Twice the gain in log-likelihood that `adapted` finds where there is nothing.
        by_slice: Whether it goes by which slice of the session or of the knife it is
            (`SliceFacts.slice_index`, `knife_slices`).
        uses_force: Whether its `motion` needs the force of the slice without it.
        absorbed_by: Base parameters that are the same thing: where one of them is free, this is
            no cause but a shift of it. So it is with those that its parameters name.
        signature: What it does to the force, in words.
        experiment: What reveals it, a key of `EXPERIMENTS`.
    """

    name = ""
    family = ""
    parameters: tuple[CauseParameter, ...] = ()
    scan: Scan | None = None
    per_record = False
    alone = False
    searched = 0.0
    by_slice = False
    uses_force = False
    absorbed_by: tuple[str, ...] = ()
    signature = ""
    experiment = ""

    @property
    def simulates(self) -> bool:
        """Whether its slices must be simulated; else it only changes wrenches that are there."""
        moves = any(p.adds_to.startswith(MOVING) for p in self.parameters)
        return self.changes_model or moves or type(self).motion is not Cause.motion

    @property
    def changes_model(self) -> bool:
        """Whether it acts in the cut."""
        adds = any(p.adds_to and not p.adds_to.startswith(BENCH) for p in self.parameters)
        return type(self).model is not Cause.model or adds

    @property
    def expressible(self) -> bool:
        """Whether a food with its bench can hold all that it does."""
        hooks = type(self).motion, type(self).wrench
        return not self.per_record and hooks == (Cause.motion, Cause.wrench)

    @property
    def adapts(self) -> bool:
        """Whether it looks at the records first, for where to look more closely."""
        return type(self).adapted is not Cause.adapted

    def adapted(self, records: Sequence[RecordSensitivity]) -> "Cause":
        """The same cause with its scan, or what else it needs, taken from the residuals.

        A period or a moment cannot be tried at a few values. For causes that act on wrenches alone.
        """
        return self

    def visible(self, facts: SliceFacts) -> SliceFacts:
        """Facts of a slice, without those that the cause does not go by."""
        return facts if self.by_slice else SharedFacts.of(facts)

    def parameter(self, name: str) -> CauseParameter:
        """One of its parameters."""
        return next(p for p in self.parameters if p.name == name)

    def nulls(self, scan: float | None = None) -> dict[str, float]:
        """Values at which it is absent, and one of its scan, if given."""
        values = {p.name: p.null for p in self.parameters}
        if self.scan is not None and scan is not None:
            values[self.scan.name] = scan
        return values

    def model(self, model: CuttingModel, values: Values, facts: SliceFacts) -> CuttingModel:
        """The cut with the cause in it, derived from the cut without."""
        added, chosen = self._changes(values, False)
        added = {name: float(get_parameter(model, name)) + x for name, x in added.items()}
        return with_parameters(model, added | chosen) if added else model

    def bench(self, bench: BenchErrors, values: Values) -> BenchErrors:
        """The bench with the cause in it."""
        added, chosen = self._changes(values, True)
        return bench.changed(added, chosen) if added else bench

    def _changes(self, values: Values, of_bench: bool) -> tuple[dict[str, float], dict[str, float]]:
        """What is added to parameters of the cut, or of the bench, and what they are set to."""
        added = {
            p.adds_to.removeprefix(BENCH): values[p.name]
            for p in self.parameters
            if p.adds_to and p.adds_to.startswith(BENCH) == of_bench and values[p.name] != p.null
        }
        if self.scan is None or not self.scan.sets or self.scan.sets.startswith(BENCH) != of_bench:
            return added, {}
        return added, {self.scan.sets.removeprefix(BENCH): values[self.scan.name]}

    def absorbed(self, base: Sequence[str]) -> bool:
        """Whether it is the same thing as one of these base parameters."""
        return not {*self.absorbed_by, *(p.adds_to for p in self.parameters)}.isdisjoint(base)

    def motion(
        self,
        R: np.ndarray,
        p: np.ndarray,
        t: np.ndarray,
        values: Values,
        facts: SliceFacts,
        force: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the knife relative to the food.

        Args:
            R, p: As recorded, in F at the coupling steps [N + 1, 3, 3] and [N + 1, 3], metres.
            t: Times [N + 1], s.
            values: Of the cause.
            facts: Of the slice.
            force: Of the slice without the cause, in F at the ends of the coupling steps [N, 3], N;
                None unless the cause has `uses_force`, which costs a simulation more.
        """
        return R, p

    def wrench(self, series: ForceSeries, values: Values, facts: SliceFacts) -> np.ndarray:
        """The wrench as it would be measured [N, 6], from `series.wrench`."""
        return series.wrench


def check_cause(cause: Cause, source: str = "") -> None:
    """Refuses a cause that lacks what every cause has.

    Raises:
        ConfigurationError: Naming the attribute.
    """

    def refuse(attribute: str, problem: str, fix: str) -> ConfigurationError:
        return ConfigurationError(
            problem, source=source, field=f"{type(cause).__name__}.{attribute}", fix=fix
        )

    if not cause.name.isidentifier():
        raise refuse("name", f"is {cause.name!r}", "Give a short name with underscores.")
    if cause.family not in FAMILIES:
        raise refuse("family", f"is {cause.family!r}", f"Give one of {', '.join(FAMILIES)}.")
    if cause.experiment not in EXPERIMENTS:
        raise refuse(
            "experiment", f"is {cause.experiment!r}", f"Give one of {', '.join(EXPERIMENTS)}."
        )
    if cause.adapts and cause.simulates:
        raise refuse("adapted", "is there, and so is model or motion", "Act on the wrench alone.")
    if not cause.parameters:
        raise refuse("parameters", "is empty", "Give at least one CauseParameter.")
    names = [p.name for p in cause.parameters] + ([cause.scan.name] if cause.scan else [])
    if len(set(names)) < len(names):
        raise refuse("parameters", "has a name twice", "Rename one.")
    for p in cause.parameters:
        if not (p.low <= p.null <= p.high and p.size > 0.0 and np.isfinite(p.size)):
            raise refuse(
                f"parameters.{p.name}",
                f"has null {p.null:g}, size {p.size:g} and range {p.low:g} to {p.high:g}",
                "Give a positive size and a null within the range.",
            )
        if cause.scan is not None and not cause.scan.values:
            raise refuse("scan", "has no values", "Give some.")
