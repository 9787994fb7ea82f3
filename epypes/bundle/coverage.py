"""The lines of a bundle's module that no sample runs: no replay proves what they compute."""

from __future__ import annotations

import inspect
import sys
import threading
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final, Self

_Trace = Callable[[FrameType, str, Any], Any]
_MOST_NAMED: Final = 8


class LineCoverage:
    """Records, while its block runs, which lines of a module's functions run, in every thread that begins meanwhile.

    Parameters
    ----------
    path
        The file of the module, as its code names it.
    """

    def __init__(self, path: Path) -> None:
        self._file = str(path)
        self._run: dict[CodeType, set[int]] = {}

    def __enter__(self) -> Self:
        self._before: tuple[Any, Any] = sys.gettrace(), threading.gettrace()
        sys.settrace(self._called)
        threading.settrace(self._called)
        return self

    def __exit__(self, *error: object) -> None:
        sys.settrace(self._before[0])
        threading.settrace(self._before[1])

    def _called(self, frame: FrameType, event: str, argument: Any) -> _Trace | None:
        code = frame.f_code
        if code.co_filename != self._file or not code.co_flags & inspect.CO_OPTIMIZED:
            return None  # another file, or the body of a module or class
        lines = self._run.setdefault(code, {code.co_firstlineno})

        def at_line(frame: FrameType, event: str, argument: Any) -> _Trace:
            lines.add(frame.f_lineno)
            return at_line

        return at_line

    @property
    def note(self) -> str:
        """The lines that were left out of functions that ran, as a sentence; "" if there are none."""
        spans = [span for code in self._run for span in _spans(code, self._run[code])]
        if not spans:
            return ""
        named = ", ".join(spans[:_MOST_NAMED]) + (" and others" if len(spans) > _MOST_NAMED else "")
        return (
            f"No sample runs these lines of {Path(self._file).name}, so no replay proves them: {named}. "
            "Give payloads that do: samples=[...]."
        )


def _spans(code: CodeType, run: set[int]) -> list[str]:
    """Return the lines of one function that did not run, adjacent ones as one span."""
    every = {line for _, _, line in code.co_lines() if line}
    missed = sorted(every - run)
    grouped = groupby(enumerate(missed), key=lambda numbered: numbered[1] - numbered[0])
    spans = [[line for _, line in group] for _, group in grouped]
    return [f"{span[0]}-{span[-1]}" if len(span) > 1 else f"{span[0]}" for span in spans]
