"""How often the bands of predicted force hold what is measured, on benches of other laws.

Two press cuts of one speed are fitted. The band (calibration/bands.py) is then compared with a
third cut of that speed, with cuts of two other speeds, and with two draws. Beside it stands a band
of constant width, 1.645 standard deviations of what the fit leaves to both sides of the fit. The
mean interval score (Gneiting and Raftery 2007), N, is the width and 20 times what lies outside; the
lower the better.

The benches are those of one part (docs/results/benches.md): what bands take for usual was set by
draws of the training part, and is reported on others. With --output each draw is kept there as a
line of JSON, from which the study goes on if it was stopped.
"""

import argparse
import dataclasses as dc
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sliceit_drake.calibration.bands import force_band
from sliceit_drake.calibration.first_fit import fit_from_starts
from sliceit_drake.calibration.gauss_newton import residuals_at
from sliceit_drake.calibration.setup import setup_of_record
from sliceit_drake.calibration.structure import coarse_predictor
from sliceit_drake.cutting.solver import CuttingError
from sliceit_drake.records.slice_record import SliceRecord
from studies.benches.draw import LAWS, PARTS, RESERVED, Draw, seed_of
from studies.pages import percent, publish, table

__all__ = ["Row", "add_arguments", "interval_score", "run", "scored"]

LEVEL = 0.9
DRAWS = 32
"""Slices of each band."""
KINDS = ("same speed", "other speeds", "draws")
COMMIT = "bands of predicted force"
"""What seeds follow from, in the place of a commit."""


@dc.dataclass(frozen=True)
class Row:
    """A record that was not fitted.

    Attributes:
        part, law, draw: Of its bench.
        kind: One of `KINDS`.
        inside: Share of it in the band.
        whole: Whether all of it is.
        width: Mean of the band's, over the root mean square force.
        score, constant: Mean interval scores of the band and of the band of constant width, N.
        constant_inside: Share of it in that one.
    """

    part: str
    law: str
    draw: int
    kind: str
    inside: float
    whole: bool
    width: float
    score: float
    constant: float
    constant_inside: float


def interval_score(low: np.ndarray, high: np.ndarray, measured: np.ndarray) -> float:
    """Mean interval score at `LEVEL` of measurements [M]."""
    outside = np.maximum(low - measured, 0.0) + np.maximum(measured - high, 0.0)
    return float(np.mean(high - low + 2.0 / (1.0 - LEVEL) * outside))


def scored(part: str, law: str, number: int) -> list[Row]:
    """The records that are not fitted, of a draw of a part.

    Raises:
        CuttingError: No start leads to slices that can be cut.
    """
    draw = Draw(law, seed_of(COMMIT, part, law, number))
    fitted, left = _chosen(draw.records())
    setup = setup_of_record(fitted[0])
    few = coarse_predictor(setup, fitted, 1)
    found = few.values(fit_from_starts(few))
    # What is each record's own is unknown of those that were not fitted.
    predictor = coarse_predictor(setup, [*fitted, *(record for _, record in left)], 1)
    model = predictor.holding_out(predictor.record_of >= len(fitted))
    unit = np.array([p.unit(found.get(p.name, p.start)) for p in predictor.parameters])
    low, high = force_band(model, unit, DRAWS).interval(LEVEL)
    # Of all entries: those that `model` does not use have no residual there.
    (residual,) = residuals_at(predictor, [unit])
    measured, fit = model.measured, model.measured + residual
    reach = 1.645 * float(np.std(residual[model.used]))
    out = []
    for k, (kind, _) in enumerate(left, len(fitted)):
        rows = (predictor.record_of == k) & predictor.used
        y, inside = measured[rows], (low <= measured)[rows] & (measured <= high)[rows]
        force = float(np.sqrt(np.mean(y**2)))
        near = np.abs(y - fit[rows]) <= reach
        row = Row(
            part,
            law,
            number,
            kind,
            inside=float(inside.mean()),
            whole=bool(inside.all()),
            width=float(np.mean((high - low)[rows])) / force,
            score=interval_score(low[rows], high[rows], y),
            constant=interval_score(fit[rows] - reach, fit[rows] + reach, y),
            constant_inside=float(near.mean()),
        )
        out.append(row)
    return out


def _chosen(
    records: Sequence[SliceRecord],
) -> tuple[list[SliceRecord], list[tuple[str, SliceRecord]]]:
    """Records to fit, and the others by kind."""
    groups: dict[str, list[SliceRecord]] = {}
    for record in records:
        groups.setdefault(record.metadata.condition, []).append(record)
    presses = [name for name in groups if name.startswith("press")]
    middle = groups[presses[1]]
    left = [(KINDS[0], middle[2]), *((KINDS[1], groups[p][0]) for p in presses[::2])]
    left += [(KINDS[2], own[0]) for name, own in groups.items() if name.startswith("draw")]
    return list(middle[:2]), left


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the study's arguments."""
    known = [law for law in LAWS if law != RESERVED]
    parser.add_argument("--laws", nargs="+", choices=known, default=known, help="default: all")
    parser.add_argument(
        "--part", choices=PARTS, default="reporting", help="of the benches (default reporting)"
    )
    parser.add_argument("--draws", type=int, default=6, help="of each law (default 6)")
    parser.add_argument("--output", type=Path, metavar="FILE", help="of JSON lines, to go on from")
    parser.set_defaults(resumes=True)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    rows: list[Row] = []
    if options.output is not None and options.output.exists():
        lines = options.output.read_text(encoding="utf-8").splitlines()
        rows = [row for row in (Row(**json.loads(x)) for x in lines) if row.part == options.part]
    done = {(row.law, row.draw) for row in rows}
    todo = [(law, k) for k in range(options.draws) for law in options.laws]
    for law, k in tqdm([pair for pair in todo if pair not in done], desc="draws"):
        try:
            found = scored(options.part, law, k)
        except CuttingError as error:
            print(f"{law} {k}: {error}")
            continue
        rows += found
        if options.output is not None:
            with options.output.open("a", encoding="utf-8") as file:
                file.writelines(json.dumps(dc.asdict(row)) + "\n" for row in found)
    publish(_table(rows), None)
    return 0


def _table(rows: Sequence[Row]) -> str:
    head = (
        "law | record | records | in the band | whole in it | width / force | interval score [N] | "
        "constant width: in it | its score [N]"
    )
    lines = []
    for law in dict.fromkeys(row.law for row in rows):
        for kind in KINDS:
            of = [row for row in rows if (row.law, row.kind) == (law, kind)]
            if not of:
                continue
            mean = {
                name: float(np.mean([getattr(row, name) for row in of]))
                for name in ("inside", "whole", "width", "score", "constant", "constant_inside")
            }
            shares = [percent(mean[name]) for name in ("inside", "whole")]
            cells = [f"{mean['width']:.2f}", f"{mean['score']:.2f}"]
            last = [percent(mean["constant_inside"]), f"{mean['constant']:.2f}"]
            lines.append((law, kind, len(of), *shares, *cells, *last))
    return table(head, lines)
