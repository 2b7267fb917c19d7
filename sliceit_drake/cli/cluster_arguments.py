"""The arguments of commands whose work a Dask cluster can do: --backend, --scheduler."""

import argparse
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["add_cluster_arguments", "check_cluster_arguments", "cluster_of"]

DASK = "dask"


def add_cluster_arguments(parser: argparse.ArgumentParser, here: str, work: str) -> None:
    """Adds --backend and --scheduler.

    Args:
        parser: Parser of the command.
        here: What the work is done by without a cluster: "threads" or "processes".
        work: What is spread, as "slices are simulated".
    """
    parser.add_argument(
        "--backend",
        choices=(here, DASK),
        default=here,
        help=f"where {work}: {here} of this machine (the default), or the workers of a Dask"
        " cluster",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="of the cluster, as tcp://192.168.0.5:8786"
    )


def check_cluster_arguments(options: argparse.Namespace) -> None:
    """Refuses one of the two without the other.

    Raises:
        ConfigurationError: It is so.
    """
    from sliceit_drake.configuration import ConfigurationError

    if (options.backend == DASK) != (options.scheduler is not None):
        raise ConfigurationError(
            "is given without --backend dask" if options.scheduler else "is not given",
            field="--scheduler",
            fix="Give both: --backend dask --scheduler tcp://HOST:8786.",
        )


def cluster_of(options: argparse.Namespace) -> "AbstractContextManager[Client | None]":
    """The cluster that the options name, connected; None without one.

    Raises:
        ConfigurationError: The options do not fit together, or see `cluster.connected`.
    """
    from sliceit_drake.cluster import connected

    check_cluster_arguments(options)
    return connected(options.scheduler) if options.backend == DASK else nullcontext()
