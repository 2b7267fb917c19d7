"""The emulator's own port, 30099, in place of a person at the pendant: a line of JSON in, one out.

Requests: ``{"inject": FAULT, "at": TIME}`` (`at` may be left out, or be `after`: since the first
target that comes), ``{"status": true}``, ``{"trace": TIME}`` for `Controller.trace` since then,
``{"fresh_food": true}`` for the same food uncut, ``{"fresh_food": SCENARIO}`` for that of a
scenario, as YAML text, ``{"stop": true}``. Answers have ``"ok"``, and ``"error"`` where it is
false.
"""

import json
from collections.abc import Callable

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.emulator.connections import Connection, Service, take_until
from sliceit_drake.emulator.faults import FaultInjector

__all__ = ["PENDANT_PORT", "Pendant"]

PENDANT_PORT = 30099
_LONGEST_LINE = 1 << 20


class Pendant(Service):
    """Takes faults from another process and tells it how the controller does."""

    def __init__(
        self,
        faults: FaultInjector,
        status: Callable[[], dict[str, object]],
        trace: Callable[[float], list[list[float]]],
        stop: Callable[[], None],
        put_fresh_food: Callable[[str | None], None],
    ) -> None:
        self._faults, self._status, self._trace, self._stop = faults, status, trace, stop
        self._put_fresh_food = put_fresh_food

    def received(self, connection: Connection) -> None:
        while (line := take_until(connection.unread, b"\n")) is not None:
            connection.send(json.dumps(self._answer(line)).encode() + b"\n")
        if len(connection.unread) > _LONGEST_LINE:
            connection.close()

    def _answer(self, line: bytes) -> dict[str, object]:
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise ValueError("a request is an object")
            if "inject" in request:
                times = (request.get(name) for name in ("at", "after"))
                at, after = (None if time is None else float(time) for time in times)
                self._faults.inject(str(request["inject"]), at, after=after)
            elif "trace" in request:
                return {"ok": True, "trace": self._trace(float(request["trace"]))}
            elif "status" in request:
                return {"ok": True, **self._status()}
            elif "stop" in request:
                self._stop()
            elif "fresh_food" in request:
                food = request["fresh_food"]
                if food is not True and not isinstance(food, str):
                    raise ValueError("fresh_food is true or a scenario as text")
                self._put_fresh_food(None if food is True else food)
            else:
                raise ValueError("a request has one of inject, status, trace, fresh_food, stop")
            return {"ok": True}
        except (ValueError, TypeError, OverflowError, RecursionError, ConfigurationError) as error:
            return {"ok": False, "error": str(error)}
