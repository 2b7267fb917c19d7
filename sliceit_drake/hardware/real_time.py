"""What the system may give a run so that its cycles come in time: priority, memory, one core."""

import contextlib
import ctypes
import os
from collections.abc import Callable

from sliceit_drake.hardware.checks import Check

__all__ = ["RealTime"]

PRIORITY = 20
"""Of SCHED_FIFO: over all usual work, below the kernel's own threads."""
CORES = 2
"""Cores that a run keeps to: the diagram's thread and the link's."""
_LOCK_ALL = 0b11  # Of mlockall: what is there, and what comes.


class RealTime(contextlib.AbstractContextManager["RealTime"]):
    """Asks for all of it, and gives it back; a context manager.

    Threads that begin inside have it too. What is refused is said in `checks`, and the run goes on
    without it: the limits of age stop the robot where cycles come late.

    Args:
        asks: False to ask for nothing, as for an emulator on the same computer.

    Attributes:
        checks: A line for each, that always passes.
    """

    def __init__(self, asks: bool = True) -> None:
        self.checks: list[Check] = []
        self._undo = contextlib.ExitStack()
        if not asks:
            self.checks.append(Check("real time", True, "not asked for beside an emulator"))
            return
        self._ask("real-time priority", f"SCHED_FIFO {PRIORITY}", self._take_priority)
        self._ask("memory lock", "all pages stay in memory", self._lock_memory)
        self._ask("cores", f"kept to {CORES} of {os.cpu_count()}", self._keep_to_cores)

    def _ask(self, name: str, given: str, ask: Callable[[], None]) -> None:
        try:
            ask()
            found = given
        except OSError as error:
            found = f"NOT ALLOWED here ({error.strerror}): cycles may come late beside other work"
        self.checks.append(Check(name, True, found))

    def _take_priority(self) -> None:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        self._undo.callback(os.sched_setscheduler, 0, *before)

    def _lock_memory(self) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_LOCK_ALL) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        self._undo.callback(libc.munlockall)

    def _keep_to_cores(self) -> None:
        before = os.sched_getaffinity(0)
        # The last ones: interrupts come to the first.
        os.sched_setaffinity(0, sorted(before)[-CORES:])
        self._undo.callback(os.sched_setaffinity, 0, before)

    def __exit__(self, *_: object) -> None:
        self._undo.close()
