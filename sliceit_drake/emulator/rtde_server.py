"""The RTDE service, port 30004: protocol 2, several clients.

A frame is ``uint16 size | uint8 type | payload``, big endian; the size counts the header.
"""

import collections
import dataclasses as dc
import enum
import random
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence

from sliceit_drake.emulator.connections import Connection, Service
from sliceit_drake.emulator.control_script import SERVO_COMMAND
from sliceit_drake.emulator.controller import Controller
from sliceit_drake.emulator.modes import MessageLevel
from sliceit_drake.emulator.robot_model import CYCLE
from sliceit_drake.emulator.variables import IN_USE, NOT_FOUND, TYPES, output_type

__all__ = [
    "LONGEST_PAYLOAD",
    "RATE",
    "FrameError",
    "InputValues",
    "PackageType",
    "Recipe",
    "RtdeServer",
    "encode_frame",
    "encode_text",
    "split_names",
    "take_frames",
]

RATE = 1.0 / CYCLE
"""Highest frequency of data packages, Hz."""

_HEADER = struct.Struct(">HB")
LONGEST_PAYLOAD = 0xFFFF - _HEADER.size
_PROTOCOL = 2
_COMMANDS = ("input_int_register_0", "input_int_register_24")
# The number of a recipe is a byte; 0 says that there is none.
_MOST_RECIPES = 255
# Above this backlog a client gets no further packages: only whole ones are ever dropped.
_FULL = 65536

InputValues = dict[str, int | float | bool | tuple]


class FrameError(ValueError):
    """Bytes that are no frame, or a payload that does not fit its recipe."""


class PackageType(enum.IntEnum):
    """Types of packages, the ASCII codes of V v O I S P U M."""

    PROTOCOL_VERSION = ord("V")
    CONTROL_VERSION = ord("v")
    SETUP_OUTPUTS = ord("O")
    SETUP_INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")
    TEXT = ord("M")


def encode_frame(kind: int, payload: bytes = b"") -> bytes:
    """A whole frame.

    Raises:
        FrameError: The payload is longer than a frame holds.
    """
    size = _HEADER.size + len(payload)
    if len(payload) > LONGEST_PAYLOAD:
        raise FrameError(f"a frame holds {LONGEST_PAYLOAD} bytes of payload, not {len(payload)}")
    return _HEADER.pack(size, kind) + payload


def encode_text(message: str, level: int) -> bytes:
    """A text message to a client; its level is a `modes.MessageLevel`."""
    text, origin = message.encode("ascii", "replace")[:255], b"emulator"
    payload = bytes([len(text)]) + text + bytes([len(origin)]) + origin + bytes([level])
    return encode_frame(PackageType.TEXT, payload)


def split_names(payload: bytes) -> list[str]:
    """Names in a comma-separated list; some clients end it with a comma.

    Raises:
        FrameError: It is not ASCII.
    """
    try:
        text = payload.decode("ascii")
    except UnicodeDecodeError as error:
        raise FrameError(f"a list of variables is not ASCII: {error}") from None
    return [name.strip() for name in text.split(",") if name.strip()]


def take_frames(buffer: bytearray) -> Iterator[tuple[int, bytes]]:
    """Takes all complete frames from a stream's bytes; yields type and payload of each.

    Raises:
        FrameError: A size is smaller than a header: the stream cannot be read further.
    """
    while len(buffer) >= _HEADER.size:
        size, kind = _HEADER.unpack_from(buffer)
        if size < _HEADER.size:
            raise FrameError(f"a frame cannot have {size} bytes")
        if len(buffer) < size:
            return
        payload = bytes(buffer[_HEADER.size : size])
        del buffer[:size]
        yield kind, payload


class Recipe:
    """An agreed list of variables, and the layout of a data package that holds them.

    Attributes:
        names: The variables, in order.
        size: Bytes of their values, without the recipe's number.
    """

    def __init__(self, names: Sequence[str], types: Sequence[str]) -> None:
        self.names = tuple(names)
        layout = ">" + "".join(TYPES[kind] for kind in types)
        self._struct = struct.Struct(layout)
        self._counts = [int(TYPES[kind][:-1] or 1) for kind in types]
        self.size = self._struct.size

    def pack(self, values: Mapping[str, object]) -> bytes:
        """Values of all names, scalars or sequences, as bytes [size]."""
        flat: list = []
        for name, count in zip(self.names, self._counts, strict=True):
            if count == 1:
                flat.append(values[name])
            else:
                flat.extend(values[name])  # type: ignore[arg-type]
        return self._struct.pack(*flat)

    def unpack(self, payload: bytes) -> dict[str, int | float | bool | tuple]:
        """Values by name from bytes.

        Raises:
            FrameError: Their number is not `size`.
        """
        if len(payload) != self.size:
            raise FrameError(f"{len(payload)} bytes of values where the recipe has {self.size}")
        flat = self._struct.unpack(payload)
        values: dict[str, int | float | bool | tuple] = {}
        start = 0
        for name, count in zip(self.names, self._counts, strict=True):
            values[name] = flat[start] if count == 1 else flat[start : start + count]
            start += count
        return values


@dc.dataclass
class _Session:
    """Agreement with a client."""

    inputs: list[Recipe] = dc.field(default_factory=list)
    outputs: Recipe | None = None
    frequency: float = 0.0
    due: float = 0.0
    is_started: bool = False
    skipped: int = 0
    ready: collections.deque[tuple[float, bytes]] = dc.field(default_factory=collections.deque)


class RtdeServer(Service):
    """Answers RTDE clients, sends them the controller's outputs and takes their inputs.

    Attributes:
        frequency_limit: Highest frequency that clients get, Hz.
        drop_share: Fraction of the data packages, in and out, that gets lost (a fault).
        delay: Controller time by which data packages come late, in and out, s (a fault).
        input_delay: The same of those that come in alone, s (a fault).
        change_targets: What arrives in place of a target of servoJ (a fault), or None.
        next_size: Size that the header of the next data package claims, bytes (a fault), or None.
        packages_in: Data packages that have arrived and fit their recipe, lost and late ones too.
        command_counts: Number of them by the value that they had for the command register.
        last_command: Last such value that was not 0, which clears a command or feeds the watchdog.
        has_reached_all: Whether all clients that want data got a package after the last cycle.
    """

    def __init__(self, controller: Controller) -> None:
        self.frequency_limit = RATE
        self.drop_share = self.delay = self.input_delay = 0.0
        self.next_size: int | None = None
        self.change_targets: Callable[[InputValues], list[InputValues]] | None = None
        self.packages_in = 0
        self.command_counts: collections.Counter[int] = collections.Counter()
        self.last_command = 0
        self.has_reached_all = False
        self._controller = controller
        self._random = random.Random(0)
        self._sessions: dict[Connection, _Session] = {}
        self._late_inputs: collections.deque[tuple[float, InputValues]] = collections.deque()

    # Service.

    def opened(self, connection: Connection) -> None:
        self._sessions[connection] = _Session()

    def closed(self, connection: Connection) -> None:
        del self._sessions[connection]
        self._controller.registers.release(connection)

    def received(self, connection: Connection) -> None:
        session = self._sessions[connection]
        try:
            for kind, payload in take_frames(connection.unread):
                self._answer(connection, session, kind, payload)
                if not connection.is_open:
                    return
        except (FrameError, struct.error) as error:
            # What follows cannot be told from garbage.
            connection.send(encode_text(f"connection closed: {error}", MessageLevel.ERROR))
            connection.close()

    # Every cycle.

    def take_late_inputs(self) -> None:
        """Takes the inputs whose delay is over; before a cycle."""
        while self._late_inputs and self._late_inputs[0][0] <= self._controller.time:
            _, values = self._late_inputs.popleft()
            self._controller.registers.write(values, self._controller.time)

    def publish(self) -> None:
        """After a cycle: sends each client its data package, if due, and all text messages."""
        controller = self._controller
        texts = [encode_text(text, level) for level, text in controller.messages]
        controller.messages.clear()
        inputs: dict[str, object] = dict(controller.registers.values)
        values = controller.outputs | inputs
        self.has_reached_all = True
        for connection, session in list(self._sessions.items()):
            for text in texts:
                connection.send(text)
            if session.outputs is None or not session.is_started:
                continue
            session.due += min(session.frequency, self.frequency_limit) * CYCLE
            if session.due > 1.0 - 1e-9:
                session.due -= 1.0
                if not self._is_lost():
                    data = encode_frame(PackageType.DATA, b"\x01" + session.outputs.pack(values))
                    if self.next_size is not None:
                        data, self.next_size = struct.pack(">H", self.next_size) + data[2:], None
                    session.ready.append((controller.time + self.delay, data))
            has_sent = False
            while session.ready and session.ready[0][0] <= controller.time:
                data, has_sent = session.ready.popleft()[1], True
                if connection.backlog > _FULL:
                    session.skipped += 1
                else:
                    connection.send(data)
            self.has_reached_all &= has_sent

    def statistics(self) -> dict[str, object]:
        """Numbers for people."""
        return {
            "clients": len(self._sessions),
            "packages_in": self.packages_in,
            "commands": dict(self.command_counts),
            "skipped": sum(s.skipped for s in self._sessions.values()),
        }

    # Packages.

    def _is_lost(self) -> bool:
        return self.drop_share > 0.0 and self._random.random() < self.drop_share

    def _answer(self, connection: Connection, session: _Session, kind: int, payload: bytes) -> None:
        if kind == PackageType.DATA:
            self._take_input(connection, session, payload)
            return
        if kind == PackageType.TEXT:
            self._controller.note(f"client says {payload!r}")
            return
        if kind in (PackageType.START, PackageType.PAUSE):
            accepted = session.outputs is not None or kind == PackageType.PAUSE
            session.is_started = kind == PackageType.START and accepted
            answer = bytes([accepted])
        elif kind == PackageType.PROTOCOL_VERSION:
            answer = bytes([struct.unpack(">H", payload) == (_PROTOCOL,)])
        elif kind == PackageType.CONTROL_VERSION:
            answer = struct.pack(">IIII", *self._controller.config.version)
        elif kind == PackageType.SETUP_OUTPUTS:
            answer = self._set_outputs(session, payload)
        elif kind == PackageType.SETUP_INPUTS:
            answer = self._set_inputs(connection, session, payload)
        else:
            connection.send(encode_text(f"unknown type of package {kind}", MessageLevel.ERROR))
            return
        connection.send(encode_frame(kind, answer))

    def _set_outputs(self, session: _Session, payload: bytes) -> bytes:
        (frequency,) = struct.unpack_from(">d", payload)
        names = split_names(payload[8:])
        types = [output_type(name, self._controller.config.version) for name in names]
        accepted = NOT_FOUND not in types and 0.0 < frequency <= self.frequency_limit
        session.outputs = Recipe(names, types) if accepted else None
        if session.outputs is not None and session.outputs.size > LONGEST_PAYLOAD - 1:
            session.outputs = None
            raise FrameError(f"a package of {len(names)} variables is too long for a frame")
        session.frequency, session.due = frequency, 0.0
        return bytes([accepted]) + ",".join(types).encode()

    def _set_inputs(self, connection: Connection, session: _Session, payload: bytes) -> bytes:
        names = split_names(payload)
        types = self._controller.registers.claim(connection, names)
        number = 0
        if not {NOT_FOUND, IN_USE} & set(types):
            if len(session.inputs) == _MOST_RECIPES:
                raise FrameError(f"a client has {_MOST_RECIPES} input recipes at most")
            session.inputs.append(Recipe(names, types))
            number = len(session.inputs)
        return bytes([number]) + ",".join(types).encode()

    def _take_input(self, connection: Connection, session: _Session, payload: bytes) -> None:
        number = payload[0] if payload else 0
        try:
            if not 1 <= number <= len(session.inputs):
                raise FrameError(f"there is no input recipe {number}")
            values = session.inputs[number - 1].unpack(payload[1:])
        except FrameError as error:
            connection.send(encode_text(f"input package ignored: {error}", MessageLevel.ERROR))
            return
        self.packages_in += 1
        for name in _COMMANDS:
            if name in values:
                command = int(values[name])  # type: ignore[arg-type]
                self.command_counts[command] += 1
                self.last_command = command or self.last_command
        if self._is_lost():
            return
        if self.change_targets is None or SERVO_COMMAND not in map(values.get, _COMMANDS):
            self._write(values)
        else:
            for changed in self.change_targets(values):
                self._write(changed)

    def _write(self, values: InputValues) -> None:
        delay = max(self.delay, self.input_delay)
        if delay > 0.0 or self._late_inputs:
            self._late_inputs.append((self._controller.time + delay, values))
        else:
            self._controller.registers.write(values, self._controller.time)
