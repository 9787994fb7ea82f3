"""How often was each function called?"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any


class Calls:
    """Counts the calls of the functions that it wraps, from any thread."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    def of(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any) -> Any:
            with self._lock:
                self.counts[function.__name__] += 1
            return function(*args)

        return counted

    def clear(self) -> None:
        self.counts.clear()
