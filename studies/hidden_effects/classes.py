"""Which causes the slices of a protocol cannot tell apart: what a run may be judged by."""

import dataclasses as dc
import json
from pathlib import Path

from sliceit_drake.content_store import content_key, source_key
from sliceit_drake.diagnosis.diagnose import BASE, setup_of_food
from sliceit_drake.diagnosis.evidence.sensitivity import sensitivities
from sliceit_drake.diagnosis.experiments import identifiability as identifiability_module
from sliceit_drake.diagnosis.experiments.identifiability import Evidence, identifiability
from sliceit_drake.diagnosis.registry import open_causes
from studies.hidden_effects.bench import (
    DIAGNOSIS_REFINEMENT,
    QuietBench,
    model_food,
    protocol_named,
)

__all__ = ["ProtocolClasses", "protocol_classes"]

SEED = 21
"""Seed of the order of slices."""


@dc.dataclass(frozen=True)
class ProtocolClasses:
    """What a protocol's slices can tell.

    Attributes:
        protocol: Its name.
        classes: By cause all that cannot be told from it, itself first.
        angles: By cause and cause, degrees.
    """

    protocol: str
    classes: dict[str, list[str]]
    angles: dict[str, dict[str, float]]


def protocol_classes(name: str, cache: Path | None = None) -> ProtocolClasses:
    """Computes them from motions without any measurement, as the study `identifiability` does.

    Args:
        name: Of a protocol.
        cache: Folder for what was computed.

    Raises:
        ConfigurationError: There is no such protocol.
    """
    protocol = protocol_named(name)
    causes = open_causes([p.name for p in BASE])
    file = None
    if cache is not None:
        code = source_key(identifiability_module.__file__)
        key = content_key(code, protocol, [(c.name, c.parameters, c.scan) for c in causes])
        file = cache / "classes" / f"{name}_{key[:12]}.json"
        if file.exists():
            return ProtocolClasses(**json.loads(file.read_text(encoding="utf-8")))
    records = QuietBench(protocol, SEED).records()
    setup = setup_of_food(model_food(protocol), DIAGNOSIS_REFINEMENT)
    found = sensitivities(setup, records, causes, cache=cache)
    told = identifiability(Evidence(found), causes, range(len(records)))
    listed = [n for n in told.names if "." not in n]
    at = {n: told.names.index(n) for n in listed}
    result = ProtocolClasses(
        name,
        {n: [m for m in told.equivalence_class(n) if "." not in m] for n in listed},
        {n: {m: float(told.angles[at[n], at[m]]) for m in listed} for n in listed},
    )
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(dc.asdict(result)) + "\n", encoding="utf-8")
    return result
