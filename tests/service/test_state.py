"""State between events of a service: what each event finds, whatever happens to the worker, the event or the bundle."""

from __future__ import annotations

import contextlib
import os
import queue
import re
import signal
import warnings

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import DeployRefused, ServiceError, UnknownName
from epypes.service import Service
from epypes.service.http import HttpServer
from epypes.service.supervision.frame_socket import WorkerMessage
from epypes.wire import decode, encode
from tests.service.processes import running
from tests.service.served import acting_bundle, event, peer_of, serving, until
from tests.service.stateful import SOURCE, send_from, stateful_bundle, sums
from tests.service.states import read_state
from tests.service.test_brokered import line_of
from tests.service.workers import ready_worker

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def adding(tmp_path_factory):
    """A bundle that answers with the sum of the numbers so far."""
    return stateful_bundle(tmp_path_factory.mktemp("stateful") / "adding")


@pytest.fixture(scope="module")
def tenfold(tmp_path_factory):
    """The same, and the answer is ten times the sum."""
    return stateful_bundle(tmp_path_factory.mktemp("stateful") / "tenfold", k=10)


@pytest.fixture(scope="module")
def other_start(tmp_path_factory):
    """The same, whose sum begins with 1,000."""
    return stateful_bundle(tmp_path_factory.mktemp("stateful") / "other_start", initial=1_000)


def kill_worker(service):
    """Kill the worker; return when the front has noticed that."""
    worker = service.info()["worker_pid"]
    os.kill(worker, signal.SIGKILL)
    until(lambda: service.info()["worker_pid"] != worker)


# -- what an event begins with ----------------------------------------------------------------------------------------


def test_an_event_begins_with_what_the_one_before_has_left(adding):
    with serving(adding) as (service, peer):
        assert sums(peer, 1, 2, 3) == [1, 3, 6]
        # Without --state-per source the source means nothing.
        assert sums(peer, 4, source="left") == [10]
        states = service.info()["states"]
        assert (states["per"], states["tokens"], states["count"]) == ("one", {"before": "total"}, 1)


def test_a_worker_that_replaces_a_killed_one_goes_on_from_the_last_answered_event(adding, quick):
    with serving(adding) as (service, peer):
        kill_worker(service)
        assert sums(peer, 1, 2) == [1, 3]
        kill_worker(service)
        assert sums(peer, 3) == [6]
        kill_worker(service)
        assert sums(peer, 4, 5) == [10, 15]


@pytest.mark.parametrize(
    ("what", "why"),
    [
        ("fail", "before the sum"),
        ("fail late", "after the sum"),
        ("fail answer", "out is of type object, which has no codec"),
        ("object", "before is of type object, which has no codec"),
        ("hold", "did not return within"),
        ("kill", r"killed by SIGKILL.*\(2 times\).*dead letter"),
    ],
)
def test_an_event_that_fails_leaves_the_state_as_it_was(adding, quick, what, why):
    with serving(adding, job_timeout_s=2.0 if what == "hold" else 60.0) as (_, peer):
        assert sums(peer, 1, 2) == [1, 3]
        assert re.search(why, peer.ask(what, 100).failure.message)
        assert sums(peer, 3, 4) == [6, 10]
        assert re.search(why, peer.ask(what, 100).failure.message)
        assert sums(peer, 5) == [15]


@pytest.mark.parametrize("what", ["fail late", "fail answer"])
def test_after_a_first_event_that_fails_the_next_one_begins_with_the_initial_state(adding, what):
    with serving(adding) as (_, peer):
        assert peer.ask(what, 100).failure is not None
        assert sums(peer, 1) == [1]


def test_a_service_that_is_started_anew_begins_with_the_initial_state(adding):
    service = Service(adding)
    for _ in range(2):
        with service:
            assert service.state == "READY"
            with peer_of(service) as peer:
                assert sums(peer, 1, 2) == [1, 3]


def test_a_drained_service_that_is_resumed_goes_on(adding):
    with serving(adding) as (service, peer):
        assert sums(peer, 1) == [1]
        assert service.drain()
        service.resume()

        def has_joined():
            # What is sent before the publisher has joined the socket again gets no answer.
            peer.send(number=0)
            with contextlib.suppress(queue.Empty):
                return peer.take(timeout_s=1.0)[0].parts["out"] == 1
            return False

        until(has_joined)
        assert sums(peer, 2) == [3]


def test_a_promoted_graph_goes_on_with_its_pictures(photograph, tmp_path, quick):
    mix = ep.CompGraph({"mix": cv2.addWeighted}, {"mix": (("image", "new", "before", "old", "offset"), "mixed")})
    runner = ep.CompGraphRunner(
        ep.delay(mix, "mixed", "before", np.zeros_like(photograph)), {"new": 0.25, "old": 0.75, "offset": 0}
    )
    images = [np.roll(photograph, shift, 0) for shift in (0, 9, 18, 27)]
    expected = [runner.run(image=image)["mixed"] for image in images]
    runner.reset()
    runner.run(image=images[0])
    with serving(ep.promote(runner, tmp_path / "mix").path) as (service, peer):
        for image, mixed in zip(images, expected, strict=True):
            peer.send_parts(image=image)
            assert np.array_equal(peer.take()[0].parts["mixed"], mixed)
            kill_worker(service)


def test_a_nested_pipeline_has_its_state_too(tmp_path, quick):
    nested = (
        SOURCE[: SOURCE.index("    def with_delays")]
        + """
    cg = ep.CompGraph({"add": add}, {"add": (("what", "number", "before"), "total")})
    func_dict = {"sum": ep.Pipeline("sum", ep.delay(cg, "total", "before", 0)), "check": check}
    func_io = {"sum": (("what", "number"), "total"), "check": (("what", "total", "k"), "out")}
    """
    )
    bundle = stateful_bundle(tmp_path / "nested", source=nested, prefix="sum.")
    with serving(bundle) as (service, peer):
        assert sums(peer, 1, 2) == [1, 3]
        kill_worker(service)
        assert sums(peer, 3) == [6]
        assert service.info()["states"]["tokens"] == {"sum.before": "sum.total"}


# -- a state for each source ------------------------------------------------------------------------------------------


def test_each_source_has_a_state_of_its_own(adding, quick):
    with serving(adding, state_per="source", threads=2) as (service, peer):
        assert sums(peer, 1, 2, source="left") == [1, 3]
        assert sums(peer, 10, 20, source="right") == [10, 30]
        assert sums(peer, 3, source="left") == [6]
        assert sums(peer, 7) == [7]
        assert service.info()["states"]["count"] == 3
        kill_worker(service)
        assert sums(peer, 30, source="right") == [60]
        assert sums(peer, 4, source="left") == [10]


def test_events_of_one_source_are_in_order_beside_those_of_others(adding, tmp_path):
    with serving(adding, state_per="source", threads=4) as (_, peer):
        # It returns when an event of the other source runs beside it, or never.
        send_from(peer, "left", 1, f"wait:{tmp_path / 'beside'}")
        for number in (2, 3):
            send_from(peer, "left", number)
        send_from(peer, "right", 10, f"touch:{tmp_path / 'beside'}")
        send_from(peer, "left", 4)
        found = [(answer.request_source, answer.parts["out"]) for answer in peer.take(5)]
        assert [out for source, out in found if source == "left"] == [1, 3, 6, 10]
        assert ("right", 10) in found


def test_slots_that_work_on_many_sources_mix_up_none(adding, quick):
    names = [f"camera {number}" for number in range(7)]
    with serving(adding, state_per="source", threads=3, mailbox_size=1_000) as (service, peer):
        for number in range(70):
            send_from(peer, names[number % 7], number)
        found = [answer.parts["out"] for answer in peer.take(35)]
        kill_worker(service)
        found += [answer.parts["out"] for answer in peer.take(35)]
    # Those of one source come in their order, and of several sources in any.
    assert sorted(found) == sorted(sum(range(number % 7, number + 1, 7)) for number in range(70))


@pytest.mark.parametrize("bound", [{"MAX_SOURCES": 2}, {"MAX_BYTES": 120}])
def test_the_source_that_was_silent_for_the_longest_time_is_forgotten(adding, monkeypatch, caplog, bound):
    for name, value in bound.items():
        monkeypatch.setattr(f"epypes.service.event_states.{name}", value)
    with serving(adding, state_per="source") as (service, peer):
        assert sums(peer, 1, source="first") == [1]
        assert sums(peer, 2, source="second") == [2]
        assert sums(peer, 1, source="first") == [2]
        assert sums(peer, 3, source="third") == [3]
        states = service.info()["states"]
        assert (states["count"], states["forgotten"]) == (2, 1)
        assert sums(peer, 1, source="first") == [3]
        assert sums(peer, 2, source="second") == [2]
        assert "state of source 'second' is forgotten" in caplog.text


def test_a_worker_keeps_no_state_that_the_front_has_forgotten(adding, tmp_path):
    with ready_worker(adding, tmp_path) as front:

        def run(seq, **content):
            front.channel.send(WorkerMessage("event", seq, content, encode(event(number=seq))))
            header, answer = done(front)
            assert header["failure"] is None
            return answer.parts["out"]

        assert run(1, key="left", state="initial") == 1
        assert run(2, key="left", state="held") == 3
        # It has had an event since the front forgot it.
        assert run(3, key="right", state="initial", forget={"left": 1}) == 3
        assert run(4, key="left", state="held") == 7
        assert run(5, key="right", state="held", forget={"left": 4}) == 8
        front.channel.send(WorkerMessage("event", 6, {"key": "left", "state": "held"}, encode(event())))
        header, answer = done(front)
        assert (header["failure"]["function"], answer.failure.exception) == ("f_in", "KeyError")


def done(front):
    """Return the contents of the next ``done`` message, and its one answer; the state comes after its frames."""
    message = front.receive("done")
    (size,) = message.content["answers"]
    assert len(message.frames) == size + message.content.get("has_state", False)
    return message.content, decode(message.frames[:size])


# -- reset ------------------------------------------------------------------------------------------------------------


def test_after_a_reset_the_next_event_begins_anew(adding, quick):
    with serving(adding) as (service, peer):
        assert service.reset() == 0
        assert sums(peer, 1, 2) == [1, 3]
        assert service.reset() == 1
        assert sums(peer, 4) == [4]
        service.reset()
        kill_worker(service)
        assert sums(peer, 5, 6) == [5, 11]
        with pytest.raises(ServiceError, match="All events have one state.*--state-per source"):
            service.reset("left")


def test_a_reset_while_an_event_is_in_flight_holds_for_the_next_one(adding, tmp_path):
    with serving(adding) as (service, peer):
        assert sums(peer, 1) == [1]
        peer.send(f"wait:{tmp_path / 'go'}", 2)
        until(lambda: service.counts()["in_flight"] == 1)
        service.reset()
        (tmp_path / "go").touch()
        assert peer.take()[0].parts["out"] == 3
        assert sums(peer, 4, 5) == [4, 9]


def test_the_state_of_one_source_is_reset(adding):
    with serving(adding, state_per="source") as (service, peer):
        assert sums(peer, 1, source="left") == sums(peer, 1, source="right") == [1]
        assert service.reset("left") == 1
        assert sums(peer, 1, source="left") == [1]
        assert sums(peer, 1, source="right") == [2]
        with pytest.raises(UnknownName, match="'rigth'.*Did you mean 'right'"):
            service.reset("rigth")
        assert service.reset() == 2
        assert sums(peer, 1, source="right") == [1]


def test_a_bundle_without_state_has_nothing_to_reset(acting):
    with serving(acting) as (service, peer):
        assert peer.ask(number=2).parts["out"] == 4
        assert service.info()["states"] is None
        with pytest.raises(ServiceError, match=r"nothing to reset.*ep\.delay"):
            service.reset()


# -- another bundle ---------------------------------------------------------------------------------------------------


def test_a_deploy_keeps_the_state_if_the_delays_are_the_same(adding, tenfold):
    with serving(adding) as (service, peer):
        assert sums(peer, 1, 2) == [1, 3]
        assert service.deploy(tenfold)["changed"] == ["k 1 -> 10", "state between events kept"]
        assert sums(peer, 3) == [60]
        assert service.rollback()["changed"][-1] == "state between events kept"
        assert sums(peer, 4) == [10]


def test_a_deploy_resets_the_state_if_it_shall(adding, tenfold):
    with serving(adding) as (service, peer):
        assert sums(peer, 1, 2) == [1, 3]
        assert service.deploy(tenfold, "reset")["changed"][-1] == "state between events reset"
        assert sums(peer, 3) == [30]
        assert service.rollback("reset")["changed"][-1] == "state between events reset"
        assert sums(peer, 4) == [4]


def test_a_deploy_of_other_delays_begins_anew_and_says_so_or_is_refused(adding, other_start):
    with serving(adding) as (service, peer):
        assert sums(peer, 1, 2) == [1, 3]
        with pytest.raises(DeployRefused, match="can't go on with the state.*before of total begins with another"):
            service.deploy(other_start, "keep")
        assert sums(peer, 3) == [6]
        line = "state between events reset: before of total begins with another value"
        assert service.deploy(other_start)["changed"] == [line]
        assert sums(peer, 1) == [1_001]


def test_a_bundle_without_state_takes_over_and_gives_back(adding, tmp_path):
    stateless = acting_bundle(tmp_path / "stateless", k=1, expected=3)
    with serving(adding) as (service, peer):
        assert sums(peer, 1, 2) == [1, 3]
        assert service.deploy(stateless)["changed"][-1] == "state between events reset: before of total -> none"
        assert sums(peer, 5, 5) == [5, 5]
        assert service.rollback()["changed"][-1] == "state between events reset: none -> before of total"
        assert sums(peer, 1, 2) == [1, 3]


# -- what can't be ----------------------------------------------------------------------------------------------------


def test_threads_that_would_mix_up_one_state_are_refused(adding, acting):
    refusal = r"has state between events \('before'\), and on 2 threads .*--threads 1.*--state-per source"
    with pytest.raises(ServiceError, match=refusal):
        Service(adding, threads=2)
    with serving(acting, threads=2) as (service, peer):
        with pytest.raises(DeployRefused, match=refusal):
            service.deploy(adding)
        assert peer.ask(number=2).parts["out"] == 4


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"state_per": "camera"}, "per 'one' or 'source', not per 'camera'"),
        ({"partitioned": True, "state_per": "source"}, "where a broker delivers them.*--sub amqp"),
    ],
)
def test_options_that_mean_nothing_are_refused(adding, options, why):
    with pytest.raises(ServiceError, match=why):
        Service(adding, **options)


def test_a_second_replica_is_refused_unless_events_are_partitioned_by_source(adding):
    with line_of("stateful") as line, Service(adding, line.sub, line.pub, replica="1") as first:
        line.send(number=1)
        assert line.take()[0].parts["out"] == 1
        with Service(adding, line.sub, line.pub, replica="2") as second:
            until(lambda: second.state == "FAULTED")
            assert "replica 1 at" in second.reason
            assert "each would see a part" in second.reason
            for number in (2, 3, 4):
                line.send(number=number)
            # The second one may have taken an event and given it back, which then comes last.
            assert max(answer.parts["out"] for answer in line.take(3)) == 10
        partitioned = {"state_per": "source", "partitioned": True}
        with Service(adding, line.sub, line.pub, replica="3", **partitioned) as third:
            until(lambda: third.group()["replicas"] == 2)
            # Both get events of the queue.
            until(lambda: line.send() and line.take() and third.counts()["answered"] > 0)
            assert (third.state, first.state) == ("READY", "READY")


# -- failures, pictures, HTTP and the command line --------------------------------------------------------------------


def test_a_failure_opens_with_the_state_that_its_event_began_with(adding):
    with serving(adding) as (service, peer), HttpServer(service, "127.0.0.1:0") as server:
        assert sums(peer, 1, 2) == [1, 3]
        failed = peer.ask("fail late", 100).failure.input_id
        assert sums(peer, 50) == [53]
        assert service.failure_store.flush()
        for source in (adding, server.url):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                runner = ep.load_failure(failed, source)
            assert (runner.last.failure.function, runner["before"], runner["total"]) == ("check", 3, 103)
            assert dict(runner.state) == {"before": 3}


def test_a_worker_that_is_killed_is_looked_into_with_the_state_of_its_event(tmp_path, quick):
    source = stateful_source_that_dies_at(3)
    bundle = stateful_bundle(tmp_path / "dying", source=source)
    with serving(bundle, retries=0) as (service, peer):
        assert sums(peer, 1, 2) == [1, 3]
        failed = peer.ask("plain", 100).failure.input_id
        assert service.failure_store.flush()
    runner = ep.load_failure(failed, bundle)
    assert (runner.last.failure.function, runner["before"], runner["total"]) == ("check", 3, 103)


def stateful_source_that_dies_at(before):
    """Return the source of a bundle whose second function kills the process if the sum before was this."""
    return SOURCE.replace(
        "def check(what, total, k):",
        "def check(what, total, k, before):\n"
        + " " * 8
        + f"if before == {before}:\n"
        + " " * 12
        + "os.kill(os.getpid(), 9)",
    ).replace('"check": (("what", "total", "k"), "out")', '"check": (("what", "total", "k", "before"), "out")')


def test_a_panel_on_a_service_tries_values_on_the_last_event_with_its_state(adding):
    with serving(adding) as (service, peer), HttpServer(service, "127.0.0.1:0") as server:
        assert sums(peer, 1, 2, 3) == [1, 3, 6]
        with ep.connect(server.url, token=server.access_key_file.read_text().strip()) as connection:
            runner = connection.to_tune()
            assert dict(runner.cg.delays) == {"before": ("total", None)}
            assert runner.free_source_tokens == ("what", "number")
            for k in (10, 100):
                run = runner.trial({"k": k})
                assert (run["before"], run["total"], run["out"]) == (3, 6, 6 * k)
        assert sums(peer, 4) == [1_000]


def test_the_commands_show_and_reset_the_state(adding, tenfold, epypes):
    with running(adding, "--http", "127.0.0.1:0", "--state-per", "source", "--threads", "2") as service:
        assert service.ready.startswith("READY")
        state = read_state(adding)
        for _ in range(2):
            assert epypes("call", adding, 'what="plain"', "number=5").returncode == 0
        shown = epypes("status", adding).stdout
        assert re.search(r"State between events: before of total; 1 source, \d+ bytes\.", shown), shown
        assert "Did you mean 'epypes call'" in epypes("reset", adding, "--source", "epypes cal").stderr
        done = epypes("reset", adding, "--source", "epypes call")
        assert done.stdout == "RESET the state between events of source epypes call.\n", done.stderr
        assert epypes("call", adding, 'what="plain"', "number=5").stdout.startswith("out = 5")
        assert epypes("reset", state.http).stdout == "RESET the state between events.\n"
        assert epypes("call", adding, 'what="plain"', "number=6").stdout.startswith("out = 6")
        deployed = epypes("deploy", tenfold, "--http", state.http, "--state", "keep").stdout
        assert "state between events kept." in deployed
        assert epypes("call", tenfold, 'what="plain"', "number=1").stdout.startswith("out = 70")
        assert "events reset." in epypes("rollback", "--http", state.http, "--state", "reset").stdout
        with ep.connect(state.http, token="wrong") as stranger, pytest.raises(ServiceError, match="access key"):
            stranger.reset()
        with ep.connect(state.http) as connection:
            assert connection.reset()["states"]["count"] == 0
    refused = epypes("serve", adding, "--threads", "2")
    assert refused.returncode == 1
    assert "on 2 threads its events have no order" in refused.stderr
