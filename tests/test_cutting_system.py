"""The cutting system in Drake: contexts, order of events, ports, energy balance of the coupling."""

import concurrent.futures

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem

from sliceit_drake.cutting.foods.effects import Effects, Resting, SlicePush
from sliceit_drake.cutting.foods.food import Food, make_food_model, start_pose
from sliceit_drake.cutting.foods.shapes import Box, Cylinder
from sliceit_drake.cutting.knife import Knife
from sliceit_drake.cutting.model import Numerics
from sliceit_drake.cutting.motion import Pose
from sliceit_drake.cutting.solver import CuttingError, CuttingSolver, SurfaceFactors
from sliceit_drake.systems.cutting_system import CuttingSystem
from sliceit_drake.systems.knife_force import AppliedForce, KnifeForceSystem

PERIOD = 2e-3
KNIFE_BODY = BodyIndex(7)
FOODS = (
    Food(shape=Cylinder(rings=2, layers=[0.0, 0.006, 0.0125])),
    Food(shape=Box(size=[0.02, 0.06, 0.022], divisions=[3, 3], layers=[0.0, 4e-3, 12e-3])),
)
DOWN = RotationMatrix(np.diag([1.0, -1.0, -1.0]))


class KnifePath(LeafSystem):
    """Pose and velocity of a knife that presses and draws at constant speed from a start."""

    def __init__(self, start: np.ndarray) -> None:
        super().__init__()
        self._start = start
        self._velocity = self.DeclareNumericParameter(BasicVector([0.0, 0.0, -0.05]))
        self.DeclareAbstractOutputPort("knife_pose", lambda: Value(RigidTransform()), self._pose)
        self.DeclareAbstractOutputPort(
            "knife_velocity", lambda: Value(SpatialVelocity.Zero()), self._rate
        )

    def set_velocity(self, context: Context, velocity: list[float]) -> None:
        context.get_mutable_numeric_parameter(self._velocity).SetFromVector(velocity)

    def _v(self, context: Context) -> np.ndarray:
        return context.get_numeric_parameter(self._velocity).value()

    def _pose(self, context: Context, output: Value) -> None:
        output.set_value(RigidTransform(DOWN, self._start + self._v(context) * context.get_time()))

    def _rate(self, context: Context, output: Value) -> None:
        output.set_value(SpatialVelocity(np.zeros(3), self._v(context)))


class WrenchReader(LeafSystem):
    """Notes, in a discrete update each coupling step, the wrench that it sees."""

    def __init__(self) -> None:
        super().__init__()
        self._wrench = self.DeclareAbstractInputPort("food_wrench", Value(SpatialForce.Zero()))
        self.seen = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, PERIOD, self._note)

    def _note(self, context: Context, state) -> None:
        force = self._wrench.Eval(context).translational()[2]
        state.get_mutable_vector(self.seen).SetFromVector([force])


@pytest.fixture(scope="module")
def solvers() -> tuple[CuttingSolver, ...]:
    return tuple(
        CuttingSolver(make_food_model(food, Knife(), Numerics()), PERIOD) for food in FOODS
    )


def build(solvers, system: KnifeForceSystem | None = None) -> Diagram:
    """A knife that starts 1 mm above the higher food, the cutting system, a reader."""
    top = max(start_pose(solver.model, 1e-3).p[2] for solver in solvers)
    builder = DiagramBuilder()
    path = builder.AddNamedSystem("path", KnifePath(np.array([0.0, 0.0, top])))
    cutting = system or CuttingSystem(solvers, RigidTransform())
    builder.AddNamedSystem("cutting", cutting)
    reader = builder.AddNamedSystem("reader", WrenchReader())
    for name in ("knife_pose", "knife_velocity"):
        builder.Connect(path.GetOutputPort(name), cutting.GetInputPort(name))
    builder.Connect(cutting.GetOutputPort("food_wrench"), reader.GetInputPort("food_wrench"))
    return builder.Build()


@pytest.fixture(scope="module")
def diagram(solvers) -> Diagram:
    return build(solvers)


class Slice:
    """One context of the diagram and its run."""

    def __init__(self, diagram: Diagram, food: int = 0, velocity=(0.0, 0.0, -0.05)) -> None:
        self.diagram = diagram
        self.cutting = diagram.GetSubsystemByName("cutting")
        self.simulator = Simulator(diagram)
        root = self.simulator.get_mutable_context()
        path = diagram.GetSubsystemByName("path")
        path.set_velocity(path.GetMyMutableContextFromRoot(root), velocity)
        self.cutting.SetFood(self.cutting.GetMyMutableContextFromRoot(root), food)
        self.simulator.Initialize()
        self.wrenches: list[np.ndarray] = []

    @property
    def context(self) -> Context:
        return self.cutting.GetMyContextFromRoot(self.simulator.get_context())

    def advance(self, coupling_steps: int) -> "Slice":
        for _ in range(coupling_steps):
            # Half way between coupling steps no update is due, whatever the rounding of the time.
            done = int(self.simulator.get_context().get_time() / PERIOD)
            self.simulator.AdvanceTo((done + 1.5) * PERIOD)
            self.wrenches.append(self.cutting.wrench(self.context).copy())
        return self

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.wrenches), self.cutting.food_state(self.context).copy()


def same(a, b) -> None:
    for first, second in zip(a, b, strict=True):
        np.testing.assert_array_equal(first, second)


MOTIONS = ((0, (0.0, 0.0, -0.05)), (0, (0.04, 0.0, -0.08)))
LENGTH = 80


@pytest.fixture(scope="module")
def alone(solvers):
    """Each motion on a diagram and solvers of its own."""
    results = []
    for food, velocity in MOTIONS:
        own = [CuttingSolver(solver.model, PERIOD) for solver in solvers]
        results.append(Slice(build(own), food, velocity).advance(LENGTH).result())
    assert all(np.abs(wrenches[:, 5]).max() > 1.0 for wrenches, _ in results)
    assert not np.array_equal(results[0][0], results[1][0])
    return results


def test_the_same_input_gives_the_same_force_bit_for_bit(diagram, alone):
    for (food, velocity), expected in zip(MOTIONS, alone, strict=True):
        same(Slice(diagram, food, velocity).advance(LENGTH).result(), expected)


def test_what_changes_the_force_of_a_cut_does_so_step_by_step(solvers, alone):
    """The pull of a draw, and a force that fades, as over the whole series at once; the food itself
    goes on as without them."""
    effects = Effects(slice_push=SlicePush(pull=0.3), resting=Resting([0.2, 0.1], [0.01, 0.1]))
    effects.resting.travel = 0.05
    velocity = np.array(MOTIONS[1][1])
    changed, plain = (
        Slice(build([CuttingSolver(model, PERIOD)]), 0, velocity)
        for model in (solvers[0].model.derive(effects=effects), solvers[0].model)
    )
    parts = []
    for _ in range(LENGTH):
        changed.advance(1)
        components = plain.advance(1).cutting.GetOutputPort("force_components").Eval(plain.context)
        parts.append(np.column_stack([np.zeros((3, 3)), components.reshape(3, 3)]))
    same([changed.result()[1]], [plain.result()[1]])
    speed, edge = np.full(LENGTH, np.linalg.norm(velocity)), np.tile([1.0, 0.0, 0.0], (LENGTH, 1))
    expected, faded = effects.changed(np.array(parts), edge, speed, PERIOD)
    assert np.array(changed.wrenches)[:, 3:] == pytest.approx(expected.sum(1)[:, 3:], abs=1e-4)
    assert changed.cutting.kept(changed.context)[-2:] == pytest.approx(faded)
    drawn = np.abs(np.array(changed.wrenches)[-20:, 3] / np.array(plain.wrenches)[-20:, 3])
    assert (drawn > 1.1).all()


def test_two_contexts_of_one_diagram_do_not_disturb_each_other(diagram, alone):
    first, second = (Slice(diagram, food, velocity) for food, velocity in MOTIONS)
    for _ in range(LENGTH):
        first.advance(1)
        second.advance(1)
    same(first.result(), alone[0])
    same(second.result(), alone[1])


def test_factors_of_one_call_do_not_reach_contexts_that_share_its_solver(diagram, solvers, alone):
    start = start_pose(solvers[0].model, 1e-4)
    R = solvers[0].model.X_FC_rotation.T
    above = Pose(R @ start.R, solvers[0].model.to_cut_frame(start.p))
    below = above._replace(p=above.p - [0.0, 0.0, 4e-4])
    fresh = solvers[0].initial_state()

    def edge(factors: SurfaceFactors) -> float:
        return float(solvers[0].coupling_step(fresh, above, below, factors).wrenches[0, 0, 5])

    run = Slice(diagram, *MOTIONS[0])
    for _ in range(LENGTH):
        run.advance(1)
        tougher = edge(SurfaceFactors(toughness=3.0))
    same(run.result(), alone[0])
    assert tougher > 2.0 * edge(SurfaceFactors()) > 0.0
    energies = [solvers[0].energies(run.result()[1], below) for _ in range(2)]
    edge(SurfaceFactors(toughness=3.0))
    assert solvers[0].energies(run.result()[1], below) == energies[0] == energies[1]


def test_two_threads_do_not_disturb_each_other(diagram, alone):
    runs = [Slice(diagram, food, velocity) for food, velocity in MOTIONS]
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        results = list(pool.map(lambda run: run.advance(LENGTH).result(), runs))
    same(results[0], alone[0])
    same(results[1], alone[1])


def test_a_context_cloned_in_the_middle_of_a_cut_goes_on_identically(diagram, alone):
    half = LENGTH // 2
    original = Slice(diagram, *MOTIONS[1]).advance(half)
    copy = Slice.__new__(Slice)
    copy.diagram, copy.cutting = diagram, original.cutting
    with pytest.raises(CuttingError, match="in the middle of a cut"):
        Simulator(diagram, original.simulator.get_context().Clone()).Initialize()
    copy.simulator = Simulator(diagram, original.simulator.get_context().Clone())
    copy.simulator.Initialize(InitializeParams(suppress_initialization_events=True))
    copy.wrenches = list(original.wrenches)
    original.advance(LENGTH - half)
    same(copy.advance(LENGTH - half).result(), alone[1])
    same(original.result(), alone[1])


def test_foods_of_different_meshes_take_turns_in_one_context(diagram, solvers):
    assert solvers[0].state_size != solvers[1].state_size
    box = Slice(diagram, 1).advance(LENGTH).result()
    assert len(box[1]) == solvers[1].state_size
    assert np.abs(box[0][:, 5]).max() > 1.0
    own = build([CuttingSolver(solvers[1].model, PERIOD), solvers[0]])
    top_is_the_same = Slice(own, 0).advance(LENGTH).result()
    same(box, top_is_the_same)
    cylinder = Slice(diagram, 0).advance(LENGTH).result()
    again = Slice(diagram, 0)
    context = again.cutting.GetMyMutableContextFromRoot(again.simulator.get_mutable_context())
    again.cutting.SetFood(context, 1)
    again.cutting.SetFood(context, 0)
    same(again.advance(LENGTH).result(), cylinder)
    with pytest.raises(IndexError, match="food 2: 2 foods are prepared"):
        again.cutting.SetFood(context, 2)


def test_a_new_food_has_no_past():
    from sliceit_drake.diagrams.scenario import load_scenario
    from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
    from sliceit_drake.resources import resource_path

    small = "{food: {shape: !Cylinder {rings: 2, layers: [0.0, 0.004, 0.012]}}}"
    diagram = ScenarioDiagram(
        load_scenario(resource_path("scenarios/cucumber_measured.yaml"), small)
    )
    simulator = Simulator(diagram)
    diagram.SetStart(simulator.get_mutable_context())
    simulator.AdvanceTo(0.8)
    cutting = diagram.station.cutting
    context = cutting.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    names = ("balance", "cut_progress", "coupling_work_error", "force_components")
    assert all(cutting.GetOutputPort(name).Eval(context).any() for name in names)
    cutting.SetFood(context, 0)
    assert not any(cutting.GetOutputPort(name).Eval(context).any() for name in names)
    assert not cutting.wrench(context).any()


def test_randomization_draws_every_food_and_the_same_for_the_same_seed(diagram):
    system = diagram.GetSubsystemByName("cutting")
    context = system.CreateDefaultContext()

    def draw(seed: int) -> list[int]:
        rng, drawn = np.random.default_rng(seed), []
        for _ in range(20):
            system.randomize_context(context, rng)
            index = system.food_index(context)
            np.testing.assert_array_equal(
                system.food_state(context), system.solver(context).initial_state()
            )
            assert system.GetOutputPort("food_index").Eval(context)[0] == index
            drawn.append(index)
        return drawn

    assert set(draw(1)) == {0, 1}
    assert draw(1) == draw(1) != draw(2)


def test_a_discrete_system_sees_the_wrench_of_the_same_instant_and_it_is_held(diagram):
    run = Slice(diagram, 0)
    reader = diagram.GetSubsystemByName("reader")
    previous = 0.0
    for _ in range(60):
        run.advance(1)
        root = run.simulator.get_context()
        seen = reader.GetMyContextFromRoot(root).get_discrete_state(reader.seen).value()[0]
        now = run.wrenches[-1][5]
        assert seen == now
        time = root.get_time()
        assert time % PERIOD == pytest.approx(0.5 * PERIOD)
        run.simulator.AdvanceTo(time + 0.45 * PERIOD)
        assert run.cutting.wrench(run.context)[5] == now
        previous = max(previous, now)
    assert previous > 1.0


def test_applied_force_is_the_food_wrench_at_the_knifes_origin(diagram):
    run = Slice(diagram, 0, (0.04, 0.0, -0.08)).advance(LENGTH)
    wrench = run.cutting.GetOutputPort("food_wrench").Eval(run.context)
    applied = AppliedForce(KNIFE_BODY)
    context = applied.CreateDefaultContext()
    applied.get_input_port().FixValue(context, wrench.get_coeffs())
    (force,) = applied.get_output_port().Eval(context)
    assert force.body_index == KNIFE_BODY
    np.testing.assert_array_equal(force.p_BoBq_B, np.zeros(3))
    np.testing.assert_array_equal(force.F_Bq_W.get_coeffs(), wrench.get_coeffs())
    np.testing.assert_array_equal(wrench.get_coeffs(), run.wrenches[-1])
    assert abs(wrench.translational()[0]) > 0.1 and wrench.translational()[2] > 1.0


def test_force_turns_with_the_food(solvers):
    turn = RigidTransform(RollPitchYaw(0.0, 0.0, 0.7), [0.3, -0.2, 0.05])
    plain = build(solvers)
    here = Slice(plain, 0).advance(60)

    class Turned(KnifePath):
        def _pose(self, context, output):
            X = RigidTransform(DOWN, self._start + self._v(context) * context.get_time())
            output.set_value(turn @ X)

    top = max(start_pose(solver.model, 1e-3).p[2] for solver in solvers)
    builder = DiagramBuilder()
    path = builder.AddNamedSystem("path", Turned(np.array([0.0, 0.0, top])))
    cutting = builder.AddNamedSystem("cutting", CuttingSystem(solvers, turn))
    for name in ("knife_pose", "knife_velocity"):
        builder.Connect(path.GetOutputPort(name), cutting.GetInputPort(name))
    there = Slice(builder.Build(), 0).advance(60)
    R = turn.rotation().matrix()
    expected = np.concatenate([R @ here.wrenches[-1][:3], R @ here.wrenches[-1][3:]])
    scale = np.abs(expected).max()
    np.testing.assert_allclose(there.wrenches[-1], expected, atol=1e-3 * scale)


class Spring(KnifeForceSystem):
    """A food that pushes up in proportion to the depth below z = 1."""

    STIFFNESS = 1000.0

    def advance(self, context, state, X_WK):
        depth = max(0.0, 1.0 - X_WK.translation()[2])
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, self.STIFFNESS * depth]), depth


def test_coupling_work_error_is_what_the_delay_costs():
    spring = Spring(PERIOD)
    builder = DiagramBuilder()
    path = builder.AddNamedSystem("path", KnifePath(np.array([0.0, 0.0, 1.0])))
    builder.AddNamedSystem("cutting", spring)
    for name in ("knife_pose", "knife_velocity"):
        builder.Connect(path.GetOutputPort(name), spring.GetInputPort(name))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.1 + 0.5 * PERIOD)
    context = spring.GetMyContextFromRoot(simulator.get_context())
    # Each coupling step the held force is one step d = v T of depth too small, and the knife moves
    # -d: n coupling steps leave n k d^2 of work that the food did and the knife did not feel.
    step = 0.05 * PERIOD
    expected = 50 * Spring.STIFFNESS * step * step
    assert spring.GetOutputPort("coupling_work_error").Eval(context)[0] == pytest.approx(expected)
    assert spring.wrench(context)[5] == pytest.approx(Spring.STIFFNESS * 0.05 * 0.1)
    assert spring.GetOutputPort("cut_progress").Eval(context)[0] == pytest.approx(0.005)


class Torsion(KnifeForceSystem):
    """A food that turns a knife back about the vertical, in proportion to its angle."""

    STIFFNESS = 3.0

    def advance(self, context, state, X_WK):
        angle = np.arctan2(X_WK.rotation().matrix()[1, 0], X_WK.rotation().matrix()[0, 0])
        return np.array([0.0, 0.0, -self.STIFFNESS * angle, 0.0, 0.0, 0.0]), 0.0


def test_coupling_work_error_counts_the_work_of_moments_on_a_knife_that_turns():
    rate, torsion = 0.5, Torsion(PERIOD)

    class Turning(KnifePath):
        def _pose(self, context, output):
            turned = RotationMatrix.MakeZRotation(rate * context.get_time())
            output.set_value(RigidTransform(turned @ DOWN, self._start))

    builder = DiagramBuilder()
    path = builder.AddNamedSystem("path", Turning(np.zeros(3)))
    builder.AddNamedSystem("cutting", torsion)
    for name in ("knife_pose", "knife_velocity"):
        builder.Connect(path.GetOutputPort(name), torsion.GetInputPort(name))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.1 + 0.5 * PERIOD)
    context = torsion.GetMyContextFromRoot(simulator.get_context())
    expected = 50 * Torsion.STIFFNESS * (rate * PERIOD) ** 2
    error = torsion.GetOutputPort("coupling_work_error").Eval(context)[0]
    assert error == pytest.approx(expected, rel=1e-5)


def test_each_slice_of_a_sequence_is_judged_by_its_own_energies():
    food = Food(shape=Cylinder(diameter=0.016, rings=2, layers=[0.0, 0.004, 0.012]))
    model = make_food_model(food, Knife(), Numerics(step_by_need=False, time_step=5e-4))
    speed, down = 0.1, 0.018
    turns = np.cumsum([0.0, down, down, down]) / speed

    class TwiceThrough(KnifePath):
        def _pose(self, context, output):
            depth = speed * np.interp(context.get_time(), turns, [0.0, 1.0, 0.0, 1.0]) * turns[1]
            output.set_value(RigidTransform(DOWN, self._start - [0.0, 0.0, depth]))

    solvers = [CuttingSolver(model, PERIOD) for _ in range(2)]
    cutting = CuttingSystem(solvers, RigidTransform(), check_period=PERIOD, in_sequence=True)
    builder = DiagramBuilder()
    path = builder.AddNamedSystem("path", TwiceThrough(start_pose(model, 1.2e-3).p))
    builder.AddNamedSystem("cutting", cutting)
    for name in ("knife_pose", "knife_velocity"):
        builder.Connect(path.GetOutputPort(name), cutting.GetInputPort(name))
    run = Slice(builder.Build())
    energies, ledgers, slices = [], [], []
    for _ in range(round(turns[-1] / PERIOD)):
        run.advance(1)
        energies.append(cutting.GetOutputPort("energy").Eval(run.context))
        ledgers.append(cutting.GetOutputPort("balance").Eval(run.context))
        slices.append(cutting.food_index(run.context))
    energies, ledgers, second = np.array(energies), np.array(ledgers), np.array(slices) == 1
    ratio, least = energies[:, 3], energies[:, 4]
    passes = round(turns[1] / PERIOD)
    # Two equal slices: what the first dissipated is no energy of the second.
    assert ratio[passes] > 1e-5
    assert ratio[-1] == pytest.approx(ratio[passes], rel=0.05)
    assert (np.diff(ledgers[:, 2:4], axis=0) >= 0.0).all()
    assert ledgers[-1, 2] == pytest.approx(2.0 * ledgers[passes, 2], rel=0.02)
    # The smallest volume ratio of a slice only falls, and begins anew with the next.
    for rows in (~second, second):
        assert (np.diff(least[rows]) <= 0.0).all()
    assert least[second][0] > 0.999 and least[passes] < 0.98
    assert least[-1] == pytest.approx(least[passes], rel=1e-3)
