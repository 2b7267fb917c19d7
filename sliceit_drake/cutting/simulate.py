"""One slice on a prescribed knife motion, without a robot."""

import dataclasses as dc
from collections.abc import Iterator

import numpy as np

from sliceit_drake.cutting.board import Board
from sliceit_drake.cutting.coupling_steps import Energies, EnergyBalance
from sliceit_drake.cutting.driver import Launch, even_launches
from sliceit_drake.cutting.knife import signed_distance
from sliceit_drake.cutting.knife_path import CHECK_TRAVEL, KnifePath
from sliceit_drake.cutting.model import CuttingModel
from sliceit_drake.cutting.motion import Motion, Pose
from sliceit_drake.cutting.solver import NOT_FINITE, CuttingError, CuttingSolver

__all__ = [
    "COMPLETE",
    "ENERGY_RATIO_LIMIT",
    "LATERAL_LIMIT",
    "SliceForces",
    "SliceResult",
    "check_clear",
    "check_energies",
    "check_in_plane",
    "energy_ratio",
    "simulate_slice",
]

ENERGY_RATIO_LIMIT = 0.05
"""Kinetic energy of the added inertia, over the internal energy, above which scaled masses are not
quasi-static."""
TURN_LIMIT = 0.5
"""Tangent of the angle by which the food may have turned in the plane of the cut: the front of the
cut is followed for small ones."""
COMPLETE = 0.999
"""Fraction of a section from which it counts as cut through."""
LATERAL_LIMIT = 3e-3
"""Greatest distance of the blade from the cut plane, metres."""
TILT_LIMIT = 0.15
"""Greatest angle between the blade and the cut plane, rad."""


@dc.dataclass
class SliceForces:
    """A slice on a prescribed motion. Row k holds the mean over the coupling step that ends at
    time[k].

    Attributes:
        time: End of each coupling step [n], s.
        position: Position of Ko in F [n, 3], metres.
        food_wrench, board_wrench: Wrenches on the knife, moment about Ko and force, in F [n, 6].
        cut: Fraction of the section that is cut [n].
    """

    time: np.ndarray
    position: np.ndarray
    food_wrench: np.ndarray
    board_wrench: np.ndarray
    cut: np.ndarray


@dc.dataclass
class SliceResult(SliceForces):
    """A slice with its energies.

    Attributes:
        edge, normal, friction: Force of the food by mechanism, in F [n, 3].
        state: The food at the end.
        pose: The knife in C at the end.
        balance: Work and dissipation.
        energies: Energies at the end.
        energy_ratio: Largest kinetic over internal energy.
    """

    edge: np.ndarray
    normal: np.ndarray
    friction: np.ndarray
    state: np.ndarray
    pose: Pose
    balance: EnergyBalance
    energies: Energies
    energy_ratio: float


def check_clear(model: CuttingModel, X_CK: Pose) -> None:
    """Refuses a knife that starts inside the food.

    Raises:
        CuttingError: With how far to raise it.
    """
    nodes = model.split.nodes[model.split.node_is_material]
    distance = signed_distance(model.knife, (nodes - X_CK.p) @ X_CK.R)
    points = model.split.points - X_CK.p
    reached = np.abs(points @ X_CK.R[:, 0]) < 0.5 * model.knife.length
    depth = float((-(points @ X_CK.R[:, 2]))[reached].max(initial=-1.0))
    if depth > 0.0 or distance.min() < 0.0:
        raise CuttingError(
            f"the knife starts inside the food: its edge is {max(depth, 0.0):.4g} m below the top "
            "of the cut. Raise the start by at least that (start.clearance)."
        )


def check_in_plane(model: CuttingModel, X_CK: Pose, time: float) -> None:
    """Refuses a knife that left the plane that the model can cut.

    Raises:
        CuttingError: The edge is in the food and the blade is off the plane, turned out of it, or
            drawn so far that one of its ends is over the cut.
    """
    px, y, pz = X_CK.p.tolist()
    if pz > model.top or pz < model.bottom - model.knife.height:
        return
    (ax, _, _), (turn, _, lean), (az, _, _) = X_CK.R.tolist()
    offset, turn, lean = abs(y), abs(turn), abs(lean)
    if offset > LATERAL_LIMIT or lean > TILT_LIMIT or turn > TILT_LIMIT:
        raise CuttingError(
            f"at {time:.4g} s the blade is {1e3 * offset:.3g} mm off the cut plane, leans "
            f"{lean:.3g} rad and is turned {turn:.3g} rad about the vertical; the model holds "
            f"up to {1e3 * LATERAL_LIMIT:g} mm and {TILT_LIMIT:g} rad. Give the knife's path the "
            "plane of the cut."
        )
    # The model cuts with the edge, not with an end of it.
    low, high = model.span
    for end in (-0.5 * model.knife.length, 0.5 * model.knife.length):
        x, z = px + end * ax, pz + end * az
        if low < x < high and z < model.top:
            raise CuttingError(
                f"at {time:.4g} s an end of the knife is over the cut, {1e3 * (x - low):.3g} mm "
                "from its side: only the edge between the ends cuts. Use a longer knife "
                f"(knife.length = {model.knife.length:.4g} m), a shorter draw, or start it nearer "
                "to the other end."
            )


def energy_ratio(energies: Energies, dissipated: float, model: CuttingModel) -> float:
    """Kinetic energy over internal energy, at least 1 % of that needed to cut through.

    Of the internal energy, `dissipated` is that since the start, J.
    """
    through = model.work_through
    internal = max(energies.elastic + energies.interface + dissipated, 0.01 * through, 1e-9)
    return energies.kinetic / internal


def check_energies(
    energies: Energies, dissipated: float, model: CuttingModel, time: float, cut: float
) -> float:
    """Refuses inverted elements, food that has turned, too little work of the edge, and too much
    energy of added inertia.

    Args:
        energies, dissipated, model: As for `energy_ratio`.
        time: For the message, s.
        cut: Fraction of the section that is cut.

    Returns:
        Their `energy_ratio`.

    Raises:
        CuttingError: With time, element and cause.
    """
    if energies.least_volume_ratio <= 0.0:
        inverted = (
            f"at {time:.4g} s element {energies.min_element} is inverted (volume ratio "
            f"{energies.least_volume_ratio:.3g})"
        )
        height, blade = model.top - model.bottom, model.knife.height
        if cut >= COMPLETE and blade < height:
            raise CuttingError(
                f"{inverted}: the blade is lower than the food, {1e3 * blade:.3g} of "
                f"{1e3 * height:.3g} mm. What it has cut closes over its spine, which pushes it "
                "open as the knife goes up. Use a higher knife (knife.height), or do not go up."
            )
        raise CuttingError(
            f"{inverted}: the edge deforms the food more than its mesh can follow. "
            f"Toughness / (E h) is {model.softness:.2g}, and a skin's line load / (E h) "
            f"{model.skin_softness:.2g}; above about 0.5 and 0.3 elements at the edge invert. Give "
            f"numerics.edge_spread: {model.wide_spread:.3g}, or a stiffer wall under a skin. Use a "
            "stiffer or less tough food where that is too wide; a finer mesh alone rarely helps."
        )
    if cut < COMPLETE and abs(energies.slope) > TURN_LIMIT:
        raise CuttingError(
            f"at {time:.4g} s the food has turned by {np.degrees(np.arctan(energies.slope)):.3g} "
            "degrees in the plane of the cut: it rolls under the knife, and the cut follows small "
            "turns only. Hold the food (food.held_sides), or draw less."
        )
    owed = energies.debt / max(model.work_through, 1e-9)
    advice = "saw by more than the food gives,"
    if model.numerics.edge_spread == 0.0:
        advice = f"{advice} give numerics.edge_spread: {model.wide_spread:.3g} for sawing,"
    # On what is left the edge does up to twice the work.
    if owed > model.numerics.work_error + 2.0 * (1.0 - cut):
        raise CuttingError(
            f"at {time:.4g} s {100 * cut:.3g} % of the section are cut, and the edge has done "
            f"{100 * owed:.1f} % less work than its toughness asks for, more than it can make up: "
            "the food has moved with the knife, back and forth or as a whole, faster than the "
            "edge's direction follows. Hold the food (food.held_sides, numerics.board_friction), "
            f"{advice} or use a smaller numerics.time_step."
        )
    ratio = energy_ratio(energies, dissipated, model)
    # Food that itself moves fast, as where it slides, has its true mass.
    excess = ratio * energies.added / max(energies.kinetic, 1e-30)
    if excess > ENERGY_RATIO_LIMIT:
        raise CuttingError(
            f"at {time:.4g} s the added inertia's kinetic energy is {100 * excess:.1f} % of the "
            f"internal energy, more than {100 * ENERGY_RATIO_LIMIT:.0f} %: scaled masses are not "
            "quasi-static here. Use a smaller numerics.time_step than the sub-step here, "
            f"{energies.sub_step:.3g} s, or a slower motion."
        )
    return ratio


def simulate_slice(
    solver: CuttingSolver,
    motion: Motion,
    board: Board | None = None,
    check_period: float = 0.05,
) -> SliceResult:
    """Drives the knife along `motion` through the food.

    Args:
        solver: The cut and its coupling period.
        motion: Poses X_FK of the knife.
        board: Board under the knife, its height in F; None for none.
        check_period: Interval of the energy and inversion checks, s; shorter where the knife moves
            more than `CHECK_TRAVEL` in it.

    Raises:
        CuttingError: The knife starts in the food, or the cut became unphysical.
    """
    model, T = solver.model, solver.exchange_period
    path = KnifePath(model, motion, T)
    count = path.coupling_steps
    every = max(1, round(check_period / T))
    check_clear(model, path.pose(0))
    balance = EnergyBalance()
    wrenches, cut = np.zeros((count, 3, 6)), np.zeros(count)
    ratio = travel = 0.0
    last_check = 0

    def launches() -> Iterator[Launch]:
        for launch in even_launches([path]):
            for m in range(launch.first + 1, launch.first + launch.coupling_steps + 1):
                check_in_plane(model, path.pose(m), m * T)
            yield launch

    for (k, block, _), (step,) in solver.driver.run([path], launches(), board):
        if not step.finite:
            raise CuttingError(f"at {(k + 1) * T:.4g} s {NOT_FINITE}")
        at, state = slice(k, k + block), step.state
        balance += step.balance
        wrenches[at] = step.wrenches
        cut[at] = step.cut
        end = k + block
        moved = np.diff(path.p_FK[k : end + 1], axis=0)
        travel += float(np.linalg.norm(moved, axis=1).sum())
        if end - last_check >= every or travel > CHECK_TRAVEL or end == count:
            travel, last_check = 0.0, end
            energies = solver.energies(state, path.pose(end))
            spent = balance.edge + balance.opening + balance.friction
            ratio = max(ratio, check_energies(energies, spent, model, end * T, cut[end - 1]))
    parts = path.in_food(wrenches)
    mechanisms = parts[:, :, 3:]
    return SliceResult(
        time=np.arange(1, count + 1) * T,
        position=path.p_FK[1:],
        food_wrench=parts.sum(1),
        board_wrench=path.board_wrenches(board),
        edge=mechanisms[:, 0],
        normal=mechanisms[:, 1],
        friction=mechanisms[:, 2],
        cut=cut,
        state=state,
        pose=path.pose(count),
        balance=balance,
        energies=energies,
        energy_ratio=ratio,
    )
