"""What do those see who look at a service: its graph, pictures of tokens, values?"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from epypes.errors import NotComputed, ServiceError, UnknownName
from epypes.service.link import Link, Message
from epypes.service.served import Served

_MOST_KEPT: Final = 64
_MOST_BYTES: Final = 32 * 1024**2


class Asks:
    """Asks the worker, and remembers what it said for when it can't.

    Parameters
    ----------
    served
        Returns the bundle that is served.
    worker
        Returns the worker; None while there is none.
    """

    def __init__(self, served: Callable[[], Served], worker: Callable[[], Link | None]) -> None:
        self._served, self._worker = served, worker
        # By the bundle's digest, what was asked, and for what. With the lock.
        self._known: OrderedDict[tuple[Any, ...], Message] = OrderedDict()
        self._bytes, self._turn = 0, threading.Lock()

    def graph(self, what: str) -> bytes:
        """Return the graph with the values of the last completed run, as JSON (``"view"``) or drawn (``"svg"``)."""
        return bytes(self._ask(what)[1][0])

    def preview(self, token: str, max_side_px: int) -> tuple[str, bytes]:
        """Return the media type and the bytes of a picture of a token, or of a text."""
        header, frames = self._ask("preview", token=token, max_side_px=max_side_px)
        return str(header["media_type"]), bytes(frames[0])

    def run(self, tokens: Sequence[str], revision: int | None) -> bytes:
        """Return the values of tokens in the last completed run, as one packed Envelope.

        The values of a run with this revision or a later one are waited for; they are never those that were asked
        for before.
        """
        asked = {"tokens": list(tokens)} | ({} if revision is None else {"revision": revision})
        return bytes(self._answer("run", asked, self._worker())[1][0])

    def _ask(self, what: str, **more: Any) -> Message:
        link = self._worker()
        digest = (self._served() if link is None else link.served).digest
        key = (digest, what, *more.values())
        try:
            answer = self._answer(what, more, link)
        except ServiceError:
            with self._turn:
                if key not in self._known:
                    raise
                self._known.move_to_end(key)
                return self._known[key]
        with self._turn:
            self._remember(key, answer)
        return answer

    def _remember(self, key: tuple[Any, ...], answer: Message) -> None:
        # Nobody asks for what another bundle has shown.
        others = [known for known in self._known if known[0] != key[0]]
        for known in (*others, *[key] * (key in self._known)):
            self._bytes -= _size(self._known.pop(known))
        self._known[key] = answer
        self._bytes += _size(answer)
        while len(self._known) > _MOST_KEPT or self._bytes > _MOST_BYTES:
            self._bytes -= _size(self._known.popitem(last=False)[1])

    def _answer(self, what: str, more: Mapping[str, Any], link: Link | None) -> Message:
        if link is None:
            raise ServiceError(
                self._served().path, "There is no worker just now that could answer. Try again in a moment."
            )
        answer = link.ask(what, **more)
        if "error" in answer[0]:
            raise self._error(answer[0], link, more)
        return answer

    def _error(self, header: Mapping[str, Any], link: Link, more: Mapping[str, Any]) -> Exception:
        asked = [more["token"]] if "token" in more else more.get("tokens", [])
        text, reason = str(header["error"]), header.get("reason")
        known = tokens_of(link.about.get("func_io", {}))
        unknown = [token for token in asked if token not in known]
        if reason == "unknown token" and unknown:
            return UnknownName("token", unknown[0], known, "in this service")
        if reason == "not computed":
            return NotComputed(", ".join(asked), text)
        return ServiceError(link.served.path, text)


def _size(answer: Message) -> int:
    return sum(frame.nbytes for frame in answer[1])


def tokens_of(func_io: Mapping[str, Sequence[Sequence[str]]]) -> tuple[str, ...]:
    """Return all tokens of a graph, given the inputs and outputs of each function.

    Examples
    --------
    >>> tokens_of({"f": (("x",), ("y",)), "g": (("y",), ("z",))})
    ('x', 'y', 'z')
    """
    found = (token for ends in func_io.values() for end in ends for token in end)
    return tuple(dict.fromkeys(found))
