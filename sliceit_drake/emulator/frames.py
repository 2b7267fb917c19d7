"""Frames of the RTDE protocol, version 2: bytes to packages and back. No sockets in it.

A frame is ``uint16 size | uint8 type | payload``, big endian; the size counts the header.
"""

import enum
import struct
from collections.abc import Iterator, Mapping, Sequence

from sliceit_drake.emulator.variables import TYPES

__all__ = [
    "LONGEST_PAYLOAD",
    "FrameError",
    "PackageType",
    "Recipe",
    "encode_frame",
    "encode_text",
    "split_names",
    "take_frames",
]

_HEADER = struct.Struct(">HB")
LONGEST_PAYLOAD = 0xFFFF - _HEADER.size


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
