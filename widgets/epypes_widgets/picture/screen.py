"""What the view of a panel shows: the stages, the picture, what failed, the history, and all of it for a new view."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from itertools import count
from typing import Any, Final
from weakref import WeakKeyDictionary

from epypes.run import Run
from epypes_widgets.history import History, changed
from epypes_widgets.picture.frames import make_frame, picture
from epypes_widgets.picture.picture_settings import Limits, PictureSettings
from epypes_widgets.picture.stages import NO_STAGES, Stages, best_stage, scalars, stages, states
from epypes_widgets.picture.tiles import Tiles
from epypes_widgets.session import Session, Tunable
from epypes_widgets.values import is_same, json_values
from epypes_widgets.view import PictureView

_MAX_ENTRIES: Final = 40
_MAX_LINES: Final = 100
_MOST_CHANGES: Final = 20
_LINE_CHARACTERS: Final = 2_000
_ERROR_CHARACTERS: Final = 2_000


@dataclass(frozen=True, slots=True)
class Comparison:
    """What the picture is compared with.

    Attributes
    ----------
    kind
        ``"default"`` for the first values of all hyperparameters, ``"history"`` for committed ones, ``"stage"`` for
        another token of the same run.
    number
        Of the entry of the history.
    token
        Of the stage.
    """

    kind: str
    number: int = 0
    token: str = ""


@dataclass(frozen=True, slots=True)
class Shown:
    """What is on the screen; replaced as a whole.

    Attributes
    ----------
    token
        Whose picture is the big one; None before the first run.
    pinned
        Whose pictures are shown small beneath it.
    comparison
        None if it is not compared.
    has_histogram
        Whether the histogram of the picture is shown.
    cut
        The tokens whose histograms are shown with thresholds on them.
    pictures
        How pictures are shown, by the token of the image.
    has_scalars
        Whether the numbers that belong to the big picture are written on it.
    scalars
        The tokens of these numbers.
    tiles
        The tokens whose numbers are shown beside it; None for those that matter.
    """

    token: str | None = None
    pinned: tuple[str, ...] = ()
    comparison: Comparison | None = None
    has_histogram: bool = False
    cut: tuple[str, ...] = ()
    pictures: Mapping[str, PictureSettings] = field(default_factory=dict)
    has_scalars: bool = False
    scalars: tuple[str, ...] = ()
    tiles: tuple[str, ...] | None = None

    def with_scalars(self, run: Run | None) -> Shown:
        """Return it with the numbers that belong to the big picture, as far as a run shows which these are."""
        if not self.has_scalars or self.token is None or run is None:
            return replace(self, scalars=())
        return replace(self, scalars=scalars(run, self.token))

    def settings(self, token: str | None) -> PictureSettings:
        """Return how the picture of a token is shown."""
        return self.pictures.get(token or "", PictureSettings())

    @property
    def limits(self) -> Limits:
        """The values that are shown black and white, by token, where they were set."""
        return {token: each.limits for token, each in self.pictures.items() if each.limits is not None}

    @property
    def other(self) -> str:
        """The stage that the big picture is compared with; empty if it is none."""
        return self.comparison.token if self.comparison is not None and self.comparison.kind == "stage" else ""

    @property
    def targets(self) -> tuple[str, ...]:
        """The tokens that must be computed, the big picture's first."""
        cut = self.cut if self.has_histogram else ()
        shown = (self.token, self.settings(self.token).over, self.other, *self.pinned, *cut, *self.scalars)
        return tuple(dict.fromkeys(token for token in shown if token))

    def within(self, stages: Stages, run: Run) -> Shown:
        """Return what of this can be shown with these stages; another big picture if this one can't."""
        token = self.token if self.token in stages else best_stage(run, stages)
        pinned = tuple(name for name in self.pinned if name in stages)
        comparison = self.comparison if not self.other or self.other in stages else None
        return replace(self, token=token, pinned=pinned, comparison=comparison)


# A cell that is run again makes a new panel, which goes on with what the last one of the runner showed.
_last_shown: WeakKeyDictionary[Tunable, Shown] = WeakKeyDictionary()


class Screen:
    """The view, and all that a view which is mounted later must get again.

    Parameters
    ----------
    view
        Gets the messages.
    session
        Its runs are shown.
    history
        Its entries are listed.
    tiles
        The numbers beside the picture.
    asked
        A token that is a stage in any case; None for none.
    cut
        The tokens that thresholds cut; their histograms are shown.

    Attributes
    ----------
    setup
        Returns what a view has to know from the start, with the bytes of its pictures.
    code
        Returns the line of code that sets what the user has set.
    shown
        What is wanted to be seen.
    stages
        The tokens that can be.
    error
        What failed with the last values; empty if nothing did.
    listed
        The number of the newest entry of the history that the view has got.
    compute_ms
        How long the run that is shown took; None before the first.
    """

    setup: Callable[[], tuple[dict[str, Any], list[bytes]]]
    code: Callable[[], str]

    def __init__(
        self,
        view: PictureView,
        session: Session,
        history: History,
        tiles: Tiles,
        asked: str | None,
        cut: tuple[str, ...],
    ) -> None:
        self.view, self.tiles = view, tiles
        before = _last_shown.get(session.runner, Shown())
        first = replace(before, token=asked or before.token, comparison=None, has_histogram=bool(cut), cut=cut)
        self.shown = first.with_scalars(session.result)
        self.stages: Stages = NO_STAGES
        self.error = ""
        self.compute_ms: float | None = None
        self.listed = 0
        self._session, self._history, self._asked = session, history, asked
        self._lock = threading.Lock()
        self._seq = count(1).__next__
        # The last message of each kind that a view which is mounted later must get again, with its bytes.
        self._kept: dict[str, tuple[dict[str, Any], tuple[bytes, ...]]] = {}
        self._is_closed = False
        self._referred: tuple[object, tuple[Any, ...]] = (None, ())
        # Held while the history is sent, so that what is sent last is the newest.
        self._listing = threading.Lock()
        self._pictured: set[int] = set()
        self.change()

    # -- what is shown ------------------------------------------------------------------------------------------

    def change(self, **parts: Any) -> None:
        """Replace parts of what is shown."""
        with self._lock:
            shown = replace(self.shown, **parts).with_scalars(self._session.result)
            self.shown = _last_shown[self._session.runner] = shown

    def change_picture(self, token: str, change: Mapping[str, Any]) -> None:
        """Change how the picture of a token is shown; ValueError or UnknownName if it can't be shown so."""
        cg = self._session.runner.cg
        for name in filter(None, (token, change.get("over"))):
            cg.require_token(name)
        changed = PictureSettings.of({**self.shown.settings(token).content, **change})
        self.change(pictures={**self.shown.pictures, token: changed})

    def require_stage(self, token: str) -> str:
        """Return the token; LookupError if it is no stage."""
        if token not in self.stages:
            raise LookupError(f"{token!r} has no picture here.")
        return token

    @property
    def pinned_tiles(self) -> tuple[str, ...]:
        """The tokens whose numbers are shown."""
        return self.tiles.pinned(self.shown.tiles)

    @property
    def targets(self) -> tuple[str, ...]:
        """The tokens that must be computed for the next frame; everything without."""
        targets = self.shown.targets
        return (*targets, *self.tiles.prompt(self.pinned_tiles, targets)) if targets else ()

    # -- on the worker's thread ---------------------------------------------------------------------------------

    def follow(self, run: Run) -> None:
        """Offer the stages that a completed run has; keep what is shown if it is among them."""
        found = stages(run, self.stages, self._asked)
        with self._lock:
            is_new, self.stages = self.tiles.follow(run, found) or found != self.stages, found
            self.shown = self.shown.within(found, run).with_scalars(run)
        if is_new:
            self.send_setup()

    def show(self, run: Run, changed_ns: int, *, failed: Run | None = None) -> None:
        """Show a completed run; ``failed`` is the newer one that did not complete."""
        shown = self.shown
        if shown.token is None:  # a graph may have no tokens
            return
        if failed is None:
            self.error = ""
            self._kept.pop("error", None)
            if self._note["waits"]:
                self.note("")
            self.compute_ms = run.report.total_ns / 1e6
        image = self._session.image_wanted
        content = {
            "stale": failed is not None,
            "image": image,
            "time_s": None if image is None else self._session.payloads.time_s(image),
            "stages": states(failed or run, self.stages),
            "tiles": self.tiles.content(run, self.pinned_tiles, has_failed=failed is not None),
        }
        make = partial(make_frame, run, shown.token, self._seq(), shown, changed_ns, self._pictures, **content)
        # Made when it is its turn: of those that newer ones replace no picture is encoded.
        self.view.frames.offer(make)

    def fail(self, text: str, function: str = "", names: Sequence[str] = ()) -> None:
        """Say what failed, and where; the picture stays. An empty text ends that."""
        self.error = text = text[:_ERROR_CHARACTERS]
        self.tell("error", {"seq": self._seq(), "text": text, "function": function, "names": list(names)})

    def note(self, text: str, *, waits: bool = False) -> None:
        """Say something that is no failure; it stays until another text, or none.

        What is waited for stands in the picture's place if there is none yet.
        """
        if waits and self.error:
            self.fail("")
        content = {"text": text, "waits": waits}
        if content != self._note:
            self.tell("note", content)

    @property
    def _note(self) -> dict[str, Any]:
        return self._kept["note"][0] if "note" in self._kept else {"text": "", "waits": False}

    def refers_to(self, key: object, payload: Sequence[Any]) -> bool:
        """Whether the picture is compared with this, computed from the very values of this payload."""
        return self._referred[0] == key and is_same(self._referred[1], tuple(payload))

    def refer(self, key: object, payload: Sequence[Any], label: str, run: Run, token: str) -> None:
        """Show a token of another run to compare with."""
        self._referred = key, tuple(payload)
        described, data = picture(run, token, "other", had_pictures=self._pictures, limits=self.shown.limits)
        content = {"seq": self._seq(), "label": label, "picture": described}
        self.tell("reference", content, (data,) if data else ())

    def refer_anew(self, *, to_nothing: bool = False) -> None:
        """Have what the picture is compared with computed again; or compare with nothing, or another stage."""
        self._referred = (None, ())
        if to_nothing:
            self._kept.pop("reference", None)

    @property
    def _pictures(self) -> set[str]:
        return {token for token, is_picture in self.stages.items() if is_picture}

    @property
    def is_beyond(self) -> bool:
        """Whether values are wanted that have no run, beside those of the history's current entry."""
        current, session = self._history.current, self._session
        if current is None:
            return False
        wanted = {name: value for name, value in session.wanted.items() if name in current.values}
        is_other = any(not is_same(current.values[name], value) for name, value in wanted.items())
        return is_other or (session.is_wanting and session.image_wanted != current.image is not None)

    # -- on any thread ------------------------------------------------------------------------------------------

    def tell(self, kind: str, content: dict[str, Any], buffers: tuple[bytes, ...] = ()) -> None:
        """Send a message, now and to each view that is mounted until the next one of its kind."""
        self._kept[kind] = content, buffers
        self.view.tell(kind, content, buffers)

    def send_setup(self) -> None:
        """Send all that a new view must know, but for the picture."""
        setup, buffers = self.setup()
        shown = self.shown
        setup |= {
            "stages": [{"token": token, "is_picture": is_picture} for token, is_picture in self.stages.items()],
            "token": shown.token,
            "pinned": list(shown.pinned),
            "numbers": list(self.tiles.offered),
            "histogram": shown.has_histogram,
            "scalars": shown.has_scalars,
            "pictures": {token: each.content for token, each in shown.pictures.items()},
            "closed": self._is_closed,
        }
        self.view.tell("setup", setup, buffers)

    def send_history(self) -> None:
        """Send the last entries; a thumbnail goes to a view once, and is empty from then on."""
        with self._listing:
            entries, current = self._history.entries, self._history.current
            numbers = self._session.payloads.numbers
            # The first one is where all came from.
            listed = entries if len(entries) <= _MAX_ENTRIES else (entries[0], *entries[1 - _MAX_ENTRIES :])
            pairs = [(self._history.left_for(entry), entry) for entry in listed]
            self.listed = len(entries) and entries[-1].number
            content = [
                {
                    "number": entry.number,
                    "values": json_values(entry.values),
                    "label": entry.label,
                    "changed": changed(before, entry, numbers),
                    "about": changed(before, entry, numbers, _MOST_CHANGES),
                    "current": entry is current,
                }
                for before, entry in pairs
            ]
            new = [entry.picture if entry.number not in self._pictured else None for _, entry in pairs]
            if self.view.frames.mounted:
                self._pictured.update(entry.number for _, entry in pairs)
            undo = self._history.can_undo or self.is_beyond
            state = {"undo": undo, "redo": self._history.can_redo, "code": self.code()}
            pictures = [b"" if each is None else each.data for each in new]
            self.view.tell("history", {"entries": content, **state}, pictures)

    def log(self, *texts: str) -> None:
        """Add lines to the log drawer."""
        if not texts:
            return
        at = f"{datetime.now().astimezone():%H:%M:%S}"
        with self._lock:  # of two threads none loses the other's line
            lines = [*self._lines, *({"at": at, "text": text[:_LINE_CHARACTERS]} for text in texts)][-_MAX_LINES:]
            self._kept["log"] = {"lines": lines}, ()
        self._tell_again("log")

    @property
    def lines(self) -> tuple[str, ...]:
        """What is in the log drawer."""
        return tuple(f"{line['at']} {line['text']}" for line in self._lines)

    @property
    def _lines(self) -> list[dict[str, str]]:
        return self._kept["log"][0]["lines"] if "log" in self._kept else []

    def close(self, text: str) -> None:
        """Say that values are not followed any more."""
        self._is_closed = True
        self.send_setup()
        self.send_history()
        self.note(text)

    def ready(self) -> None:
        """Send everything to a view that has been mounted, its picture last."""
        self.view.frames.mount()
        with self._listing:
            self._pictured.clear()
        self.send_setup()
        self.send_history()
        self._tell_again("cases", "reference", "log")
        self.view.frames.ready()
        self._tell_again("note", "error")

    def _tell_again(self, *kinds: str) -> None:
        for kind in kinds:
            if (kept := self._kept.get(kind)) is not None:
                self.view.tell(kind, *kept)
