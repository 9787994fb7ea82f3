"""Which requests reach the application at all?

Those that name this server, know the token if they change something, and bring at most 64 KB of strict JSON. All
answers leave with headers that keep a browser from doing more with them than showing them.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from email.utils import formatdate
from typing import Any, Final

from epypes.service.http.answers import refusal
from epypes.service.http.connections import REQUEST_TIMEOUT_S
from epypes.service.http.token import is_bearer

MOST_BODY_BYTES: Final = 64 * 1024
MOST_HEADER_BYTES: Final = 16 * 1024
_MOST_ADDRESS_BYTES: Final = 8 * 1024
_READING: Final = frozenset({"GET", "HEAD", "OPTIONS"})
# Pictures are SVG with a style of their own and images inside; nothing of them may run, wherever they are opened.
_CLOSED: Final = b"default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox; frame-ancestors 'none'"
_HEADERS: Final = (
    (b"content-security-policy", _CLOSED),
    (b"cache-control", b"no-store"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
)
_CLOSE: Final = {"Connection": "close"}

Scope = dict[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]


class _Refused(Exception):
    """A request that does not reach the application; its argument is the answer."""


@dataclass(frozen=True, slots=True)
class Guard:
    """An ASGI application before another.

    Attributes
    ----------
    app
        The application.
    token
        What those must know who change something.
    token_hint
        Where it is found.
    hosts
        The names that requests may call this server by, without a port; None for any.
    """

    app: Any
    token: str
    token_hint: str
    hosts: Collection[str] | None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            return
        connection = scope.get("state", {}).get("connection")
        if connection is not None:
            connection.began()
        try:
            await self._answer(scope, receive, _with_headers(send))
        finally:
            if connection is not None:
                connection.ended()

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = [(name.lower(), value) for name, value in scope["headers"]]
        try:
            await self._check(scope, headers, receive)
            body = await _body(dict(headers), receive)
        except _Refused as refused:
            await refused.args[0](scope, receive, send)
            return
        await self.app(scope, _replayed(body, receive), send)

    async def _check(self, scope: Scope, headers: Sequence[tuple[bytes, bytes]], receive: Receive) -> None:
        """Refuse what is known to be refused without its body."""
        try:
            _check_size(scope, headers)
            self._check_host([value for name, value in headers if name == b"host"])
            if scope["method"] not in _READING:
                self._check_token([value for name, value in headers if name == b"authorization"])
        except _Refused:
            # Who closes on a body that is still being sent resets the connection, and the answer with it.
            with suppress(_Refused):
                await _whole(dict(headers), receive)
            raise

    def _check_host(self, given: list[bytes]) -> None:
        if self.hosts is None:
            return
        hosts = [_without_port(host.decode("latin-1").lower()) for host in given]
        if len(hosts) != 1 or hosts[0] not in self.hosts:
            named = ", ".join(sorted(self.hosts))
            raise _Refused(refusal(421, f"This server is called by one of these names alone: {named}."))

    def _check_token(self, given: list[bytes]) -> None:
        if not given:
            text = f"Changes need the service's token, as a header 'Authorization: Bearer TOKEN'. {self.token_hint}"
            raise _Refused(refusal(401, text, {"WWW-Authenticate": 'Bearer realm="epypes"', **_CLOSE}))
        if len(given) != 1 or not is_bearer(given[0], self.token):
            raise _Refused(refusal(403, f"This is not the service's token. {self.token_hint}", _CLOSE))


def _check_size(scope: Scope, headers: Sequence[tuple[bytes, bytes]]) -> None:
    """Refuse what arrived in one piece, and so escaped the limit on what is still incomplete."""
    if len(scope.get("raw_path", b"")) + len(scope.get("query_string", b"")) > _MOST_ADDRESS_BYTES:
        text = f"An address may have {_MOST_ADDRESS_BYTES} characters at most. Ask for less at once."
        raise _Refused(refusal(414, text, _CLOSE))
    if sum(len(name) + len(value) for name, value in headers) > MOST_HEADER_BYTES:
        raise _Refused(refusal(431, f"Headers may have {MOST_HEADER_BYTES} bytes at most. Send fewer.", _CLOSE))


def _without_port(host: str) -> str:
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdecimal() else host


async def _body(headers: dict[bytes, bytes], receive: Receive) -> bytes:
    """Return the whole body, once it is known to be short, there in time, and JSON."""
    body = await _whole(headers, receive)
    if body:
        _check_json(body, headers.get(b"content-type", b""))
    return body


async def _whole(headers: dict[bytes, bytes], receive: Receive) -> bytes:
    declared = headers.get(b"content-length", b"0")
    if declared == b"0" and b"transfer-encoding" not in headers:
        return b""
    if int(declared) > MOST_BODY_BYTES:
        raise _too_long()
    try:
        async with asyncio.timeout(REQUEST_TIMEOUT_S):
            return await _received(receive)
    except TimeoutError:
        text = f"The body did not come within {REQUEST_TIMEOUT_S:g} s. Send it at once."
        raise _Refused(refusal(408, text, _CLOSE)) from None


async def _received(receive: Receive) -> bytes:
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] != "http.request":
            raise _Refused(refusal(400, "The body is not whole."))
        body += message.get("body", b"")
        if len(body) > MOST_BODY_BYTES:
            raise _too_long()
        if not message.get("more_body", False):
            return bytes(body)


def _too_long() -> _Refused:
    return _Refused(refusal(413, f"A body may have {MOST_BODY_BYTES // 1024} KB at most. Send less.", _CLOSE))


def _check_json(body: bytes, content_type: bytes) -> None:
    """Refuse what Python's reader takes and JSON does not know: NaN, half characters, nesting without end."""
    from pydantic_core import from_json

    if content_type.partition(b";")[0].strip().lower() != b"application/json":
        raise _Refused(refusal(415, "A body must be JSON. Send it with the header 'Content-Type: application/json'."))
    try:
        value = from_json(body, allow_inf_nan=False)
    except ValueError as error:
        raise _Refused(refusal(400, f"The body is not JSON: {error}.")) from None
    if not _finite(value):
        raise _Refused(refusal(400, "The body has a number that is too large for JSON's readers. Send a smaller one."))


def _finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, list):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Return a ``receive`` that gives the body once, and then what the connection has."""
    waiting = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Any:
        return waiting.pop() if waiting else await receive()

    return replay


def _with_headers(send: Send) -> Send:
    async def sending(message: Any) -> None:
        if message["type"] == "http.response.start":
            given = list(message.get("headers", ()))
            named = {name.lower() for name, _ in given}
            added = [header for header in _HEADERS if header[0] not in named]
            message = {**message, "headers": [*given, *added, (b"date", formatdate(usegmt=True).encode())]}
        await send(message)

    return sending
