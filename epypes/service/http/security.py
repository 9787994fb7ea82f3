"""Access control of the HTTP server: the access key and its file, and headers for browsers.

Every request passes, in this order: `_SafeHeaders` (response headers that keep a browser from running anything),
Starlette's TrustedHostMiddleware (against DNS rebinding: a page of a foreign site, whose name was made to mean
127.0.0.1, still sends the site's name), and Starlette's RequestBodyLimitMiddleware. Routes that change something depend
on `NEEDS_ACCESS_KEY`.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final

from fastapi import Depends, FastAPI, HTTPException, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.datastructures import MutableHeaders
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from epypes.errors import KeysError

MAX_BODY_BYTES: Final = 64 * 1024
_BEARER: Final = HTTPBearer(auto_error=False, description="The access key that `epypes serve` prints.")

_GROUP_AND_OTHERS: Final = 0o077
_KEY_BYTES: Final = 32
# What can stand in a header and an address without quoting; 22 characters of it hold 128 bits.
_ACCESS_KEY: Final = re.compile(r"[\w.~+/=-]{22,512}", re.ASCII)

# Pictures are SVG with their own style and embedded images; nothing in them may run, wherever they are opened.
_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox; frame-ancestors 'none'"
_PAGE_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}


# -- the access key's file ---------------------------------------------------------------------------------------------


def read_or_make_access_key(path: Path) -> str:
    """Return the access key in a file, which is made, readable by its owner alone, if it does not exist.

    Raises
    ------
    KeysError
        The file can't be read or made, has no key in it, or others can read it.
    """
    try:
        with suppress(FileNotFoundError):
            return _read_key(path)
        with suppress(FileExistsError):
            _make_key(path)
        return _read_key(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", "") or error
        text = f"The file {path} of the access key can't be used: {reason}. Name another."
        raise KeysError(path, text) from error


def _read_key(path: Path) -> str:
    with path.open(encoding="ascii") as file:
        if os.fstat(file.fileno()).st_mode & _GROUP_AND_OTHERS:
            raise KeysError(path, f"Others can read the access key in {path}. Run: chmod 600 {path}")
        key = file.read(1_000).strip()
    if not _ACCESS_KEY.fullmatch(key):
        text = f"{path} holds no access key: 22 letters and digits or more, in one line. Remove it, and one is made."
        raise KeysError(path, text)
    return key


def _make_key(path: Path) -> None:
    """Write a new key under another name, then link it: a reader finds all of it or no file."""
    draft = path.with_name(f".{path.name}-{secrets.token_hex(8)}")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with open(descriptor, "w", encoding="ascii") as file:
            file.write(secrets.token_urlsafe(_KEY_BYTES) + "\n")
        # Unlike a renaming, a link does not replace a key that another process has just made.
        os.link(draft, path)
    finally:
        draft.unlink()


# -- requests ---------------------------------------------------------------------------------------------------------


async def _check_access_key(
    request: Request, given: Annotated[HTTPAuthorizationCredentials | None, Security(_BEARER)]
) -> None:
    """Refuse a request without the service's access key."""
    state = request.app.state
    hint = f"It is in {state.access_key_file}, which `epypes serve` has named."
    if "authorization" not in request.headers:
        text = f"Changes need the service's access key, as a header 'Authorization: Bearer ACCESS_KEY'. {hint}"
        raise HTTPException(401, text, {"WWW-Authenticate": 'Bearer realm="epypes"'})
    credentials = "" if given is None else given.credentials
    if not secrets.compare_digest(credentials.encode(), state.access_key.encode()):
        raise HTTPException(403, f"This is not the service's access key. {hint}")


NEEDS_ACCESS_KEY: Final = Depends(_check_access_key)


def secured(app: FastAPI, access_key: str, access_key_file: Path, hosts: Collection[str]) -> ASGIApp:
    """Return an application behind all checks.

    Parameters
    ----------
    access_key, access_key_file
        What requests need that change something, and where a caller finds it.
    hosts
        The names, without a port, that requests may call this server by; ``*`` for any.
    """
    app.state.access_key, app.state.access_key_file = access_key, access_key_file
    limited = RequestBodyLimitMiddleware(app, MAX_BODY_BYTES)
    return _SafeHeaders(TrustedHostMiddleware(limited, allowed_hosts=list(hosts), www_redirect=False))


class _SafeHeaders:
    """Adds headers to every response."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope.get("path", "")
        is_page = path == "/" or path.startswith("/page/")

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
                headers.setdefault("Content-Security-Policy", _PAGE_POLICY if is_page else _POLICY)
                headers.setdefault("Cache-Control", "no-cache" if is_page else "no-store")
            await send(message)

        await self._app(scope, receive, send_with_headers)
