"""Replicas of one bundle that share the events of a broker's queue.

Each replica publishes a heartbeat every second on a broadcast address beside the queue, and hears those of the others.
Hyperparameters that are set at one replica are published to all as one `ParameterSet`; the set with the higher version
(revision, then id of its author) wins everywhere, so that all settle on the same one whatever was lost or set at the
same time. A heartbeat names the version that its replica computes with: who knows an older one asks for the newer.
What must outlive all replicas is written back into the bundle.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from time import monotonic
from typing import Any, Final, Protocol

from epypes.errors import BrokerError, MessageError, ServiceError
from epypes.service.parameters import Parameters, value_of
from epypes.service.replica_messages import (
    MAX_ID_CHARACTERS,
    MAX_IDS,
    Answered,
    Goodbye,
    Heartbeat,
    Member,
    ParameterQuery,
    ParameterSet,
    ReplicaMessage,
    decode_message,
    encode_message,
)
from epypes.transport.publisher import Publisher
from epypes.transport.subscriber import Subscriber

HEARTBEAT_S: Final = 1.0
# Three heartbeats may be lost before a replica counts as gone.
_SILENT_AFTER_S: Final = 3.5
# Events wait so long for the parameters of the others; less if no other replica answers.
_JOIN_TIMEOUT_S: Final = 5.0
_ALONE_AFTER_S: Final = 1.25
# A replica that was itself held up, or had no broker, has heard nothing: silence before that proves nothing.
_HELD_UP_S: Final = 2.0
_GRACE_S: Final = 10.0
_BATCH_S: Final = 0.1
_RETRY_S: Final = 0.25
_LOST_FOR_S: Final = 600.0
_MAX_MEMBERS: Final = 1_000
_MAX_LOST: Final = 20
_MAX_BUNDLES: Final = 100
_MAX_UNSENT_IDS: Final = 100_000
_MAX_REASON: Final = 500
_PREFETCH: Final = 64

_log = logging.getLogger("epypes.service")


class SharedParameters(Protocol):
    """The hyperparameters of this replica, as its worker computes with them."""

    @property
    def current(self) -> Parameters:
        """Revision and entries."""

    @property
    def digest(self) -> str:
        """Of the bundle that they belong to."""

    def set(self, values: Mapping[str, Any], revision: int | None, at_least: int = 0) -> Parameters:
        """Change values under a revision of ``at_least`` or more; raise as `Service.set_parameters` does."""

    def follow(self, digest: str, revision: int, values: Mapping[str, Any]) -> Mapping[str, str]:
        """Take all values as another replica has set them; return the problems by token, if the worker refuses some.

        Raises
        ------
        ServiceError
            There is no worker just now, or it is busy.
        """


@dataclass(slots=True)
class _Known:
    member: Member
    heard_s: float
    # Another bundle on the same queue is reported once.
    is_reported: bool = False


class Replicas:
    """One replica among those that take events from the same queue; or a service that stands alone.

    Parameters
    ----------
    address
        The broadcast address of the group, beside the queue; None for a service without a broker.
    facts
        Returns the fields of `Member` that the service knows: replica, name, state, reason, counts, http.
    parameters
        The hyperparameters of this replica.
    on_answered
        Called with ids of events that another replica has answered.
    on_change
        Called when `is_joining` or the members may have changed; on a thread of this object.

    Attributes
    ----------
    is_joining
        Whether events must wait: the parameters that the other replicas compute with are not known yet.
    rejected
        How many messages on the address were no messages between replicas.
    """

    def __init__(
        self,
        address: Any,
        facts: Callable[[], Mapping[str, Any]],
        parameters: SharedParameters,
        on_answered: Callable[[Iterable[str]], object] = lambda ids: None,
        on_change: Callable[[], object] = lambda: None,
    ) -> None:
        self._address, self._facts, self._parameters = address, facts, parameters
        self._on_answered, self._on_change = on_answered, on_change
        self._id = uuid.uuid4().hex
        self._changed = threading.Condition()
        self._setting = threading.Lock()
        self._members: dict[str, _Known] = {}
        self._lost: dict[str, _Known] = {}
        self._newest: dict[str, ParameterSet] = {}
        # Versions, by bundle: what this replica computes with, and what its worker has refused.
        self._applied: dict[str, tuple[int, str]] = {}
        self._refused: dict[str, tuple[int, str]] = {}
        self._unsent: deque[str] = deque(maxlen=_MAX_UNSENT_IDS)
        self._trouble = f"{address} has not been reached yet." if address is not None else ""
        self._refusal = ""
        self._joined_s = self._connected_s = self._looked_s = self._certain_from_s = 0.0
        self._is_beat_due = self._is_over = False
        self._publisher: Publisher | None = None
        self._thread: threading.Thread | None = None
        self.is_joining = False
        self.rejected = 0

    # -- start and stop -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Take part as soon as the broker is there; raises nothing."""
        if self._address is None:
            return
        self._is_over, self.is_joining = False, True
        self._joined_s = monotonic() + _JOIN_TIMEOUT_S
        self._thread = threading.Thread(target=self._run, name="epypes replicas", daemon=True)
        self._thread.start()

    def stop(self, timeout_s: float = 2.0) -> None:
        """Publish that this replica stops, and end, within ``timeout_s``."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout_s)
        self.is_joining = False

    def _run(self) -> None:
        heard = Subscriber(self._address, _Handler(self._receive), acknowledge="received", undecoded=True)
        publisher = Publisher(self._address)
        try:
            if self._opened(heard, publisher):
                self._publisher = publisher
                self._take_part(heard, publisher)
                self._flush()
                self._publish(Goodbye(self._id))
        except Exception:
            _log.exception("this replica takes no part in its group any more")
        finally:
            self._publisher = None
            publisher.stop(1.0)
            heard.stop(1.0)

    def _opened(self, heard: Subscriber, publisher: Publisher) -> bool:
        """Connect, however long the broker is away; return False if the replica was stopped before."""
        while not self._is_over:
            try:
                heard.start()
                publisher.start()
            except BrokerError as error:
                self._trouble = str(error)
                self._wait(_RETRY_S)
                self._look_at_joining()
            else:
                return True
        return False

    def _take_part(self, heard: Subscriber, publisher: Publisher) -> None:
        next_beat_s, self._looked_s = 0.0, monotonic()
        while not self._is_over:
            trouble = heard.trouble or publisher.trouble
            if self._trouble and not trouble:
                # Connected, perhaps again: the others may have changed the parameters meanwhile.
                self._connected_s = monotonic()
                self._publish(ParameterQuery(self._parameters.digest))
                self._is_beat_due = True
            self._trouble = trouble
            if monotonic() >= next_beat_s or self._is_beat_due:
                self._is_beat_due, next_beat_s = False, monotonic() + HEARTBEAT_S
                self._beat()
            self._flush()
            self._follow()
            self._look_at_joining()
            self._wait(min(next_beat_s - monotonic(), _RETRY_S if self._is_behind() else HEARTBEAT_S))

    def _wait(self, seconds: float) -> None:
        with self._changed:
            if self._unsent and not self._is_over:
                # More answers may follow, and go into the same message.
                seconds = min(seconds, _BATCH_S)
                self._changed.wait_for(lambda: self._is_over, seconds)
            elif not (self._is_beat_due or self._is_over):
                self._changed.wait(max(seconds, 0.0))

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    # -- publishing ---------------------------------------------------------------------------------------------------

    def _publish(self, message: ReplicaMessage) -> None:
        publisher = self._publisher
        if publisher is None or self._trouble:
            return
        try:
            publisher.send((encode_message(message),))
        except (BrokerError, MessageError) as error:
            _log.debug("not published to the other replicas: %s", error)

    def _beat(self) -> None:
        self._introduce()
        now_s = monotonic()
        self._look_for_lost(now_s)
        with self._changed:
            lost = [(known.member, int((now_s - known.heard_s) * 1e3)) for known in self._lost.values()]
        self._publish(Heartbeat(self._member(), lost[-_MAX_LOST:]))
        self._on_change()

    def _introduce(self) -> None:
        """Publish the revision that this bundle has gone on with here, after a deploy, if no other replica knows it."""
        digest, current = self._parameters.digest, self._parameters.current
        newest = self._newest.get(digest)
        if current.revision > (0 if newest is None else newest.revision):
            self._announce(digest, current)

    def _announce(self, digest: str, current: Parameters) -> None:
        values = {token: dict(value_of(entry)) for token, entry in current.entries.items()}
        new = ParameterSet(digest, current.revision, self._id, values)
        with self._changed:
            self._keep(new)
            self._applied[digest] = new.version
        self._publish(new)
        self._is_beat_due = True
        self._wake()

    def _flush(self) -> None:
        while self._unsent and not self._trouble:
            with self._changed:
                ids = [self._unsent.popleft() for _ in range(min(len(self._unsent), MAX_IDS))]
            self._publish(Answered(self._id, ids))

    def answered(self, event_id: str) -> None:
        """Have the other replicas know that this one has answered an event; returns at once."""
        if self._address is not None and 0 < len(event_id) <= MAX_ID_CHARACTERS:
            with self._changed:
                self._unsent.append(event_id)
                self._changed.notify_all()

    # -- receiving ----------------------------------------------------------------------------------------------------

    def _receive(self, delivery: Any) -> None:
        try:
            message = decode_message(b"".join(delivery.frames))
        except MessageError as error:
            self.rejected += 1
            _log.debug("rejected on %s: %s", self._address, error)
            return
        if isinstance(message, ParameterQuery):
            self._answer_query(message.digest)
        elif isinstance(message, ParameterSet):
            with self._changed:
                self._keep(message)
        elif isinstance(message, Heartbeat):
            if message.member.id != self._id:
                self._heard(message)
        elif message.id == self._id:
            return
        elif isinstance(message, Goodbye):
            self._left(message.id)
        else:
            self._on_answered(message.events)
        self._wake()

    def _answer_query(self, digest: str) -> None:
        newest = self._newest.get(digest)
        if newest is not None:
            self._publish(newest)
        self._is_beat_due = True

    def _keep(self, new: ParameterSet) -> None:
        """Remember a set of parameters if it is the newest of its bundle; the lock is held."""
        known = self._newest.pop(new.digest, None)
        self._newest[new.digest] = new if known is None or new.version > known.version else known
        if len(self._newest) > _MAX_BUNDLES:
            del self._newest[next(iter(self._newest))]

    def _heard(self, heartbeat: Heartbeat) -> None:
        member, now_s = heartbeat.member, monotonic()
        with self._changed:
            known = self._members.get(member.id)
            if known is None and len(self._members) >= _MAX_MEMBERS:
                return
            self._members[member.id] = _Known(member, now_s, known is not None and known.is_reported)
            self._lost.pop(member.id, None)
            for lost, silent_ms in heartbeat.lost:
                if lost.id not in self._members and lost.id != self._id:
                    self._lost.setdefault(lost.id, _Known(lost, now_s - silent_ms / 1e3))
            newest = self._newest.get(member.digest)
        if known is None:
            _log.info("%s is in the group", _label(member))
            self._is_beat_due = True
        self._warn_of_other_bundle(member)
        if (member.revision, member.author) > ((0, "") if newest is None else newest.version) and member.revision:
            self._publish(ParameterQuery(member.digest))

    def _warn_of_other_bundle(self, member: Member) -> None:
        name = str(self._facts().get("name", ""))
        known = self._members[member.id]
        if member.name != name and not known.is_reported:
            known.is_reported = True
            text = "%s serves another bundle from the same queue, %s, and this one serves %s: each takes events of the"
            _log.warning(f"{text} other. Give each bundle a queue of its own.", _label(member), member.name, name)

    def _left(self, member_id: str) -> None:
        with self._changed:
            known = self._members.pop(member_id, None)
        if known is not None:
            _log.info("%s has left the group", _label(known.member))
            self._on_change()

    def _look_for_lost(self, now_s: float) -> None:
        if now_s - self._looked_s > _HELD_UP_S or self._trouble:
            self._certain_from_s = now_s + _GRACE_S
        self._looked_s = now_s
        if now_s < self._certain_from_s:
            # It is decided later whether a silent replica is lost.
            return
        with self._changed:
            silent = [known for known in self._members.values() if now_s - known.heard_s > _SILENT_AFTER_S]
            for known in silent:
                self._lost[known.member.id] = self._members.pop(known.member.id)
            present = {_place(known.member) for known in self._members.values()} | {_place(self._member())}
            for known in [*self._lost.values()]:
                # A replica of the same name on the same machine has taken its place.
                if now_s - known.heard_s > _LOST_FOR_S or _place(known.member) in present:
                    del self._lost[known.member.id]
            newly_lost = [known.member for known in silent if known.member.id in self._lost]
        for member in newly_lost:
            _log.warning("%s is gone: no heartbeat for %.1f s", _label(member), _SILENT_AFTER_S)

    # -- hyperparameters ----------------------------------------------------------------------------------------------

    def set(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        """Change hyperparameters here and in all replicas; return them when this one computes with them.

        Raises
        ------
        RevisionConflict, ParametersRefused, ServiceError
            As `Service.set_parameters`; also if the broker is away: nothing is changed then.
        """
        if self._address is None:
            return self._parameters.set(values, revision)
        with self._setting:
            digest = self._parameters.digest
            if self._trouble:
                text = f"The other replicas can't be reached, so nothing is changed: {self._trouble}"
                raise ServiceError(digest, text)
            before, newest = self._parameters.current, self._newest.get(digest)
            now = self._parameters.set(values, revision, 0 if newest is None else newest.revision + 1)
            if now.revision != before.revision:
                self._refusal = ""
                self._announce(digest, now)
            return now

    def newest(self, digest: str) -> tuple[int, Mapping[str, Any]] | None:
        """Return revision and values that the replicas of a bundle compute with, None if none is known.

        The caller takes them over: it deploys that bundle.
        """
        with self._changed:
            found = self._newest.get(digest)
            if found is None:
                return None
            self._applied[digest] = found.version
            return found.revision, found.values

    def _is_behind(self) -> bool:
        newest = self._newest.get(self._parameters.digest)
        done = self._applied.get(self._parameters.digest), self._refused.get(self._parameters.digest)
        return newest is not None and newest.version not in done

    def _follow(self) -> None:
        """Have the worker take the newest parameters, unless this replica computes with them."""
        if not self._is_behind() or not self._setting.acquire(blocking=False):
            return
        try:
            newest = self._newest[self._parameters.digest]
            problems = self._parameters.follow(newest.digest, newest.revision, newest.values)
        except ServiceError as error:
            _log.debug("parameters of another replica wait: %s", error)
            return
        finally:
            self._setting.release()
        if problems:
            why = " ".join(f"{token!r}: {problem}" for token, problem in problems.items())
            self._refused[newest.digest] = newest.version
            self._refusal = f"The worker refuses revision {newest.revision} of the other replicas. {why}"
            _log.error("%s", self._refusal)
        else:
            self._applied[newest.digest] = newest.version
            self._refusal = ""
        self._is_beat_due = True

    def _look_at_joining(self) -> None:
        now_s = monotonic()
        if not self.is_joining:
            return
        others = [known for known in self._members.values() if known.member.digest == self._parameters.digest]
        newest = self._newest.get(self._parameters.digest)
        version = (0, "") if newest is None else newest.version
        is_known = others and all((each.member.revision, each.member.author) <= version for each in others)
        is_alone = not others and self._connected_s and now_s - self._connected_s > _ALONE_AFTER_S
        if now_s > self._joined_s or ((is_known or is_alone) and not self._is_behind()):
            self.is_joining = False
            self._on_change()

    # -- description --------------------------------------------------------------------------------------------------

    @property
    def trouble(self) -> str:
        """Why this replica does not take part, or does not compute with the newest parameters; empty if it does."""
        return self._trouble or self._refusal

    def _member(self) -> Member:
        facts = dict(self._facts())
        facts["reason"] = str(facts.get("reason", ""))[:_MAX_REASON]
        digest = self._parameters.digest
        own: dict[str, Any] = {"id": self._id, "host": socket.gethostname(), "pid": os.getpid(), "digest": digest}
        author = self._applied.get(digest, (0, ""))[1]
        version: dict[str, Any] = {"revision": self._parameters.current.revision, "author": author}
        return Member(**own, **version, trouble=self._refusal, **facts)

    def describe(self) -> dict[str, Any]:
        """Return the group as this replica knows it, JSON-ready.

        Returns
        -------
        dict
            ``is_shared``: whether there is a broker; ``replicas``: how many are alive; ``ready``: how many of them are
            READY; ``counts``: sums of theirs; ``agree``: whether all serve one bundle with one revision; ``trouble``;
            ``rejected``; ``members`` and ``lost``: a dict for each.
        """
        now_s = monotonic()
        with self._changed:
            members = [_Known(self._member(), now_s), *self._members.values()]
            lost = [_describe(known, now_s, self._id, "LOST") for known in _by_name(self._lost.values())]
        present = [known for known in _by_name(members) if now_s - known.heard_s <= _SILENT_AFTER_S]
        counts: Counter[str] = Counter()
        for known in present:
            counts.update(known.member.counts)
        return {
            "is_shared": self._address is not None,
            "replicas": len(present),
            "ready": sum(known.member.state == "READY" for known in present),
            "counts": dict(counts),
            "agree": len({(known.member.digest, known.member.revision) for known in present}) <= 1,
            "trouble": self.trouble,
            "rejected": self.rejected,
            "members": [_describe(known, now_s, self._id) for known in present],
            "lost": lost,
        }


class _Handler:
    """A queue that hands every item to a function."""

    def __init__(self, handle: Callable[[Any], object]) -> None:
        self._handle = handle

    def put(self, item: Any, *, block: bool = False, timeout: float | None = None) -> None:
        self._handle(item)


def _describe(known: _Known, now_s: float, own_id: str, state: str = "") -> dict[str, Any]:
    member, heard_s = known.member, now_s - known.heard_s
    if state:
        text = f"no heartbeat for {heard_s:.1f} s, and it did not stop in order; its counts are of then"
        member = replace(member, state=state, reason=text)
    found = asdict(member)
    is_self = found.pop("id") == own_id
    del found["author"]
    return {**found, "heard_s": round(heard_s, 3), "is_self": is_self}


def _by_name(known: Iterable[_Known]) -> list[_Known]:
    return sorted(known, key=lambda each: (len(each.member.replica), each.member.replica, each.member.id))


def _place(member: Member) -> tuple[str, str]:
    return member.replica, member.host


def _label(member: Member) -> str:
    return f"replica {member.replica} at {member.host}"
