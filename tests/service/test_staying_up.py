from __future__ import annotations

import os
import queue
import shutil
import signal
import threading

import psutil
import pytest

from epypes.bundle.manifest import write_manifest
from epypes.errors import (
    DeployRefused,
    NotComputed,
    ParametersRefused,
    RevisionConflict,
    ServiceError,
    UnknownName,
)
from epypes.service import Service
from epypes.service.supervision.packing import unpack
from epypes.wire import decode
from tests.service.served import SOURCE, TIMEOUT_S, acting_bundle, peer_of, serving, until

pytestmark = pytest.mark.slow


def started(folder):
    until((folder / "started").exists)


def kill_worker(service):
    """Kill the worker, and wait for the next."""
    before = service.info()["restarts"]
    os.kill(service.info()["worker_pid"], signal.SIGKILL)
    until(lambda: service.info()["restarts"] == before + 1 and service.state == "READY")


@pytest.fixture(scope="module")
def steady(acting, tmp_path_factory):
    """A service and its peer, for all tests that end with the parameters and the worker that they began with."""
    with pytest.MonkeyPatch.context() as own:
        own.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        with serving(acting, threads=3, mailbox_size=1000) as (service, peer):
            yield service, peer


@pytest.fixture
def tuned(steady):
    """Set the parameters of the steady service back at the end."""
    service, _ = steady
    yield service.parameters().revision
    service.set_parameters({"k": 2})


# -- what kills the worker ------------------------------------------------------------------------------------------


FORKING = """
    import ctypes
    import os
    import signal


    def act(what, number, k):
        if what == "die":
            # In C, so that no hook of Python closes the child's sockets.
            libc = ctypes.CDLL(None)
            child = libc.fork()
            if child == 0:
                libc.pause()
            with open({path!r}, "a") as file:
                print(child, file=file)
            os.kill(os.getpid(), signal.SIGKILL)
        return number * k


    func_dict = {{"act": act}}
    func_io = {{"act": (("what", "number", "k"), "out")}}
"""


def test_a_worker_that_dies_is_replaced_though_a_child_of_it_lives(tmp_path, quick):
    path = tmp_path / "child"
    bundle = acting_bundle(tmp_path / "forking", source=FORKING.format(path=str(path)))
    with serving(bundle) as (_, peer):
        try:
            assert "was killed by SIGKILL" in peer.ask("die").failure.message
            assert peer.ask("plain", 4).parts["out"] == 8
        finally:
            for child in path.read_text().split():
                os.kill(int(child), signal.SIGKILL)


@pytest.mark.parametrize("how", ["kill", "segv", "exit"])
def test_a_frame_that_kills_the_worker_is_a_dead_letter_and_the_others_are_answered_in_order(acting, how, quick):
    with serving(acting, mailbox_size=100) as (service, peer):
        for number in range(12):
            peer.send(how if number == 7 else "plain", number)
        answers = peer.take(12)
        assert [answer.correlation_id for answer in answers] == peer.sent
        assert [answer.parts["out"] for answer in answers if answer.failure is None] == [
            2 * n for n in range(12) if n != 7
        ]
        dead = answers[7].failure
        assert "The event is a dead letter" in dead.message
        until(lambda: service.state == "READY" and service.counts()["answered"] == 11)
        counts = service.counts()
        assert (counts["dead_letters"], counts["retried"]) == (1, 1)
        reported = peer.failures.get(timeout=TIMEOUT_S)
        assert reported.correlation_id == peer.sent[7]
        assert service.failure_store.flush()
        (record,) = service.failure_records()
        assert (record.kind, record.dead_letter, record.attempt, record.event_id) == ("killed", True, 2, peer.sent[7])
        assert record.function == ("act" if how == "segv" else "worker")
        assert service.failure_store.event(record.id).parts["what"] == how
        assert service.info()["restarts"] == 2


def test_a_worker_killed_from_outside_costs_no_event(acting, quick):
    with serving(acting, mailbox_size=400) as (service, peer):
        for number in range(300):
            peer.send("sleep:0.003", number)
            if number % 100 == 50:
                # What it works on has not met a death before: twice would be too often.
                until(lambda least=number - 40: service.counts()["answered"] >= least)
                kill_worker(service)
        answers = peer.take(300)
        assert [answer.correlation_id for answer in answers] == peer.sent
        assert [answer.parts["out"] for answer in answers] == [2 * number for number in range(300)]
        until(lambda: service.counts()["answered"] == 300)
        assert service.info()["restarts"] == 3


def test_with_three_slots_only_the_culprit_is_put_aside(acting):
    with serving(acting, threads=3, mailbox_size=100, retries=0) as (service, peer):
        for number in range(30):
            peer.send("kill" if number == 11 else "sleep:0.01", number)
        answers = peer.take(30)
        assert [answer.correlation_id for answer in answers] == peer.sent
        assert [n for n, answer in enumerate(answers) if answer.failure] == [11]
        assert service.counts()["dead_letters"] == 1


def test_frames_that_kill_the_worker_one_after_another_are_put_aside_and_the_service_stays_up(acting, quick):
    """As many deaths in a row would be a fault if no event had caused them."""
    with serving(acting, mailbox_size=100, retries=0) as (service, peer):
        for number in range(5):
            peer.send("kill", number)
        assert all("The event is a dead letter" in answer.failure.message for answer in peer.take(5))
        assert peer.ask(number=4).parts["out"] == 8
        assert service.state == "READY"
        assert service.counts()["dead_letters"] == 5


def test_events_that_do_not_return_one_after_another_are_reported_and_the_service_stays_up(acting, quick):
    states = []
    with serving(acting, mailbox_size=100, job_timeout_s=0.1) as (service, peer):
        service.listen(lambda kind, data: states.append(data["state"]) if kind == "state" else None)
        for number in range(5):
            peer.send("sleep:100", number)
        assert all("did not return within 0.1 s" in answer.failure.message for answer in peer.take(5))
        assert peer.ask_until_answered(number=4).parts["out"] == 8
    assert "FAULTED" not in states


def test_a_worker_that_ends_as_soon_as_it_is_ready_is_a_fault_and_is_reported(acting, tmp_path, quick):
    dying = "\n    import threading\n    threading.Timer(0.2, os._exit, [9]).start()\n"
    bundle = acting_bundle(tmp_path / "dying", source=SOURCE + dying)
    with Service(bundle) as service, peer_of(service) as peer:
        until(lambda: service.state == "FAULTED")
        assert "5 workers ended in a row as soon as they were started. The last: The worker ended with status 9" in (
            service.reason
        )
        assert service.alive() == service.reason
        assert "can't be served" in peer.ask().failure.message
        service.deploy(acting)
        assert (service.state, service.alive()) == ("READY", "")
        assert peer.ask(number=4).parts["out"] == 8


# -- what does not return -------------------------------------------------------------------------------------------


def test_a_worker_that_was_stopped_is_replaced(acting):
    with serving(acting, job_timeout_s=0.3) as (service, peer):
        worker = psutil.Process(service.info()["worker_pid"])
        worker.suspend()
        until(lambda: worker.status() == psutil.STATUS_STOPPED)
        failure = peer.ask().failure
        assert "did not return within 0.3 s" in failure.message
        assert peer.ask_until_answered(number=3).parts["out"] == 6


def test_what_runs_beside_a_stuck_event_is_tried_again(acting, tmp_path):
    with serving(acting, threads=2, job_timeout_s=2.0) as (service, peer):
        peer.send(f"hold:{tmp_path}", 1)
        started(tmp_path)
        late = threading.Event()
        # It begins when half of the other's time is over, and ends when it is tried again.
        late.wait(1.0)
        peer.send(f"hold_once:{tmp_path}", 2)
        stuck, good = peer.take(2)
        assert stuck.failure is not None
        assert good.parts["out"] == 4
        assert service.counts()["retried"] == 1


def test_an_event_that_waits_in_the_worker_for_a_change_has_its_time_from_when_it_is_begun(acting):
    with serving(acting, threads=2, job_timeout_s=2.0) as (service, peer):
        peer.send("sleep:1.1", 1)
        until(lambda: service.counts()["in_flight"] == 1)
        changing = threading.Thread(target=service.set_parameters, args=({"k": 3},))
        changing.start()
        # It is given to the worker now, which begins it when the first is done and the change is made.
        peer.send("sleep:1.1", 2)
        assert [answer.failure for answer in peer.take(2)] == [None, None]
        changing.join()
        assert service.info()["restarts"] == 0


# -- order and load -------------------------------------------------------------------------------------------------


def test_answers_keep_the_order_of_events_though_slots_differ_in_speed(steady):
    _, peer = steady
    sent = [peer.send(("sleep:0.03", "plain", "sleep:0.005", "fail:odd")[number % 4], number) for number in range(40)]
    answers = peer.take(40)
    assert [answer.correlation_id for answer in answers] == sent
    assert [answer.failure is None for answer in answers] == [True, True, True, False] * 10


def test_a_failed_event_is_told_on_both_sockets_and_its_trace_is_kept(steady):
    service, peer = steady
    heard = queue.SimpleQueue()
    forget = service.listen(lambda kind, data: heard.put(data) if kind == "failure" else None)
    answer = peer.ask("fail:oh no")
    assert (answer.failure.function, answer.failure.exception) == ("act", "ValueError")
    while (reported := peer.failures.get(timeout=TIMEOUT_S)).correlation_id != answer.correlation_id:
        pass
    assert reported.failure == answer.failure
    while (record := heard.get(timeout=TIMEOUT_S))["event_id"] != answer.correlation_id:
        pass
    forget()
    assert record["message"] == "oh no"
    assert any("raise ValueError(text)" in line for line in record["trace"])
    peer.ask("fail:again")
    assert heard.empty()


def test_events_that_come_while_it_loads_wait_in_the_mailbox(acting):
    service = Service(acting)
    thread = threading.Thread(target=service.start)
    thread.start()
    try:
        until(lambda: service.state != "STOPPED")
        with peer_of(service) as peer:
            assert peer.ask(number=5).parts["out"] == 10
    finally:
        thread.join()
        service.stop()


def test_a_paused_service_keeps_events_and_goes_on_with_them(acting):
    with serving(acting, mailbox_size=3) as (service, peer):
        service.pause()
        assert service.state == "PAUSED"
        for number in range(5):
            peer.send(number=number)
        dropped = peer.take(2)
        assert [answer.correlation_id for answer in dropped] == peer.sent[:2]
        assert service.counts()["waiting"] == 3
        assert "Events wait" in service.ready()
        service.resume()
        assert [answer.parts["out"] for answer in peer.take(3)] == [4, 6, 8]


# -- its parameters -------------------------------------------------------------------------------------------------


def test_every_output_is_computed_with_the_parameters_of_its_revision(steady, tuned):
    service, peer = steady
    values = {tuned: 2}
    for k in range(10, 30):
        # Some of them are worked on, others wait, when the change is made.
        for _ in range(5):
            peer.send(number=1)
        values[service.set_parameters({"k": k}).revision] = k
    answers = peer.take(100)
    assert all(answer.parts["out"] == values[answer.revision] for answer in answers)
    revisions = [answer.revision for answer in answers]
    assert revisions == sorted(revisions)
    assert sorted(values) == list(range(tuned, tuned + 21))


def test_parameters_outlive_the_worker(steady, tuned):
    service, peer = steady
    assert service.set_parameters({"k": 7}, revision=tuned).revision == tuned + 1
    os.kill(service.info()["worker_pid"], signal.SIGKILL)
    answer = peer.ask(number=3)
    assert (answer.parts["out"], answer.revision) == (21, tuned + 1)


def test_a_change_that_cannot_be_made_changes_nothing_and_says_why(steady, tuned):
    service, peer = steady
    with pytest.raises(ParametersRefused) as refused:
        service.set_parameters({"k": 5, "kk": 1, "n": 2})
    assert set(refused.value.problems) == {"kk", "n"}
    assert "Did you mean 'k'?" in refused.value.problems["kk"]
    with pytest.raises(ParametersRefused, match="'k' is a whole number, and 'two' is a text"):
        service.set_parameters({"k": "two"})
    assert service.parameters().revision == tuned
    service.set_parameters({"k": 3})
    with pytest.raises(RevisionConflict) as conflict:
        service.set_parameters({"k": 4}, revision=tuned)
    assert conflict.value.current.entries["k"]["value"] == 3
    assert peer.ask(number=1).parts["out"] == 3


# -- what is seen of it ---------------------------------------------------------------------------------------------


def test_the_last_run_can_be_looked_at(acting):
    with serving(acting) as (service, peer):
        with pytest.raises(NotComputed):
            service.preview("out")
        sent = peer.ask(number=4).correlation_id
        assert service.preview("out")[1].splitlines()[0] == b"8"
        with pytest.raises(UnknownName, match="Did you mean 'out'"):
            service.preview("outt")
        values = decode(unpack(service.run(["out", "number"])))
        assert (dict(values.parts), values.correlation_id) == ({"out": 8, "number": 4}, sent)
        revision = service.set_parameters({"k": 10}).revision
        again = decode(unpack(service.run(["out"], revision=revision)))
        assert (again.parts["out"], again.revision) == (40, 1)
        assert service.graph_svg().startswith(b"<svg")
        assert b'"act"' in service.view()
        assert service.info()["func_io"] == {"act": [["what", "number", "k"], ["out"]]}


# -- other bundles --------------------------------------------------------------------------------------------------


@pytest.fixture
def better(tmp_path):
    return acting_bundle(tmp_path / "better", k=100, expected=300)


def test_a_good_bundle_takes_over_under_load_and_can_be_rolled_back(acting, better):
    with serving(acting, threads=2, mailbox_size=10_000) as (service, peer):
        stop, sent = threading.Event(), []

        def load():
            while not stop.is_set():
                sent.append(peer.send("sleep:0.001", 1))
                until(lambda: service.counts()["waiting"] < 20)

        loading = threading.Thread(target=load)
        loading.start()
        first = service.info()["digest"]
        info = service.deploy(better)
        assert (info["revision"], info["digest"] != first, info["bundle"]) == (1, True, str(better))
        assert service.rollback()["digest"] == first
        stop.set()
        loading.join()
        answers = peer.take(len(sent))
        assert [answer.correlation_id for answer in answers] == sent
        by_revision = {0: 2, 1: 100, 2: 2}
        assert all(answer.parts["out"] == by_revision[answer.revision] for answer in answers)
        assert {answer.bundle_digest for answer in answers if answer.revision != 1} == {first}
        until(lambda: service.counts()["answered"] == len(sent))


def test_a_bundle_that_is_not_good_leaves_the_other_one_serving(acting, tmp_path):
    wrong = acting_bundle(tmp_path / "wrong", expected=7)
    torn = acting_bundle(tmp_path / "torn")
    (torn / "pipeline.py").write_text("x = 1\n")
    other = acting_bundle(
        tmp_path / "other", inputs=("what", "number", "more"), source=SOURCE.replace("(what, number, k)", "(what, number, k, more)")
        .replace('("what", "number", "k")', '("what", "number", "k", "more")'),
    )  # fmt: skip
    killer = acting_bundle(tmp_path / "killer", source=SOURCE + "\n    os._exit(4)\n")
    with serving(acting) as (service, peer):
        before = service.info()
        for path, why in [
            (wrong, "'out'"), (torn, "pipeline.py was changed"), (other, "other ports"), (killer, "ended with status 4"),
            (tmp_path / "none", "does not exist"),
        ]:  # fmt: skip
            with pytest.raises(DeployRefused, match=why):
                service.deploy(path)
            assert peer.ask(number=2).parts["out"] == 4
        with pytest.raises(DeployRefused, match="No bundle was served before"):
            service.rollback()
        after = service.info()
        assert {key for key in before if before[key] != after[key]} == {"counts"}


def test_a_bundle_that_was_exchanged_behind_its_back_is_not_served_unasked_and_its_last_run_is_still_shown(
    acting, tmp_path
):
    copy = shutil.copytree(acting, tmp_path / "copy")
    with serving(copy) as (service, peer):
        settings = copy / "pipeline.toml"
        settings.write_text(settings.read_text() + "\n")
        write_manifest(copy)
        assert peer.ask(number=2).parts["out"] == 4
        view = service.view()
        os.kill(service.info()["worker_pid"], signal.SIGKILL)
        until(lambda: service.state == "FAULTED")
        assert "Deploy it" in service.reason
        assert service.view() == view
        with pytest.raises(ServiceError, match="no worker"):
            service.run(["out"])
        service.deploy(copy)
        assert peer.ask(number=2).parts["out"] == 4
