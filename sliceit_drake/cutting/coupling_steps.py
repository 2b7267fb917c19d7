"""Advances food through coupling steps: forces on the knife, work and dissipation."""

import dataclasses as dc
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from sliceit_drake.cutting.kernels.layouts import BALANCE
from sliceit_drake.cutting.workspace import Workspace

__all__ = ["CouplingSteps", "Energies", "EnergyBalance", "run_coupling_steps"]


@dc.dataclass
class Energies:
    """Energies of a state, J.

    Attributes:
        elastic: Energy of the bulk.
        interface: Energy of bonds, contacts, friction anchors, the edge's unloading and the bent
            blade.
        kinetic: Energy of the stepped (scaled) mass.
        added: The part of it that the true masses do not have.
        sub_step: The last, s.
        debt: Work that the edge owes for the area that it has cut.
        slope: Of the front of the cut against the food at rest: the tangent of the angle by which
            the food has turned in the plane of the cut.
        least_volume_ratio: Smallest J of all elements.
        min_element: Element that has it.
    """

    elastic: float
    interface: float
    kinetic: float
    added: float
    sub_step: float
    debt: float
    slope: float
    least_volume_ratio: float
    min_element: int


@dc.dataclass
class EnergyBalance:
    """Work and dissipation over a time, J.

    Attributes:
        work: Work of the knife on the food.
        gravity: Work of the food's weight.
        edge, opening, friction, board_friction, blade: Energy dissipated, each never negative, by
            the edge, bonds that open, friction on the flanks, friction and damping on the board,
            and the bending blade.
        internal: Work of the bulk's forces (elastic and damping) on the nodes.
    """

    work: float = 0.0
    gravity: float = 0.0
    edge: float = 0.0
    opening: float = 0.0
    friction: float = 0.0
    board_friction: float = 0.0
    blade: float = 0.0
    internal: float = 0.0

    def __add__(self, later: "EnergyBalance") -> "EnergyBalance":
        both = zip(dc.astuple(self), dc.astuple(later), strict=True)
        return EnergyBalance(*(a + b for a, b in both))

    def damping(self, energies: Energies) -> float:
        """Dissipated by the bulk's viscosity: work on the elements that they do not store."""
        return -self.internal - energies.elastic

    def residual(self, energies: Energies) -> float:
        """Work put in minus everything that it went into; 0 if energy is conserved."""
        stored = energies.elastic + energies.interface + energies.kinetic
        spent = self.edge + self.opening + self.friction + self.board_friction + self.blade
        return self.work + self.gravity - stored - spent - self.damping(energies)


def _part(name: str, *shape: int) -> Any:
    return property(lambda steps: steps.row[steps.places[name]].reshape(shape))


@dc.dataclass
class CouplingSteps:
    """Result of E coupling steps in a row.

    Wrenches act on the knife, at Ko at the end of their coupling step, in C: moment, Nm, and force,
    N.

    Attributes:
        state: The food's new state [state_size].
        wrenches: Mean wrenches by mechanism: edge, flank pressure, friction [E, 3, 6].
        wrench: Wrench of all mechanisms in the last coupling step [6].
        cut: Fraction of the section that the edge has passed [E].
        board_force: Mean force of the board on the food [3], N.
        works: Work and dissipation over all coupling steps, in J, as `layouts.BALANCE` [8].
        added_force: Forces of the inertia that is added to the true masses, in the last sub-step of
            each coupling step: sum of their components' magnitudes over all nodes [E], N.
        substeps: Of each.
        section_area: Area of the section, m2.
        row, places: The numbers that the others are, and where in them each stands; see
            `layouts.results`.
    """

    state: np.ndarray
    substeps: int
    section_area: float
    row: np.ndarray
    places: Mapping[str, slice]

    wrenches = _part("wrenches", -1, 3, 6)
    board_force = _part("board_force", -1)
    works = _part("balance", -1)
    added_force = _part("added_force", -1)

    @property
    def wrench(self) -> np.ndarray:
        return self.row[self.places["wrench"]][-6:]

    @property
    def cut(self) -> np.ndarray:
        return self.row[self.places["cut"]] / self.section_area

    @property
    def progress(self) -> float:
        """Last of `cut`."""
        return float(self.row[self.places["cut"].stop - 1]) / self.section_area

    @property
    def balance(self) -> EnergyBalance:
        """Work and dissipation over all coupling steps."""
        return EnergyBalance(**dict(zip(BALANCE.names or (), self.works.tolist(), strict=True)))

    @property
    def finite(self) -> bool:
        """Whether the cut has not broken down; limits on forces can hide a state that has."""
        # What is not finite makes the sum of squares so, at a fourth of the cost of tests.
        wrenches = self.row[self.places["wrenches"]]
        return math.isfinite(self.state.dot(self.state) + wrenches.dot(wrenches))


def run_coupling_steps(
    ws: Workspace, states: np.ndarray, R: np.ndarray, p: np.ndarray
) -> list[CouplingSteps]:
    """Advances all cuts of a workspace by its coupling steps.

    Args:
        ws: Workspace of C cuts and E coupling steps.
        states: [C, state_size].
        R: Rotations of the knives in C at the ends of the coupling steps [C, E + 1, 3, 3].
        p: Positions of Ko there [C, E + 1, 3], metres.

    Returns:
        One result a cut; what is not finite is left so.
    """
    ws.advance(states, R, p)
    new, rows = ws.read(ws.states[-1]).copy(), ws.read(ws.result_rows).copy()
    return [
        CouplingSteps(new[c], ws.substeps, model.section_area, rows[c], ws.result_layout)
        for c, model in enumerate(ws.models)
    ]
