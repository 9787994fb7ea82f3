"""How is an event loop driven, step by step, by whoever waits?"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from contextlib import AbstractContextManager
from selectors import SelectorKey
from time import monotonic
from typing import Any, Final

from epypes.transport.channels.waking import OwnSelector

# Who does not wait gives what there is to do so many rounds, of which reading a message takes all.
_ROUNDS: Final = 3
_ROUNDS_UNASKED: Final = 8


class _Sparing(OwnSelector):
    """A selector within which a loop never waits: one that has nothing to do is stopped, and waits outside.

    Nor is the kernel asked at each round of a loop that has something else to do: a message takes five rounds, and at
    each the interpreter's lock would be let go of.

    Attributes
    ----------
    is_idle
        Whether the loop was stopped since it has nothing to do.
    due_s
        When it has, at the latest, by the monotonic clock.
    waits_until_s
        Until when somebody waits; 0 if nobody does.
    is_changed
        Whether something else is to be waited for than what who waits knows of.
    """

    def __init__(self, loop: OwnLoop) -> None:
        super().__init__()
        self._loop, self._spared = loop, 0
        self._found: list[tuple[SelectorKey, int]] = []
        self.is_idle = False
        self.due_s = self.waits_until_s = 0.0
        self.is_changed = False

    def wait_until(self, until_s: float) -> None:
        """Take note of who is about to wait, until then at most."""
        self.waits_until_s, self.is_changed = min(until_s, self.due_s), False

    def wait(self) -> None:
        """Wait until something has come, which the loop finds at its next round."""
        self._found = super().select(max(self.waits_until_s - monotonic(), 0.0))

    def wait_no_more(self) -> None:
        """Take note that nobody waits."""
        self.waits_until_s = 0.0

    def ask_now(self) -> None:
        """Have the kernel be asked at the next round."""
        self._spared = -1

    def select(self, timeout: float | None = None) -> list[tuple[SelectorKey, int]]:
        if self._found:
            found, self._found = self._found, []
            return found
        if timeout is None or timeout > 0.0:
            self.is_idle, self._spared = True, 0
            self.due_s = math.inf if timeout is None else monotonic() + timeout
            self._loop.stop()
            return []
        self._spared += 1
        return [] if self._spared % _ROUNDS_UNASKED or self.waits_until_s else super().select(0.0)

    def register(self, fileobj: Any, events: int, data: Any = None) -> SelectorKey:
        self.is_changed = True
        return super().register(fileobj, events, data)

    def modify(self, fileobj: Any, events: int, data: Any = None) -> SelectorKey:
        self.is_changed = True
        return super().modify(fileobj, events, data)

    def unregister(self, fileobj: Any) -> SelectorKey:
        # Who waits for a socket keeps it from being closed.
        self.is_changed = True
        return super().unregister(fileobj)


class OwnLoop(asyncio.SelectorEventLoop):
    """An event loop, as `turns.Loop`. While it waits it does not run, so that another thread may have it run."""

    def __init__(self) -> None:
        self.is_waiting = False
        self._sparing = _Sparing(self)
        super().__init__(self._sparing)

    def step(self, timeout_s: float, aside: AbstractContextManager[object]) -> None:
        """Take a step; see `turns.Loop.step`."""
        if timeout_s <= 0.0:
            self._sparing.ask_now()
            for _ in range(_ROUNDS):
                self.call_soon(self.stop)
                self.run_forever()
            return
        until_s = monotonic() + timeout_s
        if self._run_on():
            self._sparing.wait_until(until_s)
            try:
                self.is_waiting = True
                with aside:
                    self._sparing.wait()
                self.is_waiting = False
            finally:
                self._sparing.wait_no_more()
            self._run_on()

    def _run_on(self) -> bool:
        """Run until there is nothing to do, and return True, or until somebody shall look whether it is done."""
        self._sparing.is_idle = False
        self.run_forever()
        return self._sparing.is_idle

    def flush(self) -> None:
        """See that what is said goes out; see `turns.Loop.flush`."""
        sparing = self._sparing
        is_idle = any(self._run_on() for _ in range(_ROUNDS))
        # Who waits knows of nothing that is otherwise since he began.
        if not is_idle or sparing.is_changed or sparing.due_s < sparing.waits_until_s:
            self.wake()

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
