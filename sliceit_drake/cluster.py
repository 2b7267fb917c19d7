"""The workers of a Dask cluster, for whatever spreads over them.

    with connected("tcp://192.168.0.5:8786") as client:
        files = record_session(protocol, folder, seed=1, client=client)

The workers need this package, in the same version, and no disk that is shared: what a task needs
travels to it, and what it makes travels back.
"""

import contextlib
import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sliceit_drake.configuration import ConfigurationError

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["CONNECT", "code_version", "connected"]

CONNECT = 10.0
"""Time to reach a scheduler and one worker, s."""


@functools.cache
def code_version() -> str:
    """Hash of the package's source, by which results of one version are known."""
    h = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        h.update(file.read_bytes())
    return h.hexdigest()[:12]


@contextlib.contextmanager
def connected(scheduler: str, patience: float = CONNECT) -> "Iterator[Client]":
    """Connects to a Dask scheduler with workers.

    Args:
        scheduler: Its address, as tcp://HOST:8786.
        patience: For it and for its first worker, s.

    Raises:
        ConfigurationError: The package is not installed, nobody answers there, or the workers
            lack this package or have another version of it.
    """
    try:
        import joblib  # noqa: F401
        from distributed import Client
    except ImportError as error:
        raise ConfigurationError(
            f"needs the packages of the extra `cluster` ({error.name} is missing)",
            field="--backend",
            fix="pip install 'sliceit_drake[cluster]'",
        ) from error
    try:
        client = Client(scheduler, timeout=patience, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"no Dask scheduler answers at {scheduler}",
            field="--scheduler",
            fix="Start one (dask scheduler), give the address that it prints, and check that no"
            " firewall is between.",
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=patience)
        except TimeoutError as error:
            raise ConfigurationError(
                f"the scheduler at {scheduler} has no workers",
                field="--scheduler",
                fix=f"Start some on the machines of the cluster: dask worker {scheduler}",
            ) from error
        _check_version(client)
        yield client


def _check_version(client: "Client") -> None:
    """Refuses workers of another version: their results would not be those of this machine."""
    found: dict[str, Any] = client.run(code_version, on_error="return")
    for worker, version in sorted(found.items()):
        if version != code_version():
            lacks = isinstance(version, BaseException)
            raise ConfigurationError(
                f"the worker at {worker} "
                + ("has no sliceit_drake" if lacks else "has another version of sliceit_drake"),
                field="--scheduler",
                fix="Install the version of this machine there, and start the worker again.",
            )
