"""Where the trials of a search are kept: a journal file, or a database that many machines share."""

import contextlib
import re
import time
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

import optuna
from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock

from sliceit_drake.configuration import ConfigurationError

__all__ = ["keeps_answering", "open_storage", "without_password"]

CONNECT = 10
"""Time to reach a database, s."""
STALE = 10
"""Age of a journal file's lock, s, from which on whoever took it was killed: it is held for ms."""
BEGINNERS = 20
"""Attempts to make the tables: workers that begin together on an empty database collide."""
EXAMPLE = "postgresql://USER@HOST/DATABASE"


def open_storage(storage: str | Path) -> optuna.storages.BaseStorage:
    """Opens a storage of trials, or makes it.

    A database that cannot be reached is given up after `CONNECT` seconds, and a connection that
    it has dropped since the last trial is made anew.

    Args:
        storage: A journal file (.log), or a URL of SQLAlchemy's, as
            postgresql://user@host/database. A password may stand in it, or in the environment
            variable PGPASSWORD or the file ~/.pgpass, which do not show in a list of processes.

    Raises:
        ConfigurationError: The storage cannot be opened. The password is not in the message.
    """
    text = str(storage)
    if "://" not in text:
        try:
            # Of a relative path the lock would be a link to nowhere, whose age nobody can tell.
            file = str(Path(text).absolute())
            lock = JournalFileSymlinkLock(file, grace_period=STALE)
            return optuna.storages.JournalStorage(JournalFileBackend(file, lock))
        except Exception as error:
            raise ConfigurationError(
                f"cannot be opened ({error})",
                field="--storage",
                fix=f"Give a journal file such as trials.log, or a URL such as {EXAMPLE}.",
            ) from error
    # Without its cause: a driver's message may hold what was wrong with the password.
    try:
        return _open_database(text)
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"{without_password(text)} needs the package {error.name}",
            field="--storage",
            fix="Install it; for PostgreSQL: pip install 'sliceit_drake[database]'.",
        ) from None
    except Exception as error:
        raise ConfigurationError(
            f"{without_password(text)} cannot be opened ({_in_short(error, text)})",
            field="--storage",
            fix=f"Give a URL such as {EXAMPLE}, its password in PGPASSWORD or ~/.pgpass, and check"
            " that the server runs, lets this machine in and has the database.",
        ) from None


def _open_database(text: str) -> optuna.storages.BaseStorage:
    import sqlalchemy

    url = sqlalchemy.make_url(text)
    if url.get_backend_name() == "postgresql":
        url = url.update_query_dict(
            {"connect_timeout": url.query.get("connect_timeout", str(CONNECT))}
        )
    full = url.render_as_string(hide_password=False)
    engine = sqlalchemy.create_engine(full)
    try:
        engine.connect().close()
    finally:
        engine.dispose()
    for attempt in range(BEGINNERS):
        try:
            database = optuna.storages.RDBStorage(full, {"pool_pre_ping": True})
            return optuna.storages.get_storage(database)
        except (sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.StorageInternalError):
            if attempt + 1 == BEGINNERS:
                raise
            time.sleep(0.1)
    raise AssertionError


@contextlib.contextmanager
def keeps_answering() -> Iterator[None]:
    """Turns the failure of a database in the middle of a search into a message for the user.

    Raises:
        ConfigurationError: The database failed. Its URL is not in the message.
    """
    try:
        yield
    except Exception as error:
        # Whoever keeps trials in a file needs no SQLAlchemy.
        from sqlalchemy.exc import SQLAlchemyError

        driver = error.__cause__ if isinstance(error.__cause__, SQLAlchemyError) else error
        if not isinstance(error, SQLAlchemyError | optuna.exceptions.StorageInternalError):
            raise
        raise ConfigurationError(
            f"the database stopped answering ({_in_short(driver, '')})",
            field="--storage",
            fix="Run the same command again when it is back: finished trials are kept there.",
        ) from None


def without_password(text: str) -> str:
    """A text with the passwords of all URLs in it replaced by ***."""
    text = re.sub(r"(\w+://[^\s:/@'\"]*):[^\s'\"]*@", r"\1:***@", text)
    return re.sub(r"(\bpassword=)[^&\s'\"]*", r"\1***", text)


def _in_short(error: Exception, url: str) -> str:
    """The first line of a driver's message, with no part of the URL's password."""
    cause = getattr(error, "orig", None) or error
    message = next(iter(str(cause).strip().splitlines()), type(cause).__name__)
    found = [m[1] for m in re.finditer(r"\w+://[^:/@]*:(.*)@", url)]
    found += [m[1] for m in re.finditer(r"\bpassword=([^&]*)", url)]
    # A password with an unescaped @ or : is taken for a host or a port, and named as such.
    parts = {p for secret in found for p in (secret, *re.split("[@:/?]", secret)) if p}
    for part in sorted(parts | {urllib.parse.unquote(p) for p in parts}, key=len, reverse=True):
        message = message.replace(part, "***")
    return message
