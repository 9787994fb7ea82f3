"""Access control of the HTTP server: the token file, bearer tokens, limits on requests, and headers for browsers.

Every request passes, in this order: `_SafeHeaders` (response headers that keep a browser from running anything),
Starlette's TrustedHostMiddleware (against DNS rebinding: a page of a foreign site, whose name was made to mean
127.0.0.1, still sends the site's name), and `_RequestGuard` (token, size and time of the body, strict JSON).
"""

from __future__ import annotations

import asyncio
import math
import os
import re
import secrets
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from fastapi import Request, Security
from fastapi.security import HTTPBearer
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from epypes.errors import KeysError
from epypes.service.http.responses import refusal

MAX_HEAD_BYTES: Final = 16 * 1024
MAX_BODY_BYTES: Final = 64 * 1024
_READING_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
_BEARER: Final = HTTPBearer(auto_error=False, description="The token that `epypes serve` names a file of.")
# The guard checks the token before the body is read; on a route this only describes that in /openapi.json.
NEEDS_TOKEN: Final = Security(_BEARER)

_GROUP_AND_OTHERS: Final = 0o077
_TOKEN_BYTES: Final = 32
# What can stand in a header and an address without quoting; 22 characters of it hold 128 bits.
_TOKEN: Final = re.compile(r"[\w.~+/=-]{22,512}", re.ASCII)

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
_CLOSE: Final = {"Connection": "close"}


# -- the token file ---------------------------------------------------------------------------------------------------


def read_or_make_token(path: Path) -> str:
    """Return the token in a file, which is made, readable by its owner alone, if it does not exist.

    Raises
    ------
    KeysError
        The file can't be read or made, has no token in it, or others can read it.
    """
    try:
        with suppress(FileNotFoundError):
            return _read_token(path)
        with suppress(FileExistsError):
            _make_token(path)
        return _read_token(path)
    except (OSError, UnicodeDecodeError) as error:
        text = f"The token file {path} can't be used: {getattr(error, 'strerror', '') or error}. Name another."
        raise KeysError(path, text) from error


def _read_token(path: Path) -> str:
    with path.open(encoding="ascii") as file:
        if os.fstat(file.fileno()).st_mode & _GROUP_AND_OTHERS:
            raise KeysError(path, f"Others can read the token in {path}. Say: chmod 600 {path}")
        token = file.read(1_000).strip()
    if not _TOKEN.fullmatch(token):
        text = f"{path} holds no token: 22 letters and digits or more, in one line. Remove it, and one is made."
        raise KeysError(path, text)
    return token


def _make_token(path: Path) -> None:
    """Write a new token under another name, then link it: a reader finds all of it or no file."""
    draft = path.with_name(f".{path.name}-{secrets.token_hex(8)}")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with open(descriptor, "w", encoding="ascii") as file:
            file.write(secrets.token_urlsafe(_TOKEN_BYTES) + "\n")
        # Unlike a renaming, a link does not replace a token that another process has just made.
        os.link(draft, path)
    finally:
        draft.unlink()


# -- requests ---------------------------------------------------------------------------------------------------------


def secured(app: ASGIApp, token: str, token_file: Path, hosts: Collection[str], timeout_s: float) -> ASGIApp:
    """Return an application behind all checks.

    Parameters
    ----------
    token, token_file
        What requests need that change something, and where a caller finds it.
    hosts
        The names, without a port, that requests may call this server by; ``*`` for any.
    timeout_s
        How long a body may take to arrive, in seconds.
    """
    guarded = _RequestGuard(app, token, token_file, timeout_s)
    return _SafeHeaders(TrustedHostMiddleware(guarded, allowed_hosts=list(hosts), www_redirect=False))


class _SafeHeaders:
    """Adds headers to every response; reports to the connection when a request begins and ends."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        is_page = scope["path"] == "/" or scope["path"].startswith("/page/")

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
                headers.setdefault("Content-Security-Policy", _PAGE_POLICY if is_page else _POLICY)
                headers.setdefault("Cache-Control", "no-cache" if is_page else "no-store")
            await send(message)

        connection = scope.get("state", {}).get("connection")
        if connection is None:
            await self._app(scope, receive, send_with_headers)
            return
        connection.request_began()
        try:
            await self._app(scope, receive, send_with_headers)
        finally:
            connection.request_ended()


class _RequestGuard:
    """Refuses requests without the token, and bodies that are too long, too slow or not strict JSON."""

    def __init__(self, app: ASGIApp, token: str, token_file: Path, timeout_s: float) -> None:
        self._app, self._token, self._timeout_s = app, token, timeout_s
        self._hint = f"It is in {token_file}, which `epypes serve` has named."

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope, receive)
        refused = None
        # h11 limits only a head that is still incomplete.
        head = scope["raw_path"], scope["query_string"], *(part for header in scope["headers"] for part in header)
        if sum(map(len, head)) > MAX_HEAD_BYTES:
            text = f"Address and headers may have {MAX_HEAD_BYTES // 1024} KB at most. Send less."
            refused = refusal(431, text, _CLOSE)
        elif request.method not in _READING_METHODS:
            refused = await self._token_refusal(request)
        try:
            # Also the body of a refused request is read: a server that closes earlier resets the connection, and the
            # caller loses the answer.
            body = await _read_body(request, self._timeout_s)
            if refused is None and body:
                _check_json(body, request.headers.get("content-type", ""))
        except HTTPException as error:
            refused = refused or refusal(error.status_code, str(error.detail), error.headers)
        if refused is not None:
            await refused(scope, receive, send)
            return
        waiting: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def replay() -> Message:
            return waiting.pop() if waiting else await receive()

        await self._app(scope, replay, send)

    async def _token_refusal(self, request: Request) -> Any:
        if "authorization" not in request.headers:
            text = f"Changes need the service's token, as a header 'Authorization: Bearer TOKEN'. {self._hint}"
            return refusal(401, text, {"WWW-Authenticate": 'Bearer realm="epypes"', **_CLOSE})
        given = await _BEARER(request)
        is_one = len(request.headers.getlist("authorization")) == 1
        if given is None or not is_one or not _is_same(given.credentials, self._token):
            return refusal(403, f"This is not the service's token. {self._hint}", _CLOSE)
        return None


def _is_same(given: str, token: str) -> bool:
    """Compare in a time that does not depend on where the two differ."""
    return secrets.compare_digest(given.encode("latin-1", errors="replace"), token.encode("ascii"))


async def _read_body(request: Request, timeout_s: float) -> bytes:
    too_long = HTTPException(413, f"A body may have {MAX_BODY_BYTES // 1024} KB at most. Send less.", _CLOSE)
    declared = request.headers.get("content-length", "0")
    if not declared.isdecimal() or int(declared) > MAX_BODY_BYTES:
        raise too_long
    body = bytearray()
    try:
        async with asyncio.timeout(timeout_s):
            async for chunk in request.stream():
                body += chunk
                if len(body) > MAX_BODY_BYTES:
                    raise too_long
    except TimeoutError:
        text = f"The body did not come within {timeout_s:g} s. Send it at once."
        raise HTTPException(408, text, _CLOSE) from None
    except ClientDisconnect:
        raise HTTPException(400, "The body is not whole.") from None
    return bytes(body)


def _check_json(body: bytes, content_type: str) -> None:
    """Refuse what Python's reader takes and JSON does not know: NaN, half characters, nesting without end."""
    from pydantic_core import from_json

    if content_type.partition(";")[0].strip().lower() != "application/json":
        raise HTTPException(415, "A body must be JSON. Send it with the header 'Content-Type: application/json'.")
    try:
        value = from_json(body, allow_inf_nan=False)
    except ValueError as error:
        raise HTTPException(400, f"The body is not JSON: {error}.") from None
    if not _is_finite(value):
        raise HTTPException(400, "The body has a number that is too large for JSON's readers. Send a smaller one.")


def _is_finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_is_finite, value.values()))
    if isinstance(value, list):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)
