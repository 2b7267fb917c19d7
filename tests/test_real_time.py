"""What a run asks of the system, is told, and gives back."""

import ctypes
import errno
import os

import pytest

from sliceit_drake.hardware.real_time import CORES, PRIORITY, RealTime


class Libc:
    def __init__(self, allows):
        self.allows, self.calls = allows, []

    def mlockall(self, flags):
        self.calls.append(f"lock {flags}")
        ctypes.set_errno(errno.ENOMEM)
        return 0 if self.allows else -1

    def munlockall(self):
        self.calls.append("unlock")
        return 0


@pytest.fixture
def calls(monkeypatch):
    """The system of a computer that allows all; what is asked of it."""
    asked = []
    libc = Libc(allows=True)
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: libc)
    monkeypatch.setattr(os, "sched_getscheduler", lambda _: os.SCHED_OTHER)
    monkeypatch.setattr(os, "sched_getparam", lambda _: os.sched_param(0))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda _, kind, p: asked.append((kind, p.sched_priority))
    )
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: asked.append(set(cores)))
    return asked, libc


def test_it_asks_for_priority_memory_and_cores_and_gives_them_back(calls):
    asked, libc = calls
    with RealTime() as given:
        assert asked == [(os.SCHED_FIFO, PRIORITY), {2, 3}] and CORES == 2
        assert libc.calls == ["lock 3"]
        assert not any("NOT ALLOWED" in check.found for check in given.checks)
    assert asked[2:] == [{0, 1, 2, 3}, (os.SCHED_OTHER, 0)] and libc.calls[1:] == ["unlock"]


def test_what_the_system_refuses_is_said_and_does_not_stop_the_run(calls, monkeypatch):
    asked, libc = calls
    libc.allows = False

    def refuse(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with RealTime() as given:
        found = {check.name: check.found for check in given.checks}
        assert "NOT ALLOWED here (Operation not permitted)" in found["real-time priority"]
        assert "NOT ALLOWED here (Cannot allocate memory)" in found["memory lock"]
        assert all(check.passed for check in given.checks)
    assert asked == [{2, 3}, {0, 1, 2, 3}] and "unlock" not in libc.calls


def test_beside_an_emulator_nothing_is_asked_for(calls):
    with RealTime(asks=False) as given:
        assert [str(check) for check in given.checks] == [
            "[ok] real time: not asked for beside an emulator"
        ]
    assert calls[0] == [] and calls[1].calls == []
