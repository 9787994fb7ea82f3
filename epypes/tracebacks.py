"""Tracebacks in notebooks, which end at the user's own line.

The functions that stand between the user's call and the user's function have a variable ``__tracebackhide__``: IPython,
its debugger and pytest fold their frames away. IPython shows the last frame all the same, which is one of EPypes where
EPypes itself raises, or calls a C function. IPython asks an exception that has ``_render_traceback_`` for its lines.
An error of EPypes says in its text what a library has said, so the library's own traceback is left out.
"""

from __future__ import annotations

import functools
import sys
from types import FrameType, TracebackType
from typing import Any, Final

HIDE: Final = "__tracebackhide__"
_RENDER: Final = "_render_traceback_"
_OWN: Final = ("epypes", "epypes_widgets")


def is_hidden(frame: FrameType) -> bool:
    """Whether a frame is one that stands between the user's call and the user's function."""
    return HIDE in frame.f_code.co_varnames


def fold_end(error: BaseException) -> None:
    """Have IPython end the traceback of a user's exception at the user's line, if a C function has raised it."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if "IPython" in sys.modules and last is not None and is_hidden(last.tb_frame):
        # Not a method of this exception, which would then refer to itself, and live on with all its inputs.
        error._render_traceback_ = render  # type: ignore[attr-defined]


def render(error: BaseException | None = None, *, is_own: bool = False) -> list[str]:
    """Return the lines that IPython shows of an exception, without the frames of EPypes at its end.

    Parameters
    ----------
    error
        The exception; without, the one that is being handled, or was handled last.
    is_own
        Whether EPypes has raised it: every frame after the user's last one is left out, not only the hidden ones, and
        its cause, if only EPypes and libraries were running then.
    """
    shown: Any = error or sys.exc_info()[1] or sys.last_value
    shell: Any = sys.modules["IPython"].get_ipython()
    traceback = shown.__traceback__
    if shell.InteractiveTB.skip_hidden:
        traceback = _without_end(traceback, is_own) or traceback
    cause = shown.__cause__
    if is_own and cause is not None and shell.InteractiveTB.skip_hidden and not _has_users_frame(cause.__traceback__):
        shown.__cause__ = None
    try:
        lines: list[str] = shell.InteractiveTB.structured_traceback(type(shown), shown, traceback)
    finally:
        if shown.__cause__ is not cause:
            shown.__cause__ = cause
    return lines


def _without_end(traceback: TracebackType | None, is_own: bool) -> TracebackType | None:
    """Return a traceback up to the last frame that is shown; None if none is."""
    parts = []
    while traceback is not None:
        parts.append(traceback)
        traceback = traceback.tb_next
    while parts and (is_hidden(parts[-1].tb_frame) or (is_own and not _is_users(parts[-1].tb_frame))):
        parts.pop()
    made = None
    for part in reversed(parts):
        made = TracebackType(made, part.tb_frame, part.tb_lasti, part.tb_lineno)
    return made


def _has_users_frame(traceback: TracebackType | None) -> bool:
    while traceback is not None:
        if _is_users(traceback.tb_frame):
            return True
        traceback = traceback.tb_next
    return False


def _is_users(frame: FrameType) -> bool:
    """Whether a frame is neither one of EPypes nor of an installed package."""
    is_own = str(frame.f_globals.get("__name__")).partition(".")[0] in _OWN
    return not is_own and not frame.f_code.co_filename.startswith(_installed())


@functools.cache
def _installed() -> tuple[str, ...]:
    """Return what the file names of installed packages, and of Python's own modules, begin with."""
    import sysconfig  # not before something has failed

    paths = sysconfig.get_paths()
    return (*(paths[kind] for kind in ("stdlib", "platstdlib", "purelib", "platlib")), "<frozen")
