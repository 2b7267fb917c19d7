"""The services that take robot programs: ports 30003, 30001 and 30002."""

import dataclasses as dc

from sliceit_drake.emulator.connections import Connection
from sliceit_drake.emulator.control_script import ControlScript, register_offset
from sliceit_drake.emulator.controller import Controller
from sliceit_drake.emulator.modes import MessageLevel

__all__ = ["ScriptServer"]

_LONGEST_PROGRAM = 1 << 20
_END = b"\nend\n"


@dc.dataclass
class _Upload:
    text: bytearray
    is_read_only: bool


class ScriptServer:
    """Starts ur_rtde's control script when a client uploads it; refuses other programs aloud.

    On a real controller these ports also stream the robot's state, which ur_rtde does not read;
    here they are silent. A connection that was opened in local control stays read-only, as on a
    real controller.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._uploads: dict[Connection, _Upload] = {}

    def opened(self, connection: Connection) -> None:
        """See `connections.Service`."""
        self._uploads[connection] = _Upload(bytearray(), not self._controller.is_remote)

    def closed(self, connection: Connection) -> None:
        """See `connections.Service`."""
        del self._uploads[connection]

    def received(self, connection: Connection, data: bytes) -> None:
        """See `connections.Service`."""
        upload = self._uploads[connection]
        upload.text += data
        # A program has a top-level "end"; a bare line is a program of its own.
        while upload.text:
            is_function = upload.text.startswith((b"def ", b"sec "))
            mark = _END if is_function else b"\n"
            end = upload.text.find(mark)
            if end < 0:
                break
            text = bytes(upload.text[: end + len(mark)]).decode("utf-8", "replace")
            del upload.text[: end + len(mark)]
            if text.strip():
                self._run(text, upload)
        if len(upload.text) > _LONGEST_PROGRAM:
            connection.close()

    def _run(self, text: str, upload: _Upload) -> None:
        controller = self._controller
        if upload.is_read_only or not controller.is_remote:
            controller.log.append((controller.time, "program ignored: not in remote control"))
            return
        offset = register_offset(text)
        if offset is None:
            first = text.strip().splitlines()[0][:60]
            controller.tell(
                MessageLevel.ERROR,
                f"program not emulated, only ur_rtde's control script is; it begins with {first!r}",
            )
            controller.stop_program("a program that is not emulated was sent")
            return
        controller.start_program(
            ControlScript(controller, offset), f"control script, {len(text)} characters"
        )
