"""Signals that end a program, or tell it to end."""

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

__all__ = [
    "ENDING",
    "catch_signals",
    "handle_signals",
    "interrupt_main_thread",
    "interrupted_once",
    "raise_if_interrupted",
    "uninterrupted",
]

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What asks a program to end: Ctrl-C, who ends a process, and a terminal that is closed."""
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
        with handle_signals(ENDING, _interrupt):
            yield
    finally:
        _asked.clear()


@contextmanager
def interrupted_once() -> Iterator[None]:
    """Lets only the first signal interrupt what moves a robot, within `catch_signals`.

    What follows the first, stopping the robot and keeping its record, is not left half done for a
    user who presses Ctrl-C again, or a terminal that sends two signals when it is closed.
    """

    def interrupt(*_: object) -> None:
        if not _asked.is_set():
            _interrupt()

    with handle_signals(ENDING, interrupt):
        yield


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Lets no signal keep a robot from being stopped; it is noted, see `raise_if_interrupted`.

    For what ends by itself within seconds.
    """
    with handle_signals(ENDING, lambda *_: _asked.set()):
        yield


def interrupt_main_thread() -> None:
    """Sends Ctrl-C from another thread to the main one.

    A signal to the whole process may come to any thread, and not end what the main one waits for.
    """
    main = threading.main_thread().ident
    assert main is not None
    signal.pthread_kill(main, signal.SIGINT)


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
