"""Queries to the worker: its graph, previews of tokens, values of a run.

Answers about the graph are cached, and shown while there is no worker, or while it is busy.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from epypes.errors import NotComputed, ServiceError, UnknownName
from epypes.service.bundle_info import BundleInfo
from epypes.service.supervision.frame_socket import WorkerMessage
from epypes.service.supervision.worker_connection import WorkerConnection

_MAX_CACHED: Final = 64
_MAX_BYTES: Final = 32 * 1024**2


class WorkerQueries:
    """Queries the worker, and caches its answers.

    Parameters
    ----------
    bundle
        Returns the bundle that is served.
    worker
        Returns the worker; None while there is none.
    """

    def __init__(self, bundle: Callable[[], BundleInfo], worker: Callable[[], WorkerConnection | None]) -> None:
        self._bundle, self._worker = bundle, worker
        # By the bundle's digest, the query and its arguments. With the lock.
        self._cache: OrderedDict[tuple[Any, ...], WorkerMessage] = OrderedDict()
        self._bytes, self._lock = 0, threading.Lock()

    def graph(self, what: str) -> bytes:
        """Return the graph with the values of the last completed run, as JSON (``"view"``) or drawn (``"svg"``)."""
        return bytes(self._cached(what).frames[0])

    def preview(self, token: str, max_side_px: int) -> tuple[str, bytes]:
        """Return the media type and the bytes of a picture of a token, or of a text."""
        answer = self._cached("preview", token=token, max_side_px=max_side_px)
        return str(answer.content["media_type"]), bytes(answer.frames[0])

    def run(self, tokens: Sequence[str], revision: int | None) -> bytes:
        """Return the values of tokens in the last completed run, as one packed Envelope.

        With a revision, waits for the values of a run with this revision or a later one. They are never cached.
        """
        arguments = {"tokens": list(tokens)} | ({} if revision is None else {"revision": revision})
        return bytes(self._query("run", arguments, self._worker()).frames[0])

    def _cached(self, what: str, **arguments: Any) -> WorkerMessage:
        connection = self._worker()
        digest = (self._bundle() if connection is None else connection.bundle).digest
        key = (digest, what, *arguments.values())
        try:
            answer = self._query(what, arguments, connection)
        except ServiceError:
            with self._lock:
                if key not in self._cache:
                    raise
                self._cache.move_to_end(key)
                return self._cache[key]
        with self._lock:
            # Answers about another bundle are of no use any more.
            stale = [known for known in self._cache if known[0] != digest]
            for known in (*stale, *[key] * (key in self._cache)):
                self._bytes -= _size(self._cache.pop(known))
            self._cache[key] = answer
            self._bytes += _size(answer)
            while len(self._cache) > _MAX_CACHED or self._bytes > _MAX_BYTES:
                self._bytes -= _size(self._cache.popitem(last=False)[1])
        return answer

    def _query(self, what: str, arguments: Mapping[str, Any], connection: WorkerConnection | None) -> WorkerMessage:
        if connection is None:
            raise ServiceError(self._bundle().path, "There is no worker just now. Try again in a moment.")
        answer = connection.query(what, **arguments)
        refusal = answer.content
        if "error" not in refusal:
            return answer
        asked = [arguments["token"]] if "token" in arguments else arguments.get("tokens", [])
        ends = (end for both in connection.about.get("func_io", {}).values() for end in both)
        known = tuple(dict.fromkeys(token for end in ends for token in end))
        unknown = [token for token in asked if token not in known]
        if refusal.get("reason") == "unknown token" and unknown:
            raise UnknownName("token", unknown[0], known, "in this service")
        if refusal.get("reason") == "not computed":
            raise NotComputed(", ".join(asked), str(refusal["error"]))
        raise ServiceError(connection.bundle.path, str(refusal["error"]))


def _size(answer: WorkerMessage) -> int:
    return sum(len(frame) for frame in answer.frames)
