"""Says which of the package's extras a command needs, where it is not installed."""

from collections.abc import Iterator
from contextlib import contextmanager

from sliceit_drake.configuration import ConfigurationError

__all__ = ["needs_extra"]


@contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Turns the failed import of another's package into a message for the user.

    Args:
        extra: Name of the extra in pyproject.toml.

    Raises:
        ConfigurationError: A package is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] == "sliceit_drake":
            raise
        raise ConfigurationError(
            f"the package {error.name} is not installed",
            fix=f"Install it with: pip install -e '.[{extra}]'",
        ) from error
