"""What a single record shows: a description of that slice, and never a diagnosis.

The unit of replication is the record. With one of them nobody can know how slices vary, so that
whatever is found here may be that slice's own. What can be done is done: the simulation is fitted
to the slice; what is left is taken for an autocorrelated process within the slice, and each cause
is asked how much of it it explains (generalised least squares, with the largest gain over all
causes calibrated by a parametric bootstrap), and how well blocks of depth are predicted that were
left out. Projected sensitivities say which causes such a motion cannot tell apart.
"""

import copy
import dataclasses as dc
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from sliceit_drake.calibration.noise import MarkovCovariance
from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.cutting.effects import Effects
from sliceit_drake.diagnosis.cause import EXPERIMENTS, Cause
from sliceit_drake.diagnosis.identifiability import (
    ANGLE,
    SHIFT,
    SHOWS,
    Evidence,
    Identifiability,
    identifiability,
)
from sliceit_drake.diagnosis.identifiability_report import classes, short
from sliceit_drake.diagnosis.linear import USUAL, scaled_inverse
from sliceit_drake.diagnosis.noise_levels import ChannelNoise
from sliceit_drake.diagnosis.prediction import SlicePredictor
from sliceit_drake.diagnosis.registry import is_users, open_causes
from sliceit_drake.diagnosis.sensitivity import RecordSensitivity, Sensitivities, sensitivities
from sliceit_drake.diagnosis.slice_fit import (
    BLOCKS,
    OWN,
    SliceFit,
    depth_blocks,
    fit_slice,
)
from sliceit_drake.diagrams.calibrated_food import CalibratedFood
from sliceit_drake.records.slice_record import SliceRecord

__all__ = [
    "KIND",
    "CauseInSlice",
    "OneSlice",
    "SliceEvidence",
    "diagnose_slice",
    "estimate_slice_noise",
    "setup_of_slice",
    "slice_evidence",
]

BASE = (
    ParameterRange("material.toughness", 10.0, 5000.0),
    ParameterRange("material.youngs_modulus", 2e4, 2e7),
    ParameterRange("material.friction", 1e-3, 2.0),
)
"""Fitted in any case."""
KIND = "one_slice"
"""The verdict on a single record, whatever it shows."""
LEVEL = 0.05
"""Greatest p-value, over all causes, of one that the slice supports."""
LEAST_GAIN = 0.1
"""Least share of the error on left-out depth that such a cause removes."""
CONFIRMED = 3
"""Most causes that are fitted by simulation."""
REPLICATES = 3
"""Slices of each condition from which variation can be told from an effect."""
LEAST_SPREAD = 0.5
"""Of a gain where nothing is wrong: that of a cause that hardly shows is next to none, and must not
turn what is small into many standard deviations."""
REFINED = 1.5
END = 0.02
"""Last stretch of a record without a say in the evidence, s: the simulated knife comes to rest when
the record is over, and causes that go with speed or acceleration would be told by that."""

Progress = Callable[[str, int, int], None]


@dc.dataclass
class CauseInSlice:
    """What one slice says of one cause.

    Attributes:
        name: Of the cause.
        scan: Best value of its scan, or None.
        gain: Twice the gain in log-likelihood.
        p_value: Of a gain as large, relative to its spread, by any cause where nothing is wrong.
        shows: Standard deviations by which its plausible size would stand out of what is left.
        held_out: Error on left-out depth with it by the linear prediction, N; each block chooses
            its scan anew.
        confirmed: The same by simulation, N; None where that was not done.
        fitted: Error of the fit by simulation, N; None where that was not done.
        blocks_better: Of the left-out blocks, those that it predicts better, by simulation.
        without_best: Error with it over that without on all left-out blocks but the one where it
            gains most, by simulation: what rests on one block may be its accident.
        values: Fitted by simulation, by name.
        others: Causes and shifts that this motion cannot tell it from.
    """

    name: str
    scan: float | None
    gain: float
    p_value: float
    shows: float
    held_out: float
    confirmed: float | None = None
    fitted: float | None = None
    blocks_better: int = 0
    without_best: float = 1.0
    values: dict[str, float] = dc.field(default_factory=dict)
    others: list[str] = dc.field(default_factory=list)


@dc.dataclass
class SliceEvidence:
    """Evidence of all causes in one slice, by the linear problem.

    Attributes:
        causes: By increasing p-value.
        held_out: Error on left-out depth without any cause, by the linear prediction, N.
        noise: Of what is left in the slice, by channel.
    """

    causes: list[CauseInSlice]
    held_out: float
    noise: tuple[ChannelNoise, ...]


@dc.dataclass
class OneSlice:
    """What one slice shows; prints as a table, saves to a folder.

    Attributes:
        record: Measured, and predicted by the fit, with sensitivities there.
        evidence: Of all causes.
        fit: Without a cause.
        fits: With those that were confirmed, by name.
        block: Number of each row's block of depth.
        angles: Between causes, from projected sensitivities.
        causes: All that were tested, by name.
        remarks: What a reader must know.
        elements: Tetrahedra of the food.
    """

    record: RecordSensitivity
    evidence: SliceEvidence
    fit: SliceFit
    fits: dict[str, SliceFit]
    block: np.ndarray
    angles: Identifiability
    causes: dict[str, Cause]
    remarks: list[str]
    elements: int = 0

    kind = KIND

    @property
    def supported(self) -> list[CauseInSlice]:
        """Causes that explain more than chance would, and predict depth that was left out."""
        before = self.error(self.fit.held_out)
        return [
            c
            for c in self.evidence.causes
            if c.p_value <= LEVEL
            and c.confirmed is not None
            and c.confirmed <= (1.0 - LEAST_GAIN) * before
            and c.without_best <= 1.0 - LEAST_GAIN
        ]

    @property
    def supported_classes(self) -> list[list[str]]:
        """Those causes with what this slice cannot tell from each; one that is in the class of
        another has none of its own."""
        out: list[list[str]] = []
        for c in self.supported:
            if not any(c.name in group for group in out):
                out.append([c.name, *c.others])
        return out

    @property
    def verdict(self) -> str:
        """In a sentence."""
        found = self.supported
        if not found:
            untried = [
                c.name for c in self.evidence.causes if c.p_value <= LEVEL and c.confirmed is None
            ]
            return (
                "in this slice no cause that was fitted explains more of what is left than chance"
                " would and predicts depth that was left out"
                + (f" (not fitted by simulation: {', '.join(untried)})" if untried else "")
            )
        names = "; ".join(" or ".join(map(short, group)) for group in self.supported_classes)
        return f"this slice is described better with {names}; another slice may show otherwise"

    @property
    def classes(self) -> list[list[str]]:
        """What this motion cannot tell apart; they may overlap."""
        groups = classes(self.angles)
        return [g for g in groups if not any(set(g) < set(other) for other in groups)]

    @property
    def drowned(self) -> list[str]:
        """Causes that could show, but not above what this simulation gets wrong in this slice."""
        small = [c.name for c in self.evidence.causes if c.shows < SHOWS]
        return sorted(set(small) - set(self.hidden))

    @property
    def hidden(self) -> list[str]:
        """Causes that such a slice could not show at their plausible size, were all else right."""
        names = self.angles.names
        return [
            names[k] for k in range(self.angles.shifts, len(names)) if not self.angles.visible[k]
        ]

    def error(self, predicted: np.ndarray, rows: np.ndarray | None = None) -> float:
        """RMS error of the forces of a prediction, N."""
        keep = [k for k, c in enumerate(self.record.channels) if c.startswith("force")]
        rest = (self.record.measured - predicted)[:, keep]
        rest = rest if rows is None else rest[rows]
        return float(np.sqrt((rest**2).sum(1).mean())) if len(rest) else 0.0

    def by_depth(self) -> list[tuple[str, int, float, float, float]]:
        """Of the air and each block of depth: name, rows, mean and RMS of what the fit leaves, RMS
        where it was left out, N."""
        record, out = self.record, []
        depth = record.depth
        parts = [("before contact", ~record.in_contact & (depth <= 0.0))]
        for k in range(int(self.block.max()) + 1):
            rows = (self.block == k) & record.in_contact
            if rows.any():
                low, high = 1e3 * depth[rows].min(), 1e3 * depth[rows].max()
                parts.append((f"{low:.1f} to {high:.1f} mm", rows))
        channel = self.shown
        for name, rows in parts:
            if rows.any():
                rest = (record.measured - self.fit.predicted)[rows, channel]
                errors = self.error(self.fit.predicted, rows), self.error(self.fit.held_out, rows)
                out.append((name, int(rows.sum()), float(rest.mean()), *errors))
        return out

    @property
    def shown(self) -> int:
        """Number of the channel that figures and tables show."""
        channels = self.record.channels
        return channels.index("force_z") if "force_z" in channels else 0

    def experiments(self) -> list[str]:
        """Experiments that part what this slice cannot tell apart or does not show, those that
        serve most causes first."""
        names = {n for group in self.classes for n in group} | set(self.hidden)
        asked = [self.causes[n].experiment for n in sorted(names) if n in self.causes]
        asked += ["repeats"] * len(self.supported)
        return sorted(set(asked), key=lambda e: (-asked.count(e), e))

    def table(self) -> str:
        """The result in a minute."""
        lines = [
            f"1 record: {self.record.name}",
            f"Verdict: {KIND.replace('_', ' ')}, no diagnosis: {self.verdict}",
            f"Error of the fit {self.error(self.fit.predicted):.3f} N, on depth that was left out "
            f"{self.error(self.fit.held_out):.3f} N; "
            + ", ".join(
                f"{k} {v:.3g}"
                for k, v in (self.fit.values("base") | self.fit.values("own")).items()
            ),
            "",
            f"{'depth':>18}{'rows':>6}{'mean left N':>13}{'RMS N':>8}{'left out N':>12}",
        ]
        for name, rows, mean, rms, out in self.by_depth():
            lines.append(f"{name:>18}{rows:6d}{mean:13.2f}{rms:8.2f}{out:12.2f}")
        lines += ["", f"{'cause':20}{'gain':>8}{'p':>8}{'left out N':>12}{'by simulation':>15}"]
        mine = [c for c in self.evidence.causes[10:] if is_users(self.causes[c.name])]
        for c in (*self.evidence.causes[:10], *mine):
            own = "" if c.confirmed is None else f"{c.confirmed:.3f}"
            lines.append(f"{c.name:20}{c.gain:8.1f}{c.p_value:8.3f}{c.held_out:12.3f}{own:>15}")
        lines.append(
            f"{'without a cause':20}{'':16}{self.evidence.held_out:12.3f}"
            f"{self.error(self.fit.held_out):15.3f}"
        )
        lines.append("")
        for group in self.classes:
            lines.append(f"Not told apart by such a slice: {', '.join(map(short, group))}")
        if self.hidden:
            lines.append(f"Such a slice cannot show: {', '.join(self.hidden)}")
        if self.drowned:
            lines.append(
                f"Not above what the simulation gets wrong here: {', '.join(self.drowned)}"
            )
        lines += self.needed()
        return "\n".join(lines + self.remarks)

    def needed(self) -> list[str]:
        """What would make a diagnosis of it."""
        lines = [
            f"Needed for a diagnosis: at least {REPLICATES} slices of each condition (one slice"
            " says nothing of how slices vary)."
        ]
        for name in self.experiments()[:3]:
            lines.append(f"  Next: {EXPERIMENTS[name]} ({name})")
        return lines

    def facts(self) -> dict[str, Any]:
        """The result as plain values."""
        return {
            "verdict": KIND,
            "reason": self.verdict,
            "record": self.record.name,
            "supported_in_this_slice": self.supported_classes,
            "error_N": self.error(self.fit.predicted),
            "held_out_depth_error_N": self.error(self.fit.held_out),
            "values": self.fit.values("base") | self.fit.values("own"),
            "by_depth": [
                dict(zip(("part", "rows", "mean_N", "rms_N", "left_out_N"), row, strict=True))
                for row in self.by_depth()
            ],
            "evidence": [dc.asdict(c) for c in self.evidence.causes],
            "noise": {
                c: dc.asdict(n)
                for c, n in zip(self.record.channels, self.evidence.noise, strict=True)
            },
            "not_told_apart": self.classes,
            "cannot_show": self.hidden,
            "not_above_what_is_left": self.drowned,
            "experiments": self.experiments(),
            "slices_needed_of_each_condition": REPLICATES,
            "remarks": self.remarks,
        }

    def save(self, directory: Path) -> None:
        """Writes diagnosis.json and report.html; no food is extended by what one slice shows."""
        from sliceit_drake.diagnosis.one_slice_report import report_html

        directory.mkdir(parents=True, exist_ok=True)
        text = json.dumps(self.facts(), indent=2) + "\n"
        (directory / "diagnosis.json").write_text(text, encoding="utf-8")
        (directory / "report.html").write_text(report_html(self), encoding="utf-8")


def setup_of_slice(
    food: CalibratedFood, refinement: float = 1.0, plain: bool = False
) -> CalibrationSetup:
    """What is fitted to one slice: all that its calibration fitted, and `BASE`.

    A cause that the calibration has in the food already gets no second chance: it is free.

    Args:
        food: Calibrated.
        refinement: Elements along an edge, relative to the food's mesh.
        plain: Whether skin, core and centre are taken out, so that the food is the same all
            through; what is fitted is then the material and the contact alone.
    """
    known = food.distribution
    parameters = [
        ParameterRange(name, low, high, "log" if log else "linear")
        for name, low, high, log in zip(known.names, known.low, known.high, known.log, strict=True)
    ]
    names = {p.name for p in parameters}
    parameters += [p for p in BASE if p.name not in names]
    own = copy.deepcopy(food.food)
    if plain:
        effects = Effects()
        own.effects = dc.replace(
            own.effects, skin=effects.skin, core=effects.core, centre=effects.centre
        )
        parameters = [p for p in parameters if not p.name.startswith("effects.")]
    setup = CalibrationSetup(
        food=own, knife=food.knife, parameters=parameters, refinement=refinement
    )
    setup.numerics.flank_stiffness = food.flank_stiffness
    return setup


def diagnose_slice(
    setup: CalibrationSetup,
    record: SliceRecord,
    extra: Sequence[Cause] = (),
    cache: Path | None = None,
    replicates: int = 200,
    seed: int = 0,
    workers: int | None = None,
    progress: Progress | None = None,
    remarks: Sequence[str] = (),
) -> OneSlice:
    """Describes one slice.

    Args:
        setup: Food, knife and board; its parameters are fitted to the slice.
        record: The slice.
        extra: Causes of the user's, beside the built-in ones.
        cache: Folder for simulations.
        replicates: Of the bootstrap.
        seed: Of the bootstrap.
        workers: Threads.
        progress: See `Progress`.
        remarks: What is known already that a reader must know.

    Raises:
        ConfigurationError: The record cannot be compared.
        CuttingError: The slice breaks down at the calibrated values.
    """
    show = progress or (lambda *_: None)
    causes = open_causes([p.name for p in setup.parameters], extra)
    by_name = {c.name: c for c in causes}
    stages = 2 + CONFIRMED
    show("fits", 0, stages)
    predictor = SlicePredictor(
        setup, [record], cache=None if cache is None else cache / "slices", workers=workers
    )
    (target,) = predictor.targets
    contact = target.depth > 0.0
    block = depth_blocks(target.depth, contact, BLOCKS)
    fit = fit_slice(predictor, setup.parameters, block)
    show("fits", 1, stages)
    found = sensitivities(
        setup,
        [record],
        causes,
        point=fit.point,
        finer=REFINED,
        cache=cache,
        workers=workers,
        progress=lambda done, total: show("simulations", done, total),
    )
    whole = found.records[0]
    kept = whole.time < whole.time[-1] - END
    found = _rows(found, kept)
    evidence = slice_evidence(
        found, fit.jacobian[kept], _priors(fit), block[kept], replicates, seed, _own_columns(fit)
    )
    angles = identifiability(Evidence(_all_free(found)), causes, record.name, [0], {})
    result = OneSlice(
        record=whole,
        evidence=evidence,
        fit=fit,
        fits={},
        block=block,
        angles=angles,
        causes=by_name,
        remarks=[*remarks, *found.warnings],
        elements=found.elements,
    )
    show("fits", 2, stages)
    for done, c in enumerate(_promising(evidence), 3):
        _confirm(result, c, predictor, setup, by_name[c.name])
        show("fits", done, stages)
    show("fits", stages, stages)
    for c in evidence.causes:
        alike = angles.equivalence_class(c.name)[1:]
        c.others = [*alike, *(name for name in c.others if name not in alike)]
    return result


def _rows(found: Sensitivities, kept: np.ndarray) -> Sensitivities:
    """The same with some rows of its one record."""
    (record,) = found.records
    series = {f.name: getattr(record, f.name) for f in dc.fields(record)}
    cut = {n: v[kept] for n, v in series.items() if isinstance(v, np.ndarray)}
    return Sensitivities(found.columns, [dc.replace(record, **cut)], found.warnings, found.elements)


def _promising(evidence: SliceEvidence) -> list[CauseInSlice]:
    """Causes that are worth a fit by simulation."""
    likely = [c for c in evidence.causes if c.p_value <= LEVEL]
    found = [c for c in evidence.causes if c.held_out <= (1.0 - LEAST_GAIN) * evidence.held_out]
    found = sorted(found, key=lambda c: c.held_out)
    return [*likely, *(c for c in found if c not in likely)][:CONFIRMED]


def _confirm(
    result: OneSlice,
    evidence: CauseInSlice,
    predictor: SlicePredictor,
    setup: CalibrationSetup,
    cause: Cause,
) -> None:
    fit = result.fit
    start = {u.name: float(x) for u, x in zip(fit.unknowns, fit.theta, strict=True)}
    own = fit_slice(predictor, setup.parameters, result.block, cause, evidence.scan, start)
    result.fits[evidence.name] = own
    evidence.fitted = result.error(own.predicted)
    evidence.confirmed = result.error(own.held_out)
    evidence.values = own.values("cause")
    rows = [result.block == k for k in np.unique(result.block)]
    squares = np.array(
        [[r.sum() * result.error(f.held_out, r) ** 2 for r in rows] for f in (fit, own)]
    )
    evidence.blocks_better = int((squares[1] < squares[0]).sum())
    rest = np.arange(len(rows)) != np.argmax(squares[0] - squares[1])
    evidence.without_best = float(np.sqrt(squares[1, rest].sum() / squares[0, rest].sum()))


def _priors(fit: SliceFit) -> np.ndarray:
    return np.array([1.0 / u.spread**2 for u in fit.unknowns])


def _own_columns(fit: SliceFit) -> list[int]:
    return [k for k, u in enumerate(fit.unknowns) if u.kind == "own"]


def _all_free(found: Sensitivities) -> Sensitivities:
    """The same with what is the record's own as free as what all share, and what slices differ in
    left out: in one slice it is the same as a shift of a base parameter."""
    keep = [
        k
        for k, c in enumerate(found.columns)
        if c.kind != "record" or c.name in ("height", "speed")
    ]
    columns = []
    for k in keep:
        c = found.columns[k]
        if c.kind == "record":
            # A shift that is plausible for a base parameter counts as one of this for height.
            plausible = OWN[c.name][1]
            c = dc.replace(
                c,
                kind="base",
                name=f"own.{c.name}",
                size=c.size * SHIFT / plausible,
                per_record=False,
            )
        columns.append(c)
    (record,) = found.records
    one = dc.replace(record, columns=record.columns[:, :, keep], even=record.even[:, :, keep])
    return Sensitivities(columns, [one], found.warnings, found.elements)


def slice_evidence(
    found: Sensitivities,
    free: np.ndarray,
    precision: np.ndarray,
    block: np.ndarray,
    replicates: int = 200,
    seed: int = 0,
    own: Sequence[int] = (),
) -> SliceEvidence:
    """Evidence of all causes in one record.

    Args:
        found: Sensitivities of the record at the fit.
        free: Change of the prediction by each unknown of the fit [m, c, n].
        precision: Of these unknowns before the data [n].
        block: Number of each row's block of depth [m].
        replicates: Of the bootstrap.
        seed: Of the bootstrap.
        own: Numbers of the unknowns that stay as fitted when depth is left out.
    """
    (record,) = found.records
    known, weights = _known(found)
    X = np.concatenate([free, record.columns[:, :, known].astype(float)], axis=2)
    precision = np.concatenate([precision, weights])
    noise = tuple(
        estimate_slice_noise(record.time, record.residual[:, c], X[:, c], precision)
        for c in range(len(record.channels))
    )
    problem = _Slice(found, X, precision, noise)
    options = [(n, s, found.index("cause", n, s)) for n in found.causes for s in found.scans(n)]
    rng = np.random.default_rng(seed)
    best = _best_gains(problem, options, record.residual)
    null = []
    for _ in range(replicates):
        gains = _best_gains(problem, options, problem.sample(rng))
        null.append([gains[name][0] for name in found.causes])
    draws = np.array(null)
    mean, spread = draws.mean(0), np.maximum(draws.std(0), LEAST_SPREAD)
    largest = ((draws - mean) / spread).max(1)
    held_out = _HeldOut(problem, block, own)
    causes = []
    for k, name in enumerate(found.causes):
        gain, scan = best[name]
        score = (gain - mean[k]) / spread[k]
        p = (1.0 + float((largest >= score).sum())) / (replicates + 1.0)
        error = held_out.error([c for n, _, c in options if n == name])
        own_columns = found.index("cause", name)
        shows = float(np.sqrt(max(0.0, np.diag(problem.gram)[own_columns].max())))
        causes.append(CauseInSlice(name, scan, gain, p, shows, error))
    for c in causes:
        if c.p_value <= LEVEL:
            c.others = _same_effect(problem, options, c)
    causes.sort(key=lambda c: (c.p_value, c.held_out))
    return SliceEvidence(causes, held_out.error([[]]), noise)


def _known(found: Sensitivities) -> tuple[list[int], np.ndarray]:
    """Columns whose coefficient is known but for a plausible spread, and their precision."""
    columns, precision = list(found.index("numerical")), [1.0] * len(found.index("numerical"))
    for k, c in enumerate(found.columns):
        for cause, scan, parameter, deviation, _ in USUAL:
            if (c.name, c.scan, c.parameter) == (cause, scan, parameter):
                columns.append(k)
                precision.append((c.size / deviation) ** 2)
    return columns, np.array(precision)


def estimate_slice_noise(
    time: np.ndarray, rest: np.ndarray, X: np.ndarray, precision: np.ndarray
) -> ChannelNoise:
    """Restricted maximum likelihood of an autocorrelated process in one series.

    What the simulation gets wrong is in it, too, as long as no cause takes it: evidence against it
    is evidence against a model error without a shape of its own.

    Args:
        time: Of the rows [m], s.
        rest: Measured less predicted [m].
        X: Columns that are fitted beside [m, n].
        precision: Of their coefficients before the data [n].
    """
    gap = np.diff(time)
    scale = max(float(rest.std()), 1e-3)
    # A column that does nothing here has no say in the likelihood.
    used = np.abs(X).max(0) > 1e-9
    X, prior = X[:, used], precision[used]

    def objective(x: np.ndarray) -> float:
        ar, tau, white = np.exp(x)
        V = MarkovCovariance(gap, ar, tau, white)
        XV = V.solve(X)
        A = X.T @ XV + np.diag(prior)
        b = XV.T @ rest
        _, log_det = np.linalg.slogdet(A)
        square = float(rest @ V.solve(rest[:, None])[:, 0] - b @ scaled_inverse(A) @ b)
        return V.log_det() + float(log_det) + square

    step, span = float(np.median(gap)), float(time[-1] - time[0])
    bounds = [
        (np.log(0.02 * scale), np.log(20.0 * scale)),
        (np.log(step), np.log(0.5 * span)),
        (np.log(0.01 * scale), np.log(3.0 * scale)),
    ]
    fits = [
        minimize(
            objective,
            np.log([scale, tau, 0.1 * scale]),
            method="L-BFGS-B",
            bounds=bounds,
        )
        for tau in (5.0 * step, 0.05 * span)
    ]
    ar, tau, white = np.exp(min(fits, key=lambda f: f.fun).x).tolist()
    return ChannelNoise(ar, tau, white)


class _Slice:
    """Generalised least squares of one record: what the free columns leave of causes and of y."""

    def __init__(
        self,
        found: Sensitivities,
        X: np.ndarray,
        precision: np.ndarray,
        noise: tuple[ChannelNoise, ...],
    ) -> None:
        self.found, self.X, self.precision, self.noise = found, X, precision, noise
        (self.record,) = found.records
        self.C = self.record.columns.astype(float)
        self.XV = self._weighted(X)
        self.CV = self._weighted(self.C)
        self.inverse = scaled_inverse(_product(X, self.XV) + np.diag(precision))
        self.cross = _product(X, self.CV)
        # Of all columns with each other, beside the free ones.
        self.gram = _product(self.C, self.CV) - self.cross.T @ self.inverse @ self.cross
        gap = np.diff(self.record.time)
        self._draws = [MarkovCovariance(gap, n.ar, n.tau, n.white) for n in noise]

    def _weighted(self, columns: np.ndarray) -> np.ndarray:
        time = self.record.time
        return np.stack([n.solve(time, columns[:, c]) for c, n in enumerate(self.noise)], axis=1)

    def with_y(self, y: np.ndarray) -> np.ndarray:
        """Scalar products of all columns with a residual [m, c], beside the free ones [K]."""
        b = np.tensordot(self.CV, y, ((0, 1), (0, 1)))
        return np.asarray(
            b - self.cross.T @ (self.inverse @ np.tensordot(self.XV, y, ((0, 1), (0, 1))))
        )

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """A residual where nothing is wrong [m, c]: the process, and what is free or known but for
        a spread as it may be."""
        y = np.column_stack([V.sample(rng) for V in self._draws])
        deviation = 1.0 / np.sqrt(self.precision)
        return np.asarray(y + self.X @ (deviation * rng.normal(size=len(deviation))))


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.tensordot(a, b, ((0, 1), (0, 1))))


def _best_gains(
    problem: _Slice, options: Sequence[tuple[str, float | None, list[int]]], y: np.ndarray
) -> dict[str, tuple[float, float | None]]:
    """Of each cause its largest gain, and the value of its scan."""
    b, kinds = problem.with_y(y), problem.found.columns
    out: dict[str, tuple[float, float | None]] = {}
    for name, scan, columns in options:
        A = problem.gram[np.ix_(columns, columns)]
        gain, _ = _bounded(A, b[columns], [kinds[k].one_sided for k in columns])
        if name not in out or gain > out[name][0]:
            out[name] = gain, scan
    return out


def _bounded(A: np.ndarray, b: np.ndarray, one_sided: list[bool]) -> tuple[float, np.ndarray]:
    """Gain in the quadratic form where one-sided coefficients are not negative, and these."""
    n = len(b)
    full = (1 << n) - 1
    best, at = 0.0, np.zeros(n)
    for bits in range(1, full + 1) if any(one_sided) else [full]:
        active = [k for k in range(n) if bits >> k & 1 and A[k, k] > 1e-9]
        if not active:
            continue
        g = scaled_inverse(A[np.ix_(active, active)], 1e-8) @ b[active]
        if all(x >= 0.0 or not one_sided[k] for k, x in zip(active, g, strict=True)):
            gain = float(b[active] @ g)
            if gain > best:
                best, at = gain, np.zeros(n)
                at[active] = g
    return best, at


def _same_effect(
    problem: _Slice, options: Sequence[tuple[str, float | None, list[int]]], found: CauseInSlice
) -> list[str]:
    """Causes that can do what one was found to do to within `ANGLE`, at a value of their scan."""
    kinds = problem.found.columns
    b = problem.with_y(problem.record.residual)
    own = next(c for n, s, c in options if (n, s) == (found.name, found.scan))
    _, e = _bounded(problem.gram[np.ix_(own, own)], b[own], [kinds[k].one_sided for k in own])
    square = float(e @ problem.gram[np.ix_(own, own)] @ e)
    least = square * np.cos(np.radians(ANGLE)) ** 2
    out = []
    for name, _, columns in options:
        if name == found.name or name in out or square <= 0.0:
            continue
        explained, _ = _bounded(
            problem.gram[np.ix_(columns, columns)],
            problem.gram[np.ix_(columns, own)] @ e,
            [kinds[k].one_sided for k in columns],
        )
        if explained >= least:
            out.append(name)
    return out


class _HeldOut:
    """Errors on blocks of depth that were left out, each predicted from the others, by ordinary
    least squares: what counts is newtons, wherever they are."""

    def __init__(self, problem: _Slice, block: np.ndarray, own: Sequence[int]) -> None:
        self.problem, self.block, self.own = problem, block, list(own)
        self.scale = max(float(np.sqrt(np.mean(problem.record.residual**2))), 1e-6)

    def error(self, options: Sequence[list[int]]) -> float:
        """RMS over all left-out rows, N; the rest chooses between the options of a cause."""
        record = self.problem.record
        keep = [k for k, c in enumerate(record.channels) if c.startswith("force")]
        left = np.zeros_like(record.residual)
        for k in np.unique(self.block):
            rows = self.block == k
            trials = [self._predicted(columns, rows) for columns in options]
            left[rows] = min(trials, key=lambda t: t[0])[1]
        return float(np.sqrt((left[:, keep] ** 2).sum(1).mean()))

    def _predicted(self, columns: list[int], rows: np.ndarray) -> tuple[float, np.ndarray]:
        """Squares on the other rows, and what is left on these."""
        problem = self.problem
        X = np.concatenate([problem.X, problem.C[:, :, columns]], axis=2)
        precision = np.concatenate([problem.precision, np.full(len(columns), 1e-6)])
        kinds = problem.found.columns
        bound = np.full(X.shape[2], -np.inf)
        for j, k in enumerate(columns):
            if kinds[k].one_sided:
                bound[problem.X.shape[2] + j] = 0.0
        everything = np.ones(len(rows), bool)
        theta = self._solve(X, precision, bound, everything, None)
        theta = self._solve(X, precision, bound, ~rows, theta)
        rest = problem.record.residual - X @ theta
        return float((rest[~rows] ** 2).sum()), rest[rows]

    def _solve(
        self,
        X: np.ndarray,
        precision: np.ndarray,
        bound: np.ndarray,
        rows: np.ndarray,
        fixed: np.ndarray | None,
    ) -> np.ndarray:
        y = self.problem.record.residual[rows].ravel()
        A = X[rows].reshape(len(y), -1)
        held = self.own if fixed is not None else []
        out = np.zeros(X.shape[2])
        if fixed is not None:
            out[held] = fixed[held]
        active = [k for k in range(X.shape[2]) if k not in held]
        while True:
            part = A[:, active]
            G = part.T @ part / self.scale**2 + np.diag(precision[active])
            own = scaled_inverse(G) @ (part.T @ (y - A[:, held] @ out[held]) / self.scale**2)
            wrong = [k for k, x in zip(active, own, strict=True) if x < bound[k]]
            if not wrong:
                out[active] = own
                return out
            active = [k for k in active if k not in wrong]
