"""What becomes of values that are to be written back into the bundle of a service?"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

from epypes.errors import EpypesError

_LOG: Final = logging.getLogger(__name__)
_DIFF_CHARACTERS: Final = 20_000
_DIGEST_CHARACTERS: Final = 12

State = Literal["running", "diff", "done", "refused"]


class Writable(Protocol):
    """What writes values back: a connection to a service."""

    def write_back(self, dry_run: bool = False) -> Any:
        """Write them, or say what would change; the answer has ``diff`` and ``digest``."""
        ...


@dataclass(frozen=True, slots=True)
class Written:
    """How far writing back has come.

    Attributes
    ----------
    state
        ``"running"``, ``"diff"`` when it is shown what would change, ``"done"`` or ``"refused"``.
    text
        For the user.
    diff
        What would change, or has changed.
    """

    state: State
    text: str
    diff: str = ""


class WritingBack:
    """Writes values back on a thread of its own, one at a time.

    Parameters
    ----------
    report
        Is called with each ``Written``, the first on the caller's thread. What it raises is logged.
    """

    def __init__(self, report: Callable[[Written], None]) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._ended.set()
        self.last: Written | None = None

    def start(self, service: Writable, *, dry_run: bool) -> bool:
        """Begin, and return at once; False, and nothing else, if one is under way.

        Parameters
        ----------
        service
            Is asked.
        dry_run
            Whether to show what would change; nothing is written then.
        """
        with self._lock:
            if not self._ended.is_set():
                return False
            self._ended.clear()
        text = "Looking at what would change ..." if dry_run else "Writing, and replaying the samples ..."
        self._tell(Written("running", text))
        threading.Thread(target=self._work, args=(service, dry_run), name="epypes-write-back", daemon=True).start()
        return True

    def wait(self, timeout_s: float) -> Written | None:
        """Return what was told last once nothing is under way; TimeoutError if that takes longer."""
        if not self._ended.wait(timeout_s):
            raise TimeoutError(f"Writing back did not end within {timeout_s:g} s.")
        return self.last

    def _work(self, service: Writable, dry_run: bool) -> None:
        try:
            done = service.write_back(dry_run=dry_run)
            told = _told(str(done.diff), str(done.digest), dry_run)
        except EpypesError as error:
            told = Written("refused", f"Not written: {error}")
        except Exception as error:
            told = Written("refused", f"Not written: {type(error).__name__}: {error}")
        self._tell(told)
        self._ended.set()

    def _tell(self, told: Written) -> None:
        self.last = told
        try:
            self._report(told)
        except Exception:
            _LOG.exception("What became of writing back could not be shown")


def _told(diff: str, digest: str, dry_run: bool) -> Written:
    short = digest[:_DIGEST_CHARACTERS]
    if not diff:
        return Written("done", f"pipeline.toml has these values already; the bundle is {short}.")
    shown = diff if len(diff) <= _DIFF_CHARACTERS else f"{diff[:_DIFF_CHARACTERS]}\n..."
    if dry_run:
        return Written("diff", "This would change in pipeline.toml.", shown)
    return Written("done", f"Written to pipeline.toml and replayed; the bundle is {short} now.", shown)
