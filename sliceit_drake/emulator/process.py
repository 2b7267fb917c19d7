"""An emulator in a process of its own, and the hand on its pendant: for tests and benchmarks.

The constructors of the real client hold Python's lock while they wait for the controller, so the
two cannot share a process.
"""

import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from sliceit_drake.emulator.pendant import PENDANT_PORT

__all__ = ["EmulatorError", "EmulatorProcess", "PendantClient"]


class EmulatorError(RuntimeError):
    """The emulator did not start, refused a request, or does not answer."""


class PendantClient:
    """A connection to the own port of a running emulator; answers come within `timeout`, s.

    Raises:
        OSError: Nothing answers there.
    """

    def __init__(self, address: str, timeout: float = 5.0, port: int = PENDANT_PORT) -> None:
        self._socket = socket.create_connection((address, port), timeout)
        self._file = self._socket.makefile("rwb")

    def request(self, **request: object) -> dict:
        """Sends a request of `pendant` and returns the answer.

        Raises:
            EmulatorError: It was refused, or no answer came in time.
        """
        try:
            self._file.write(json.dumps(request).encode() + b"\n")
            self._file.flush()
            line = self._file.readline()
        except OSError as error:
            raise EmulatorError(f"the emulator does not answer {request}: {error}") from error
        if not line:
            raise EmulatorError(f"the emulator has closed its port before it answered {request}")
        answer = json.loads(line)
        if not answer.pop("ok"):
            raise EmulatorError(answer["error"])
        return answer

    def inject(self, fault: str, at: float | None = None, *, after: float | None = None) -> None:
        """Injects a fault of `faults.FAULTS`, see `FaultInjector.inject`."""
        self.request(inject=fault, at=at, after=after)

    def trace(self, since: float = 0.0) -> list[list[float]]:
        """The true arm and force in each cycle since a controller time, s: `Controller.trace`."""
        return self.request(trace=since)["trace"]

    def status(self) -> dict:
        """Answer of `emulator.Emulator.status`."""
        return self.request(status=True)

    def put_fresh_food(self, scenario: str | None = None) -> None:
        """Puts an uncut food under the knife: that of a scenario, as YAML, or the same again.

        Raises:
            EmulatorError: It was refused, or preparing it takes longer than the timeout.
        """
        self.request(fresh_food=True if scenario is None else scenario)

    def close(self) -> None:
        """Closes the connection."""
        self._file.close()
        self._socket.close()


class EmulatorProcess(contextlib.AbstractContextManager["EmulatorProcess"]):
    """An emulated controller: ``sliceit emulate`` as a child process; a context manager.

    The child ends with this process, however that ends.

    Args:
        scenario: What is on the table; None for an arm alone that follows without dynamics.
        address: Loopback address; one emulator each.
        pace: Controller time per wall time.
        lockstep: See `emulator.ControllerClock`.
        options: More options of the command.
        timeout: Wall time that it may take to start, s.

    Attributes:
        address: Address on which it listens.
        pendant: Client that injects faults and asks how it does.

    Raises:
        EmulatorError: It did not start; the message has what it said.
    """

    def __init__(
        self,
        scenario: str | Path | None = None,
        address: str = "127.0.0.1",
        pace: float = 1.0,
        lockstep: bool = False,
        options: Sequence[str] = (),
        timeout: float = 60.0,
    ) -> None:
        self.address = address
        command = [sys.executable, "-m", "sliceit_drake.cli.main", "emulate"]
        command += ["--arm-alone"] if scenario is None else [str(scenario)]
        command += ["--address", address, "--pace", str(pace), "--end-with-stdin"]
        command += ["--lockstep"] if lockstep else []
        self._process = subprocess.Popen(
            [*command, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        try:
            self.pendant = self._connect(timeout)
        except BaseException:
            self._end()
            raise

    def _connect(self, timeout: float) -> PendantClient:
        end = time.monotonic() + timeout
        while True:
            if self._process.poll() is not None:
                said = self._process.communicate()[0].decode("utf-8", "replace").strip()
                raise EmulatorError(f"the emulator did not start: {said}")
            # An emulator that had the address before may answer too.
            with contextlib.suppress(OSError, EmulatorError):
                pendant = PendantClient(self.address)
                if pendant.status()["pid"] == self._process.pid:
                    return pendant
                pendant.close()
            if time.monotonic() > end:
                raise EmulatorError(
                    f"the emulator did not open {self.address}:{PENDANT_PORT} in {timeout:g} s"
                )
            time.sleep(0.02)

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether the child still runs."""
        return self._process.poll() is None

    def kill(self) -> None:
        """Ends it at once, as a controller that loses power."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """Ends it and waits for that."""
        if self.is_running:
            with contextlib.suppress(EmulatorError):
                self.pendant.request(stop=True)
        self.pendant.close()
        self._end()

    def _end(self) -> None:
        try:
            self._process.communicate(timeout=5.0)
        except subprocess.TimeoutExpired:
            self.kill()
            self._process.communicate()

    def __exit__(self, *_: object) -> None:
        self.close()
