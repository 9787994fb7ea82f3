"""Replicas of one bundle that share the events of a broker's queue.

Each replica publishes a heartbeat every second on a broadcast address beside the queue, and hears those of the others.
Hyperparameters that are set at one replica are published to all as one `ParameterSet`; the set with the higher version
(revision, then id of its author) wins everywhere, so that all settle on the same one whatever was lost or set at the
same time. A heartbeat names the version that its replica computes with: a replica that knows only an older one asks for
it. What must outlive all replicas is written back into the bundle.

Two threads: one publishes, the other has the worker take newer parameters, since that waits for the event that is
worked on. Messages are received on a thread of the subscriber. Nothing of the service is called while the lock is held:
the dispatcher calls `Replicas.newest` with its own lock held.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import monotonic
from typing import Any, Final

from epypes.errors import BrokerError, MessageError, ServiceError
from epypes.service.parameters import ParameterControl, Parameters, value_of
from epypes.service.replication.membership import Membership, label
from epypes.service.replication.messages import (
    MAX_INTEGER,
    Goodbye,
    Heartbeat,
    ParameterQuery,
    ParameterSet,
    ReplicaMessage,
    Version,
    decode_message,
    encode_message,
)
from epypes.transport import Publisher, Subscriber
from epypes.transport.address import Address
from epypes.transport.channel import Delivery

HEARTBEAT_S: Final = 1.0
# After this time every other replica has published a heartbeat.
_GATHERING_S: Final = 1.25
# Events wait no longer than this for the parameters of the others.
_JOIN_TIMEOUT_S: Final = 5.0
_RETRY_S: Final = 0.25
_CLOSE_S: Final = 1.0
_MAX_BUNDLES: Final = 100
# In these states a replica takes no events.
_TAKES_NONE: Final = ("DRAINING", "FAULTED", "STOPPED")
# Longer texts are cut: a heartbeat is small.
_MAX_TEXT: Final = 500

_log = logging.getLogger("epypes.service")


@dataclass(slots=True)
class _BundleParameters:
    """What a replica knows of the parameters of one bundle.

    Attributes
    ----------
    newest
        The newest set that was published.
    settled
        The version of the last set that the worker has taken or refused.
    refusal
        Why the worker has refused it; empty if it has taken it.
    """

    newest: ParameterSet | None = None
    settled: Version = (0, "")
    refusal: str = ""

    @property
    def version(self) -> Version:
        return (0, "") if self.newest is None else self.newest.version

    @property
    def is_behind(self) -> bool:
        return self.version > (0, "") and self.version != self.settled


class Replicas:
    """One replica among those that take events from the same queue; or a service that stands alone.

    Parameters
    ----------
    address
        The broadcast address of the group, beside the queue; None for a service without a broker.
    facts
        Returns the fields of `Heartbeat` that the service knows: replica, name, state, reason, counts, http.
    parameters
        The hyperparameters of this replica.
    on_joined
        Called once after `start`, on a thread of this object: the parameters that the other replicas compute with are
        taken over, or were not to be had in time. Events must wait until then.

    Attributes
    ----------
    is_shared
        Whether there is a broker.
    is_joining
        Whether `on_joined` is still to be called.
    """

    def __init__(
        self,
        address: Address | None,
        facts: Callable[[], Mapping[str, Any]],
        parameters: ParameterControl,
        on_joined: Callable[[], object],
    ) -> None:
        self._address, self._facts, self._parameters = address, facts, parameters
        self._on_joined = on_joined
        self.is_shared, self.is_joining = address is not None, False
        self._changed = threading.Condition()
        # Held while parameters are changed and published: a set of another replica is taken before or after that.
        self._setting = threading.Lock()
        self._threads: list[threading.Thread] = []
        # By digest of the bundle; with the lock `_changed`.
        self._bundles: dict[str, _BundleParameters] = {}
        self._reset()

    def _reset(self) -> None:
        self._id = uuid.uuid4().hex
        self._membership = Membership()
        self._subscriber: Subscriber | None = None
        self._publisher: Publisher | None = None
        self._unreached = "" if self._address is None else f"{self._address} has not been reached yet."
        self._connected_s: float | None = None
        self._join_until_s = monotonic() + _JOIN_TIMEOUT_S
        self._is_beat_due = self._is_over = False
        self._rejected = 0

    # -- start and stop -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Take part as soon as the broker is there; raises nothing."""
        if self._address is None:
            return
        for thread in self._threads:
            # After a stop that did not wait for a broker which does not answer.
            thread.join()
        self._reset()
        self.is_joining = True
        self._threads = [
            threading.Thread(target=self._run, args=(self._address,), name="epypes replicas", daemon=True),
            threading.Thread(target=self._follow, name="epypes following", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self, timeout_s: float = 2.0) -> None:
        """Publish that this replica stops, and end, within ``timeout_s``."""
        until_s = monotonic() + timeout_s
        with self._changed:
            self._is_over = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(max(until_s - monotonic(), 0.0))
        self.is_joining = False

    def _run(self, address: Address) -> None:
        subscriber = Subscriber(address, self, acknowledge="received", undecoded=True)
        publisher = Publisher(address)
        subscriber.on_connection = publisher.on_connection = lambda is_connected, reason: self._beat_soon()
        try:
            if self._connect(subscriber, publisher):
                self._take_part()
                self._publish(Goodbye(self._id))
        except Exception as error:
            _log.exception("this replica takes no part in its group any more")
            self._unreached = f"This replica takes no part in its group any more: {error!r:.200}"
        finally:
            self._publisher = None
            publisher.stop(_CLOSE_S)
            subscriber.stop(_CLOSE_S)

    def _connect(self, subscriber: Subscriber, publisher: Publisher) -> bool:
        """Connect, however long the broker is away; return False if the replica was stopped before."""
        while not self._is_over:
            try:
                subscriber.start()
                publisher.start()
            except BrokerError as error:
                self._unreached = str(error)
                with self._changed:
                    self._changed.wait_for(self._has_ended, _RETRY_S)
            else:
                self._subscriber, self._publisher = subscriber, publisher
                self._connected_s, self._unreached = monotonic(), "This replica has stopped."
                return True
        return False

    def _take_part(self) -> None:
        beat_s = 0.0
        while not self._is_over:
            if self._is_beat_due or monotonic() >= beat_s:
                self._is_beat_due, beat_s = False, monotonic() + HEARTBEAT_S
                self._beat()
            with self._changed:
                self._changed.wait_for(lambda: self._is_over or self._is_beat_due, max(beat_s - monotonic(), 0.0))

    def _has_ended(self) -> bool:
        return self._is_over

    def _beat_soon(self) -> None:
        with self._changed:
            self._is_beat_due = True
            self._changed.notify_all()

    @property
    def _away(self) -> str:
        """Why the broker is not connected; empty if it is."""
        subscriber, publisher = self._subscriber, self._publisher
        if subscriber is None or publisher is None:
            return self._unreached
        return subscriber.trouble or publisher.trouble

    # -- publishing ---------------------------------------------------------------------------------------------------

    def _publish(self, message: ReplicaMessage) -> None:
        """Publish a message if the broker is there; what a peer misses is named again by the next heartbeat."""
        publisher = self._publisher
        if publisher is None or self._away:
            return
        try:
            publisher.send((encode_message(message),))
        except (BrokerError, MessageError) as error:
            _log.warning("a %s was not published to the other replicas: %s", type(message).__name__, error)

    def _beat(self) -> None:
        self._introduce()
        heartbeat = self._heartbeat()
        self._membership.look_for_lost(heartbeat, bool(self._away))
        self._publish(heartbeat)

    def _introduce(self) -> None:
        """Publish the revision that this bundle has gone on with here, after a deploy, if no other replica knows it."""
        digest, current = self._parameters.snapshot()
        with self._changed:
            is_new = current.revision > self._bundle(digest).version[0]
        if is_new:
            self._announce(digest, current)

    def _announce(self, digest: str, current: Parameters) -> None:
        values = {token: value_of(entry) for token, entry in current.entries.items()}
        new = ParameterSet(digest, current.revision, self._id, values)
        with self._changed:
            self._keep(new)
            self._settle(new)
        self._publish(new)
        self._beat_soon()

    # -- receiving ----------------------------------------------------------------------------------------------------

    def put(self, item: Delivery, *, block: bool = False, timeout: float | None = None) -> None:
        """Take a message; called by the subscriber, whose queue this is."""
        try:
            message = decode_message(b"".join(item.frames))
        except MessageError as error:
            self._rejected += 1
            _log.debug("rejected on %s: %s", self._address, error)
            return
        if isinstance(message, ParameterQuery):
            with self._changed:
                newest = self._bundle(message.digest).newest
            if message.id == self._id and newest is not None:
                self._publish(newest)
        elif isinstance(message, ParameterSet):
            with self._changed:
                self._keep(message)
        elif isinstance(message, Heartbeat):
            if message.id != self._id:
                self._heard(message)
        elif message.id != self._id:
            self._membership.forget(message.id)

    def _bundle(self, digest: str) -> _BundleParameters:
        """Return what is known of a bundle; the lock is held."""
        known = self._bundles.pop(digest, None) or _BundleParameters()
        self._bundles[digest] = known
        if len(self._bundles) > _MAX_BUNDLES:
            del self._bundles[next(iter(self._bundles))]
        return known

    def _keep(self, new: ParameterSet) -> None:
        """Remember a set of parameters if it is the newest of its bundle; the lock is held."""
        known = self._bundle(new.digest)
        if new.version > known.version:
            known.newest = new
            self._changed.notify_all()

    def _settle(self, new: ParameterSet, refusal: str = "") -> None:
        """Remember that the worker has taken or refused a set; the lock is held."""
        known = self._bundle(new.digest)
        known.settled, known.refusal = new.version, refusal

    def _heard(self, heartbeat: Heartbeat) -> None:
        known = self._membership.hear(heartbeat)
        with self._changed:
            is_newer = heartbeat.version > self._bundle(heartbeat.digest).version
            self._changed.notify_all()
        if known is None:
            # The newcomer need not wait for the next one.
            self._beat_soon()
        is_name_new = known is None or known.name != heartbeat.name
        if is_name_new and heartbeat.name != (name := self._facts()["name"]):
            text = "%s serves another bundle from the same queue, %s, and this one serves %s: each takes events of the"
            _log.warning(f"{text} other. Give each bundle a queue of its own.", label(heartbeat), heartbeat.name, name)
        if is_newer:
            self._publish(ParameterQuery(heartbeat.id, heartbeat.digest))

    # -- hyperparameters ----------------------------------------------------------------------------------------------

    def set(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        """Change hyperparameters here and in all replicas; return them when this one computes with them.

        Raises
        ------
        RevisionConflict, ParametersRefused, ServiceError
            As `Service.set_parameters`; also if the broker is away: nothing is changed then.
        """
        if not self.is_shared:
            return self._parameters.set(values, revision)
        with self._setting:
            if away := self._away:
                text = f"The other replicas can't be reached, so nothing is changed: {away}"
                raise ServiceError(self._parameters.digest, text)
            # A change that is known here must not be undone by the next one: its revision is a conflict.
            self._apply_newest()
            before = self._parameters.current
            with self._changed:
                at_least = self._bundle(self._parameters.digest).version[0] + 1
            if at_least > MAX_INTEGER:
                text = f"Revision {at_least - 1} is the last one that replicas can read. Write the parameters back."
                raise ServiceError(self._parameters.digest, text)
            changed = self._parameters.set(values, revision, at_least)
            digest, current = self._parameters.snapshot()
            # Otherwise another bundle has been deployed since.
            if current is changed and changed is not before:
                self._announce(digest, changed)
            return changed

    def newest(self, digest: str) -> tuple[int, Mapping[str, Any]] | None:
        """Return revision and values that the replicas of a bundle compute with, None if none is known.

        The caller takes them over: it deploys that bundle.
        """
        with self._changed:
            found = self._bundle(digest).newest
            if found is None:
                return None
            self._settle(found)
            return found.revision, found.values

    def _is_behind(self) -> bool:
        """Whether newer parameters are to be taken over; the lock is held."""
        return self._bundle(self._parameters.digest).is_behind

    def _follow(self) -> None:
        """Have the worker take newer parameters, one set after the other."""
        while not self._is_over:
            is_tried_again = False
            try:
                with self._setting:
                    self._apply_newest()
            except ServiceError as error:
                is_tried_again = True
                _log.debug("parameters of another replica wait: %s", error)
            except Exception:
                is_tried_again = True
                _log.exception("parameters of another replica can't be taken over")
            self._look_at_joining()
            with self._changed:
                # At least each second: a deploy is not notified.
                timeout_s = _RETRY_S if is_tried_again or self.is_joining else HEARTBEAT_S
                self._changed.wait_for(self._has_ended if is_tried_again else self._is_follow_due, timeout_s)

    def _is_follow_due(self) -> bool:
        return self._is_over or self._is_behind() or (self.is_joining and self._may_join())

    def _apply_newest(self) -> None:
        """Have the worker take the newest parameters, unless it has; `_setting` is held.

        Raises
        ------
        ServiceError
            There is no worker just now, or it is busy.
        """
        with self._changed:
            known = self._bundle(self._parameters.digest)
            newest = known.newest
            if newest is None or not known.is_behind:
                return
        problems = self._parameters.follow(newest.digest, newest.revision, newest.values)
        refusal = ""
        if problems:
            why = " ".join(f"{token!r}: {problem}" for token, problem in problems.items())
            refusal = f"The worker refuses revision {newest.revision} of the other replicas. {why}"[:_MAX_TEXT]
            _log.error("%s", refusal)
        with self._changed:
            self._settle(newest, refusal)
        self._beat_soon()

    def _look_at_joining(self) -> None:
        if not self.is_joining:
            return
        with self._changed:
            if not self._may_join():
                return
            self.is_joining = False
        self._on_joined()

    def _may_join(self) -> bool:
        """Whether events need not wait for the parameters of the others; the lock is held."""
        now_s, connected_s, digest = monotonic(), self._connected_s, self._parameters.digest
        has_gathered = connected_s is not None and now_s - connected_s > _GATHERING_S
        known = self._bundle(digest)
        is_known = all(each.version <= known.version for each in self._membership.serving(digest))
        return (has_gathered and is_known and not known.is_behind) or now_s > self._join_until_s

    # -- description --------------------------------------------------------------------------------------------------

    def _heartbeat(self) -> Heartbeat:
        digest, current = self._parameters.snapshot()
        with self._changed:
            known = self._bundle(digest)
            (revision, author), refusal = known.settled, known.refusal
        about: dict[str, Any] = {
            **self._facts(),
            "id": self._id,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "digest": digest,
            "revision": current.revision,
            # If they differ, the revision is about to be announced.
            "author": author if revision == current.revision and not refusal else "",
            "trouble": refusal,
        }
        cut: dict[str, Any] = {
            key: value[:_MAX_TEXT] if isinstance(value, str) else value for key, value in about.items()
        }
        return Heartbeat(**cut)

    def others(self) -> list[str]:
        """Return names of the other replicas that take events from the queue, as far as they are known."""
        return [label(each) for each in self._membership.present() if each.state not in _TAKES_NONE]

    def describe(self) -> dict[str, Any]:
        """Return the group as this replica knows it, JSON-ready.

        Returns
        -------
        dict
            ``is_shared``: whether there is a broker; ``replicas``: how many are alive; ``ready``: how many of them are
            READY; ``counts``: sums of theirs; ``agree``: whether all serve one bundle with one revision; ``trouble``:
            why this replica does not take part, or does not compute with the newest parameters, empty if it does;
            ``rejected``: how many messages were no messages between replicas; ``members`` and ``lost``: a dict for
            each.
        """
        own, subscriber = self._heartbeat(), self._subscriber
        return {
            "is_shared": self.is_shared,
            "trouble": self._away or own.trouble,
            "rejected": self._rejected + (0 if subscriber is None else sum(subscriber.rejected.values())),
            **self._membership.describe(own),
        }
