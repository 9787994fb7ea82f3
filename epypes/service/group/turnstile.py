"""May an answer be published yet, or is an event before it still worked on by another replica?

Pure: times are given. Events are ordered within what one sender numbers from its start to its stop: its source and
epoch, a stream. An answer waits until all events before it in its stream are done, wherever, and never longer than its
time: then what is missing is given up, and the stream goes on. So it costs that time once if a number is sent that no
replica ever gets: an event that can't be understood, or one of an id that was answered before.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

# Who has sent events, and from when on: its source and epoch.
Stream = tuple[str, int]
# The first event that a sender numbers.
FIRST: Final = 1
# So long others may say that they have an earlier event of a stream, or know how far it is, before the first one that
# is known counts as its beginning: somewhat more than they take from one word to the next.
SETTLE_S: Final = 1.5
_MOST_STREAMS: Final = 1_000


@dataclass(slots=True)
class _Line:
    """Which numbers are through: all below ``next``, and those in ``ahead``."""

    next: int = FIRST
    ahead: set[int] = field(default_factory=set)

    def add(self, number: int) -> None:
        if number >= self.next:
            self.ahead.add(number)
            self._go_on()

    def skip_to(self, number: int) -> None:
        if number > self.next:
            self.next = number
            self.ahead = {each for each in self.ahead if each >= number}
            self._go_on()

    def _go_on(self) -> None:
        while self.next in self.ahead:
            self.ahead.remove(self.next)
            self.next += 1


@dataclass(slots=True, eq=False)
class Waiting:
    """An answer that waits for its turn.

    Attributes
    ----------
    stream, number
        Its event.
    ticket
        What the caller knows it by.
    until_s
        When it goes on anyway.
    has_overtaken
        Whether it goes on though an event before it is not known to be done; set when it does.
    """

    stream: Stream
    number: int
    ticket: Any
    until_s: float
    has_overtaken: bool = False


@dataclass(slots=True)
class _State:
    # Done by anybody or let through here, and done by anybody: what was let through here may not be published yet.
    through: _Line = field(default_factory=_Line)
    done: _Line = field(default_factory=_Line)
    waiting: list[Waiting] = field(default_factory=list)
    # While it is not known where the stream begins: the lowest number that somebody has, and when that counts.
    lowest: int | None = None
    settles_s: float | None = None

    def begin_at(self, number: int) -> None:
        self.settles_s = None
        self.through.skip_to(number)
        self.done.skip_to(number)


class Turnstile:
    """Lets answers through in the order of their events, over all replicas.

    Parameters
    ----------
    timeout_s
        How long an answer waits at most, in seconds.

    Attributes
    ----------
    overtaken
        How many went on though an event before them was not known to be done.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._streams: OrderedDict[Stream, _State] = OrderedDict()
        # Those that somebody waits in.
        self._busy: dict[Stream, _State] = {}
        self.overtaken = 0

    # -- what is heard --------------------------------------------------------------------------------------------

    def arrived(self, stream: Stream, number: int, now_s: float) -> bool:
        """Note that an event has come, here or elsewhere; return whether others must hear of it.

        They must while it is not known where its stream begins: it may be the first of it.
        """
        state = self._state(stream, now_s)
        if state.settles_s is None:
            return False
        is_lowest = state.lowest is None or number < state.lowest
        if is_lowest:
            state.lowest = number
        if number <= FIRST:
            state.begin_at(FIRST)
        return is_lowest

    def done(self, stream: Stream, number: int, now_s: float, *, has_overtaken: bool = False) -> None:
        """Note that an event is done: its answer is published, or it is put aside; here or elsewhere."""
        state = self._state(stream, now_s)
        if has_overtaken:
            # What was missing before it is given up by all.
            state.begin_at(number)
        for line in (state.through, state.done):
            line.add(number)

    def told(self, stream: Stream, next_number: int, now_s: float) -> None:
        """Note that another replica knows of all events below a number that they are done."""
        self._state(stream, now_s).begin_at(next_number)

    # -- who waits --------------------------------------------------------------------------------------------------

    def enter(self, stream: Stream, number: int, ticket: Any, now_s: float) -> None:
        """Have an answer wait for its turn."""
        self.arrived(stream, number, now_s)
        state = self._state(stream, now_s)
        state.waiting.append(Waiting(stream, number, ticket, now_s + self._timeout_s))
        state.waiting.sort(key=lambda each: each.number)
        self._busy[stream] = state

    def passing(self, now_s: float) -> list[Waiting]:
        """Return those whose turn it is, in order; each is returned once."""
        passed: list[Waiting] = []
        for stream, state in list(self._busy.items()):
            self._let_through(state, now_s, passed)
            if not state.waiting:
                del self._busy[stream]
        return passed

    def _let_through(self, state: _State, now_s: float, passed: list[Waiting]) -> None:
        self._settle(state, now_s)
        late = [each.number for each in state.waiting if each.until_s <= now_s]
        last_late = max(late, default=None)
        while state.waiting:
            first = state.waiting[0]
            is_its_turn = first.number <= state.through.next and state.settles_s is None
            if not is_its_turn and (last_late is None or first.number > last_late):
                return
            # Before one whose time is over go those that wait with lower numbers, or they would be overtaken for ever.
            if not is_its_turn:
                first.has_overtaken, self.overtaken = True, self.overtaken + 1
                state.settles_s = None
                state.through.skip_to(first.number)
            state.through.add(first.number)
            passed.append(state.waiting.pop(0))

    def _settle(self, state: _State, now_s: float) -> None:
        if state.settles_s is not None and state.settles_s <= now_s:
            state.begin_at(state.lowest if state.lowest is not None else FIRST)

    def due_s(self) -> float | None:
        """Return when `passing` may return more, if nothing is heard until then; None if nobody waits."""
        times = [time_s for state in self._busy.values() for time_s in _times(state)]
        return min(times, default=None)

    @property
    def waiting(self) -> int:
        """How many wait."""
        return sum(len(state.waiting) for state in self._busy.values())

    def leave(self) -> list[Waiting]:
        """Return all that wait, which do so no more."""
        left = [each for state in self._busy.values() for each in state.waiting]
        for state in self._busy.values():
            state.waiting.clear()
        self._busy.clear()
        return left

    # -- what others are told -----------------------------------------------------------------------------------------

    def known(self, most: int = 100) -> list[tuple[Stream, int]]:
        """Return up to which number all events are done, by stream, for those that were heard of last."""
        recent: Iterable[Stream] = reversed(self._streams)
        known = [(stream, self._streams[stream]) for stream in recent]
        return [(stream, state.done.next) for stream, state in known if state.settles_s is None][:most]

    def _state(self, stream: Stream, now_s: float) -> _State:
        state = self._streams.get(stream)
        if state is None:
            state = self._streams[stream] = _State(settles_s=now_s + SETTLE_S)
            self._forget()
        self._streams.move_to_end(stream)
        return state

    def _forget(self) -> None:
        if len(self._streams) > _MOST_STREAMS:
            idle = next((stream for stream, state in self._streams.items() if not state.waiting), None)
            if idle is not None:
                del self._streams[idle]


def _times(state: _State) -> list[float]:
    ends = [min(each.until_s for each in state.waiting)]
    return ends if state.settles_s is None else [*ends, state.settles_s]
