"""Everything about one cut that neither material nor knife nor step decides."""

import dataclasses as dc
import functools
from collections.abc import Sequence

import numpy as np
from scipy.sparse import csc_array, csr_array

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.inertia import elimination_order
from sliceit_drake.cutting.kernels.types import LANES, STRIP
from sliceit_drake.cutting.mesh.cut_surface import (
    EdgeTables,
    depth_below,
    distance_inside,
    edge_tables,
)
from sliceit_drake.cutting.mesh.split import CutPlane, SplitMesh, split_mesh
from sliceit_drake.cutting.mesh.strips import tetrahedron_strips
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh, boundary_faces

__all__ = ["CutGeometry", "make_cut_geometry"]

MIN_SHARE = 0.05
"""Least fraction of a split element's stiffness that a copy gets; the other gets the rest.

A corner of material that is much smaller than its element would be held by a fraction of the
stiffness that vanishes as its size cubed, but pushed by the edge in proportion to its size: it
would invert. Volume, mass and weight keep their true shares, and the two copies together their
stiffness. """


@dc.dataclass
class CutGeometry:
    """One cut through one mesh. Arrays are NumPy, double precision, in the frame C of the cut.

    Only nodes and elements that can move are computed; `computed` maps them to `split`.

    Attributes:
        split: The two half bodies.
        X_FC_rotation, X_FC_position: Pose of C in the food frame.
        up: Opposite of gravity [3].
        computed: Node of `split` for each computed node [N].
        moving: Computed nodes that are not held, in the order in which their equations are solved
            [K].
        nodes: Rest positions of computed nodes [N, 3].
        tetrahedra: Computed nodes of the elements [T, 4].
        inverse: Inverse rest edges [T, 3, 3], 1/m.
        stiff_volume: Volume of the elements that is stiff [T], m^3.
        node_volume: Material volume lumped to the nodes [N], m^3.
        weight_volume: The same for weight, which acts at the material's centroids [N], m^3.
        vertex_volume: Lumped volume of each node's vertex in the uncut mesh [N], m^3.
        element_distance: Distance of the elements' centroids from the outline, inwards [T], metres;
            negative outside.
        tables: Edge tables of the cut points.
        point_nodes, point_weights: Embedding of cut points [P, 4] (minus ends, plus ends), [P, 2].
        point_depth: Depth of the cut points below the outline [P], metres.
        point_distance: Their distance from it, inwards [P], metres.
        board_area: Area of food surface that may rest on the board, by node [N], m^2.
        board: Board plane n . x = d: (n, d) [4].
        element_size: Mean edge length of computed elements, metres.
    """

    split: SplitMesh
    X_FC_rotation: np.ndarray
    X_FC_position: np.ndarray
    up: np.ndarray
    computed: np.ndarray
    moving: np.ndarray
    nodes: np.ndarray
    tetrahedra: np.ndarray
    inverse: np.ndarray
    stiff_volume: np.ndarray
    node_volume: np.ndarray
    weight_volume: np.ndarray
    vertex_volume: np.ndarray
    element_distance: np.ndarray
    tables: EdgeTables
    point_nodes: np.ndarray
    point_weights: np.ndarray
    point_depth: np.ndarray
    point_distance: np.ndarray
    board_area: np.ndarray
    board: np.ndarray
    element_size: float

    @property
    def element_count(self) -> int:
        """Elements that are computed."""
        return len(self.tetrahedra)

    @functools.cached_property
    def free_side(self) -> int:
        """The half that comes off where one alone is held: 0 for that at y < 0, 1 for the other."""
        # Elements across a slanting cut may hold the free half by some nodes as well.
        return int(self.held_nodes.argmin())

    @property
    def held_nodes(self) -> np.ndarray:
        """Number of nodes of each half that do not move [2]: that at y < 0, the other."""
        sides = np.delete(self.split.node_side, self.computed[self.moving])
        return np.bincount(sides, minlength=2)

    @property
    def unheld(self) -> bool:
        """Whether all nodes can move."""
        return len(self.moving) == len(self.nodes)

    @functools.cached_property
    def section_area(self) -> float:
        """Area of the cut, m^2."""
        return float(self.tables.area.sum())

    @functools.cached_property
    def row_height(self) -> float:
        """Mean height of the section's triangles by their area, metres."""
        corners = self.split.points[self.split.triangles]
        along = np.diff(corners, axis=1)
        areas = np.linalg.norm(np.cross(along[:, 0], along[:, 1]), axis=1)
        return float(np.average(np.ptp(corners[..., 2], axis=1), weights=areas))

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

    @functools.cached_property
    def _strips(self) -> tuple[np.ndarray, np.ndarray]:
        return tetrahedron_strips(self.tetrahedra)

    @functools.cached_property
    def blocks(self) -> np.ndarray:
        """Nodes of the strips of elements, eight strips an entry [B, CORNERS, LANES].

        Filled up with the last strip.
        """
        strips, _ = self._strips
        fill = np.minimum(np.arange(-(-len(strips) // LANES) * LANES), len(strips) - 1)
        return strips[fill].reshape(-1, LANES, strips.shape[1]).transpose(0, 2, 1)

    @functools.cached_property
    def element_place(self) -> np.ndarray:
        """Where each element stands in arrays [B, STRIP, LANES], counted along all of them [T]."""
        strip, k = np.divmod(self._strips[1], STRIP)
        return np.asarray((strip // LANES * STRIP + k) * LANES + strip % LANES)

    @functools.cached_property
    def shape(self) -> np.ndarray:
        """Inverse rest edges of each block's elements, row major [B, 9 STRIP, LANES]."""
        corners = np.stack([self.blocks[:, k : k + 4] for k in range(STRIP)], axis=1)
        x = self.nodes[corners.transpose(0, 3, 1, 2)]
        inverse = np.linalg.inv((x[..., 1:, :] - x[..., :1, :]).swapaxes(-1, -2))
        return inverse.reshape(*inverse.shape[:2], -1).transpose(0, 2, 1)

    def distances_inside(self, offset: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """`point_distance` [P] and `element_distance` [T] from an outline that is moved by `offset`
        along x and z of C [2], metres."""
        if not any(offset):
            return self.point_distance, self.element_distance
        section = self.split.points[:, [0, 2]]
        places = (section, self.nodes[self.tetrahedra].mean(1)[:, [0, 2]])
        points, elements = (
            distance_inside(section, self.split.triangles, each - offset) for each in places
        )
        return points, elements

    def to_cut_frame(self, p_F: np.ndarray) -> np.ndarray:
        """Points [..., 3] from F to C."""
        return (np.asarray(p_F) - self.X_FC_position) @ self.X_FC_rotation

    @functools.cached_property
    def _gradient_products(self) -> tuple[np.ndarray, np.ndarray]:
        """Lengths [T, 4] and scalar products [T, 4, 4] of the shape functions' gradients."""
        gradients = np.concatenate([-self.inverse.sum(1, keepdims=True), self.inverse], axis=1)
        products = gradients @ gradients.transpose(0, 2, 1)
        return np.sqrt(np.einsum("tii->ti", products)), products

    @functools.cached_property
    def _gradient(self) -> tuple[csr_array, csr_array]:
        """What gives the gradient in each element for values at the moving nodes [3 T, K], and its
        transpose."""
        g = np.concatenate([-self.inverse.sum(1, keepdims=True), self.inverse], axis=1)
        rows = np.broadcast_to(np.arange(3 * len(g)).reshape(-1, 1, 3), g.shape)
        columns = np.broadcast_to(self.tetrahedra[:, :, None], g.shape)
        entries = g.ravel(), (rows.ravel(), columns.ravel())
        every = csc_array(entries, (3 * len(g), len(self.nodes)))
        gradient = every[:, self.moving].tocsr()
        return gradient, gradient.T.tocsr()

    def stiffness_bound(self, volume: np.ndarray, mu: float, lam: float) -> np.ndarray:
        """Gershgorin bound of the bulk stiffness at each node [N], N/m.

        The sum over the elements of the spectral norms of their blocks
        V (lam a b^T + mu b a^T + mu (a . b) I), with gradients a and b (in closed form: the first
        two act in the plane of a and b).

        Args:
            volume: Stiff volumes of the elements [T], m^3.
            mu, lam: Lame's moduli, Pa.
        """
        length, dot = self._gradient_products
        both = (length[:, :, None] * length[:, None, :]) ** 2
        c = mu * dot
        square = (lam**2 + mu**2) * both + 2.0 * lam * mu * dot**2
        square += 2.0 * c**2 + 2.0 * c * (lam + mu) * dot
        determinant = c**2 + c * (lam + mu) * dot - lam * mu * (both - dot**2)
        root = np.sqrt(np.maximum(square**2 - 4.0 * determinant**2, 0.0))
        norm = np.maximum(np.sqrt(0.5 * (square + root)), np.abs(c)).sum(-1)
        bound = np.zeros(len(self.nodes))
        np.add.at(bound, self.tetrahedra, volume[:, None] * norm)
        return bound


def make_cut_geometry(
    mesh: TetrahedralMesh,
    plane: CutPlane,
    held: np.ndarray,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    board_height: float | None = 0.0,
) -> CutGeometry:
    """Splits the mesh and prepares what follows from the geometry alone.

    Args:
        mesh: The food in F; one that no generator of ours made should pass its `check_solid`.
        plane: The cut plane in F.
        held: Vertices of the mesh that cannot move, mask [V].
        up: Opposite of gravity in F [3].
        board_height: Height of the board's top along `up` in F, metres; None for no board.

    Raises:
        MeshError: Bad mesh, or the plane misses it.
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
            field="food.hold_distance",
            fix="Hold the food farther from the cut plane.",
        )
    tetrahedra = split.tetrahedra[active]
    computed, t = np.unique(tetrahedra, return_inverse=True)
    t = t.reshape(-1, 4)
    number = np.full(len(split.nodes), -1)
    number[computed] = np.arange(len(computed))
    nodes = split.nodes[computed]
    fraction, centroid = split.fraction[active], split.centroid[active]

    bulk = TetrahedralMesh(nodes, t)
    whole = bulk.volumes()
    volume = whole * fraction
    weight_volume = np.zeros(len(nodes))
    np.add.at(weight_volume, t, volume[:, None] * centroid)
    # Both copies of a split element share its stiffness; see `MIN_SHARE`.
    share = np.where(fraction < 1.0, np.clip(fraction, MIN_SHARE, 1.0 - MIN_SHARE), 1.0)
    uncut = TetrahedralMesh(split.vertex_position, split.source_tetrahedra)

    point_nodes = number[split.point_nodes].reshape(-1, 4)
    free = (point_nodes >= 0).all(1)
    if not free.all():
        raise ConfigurationError(
            f"{np.count_nonzero(~free)} of {len(free)} points of the cut lie in elements that are "
            "held",
            field="food.hold_distance",
            fix="Hold the food farther from the cut plane.",
        )
    board = np.concatenate([up_C, [0.0]])
    board_area = np.zeros(len(nodes))
    if board_height is not None:
        board[3] = board_height - upward @ p_FC
        board_area = _downward_area(split, up_C)[computed]

    section = split.points[:, [0, 2]]
    return CutGeometry(
        split=split,
        X_FC_rotation=R_FC,
        X_FC_position=p_FC,
        up=up_C,
        computed=computed,
        moving=elimination_order(~held_node[computed], np.concatenate([t, point_nodes])),
        nodes=nodes,
        tetrahedra=t,
        inverse=np.linalg.inv(bulk.edges()),
        stiff_volume=whole * share,
        node_volume=bulk.lumped(volume),
        weight_volume=weight_volume,
        vertex_volume=uncut.lumped(uncut.volumes())[split.node_source[computed]],
        element_distance=distance_inside(section, split.triangles, nodes[t].mean(1)[:, [0, 2]]),
        tables=edge_tables(section, split.triangles, groups=split.nearest_vertex),
        point_nodes=point_nodes,
        point_weights=split.point_weights,
        point_depth=depth_below(section, split.triangles, section),
        point_distance=distance_inside(section, split.triangles, section),
        board_area=board_area,
        board=board,
        element_size=bulk.mean_edge_length(),
    )


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
