"""The bulk as the solver steps it, the knife far away: patch tests, bars, fall, waves, damping."""

import numpy as np
import pytest
from held_reaction import held_reaction
from scipy.optimize import brentq, curve_fit
from scipy.spatial.transform import Rotation

from sliceit_drake.cutting.foods.material import Material
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.mesh.cut_geometry import make_cut_geometry
from sliceit_drake.cutting.mesh.generators import box_mesh
from sliceit_drake.cutting.mesh.split import CutPlane
from sliceit_drake.cutting.mesh.tetrahedra import TetrahedralMesh
from sliceit_drake.cutting.model import CuttingModel, Numerics, prepare_cut
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.solver import CuttingSolver
from studies.physics.neo_hookean import energy_density, first_piola_stress

FAR = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5]))
SOFT = Material(youngs_modulus=2e5, poisson_ratio=0.35, density=1000.0, damping_time=0.0)
UNEVEN = np.array([0.0, 0.3, 0.55, 1.0])
ALONG_Y = CutPlane(np.array([0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0, 0, 1.0]))
OBLIQUE = CutPlane(np.array([0.0, 1e-3, 0.0]), np.array([0.4, 1.0, 0.3]), np.array([0, 0, 1.0]))

# Masses scaled to a long step. Stopping the food feeds waves near the limit unless they are damped.
STATIC = {"time_step": 1e-3, "substeps": 4, "numerical_damping": 0.2}


def random_box(seed: int = 1) -> TetrahedralMesh:
    """A box of uneven cells whose inner vertices are moved at random."""
    mesh = box_mesh(0.02 * UNEVEN - 0.01, 0.04 * np.linspace(-0.5, 0.5, 6), 0.015 * UNEVEN)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    inner = ((mesh.vertices > low + 1e-9) & (mesh.vertices < high - 1e-9)).all(1)
    mesh.vertices[inner] += np.random.default_rng(seed).uniform(-8e-4, 8e-4, (inner.sum(), 3))
    mesh.check()
    return mesh


def prepare(
    mesh: TetrahedralMesh,
    plane: CutPlane = ALONG_Y,
    held: np.ndarray | None = None,
    material: Material = SOFT,
    board_height: float | None = None,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    substeps: int = 1,
    **numerics,
) -> CuttingSolver:
    undamped = {"numerical_damping": 0.0, "board_friction": 0.0}
    numerics = {"precision": "float64"} | undamped | numerics
    held = np.zeros(len(mesh.vertices), bool) if held is None else held
    geometry = make_cut_geometry(mesh, plane, held, up, board_height)
    model = prepare_cut(geometry, material, Knife(), Numerics(**numerics))
    return CuttingSolver(model, substeps * model.numerics.time_step)


def placed(solver: CuttingSolver, x: np.ndarray, v: np.ndarray | float = 0.0) -> np.ndarray:
    """The uncut food with its computed nodes at `x` [N, 3] and velocities `v`."""
    state = solver.initial_state()
    solver.positions(state)[:] = x
    solver.velocities(state)[:] = v
    np.testing.assert_array_equal(solver.positions(state), x)
    return state


def forces(solver: CuttingSolver, x: np.ndarray, v: np.ndarray | float = 0.0) -> np.ndarray:
    """Force on each node less its weight [N, 3], from the momentum that one tiny step gives it."""
    state = placed(solver, x, v)
    new = solver.coupling_step(state, FAR, FAR).state
    change = solver.velocities(new) - solver.velocities(state)
    model = solver.model
    momentum = np.zeros_like(change)
    momentum[model.moving] = model.inertia.of_nodes @ change[model.moving]
    return momentum / solver.exchange_period - model.weight


def by_vertex(model: CuttingModel, nodal: np.ndarray) -> np.ndarray:
    """Sum over both copies of each vertex of the uncut mesh [V, 3]."""
    out = np.zeros((len(model.split.vertex_position), 3))
    np.add.at(out, model.split.node_source[model.computed], nodal)
    return out


def settle(solver: CuttingSolver, state: np.ndarray, coupling_steps: int) -> np.ndarray:
    """To rest, by slowing the food down after each coupling step."""
    for _ in range(coupling_steps):
        state = solver.coupling_step(state, FAR, FAR).state
        solver.velocities(state)[:] *= 0.9
    return state


def pressed(solver: CuttingSolver, expected: np.ndarray) -> np.ndarray:
    """At rest after the held nodes went from rest to `expected` little by little."""
    model = solver.model
    state = solver.initial_state()
    still = np.setdiff1d(np.arange(len(model.nodes)), model.moving)
    for share in np.linspace(0.0, 1.0, 61)[1:]:
        goal = model.nodes + share * (expected - model.nodes)
        solver.positions(state)[still] = goal[still]
        state = settle(solver, state, 3)
    return settle(solver, state, 600)


def in_C(model: CuttingModel, F: np.ndarray) -> np.ndarray:
    return model.X_FC_rotation.T @ F @ model.X_FC_rotation


DEFORMATION = np.eye(3) + np.array([[0.1, 0.05, -0.1], [0.12, -0.15, 0.02], [0.0, 0.07, 0.08]])


@pytest.mark.parametrize("plane", [ALONG_Y, OBLIQUE], ids=["through cells", "oblique"])
def test_patch_of_homogeneous_strain_is_in_equilibrium_inside_and_loaded_as_the_stress_says(plane):
    mesh = random_box()
    solver = prepare(mesh, plane, time_step=1e-7, mass_scaling=False)
    model = solver.model
    F = in_C(model, DEFORMATION)
    found = by_vertex(model, forces(solver, model.nodes @ F.T)) @ model.X_FC_rotation.T
    P = first_piola_stress(DEFORMATION, *SOFT.stable_neo_hookean())
    # The load on a surface vertex is minus P times a third of the area vectors around it.
    expected = np.zeros_like(found)
    corners = mesh.tetrahedra[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    a, b, c = (mesh.vertices[corners[:, k]] for k in range(3))
    np.add.at(expected, corners, np.repeat((-np.cross(b - a, c - a) @ P.T / 6.0)[:, None], 3, 1))
    scale = np.abs(expected).max()
    assert scale > 1e-3
    np.testing.assert_allclose(found, expected, atol=1e-6 * scale)
    inner = np.abs(expected).max(1) < 1e-9 * scale
    assert inner.sum() >= 8


def test_reaction_of_held_nodes_is_the_stress_on_the_section():
    mesh = random_box()
    held = mesh.vertices[:, 1] < -0.019
    solver = prepare(mesh, held=held, material=SOFT, time_step=1e-5)
    model = solver.model
    reaction = held_reaction(solver, placed(solver, model.nodes @ DEFORMATION.T), FAR)
    P = first_piola_stress(DEFORMATION, *SOFT.stable_neo_hookean())
    still = np.ones(len(model.nodes), bool)
    still[model.moving] = False
    weight = model.weight[still].sum(0)
    np.testing.assert_allclose(reaction, -0.02 * 0.015 * P[:, 1] - weight, rtol=1e-9, atol=1e-12)


def lateral_stretch(stretch: float, material: Material) -> float:
    """Stretch across a bar that is free at its sides."""

    def side_stress(s: float) -> float:
        return first_piola_stress(np.diag([s, s, stretch]), *material.stable_neo_hookean())[0, 0]

    return brentq(side_stress, 0.5, 2.0)


def test_bar_pressed_on_the_board_takes_the_neo_hookean_shape_and_force():
    mesh = box_mesh(0.02 * UNEVEN - 0.006, np.linspace(-0.008, 0.008, 4), 0.012 * UNEVEN)
    plane = CutPlane(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    held = mesh.vertices[:, 2] > 0.012 - 1e-9
    light = Material(youngs_modulus=2e5, poisson_ratio=0.35, density=1e-3, damping_time=0.0)
    solver = prepare(mesh, plane, held, light, board_height=0.0, **STATIC)
    model = solver.model
    stretch = 0.85
    side = lateral_stretch(stretch, light)
    F = np.diag([side, side, stretch])
    pressure = -first_piola_stress(F, *light.stable_neo_hookean())[2, 2]
    sink = pressure / model.parameters["board_stiffness"]
    expected = model.nodes @ in_C(model, F).T - [0.0, 0.0, sink]
    state = pressed(solver, expected)
    np.testing.assert_allclose(solver.positions(state), expected, atol=1e-6)
    area = 0.02 * 0.016
    assert solver.coupling_step(state, FAR, FAR).board_force[2] == pytest.approx(
        pressure * area, rel=1e-4
    )
    assert held_reaction(solver, state, FAR)[2] == pytest.approx(-pressure * area, rel=1e-4)
    energies = solver.energies(state, FAR)
    volume = area * 0.012
    assert energies.elastic == pytest.approx(
        volume * energy_density(F, *light.stable_neo_hookean()), rel=1e-4
    )
    assert energies.interface == pytest.approx(0.5 * pressure * sink * area, rel=1e-3)
    assert energies.least_volume_ratio == pytest.approx(side**2 * stretch, rel=1e-4)


# Through cells, but with no copy below MIN_SHARE, whose stiffness is not that of its material.
@pytest.mark.parametrize("offset", [0.0, 3.3e-3], ids=["between layers", "through cells"])
def test_bar_pressed_between_its_held_ends_is_a_spring_in_series_with_its_uncut_faces(offset):
    mesh = box_mesh(0.02 * UNEVEN - 0.01, np.linspace(-0.02, 0.02, 7), 0.015 * UNEVEN)
    held = np.abs(mesh.vertices[:, 1]) > 0.0199
    plane = CutPlane(np.array([0.0, offset, 0.0]), ALONG_Y.normal, ALONG_Y.up)
    light = Material(youngs_modulus=2e5, poisson_ratio=0.35, density=1e-3, damping_time=0.0)
    solver = prepare(mesh, plane, held, light, **STATIC)
    model = solver.model
    stretch = 0.85
    side = lateral_stretch(stretch, light)
    F = np.diag([side, stretch, side])
    pressure = -first_piola_stress(F, *light.stable_neo_hookean())[1, 1]
    closed = pressure / model.parameters["bond_stiffness"]
    assert closed > 1e-5
    minus = model.split.node_side[model.computed] == 0
    expected = model.nodes @ F.T
    expected[minus, 1] += closed
    state = pressed(solver, expected)
    np.testing.assert_allclose(solver.positions(state), expected, atol=1e-6)
    area = 0.02 * 0.015
    energies = solver.energies(state, FAR)
    assert energies.interface == pytest.approx(0.5 * pressure * closed * area, rel=1e-3)
    assert energies.elastic == pytest.approx(
        area * 0.04 * energy_density(F, *light.stable_neo_hookean()), rel=1e-4
    )


def test_bar_standing_on_the_board_shrinks_under_its_weight_as_betti_says():
    # On a frictionless base the mean shortening is rho g L^2 / 2E for any Poisson's ratio, exactly,
    # also of linear elements: uniform compression is among their fields.
    length = 0.03
    mesh = box_mesh(np.linspace(-0.01, 0.01, 5), np.linspace(-0.008, 0.008, 4), length * UNEVEN)
    plane = CutPlane(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    solver = prepare(mesh, plane, board_height=0.0, **STATIC)
    model = solver.model
    assert model.mass_ratio > 2.0
    state = settle(solver, solver.initial_state(), 700)
    weight = SOFT.density * 9.81 * 0.02 * 0.016 * length
    assert solver.coupling_step(state, FAR, FAR).board_force[2] == pytest.approx(weight, rel=1e-3)
    np.testing.assert_allclose(held_reaction(solver, state, FAR), 0.0, atol=1e-12)
    moved = solver.positions(state)[:, 2] - model.nodes[:, 2]

    def mean_over(height: float) -> float:
        at = np.abs(model.nodes[:, 2] - height) < 1e-9
        area = np.zeros(len(model.nodes))
        # Consistent areas of the grid's nodes: faces at this height, a third to each corner.
        t = np.searchsorted(model.computed, model.split.tetrahedra)
        for face in t[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3):
            if at[face].all():
                a, b, c = model.nodes[face]
                area[face] += np.linalg.norm(np.cross(b - a, c - a)) / 6.0
        assert area.sum() == pytest.approx(0.02 * 0.016)
        return float(area @ moved / area.sum())

    shortening = mean_over(0.0) - mean_over(length)
    expected = SOFT.density * 9.81 * length**2 / (2.0 * SOFT.youngs_modulus)
    assert shortening == pytest.approx(expected, rel=5e-3)


def test_free_body_falls_with_its_true_mass():
    solver = prepare(random_box(), OBLIQUE, time_step=1e-5, mass_scaling=False, substeps=50)
    model = solver.model
    state = solver.initial_state()
    for _ in range(4):
        state = solver.coupling_step(state, FAR, FAR).state
    t, dt = 4 * solver.exchange_period, model.numerics.time_step
    mass = 1000.0 * 0.02 * 0.04 * 0.015
    down = -model.X_FC_rotation.T @ [0.0, 0.0, 1.0]
    stepped = model.inertia.of_nodes.sum(0)
    momentum = stepped @ solver.velocities(state)[model.moving]
    np.testing.assert_allclose(momentum, mass * 9.81 * t * down, atol=1e-9 * mass * 9.81 * t)
    fallen = stepped @ (solver.positions(state) - model.nodes)[model.moving] / mass
    # Semi-implicit Euler falls g t (t + dt) / 2.
    np.testing.assert_allclose(fallen, 0.5 * 9.81 * t * (t + dt) * down, atol=1e-6 * 9.81 * t * t)


def test_rigid_motion_of_the_body_costs_no_force():
    solver = prepare(random_box(), OBLIQUE, time_step=1e-7, mass_scaling=False)
    x = solver.model.nodes
    stretched = np.abs(forces(solver, x @ DEFORMATION.T)).max()
    for turn in Rotation.random(4, rng=np.random.default_rng(4)).as_matrix():
        assert np.abs(forces(solver, x @ turn.T + [0.01, -0.02, 0.03])).max() < 1e-8 * stretched


def test_damping_sees_no_translation_and_rotation_only_to_second_order():
    tau = 1e-4
    viscous = Material(youngs_modulus=2e5, poisson_ratio=0.35, density=1000.0, damping_time=tau)
    solver = prepare(random_box(), OBLIQUE, material=viscous, time_step=1e-9, mass_scaling=False)
    x = solver.model.nodes
    shearing = np.abs(forces(solver, x, x @ (DEFORMATION - np.eye(3)).T)).max()
    moving = np.abs(forces(solver, x, np.array([0.3, -0.2, 0.5]))).max()
    assert moving < 1e-6 * shearing
    spin = [
        np.abs(forces(solver, x, np.cross(rate * np.array([0.6, 0.0, 0.8]), x))).max()
        for rate in (50.0, 100.0)
    ]
    # A first-order effect would be of a strain rate of 50 rather than of 0.1.
    assert spin[0] < 0.02 * (50.0 / 0.1) * shearing
    assert spin[1] / spin[0] == pytest.approx(4.0, rel=0.02)


def test_uniform_velocity_changes_nothing():
    held_motion = []
    for v in (np.zeros(3), np.array([0.2, -0.1, 0.05])):
        solver = prepare(random_box(), OBLIQUE, time_step=1e-5, mass_scaling=False, substeps=20)
        model = solver.model
        stretched = model.nodes @ (np.eye(3) + 0.1 * (DEFORMATION - np.eye(3))).T
        state = solver.coupling_step(placed(solver, stretched, v), FAR, FAR).state
        t = solver.exchange_period
        held_motion.append((solver.positions(state) - v * t, solver.velocities(state) - v))
    np.testing.assert_allclose(held_motion[0][0], held_motion[1][0], atol=1e-12)
    np.testing.assert_allclose(held_motion[0][1], held_motion[1][1], atol=1e-9)
    assert np.abs(held_motion[0][1]).max() > 1e-3


def oscillation(tau: float) -> tuple[float, float]:
    """Rate of decay and angular frequency (1/s) of a bar along y that is stretched and let go."""
    mesh = box_mesh(
        np.linspace(-5e-3, 5e-3, 3), np.linspace(-0.03, 0.03, 9), np.linspace(0, 0.01, 3)
    )
    held = mesh.vertices[:, 1] < -0.0299
    viscous = Material(youngs_modulus=2e5, poisson_ratio=0.0, density=1000.0, damping_time=tau)
    solver = prepare(
        mesh,
        held=held,
        material=viscous,
        up=(0.0, 1.0, 0.0),
        time_step=1e-5,
        mass_scaling=False,
        substeps=50,
        bond_stiffness=100.0,
    )
    model = solver.model
    x = model.nodes.copy()
    x[:, 1] += 1e-3 * np.sin(0.5 * np.pi * (x[:, 1] / 0.06 + 0.5))
    state = placed(solver, x)
    end = model.nodes[:, 1] > 0.0299
    position = []
    for _ in range(150):
        state = solver.coupling_step(state, FAR, FAR).state
        position.append(solver.positions(state)[end, 1].mean() - 0.03)
    t = np.arange(1, 151) * solver.exchange_period

    def wave(t: np.ndarray, size: float, rate: float, omega: float, phase: float, rest: float):
        return size * np.exp(-rate * t) * np.cos(omega * t + phase) + rest

    (_, rate, omega, _, _), _ = curve_fit(wave, t, position, p0=[1e-3, 5.0, 370.0, 0.0, 0.0])
    return rate, omega


def test_damping_makes_an_oscillation_decay_at_the_kelvin_voigt_rate():
    undamped, omega = oscillation(0.0)
    # Longest wave of a bar held at one end: four lengths at sqrt(E / rho).
    assert omega == pytest.approx(0.5 * np.pi / 0.06 * np.sqrt(2e5 / 1000.0), rel=0.02)
    tau = 1.5e-4
    damped, _ = oscillation(tau)
    assert abs(undamped) < 0.02 * damped
    assert damped == pytest.approx(0.5 * tau * omega**2, rel=0.03)


def test_the_least_volume_ratio_is_that_of_the_element_that_is_pressed_most():
    solver = prepare(random_box())
    model = solver.model
    x = model.nodes + np.random.default_rng(3).uniform(-3e-4, 3e-4, model.nodes.shape)
    corners = model.tetrahedra
    volumes = [np.linalg.det(at[corners[:, 1:]] - at[corners[:, :1]]) for at in (x, model.nodes)]
    ratio = volumes[0] / volumes[1]
    assert ratio.min() < 0.95 and ratio.max() > 1.05
    energies = solver.energies(placed(solver, x), FAR)
    assert energies.least_volume_ratio == pytest.approx(ratio.min(), rel=1e-9)
    assert energies.min_element == ratio.argmin()
