"""Count the calls of functions."""

from __future__ import annotations

import logging
import threading
import uuid
from collections import Counter
from collections.abc import Callable
from typing import Any


def log_to(listener: Callable[[Any], None]) -> logging.Logger:
    """Return a logger that gives what is logged to a listener.

    Stored results are of all that a function reaches, and of a logger that is its name alone: so a listener may count.
    """

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            listener(record.msg)

    logger = logging.getLogger(f"calls.{uuid.uuid4()}")
    logger.addHandler(Handler())
    logger.propagate = False
    logger.setLevel(logging.INFO)
    return logger


class Calls:
    """Counts the calls of the functions that it wraps, from any thread."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._logger = log_to(self._count)

    def _count(self, name: str) -> None:
        with self._lock:
            self.counts[name] += 1

    def of(self, function: Callable[..., Any]) -> Callable[..., Any]:
        logger = self._logger

        def counted(*args: Any) -> Any:
            logger.info(function.__name__)
            return function(*args)

        return counted

    def clear(self) -> None:
        self.counts.clear()
