"""Replicas of a bundle that share the events of a broker: services in this process."""

from __future__ import annotations

import itertools
import json
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from time import monotonic

import httpx
import pytest
from httpx_sse import EventSource

from epypes.errors import ParametersRefused, RevisionConflict, ServiceError
from epypes.service import Service
from epypes.service.http import HttpServer
from epypes.service.replication.messages import (
    MAX_INTEGER,
    Goodbye,
    Heartbeat,
    ParameterQuery,
    ParameterSet,
    encode_message,
)
from epypes.transport.address import parse_address
from tests.brokers import nats as nats_server
from tests.service.replicated import publish_to_replicas
from tests.service.served import TIMEOUT_S, acting_bundle, until
from tests.service.test_brokered import line_of, replica_of
from tests.transport.channels import Receiver

_numbers = itertools.count(1)


@pytest.fixture
def host():
    """The name of a broker of its own."""
    return f"replicas{next(_numbers)}"


@contextmanager
def group_of(bundle, line, count=2, **options):
    """Serve a bundle so many times; yield when all know each other."""
    with ExitStack() as stack:
        replicas = [
            stack.enter_context(replica_of(bundle, line, replica=str(number), **options))
            for number in range(1, count + 1)
        ]
        for replica in replicas:
            until(lambda replica=replica: replica.group()["replicas"] == count)
        yield replicas


@pytest.fixture(scope="module")
def trio(acting, tmp_path_factory):
    """Three replicas, and what sends them events."""
    with pytest.MonkeyPatch.context() as own:
        own.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        with line_of("trio") as line, group_of(acting, line, 3) as replicas:
            yield line, replicas


@pytest.fixture(scope="module")
def http(trio, tmp_path_factory):
    """The control of the first of them."""
    _, (first, *_) = trio
    with HttpServer(first, "127.0.0.1:*", access_key_file=tmp_path_factory.mktemp("token") / "token") as server:
        headers = {"Authorization": f"Bearer {server.access_key_file.read_text().strip()}"}
        with httpx.Client(base_url=server.url, trust_env=False, timeout=60, headers=headers) as client:
            yield client


def revisions(replicas):
    return [replica.parameters().revision for replica in replicas]


def values(replicas):
    return [replica.parameters().entries["k"]["value"] for replica in replicas]


def member_of(service, replica):
    """Return what a service shows of another replica; None if that is no member."""
    found = [each for each in service.group()["members"] if each["replica"] == replica]
    return found[0] if found else None


# -- members ----------------------------------------------------------------------------------------------------------


def test_replicas_share_the_events_and_know_each_other(trio):
    line, replicas = trio
    sent = [line.send(number=number) for number in range(60)]
    answers = line.take(60)
    assert sorted(answer.correlation_id for answer in answers) == sorted(sent)
    for replica in replicas:
        until(lambda replica=replica: replica.group()["counts"]["answered"] == 60)
        group = replica.group()
        assert [each["replica"] for each in group["members"]] == ["1", "2", "3"]
        assert [each["is_self"] for each in group["members"]] == [each is replica for each in replicas]
        assert all(each["heard_s"] < 3.5 and each["counts"]["answered"] for each in group["members"])
        assert (group["ready"], group["agree"], group["trouble"], group["lost"]) == (3, True, "", [])


def test_every_replica_describes_all_over_http(trio, http):
    _, (first, *_) = trio
    group = http.get("/v1/group").json()
    assert group["replicas"] == 3
    assert [each["pid"] for each in group["members"]] == [first.info()["pid"]] * 3
    assert group["lost"] == []
    assert group["members"][0].keys() >= {"host", "state", "reason", "revision", "digest", "counts", "http", "heard_s"}
    metrics = http.get("/metrics").text
    assert "epypes_group_replicas 3.0" in metrics
    assert "epypes_group_ready 3.0" in metrics
    assert "epypes_group_lost 0.0" in metrics


@pytest.mark.slow
def test_listeners_are_sent_the_group_each_second(http):
    with http.stream("GET", "/v1/events", params={"for_s": 1.5}) as answer:
        groups = [json.loads(each.data) for each in EventSource(answer).iter_sse() if each.event == "group"]
    assert len(groups) >= 2
    assert groups[0]["replicas"] == 3


def test_a_service_on_a_socket_is_a_group_of_its_own(acting):
    group = Service(acting).group()
    assert (group["is_shared"], group["replicas"], group["agree"], group["trouble"]) == (False, 1, True, "")
    assert group["members"][0]["state"] == "STOPPED"


def test_messages_of_other_programs_are_rejected_and_counted(trio):
    line, (first, *_) = trio
    before, known = first.group()["rejected"], first.parameters()
    digest = first.info()["digest"]

    def heartbeat(**fields):
        document = json.loads(encode_message(Heartbeat("x")))
        document["message"] |= fields
        return json.dumps(document).encode()

    hostile = [
        b"",
        b"\xff\x00",
        b"[]",
        b"null",
        b"[" * 100_000,
        b'{"version":2,"message":{"kind":"goodbye","id":"x"}}',
        b'{"version":3,"message":{"kind":"farewell","id":"x"}}',
        b'{"version":3,"message":{"kind":"goodbye","id":7}}',
        encode_message(ParameterSet(digest, 10**30, "x", {})),
        encode_message(ParameterSet(digest, -1, "x", {})),
        encode_message(ParameterSet(digest, 900, "x", {"k": 5})),
        encode_message(ParameterSet(digest, 900, "x", {f"k{number}": {} for number in range(1_001)})),
        encode_message(Goodbye("x" * 5_000)),
        encode_message(Goodbye("x" * 5_000)).ljust(1_100_000),
        heartbeat(pid="7"),
        heartbeat(counts={"answered": -1}),
    ]
    publish_to_replicas(line.sub, *hostile, ParameterQuery("of no replica", digest), Goodbye("of no replica"))
    until(lambda: first.group()["rejected"] == before + len(hostile))
    assert (first.group()["trouble"], first.parameters()) == ("", known)
    assert first.group()["replicas"] == 3


def test_control_characters_of_a_peer_are_not_shown(trio):
    line, (first, *_) = trio
    publish_to_replicas(line.sub, Heartbeat("peer", replica="evil\x1b[2J\n", state="READY"))
    until(lambda: first.group()["replicas"] == 4)
    assert [each["replica"] for each in first.group()["members"]][-1] == "evil [2J "
    publish_to_replicas(line.sub, Goodbye("peer"))
    until(lambda: first.group()["replicas"] == 3)


def test_another_bundle_on_the_same_queue_is_warned_of_once(trio, caplog):
    caplog.set_level("INFO", "epypes.service")
    line, (first, *_) = trio
    peer = Heartbeat("stranger", replica="stranger", host="elsewhere", name="another bundle")
    publish_to_replicas(line.sub, peer, peer, Goodbye("stranger"))
    until(lambda: caplog.text.count("stranger at elsewhere has left") == 3)
    warned = [record for record in caplog.records if "serves another bundle from the same queue" in record.message]
    assert len(warned) == 3, "once by each replica"
    assert first.group()["replicas"] == 3


@pytest.mark.slow
def test_a_replica_that_stops_has_left_at_once_and_may_come_back(trio):
    _, (first, *_, last) = trio
    last.stop()
    until(lambda: first.group()["replicas"] == 2)
    assert first.group()["lost"] == []
    last.start()
    until(lambda: first.group()["replicas"] == last.group()["replicas"] == 3)


# -- hyperparameters --------------------------------------------------------------------------------------------------


def test_a_change_at_one_replica_reaches_all_with_one_revision(trio):
    line, replicas = trio
    before = replicas[0].parameters().revision
    now = replicas[1].set_parameters({"k": 5}, before)
    assert (now.revision, now.entries["k"]["value"]) == (before + 1, 5)
    assert replicas[1].parameters() == now, "it is made here when it is answered"
    until(lambda: revisions(replicas) == [now.revision] * 3)
    assert values(replicas) == [5, 5, 5]
    for number in range(30):
        line.send(number=number)
    answers = line.take(30)
    assert {answer.revision for answer in answers} == {now.revision}
    assert sorted(int(answer.parts["out"]) for answer in answers) == [5 * number for number in range(30)]
    until(lambda: all(replica.group()["agree"] for replica in replicas))


@pytest.mark.slow
def test_a_revision_beyond_the_last_that_replicas_can_read_is_not_made(acting, host):
    with line_of(host) as line, group_of(acting, line) as (first, second):
        last = ParameterSet(first.info()["digest"], MAX_INTEGER, "peer", {"k": {"value": 9}})
        publish_to_replicas(line.sub, last)
        until(lambda: {first.parameters().revision, second.parameters().revision} == {MAX_INTEGER})
        with pytest.raises(ServiceError, match="last one that replicas can read"):
            first.set_parameters({"k": 4})
        assert first.parameters() == second.parameters()


def test_a_change_that_is_refused_reaches_no_replica(trio):
    _, replicas = trio
    before = [replica.parameters() for replica in replicas]
    for wrong in ({"k": "five"}, {"gain": 5}):
        with pytest.raises(ParametersRefused):
            replicas[0].set_parameters(wrong)
    now = replicas[0].set_parameters({"k": 6})
    assert now.revision == before[0].revision + 1, "none was made between"
    until(lambda: revisions(replicas) == [now.revision] * 3)


def test_a_change_from_an_older_revision_is_a_conflict_at_every_replica(trio, http):
    _, (first, second, third) = trio
    before = http.get("/v1/parameters").json()["revision"]
    assert third.set_parameters({"k": 7}, before).revision == before + 1
    until(lambda: first.parameters().revision == second.parameters().revision == before + 1)
    refused = http.patch("/v1/parameters", json={"revision": before, "values": {"k": 8}})
    assert refused.status_code == 409
    assert refused.json()["parameters"]["k"]["value"] == 7
    with pytest.raises(RevisionConflict):
        second.set_parameters({"k": 9}, before)
    assert http.patch("/v1/parameters", json={"values": {"k": 8}}).json()["revision"] == before + 2
    until(lambda: values(trio[1]) == [8, 8, 8])


def test_replicas_settle_on_one_of_the_changes_that_are_made_at_the_same_time(trio):
    _, replicas = trio
    with ThreadPoolExecutor(3) as pool:
        for k in range(20, 50, 10):
            before = revisions(replicas)[0]
            together = threading.Barrier(3)

            def change(number, k=k, together=together):
                together.wait(TIMEOUT_S)
                return replicas[number].set_parameters({"k": k + number}).revision

            made = [*pool.map(change, range(3))]
            until(lambda: len(set(revisions(replicas))) == len(set(values(replicas))) == 1)
            assert before < max(made) == revisions(replicas)[0]
            assert values(replicas)[0] in (k, k + 1, k + 2)
            until(lambda: all(replica.group()["agree"] for replica in replicas))


@contextmanager
def paused(replicas):
    """Have replicas leave the events to others within the block."""
    for replica in replicas:
        replica.pause()
    # The threads that leave the queue: a replica that has not done so yet would take an event and give it back, and
    # three of them make a dead letter of it.
    until(lambda: not any(thread.name == "epypes intake" for thread in threading.enumerate()))
    try:
        yield
    finally:
        for replica in replicas:
            replica.resume()


@pytest.mark.slow
def test_a_newcomer_has_the_revision_of_the_group_from_its_first_event_on(trio, acting):
    line, (first, *_) = trio
    known = first.set_parameters({"k": 14})
    until(lambda: revisions(trio[1]) == [known.revision] * 3)
    with paused(trio[1]):
        line.send(number=1)
        with replica_of(acting, line, replica="4") as newcomer:
            (answer,) = line.take()
            assert (answer.revision, int(answer.parts["out"])) == (known.revision, 14)
            assert newcomer.parameters() == known
            until(lambda: newcomer.counts()["answered"] == 1)


@pytest.mark.slow
def test_events_do_not_wait_for_ever_for_parameters_that_no_replica_publishes(acting, host, monkeypatch):
    monkeypatch.setattr("epypes.service.replication.replicas._JOIN_TIMEOUT_S", 1.0)
    digest = Service(acting).info()["digest"]
    with line_of(host) as line, Service(acting, line.sub, line.pub) as service:
        boast = Heartbeat("boaster", replica="2", host="elsewhere", digest=digest, revision=1_000, author="boaster")
        publish_to_replicas(line.sub, boast)
        line.send(number=1)
        assert line.take()[0].revision == 0
        assert service.state == "READY"


@pytest.mark.slow
def test_a_worker_that_is_started_again_has_the_revision_of_the_group(trio):
    line, (first, second, third) = trio
    now = first.set_parameters({"k": 7})
    until(lambda: third.parameters() == now)
    with paused((first, second)):
        line.send("exit", 1)
        assert line.take()[0].failure is not None
        line.send(number=2)
        (answer,) = line.take()
    assert (answer.revision, answer.parts["out"]) == (now.revision, 14)


def test_a_change_is_made_between_two_events_of_a_replica_that_works(trio, tmp_path):
    line, replicas = trio
    line.send(f"hold:{tmp_path}", 1)
    until((tmp_path / "started").exists)
    (busy,) = (replica for replica in replicas if replica.counts()["in_flight"])
    idle = next(replica for replica in replicas if replica is not busy)
    now = idle.set_parameters({"k": 11})
    until(lambda: revisions(replicas).count(now.revision) == 2)
    assert busy.parameters().revision < now.revision
    (tmp_path / "release").touch()
    assert line.take()[0].revision < now.revision
    until(lambda: busy.parameters() == now)
    until(lambda: idle.group()["agree"])


@pytest.mark.slow
def test_another_bundle_begins_with_a_revision_that_its_replicas_share(acting, host, tmp_path):
    other = acting_bundle(tmp_path / "other", k=4, expected=12)
    with line_of(host) as line, group_of(acting, line) as replicas:
        replicas[0].set_parameters({"k": 3})
        until(lambda: revisions(replicas) == [1, 1])
        assert replicas[0].deploy(other)["revision"] == 2
        assert replicas[0].group()["agree"] is False
        assert replicas[0].set_parameters({"k": 6}).revision == 3
        digest = replicas[0].info()["digest"]
        until(lambda: member_of(replicas[1], "1")["digest"] == digest and member_of(replicas[1], "1")["revision"] == 3)
        assert replicas[1].parameters().revision == 1, "of another bundle"
        assert replicas[1].deploy(other)["revision"] == 3
        assert values(replicas) == [6, 6]
        for number in range(8):
            line.send(number=number)
        answers = line.take(8)
        assert {answer.revision for answer in answers} == {3}
        assert sorted(int(answer.parts["out"]) for answer in answers) == [6 * number for number in range(8)]
        until(lambda: replicas[0].group()["agree"] is True)
        replicas[1].rollback()
        assert values(replicas) == [6, 3], "as its group had left it"


@pytest.mark.slow
def test_parameters_that_the_worker_refuses_are_not_computed_with(acting, host, tmp_path):
    other = acting_bundle(tmp_path / "other", k=4, expected=12)
    with line_of(host) as line, group_of(acting, line, 1) as (replica,):
        digest, another = replica.info()["digest"], Service(other).info()["digest"]
        publish_to_replicas(
            line.sub, *(ParameterSet(each, 4, "peer", {"k": {"value": "no number"}}) for each in (digest, another))
        )
        until(lambda: "revision 4" in replica.group()["trouble"])
        assert "revision 4" in member_of(replica, "1")["trouble"]
        line.send(number=2)
        assert line.take()[0].revision == 0
        assert replica.deploy(other)["state"] == "READY", "with its own values"
        assert replica.group()["trouble"] == ""
        line.send(number=2)
        assert int(line.take()[0].parts["out"]) == 8
        assert replica.set_parameters({"k": 5}).revision > 5
        replica.rollback()
        assert replica.state == "READY"
        assert replica.set_parameters({"k": 6}).entries["k"]["value"] == 6
        assert replica.group()["trouble"] == ""


# -- the broker -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_change_that_a_replica_has_missed_is_made_when_it_hears_of_it(acting, host):
    with line_of(host) as line, replica_of(acting, line, replica="1") as service:
        digest = service.info()["digest"]
        address = parse_address(line.sub).beside("group", "broadcast")
        heard = []
        receiver = Receiver(address)
        try:
            # A member computes with a revision of which this one has heard nothing.
            member = Heartbeat("peer", replica="2", host="elsewhere", digest=digest, revision=3, author="peer")
            publish_to_replicas(line.sub, member)
            while not heard or heard[-1]["kind"] != "query":
                heard.append(json.loads(b"".join(receiver.next().frames))["message"])
            assert (heard[-1]["id"], heard[-1]["digest"]) == ("peer", digest)
            publish_to_replicas(line.sub, ParameterSet(digest, 3, "peer", {"k": {"value": 8}}))
            until(lambda: revisions([service]) == [3])
            assert values([service]) == [8]
        finally:
            receiver.channel.close()


def test_replicas_agree_on_every_broker_and_a_newcomer_knows_it(acting, broker):
    """Also where a broadcast is an exchange, a subject or a topic."""
    name = f"agree{next(_numbers)}"
    sub, pub = (broker.address(f"{name}.{what}", create=True) for what in ("events", "answers"))
    with ExitStack() as stack:
        replicas = [stack.enter_context(Service(acting, sub, pub, replica=str(number))) for number in (1, 2)]
        until(lambda: all(replica.group()["replicas"] == 2 for replica in replicas))
        for k in range(3, 6):
            assert replicas[k % 2].set_parameters({"k": k}).revision == k - 2
            until(lambda k=k: values(replicas) == [k, k])
        with Service(acting, sub, pub, replica="late") as late:
            until(lambda: late.parameters() == replicas[0].parameters())
            assert late.set_parameters({"k": 8}, 3).revision == 4
            until(lambda: values(replicas) == [8, 8])
        until(lambda: all(replica.group()["replicas"] == 2 for replica in replicas))


@pytest.mark.skipif(not nats_server.is_installed(), reason="no NATS server is installed")
@pytest.mark.slow
def test_a_service_stops_in_time_though_its_broker_does_not_answer(acting):
    with nats_server.server() as broker:
        service = Service(acting, broker.address("events", create="true"), broker.address("answers", create="true"))
        service.start()
        until(lambda: not service.group()["trouble"] and service.state == "READY")
        broker.process.send_signal(signal.SIGSTOP)
        try:
            began_s = monotonic()
            service.stop(0.5)
            took_s = monotonic() - began_s
        finally:
            broker.process.send_signal(signal.SIGCONT)
        assert service.state == "STOPPED"
        # Bounded by 0.5 s and the least that each end has; not by the 10 s that one broker's answer is waited for.
        assert took_s < 10.0
