"""What is told of something that was raised in a worker: its class, its message, the lines where it happened?

An exception of a user's may do anything when it is asked for its text; what is told is bounded all the same.
"""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import Any, Final

import epypes
from epypes.errors import EpypesError
from epypes.run import Failure

_MOST_FRAMES: Final = 20
_MOST_CHARACTERS: Final = 500
_MESSAGE_CHARACTERS: Final = 2_000
_OURS: Final = str(Path(epypes.__file__).parent)


def failure_told(failure: Failure) -> dict[str, Any]:
    """Return what the front is told of an event's failure, as what json takes."""
    return {
        "function": failure.function,
        "tokens": list(failure.tokens),
        "exception": failure.kind,
        "message": failure.message[:_MESSAGE_CHARACTERS],
        "trace": trace_of(failure.exception),
        "kind": "raised",
    }


def trace_of(exception: BaseException) -> list[str]:
    """Return where an exception was raised, outermost call first, and what it says; frames of EPypes are left out."""
    try:
        frames = traceback.extract_tb(exception.__traceback__)
        users = [frame for frame in frames if not frame.filename.startswith((_OURS, "<epypes"))]
        lines = [_frame_told(frame) for frame in users[-_MOST_FRAMES:]]
        said = traceback.format_exception_only(exception)
        return [line[:_MOST_CHARACTERS] for text in (*lines, *said) for line in text.splitlines()[:_MOST_FRAMES]]
    except BaseException:  # whatever the exception's own methods do
        return []


def _frame_told(frame: traceback.FrameSummary) -> str:
    return f'File "{frame.filename}", line {frame.lineno}, in {frame.name}\n  {frame.line}'


def reason_of(error: BaseException, doing: str, folder: Path) -> str:
    """Return why something could not be done with a bundle: a sentence of ours, or what its code raised, and where."""
    if isinstance(error, EpypesError):
        return str(error)
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(str(folder))]
    where = f" at {Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line}" if frames else ""
    failure = Failure(doing, (), {}, error)
    notes = [note for note in getattr(error, "__notes__", ()) if isinstance(note, str)]
    return " | ".join([f"{doing} failed{where}: {failure.kind}: {failure.message}", *notes])[:_MESSAGE_CHARACTERS]
