"""Throttled log warnings, for lines that a peer can cause as often as it likes."""

from __future__ import annotations

import logging
from time import monotonic
from typing import Final

PAUSE_S: Final = 5.0
# Of an error's text, which may quote a peer's message.
_MOST_CHARACTERS: Final = 1_000


class Throttle:
    """Writes at most one warning per cause in `PAUSE_S`; the next one has the number of those that were left out.

    From any thread: two threads at once may write one line more, or miscount by one.

    Parameters
    ----------
    logger
        Where the warnings go.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        # By cause: when the last line was written, and how many were left out since.
        self._written_s: dict[str, float] = {}
        self._left_out: dict[str, int] = {}

    def warning(self, cause: str, text: str) -> None:
        """Write a warning, or count it for the next one; causes are few and fixed, since each is remembered."""
        now_s = monotonic()
        if now_s - self._written_s.get(cause, -PAUSE_S) < PAUSE_S:
            self._left_out[cause] = self._left_out.get(cause, 0) + 1
            return
        self._written_s[cause] = now_s
        left_out = self._left_out.pop(cause, 0)
        shown = text if len(text) <= _MOST_CHARACTERS else f"{text[:_MOST_CHARACTERS]}..."
        self._logger.warning("%s%s", shown, f"; {left_out} more since the last such line" if left_out else "")
