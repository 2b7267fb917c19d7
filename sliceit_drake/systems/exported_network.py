"""An exported network that decides: ONNX, run by ONNX Runtime, without what trained it."""

import dataclasses as dc
import json

import numpy as np

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.resources import file_or_resource
from sliceit_drake.systems.agent import ACTIONS, AgentConfig, Decide, observation_names

__all__ = ["LAYOUT", "layout_of", "load_network"]

LAYOUT = "sliceit_layout"
"""Key of the file's metadata under which the layout of observation and action stands."""


# What does not change the meaning of an observation or an action.
FREE = (
    *("network", "descent", "duration", "history", "lift_speed"),
    *("goal", "goal_decisions", "goal_lost"),
)


def layout_of(config: AgentConfig) -> str:
    """What an agent's network takes and gives, and what its actions do, as text for its file."""
    meaning = {k: v for k, v in dc.asdict(config).items() if k not in FREE and v is not None}
    layout = {"observation": observation_names(config.history), "action": list(ACTIONS)}
    return json.dumps(layout | meaning)


def load_network(config: AgentConfig) -> Decide:
    """The network of an agent's configuration.

    Returns:
        A function from an observation to the action [6], float64; nothing but zeros where there is
        a rule and no network.

    Raises:
        ConfigurationError: There is no such file, it is no network, or it was trained on another
            observation.
    """
    if config.rule is not None and not config.network:
        return lambda _: np.zeros(len(ACTIONS))
    import onnxruntime

    def refusal(
        problem: str, fix: str = "Give the policy.onnx of a training."
    ) -> ConfigurationError:
        return ConfigurationError(problem, field="scenario.policy.network", fix=fix)

    file = file_or_resource(config.network)
    if file is None:
        raise refusal(f"there is no file {config.network!r}, neither here nor in the package")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(
            str(file), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # ONNX Runtime's errors have no common class.
        raise refusal(f"{file} is no network that can be run ({error})") from error
    found = session.get_modelmeta().custom_metadata_map.get(LAYOUT)
    if found != layout_of(config):
        raise refusal(
            f"{file} {_difference(found, layout_of(config))}",
            "Give the agent the values of the training's training.yaml.",
        )
    name = session.get_inputs()[0].name

    def decide(observation: np.ndarray) -> np.ndarray:
        given = {name: np.asarray(observation, np.float32)[None]}
        return np.asarray(session.run(None, given)[0], float).reshape(len(ACTIONS))

    try:
        decide(np.zeros(config.observation_size()))
    except Exception as error:
        raise refusal(f"{file} is a network, but none that decides ({error})") from error
    return decide


def _difference(found: str | None, wanted: str) -> str:
    if found is None:
        return "does not say what it observes"
    ours = json.loads(wanted)
    try:
        theirs = dict(json.loads(found))
    except (TypeError, ValueError):
        return "says what it observes in a way that cannot be read"
    for key in ours | theirs:
        if ours.get(key) != theirs.get(key):
            if key == "observation":
                sizes = len(theirs.get(key, [])), len(ours[key])
                return f"observes {sizes[0]} numbers, the scenario's agent {sizes[1]}"
            return f"has {key} {theirs.get(key)}, the scenario's agent {ours.get(key)}"
    return "has another layout than the scenario's agent"
