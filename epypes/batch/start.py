"""Where do jobs on one item begin, so that what they have in common is computed once?"""

from __future__ import annotations

import threading
from collections.abc import Callable

from epypes.batch.thumbnails import Album
from epypes.run import CompGraphRunner
from epypes.run.branch import branched


class Start:
    """What several jobs of one process begin with: parts of a grid on one and the same item.

    The job that comes first runs the item; the others, on whatever thread, wait for that and go on from there.

    Attributes
    ----------
    album
        The thumbnails of the item.
    """

    def __init__(self) -> None:
        self.album = Album()
        self._lock = threading.Lock()
        self._runner: CompGraphRunner | None = None

    def go_on(self, begin: Callable[[], CompGraphRunner | None]) -> CompGraphRunner | None:
        """Return a runner that has run the item.

        For who comes first that is what ``begin`` returns, which is called meanwhile: a runner that has run the item,
        or None if that can't be; who comes next is then the first one. All others get one of their own.
        """
        with self._lock:
            if self._runner is not None:
                return branched(self._runner)
            begun = begin()
            self._runner = None if begun is None else branched(begun)
            return begun

    def leave(self, runner: CompGraphRunner) -> None:
        """Let the next one begin where this runner stands."""
        with self._lock:
            self._runner = branched(runner)
