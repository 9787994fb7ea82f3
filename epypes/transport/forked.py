"""What must a forked child forget? Locks that threads of its parent held, and sockets that are the parent's."""

from __future__ import annotations

import os
import weakref
from typing import Final, Protocol


class Forgetful(Protocol):
    """What is of no use in a forked child as it is."""

    def forget(self) -> None:
        """Begin anew; called in a forked child."""


# Those of this process.
_known: Final[weakref.WeakSet[Forgetful]] = weakref.WeakSet()


def forget_in_child(thing: Forgetful) -> None:
    """Have something told when it finds itself in a forked child, for as long as it lives."""
    _known.add(thing)


def _tell_all() -> None:
    for thing in list(_known):
        thing.forget()


os.register_at_fork(after_in_child=_tell_all)
