"""Signals that end a program which moves a robot.

An exception alone is not enough: Python drops one that is raised within a destructor or a callback,
and the robot would go on. What moves a robot therefore also asks here, in each of its cycles.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["catch_signals", "raise_if_interrupted"]

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_asked = threading.Event()


@contextmanager
def catch_signals() -> Iterator[None]:
    """Lets Ctrl-C, a closed terminal and SIGTERM interrupt what is inside.

    Each raises a KeyboardInterrupt, which `raise_if_interrupted` repeats. Signals belong to the
    process: in another thread than the main one this changes nothing.
    """
    _asked.clear()
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, _interrupt) for number in SIGNALS} if is_main else {}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _asked.clear()


def raise_if_interrupted() -> None:
    """Ends a motion that was interrupted; called in each of its cycles.

    Raises:
        KeyboardInterrupt: A signal came since `catch_signals`.
    """
    if _asked.is_set():
        raise KeyboardInterrupt


def _interrupt(*_: object) -> None:
    _asked.set()
    raise KeyboardInterrupt
