"""What stands for the browser where a test needs none?"""

from __future__ import annotations

import json
import random
import threading
from collections.abc import Callable
from typing import Any

import pytest

from epypes_widgets import Panel

Channel = Callable[[Callable[[], None]], None]


class FrontEnd:
    """A view of a panel: keeps what arrives and answers as the script in the browser does.

    Parameters
    ----------
    panel
        Whose view this is.
    monkeypatch
        Puts this in the place of the comm.
    down, up
        Carry a message from the kernel and an answer to it: each is given a function that delivers, and may call it
        later, on another thread, twice or never. At once without.
    """

    def __init__(
        self, panel: Panel, monkeypatch: pytest.MonkeyPatch, down: Channel | None = None, up: Channel | None = None
    ) -> None:
        self.messages: list[dict[str, Any]] = []
        self.buffers: list[list[bytes]] = []
        self.painted: list[dict[str, Any]] = []
        self.view = panel._screen.view
        self._down, self._up = down or (lambda deliver: deliver()), up or (lambda deliver: deliver())
        self._changed = threading.Condition()
        monkeypatch.setattr(self.view, "send", self._sent)
        self.tell("ready")

    @property
    def frames(self) -> list[dict[str, Any]]:
        return self.of("frame")

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [message for message in self.messages if message["kind"] == kind]

    def last(self, kind: str) -> dict[str, Any]:
        return self.of(kind)[-1]

    def tell(self, kind: str, **content: Any) -> None:
        message = json.loads(json.dumps({"kind": kind, **content}))
        self._up(lambda: self.view._handle(self.view, message, []))

    def wait_for_values(self, timeout_s: float, **values: Any) -> None:
        """Return when the picture that is shown was computed with these values."""

        def are_shown() -> bool:
            return bool(self.painted) and values.items() <= self.painted[-1]["values"].items()

        with self._changed:
            assert self._changed.wait_for(are_shown, timeout_s), self.painted[-1]["values"] if self.painted else None

    def _sent(self, content: dict[str, Any], buffers: list[bytes] | None = None) -> None:
        message = json.loads(json.dumps(content, allow_nan=False))
        self._down(lambda: self._arrives(message, list(buffers or [])))

    def _arrives(self, message: dict[str, Any], buffers: list[bytes]) -> None:
        with self._changed:
            self.messages.append(message)
            self.buffers.append(buffers)
            if message["kind"] != "frame":
                return
            if not self.painted or message["seq"] > self.painted[-1]["seq"]:
                self.painted.append(message)
            self._changed.notify_all()
        self.tell("painted", seq=message["seq"])


class BadLine:
    """A channel on a thread of its own that loses, doubles, delays and exchanges what it carries, until it is mended.

    Parameters
    ----------
    seed
        Of what happens.
    """

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._changed = threading.Condition()
        self._waiting: list[Callable[[], None]] = []
        self._is_bad, self._is_open = True, True
        self.lost = 0
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def __call__(self, deliver: Callable[[], None]) -> None:
        with self._changed:
            fate = self._random.random() if self._is_bad else 1.0
            if fate < 0.3:
                self.lost += 1
                return
            self._waiting += [deliver] * (2 if fate < 0.4 else 1)
            self._changed.notify()

    def mend(self) -> None:
        """Lose nothing more; what waits arrives in any order."""
        with self._changed:
            self._is_bad = False

    def close(self) -> None:
        with self._changed:
            self._is_open = False
            self._changed.notify()
        self._thread.join(60)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or not self._is_open)
                if not self._is_open:
                    return
                deliver = self._waiting.pop(self._random.randrange(len(self._waiting)))
            deliver()
