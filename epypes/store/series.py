"""What is a series: rows under keys, each written once?"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import StoreError
from epypes.optional import optional_import
from epypes.store.jsontext import from_text, from_word, to_text, to_word
from epypes.store.onefile import file_of

if TYPE_CHECKING:
    import pandas as pd
    from sqlalchemy import Connection, Select

    from epypes.store.database import Database

# Read at a time, so that a long series is never in memory as a whole.
_PAGE: Final = 500
# The number of no series.
_NONE: Final = 0


@dataclass(frozen=True, slots=True)
class _Entry:
    """What a database knows of a series; one in which it was made anew may know it by another number."""

    file: int | None
    number: int
    about: str


class Series:
    """Rows of one kind under one name; `Store.series` gives it.

    A row is a mapping under a key: numbers (NaN and infinities too), texts, truth values, None, lists and dicts.
    Written under a key that is there already, it takes the place of the earlier one. Any thread may use it, and many
    processes may write to one series at the same time.
    """

    def __init__(self, database: Database, kind: str, name: str, about: Mapping[str, Any] | None = None) -> None:
        self._database, self.kind, self.name = database, kind, name
        self._about = self._text("about", about or {})
        # None as long as nobody has made it: to look for a series is not to make it.
        self._entry: _Entry | None = None
        self._take(database.read(self._found) if about is None else database.write(self._made))

    def _take(self, entry: _Entry | None) -> None:
        """Know from now on what the database knows of this series, and go on with what is said of it there."""
        if entry is not None:
            self._entry, self._about = entry, entry.about

    def _made(self, connection: Connection) -> _Entry:
        """Return the entry of this series; it is made if it is not there."""
        from sqlalchemy import insert

        from epypes.store.tables import digest_of, series

        found = self._found(connection)
        if found is None:
            kind, name = to_word(self.kind), to_word(self.name)
            values = {"kind": kind, "name": name, "digest": digest_of(kind, name)}
            made = insert(series).values(**values, about=self._about, made_ns=time.time_ns())
            number: Any = connection.execute(made).inserted_primary_key
            found = _Entry(file_of(connection), number[0], self._about)
        return found

    def _found(self, connection: Connection) -> _Entry | None:
        """Return the entry of this series in the file that is there now; None if it is not there."""
        from sqlalchemy import select

        from epypes.store.tables import digest_of, series

        digest = digest_of(to_word(self.kind), to_word(self.name))
        found = connection.execute(select(series.c.id, series.c.about).where(series.c.digest == digest)).one_or_none()
        return None if found is None else _Entry(file_of(connection), found[0], found[1])

    def _number(self, connection: Connection) -> int:
        """Return the number of this series in the file that is there now, to read it."""
        found = self._known(connection) or self._found(connection)
        return _NONE if found is None else found.number

    def _known(self, connection: Connection) -> _Entry | None:
        """Return the entry that is known; None if there is none, or it is of another file than the one there now."""
        entry = self._entry
        return entry if entry is not None and entry.file == file_of(connection) else None

    @property
    def about(self) -> Mapping[str, Any]:
        """What was said of the series when it was made."""
        if self._entry is None:
            self._take(self._database.read(self._found))
        about: dict[str, Any] = from_text(self._about)
        return about

    # -- writing ------------------------------------------------------------------------------------------------

    def append(self, key: str, data: Mapping[str, Any]) -> None:
        """Write a row under a key; if there is one, it is replaced.

        Raises
        ------
        StoreError
            It can't be written: the database is away, or the disk full.
        TypeError
            There is something in data that JSON has no word for.
        """
        self.append_all([(key, data)])

    def append_all(self, rows: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
        """Write several rows, as pairs of key and data: all of them, or none.

        Raises
        ------
        StoreError, TypeError
            As `append`.
        """
        # The last one of a key is the one that stays.
        found = {row["digest"]: row for row in (self._row(key, data) for key, data in rows)}
        if not found:
            return

        def put(connection: Connection) -> _Entry:
            entry = self._known(connection) or self._made(connection)
            _put(connection, entry.number, found)
            return entry

        # Not before that is written: what is undone has made no series either.
        self._take(self._database.write(put))

    def _row(self, key: str, data: Mapping[str, Any]) -> dict[str, Any]:
        from epypes.store.tables import digest_of

        word, text = to_word(key), self._text(key, data)
        return {"digest": digest_of(word), "key": word, "data": text, "written_ns": time.time_ns()}

    def _text(self, key: str, data: Mapping[str, Any]) -> str:
        try:
            return to_text(dict(data))
        except (TypeError, ValueError, RecursionError) as error:
            raise TypeError(f"Row {key!r:.200} of {self.kind} {self.name!r} can't be stored: {error}.") from error

    # -- reading ------------------------------------------------------------------------------------------------

    def get(self, key: str) -> Mapping[str, Any] | None:
        """Return the row under a key; None if there is none."""
        from epypes.store.tables import digest_of, row_data

        digest = digest_of(to_word(key))

        def read(connection: Connection) -> Any:
            wanted = {"series": self._number(connection), "digest": digest}
            return connection.execute(row_data, wanted).scalar()

        text = self._database.read(read)
        return None if text is None else self._data(key, text)

    def keys(self) -> frozenset[str]:
        """Return all keys."""
        from sqlalchemy import select

        from epypes.store.tables import rows

        found = self._selected(select(rows.c.key))
        return frozenset(from_word(word) for (word,) in found)

    def items(self) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield keys with their rows in the order of writing, a page at a time; what comes meanwhile may come too."""
        from sqlalchemy import select

        from epypes.store.tables import rows

        last = 0
        while True:
            wanted = select(rows.c.id, rows.c.key, rows.c.data).where(rows.c.id > last).order_by(rows.c.id).limit(_PAGE)
            page = self._selected(wanted)
            if not page:
                return
            for last, word, text in page:  # noqa: B007 - where the next page begins
                yield from_word(word), self._data(word, text)

    def _selected(self, wanted: Select[Any]) -> list[Any]:
        """Return what is wanted of the rows of this series."""
        from epypes.store.tables import rows

        def read(connection: Connection) -> list[Any]:
            mine = rows.c.series_id == self._number(connection)
            return list(connection.execute(wanted.where(mine)))

        return self._database.read(read)

    def rows(self) -> Iterator[Mapping[str, Any]]:
        """Yield the rows in the order of writing."""
        return (data for _, data in self.items())

    def _data(self, key: str, text: str) -> dict[str, Any]:
        try:
            data: dict[str, Any] = from_text(text)
        except (ValueError, TypeError, RecursionError) as error:
            place = self._database.place
            raise StoreError(place, f"Row {key!r:.200} of {self.kind} {self.name!r} in {place} is damaged.") from error
        return data

    def to_frame(self) -> pd.DataFrame:
        """Return the series as a pandas table: a row by key, a column by name; of dicts in it ``values.canny_lo``."""
        with optional_import():
            import pandas as pd

        found = list(self.items())
        index = pd.Index([key for key, _ in found], name="key", dtype="object")
        return pd.DataFrame([dict(_flat(data)) for _, data in found], index=index)

    def __len__(self) -> int:
        from sqlalchemy import func, select

        from epypes.store.tables import rows

        ((count,),) = self._selected(select(func.count()).select_from(rows))
        return int(count)

    def __bool__(self) -> bool:
        # An empty series is one all the same; and to ask costs no look into the database.
        return True

    def __contains__(self, key: object) -> bool:
        return isinstance(key, str) and self.get(key) is not None

    def __repr__(self) -> str:
        return f"<Series {self.kind} {self.name[:60]!r}>"


def _flat(data: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in data.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{before}{name}.")
        else:
            yield before + name, value


def _put(connection: Connection, series_id: int, found: Mapping[str, Mapping[str, Any]]) -> None:
    """Write rows by digest; whoever writes one of them at the same moment makes this fail, to be tried again."""
    from sqlalchemy import update

    from epypes.store.tables import new_row, rows

    there = _there(connection, series_id, list(found))
    new = [{"series_id": series_id, **row} for digest, row in found.items() if digest not in there]
    if new:
        connection.execute(new_row, new)
    for digest in there:
        mine = (rows.c.series_id == series_id, rows.c.digest == digest)
        changed = {name: found[digest][name] for name in ("data", "written_ns")}
        connection.execute(update(rows).where(*mine).values(**changed))


def _there(connection: Connection, series_id: int, digests: list[str]) -> list[str]:
    """Return which of these are there already."""
    from epypes.store.tables import rows_there

    there: list[str] = []
    for first in range(0, len(digests), _PAGE):
        asked = {"series": series_id, "digests": digests[first : first + _PAGE]}
        there += connection.execute(rows_there, asked).scalars()
    return there
