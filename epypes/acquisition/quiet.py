"""Silencing OpenCV's log while EPypes reports a failure as an error of its own."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from epypes.optional import optional_import

# cv2.utils.logging.LOG_LEVEL_SILENT
_SILENT: Final = 0
_lock = threading.Lock()
_users = 0
_level_before = 0


@contextmanager
def quiet() -> Iterator[None]:
    """Silence OpenCV's log while this lasts.

    The level belongs to the whole process and cameras read side by side, so the last one to leave sets it back.
    """
    global _users, _level_before
    with _lock:
        if _users == 0:
            _level_before = _set_level(_SILENT)
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                _set_level(_level_before)


def _set_level(level: int) -> int:
    """Set the level of OpenCV's log, and return the one before."""
    with optional_import():
        import cv2

    # Up to OpenCV 4.12 the function is in cv2 itself.
    logging = getattr(cv2.utils, "logging", cv2)
    return int(logging.setLogLevel(level))
