"""Counting of lost sequence numbers (`LossCounter`), and reordering by sequence number (`ReorderBuffer`).

A publisher numbers the envelopes of each source from 1, anew in each epoch, which begins with its start.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from time import monotonic
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import MessageError

if TYPE_CHECKING:
    from epypes.wire import EncodedEnvelope, Envelope

log = logging.getLogger("epypes.transport")

# Sources whose numbers are followed; a peer that invents sources must not fill the memory.
_MOST_SOURCES: Final = 1_024
_MAX_SOURCE_BYTES: Final = 1_024
MOST_HELD: Final = 1_000

# Name and epoch.
Source = tuple[str, int]


def check_source(source: str) -> None:
    """Raise MessageError if a source's name is too long."""
    size = len(source.encode(errors="surrogatepass"))
    if size > _MAX_SOURCE_BYTES:
        raise MessageError("bad source", f"A source's name of {size:,} bytes; {_MAX_SOURCE_BYTES:,} is the limit.")


def place_in_order(envelope: Envelope | EncodedEnvelope) -> tuple[Source, int]:
    """Return the source and the number by which an envelope is ordered.

    Answers are in the order of the requests, also those of several replicas.
    """
    if envelope.request_sequence:
        return (envelope.request_source, envelope.request_epoch), envelope.request_sequence
    return (envelope.source, envelope.epoch), envelope.sequence


class LossCounter:
    """Counts gaps in the sequence numbers of messages that arrive in order.

    Attributes
    ----------
    lost
        How many envelopes never arrived, by (source, epoch).
    """

    def __init__(self) -> None:
        self.lost: dict[Source, int] = {}
        self._began_ns = 0
        self._epochs: dict[str, int] = {}
        self._last: dict[Source, int] = {}

    def begin(self) -> None:
        """Take note that the subscriber listens from now on."""
        self._began_ns = time.time_ns()

    def add(self, name: str, epoch: int, sequence: int) -> None:
        """Count what is missing before an envelope of a source."""
        if sequence == 0:
            return
        source = (name, epoch)
        last = self._last.pop(source, None)
        if last is None:
            last = 0 if self._has_restarted(name, epoch) else sequence - 1
        missing = sequence - last - 1
        if missing > 0:
            self.lost[source] = self.lost.get(source, 0) + missing
        self._last[source] = max(last, sequence)
        if len(self._last) > _MOST_SOURCES:
            oldest = next(iter(self._last))
            del self._last[oldest]
            self.lost.pop(oldest, None)
            self._epochs.pop(oldest[0], None)

    def _has_restarted(self, name: str, epoch: int) -> bool:
        """Return whether a known source has begun anew while the subscriber listened.

        Then what came before this envelope is lost; otherwise it was sent before this subscriber had joined.
        """
        known = self._epochs.get(name)
        self._epochs[name] = max(epoch, known or 0)
        return known is not None and epoch > max(known, self._began_ns)


class ReorderBuffer:
    """Holds back items that came too early, until those before them have come.

    Parameters
    ----------
    hold_s
        Longest time that an item is held back, in seconds; at most `MOST_HELD` items are.

    Notes
    -----
    Of a new source, number 1 is expected. A receiver that joins in mid-stream holds the first items for ``hold_s``
    once, because number 1 never comes.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._next: dict[Source, int] = {}
        # By source: items by their number, in the order of arrival, with the time of that.
        self._held: dict[Source, dict[int, tuple[float, Any]]] = {}
        self._count = 0

    def add(self, source: Source, sequence: int, item: Any) -> Iterator[Any]:
        """Take an item; yield what is to be delivered now, in order."""
        known = self._next.pop(source, None)
        # At the end, so that the first is the one that was heard longest ago.
        self._next[source] = following = 1 if known is None else known
        held = self._held.get(source, {})
        if sequence < following or sequence in held:
            # It has no number; or it is late, and was waited for in vain; or there are two of its number.
            yield item
            return
        held[sequence] = (monotonic(), item)
        self._held[source] = held
        self._count += 1
        yield from self._ready(source)
        while self._count > MOST_HELD:
            yield from self._skip(next(iter(self._held)), f"{MOST_HELD:,} items are held back")
        if len(self._next) > _MOST_SOURCES:
            oldest = next(iter(self._next))
            if oldest in self._held:
                yield from self._skip(oldest, f"there are {_MOST_SOURCES:,} sources")
            del self._next[oldest]

    @property
    def due_s(self) -> float | None:
        """When `overdue` has something to yield, by the monotonic clock; None if nothing is held back."""
        return min(
            (min(came_s for came_s, _ in held.values()) + self._hold_s for held in self._held.values()), default=None
        )

    def overdue(self) -> Iterator[Any]:
        """Yield what was held back for too long, in order."""
        now_s = monotonic()
        for source, held in list(self._held.items()):
            if source in self._held and min(came_s for came_s, _ in held.values()) + self._hold_s <= now_s:
                yield from self._skip(source, f"{self._hold_s:g} s are over")

    def rest(self) -> list[Any]:
        """Return all that is held back, and forget it."""
        rest = [item for held in self._held.values() for _, (_, item) in sorted(held.items())]
        self._held.clear()
        self._count = 0
        return rest

    def _ready(self, source: Source) -> Iterator[Any]:
        """Yield the items of a source that nothing is missing before."""
        held = self._held[source]
        try:
            while (entry := held.pop(self._next[source], None)) is not None:
                self._next[source] += 1
                self._count -= 1
                yield entry[1]
        finally:
            # Also if the caller stops in between, and has perhaps called `rest`.
            if not held:
                self._held.pop(source, None)

    def _skip(self, source: Source, why: str) -> Iterator[Any]:
        """Go on with the first item that is held back of a source; what is missing before it was waited for in vain."""
        missing, first = self._next[source], min(self._held[source])
        log.warning("waited in vain for %d..%d of source %r (epoch %d): %s", missing, first - 1, *source, why)
        self._next[source] = first
        yield from self._ready(source)
