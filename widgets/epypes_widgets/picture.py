"""How do a panel and its view in the browser talk?

Every message has a ``kind``; those of the kernel that replace one another a ``seq``, which rises. Any may come late,
twice or in another order than they were sent.

- To the view: ``setup`` (what there is: rows, folders, stages, images), ``frame`` (pictures, with their bytes),
  ``reference`` (a picture to compare with), ``error``, ``note`` (a sentence that is no error), ``latency``,
  ``history``, ``cases`` (which test images pass), ``probe``, ``settings``, ``promoted``, ``written``, ``log``.
- To the kernel: ``ready`` and ``closed`` (a view is mounted or removed), ``painted`` (a frame has come, and the one
  before is on the screen; what was moved meanwhile goes with it), ``move`` (what is under the hand at the moment),
  ``set`` (what it has stopped at), ``hold`` and ``release`` (of a control), ``reset``, ``undo``, ``redo``, ``goto``,
  ``save``, ``load``, ``promote``, ``write_back``, ``stage``, ``pin``, ``compare``, ``histogram``, ``probe``,
  ``image``, ``live`` and ``run``.

Pictures travel as one binary message per frame, never in a trait: traits are kept, compared and saved.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from time import perf_counter_ns
from typing import Any, Final

import anywidget

from epypes_widgets.sender import Frame, FrameSender
from epypes_widgets.view.script import joined, styles

_MOST_TIMES: Final = 200
_REST_S: Final = 0.3

Later = Callable[[str, float, Callable[[], None]], None]
Message = Mapping[str, Any]


class PictureView(anywidget.AnyWidget):
    """The picture of a panel, and everything around it that is no control of ipywidgets.

    Parameters
    ----------
    later
        Is called with a word, a delay in seconds and a function, which is to be called once after it; a later call with
        the same word replaces an earlier one.
    handlers
        By kind of message, what is called with it on the thread that answers the front end; by ``"seen"`` when a frame
        has been painted, by ``"left"`` when the last view is gone.
    failed
        Is called with what a handler has raised.
    """

    _esm = joined()
    _css = styles()

    def __init__(
        self,
        later: Later,
        handlers: Mapping[str, Callable[[Message], object]],
        failed: Callable[[BaseException], None],
    ) -> None:
        super().__init__()
        self.frames = FrameSender(self._send_frame, partial(later, "lost frame"))
        self.to_screen_ms: list[float] = []
        self._later, self._failed = later, failed
        self._handlers: dict[str, Callable[[Message], object]] = {
            **handlers,
            "painted": self._painted,
            "closed": self._closed,
        }
        self.on_msg(self._answer)

    def tell(self, kind: str, content: Message, buffers: Sequence[bytes] = ()) -> None:
        """Send a message other than a frame, if there is a view."""
        if self.frames.mounted:
            self.send({"kind": kind, **content}, list(buffers))

    def _send_frame(self, frame: Frame) -> None:
        last = self.to_screen_ms[-1] if self.to_screen_ms else None
        self.send({**frame.content, "to_screen_ms": last}, list(frame.buffers))

    def _answer(self, _widget: object, content: Any, _buffers: object) -> None:
        try:
            handler = self._handlers.get(content.get("kind"))
            if handler is not None:
                handler(content)
        except Exception as error:
            self._failed(error)

    def _closed(self, message: Message) -> None:
        self.frames.closed()
        self._handlers["release"](message)
        if self.frames.left:
            self._handlers["left"](message)

    def _painted(self, message: Message) -> None:
        frame = self.frames.painted(int(message.get("seq", 0)))
        if "move" in message:
            self._answer(None, {**message["move"], "kind": "move"}, ())
        if frame is not None:
            self._handlers["seen"](message)
        # A frame with values that nobody moved has no time to the screen.
        if frame is None or not frame.changed_ns:
            return
        # What a picture takes in the browser after it has come is known of the one before.
        shown_ms = float(message.get("shown_ms", 0))
        self.to_screen_ms.append((perf_counter_ns() - frame.changed_ns) / 1e6 + shown_ms)
        del self.to_screen_ms[:-_MOST_TIMES]
        told = {"seq": frame.seq, "to_screen_ms": self.to_screen_ms[-1]}
        # A small message right before a frame would hold that frame back, so it waits until the hand rests.
        self._later("latency", _REST_S, lambda: self.tell("latency", told))
