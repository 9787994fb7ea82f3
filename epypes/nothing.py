"""The value of a token for which nothing was found; functions never receive it."""

from __future__ import annotations

from typing import Final, final


@final
class NothingType:
    """The type of ``Nothing``, for annotations: ``def find_marker(image) -> Pose | ep.NothingType``."""

    __slots__ = ()
    _only: NothingType | None = None

    def __new__(cls) -> NothingType:
        """Return the one object of this type."""
        if cls._only is None:
            cls._only = super().__new__(cls)
        return cls._only

    def __bool__(self) -> bool:
        """Whether something was found: false."""
        return False

    def __reduce__(self) -> str:
        # By its name in this module: a copy, and what pickle reads in another process, are the same object.
        return "Nothing"

    def __repr__(self) -> str:
        return "Nothing"


Nothing: Final = NothingType()
"""What a function returns when there is nothing to be found, in place of any of its output tokens or of all of them.

A function that takes the token is not called: it is skipped, and each of its output tokens is ``Nothing``. A reader of
the token, such as ``f_out`` of a pipeline, gets it: ``if view["pose"] is ep.Nothing``. It is false. ``None`` is a value
like any other, which functions receive.
"""


class NothingGiven(Exception):
    """An input of a step is ``Nothing``: the step is to be skipped. Raised before its function is called."""
