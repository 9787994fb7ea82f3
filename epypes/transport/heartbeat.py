"""Has a publisher nothing to say, or has it stopped?

A subscriber that has heard nothing for a while asks: it takes its private subscription back and gives it again, which
the publisher answers to it alone, as when it joined. So peers of 2019 see nothing of it, and nobody is asked who talks.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from time import monotonic

log = logging.getLogger("epypes.transport")

# In heartbeats. Looked at once in each, so that silence is reported within three.
_ASKED_AFTER, _STALE_AFTER = 0.5, 2.0
# If the next look comes so late, this process itself was held up, and what it did not hear proves nothing.
_LATE_AFTER = 1.5


class Pulse:
    """When a subscriber has heard something last, and whether that is too long ago.

    Parameters
    ----------
    heartbeat_s
        Time between two looks, in seconds.
    report
        Called with True when the input has become stale, and with False when something is heard again; on the I/O
        thread.
    """

    def __init__(self, heartbeat_s: float, report: Callable[[bool], None]) -> None:
        self._heartbeat_s, self._report = heartbeat_s, report
        self._looked_s = monotonic()
        self._heard_s = 0.0
        self.is_stale = False

    @property
    def last_heard_s(self) -> float | None:
        """How many seconds ago something was heard; None if nothing was yet."""
        return monotonic() - self._heard_s if self._heard_s else None

    def heard(self) -> None:
        """Take note that something has been heard."""
        self._heard_s = monotonic()
        if self.is_stale:
            self._change(False)

    def look(self, has_joined: bool) -> bool:
        """Once per heartbeat: see whether the input is stale; return whether the publisher is to be asked.

        Parameters
        ----------
        has_joined
            Whether there was a publisher that answers. Silence of others means nothing.
        """
        now_s = monotonic()
        was_late = now_s - self._looked_s > _LATE_AFTER * self._heartbeat_s
        self._looked_s = now_s
        silent_s = now_s - self._heard_s
        if has_joined and not self.is_stale and not was_late and silent_s >= _STALE_AFTER * self._heartbeat_s:
            self._change(True)
        return silent_s > _ASKED_AFTER * self._heartbeat_s

    def _change(self, is_stale: bool) -> None:
        self.is_stale = is_stale
        try:
            self._report(is_stale)
        except BaseException:
            # It is the user's; the other sockets go on.
            log.exception("on_stale itself failed")
