"""Records of a diagnosis whose sensitivities are given shapes, so that no slice is simulated."""

import numpy as np
from scipy.signal import lfilter

from sliceit_drake.diagnosis.evidence.columns import Column, RecordSensitivity

ROWS = 300
NOISE = 0.1
VARIATION = 0.05
COLUMNS = [
    Column("base", "material.toughness", size=0.05),
    Column("record", "toughness", size=0.05, per_record=True),
    Column("numerical", "mesh"),
    Column("cause", "rate", "exponent", size=0.1),
    Column("cause", "skin", "toughness", size=1.0, one_sided=True),
    Column("cause", "skin_like", "toughness", size=1.0, one_sided=True),
    Column("cause", "fading", "share", scan=0.2, size=0.2, one_sided=True),
    Column("cause", "fading", "share", scan=1.0, size=0.2, one_sided=True),
]
SPEEDS = (0.005, 0.02, 0.08)


def shapes(speed: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, depth, contact and force of a press with a hold in its middle third."""
    time = np.linspace(0.0, 3.0, ROWS)
    depth = 0.02 * np.interp(time, [0.0, 0.3, 1.2, 2.0, 3.0], [-0.1, 0.0, 0.5, 0.5, 1.0])
    contact = depth > 0.0
    return time, depth, contact, 10.0 * np.sqrt(np.clip(depth / 0.02, 0.0, None))


def record(
    name: str, speed: float, rng: np.random.Generator, hidden: dict[str, float], unknown: float
) -> RecordSensitivity:
    time, depth, contact, force = shapes(speed)
    edge = np.exp(-np.clip(depth, 0.0, None) / 2e-3) * contact
    near = np.exp(-np.clip(depth, 0.0, None) / 1.8e-3) * contact
    held = np.clip(time - 1.2, 0.0, 0.8) * (time < 2.0)
    ripple = 0.02 * np.sin(2.0 * np.pi * depth / 5e-3) * contact
    columns = {
        "material.toughness": 0.05 * force,
        "toughness": 0.05 * force,
        "mesh": ripple,
        "rate": force * 0.1 * np.log(speed / 0.02),
        "skin": edge,
        "skin_like": near,
        "fading0.2": -0.2 * force * (1.0 - np.exp(-held / 0.2)),
        "fading1.0": -0.2 * force * (1.0 - np.exp(-held / 1.0)),
    }
    table = np.column_stack(list(columns.values()))[:, None, :]
    noise = lfilter([np.sqrt(1.0 - 0.9**2)], [1.0, -0.9], rng.normal(size=ROWS))
    y = NOISE * noise + rng.normal() * VARIATION / 0.05 * columns["toughness"]
    for cause, amount in hidden.items():
        y = y + amount * columns[cause]
    # Grows with the square of time and turns with depth: in no column.
    y = y + unknown * contact * np.sin(3.0 * time) ** 2 * (speed > 0.01) * np.sign(depth - 0.012)
    return RecordSensitivity(
        name=name,
        condition=f"press at {speed}",
        channels=("force_z",),
        time=time,
        phase=np.full(ROWS, "slice"),
        depth=depth,
        path=np.clip(depth, 0.0, None),
        in_contact=contact,
        measured=(force + y)[:, None],
        predicted=force[:, None],
        columns=table,
        even=np.zeros_like(table),
    )
