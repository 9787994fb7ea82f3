"""Which stream and which consumer of a NATS server stand for a place, and who makes them?"""

from __future__ import annotations

import re
from typing import Any, Final

from nats.aio.client import Client
from nats.js import JetStreamContext
from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy, RetentionPolicy, StorageType, StreamConfig
from nats.js.errors import APIError, NotFoundError, ServiceUnavailableError

from epypes.errors import BrokerError, MessageError
from epypes.transport.channels.place import Place

# A receiver that has died is noticed by this: who lives says so for each message every second.
ACK_WAIT_S: Final = 5.0
_DUPLICATES_S: Final = 120.0
_FORGOTTEN_S: Final = 60.0
_SUBJECT: Final = re.compile(r"(?:[^\s.*>]+|\*)(?:\.(?:[^\s.*>]+|\*))*(?:\.>)?|>")


def check(place: Place) -> None:
    """Raise BrokerError if a place's name can't be a subject, or its group no consumer."""
    if not _SUBJECT.fullmatch(place.name):
        text = f"{place.name!r} is no subject of NATS: write words with dots between them, such as robot.events."
        raise BrokerError(str(place), text)
    if place.kind == "queue" and is_pattern(place.dead_letters.name):
        raise BrokerError(str(place), f"{place} stands for many subjects: say where dead letters go, by dead=SUBJECT.")
    if not re.fullmatch(r"[^\s.*>/\\]+", place.group):
        text = f"{place.group!r} can't be a group at {place}: it may have no spaces, dots, slashes, * and > in it."
        raise BrokerError(str(place), text)


def is_pattern(subject: str) -> bool:
    """Return whether a subject stands for many; such can be received from, and not sent to."""
    return "*" in subject or ">" in subject


def check_sending(place: Place) -> None:
    """Raise MessageError if nothing can be sent to a place."""
    if is_pattern(place.name):
        raise MessageError("many subjects", f"{place} stands for many subjects: name the one to send to.")


async def streams_of(client: Client, place: Place, timeout_s: float) -> str:
    """Return the name of the stream that keeps what is sent to a place; empty for a broadcast, which none keeps.

    Raises
    ------
    BrokerError
        There is none, for the place itself or its dead letters, and none is to be made; or the server refuses.
    """
    if place.kind == "broadcast":
        return ""
    jetstream = client.jetstream(timeout=timeout_s)
    try:
        stream = await _found(jetstream, place)
        if place.kind == "queue" and not is_for_dead_letters(place):
            await _found(jetstream, place.dead_letters)
    except ServiceUnavailableError as error:
        text = f"{place} can't keep messages: JetStream is off there. Start the server with it: nats-server -js."
        raise BrokerError(str(place), text) from error
    except APIError as error:
        raise BrokerError(str(place), f"{place} refuses: {error.description}.") from error
    return stream


def is_for_dead_letters(place: Place) -> bool:
    """Return whether a place is one for dead letters, which has none itself unless they are asked for."""
    return place.name.endswith(".dead") and not place.dead


async def _found(jetstream: JetStreamContext, place: Place) -> str:
    try:
        return str(await jetstream.find_stream_name_by_subject(place.name))
    except NotFoundError:
        if not place.create:
            text = (
                f"No stream at {place} keeps the subject {place.name!r}. Make one, or add ?create=true to the address."
            )
            raise BrokerError(str(place), text) from None
    stream = re.sub(r"[\s.*>/\\]", "_", place.name)
    config = StreamConfig(
        name=stream,
        subjects=[place.name],
        retention=RetentionPolicy.WORK_QUEUE if place.kind == "queue" else RetentionPolicy.LIMITS,
        storage=StorageType.FILE,
        duplicate_window=_DUPLICATES_S,
    )
    await jetstream.add_stream(config)
    return stream


async def consumer_of(client: Client, place: Place, stream: str, timeout_s: float) -> tuple[str, float]:
    """Return the name of the consumer that a place is received by, and how long it waits for an acknowledgement.

    Those who share a queue share one that lasts; who reads a log has one of his own, from the first message on.
    """
    jetstream = client.jetstream(timeout=timeout_s)
    try:
        if place.kind == "log":
            return str((await jetstream.add_consumer(stream, _OWN, filter_subject=place.name)).name), ACK_WAIT_S
        try:
            found = (await jetstream.consumer_info(stream, place.group)).config
        except NotFoundError:
            shared = _SHARED.evolve(durable_name=place.group, filter_subject=place.name)
            found = (await jetstream.add_consumer(stream, shared)).config
    except APIError as error:
        raise BrokerError(str(place), f"{place} can't be received from: {error.description}.") from error
    _check_shared(place, stream, found)
    return place.group, found.ack_wait or ACK_WAIT_S


def _check_shared(place: Place, stream: str, found: Any) -> None:
    """Raise BrokerError if a consumer of this name is for something else."""
    other = found.filter_subject
    if other and other != place.name:
        text = f"The consumer {place.group!r} of the stream {stream!r} is for {other}. Add &group=NAME to {place}."
    elif found.deliver_subject or found.ack_policy != AckPolicy.EXPLICIT:
        text = f"The consumer {place.group!r} of the stream {stream!r} does not wait to be asked and acknowledged to."
    else:
        return
    raise BrokerError(str(place), text)


_SHARED: Final = ConsumerConfig(
    deliver_policy=DeliverPolicy.ALL,
    ack_policy=AckPolicy.EXPLICIT,
    ack_wait=ACK_WAIT_S,
    # Who receives counts the attempts, so that the last failure is kept and not just dropped.
    max_deliver=-1,
    # Nobody asks for more than he can hold.
    max_ack_pending=-1,
)
_OWN: Final = ConsumerConfig(
    deliver_policy=DeliverPolicy.ALL,
    ack_policy=AckPolicy.NONE,
    inactive_threshold=_FORGOTTEN_S,
    mem_storage=True,
)
