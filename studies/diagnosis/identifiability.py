"""Which causes the slices of a protocol can tell apart, before anything is measured.

Takes the motions of the protocols poor, rich and full without noise, computes how each cause would
change the forces, and the angles between causes after base parameters, differences from slice to
slice and the discretisation have taken what they can. Takes a few minutes.
docs/results/identifiability.md is what comes out.
"""

import argparse
import dataclasses as dc
from collections.abc import Callable, Sequence
from pathlib import Path

from tqdm import tqdm

from sliceit_drake.calibration.setup import CalibrationSetup, ParameterRange
from sliceit_drake.diagnosis.cause import Cause
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.experiments.identifiability import Evidence
from sliceit_drake.diagnosis.registry import load_cause, open_causes
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.resources import resource_path
from sliceit_drake.stand_in.finite_element_world import FiniteElementSettings
from sliceit_drake.stand_in.protocol import Protocol, load_protocol
from sliceit_drake.stand_in.session import Session
from studies.diagnosis.conditions import protocol_identifiability
from studies.diagnosis.identifiability_page import Study, page_values, plot_angles
from studies.hidden_effects.quiet import records_of_conditions, without_noise
from studies.pages import publish, render_and_store

__all__ = ["add_arguments", "nominal_records", "protocol_setup", "run", "study"]

PROTOCOLS = ("poor", "rich", "full")
BASE = (
    ("material.toughness", 50.0, 1000.0),
    ("material.youngs_modulus", 1e5, 1e7),
    ("material.friction", 0.01, 1.0),
)
"""Base parameters that are free, with their ranges."""
COARSE_STEP = 1e-3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the study."""
    parser.add_argument("--output", metavar="FILE", type=Path, help="also write the report there")
    parser.add_argument(
        "--figure", metavar="FILE", type=Path, help="draw the angles there, as .png"
    )
    parser.add_argument(
        "--refinement",
        metavar="X",
        type=float,
        default=0.75,
        help="elements along an edge, relative to the food's mesh (default: 0.75)",
    )
    parser.add_argument(
        "--cache", metavar="FOLDER", type=Path, help="keep finished simulations there"
    )
    parser.add_argument(
        "--cause", metavar="FILE", action="append", default=[], help="also a cause of your own"
    )
    parser.add_argument("--workers", metavar="N", type=int, help="threads (default: all)")


def protocol_setup(protocol: Protocol, refinement: float = 1.0) -> CalibrationSetup:
    """What a calibration on a protocol's slices would start from."""
    return CalibrationSetup(
        food=protocol.food,
        knife=protocol.knife,
        board=protocol.board,
        parameters=[ParameterRange(*entry) for entry in BASE],
        refinement=refinement,
    )


def nominal_records(protocol: Protocol, prefix: str = "") -> list[SliceRecord]:
    """The slices of a protocol without noise and differences, coarsely computed.

    Args:
        protocol: What is cut.
        prefix: Of the records' names.
    """
    settings = FiniteElementSettings(refinement=0.5, time_step=COARSE_STEP, travel=2e-4)
    session = Session(without_noise(protocol, delay=0.0), seed=0, settings=settings)
    return records_of_conditions(session, name=lambda k: f"{prefix}{k:03d}")


def study(
    protocols: Sequence[Protocol],
    causes: Sequence[Cause],
    refinement: float = 0.75,
    cache: Path | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """What each of some protocols can tell.

    Args:
        protocols: Of one food and knife; conditions of the last are what is proposed.
        causes: What may be wrong.
        refinement: Elements along an edge, relative to the food's mesh.
        cache: Folder for finished simulations; None for none.
        workers: Threads.
        progress: Called with the number of simulated slices, and of those that must be.
    """
    records: list[SliceRecord] = []
    ranges = []
    for protocol in protocols:
        own = nominal_records(protocol, f"{protocol.name}_")
        ranges.append(list(range(len(records), len(records) + len(own))))
        records += own
    setup = protocol_setup(protocols[-1], refinement)
    found = sensitivities(setup, records, causes, cache=cache, workers=workers, progress=progress)
    evidence = Evidence(found)
    cuts = [[dc.replace(c, replicates=1) for c in p.conditions] for p in protocols]
    results = []
    for protocol, own_records, own_cuts in zip(protocols, ranges, cuts, strict=True):
        menu: dict[str, list[int]] = {}
        new = {c.label for c in cuts[-1] if c not in own_cuts}
        for k in ranges[-1]:
            label = found.records[k].condition
            if label in new:
                menu.setdefault(label, []).append(k)
        results.append(protocol_identifiability(evidence, causes, protocol.name, own_records, menu))
    return Study(results, causes, found)


def run(options: argparse.Namespace) -> int:
    """Runs the study."""
    protocols = [
        load_protocol(str(resource_path(f"calibration/protocols/{name}.yaml")))
        for name in PROTOCOLS
    ]
    extra = [load_cause(file) for file in options.cause]
    causes = open_causes([name for name, *_ in BASE], extra)
    with tqdm(desc="slices") as bar:

        def progress(done: int, of: int) -> None:
            bar.total = of
            bar.update(done - bar.n)

        found = study(
            protocols, causes, options.refinement, options.cache, options.workers, progress
        )
    values = page_values(found)
    publish(
        render_and_store("identifiability", options.output, values, found.results), options.output
    )
    if options.figure is not None:
        plot_angles(found, options.figure)
    return 0
