"""A database of series, and series of rows that are written once under each key.

A row is JSON text that any reader of JSON understands, so NaN and infinities become ``{"$float": "nan"}``, and other
keys that begin with ``$`` get another one. Kinds, names and keys are JSON texts too: databases refuse some characters.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import InvalidType, StoreError
from epypes.optional import optional_import

if TYPE_CHECKING:
    import pandas as pd
    from sqlalchemy import URL

    from epypes.store.database import Database

# The key of a float that JSON has no literal for.
_FLOAT: Final = "$float"


class Store(AbstractContextManager["Store"]):
    """A database of series of rows; a context manager.

    Parameters
    ----------
    place
        The path of a SQLite file, made if it is not there, or the URL of a database as SQLAlchemy writes it:
        ``"postgresql://user:password@host/database"``.

    Attributes
    ----------
    place
        The path, or the URL without its password.
    url
        The URL with its password, for another library that is to use the same database.

    Raises
    ------
    StoreError
        It can't be opened; the text says why, and never the password.
    TypeError
        It is neither a path nor a URL.

    Notes
    -----
    Any thread may use it, and many processes at the same time. Its tables are made when it is opened; their names
    begin with ``epypes_``, so it may share a database with others. If a file is deleted or moved while it is open, the
    log reports that. Later rows are written to the file of that name, made anew if it is missing.
    """

    def __init__(self, place: str | Path) -> None:
        with optional_import():
            from epypes.store.database import Database
        self.database = Database(place)
        self.place = self.database.place
        self.url: URL = self.database.engine.url
        # Connects, and makes the tables.
        self.database.series_names()

    def series(self, kind: str, name: str, *, about: Mapping[str, Any] | None = None) -> Series:
        """Return the series of a kind and a name.

        Parameters
        ----------
        kind
            ``"map"``, ``"sweep"``, ``"check"``, ``"tuning"``, ``"events"``, or a kind of your own.
        about
            The description of the series, which is then made if it is not there; one that exists keeps its own.
            Without, its first row makes it, so that to look for a series is not to make it.

        Raises
        ------
        StoreError
            The database can't be read or written.
        """
        series = Series(self.database, kind, name, about)
        if about is not None:
            series.put({})
        return series

    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of all series, sorted."""
        return tuple(sorted({json.loads(kind) for kind, _ in self.database.series_names()}))

    def names(self, kind: str) -> tuple[str, ...]:
        """Return the names of the series of a kind, in the order in which they were made."""
        return tuple(json.loads(name) for found, name in self.database.series_names() if json.loads(found) == kind)

    def close(self) -> None:
        """Close it; a second time does nothing. It and its series can't be read or written any more."""
        self.database.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Store {self.place[-70:]!r}>"


@contextmanager
def opened_store(given: str | Path | Store | None) -> Iterator[Store | None]:
    """Open a store for the time of a block; a given Store stays open afterwards, and None stays None.

    Raises
    ------
    StoreError
        It can't be opened.
    TypeError
        It is neither a path, a URL nor a Store.
    """
    if given is None or isinstance(given, Store):
        yield given
    else:
        with Store(given) as store:
            yield store


class Series:
    """Rows of one kind under one name; `Store.series` returns it.

    A row is a mapping under a key: numbers (NaN and infinities too), texts, truth values, None, lists and dicts.
    Written under a key that is there already, it takes the place of the earlier one. Any thread may use it, and many
    processes may write to one series at the same time.
    """

    def __init__(self, database: Database, kind: str, name: str, about: Mapping[str, Any] | None = None) -> None:
        self.kind, self.name = kind, name
        self._database = database
        self._key = _name_text(kind), _name_text(name)
        self._about = self.encode("about", about or {})

    @property
    def about(self) -> Mapping[str, Any]:
        """The description that the series was made with."""
        return self._decode("about", self._database.about(self._key) or self._about)

    def append(self, key: str, data: Mapping[str, Any]) -> None:
        """Write a row under a key; if there is one, it is replaced.

        Raises
        ------
        StoreError
            It can't be written: the database is away, or the disk full.
        TypeError
            data contains an object that JSON has no type for.
        """
        self.put({key: self.encode(key, data)})

    def append_all(self, rows: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
        """Write several rows, as pairs of key and data: all of them, or none.

        Raises
        ------
        StoreError, TypeError
            As `append`.
        """
        # The last row of a key is the one that stays.
        encoded = {key: self.encode(key, data) for key, data in rows}
        if encoded:
            self.put(encoded)

    def encode(self, key: str, data: Mapping[str, Any]) -> str:
        """Return a row as JSON text; raise TypeError, as `append` does."""
        try:
            return json.dumps(_encoded(dict(data)), allow_nan=False, separators=(",", ":"))
        except (TypeError, ValueError, RecursionError) as error:
            raise InvalidType(f"Row {key!r:.200} of {self.kind} {self.name!r} can't be stored: {error}.") from error

    def put(self, rows: Mapping[str, str]) -> None:
        """Write rows that are encoded, by key: all of them, or none; raise StoreError, as `append` does."""
        self._database.put(self._key, self._about, {_name_text(key): text for key, text in rows.items()})

    def get(self, key: str) -> Mapping[str, Any] | None:
        """Return the row under a key; None if there is none."""
        text = self._database.row(self._key, _name_text(key))
        return None if text is None else self._decode(key, text)

    def _decode(self, key: str, text: str) -> dict[str, Any]:
        try:
            data: dict[str, Any] = json.loads(text, object_hook=_decoded)
        except ValueError as error:
            place = self._database.place
            raise StoreError(place, f"Row {key!r:.200} of {self.kind} {self.name!r} in {place} is damaged.") from error
        return data

    def keys(self) -> frozenset[str]:
        """Return all keys."""
        return frozenset(map(json.loads, self._database.keys(self._key)))

    def items(self) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield keys with their rows in the order of writing, a page at a time; rows written meanwhile may come too."""
        last = 0
        while page := self._database.page(self._key, last):
            for _, key_text, text in page:
                key = json.loads(key_text)
                yield key, self._decode(key, text)
            last = page[-1][0]

    def rows(self) -> Iterator[Mapping[str, Any]]:
        """Yield the rows in the order of writing."""
        return (data for _, data in self.items())

    def to_frame(self) -> pd.DataFrame:
        """Return the series as a pandas table: a row by key, a column by name; of dicts in it ``values.canny_lo``."""
        with optional_import():
            import pandas as pd

        found = list(self.items())
        frame = pd.json_normalize([dict(data) for _, data in found])
        return frame.set_axis(pd.Index([key for key, _ in found], name="key", dtype="object"))

    def __len__(self) -> int:
        return self._database.count(self._key)

    def __contains__(self, key: object) -> bool:
        return isinstance(key, str) and self.get(key) is not None

    def __repr__(self) -> str:
        return f"<Series {self.kind} {self.name[:60]!r}>"


# -- rows as JSON ------------------------------------------------------------------------------------------------------


def _name_text(name: str) -> str:
    """Return the JSON text of a kind, name or key."""
    if not isinstance(name, str):
        raise InvalidType(f"Kinds, names and keys of series are texts, not {type(name).__name__!r}: {name!r:.80}")
    return json.dumps(name)


def _encoded(value: Any) -> Any:
    """Return a value as JSON's own types, as far as it is made of such; numpy's numbers become Python's."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else {_FLOAT: str(float(value))}
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):  # as a text it may be the same as another key: 1 and "1"
                raise InvalidType(f"key {key!r:.80} is no text; as one it is {str(key)!r:.80}")
        return {f"${key}" if key.startswith("$") else key: _encoded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_encoded(item) for item in value]
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        return _encoded(value.item())
    return value


def _decoded(found: dict[str, Any]) -> Any:
    """Return what an object of JSON stands for, whose values are decoded."""
    if found.keys() == {_FLOAT}:
        return float(found[_FLOAT])
    return {key.removeprefix("$") if key.startswith("$$") else key: value for key, value in found.items()}
