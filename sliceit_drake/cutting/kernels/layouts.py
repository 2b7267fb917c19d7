"""Names of the numbers that the kernels read and write in rows: one layout for them and readers."""

import enum
from typing import Any

import numpy as np

__all__ = [
    "BALANCE",
    "BLADE_SUMS",
    "FRONT",
    "KNIFE",
    "PLANNED",
    "POINT_SUMS",
    "POINT_TOTALS",
    "Balance",
    "BladeSum",
    "Front",
    "Planned",
    "PointSum",
    "PointTotal",
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
POINT_TOTALS = np.dtype(
    [
        ("push", "f8"),
        ("width", "f8"),
        ("place", "f8"),
        ("square", "f8"),
        ("sunk", "f8"),
        ("leant", "f8"),
        ("drawn", "f8"),
        ("travel", "f8"),
        ("limit", "f8"),
        ("owed", "f8"),
    ]
)
"""Totals over the cut points in a sub-step: the force of the flanks on the blade along Ky; weighted
by the width that each point carries at the front of the cut 1, x at rest, its square, the
displacement along Kz, that times x, the velocity along Kx, and the edge's travel; what the edge's
force may be, N; and the work that it should have done less what it did, J."""

FRONT = np.dtype(
    [
        ("sunk", "f8"),
        ("slope", "f8"),
        ("drift", "f8"),
        ("drift_ahead", "f8"),
        ("debt", "f8"),
        ("raised", "f8"),
    ]
)
"""The front of the cut: the food's displacement along Kz at x = 0, metres, and its slope along x;
the velocity along Kx at which food that nothing holds slides, m/s, filtered and with a lead; the
work that the edge owes for the area that it has cut, J, and by what fraction its force is
raised."""

PLANNED = np.dtype([("before", "f8", 3), ("behind", "f8", 3), ("sub_step", "f8"), ("calm", "f8")])
"""What a state holds of its sub-steps: the velocities of the edge's two points that the food has
settled to, in C, m/s; its last sub-step, s, or 0; coupling steps in which it could have been twice
as long."""


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
PointTotal = _places("PointTotal", POINT_TOTALS)
Front = _places("Front", FRONT)
Planned = _places("Planned", PLANNED)
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
