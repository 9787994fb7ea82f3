"""How does somebody use MQTT 5 with paho-mqtt alone: a shared subscription, answers confirmed, then the event too?"""

from __future__ import annotations

import queue
import socket
import threading
import uuid
from collections.abc import Callable
from typing import Any

import numpy as np
from paho.mqtt.client import Client, MQTTMessage, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from tests.benchmarks.brokers.parties import DEADLINE_S, GROUP, PREFETCH, Meeting, keep_busy

_AT_LEAST_ONCE = 1


class _Connection:
    """A client whose messages wait in a queue, since its thread must not wait for confirmations."""

    def __init__(self, meeting: Meeting, topic: str = "") -> None:
        self._topic, self._is_ready = topic, threading.Event()
        self.arrived: queue.SimpleQueue[MQTTMessage] = queue.SimpleQueue()
        self.client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5, manual_ack=True)
        self.client.username_pw_set(meeting.user, meeting.password)
        self.client.on_connect, self.client.on_subscribe = self._subscribe, self._begin
        self.client.on_message = lambda client, data, message: self.arrived.put(message)
        self.client.on_socket_open = _without_delay
        connecting = Properties(PacketTypes.CONNECT)
        connecting.ReceiveMaximum = PREFETCH
        self.client.connect("127.0.0.1", meeting.port, properties=connecting)
        self.client.loop_start()
        if not self._is_ready.wait(DEADLINE_S):
            raise TimeoutError("The broker does not answer.")

    def _subscribe(self, client: Client, *_: Any) -> None:
        if self._topic:
            client.subscribe(f"$share/{GROUP}/{self._topic}", _AT_LEAST_ONCE)
        else:
            self._is_ready.set()

    def _begin(self, *_: Any) -> None:
        self._is_ready.set()

    def send(self, topic: str, body: bytes, message_id: str) -> None:
        # MQTT has no place for it, and brokers tell no duplicates: whoever receives must.
        told = Properties(PacketTypes.PUBLISH)
        told.UserProperty = ("id", message_id)
        self.client.publish(topic, body, _AT_LEAST_ONCE, properties=told).wait_for_publish(DEADLINE_S)

    def receive(self) -> MQTTMessage:
        return self.arrived.get(timeout=DEADLINE_S)

    def ack(self, message: MQTTMessage) -> None:
        self.client.ack(message.mid, message.qos)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


def _without_delay(client: Client, data: Any, opened: Any) -> None:
    # Without it, Nagle's algorithm and delayed acknowledgements make it 40 ms now and then.
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def prepare(meeting: Meeting) -> None:
    """There is nothing to make: a topic is there when somebody subscribes to it."""


def serve(meeting: Meeting, ready: Callable[[], object]) -> None:
    """Answer every event with what came."""
    connection = _Connection(meeting, meeting.events)
    ready()
    while True:
        try:
            message = connection.receive()
        except queue.Empty:
            continue
        ((_, message_id),) = message.properties.UserProperty
        connection.send(meeting.answers, message.payload, message_id)
        connection.ack(message)


class Asker:
    """Who asks: a connection that takes answers, and one for each thread that sends."""

    def __init__(self, meeting: Meeting, senders: int) -> None:
        self._events = meeting.events
        self._receiver = _Connection(meeting, meeting.answers)
        self._senders = [_Connection(meeting) for _ in range(senders)]

    def _receive(self) -> bytes:
        message = self._receiver.receive()
        self._receiver.ack(message)
        return message.payload

    def ask(self, image: np.ndarray) -> np.ndarray:
        self._senders[0].send(self._events, image.tobytes(), str(uuid.uuid4()))
        return np.frombuffer(self._receive(), image.dtype).reshape(image.shape)

    def ask_many(self, image: np.ndarray, count: int) -> None:
        def sending(connection: _Connection) -> Callable[[], object]:
            return lambda: connection.send(self._events, image.tobytes(), str(uuid.uuid4()))

        keep_busy([sending(connection) for connection in self._senders], self._receive, count)

    def close(self) -> None:
        for connection in (*self._senders, self._receiver):
            connection.close()
