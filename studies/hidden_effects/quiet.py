"""The slices of a protocol as they would be without noise and without differences among them."""

import dataclasses as dc
from collections.abc import Callable

from sliceit_drake.records.metadata import slice_name
from sliceit_drake.records.slice_record import SliceRecord
from sliceit_drake.stand_in.protocol import Protocol, Variation
from sliceit_drake.stand_in.session import Session

__all__ = ["records_of_conditions", "without_noise"]

NOISELESS = {
    "force_noise": 0.0,
    "torque_noise": 0.0,
    "force_bias": 0.0,
    "torque_bias": 0.0,
    "force_drift": 0.0,
    "torque_drift": 0.0,
}


def without_noise(protocol: Protocol, **sensor: float) -> Protocol:
    """A protocol whose slices are all alike, with a sensor without noise, bias and drift.

    Args:
        protocol: What is cut.
        sensor: Further fields of its sensor.
    """
    alike = Variation(toughness=0.0, stiffness=0.0, friction=0.0, height=0.0)
    quiet = dc.replace(protocol.sensor, **(NOISELESS | sensor))
    return dc.replace(protocol, sensor=quiet, variation=alike)


def records_of_conditions(
    session: Session, once: bool = True, name: Callable[[int], str] = slice_name
) -> list[SliceRecord]:
    """All slices of a session.

    Args:
        session: A session with a protocol `without_noise`.
        once: Whether each condition is cut once, and its record stands for all of its slices.
        name: Name of a record by its order.

    Raises:
        CuttingError: The cut broke down.
    """
    found: dict[str, SliceRecord] = {}
    out = []
    for k, specimen in enumerate(session.specimens):
        label = specimen.condition.label
        if label not in found or not once:
            found[label] = session.record(k)
        metadata = dc.replace(
            found[label].metadata,
            name=name(k),
            slice_index=k,
            knife_slices=session.protocol.knife_slices + k,
        )
        out.append(dc.replace(found[label], metadata=metadata))
    return out
