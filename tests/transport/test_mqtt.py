"""MQTT 5: what it alone promises, and the errors it gives; against a real mosquitto."""

from __future__ import annotations

import signal
from concurrent.futures import ThreadPoolExecutor

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from epypes.errors import BrokerError, MessageError
from epypes.transport.address import parse_address
from epypes.transport.brokers import mqtt
from tests.brokers import mosquitto as servers
from tests.transport.channels import WAIT_S, Receiver, Sender, body
from tests.transport.peers import line_of, process, wait_until
from tests.transport.test_channels import KILLED

pytestmark = pytest.mark.slow


@pytest.fixture
def queue(mosquitto, name):
    return mosquitto.address(name, create=True)


@pytest.fixture
def foreign(mosquitto):
    """Another program's client."""
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


def taken(receivers, ids):
    """Take and acknowledge until all ids have come; return how often each did."""
    came = {}
    while set(ids) - came.keys():
        for receiver in receivers:
            while not receiver.arrived.empty():
                delivery = receiver.next()
                came[delivery.id] = came.get(delivery.id, 0) + 1
                delivery.ack()
    return came


def test_a_message_of_another_program_is_one_frame_whatever_its_quality_of_service(opened, mosquitto, name, foreign):
    queue = mosquitto.address(name)
    receiver, sensor = opened(Receiver, queue), foreign()
    for qos in (0, 1, 2):
        sensor.publish(name, b"21.5 C", qos=qos)
        delivery = receiver.next()
        assert (body(delivery), delivery.id, dict(delivery.headers), delivery.attempt) == (b"21.5 C", "", {}, 0)
        delivery.ack()
    sensor.publish(name, b"", qos=0)
    receiver.next().reject("it is empty")
    letters = opened(Receiver, parse_address(queue).dead_letters)
    assert letters.next().headers["epypes-reason"] == "it is empty"


def test_a_message_whose_sizes_do_not_fit_is_rejected_whole(opened, queue, name, foreign):
    receiver, properties = opened(Receiver, queue), Properties(PacketTypes.PUBLISH)
    properties.UserProperty = [("epypes-frames", "3,4"), ("from", "a sensor")]
    foreign(paho.MQTTv5).publish(name, b"21.5 C", qos=1, properties=properties)
    delivery = receiver.next()
    assert delivery.frames == ()
    assert "epypes-frames" in delivery.headers["epypes-error"]
    delivery.reject("it is no message")
    letter = opened(Receiver, parse_address(queue).dead_letters).next()
    assert (letter.headers["from"], letter.headers["epypes-reason"]) == ("a sensor", "it is no message")


def test_a_log_gives_the_newest_and_then_all_that_come(mosquitto, opened, name):
    address = mosquitto.address(name, kind="log")
    sender = opened(Sender, address)
    for number in range(3):
        sender.send(b"%d" % number)
    receivers = [opened(Receiver, address), opened(Receiver, address)]
    assert [body(receiver.next()) for receiver in receivers] == [b"2", b"2"]
    for number in range(3, 6):
        sender.send(b"%d" % number)
    for receiver in receivers:
        assert [body(delivery) for delivery in receiver.take(3)] == [b"3", b"4", b"5"]


def test_topics_with_wildcards_can_be_listened_to_and_are_no_queues(mosquitto, opened, name):
    receiver = opened(Receiver, mosquitto.address(f"{name}/+", kind="broadcast"))
    opened(Sender, mosquitto.address(f"{name}/cam1", kind="broadcast")).send(b"a")
    assert body(receiver.next()) == b"a"
    with pytest.raises(BrokerError, match="one topic"):
        Receiver(mosquitto.address(f"{name}/+"))


def test_what_a_killed_consumer_had_comes_to_those_that_live(opened, queue):
    living, sender = [opened(Receiver, queue, prefetch=4) for _ in range(2)], opened(Sender, queue)
    ids = [str(number) for number in range(60)]
    with process(KILLED, queue, "4") as consumer:
        assert line_of(consumer) == "open"
        for known_as in ids:
            sender.send(b"a", b"", id=known_as)
        assert line_of(consumer) == "holds"
        consumer.send_signal(signal.SIGKILL)
        taken(living, ids)


def test_a_session_that_was_left_is_announced_and_ended_by_the_next_consumer(opened, queue, name, foreign):
    heard, client = {}, foreign()
    client.on_message = lambda _client, _data, message: heard.update({message.topic: message.payload})
    client.subscribe(f"{name}/gone/epypes/+", qos=1)
    with process(KILLED, queue, "2") as consumer:
        assert line_of(consumer) == "open"
        sender = opened(Sender, queue)
        for number in range(20):
            sender.send(b"a", id=str(number))
        assert line_of(consumer) == "holds"
        consumer.send_signal(signal.SIGKILL)
        consumer.wait()
    sender.send(b"a", id="20")
    wait_until(lambda: {*heard.values()} - {b"", b"in use"}, WAIT_S)
    assert taken([opened(Receiver, queue)], [str(number) for number in range(21)])["20"] == 1
    wait_until(lambda: sorted(heard.values()) == [b"", b"in use"], WAIT_S)


def test_a_session_that_could_not_be_asked_is_emptied_when_it_is_announced(opened, queue, name, foreign, monkeypatch):
    failures, publish = [BrokerError(queue, "refused")], mqtt.PahoConnection.publish

    async def fail_once(connection, topic, body, headers, *, retain=False):
        if body == b"?" and failures:
            raise failures.pop()
        return await publish(connection, topic, body, headers, retain=retain)

    monkeypatch.setattr(mqtt.PahoConnection, "publish", fail_once)
    heard, client, topic = [], foreign(), f"{name}/gone/epypes/left"
    client.on_message = lambda _client, _data, message: heard.append(message.payload)
    client.subscribe(topic, qos=1)
    client.publish(topic, b"in use", qos=1, retain=True)
    wait_until(lambda: heard == [b"in use"])
    opened(Receiver, queue)
    wait_until(lambda: not failures)
    client.publish(topic, b"left", qos=1, retain=True)
    wait_until(lambda: heard[-1] == b"")


def test_channels_that_make_the_same_queue_at_the_same_moment_do_not_disturb_each_other(queue, opened):
    with ThreadPoolExecutor(16) as threads:
        senders = list(threads.map(lambda _: opened(Sender, queue), range(16)))
    for number, sender in enumerate(senders):
        sender.send(b"a", id=str(number))
    taken([opened(Receiver, queue)], list(map(str, range(16))))


def test_what_a_consumer_was_still_fetching_from_a_session_when_it_ended_reaches_the_next_one(opened, queue):
    ids = list(map(str, range(120)))
    sender, outcomes = opened(Sender, queue), []
    for known_as in ids:
        sender.channel.send([b"a"], id=known_as, confirmed=outcomes.append)
    wait_until(lambda: len(outcomes) == len(ids), WAIT_S)
    first = Receiver(queue, prefetch=1)
    first.next()
    first.channel.close(0.0)
    taken([opened(Receiver, queue)], ids)


def test_what_a_consumer_kept_that_died_with_the_broker_reaches_another_one(name, opened, monkeypatch):
    monkeypatch.setattr(mqtt, "_ANSWER_S", 0.5)
    ids = list(map(str, range(30)))
    with servers.server() as server:
        address = server.address(name, create=True)
        with process(KILLED, address, "2") as consumer:
            assert line_of(consumer) == "open"
            sender = opened(Sender, address)
            for known_as in ids:
                sender.send(b"a", id=known_as)
            wait_until(lambda: server.has_written, WAIT_S)
            server.stop(at_once=True)
            consumer.kill()
            consumer.wait()
        server.start()
        taken([opened(Receiver, address)], ids)


def test_what_a_consumer_was_fetching_from_a_session_when_the_broker_was_killed_is_fetched_again(
    name, opened, monkeypatch
):
    monkeypatch.setattr(mqtt, "_ANSWER_S", 0.5)
    ids = list(map(str, range(120)))
    with servers.server() as server:
        address = server.address(name, create=True)
        sender, outcomes = opened(Sender, address), []
        for known_as in ids:
            sender.channel.send([b"a"], id=known_as, confirmed=outcomes.append)
        wait_until(lambda: len(outcomes) == len(ids), WAIT_S)
        receiver = opened(Receiver, address, prefetch=8)
        first = receiver.next()
        wait_until(lambda: server.has_written, WAIT_S)
        server.stop(at_once=True)
        server.start()
        taken([receiver], [known_as for known_as in ids if known_as != first.id])


def test_what_a_consumer_of_one_group_leaves_reaches_that_group_alone_and_others_get_nothing_twice(
    mosquitto, name, opened
):
    ids = list(map(str, range(30)))
    left, other = (mosquitto.address(name, create=True, group=group) for group in ("left", "other"))
    receiver = opened(Receiver, other)
    with process(KILLED, left, "2") as consumer:
        assert line_of(consumer) == "open"
        sender = opened(Sender, left)
        for known_as in ids:
            sender.send(b"a", id=known_as)
        assert line_of(consumer) == "holds"
        consumer.send_signal(signal.SIGKILL)
        consumer.wait()
    assert set(taken([receiver], ids).values()) == {1}
    taken([opened(Receiver, left)], ids)
    assert receiver.is_quiet()


def test_a_message_that_is_returned_is_delivered_again_to_its_group_alone(mosquitto, name, opened):
    first, second = (opened(Receiver, mosquitto.address(name, create=True, group=group)) for group in ("a", "b"))
    opened(Sender, mosquitto.address(name)).send(b"x", id="x")
    first.next().nack()
    first.next().ack()
    second.next().ack()
    assert second.is_quiet()


def test_after_a_restart_of_the_broker_a_sender_waits_until_there_is_a_session(name, opened, caplog):
    with servers.server() as server:
        receiver = Receiver(server.address(name))
        receiver.channel.close(0.0)
        server.stop()
        server.start()
        # mosquitto 2.0 has forgotten the shared subscriptions: what it would lose is refused.
        sender, outcomes = opened(Sender, server.address(name)), []
        sender.channel.send([b"a"], id="kept", confirmed=outcomes.append)
        wait_until(lambda: "no session is subscribed" in caplog.text, WAIT_S)
        assert outcomes == []
        assert opened(Receiver, server.address(name)).next().id == "kept"
        wait_until(lambda: outcomes == [None], WAIT_S)


def test_what_is_too_large_is_refused_and_whatever_can_be_sent_can_be_rejected(name, opened):
    with servers.server(settings={"max_packet_size": 4_000}) as server:
        address = server.address(name, create=True)
        sender, receiver = opened(Sender, address), opened(Receiver, address)
        with pytest.raises(MessageError, match="4,000") as refused:
            sender.send(bytes(4_000))
        assert refused.value.reason == "too large"
        sender.send(bytes(2_800), id="x")
        receiver.next().reject("ü" * 10_000)
        assert len(body(opened(Receiver, parse_address(address).dead_letters).next())) == 2_800


def test_a_silent_broker_is_lost(name, opened, monkeypatch):
    # The least that mosquitto takes; the broker gives up after one and a half of it, the client after two.
    monkeypatch.setattr("epypes.transport.brokers.mqtt._KEEP_ALIVE_S", 1)
    with servers.server() as server:
        address = server.address(name, create=True)
        sender, receiver = opened(Sender, address), opened(Receiver, address)
        assert receiver.is_quiet(3.0)
        assert (sender.channel.reconnects, receiver.channel.reconnects) == (0, 0)
        server.pause()
        wait_until(lambda: not sender.channel.is_connected and not receiver.channel.is_connected, WAIT_S)
        assert "nothing was heard from the broker" in receiver.channel.trouble


def test_what_comes_with_qos_0_while_nothing_is_taken_does_not_fill_the_memory(
    mosquitto, name, opened, foreign, monkeypatch, caplog
):
    monkeypatch.setattr("epypes.transport.brokers.mqtt._MOST_UNKEPT", 100)
    receiver, sensor = opened(Receiver, mosquitto.address(name), prefetch=1), foreign()
    for _ in range(200):
        sensor.publish(name, b"21.5 C", qos=0)
    # What it sends with QoS 1 comes after, and always.
    sensor.publish(name, b"the last", qos=1)
    count = 0
    while True:
        delivery = receiver.next()
        delivery.ack()
        count += 1
        if body(delivery) == b"the last":
            break
    assert count <= 201
    wait_until(lambda: count > 101 or "what comes with QoS 0 is dropped" in caplog.text, WAIT_S)
