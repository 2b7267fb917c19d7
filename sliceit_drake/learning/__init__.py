"""Learning to slice; importing it registers the environment `sliceit_drake/Slicing-v0`."""

from typing import TYPE_CHECKING

import gymnasium

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    from sliceit_drake.learning.evaluation import cut_slice as cut_slice
    from sliceit_drake.learning.task import TaskConfig as TaskConfig
    from sliceit_drake.learning.task import station_scenario as station_scenario
    from sliceit_drake.learning.training_config import TrainingConfig as TrainingConfig
    from sliceit_drake.systems.exported_network import load_network as load_network
else:
    __getattr__, __dir__ = lazy_names(__name__)

gymnasium.register(
    id="sliceit_drake/Slicing-v0", entry_point="sliceit_drake.learning.environment:SlicingEnv"
)
