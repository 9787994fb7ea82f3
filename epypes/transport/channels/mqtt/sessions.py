"""Who gets what the broker keeps for a receiver that is gone? MQTT says nobody; so receivers hand it on to each other.

A message of a shared subscription is assigned to one session as soon as it comes, whether that is connected or not,
and stays there: no other member gets it. So each receiver leaves word, a will retained at ``NAME/gone/SESSION``, and
who reads that connects as the one who is gone, sends what is kept there to the queue again, and ends the session.
"""

from __future__ import annotations

import logging
import secrets
import threading
from collections.abc import Callable
from time import monotonic
from typing import Any, Final

from epypes.errors import BrokerError, MessageError
from epypes.transport.channels.mqtt.connection import Connection
from epypes.transport.channels.mqtt.headers import headers_of
from epypes.transport.channels.place import Place

log = logging.getLogger("epypes.transport")

# All who live read of one who is gone at the same time; one will do.
_PATIENCE_MS: Final = 200
_kept: Final[dict[tuple[str, int, str, str], str]] = {}
_lost: Final[dict[tuple[str, int, str, str], list[str]]] = {}
_lock: Final = threading.Lock()


def shared(place: Place) -> str:
    """Return the topic by which several receivers share a queue."""
    return f"$share/{place.group}/{place.name}"


def notices(place: Place, session: str = "+") -> str:
    """Return the topic where it is told that a session is without a connection."""
    return f"{place.name}/gone/{session}"


def _patience_s() -> float:
    return (secrets.randbelow(_PATIENCE_MS) + 20) / 1000


def _key(place: Place) -> tuple[str, int, str, str]:
    return (place.host, place.port, place.name, place.group)


def session_of(place: Place) -> str:
    """Return the name for a receiver's session: one that this process has lost, else a new one."""
    with _lock:
        lost = _lost.get(_key(place), [])
        return lost.pop() if lost else f"epypes-{secrets.token_hex(8)}"


def keep_for_later(place: Place, session: str) -> None:
    """Take note that a connection of this process was lost: the next receiver here goes on with its session."""
    with _lock:
        _lost.setdefault(_key(place), []).append(session)


def join(place: Place, session: str, prefetch: int, timeout_s: float) -> Connection:
    """Return the connection of a receiver that shares a queue with others.

    Raises
    ------
    BrokerError
        The broker can't be reached, refuses, or knows no shared subscriptions.
    """
    connection = Connection(place, timeout_s, session=session, notice=notices(place, session), prefetch=prefetch)
    try:
        if not connection.shares:
            text = f"{place} is no queue: its broker does not let receivers share a topic. Take ?kind=broadcast."
            raise BrokerError(str(place), text)
        # Again after each restart: mosquitto 2.0 forgets shared subscriptions, and keeps the session.
        connection.subscribe(shared(place))
        connection.publish(notices(place, session), b"", {}, retain=True)
    except BaseException:
        connection.close(with_notice=True)
        raise
    return connection


def keep(place: Place, timeout_s: float) -> None:
    """Have the broker keep what comes for a queue until there is a receiver.

    Raises
    ------
    BrokerError
        The broker can't be reached, or refuses.
    """
    with _lock:
        session = _kept.setdefault(_key(place), f"epypes-{secrets.token_hex(8)}-kept")
    until_s = monotonic() + timeout_s
    while True:
        try:
            join(place, session, 1, timeout_s).close(with_notice=True)
            return
        except BrokerError:
            # An heir that had just heard of it may have taken the session over.
            if monotonic() > until_s:
                raise
        threading.Event().wait(_patience_s())


def hand_on(place: Place, session: str, timeout_s: float, is_wanted: Callable[[], bool]) -> int | None:
    """Send what is kept for a session to its queue again, and end the session.

    Parameters
    ----------
    place
        The queue.
    session
        Of a receiver that is gone.
    timeout_s
        Longest wait for the broker's word.
    is_wanted
        Asked before each message; once it is not, the rest is left to another.

    Returns
    -------
    int or None
        How many messages; None if it was not brought to its end, and is still there.
    """
    notice = notices(place, session)
    connection = Connection(place, timeout_s, session=session, notice=notice)
    count, is_done = 0, not connection.has_session
    try:
        # Whoever sees it in time need not come, too.
        connection.publish(notice, b"", {}, retain=True)
        if not is_done:
            count, is_done = _emptied(place, connection, session, timeout_s, is_wanted)
    finally:
        connection.close(with_notice=not is_done, with_session=is_done)
    return count if is_done else None


def _emptied(
    place: Place, connection: Connection, session: str, timeout_s: float, is_wanted: Callable[[], bool]
) -> tuple[int, bool]:
    end = f"{notices(place, session)}/end"
    connection.unsubscribe(shared(place))
    connection.subscribe(end)
    mark, count = secrets.token_bytes(16), 0
    # What is kept comes in order, so all of it before this.
    connection.publish(end, mark, {})
    while is_wanted():
        message = connection.next(timeout_s)
        if message is None:
            break
        if message.topic == end and message.payload == mark:
            return count, True
        if message.topic == place.name:
            if not _sent_again(place, connection, message):
                break
            count += 1
        connection.acknowledge(message)
    return count, False


def _sent_again(place: Place, connection: Connection, message: Any) -> bool:
    try:
        return connection.publish(place.name, bytes(message.payload), headers_of(message))
    except MessageError as error:
        # The broker takes less than it did before.
        log.error("a message of %s is lost: %s", place, error)
        return True


class Heirs:
    """What a receiver does for others of its queue: it looks who is gone, and hands on what was theirs.

    Parameters
    ----------
    place, session
        The queue, and the receiver's own session.
    listening
        A connection on which nothing else comes, so that notices never wait behind messages; whoever made it closes it.
    timeout_s
        Longest wait for the broker's word.
    """

    def __init__(self, place: Place, session: str, listening: Connection, timeout_s: float) -> None:
        self._place, self._session, self._timeout_s = place, session, timeout_s
        self._over = threading.Event()
        self._listening = listening
        listening.subscribe(notices(place))
        self._thread = threading.Thread(target=self._run, name=f"epypes mqtt heirs {place.host}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        gone: list[str] = []
        try:
            while not self._over.is_set():
                gone = self._heard(gone, 0.0 if gone else 1.0)
                if gone and not self._over.wait(_patience_s()):
                    # Meanwhile another may have begun.
                    gone = self._heard(gone, 0.0)
                    if gone:
                        self._inherit(gone.pop(0))
        except BrokerError:
            # The channel's own connections notice it, too.
            return

    def _heard(self, gone: list[str], timeout_s: float) -> list[str]:
        known = list(gone)
        while (message := self._listening.next(timeout_s)) is not None:
            self._listening.acknowledge(message)
            session = message.topic.rpartition("/")[2]
            if session in known:
                known.remove(session)
            if message.payload and session != self._session:
                known.append(session)
            timeout_s = 0.0
        return known

    def _inherit(self, session: str) -> None:
        try:
            count = hand_on(self._place, session, self._timeout_s, lambda: not self._over.is_set())
        except BrokerError as error:
            # Mostly another was quicker; if not, the broker tells it again.
            log.info("what %s keeps for a receiver that is gone could not be handed on: %s", self._place, error)
            return
        if count:
            log.info("%d messages of %s that a receiver had which is gone were sent again", count, self._place)

    def close(self) -> None:
        """End it, once the connection is closed; what is being handed on is left to another."""
        self._over.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(2.0)
