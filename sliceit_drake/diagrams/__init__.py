"""Stations as diagrams: scenario, port contract, simulated and hardware station, and their runs."""

from typing import TYPE_CHECKING

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    from sliceit_drake.diagrams import live_view as live_view
    from sliceit_drake.diagrams import ports as ports
    from sliceit_drake.diagrams.outputs.run_log import add_recorder as add_recorder
    from sliceit_drake.diagrams.randomize import randomize as randomize
    from sliceit_drake.diagrams.sweep import Sweep as Sweep
else:
    __getattr__, __dir__ = lazy_names(__name__)
