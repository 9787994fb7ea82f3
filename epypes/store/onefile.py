"""Is the SQLite file that a connection has open still the one at its path?

A file that is deleted or moved stays there for whoever has it open: what is written to it is in no folder any more.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sqlalchemy import Connection, Engine

_log = logging.getLogger(__name__)

# Of what SQLAlchemy knows of a connection.
_FOUND: Final = "epypes_found"
_FILE: Final = "epypes_file"
# SQLite writes beside a file what is not in it yet, and where that is.
_BESIDE: Final = ("-wal", "-shm")

_Identity = tuple[int, int] | None


class OneFile:
    """Has connections follow the file at a path; what has to be made in a new one is known by its number.

    Parameters
    ----------
    path
        Of the file.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        # A new file may be known to the disk by the very number of the one that was deleted.
        self._count, self._lock = 0, threading.Lock()

    def watch(self, engine: Engine) -> None:
        """Look at the file when a connection is made, and each time before one is used."""
        from sqlalchemy import event

        event.listen(engine, "connect", self._connected)
        event.listen(engine, "checkout", self._checked)

    def _connected(self, connection: Any, record: Any) -> None:
        # SQLite opens what is beside the file with the first look into it.
        connection.execute("SELECT 1 FROM sqlite_master").fetchall()
        record.info[_FILE] = self._count
        record.info[_FOUND] = {ending: _identity(self._path + ending) for ending in ("", *_BESIDE)}

    def _checked(self, connection: Any, record: Any, _fairy: object) -> None:
        from sqlalchemy.exc import DisconnectionError

        found: Mapping[str, _Identity] = record.info[_FOUND]
        if _identity(self._path) == found[""]:
            return
        with self._lock:
            if record.info[_FILE] == self._count:
                self._count += 1
                _log.warning(
                    "%s was deleted, moved or replaced while it was open. What comes from now on is written to the "
                    "file of that name, which is made anew if there is none; what was written before is not in it.",
                    self._path,
                )
            self._leave(connection, found)
        raise DisconnectionError(f"{self._path} is another file now.")

    def _leave(self, connection: Any, found: Mapping[str, _Identity]) -> None:
        """Complete the file that is left; what is left beside its old path would be taken for the new one's."""
        with suppress(Exception):  # it may be on no disk any more
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        for ending in _BESIDE:
            if found[ending] is not None and _identity(self._path + ending) == found[ending]:
                with suppress(OSError):
                    os.unlink(self._path + ending)


def _identity(path: str) -> _Identity:
    """Return what tells a file from any other that is there now; None if it can't be seen."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def file_of(connection: Connection) -> int | None:
    """Return the number of the file that a connection writes to; None if that is no file."""
    number: int | None = connection.info.get(_FILE)
    return number
