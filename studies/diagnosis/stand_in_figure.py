"""Draws what each effect of the stand-in changes (docs/figures/stand_in.png)."""

import argparse
import dataclasses as dc
from pathlib import Path

import numpy as np

from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.effect import Effect
from sliceit_drake.stand_in.effect_registry import EFFECTS
from sliceit_drake.stand_in.protocol import Protocol, Variation, load_protocol
from sliceit_drake.stand_in.sensor_model import SensorModel
from sliceit_drake.stand_in.session import Session
from studies.figures import BLUE, RED, new_figure, save_figure

__all__ = ["add_arguments", "run"]

GREY = "0.55"
FIGURE = Path(__file__).resolve().parents[2] / "docs/figures/stand_in.png"
CONDITIONS = {"slice_push_law": "draw_1", "holder_compliance": "draw_1", "serrated_edge": "draw_1"}
CONDITIONS |= {"board_law": "board", "tool_weight": "air"}
NORMAL = ("food_slip", "magnetic_board", "sensor_tilt", "warm_wrist")
SLICE, COLUMNS = 19, 4


def protocol_of(label: str) -> Protocol:
    """One condition of the full protocol, without variation and noise."""
    protocol = load_protocol(str(resource_path("calibration/protocols/full.yaml")))
    (condition,) = (c for c in protocol.conditions if c.label == label)
    quiet = {f.name: 0.0 for f in dc.fields(SensorModel) if f.default is not dc.MISSING}
    kept = {name: getattr(SensorModel(), name) for name in ("rate", "force_range", "torque_range")}
    quiet |= kept | {"correlation_time": 1.0}
    return dc.replace(
        protocol,
        conditions=[dc.replace(condition, replicates=SLICE + 1)],
        sensor=SensorModel(**quiet),
        variation=Variation(0.0, 0.0, 0.0, 0.0),
    )


def cut(label: str, effects: list[Effect]) -> SliceRecord:
    return Session(protocol_of(label), effects, seed=2).record(SLICE)


def lateral(record: SliceRecord, axis: int) -> np.ndarray:
    """Force along the edge (0) or normal to the blade (1)."""
    assert record.force is not None
    return np.einsum("nc,nc->n", record.force, record.rotation[:, :, axis])


def vertical(record: SliceRecord) -> np.ndarray:
    """Force upwards."""
    assert record.force is not None
    return record.force[:, 2]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds nothing: the study has no arguments."""


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    plain = {label: cut(label, []) for label in {"press", *CONDITIONS.values()}}
    rows = -(-len(EFFECTS) // COLUMNS)
    figure = new_figure(12, 1.75 * rows)
    axes = figure.subplots(rows, COLUMNS)
    for axis, (name, kind) in zip(axes.flat, EFFECTS.items(), strict=False):
        label = CONDITIONS.get(name, "press")
        record, without = cut(label, [kind()]), plain[label]
        side = int(name in NORMAL)
        axis.plot(without.time, vertical(without), color=GREY, lw=1.8)
        axis.plot(without.time, lateral(without, side), color=GREY, lw=1.8, ls=":")
        axis.plot(record.time, vertical(record), color=BLUE, lw=0.9)
        axis.plot(record.time, lateral(record, side), color=RED, lw=0.9, ls=":")
        size = f"{kind.typical:g} {kind.unit}".strip()
        normal = ", normal" if side else ""
        axis.set_title(f"{name} {size} ({label}{normal})", fontsize=8)
        axis.tick_params(labelsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("force [N]", fontsize=8)
    figure.suptitle(
        "Force on the knife, upwards (solid) and along the edge, or where it says so normal to the "
        "blade (dotted):\nwithout an effect (grey) and with one (colour)",
        fontsize=10,
    )
    save_figure(figure, FIGURE, 90)
    return 0
