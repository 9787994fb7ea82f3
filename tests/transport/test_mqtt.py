"""What does MQTT 5 promise, what do we add, and what is lost? Tried with a real mosquitto."""

from __future__ import annotations

import logging
import signal
from time import monotonic
from uuid import uuid4

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from epypes.errors import BrokerError, MessageError
from epypes.transport.channels import open_channel, place_of
from epypes.transport.channels.mqtt.connection import Connection
from epypes.transport.channels.mqtt.sessions import join, keep_for_later, notices
from tests.brokers import mosquitto as servers
from tests.transport.peers import line_of, process, wait_until

pytestmark = pytest.mark.slow

WAIT_S = 60.0

# Receives until it has COUNT, acknowledges none, prints how many it has, and waits.
HOLDER = """
import sys
from epypes.transport.channels import open_channel
channel = open_channel(sys.argv[1], prefetch=int(sys.argv[2]))
held = []
print("joined" if channel.receive(0.0) is None else "", flush=True)
while len(held) < int(sys.argv[2]):
    received = channel.receive(1.0)
    if received is not None:
        held.append(received)
print("holds", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def opened():
    """Opens channels, and closes them."""
    made = []

    def make(address, **options):
        made.append(open_channel(address, **{"timeout_s": WAIT_S, **options}))
        return made[-1]

    yield make
    for channel in made:
        channel.close()


@pytest.fixture
def name():
    return f"test-{uuid4().hex[:12]}"


@pytest.fixture
def queue(mosquitto, name):
    return mosquitto.address(name, create=True)


@pytest.fixture
def foreign(mosquitto):
    """Sends as a program without EPypes does, in the words of MQTT 3.1.1 or of 5."""
    made = []

    def make(protocol=paho.MQTTv311):
        client = paho.Client(CallbackAPIVersion.VERSION2, protocol=protocol)
        client.username_pw_set(mosquitto.user, mosquitto.password)
        client.connect(mosquitto.host, mosquitto.port)
        client.loop_start()
        made.append(client)
        wait_until(client.is_connected, WAIT_S)
        return client

    yield make
    for client in made:
        client.disconnect()
        client.loop_stop()


def next_of(channel):
    received = channel.receive(WAIT_S)
    assert received is not None, "nothing has come"
    return received


def taken(channels, ids, timeout_s=2 * WAIT_S):
    """Take from several channels until all ids have come; return how often each did."""
    came, end_s = {}, monotonic() + timeout_s
    while set(ids) - came.keys() and monotonic() < end_s:
        for channel in channels:
            received = channel.receive(0.02)
            if received is not None:
                came[received.id] = came.get(received.id, 0) + 1
                received.ack()
    assert set(ids) - came.keys() == set()
    return came


def body(received):
    return b"|".join(bytes(frame) for frame in received.frames)


def test_a_message_of_another_program_is_one_frame(opened, mosquitto, name, foreign):
    queue = mosquitto.address(name)
    receiver = opened(queue)
    assert receiver.receive(0.0) is None
    sensor = foreign()
    for qos in (0, 1, 2):
        sensor.publish(name, b"21.5 C", qos=qos)
        received = next_of(receiver)
        assert (body(received), received.id, dict(received.headers), received.attempt) == (b"21.5 C", "", {}, 0)
        received.ack()
    sensor.publish(name, b"", qos=0)
    next_of(receiver).reject("it is empty")
    assert next_of(opened(place_of(queue).dead_letters)).headers["epypes-reason"] == "it is empty"
    assert receiver.receive(0.0) is None


def test_a_message_whose_frames_are_not_told_right_is_put_aside_whole(opened, queue, name, foreign):
    receiver = opened(queue)
    assert receiver.receive(0.0) is None
    told = Properties(PacketTypes.PUBLISH)
    told.UserProperty = [("epypes-frames", "3,4"), ("from", "a sensor")]
    foreign(paho.MQTTv5).publish(name, b"21.5 C", qos=1, properties=told)
    received = next_of(receiver)
    assert received.frames == ()
    assert "epypes-frames" in received.headers["epypes-error"]
    received.reject("it is no message")
    dead = opened(place_of(queue).dead_letters)
    letter = next_of(dead)
    assert letter.headers["from"] == "a sensor"
    assert letter.headers["epypes-reason"] == "it is no message"


def test_who_listens_to_a_log_gets_the_newest_and_then_all_that_come(mosquitto, opened, name):
    address = mosquitto.address(name, kind="log")
    sender = opened(address)
    for number in range(3):
        sender.send([b"%d" % number])
    listeners = [opened(address), opened(address)]
    assert [body(next_of(listener)) for listener in listeners] == [b"2", b"2"]
    for number in range(3, 6):
        sender.send([b"%d" % number])
    for listener in listeners:
        assert [body(next_of(listener)) for _ in range(3)] == [b"3", b"4", b"5"]


def test_topics_with_signs_for_many_can_be_listened_to_and_are_no_queues(mosquitto, opened, name):
    listener = opened(mosquitto.address(f"{name}/+", kind="broadcast"))
    assert listener.receive(0.0) is None
    opened(mosquitto.address(f"{name}/cam1", kind="broadcast")).send([b"a"])
    assert body(next_of(listener)) == b"a"
    with pytest.raises(BrokerError, match="one topic"):
        open_channel(mosquitto.address(f"{name}/+"))


def test_what_a_killed_receiver_had_is_handed_on_to_those_who_live(opened, queue):
    sender, living = opened(queue), [opened(queue, prefetch=4), opened(queue, prefetch=4)]
    for receiver in living:
        assert receiver.receive(0.0) is None
    with process(HOLDER, queue, "4") as holder:
        assert line_of(holder) == "joined"
        ids = [str(number) for number in range(60)]
        for number in ids:
            sender.send([b"a", b""], id=number)
        assert line_of(holder) == "holds"
        holder.send_signal(signal.SIGKILL)
        taken(living, ids)


def test_what_is_kept_for_a_killed_receiver_waits_for_the_next(opened, queue, name, foreign):
    with process(HOLDER, queue, "2") as holder:
        assert line_of(holder) == "joined"
        sender = opened(queue)
        for number in range(20):
            sender.send([b"a"], id=str(number))
        assert line_of(holder) == "holds"
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    sender.send([b"a"], id="20")
    receiver = opened(queue)
    assert taken([receiver], [str(number) for number in range(21)])["20"] == 1
    # Nothing is left of who is gone.
    heard, client = [], foreign()
    client.on_message = lambda _client, _data, message: heard.append((message.topic, message.payload))
    client.subscribe(f"{name}/gone/+", qos=1)
    client.subscribe(f"{name}/mark", qos=1)
    client.publish(f"{name}/mark", b"", qos=1)
    wait_until(lambda: (f"{name}/mark", b"") in heard, WAIT_S)
    assert heard == [(f"{name}/mark", b"")]


def test_a_receiver_that_lost_its_broker_goes_on_with_what_was_its(name):
    with servers.server() as server:
        address = server.address(name, create=True)
        sender, receiver = open_channel(address), open_channel(address, prefetch=5)
        assert receiver.receive(0.0) is None
        ids = [str(number) for number in range(20)]
        for number in ids:
            sender.send([b"a"], id=number)
        held = [next_of(receiver) for _ in range(5)]
        server.stop()
        server.start()
        for channel in (sender, receiver):
            with pytest.raises(BrokerError):
                channel.receive(WAIT_S)
            channel.close()
        held[0].ack()
        receiver = open_channel(address)
        # One may just have been handed on by the session that kept it before there was a receiver.
        assert sum(taken([receiver], ids).values()) <= len(ids) + 1
        receiver.close()


def test_after_a_restart_of_the_broker_a_sender_is_told_that_nobody_is_there(name):
    with servers.server() as server:
        address = server.address(name)
        receiver = open_channel(address)
        assert receiver.receive(0.0) is None
        server.stop()
        server.start()
        receiver.close()
        # mosquitto 2.0 has forgotten who shared the topic: what it would lose is refused.
        sender = open_channel(address)
        with pytest.raises(BrokerError, match="nobody is subscribed"):
            sender.send([b"a"])
        sender.close()
        keeping = open_channel(f"{address}?create=true")
        keeping.send([b"a"], id="kept")
        receiver = open_channel(address)
        taken([receiver], ["kept"])
        for channel in (keeping, receiver):
            channel.close()


def test_what_the_broker_refuses_for_its_size_is_told_before_it_is_sent(name):
    with servers.server(settings={"max_packet_size": 4_000}) as server:
        address = server.address(name, create=True)
        sender, receiver = open_channel(address), open_channel(address)
        with pytest.raises(MessageError) as caught:
            sender.send([bytes(4_000)])
        assert caught.value.reason == "too large"
        assert "4,000" in str(caught.value)
        sender.send([bytes(2_800)], id="x")
        # Whatever can be sent can be put aside, with as long a reason as you like.
        next_of(receiver).reject("ü" * 10_000)
        dead = open_channel(place_of(address).dead_letters)
        assert len(body(next_of(dead))) == 2_800
        for channel in (sender, receiver, dead):
            channel.close()


def test_a_header_that_mqtt_has_no_way_to_say_is_an_error(opened, queue):
    sender = opened(queue)
    for headers in ({"k": "a\0b"}, {"k": "a" * 70_000}):
        with pytest.raises(MessageError, match="header"):
            sender.send([b"a"], headers=headers)
    sender.send([b"b"])
    assert body(next_of(opened(queue))) == b"b"


def test_an_encrypted_broker_is_checked_by_its_certificate(certificates, name, tmp_path):
    with servers.server(tls=(certificates / "cert.pem", certificates / "key.pem")) as server:
        address = server.address(name, create=True, ca=certificates / "ca.pem")
        sender, receiver = open_channel(address), open_channel(address)
        sender.send([b"secret"])
        assert body(next_of(receiver)) == b"secret"
        for channel in (sender, receiver):
            channel.close()
        with pytest.raises(BrokerError, match="certificate"):
            open_channel(server.address(name))
        with pytest.raises(BrokerError, match="nowhere"):
            open_channel(server.address(name, ca=tmp_path / "nowhere"))
        with pytest.raises(BrokerError):
            open_channel(server.address(name).replace("mqtts:", "mqtt:"), timeout_s=2.0)


def test_an_address_elsewhere_without_encryption_is_warned_of_once(caplog):
    with caplog.at_level(logging.WARNING, "epypes.transport"):
        for _ in range(2):
            with pytest.raises(BrokerError):
                open_channel("mqtt://robot:secret@192.0.2.1/events", timeout_s=0.2)
    assert ["read along" in record.getMessage() for record in caplog.records] == [True]
    assert "secret" not in caplog.text


def test_an_idle_connection_stays_and_a_silent_broker_is_noticed(name, monkeypatch):
    # The least that mosquitto takes; the broker gives up after one and a half of it, the client after two.
    monkeypatch.setattr("epypes.transport.channels.mqtt.connection._KEEP_ALIVE_S", 1)
    with servers.server() as server:
        address = server.address(name, create=True)
        sender, receiver = open_channel(address), open_channel(address)
        assert receiver.receive(3.0) is None
        sender.send([b"a"])
        next_of(receiver).ack()
        server.pause()
        with pytest.raises(BrokerError, match="nothing has come"):
            receiver.receive(WAIT_S)
        with pytest.raises(BrokerError):
            sender.send([b"a"])
        for channel in (sender, receiver):
            channel.close()


def test_what_comes_with_qos_0_while_nobody_receives_does_not_fill_the_memory(mosquitto, name, opened, foreign, caplog):
    address = mosquitto.address(name, kind="broadcast")
    channel = opened(address)
    assert channel.receive(0.0) is None
    sensor = foreign()
    for _ in range(1_500):
        sensor.publish(name, b"21.5 C", qos=0)
    # What it sends with QoS 1 comes after, and always.
    sensor.publish(name, b"the last", qos=1)
    arrived = channel._receiving._arrived
    wait_until(lambda: arrived and bytes(arrived[-1].payload) == b"the last")
    assert 900 < len(arrived) <= 1_001
    assert "what comes with QoS 0 is dropped" in caplog.text
    received = [channel.receive(WAIT_S) for _ in range(len(arrived))]
    assert bytes(received[-1].frames[0]) == b"the last"


def test_what_an_heir_has_left_who_came_too_early_is_no_event(mosquitto, queue, opened):
    """It was connected as one who was gone, and had begun to hand on what is kept for him, when he came back."""
    place = place_of(queue)
    end = f"{notices(place, 'early')}/end"
    join(place, "early", 1, WAIT_S).close(with_notice=True)
    heir = Connection(place, WAIT_S, session="early", notice=notices(place, "early"))
    heir.subscribe(end)
    heir.publish(end, b"mark", {})
    keep_for_later(place, "early")
    receiver = opened(queue)
    assert receiver.receive(1.0) is None
    opened(queue).send([b"event"])
    assert body(next_of(receiver)) == b"event"
    heir.close()
