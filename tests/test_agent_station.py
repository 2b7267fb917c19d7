"""The SliceIt! agent on a station: a scenario names its network, and starts differ by the seed."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.randomize import randomize
from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.diagrams.scenario_diagram import ScenarioDiagram
from sliceit_drake.learning.task import RandomizationConfig, TaskConfig, make_agent_station
from sliceit_drake.systems.agent import AgentConfig, AgentSystem
from sliceit_drake.systems.agent_rule import AgentRule
from sliceit_drake.systems.exported_network import LAYOUT, layout_of

SCENARIO = """
controller:
  mode: {mode}
  error_scale: 0.2
  stiffness: [5500.0, 2000.0, 2000.0, 80.0, 120.0, 80.0]
  p_gains: [0.2, 0.2, 0.06, 2.0, 1.6, 2.0]
  selection: [1.0, 1.0, 0.5, 1.0, 0.5, 1.0]
food: !SpringFood {{height: 0.027}}
start: {{clearance: 0.010}}
policy: !AgentConfig {{network: "{network}", descent: {descent}, history: 3}}
"""


def scenario_of(folder, network, mode="parallel", descent=0.037):
    file = folder / "scenario.yaml"
    file.write_text(SCENARIO.format(network=network, mode=mode, descent=descent))
    return load_scenario(file)


def write_network(file, weights, bias, layout):
    """The network tanh(weights observation + bias), as ONNX."""
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    outputs, inputs = weights.shape
    graph = helper.make_graph(
        [
            helper.make_node("Gemm", ["observation", "w", "b"], ["linear"]),
            helper.make_node("Tanh", ["linear"], ["action"]),
        ],
        "policy",
        [helper.make_tensor_value_info("observation", kind, [1, inputs])],
        [helper.make_tensor_value_info("action", kind, [1, outputs])],
        [
            onnx.numpy_helper.from_array(weights.T.astype(np.float32).copy(), "w"),
            onnx.numpy_helper.from_array(bias.astype(np.float32), "b"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    if layout is not None:
        helper.set_model_props(model, {LAYOUT: layout})
    onnx.save(model, str(file))
    return file


def network_of(file, bias=(0.0,) * 6, weights=None, layout=None, config=None):
    config = config or AgentConfig(history=3)
    weights = np.zeros((6, config.observation_size())) if weights is None else weights
    return write_network(file, weights, np.array(bias), layout or layout_of(config))


def test_a_scenario_with_a_network_runs_as_its_network_decides(tmp_path):
    rng = np.random.default_rng(2)
    weights = 0.3 * rng.normal(size=(6, 28))
    weights[5] = 0.0  # It always presses.
    bias = np.array([0.2, -0.4, 0.1, 0.3, 0.0, 9.0])
    network = network_of(tmp_path / "policy.onnx", bias, weights)
    diagram = ScenarioDiagram(scenario_of(tmp_path, network))
    assert isinstance(diagram.policy, AgentSystem)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    diagram.SetStart(context)
    simulator.Initialize()
    own = diagram.policy.GetMyContextFromRoot(context)
    action = np.tanh(weights @ diagram.policy.observe(own) + bias)
    simulator.AdvanceTo(0.04)
    share = 0.5 * (action[:4] + 1.0)
    stiffness = diagram.policy.GetOutputPort("stiffness").Eval(own)
    gains = diagram.policy.GetOutputPort("p_gains").Eval(own)
    assert stiffness[[0, 4]] == pytest.approx([1000, 40] + share[:2] * [9000, 160], rel=1e-5)
    assert gains[[2, 4]] == pytest.approx([0.02, 0.2] + share[2:] * [0.08, 2.8], rel=1e-5)
    assert stiffness[[1, 2, 3, 5]] == pytest.approx([2000.0, 2000.0, 80.0, 80.0])
    height = diagram.policy.GetOutputPort("error").Eval(own)[1]
    simulator.AdvanceTo(0.5)
    assert diagram.policy.GetOutputPort("error").Eval(own)[1] < height - 2e-3


def test_a_rule_needs_no_network(tmp_path):
    scenario = scenario_of(tmp_path, "")
    scenario.policy.rule = AgentRule(12.0)
    diagram = ScenarioDiagram(scenario)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    diagram.SetStart(context)
    simulator.Initialize()
    own = diagram.policy.GetMyContextFromRoot(context)
    height = diagram.policy.GetOutputPort("error").Eval(own)[1]
    simulator.AdvanceTo(0.5)
    assert diagram.policy.GetOutputPort("error").Eval(own)[1] < height - 2e-3
    assert "a rule that keeps to 12 N decides" in scenario.policy.describe()


def test_a_network_that_corrected_another_rule_is_refused(tmp_path):
    theirs = AgentConfig(history=3, rule=AgentRule(12.0))
    scenario = scenario_of(tmp_path, network_of(tmp_path / "policy.onnx", config=theirs))
    with pytest.raises(
        ConfigurationError, match=r"has rule \{'level': 12.0.*the scenario's agent No"
    ):
        ScenarioDiagram(scenario)
    scenario.policy.rule = AgentRule(12.0)
    ScenarioDiagram(scenario)
    scenario.policy.rule = AgentRule(14.0)
    with pytest.raises(ConfigurationError, match="'level': 14.0"):
        ScenarioDiagram(scenario)


def test_a_network_of_another_observation_is_refused(tmp_path):
    network = network_of(tmp_path / "policy.onnx", config=AgentConfig(history=12))
    with pytest.raises(ConfigurationError, match="observes 55 numbers.* 28") as caught:
        ScenarioDiagram(scenario_of(tmp_path, network))
    assert caught.value.field == "scenario.policy.network"
    assert "training.yaml" in caught.value.fix


def test_a_network_of_another_pace_is_refused(tmp_path):
    slow = AgentConfig(history=3, period=0.1)
    network = network_of(tmp_path / "policy.onnx", config=slow)
    with pytest.raises(ConfigurationError, match="has period 0.1, the scenario's agent 0.05"):
        ScenarioDiagram(scenario_of(tmp_path, network))


def test_a_network_whose_actions_meant_something_else_is_refused(tmp_path):
    theirs = AgentConfig(history=3, mapping="upper")
    network = network_of(tmp_path / "policy.onnx", config=theirs)
    with pytest.raises(ConfigurationError, match="has mapping upper, the scenario's agent whole"):
        ScenarioDiagram(scenario_of(tmp_path, network))


@pytest.mark.parametrize(
    ("layout", "problem"), [(None, "does not say what"), ("[1", "cannot be read")]
)
def test_a_network_without_a_layout_is_refused(tmp_path, layout, problem):
    file = write_network(tmp_path / "policy.onnx", np.zeros((6, 28)), np.zeros(6), layout)
    with pytest.raises(ConfigurationError, match=problem) as caught:
        ScenarioDiagram(scenario_of(tmp_path, file))
    assert caught.value.field == "scenario.policy.network"


@pytest.mark.parametrize("shape", [(6, 27), (5, 28)])
def test_a_network_that_says_another_layout_than_it_has_is_refused(tmp_path, shape):
    network = network_of(tmp_path / "policy.onnx", np.zeros(shape[0]), np.zeros(shape))
    with pytest.raises(ConfigurationError, match="none that decides"):
        ScenarioDiagram(scenario_of(tmp_path, network))


@pytest.mark.parametrize(
    ("name", "problem"),
    [("", "no file"), ("absent.onnx", "no file"), ("scenario.yaml", "no network")],
)
def test_what_is_no_network_is_refused(tmp_path, monkeypatch, name, problem):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigurationError, match=problem) as caught:
        ScenarioDiagram(scenario_of(tmp_path, name))
    assert caught.value.field == "scenario.policy.network"
    assert "policy.onnx" in caught.value.fix


def test_an_agent_needs_parallel_control(tmp_path):
    network = network_of(tmp_path / "policy.onnx")
    with pytest.raises(ConfigurationError, match="'motion'.*parallel") as caught:
        ScenarioDiagram(scenario_of(tmp_path, network, mode="motion"))
    assert caught.value.field == "scenario.controller.mode"


def test_an_agent_starts_as_high_as_it_says(tmp_path):
    network = network_of(tmp_path / "policy.onnx")
    with pytest.raises(ConfigurationError, match=r"0\.0500 m; the start is 0\.0370 m") as caught:
        ScenarioDiagram(scenario_of(tmp_path, network, descent=0.05))
    assert caught.value.field == "scenario.policy.descent"
    assert "0.0370" in caught.value.fix


def random_numbers(context):
    """All numbers of a context."""
    numbers = [
        context.get_discrete_state(k).value() for k in range(context.num_discrete_state_groups())
    ]
    count = context.num_numeric_parameter_groups()
    numbers += [context.get_numeric_parameter(k).value() for k in range(count)]
    return np.concatenate(numbers)


@pytest.mark.parametrize("simulator", ["spring", "cutting"])
def test_randomize_is_made_by_the_seed_and_by_nothing_before(simulator):
    task = TaskConfig(
        simulator=simulator,
        foods=["cucumber"],
        refinement=0.5,
        randomization=RandomizationConfig(variants=6 if simulator == "cutting" else 1, stations=1),
    )
    diagram = make_agent_station(task, "cucumber", np.random.default_rng(0))
    context = diagram.CreateDefaultContext()

    def drawn(seed):
        randomize(diagram, context, np.random.default_rng(seed))
        return random_numbers(context)

    first, others = drawn(3), [drawn(seed) for seed in range(4, 9)]
    assert np.array_equal(first, drawn(3), equal_nan=True)
    assert all(not np.array_equal(first, other, equal_nan=True) for other in others)
    cutting = diagram.station.cutting
    food = cutting.GetMyContextFromRoot(context)

    def kind(seed):
        drawn(seed)
        return cutting.food_index(food) if simulator == "cutting" else cutting.spring(food)

    assert len({kind(seed) for seed in range(12)}) > 2
