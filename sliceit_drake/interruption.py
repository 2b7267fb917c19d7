"""Signals that end a program, or tell it to end."""

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

__all__ = ["catch_signals", "handle_signals", "raise_if_interrupted"]

_asked = threading.Event()


@contextmanager
def handle_signals(
    numbers: Iterable[signal.Signals], handler: Callable[..., object]
) -> Iterator[None]:
    """Handles signals in a context.

    They belong to the process: in another thread than the main one this changes nothing.
    """
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, handler) for number in numbers} if is_main else {}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def catch_signals() -> Iterator[None]:
    """Lets Ctrl-C, a closed terminal and SIGTERM interrupt a program that moves a robot.

    An exception alone is not enough: Python drops one that is raised within a destructor or a
    callback, and the robot would go on. What moves a robot therefore also asks
    `raise_if_interrupted`, in each of its cycles.
    """
    _asked.clear()
    try:
        with handle_signals((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), _interrupt):
            yield
    finally:
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
