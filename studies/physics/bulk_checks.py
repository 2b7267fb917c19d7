"""The bulk against exact solutions, one function a check; docs/results/verification.md."""

import dataclasses as dc
import functools
from collections.abc import Callable, Sequence

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import LinearOperator, cg, splu
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.cut_geometry import make_cut_geometry
from sliceit_drake.cutting.mesh.generators import box_mesh
from sliceit_drake.cutting.mesh.split import CutPlane
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh
from sliceit_drake.cutting.model import GRAVITY, Numerics, prepare_cut
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.solver import CuttingSolver
from studies.physics.neo_hookean import first_piola_stress, small_strain_stiffness

__all__ = ["BeamCheck", "PatchCheck", "check_beam", "check_patch"]

UP = np.array([0.0, 0.0, 1.0])
FAR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5]))
"""A knife that touches nothing."""

SOFT = Material(youngs_modulus=2e5, poisson_ratio=0.35, density=1000.0, damping_time=0.0)
PLANES = {
    "between elements": CutPlane(np.zeros(3), np.array([0.0, 1.0, 0.0]), UP),
    "through elements": CutPlane(np.array([0.0, 1e-3, 0.0]), np.array([0.4, 1.0, 0.3]), UP),
}
STRAIN = np.array([[0.1, 0.05, -0.1], [0.12, -0.15, 0.02], [0.0, 0.07, 0.08]])
"""Displacement gradient of the patch test: 15 % and less, with shear and rotation."""


def _uncut(
    mesh: TetrahedralMesh,
    plane: CutPlane,
    held: np.ndarray,
    material: Material,
    bond_stiffness: float = 4.0,
) -> CuttingSolver:
    """A body in double precision with its masses not scaled to the step, for one short step."""
    given = Numerics(
        time_step=1e-7,
        mass_scaling=False,
        precision="float64",
        numerical_damping=0.0,
        board_friction=0.0,
        bond_stiffness=bond_stiffness,
    )
    geometry = make_cut_geometry(mesh, plane, held, board_height=None)
    model = prepare_cut(geometry, material, Knife(), given)
    return CuttingSolver(model, given.time_step)


def _forces(solver: CuttingSolver, x: np.ndarray) -> np.ndarray:
    """Force on each node at rest at `x`, less its weight [N, 3], N, from the momentum of a step."""
    state = solver.initial_state()
    solver.positions(state)[:] = x
    after = solver.velocities(solver.coupling_step(state, FAR, FAR).state)
    model, momentum = solver.model, np.zeros_like(after)
    # Beside the cut, slivers of elements are heavier than their true mass.
    momentum[model.moving] = model.inertia.of_nodes @ after[model.moving]
    return momentum / solver.exchange_period - model.weight


@dc.dataclass
class PatchCheck:
    """Forces of the uncut body of two halves in double precision, relative to the largest load.

    Attributes:
        name: Of the cut plane.
        elements: After the split.
        inside: Largest force on an inner vertex at homogeneous strain, where none belongs.
        surface: Largest error of the load on a surface vertex there, against the stress.
        rigid: Largest force after rotations and translations.
        one_body: Largest difference from the body that is not split, at a strain that varies.
    """

    name: str
    elements: int
    inside: float
    surface: float
    rigid: float
    one_body: float


def check_patch() -> list[PatchCheck]:
    """Patch tests on a distorted box, cut between its elements and through them."""
    uneven = np.array([0.0, 0.3, 0.55, 1.0])
    mesh = box_mesh(0.02 * uneven - 0.01, 0.04 * np.linspace(-0.5, 0.5, 6), 0.015 * uneven)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    inner = ((mesh.vertices > low + 1e-9) & (mesh.vertices < high - 1e-9)).all(1)
    shift = np.random.default_rng(1).uniform(-8e-4, 8e-4, (int(inner.sum()), 3))
    mesh.vertices[inner] += shift
    free = np.zeros(len(mesh.vertices), bool)
    return [_patch(name, plane, mesh, inner, free) for name, plane in PLANES.items()]


def _patch(
    name: str, plane: CutPlane, mesh: TetrahedralMesh, inner: np.ndarray, free: np.ndarray
) -> PatchCheck:
    solver = _uncut(mesh, plane, free, SOFT)
    model = solver.model
    R = model.X_FC_rotation
    rest = model.nodes @ R.T + model.X_FC_position

    def found(at: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Force on the vertices of the mesh, both halves together, in F."""
        nodal = _forces(solver, model.to_cut_frame(at(rest))) @ R.T
        total = np.zeros_like(mesh.vertices)
        np.add.at(total, model.split.node_source[model.computed], nodal)
        return total

    def strained(p: np.ndarray) -> np.ndarray:
        return p + p @ STRAIN.T

    def bent(p: np.ndarray) -> np.ndarray:
        return strained(p) + 4.0 * np.stack([p[:, 1] ** 2, p[:, 0] * p[:, 2], p[:, 1] * p[:, 0]], 1)

    def error(at: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        return np.abs(found(at) - _element_forces(mesh, at(mesh.vertices))).max(1) / load

    load = float(np.abs(found(strained)).max())
    at_strain = error(strained)
    turns = Rotation.random(4, rng=np.random.default_rng(4)).as_matrix()

    def moved(p: np.ndarray, turn: np.ndarray) -> np.ndarray:
        return p @ turn.T + [0.01, -0.02, 0.03]

    rigid = [np.abs(found(functools.partial(moved, turn=turn))).max() for turn in turns]
    return PatchCheck(
        name=name,
        elements=model.element_count,
        inside=float(np.abs(found(strained))[inner].max()) / load,
        surface=float(at_strain[~inner].max()),
        rigid=float(max(rigid)) / load,
        one_body=float(error(bent).max()),
    )


def _element_forces(mesh: TetrahedralMesh, x: np.ndarray) -> np.ndarray:
    """Elastic forces of the body that is not split, vertices at `x` [V, 3], N."""
    corners = mesh.vertices[mesh.tetrahedra]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    now = x[mesh.tetrahedra]
    inverse = np.linalg.inv(edges)
    F = np.swapaxes(now[:, 1:] - now[:, :1], 1, 2) @ inverse
    stress = first_piola_stress(F, *SOFT.stable_neo_hookean())
    volume = np.linalg.det(edges)[:, None, None] / 6.0
    on_corners = -volume * np.swapaxes(stress @ np.swapaxes(inverse, 1, 2), 1, 2)
    out = np.zeros_like(x)
    np.add.at(out, mesh.tetrahedra[:, 1:], on_corners)
    np.add.at(out, mesh.tetrahedra[:, 0], -on_corners.sum(1))
    return out


@dc.dataclass
class BeamCheck:
    """Deflection of a cantilever under its weight, over that of a Timoshenko beam.

    Attributes:
        divisions: Elements along an edge of the section, by mesh.
        ratio: Deflection of the end, by mesh.
        order: Of convergence to 1, between each mesh and that before.
    """

    divisions: list[int]
    ratio: list[float]
    order: list[float]


def check_beam(divisions: Sequence[int] = (2, 4, 8)) -> BeamCheck:
    """A bar of square section held at one end, its masses' weight its load.

    Solved by conjugate gradients on the linearised forces of the kernels, in double precision; the
    cut, across the bar near its free end, is bonded. Each of `divisions` doubles that before.
    """
    side, length = 0.01, 0.06
    material = dc.replace(SOFT, youngs_modulus=1e7, poisson_ratio=0.0)
    inertia, area = side**4 / 12.0, side**2
    load = material.density * GRAVITY * area
    E = material.youngs_modulus
    # Shear coefficient 5/6 is exact for a rectangle without Poisson's effect.
    exact = load * length**4 / (8.0 * E * inertia) + load * length**2 / (
        2.0 * 5.0 / 6.0 * 0.5 * E * area
    )
    ratio = []
    for n in divisions:
        grid = np.linspace(0.0, 1.0, n + 1)
        mesh = box_mesh(
            side * (grid - 0.5), np.linspace(0.0, length, 6 * n + 1), side * (grid - 0.5)
        )
        held = mesh.vertices[:, 1] < 1e-9
        plane = CutPlane(
            np.array([0.0, length - side / divisions[0], 0.0]), np.array([0, 1.0, 0]), UP
        )
        solver = _uncut(mesh, plane, held, material, bond_stiffness=100.0)
        ratio.append(_deflection(solver, length) / exact)
    error = np.abs(np.array(ratio) - 1.0)
    return BeamCheck(list(divisions), ratio, np.log2(error[:-1] / error[1:]).tolist())


def _deflection(solver: CuttingSolver, length: float) -> float:
    """Mean fall of the free end under the weight, metres."""
    model = solver.model
    moving = model.moving
    size = 1e-7

    def stiffness(u: np.ndarray) -> np.ndarray:
        move = np.zeros_like(model.nodes)
        greatest = float(np.abs(u).max())
        if greatest == 0.0:
            return np.zeros_like(u)
        move[moving] = u.reshape(-1, 3) * (size / greatest)
        change = _forces(solver, model.nodes + move) - _forces(solver, model.nodes - move)
        return -change[moving].ravel() * (0.5 * greatest / size)

    n = 3 * len(moving)
    solve = splu(_bonded_stiffness(solver)).solve
    u, info = cg(
        LinearOperator((n, n), matvec=stiffness, dtype=float),
        model.weight[moving].ravel(),
        rtol=1e-7,
        maxiter=100,
        M=LinearOperator((n, n), matvec=solve, dtype=float),
    )
    if info != 0:
        raise RuntimeError("the deflection of the beam did not converge")
    rest = model.nodes @ model.X_FC_rotation.T + model.X_FC_position
    end = rest[moving, 1] > length - 1e-9
    return -float((u.reshape(-1, 3) @ model.X_FC_rotation.T)[end, 2].mean())


def _bonded_stiffness(solver: CuttingSolver) -> csc_matrix:
    """Stiffness of the moving nodes at rest without the kernels, bonds as if isotropic."""
    model = solver.model
    gradients = np.concatenate([-model.inverse.sum(1, keepdims=True), model.inverse], axis=1)
    bulk = small_strain_stiffness(gradients, model.element_volume, *model.material.lame())
    bond = model.parameters["bond_stiffness"] * model.tables.area
    apart = np.concatenate([-model.point_weights, model.point_weights], axis=1)
    bonds = (bond[:, None, None] * apart[:, :, None] * apart[:, None, :])[..., None, None]
    values, rows, columns = [], [], []
    for nodes, blocks in ((model.tetrahedra, bulk), (model.point_nodes, bonds * np.eye(3))):
        at = 3 * nodes[:, :, None] + np.arange(3)
        shape = (len(nodes), 4, 4, 3, 3)
        values.append(blocks.ravel())
        rows.append(np.broadcast_to(at[:, :, None, :, None], shape).ravel())
        columns.append(np.broadcast_to(at[:, None, :, None, :], shape).ravel())
    size = 3 * len(model.nodes)
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    free = (3 * model.moving[:, None] + np.arange(3)).ravel()
    return csc_matrix(entries, shape=(size, size))[free][:, free]
