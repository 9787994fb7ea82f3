"""Which database is meant by a path or a URL, and how is it called without its password?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import unquote, urlsplit

from epypes.errors import StoreError
from epypes.optional import optional_import

if TYPE_CHECKING:
    from sqlalchemy import URL

# Who else writes is waited for so long; who does not answer, too.
_BUSY_S: Final = 30
_CONNECT_S: Final = 10
_DRIVERS: Final = {"postgres": "postgresql+psycopg", "postgresql": "postgresql+psycopg"}


def url_of(given: str | Path) -> URL:
    """Return the URL of a database; what has no ``://`` in it is the path of a SQLite file.

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
        import sqlalchemy  # noqa: F401 - missing here, rather than after the first run
    if isinstance(given, str) and "://" in given:
        return _parsed(given)
    if not str(given).strip() or str(given) == ":memory:":
        raise _no_file(str(given))
    return _file_url(Path(given).expanduser())


def _parsed(given: str) -> URL:
    from sqlalchemy import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        url = make_url(given)
    except (ArgumentError, ValueError):
        scheme = given.partition("://")[0] or "postgresql"
        text = (
            f"The URL {scheme}://... can't be read. It is {scheme}://user:password@host:port/database; "
            "special characters of a password are written as %40 for @, %3A for : and %2F for /."
        )
        # What could not be read has the password in it.
        raise StoreError(f"{scheme}://...", text) from None
    if url.get_backend_name() != "sqlite":
        return url.set(drivername=_DRIVERS.get(url.drivername, url.drivername))
    if url.database in (None, "", ":memory:") or "mode=memory" in given:
        raise _no_file(given)
    return url if str(url.database).startswith("file:") else _file_url(Path(str(url.database)), url)


def _no_file(given: str) -> StoreError:
    return StoreError(given, f"{given!r} is no file, and what is in memory only is lost. Name one: 'results.sqlite'.")


def _file_url(path: Path, url: URL | None = None) -> URL:
    from sqlalchemy import URL

    if path.is_dir():
        raise StoreError(str(path), f"{path} is a folder. Name a file in it: {path / 'results.sqlite'}")
    if path.exists() and not path.is_file():
        raise StoreError(str(path), f"{path} is no file but a device or a pipe. Name a file: 'results.sqlite'.")
    if not path.absolute().parent.is_dir():
        raise StoreError(
            str(path), f"There is no folder {path.absolute().parent} to store {path.name!r} in. Make it first."
        )
    return url.set(database=str(path)) if url is not None else URL.create("sqlite", database=str(path))


def file_path(url: URL) -> str | None:
    """Return the absolute path of the file of a SQLite database; None if it is another database, or not to be told."""
    if url.get_backend_name() != "sqlite" or not url.database:
        return None
    if not url.database.startswith("file:"):
        return str(Path(url.database).absolute())
    path = unquote(urlsplit(url.database).path)
    return str(Path(path).absolute()) if path else None


def shown(url: URL) -> str:
    """Return how a database is called in messages: a file by its path, others by URL without password and options."""
    if url.get_backend_name() == "sqlite":
        return str(url.database)
    return url.set(password=None, query={}).render_as_string()


def connect_options(url: URL) -> dict[str, Any]:
    """Return what a driver is told so that nobody is waited for without end."""
    if url.get_backend_name() == "sqlite":
        return {"timeout": _BUSY_S}
    if url.drivername in ("postgresql+psycopg", "postgresql+psycopg2"):
        return {"connect_timeout": _CONNECT_S, "tcp_user_timeout": 1000 * _BUSY_S}
    return {}
