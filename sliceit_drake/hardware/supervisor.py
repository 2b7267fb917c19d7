"""A process beside a run that stops the robot if the run's process dies, and says so.

ur_rtde can end a process in the middle of a motion, by an abort or a segmentation fault; then no
line of Python runs there any more. It can also wait for ever, with Python's lock held: `limit` ends
the run's process then. This process only reads a pipe from it. If the pipe ends without the word
that the robot's program is stopped, or nothing comes for a while, it stops that program through the
dashboard server.
"""

import contextlib
import faulthandler
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

from sliceit_drake.hardware.client import RobotUnavailableError
from sliceit_drake.interruption import uninterrupted

__all__ = ["Supervisor", "stop_by_dashboard"]

DASHBOARD_PORT = 29999
PATIENCE = 15.0
"""How long a controller is asked that does not answer, s."""
CALL_TIME = 10.0
"""How long a call of the robot's library may take, s."""
SILENCE = 1.5 * CALL_TIME
"""How long a process that controls a robot may show no life, s."""
BEAT = 0.5
"""Time between two signs of its life, s."""
_CONTROL, _ALIVE, _DONE, _UNSURE = b"control\n", b".", b"done\n", b"unsure\n"
_UNSURE_TEXT = (
    "\nTHE ROBOT HAS NOT CONFIRMED THAT ITS PROGRAM IS STOPPED. Stay away: its dashboard is asked "
    f"for up to {PATIENCE:g} s."
)


class Supervisor(contextlib.AbstractContextManager["Supervisor"]):
    """Watches over this process from another; a context manager.

    Args:
        host: Address of the robot.
    """

    def __init__(self, host: str) -> None:
        # In a session of its own, so that Ctrl-C and a closed terminal do not reach it.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sliceit_drake.hardware.supervisor", host],
            stdin=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        self._is_over = threading.Event()
        self._is_stopped = True
        self._beats = threading.Thread(target=self._live, daemon=True)

    def begin(self) -> None:
        """Says that this process takes control of the robot: its end or silence stops the robot."""
        self._is_stopped = False
        self._say(_CONTROL)
        self._beats.start()

    def confirm(self) -> None:
        """Says that the robot's program is known to be stopped: only then all is done."""
        self._is_stopped = True

    def _live(self) -> None:
        while not self._is_over.wait(BEAT):
            self._say(_ALIVE)

    @contextlib.contextmanager
    def limit(self) -> Iterator[None]:
        """Ends this process at once if what is done inside takes longer than `CALL_TIME`.

        One at a time in a process; for calls that nothing else watches.
        """
        # Its timer needs no lock of Python. A terminal that stands must not keep it from the end.
        with open(os.devnull, "w", encoding="utf-8") as nowhere:
            faulthandler.dump_traceback_later(CALL_TIME, exit=True, file=nowhere)
            try:
                yield
            finally:
                faulthandler.cancel_dump_traceback_later()

    def _say(self, word: bytes) -> None:
        assert self._process.stdin is not None
        # If it was ended the run goes on as without it: the robot's watchdog is still there.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(word)
            self._process.stdin.flush()

    def __exit__(self, *_: object) -> None:
        """Ends it; a robot that has not confirmed its stop is stopped by the other process first.

        Raises:
            RobotUnavailableError: It has not confirmed that one either.
        """
        with uninterrupted():
            self._end()

    def _end(self) -> None:
        self._is_over.set()
        if self._beats.ident is not None:
            self._beats.join()
        self._say(_DONE if self._is_stopped else _UNSURE)
        if not self._is_stopped:
            # The other process is at work already: a terminal that stands delays nothing.
            with contextlib.suppress(OSError):
                print(_UNSURE_TEXT, file=sys.stderr, flush=True)
        self._process.communicate()
        if not self._is_stopped and self._process.returncode != 0:
            raise RobotUnavailableError(
                "The robot did not confirm that its program is stopped. Use the emergency stop "
                "before you go near it; then find out why it does not answer."
            )


def stop_by_dashboard(host: str) -> str | None:
    """Stops the robot's program through its dashboard server, as often as it has to be asked.

    Returns:
        Why it is not known to be stopped, or None.
    """
    problem, end = "", time.monotonic() + PATIENCE
    while time.monotonic() < end:
        try:
            with socket.create_connection((host, DASHBOARD_PORT), 2.0) as connection:
                lines = connection.makefile("rwb")
                lines.readline()
                answers = []
                for question in (b"stop\n", b"running\n", b"programState\n"):
                    lines.write(question)
                    lines.flush()
                    answers.append(lines.readline().decode("utf-8", "replace").strip())
                # One that is paused does not run, but goes on when somebody resumes it.
                if answers[1].lower() == "program running: false":
                    if answers[2].startswith("STOPPED"):
                        return None
                problem = ", ".join(answers[1:])
        except OSError as error:
            problem = str(error)
        time.sleep(0.1)
    return problem or "it does not answer"


def _watch(host: str) -> int:
    """Waits for the end, or the silence, of the process that has the other end of standard
    input; returns an exit code."""
    said, what = b"", "HAS CRASHED"
    pipe = sys.stdin.fileno()
    while True:
        patience = SILENCE if said.startswith(_CONTROL) else None
        if not select.select([pipe], [], [], patience)[0]:
            what = f"HAS SHOWN NO LIFE FOR {SILENCE:g} S"
            break
        new = os.read(pipe, 4096)
        if not new:
            break
        said = (said + new).replace(_ALIVE, b"")
    if not said.startswith(_CONTROL) or said.endswith(_DONE):
        return 0
    if said.endswith(_UNSURE):
        what = "ENDS WITHOUT A CONFIRMED STOP OF THE ROBOT"
    problem = stop_by_dashboard(host)
    text = f"THE PROGRAM THAT DROVE THE ROBOT {what}. "
    if problem is None:
        text += "The robot's program was stopped through its dashboard. Find the cause first."
    else:
        text += (
            f"THE ROBOT DID NOT CONFIRM THAT ITS PROGRAM IS STOPPED ({problem}). Use the "
            "emergency stop before you go near it."
        )
    print(f"\n{text}", file=sys.stderr, flush=True)
    return 0 if problem is None else 1


if __name__ == "__main__":
    sys.exit(_watch(sys.argv[1]))
