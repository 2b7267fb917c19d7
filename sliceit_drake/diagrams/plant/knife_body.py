"""The knife as a rigid body of a plant: mass, looks, and the edge that touches the board."""

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    AddContactMaterial,
    GeometryProperties,
    InMemoryMesh,
    Mesh,
    ProximityProperties,
    Sphere,
    SurfaceTriangle,
    TriangleSurfaceMesh,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import CalcSpatialInertia, Frame, JacobianWrtVariable, RigidBody

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.cutting.board import Board, edge_contact_positions, impact_peak_loss
from sliceit_drake.cutting.knife import STEEL_DENSITY, Knife

__all__ = [
    "add_knife",
    "blade_surface",
    "check_plant_step",
    "contact_properties",
    "effective_mass",
]

# Above it a station is refused. The default board and step have 4.5 %, measured 2 to 4 %.
PEAK_LOSS_LIMIT = 0.05

# Polyoxymethylene, the usual plastic of kitchen knives' handles.
HANDLE_DENSITY = 1410.0

HANDLE_LENGTH = 0.115
HANDLE_HEIGHT = 0.028
HANDLE_THICKNESS = 0.020
EDGE_SPHERE_RADIUS = 1e-3

STEEL = np.array([0.66, 0.68, 0.70, 1.0])
GROUND = np.array([0.86, 0.88, 0.90, 1.0])
BEVEL = 0.12
"""Part of the blade's height that is drawn brighter, as ground."""
PLASTIC = np.array([0.06, 0.06, 0.07, 1.0])


def add_knife(
    plant: MultibodyPlant,
    knife: Knife,
    board: Board,
    parent_frame: Frame,
    X_PK: RigidTransform,
) -> RigidBody:
    """Adds the rigid body ``knife``, welded to a frame.

    The body's frame is the knife frame K: origin at the middle of the edge, Kx along the edge, Kz
    from spine to edge. Mass and inertia are those of the steel prism and of a plastic handle behind
    it. The edge is a row of small spheres that touch the edge line from inside and share the
    board's contact law equally (`edge_contact_positions`, the points of `board_wrench`): several
    points hold a blade steadily where one box would flip between its ends. Steps of the plant take
    from an impact's peak: see `check_plant_step`.

    Args:
        plant: Plant, not finalized, registered with a scene graph.
        knife: The blade.
        board: The board, whose stiffness and dissipation the contact of knife and board has.
        parent_frame: Frame P that carries the knife.
        X_PK: Pose of the knife frame in P.

    Returns:
        The body.
    """
    blade, handle = blade_surface(knife), _handle(knife)
    inertia = CalcSpatialInertia(blade, STEEL_DENSITY)
    inertia += CalcSpatialInertia(handle, HANDLE_DENSITY)
    body = plant.AddRigidBody("knife", plant.AddModelInstance("knife"), inertia)
    plant.WeldFrames(parent_frame, body.body_frame(), X_PK)
    drawn = (
        ("blade", _drawn_blade(knife, BEVEL, 1.0), STEEL),
        ("edge", _drawn_blade(knife, 0.0, BEVEL), GROUND),
        ("handle", handle, PLASTIC),
    )
    for name, mesh, colour in drawn:
        plant.RegisterVisualGeometry(body, RigidTransform(), _shape(mesh, name), name, colour)
    properties = contact_properties(board, len(edge_contact_positions(knife)))
    for i, x in enumerate(edge_contact_positions(knife)):
        X_KS = RigidTransform([x, 0.0, -EDGE_SPHERE_RADIUS])
        plant.RegisterCollisionGeometry(
            body, X_KS, Sphere(EDGE_SPHERE_RADIUS), f"edge_{i}", properties
        )
    return body


def effective_mass(plant: MultibodyPlant, knife: RigidBody, joints: np.ndarray) -> float:
    """Mass that a vertical blow on the edge's middle meets, rotors included, kg.

    Args:
        plant: Finalized.
        knife: Body ``knife``.
        joints: Positions of the plant, rad.
    """
    context, world = plant.CreateDefaultContext(), plant.world_frame()
    plant.SetPositions(context, joints)
    J = plant.CalcJacobianTranslationalVelocity(
        context, JacobianWrtVariable.kV, knife.body_frame(), np.zeros(3), world, world
    )[2]
    return float(1.0 / (J @ np.linalg.solve(plant.CalcMassMatrix(context), J)))


def check_plant_step(board: Board, mass: float, time_step: float, exchange_period: float) -> float:
    """Refuses a board too stiff for the plant's step.

    The estimate is that of a free mass (`impact_peak_loss`) and bounds what the arm does. Measured
    at 50 and 100 mm/s against steps of 0.1 ms (tests/test_robot.py repeats some), the peak is
    2 to 4 % low at 3e4 N/m with 1 ms, where the estimate is 4.6 %; at 1e5 N/m 5 to 6 % (8 %), and
    3 % (4 %) with 0.5 ms; at 4.5e5 N/m 12 to 13 % (16 %) and 6 % (9 %). Forces at rest do not
    depend on the step.

    Args:
        board: Of the station.
        mass: `effective_mass`, kg.
        time_step: Of the plant, s.
        exchange_period: Whole number of such steps, s.

    Returns:
        Estimated fraction of an impact's peak force that the steps take.

    Raises:
        ConfigurationError: It is above `PEAK_LOSS_LIMIT`.
    """
    loss = impact_peak_loss(board.stiffness, mass, time_step)
    if loss > PEAK_LOSS_LIMIT:
        x = 4.0 / np.pi * PEAK_LOSS_LIMIT
        stiffness = mass * (x / time_step) ** 2
        steps = np.ceil(exchange_period / (x * np.sqrt(mass / board.stiffness)))
        raise ConfigurationError(
            f"{board.stiffness:.4g} N/m is too stiff for a plant step of {time_step:.4g} s: the "
            f"peak force of an impact would be about {100.0 * loss:.0f} % low",
            field="scenario.board.stiffness",
            fix=f"Give robot.plant_time_step {exchange_period / steps:.6g} s or less, or at most "
            f"{stiffness:.2g} N/m.",
        )
    return loss


def contact_properties(board: Board, contacts: int) -> GeometryProperties:
    """Contact properties of both surfaces, so that `contacts` points together have the board's law.

    Drake combines the stiffnesses of two surfaces in series, so each gets twice the point's, and
    averages their dissipations. The contact is without friction, as in `board_wrench`.
    """
    properties = ProximityProperties()
    AddContactMaterial(
        board.dissipation,
        2.0 * board.stiffness / contacts,
        CoulombFriction(0.0, 0.0),
        properties,
    )
    return properties


def blade_surface(knife: Knife) -> TriangleSurfaceMesh:
    """The blade as a closed prism in K, faces outward."""
    half = [
        (0.0, 0.0),
        (0.5 * knife.edge_thickness, -knife.tip_height),
        (0.5 * knife.spine_thickness, -knife.tip_height - knife.height),
    ]
    outline = half + [(-y, z) for y, z in half[:0:-1]]
    return _loft([(x, outline) for x in (-0.5 * knife.length, 0.5 * knife.length)])


def _drawn_blade(knife: Knife, low: float, high: float) -> TriangleSurfaceMesh:
    """The blade as it is drawn in K, between two fractions of its height: the spine falls in front.

    What cuts and weighs is the whole prism, `blade_surface`.
    """
    full = knife.tip_height + knife.height
    rings = []
    for along in (-0.5, *np.linspace(0.2, 0.5, 12)):
        spine = 1.0 - 0.75 * max((along - 0.2) / 0.3, 0.0) ** 2
        heights = [min(part, spine) * full for part in (low, high)]
        half = [
            0.5 * np.interp(z, [0.0, knife.tip_height, full], _thicknesses(knife)) for z in heights
        ]
        (bottom, top), (thin, thick) = heights, half
        outline = [(-thin, -bottom), (thin, -bottom), (thick, -top), (-thick, -top)]
        rings.append((along * knife.length, outline))
    return _loft(rings)


def _thicknesses(knife: Knife) -> list[float]:
    """Of the blade at edge, shoulder and spine, metres."""
    return [1e-6, knife.edge_thickness, knife.spine_thickness]


def _handle(knife: Knife) -> TriangleSurfaceMesh:
    """The handle behind the blade's heel, along -Kx, a closed surface in K, faces outward."""
    centre = -0.55 * (knife.tip_height + knife.height)
    angle = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    round_y = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.6
    round_z = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.6
    # Positions along the handle from butt to blade, and the section's size there.
    sections = [(0.00, 0.70), (0.04, 0.96), (0.12, 1.0), (0.35, 0.90), (0.6, 0.88), (0.9, 1.0)]
    sections += [(0.97, 0.96), (1.0, 0.80)]
    rings = []
    for along, size in sections:
        y = 0.5 * size * HANDLE_THICKNESS * round_y
        z = centre - 0.5 * size * HANDLE_HEIGHT * round_z
        x = -0.5 * knife.length - HANDLE_LENGTH * (1.0 - along)
        rings.append((x, list(zip(y, z, strict=True))))
    return _loft(rings)


def _loft(rings: list[tuple[float, list[tuple[float, float]]]]) -> TriangleSurfaceMesh:
    """Closes a surface through outlines (y, z), clockwise about +x, at increasing x."""
    count = len(rings[0][1])
    vertices = [np.array([x, y, z]) for x, outline in rings for y, z in outline]
    triangles = []
    for ring in range(len(rings) - 1):
        for i in range(count):
            a, b = ring * count + i, ring * count + (i + 1) % count
            c, d = a + count, b + count
            triangles += [(a, c, b), (b, c, d)]
    last = (len(rings) - 1) * count
    for i in range(1, count - 1):
        triangles += [(0, i, i + 1), (last, last + i + 1, last + i)]
    return TriangleSurfaceMesh([SurfaceTriangle(*t) for t in triangles], vertices)


def _shape(mesh: TriangleSurfaceMesh, name: str) -> Mesh:
    """The surface as an OBJ file in memory, each triangle shaded flat."""
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*v) for v in mesh.vertices()]
    for i, triangle in enumerate(mesh.triangles(), start=1):
        lines.append("vn {:.6f} {:.6f} {:.6f}".format(*mesh.face_normal(i - 1)))
        lines.append("f " + " ".join(f"{triangle.vertex(k) + 1}//{i}" for k in range(3)))
    contents = "\n".join(lines) + "\n"
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(contents, ".obj", name)))
