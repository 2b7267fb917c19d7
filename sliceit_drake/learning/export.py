"""Writes an actor as a network that runs without the library that trained it."""

from pathlib import Path

import onnx
import torch
from stable_baselines3.sac.policies import Actor
from torch import nn

from sliceit_drake.systems.agent import AgentConfig
from sliceit_drake.systems.exported_network import LAYOUT, layout_of

__all__ = ["export_policy"]


def export_policy(actor: Actor, config: AgentConfig, file: Path) -> None:
    """Writes the actor's decisions, without its randomness, as ONNX with the layout it needs.

    Args:
        actor: Actor of a Stable-Baselines3 SAC.
        config: The agent's configuration.
        file: File to write.
    """
    # The middle of the distribution.
    parts = (actor.features_extractor, actor.latent_pi, actor.mu, nn.Tanh())
    network = nn.Sequential(*parts).eval()
    example = torch.zeros(1, config.observation_size())
    torch.onnx.export(
        network,
        (example,),
        str(file),
        input_names=["observation"],
        output_names=["action"],
        dynamo=False,
    )
    model = onnx.load(str(file))
    onnx.helper.set_model_props(model, {LAYOUT: layout_of(config)})
    onnx.save(model, str(file))
