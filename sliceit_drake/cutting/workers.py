"""Processes that work for a command, and end with it."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker
from typing import Any

__all__ = ["children_without_interrupts", "start_worker", "worker_processes"]


@contextmanager
def worker_processes(count: int, method: str = "spawn") -> Iterator[ProcessPoolExecutor]:
    """Processes that end with the context, started by "spawn" or "forkserver".

    What leaves the context by an error, Ctrl-C included, ends the tasks that run by a SystemExit
    and drops those that wait.
    """
    pool = _Pool(count, get_context(method), initializer=start_worker)
    try:
        yield pool
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()


@contextmanager
def children_without_interrupts() -> Iterator[None]:
    """Processes that are started in this context do not hear Ctrl-C, from their first moment on."""
    # Its start would end the blocking.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def start_worker() -> None:
    """Readies a process: Ctrl-C, which a terminal sends to all, is for the one that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _end)


class _Pool(ProcessPoolExecutor):
    """Drops the task, too, that a process holds in advance."""

    def submit(self, task: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        return super().submit(_unless_ended, task, *arguments, **named)


_ended = threading.Event()


def _end(*_: object) -> None:
    """Leaves a task by an exit, which cleans up; by the signal alone files stay half written."""
    _ended.set()
    sys.exit(1)


def _unless_ended(task: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    if _ended.is_set():
        sys.exit(1)
    return task(*arguments, **named)
