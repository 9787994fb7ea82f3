"""How is a database opened, written to and read, and what is said when that fails?"""

from __future__ import annotations

import random
import re
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from epypes.errors import StoreError
from epypes.store.onefile import OneFile, file_of
from epypes.store.place import connect_options, file_path, shown, url_of

if TYPE_CHECKING:
    from sqlalchemy import URL, Connection, Engine
    from sqlalchemy.exc import SQLAlchemyError

_T = TypeVar("_T")

# Two that make the tables, or write one key, at the same moment: one of them begins again.
_TRIES: Final = 8
_AGAIN_S: Final = 0.02
_NOWHERE: Final = object()


class Database:
    """An opened database in which the tables are.

    Parameters
    ----------
    given
        A path or a URL.

    Raises
    ------
    StoreError
        It can't be opened, or was made by a newer EPypes.
    """

    def __init__(self, given: str | Path) -> None:
        self._url = url_of(given)
        self.place = shown(self._url)
        self.engine = engine_of(self._url)
        self._made_in: object = _NOWHERE
        self._is_closed = False
        try:
            self.write(lambda _connection: None)
        except BaseException:
            self.engine.dispose()
            raise

    def _make_tables(self, connection: Connection) -> None:
        from sqlalchemy import insert, select

        from epypes.store import tables

        tables.metadata.create_all(connection)
        version = connection.execute(select(tables.schema.c.version)).scalar()
        if version is None:
            connection.execute(insert(tables.schema).values(id=1, version=tables.SCHEMA))
        elif version != tables.SCHEMA:
            raise StoreError(self.place, self._other_version(version, tables.SCHEMA))

    def _other_version(self, found: int, known: int) -> str:
        who, way_out = "an older", "Store in another one, or use that EPypes."
        if found > known:
            who, way_out = "a newer", "Update: pip install --upgrade epypes"
        return f"{self.place} was made by {who} EPypes: its tables have version {found}, here it is {known}. {way_out}"

    def _done(self, work: Callable[[Connection], _T]) -> _T:
        """Do something in one transaction, in a database that has the tables."""
        with self.engine.begin() as connection:
            file = file_of(connection)
            if file != self._made_in:
                self._make_tables(connection)
            found = work(connection)
        self._made_in = file
        return found

    def write(self, work: Callable[[Connection], _T]) -> _T:
        """Do something in one transaction: all of it is written, or nothing; again if another came in between.

        Raises
        ------
        StoreError
            It can't be written, or was closed.
        """
        from sqlalchemy.exc import SQLAlchemyError

        if self._is_closed:
            raise StoreError(self.place, f"The store {self.place} was closed. Open it again: ep.Store(...)")
        tries = 0
        while True:
            tries += 1
            try:
                return self._done(work)
            except SQLAlchemyError as error:
                if tries == _TRIES or not _may_be_another(error):
                    raise self._told(error) from None
            time.sleep(tries * _AGAIN_S * random.random())  # noqa: S311 - so that two don't meet again

    def read(self, work: Callable[[Connection], _T]) -> _T:
        """Read something.

        Raises
        ------
        StoreError
            It can't be read, or was closed.
        """
        # In a file that was made anew meanwhile there are the tables to be made first.
        return self.write(work)

    def close(self) -> None:
        """Have nothing written or read any more."""
        self._is_closed = True
        self.engine.dispose()

    def _told(self, error: SQLAlchemyError) -> StoreError:
        said = _said(error)
        if self._url.password:
            said = said.replace(str(self._url.password), "***")
        return StoreError(self.place, f"{self.place} {_plainly(said)}")


def engine_of(url: URL) -> Engine:
    """Return what connects to a database, which is not looked for yet.

    Raises
    ------
    StoreError
        There is no driver for it.
    """
    from sqlalchemy import create_engine, event
    from sqlalchemy.exc import ArgumentError, NoSuchModuleError

    try:
        # Pinged, so that a server that was restarted is found again.
        options = connect_options(url)
        engine = create_engine(url, connect_args=options, hide_parameters=True, pool_pre_ping=True)
    except (NoSuchModuleError, ImportError, ArgumentError) as error:
        raise StoreError(shown(url), _no_driver(url, error)) from None
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _set_up_sqlite)
        if (path := file_path(url)) is not None:
            OneFile(path).watch(engine)
    return engine


def check_place(given: str | Path) -> None:
    """Raise StoreError if there can be no such database; whether it answers is not tried."""
    engine_of(url_of(given)).dispose()


def _no_driver(url: URL, error: Exception) -> str:
    kind, driver = url.get_backend_name(), url.drivername.partition("+")[2]
    way_out = "pip install 'epypes[postgres]'" if driver == "psycopg" else f"Install a driver of {kind}"
    missing = getattr(error, "name", None)
    what = f"module {missing!r} is not installed" if missing else f"SQLAlchemy knows no {url.drivername!r}"
    return f"{shown(url)} can't be opened: {what}. {way_out}, or store in a file: 'results.sqlite'."


def _set_up_sqlite(connection: Any, _record: object) -> None:
    """Have readers not wait for writers; what a power failure may take is the last rows, never the file."""
    connection.execute("PRAGMA synchronous=NORMAL")
    for tries in range(1, _TRIES + 1):
        if connection.execute("PRAGMA journal_mode").fetchone()[0] == "wal":
            return
        try:
            connection.execute("PRAGMA journal_mode=WAL")
        except sqlite3.OperationalError as error:
            # SQLite does not wait here for another that changes it just now.
            if tries == _TRIES or "locked" not in str(error):
                raise
            time.sleep(tries * _AGAIN_S)


def _said(error: SQLAlchemyError) -> str:
    """Return what the driver says, in one line, without the statement."""
    text = str(getattr(error, "orig", None) or error)
    return re.sub(r"\s+", " ", text).strip()[:500].rstrip(".?")


def _may_be_another(error: SQLAlchemyError) -> bool:
    """Whether it was another writer who came in between: the same key or table, or a deadlock."""
    from sqlalchemy.exc import IntegrityError

    cause = getattr(error, "orig", None)
    state = str(getattr(cause, "sqlstate", None) or "")
    # 40...: deadlocks; 42P07 and 42710: the table has just been made.
    is_state = state.startswith("40") or state in ("42P07", "42710")
    return is_state or isinstance(error, IntegrityError) or "already exists" in str(cause)


# What drivers say, and what that means.
_MEANINGS: Final = (
    (r"not a database|malformed|encrypted", "is no SQLite file, or a damaged one: {}. Restore it, or name another."),
    (r"disk is full|No space|disk I/O|could not extend", "can't be written: {}. Make room on the disk."),
    (r"read-?only|unable to open|[Pp]ermission denied", "can't be opened or written: {}. Check who may."),
    (r"database is locked", "is locked by another process: {}. End it, or wait."),
    (r"password|authentication|role .* does not exist", "does not let you in: {}. Check user and password."),
    (r"database .* does not exist", "is not there: {}. Make it: createdb NAME"),
    (r"connect|resolve|host|server|closed|shut", "can't be reached: {}. Check that it runs, and the URL."),
)


def _plainly(said: str) -> str:
    for pattern, meaning in _MEANINGS:
        if re.search(pattern, said):
            return meaning.format(said)
    return f"refused: {said}."
