"""How does the server wait for what may block, and still answer others meanwhile?"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

from epypes.errors import ServiceError

_T = TypeVar("_T")


class Calls:
    """Calls on threads of their own, at most so many at once.

    Parameters
    ----------
    most
        How many may run at once.
    patience_s
        How long one waits for its turn, in seconds.
    busy
        What one is told whose turn does not come.
    """

    def __init__(self, most: int, patience_s: float, busy: str) -> None:
        self._turns = asyncio.Semaphore(most)
        self._patience_s, self._busy = patience_s, busy
        self._waiting: set[asyncio.Future[Any]] = set()

    @property
    def is_full(self) -> bool:
        """Whether as many calls are under way as may be."""
        return self._turns.locked()

    async def __call__(self, function: Callable[..., _T], *arguments: Any, **named: Any) -> _T:
        """Return what a function returns, or raise what it raises.

        Raises
        ------
        ServiceError
            Too many calls are under way, or the server stops.
        """
        try:
            async with asyncio.timeout(self._patience_s):
                await self._turns.acquire()
        except TimeoutError:
            raise ServiceError("", self._busy) from None
        loop = asyncio.get_running_loop()
        future: asyncio.Future[_T] = loop.create_future()
        self._waiting.add(future)

        def call() -> None:
            result, error = None, None
            try:
                result = function(*arguments, **named)
            except BaseException as raised:
                error = raised
            with suppress(RuntimeError):  # the server is gone
                loop.call_soon_threadsafe(self._end, future, result, error)

        # A pool's threads would hold up the end of the interpreter.
        threading.Thread(target=call, name="epypes-http-call", daemon=True).start()
        return await future

    def _end(self, future: asyncio.Future[Any], result: Any, error: BaseException | None) -> None:
        self._turns.release()
        self._waiting.discard(future)
        if future.done():
            return
        if error is None:
            future.set_result(result)
        else:
            future.set_exception(error)

    def stop(self) -> None:
        """Tell all that wait that the server stops."""
        for future in list(self._waiting):
            if not future.done():
                future.set_exception(ServiceError("", "The service stops. Ask it again once it is back."))
