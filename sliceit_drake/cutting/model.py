"""Everything about one cut that does not change: geometry, parameters, masses, tables."""

import dataclasses as dc
import functools
from collections.abc import Sequence

import numpy as np

from sliceit_drake.configuration import ConfigurationError, choice, quantity
from sliceit_drake.cutting.cut_surface import EdgeTables, edge_tables
from sliceit_drake.cutting.kernels import LANES, PARAMETERS
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.material import Material, small_strain_stiffness
from sliceit_drake.cutting.mesh import TetrahedralMesh, boundary_faces
from sliceit_drake.cutting.split import CutPlane, SplitMesh, split_mesh

__all__ = ["CuttingModel", "Numerics", "TimeStepError", "make_cutting_model"]

GRAVITY = 9.81

SLIVER = 0.1
"""Share of a vertex's mass below which a node of one side does not set the step."""

LEAST_SHARE = 0.05
"""Least share of a split element's stiffness that a copy gets; the other gets the rest.

A corner of material that is much smaller than its element would be held by a share of the stiffness
that vanishes as its size cubed, but pushed by the edge in proportion to its size: it would invert.
Volume, mass and weight keep their true shares, and the two copies together their stiffness.
"""


class TimeStepError(ValueError):
    """The time step is beyond the stability limit; the message names the limit and the fix."""


@dc.dataclass
class Numerics:
    """How the cut is computed. Contacts and bonds scale with E over the edge length h."""

    time_step: float = quantity(
        5e-4, "s", low=1e-7, high=5e-3, doc="Sub-step; must divide the exchange period."
    )
    mass_scaling: bool = True
    stability_margin: float = quantity(
        0.8, "", low=0.1, high=0.95, doc="Step over the Gershgorin stability limit."
    )
    numerical_damping: float = quantity(
        0.2, "", low=0.0, high=0.5, doc="Viscosity added to the material's, in steps."
    )
    bond_stiffness: float = quantity(
        4.0, "E/h", low=0.1, high=1e3, doc="Stiffness of the uncut faces and of their self contact."
    )
    flank_stiffness: float = quantity(
        4.0, "E/h", low=0.01, high=1e3, doc="Contact stiffness of the flanks, also in friction."
    )
    board_stiffness: float = quantity(
        1.0, "E/h", low=0.01, high=1e3, doc="Contact stiffness of the food on the board."
    )
    board_friction: float = quantity(0.3, "", low=0.0, high=2.0, doc="Friction of food on board.")
    board_damping_time: float = quantity(
        5e-3, "s", low=0.0, high=1.0, doc="Damping over stiffness of the food on the board."
    )
    unloading_length: float = quantity(
        1e-4, "m", low=1e-6, high=1e-2, doc="Retreat of the edge over which its force vanishes."
    )
    direction_length: float = quantity(
        2e-4, "m", low=1e-7, high=1e-2, doc="Travel over which the edge's direction follows."
    )
    precision: str = choice("float32", ("float32", "float64"), doc="Arithmetic of the kernels.")
    device: str = "cpu"


@dc.dataclass
class CuttingModel:
    """One cut, prepared. Arrays are NumPy, double precision, in the frame C of the cut.

    Only nodes and elements that can move are computed; `computed` maps them to `split`.

    Attributes:
        split: The two half bodies.
        material, knife, numerics: What the user gave.
        X_FC_rotation, X_FC_position: Pose of C in the food frame.
        computed: Node of `split` for each computed node [N].
        moving: Computed nodes that are not held [K].
        nodes: Rest positions of computed nodes [N, 3].
        blocks: Node indices of elements, eight an entry [B, 4, LANES].
        shape: Inverse rest edges (row major) and minus the volume that is stiff [B, 10, LANES].
        element_count: Elements without padding.
        true_mass, mass: Lumped true mass and the mass that is stepped [N], kg.
        weight: Gravity force on each node [N, 3], N, by the true mass.
        tables: Edge tables of the cut points.
        point_nodes, point_weights: Embedding of cut points [P, 4] (minus ends, plus ends), [P, 2].
        toughness: Surface energy of each cut point [P], J/m^2.
        unloading: Slope of the edge's force when it retreats [P], N/m.
        board_area: Area of food surface that may rest on the board, by node [N], m^2.
        board: Board plane n . x = d in C: (n, d) [4].
        parameters: Scalars by name, see `kernels.PARAMETERS`.
        element_size: Mean edge length of computed elements, metres.
        critical_time_step: Stability limit with the true masses, including the margin, s. Slivers
            do not count: nodes with less than `SLIVER` of their vertex's mass get what they need.
    """

    split: SplitMesh
    material: Material
    knife: Knife
    numerics: Numerics
    X_FC_rotation: np.ndarray
    X_FC_position: np.ndarray
    computed: np.ndarray
    moving: np.ndarray
    nodes: np.ndarray
    blocks: np.ndarray
    shape: np.ndarray
    element_count: int
    true_mass: np.ndarray
    mass: np.ndarray
    weight: np.ndarray
    tables: EdgeTables
    point_nodes: np.ndarray
    point_weights: np.ndarray
    toughness: np.ndarray
    unloading: np.ndarray
    board_area: np.ndarray
    board: np.ndarray
    parameters: dict[str, float]
    element_size: float
    critical_time_step: float

    @functools.cached_property
    def section_area(self) -> float:
        """Area of the cut, m^2."""
        return float(self.tables.area.sum())

    @property
    def mass_ratio(self) -> float:
        """Stepped over true mass of the moving nodes."""
        return float(self.mass[self.moving].sum() / self.true_mass[self.moving].sum())

    @functools.cached_property
    def top(self) -> float:
        """Height of the highest cut point in C, metres."""
        return float(self.split.points[:, 2].max())

    @functools.cached_property
    def bottom(self) -> float:
        """Height of the lowest cut point in C, metres."""
        return float(self.split.points[:, 2].min())

    @functools.cached_property
    def span(self) -> tuple[float, float]:
        """Least and greatest coordinate of the cut points along the edge, metres."""
        x = self.split.points[:, 0]
        return float(x.min()), float(x.max())

    def to_cut_frame(self, p_F: np.ndarray) -> np.ndarray:
        """Points [..., 3] from F to C."""
        return (np.asarray(p_F) - self.X_FC_position) @ self.X_FC_rotation


def make_cutting_model(
    mesh: TetrahedralMesh,
    plane: CutPlane,
    held: np.ndarray,
    material: Material,
    knife: Knife,
    numerics: Numerics,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    board_height: float | None = 0.0,
) -> CuttingModel:
    """Splits the mesh and prepares one cut.

    Args:
        mesh: The food in F.
        plane: The cut plane in F.
        held: Vertices of the mesh that cannot move, mask [V].
        material: Food.
        knife: Knife.
        numerics: Discretisation.
        up: Opposite of gravity in F [3].
        board_height: Height of the board's top along `up` in F, metres; None for no board.

    Raises:
        MeshError: Bad mesh, or the plane misses it.
        TimeStepError: The step is beyond the limit and masses are not scaled.
        ConfigurationError: Nothing can move.
    """
    mesh.check()
    split = split_mesh(mesh, plane)
    R_FC = plane.rotation()
    p_FC = np.asarray(plane.point, float)
    upward = np.asarray(up, float) / np.linalg.norm(up)
    up_C = upward @ R_FC

    held_node = held[split.node_source]
    active = ~held_node[split.tetrahedra].all(1)
    if not active.any():
        raise ConfigurationError(
            "every element at the cut is held",
            field="food.hold",
            fix="Hold the food farther from the cut plane.",
        )
    tetrahedra = split.tetrahedra[active]
    computed, t = np.unique(tetrahedra, return_inverse=True)
    t = t.reshape(-1, 4)
    number = np.full(len(split.nodes), -1)
    number[computed] = np.arange(len(computed))
    nodes = split.nodes[computed]
    fraction, centroid = split.fraction[active], split.centroid[active]
    moving = np.flatnonzero(~held_node[computed])

    edges = np.stack([nodes[t[:, k]] - nodes[t[:, 0]] for k in (1, 2, 3)], axis=-1)
    whole = np.linalg.det(edges) / 6.0
    volume = whole * fraction
    # Both copies of a split element share its stiffness; see `LEAST_SHARE`.
    stiff_volume = whole * _stiffness_share(fraction)
    inverse = np.linalg.inv(edges)
    element_size = TetrahedralMesh(nodes, t).mean_edge_length()

    true_mass = np.zeros(len(nodes))
    np.add.at(true_mass, t, np.repeat(0.25 * material.density * volume[:, None], 4, axis=1))
    share = np.zeros(len(nodes))
    np.add.at(share, t, material.density * volume[:, None] * centroid)
    weight = -GRAVITY * share[:, None] * up_C

    tables = edge_tables(split.points[:, [0, 2]], split.triangles)
    point_nodes = number[split.point_nodes].reshape(-1, 4)
    free = (point_nodes >= 0).all(1)
    if not free.all():
        raise ConfigurationError(
            f"{np.count_nonzero(~free)} of {len(free)} points of the cut lie in elements that are "
            "held",
            field="food.hold",
            fix="Hold the food farther from the cut plane.",
        )
    point_weights = split.point_weights

    scale = material.youngs_modulus / element_size
    toughness = np.full(len(split.points), material.toughness)
    # Never flatter than the rise of the force on the way in: a retreat must not gain anything.
    steepest = (np.diff(tables.width, axis=1) / tables.spacing).max(1)
    unloading = toughness * np.maximum(tables.width.max(1) / numerics.unloading_length, steepest)
    bond = numerics.bond_stiffness * scale
    strength = min(material.strength, 0.5 * np.sqrt(2.0 * max(material.toughness, 1e-12) * bond))
    mu, lam = material.stable_neo_hookean()
    damping_time = material.damping_time + numerics.numerical_damping * numerics.time_step
    parameters = dict.fromkeys(PARAMETERS, 0.0) | {
        "mu": mu,
        "lam": lam,
        "damping_time": damping_time,
        "bond_stiffness": bond,
        "strength": strength,
        "flank_stiffness": numerics.flank_stiffness * scale,
        "friction": material.friction,
        "static_friction": material.static_friction,
        "stribeck_velocity": material.stribeck_velocity,
        "unloading_length": numerics.unloading_length,
        "direction_length": numerics.direction_length,
        "board_stiffness": numerics.board_stiffness * scale,
        "board_friction": numerics.board_friction,
        "board_damping_time": numerics.board_damping_time,
        "blade_stiffness": knife.lateral_stiffness,
        "blade_damping": knife.lateral_stiffness * knife.lateral_relaxation_time,
    }

    board = np.concatenate([up_C, [0.0]])
    board_area = np.zeros(len(nodes))
    if board_height is not None:
        board[3] = board_height - upward @ p_FC
        board_area = _downward_area(split, up_C)[computed]

    pushing = 2.0 * parameters["flank_stiffness"] * float(tables.area.sum())
    blade_need = 0.25 * (2.0 * pushing + knife.lateral_stiffness)
    parameters["blade_mass"] = max(
        knife.lateral_mass(), blade_need * (numerics.time_step / numerics.stability_margin) ** 2
    )
    bulk = 0.25 * _stiffness_bound(t, inverse, stiff_volume, material)
    per_point = tables.area * (2.0 * bond + 2.0 * parameters["flank_stiffness"])
    per_point += 0.5 * unloading
    contact = 2.0 * parameters["board_stiffness"] * board_area
    for side in range(2):
        for end in range(2):
            np.add.at(contact, point_nodes[:, 2 * side + end], per_point * point_weights[:, end])
    # Step dt = margin x is stable if stiff x^2 + viscous x <= mass; explicit damping counts twice.
    stiff = bulk * (1.0 + 2.0 * numerics.numerical_damping) + 0.25 * contact
    viscous = 2.0 * material.damping_time * bulk
    limit = _largest_step(true_mass, stiff, viscous)
    sliver = true_mass < SLIVER * _vertex_mass(split, material)[split.node_source[computed]]
    setting = moving[~sliver[moving]] if not sliver[moving].all() else moving
    worst = setting[int(limit[setting].argmin())]
    critical = numerics.stability_margin * float(limit[worst])
    step = numerics.time_step
    if not numerics.mass_scaling and step > critical:
        raise TimeStepError(
            f"numerics.time_step = {step:.3g} s is beyond the stability limit {critical:.3g} s, "
            f"set by the node at {nodes[worst]} m of the cut frame (true mass "
            f"{true_mass[worst]:.3g} kg, stiffness bound {4.0 * stiff[worst]:.3g} N/m). Give at "
            f"most {0.99 * critical:.3g}, a coarser mesh, or mass_scaling: true."
        )
    x = (step if numerics.mass_scaling else critical) / numerics.stability_margin
    scaled = np.ones(len(nodes), bool) if numerics.mass_scaling else sliver
    mass = np.where(scaled, np.maximum(true_mass, (stiff * x + viscous) * x), true_mass)

    blocks, shape = _blocks(t, inverse, stiff_volume)
    return CuttingModel(
        split=split,
        material=material,
        knife=knife,
        numerics=numerics,
        X_FC_rotation=R_FC,
        X_FC_position=p_FC,
        computed=computed,
        moving=moving,
        nodes=nodes,
        blocks=blocks,
        shape=shape,
        element_count=len(t),
        true_mass=true_mass,
        mass=mass,
        weight=weight,
        tables=tables,
        point_nodes=point_nodes,
        point_weights=point_weights,
        toughness=toughness,
        unloading=unloading,
        board_area=board_area,
        board=board,
        parameters=parameters,
        element_size=element_size,
        critical_time_step=critical,
    )


def _stiffness_share(fraction: np.ndarray) -> np.ndarray:
    return np.where(fraction < 1.0, np.clip(fraction, LEAST_SHARE, 1.0 - LEAST_SHARE), 1.0)


def _largest_step(mass: np.ndarray, stiff: np.ndarray, viscous: np.ndarray) -> np.ndarray:
    """Positive root x of stiff x^2 + viscous x = mass [N], s."""
    return 2.0 * mass / (viscous + np.sqrt(viscous**2 + 4.0 * stiff * mass))


def _vertex_mass(split: SplitMesh, material: Material) -> np.ndarray:
    """Lumped mass of the vertices of the uncut mesh [V], kg."""
    volume = TetrahedralMesh(split.vertex_position, split.source_tetrahedra).volumes()
    mass = np.zeros(len(split.vertex_position))
    share = 0.25 * material.density * volume[:, None]
    np.add.at(mass, split.source_tetrahedra, np.repeat(share, 4, axis=1))
    return mass


def _downward_area(split: SplitMesh, up_C: np.ndarray) -> np.ndarray:
    """Area of material surface that faces down, lumped to the material nodes [N], m^2.

    A face that the plane crosses gives each side the area of its material corners' share.
    """
    faces, _ = boundary_faces(split.source_tetrahedra)
    p = split.vertex_position[faces]
    normal = 0.5 * np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    down = -(normal @ up_C)
    horizontal = down > 0.2 * np.linalg.norm(normal, axis=1)
    material = np.zeros((len(split.vertex_position), 2), bool)
    material[split.node_source, split.node_side] = split.node_is_material
    # Corners on the plane are of both sides, and a face that touches it there of one.
    sides = material[faces] / material[faces].sum(2, keepdims=True)
    whole = material[faces].all(1)
    one = whole.sum(1) == 1
    sides[one] = whole[one][:, None]
    area = np.zeros(material.shape)
    third = np.where(horizontal, down, 0.0)[:, None, None] / 3.0
    np.add.at(area, faces, third * sides)
    return area[split.node_source, split.node_side]


def _stiffness_bound(
    tetrahedra: np.ndarray, inverse: np.ndarray, volume: np.ndarray, material: Material
) -> np.ndarray:
    """Gershgorin bound of the bulk stiffness at each node [N], N/m: sum of the blocks' norms."""
    gradients = np.concatenate([-inverse.sum(1, keepdims=True), inverse], axis=1)
    blocks = small_strain_stiffness(gradients, volume, *material.lame())
    norms = np.linalg.norm(blocks, ord=2, axis=(-2, -1)).sum(-1)
    bound = np.zeros(int(tetrahedra.max()) + 1)
    np.add.at(bound, tetrahedra, norms)
    return bound


def _blocks(
    tetrahedra: np.ndarray, inverse: np.ndarray, volume: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Elements in blocks of `LANES`, padded with elements of no volume."""
    count = len(tetrahedra)
    padded = -(-count // LANES) * LANES
    fill = np.minimum(np.arange(padded), count - 1)
    blocks = tetrahedra[fill].reshape(-1, LANES, 4).transpose(0, 2, 1)
    weight = np.where(np.arange(padded) < count, -volume[fill], 0.0)
    values = np.concatenate([inverse[fill].reshape(padded, 9), weight[:, None]], axis=1)
    return blocks, values.reshape(-1, LANES, 10).transpose(0, 2, 1)
