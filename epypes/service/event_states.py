"""State between events, as the front keeps it: what the last answered event of each series has left (``ep.delay``).

All events are one series, or those of each source are one. At most one event of a series is in flight, and it begins
with what the last answered event of its series has left. A worker answers with the state after the event, which stays
encoded here: the front decodes no value. The worker keeps it too, so it is sent only to a worker that has not worked on
the series before, such as one that replaces a worker that died.

Every method is called with the dispatcher's lock held.
"""

from __future__ import annotations

import logging
from collections import OrderedDict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.errors import ServiceError, UnknownName
from epypes.transport.throttle import Throttle
from epypes.wording import counted

if TYPE_CHECKING:
    from epypes.service.dispatcher import AcceptedEvent
    from epypes.service.options import Options
    from epypes.service.supervision.frame_socket import WorkerMessage
    from epypes.service.supervision.worker_connection import WorkerConnection

StatePer = Literal["one", "source"]
# What a deploy does with the states.
StateChoice = Literal["keep", "reset"]
# By key of the state, what two bundles must have in common so that one goes on with the state of the other: the delayed
# token, and a digest of the initial value.
Delays = Mapping[str, Sequence[str]]

MAX_SOURCES: Final = 1_000
MAX_BYTES: Final = 512 * 1024**2
# Of one message to the worker.
_MAX_FORGOTTEN: Final = 100

_log = logging.getLogger("epypes.service")


@dataclass(slots=True, eq=False)
class Series:
    """The state of one series of events.

    Attributes
    ----------
    block
        What the last answered event has left, encoded; empty for the initial state.
    holder
        The worker that has it; None if the next event brings it.
    last_seq
        Of the last event that was begun.
    """

    block: bytes = b""
    holder: WorkerConnection | None = None
    last_seq: int = 0


class EventStates:
    """The states of all series of events of a bundle.

    Parameters
    ----------
    delays
        What the worker says of the bundle's delays.
    per
        ``"one"``: all events are one series; ``"source"``: those of each source are one.

    Attributes
    ----------
    delays
        As given.
    """

    def __init__(self, delays: Delays, per: StatePer) -> None:
        self.delays, self._per = delays, per
        # The series that has waited for the longest time is the first one.
        self._series: OrderedDict[str, Series] = OrderedDict()
        self._bytes = self._forgotten = 0
        # By key: workers need not keep the state of the events up to this number.
        self._dropped: dict[str, int] = {}
        self._throttle = Throttle(_log)

    def key_of(self, event: AcceptedEvent) -> str:
        """Return which series an event belongs to: its source, empty where it has none or all are one series."""
        envelope = event.delivery.envelope
        return "" if self._per == "one" or envelope is None else envelope.source

    def take_next(self, waiting: deque[AcceptedEvent], running: Iterable[AcceptedEvent]) -> AcceptedEvent | None:
        """Remove the first event of which no other one of its series is in flight, and return it; None if all wait."""
        busy = {self.key_of(event) for event in running}
        for place, event in enumerate(waiting):
            if self.key_of(event) not in busy:
                del waiting[place]
                return event
        return None

    def post(self, event: AcceptedEvent, connection: WorkerConnection, running: Iterable[AcceptedEvent]) -> None:
        """Give a worker an event, with its state if the worker does not have that.

        Raises
        ------
        MemoryError
            It is not given to the worker.
        """
        key = self.key_of(event)
        series = self._series.setdefault(key, Series())
        self._series.move_to_end(key)
        event.state, series.last_seq = series.block, event.seq
        self._make_room(running)
        content: dict[str, Any] = {"key": key, "state": "held"}
        frames = list(event.delivery.frames)
        if series.holder is not connection:
            content["state"] = "given" if series.block else "initial"
            frames += [series.block] if series.block else []
        if self._dropped:
            sent = content["forget"] = dict(list(self._dropped.items())[:_MAX_FORGOTTEN])
            for each in sent:
                del self._dropped[each]
        series.holder = None
        connection.post_event(event.seq, frames, content)
        # It has answered before the next event of the series is posted.
        series.holder = connection

    def note(self, event: AcceptedEvent, message: WorkerMessage, running: Iterable[AcceptedEvent]) -> None:
        """Keep what an event has left by a worker's ``done`` message; a failed one leaves the state as it was."""
        series = self._series.get(self.key_of(event))
        if series is None:
            # The state was reset while the event was in flight.
            return
        if not message.content.get("has_state"):
            # It is sent again: the worker may have no memory for it.
            series.holder = None
            return
        self._bytes -= len(series.block)
        # A copy: a small frame is a part of the memory of its whole message.
        series.block = bytes(message.frames[-1])
        self._bytes += len(series.block)
        self._make_room(running)

    def _make_room(self, running: Iterable[AcceptedEvent]) -> None:
        """Forget the states of sources that have been idle for the longest time, if there are too many."""
        if len(self._series) <= MAX_SOURCES and self._bytes <= MAX_BYTES:
            return
        newest = next(reversed(self._series))
        busy = {newest, *map(self.key_of, running)}
        for key in [key for key in self._series if key not in busy]:
            if len(self._series) <= MAX_SOURCES and self._bytes <= MAX_BYTES:
                return
            self._drop(key)
            self._forgotten += 1
            text = f"the state of source {key!r:.80} is forgotten, which has sent nothing for the longest time: there"
            self._throttle.warning("forgotten", f"{text} are too many, or they are too large")

    def _drop(self, key: str) -> None:
        series = self._series.pop(key)
        self._bytes -= len(series.block)
        if series.holder is not None:
            self._dropped[key] = series.last_seq

    def reset(self, source: str | None = None) -> int:
        """Have the next event of each series, or of one source's, begin with the initial state; return how many.

        Raises
        ------
        UnknownName
            There is no state of this source.
        ServiceError
            All sources have one state.
        """
        if source is not None and self._per == "one":
            text = f"All events have one state here, so that of source {source!r:.80} can't be reset alone"
            raise ServiceError(source, f"{text}. Reset it without a source, or serve with --state-per source.")
        if source is not None and source not in self._series:
            raise UnknownName("source", source, self._series, "with a state in this service")
        keys = list(self._series) if source is None else [source]
        for key in keys:
            self._drop(key)
        return len(keys)

    def describe(self) -> dict[str, Any]:
        """Return which tokens are delayed, how many states there are, and their size, JSON-ready."""
        return {
            "per": self._per,
            "tokens": {key: token for key, (token, *_) in self.delays.items()},
            "count": len(self._series),
            "bytes": self._bytes,
            "forgotten": self._forgotten,
        }


def change_of_state(before: Delays, after: Delays, choice: StateChoice | None) -> tuple[bool, str]:
    """Return whether a bundle goes on with the states of another one, and a line that says so.

    Parameters
    ----------
    before, after
        The delays of the bundle that is served, and of the one that replaces it.
    choice
        What the user wants; without, the states are kept if the delays are the same.
    """
    if before == after:
        is_kept = choice != "reset"
        return is_kept, (f"state between events {'kept' if is_kept else 'reset'}" if before else "")
    had, has = (
        ", ".join(f"{key} of {each[0]}" for key, each in sorted(of.items())) or "none" for of in (before, after)
    )
    how = f"{had} -> {has}" if had != has else f"{had} begins with another value"
    return False, f"state between events reset: {how}"


def why_refused(states: Mapping[str, str], options: Options, others: Iterable[str] = ()) -> str:
    """Return why a bundle with state between events can't be served so; empty if it can.

    Parameters
    ----------
    states
        Of the bundle, as ``Settings.states``; empty if it has no state.
    options
        Of the service.
    others
        Names of the replicas that take events from the same queue.
    """
    if not states:
        return ""
    has_state = f"The bundle has state between events ({', '.join(map(repr, states))})"
    if options.threads > 1 and options.state_per == "one":
        text = f"{has_state}, and on {counted(options.threads, 'thread')} its events have no order. Serve it with"
        return f"{text} --threads 1, or with a state for each source of events: --state-per source."
    other = next(iter(others), "")
    if other and not options.partitioned:
        text = f"{has_state}, and {other} takes events from the same queue: each would see a part of them. Serve it"
        way_out = "once, or, if the broker delivers all events of one source to one replica, with"
        return f"{text} {way_out} --state-per source --partitioned."
    return ""
