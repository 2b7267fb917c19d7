"""Helpers for tests of the emulated controller: free addresses, and a client that is bytes only."""

import itertools
import os
import socket
import time

import numpy as np

from sliceit_drake.emulator.control_script import ControlScript
from sliceit_drake.emulator.controller import Controller, ControllerConfig
from sliceit_drake.emulator.emulator import Emulator
from sliceit_drake.emulator.process import PendantClient
from sliceit_drake.emulator.robot_model import KinematicRobot
from sliceit_drake.emulator.rtde_server import PackageType, Recipe, encode_frame, take_frames

_number = itertools.count(1)


def free_address() -> str:
    """A loopback address that no other test of this run, and no other run, uses."""
    pid = os.getpid()
    return f"127.{20 + pid % 200}.{pid // 200 % 250}.{next(_number)}"


def wait_until(pendant: PendantClient, moment: float, timeout: float = 30.0) -> dict:
    """Waits for a controller time, s, within `timeout` s of wall time; the status then."""
    end = time.monotonic() + timeout
    while (status := pendant.status())["time"] < moment:
        assert time.monotonic() < end, f"{status['time']} s after {timeout} s, not {moment} s"
        time.sleep(0.002)
    return status


class Bench:
    """An emulator in this process, whose cycles the test makes one by one."""

    def __init__(self, robot=None, config: ControllerConfig | None = None) -> None:
        self.address = free_address()
        self.emulator = Emulator(robot or KinematicRobot(), self.address, config=config)
        self.controller: Controller = self.emulator.controller

    def serve(self) -> None:
        """Lets the emulator answer what has been sent."""
        for _ in range(4):
            self.emulator.serve(0.002)

    def cycles(self, count: int) -> None:
        for _ in range(count):
            self.emulator.serve(0.0)
            self.emulator.cycle()

    def inject(self, fault: str, at: float | None = None) -> None:
        self.emulator.faults.inject(fault, at)

    def __enter__(self) -> "Bench":
        return self

    def __exit__(self, *_: object) -> None:
        self.emulator.close()


class RawClient:
    """An RTDE client that speaks frames."""

    def __init__(self, bench: Bench, port: int = 30004, receive_buffer: int = 0) -> None:
        self._bench = bench
        self.socket = socket.socket()
        if receive_buffer:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.socket.settimeout(2.0)
        self.socket.connect((bench.address, port))
        self.socket.setblocking(False)
        self._unread = bytearray()
        self.is_closed = False
        bench.serve()

    def frames(self) -> list[tuple[int, bytes]]:
        """All frames that have arrived."""
        found = []
        while True:
            try:
                data = self.socket.recv(65536)
            except BlockingIOError:
                return found
            except ConnectionResetError:
                data = b""
            if not data:
                self.is_closed = True
                return found
            self._unread += data
            found += take_frames(self._unread)

    def ask(self, kind: int, payload: bytes = b"") -> bytes:
        """Sends a request; returns the payload of its answer."""
        self.socket.sendall(encode_frame(kind, payload))
        self._bench.serve()
        return next(payload for its_kind, payload in self.frames() if its_kind == kind)

    def send(self, kind: int, payload: bytes = b"") -> None:
        self.socket.sendall(encode_frame(kind, payload))
        self._bench.serve()

    def read_from(self, names: str, types: list[str], frequency: float = 500.0) -> Recipe:
        """Subscribes and starts."""
        request = np.array([frequency], ">f8").tobytes() + names.encode()
        assert self.ask(PackageType.SETUP_OUTPUTS, request) == b"\x01" + ",".join(types).encode()
        assert self.ask(PackageType.START) == b"\x01"
        return Recipe(names.split(","), types)

    def data(self, recipe: Recipe) -> list[dict]:
        """Data packages that have arrived, decoded."""
        packages = [p for kind, p in self.frames() if kind == PackageType.DATA]
        assert all(p[0] == 1 for p in packages)  # The number of the only recipe.
        return [recipe.unpack(p[1:]) for p in packages]

    def texts(self) -> list[str]:
        """Text messages that have arrived."""
        frames = [p for kind, p in self.frames() if kind == PackageType.TEXT]
        return [p[1 : 1 + p[0]].decode() for p in frames]

    def close(self) -> None:
        self.socket.close()
        self._bench.serve()


class ScriptBench:
    """A controller that plays the control script; commands go straight into its registers."""

    def __init__(self, robot=None, config: ControllerConfig | None = None) -> None:
        self.controller = Controller(robot or KinematicRobot(), config)
        self.controller.start_program(ControlScript(self.controller).step, "test")
        self.step()

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            self.controller.step()

    def write(self, command: int, doubles=(), integer: int = 0) -> None:
        values = {f"input_double_register_{i}": float(v) for i, v in enumerate(doubles)}
        values |= {"input_int_register_0": command, "input_int_register_1": integer}
        self.controller.registers.write(values, self.controller.time)

    def call(self, command: int, doubles=(), integer: int = 0, limit: int = 5000) -> int:
        """Runs a command until it is done or the program ends; returns the cycles it took."""
        self.write(command, doubles, integer)
        for cycle in range(limit):
            self.step()
            done = self.controller.outputs["output_int_register_0"] == 2
            if done or self.controller.runtime.name != "PLAYING":
                self.write(0)
                self.step()
                return cycle + 1
        raise AssertionError(f"command {command} was not done in {limit} cycles")

    @property
    def positions(self) -> np.ndarray:
        return self.controller.robot.state.positions

    def answer(self, count: int = 6) -> np.ndarray:
        outputs = self.controller.outputs
        return np.array([outputs[f"output_double_register_{i}"] for i in range(count)])

    def texts(self) -> str:
        return "; ".join(text for _, text in self.controller.messages)
