"""The program `sliceit`: each command parses its arguments, calls its package, and prints."""

import contextlib
import os
import sys

__all__ = ["ended", "start"]


def start() -> int:
    """Runs `sliceit` as `main` does, and says so if Ctrl-C comes while that is imported."""
    try:
        from sliceit_drake.cli.main import main
    except KeyboardInterrupt:
        print("sliceit: interrupted. The same command starts again.", file=sys.stderr)
        return 130
    return ended(main())


def ended(status: int) -> int:
    """The status that the process ends with; after a lost link to a robot it ends here, at once.

    The usual end frees what ur_rtde has made, which crashes then.
    """
    client = sys.modules.get("sliceit_drake.hardware.ur_client")
    if client is not None and client.LOST:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):  # Who read it may have left.
                stream.flush()
        os._exit(status)
    return status
