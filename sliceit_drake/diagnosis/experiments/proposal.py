"""What to cut next, and what to expect of it: as text, plain values and scenarios."""

import dataclasses as dc
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scipy.special import ndtri

from sliceit_drake.configuration import dump_yaml
from sliceit_drake.cutting.planned_slice import PlannedSlice
from sliceit_drake.diagnosis.evidence.verdict import CLASS_ANGLE, DecisionRule
from sliceit_drake.diagnosis.experiments.designs import Experiment

__all__ = ["MARGIN", "NEEDED", "NextExperiment", "Pair", "Step"]

POWER = 0.9
"""Probability with which slices shall tell two causes apart."""
NEEDED = float((ndtri(1.0 - DecisionRule.alarm) + ndtri(POWER)) ** 2)
"""Expected gain that a test at the verdict's level finds with `POWER`."""
MARGIN = 5.0
"""By which the angle shall exceed that of a class, degrees: sizes were estimated."""
WANTED = CLASS_ANGLE + 10.0
"""Angle beyond which more is no better, degrees."""


@dc.dataclass(frozen=True)
class Pair:
    """How two causes of a class part.

    Attributes:
        true, fitted: The one that acts, and the one that is blamed.
        before, after: Angle of the one to all that the other can do, degrees, by the records at
            hand and with the new slices.
        gain: Expected difference of twice the log-likelihood with the new slices.
        gain_per_slice: What one of them adds to it, on average over all of them.
    """

    true: str
    fitted: str
    before: float
    after: float
    gain: float
    gain_per_slice: float

    @property
    def parts(self) -> bool:
        """Whether the one is no longer taken for the other."""
        return bool(self.after >= CLASS_ANGLE + MARGIN and self.gain >= NEEDED)

    @property
    def missing(self) -> float:
        """By how much it is short of `WANTED`, degrees; an angle that noise hides counts less."""
        return WANTED - min(self.after, WANTED) * min(self.gain / NEEDED, 1.0)


@dc.dataclass
class Step:
    """A motion and how many slices of it.

    Attributes:
        experiment: What is done.
        plan: One of the slices.
        slices: How many.
        file: Where it was written; None before.
    """

    experiment: Experiment
    plan: PlannedSlice
    slices: int = DecisionRule.replicates
    file: Path | None = None


@dc.dataclass
class NextExperiment:
    """What to cut next, and what to expect of it.

    Attributes:
        kind: split, explore, repeat or none.
        reason: In a sentence.
        steps: Motions, in order; each for slices of its own.
        pairs: Of the class; empty if there is none to split.
    """

    kind: str
    reason: str
    steps: list[Step] = dc.field(default_factory=list)
    pairs: list[Pair] = dc.field(default_factory=list)

    def lines(self) -> list[str]:
        """For people."""
        out = [f"Next experiment: {self.reason}"]
        for step in self.steps:
            at = f" ({step.file})" if step.file else ""
            out.append(f"  {step.slices} slices of {step.plan.name}{at}: {step.experiment.what}")
            if step.experiment.by_hand:
                out.append(f"    By hand: {step.experiment.by_hand}")
        if self.pairs and self.steps:
            out.append(
                f"  {'acts':20}{'blamed':20}{'angle now':>10}{'then':>6}{'gain a slice':>14}"
            )
            out += [
                f"  {p.true:20}{p.fitted:20}{p.before:10.0f}{p.after:6.0f}{p.gain_per_slice:14.1f}"
                + ("" if p.parts else "  not parted")
                for p in self.pairs
            ]
        return out

    def facts(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "kind": self.kind,
            "reason": self.reason,
            "steps": [
                {
                    "name": s.plan.name,
                    "what": s.experiment.what,
                    "by_hand": s.experiment.by_hand,
                    "slices": s.slices,
                    "file": None if s.file is None else str(s.file),
                }
                for s in self.steps
            ],
            "pairs": [{**dc.asdict(p), "parts": p.parts} for p in self.pairs],
            "gain_needed": NEEDED,
        }

    def write(self, file: Path, scenario_of: Callable[[PlannedSlice], Any]) -> list[Path]:
        """Writes the scenarios: FILE, and FILE_2, FILE_3 beside it for further motions.

        Args:
            file: The first.
            scenario_of: Makes a scenario of a slice (`diagrams.planned_scenario`).

        Returns:
            The files; none where there is nothing to cut.
        """
        file.parent.mkdir(parents=True, exist_ok=True)
        for k, step in enumerate(self.steps):
            step.file = file if k == 0 else file.with_name(f"{file.stem}_{k + 1}{file.suffix}")
        files = [step.file for step in self.steps if step.file is not None]
        for step, own in zip(self.steps, files, strict=True):
            own.write_text(self._text(step, scenario_of(step.plan)), encoding="utf-8")
        return files

    def _text(self, step: Step, scenario: Any) -> str:
        head = [
            f"Next experiment of a diagnosis: {self.reason}",
            f"What: {step.experiment.what}.",
            f"By hand: {step.experiment.by_hand or 'nothing but a fresh cut for each slice'}.",
            f"Slices: {step.slices}.",
        ]
        if len(self.steps) > 1:
            head.append(f"Together with {', '.join(str(s.file) for s in self.steps if s != step)}.")
        for p in self.pairs:
            head.append(
                f"If {p.true} acts and {p.fitted} is blamed: {p.before:.0f} degrees apart by the "
                f"records at hand, {p.after:.0f} with these slices; a slice adds "
                f"{p.gain_per_slice:.1f} to the gain by telling them apart, "
                f"{NEEDED:.0f} are needed."
            )
        head += [
            f"Station:  sliceit simulate {step.file}",
            f"Stand-in: sliceit record {step.file} --replicates {step.slices} --output NEW",
            "Then:     sliceit diagnose OLD NEW --model FOOD --output DIR",
        ]
        text = dump_yaml(scenario, defaults=type(scenario)())
        return "".join(f"# {line}\n" for line in head) + text
