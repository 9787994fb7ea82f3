"""What is known of a function that failed?"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

# OpenCV begins its messages with its version and the place in its own source; what went wrong comes after.
_OPENCV_PLACE: Final = re.compile(r"^OpenCV\([^)]*\) \S+ error: ")


@dataclass(frozen=True, slots=True)
class Failure:
    """A function, or a reactive pipeline's f_in or f_out, that raised.

    Attributes
    ----------
    function
        Its name in the graph, or ``"f_in"`` or ``"f_out"``.
    tokens
        Its input tokens, then its output tokens.
    inputs
        The values that it was called with, by token; by ``"event"`` for f_in.
    exception
        What it raised, unchanged.
    event_id
        The id of the event that was being worked on, if it has one.
    """

    function: str
    tokens: tuple[str, ...]
    inputs: Mapping[str, Any] = field(repr=False)
    exception: BaseException
    event_id: str = ""

    @property
    def message(self) -> str:
        """What the exception says, without OpenCV's place in its own source."""
        try:
            text = str(self.exception).strip()
        except BaseException:  # an exception's own __str__ may raise
            text = "(its message can't be had)"
        return _OPENCV_PLACE.sub("", text)

    def __str__(self) -> str:
        kind, text = type(self.exception).__name__, self.message
        return f"{self.function}: {kind}{': ' + text if text else ''}"
