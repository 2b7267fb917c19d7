"""The hardware station's scenario and configuration for tests on a fake robot."""

from sliceit_drake.diagrams.scenario import load_scenario
from sliceit_drake.hardware.hardware_config import SafetyLimits
from sliceit_drake.resources import resource_path

PACE = 0.15
# A machine that other tests keep busy may be late: these runs are about what is done, not when.
PATIENT = SafetyLimits(state_age=0.1, command_age=0.1, joint_step=0.1)
CONFIG = dict(payload=1.2, payload_cog=[0.0, 0.0, 0.06], board_height=0.05, limits=PATIENT)


def spring_scenario():
    return load_scenario(resource_path("scenarios/cucumber_spring.yaml"))
