"""Learning to slice; importing it registers the environment `sliceit_drake/Slicing-v0`."""

import gymnasium

__all__: list[str] = []

gymnasium.register(
    id="sliceit_drake/Slicing-v0", entry_point="sliceit_drake.learning.environment:SlicingEnv"
)
