"""The result of a diagnosis: its table, figures, files and the extended food."""

import dataclasses as dc
import datetime
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sliceit_drake.calibration.setup import CalibrationSetup
from sliceit_drake.configuration import dump_yaml
from sliceit_drake.cutting.foods.calibrated_food import CalibratedFood
from sliceit_drake.cutting.foods.known_error import KnownError
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.confirm import Confirmation, confirm
from sliceit_drake.diagnosis.evidence.held_out import HeldOutGain, held_out_gain, held_out_share
from sliceit_drake.diagnosis.evidence.linear import LinearProblem
from sliceit_drake.diagnosis.evidence.verdict import LAW, Finding, Verdict
from sliceit_drake.diagnosis.experiments.proposal import NextExperiment
from sliceit_drake.diagnosis.extension import extended_food, predicting_by
from sliceit_drake.diagnosis.prediction import SlicePredictor
from sliceit_drake.diagnosis.registry import is_users
from sliceit_drake.diagnosis.report import (
    evidence_figure,
    overview_figure,
    records_figure,
    report_html,
    sentence,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Diagnosis"]

ANOTHER_FOOD = np.log(2.0)
"""Logarithm of a shift of a base parameter, less two standard errors, from which on a cause that
slices share is named only if its file clearly predicts left-out records better."""


@dc.dataclass
class Diagnosis:
    """What a diagnosis found; prints as a table, plots itself, saves to a folder.

    Attributes:
        verdict: The decision and the evidence.
        problem: The records' moments.
        setup: The model that was tested.
        causes: All that were tested, by name.
        shifts: Changes of the base parameters with the verdict's causes in the model, by name:
            factor (log scale) and its standard error.
        gain: Held-out error by the extended food; None if nothing is named that it can hold.
        remarks: What a reader must know.
        confirmation: What simulations with the named causes say; None before, or if none is named
            whose numbers all records share.
        extension: The moments as the extended food predicts them; None as `gain`.
        next_experiment: What to cut next, where that was asked for.
        known: What the food's file says that the simulation gets wrong.
    """

    verdict: Verdict
    problem: LinearProblem
    setup: CalibrationSetup
    causes: dict[str, Cause]
    shifts: dict[str, tuple[float, float]]
    gain: HeldOutGain | None
    remarks: list[str]
    confirmation: Confirmation | None = None
    extension: LinearProblem | None = None
    next_experiment: NextExperiment | None = None
    known: KnownError | None = None

    def confirm(
        self,
        predictor: SlicePredictor,
        seed: int = 0,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Simulates the records with what is named, and measures its worth."""
        findings = self.verdict.findings
        shared = [f for f in findings if not f.evidence.per_record]
        if shared:
            chosen = [(self.causes[f.evidence.name], self.values(f)) for f in shared]
            self.confirmation = confirm(self.problem, predictor, chosen, progress)
        if self.confirmation is not None and self.confirmation.holds:
            factors = self.confirmation.factors
            self.shifts = {n: (factors.get(n, f), error) for n, (f, error) in self.shifts.items()}
        elif self.confirmation is not None:
            self.remarks.append(
                "A simulation with the cause in it gains less than half of what its derivatives "
                "promise: take the values for a direction."
            )
        held = [f for f in findings if self.causes[f.evidence.name].expressible]
        if held:
            food, _ = self._extension(held)
            self.extension = predicting_by(self.problem, predictor, food)
            named = [f.evidence.cause for f in held]
            self.gain = held_out_gain(self.problem, named, seed, self.extension)

    def refuted(self) -> dict[str, str]:
        """Named causes that simulations do not bear out, by name, with the reason: a number ends at
        a bound, the food's file is of another food and the extended one does not clearly predict
        records that were left out better, or it clearly predicts them worse, which is laid to the
        cause with least evidence."""
        named = self.verdict.findings if self.verdict.names else []
        shared = [f for f in named if not f.evidence.per_record]
        out = {}
        for f in shared:
            values, cause = self.values(f), self.causes[f.evidence.name]
            for c in f.evidence.columns:
                away = values[c.parameter] - cause.parameter(c.parameter).null
                if away != 0.0 and not c.low < away < c.high:
                    out[cause.name] = f"a simulation takes {c.parameter} to a bound"
        far = [
            f"{name} times {factor:.2f}"
            for name, (factor, error) in self.shifts.items()
            if abs(np.log(factor)) - 2.0 * error >= ANOTHER_FOOD
        ]
        if not out and far and not (self.gain is not None and self.gain.interval[0] > 0.0):
            return {f.evidence.name: f"the file is of another food: {far[0]}" for f in shared}
        if not out and shared and self.gain is not None and self.gain.interval[1] <= 0.0:
            weakest = min(shared, key=lambda f: f.evidence.gain)
            out[weakest.evidence.name] = "its file predicts records that were left out worse"
        return out

    def values(self, finding: Finding) -> dict[str, float]:
        """Parameters of a finding's cause."""
        e, cause = finding.evidence, self.causes[finding.evidence.name]
        if self.confirmation is not None and e.name in self.confirmation.values:
            return dict(self.confirmation.values[e.name])
        values = cause.nulls(e.scan)
        for column, coefficient in zip(e.columns, e.coefficients, strict=True):
            p = cause.parameter(column.parameter)
            values[p.name] = p.within(p.null + coefficient * column.size)
        return values

    def sentence(self) -> str:
        """The result in a breath."""
        return sentence(self)

    def table(self) -> str:
        """The result in a minute."""
        v, lines = self.verdict, []
        count, kinds = len(self.problem.found.records), len(self.problem.conditions)
        lines.append(f"{count} records of {kinds} condition{'s' * (kinds > 1)}")
        lines.append(f"Verdict: {v.kind.replace('_', ' ')}: {v.reason}")
        for finding in v.findings:
            lines += self._lines(finding)
        lines.append(
            f"The simulation by itself: wrong by {100 * v.own_error:.1f} % of the force, "
            f"{v.misfit:.2f} of the noise, in contact"
        )
        if v.trend is not None:
            lines.append(
                f"With the number of the slice: {v.trend.channel}, by {v.trend.size:.1f} of the "
                f"noise (chance {v.trend.p_value:.3f})"
            )
        if self.gain is not None:
            g = self.gain
            lines.append(
                f"Held-out error of the force: {g.before:.3f} N before, {g.after:.3f} N after, "
                f"noise {g.floor:.3f} N: {100 * g.share:.0f} % of the reducible removed (90 % "
                f"interval {100 * g.interval[0]:.0f} to {100 * g.interval[1]:.0f} %)"
            )
        if v.slices_needed:
            lines.append(
                f"Needed to tell variation from effect: {v.slices_needed} more slices of each "
                "condition"
            )
        if self.next_experiment is not None:
            lines += self.next_experiment.lines()
        lines.append("")
        lines.append(f"{'cause':20}{'gain':>10}{'by chance':>11}{'95 % limit':>12}{'visible':>9}")
        screening = v.screening
        # A user looks for their own cause, whether it matters or not.
        own = [e for e in screening.causes[8:] if is_users(self.causes[e.name])]
        for e in (*screening.causes[:8], *own):
            visible = screening.visible[screening.names.index(e.name)]
            lines.append(
                f"{e.name:20}{e.gain:10.1f}{e.expected:11.1f}{e.limit:12.1f}{visible:9.0f}"
            )
        for name, (factor, error) in self.shifts.items():
            if self._is_understood() and abs(np.log(factor)) > 2.0 * error:
                lines.append(f"Shift of {name}: times {factor:.3f} (+-{error:.3f})")
        return "\n".join(lines + self.remarks)

    def plot_overview(self) -> "Figure":
        """Where the cause shows most, what is left, and evidence and size of each cause."""
        return overview_figure(self)

    def plot(self) -> "Figure":
        """Measured and simulated force of each condition, and what is left."""
        return records_figure(self.problem, self.verdict)

    def plot_evidence(self) -> "Figure":
        """Gain of each cause against chance, and the angles between causes."""
        return evidence_figure(self.verdict.screening)

    def _lines(self, finding: Finding) -> list[str]:
        e, cause = finding.evidence, self.causes[finding.evidence.name]
        values = self.values(finding)
        parts = []
        for c, error in zip(e.columns, e.errors, strict=True):
            spread = f" +- {abs(error * c.size):.2g}" if np.isfinite(error) else ""
            parts.append(f"{c.parameter} = {values[c.parameter]:.3g}{spread} {c.unit}".rstrip())
        word = "Nearest" if self.verdict.kind == "unknown" else "Supported"
        lines = [
            f"  {word}: {e.name} ({cause.family}), {', '.join(parts)}; "
            f"{finding.size:.2f} of noise and own error where it acts, explains "
            f"{100 * finding.share:.0f} % there"
        ]
        if finding.others:
            split = sorted({self.causes[n].experiment for n in finding.names if n != LAW})
            lines.append(
                f"    These records cannot tell it from: {', '.join(finding.others)}. To split "
                f"them: {', '.join(split)}"
            )
            if self.next_experiment is None:
                lines.append("    --next-experiment FILE finds the motion that does, and writes it")
        return lines

    def extended(self) -> CalibratedFood:
        """The food with the named causes and the shifts of the base parameters in it and its bench.

        The note names the causes that it cannot hold.
        """
        findings = self.verdict.findings if self._is_understood() else []
        food, left = self._extension(findings, self._is_understood())
        food.records = [r.name for r in self.problem.found.records]
        food.known_error = self.known
        food.date = datetime.date.today().isoformat()
        food.note = f"Not in this file: {', '.join(left)}." if left else ""
        return food

    def _is_understood(self) -> bool:
        """Whether shifts and causes can be told; what is left, or the slices, may be in them."""
        return self.verdict.kind in ("cause", "causes", "nothing")

    def _extension(
        self, findings: list[Finding], shifted: bool = True
    ) -> tuple[CalibratedFood, list[str]]:
        """See `extended_food`."""
        factors = {name: factor for name, (factor, _) in self.shifts.items() if shifted}
        causes = [(self.causes[f.evidence.name], self.values(f)) for f in findings]
        return extended_food(self.setup, factors, causes)

    def facts(self) -> dict[str, Any]:
        """The result as plain values."""
        v = self.verdict
        return {
            "verdict": v.kind,
            "reason": v.reason,
            "classes": v.names,
            "findings": [
                {
                    "cause": f.evidence.name,
                    "others": f.others,
                    "values": self.values(f),
                    "size_over_noise": f.size,
                    "share_explained": f.share,
                }
                for f in v.findings
            ],
            "own_error": v.own_error,
            "own_error_mostly": [
                {"channel": c, "phase": f, "part": p, "share": s} for c, f, p, s in v.mostly
            ],
            "causes": [
                {"cause": c.name, "verdict": c.kind, "why": c.why, "limits": c.limits}
                for c in v.causes
            ],
            "misfit_over_noise": v.misfit,
            "trend": None if v.trend is None else dc.asdict(v.trend),
            "p_value": v.screening.p_value,
            "simulated_share_of_gain": None
            if self.confirmation is None
            else self.confirmation.gained / max(self.confirmation.promised, 1e-9),
            "slices_needed": v.slices_needed,
            "gain": None
            if self.gain is None
            else {
                "before_N": self.gain.before,
                "after_N": self.gain.after,
                "floor_N": self.gain.floor,
                "share_removed": self.gain.share,
                "interval": list(self.gain.interval),
            },
            "evidence": [
                {
                    "cause": e.name,
                    "gain": e.gain,
                    "expected": e.expected,
                    "limit": e.limit,
                    "scan": e.scan,
                    "size": e.size,
                    "held_out_share": held_out_share(self.problem, [e.cause])
                    if e.score > 0.0
                    else None,
                }
                for e in v.screening.causes
            ],
            "noise": {
                c: dc.asdict(n)
                for c, n in zip(
                    self.problem.found.records[0].channels, self.problem.noise, strict=True
                )
            },
            "variation": {
                self.problem.found.columns[k].name: float(s) * self.problem.found.columns[k].size
                for k, s in zip(self.problem.own, self.problem.variation, strict=True)
            },
            "shifts": {name: list(pair) for name, pair in self.shifts.items()},
            "next_experiment": None
            if self.next_experiment is None
            else self.next_experiment.facts(),
            "remarks": self.remarks,
        }

    def save(self, directory: str | Path, report: bool = True) -> None:
        """Writes diagnosis.json, extended.yaml and, if wanted, report.html."""
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        text = json.dumps(self.facts(), indent=2) + "\n"
        (directory / "diagnosis.json").write_text(text, encoding="utf-8")
        dump_yaml(self.extended(), directory / "extended.yaml")
        if report:
            (directory / "report.html").write_text(report_html(self), encoding="utf-8")
