"""How is an event loop driven, step by step, by whoever waits?"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from contextlib import AbstractContextManager
from selectors import SelectorKey
from typing import Final

from epypes.transport.channels.waking import OwnSelector

# What is said goes out within so many rounds: to publish is to wake the library's own task, which writes.
_ROUNDS: Final = 3
_ROUNDS_UNASKED: Final = 8


class _Sparing(OwnSelector):
    """A selector that does not ask the kernel at each round of a loop that has something else to do.

    A message takes five rounds, and at each the interpreter's lock would be let go of.
    """

    def __init__(self, loop: OwnLoop) -> None:
        super().__init__()
        self._loop, self._spared = loop, 0

    def ask_now(self) -> None:
        """Have the kernel be asked at the next round."""
        self._spared = -1

    def select(self, timeout: float | None = None) -> list[tuple[SelectorKey, int]]:
        self._spared = self._spared + 1 if timeout == 0 else 0
        if self._spared % _ROUNDS_UNASKED:
            return []
        self._loop.is_waiting = True
        ready = super().select(timeout)
        self._loop.is_waiting = False
        return ready


class OwnLoop(asyncio.SelectorEventLoop):
    """An event loop, as `turns.Loop`."""

    def __init__(self) -> None:
        self.is_waiting = False
        self._sparing = _Sparing(self)
        super().__init__(self._sparing)

    def step(self, timeout_s: float, aside: AbstractContextManager[object]) -> None:
        """Take a step, aside never: a task may be anywhere; see `turns.Loop.step`."""
        if timeout_s <= 0:
            self._sparing.ask_now()
            for _ in range(_ROUNDS):
                self.call_soon(self.stop)
                self.run_forever()
            return
        alarm = self.call_later(timeout_s, self.stop)
        try:
            self.run_forever()
        finally:
            alarm.cancel()

    def flush(self) -> None:
        """Do nothing, since no step is aside; see `turns.Loop.flush`."""

    def wake(self) -> None:
        """Have a step end soon; see `turns.Loop.wake`."""
        # Closed, there is nobody to be woken.
        with contextlib.suppress(RuntimeError):
            self.call_soon_threadsafe(self.stop)

    def suits(self) -> bool:
        """Return whether the calling thread may take steps; see `turns.Loop.suits`."""
        # A cell of a notebook runs within a loop of its thread, which can't run another one meanwhile.
        return _running() is None


def _running() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None


def is_not_ours(record: logging.LogRecord) -> bool:
    """Return whether a record is not about one of our connections; what happens to those we say ourselves."""
    return not isinstance(_running(), OwnLoop)
