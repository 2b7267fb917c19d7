"""The robot's own thread: reads each cycle of the controller, judges, and sends.

The diagram and this thread exchange only their newest values: neither waits for the other.
"""

import csv
import math
import threading
import time as clock
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from sliceit_drake.hardware.client import RobotClient, RobotState, RobotUnavailableError
from sliceit_drake.hardware.safety import SafetyLayer, Stop
from sliceit_drake.interruption import uninterrupted

__all__ = ["LinkStatus", "RobotLink"]

POLL = 1e-4
"""Pause between two looks for new data, s."""
SLOW_CALL = 0.05
"""A call that sends a target and takes longer has reconnected or stands, controller s."""
FIRST_DATA = 3.0
"""How long a robot that is connected may be silent, s."""
STOP_TIME = 2.0
"""How long a stop at the end may take, s."""
HALT_TIME = 3.0
"""How long the robot may take to end its program, s."""
LATENESS = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""Bounds of the histogram of lateness, s."""
HOLD_TIME = 1.0
"""How long a latched arm is held at rest for who does not `finish`, controller s."""
SLOWEST = 0.2
"""Pace below which no more wall time is given for that."""


class _Command(NamedTuple):
    number: int
    q: list[float]
    time: float


class _Task(NamedTuple):
    """Wait of the diagram: its name, since when (controller time, s), and how long it may last."""

    limit: str
    begin: float
    allowed: float


class LinkStatus(NamedTuple):
    """The newest state of the link.

    Attributes:
        state: State of the controller.
        arrival: Wall time at which it was seen, s (`time.perf_counter`).
        period: Controller time since the state before, s.
        lateness: Wall time since the state before, less the period at the link's pace, s.
        cycles: States seen.
        missed: Cycles of the controller of which no state was seen.
        sent: Targets sent.
        stop: Why the safety layer is latched, or None.
    """

    state: RobotState
    arrival: float
    period: float
    lateness: float
    cycles: int
    missed: int
    sent: int
    stop: Stop | None


class RobotLink:
    """Owns a robot client and a safety layer during a run.

    The thread watches from `start` on; from `arm` on it sends. It latches by itself when the
    controller's clock stands, jumps or goes back, when the robot's program does not play, when a
    safety bit is set, when a connection is lost even for a moment, and when a call that sends is
    refused, fails or takes long: traces of a link that came back, and of a program that was
    uploaded anew. After such a fault nothing is sent again.

    A breach of a limit is held at rest for `HOLD_TIME` at most. If nobody has called `finish` by
    then, as after a policy that never returns, the thread stops the robot's program itself.

    Args:
        client: Connected.
        safety: Not armed yet.
        watchdog: Least rate of inputs that the controller shall demand, Hz; set before the first
            target.
        pace: Controller seconds in a second; 1 for all robots, less for an emulated one.

    Attributes:
        stop_error: What the client said when it could not stop the robot's program, or None.
        abandoned: Called with the stop, from the thread, if a hold ends that way.
    """

    def __init__(
        self, client: RobotClient, safety: SafetyLayer, watchdog: float = 50.0, pace: float = 1.0
    ) -> None:
        self._client, self._safety = client, safety
        self._watchdog, self._pace = watchdog, pace
        self._command: _Command | None = None
        self._judged = 0
        self._served: RobotState | None = None  # In whose cycle the last target went out.
        self._armed = self._ending = False
        self._task: _Task | None = None
        # What came and went out in each cycle: state, lateness, target.
        self._log: list[tuple[RobotState, float, list[float] | None]] = []
        self._status: LinkStatus | None = None
        self._changed = threading.Condition()
        self._halted = False
        self._halt_thread: threading.Thread | None = None
        self.stop_error: str | None = None
        self.abandoned: Callable[[Stop], None] | None = None
        self._held_since = math.inf
        self._thread = threading.Thread(target=self._guarded, name="robot link", daemon=True)

    def start(self) -> LinkStatus:
        """Begins to watch, without sending anything.

        Raises:
            RobotUnavailableError: No data came.
        """
        self._thread.start()
        status = self.wait(None, FIRST_DATA)
        if status is None:
            self._ending = True
            raise RobotUnavailableError(
                f"The robot is connected but sends no data within {FIRST_DATA:g} s. Check the "
                "network, and that the robot has started up."
            )
        return status

    def arm(self) -> Stop | None:
        """Sets the watchdog and begins to send, from the arm's actual position on.

        Returns:
            Why it latched instead.

        Raises:
            LatchedError: It is latched.
        """
        status = self.latest()
        if not self._client.set_watchdog(self._watchdog):
            return self._safety.latch("watchdog", "the controller did not accept the watchdog")
        newer = self.wait(status, FIRST_DATA)
        if newer is None:
            return self._safety.latch("state_age", "no data after the watchdog was set")
        with self._changed:
            assert self._status is not None
            stop = self._safety.arm(self._status.state)
            self._command, self._armed = None, stop is None
        return stop

    def look(self, state: RobotState) -> Stop | None:
        """What a state says against the robot, where nothing is sent to it."""
        return self._safety.look(state)

    def latest(self) -> LinkStatus:
        """The newest status."""
        assert self._status is not None, "start() first"
        return self._status

    def wait(self, seen: LinkStatus | None, timeout: float) -> LinkStatus | None:
        """Waits for a status newer than `seen`, a latched stop included; None after `timeout` s."""
        with self._changed:
            self._changed.wait_for(lambda: self._status is not seen, timeout)
            return None if self._status is seen else self._status

    def put(self, q: Sequence[float], time: float) -> None:
        """Hands over the newest target [6], rad, with the controller time that it answers, s."""
        number = self._command.number + 1 if self._command else self._judged + 1
        self._command = _Command(number, list(q), time)

    @contextmanager
    def deadline(self, limit: str, allowed: float) -> Iterator[None]:
        """Stops the robot, braking, if what is done inside takes longer than allowed, controller s.

        It would be late as a command anyway (`SafetyLimits.command_age`), but the operator shall
        read what was slow: `limit` names it. So that this comes first, less is allowed where that
        limit is shorter.
        """
        ages = self._safety.limits.command_age - self._safety.period
        self._task = _Task(limit, self.latest().state.time, min(allowed, ages))
        try:
            yield
        finally:
            self._task = None

    def finish(self, reason: str) -> Stop:
        """Brakes, holds, stops the program on the robot and ends the thread.

        Returns:
            Why the robot stopped: `reason`, or what stopped it before.
        """
        try:
            with self._changed:
                stop = self._safety.latch("end", reason, sends=self._armed)
            deadline = clock.perf_counter() + STOP_TIME / self._pace
            while self._thread.is_alive() and clock.perf_counter() < deadline:
                if not stop.sends or self._safety.is_still:
                    break
                clock.sleep(0.005)
                stop = self._safety.stop or stop
        finally:
            # Also for an operator who presses Ctrl-C again, because it does not brake at once. Only
            # after this is known whether the robot has stopped: no signal shortens it.
            with uninterrupted():
                self._ending = True
                self._halt()
                self._thread.join(STOP_TIME)
                self._await_halt()
        return self._safety.stop or stop

    def _await_halt(self) -> None:
        """Waits for the robot's answer to `_halt`, and notes if there is none."""
        if self._halt_thread is None:
            return
        # A dead link makes the library wait for minutes; the watchdog has stopped the robot.
        patience = HALT_TIME / max(self._pace, SLOWEST)
        self._halt_thread.join(patience)
        if self._halt_thread.is_alive():
            self.stop_error = f"it did not answer for {patience:g} s"

    def way(self) -> list[list[float]]:
        """Measured joints [n, 6], rad, from the first target on; after `finish`."""
        first = next((k for k, (_, _, q) in enumerate(self._log) if q), len(self._log))
        return [state.q for state, _, _ in self._log[first:]]

    def timing(self) -> dict[str, float]:
        """How the cycles came: counts, and percentiles of lateness, s; after `finish`."""
        lateness = sorted(late for _, late, _ in self._log) or [0.0]
        status = self.latest()

        def percentile(share: float) -> float:
            return lateness[round(share * (len(lateness) - 1))]

        return {
            "pace": self._pace,
            "cycles": status.cycles,
            "missed_cycles": status.missed,
            "targets_sent": sum(q is not None for _, _, q in self._log),
            "lateness_median_s": percentile(0.5),
            "lateness_99_s": percentile(0.99),
            "lateness_max_s": percentile(1.0),
        }

    def lateness_histogram(self) -> dict[str, int]:
        """How many cycles came how late, by wall time; after `finish`."""
        counts = dict.fromkeys([f"below {1e3 * most:g} ms" for most in LATENESS], 0)
        rest = f"{1e3 * LATENESS[-1]:g} ms and more"
        counts[rest] = 0
        for _, late, _ in self._log:
            name = next((f"below {1e3 * most:g} ms" for most in LATENESS if late < most), rest)
            counts[name] += 1
        return counts

    def write_log(self, file: Path) -> None:
        """Writes what came and went out in every cycle as CSV; after `finish`."""
        names = ["time", "lateness"]
        for part in ("q", "qd", "wrench", "sent"):
            names += [f"{part}_{k}" for k in range(1, 7)]
        with file.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow([*names, "runtime_state", "safety_bits"])
            for state, late, sent in self._log:
                row: list = [state.time, late, *state.q, *state.qd, *state.wrench]
                shown = [f"{x:.9g}" for x in row]
                shown += [f"{x:.9g}" for x in sent] if sent else [""] * 6
                writer.writerow([*shown, state.runtime_state, state.safety_bits])

    def _guarded(self) -> None:
        try:
            self._run()
        except Exception as error:  # Whatever it is, the operator must hear of it.
            with self._changed:
                self._latch("link", f"{type(error).__name__}: {str(error).strip()}")
            self._halt()

    def _run(self) -> None:
        client, pace = self._client, self._pace
        longest = self._safety.limits.state_age / pace
        first = clock.perf_counter()
        last_time, last_arrival = client.timestamp(), first
        cycles = missed = sent = 0
        state: RobotState | None = None
        while not self._ending:
            time = client.timestamp()
            if time == last_time:
                command = self._command
                if state and self._armed and self._is_new(command, state):
                    sent += self._cycle(state)  # The answer goes out at once, not a cycle later.
                    continue
                silence = clock.perf_counter() - last_arrival
                if self._armed and silence > longest and not self._halted:
                    self._latch_fault(
                        "state_age", f"the controller's clock stands for {silence:.4g} s"
                    )
                clock.sleep(POLL)
                continue
            state = client.read()
            if not math.isfinite(state.time):
                self._latch_fault("link", f"the controller's clock shows {state.time}: no time")
                return
            arrival = clock.perf_counter()
            period = state.time - last_time
            cycles += 1
            missed += max(0, round(period / self._safety.period) - 1)
            lateness = arrival - last_arrival - period / pace
            self._log.append((state, lateness, None))
            if self._armed:
                sent += self._cycle(state)
            with self._changed:
                self._status = LinkStatus(
                    state, arrival, period, lateness, cycles, missed, sent, self._safety.stop,
                )  # fmt: skip
                self._changed.notify_all()
            last_time, last_arrival = state.time, arrival

    def _is_new(self, command: _Command | None, state: RobotState) -> bool:
        """Whether a command waits and may go out: one goes in a cycle, the next in the next."""
        if command is None or self._served is state:
            return False
        return command.number != self._judged

    def _cycle(self, state: RobotState) -> bool:
        """Judges a state and the newest command, and sends; whether a target went out."""
        client, safety, command = self._client, self._safety, self._command
        if not client.is_connected():
            self._latch_fault("link", "a connection to the robot was lost")
        is_new = self._is_new(command, state)
        # Until the first command comes nothing moves, and nothing can be late.
        answered = state.time if command is None else command.time
        task = self._task
        if task is not None and self._armed and state.time - task.begin > task.allowed + 1e-9:
            took = state.time - task.begin
            with self._changed:
                safety.latch(
                    task.limit, f"the {task.limit} takes {took:.4g} s and more, allowed "
                    f"{task.allowed:.4g}", took, task.allowed, sends=True,
                )  # fmt: skip
        with self._changed:
            decision = safety.step(state, command.q if command and is_new else None, answered)
        if command is not None and is_new:
            self._judged = command.number
        if decision.stop is not None and safety.is_still and self._is_held_too_long(state.time):
            self._latch_fault("hold", "nobody ends the run")  # The first stop stays the reason.
            if self.abandoned is not None:
                self.abandoned(decision.stop)
            return False
        if decision.q is None:
            if decision.stop is not None:
                self._halt()
            elif command is None:
                client.kick()
            return False
        self._served = state
        self._log[-1] = (*self._log[-1][:2], decision.q)
        begin = clock.perf_counter()
        accepted = client.servo(decision.q)
        took = clock.perf_counter() - begin
        if not accepted:
            self._latch_fault("link", "the robot's program did not take a target")
        elif took > SLOW_CALL / self._pace:
            self._latch_fault("link", f"sending a target took {took:.3g} s: the link reconnected")
        return True

    def _is_held_too_long(self, time: float) -> bool:
        """Whether a latched arm was held at rest for longer than it takes to end a run."""
        self._held_since = min(self._held_since, time)
        return time - self._held_since > HOLD_TIME and not self._ending and not self._halted

    def _latch_fault(self, limit: str, detail: str) -> None:
        with self._changed:
            self._latch(limit, detail)
        self._halt()

    def _latch(self, limit: str, detail: str) -> None:
        stop = self._safety.latch(limit, detail)
        if self._status is not None:
            self._status = self._status._replace(stop=stop)
        self._changed.notify_all()

    def _halt(self) -> None:
        """Asks the robot once to stop its program, beside the thread: the call may block."""
        if self._halted:
            return
        self._halted = True
        self._halt_thread = threading.Thread(target=self._ask_to_stop, daemon=True)
        self._halt_thread.start()

    def _ask_to_stop(self) -> None:
        try:
            self._client.stop()
        except Exception as error:  # Whatever it is, the operator must hear of it.
            # The link is gone; the robot's watchdog stops it. Latched already.
            with self._changed:
                self.stop_error = str(error) or type(error).__name__
