"""A robot without a network: a thread that is the controller's clock, and faults on demand."""

import threading
import time as clock

from sliceit_drake.hardware.client import PLAYING, RobotFacts, RobotState
from sliceit_drake.systems.servo import ServoConfig, ServoLaw


class FakeRobot:
    """Implements `RobotClient`; the arm follows the last target as the simulated servo does.

    Args:
        q: Joint positions at the start [6], rad.
        pace: Controller seconds in a second.
    """

    def __init__(self, q, pace=0.2):
        self.q, self.qd, self.target, self.pace = list(q), [0.0] * 6, list(q), pace
        self._law = ServoLaw(ServoConfig(), 0.002)
        self._state = self._law.state_at_rest(q)
        self.wrench, self._noise = [0.0] * 6, 1e-9
        self.runtime, self.bits, self.connected, self.accepts = PLAYING, 1, True, True
        self.payload = (1.2, 0.0, 0.0, 0.06)
        self.call_time = 0.0
        self.frozen = False
        self.raw = None
        self.time = 100.0
        # Targets, each with the time of the state read before it: under load the clock has gone on.
        self.sent = []
        self._read_time = self.time
        self.log = []
        self.watchdog = None
        self.move = None  # Where a planned motion goes, and how fast.
        self.stopped = threading.Event()
        self._running = True
        self._lived, self._later = 0.0, []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        due = clock.perf_counter()
        while self._running:
            # What a busy machine made late is not made up for: a burst of cycles would be a fault.
            due = max(due + 0.002 / self.pace, clock.perf_counter())
            clock.sleep(max(0.0, due - clock.perf_counter()))
            self._lived += 0.002
            for entry in [entry for entry in self._later if entry[0] <= self._lived]:
                entry[1]()
                self._later.remove(entry)
            if self.move is not None:
                end, speed = self.move
                way = [b - a for a, b in zip(self.target, end, strict=True)]
                share = min(1.0, 0.002 * speed / max(1e-9, max(map(abs, way))))
                self.target = [a + share * b for a, b in zip(self.target, way, strict=True)]
            if not self.frozen:
                self._state = self._law.step(self._state, self.target)
                self.q, self.qd = self._state[0].tolist(), self._state[1].tolist()
                self.time += 0.002

    def later(self, seconds, call):
        """Calls after so many of the controller's seconds, counted also while it is frozen."""
        self._later.append((self._lived + seconds, call))

    def wait(self, seconds):
        """Waits for so much of it."""
        over = threading.Event()
        self.later(seconds, over.set)
        assert over.wait(60.0), "the fake robot does not run"

    def timestamp(self):
        return self.time

    def read(self):
        self._read_time = self.time
        # No two readings of a sensor are the same.
        self._noise = -self._noise
        wrench = [x + self._noise * self._read_time for x in self.wrench]
        return RobotState(
            self._read_time, self.q, self.qd, wrench, self.runtime, self.bits, self.payload,
            raw_wrench=self.raw,
        )  # fmt: skip

    def is_connected(self):
        return self.connected

    def servo(self, q):
        if self.watchdog is None:
            raise RuntimeError("a target before the watchdog")
        clock.sleep(self.call_time)
        if self.accepts:
            self.sent.append((self._read_time, list(q)))
            self.target = list(q)
        return self.accepts

    def kick(self):
        self.log.append("kick")

    def set_watchdog(self, frequency):
        self.watchdog = frequency
        self.log.append("watchdog")
        return True

    def stop(self):
        self.log.append("stop")
        self.move = None
        self.stopped.set()

    def facts(self):
        return RobotFacts(
            model="UR5",
            serial="20205500001",
            software="5.11.1",
            robot_mode="RUNNING",
            safety_mode="NORMAL",
            remote_control=True,
            payload=1.2,
            payload_cog=[0.0, 0.0, 0.06],
            tcp=[0.0] * 6,
            speed_scaling=1.0,
        )

    def zero_sensor(self):
        self.log.append("zero")

    def allows_joints(self, q):
        return True

    def start_move(self, q, speed, acceleration):
        if self.watchdog is None:
            raise RuntimeError("a motion before the watchdog")
        self.log.append("move")
        self.move = list(q), speed
        return True

    def close(self):
        self._running = False
        self._thread.join()
