"""Which run was it that raised an exception?"""

from __future__ import annotations

from types import TracebackType
from typing import Any

from epypes.run.record import Run


def run_that_raised(exception: BaseException, runner: Any) -> Run | None:
    """Return the failed run of a CompGraphRunner that an exception came out of; None if it came from elsewhere.

    It is read from the traceback: ``runner.last`` may be another thread's run by now, and an exception that is raised
    twice belongs to the run that raised it last.
    """
    code = type(runner)._ended.__code__
    # Past what the exception's class may have instead.
    traceback: TracebackType | None = BaseException.__dict__["__traceback__"].__get__(exception)
    while traceback is not None:
        frame = traceback.tb_frame
        if frame.f_code is code and frame.f_locals.get("self") is runner:
            run: Run = frame.f_locals["run"]
            return run
        traceback = traceback.tb_next
    return None
