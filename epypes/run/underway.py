"""The functions that are being run at this moment, in any thread.

Runs don't keep account of that, which would cost something at every call: the frames of all threads are looked at,
when somebody asks.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Collection, Iterator
from types import CodeType, FrameType
from typing import Any, Final

from epypes.run.call import call
from epypes.run.compiled import FILE_NAME
from epypes.run.program import Program, Step

_CALL: Final = call.__code__
# Before 3.11.9 Python collects garbage while it holds the lock that makes the frames; the end of a thread-local object
# waits for that lock forever: https://github.com/python/cpython/issues/106883
_without_collection: Final = threading.RLock()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_without_collection.acquire,
        after_in_parent=_without_collection.release,
        after_in_child=_without_collection.release,
    )


def running_functions(program: Program) -> tuple[str, ...]:
    """Return the functions of a program that were called and have not returned, in run order."""
    found = {step.place: step.name for its_program, step in _steps_under_way() if its_program is program}
    return tuple(found[place] for place in sorted(found))


def functions_under_way() -> list[object]:
    """Return the functions of graphs that were called and have not returned."""
    return [step.function for _, step in _steps_under_way()]


def locals_under_way(codes: Collection[CodeType]) -> list[dict[str, Any]]:
    """Return, for each call of a function with such a code that has not returned, its local variables by name."""
    return [dict(frame.f_locals) for frame in _frames() if frame.f_code in codes]


def _frames() -> Iterator[FrameType]:
    """Give the frames of all threads, the innermost of each first."""
    # The frame of this call is among them. A local variable that still held it at the end would be a cycle, which
    # keeps all that its callers hold alive: so what remains to be looked at is taken out of a list.
    remaining = _innermost_frames()
    while remaining:
        frame: FrameType | None = remaining.pop()
        while frame is not None:
            yield frame
            frame = frame.f_back


def _innermost_frames() -> list[FrameType]:
    with _without_collection:
        is_enabled = gc.isenabled()
        gc.disable()
        try:
            return [*sys._current_frames().values()]
        finally:
            if is_enabled:
                gc.enable()


def _steps_under_way() -> Iterator[tuple[Program, Step]]:
    """Give the steps that the frames of engines are at, with their programs."""
    for frame in _frames():
        code = frame.f_code
        if code is _CALL:
            yield frame.f_locals["program"], frame.f_locals["step"]
        elif code.co_filename == FILE_NAME:
            program, place = frame.f_globals["program"], frame.f_locals.get("at")
            if place is not None:
                yield program, program.steps[place]
