"""What does the view of a panel know, and what is it told?"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import count
from operator import is_
from typing import Any, Final

from epypes.run import Run
from epypes_widgets.frames import make_frame, picture
from epypes_widgets.history import Entry, History, changed
from epypes_widgets.looking.stages import Stage, is_fresh, stages, states
from epypes_widgets.picture import PictureView
from epypes_widgets.plain import plain_values
from epypes_widgets.session import Session
from epypes_widgets.shown import Shown, remember_shown, shown_before

_MOST_ENTRIES: Final = 40
_MOST_LINES: Final = 100
_LINE_CHARACTERS: Final = 500
_ERROR_CHARACTERS: Final = 2_000


class Screen:
    """The view, and all that a view which is mounted later has to be told again.

    Parameters
    ----------
    view
        What is told.
    session
        Its runs are shown.
    history
        Its entries are listed.
    asked
        A token that is a stage in any case; None for none.
    setup
        Returns what a view has to know from the start, with the bytes of its pictures.
    code
        Returns the line of code that does what the hand has done.

    Attributes
    ----------
    shown
        What is wanted to be seen.
    stages
        The tokens that can be.
    error
        What failed with the last values; empty if nothing did.
    told
        The number of the newest entry of the history that the view was told of.
    compute_ms
        How long the run that is shown took; None before the first.
    is_closed
        Whether nothing follows the hand any more.
    """

    def __init__(
        self,
        view: PictureView,
        session: Session,
        history: History,
        asked: str | None,
        setup: Callable[[], tuple[dict[str, Any], list[bytes]]],
        code: Callable[[], str],
    ) -> None:
        self.view = view
        before = shown_before(session.runner)
        self.shown = Shown(asked or before.token, before.pinned)
        self.stages: tuple[Stage, ...] = ()
        self.error = ""
        self.compute_ms: float | None = None
        self._session, self._history, self._asked, self._setup, self._code = session, history, asked, setup, code
        self._lock = threading.Lock()
        self._seq = count(1).__next__
        self._failure: dict[str, Any] | None = None
        self._noted, self._waits = "", False
        self.is_closed = False
        self._reference: tuple[dict[str, Any], tuple[bytes, ...]] | None = None
        self._referred: tuple[object, tuple[Any, ...]] = (None, ())
        self._seen_token: str | None = None
        # Held while the history is told, so that what is told last is the newest.
        self._telling = threading.Lock()
        self._told: set[int] = set()
        self.told = 0
        self._log: list[dict[str, str]] = []
        self._verdicts: dict[str, Any] | None = None

    # -- what is shown ------------------------------------------------------------------------------------------

    def change(self, **parts: Any) -> Shown:
        """Replace parts of what is shown, and return it."""
        with self._lock:
            self.shown = replace(self.shown, **parts)
            remember_shown(self._session.runner, self.shown)
            return self.shown

    @property
    def _pictures(self) -> set[str]:
        return {stage.token for stage in self.stages if stage.is_picture}

    def require_stage(self, token: object) -> str:
        """Return the token; LookupError if it is no stage."""
        if not any(stage.token == token for stage in self.stages):
            raise LookupError(f"{token!r} has no picture here.")
        return str(token)

    # -- what is told, on the worker's thread -------------------------------------------------------------------

    def follow(self, run: Run) -> None:
        """Offer the stages that a completed run has; keep what is shown if it is among them."""
        found = stages(run, self.stages, self._asked)
        with self._lock:
            is_new, self.stages = found != self.stages, found
            self.shown = self.shown.within(found, run)
        if is_new:
            self.tell_setup()

    def show(self, run: Run, changed_ns: int, *, failed: Run | None = None) -> None:
        """Show a completed run; ``failed`` is the newer one that did not complete."""
        shown = self.shown
        if shown.token is None:  # a graph may have no tokens
            return
        if failed is None:
            self._failure, self.error = None, ""
            if self._waits:
                self.note("")
            self.compute_ms = run.report.total_ns / 1e6
        if is_fresh(run, shown.token):
            self._seen_token = shown.token
        frame = make_frame(
            run,
            shown.token,
            self._seq(),
            shown,
            changed_ns,
            self._pictures,
            stale=failed is not None,
            image=self._session.image_wanted,
            stages=states(failed or run, self.stages),
        )
        self.view.frames.offer(frame)

    def token_in(self, run: Run) -> str | None:
        """Return the token that is seen in a run: the one before, while one chosen just now is not computed."""
        token = self.shown.token
        return token if token is None or is_fresh(run, token) else self._seen_token

    def fail(self, text: str, function: str = "", names: Sequence[str] = ()) -> None:
        """Say what failed, and where; the picture stays."""
        self.error = text = text[:_ERROR_CHARACTERS]
        self._failure = {"seq": self._seq(), "text": text, "function": function, "names": list(names)}
        self.view.tell("error", self._failure)

    def note(self, text: str) -> None:
        """Say something that is no failure; it stays until something else is said, or nothing."""
        if text != self._noted:
            self._noted, self._waits = text, False
            self._tell_note()

    def wait(self, text: str) -> None:
        """Say what is waited for, which is no failure: in the picture's place if there is none yet."""
        if self.error:
            self._failure, self.error = None, ""
            self.view.tell("error", {"seq": self._seq(), "text": "", "function": "", "names": []})
        self._noted, self._waits = text, True
        self._tell_note()

    def close(self, text: str) -> None:
        """Say that nothing follows the hand any more."""
        self.is_closed = True
        self.tell_setup()
        self.tell_history()
        self.note(text)

    def _tell_note(self) -> None:
        self.view.tell("note", {"text": self._noted, "waits": self._waits})

    def refers_to(self, key: object, payload: Sequence[Any]) -> bool:
        """Whether the picture is compared with this, computed from the very values of this payload."""
        before, values = self._referred
        return before == key and len(values) == len(payload) and all(map(is_, values, payload))

    def refer(self, key: object, payload: Sequence[Any], label: str, run: Run, token: str) -> None:
        """Show a token of another run to compare with."""
        self._referred = key, tuple(payload)
        described, data = picture(run, token, "other", had_pictures=self._pictures)
        self._reference = {"seq": self._seq(), "label": label, "picture": described}, (data,) if data else ()
        self.view.tell("reference", *self._reference)

    def refer_anew(self) -> None:
        """Have what the picture is compared with computed again: a cell has run it, or set what is default."""
        self._referred = (None, ())

    def refer_to_nothing(self) -> None:
        """Compare with nothing, or with another stage, which comes with each frame."""
        self._referred, self._reference = (None, ()), None

    # -- what is told, on any thread ----------------------------------------------------------------------------

    def tell_setup(self) -> None:
        """Tell all that a new view must know, but for the picture."""
        setup, buffers = self._setup()
        shown = self.shown
        setup |= {
            "stages": [{"token": stage.token, "is_picture": stage.is_picture} for stage in self.stages],
            "token": shown.token,
            "pinned": list(shown.pinned),
            "histogram": shown.has_histogram,
            "closed": self.is_closed,
        }
        self.view.tell("setup", setup, buffers)

    def tell_history(self) -> None:
        """Tell the last entries; a thumbnail goes to a view once, and is empty from then on."""
        with self._telling:
            entries, current = self._history.entries, self._history.current
            pairs = list(zip([None, *entries][: len(entries)], entries, strict=True))
            # The first one is where all came from.
            pairs = pairs if len(pairs) <= _MOST_ENTRIES else [pairs[0], *pairs[1 - _MOST_ENTRIES :]]
            self.told = len(entries) and entries[-1].number
            content = [_entry(before, entry, is_current=entry is current) for before, entry in pairs]
            buffers = [b"" if entry.number in self._told else _thumbnail(entry) for _, entry in pairs]
            if self.view.frames.mounted:
                self._told.update(entry.number for _, entry in pairs)
            state = {"undo": self._history.can_undo, "redo": self._history.can_redo, "code": self._code()}
            self.view.tell("history", {"entries": content, **state}, buffers)

    def tell_verdicts(self, content: dict[str, Any]) -> None:
        """Tell which test images pass."""
        self._verdicts = content
        self.view.tell("cases", content)

    def log(self, text: str) -> None:
        """Add a line to the log drawer."""
        line = {"at": f"{datetime.now().astimezone():%H:%M:%S}", "text": text[:_LINE_CHARACTERS]}
        with self._lock:
            self._log = [*self._log, line][-_MOST_LINES:]
        self.view.tell("log", {"lines": self._log})

    @property
    def lines(self) -> tuple[str, ...]:
        """What is in the log drawer."""
        return tuple(f"{line['at']} {line['text']}" for line in self._log)

    def ready(self) -> None:
        """Tell a view that has been mounted everything, its picture last."""
        self.view.frames.mount()
        with self._telling:
            self._told.clear()
        self.tell_setup()
        self.tell_history()
        if self._verdicts is not None:
            self.view.tell("cases", self._verdicts)
        if self._reference is not None:
            self.view.tell("reference", *self._reference)
        if self._log:
            self.view.tell("log", {"lines": self._log})
        self.view.frames.ready()
        if self._noted:
            self._tell_note()
        if self._failure is not None:
            self.view.tell("error", self._failure)


def _entry(before: Entry | None, entry: Entry, *, is_current: bool) -> dict[str, Any]:
    return {
        "number": entry.number,
        "values": plain_values(entry.values),
        "label": entry.label,
        "changed": changed(before, entry),
        "current": is_current,
    }


def _thumbnail(entry: Entry) -> bytes:
    return b"" if entry.picture is None else entry.picture.data
