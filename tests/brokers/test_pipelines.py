"""Do pipelines in code answer every event once, on a real broker, whoever is killed?"""

from __future__ import annotations

from collections import Counter

import pytest

import epypes as ep
from tests.brokers.fleet import fleet
from tests.brokers.traffic import KILLS, PLAIN, RAISES, Reader, dead_letters, event, lasting, left, until

pytestmark = pytest.mark.slow

COUNT = 200
REPLICA = ("-m", "tests.brokers.replica")


@pytest.fixture
def brokered(request):
    """A broker that has work queues."""
    return request.getfixturevalue(request.param)


def kind_of(number):
    return RAISES if number % 100 == 50 else PLAIN


def outlived(broker, sub, pub, restarted_by):
    """Send events; kill a pipeline half-way, and restart the broker. Check that each was answered once, or a dead letter."""
    outbox = ep.Mailbox("block")
    with (
        fleet([(*REPLICA, sub, pub)] * 3) as replicas,
        Reader(pub) as reader,
        ep.Publisher(sub, outbox) as publisher,
    ):
        for number in range(COUNT):
            if number == COUNT // 2:
                until(lambda: reader.look() > COUNT // 4, "a quarter of the answers")
                replicas[0].kill()
            if number == COUNT * 3 // 4:
                restarted_by()
            outbox.put(event(number, kind_of(number)))
        assert publisher.sent == COUNT
        expected = COUNT * 99 // 100
        until(
            lambda: reader.look() >= expected,
            lambda: f"{reader.look()} answers of {expected}; the broker keeps {left(sub)} events, {left(pub)} answers",
        )
        letters = dead_letters(sub, COUNT // 100)
        # What a killed one had answered, and not acknowledged, comes again.
        until(lambda: left(sub) == 0, lambda: f"{left(sub)} events to be acknowledged")
        for replica in replicas:
            replica.end()
        until(lambda: left(pub) == 0, lambda: f"{left(pub)} answers to be acknowledged")
        check(reader, letters)
    shares = Counter(answer.parts["process"] for answer in reader.answers)
    assert all(shares[replica.process.pid] > COUNT // 50 for replica in replicas[1:]), shares
    assert (left(sub), left(pub)) == (0, 0)


def check(reader, letters):
    assert set(reader.ids().values()) == {1}
    assert letters.keys() == {f"event-{number}" for number in range(50, COUNT, 100)}
    assert all("is spoilt" in letter.headers["epypes-reason"] for letter in letters.values())
    assert reader.ids().keys() | letters.keys() == {f"event-{number}" for number in range(COUNT)}
    assert not reader.ids().keys() & letters.keys()
    assert all(int(answer.parts["result"][1]) == 2 * int(answer.correlation_id[6:]) for answer in reader.answers)


@pytest.mark.parametrize("brokered", ["nats", pytest.param("rabbitmq", marks=pytest.mark.soak)], indirect=True)
def test_every_event_outlives_a_killed_pipeline_and_a_killed_broker(brokered):
    def killed():
        brokered.stop(at_once=True)
        brokered.start()

    sub = lasting(brokered, "pipelines.events", attempts=5)
    outlived(brokered, sub, lasting(brokered, "pipelines.answers"), killed)


def test_every_event_outlives_a_killed_pipeline_over_mqtt_and_a_broker_that_ends_in_order(mosquitto):
    def stopped():
        mosquitto.stop()
        mosquitto.start()

    sub = mosquitto.address("pipelines/events", create=True)
    outlived(mosquitto, sub, mosquitto.address("pipelines/answers", create=True), stopped)


@pytest.mark.parametrize("brokered", ["rabbitmq", pytest.param("nats", marks=pytest.mark.soak)], indirect=True)
def test_an_event_that_kills_whoever_works_on_it_is_a_dead_letter(brokered):
    sub = brokered.address("poison.events", create=True, attempts=2)
    pub = brokered.address("poison.answers", create=True)
    outbox = ep.Mailbox("block")
    with fleet([(*REPLICA, sub, pub)] * 3) as replicas, Reader(pub) as reader, ep.Publisher(sub, outbox):
        outbox.put(event(0, KILLS))
        letters = dead_letters(sub, 1)
        assert sum(replica.is_running for replica in replicas) == 1
        outbox.put(event(1))
        until(lambda: reader.look(), "an answer of the one that is left")
        assert reader.ids() == {"event-1": 1}
    assert "delivered 3 times" in letters["event-0"].headers["epypes-reason"]
