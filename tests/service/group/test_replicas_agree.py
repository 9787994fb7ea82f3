from __future__ import annotations

import itertools
import json
from contextlib import ExitStack, contextmanager

import httpx
import pytest
from httpx_sse import EventSource

from epypes.bundle.seal import check_seal
from epypes.errors import ParametersRefused
from epypes.service import Service
from epypes.service.group.notices import written
from epypes.service.group.revisions import Proposal
from epypes.service.http import HttpServer
from epypes.transport.channels import memory, open_channel, place_of
from epypes.wire import encode
from tests.service.served import acting_bundle, event, until
from tests.service.test_brokered import line_of, replica_of

_numbers = itertools.count(1)


@pytest.fixture
def host():
    """The name of a broker of its own."""
    return f"group{next(_numbers)}"


@contextmanager
def group_of(bundle, line, count=2, **options):
    """Serve a bundle so many times, until all know each other."""
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
    """Three replicas, and who sends them events."""
    with pytest.MonkeyPatch.context() as own:
        own.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        with line_of("trio") as line, group_of(acting, line, 3) as replicas:
            yield line, replicas


@pytest.fixture(scope="module")
def http(trio, tmp_path_factory):
    """The control of the first of them."""
    _, (first, *_) = trio
    with HttpServer(first, "127.0.0.1:*", token_file=tmp_path_factory.mktemp("token") / "token") as server:
        headers = {"Authorization": f"Bearer {server.token_file.read_text().strip()}"}
        with httpx.Client(base_url=server.url, trust_env=False, timeout=60, headers=headers) as client:
            yield client


def revisions(replicas):
    return [replica.parameters().revision for replica in replicas]


def values(replicas):
    return [replica.parameters().entries["k"]["value"] for replica in replicas]


@pytest.mark.slow
def test_replicas_share_the_events_and_know_each_other(trio):
    line, replicas = trio
    sent = [line.send(number=number) for number in range(60)]
    answers = line.take(60)
    assert sorted(answer.correlation_id for answer in answers) == sorted(sent)
    for replica in replicas:
        until(lambda replica=replica: replica.group()["counts"]["answered"] == 60)
        told = replica.group()
        assert [each["replica"] for each in told["members"]] == ["1", "2", "3"]
        assert [each["is_self"] for each in told["members"]] == [each is replica for each in replicas]
        assert all(each["heard_s"] < 3.5 and each["counts"]["answered"] for each in told["members"])
        assert (told["ready"], told["agree"], told["trouble"]) == (3, True, "")


@pytest.mark.slow
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


def test_what_a_worker_refuses_no_replica_is_told(trio):
    _, replicas = trio
    before = len(memory._broker("trio").logs["events.parameters"])
    for wrong in ({"k": "five"}, {"gain": 5}):
        with pytest.raises(ParametersRefused):
            replicas[0].set_parameters(wrong)
    assert len(memory._broker("trio").logs["events.parameters"]) == before


def test_a_change_over_http_is_refused_by_a_replica_that_knows_of_a_later_one(trio, http):
    _, (_, _, third) = trio
    before = http.get("/v1/parameters").json()["revision"]
    assert third.set_parameters({"k": 7}, before).revision == before + 1
    refused = http.patch("/v1/parameters", json={"revision": before, "values": {"k": 8}})
    assert refused.status_code == 409
    assert refused.json()["parameters"]["k"]["value"] == 7
    assert http.patch("/v1/parameters", json={"values": {"k": 8}}).json()["revision"] == before + 2


def test_any_replica_answers_for_all_over_http(trio, http):
    _, (first, *_) = trio
    told = http.get("/v1/group").json()
    assert told["replicas"] == 3
    assert [each["pid"] for each in told["members"]] == [first.info()["pid"]] * 3
    assert told["lost"] == []
    assert told["members"][0].keys() >= {"host", "state", "reason", "revision", "digest", "counts", "http", "heard_s"}
    metrics = http.get("/metrics").text
    assert "epypes_group_replicas 3.0" in metrics
    assert "epypes_group_ready 3.0" in metrics
    assert "epypes_group_lost 0.0" in metrics


@pytest.mark.slow
def test_listeners_hear_of_the_group_each_second(http):
    with http.stream("GET", "/v1/events", params={"for_s": 1.5}) as answer:
        told = [json.loads(each.data) for each in EventSource(answer).iter_sse() if each.event == "group"]
    assert len(told) >= 2
    assert told[0]["replicas"] == 3


@pytest.mark.slow
def test_a_service_on_a_socket_is_a_group_of_its_own(acting):
    told = Service(acting).group()
    assert (told["is_shared"], told["replicas"], told["agree"]) == (False, 1, True)
    assert told["members"][0]["state"] == "STOPPED"


@pytest.mark.slow
def test_who_ends_is_not_waited_for(acting, host):
    with line_of(host) as line, group_of(acting, line) as (first, second):
        second.stop()
        until(lambda: first.group()["replicas"] == 1)


@pytest.mark.slow
def test_who_joins_late_has_the_revision_of_the_group_from_its_first_event_on(acting, host):
    with line_of(host) as line, replica_of(acting, line, replica="1") as first:
        for number in range(5):
            first.set_parameters({"k": 10 + number})
        first.pause()
        line.send(number=1)
        with replica_of(acting, line, replica="2") as second:
            line.send(number=1)
            line.send(number=1)
            (answer, *_) = line.take(1)
            assert (answer.revision, answer.parts["out"]) == (5, 14)
            assert second.parameters() == first.parameters()
            first.resume()
            line.take(2)


@pytest.mark.slow
def test_a_worker_that_is_started_again_has_the_revision_of_the_group(acting, host):
    with line_of(host) as line, group_of(acting, line) as (first, second):
        first.set_parameters({"k": 7})
        until(lambda: second.parameters().revision == 1)
        first.stop()
        line.send("exit", 1)
        (answer,) = line.take()
        assert answer.failure is not None
        line.send(number=2)
        (answer,) = line.take()
        assert (answer.revision, answer.parts["out"]) == (1, 14)


@pytest.mark.slow
def test_another_bundle_begins_with_a_revision_that_its_replicas_share(acting, host, tmp_path):
    other = acting_bundle(tmp_path / "other", k=4, expected=12)
    with line_of(host) as line, group_of(acting, line) as replicas:
        replicas[0].set_parameters({"k": 3})
        until(lambda: revisions(replicas) == [1, 1])
        assert replicas[0].deploy(other)["revision"] == 2
        assert replicas[0].group()["agree"] is False
        assert replicas[0].set_parameters({"k": 6}).revision == 3
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
def test_what_another_program_has_written_into_the_log_is_not_computed_with(acting, host, tmp_path):
    other = acting_bundle(tmp_path / "other", k=4, expected=12)
    with line_of(host) as line, group_of(acting, line, 1) as (replica,):
        log = open_channel(place_of(line.sub).beside("parameters", "log"))
        for digest in (replica.info()["digest"], check_seal(other)):
            log.send((written(Proposal(digest, digest, 0, 4, {"k": {"value": float("nan")}})),))
        until(lambda: "revision 4" in replica.group()["members"][0]["trouble"])
        line.send(number=2)
        (answer,) = line.take(1)
        assert answer.revision == 0
        assert replica.deploy(other)["state"] == "READY", "with its own values"
        line.send(number=2)
        (answer,) = line.take(1)
        assert int(answer.parts["out"]) == 8
        assert replica.set_parameters({"k": 5}).revision > 5
        replica.rollback()
        assert replica.state == "READY"
        assert replica.set_parameters({"k": 6}).entries["k"]["value"] == 6


@pytest.mark.slow
def test_an_event_that_another_has_answered_is_not_worked_on_again(acting, host):
    with line_of(host) as line, group_of(acting, line) as (first, second):
        sent = line.send(number=1)
        line.take()
        other = second if first.counts()["answered"] else first
        # As a broker does that has not heard the acknowledgement.
        until(lambda: first.counts()["answered"] + second.counts()["answered"] == 1)
        done_by = first if first.counts()["answered"] else second
        done_by.pause()
        until(lambda: sent in other._endpoints.events._subscriber._arrivals.seen._done)
        done_by.drain(5.0)
        channel = open_channel(place_of(line.sub))
        try:
            channel.send(encode(event(number=1)), id=sent)
        finally:
            channel.close()
        until(lambda: other.counts()["duplicates"] == 1)
        assert line.left() == 0
        assert other.counts()["received"] == 0
