"""Live view of a run in a browser: how to find it, wait for it, change its speed, stop it."""

import getpass
import logging
import os
import sys
import time

from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator

__all__ = ["FASTEST", "LiveControls", "make_meshcat", "viewing_instructions", "wait_for_browser"]

SPEED = "speed"
STOP = "stop"
FASTEST = 2.0
"""Right end of the slider, in times real time: no limit."""


class LiveControls:
    """A slider for the speed of a run and a button that ends it, in Meshcat's control panel.

    They change when a step is computed, never its result. The slider's right end sets no limit.

    Args:
        meshcat: Viewer.
    """

    def __init__(self, meshcat: Meshcat) -> None:
        self._meshcat = meshcat
        meshcat.AddSlider(SPEED, min=0.1, max=FASTEST, step=0.1, value=1.0)
        meshcat.AddButton(STOP)

    def apply(self, simulator: Simulator) -> bool:
        """Sets the simulator's target rate by the slider; returns whether the run shall go on."""
        speed = self._meshcat.GetSliderValue(SPEED)
        rate = 0.0 if speed >= FASTEST else speed  # Drake: 0 is as fast as possible.
        if rate != simulator.get_target_realtime_rate():
            simulator.set_target_realtime_rate(rate)
            # Or else the new rate would count from the start of the run and be made up for.
            simulator.ResetStatistics()
        return self._meshcat.GetButtonClicks(STOP) == 0


def make_meshcat() -> Meshcat:
    """A viewer on the loopback interface; `viewing_instructions` says how to see it."""
    log = logging.getLogger("drake")
    level = log.level
    # Drake would say where every viewer listens, those too that only record a replay.
    log.setLevel(logging.WARNING)
    try:
        return Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    finally:
        log.setLevel(level)


def wait_for_browser(meshcat: Meshcat, timeout: float) -> bool:
    """Waits until a browser shows the viewer; returns whether one came within `timeout`, s."""
    end = time.monotonic() + timeout
    while meshcat.GetNumActiveConnections() == 0:
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def viewing_instructions(port: int) -> str:
    """How to see a viewer at a port of this machine, which may have no display."""
    url = f"http://localhost:{port}"
    tunnel = f"ssh -N -L {port}:localhost:{port}"
    connection = os.environ.get("SSH_CONNECTION", "").split()
    if len(connection) == 4:
        host, ssh_port = connection[2:]
        option = "" if ssh_port == "22" else f" -p {ssh_port}"
        return (
            f"You are here by ssh. Run this on the machine in front of you and leave it running:\n"
            f"    {tunnel}{option} {getpass.getuser()}@{host}\n"
            f"then open {url} there."
        )
    displays = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform == "linux" and not any(os.environ.get(name) for name in displays):
        return (
            f"This machine has no display. On one that has, run this and leave it running:\n"
            f"    {tunnel} USER@HOST    (HOST is this machine's name)\n"
            f"then open {url} there. Without ssh: leave out --meshcat and open replay.html."
        )
    return f"Open {url} in a browser."
