"""What is a new message called? A name that no other one has, on any machine."""

from __future__ import annotations

import os
from typing import Final

_BYTES: Final = 16
# To ask the kernel lets go of the interpreter's lock, for which the caller then waits: so for many at a time.
_AT_A_TIME: Final = 256
_unused: Final[list[str]] = []


def new_id() -> str:
    """Return 32 hexadecimal digits, at random; from any thread."""
    while True:
        try:
            return _unused.pop()
        except IndexError:
            digits, size = os.urandom(_BYTES * _AT_A_TIME).hex(), 2 * _BYTES
            _unused.extend(digits[begin : begin + size] for begin in range(0, len(digits), size))


# A forked child must not give its messages the names that its parent will give.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unused.clear)
