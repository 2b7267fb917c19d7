"""One cut, prepared: geometry with parameters and the masses that are stepped."""

import copy
import dataclasses as dc
import functools
from typing import Any, Self

import numpy as np
from scipy.sparse import csc_array
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import choice, quantity
from sliceit_drake.cutting.foods.effects import Effects, Section
from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.inertia import Inertia, assemble, largest_share
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.cut_geometry import CutGeometry
from sliceit_drake.cutting.mesh.cut_surface import edge_tables

__all__ = [
    "GRAVITY",
    "SOFTEST",
    "CuttingModel",
    "Numerics",
    "PointScales",
    "TimeStepError",
    "prepare_cut",
]

GRAVITY = 9.81
"""Acceleration of gravity, as Drake's plants have it, m/s^2."""

DEBT_LENGTH = 2.5
"""Way of the edge over which it makes up for work that it owes, in rows of the section's triangles:
more than one, for the elastic energy of the food swings with them."""

FOLLOWS = 0.75
"""Travel past a soft food over which the edge's direction follows, in `Numerics.edge_spread`: less,
and a draw swings with the food; more, and strokes feel it further."""
DRIFT_LENGTH = 5e-4
"""Travel of the edge over which the drift of unheld food is filtered, metres."""
DRIFT_LEAD = 1e-3
"""Time by which it is led, s: without it, food that slides swings in the filter."""

SLIVER = 0.1
"""Fraction of a vertex's mass below which a node of one side does not set the step."""

SWING = 6.0
"""Relaxation time of the blade beside its own, in steps: the inertia that its contacts need makes
it heavy, and it would swing sideways for half a second after it has met the food."""
LEAN = 0.15
"""Angle between a flank and the cut plane for which added inertia suffices, rad."""

SOFTEST = 0.5
"""Greatest toughness over Young's modulus, R / E, at which the edge's force is verified, over the
length by which the mesh follows an edge or `Numerics.edge_spread`."""
SOFTEST_UNDER_SKIN = 0.3
"""The same of a skin's line load over Young's modulus; a spread does not help there."""

SPLITS = 0.8
"""Line load of a skin over the strength and height of a food, from which on the food may come apart
under its skin before the edge is through that."""

BULK_SHARE = 0.95
"""Share of the stepped masses that the bulk may need where a half of the food is free."""


class TimeStepError(ValueError):
    """The time step is beyond the stability limit; the message names the limit and the fix."""


@dc.dataclass
class Numerics:
    """Numerical settings of a cut. Board and bonds scale with E over the edge length h."""

    time_step: float = quantity(1e-3, "s", low=1e-7, high=5e-3)
    """Longest sub-step; must divide the coupling period."""
    step_by_need: bool = True
    """Whether sub-steps are shorter where knife or food change their velocity."""
    mass_scaling: bool = True
    """Whether inertia is added as the step asks for it; else a step too long is refused."""
    stability_margin: float = quantity(0.8, "", low=0.1, high=0.95)
    """Step over the Gershgorin stability limit."""
    numerical_damping: float = quantity(0.2, "", low=0.0, high=0.5)
    """Viscosity of bulk and flank contact beside the material's, in steps."""
    bond_stiffness: float = quantity(4.0, "E/h", low=0.01, high=1e3)
    """Stiffness of the uncut faces and of their self contact."""
    flank_length: float = quantity(2e-4, "m", low=1e-6, high=1.0)
    """Length that E over it is the flanks' contact stiffness per area."""
    anchor_length: float = quantity(1e-3, "m", low=1e-6, high=1.0)
    """Length that E over it is the stiffness of the flanks' friction per area until it slides."""
    board_stiffness: float = quantity(1.0, "E/h", low=0.01, high=1e3)
    """Contact stiffness of the food on the board."""
    board_friction: float = quantity(0.3, "", low=0.0, high=2.0)
    """Friction of food on board."""
    board_damping_time: float = quantity(5e-4, "s", low=0.0, high=1.0)
    """Damping over stiffness of the food on the board."""
    unloading_length: float = quantity(1e-4, "m", low=1e-6, high=1e-2)
    """Retreat of the edge over which its force vanishes; less where it rises more steeply."""
    edge_spread: float = quantity(0.0, "m", low=0.0, high=0.05)
    """Depth above and below the edge over which its force is spread: 2 toughness / E if soft. The
    edge's direction then follows its motion past the food, which may move with the blade."""
    direction_length: float = quantity(2e-4, "m", low=1e-7, high=1e-2)
    """Travel over which the edge's direction follows."""
    work_error: float = quantity(0.02, "", low=0.0, high=0.5)
    """Fraction of a cut's work that the edge may still owe when it is through; more is refused."""
    precision: str = choice("float32", ("float32", "float64"))
    """Arithmetic of the kernels."""
    device: str = "cpu"
    """A device by Warp's name: "cpu", "cuda" or "cuda:1"."""


@dc.dataclass
class PointScales:
    """Factors on the material's values for each cut point [P].

    Attributes:
        toughness: Factors on the surface energy.
        friction: Factors on the sliding friction of the flanks.
        flank_stiffness: Factors on the contact stiffness of the flanks.
    """

    toughness: np.ndarray
    friction: np.ndarray
    flank_stiffness: np.ndarray


@dc.dataclass
class CuttingModel(CutGeometry):
    """One cut, prepared: its geometry, what the user gave, and what follows for the kernels.

    Attributes:
        material, effects, knife, numerics: What the user gave.
        point_scales: Factors by cut point.
        true_mass: Lumped mass [N], kg.
        weight: Gravity force on each node [N, 3], N, by the true mass.
        toughness: Surface energy of each cut point [P], J/m^2.
        toughness_by_scale: Its derivative by the point's scale [P], J/m^2.
        flank_scale: Factors on the contact stiffness of the flanks [P].
        unloading: Slope of the edge's force when it retreats [P], N/m.
        element_volume: Stiff volume of the elements times their modulus over the material's [T].
        relaxing: Fractions of the modulus that relax [M].
        keep: What a sub-step leaves of each branch's force [M].
        parameters: Scalars by name, see `PARAMETERS`.
    """

    material: Material
    effects: Effects
    knife: Knife
    numerics: Numerics
    point_scales: PointScales
    true_mass: np.ndarray = dc.field(init=False)
    _inertia_of: "CuttingModel | None" = dc.field(init=False, default=None)
    _like: "CuttingModel | None" = dc.field(init=False, default=None)
    weight: np.ndarray = dc.field(init=False)
    toughness: np.ndarray = dc.field(init=False)
    toughness_by_scale: np.ndarray = dc.field(init=False)
    flank_scale: np.ndarray = dc.field(init=False)
    unloading: np.ndarray = dc.field(init=False)
    element_volume: np.ndarray = dc.field(init=False)
    relaxing: np.ndarray = dc.field(init=False)
    keep: np.ndarray = dc.field(init=False)
    parameters: dict[str, float] = dc.field(init=False)

    def __post_init__(self) -> None:
        material, effects, numerics = self.material, self.effects, self.numerics
        self.true_mass = material.density * self.node_volume
        self.weight = -GRAVITY * material.density * self.weight_volume[:, None] * self.up
        if self.tables.spread != numerics.edge_spread:
            split = self.split
            section, groups = split.points[:, [0, 2]], split.nearest_vertex
            self.tables = edge_tables(section, split.triangles, numerics.edge_spread, groups)
        self.toughness_by_scale = np.full(len(self.point_depth), material.toughness)
        self.flank_scale = self.point_scales.flank_stiffness
        up = self.split.points[:, 2] - self.bottom
        if effects.section != Section():
            width = effects.section.width(2.0 * up / (self.top - self.bottom) - 1.0)
            self.toughness_by_scale = self.toughness_by_scale * width
            self.flank_scale = self.flank_scale * width
        excess = self._excess()
        points, elements = self.distances_inside(effects.core.offset)
        centred, _ = self.distances_inside(effects.centre.offset)
        parts = (effects.core, points), (effects.centre, centred), (effects.underside, up)
        for part, place in parts:
            factor = 1.0 + (part.toughness_ratio - 1.0) * part.share(place)
            self.toughness_by_scale, excess = self.toughness_by_scale * factor, excess * factor
        self.toughness = self.toughness_by_scale * self.point_scales.toughness + excess
        inside = effects.core.share(elements)
        stiffer = effects.core.stiffness_ratio - 1.0
        self.element_volume = self.stiff_volume * (1.0 + stiffer * inside)
        # Never flatter than the rise of the force on the way in: a retreat must not return more
        # energy than the advance took.
        force = self.edge_forces()
        steepest = (np.diff(force, axis=1) / self.tables.spacing).max(1)
        self.unloading = np.maximum(force.max(1) / numerics.unloading_length, steepest)
        self.relaxing = np.array(effects.relaxation.shares, float)
        self._by_step: dict[str, Self] = {}
        self._set_step()

    def _excess(self) -> np.ndarray:
        """Toughness beyond the material's, near the outside and near the top [P], J/m^2: by what
        the effects ask for in all, whatever the mesh makes of its shape."""
        tables, outside = self.tables, self.effects.outside
        out = np.zeros(len(self.point_depth))
        if outside.toughness > 0.0:
            outline = float(tables.outline.sum()) / 2.0
            shape = np.exp(-self.point_distance / outside.thickness)
            out += outside.toughness * outline * shape / float(tables.area @ shape)
        grid = np.linspace(-tables.reach, tables.reach, tables.width.shape[1])
        depths = self.top - self.split.points[:, 2]
        for initiation, depth in self.effects.entry.excesses():
            if initiation > 0.0:
                below = np.maximum(depths[:, None] + grid, 0.0)
                work = float((np.exp(-below / depth) * tables.width).sum()) * tables.spacing
                shape = np.exp(-np.maximum(depths, 0.0) / depth)
                out += initiation * work * shape / float(tables.area @ shape)
        return out

    def _set_step(self) -> None:
        """Sets what depends on the sub-step."""
        step, times = self.numerics.time_step, np.array(self.effects.relaxation.times, float)
        self.keep = np.exp(-step / times)
        self.parameters = self._parameters()
        if not self.numerics.mass_scaling and step > self.critical_time_step:
            raise self._too_long()

    def _parameters(self) -> dict[str, float]:
        material, effects, knife, numerics = self.material, self.effects, self.knife, self.numerics
        scale = material.youngs_modulus / self.element_size
        bond = numerics.bond_stiffness * scale
        places = effects.core, effects.centre, effects.underside
        weakest = float(np.prod([min(1.0, part.toughness_ratio) for part in places]))
        weakest = max(material.toughness * weakest, 1e-12)
        mu, lam = material.stable_neo_hookean()
        step = numerics.time_step
        return {
            "mu": mu,
            "lam": lam,
            "damping_time": material.damping_time + numerics.numerical_damping * step,
            "bond_stiffness": bond,
            # A bond holds up to a quarter of its opening at failure, 2 R / strength, or less.
            "strength": min(material.strength, 0.5 * float(np.sqrt(2.0 * weakest * bond))),
            "flank_stiffness": material.youngs_modulus / numerics.flank_length,
            "contact_damping": numerics.numerical_damping,
            "anchor_stiffness": material.youngs_modulus / numerics.anchor_length,
            "friction": material.friction,
            "static_friction": material.static_friction,
            "stribeck_velocity": material.stribeck_velocity,
            "direction_length": max(numerics.direction_length, FOLLOWS * numerics.edge_spread),
            "debt_length": DEBT_LENGTH * self.row_height,
            "drift_rate": 1.0 / DRIFT_LENGTH if self.unheld else 1e9 * (numerics.edge_spread > 0.0),
            "drift_lead": DRIFT_LEAD * self.unheld,
            "board_stiffness": numerics.board_stiffness * scale,
            "board_friction": numerics.board_friction,
            "board_damping_time": numerics.board_damping_time,
            "blade_stiffness": knife.lateral_stiffness,
            "blade_damping": knife.lateral_stiffness * self._blade_relaxation,
            "rate_exponent": effects.toughness_rate.exponent,
            "reference_speed": effects.toughness_rate.reference_speed,
            "slice_push_exponent": effects.slice_push.exponent,
            "skin_toughness": effects.skin.toughness,
            "skin_thickness": effects.skin.thickness,
            "adhesion": effects.adhesion.stress,
            "flank_viscosity": effects.adhesion.viscosity,
            "flank_exponent": effects.adhesion.exponent,
            "flank_speed": effects.adhesion.reference_speed,
            "initiation": effects.bluntness.grown,
            "initiation_depth": effects.bluntness.depth,
            "edge_share": effects.edge.share,
        }

    @functools.cached_property
    def critical_time_step(self) -> float:
        """Stability limit with the true masses, including the margin, s.

        Slivers do not count: nodes with less than `SLIVER` of their vertex's mass get what they
        need.
        """
        return self.numerics.stability_margin * float(self._stable_steps.min())

    @property
    def _stable_steps(self) -> np.ndarray:
        """The stability limit without the margin by moving node [K], s; none for slivers."""
        mass = self.true_mass
        stiff, viscous = self._stiffness_bounds()
        # A step x is stable if stiff x^2 + viscous x <= mass.
        limit = 2.0 * mass / (viscous + np.sqrt(viscous**2 + 4.0 * stiff * mass))
        sliver = self._slivers[self.moving]
        return np.where(sliver & ~sliver.all(), np.inf, limit[self.moving])

    def _too_long(self) -> TimeStepError:
        node = self.moving[int(self._stable_steps.argmin())]
        critical, stiff = self.critical_time_step, self._stiffness_bounds()[0][node]
        return TimeStepError(
            f"numerics.time_step = {self.numerics.time_step:.3g} s is beyond the stability limit "
            f"{critical:.3g} s, set by the node at {self.nodes[node]} m of the cut frame "
            f"(true mass {self.true_mass[node]:.3g} kg, stiffness bound {4.0 * stiff:.3g} "
            f"N/m). Give at most {0.99 * critical:.3g}, a coarser mesh, or mass_scaling: true."
        )

    @functools.cached_property
    def inertia(self) -> Inertia:
        """Mass matrix that is stepped."""
        numerics = self.numerics
        if self._inertia_of is not None:
            return self._inertia_of.with_step(numerics.time_step).inertia
        if numerics.mass_scaling:
            share = self._bulk_share
            # By more than in proportion: what else is in the matrix stays.
            factor = max(1.0, share / BULK_SHARE) ** 1.5
            return Inertia(self._scaled_masses(factor) if factor > 1.0 else self._unraised_masses)
        stiff, viscous = self._stiffness_bounds()
        x = self.critical_time_step / numerics.stability_margin
        needed = np.where(self._slivers, (stiff * x + viscous) * x, 0.0)
        flank = self.parameters["flank_stiffness"] * self.flank_scale
        blade = float(flank @ self.tables.area) * x**2 + self._bending(x)
        diagonal = np.maximum(self.true_mass, needed)
        return Inertia(self._with_blade([], diagonal, max(blade, self.knife.lateral_mass())))

    def _bending(self, x: float) -> float:
        """What the blade's spring and damper add to its entry, kg; see `_scaled_masses`."""
        knife = self.knife
        return (0.25 * x**2 + 0.5 * x * self._blade_relaxation) * knife.lateral_stiffness

    @property
    def _blade_relaxation(self) -> float:
        """Damping of the blade over its stiffness, s."""
        return self.knife.lateral_relaxation_time + SWING * self.numerics.time_step

    def _with_blade(self, parts: Any, diagonal: np.ndarray, entry: float) -> csc_array:
        """See `assemble`; the blade is the node after the last, with its own entry, kg."""
        moving = np.append(self.moving, len(diagonal))
        return assemble(moving, parts, np.append(diagonal, entry))

    @functools.cached_property
    def _slivers(self) -> np.ndarray:
        """Whether a node is one [N]."""
        return np.asarray(self.node_volume < SLIVER * self.vertex_volume)

    @functools.cached_property
    def _unraised_masses(self) -> csc_array:
        return self._scaled_masses()

    def _scaled_masses(self, bulk_factor: float = 1.0) -> csc_array:
        """True masses and what keeps a step, x with the stability margin, stable, kg.

        With f = -K u - C v a step is stable if S >= (x / 2)^2 K + (x / 2) C. Every stiffness that
        can become active is there from the start.
        """
        bulk, bond, flank, anchor, unloading, board, blade = self._mass_parts
        _, products = self._gradient_products
        w, zero = self.point_weights, np.zeros_like(self.point_weights)
        none = zero[:, :1]
        minus, plus = np.hstack([w, zero, none]), np.hstack([zero, w, none])
        middle = np.hstack([zero, zero, none + 1.0])
        ends = np.column_stack([self.point_nodes, np.full(len(w), len(self.nodes))])
        points = sum(
            stiffness[:, None, None] * row[:, :, None] * row[:, None, :]
            for stiffness, row in (
                (bond, plus - minus),
                (flank, minus - middle),
                (flank, plus - middle),
                (anchor, minus),
                (anchor, plus),
                (unloading, 0.5 * (minus + plus)),
            )
        )
        parts = [(self.tetrahedra, (bulk_factor * bulk)[:, None, None] * products), (ends, points)]
        return self._with_blade(parts, self.true_mass + board, float(blade[0]))

    @functools.cached_property
    def _mass_parts(self) -> tuple[np.ndarray, ...]:
        """What `_scaled_masses` adds to the true masses: factors of the bulk in each element [T];
        of bonds, flanks, friction and unloading at each cut point [P]; the board's at each node
        [N]; and the blade's entry [1], all kg but the first, kg m^2."""
        material, numerics, parameters = self.material, self.numerics, self.parameters
        mu, lam = material.lame()
        x = numerics.time_step / numerics.stability_margin
        square, half = 0.25 * x**2, 0.5 * x
        damped = square * (1.0 + 2.0 * numerics.numerical_damping)
        viscous = damped + half * material.damping_time
        area, adhesion = self.tables.area, self.effects.adhesion
        scaled = damped * self.flank_scale * area
        # Friction acts against the knife's body. So does the part of the pressure that is not
        # along y: the flanks lean a little, and so may the knife.
        anchor = (parameters["anchor_stiffness"] + LEAN**2 * parameters["flank_stiffness"]) * scaled
        board = parameters["board_stiffness"] * self.board_area
        return (
            viscous * (lam + 2.0 * mu) * self.element_volume,
            square * parameters["bond_stiffness"] * area,
            parameters["flank_stiffness"] * scaled,
            anchor + x * adhesion.viscosity * adhesion.steepest * area,
            square * self.unloading,
            board * (2.0 * square + half * numerics.board_damping_time),
            np.array([self.knife.lateral_mass() + self._bending(x)]),
        )

    @functools.cached_property
    def _bulk_share(self) -> float:
        """Share of the mass matrix that the stiffness and damping of the bulk need, at most.

        (lam + 2 mu) grad u : grad u bounds the bulk's energy where the surface is held; a part that
        is free may dilate, by up to 3 lam + 2 mu.
        """
        if self._like is not None and (most := self._share_by(self._like)) <= BULK_SHARE:
            return most
        mu, lam = self.material.lame()
        modulus = self._bulk_modulus
        gradient, back = self._gradient

        def forces(motion: np.ndarray) -> np.ndarray:
            strain = (gradient @ motion[:-1]).reshape(-1, 3, 3)
            stress = mu * (strain + strain.swapaxes(1, 2))
            stress += lam * strain.trace(axis1=1, axis2=2)[:, None, None] * np.eye(3)
            of_nodes = back @ (modulus[:, None, None] * stress).reshape(-1, 3)
            return np.vstack([of_nodes, np.zeros(3)])

        # A dilation needs most. Some of any other motion is in the start, in case one does.
        around = self.nodes[self.moving] - self.nodes[self.moving].mean(0)
        start = np.vstack([around, np.zeros(3)])
        start += 0.1 * around.std() * np.random.default_rng(0).normal(size=start.shape)
        return largest_share(forces, self._unraised_masses, start)

    @property
    def _bulk_modulus(self) -> np.ndarray:
        """What the moduli are multiplied with in each element [T], s^2 m^3: stiffness and damping
        in half a step."""
        half = 0.5 * self.numerics.time_step
        return (half**2 + half * self.parameters["damping_time"]) * self.element_volume

    def _share_by(self, other: "CuttingModel") -> float:
        """A bound of `_bulk_share` by that of another cut of the mesh, whose masses and stiffness
        are sums of the same positive parts with other factors."""
        mine, theirs = ((m.true_mass, *m._mass_parts) for m in (self, other))
        lightest = min(_ratios(a, b).min(initial=np.inf) for a, b in zip(mine, theirs, strict=True))
        moduli = (np.array(m.material.lame()) for m in (self, other))
        stiffest = _ratios(*moduli).max() * _ratios(self._bulk_modulus, other._bulk_modulus).max()
        with np.errstate(divide="ignore"):
            return float(other._bulk_share * stiffest / lightest)

    def _stiffness_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Gershgorin's bounds of a quarter of the stiffness, N/m, and of half the damping, Ns/m, of
        each node [N]."""
        material, numerics, parameters = self.material, self.numerics, self.parameters
        area, adhesion = self.tables.area, self.effects.adhesion
        # In a layer between core and rind the stiffer of two elements sets a node's bound.
        bulk = 0.25 * self.stiffness_bound(self.element_volume, *material.lame())
        damped = 1.0 + 2.0 * numerics.numerical_damping
        flank = damped * parameters["flank_stiffness"] * self.flank_scale
        per_point = area * (2.0 * parameters["bond_stiffness"] + 2.0 * flank) + 0.5 * self.unloading
        board = parameters["board_stiffness"] * self.board_area
        contact = 2.0 * board
        viscous = 2.0 * material.damping_time * bulk + 0.5 * numerics.board_damping_time * board
        dragged = adhesion.viscosity * adhesion.steepest * area
        ends, shares = self.point_nodes.T.ravel(), np.tile(self.point_weights.T, (2, 1))
        np.add.at(contact, ends, (per_point * shares).ravel())
        np.add.at(viscous, ends, (dragged * shares).ravel())
        return bulk * damped + 0.25 * contact, viscous

    @property
    def work_through(self) -> float:
        """Work of cutting the whole section, R A, J."""
        return float(self.toughness @ self.tables.area)

    @property
    def mass_ratio(self) -> float:
        """Stepped over true mass of the moving nodes in a translation."""
        return float(self.inertia.of_nodes.sum() / self.true_mass[self.moving].sum())

    @property
    def _edge_scale(self) -> float:
        """Length by which the mesh follows an edge, h, metres: the mean edge of its elements, or
        one and a half rows of the section, if these are finer."""
        return min(self.element_size, 1.5 * self.row_height)

    @property
    def softness(self) -> float:
        """Greatest toughness over Young's modulus and the mesh's length at the edge, R / (E h)."""
        return float(self.toughness.max()) / (self.material.youngs_modulus * self._edge_scale)

    @property
    def skin_softness(self) -> float:
        """A skin's line load over Young's modulus of what is under it and the same length."""
        return self.effects.skin.line_load / (self.material.youngs_modulus * self._edge_scale)

    @property
    def strength(self) -> float:
        """Traction at which the uncut faces part, Pa: the material's, where the mesh allows it.

        A bond that opens elastically by much of what it can open at all has no softening left to
        follow. Its strength is then lowered at constant toughness; see `warnings`.
        """
        return self.parameters["strength"]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Where the computation departs from what the user gave, and how to mend it."""
        texts = []
        if self.unheld and self.numerics.board_friction == 0.0:
            texts.append(
                "food.held_sides = none and numerics.board_friction = 0: nothing holds the food, "
                "and a draw pushes it away. Hold a side, or give the board friction, as 0.3."
            )
        size = self.element_size
        wanted, used = self.material.strength, self.strength
        if used < wanted:
            stiffness = self.numerics.bond_stiffness * (wanted / used) ** 2
            texts.append(
                f"material.strength = {wanted:.4g} Pa is more than bonds of "
                f"{self.material.toughness:g} J/m2 hold on elements of {1e3 * size:.3g} mm: the "
                f"faces part at {used:.4g} Pa, with the same toughness. Give strength: "
                f"{0.999 * used:.4g}, or numerics.bond_stiffness: {stiffness:.3g} and a sub-step "
                "to match."
            )
        height, load = self.top - self.bottom, self.effects.skin.line_load
        if load > SPLITS * self.strength * height:
            texts.append(
                f"the skin holds {load:.3g} N/m, {load / (self.strength * height):.2g} times "
                "strength times height: the food may come apart under it ahead of the edge. Use a "
                "stronger food, or a skin that is thicker or less tough."
            )
        if self.wide_spread > height:
            texts.append(
                f"toughness / E is {1e3 * self.softness * self._edge_scale:.2g} mm in a section "
                f"that is {1e3 * height:.3g} mm high: the edge presses such a food onto the board "
                "before it cuts it. Use a stiffer or less tough food."
            )
        elif self.softness > SOFTEST * max(1.0, self.numerics.edge_spread / self._edge_scale):
            texts.append(
                f"the greatest toughness in the food over E h is {self.softness:.2g}: the edge "
                f"deforms the food by more than its mesh of {1e3 * self._edge_scale:.3g} mm is "
                f"verified to follow, {SOFTEST:g}, and its force may jump. Give "
                f"numerics.edge_spread: {self.wide_spread:.3g}."
            )
        if self.skin_softness > SOFTEST_UNDER_SKIN:
            stiff = self.material.youngs_modulus * self.skin_softness / SOFTEST_UNDER_SKIN
            texts.append(
                f"the skin's toughness / thickness over E h is {self.skin_softness:.2g}: until it "
                "is punctured it folds around the edge by more than the mesh is verified to "
                f"follow, {SOFTEST_UNDER_SKIN:g}. Give what is under it material.youngs_modulus: "
                f"{1.01 * stiff:.3g}, and a soft inside by effects.core.stiffness_ratio."
            )
        return tuple(texts)

    @property
    def skin_fold(self) -> float:
        """`skin_softness` over the greatest that is verified: above 1 elements may invert."""
        return self.skin_softness / SOFTEST_UNDER_SKIN

    @property
    def wide_spread(self) -> float:
        """The `Numerics.edge_spread` that a food as soft as this one needs, metres."""
        return 1.01 * self.softness * self._edge_scale / SOFTEST

    def edge_forces(self) -> np.ndarray:
        """Greatest force of the edge at each cut point on the grid of its tables [P, G], N.

        Pressing, at the speed of reference; of a skin all that the point carries.
        """
        tables, effects = self.tables, self.effects
        grid = np.linspace(-tables.reach, tables.reach, tables.width.shape[1])
        below = np.maximum(self.point_depth[:, None] + grid, 0.0)
        work = self.toughness[:, None] + effects.bluntness.excess(below)
        skin = effects.skin.line_load * 0.5 * tables.outline.sum(1, keepdims=True)
        return np.asarray(work * tables.width + skin)

    def rigid_motion(
        self, positions: np.ndarray, velocities: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Pose and velocity of the half on the `free_side` as if it were rigid.

        The pose is the least-squares fit to its nodes, weighted by their true masses; the velocity
        has their momentum and angular momentum.

        Args:
            positions, velocities: Of the computed nodes in C [N, 3], metres and m/s.

        Returns:
            R [3, 3] and p [3] in C, so that a point at x at rest is now at R x + p; the angular
            velocity [3] in C, rad/s; and the velocity [3] of the point now at the origin of C, m/s.
        """
        mine = self.split.node_side[self.computed] == self.free_side
        mass = self.true_mass[mine]
        rest, now, v = self.nodes[mine], positions[mine], velocities[mine]
        centre, here = mass @ rest / mass.sum(), mass @ now / mass.sum()
        R = Rotation.align_vectors(now - here, rest - centre, mass)[0].as_matrix()
        r = now - here
        inertia = np.einsum("i,ijk->jk", mass, (r * r).sum(1)[:, None, None] * np.eye(3))
        inertia -= np.einsum("i,ij,ik->jk", mass, r, r)
        spin = np.linalg.solve(inertia, mass @ np.cross(r, v))
        return R, here - R @ centre, spin, mass @ v / mass.sum() - np.cross(spin, here)

    def __getstate__(self) -> dict[str, Any]:
        # A copy, also in another process, may get other values, and then has other inertia; and
        # gradients are long to send.
        own = (
            "_gradient",
            "inertia",
            "critical_time_step",
            "_unraised_masses",
            "_mass_parts",
            "_bulk_share",
            "_like",
        )
        return {k: v for k, v in vars(self).items() if k not in own} | {"_by_step": {}}

    def with_step(self, step: float) -> Self:
        """The same cut with another sub-step, s, to six digits; made once."""
        name = f"{step:.6g}"
        if name == f"{self.numerics.time_step:.6g}":
            return self
        if name not in self._by_step:
            other = self._by_step[name] = copy.copy(self)
            other.numerics = dc.replace(self.numerics, time_step=step)
            other._like = self
            other._set_step()
        return self._by_step[name]

    def derive(self, inertia_of: "CuttingModel | None" = None, **changes: Any) -> Self:
        """The same cut with another material, effects, knife, numerics or point_scales.

        Args:
            inertia_of: A cut whose mass matrix is stepped; None for what the changes ask for. The
                difference of two cuts by a parameter is cleaner with one.
            changes: By name.

        Raises:
            TimeStepError: The step is beyond the limit and masses are not scaled.
        """
        unknown = changes.keys() - {"material", "effects", "knife", "numerics", "point_scales"}
        if unknown:
            raise TypeError(f"a cut has no {', '.join(unknown)} to change")
        # With what was computed of the geometry.
        derived = copy.copy(self)
        vars(derived).update(
            changes,
            _inertia_of=inertia_of,
            _like=self._like or self,
            _strips=self._strips,
            _gradient=self._gradient,
            _gradient_products=self._gradient_products,
        )
        derived.__post_init__()
        return derived


def _ratios(mine: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Of positive numbers, where the second is not zero."""
    return mine[theirs > 0.0] / theirs[theirs > 0.0]


def prepare_cut(
    geometry: CutGeometry,
    material: Material,
    knife: Knife,
    numerics: Numerics,
    effects: Effects | None = None,
) -> CuttingModel:
    """Prepares a cut; without `effects` it is that of the base model.

    Raises:
        TimeStepError: The step is beyond the limit and masses are not scaled.
    """
    ones = np.ones(len(geometry.point_nodes))
    return CuttingModel(
        **{field.name: getattr(geometry, field.name) for field in dc.fields(CutGeometry)},
        material=material,
        effects=effects or Effects(),
        knife=knife,
        numerics=numerics,
        point_scales=PointScales(ones, ones, ones),
    )
