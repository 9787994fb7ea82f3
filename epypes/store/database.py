"""The database of a store: its URL, tables, statements and transactions, and its errors in plain words."""

from __future__ import annotations

import hashlib
import logging
import os
import random
import re
import sqlite3
import time
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

import sqlalchemy as sa
from sqlalchemy.dialects.mysql import LONGTEXT
from sqlalchemy.exc import ArgumentError, DisconnectionError, IntegrityError, NoSuchModuleError, SQLAlchemyError

from epypes.errors import StoreError

_T = TypeVar("_T")
_log = logging.getLogger(__name__)

# Raised when the tables change; a database of another version is refused.
SCHEMA: Final = 1
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
_SCHEMAS: Final = sa.Table(
    "epypes_schema",
    _METADATA,
    sa.Column("id", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("version", sa.Integer, nullable=False),
)
# Names can be longer than an index takes, so their digests are what is unique.
_SERIES: Final = sa.Table(
    "epypes_series",
    _METADATA,
    sa.Column("id", _NUMBER, primary_key=True),
    sa.Column("digest", sa.String(64), nullable=False, unique=True),
    sa.Column("kind", sa.Text, nullable=False),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("about", _LONG_TEXT, nullable=False),
    sa.Column("made_ns", sa.BigInteger, nullable=False),
)
_ROWS: Final = sa.Table(
    "epypes_rows",
    _METADATA,
    sa.Column("id", _NUMBER, primary_key=True),
    sa.Column("series_id", _NUMBER, sa.ForeignKey("epypes_series.id"), nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("key", sa.Text, nullable=False),
    sa.Column("data", _LONG_TEXT, nullable=False),
    sa.Column("written_ns", sa.BigInteger, nullable=False),
    sa.UniqueConstraint("series_id", "digest", name="epypes_rows_once"),
)

# Made once, since to make a statement takes three times as long as to execute it.
_FIND_SERIES: Final = sa.select(_SERIES.c.id, _SERIES.c.about).where(_SERIES.c.digest == sa.bindparam("digest"))
_SERIES_ID: Final = sa.select(_SERIES.c.id).where(_SERIES.c.digest == sa.bindparam("series")).scalar_subquery()
_OF_SERIES: Final = _ROWS.c.series_id == _SERIES_ID
_ROW: Final = sa.select(_ROWS.c.data).where(_OF_SERIES, _ROWS.c.digest == sa.bindparam("digest"))
_KEYS: Final = sa.select(_ROWS.c.key).where(_OF_SERIES)
_COUNT: Final = sa.select(sa.func.count(_ROWS.c.id)).where(_OF_SERIES)
_ROWS_AFTER: Final = (
    sa.select(_ROWS.c.id, _ROWS.c.key, _ROWS.c.data)
    .where(_OF_SERIES, _ROWS.c.id > sa.bindparam("last"))
    .order_by(_ROWS.c.id)
    .limit(_PAGE)
)
_UPDATE: Final = sa.update(_ROWS).where(
    _ROWS.c.series_id == sa.bindparam("of_series"), _ROWS.c.digest == sa.bindparam("of_key")
)
_INSERT: Final = sa.insert(_ROWS)

# Kind and name, both escaped.
SeriesKey = tuple[str, str]
# In the `info` of a connection: whether its database has the tables; of SQLite, the identities of its files.
_HAS_TABLES: Final = "epypes_has_tables"
_IDENTITIES: Final = "epypes_identities"


def _digest(*texts: str) -> str:
    """Return the digest by which an index knows these texts."""
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()


class Database:
    """An open database with the tables of a store; any thread may use it.

    Parameters
    ----------
    given
        A path or a URL.

    Raises
    ------
    StoreError
        It can't be opened, or was made by another version of EPypes. All other methods raise it too.
    """

    def __init__(self, given: str | Path) -> None:
        url = database_url(given)
        self.place = without_password(url)
        self.engine = _create_engine(url)
        self._is_closed = False
        # A store that is never closed, as in a notebook, leaves no connection behind.
        weakref.finalize(self, self.engine.dispose)
        try:
            self._transaction(lambda _connection: None)
        except BaseException:
            self.engine.dispose()
            raise

    def close(self) -> None:
        """Refuse all reading and writing from now on."""
        self._is_closed = True
        self.engine.dispose()

    def series_names(self) -> list[tuple[str, str]]:
        """Return kind and name of all series, in the order in which they were made."""
        return self._read(sa.select(_SERIES.c.kind, _SERIES.c.name).order_by(_SERIES.c.id))

    def about(self, series: SeriesKey, new: str | None = None) -> str | None:
        """Return the description of a series; with a new description, a series that is not there is made."""

        def work(connection: sa.Connection) -> str | None:
            found = connection.execute(_FIND_SERIES, {"digest": _digest(*series)}).one_or_none()
            if found is None and new is not None:
                _make_series(connection, series, new)
            return new if found is None else str(found.about)

        return self._transaction(work)

    def row(self, series: SeriesKey, key: str) -> str | None:
        """Return the text of a row; None if there is none under this key."""
        found = self._read(_ROW, series=_digest(*series), digest=_digest(key))
        return found[0][0] if found else None

    def keys(self, series: SeriesKey) -> list[str]:
        """Return the keys of all rows."""
        return [key for (key,) in self._read(_KEYS, series=_digest(*series))]

    def count(self, series: SeriesKey) -> int:
        """Return how many rows a series has."""
        return int(self._read(_COUNT, series=_digest(*series))[0][0])

    def page(self, series: SeriesKey, last: int) -> list[tuple[int, str, str]]:
        """Return the number, key and text of the next rows after the one of a number."""
        return self._read(_ROWS_AFTER, series=_digest(*series), last=last)

    def put(self, series: SeriesKey, about: str, texts: Mapping[str, str]) -> None:
        """Write rows by key, all or none; a series that is not there is made with this description."""

        def work(connection: sa.Connection) -> None:
            found = connection.execute(_FIND_SERIES, {"digest": _digest(*series)}).one_or_none()
            number = _make_series(connection, series, about) if found is None else found.id
            now_ns = time.time_ns()
            for key, text in texts.items():
                digest, values = _digest(key), {"data": text, "written_ns": now_ns}
                updated = connection.execute(_UPDATE, {"of_series": number, "of_key": digest, **values})
                if not updated.rowcount:
                    connection.execute(_INSERT, {"series_id": number, "digest": digest, "key": key, **values})

        self._transaction(work)

    def _read(self, statement: sa.Select[Any], **values: Any) -> list[Any]:
        return self._transaction(lambda connection: list(connection.execute(statement, values)))

    def _transaction(self, work: Callable[[sa.Connection], _T]) -> _T:
        """Do something in one transaction; again if another connection made the same row or table meanwhile."""
        if self._is_closed:
            raise StoreError(self.place, f"The store {self.place} was closed. Open it again: ep.Store(...)")
        attempt = 0
        while True:
            attempt += 1
            try:
                with self.engine.begin() as connection:
                    info = connection.info
                    if _HAS_TABLES not in info:
                        self._make_tables(connection)
                    found = work(connection)
                info[_HAS_TABLES] = True
                return found
            except SQLAlchemyError as error:
                if attempt == _ATTEMPTS or not _is_conflict(error):
                    raise StoreError(self.place, f"{self.place} {_reason(error, self.engine.url.password)}") from None
            time.sleep(attempt * _PAUSE_S * random.random())  # noqa: S311 - so that the two don't meet again

    def _make_tables(self, connection: sa.Connection) -> None:
        _METADATA.create_all(connection)
        version = connection.execute(sa.select(_SCHEMAS.c.version)).scalar()
        if version is None:
            connection.execute(sa.insert(_SCHEMAS).values(id=1, version=SCHEMA))
        elif version != SCHEMA:
            versions = f"its tables have version {version}, here it is {SCHEMA}"
            text = f"{self.place} was made by a newer EPypes: {versions}. Update: pip install --upgrade epypes"
            raise StoreError(self.place, text)


def _make_series(connection: sa.Connection, series: SeriesKey, about: str) -> int:
    kind, name = series
    values = {"kind": kind, "name": name, "digest": _digest(*series), "about": about, "made_ns": time.time_ns()}
    number: Any = connection.execute(sa.insert(_SERIES).values(**values)).inserted_primary_key
    return int(number[0])


# -- the URL ----------------------------------------------------------------------------------------------------------


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
        raise TypeError(f"A store is a path or a URL, not {given!r:.80}. Name a file: 'results.sqlite'.")
    if not isinstance(given, str) or "://" not in given:
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
    if url.database in (None, "", ":memory:") or url.query.get("mode") == "memory":
        text = f"{str(given)!r} is no file, and what is in memory only is lost. Name one: 'results.sqlite'."
        raise StoreError(str(given), text)
    if not str(url.database).startswith("file:"):
        _check_file(Path(str(url.database)))
    return url


def _check_file(path: Path) -> None:
    folder = path.absolute().parent
    if path.is_dir():
        raise StoreError(str(path), f"{path} is a folder. Name a file in it: {path / 'results.sqlite'}")
    if path.exists() and not path.is_file():
        raise StoreError(str(path), f"{path} is no file but a device or a pipe. Name a file: 'results.sqlite'.")
    if not folder.is_dir():
        raise StoreError(str(path), f"There is no folder {folder} to store {path.name!r} in. Make it first.")


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


# -- connections ------------------------------------------------------------------------------------------------------


def check_database(given: str | Path) -> None:
    """Raise StoreError if there can be no such database; whether it answers is not tried."""
    _create_engine(database_url(given)).dispose()


def _create_engine(url: sa.URL) -> sa.Engine:
    """Return what connects to a database; no connection is made yet."""
    try:
        # Pinged, so that a server that was restarted is found again.
        engine = sa.create_engine(url, connect_args=connect_options(url), hide_parameters=True, pool_pre_ping=True)
    except (NoSuchModuleError, ImportError, ArgumentError) as error:
        kind, driver = url.get_backend_name(), url.drivername.partition("+")[2]
        way_out = "pip install 'epypes[postgres]'" if driver == "psycopg" else f"Install a driver of {kind}"
        missing = getattr(error, "name", None)
        reason = f"module {missing!r} is not installed" if missing else f"SQLAlchemy knows no {url.drivername!r}"
        name = without_password(url)
        text = f"{name} can't be opened: {reason}. {way_out}, or store in a file: 'results.sqlite'."
        raise StoreError(name, text) from None
    if engine.dialect.name == "sqlite":
        sa.event.listen(engine, "connect", _open_file)
        sa.event.listen(engine, "checkout", _check_identity)
    return engine


def _open_file(connection: Any, record: Any) -> None:
    """Use a write-ahead log, so that readers and writers don't wait for each other; note which files are open.

    A power failure may take the last rows, never the file.
    """
    connection.execute("PRAGMA synchronous=NORMAL")
    # SQLite refuses at once while another connection changes it, and the file keeps what that one sets.
    with suppress(sqlite3.OperationalError):
        connection.execute("PRAGMA journal_mode=WAL")
    # SQLite opens the files beside it with the first query.
    connection.execute("SELECT 1 FROM sqlite_master").fetchall()
    path = connection.execute("PRAGMA database_list").fetchone()[2]
    record.info[_IDENTITIES] = {name: _identity(name) for name in (path, f"{path}-wal", f"{path}-shm")}


def _check_identity(connection: Any, record: Any, _fairy: object) -> None:
    """Have a connection reopen its file if another one is at the path: a deleted file would take rows silently."""
    (path, identity), *beside = record.info[_IDENTITIES].items()
    if _identity(path) == identity:
        return
    _log.warning(
        "%s was deleted, moved or replaced while it was open. Later rows are written to the file of that "
        "name, which is made anew if there is none; earlier rows are not in it.",
        path,
    )
    # The old file is completed. Its log, left beside its old path, would be taken for the new file's.
    with suppress(sqlite3.Error):  # it may be on no disk any more
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    for name, identity in beside:
        if identity is not None and _identity(name) == identity:
            with suppress(OSError):
                os.unlink(name)
    raise DisconnectionError(f"{path} is another file now.")


def _identity(path: str) -> tuple[int, int] | None:
    """Return the device and number of the file that is at a path now; None if there is none."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


# -- errors -----------------------------------------------------------------------------------------------------------


def _is_conflict(error: SQLAlchemyError) -> bool:
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


def _reason(error: SQLAlchemyError, password: object) -> str:
    """Return the driver's message in one line, without statement and password, and with a way out."""
    message = re.sub(r"\s+", " ", str(getattr(error, "orig", None) or error)).strip()[:500].rstrip(".?")
    if password:
        message = message.replace(str(password), "***")
    meanings = (meaning for pattern, meaning in _MEANINGS if re.search(pattern, message))
    return next(meanings, "refused: {}.").format(message)
