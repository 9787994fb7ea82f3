"""DDS: Cyclone DDS as it comes, with EPypes' messages or those of ROS 2.

A channel has a reader or a writer of one topic; all channels of a process in one domain share its participant.

Joining: a reader may know a writer that does not know it yet, and whose messages it would miss. So a writer lists the
keys of its readers in its own discovery data, as USER_DATA, and a reader counts the writers that list it. Those of
other programs list none: they count when they match.

No listener is used: Cyclone would call it on its own threads, under its own locks, and it would wait there for Python's
lock, which cyclonedds holds while it writes. One thread per channel waits for data and statuses and reads both.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import uuid
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import DDSException, DDSStatus, GuardCondition, WaitSet
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from epypes.errors import AddressError, BrokerError, MessageError
from epypes.transport.address import Address
from epypes.transport.channel import ChannelOptions, Frames
from epypes.transport.peers.channel import PeerChannel, PeerSession
from epypes.transport.peers.dds_domain import check_topic, describe, domain_of, domains, qos_of
from epypes.transport.peers.dds_messages import codec_of

if TYPE_CHECKING:
    from cyclonedds.builtin import DcpsEndpoint

log = logging.getLogger("epypes.transport")

# Samples that are taken at once.
_BATCH: Final = 8
# What the id, the headers and the sizes of the frames take at most.
_MOST_HEADER_BYTES: Final = 1024**2
_READER_STATUSES: Final = (
    DDSStatus.DataAvailable
    | DDSStatus.SubscriptionMatched
    | DDSStatus.LivelinessChanged
    | DDSStatus.RequestedDeadlineMissed
    | DDSStatus.RequestedIncompatibleQos
)
# How USER_DATA begins that lists the readers of a writer, and the bytes of each key.
_READERS: Final = b"epypes"
_KEY_BYTES: Final = 16
_WRITER_STATUSES: Final = DDSStatus.PublicationMatched | DDSStatus.OfferedIncompatibleQos
# By the number that DDS gives them: what an address says of a policy.
_POLICIES: Final[Mapping[int, tuple[str, Any]]] = {
    2: ("durability", Policy.Durability),
    4: ("deadline", Policy.Deadline),
    8: ("lease", Policy.Liveliness),
    11: ("reliability", Policy.Reliability),
}


class DDSSession(PeerSession):
    """A reader or a writer of one topic."""

    def __init__(self, address: Address, options: ChannelOptions) -> None:
        super().__init__(address, options)
        self._number = domain_of(address)
        check_topic(address)
        self._codec, self._sample_type = codec_of(address, options)
        self._type_name = ""
        self._qos: Any = None
        self._reader: Any = None
        self._writer: Any = None
        # What tells about the writers or readers that there are, and those of this topic by their key.
        self._discovery: Any = None
        self._others: dict[uuid.UUID, DcpsEndpoint] = {}
        self._waitset: Any = None
        self._stop: Any = None
        self._thread: threading.Thread | None = None

    def open(self, is_receiver: bool) -> None:
        """Make the reader or the writer, and begin to watch it."""
        address = self.address
        qos = self._qos = qos_of(address, is_receiver)
        participant = domains.join(self, self._number)
        try:
            topic = Topic(participant, address.name, self._sample_type)
        except DDSException as error:
            why = "write its name with letters, digits, _ and /"
            if error.code != DDSException.DDS_RETCODE_BAD_PARAMETER:
                why = f"is it of another type in this process? {error}"
            raise AddressError(str(address), f"{address} is no topic of DDS: {why}.") from error
        self._type_name = topic.typename
        if is_receiver:
            watched = self._reader = DataReader(participant, topic, qos)
            watched.set_status_mask(_READER_STATUSES)
        else:
            watched = self._writer = DataWriter(participant, topic, Qos(Policy.Userdata(_READERS), base=qos))
            watched.set_status_mask(_WRITER_STATUSES)
        others = BuiltinTopicDcpsPublication if is_receiver else BuiltinTopicDcpsSubscription
        self._discovery, self._stop = BuiltinDataReader(participant, others), GuardCondition(participant)
        self._discovery.set_status_mask(DDSStatus.DataAvailable)
        self._waitset = WaitSet(participant)
        for entity in (watched, self._discovery, self._stop):
            self._waitset.attach(entity)
        self._thread = threading.Thread(target=self._watch, name=f"epypes peer {address.name}", daemon=True)
        self._thread.start()

    def send(self, frames: Frames, id: str, headers: Mapping[str, str]) -> None:  # noqa: A002
        """Write a message; Cyclone has copied it when this returns."""
        cdr, writer = self._codec.pack(frames, id, headers), self._writer
        if writer is None:
            raise BrokerError(str(self.address), f"A message to {self.address} was not sent: the channel is closed.")
        try:
            writer.write(self._sample_type(cdr))
        except DDSException as error:
            text = f"A message to {self.address} was not sent: {error}."
            raise BrokerError(str(self.address), text) from error

    def close(self, timeout_s: float) -> None:
        """Wait until the readers have acknowledged what was written, and delete everything."""
        if self._thread is not None:
            if self._writer is not None:
                # At the time-out it looks for a name that `Exception` does not have, and raises AttributeError.
                with contextlib.suppress(DDSException, AttributeError):
                    self._writer.wait_for_acks(duration(seconds=timeout_s))
            self._stop.set(True)
            self._thread.join()
        self._reader = self._writer = self._discovery = self._stop = self._waitset = None
        domains.leave(self)

    # --- the thread that watches ---

    def _watch(self) -> None:
        while not self._stop.read():
            try:
                self._look()
            except Exception:
                log.exception("%s: what came could not be read", self.address)
            self._waitset.wait(duration(infinite=True))

    def _look(self) -> None:
        """Read what has changed: other endpoints, statuses, and data."""
        watched, channel = self._reader or self._writer, self.channel
        statuses = watched.take_status()
        is_discovered = self._read_discovery()
        if statuses & DDSStatus.RequestedIncompatibleQos:
            self._warn_of_policy(watched.get_requested_incompatible_qos_status().last_policy_id)
        if statuses & DDSStatus.OfferedIncompatibleQos:
            self._warn_of_policy(watched.get_offered_incompatible_qos_status().last_policy_id)
        if statuses & DDSStatus.PublicationMatched:
            self._list_readers()
        if statuses & DDSStatus.SubscriptionMatched or (is_discovered and self._reader is not None):
            channel.publishers.set_count(self._writers_that_know())
        if statuses & DDSStatus.LivelinessChanged:
            channel.publishers.set_stale(watched.get_liveliness_changed_status().alive_count == 0)
        if statuses & DDSStatus.RequestedDeadlineMissed:
            channel.publishers.set_stale(True)
        # Those of a writer that is faster never end.
        while self._reader is not None and not self._stop.read() and (samples := self._reader.take(_BATCH)):
            for sample in samples:
                # Another sample is only the news that a writer has gone.
                if isinstance(sample, self._sample_type):
                    self._deliver(sample.cdr)

    def _deliver(self, cdr: bytes) -> None:
        most = self.options.max_message_bytes + _MOST_HEADER_BYTES
        if len(cdr) > most:
            self.channel.reject("too large", f"A message of {len(cdr):,} bytes; the limit is {most:,}.")
            return
        try:
            frames, known_as, headers = self._codec.unpack(cdr)
        except MessageError as error:
            self.channel.reject(error.reason, str(error))
        except Exception as error:
            # Whatever the bytes are, the next message is read.
            self.channel.reject("bad cdr", f"The message can't be read: {error}")
        else:
            self.channel.deliver(frames, known_as, headers)

    def _list_readers(self) -> None:
        """Count the readers that match the writer, and have it list them."""
        handles = self._writer.get_matched_subscriptions()
        found = filter(None, map(self._writer.get_matched_subscription_data, handles))
        self._writer.set_qos(Qos(Policy.Userdata(b"".join([_READERS, *(reader.key.bytes for reader in found)]))))
        self.channel.subscriptions.set_count(len(handles))

    def _writers_that_know(self) -> int:
        """Return how many writers match the reader and list it, or list none."""
        found = map(self._reader.get_matched_publication_data, self._reader.get_matched_publications())
        writers = [self._others[writer.key] for writer in found if writer is not None and writer.key in self._others]
        return sum(_lists(writer.qos, self._reader.guid.bytes) for writer in writers)

    def _read_discovery(self) -> bool:
        """Take what has changed about other endpoints; return whether one of this topic has."""
        is_changed = False
        while found := self._discovery.take(_BATCH):
            for other in found:
                if not other.sample_info.valid_data:
                    is_changed |= self._others.pop(other.key, None) is not None
                elif other.topic_name == self.address.name:
                    is_changed, self._others[other.key] = True, other
                    if other.type_name != self._type_name:
                        text = "%s: a peer has this topic with the type %s; here it is %s, so the two don't match."
                        log.warning(text, self.address, other.type_name, self._type_name)
        return is_changed

    def _warn_of_policy(self, number: int) -> None:
        """Warn of the policy by which a peer does not match."""
        option, policy = _POLICIES.get(number, ("", None))
        if policy is None:
            log.warning("%s: a peer does not match, by policy %d of DDS.", self.address, number)
            return
        ours = describe(self._qos[policy]) if policy in self._qos else "none"
        found = {describe(other.qos[policy]) for other in self._others.values() if policy in other.qos} - {ours}
        theirs = " or ".join(sorted(found)) or "another one"
        offers, asks = (theirs, ours) if self._reader is not None else (ours, theirs)
        text = "%s does not match a peer: the publisher offers %s %s, the subscriber asks for %s. Give both the same."
        log.warning(text, self.address, option, offers, asks)


def _lists(qos: Any, key: bytes) -> bool:
    """Whether a writer lists the reader of this key; one of another program lists none."""
    listed = qos[Policy.Userdata].data if Policy.Userdata in qos else b""
    keys = (listed[start : start + _KEY_BYTES] for start in range(len(_READERS), len(listed), _KEY_BYTES))
    return not listed.startswith(_READERS) or key in keys


def make_channel(address: Address, options: ChannelOptions) -> PeerChannel:
    """Return a channel to a topic of DDS."""
    return PeerChannel(DDSSession(address, options), options)
