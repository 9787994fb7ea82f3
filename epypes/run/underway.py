"""The functions that are being run at this moment, in any thread.

Runs don't keep account of that, which would cost something at every call: the frames of all threads are looked at,
when somebody asks.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterator
from types import CodeType, FrameType
from typing import Any, Final

from epypes.run.call import call
from epypes.run.compiled import FILE_NAME
from epypes.run.program import Program, Step

_CALL: Final = call.__code__


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
    remaining = [*sys._current_frames().values()]
    while remaining:
        frame: FrameType | None = remaining.pop()
        while frame is not None:
            yield frame
            frame = frame.f_back


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
