"""The services that take robot programs: ports 30003, 30001 and 30002."""

import weakref

from sliceit_drake.emulator.connections import Connection, Service, take_until
from sliceit_drake.emulator.control_script import ControlScript, read_script
from sliceit_drake.emulator.controller import Controller
from sliceit_drake.emulator.modes import MessageLevel

__all__ = ["ScriptServer"]

_LONGEST_PROGRAM = 1 << 20
_END = b"\nend\n"


class ScriptServer(Service):
    """Starts a control script when a client uploads it; refuses other programs aloud.

    On a real controller these ports also stream the robot's state, which ur_rtde does not read;
    here they are silent. A connection that was opened in local control stays read-only, as on a
    real controller.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._read_only: weakref.WeakSet[Connection] = weakref.WeakSet()

    def opened(self, connection: Connection) -> None:
        if not self._controller.is_remote:
            self._read_only.add(connection)

    def received(self, connection: Connection) -> None:
        # A program has a top-level "end"; a bare line is a program of its own.
        while unread := connection.unread:
            is_function = unread.startswith((b"def ", b"sec "))
            program = take_until(unread, _END if is_function else b"\n")
            if program is None:
                break
            text = program.decode("utf-8", "replace")
            if text.strip():
                self._run(text, connection in self._read_only)
        if len(connection.unread) > _LONGEST_PROGRAM:
            connection.close()

    def _run(self, text: str, is_read_only: bool) -> None:
        controller = self._controller
        if is_read_only or not controller.is_remote:
            controller.note("program ignored: not in remote control")
            return
        found = read_script(text)
        if found is None:
            first = text.strip().splitlines()[0][:60]
            controller.tell(
                MessageLevel.ERROR,
                f"program not emulated, only a control script is; it begins with {first!r}",
            )
            controller.stop_program("a program that is not emulated was sent")
            return
        program = ControlScript(controller, found)
        controller.start_program(program.step, f"control script, {len(text)} characters")
