"""How is the HTTP control of a service asked, and what does it mean when that fails?"""

from __future__ import annotations

import json
import socket
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final, NoReturn
from urllib.parse import parse_qs, urlsplit

from epypes.errors import DeployRefused, MessageError, NotComputed, ParametersRefused, RevisionConflict, ServiceError
from epypes.optional import optional_import
from epypes.service.parameters import Parameters

if TYPE_CHECKING:
    import httpx

_LOOPBACK: Final = ("localhost", "127.0.0.1", "::1")
# The service tells its counts each second: who hears nothing for so long hears nothing any more.
SILENCE_S: Final = 5.0
_DETAIL_CHARACTERS: Final = 2_000
_HOW_TO_CHANGE: Final = "Give it here: ep.connect(url, token=...), or set EPYPES_TOKEN."


class Control:
    """The control of one service; may be used from several threads.

    Parameters
    ----------
    url
        Where it is, as ``http://127.0.0.1:8642``.
    token
        What changes are asked for with; empty for none.
    timeout_s
        How long an answer may take.

    Raises
    ------
    ServiceError
        The address is none.
    """

    def __init__(self, url: str, token: str, timeout_s: float) -> None:
        with optional_import():
            import httpx

        self.url, self.timeout_s, self.has_token = url, timeout_s, bool(token)
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        try:
            # A proxy of the environment's has nothing to do with what is on this machine.
            is_here = urlsplit(url).hostname in _LOOPBACK
            self._client = httpx.Client(base_url=url, timeout=timeout_s, headers=headers, trust_env=not is_here)
        except (httpx.InvalidURL, ValueError) as error:
            raise ServiceError(url, f"{url!r:.200} is no address: {error}.") from error
        self.close = weakref.finalize(self, self._client.close)

    def get(self, path: str, **params: Any) -> Any:
        """Return what is read there, from JSON."""
        return self._json(path, self._answered("GET", path, params=params))

    def content(self, path: str, **params: Any) -> tuple[str, bytes]:
        """Return what is read there as it is, with its media type."""
        answer = self._answered("GET", path, params=params)
        return answer.headers.get("content-type", "").partition(";")[0], answer.content

    def change(
        self, method: str, path: str, body: Mapping[str, Any] | None = None, timeout_s: float | None = None
    ) -> Any:
        """Ask for a change, which may take longer than an answer, and return what is answered."""
        try:
            content = json.dumps(body or {}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ServiceError(self.url, f"This can't be sent to the service at {self.url}: {error}.") from error
        headers = {"Content-Type": "application/json"}
        patience_s = max(timeout_s or 0.0, self.timeout_s)
        request = {"content": content, "headers": headers, "timeout": patience_s}
        return self._json(path, self._answered(method, path, **request))

    @contextmanager
    def events(self) -> Iterator[Stream]:
        """Open the stream of what the service tells of by itself."""
        with optional_import():
            import httpx

        timeout = httpx.Timeout(self.timeout_s, read=SILENCE_S)
        headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
        try:
            with self._client.stream("GET", "/v1/events", timeout=timeout, headers=headers) as answer:
                if answer.status_code != 200:
                    answer.read()
                    self._refuse("/v1/events", answer)
                yield Stream(self, answer)
        except (httpx.HTTPError, httpx.StreamError) as error:
            self._fail(error)

    def _answered(self, method: str, path: str, **request: Any) -> httpx.Response:
        with optional_import():
            import httpx

        try:
            answer = self._client.request(method, path, **request)
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            self._fail(error)
        except RuntimeError as error:
            raise ServiceError(
                self.url, f"The connection to {self.url} is closed. Make one: ep.connect(...)."
            ) from error
        if answer.status_code != 200:
            self._refuse(path, answer)
        return answer

    def _fail(self, error: Exception) -> NoReturn:
        with optional_import():
            import httpx

        if isinstance(error, httpx.TimeoutException):
            text = f"The service at {self.url} did not answer in time ({self.timeout_s:g} s). Is it stopped, or busy?"
        elif isinstance(error, httpx.ConnectError):
            text = f"No service answers at {self.url}. Start one: epypes serve BUNDLE --http ADDRESS"
        elif isinstance(error, httpx.UnsupportedProtocol | httpx.InvalidURL):
            text = f"{self.url!r:.200} is no address of a service. Write it as http://127.0.0.1:8642."
        else:
            text = f"The connection to the service at {self.url} broke off: {error or type(error).__name__}."
        raise ServiceError(self.url, text) from error

    def _json(self, path: str, answer: httpx.Response) -> Any:
        try:
            return answer.json()
        except ValueError as error:
            raise ServiceError(self.url, f"What answers at {self.url}{path} is no EPypes service.") from error

    def _refuse(self, path: str, answer: httpx.Response) -> NoReturn:
        """Raise what a refusal means."""
        said = _object(answer)
        detail = str(said.get("detail") or f"{path} was answered with status {answer.status_code}.")
        detail = detail[:_DETAIL_CHARACTERS]
        if "revision" in said and "parameters" in said:
            raise RevisionConflict(self.url, parameters_of(self.url, said))
        if "problems" in said and path == "/v1/parameters":
            raise ParametersRefused(self.url, said["problems"])
        if "reasons" in said:
            raise DeployRefused(self.url, said["reasons"])
        if answer.status_code in (401, 403) and not self.has_token:
            raise ServiceError(self.url, f"{detail} {_HOW_TO_CHANGE}")
        if answer.status_code == 409:
            raise NotComputed("", detail)
        if answer.status_code == 422:
            raise MessageError("refused", detail)
        raise ServiceError(self.url, detail)


class Stream:
    """What a service tells of by itself, while it is open."""

    def __init__(self, control: Control, answer: httpx.Response) -> None:
        self._control, self._answer = control, answer

    def __iter__(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the name of each event and what it says."""
        with optional_import():
            from httpx_sse import EventSource, SSEError

        try:
            for event in EventSource(self._answer).iter_sse():
                with suppress(ValueError):
                    said = event.json()
                    if isinstance(said, dict):
                        yield event.event, said
        except SSEError as error:
            raise ServiceError(self._control.url, f"{self._control.url} tells of no events: {error}.") from error

    def close(self) -> None:
        """End it; whoever waits for its next event waits no more. From any thread."""
        stream = self._answer.extensions.get("network_stream")
        end = stream.get_extra_info("socket") if stream is not None else None
        if end is not None:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


def address_of(url: str) -> tuple[str, str]:
    """Return an address of a service without what a page's has behind it, and the token that was there.

    Raises
    ------
    ServiceError
        It is none.
    """
    try:
        parts = urlsplit(url.strip())
        is_one = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except (ValueError, AttributeError):
        is_one = False
    if not is_one:
        text = f"{url!r:.200} is no address of a service. Write it as http://127.0.0.1:8642."
        raise ServiceError(url, text)
    token = parse_qs(parts.fragment).get("token", [""])[0]
    return f"{parts.scheme}://{parts.netloc}{parts.path.rstrip('/')}", token


def parameters_of(url: str, said: Any) -> Parameters:
    """Return the parameters that a service tells of; ServiceError if it tells of none."""
    try:
        entries = {str(token): dict(entry) for token, entry in said["parameters"].items()}
        return Parameters(int(said["revision"]), entries)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ServiceError(url, f"What answers at {url} is no EPypes service: it has no parameters.") from error


def _object(answer: httpx.Response) -> Mapping[str, Any]:
    try:
        said = answer.json()
    except ValueError:
        return {}
    return said if isinstance(said, dict) else {}
