"""Tables of the cut surface: how much of the blade's edge each cut point carries.

The section is triangulated by the cut points with hat functions N_i. When the edge, a line along
Cx, lies s below point i in the rest configuration, the point carries

    T_i(s) = integral of N_i along the edge.

The hats are a partition of unity, so the T_i of all points sum to the section's width at the edge
for any mesh, and the integral of T_i over s is the point's area A_i. The force that parts the
surface is then toughness times T_i at the largest s so far: pressing through gives toughness times
width with no ripple from the mesh, and R A_i of work at each point (docs/explanation/physics.md,
"Edge").
"""

import dataclasses as dc

import numpy as np

__all__ = ["EdgeTables", "depth_below", "distance_inside", "edge_tables"]

OVERSAMPLING = 8
"""Exact line integrals that are averaged into each grid point of the tables."""


@dc.dataclass
class EdgeTables:
    """Edge tables of all cut points on a common grid.

    Attributes:
        reach: The grid runs over s in [-reach, reach], metres.
        width: T_i on the grid [P, G], metres.
        fraction: Cut fraction on the grid [P, G]: the integral of T_i up to s over A_i.
        rise: Height of the centroid of the part that is cut above the point [P, G], metres.
        outline: Length of the section's outline that the point carries, up to a grid point: of the
            upper outline and of the lower [2, P, G], metres.
        area: Areas A_i [P], m^2.
    """

    reach: float
    width: np.ndarray
    fraction: np.ndarray
    rise: np.ndarray
    outline: np.ndarray
    area: np.ndarray

    @property
    def spacing(self) -> float:
        """Grid spacing, metres."""
        return 2.0 * self.reach / (self.width.shape[1] - 1)

    def skin(self, thickness: float) -> np.ndarray:
        """Length of a skin per height that each point carries, as `width` [P, G].

        Each piece of the outline counts over `thickness` of depth below (the upper) or above (the
        lower outline) it: a level one would else ask for all of its work at once. What that
        leaves beyond the grid counts on it.
        """
        grid = np.linspace(-self.reach, self.reach, self.width.shape[1])
        upper, lower = (
            np.array([np.interp(grid + shift, grid, row) for row in rows])
            for rows, shift in zip(self.outline, (-thickness, thickness), strict=True)
        )
        skin = self.outline[0] - upper + lower - self.outline[1]
        # Tables hold on beyond the grid with their values at its ends.
        skin[:, [0, -1]] = 0.0
        total = self.spacing * skin.sum(1, keepdims=True)
        length = self.outline[:, :, -1].sum(0)[:, None]
        return np.asarray(skin * np.divide(length, total, out=total, where=total > 0.0))


def edge_tables(points: np.ndarray, triangles: np.ndarray, grid: int = 97) -> EdgeTables:
    """Integrates the hat functions along horizontal lines.

    Args:
        points: Cut points [P, 2], (x along the edge, z up), metres.
        triangles: The section triangulated by cut points [M, 3].
        grid: Grid points of the tables.
    """
    corner = points[triangles]
    x, z = corner[..., 0], corner[..., 1]
    double_area = np.abs(
        (x[:, 1] - x[:, 0]) * (z[:, 2] - z[:, 0]) - (x[:, 2] - x[:, 0]) * (z[:, 1] - z[:, 0])
    )
    area = np.zeros(len(points))
    np.add.at(area, triangles, np.repeat(double_area[:, None] / 6.0, 3, axis=1))

    reach = 1.02 * float(np.ptp(z, axis=1).max())
    spacing = 2.0 * reach / (grid - 1)
    fine = np.linspace(-reach - 0.5 * spacing, reach + 0.5 * spacing, grid * OVERSAMPLING + 1)
    fine = 0.5 * (fine[1:] + fine[:-1])
    width = np.zeros((len(points), grid))
    for k in range(3):
        edge_height = z[:, k, None] - fine
        low = np.full(edge_height.shape, np.inf)
        high = np.full(edge_height.shape, -np.inf)
        hat = np.zeros(edge_height.shape)
        for u, v in ((0, 1), (1, 2), (2, 0)):
            zu, zv = z[:, u, None], z[:, v, None]
            crosses = (np.minimum(zu, zv) <= edge_height) & (edge_height < np.maximum(zu, zv))
            rise = np.where(zv == zu, 1.0, zv - zu)
            w = np.where(crosses, (edge_height - zu) / rise, 0.0)
            crossing = x[:, u, None] + w * (x[:, v, None] - x[:, u, None])
            low = np.where(crosses, np.minimum(low, crossing), low)
            high = np.where(crosses, np.maximum(high, crossing), high)
            hat += np.where(crosses, (1.0 - w) * (k == u) + w * (k == v), 0.0)
        chord = np.where(high > low, high - low, 0.0)
        carried = (chord * 0.5 * hat).reshape(len(triangles), grid, OVERSAMPLING).mean(-1)
        np.add.at(width, triangles[:, k], carried)

    # A point between two lines carries all of its area at its own height, so that it too is cut.
    width[~width.any(1), grid // 2] = 1.0
    total = 0.5 * spacing * (width[:, 1:] + width[:, :-1]).sum(1, keepdims=True)
    width *= area[:, None] / total
    cut = _integral(width, spacing)
    # The centroid of the part that is cut lies the mean of s - s' above the edge, weight T_i(s').
    above_edge = np.divide(
        _integral(cut, spacing), cut, out=np.zeros_like(cut), where=cut > 1e-9 * area[:, None]
    )
    grid_s = np.linspace(-reach, reach, grid)
    fraction = np.divide(cut, area[:, None], out=np.zeros_like(cut), where=area[:, None] > 0.0)
    outline = _outline_tables(points, triangles, grid_s)
    return EdgeTables(reach, width, fraction, above_edge - grid_s, outline, area)


def _outline_edges(triangles: np.ndarray) -> np.ndarray:
    """Edges of the section's outline, as pairs of points, and the point inside of each [E, 3]."""
    corners = triangles[:, [[0, 1, 2], [1, 2, 0], [2, 0, 1]]].reshape(-1, 3)
    edges = np.sort(corners[:, :2], axis=1)
    _, first, count = np.unique(edges, axis=0, return_index=True, return_counts=True)
    once = first[count == 1]
    return np.column_stack([edges[once], corners[once, 2]])


def depth_below(points: np.ndarray, triangles: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Depth of positions [M, 2] below the upper outline of the section [M], metres."""
    a, b = (points[_outline_edges(triangles)[:, k]] for k in (0, 1))
    x = positions[:, 0, None]
    across = b[:, 0] - a[:, 0]
    w = (x - a[:, 0]) / np.where(across == 0.0, 1.0, across)
    inside = (w >= -1e-9) & (w <= 1.0 + 1e-9) & (across != 0.0)
    top = np.where(inside, a[:, 1] + w * (b[:, 1] - a[:, 1]), -np.inf).max(1)
    return np.maximum(np.where(np.isfinite(top), top, positions[:, 1]) - positions[:, 1], 0.0)


def distance_inside(points: np.ndarray, triangles: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Distance of positions [M, 2] from the section's outline [M], metres; negative outside."""
    a, b = (points[_outline_edges(triangles)[:, k]] for k in (0, 1))
    along = b - a
    from_a = positions[:, None] - a
    w = np.clip((from_a * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    distance = np.linalg.norm(from_a - w[..., None] * along, axis=-1).min(1)
    # Outside a line upwards crosses the outline an even number of times.
    x, z = positions[:, 0, None], positions[:, 1, None]
    beside = (a[:, 0] > x) != (b[:, 0] > x)
    rise = along[:, 1] / np.where(along[:, 0] == 0.0, 1.0, along[:, 0])
    above = a[:, 1] + (x - a[:, 0]) * rise > z
    return np.where((beside & above).sum(1) % 2, distance, -distance)


def _outline_tables(points: np.ndarray, triangles: np.ndarray, grid_s: np.ndarray) -> np.ndarray:
    """Length of outline that each point carries up to the grid points [2, P, G]: upper, lower."""
    edges = _outline_edges(triangles)
    along = points[edges[:, 1]] - points[edges[:, 0]]
    inwards = points[edges[:, 2]] - points[edges[:, 0]]
    # Height of the point inside over the edge's line, times the edge's run along x.
    side = inwards[:, 1] * along[:, 0] - inwards[:, 0] * along[:, 1]
    below = side * along[:, 0] <= 0.0
    pieces = 256
    w = (np.arange(pieces) + 0.5) / pieces
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    height = a[:, 1, None] + w * (b - a)[:, 1, None]
    length = np.broadcast_to(np.linalg.norm(b - a, axis=1)[:, None] / pieces, height.shape)
    table = np.zeros((2, len(points), len(grid_s) + 1))
    part = np.broadcast_to(np.where(below, 0, 1)[:, None], height.shape)
    for end, share in ((0, 1.0 - w), (1, w)):
        node = np.broadcast_to(edges[:, end, None], height.shape)
        s = points[edges[:, end], 1][:, None] - height
        np.add.at(table, (part, node, np.searchsorted(grid_s, s - 1e-12)), share * length)
    return np.cumsum(table, axis=2)[..., :-1]


def _integral(values: np.ndarray, spacing: float) -> np.ndarray:
    """Integral from the start of each row, trapezoidal."""
    steps = 0.5 * spacing * (values[:, 1:] + values[:, :-1])
    return np.concatenate([np.zeros((len(values), 1)), np.cumsum(steps, axis=1)], axis=1)
