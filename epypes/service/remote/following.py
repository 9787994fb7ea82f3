"""How is a service followed that may be gone and come back?"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from typing import Any, Final

from epypes.errors import EpypesError
from epypes.service.remote.control import Stream

_LOG: Final = logging.getLogger(__name__)
_FIRST_WAIT_S: Final = 0.25
_LAST_WAIT_S: Final = 8.0
_STOP_TIMEOUT_S: Final = 5.0


class Follower:
    """Hears what a service tells of by itself, on a thread of its own; when the service is gone, it tries again.

    Parameters
    ----------
    events
        Opens the stream.
    back
        Is called when the stream is open, before the first event.
    heard
        Is called with the name of each event and what it says.
    gone
        Is called with the reason when the stream ends, and when it can't be opened.

    Notes
    -----
    All are called on its thread, a daemon. Between two tries it waits 0.25 s, 0.5 s ... 8 s.
    """

    def __init__(
        self,
        events: Callable[[], AbstractContextManager[Stream]],
        back: Callable[[], None],
        heard: Callable[[str, Mapping[str, Any]], None],
        gone: Callable[[str], None],
    ) -> None:
        self._events, self._back, self._heard, self._gone = events, back, heard, gone
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._stream: Stream | None = None
        self._is_open = False
        self._thread = threading.Thread(target=self._work, name="epypes-follower", daemon=True)

    @property
    def is_open(self) -> bool:
        """Whether it hears what the service tells, and has caught up."""
        return self._is_open

    def start(self) -> None:
        """Begin to follow."""
        self._thread.start()

    def stop(self) -> None:
        """Follow no more, and end the thread, from whichever thread."""
        self._stopped.set()
        with self._lock:
            if self._stream is not None:
                self._stream.close()
        if self._thread is not threading.current_thread() and self._thread.ident is not None:
            self._thread.join(_STOP_TIMEOUT_S)

    def _work(self) -> None:
        wait_s = _FIRST_WAIT_S
        while not self._stopped.is_set():
            reason = "It ended the connection."
            try:
                with self._events() as stream:
                    self._take(stream)
                    self._back()
                    self._is_open = True
                    wait_s = _FIRST_WAIT_S
                    for name, said in stream:
                        if self._stopped.is_set():
                            break
                        self._heard(name, said)
            except EpypesError as error:
                reason = str(error)
            except Exception as error:
                _LOG.exception("What a service told could not be taken")
                reason = f"{type(error).__name__}: {error}"
            self._take(None)
            self._is_open = False
            if not self._stopped.is_set():
                with suppress(Exception):
                    self._gone(reason)
            self._stopped.wait(wait_s)
            wait_s = min(2 * wait_s, _LAST_WAIT_S)

    def _take(self, stream: Stream | None) -> None:
        with self._lock:
            self._stream = stream
            if stream is not None and self._stopped.is_set():
                stream.close()
