"""The networks of the agent: a temporal convolution over the readings, beside all the rest.

`export_network` writes a policy as a network that runs without the library that trained it.
"""

from pathlib import Path

import gymnasium
import onnx
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import Actor
from torch import nn

from sliceit_drake.systems.agent import AgentConfig
from sliceit_drake.systems.exported_network import LAYOUT, layout_of

__all__ = ["HistoryExtractor", "TemporalConvolution", "export_network", "export_policy"]

READING = 3


class TemporalConvolution(nn.Module):
    """Dilated causal convolutions over a short history, evaluated only where the last output needs.

    Bai, Kolter and Koltun, "An Empirical Evaluation of Generic Convolutional and Recurrent Networks
    for Sequence Modeling" (2018); one convolution a level and no residual path: smaller than
    theirs. Levels are added until the receptive field covers the history; the kernel is 3 at the
    first and 2 at the others, which do not overlap. What lies before the history counts as zero.

    Args:
        length: Readings in the history.
        channels: Numbers in a reading.
        width: Channels of each level.
        features: Numbers that come out.
    """

    def __init__(self, length: int, channels: int, width: int = 32, features: int = 64) -> None:
        super().__init__()
        kernels, spans = [min(3, length)], [min(3, length)]
        while spans[-1] < length:
            kernels.append(2)
            spans.append(2 * spans[-1])
        self.length, self.channels, self._kernels = length, channels, kernels
        self.padding = spans[-1] - length
        sizes = [channels] + [width] * len(kernels)
        self.levels = nn.ModuleList(
            nn.Linear(kernel * size, width) for kernel, size in zip(kernels, sizes, strict=False)
        )
        self.head = nn.Linear(width, features)

    def forward(self, history: torch.Tensor) -> torch.Tensor:
        """From [batch, length, channels], the newest last, to [batch, features]."""
        # Padding is exported as a slice that goes backwards, of which the exporter warns.
        before = history.new_zeros(history.shape[0], self.padding, self.channels)
        x = torch.cat([before, history], dim=1)
        for kernel, level in zip(self._kernels, self.levels, strict=True):
            # Every tap that the last output needs, and no other: kernels side by side.
            x = torch.relu(level(x.reshape(x.shape[0], x.shape[1] // kernel, -1)))
        return torch.relu(self.head(x[:, 0]))


class HistoryExtractor(BaseFeaturesExtractor):
    """A temporal convolution over the history and a fully connected layer over the rest, joined.

    Args:
        observation_space: The environment's.
        history: Readings at the end of an observation.
        features: Numbers that each of the two branches gives.
        blind: Whether the history is left out, and with it its branch.
    """

    def __init__(
        self,
        observation_space: gymnasium.spaces.Box,
        history: int,
        features: int = 64,
        blind: bool = False,
    ) -> None:
        super().__init__(observation_space, features * (1 if blind else 2))
        self.history, self.blind = history, blind
        self.rest = int(observation_space.shape[0]) - READING * history
        self.dense = nn.Sequential(nn.Linear(self.rest, features), nn.ReLU())
        if not blind:
            self.convolution = TemporalConvolution(history, READING, features=features)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """From [batch, observation] to [batch, features_dim]."""
        dense = self.dense(observations[:, : self.rest])
        if self.blind:
            return dense
        history = observations[:, self.rest :].reshape(-1, self.history, READING)
        return torch.cat([self.convolution(history), dense], dim=1)


def export_policy(actor: Actor, config: AgentConfig, file: Path) -> None:
    """Writes the actor's decisions, without its randomness; see `export_network`."""
    # The middle of the distribution.
    parts = (actor.features_extractor, actor.latent_pi, actor.mu, nn.Tanh())
    export_network(nn.Sequential(*parts), config, file)


def export_network(network: nn.Module, config: AgentConfig, file: Path) -> None:
    """Writes a policy of any algorithm as ONNX, for `AgentConfig.network`.

    Args:
        network: From observations [batch, n] to actions [batch, 6], which are cut off at -1 and 1.
        config: The agent's settings in training; the file keeps the layout of its observations.
        file: To write.
    """
    example = torch.zeros(1, config.observation_size())
    torch.onnx.export(
        network.eval(),
        (example,),
        str(file),
        input_names=["observation"],
        output_names=["action"],
        dynamo=False,
    )
    model = onnx.load(str(file))
    onnx.helper.set_model_props(model, {LAYOUT: layout_of(config)})
    onnx.save(model, str(file))
