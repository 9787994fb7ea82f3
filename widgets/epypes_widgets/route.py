"""On which thread of the kernel is the front end's answer to a message handled?

Since ipykernel 7.4, on the one that handled the request during which the message was sent. A thread that a cell has
started counts as that cell; so what the front end answers to it, or sends next, would wait until cells have ended.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import Context, copy_context
from typing import Any


class Route:
    """Sends messages as answers to the front end, whichever thread sends them, so that no cell holds up what follows.

    Before anything has been heard, messages are sent as they are.
    """

    def __init__(self) -> None:
        self._context: Context | None = None

    def hear(self) -> None:
        """Know that the front end is being listened to here: on this thread, during this message."""
        self._context = copy_context()

    def call(self, send: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function that sends messages, and return what it returns."""
        if self._context is None:
            return send(*arguments)
        # A context can be in use once at a time.
        return self._context.copy().run(send, *arguments)
