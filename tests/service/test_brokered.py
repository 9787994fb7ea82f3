from __future__ import annotations

import itertools
import queue
from contextlib import contextmanager

import pytest

import epypes as ep
from epypes.errors import AddressError, BrokerError, BundleError, ServiceError
from epypes.service import Service
from epypes.store import Store
from epypes.transport import memory
from epypes.transport.address import parse_address
from epypes.transport.publisher import Publisher
from epypes.transport.subscriber import Subscriber
from epypes.wire import Envelope
from tests.service.served import TIMEOUT_S, acting_bundle, event, until

pytestmark = pytest.mark.slow

_numbers = itertools.count(1)


@pytest.fixture
def host():
    """The name of a broker of its own."""
    return f"served{next(_numbers)}"


class Line:
    """Who sends events to a queue, and gets what is answered."""

    def __init__(self, host):
        self.host = host
        self.sub, self.pub = f"memory://{host}/events?create=true", f"memory://{host}/answers?create=true"
        self.requests, self.answers = ep.Mailbox("block", 1_000), queue.Queue()

    def send(self, what="plain", number=1):
        request = event(what, number)
        self.requests.put(request)
        return request.id

    def take(self, count=1):
        found = []
        for _ in range(count):
            answer = self.answers.get(timeout=TIMEOUT_S)
            answer.ack()
            found.append(answer)
        return found

    def left(self, name="events"):
        """How many messages wait in a queue of the broker and are not delivered."""
        return len(memory.queued(f"memory://{self.host}/{name}"))

    def dead(self):
        return delivered(parse_address(self.sub).dead_letters, lambda letter: letter.ack())


def delivered(address, settle=lambda delivery: None):
    """Take one message of an address; without being settled it is delivered again."""
    found = queue.Queue()
    with Subscriber(address, found, undecoded=True, prefetch=1):
        delivery = found.get(timeout=TIMEOUT_S)
        settle(delivery)
    return delivery


def send_raw(address, frames, known_as):
    with Publisher(address) as publisher:
        publisher.send(frames, id=known_as)


@contextmanager
def line_of(host):
    line = Line(host)
    with Publisher(line.sub, line.requests), Subscriber(line.pub, line.answers, prefetch=1_000):
        yield line


@contextmanager
def replica_of(bundle, line, **options):
    with Service(bundle, line.sub, line.pub, **options) as service:
        assert service.state == "READY", service.reason
        yield service
    check(service.counts())


@pytest.fixture(scope="module")
def lasting(acting, tmp_path_factory):
    """A line and its one replica, with the least of mailboxes, for all tests that need no other."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "XDG_CONFIG_HOME"):
            patch.setenv(name, str(tmp_path_factory.mktemp(name)))
        with line_of("lasting") as line, replica_of(acting, line, mailbox_size=1) as service:
            yield line, service
        assert (line.left(), line.answers.qsize()) == (0, 0)


@pytest.fixture
def more(lasting):
    """How many more events there are of a kind than when the test began."""
    _, service = lasting
    before = service.counts()
    return lambda kind: service.counts()[kind] - before[kind]


def check(counts):
    parts = ("answered", "failed", "dropped", "dead_letters", "waiting", "in_flight", "given_back")
    assert counts["received"] == sum(counts[part] for part in parts), counts


def test_an_event_is_acknowledged_when_its_answer_has_arrived(lasting, more):
    line, service = lasting
    sent = [line.send(number=number) for number in range(60)]
    answers = line.take(60)
    assert [answer.correlation_id for answer in answers] == sent
    assert [answer.parts["out"] for answer in answers] == [2 * number for number in range(60)]
    assert [answer.delivery.id for answer in answers] == sent, "so that a duplicate is detected"
    until(lambda: more("answered") == 60)
    until(lambda: service.counts()["in_flight"] == 0)
    assert (line.left(), more("redelivered"), more("given_back"), more("dropped")) == (0, 0, 0, 0)


def test_a_failed_event_is_answered_and_done(lasting, more):
    line, service = lasting
    line.send("fail:no", 1)
    (answer,) = line.take()
    assert (answer.failure.function, answer.failure.message.partition(" | ")[0]) == ("act", "no")
    until(lambda: more("failed") == 1)
    until(lambda: service.counts()["in_flight"] == 0)
    assert (line.left(), line.left("events.dead")) == (0, 0)


def test_an_event_that_kills_the_worker_again_and_again_is_a_dead_letter_of_the_broker_too(lasting, more):
    line, service = lasting
    sent = line.send("exit", 1)
    (answer,) = line.take()
    assert answer.failure.input_id == sent
    until(lambda: more("dead_letters") == 1)
    dead = line.dead()
    assert "The event is a dead letter" in dead.headers["epypes-reason"]
    assert dead.id == sent
    until(lambda: service.counts()["in_flight"] == 0)
    assert line.left() == 0


def test_an_event_that_was_delivered_too_often_is_put_aside_and_can_be_opened(acting, host):
    with line_of(host) as line:
        sent = line.send("plain", 7)
        for _ in range(3):
            # As a replica that dies of it.
            assert delivered(line.sub).id == sent
        with replica_of(acting, line) as service:
            (answer,) = line.take()
            assert "delivered 3 times before, and never answered" in answer.failure.message
            until(lambda: service.counts()["dead_letters"] == 1)
            assert service.counts()["rejected"] == 0
            assert service.counts()["redelivered"] == 1
            assert service.failure_store.flush()
            (record,) = service.failure_records()
            assert (record.dead_letter, record.event_id, record.attempt) == (True, sent, 3)
            assert "never answered" in line.dead().headers["epypes-reason"]
    with pytest.warns(UserWarning, match="it is not known which function it is, so none was run"):
        runner = ep.load_failure(record.id)
    assert runner.rerun("out") is not None
    assert runner["out"] == 14


def test_what_is_not_answered_when_the_service_stops_is_given_back(acting, host, tmp_path):
    with line_of(host) as line:
        with replica_of(acting, line) as service:
            for number in range(5):
                line.send(f"hold:{tmp_path}", number)
            until((tmp_path / "started").exists)
            service.stop(0.5)
            assert service.counts()["given_back"] == 1
        assert line.left() == 5
        assert line.answers.empty(), "none is answered as refused"
        (tmp_path / "release").touch()
        with replica_of(acting, line) as other:
            assert {answer.parts["out"] for answer in line.take(5)} == {0, 2, 4, 6, 8}
            until(lambda: other.counts()["answered"] == 5)
            assert other.counts()["redelivered"] == 1, "the others were never delivered to who stopped"


def test_a_replica_takes_no_more_events_than_it_computes_at_once(acting, host, tmp_path):
    """If the replica is killed, each event it holds counts as delivered; an event that did nothing is no dead letter."""
    with line_of(host) as line, replica_of(acting, line, threads=2) as service:
        for number in range(6):
            line.send(f"hold:{tmp_path}", number)
        until(lambda: service.counts()["in_flight"] == 2)
        until((tmp_path / "started").exists)
        assert (line.left(), service.counts()["received"]) == (4, 2)
        (tmp_path / "release").touch()
        line.take(6)
        until(lambda: service.counts()["answered"] == 6)


def test_a_service_is_degraded_while_its_broker_is_away_and_goes_on_afterwards(acting, host, tmp_path):
    told = []
    with line_of(host) as line, replica_of(acting, line) as service:
        service.listen(lambda kind, data: told.append(data["state"]) if kind == "state" else None)
        sent = line.send(f"hold:{tmp_path}", 1)
        until((tmp_path / "started").exists)
        with memory.away(host):
            until(lambda: service.state == "DEGRADED")
            assert "away" in service.reason
            assert host in service.ready()
            assert service.alive() == ""
            (tmp_path / "release").touch()
            until((tmp_path / "over").exists)
        until(lambda: service.state == "READY")
        (answer,) = line.take()
        assert (answer.correlation_id, answer.parts["out"]) == (sent, 2)
        until(lambda: service.counts()["answered"] == 1)
        assert line.send(number=4) == line.take()[0].correlation_id
        until(lambda: service.counts()["answered"] == 2)
        assert service.counts()["reconnects"] == 1
    assert line.left() == 0
    states = [state for state, _ in itertools.groupby(told)]
    assert states[states.index("DEGRADED") :] == ["DEGRADED", "READY", "DRAINING", "STOPPED"]


def test_a_service_whose_broker_is_away_stops_in_time_and_has_answered_nothing_twice(acting, host, tmp_path):
    with line_of(host) as line:
        with replica_of(acting, line) as service:
            line.send(f"hold:{tmp_path}", 1)
            until((tmp_path / "started").exists)
            with memory.away(host):
                until(lambda: service.state == "DEGRADED")
                (tmp_path / "release").touch()
                until((tmp_path / "over").exists)
                service.stop(0.3)
            assert (service.counts()["given_back"], service.counts()["answered"]) == (1, 0)
        with replica_of(acting, line):
            assert line.take()[0].parts["out"] == 2


def test_a_drained_service_leaves_the_events_to_others_and_takes_them_again(lasting, more):
    line, service = lasting
    assert service.drain(TIMEOUT_S)
    line.send(number=5)
    until(lambda: line.left() == 1)
    assert service.state == "DRAINING"
    service.resume()
    assert line.take()[0].parts["out"] == 10
    until(lambda: more("answered") == 1)


def test_answers_may_go_to_a_socket_and_events_come_from_one(acting, host):
    with line_of(host) as line:
        with (
            Service(acting, line.sub) as service,
            ep.ZMQSubscriber(service.service_state.pub, line.answers) as answered,
        ):
            assert answered.wait_joined(TIMEOUT_S)
            sent = line.send(number=3)
            assert line.answers.get(timeout=TIMEOUT_S).correlation_id == sent
            until(lambda: service.counts()["answered"] == 1)
        assert line.left() == 0
        requests = queue.Queue()
        with Service(acting, pub=line.pub) as service:
            sub = service.service_state.sub
            with ep.ZMQPublisher(sub, requests, bind=False) as publisher:
                assert publisher.wait_for_subscriber(TIMEOUT_S)
                requests.put(event(number=4))
                assert line.take()[0].parts["out"] == 8


def test_an_answer_that_its_broker_never_took_is_no_answered_event(acting, host, tmp_path):
    requests = queue.Queue()
    with line_of(host) as line, Service(acting, pub=line.pub) as service:
        with ep.ZMQPublisher(service.service_state.sub, requests, bind=False) as publisher:
            assert publisher.wait_for_subscriber(TIMEOUT_S)
            requests.put(event(f"hold:{tmp_path}", 1))
            until((tmp_path / "started").exists)
            with memory.away(host):
                (tmp_path / "release").touch()
                until(lambda: service.state == "DEGRADED")
                service.stop(0.5)
        counts = service.counts()
        assert (counts["received"], counts["answered"], counts["failed"]) == (1, 0, 1)
        assert service.failure_store.flush()
        (record,) = service.failure_records()
        assert (record.function, record.exception) == ("f_out", "BrokerError")
        assert "was not sent" in record.message


def test_an_answer_that_can_never_be_sent_is_answered_as_a_failure(lasting, more, monkeypatch):
    from epypes.errors import MessageError

    def refusing(session, message):
        if "answers" in str(session.address) and not refused:
            refused.append(message.id)
            raise MessageError("too large", "The broker takes no message of that size.")

    refused = []
    monkeypatch.setattr(memory.MemorySession, "check", refusing)
    line, service = lasting
    sent = line.send()
    (answer,) = line.take()
    assert (answer.failure.function, answer.failure.input_id) == ("f_out", sent)
    assert "no message of that size" in answer.failure.message
    until(lambda: more("failed") == 1)
    until(lambda: service.counts()["in_flight"] == 0)
    assert line.left() == 0


def test_what_is_no_event_is_rejected_and_counted(lasting, more):
    line, _ = lasting
    send_raw(line.sub, (b"a", b"b", b"c"), "odd")
    until(lambda: more("rejected") == 1)
    assert line.dead().id == "odd"
    assert more("received") == 0


def test_a_broker_that_is_away_or_has_no_such_queue_is_an_error_at_the_start(acting, host):
    with memory.away(host), pytest.raises(BrokerError, match="can't be reached"):
        Service(acting, f"memory://{host}/events?create=true").start()
    with pytest.raises(BrokerError, match="no queue 'events'"):
        Service(acting, f"memory://{host}/events").start()


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"mailbox_policy": "fault"}, "A broker keeps what waits"),
        ({"sub": "tcp://127.0.0.1:*", "replica": "a"}, "shares the events of a broker"),
    ],
)
def test_what_does_not_go_with_a_broker_is_refused(acting, options, why):
    with pytest.raises(ServiceError, match=why):
        Service(acting, **{"sub": "memory://b/events", **options})


@pytest.mark.parametrize("end", ["sub", "pub", "failures"])
def test_an_address_that_is_mistyped_is_refused_without_its_password(acting, host, end):
    with pytest.raises(AddressError, match="'ampq' is not the beginning of an address") as refused:
        Service(acting, **{end: f"ampq://robot:hush@{host}/events"})
    assert "hush" not in str(refused.value)


@pytest.mark.parametrize("end", ["pub", "failures"])
def test_answers_that_would_be_events_again_are_refused(acting, host, end):
    sub = f"memory://{host}/events?create=true"
    with pytest.raises(ServiceError, match="would be its next event"):
        Service(acting, sub, **{end: f"memory://robot:hush@{host}/events"})


def test_passwords_are_in_nothing_that_a_service_says(acting, host, caplog):
    with line_of(host) as line:
        sub, pub = (address.replace("://", "://robot:hush@") for address in (line.sub, line.pub))
        with Service(acting, sub, pub) as service:
            said = [service.info(), service.service_state, service.addresses if hasattr(service, "addresses") else ""]
            with memory.away(host):
                until(lambda: service.state == "DEGRADED")
                said.append(service.reason)
        assert "hush" not in f"{said} {caplog.text}"
        assert "robot@" in str(said)


def test_an_event_of_another_program_is_answered_under_the_id_of_its_message_and_logged_as_unreadable(
    lasting, more, caplog
):
    line, _ = lasting
    send_raw(line.sub, (b"no envelope",), "foreign")
    answer = line.answers.get(timeout=TIMEOUT_S)
    assert isinstance(answer, Envelope)
    assert answer.delivery.id == "foreign"
    answer.ack()
    until(lambda: more("failed") == 1)
    assert "event foreign could not be read (f_in): " in caplog.text


def test_a_paused_replica_leaves_the_events_to_others_and_goes_on_when_it_is_resumed(lasting, more, acting, tmp_path):
    line, service = lasting
    line.send(f"hold:{tmp_path}", 1)
    until((tmp_path / "started").exists)
    for number in range(2, 6):
        line.send(number=number)
    service.pause()
    (tmp_path / "release").touch()
    assert line.take()[0].parts["out"] == 2, "what was begun is answered"
    until(lambda: line.left() == 4)
    assert service.state == "PAUSED"
    with replica_of(acting, line) as other:
        assert {answer.parts["out"] for answer in line.take(4)} == {4, 6, 8, 10}
        until(lambda: other.counts()["answered"] == 4)
    service.resume()
    line.send(number=7)
    assert line.take()[0].parts["out"] == 14
    until(lambda: more("answered") == 2)


def test_a_service_that_can_no_longer_work_leaves_its_events_to_others_until_another_bundle_is_deployed(
    acting, host, tmp_path
):
    folder = acting_bundle(tmp_path / "own")
    with line_of(host) as line, replica_of(folder, line) as service:
        line.send(number=1)
        line.take()
        (folder / "pipeline.py").write_text("")
        line.send("exit", 1)
        until(lambda: service.state == "FAULTED")
        until(lambda: line.left() == 1)
        line.send(number=2)
        until(lambda: line.left() == 2)
        assert line.answers.empty(), "it refuses nothing"
        service.deploy(acting)
        assert line.take(2)
        until(lambda: service.state == "READY")
        until(lambda: service.counts()["in_flight"] == 0)


def test_the_doctor_looks_whether_a_broker_has_a_place_and_shows_no_password(host):
    from epypes.service.ops.doctor import examine

    given = [f"memory://robot:hush@{name}" for name in ("gone/events", f"{host}/events", f"{host}/events?create=true")]
    with memory.away("gone"):
        found = [check for check in examine(addresses=given) if "memory" in check.name]
    assert [check.outcome for check in found] == ["failed", "failed", "ok"]
    assert "away" in found[0].found
    assert "no queue" in found[1].found
    assert "hush" not in str(found)
    assert "robot@" in str(found)


def test_no_event_is_taken_before_it_can_be_worked_on(acting, host, tmp_path):
    folder = acting_bundle(tmp_path / "own")
    (folder / "pipeline.py").write_text("raise ValueError('broken')")
    with line_of(host) as line:
        sent = line.send()
        with pytest.raises(BundleError):
            Service(folder, line.sub, line.pub)
        folder = acting_bundle(tmp_path / "other", expected=7)
        with Service(folder, line.sub, line.pub) as service:
            assert service.state == "FAULTED", "its sample is not what it computes"
            assert (line.left(), service.counts()["received"]) == (1, 0)
        with replica_of(acting, line):
            assert line.take()[0].correlation_id == sent


def test_rows_of_events_say_who_had_them_and_how_often_they_were_delivered(acting, host, tmp_path):
    database = tmp_path / "rows.db"
    with line_of(host) as line:
        line.send(number=1)
        delivered(line.sub)
        with replica_of(acting, line, replica="left", store=str(database)) as service:
            line.take()
            until(lambda: service.counts()["answered"] == 1)
    with Store(database) as store:
        (row,) = store.series("events", *store.names("events")).rows()
    assert (row["deliveries"], row["replica"], row["outcome"]) == (2, "left", "answered")
