"""Names of the numbers that the kernels read and write in rows: one layout for them and readers."""

import enum
from typing import Any

import numpy as np

__all__ = [
    "BALANCE",
    "BLADE_SUMS",
    "KNIFE",
    "POINT_SUMS",
    "Balance",
    "BladeSum",
    "PointSum",
    "Section",
    "field_shape",
    "numbers",
    "results",
]

KNIFE = np.dtype(
    [
        ("tip", "f8", 2),
        ("shoulder", "f8", 2),
        ("spine", "f8", 2),
        ("edge_radius", "f8"),
        ("half_length", "f8"),
    ]
)
"""The knife's section, corners as (|y|, height) drawn in by the radius, and half its length, m."""

POINT_SUMS = np.dtype(
    [
        ("forces", "f8", (3, 3)),
        ("moments", "f8", (3, 3)),
        ("edge_loss", "f8"),
        ("opening_loss", "f8"),
        ("friction_loss", "f8"),
        ("cut_area", "f8"),
        ("buried_moment", "f8", 3),
        ("buried_area", "f8"),
    ]
)
"""Sums over the cut points: forces and moments on the knife by edge, flank pressure and friction,
and energies dissipated, each summed over the sub-steps of a coupling step; at its end the area that
is cut, and the moment about Ko and the size of that part of the flanks which is in the food."""

BLADE_SUMS = np.dtype([("loss", "f8"), ("on_knife", "f8"), ("on_blade", "f8")])
"""Sums over the sub-steps of a coupling step: energy lost in the bending blade, the force that it
passes on to the knife's body, and the force of the flanks on it."""

BALANCE = np.dtype(
    [
        ("work", "f8"),
        ("gravity", "f8"),
        ("edge", "f8"),
        ("opening", "f8"),
        ("friction", "f8"),
        ("board_friction", "f8"),
        ("blade", "f8"),
        ("internal", "f8"),
    ]
)
"""Work and dissipation, see `EnergyBalance`."""


def results(coupling_steps: int) -> np.dtype:
    """Results of one cut over E coupling steps: sums and wrenches of each, the area that is cut at
    its end; the board's mean force on the food, and the balance, over all of them."""
    return np.dtype(
        [
            ("point_sums", POINT_SUMS, (coupling_steps,)),
            ("blade", BLADE_SUMS, (coupling_steps,)),
            ("wrenches", "f8", (coupling_steps, 3, 6)),
            ("wrench", "f8", (coupling_steps, 6)),
            ("work", "f8", (coupling_steps,)),
            ("cut", "f8", (coupling_steps,)),
            ("board_force", "f8", 3),
            ("balance", BALANCE),
            ("added_force", "f8", (coupling_steps,)),
        ]
    )


def _places(name: str, layout: np.dtype) -> Any:
    """Places of the first number of each field."""
    assert layout.fields is not None
    return enum.IntEnum(name, {k.upper(): at[1] // 8 for k, at in layout.fields.items()})


Section = _places("Section", KNIFE)
PointSum = _places("PointSum", POINT_SUMS)
BladeSum = _places("BladeSum", BLADE_SUMS)
Balance = _places("Balance", BALANCE)


def numbers(layout: np.dtype) -> int:
    """How many numbers a layout names."""
    return layout.itemsize // 8


def field_shape(layout: np.dtype, name: str) -> tuple[int, ...]:
    """Shape of a field as an array of numbers."""
    field = layout[name]
    return field.shape + ((numbers(field.base),) if field.base.names else ())
