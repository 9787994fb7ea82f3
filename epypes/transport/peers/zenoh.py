"""Zenoh: messages from peer to peer, or through routers, by eclipse-zenoh as it comes.

``zenoh://127.0.0.1/KEY`` is for the peers of this machine. Each session listens on a free port. One of them opens a
second session, which listens on `_MEETING_PORT`: all connect to that one, learn from it where the rest are, and connect
to these. When it ends, another session takes the port. Nothing is sent by multicast, and nothing listens beyond this
machine.
``zenoh://HOST:PORT/KEY`` connects to a router. On this machine, peers then also find each other through it, and go on
without it; anywhere else, with a user or encrypted, all goes through the router.

Joining: a publisher declares a queryable and a liveliness token, ``@epypes/NUMBER/KEY``. A subscriber that sees the
token queries it: the answer comes after the publisher knows of the subscription. A token that has gone is a publisher
that has gone. Those of ROS 2 answer no query: there, a token is enough.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any, Final

import zenoh
from zenoh.handlers import Callback

from epypes.errors import AddressError, BrokerError, MessageError
from epypes.transport.address import Address
from epypes.transport.channel import ChannelOptions, Frames
from epypes.transport.peers.channel import PeerChannel, PeerSession
from epypes.transport.peers.zenoh_topics import topic_of, why

# Where the peers of this machine meet, if the address names no port, and where routers listen.
_MEETING_PORT: Final = 7446
_ROUTER_PORT: Final = 7447
# The most batches of 64 kB that Zenoh lets wait for a slow subscriber; its default is 2.
_MOST_BATCHES: Final = 16
# How long a message waits for room there before it is dropped; Zenoh's default is 1 ms, which a busy machine loses
# messages by. The next ones are dropped at once, until there is room: so a stuck subscriber costs this time once.
_ROOM_US: Final = 1_000_000
# A message up to so many times the limit arrives and is counted as rejected; Zenoh drops a larger one.
_RECEIVED_OVER_LIMIT: Final = 2
# How often a session tries to take the port where peers meet, which takes 0.4 ms of CPU while another one has it.
_TAKES_PORT_S: Final = 0.5
# While nothing is reached.
_RETRY: Final = {"period_init_ms": 100, "period_max_ms": 2_000, "period_increase_factor": 2}
_FOR_EVER_MS: Final = -1
_CALLBACK_ENDS_S: Final = 0.5
# The first peer waits so long for others.
_SCOUTING_MS: Final = 50

# The process whose threads run Zenoh. They are missing in a forked child, where each call would wait for ever.
_process = 0
_lock: Final = threading.Lock()


class ZenohSession(PeerSession):
    """One session of Zenoh, with a publisher or a subscriber."""

    def __init__(self, address: Address, options: ChannelOptions) -> None:
        super().__init__(address, options)
        self._topic = topic_of(address, options)
        self._session: Any = None
        self._publisher: Any = None
        # What `close` undeclares.
        self._declared: list[Any] = []
        # The publishers by their tokens: those that are there, and those of them that have answered.
        self._tokens: set[str] = set()
        self._joined: set[str] = set()
        self._routers: set[str] = set()
        self._changed = threading.Lock()
        # Keeps the port where peers meet, until the session closes.
        self._keeper: threading.Thread | None = None
        self._closing = threading.Event()
        # How many threads Zenoh has started for callbacks, and those that end.
        self._callbacks, self._ended = 0, queue.SimpleQueue[threading.Thread]()

    def open(self, is_receiver: bool) -> None:
        """Open a session, and declare what receives or sends; see `PeerSession.open`."""
        address = self.address
        if not is_receiver and "*" in self._topic.key:
            text = f"{address} can't be sent to: its key stands for several, for its wildcard. Write one key."
            raise AddressError(str(address), text)
        _check_process(address)
        if not _has_router(address):
            name = f"epypes peer {address.name}"
            self._keeper = threading.Thread(target=self._keep_meeting_point, name=name, daemon=True)
            self._keeper.start()
        try:
            session = self._session = zenoh.open(_config(address, self.options))
            if is_receiver:
                self._declare_receiving(session)
            else:
                self._declare_sending(session)
            if _has_router(address):
                listener = session.info.declare_transport_events_listener(
                    self._called(self._on_transport), history=True
                )
                self._declared.append(listener)
        except zenoh.ZError as error:
            raise _unreachable(address, error) from error

    def _declare_receiving(self, session: Any) -> None:
        topic, liveliness = self._topic, session.liveliness()
        self._declared.append(session.declare_subscriber(topic.keys, self._called(self._on_sample)))
        self._declared += map(liveliness.declare_token, topic.subscriber_tokens(session))
        self._declared.append(liveliness.declare_subscriber(topic.tokens, self._called(self._on_token), history=True))

    def _declare_sending(self, session: Any) -> None:
        topic, options = self._topic, self.address.options
        self._publisher = session.declare_publisher(
            topic.key,
            congestion_control=getattr(zenoh.CongestionControl, options.get("congestion", "drop").upper()),
            priority=getattr(zenoh.Priority, options.get("priority", "data").upper()),
        )
        self._declared.append(self._publisher.declare_matching_listener(self._called(self._on_matching)))
        self._on_matching()
        for token in topic.publisher_tokens(session):
            if topic.answers:
                self._declared.append(session.declare_queryable(token, self._called(_answer)))
            self._declared.append(session.liveliness().declare_token(token))
        self._declared.append(self._publisher)

    def _keep_meeting_point(self) -> None:
        """Listen where the peers of this machine meet, as soon as no other session does.

        Zenoh could try again by itself, but waits for that without end when the session closes.
        """
        endpoints = [_endpoint(self.address, _MEETING_PORT)]
        listen = {"endpoints": endpoints, "timeout_ms": 0, "exit_on_failure": True}
        while not self._closing.is_set():
            with contextlib.suppress(zenoh.ZError), zenoh.open(_made({"mode": "peer", "listen": listen})):
                self._closing.wait()
            self._closing.wait(_TAKES_PORT_S)

    def send(self, frames: Frames, id: str, headers: Mapping[str, str]) -> None:  # noqa: A002
        """Put a message; see `PeerSession.send`."""
        payload, attachment = self._topic.pack(frames, id, headers)
        try:
            self._publisher.put(payload, attachment=attachment)
        except zenoh.ZError as error:
            text = f"A message to {self.address} was not sent: {why(error)}."
            raise BrokerError(str(self.address), text) from error

    def close(self, timeout_s: float) -> None:
        """Close the session; Zenoh sends first what it has taken. See `PeerSession.close`."""
        self._closing.set()
        # First: a session of Zenoh may connect to peers again while it closes; what it has declared stays with them.
        for declared in self._declared:
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()
        if self._session is not None:
            self._session.close()
        if self._keeper is not None:
            self._keeper.join()
        # Freed here, and not by the garbage collector of a forked child, where Zenoh would wait for its threads.
        self._declared.clear()
        # A thread of a callback that is left when the interpreter ends would abort the process.
        with contextlib.suppress(queue.Empty):
            for _ in range(self._callbacks):
                self._ended.get(timeout=_CALLBACK_ENDS_S).join(_CALLBACK_ENDS_S)

    def _called(self, function: Callable[[Any], object], at_end: Callable[[], object] = lambda: None) -> Any:
        """Return a callback of Zenoh that `close` waits for; each has a thread, and calls ``at_end`` at its end."""

        def end() -> None:
            at_end()
            self._ended.put(threading.current_thread())

        with self._changed:
            self._callbacks += 1
            self._forget_ended()
        return Callback(function, end)

    def _forget_ended(self) -> None:
        """Let go of the threads that have ended: a subscriber has one for each publisher that it has ever seen."""
        # `close` may take some, too.
        with contextlib.suppress(queue.Empty):
            for _ in range(self._ended.qsize()):
                thread = self._ended.get_nowait()
                if thread.is_alive():
                    self._ended.put(thread)
                else:
                    self._callbacks -= 1

    # --- the threads of Zenoh's callbacks, one for each: those that read must never wait for Python's lock, since they
    # hold Zenoh's, which an object of Zenoh's that ends in Python waits for ---

    def _on_sample(self, sample: zenoh.Sample) -> None:
        size, limit = len(sample.payload), self.options.max_message_bytes
        if size > limit:
            # Before it is copied into Python.
            self.channel.reject("too large", f"A message of {size:,} bytes; the limit is {limit:,}.")
            return
        if sample.kind == zenoh.SampleKind.DELETE:
            self.channel.reject("no message", "The key was deleted, which is no message.")
            return
        try:
            self.channel.deliver(*self._topic.unpack(sample.payload.to_bytes(), sample.attachment))
        except MessageError as error:
            self.channel.reject(error.reason, str(error))

    def _on_matching(self, _: object = None) -> None:
        # Read here, so that the newest status counts, whichever thread comes last.
        with self._changed:
            self.channel.subscriptions.set_count(int(self._publisher.matching_status.matching))

    def _on_token(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        with self._changed:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._tokens.discard(token)
                self._joined.discard(token)
                self.channel.publishers.set_count(len(self._joined))
                return
            self._tokens.add(token)
        if not self._topic.answers:
            self._on_answered(token)
        else:
            # Its end counts, with an answer or without: in between the publisher may have gone.
            answered = self._called(lambda reply: None, lambda: self._on_answered(token))
            # It is closed by now.
            with contextlib.suppress(zenoh.ZError):
                self._session.get(token, answered)

    def _on_answered(self, token: str) -> None:
        with self._changed:
            if token in self._tokens:
                self._joined.add(token)
                self.channel.publishers.set_count(len(self._joined))

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        transport = event.transport
        if transport.whatami != zenoh.WhatAmI.ROUTER:
            return
        change = self._routers.discard if event.kind == zenoh.SampleKind.DELETE else self._routers.add
        with self._changed:
            change(str(transport.zid))
            self.channel.report_connection("" if self._routers else "the connection to the router was lost")


def _answer(query: zenoh.Query) -> None:
    query.reply(query.key_expr, b"")


def _check_process(address: Address) -> None:
    global _process
    with _lock:
        _process = _process or os.getpid()
    if _process != os.getpid():
        text = (
            f"{address} can't be opened: this process was forked from one that uses Zenoh, whose threads it does not "
            'have. Start it anew, as multiprocessing.get_context("spawn") does.'
        )
        raise BrokerError(str(address), text)


def _has_router(address: Address) -> bool:
    return bool(address.port or address.user or address.ca) or not address.is_on_this_machine


def _endpoint(address: Address, port: int) -> str:
    host = f"[{address.host}]" if ":" in address.host else address.host
    return f"{'tls' if address.ca else 'tcp'}/{host}:{port}"


def _config(address: Address, options: ChannelOptions) -> zenoh.Config:
    is_peer = address.is_on_this_machine and not (address.user or address.ca)
    connect: dict[str, Any] = {"timeout_ms": 0, "exit_on_failure": True, "retry": _RETRY}
    if not _has_router(address):
        connect |= {"timeout_ms": _FOR_EVER_MS, "exit_on_failure": False}
    port = address.port or (_ROUTER_PORT if _has_router(address) else _MEETING_PORT)
    settings: dict[str, Any] = {
        "mode": "peer" if is_peer else "client",
        "scouting/delay": _SCOUTING_MS,
        "connect": {"endpoints": [_endpoint(address, port)], **connect},
        "listen/endpoints": [_endpoint(address, 0)] if is_peer else [],
        "transport/unicast/open_timeout": int(options.timeout_s * 1000),
        "transport/link/rx/max_message_size": _RECEIVED_OVER_LIMIT * options.max_message_bytes,
        f"transport/link/tx/queue/size/{address.options.get('priority', 'data')}": _MOST_BATCHES,
        "transport/link/tx/queue/congestion_control/drop": {
            "wait_before_drop": _ROOM_US,
            "max_wait_before_drop_fragments": _ROOM_US,
        },
    }
    if address.user:
        settings["transport/auth/usrpwd"] = {"user": address.user, "password": address.password}
    if address.ca:
        settings["transport/link/tls/root_ca_certificate"] = address.ca
    return _made(settings)


def _made(settings: Mapping[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for name, value in {"scouting/multicast/enabled": False, **settings}.items():
        config.insert_json5(name, json.dumps(value))
    return config


def _unreachable(address: Address, error: zenoh.ZError) -> BrokerError:
    if not _has_router(address):
        return BrokerError(str(address), f"{address} can't be opened: {why(error)}.")
    hint = f" {address.refused_way_out}" if address.user else ""
    return BrokerError(
        str(address), f"{address} can't be reached: {why(error)}. Is a Zenoh router running there?{hint}"
    )


def make_channel(address: Address, options: ChannelOptions) -> PeerChannel:
    """Return a channel of an address of Zenoh."""
    return PeerChannel(ZenohSession(address, options), options)
