"""Where are results and history kept, and which are there?"""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, overload

from epypes.store.database import Database
from epypes.store.jsontext import from_word
from epypes.store.series import Series

if TYPE_CHECKING:
    from sqlalchemy import URL


class Store:
    """A database of series of rows; a context manager.

    Parameters
    ----------
    place
        The path of a SQLite file, made if it is not there, or the URL of a database as SQLAlchemy writes it:
        ``"postgresql://user:password@host/database"``.

    Raises
    ------
    StoreError
        It can't be opened; the text says why, and never the password.
    TypeError
        It is neither a path nor a URL.

    Notes
    -----
    Any thread may use it, and many processes at the same time. Its tables are made when it is opened; their names
    begin with ``epypes_``, so it may share a database with others. A file that is deleted, moved or replaced while it
    is open is told in the log; what comes from then on is written to the file of that name, made anew if need be.
    """

    def __init__(self, place: str | Path) -> None:
        self._database = Database(place)
        # A store that nobody closed, as in a notebook, leaves no connection behind.
        weakref.finalize(self, self._database.engine.dispose)

    @property
    def place(self) -> str:
        """The path, or the URL without its password."""
        return self._database.place

    @property
    def url(self) -> URL:
        """What SQLAlchemy opens it by, with its password: for another library that is to use the same database."""
        return self._database.engine.url

    def series(self, kind: str, name: str, *, about: Mapping[str, Any] | None = None) -> Series:
        """Return the series of a kind and a name.

        Parameters
        ----------
        kind
            ``"map"``, ``"sweep"``, ``"check"``, ``"tuning"``, ``"events"``, or a word of your own.
        about
            What is said of a series, which is then made if it is not there; one that is keeps what was said of it.
            Without, its first row makes it, so that to look for a series is not to make it.

        Raises
        ------
        StoreError
            The database can't be read or written.
        """
        return Series(self._database, kind, name, about)

    def kinds(self) -> tuple[str, ...]:
        """Return of which kinds there are series, sorted."""
        return tuple(sorted({kind for kind, _ in self._names()}))

    def names(self, kind: str) -> tuple[str, ...]:
        """Return the names of the series of a kind, in the order in which they were made."""
        return tuple(name for found, name in self._names() if found == kind)

    def _names(self) -> list[tuple[str, str]]:
        from sqlalchemy import select

        from epypes.store.tables import series

        wanted = select(series.c.kind, series.c.name).order_by(series.c.id)
        found = self._database.read(lambda connection: list(connection.execute(wanted)))
        return [(from_word(kind), from_word(name)) for kind, name in found]

    def close(self) -> None:
        """Close it; a second time does nothing. It and its series can't be read or written any more."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Store {self.place[-70:]!r}>"


@overload
def as_store(given: str | Path | Store) -> Store: ...


@overload
def as_store(given: None) -> None: ...


@overload
def as_store(given: str | Path | Store | None) -> Store | None: ...


def as_store(given: str | Path | Store | None) -> Store | None:
    """Return the store that is meant by a path, a URL or a Store; None stays None.

    Raises
    ------
    StoreError
        It can't be opened.
    """
    if given is None or isinstance(given, Store):
        return given
    if not isinstance(given, str | Path):
        raise TypeError(f"store= must be a path, a URL or an ep.Store, not {type(given).__name__!r}.")
    return Store(given)


@contextmanager
def opened_store(given: str | Path | Store | None) -> Iterator[Store | None]:
    """Have the store that is meant, and close it afterwards if it was opened for this; a given Store stays open.

    Raises
    ------
    StoreError
        It can't be opened.
    """
    store = as_store(given)
    try:
        yield store
    finally:
        if store is not None and store is not given:
            store.close()
