"""Tables of the cut surface: how much of the blade's edge each cut point carries.

The section is triangulated by the cut points with hat functions. N_i is that of point i, or where a
plane through elements gives a vertex of the mesh several points, which hardly move past each other,
their sum times the point's share of their area: the edge passes them as one. When the edge, a line
along Cx, lies s below point i in the rest configuration, the point carries

    T_i(s) = integral of N_i along the edge.

The N_i are a partition of unity, so the T_i of all points sum to the section's width at the edge
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

ROUNDS = 10
"""Times that spread tables are scaled to the section's widths and the points' areas."""


@dc.dataclass
class EdgeTables:
    """Edge tables of all cut points on a common grid.

    Attributes:
        reach: The grid runs over s in [-reach, reach], metres.
        width: T_i on the grid [P, G], metres.
        fraction: Cut fraction on the grid [P, G]: the integral of T_i up to s over A_i.
        rise: Height of the centroid of the part that is cut above the point [P, G], metres.
        beside: The points beside it on the section's outline [P, 2].
        outline: Lengths of the outline to them [P, 2], metres; 0 within the section.
        lower: 1 where that is of the lower outline, otherwise 0 [P, 2].
        area: Areas A_i [P], m^2.
        spread: Depth above and below the edge over which the T_i are spread, metres.
    """

    reach: float
    width: np.ndarray
    fraction: np.ndarray
    rise: np.ndarray
    beside: np.ndarray
    outline: np.ndarray
    lower: np.ndarray
    area: np.ndarray
    spread: float

    @property
    def spacing(self) -> float:
        """Grid spacing, metres."""
        return 2.0 * self.reach / (self.width.shape[1] - 1)


def edge_tables(
    points: np.ndarray,
    triangles: np.ndarray,
    spread: float = 0.0,
    groups: np.ndarray | None = None,
    grid: int = 97,
) -> EdgeTables:
    """Integrates the hat functions along horizontal lines.

    Args:
        points: Cut points [P, 2], (x along the edge, z up), metres.
        triangles: The section triangulated by cut points [M, 3].
        spread: Depth above and below the edge over which each T_i is spread, metres.
        groups: A number [P] that points which the edge passes as one have in common; None where
            each is by itself.
        grid: Grid points of tables of single points; wider ones have their spacing.
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
    more = int(np.ceil((spread + _height_of_groups(points[:, 1], groups)) / spacing))
    grid, reach = grid + 2 * more, reach + more * spacing
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
    if groups is not None:
        width = _grouped(width, points[:, 1], area, groups, spacing)
    if spread > 0.0:
        width = _spread(width, points[:, 1], spread, spacing)
    cut = _integral(width, spacing)
    # The centroid of the part that is cut lies the mean of s - s' above the edge, weight T_i(s').
    above_edge = np.divide(
        _integral(cut, spacing), cut, out=np.zeros_like(cut), where=cut > 1e-9 * area[:, None]
    )
    grid_s = np.linspace(-reach, reach, grid)
    fraction = np.divide(cut, area[:, None], out=np.zeros_like(cut), where=area[:, None] > 0.0)
    outline = _outline_lengths(points, triangles)
    return EdgeTables(reach, width, fraction, above_edge - grid_s, *outline, area, spread)


def _height_of_groups(height: np.ndarray, groups: np.ndarray | None) -> float:
    """Greatest difference of the heights of two points of a group, metres."""
    if groups is None:
        return 0.0
    low, high = np.full((2, groups.max() + 1), [[np.inf], [-np.inf]])
    np.minimum.at(low, groups, height)
    np.maximum.at(high, groups, height)
    return float((high - low).max(initial=0.0, where=high > low))


def _grouped(
    width: np.ndarray, height: np.ndarray, area: np.ndarray, groups: np.ndarray, spacing: float
) -> np.ndarray:
    """Tables [P, G] of which each is its group's, seen from the point, times its share of the area.

    They still sum to the section's width, and each point keeps its area.

    Args:
        width: T_i of single points, on a grid that is wider by the height of a group [P, G], m.
        height, area: Heights of the points and their areas [P], m and m^2.
        groups: Numbers of their groups [P].
        spacing: Of the grid, metres.
    """
    s = spacing * np.arange(width.shape[1])
    out = np.zeros_like(width)
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group)
        total = max(float(area[members].sum()), 1e-30)
        for i in members:
            seen = [np.interp(s + height[j] - height[i], s, width[j], 0.0, 0.0) for j in members]
            out[i] = area[i] / total * np.sum(seen, axis=0)
    return out


def _spread(width: np.ndarray, height: np.ndarray, spread: float, spacing: float) -> np.ndarray:
    """Tables [P, G] that are smoothed by a hat of half width `spread`.

    In turn they are scaled at each height of the edge, so that they sum to the section's width, and
    at each point, so that it keeps its area. Beyond the section the edge carries nothing.

    Args:
        width: T_i of the points, on a grid that `spread` fits into [P, G], metres.
        height: Heights of the points [P], metres.
        spread, spacing: Half width, and spacing of the grid, metres.
    """
    n = int(np.ceil(spread / spacing))
    hat = np.maximum(0.0, 1.0 - np.abs(np.arange(-n, n + 1)) * spacing / spread)
    edge = height[:, None] + spacing * (width.shape[1] // 2 - np.arange(width.shape[1]))
    heights = np.arange(height.min() - spacing, height.max() + 2.0 * spacing, spacing)

    def total(tables: np.ndarray) -> np.ndarray:
        rows = zip(edge[:, ::-1], tables[:, ::-1], strict=True)
        return np.sum([np.interp(heights, at, row, 0.0, 0.0) for at, row in rows], axis=0)

    section, areas = total(width), width.sum(1, keepdims=True)
    tables = np.array([np.convolve(row, hat, mode="same") for row in width])
    for _ in range(ROUNDS):
        now = total(tables)
        scale = np.divide(section, now, out=np.zeros_like(now), where=now > 0.0)
        tables = tables * np.interp(edge, heights, scale, 0.0, 0.0)
        tables *= areas / np.maximum(tables.sum(1, keepdims=True), 1e-30)
    return tables


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


def _outline_lengths(
    points: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`beside`, `outline` and `lower` of `EdgeTables`."""
    edges = _outline_edges(triangles)
    along = points[edges[:, 1]] - points[edges[:, 0]]
    inwards = points[edges[:, 2]] - points[edges[:, 0]]
    # Height of the point inside over the edge's line, times the edge's run along x.
    side = inwards[:, 1] * along[:, 0] - inwards[:, 0] * along[:, 1]
    facts = np.linalg.norm(along, axis=1), side * along[:, 0] > 0.0
    beside = np.zeros((len(points), 2), int)
    length, lower = np.zeros((len(points), 2)), np.zeros((len(points), 2))
    taken, whole = np.zeros(len(points), int), np.zeros(len(points))
    for (a, b, _), size, below in zip(edges, *facts, strict=True):
        for point, other in ((a, b), (b, a)):
            whole[point] += size
            if (k := taken[point]) < 2:
                beside[point, k], length[point, k], lower[point, k] = other, size, below
                taken[point] += 1
    # Where more than two pieces meet, two carry all.
    kept = length.sum(1)
    more = np.divide(whole, kept, out=np.ones_like(kept), where=kept > 0.0)
    return beside, length * more[:, None], lower


def _integral(values: np.ndarray, spacing: float) -> np.ndarray:
    """Integral from the start of each row, trapezoidal."""
    steps = 0.5 * spacing * (values[:, 1:] + values[:, :-1])
    return np.concatenate([np.zeros((len(values), 1)), np.cumsum(steps, axis=1)], axis=1)
