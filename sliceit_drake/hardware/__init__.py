"""A real UR5e: limits, safety layer, checks, the link through RTDE and the system that reads it."""

from typing import TYPE_CHECKING

from sliceit_drake.lazy_names import lazy_names

if TYPE_CHECKING:
    from sliceit_drake.hardware.hardware_config import load_hardware_config as load_hardware_config
    from sliceit_drake.hardware.ur_client import UrClient as UrClient
else:
    __getattr__, __dir__ = lazy_names(__name__)
