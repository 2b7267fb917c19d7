"""Writes the visual meshes of the robot's links and of the gripper: glTF files in ur5e and gripper.

Run ``python models/make_meshes.py``. The shapes are surfaces of revolution and extruded outlines
that we drew after the main dimensions of the real parts (for the arm the kinematics in ur5e.urdf,
a foot of 149 mm and joints of about 120, 110 and 77 mm diameter; for the gripper the envelope of a
Robotiq 2F-85). They are for the eye only: no physics uses them.
"""

import base64
import dataclasses as dc
import json
import math
from pathlib import Path

import numpy as np

SEGMENTS = 32
CREASE = math.radians(40)

# Base colour (linear RGB), metallic and roughness factors.
MATERIALS = {
    "tube": ((0.47, 0.48, 0.49), 0.10, 0.45),
    "housing": ((0.115, 0.12, 0.128), 0.10, 0.50),
    "lid": ((0.10, 0.29, 0.53), 0.0, 0.40),
    "seal": ((0.015, 0.015, 0.016), 0.0, 0.75),
    "steel": ((0.40, 0.41, 0.43), 0.40, 0.35),
    "black": ((0.030, 0.031, 0.033), 0.10, 0.55),
}

X, Y, Z = np.eye(3)


@dc.dataclass
class Part:
    """Triangles of one material: vertices and unit normals [N, 3], faces [M, 3]."""

    material: str
    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray


def rounded(profile: list[tuple[float, ...]], steps: int = 3) -> np.ndarray:
    """Replaces corners of a profile by arcs.

    Args:
        profile: Points (radius, height) or (radius, height, fillet), metres.
        steps: Segments of an arc.

    Returns:
        Points [N, 2].
    """
    points = [np.array(p[:2]) for p in profile]
    out = [points[0]]
    for i in range(1, len(points) - 1):
        fillet = profile[i][2] if len(profile[i]) > 2 else 0.0
        before, after = points[i - 1] - points[i], points[i + 1] - points[i]
        lengths = np.linalg.norm(before), np.linalg.norm(after)
        u, v = before / lengths[0], after / lengths[1]
        angle = math.acos(np.clip(u @ v, -1.0, 1.0))
        if fillet == 0.0 or math.pi - angle < 1e-6:
            out.append(points[i])
            continue
        cut = min(fillet / math.tan(angle / 2), 0.499 * min(lengths))
        radius = cut * math.tan(angle / 2)
        bisector = (u + v) / np.linalg.norm(u + v)
        centre = points[i] + bisector * radius / math.sin(angle / 2)
        start, end = points[i] + u * cut - centre, points[i] + v * cut - centre
        sweep = math.pi - angle
        for k in range(steps + 1):
            s = k / steps
            arc = (math.sin((1 - s) * sweep) * start + math.sin(s * sweep) * end) / math.sin(sweep)
            out.append(centre + arc)
    out.append(points[-1])
    return np.array(out)


def lathe(
    material: str, profile: list[tuple[float, ...]], origin: np.ndarray, axis: np.ndarray
) -> Part:
    """Surface of revolution.

    Args:
        material: Name in MATERIALS.
        profile: Points (radius, height[, fillet]) in order of the surface, the outside on the left
            of the direction of travel seen with the radius to the right and the height up.
        origin: Where height 0 lies on the axis, link frame, metres.
        axis: Unit vector of the axis, link frame.

    Returns:
        The part, its shading smooth except at edges sharper than CREASE.
    """
    points = rounded(profile)
    tangents = np.diff(points, axis=0)
    normals = np.stack([tangents[:, 1], -tangents[:, 0]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rings: list[tuple[np.ndarray, np.ndarray]] = []
    quads: list[tuple[int, int]] = []
    for i, normal in enumerate(normals):
        ends = []
        for point, neighbour in ((points[i], i - 1), (points[i + 1], i + 1)):
            shade = normal
            if 0 <= neighbour < len(normals) and normal @ normals[neighbour] > math.cos(CREASE):
                shade = normal + normals[neighbour]
            ends.append(len(rings))
            rings.append((point, shade / np.linalg.norm(shade)))
        quads.append((ends[0], ends[1]))
    side = X if abs(axis @ X) < 0.9 else Y
    e1 = np.cross(axis, side)
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(axis, e1)
    angle = np.linspace(0.0, 2 * math.pi, SEGMENTS, endpoint=False)
    radial = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
    vertices = np.concatenate([origin + p[0] * radial + p[1] * axis for p, _ in rings])
    shading = np.concatenate([n[0] * radial + n[1] * axis for _, n in rings])
    k = np.arange(SEGMENTS)
    next_k = (k + 1) % SEGMENTS
    faces = []
    for a, b in quads:
        a_k, a_n, b_k, b_n = (
            r * SEGMENTS + j for r, j in ((a, k), (a, next_k), (b, k), (b, next_k))
        )
        faces += [np.stack([a_k, a_n, b_n], axis=1), np.stack([a_k, b_n, b_k], axis=1)]
    return Part(material, vertices, shading, np.concatenate(faces))


def drum(
    material: str,
    origin: np.ndarray,
    axis: np.ndarray,
    low: float,
    high: float,
    radius: float,
    radius_high: float | None = None,
    fillet: float = 0.006,
) -> Part:
    """Closed cylinder or cone from height `low` to `high`, its rims rounded."""
    top = radius if radius_high is None else radius_high
    profile = [(0.0, low), (radius, low, fillet), (top, high, fillet), (0.0, high)]
    return lathe(material, profile, origin, axis)


def extrusion(
    material: str,
    outline: list[tuple[float, ...]],
    origin: np.ndarray,
    axes: tuple[np.ndarray, np.ndarray, np.ndarray],
    low: float,
    high: float,
    bevel: float = 0.0015,
) -> Part:
    """Convex outline swept along an axis, its rims bevelled.

    Args:
        material: Name in MATERIALS.
        outline: Corners (u, v[, fillet]) of a convex polygon, counter-clockwise, metres.
        origin: Origin of (u, v) and of the height, link frame, metres.
        axes: Right-handed unit vectors of u, v and height, link frame.
        low: Least height.
        high: Greatest height.
        bevel: Width of the bevel.

    Returns:
        The part, its sides shaded smooth except at edges sharper than CREASE.
    """
    corners = [np.array(p[:2]) for p in outline]
    seam = tuple(0.5 * (corners[-1] + corners[0]))
    ring = rounded([seam, *outline, seam])[:-1]
    edge = np.roll(ring, -1, axis=0) - ring
    side = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    mitre = side + np.roll(side, 1, axis=0)
    mitre /= 1.0 + np.sum(side * np.roll(side, 1, axis=0), axis=1)[:, None]
    inner = ring - bevel * mitre
    u, v, w = axes
    vertices: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    faces: list[tuple[int, int, int]] = []

    def face(points: list[np.ndarray], shades: list[np.ndarray]) -> None:
        start = len(vertices)
        vertices.extend(origin + p[0] * u + p[1] * v + p[2] * w for p in points)
        normals.extend(n[0] * u + n[1] * v + n[2] * w for n in shades)
        faces.extend((start, start + k, start + k + 1) for k in range(1, len(points) - 1))

    count = len(ring)
    for i in range(count):
        j = (i + 1) % count
        shade = []
        for neighbour in (i - 1, j):
            smooth = side[i] @ side[neighbour] > math.cos(CREASE)
            n = side[i] + side[neighbour] if smooth else side[i]
            shade.append(n / np.linalg.norm(n))
        a, b = (np.append(n, 0.0) for n in shade)
        walls = [
            (inner, low, ring, low + bevel, -1.0),
            (ring, low + bevel, ring, high - bevel, 0.0),
            (ring, high - bevel, inner, high, 1.0),
        ]
        for lower, z0, upper, z1, tilt in walls:
            t = np.array([0.0, 0.0, tilt])
            na, nb = ((n + t) / np.linalg.norm(n + t) for n in (a, b))
            points = [np.append(lower[i], z0), np.append(lower[j], z0)]
            points += [np.append(upper[j], z1), np.append(upper[i], z1)]
            face(points, [na, nb, nb, na])
    top = np.array([0.0, 0.0, 1.0])
    face([np.append(p, high) for p in inner], [top] * count)
    face([np.append(p, low) for p in inner[::-1]], [-top] * count)
    return Part(material, np.array(vertices), np.array(normals), np.array(faces))


def block(
    material: str,
    centre: tuple[float, float, float],
    size: tuple[float, float, float],
    fillet: float,
) -> Part:
    """Box with rounded vertical edges and bevelled rims, aligned with the link frame."""
    x, y, z = 0.5 * np.array(size)
    outline = [(-x, -y, fillet), (x, -y, fillet), (x, y, fillet), (-x, y, fillet)]
    return extrusion(material, outline, np.array(centre), (X, Y, Z), -z, z)


def lid(origin: np.ndarray, axis: np.ndarray, height: float, radius: float) -> list[Part]:
    """Blue cover of a joint: a dark gap, a rounded cap and a shallow dish."""
    r = radius
    cap = [
        (r - 0.001, height + 0.003),
        (r, height + 0.005, 0.002),
        (r, height + 0.012, 0.007),
        (0.72 * r, height + 0.0185, 0.010),
        (0.60 * r, height + 0.0165, 0.004),
        (0.0, height + 0.0165),
    ]
    return [
        drum("seal", origin, axis, height - 0.002, height + 0.004, r - 0.0015, fillet=0.0005),
        lathe("lid", cap, origin, axis),
    ]


def ring(origin: np.ndarray, axis: np.ndarray, height: float, radius: float) -> Part:
    """Dark seal between two joints, 6 mm wide and centred at `height`."""
    return drum("seal", origin, axis, height - 0.003, height + 0.003, radius, fillet=0.001)


def base() -> list[Part]:
    o = np.zeros(3)
    foot = [
        (0.0, 0.0),
        (0.0745, 0.0, 0.002),
        (0.0745, 0.011, 0.004),
        (0.0665, 0.014, 0.010),
        (0.0630, 0.040, 0.020),
        (0.0630, 0.086, 0.003),
        (0.0, 0.086),
    ]
    parts = [lathe("housing", foot, o, Z), ring(o, Z, 0.0885, 0.0605)]
    for angle in np.radians([45, 135, 225, 315]):
        screw = np.array([0.066 * math.cos(angle), 0.066 * math.sin(angle), 0.0])
        parts.append(drum("steel", screw, Z, 0.008, 0.0165, 0.0052, fillet=0.001))
    connector = np.array([0.0, -0.055, 0.045])
    parts.append(drum("seal", connector, -Y, 0.0, 0.022, 0.010, fillet=0.002))
    return parts


def shoulder() -> list[Part]:
    o = np.zeros(3)
    # The next joint's axis is -y: the arm sits at y = -0.138, the lid faces +y.
    return [
        drum("housing", o, Z, -0.071, 0.058, 0.0615, fillet=0.030),
        drum("housing", o, -Y, -0.062, 0.073, 0.0600, fillet=0.004),
        ring(o, -Y, 0.0755, 0.0570),
        *lid(o, Y, 0.062, 0.0600),
    ]


def upper_arm() -> list[Part]:
    at_shoulder, at_elbow = np.array([0.0, 0.0, 0.138]), np.array([-0.425, 0.0, 0.138])
    return [
        drum("housing", at_shoulder, Z, -0.060, 0.058, 0.0600, fillet=0.005),
        *lid(at_shoulder, Z, 0.058, 0.0600),
        ring(at_shoulder, -X, 0.068, 0.0555),
        drum("housing", at_shoulder, -X, 0.0, 0.066, 0.0560, fillet=0.002),
        drum("tube", at_shoulder, -X, 0.070, 0.358, 0.0535, 0.0475, fillet=0.002),
        ring(at_shoulder, -X, 0.360, 0.0490),
        drum("housing", at_elbow, X, 0.0, 0.063, 0.0500, fillet=0.002),
        drum("housing", at_elbow, Z, -0.0655, 0.052, 0.0550, fillet=0.005),
        *lid(at_elbow, Z, 0.052, 0.0550),
    ]


def forearm() -> list[Part]:
    at_elbow, at_wrist = np.array([0.0, 0.0, 0.007]), np.array([-0.3922, 0.0, 0.007])
    return [
        ring(at_elbow, Z, 0.0625, 0.0520),
        drum("housing", at_elbow, Z, -0.052, 0.060, 0.0550, fillet=0.005),
        *lid(at_elbow, -Z, 0.052, 0.0550),
        drum("housing", at_elbow, -X, 0.0, 0.062, 0.0470, fillet=0.002),
        ring(at_elbow, -X, 0.064, 0.0462),
        drum("tube", at_elbow, -X, 0.066, 0.336, 0.0445, 0.0365, fillet=0.002),
        ring(at_elbow, -X, 0.338, 0.0380),
        drum("housing", at_wrist, X, 0.0, 0.053, 0.0375, fillet=0.002),
        drum("housing", at_wrist, Z, -0.045, 0.046, 0.0390, fillet=0.004),
        *lid(at_wrist, -Z, 0.045, 0.0390),
    ]


def wrist_1() -> list[Part]:
    o = np.zeros(3)
    # From the forearm's joint at z = -0.126 to the crossing with the next axis, which is -y.
    return [
        ring(o, Z, -0.0775, 0.0365),
        drum("housing", o, Z, -0.075, 0.040, 0.0385, fillet=0.004),
        *lid(o, Z, 0.040, 0.0385),
        drum("housing", o, -Y, 0.0, 0.050, 0.0380, fillet=0.004),
    ]


def wrist_2() -> list[Part]:
    o = np.zeros(3)
    # The joint's axis is z; the next one leaves along +y.
    return [
        ring(o, Z, -0.0475, 0.0365),
        drum("housing", o, Z, -0.045, 0.040, 0.0385, fillet=0.004),
        *lid(o, Z, 0.040, 0.0385),
        drum("housing", o, Y, 0.0, 0.050, 0.0380, fillet=0.004),
    ]


def wrist_3() -> list[Part]:
    o = np.zeros(3)
    parts = [
        ring(o, Z, -0.0475, 0.0365),
        drum("housing", o, Z, -0.045, -0.011, 0.0378, fillet=0.003),
        drum("steel", o, Z, -0.011, 0.0, 0.0375, 0.0375, fillet=0.0012),
    ]
    for angle in np.radians([45, 135, 225, 315]):
        hole = np.array([0.025 * math.cos(angle), 0.025 * math.sin(angle), 0.0])
        parts.append(drum("seal", hole, Z, -0.004, 0.0002, 0.0032, fillet=0.0))
    connector = np.array([0.0, 0.036, -0.024])
    parts.append(drum("seal", connector, Y, 0.0, 0.010, 0.007, fillet=0.001))
    return parts


def gripper() -> list[Part]:
    """Two-finger gripper whose fingers carry an adapter for a knife's spine, in the plane y = 0.

    The frame is the flange's: z leaves the robot, the fingers move along y.
    """
    o = np.zeros(3)
    body = [
        (-0.0375, -0.0200, 0.012),
        (0.0375, -0.0200, 0.012),
        (0.0375, 0.0200, 0.012),
        (-0.0375, 0.0200, 0.012),
    ]
    parts = [
        drum("steel", o, Z, 0.0, 0.0115, 0.0375, fillet=0.001),
        drum("black", o, Z, 0.0115, 0.0300, 0.0365, 0.0350, fillet=0.003),
        extrusion("black", body, o, (Y, -X, Z), 0.026, 0.094, bevel=0.003),
        block("tube", (0.0, 0.0, 0.062), (0.0412, 0.040, 0.026), 0.004),
    ]
    for s in (-1.0, 1.0):
        # Knuckle, inner and outer link, and finger, as outlines in the plane (y, z).
        links = [
            ("black", [(0.016, 0.083), (0.040, 0.083), (0.040, 0.100), (0.022, 0.103)], 0.013),
            ("steel", [(0.030, 0.088), (0.041, 0.088), (0.031, 0.126), (0.021, 0.126)], 0.011),
            ("steel", [(0.013, 0.092), (0.020, 0.092), (0.021, 0.122), (0.015, 0.122)], 0.008),
            ("black", [(0.010, 0.114), (0.030, 0.114), (0.028, 0.140), (0.010, 0.144)], 0.012),
        ]
        for material, outline, half in links:
            corners = [(s * y, z, 0.003) for y, z in outline]
            ordered = corners if s > 0 else corners[::-1]
            parts.append(extrusion(material, ordered, o, (Y, Z, X), -half, half))
        for y, z in ((0.036, 0.090), (0.026, 0.122)):
            pin = np.array([0.0, s * y, z])
            parts.append(drum("black", pin, X, -0.0145, 0.0145, 0.0045, fillet=0.001))
        # The adapter's jaw.
        jaw = [(s * 0.0018, 0.132), (s * 0.0115, 0.132), (s * 0.0095, 0.168), (s * 0.0018, 0.168)]
        corners = [(y, z, 0.0015) for y, z in (jaw if s > 0 else jaw[::-1])]
        parts.append(extrusion("tube", corners, o, (Y, Z, X), -0.034, 0.034, bevel=0.0012))
        for x in (-0.024, 0.024):
            screw = np.array([x, s * 0.010, 0.151])
            parts.append(drum("black", screw, s * Y, -0.002, 0.0045, 0.0040, fillet=0.001))
    return parts


MESHES = {
    "ur5e/base": base,
    "ur5e/shoulder": shoulder,
    "ur5e/upper_arm": upper_arm,
    "ur5e/forearm": forearm,
    "ur5e/wrist_1": wrist_1,
    "ur5e/wrist_2": wrist_2,
    "ur5e/wrist_3": wrist_3,
    "gripper/gripper": gripper,
}


def gltf(parts: list[Part]) -> dict:
    """Packs parts into a glTF 2.0 document with its buffer embedded."""
    used = [name for name in MATERIALS if any(p.material == name for p in parts)]
    blobs: list[bytes] = []
    views, accessors, primitives = [], [], []

    def add(data: np.ndarray, target: int, kind: str, component: int, **limits: list) -> int:
        raw = data.tobytes()
        raw += b"\0" * (-len(raw) % 4)
        offset = sum(map(len, blobs))
        blobs.append(raw)
        views.append(
            {"buffer": 0, "byteOffset": offset, "byteLength": data.nbytes, "target": target}
        )
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": component,
                "count": len(data) if data.ndim > 1 else data.size,
                "type": kind,
                **limits,
            }
        )
        return len(accessors) - 1

    for name in used:
        mine = [p for p in parts if p.material == name]
        # glTF is y-up; Drake turns its y into z. Hence (x, y, z) is written as (x, z, -y).
        turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)
        vertices = np.concatenate([p.vertices for p in mine]) @ turn.T
        normals = np.concatenate([p.normals for p in mine]) @ turn.T
        starts = np.cumsum([0] + [len(p.vertices) for p in mine[:-1]])
        faces = np.concatenate([p.faces + s for p, s in zip(mine, starts, strict=True)])
        corners = vertices[faces]
        area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        faces = faces[area > 1e-12]
        v32 = np.ascontiguousarray(vertices, np.float32)
        limits = {"min": v32.min(0).tolist(), "max": v32.max(0).tolist()}
        primitives.append(
            {
                "attributes": {
                    "POSITION": add(v32, 34962, "VEC3", 5126, **limits),
                    "NORMAL": add(np.ascontiguousarray(normals, np.float32), 34962, "VEC3", 5126),
                },
                "indices": add(faces.astype(np.uint16).ravel(), 34963, "SCALAR", 5123),
                "material": used.index(name),
            }
        )
    blob = b"".join(blobs)
    return {
        "asset": {"version": "2.0", "generator": "models/make_meshes.py"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "materials": [
            {
                "name": name,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*MATERIALS[name][0], 1.0],
                    "metallicFactor": MATERIALS[name][1],
                    "roughnessFactor": MATERIALS[name][2],
                },
            }
            for name in used
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [
            {
                "byteLength": len(blob),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(blob).decode(),
            }
        ],
    }


def main() -> None:
    folder = Path(__file__).parent
    for name, build in MESHES.items():
        text = json.dumps(gltf(build()), separators=(",", ":"))
        (folder / f"{name}.gltf").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
