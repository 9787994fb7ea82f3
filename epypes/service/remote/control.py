"""HTTP requests to the control of a service, its event stream, and the errors that refusals stand for."""

from __future__ import annotations

import json
import re
import weakref
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, Final, NoReturn
from urllib.parse import parse_qs, urlsplit

from epypes.errors import (
    DeployRefused,
    MessageError,
    NotComputed,
    ParametersRefused,
    RevisionConflict,
    ServiceError,
)
from epypes.optional import optional_import
from epypes.service.parameters import Parameters

with optional_import():
    import httpx

_LOOPBACK: Final = ("localhost", "127.0.0.1", "::1")
# A service sends its counts each second.
_SILENCE_S: Final = 5.0
_MAX_DETAIL_CHARACTERS: Final = 2_000
_HOW_TO_CHANGE: Final = "Give it here: ep.connect(url, access_key=...), or set EPYPES_ACCESS_KEY."

Event = tuple[str, dict[str, Any]]


class Control:
    """The HTTP control of one service; may be used from several threads.

    Parameters
    ----------
    url
        Its address, as ``http://127.0.0.1:8642``.
    access_key
        Empty for none.
    timeout_s
        How long an answer may take, in seconds.

    Raises
    ------
    ServiceError
        This is no address, or no access key.
    """

    def __init__(self, url: str, access_key: str, timeout_s: float) -> None:
        # As it is read from its file, it ends a line.
        access_key = access_key.strip()
        if re.search("[^!-~]", access_key):
            # A header can't hold it; what refuses it there shows all of it.
            text = f"What was given for {url} is no access key: it has characters that none has. {_HOW_TO_CHANGE}"
            raise ServiceError(url, text)
        self.url, self.timeout_s, self._has_key = url, timeout_s, bool(access_key)
        headers = {"Authorization": f"Bearer {access_key}"} if access_key else {}
        try:
            # A proxy of the environment does not reach this machine's loopback.
            is_here = urlsplit(url).hostname in _LOOPBACK
            self._client = httpx.Client(base_url=url, timeout=timeout_s, headers=headers, trust_env=not is_here)
        except (httpx.InvalidURL, ValueError) as error:
            raise ServiceError(url, f"{url!r:.200} is no address: {error}.") from error
        self.close = weakref.finalize(self, self._client.close)

    def get(self, path: str, **params: Any) -> Any:
        """Return JSON from a path."""
        return self._json(path, self._request("GET", path, params=params))

    def content(self, path: str, **params: Any) -> tuple[str, bytes]:
        """Return the media type and the bytes from a path."""
        response = self._request("GET", path, params=params)
        return response.headers.get("content-type", "").partition(";")[0], response.content

    def change(self, method: str, path: str, body: Mapping[str, Any] | None = None, timeout_s: float = 0.0) -> Any:
        """Request a change, which may take longer than a reading, and return the JSON of the answer."""
        try:
            content = json.dumps(body or {}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ServiceError(self.url, f"This can't be sent to the service at {self.url}: {error}.") from error
        headers = {"Content-Type": "application/json"}
        timeout_s = max(timeout_s, self.timeout_s)
        return self._json(path, self._request(method, path, content=content, headers=headers, timeout=timeout_s))

    def events(self) -> Iterator[Event]:
        """Yield the name and the data of each server-sent event, the state of the service first."""
        from httpx_sse import EventSource, SSEError

        timeout = httpx.Timeout(self.timeout_s, read=_SILENCE_S)
        headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
        try:
            with self._client.stream("GET", "/v1/events", timeout=timeout, headers=headers) as response:
                if response.status_code != 200:
                    response.read()
                    self._raise_refusal("/v1/events", response)
                for event in EventSource(response).iter_sse():
                    with suppress(ValueError):
                        data = event.json()
                        if isinstance(data, dict):
                            yield event.event, data
        except SSEError as error:
            raise ServiceError(self.url, f"{self.url} sends no events: {error}.") from error
        except (httpx.HTTPError, httpx.StreamError) as error:
            self._raise_unreachable(error)

    def _request(self, method: str, path: str, **request: Any) -> httpx.Response:
        try:
            response = self._client.request(method, path, **request)
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            self._raise_unreachable(error)
        except RuntimeError as error:
            text = f"The connection to {self.url} is closed. Make one: ep.connect(...)."
            raise ServiceError(self.url, text) from error
        if response.status_code != 200:
            self._raise_refusal(path, response)
        return response

    def _json(self, path: str, response: httpx.Response) -> Any:
        try:
            return response.json()
        except ValueError as error:
            raise ServiceError(self.url, f"What answers at {self.url}{path} is no EPypes service.") from error

    def _raise_unreachable(self, error: Exception) -> NoReturn:
        if isinstance(error, httpx.TimeoutException):
            text = f"The service at {self.url} did not answer in time ({self.timeout_s:g} s). Is it stopped, or busy?"
        elif isinstance(error, httpx.ConnectError):
            text = f"No service answers at {self.url}. Start one: epypes serve BUNDLE --http ADDRESS"
        elif isinstance(error, httpx.UnsupportedProtocol | httpx.InvalidURL):
            text = f"{self.url!r:.200} is no address of a service. Write it as http://127.0.0.1:8642."
        else:
            text = f"The connection to the service at {self.url} broke off: {error or type(error).__name__}."
        raise ServiceError(self.url, text) from error

    def _raise_refusal(self, path: str, response: httpx.Response) -> NoReturn:
        try:
            body = response.json()
        except ValueError:
            body = {}
        body = body if isinstance(body, dict) else {}
        detail = str(body.get("detail") or f"{path} was answered with status {response.status_code}.")
        detail = detail[:_MAX_DETAIL_CHARACTERS]
        if "revision" in body and "parameters" in body:
            raise RevisionConflict(self.url, read_parameters(self.url, body))
        if "problems" in body and path == "/v1/parameters":
            raise ParametersRefused(self.url, body["problems"])
        if "reasons" in body:
            raise DeployRefused(self.url, body["reasons"])
        if response.status_code in (401, 403) and not self._has_key:
            raise ServiceError(self.url, f"{detail} {_HOW_TO_CHANGE}")
        if response.status_code == 409:
            raise NotComputed("", detail)
        if response.status_code == 422:
            raise MessageError("refused", detail)
        raise ServiceError(self.url, detail)


def split_url(url: str) -> tuple[str, str]:
    """Return the address of a service without what its page's address has behind it, and the access key in that.

    Raises
    ------
    ServiceError
        This is no address.
    """
    try:
        parts = urlsplit(url.strip())
        is_address = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except (ValueError, AttributeError):
        is_address = False
    if not is_address:
        # Not what is behind a mark, which may be the key.
        shown = re.split("[?#]", url)[0] if isinstance(url, str) else url
        text = f"{shown!r:.200} is no address of a service. Write it as http://127.0.0.1:8642."
        raise ServiceError(shown, text)
    # It was printed as #token=... once.
    found = parse_qs(parts.query).get("access_key") or parse_qs(parts.fragment).get("token") or [""]
    return f"{parts.scheme}://{parts.netloc}{parts.path.rstrip('/')}", found[0]


def read_parameters(url: str, body: Any) -> Parameters:
    """Return the parameters in a service's answer; ServiceError if it has none."""
    try:
        entries = {str(token): dict(entry) for token, entry in body["parameters"].items()}
        return Parameters(int(body["revision"]), entries)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ServiceError(url, f"What answers at {url} is no EPypes service: it has no parameters.") from error
