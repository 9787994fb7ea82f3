"""Replicas of a bundle as processes on a real broker, of which some are killed."""

from __future__ import annotations

import pytest

import epypes as ep
from epypes.errors import ServiceError
from tests.brokers.traffic import KILLS, KILLS_PARENT, PLAIN, RAISES, Reader, dead_letters, event, lasting, left, until
from tests.service.replicated import control, promoted, replicas, stopped

pytestmark = pytest.mark.slow

COUNT = 400


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return promoted(tmp_path_factory.mktemp("replicated"))


@pytest.fixture
def brokered(request):
    """A broker that has work queues."""
    return request.getfixturevalue(request.param)


def on(name):
    """Run a test on one of these brokers, and in `make soak` on the other."""
    other = "nats" if name == "rabbitmq" else "rabbitmq"
    return pytest.mark.parametrize("brokered", [name, pytest.param(other, marks=pytest.mark.soak)], indirect=True)


def kind_of(number):
    """One in a hundred raises, and one of all kills its worker."""
    if number == COUNT // 3:
        return KILLS
    return RAISES if number % 100 == 50 else PLAIN


def outlived(bundle, broker, sub, pub, restarted_by):
    """Send events; kill a replica half-way, and restart the broker. Check the outcome of each event."""
    outbox = ep.Mailbox("block")
    with replicas(bundle, sub, pub) as members, Reader(pub) as reader, ep.Publisher(sub, outbox) as publisher:
        for number in range(COUNT):
            if number == COUNT // 2:
                until(lambda: reader.look() > COUNT // 4, "a quarter of the answers")
                members[0].kill()
            if number == COUNT * 3 // 4:
                restarted_by(broker)
            outbox.put(event(number, kind_of(number)))
        assert publisher.sent == COUNT
        until(lambda: reader.look() >= COUNT, lambda: f"{reader.look()} answers of {COUNT}")
        letters = dead_letters(sub, 1)
        # What the killed one had answered, and not acknowledged, is delivered again.
        until(lambda: left(sub) == 0, lambda: f"{left(sub)} events to be acknowledged")
        counts = [stopped(member) for member in members[1:]]
        check_answers(reader, letters)
    assert (left(sub), left(pub)) == (0, 0)
    check_counts(counts)


def killed(broker):
    broker.stop(at_once=True)
    broker.start()


def ended_in_order(broker):
    broker.stop()
    broker.start()


@on("rabbitmq")
def test_all_events_outlive_a_killed_replica_and_a_killed_broker(bundle, brokered):
    sub = lasting(brokered, "chaos.events", attempts=5)
    outlived(bundle, brokered, sub, lasting(brokered, "chaos.answers"), killed)


@pytest.mark.soak
def test_all_events_outlive_a_killed_replica_over_mqtt_and_a_broker_that_ends_in_order(bundle, mosquitto):
    sub = mosquitto.address("chaos/events", create=True)
    outlived(bundle, mosquitto, sub, mosquitto.address("chaos/answers", create=True), ended_in_order)


def check_answers(reader, letters):
    """Every event was answered once: with its product, or with what failed."""
    assert set(reader.ids().values()) == {1}
    assert reader.ids().keys() == {f"event-{number}" for number in range(COUNT)}
    failed = {answer.correlation_id: answer.failure for answer in reader.answers if answer.failure is not None}
    assert failed.keys() == {f"event-{number}" for number in range(COUNT) if kind_of(number) != PLAIN}
    assert letters.keys() == {f"event-{COUNT // 3}"}
    for answer in reader.answers:
        number = int(answer.correlation_id.removeprefix("event-"))
        if kind_of(number) == PLAIN:
            assert answer.parts["result"].tolist() == [number, 2, 2 * number]
        elif kind_of(number) == RAISES:
            assert f"event {number} is spoilt" in answer.failure.message
    (letter,) = letters.values()
    assert letter.headers["epypes-reason"]


def check_counts(counts):
    """The others have shared the load, and have answered what they count."""
    for counted in counts:
        assert counted["answered"] > COUNT // 50, counts
        parts = "answered", "failed", "dead_letters", "given_back"
        assert counted["received"] == sum(counted[name] for name in parts), counted
        # Once in each replica at most: the broker may die before it has the rejection, and deliver it to the other.
        assert counted["dead_letters"] <= 1
    assert sum(counted["answered"] + counted["failed"] for counted in counts) >= COUNT // 2


# RabbitMQ delivers again at once; NATS waits 5 s for the acknowledgement of each replica that was killed.
@on("rabbitmq")
def test_an_event_that_takes_down_each_replica_is_a_dead_letter_that_can_be_opened(bundle, brokered):
    sub = brokered.address("deadly.events", create=True, attempts=2)
    pub = brokered.address("deadly.answers", create=True)
    outbox = ep.Mailbox("block")
    with replicas(bundle, sub, pub) as members, Reader(pub) as reader, ep.Publisher(sub, outbox):
        outbox.put(event(0, KILLS_PARENT))
        until(reader.look, "an answer of the one that is left")
        (answer,) = reader.answers
        letters = dead_letters(sub, 1)
        (alive,) = (member for member in members if member.is_running)
        counted = stopped(alive)
    assert answer.correlation_id == "event-0"
    assert "2 times" in answer.failure.message
    assert "2 times" in letters["event-0"].headers["epypes-reason"]
    assert (counted["dead_letters"], counted["answered"]) == (1, 0)
    with pytest.warns(UserWarning, match="none was run"):
        opened = ep.load_failure("event-0", bundle)
    assert (opened["number"], opened["kind"]) == (0, KILLS_PARENT)


def test_every_replica_describes_all_and_shows_a_killed_one_as_lost(bundle, nats, epypes):
    sub, pub = nats.address("described.events", create=True), nats.address("described.answers", create=True)
    outbox = ep.Mailbox("block")
    with (
        replicas(bundle, sub, pub) as members,
        Reader(pub) as reader,
        ep.Publisher(sub, outbox),
        control(members[0]) as first,
        control(members[2]) as third,
    ):
        until(lambda: first.group()["replicas"] == 3, first.group)
        for number in range(90):
            outbox.put(event(number))
        until(lambda: reader.look() == 90, lambda: f"{reader.look()} answers")
        until(lambda: first.group()["counts"]["answered"] == 90, first.group)
        assert first.set(gain=5).revision == 1
        until(lambda: third.parameters().revision == 1, third.group)
        until(lambda: first.group()["agree"], first.group)
        shown = epypes("status", first.url).stdout
        assert "Group: replicas 3, ready 3" in shown
        assert f"process {members[2].process.pid}" in shown
        members[2].kill()
        until(lambda: first.group()["replicas"] == 2, first.group)
        until(lambda: first.group()["lost"], first.group)
        (lost,) = first.group()["lost"]
        assert (lost["state"], lost["pid"], lost["counts"]["failed"]) == ("LOST", members[2].process.pid, 0)
        (line,) = (line for line in epypes("status", first.url).stdout.splitlines() if "LOST" in line)
        assert line.startswith("- 3: LOST (no heartbeat for ")
        assert " s, and it did not stop in order; its counts are of then), " in line
        assert "Group: replicas 2, ready 2, lost 1, all with" in epypes("status", first.url).stdout
        with replicas(bundle, sub, pub, names=["again"]) as (newcomer,), control(newcomer) as last:
            # It is ready at once; its events wait until it has the parameters of the others.
            until(lambda: last.parameters().revision == 1, last.group)
            assert last.parameters().entries["gain"]["value"] == 5
            until(lambda: first.group()["replicas"] == last.group()["replicas"] == 3, last.group)
            until(lambda: last.group()["agree"], last.group)
        # One of the same name takes its place, as a supervisor starts it.
        with replicas(bundle, sub, pub, names=["3"]):
            until(lambda: "3" not in [each["replica"] for each in first.group()["lost"]], first.group)


def test_replicas_agree_again_after_their_broker_was_killed(bundle, nats):
    sub, pub = nats.address("away.events", create=True), nats.address("away.answers", create=True)
    with (
        replicas(bundle, sub, pub, names=["1", "2"]) as members,
        control(members[0]) as first,
        control(members[1]) as second,
    ):
        until(lambda: first.group()["replicas"] == 2, first.group)
        assert first.set(gain=3).revision == 1
        until(lambda: second.parameters().revision == 1, second.group)
        nats.stop(at_once=True)
        try:
            until(lambda: first.group()["trouble"], first.group)
            with pytest.raises(ServiceError, match="other replicas can't be reached, so nothing is changed"):
                first.set(gain=4)
            until(lambda: first.info()["state"] == "DEGRADED", first.info)
        finally:
            nats.start()
        # Each connects again by itself, one later than the other.
        until(lambda: first.group()["replicas"] == 2 and not first.group()["trouble"], first.group)
        until(lambda: second.group()["replicas"] == 2 and not second.group()["trouble"], second.group)
        assert second.set(gain=6).revision == 2
        until(lambda: first.parameters().revision == 2, first.group)
        assert first.parameters().entries["gain"]["value"] == 6
        assert first.group()["lost"] == second.group()["lost"] == []
