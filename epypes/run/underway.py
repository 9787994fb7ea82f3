"""Which functions are being run at this moment, in whatever thread?

Runs don't keep account of that, which would cost something at every call: the frames of all threads are looked at,
when somebody asks.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import CodeType, FrameType
from typing import Any, Final

from epypes.run.call import call
from epypes.run.compiled import FILE_NAME
from epypes.run.program import Program, Step

_CALL: Final = call.__code__


def running_functions(program: Program) -> tuple[str, ...]:
    """Return the functions of a program that were called and have not returned, in run order."""
    # The dictionary of frames gets no name: it holds the frame of this call, and would be a cycle with it.
    found = {
        step.place: step.name
        for frame in sys._current_frames().values()
        for caller in _callers(frame)
        for step in _steps(caller, program)
    }
    return tuple(found[place] for place in sorted(found))


def locals_under_way(code: CodeType) -> list[dict[str, Any]]:
    """Return, for each call of the function with this code that has not returned, its local variables by name."""
    return [
        dict(caller.f_locals)
        for frame in sys._current_frames().values()
        for caller in _callers(frame)
        if caller.f_code is code
    ]


def _callers(frame: FrameType) -> Iterator[FrameType]:
    caller: FrameType | None = frame
    while caller is not None:
        yield caller
        caller = caller.f_back


def _steps(frame: FrameType, program: Program) -> Iterator[Step]:
    """Give the step that a frame of an engine is at, if it runs this program."""
    code = frame.f_code
    if code is _CALL:
        found = frame.f_locals
        if found.get("program") is program:
            yield found["step"]
    elif code.co_filename == FILE_NAME and frame.f_globals.get("program") is program:
        place = frame.f_locals.get("at")
        if place is not None:
            yield program.steps[place]
