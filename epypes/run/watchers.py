"""Who is told that a runner has changed?"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

_LOG: Final = logging.getLogger(__name__)


class Watchers:
    """Callbacks that are called, without arguments, on the thread that changed something.

    What one raises is logged: the run that it was told of has been done all the same.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Replaced as a whole, so that telling needs no lock.
        self.callbacks: tuple[Callable[[], object], ...] = ()

    def add(self, callback: Callable[[], object]) -> Callable[[], None]:
        """Tell from now on; return what ends that, and may be called twice."""
        # A callable of its own for each call, so that one callback may be added twice and taken out once.
        entry = lambda: callback()  # noqa: E731
        with self._lock:
            self.callbacks = (*self.callbacks, entry)

        def remove() -> None:
            with self._lock:
                self.callbacks = tuple(other for other in self.callbacks if other is not entry)

        return remove

    def tell(self) -> None:
        """Call them all."""
        for callback in self.callbacks:
            try:
                callback()
            except Exception:
                _LOG.exception("A watcher of a runner has failed")
