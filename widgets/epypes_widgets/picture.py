"""What does the screen show of a token, and what does it answer?

The picture travels as one binary message per frame, never in a trait: traits are kept, compared and saved. The front
end (``view/``) sends ``{kind: "ready"}`` when it is mounted and ``{kind: "painted", seq}`` for each frame.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter_ns
from typing import Any

import anywidget

from epypes_widgets.frames import Frame, FrameSender
from epypes_widgets.view.script import joined, styles


class PictureView(anywidget.AnyWidget):
    """One big picture with a header and a status line.

    Parameters
    ----------
    idle
        Whether nothing is being computed. Only then the time to the screen is sent: a small message just before a
        frame would hold that frame back, since the websocket of JupyterLab waits to fill its packets.
    """

    _esm = joined()
    _css = styles()

    def __init__(self, idle: Callable[[], bool]) -> None:
        super().__init__()
        self.frames = FrameSender(self._send_frame)
        self.to_screen_ms: float | None = None
        self._idle = idle
        self._error: dict[str, Any] | None = None
        self.on_msg(self._answer)

    @property
    def error(self) -> str:
        """The message on the status line; empty if there is none."""
        return str(self._error["text"]) if self._error else ""

    def show(self, frame: Frame) -> None:
        """Show a frame as soon as the one in flight is painted; clears the error unless the frame is marked stale."""
        if not frame.content.get("stale"):
            self._error = None
        self.frames.offer(frame)

    def fail(self, seq: int, text: str, function: str = "") -> None:
        """Keep the picture, badge it stale and show why; ``seq`` puts this in line with the frames."""
        self._error = {"kind": "error", "seq": seq, "text": text, "function": function}
        self.send(self._error)

    def _send_frame(self, frame: Frame) -> None:
        content = {**frame.content, "to_screen_ms": self.to_screen_ms}
        self.send(content, [frame.data] if frame.data else [])

    def _answer(self, _widget: object, content: Any, _buffers: object) -> None:
        kind = content.get("kind")
        if kind == "ready":
            self.frames.ready()
            error = self._error
            if error is not None:
                self.send(error)
        elif kind == "painted":
            self._painted(self.frames.painted(int(content.get("seq", 0))))

    def _painted(self, frame: Frame | None) -> None:
        # The first frame of a panel shows values that nobody moved, so it has no time to the screen.
        if frame is None or not frame.changed_ns:
            return
        self.to_screen_ms = (perf_counter_ns() - frame.changed_ns) / 1e6
        if self._idle() and self.frames.in_flight is None:
            self.send({"kind": "latency", "seq": frame.seq, "to_screen_ms": self.to_screen_ms})
