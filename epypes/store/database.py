"""The database of a store: its URL, tables, statements and transactions, and its errors in plain words."""

from __future__ import annotations

import hashlib
import logging
import random
import re
import time
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

import sqlalchemy as sa
from sqlalchemy.dialects.mysql import LONGTEXT
from sqlalchemy.exc import ArgumentError, IntegrityError, NoSuchModuleError, SQLAlchemyError

from epypes.errors import InvalidType, StoreError, install_command

_T = TypeVar("_T")
_log = logging.getLogger(__name__)

# Rows read at a time, so that a long series is never in memory as a whole.
_PAGE: Final = 500
# If two connections make the tables, or write one key, at the same moment, one of them begins again.
_ATTEMPTS: Final = 8
_PAUSE_S: Final = 0.02
# Longest waits for a lock of another process, and for a server that does not answer.
_BUSY_S: Final = 30
_CONNECT_S: Final = 10
_DRIVERS: Final = {"postgres": "postgresql+psycopg", "postgresql": "postgresql+psycopg"}

# SQLite counts rows by INTEGER alone; the TEXT of MySQL ends at 64 KB.
_NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
_LONG_TEXT = sa.Text().with_variant(LONGTEXT(), "mysql", "mariadb")
_METADATA: Final = sa.MetaData()
# Names can be longer than an index takes, so their digests are what is unique.
_SERIES: Final = sa.Table(
    "epypes_series",
    _METADATA,
    sa.Column("id", _NUMBER, primary_key=True),
    sa.Column("digest", sa.String(64), nullable=False, unique=True),
    sa.Column("kind", sa.Text, nullable=False),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("about", _LONG_TEXT, nullable=False),
)
_ROWS: Final = sa.Table(
    "epypes_rows",
    _METADATA,
    sa.Column("id", _NUMBER, primary_key=True),
    sa.Column("series_id", _NUMBER, sa.ForeignKey("epypes_series.id"), nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("key", sa.Text, nullable=False),
    sa.Column("data", _LONG_TEXT, nullable=False),
    sa.UniqueConstraint("series_id", "digest"),
)

# Kind and name, as JSON texts; keys, rows and descriptions are JSON texts too.
SeriesKey = tuple[str, str]


def _digest(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()


def _is_of(series: SeriesKey) -> sa.ColumnElement[bool]:
    """Return the condition that a row belongs to a series."""
    number = sa.select(_SERIES.c.id).where(_SERIES.c.digest == _digest(*series)).scalar_subquery()
    return _ROWS.c.series_id == number


class Database:
    """A database with the tables of a store; any thread may use it.

    Parameters
    ----------
    given
        A path or a URL. The first statement connects to it.

    Raises
    ------
    StoreError
        There can be no such database, or there is no driver for it. All other methods raise it too.
    TypeError
        It is neither a path nor a URL.
    """

    def __init__(self, given: str | Path) -> None:
        url = database_url(given)
        self.place = without_password(url)
        self._is_file = url.get_backend_name() == "sqlite"
        # A file is opened for each transaction, since it may be another one by then.
        # A server is pinged: it may have been restarted.
        pool = sa.NullPool if self._is_file else None
        try:
            self.engine = sa.create_engine(
                url, connect_args=connect_options(url), hide_parameters=True, pool_pre_ping=True, poolclass=pool
            )
        except (NoSuchModuleError, ImportError, ArgumentError) as error:
            kind, driver = url.get_backend_name(), url.drivername.partition("+")[2]
            way_out = install_command("postgres") if driver == "psycopg" else f"Install a driver of {kind}"
            missing = getattr(error, "name", None)
            reason = f"module {missing!r} is not installed" if missing else f"SQLAlchemy knows no {url.drivername!r}"
            text = f"{self.place} can't be opened: {reason}. {way_out}, or store in a file: 'results.sqlite'."
            raise StoreError(self.place, text) from None
        self._is_closed = self._has_tables = False
        # A store that is never closed, as in a notebook, leaves no connection behind.
        weakref.finalize(self, self.engine.dispose)

    def close(self) -> None:
        """Refuse all reading and writing from now on."""
        self._is_closed = True
        self.engine.dispose()

    def series_names(self) -> list[SeriesKey]:
        """Return kind and name of all series, in the order in which they were made."""
        return self._read(sa.select(_SERIES.c.kind, _SERIES.c.name).order_by(_SERIES.c.id))

    def about(self, series: SeriesKey) -> str | None:
        """Return the description of a series; None if it is not there."""
        found = self._read(sa.select(_SERIES.c.about).where(_SERIES.c.digest == _digest(*series)))
        return found[0][0] if found else None

    def row(self, series: SeriesKey, key: str) -> str | None:
        """Return the row under a key; None if there is none."""
        found = self._read(sa.select(_ROWS.c.data).where(_is_of(series), _ROWS.c.digest == _digest(key)))
        return found[0][0] if found else None

    def keys(self, series: SeriesKey) -> list[str]:
        """Return the keys of all rows."""
        return [key for (key,) in self._read(sa.select(_ROWS.c.key).where(_is_of(series)))]

    def count(self, series: SeriesKey) -> int:
        """Return how many rows a series has."""
        return int(self._read(sa.select(sa.func.count(_ROWS.c.id)).where(_is_of(series)))[0][0])

    def page(self, series: SeriesKey, last: int) -> list[tuple[int, str, str]]:
        """Return the number, key and data of the next rows after the one of a number."""
        rows = sa.select(_ROWS.c.id, _ROWS.c.key, _ROWS.c.data).where(_is_of(series), _ROWS.c.id > last)
        return self._read(rows.order_by(_ROWS.c.id).limit(_PAGE))

    def put(self, series: SeriesKey, about: str, rows: Mapping[str, str]) -> None:
        """Write rows by key, all or none; a series that is not there is made with this description."""

        def work(connection: sa.Connection) -> None:
            digest = _digest(*series)
            number = connection.execute(sa.select(_SERIES.c.id).where(_SERIES.c.digest == digest)).scalar()
            if number is None:
                kind, name = series
                made = sa.insert(_SERIES).values(kind=kind, name=name, digest=digest, about=about)
                number = connection.execute(made).inserted_primary_key[0]  # type: ignore[index]
            is_key = _ROWS.c.digest == sa.bindparam("of_key")
            update, insert = sa.update(_ROWS).where(_ROWS.c.series_id == number, is_key), sa.insert(_ROWS)
            for key, data in rows.items():
                digest = _digest(key)
                if not connection.execute(update, {"of_key": digest, "data": data}).rowcount:
                    connection.execute(insert, {"series_id": number, "digest": digest, "key": key, "data": data})

        self._transaction(work)

    def _read(self, statement: sa.Select[Any]) -> list[Any]:
        return self._transaction(lambda connection: list(connection.execute(statement)))

    def _transaction(self, work: Callable[[sa.Connection], _T]) -> _T:
        """Do something in one transaction; again if another connection made the same row or table meanwhile."""
        if self._is_closed:
            raise StoreError(self.place, f"The store {self.place} was closed. Open it again: ep.Store(...)")
        attempt = 0
        while True:
            attempt += 1
            try:
                return self._attempt(work)
            except SQLAlchemyError as error:
                if attempt == _ATTEMPTS or not _is_conflict(error):
                    raise StoreError(self.place, f"{self.place} {_reason(error, self.engine.url.password)}") from None
            time.sleep(attempt * _PAUSE_S * random.random())  # noqa: S311 - so that the two don't meet again

    def _attempt(self, work: Callable[[sa.Connection], _T]) -> _T:
        with self.engine.begin() as connection:
            # A file is opened for each transaction, and may have been deleted, moved or replaced since the last one.
            if not self._has_tables or (self._is_file and not sa.inspect(connection).has_table(_ROWS.name)):
                if self._has_tables:
                    _log.warning("%s was deleted, moved or replaced while it was open; it is made anew.", self.place)
                _METADATA.create_all(connection)
            found = work(connection)
        self._has_tables = True
        return found


# -- URL and connections ----------------------------------------------------------------------------------------------


def database_url(given: str | Path) -> sa.URL:
    """Return the URL of a database; a text without ``://`` is the path of a SQLite file.

    Raises
    ------
    StoreError
        There can be no such database.
    TypeError
        It is neither a path nor a URL.
    """
    if not isinstance(given, str | Path):
        raise InvalidType(f"A store is a path or a URL, not {given!r:.80}. Name a file: 'results.sqlite'.")
    if isinstance(given, Path) or "://" not in given:
        url = sa.URL.create("sqlite", database=str(Path(given).expanduser()) if str(given).strip() else "")
    else:
        try:
            url = sa.make_url(given)
        except (ArgumentError, ValueError):
            scheme = given.partition("://")[0] or "postgresql"
            text = (
                f"The URL {scheme}://... can't be read. It is {scheme}://user:password@host:port/database; "
                "special characters of a password are written as %40 for @, %3A for : and %2F for /."
            )
            # The text that could not be read has the password in it.
            raise StoreError(f"{scheme}://...", text) from None
    if url.get_backend_name() != "sqlite":
        return url.set(drivername=_DRIVERS.get(url.drivername, url.drivername))
    path = Path(url.database or "")
    reason = ""
    if url.database in (None, "", ":memory:") or url.query.get("mode") == "memory":
        reason = f"{str(given)!r} is no file, and what is in memory only is lost. Name one: 'results.sqlite'."
    elif path.exists() and not path.is_file():
        reason = f"{path} is no file. Name one: 'results.sqlite'."
    elif not str(path).startswith("file:") and not path.absolute().parent.is_dir():
        reason = f"There is no folder {path.absolute().parent} to store {path.name!r} in. Make it first."
    if reason:
        raise StoreError(str(path), reason)
    return url


def without_password(url: sa.URL) -> str:
    """Return a database's name in messages: a file by its path, others by URL without password and options."""
    if url.get_backend_name() == "sqlite":
        return str(url.database)
    return url.set(password=None, query={}).render_as_string()


def connect_options(url: sa.URL) -> dict[str, Any]:
    """Return the options of the driver that bound every wait."""
    if url.get_backend_name() == "sqlite":
        return {"timeout": _BUSY_S}
    if url.drivername in ("postgresql+psycopg", "postgresql+psycopg2"):
        return {"connect_timeout": _CONNECT_S, "tcp_user_timeout": 1000 * _BUSY_S}
    return {}


# -- errors -----------------------------------------------------------------------------------------------------------


def _is_conflict(error: Exception) -> bool:
    """Whether another connection came in between: it made the same key or table, or there was a deadlock."""
    cause = getattr(error, "orig", None)
    state = str(getattr(cause, "sqlstate", None) or "")
    # 40...: deadlocks; 42P07 and 42710: the table has just been made.
    is_state = state.startswith("40") or state in ("42P07", "42710")
    return is_state or isinstance(error, IntegrityError) or "already exists" in str(cause)


# Messages of drivers, and their meaning.
_MEANINGS: Final = (
    (r"not a database|malformed|encrypted", "is no SQLite file, or a damaged one: {}. Restore it, or name another."),
    (r"disk is full|No space|disk I/O|could not extend", "can't be written: {}. Make room on the disk."),
    (r"read-?only|unable to open|[Pp]ermission denied", "can't be opened or written: {}. Check the permissions."),
    (r"database is locked", "is locked by another process: {}. End it, or wait."),
    (r"password|authentication|role .* does not exist", "does not let you in: {}. Check user and password."),
    (r"database .* does not exist", "is not there: {}. Make it: createdb NAME"),
    (r"connect|resolve|host|server|closed|shut", "can't be reached: {}. Check that it runs, and the URL."),
)


def _reason(error: Exception, password: object) -> str:
    """Return the driver's message in one line, without statement and password, and with a way out."""
    message = re.sub(r"\s+", " ", str(getattr(error, "orig", None) or error)).strip()[:500].rstrip(".?")
    if password:
        message = message.replace(str(password), "***")
    meanings = (meaning for pattern, meaning in _MEANINGS if re.search(pattern, message))
    return next(meanings, "refused: {}.").format(message)
