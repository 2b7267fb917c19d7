"""The program `sliceit`: each command parses its arguments, calls its package, and prints."""

__all__ = ["start"]


def start() -> int:
    """Runs `sliceit` as `main` does, and says so if Ctrl-C comes while that is imported."""
    try:
        from sliceit_drake.cli.main import main
    except KeyboardInterrupt:
        import sys

        print("sliceit: interrupted. The same command starts again.", file=sys.stderr)
        return 130
    return main()
