"""Tables, statements and transactions of a store's database, and its errors in plain words."""

from __future__ import annotations

import hashlib
import logging
import os
import random
import re
import sqlite3
import threading
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
from epypes.store.place import connect_options, shown, url_of

_T = TypeVar("_T")
_log = logging.getLogger(__name__)

# Raised when the tables change; a database of another version is refused.
SCHEMA: Final = 1
# Rows read at a time, so that a long series is never in memory as a whole.
_PAGE: Final = 500
# If two connections make the tables, or write one key, at the same moment, one of them begins again.
_TRIES: Final = 8
_PAUSE_S: Final = 0.02

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
_EXISTING: Final = sa.select(_ROWS.c.digest).where(
    _ROWS.c.series_id == sa.bindparam("id"), _ROWS.c.digest.in_(sa.bindparam("digests", expanding=True))
)
_UPDATE: Final = sa.update(_ROWS).where(
    _ROWS.c.series_id == sa.bindparam("of_series"), _ROWS.c.digest == sa.bindparam("of_key")
)
_INSERT: Final = sa.insert(_ROWS)

# Kind and name, both escaped.
SeriesKey = tuple[str, str]


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
        self.place = shown(url_of(given))
        self.engine = _engine_of(url_of(given))
        self._file_with_tables: object = self
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
        rows = [{"digest": _digest(key), "key": key, "data": text} for key, text in texts.items()]

        def work(connection: sa.Connection) -> None:
            found = connection.execute(_FIND_SERIES, {"digest": _digest(*series)}).one_or_none()
            number, now_ns = _make_series(connection, series, about) if found is None else found.id, time.time_ns()
            for first in range(0, len(rows), _PAGE):
                page = rows[first : first + _PAGE]
                digests = [row["digest"] for row in page]
                existing = set(connection.execute(_EXISTING, {"id": number, "digests": digests}).scalars())
                new = [row for row in page if row["digest"] not in existing]
                old = [row for row in page if row["digest"] in existing]
                if new:
                    connection.execute(_INSERT, [{"series_id": number, "written_ns": now_ns, **row} for row in new])
                if old:
                    connection.execute(_UPDATE, [_update(number, now_ns, row) for row in old])

        self._transaction(work)

    def _read(self, statement: sa.Select[Any], **values: Any) -> list[Any]:
        return self._transaction(lambda connection: list(connection.execute(statement, values)))

    def _transaction(self, work: Callable[[sa.Connection], _T]) -> _T:
        """Do something in one transaction; again if another connection made the same row or table meanwhile."""
        if self._is_closed:
            raise StoreError(self.place, f"The store {self.place} was closed. Open it again: ep.Store(...)")
        tries = 0
        while True:
            tries += 1
            try:
                with self.engine.begin() as connection:
                    file = connection.info.get(_FILE)
                    if file != self._file_with_tables:
                        self._make_tables(connection)
                    found = work(connection)
                self._file_with_tables = file
                return found
            except SQLAlchemyError as error:
                if tries == _TRIES or not _is_conflict(error):
                    raise StoreError(self.place, f"{self.place} {_reason(error, self.engine.url.password)}") from None
            time.sleep(tries * _PAUSE_S * random.random())  # noqa: S311 - so that the two don't meet again

    def _make_tables(self, connection: sa.Connection) -> None:
        _METADATA.create_all(connection)
        version = connection.execute(sa.select(_SCHEMAS.c.version)).scalar()
        if version is None:
            connection.execute(sa.insert(_SCHEMAS).values(id=1, version=SCHEMA))
        elif version != SCHEMA:
            author, way_out = "an older", "Store in another one, or use that EPypes."
            if version > SCHEMA:
                author, way_out = "a newer", "Update: pip install --upgrade epypes"
            versions = f"its tables have version {version}, here it is {SCHEMA}"
            raise StoreError(self.place, f"{self.place} was made by {author} EPypes: {versions}. {way_out}")


def _make_series(connection: sa.Connection, series: SeriesKey, about: str) -> int:
    kind, name = series
    values = {"kind": kind, "name": name, "digest": _digest(*series), "about": about, "made_ns": time.time_ns()}
    number: Any = connection.execute(sa.insert(_SERIES).values(**values)).inserted_primary_key
    return int(number[0])


def _update(series_id: int, now_ns: int, row: Mapping[str, str]) -> dict[str, Any]:
    return {"of_series": series_id, "of_key": row["digest"], "data": row["data"], "written_ns": now_ns}


# -- connections ------------------------------------------------------------------------------------------------------


def check_place(given: str | Path) -> None:
    """Raise StoreError if there can be no such database; whether it answers is not tried."""
    _engine_of(url_of(given)).dispose()


def _engine_of(url: sa.URL) -> sa.Engine:
    """Return what connects to a database; no connection is made yet."""
    try:
        # Pinged, so that a server that was restarted is found again.
        engine = sa.create_engine(url, connect_args=connect_options(url), hide_parameters=True, pool_pre_ping=True)
    except (NoSuchModuleError, ImportError, ArgumentError) as error:
        kind, driver = url.get_backend_name(), url.drivername.partition("+")[2]
        way_out = "pip install 'epypes[postgres]'" if driver == "psycopg" else f"Install a driver of {kind}"
        missing = getattr(error, "name", None)
        reason = f"module {missing!r} is not installed" if missing else f"SQLAlchemy knows no {url.drivername!r}"
        text = f"{shown(url)} can't be opened: {reason}. {way_out}, or store in a file: 'results.sqlite'."
        raise StoreError(shown(url), text) from None
    if engine.dialect.name == "sqlite":
        files = _FileTracker(str(url.database))
        sa.event.listen(engine, "connect", _use_wal)
        sa.event.listen(engine, "connect", files.on_connect)
        sa.event.listen(engine, "checkout", files.on_checkout)
    return engine


def _use_wal(connection: Any, _record: object) -> None:
    """Use a write-ahead log, so that readers and writers don't wait for each other.

    A power failure may take the last rows, never the file.
    """
    connection.execute("PRAGMA synchronous=NORMAL")
    for tries in range(1, _TRIES + 1):
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            return
        except sqlite3.OperationalError as error:
            # SQLite does not wait here for another connection that changes it just now.
            if tries == _TRIES or "locked" not in str(error):
                raise
            time.sleep(tries * _PAUSE_S)


# In the `info` of a connection: the number of its file, and its path and identities.
_FILE, _FOUND = "epypes_file", "epypes_found"
# SQLite writes beside a file what is not in it yet.
_BESIDE: Final = ("-wal", "-shm")


class _FileTracker:
    """Has an engine's connections follow the file at a path, since a deleted file stays open and takes rows silently.

    Files are numbered, since the disk may give a new file the identity of the one that was deleted.
    """

    def __init__(self, name: str) -> None:
        # A link, which may lead to another file later; a URL of SQLite has no link in it.
        self._link = "" if name.startswith("file:") else os.path.abspath(name)
        self._count, self._lock = 0, threading.Lock()

    def on_connect(self, connection: Any, record: Any) -> None:
        # SQLite opens the files beside it with the first query.
        connection.execute("SELECT 1 FROM sqlite_master").fetchall()
        path = connection.execute("PRAGMA database_list").fetchone()[2]
        record.info[_FILE] = self._count
        record.info[_FOUND] = path, {ending: _identity(path + ending) for ending in ("", *_BESIDE)}

    def on_checkout(self, connection: Any, record: Any, _fairy: object) -> None:
        path, found = record.info[_FOUND]
        if _identity(self._link or path) == found[""]:
            return
        with self._lock:
            if record.info[_FILE] == self._count:
                self._count += 1
                _log.warning(
                    "%s was deleted, moved or replaced while it was open. Later rows are written to the file of that "
                    "name, which is made anew if there is none; earlier rows are not in it.",
                    self._link or path,
                )
            # The old file is completed. Its log, left beside its old path, would be taken for the new file's.
            with suppress(sqlite3.Error):  # it may be on no disk any more
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            for ending in _BESIDE:
                if found[ending] is not None and _identity(path + ending) == found[ending]:
                    with suppress(OSError):
                        os.unlink(path + ending)
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
