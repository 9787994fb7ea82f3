r"""A database of series, and series of rows that are written once under each key.

A row is JSON text that any reader of JSON understands, so NaN and infinities become ``{"$float": "nan"}``. NUL and
halves of surrogate pairs, which PostgreSQL or UTF-8 refuse, are escaped as ``\u0000``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import StoreError
from epypes.optional import optional_import

if TYPE_CHECKING:
    import pandas as pd
    from sqlalchemy import URL

    from epypes.store.database import Database

# The key of a float that JSON has no literal for, and of a dict that looks like one.
_FLOAT, _DICT = "$float", "$dict"
_SURROGATE: Final = re.compile("[\ud800-\udfff]")


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
    begin with ``epypes_``, so it may share a database with others. If a file is deleted, moved or replaced while it is
    open, the log reports that; later rows are written to the file of that name, made anew if need be.
    """

    def __init__(self, place: str | Path) -> None:
        with optional_import():
            from epypes.store.database import Database
        self._database = Database(place)

    @property
    def place(self) -> str:
        """The path, or the URL without its password."""
        return self._database.place

    @property
    def url(self) -> URL:
        """The URL with its password, for another library that is to use the same database."""
        return self._database.engine.url

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
        return Series(self._database, kind, name, about)

    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of all series, sorted."""
        return tuple(sorted({_unescaped(kind) for kind, _ in self._database.series_names()}))

    def names(self, kind: str) -> tuple[str, ...]:
        """Return the names of the series of a kind, in the order in which they were made."""
        return tuple(_unescaped(name) for found, name in self._database.series_names() if found == _escaped(kind))

    def close(self) -> None:
        """Close it; a second time does nothing. It and its series can't be read or written any more."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

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
        self._key = _escaped(kind), _escaped(name)
        # As the database has it, once that was read; a file that is made anew gets it too.
        self._about = database.about(self._key, None if about is None else self._text("about", about)) or "{}"

    @property
    def about(self) -> Mapping[str, Any]:
        """The description that the series was made with."""
        self._about = self._database.about(self._key) or self._about
        about: dict[str, Any] = _from_text(self._about)
        return about

    def append(self, key: str, data: Mapping[str, Any]) -> None:
        """Write a row under a key; if there is one, it is replaced.

        Raises
        ------
        StoreError
            It can't be written: the database is away, or the disk full.
        TypeError
            data contains an object that JSON has no type for.
        """
        self.append_all([(key, data)])

    def append_all(self, rows: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
        """Write several rows, as pairs of key and data: all of them, or none.

        Raises
        ------
        StoreError, TypeError
            As `append`.
        """
        # The last row of a key is the one that stays.
        texts = {_escaped(key): self._text(key, data) for key, data in rows}
        if texts:
            self._database.put(self._key, self._about, texts)

    def _text(self, key: str, data: Mapping[str, Any]) -> str:
        try:
            return _to_text(dict(data))
        except (TypeError, ValueError, RecursionError) as error:
            raise TypeError(f"Row {key!r:.200} of {self.kind} {self.name!r} can't be stored: {error}.") from error

    def get(self, key: str) -> Mapping[str, Any] | None:
        """Return the row under a key; None if there is none."""
        text = self._database.row(self._key, _escaped(key))
        return None if text is None else self._data(key, text)

    def keys(self) -> frozenset[str]:
        """Return all keys."""
        return frozenset(map(_unescaped, self._database.keys(self._key)))

    def items(self) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield keys with their rows in the order of writing, a page at a time; rows written meanwhile may come too."""
        last = 0
        while page := self._database.page(self._key, last):
            for last, key, text in page:  # noqa: B007 - where the next page begins
                yield _unescaped(key), self._data(_unescaped(key), text)

    def rows(self) -> Iterator[Mapping[str, Any]]:
        """Yield the rows in the order of writing."""
        return (data for _, data in self.items())

    def _data(self, key: str, text: str) -> dict[str, Any]:
        try:
            data: dict[str, Any] = _from_text(text)
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
        return self._database.count(self._key)

    def __bool__(self) -> bool:
        # An empty series is a series too, and this needs no query.
        return True

    def __contains__(self, key: object) -> bool:
        return isinstance(key, str) and self.get(key) is not None

    def __repr__(self) -> str:
        return f"<Series {self.kind} {self.name[:60]!r}>"


def _flat(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in data.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


# -- rows as JSON ------------------------------------------------------------------------------------------------------


def _to_text(value: Any) -> str:
    """Return a value as JSON.

    Raises
    ------
    TypeError
        It contains an object that JSON has no type for, or a key that is no text.
    RecursionError
        It contains itself.
    """
    text = json.dumps(_encoded(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return _SURROGATE.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def _encoded(value: Any) -> Any:
    """Return a value made of JSON's types alone; numpy's numbers become Python's."""
    if isinstance(value, float):
        return value if math.isfinite(value) else {_FLOAT: str(float(value))}
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):  # as a text it may be the same as another key: 1 and "1"
                raise TypeError(f"key {key!r:.80} is no text; as one it is {str(key)!r:.80}")
        encoded = {key: _encoded(item) for key, item in value.items()}
        return {_DICT: encoded} if encoded.keys() & {_FLOAT, _DICT} else encoded
    if isinstance(value, list | tuple):
        return [_encoded(item) for item in value]
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        return _encoded(value.item())
    raise TypeError(f"{type(value).__name__!r} is neither a number, a text, a truth value, a list nor a dict")


def _from_text(text: str) -> Any:
    """Return the value of a text; tuples come back as lists."""
    value = json.loads(text)
    return _decoded(value) if '{"$' in text else value


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return [_decoded(item) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {_FLOAT}:
        return float(value[_FLOAT])
    inner = value[_DICT] if value.keys() == {_DICT} else value
    return {key: _decoded(item) for key, item in inner.items()}


def _escaped(name: str) -> str:
    """Return a kind, name or key as every database takes it: the text itself where it can be."""
    if not isinstance(name, str):
        raise TypeError(f"Kinds, names and keys of series are texts, not {type(name).__name__!r}: {name!r:.80}")
    return _to_text(name)[1:-1]


def _unescaped(text: str) -> str:
    return str(json.loads(f'"{text}"'))
