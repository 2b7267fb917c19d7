"""Learning to slice.

Where Gymnasium is installed, importing this package registers the environment
`sliceit_drake/Slicing-v0` and one for each calibrated food, such as
`sliceit_drake/SlicingCucumber-v0`; `gymnasium.make("sliceit_drake.learning:ID")` imports it.
"""

from importlib.util import find_spec
from typing import TYPE_CHECKING

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    from sliceit_drake.learning.evaluation import cut_slice as cut_slice
    from sliceit_drake.learning.task import TaskConfig as TaskConfig
    from sliceit_drake.learning.task import station_scenario as station_scenario
    from sliceit_drake.learning.training_config import TrainingConfig as TrainingConfig
    from sliceit_drake.systems.exported_network import load_network as load_network
else:
    __getattr__, __dir__ = lazy_names(__name__)

# Policies are run and evaluated without it.
if find_spec("gymnasium") is not None:
    import gymnasium

    for _food in ("", "apple", "carrot", "cucumber", "potato", "tomato"):
        gymnasium.register(
            f"sliceit_drake/Slicing{_food.title()}-v0",
            "sliceit_drake.learning.environment:SlicingEnv",
            kwargs={"food": _food} if _food else {},
        )
