"""How does a replica take part in its group? It says each second that it lives, and at once what others must know."""

from __future__ import annotations

import logging
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from time import monotonic
from typing import Any, Final

from epypes.errors import BrokerError, MessageError, ServiceError
from epypes.service.group.agreement import Agreement, Tuned
from epypes.service.group.membership import Heard, Member, Membership, summary, told, told_lost
from epypes.service.group.notices import MOST_ID, MOST_IDS, Beat, Begun, Done, Left, Lost, Notice, read_notice, written
from epypes.service.group.order import Order, place_in_stream
from epypes.service.group.talk import Talk
from epypes.service.group.turnstile import Stream
from epypes.service.group.watch import Watch
from epypes.transport.channels import Place, Received

_log = logging.getLogger("epypes.service")

BEAT_S: Final = 1.0
# With so many beats newcomers are told who is lost: at the first of them one may not listen yet.
_TELLINGS: Final = 3
# What is done is said together for so long; at once where others wait for it.
_BATCH_S: Final = 0.1
_STOP_S: Final = 2.0
# Of the time for stopping; the rest is for the ends of its connections.
_LAST_WORDS_SHARE: Final = 0.75
_CHANGE_S: Final = 10.0
# What is done while the broker is away: more than this nobody has to hear of.
_MOST_UNSAID: Final = 100_000


class Group:
    """One replica among those of its bundle that take events from the same place.

    Parameters
    ----------
    place
        Where they take events from.
    about
        Returns what there is to say of this replica, by its id here.
    tuned
        Its parameters.
    seen
        Called with the ids of events that others are done with.
    changed
        Called when something may be another now; on threads of the group.
    stands_still
        Called with how many answers wait for their turn when none has passed for a while; with 0 when that is over.
    order_timeout_s
        How long an answer waits for those before it at most, in seconds; None: for none.

    Attributes
    ----------
    id
        Of this replica, from its start on.
    agreement
        The parameters of all.
    rejected
        How many messages were none of a replica's.
    """

    def __init__(
        self,
        place: Place,
        about: Callable[[str], Member],
        tuned: Tuned,
        seen: Callable[[Iterable[str]], object],
        changed: Callable[[], object],
        stands_still: Callable[[int], object],
        order_timeout_s: float | None = None,
    ) -> None:
        self.id = uuid.uuid4().hex
        self._about, self._tuned, self._seen, self._changed = about, tuned, seen, changed
        self._talk = Talk(place.beside("group", "broadcast", create=True), self._hear)
        log = place.beside("parameters", "log", create=True)
        self.agreement = Agreement(log, tuned, _CHANGE_S, self._rank, self._noted)
        self._order = None if order_timeout_s is None else Order(order_timeout_s, self._say_begun, stands_still)
        self._members, self._watch = Membership(), Watch()
        self._lock = threading.Lock()
        self._unsaid = threading.Condition()
        self._done: deque[tuple[str, tuple[Stream, int] | None, bool]] = deque(maxlen=_MOST_UNSAID)
        self._to_acknowledge: list[Callable[[], object]] = []
        self._begun: list[tuple[Stream, int]] = []
        self._said_revision, self._is_beat_due = -1, False
        self._tellings = 0
        self._is_over = False
        self._thread = threading.Thread(target=self._run, name="epypes group", daemon=True)
        self.rejected = 0

    # -- beginning and end ------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Take part, as soon as the broker is there; raises nothing."""
        self._talk.start()
        self.agreement.start()
        if self._order is not None:
            self._order.start()
        self._thread.start()

    def stop(self, timeout_s: float = _STOP_S) -> None:
        """Say that it ends, and end; all that bounded by ``timeout_s``."""
        until_s = monotonic() + timeout_s
        with self._unsaid:
            self._is_over = True
            self._unsaid.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout_s * _LAST_WORDS_SHARE)
        self.give_up()
        for talking in (self.agreement, self._talk):
            talking.end_soon()
        for talking in (self.agreement, self._talk):
            talking.stop(max(until_s - monotonic(), 0.0))

    def give_up(self) -> None:
        """Let no more answers through that wait for their turn."""
        if self._order is not None:
            self._order.stop()

    # -- what there is to know ----------------------------------------------------------------------------------------

    @property
    def trouble(self) -> str:
        """Why it does not take part just now; empty if it does."""
        return self._talk.trouble or self.agreement.trouble

    @property
    def overtaken(self) -> int:
        """How many answers went on though an event before them was not known to be done."""
        return 0 if self._order is None else self._order.overtaken

    def present(self) -> list[Heard]:
        """Return the replicas that live; this one is always among them."""
        member, now_s = self._member(), monotonic()
        with self._lock:
            self._members.heard(member, now_s, is_self=True)
            return self._members.present(now_s)

    def told(self) -> dict[str, Any]:
        """Return what there is to know of the group, JSON-ready."""
        present = self.present()
        members = [told(each, is_self=each.member.id == self.id) for each in present]
        rejected = self.rejected + self.agreement.rejected
        with self._lock:
            lost = [told_lost(each) for each in self._watch.lost(monotonic())]
        return {**summary(present), "trouble": self.trouble, "rejected": rejected, "members": members, "lost": lost}

    def _member(self) -> Member:
        return replace(self._about(self.id), agreed=self.agreement.agreed, trouble=self.agreement.trouble)

    def _rank(self) -> int:
        """Return how many of those that know as much of this bundle come before this one."""
        present = [each.member for each in self.present()]
        own = next(member for member in present if member.id == self.id)
        return sum(each.id < own.id for each in present if each.digest == own.digest and each.agreed >= own.agreed)

    # -- what happens to events here ----------------------------------------------------------------------------------

    def arrived(self, event: Any) -> None:
        """Note that an event has come here."""
        if self._order is not None:
            self._order.arrived(event)

    def wait_turn(self, event: Any, publish: Callable[[bool], object]) -> None:
        """Have an answer published when it is its turn, with whether it overtakes others; at once without an order."""
        if self._order is None:
            publish(False)
        else:
            self._order.wait_turn(event, publish)

    def done(
        self,
        event: Any,
        has_overtaken: bool = False,
        *,
        is_aside: bool = False,
        acknowledge: Callable[[], object] = lambda: None,
    ) -> None:
        """Note that an event is done, and its answer published; the others are told. Returns at once.

        With ``is_aside``, of its place alone and not of its id: who is delivered it again puts it aside again.
        ``acknowledge`` is called once. With an order the others are told before: if this replica is killed in between,
        they would wait for an event that nobody has.
        """
        numbered = place_in_stream(event)
        if self._order is not None and numbered is not None:
            self._order.done([(*numbered, has_overtaken)])
        said = ("" if is_aside else _id_of(event), numbered, has_overtaken)
        with self._unsaid:
            is_later = self._order is not None and not (self._talk.trouble or self._is_over)
            if is_later:
                self._to_acknowledge.append(acknowledge)
                self._note(said)
        if not is_later:
            acknowledge()
            # Without an order here too: others may keep one.
            with self._unsaid:
                self._note(said)

    def _note(self, said: tuple[str, tuple[Stream, int] | None, bool]) -> None:
        self._done.append(said)
        if len(self._done) == 1:
            self._unsaid.notify_all()

    def _say_begun(self, numbers: Iterable[tuple[Stream, int]]) -> None:
        with self._unsaid:
            self._begun += numbers
            self._unsaid.notify_all()

    # -- what is said, on a thread of its own -------------------------------------------------------------------------

    def _run(self) -> None:
        next_beat_s = 0.0
        while not self._is_over:
            if monotonic() >= next_beat_s or self._is_beat_due:
                next_beat_s, self._is_beat_due = monotonic() + BEAT_S, False
                self._say([self._beat(), *self._losses()])
                self._changed()
            self._tell()
            self._wait(next_beat_s)
        self._tell(Left(self.id))

    def _tell(self, *last: Notice) -> None:
        """Say what is new, and acknowledge then what the others know of."""
        with self._unsaid:
            news, acknowledging = self._news(), tuple(self._to_acknowledge)
            self._to_acknowledge.clear()
        self._say([*news, *last])
        for acknowledge in acknowledging:
            try:
                acknowledge()
            except Exception:
                _log.exception("an event could not be acknowledged")

    def _wait(self, until_s: float) -> None:
        with self._unsaid:
            if self._talk.trouble:
                # What there is to say waits for the broker.
                self._unsaid.wait_for(lambda: self._is_over, max(until_s - monotonic(), 0.0))
            elif not (self._done or self._begun or self._is_beat_due or self._is_over):
                self._unsaid.wait(max(until_s - monotonic(), 0.0))
            if self._done and self._order is None and not self._is_over:
                # More may come meanwhile; nobody waits for it.
                self._unsaid.wait_for(lambda: self._is_over, _BATCH_S)

    def _noted(self) -> None:
        """Say at once that the parameters are others now."""
        if self._tuned.current.revision != self._said_revision:
            self._beat_soon()
        self._changed()

    def _beat_soon(self) -> None:
        with self._unsaid:
            self._is_beat_due = True
            self._unsaid.notify_all()

    def _beat(self) -> Beat:
        member = self._member()
        self._said_revision = member.revision
        with self._lock:
            self._members.heard(member, monotonic(), is_self=True)
        return Beat(member, () if self._order is None else self._order.known())

    def _losses(self) -> list[Notice]:
        """Return who is lost, while somebody has come who can't know it."""
        with self._lock:
            if self._tellings == 0:
                return []
            self._tellings -= 1
            return [Lost(each) for each in self._watch.lost(monotonic())]

    def _news(self) -> list[Notice]:
        if self._talk.trouble:
            return []
        news: list[Notice] = []
        with self._unsaid:
            while self._begun:
                news.append(Begun(self.id, self._begun[:MOST_IDS]))
                self._begun = self._begun[MOST_IDS:]
            while self._done:
                some = [self._done.popleft() for _ in range(min(len(self._done), MOST_IDS))]
                numbers = [(*numbered, has_overtaken) for _, numbered, has_overtaken in some if numbered is not None]
                news.append(
                    Done(
                        self.id,
                        [each for each, _, _ in some if 0 < len(each.encode(errors="replace")) <= MOST_ID],
                        numbers,
                    )
                )
        return news

    def _say(self, notices: list[Notice]) -> None:
        for notice in notices:
            try:
                self._talk.say(written(notice))
            except (BrokerError, MessageError) as error:
                _log.debug("the group has not heard this: %s", error)
                return

    # -- what is heard ------------------------------------------------------------------------------------------------

    def _hear(self, received: Received) -> None:
        try:
            notice = read_notice(b"".join(received.frames))
        except MessageError as error:
            self.rejected += 1
            _log.debug("a message to the group is passed over: %s", error)
            return
        if isinstance(notice, Beat):
            self._heard_beat(notice)
        elif isinstance(notice, Left):
            with self._lock:
                self._members.left(notice.member_id)
                self._watch.left(notice.member_id)
            self._look()
            self._changed()
        elif isinstance(notice, Lost):
            with self._lock:
                self._watch.told_of(notice.heard, monotonic())
        elif notice.member_id != self.id:
            self._heard_of_events(notice)

    def _heard_beat(self, beat: Beat) -> None:
        member = beat.member
        if member.id == self.id:
            # Only who hears itself can tell that others are not heard.
            self._look()
            return
        with self._lock:
            is_new = self._members.heard(member, monotonic())
            if is_new:
                self._tellings = _TELLINGS
        if self._order is not None:
            self._order.told(beat.known)
        if is_new:
            self._look()
            # It shall know us at once too.
            self._beat_soon()
            self._changed()
        self._compare(member)

    def _heard_of_events(self, notice: Done | Begun) -> None:
        if isinstance(notice, Done):
            self._seen(notice.ids)
            if self._order is not None:
                self._order.done(notice.numbers)
        elif self._order is not None:
            self._order.begun_elsewhere(notice.numbers)

    def _look(self) -> None:
        own, present = self._member(), self.present()
        with self._lock:
            lines = self._watch.look(own, present, monotonic())
        for level, text in lines:
            _log.log(level, "%s", text)

    def _compare(self, member: Member) -> None:
        if member.agreed < self.agreement.agreed and self._rank() == 0:
            try:
                self.agreement.compare(member.digest, member.agreed, monotonic())
            except (BrokerError, MessageError, ServiceError) as error:
                _log.debug("what holds could not be said again: %s", error)


def _id_of(event: Any) -> str:
    """Return the id that a broker's deliveries of an event are told by."""
    delivery = getattr(event, "delivery", None)
    return str(event.id if delivery is None else delivery.id)
