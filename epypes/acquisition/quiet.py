"""How is OpenCV kept from printing what is said in an error of ours?"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from epypes.optional import optional_import

_lock = threading.Lock()
_users = 0
_level_before = 0


@contextmanager
def quiet() -> Iterator[None]:
    """Silence OpenCV's log while this lasts.

    The level belongs to the whole process and cameras read side by side, so the last one to leave sets it back.
    """
    with optional_import():
        import cv2

    global _users, _level_before
    with _lock:
        if _users == 0:
            _level_before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                cv2.utils.logging.setLogLevel(_level_before)
