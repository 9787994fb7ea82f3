"""The view of a panel in the browser, as the kernel knows it: its script, its messages, and the frames on their way.

Every message has a ``kind``; those of the kernel that replace one another a ``seq``, which rises. Any may come late,
twice or in another order than they were sent.

- To the view: ``setup`` (what there is: rows, folders, stages, images), ``frame`` (pictures, with their bytes),
  ``reference`` (a picture to compare with), ``error``, ``note`` (a sentence that is no error), ``latency``,
  ``history``, ``cases`` (which test images pass), ``probe``, ``settings``, ``promoted``, ``written``, ``optimised``,
  ``log``, ``pong`` (the answer to ``ping``).
- To the kernel: ``ready`` and ``closed`` (a view is mounted or removed), ``painted`` (a frame has come, and the one
  before is on the screen; what was moved meanwhile goes with it), and what ``messages`` handles.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf
from pathlib import Path
from statistics import median
from time import perf_counter_ns
from typing import Any, Final

import anywidget
import ipywidgets

from epypes_widgets.picture.frames import Frame
from epypes_widgets.worker import Worker

# Longer than any screen takes to paint; a screen that is gone costs a frame every half minute.
FIRST_TIMEOUT_S: Final = 2.0
LAST_TIMEOUT_S: Final = 32.0
# The keys under which the frame that waits, and the one that may be lost, stand in the worker.
_NEXT, _LOST = "frame", "lost frame"
_MAX_TIMES: Final = 200
_REST_S: Final = 0.3
_HERE: Final = Path(__file__).parent
_IMPORT: Final = re.compile(r'^import \{[^}]*\} from "\./([\w-]+\.js)";\n', re.MULTILINE)
_EXPORT: Final = re.compile(r"^export (?!default)", re.MULTILINE)

Message = Mapping[str, Any]
Handler = Callable[[Message], object]


def script(entry: str = "main.js") -> str:
    """Return a module and those that it imports as one ES module.

    anywidget loads a single module from a Blob URL, where an import of another file finds nothing. So the files are
    joined in the order of their imports, without the lines that import and export between them.
    """
    sources: dict[str, str] = {}

    def add(name: str) -> None:
        source = (_HERE / name).read_text(encoding="utf-8")
        for imported in _IMPORT.findall(source):
            if imported not in sources:
                add(imported)
        sources[name] = _EXPORT.sub("", _IMPORT.sub("", source))

    add(entry)
    return "\n".join(f"// {name}\n{source}" for name, source in sources.items())


def styles() -> str:
    """Return the style sheet of the view and of the picker."""
    return (_HERE / "view.css").read_text(encoding="utf-8")


def use_subshell(widget: ipywidgets.Widget) -> None:
    """Have the messages to a widget, and to all inside it, handled on the thread that the front end names.

    JupyterLab names one that no cell runs on (a subshell) in every message of a widget. Since ipykernel 7.4 a widget
    that has sent a message overrules that: its messages are handled where it last did so, which for one that a cell has
    made is the thread of the cells, and so wait until they have ended.
    """
    comm = widget.comm
    if comm is not None:
        # An ipykernel that does not know this name goes by the front end anyway.
        comm._reply_subshell_for = lambda _data, named: named
    for child in getattr(widget, "children", ()):
        use_subshell(child)


@dataclass(frozen=True, slots=True)
class Latency:
    """Times of a panel's last frames, at most 200.

    Attributes
    ----------
    compute_ms
        Of the last run; None before the first.
    to_screen_ms
        From the last value that was set to the picture of it, or of a later one, being painted; None if no view has
        painted one.
    p50_ms, p95_ms
        Half and 95 % of the frames took at most so long; None without frames.
    frames
        How many were painted, at most 200.
    """

    compute_ms: float | None
    to_screen_ms: float | None = None
    p50_ms: float | None = None
    p95_ms: float | None = None
    frames: int = 0


class FrameSender:
    """Sends frames one at a time; so the screen is never behind by more than one frame.

    The newest one that could not be sent yet waits in the worker, like all that is replaced by what is newer.

    Parameters
    ----------
    send
        Is called with a frame, on any thread, one call at a time; must not wait for the front end.
    worker
        Makes the frame that has waited, and one again that was lost.

    Attributes
    ----------
    newest
        The frame that was made last, for a view that is mounted later.
    in_flight
        The frame that was sent and is not acknowledged yet.

    Notes
    -----
    Nothing is sent before ``ready``: there is no view yet that could acknowledge it. A frame or an acknowledgement that
    is lost is made good after a time-out. All methods but ``offer`` may be called from any thread.
    """

    def __init__(self, send: Callable[[Frame], None], worker: Worker) -> None:
        self._send, self._worker = send, worker
        # Held while sending, so that frames leave in order. An answer within send() on this thread is allowed.
        self._lock = threading.RLock()
        self.newest: Frame | None = None
        self.in_flight: Frame | None = None
        self._views: int | None = None  # none has been mounted yet
        self._timeout_s = FIRST_TIMEOUT_S

    @property
    def mounted(self) -> bool:
        """Whether there is a view."""
        return bool(self._views)

    @property
    def left(self) -> bool:
        """Whether there was a view, and there is none any more."""
        return self._views == 0

    def offer(self, make: Callable[[], Frame]) -> None:
        """Make a frame and send it, when the one in flight has been painted, unless a newer one comes until then.

        It is called on the worker's thread, or while that has nothing to do. Once the worker is closed nothing waits.
        """
        with self._lock:
            if self.in_flight is not None and not self._worker.closed:
                self._worker.post(_NEXT, partial(self.offer, make), inf, is_work=False)
                return
        frame = make()
        with self._lock:
            self.newest = frame
            self._put()

    def painted(self, seq: int) -> Frame | None:
        """Take an acknowledgement; return the frame that it was for, None if it was late or came twice."""
        with self._lock:
            frame = self.in_flight
            if frame is None or frame.seq != seq:
                return None
            self.in_flight, self._timeout_s = None, FIRST_TIMEOUT_S
            self._worker.hasten(_NEXT)
            return frame

    def mount(self) -> None:
        """Take note that there is one more view, which is not to get frames yet."""
        with self._lock:
            self._views = (self._views or 0) + 1
            self.in_flight = None

    def ready(self) -> None:
        """Start over with the newest frame: what was in flight may be lost to a view that has just been mounted."""
        with self._lock:
            self._timeout_s = FIRST_TIMEOUT_S
            self._put()

    def closed(self) -> None:
        """Take note that there is one view less; without one nothing is sent.

        A page that is loaded anew does not say that its views are gone; more of them are then counted than there are.
        """
        with self._lock:
            if self._views is not None:
                self._views = max(0, self._views - 1)
            if not self._views:
                self.in_flight = None
                self._worker.hasten(_NEXT)

    def _put(self) -> None:
        """Send the newest frame if there is a view."""
        frame = self.newest
        if self._views and frame is not None:
            self.in_flight = frame
            # Asked for first: an answer within send() may lead to the next frame, whose time-out replaces this one.
            self._worker.post(_LOST, partial(self._overdue, frame), self._timeout_s, is_work=False)
            self._send(frame)

    def _overdue(self, frame: Frame) -> None:
        """Take a frame, or its acknowledgement, for lost."""
        with self._lock:
            if self.in_flight is frame and self._views:
                self._timeout_s = min(2 * self._timeout_s, LAST_TIMEOUT_S)
                self.in_flight = None
                if not self._worker.hasten(_NEXT):
                    self._put()


class PictureView(anywidget.AnyWidget):
    """The picture of a panel, and everything around it that is no control of ipywidgets.

    Parameters
    ----------
    worker
        As for ``FrameSender``.
    failed
        Is called with what a handler has raised.

    Attributes
    ----------
    handlers
        By kind of message, what is called with it on the thread that handles messages of the front end; by ``"seen"``
        when a frame has been painted, by ``"left"`` when the last view is gone.
    frames
        The frames on their way.
    """

    _esm = script()
    _css = styles()

    def __init__(self, worker: Worker, failed: Callable[[BaseException], None]) -> None:
        super().__init__()
        self.handlers: Mapping[str, Handler] = {}
        self.frames = FrameSender(self._send_frame, worker)
        self._to_screen_ms: list[float] = []
        self._worker, self._failed = worker, failed
        self.on_msg(self._handle)

    def latency(self, compute_ms: float | None) -> Latency:
        """Return how long the last frames took from a value to the screen."""
        times = sorted(self._to_screen_ms)
        if not times:
            return Latency(compute_ms)
        p95_ms = times[min(len(times) - 1, int(0.95 * len(times)))]
        return Latency(compute_ms, self._to_screen_ms[-1], median(times), p95_ms, len(times))

    def tell(self, kind: str, content: Message, buffers: Sequence[bytes] = ()) -> None:
        """Send a message other than a frame, if there is a view."""
        if self.frames.mounted:
            self.send({"kind": kind, **content}, list(buffers))

    def _send_frame(self, frame: Frame) -> None:
        last = self._to_screen_ms[-1] if self._to_screen_ms else None
        self.send({**frame.content, "to_screen_ms": last}, list(frame.buffers))

    def _handle(self, _widget: object, content: Any, _buffers: object) -> None:
        kind = content.get("kind")
        try:
            if kind == "painted":
                self._painted(content)
            elif kind == "closed":
                self.frames.closed()
                self.handlers["release"](content)
                if self.frames.left:
                    self.handlers["left"](content)
            elif kind in self.handlers:
                self.handlers[kind](content)
        except Exception as error:
            self._failed(error)

    def _painted(self, message: Message) -> None:
        frame = self.frames.painted(int(message.get("seq", 0)))
        if "move" in message:
            self._handle(None, {**message["move"], "kind": "move"}, ())
        if frame is not None:
            self.handlers["seen"](message)
        # A frame with values that were not set has no time to the screen.
        if frame is None or not frame.changed_ns:
            return
        # What a picture takes in the browser after it has come is known of the one before.
        took_ms = (perf_counter_ns() - frame.changed_ns) / 1e6 + float(message.get("shown_ms", 0))
        self._to_screen_ms = [*self._to_screen_ms, took_ms][-_MAX_TIMES:]
        # A small message right before a frame would hold that frame back, so it waits until the values rest.
        told = {"seq": frame.seq, "to_screen_ms": took_ms}
        self._worker.post("latency", partial(self.tell, "latency", told), _REST_S, is_work=False)
