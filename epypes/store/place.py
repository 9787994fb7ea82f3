"""The URL of a store's database, from a path or a URL, and how it is shown without its password."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import StoreError
from epypes.optional import optional_import

if TYPE_CHECKING:
    from sqlalchemy import URL

# A lock of another process is waited for so long, and a server that does not answer.
_BUSY_S: Final = 30
_CONNECT_S: Final = 10
_DRIVERS: Final = {"postgres": "postgresql+psycopg", "postgresql": "postgresql+psycopg"}


def url_of(given: str | Path) -> URL:
    """Return the URL of a database; a text without ``://`` is the path of a SQLite file.

    Raises
    ------
    StoreError
        There can be no such database.
    MissingPackage
        SQLAlchemy is missing.
    TypeError
        It is neither a path nor a URL.
    """
    if not isinstance(given, str | Path):
        raise TypeError(f"A store is a path or a URL, not {given!r:.80}. Name a file: 'results.sqlite'.")
    with optional_import():
        from sqlalchemy import URL, make_url
        from sqlalchemy.exc import ArgumentError
    if not isinstance(given, str) or "://" not in given:
        url = URL.create("sqlite", database=str(Path(given).expanduser()) if str(given).strip() else "")
    else:
        try:
            url = make_url(given)
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


def shown(url: URL) -> str:
    """Return a database's name in messages: a file by its path, others by URL without password and options."""
    if url.get_backend_name() == "sqlite":
        return str(url.database)
    return url.set(password=None, query={}).render_as_string()


def connect_options(url: URL) -> dict[str, Any]:
    """Return the options of the driver that bound every wait."""
    if url.get_backend_name() == "sqlite":
        return {"timeout": _BUSY_S}
    if url.drivername in ("postgresql+psycopg", "postgresql+psycopg2"):
        return {"connect_timeout": _CONNECT_S, "tcp_user_timeout": 1000 * _BUSY_S}
    return {}
