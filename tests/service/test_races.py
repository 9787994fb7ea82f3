"""What two threads of a front do at once: changes of parameters, deploys, restarts, drains."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from types import SimpleNamespace

import pytest

from epypes.errors import RevisionConflict, ServiceError
from epypes.service.supervision.frame_socket import WorkerMessage
from epypes.service.supervision.worker_queries import WorkerQueries
from tests.service.bundles import written_bundle
from tests.service.served import SOURCE, TIMEOUT_S, acting_bundle, gated_bundle, serving, until

pytestmark = pytest.mark.slow

TABLE = '''
    """A function with a table among its hyperparameters."""


    def act(what, number, k, table):
        return number * k + 0 * len(table)


    func_dict = {"act": act}
    func_io = {"act": (("what", "number", "k", "table"), "out")}
'''


@pytest.fixture
def better(tmp_path):
    return acting_bundle(tmp_path / "better", k=3, expected=9)


def test_a_large_table_does_not_keep_a_new_worker_from_taking_the_parameters(tmp_path):
    sample = {"what": "plain", "number": 3}, {"out": 6}
    many = {"k": 2, "table": list(range(200_000))}
    bundle = written_bundle(tmp_path / "b", TABLE, ("what", "number"), ("out",), hyperparameters=many, sample=sample)
    with serving(bundle) as (service, peer):
        service.set_parameters({"k": 10})
        assert peer.ask(number=5).parts["out"] == 50
        os.kill(service.info()["worker_pid"], signal.SIGKILL)
        answer = peer.ask(number=5)
        assert (answer.parts["out"], answer.revision) == (50, 1)


def test_a_worker_that_refuses_the_parameters_of_the_last_one_is_not_used(tmp_path):
    once = tmp_path / "once"
    source = (
        SOURCE
        + f"""
    from epypes.pipeline import FullPipeline


    class Own(FullPipeline):
        def set(self, **values):
            if values.get("k") == 5 and os.path.exists({str(once)!r}):
                raise ValueError("not again")
            super().set(**values)


    def make_pipeline(*given):
        return Own("own", *given)
"""
    )
    sample = {"what": "plain", "number": 3}, {"out": 6}
    bundle = written_bundle(
        tmp_path / "own",
        source,
        ("what", "number"),
        ("out",),
        hyperparameters={"k": 2},
        sample=sample,
        own=("make_pipeline",),
    )
    with serving(bundle) as (service, peer):
        service.set_parameters({"k": 5})
        assert peer.ask(number=2).parts["out"] == 10
        once.touch()
        os.kill(service.info()["worker_pid"], signal.SIGKILL)
        until(lambda: service.state == "FAULTED")
        assert "does not take the parameters" in service.reason
        assert "not again" in service.reason


def test_a_worker_started_while_another_bundle_takes_over_is_not_used(better, tmp_path):
    gate = tmp_path / "gate"
    with serving(gated_bundle(tmp_path / "gated", gate)) as (service, peer):
        gate.touch()
        os.kill(service.info()["worker_pid"], signal.SIGKILL)
        until(lambda: service.state == "DEGRADED")
        served_by = service.deploy(better)["worker_pid"]
        gate.unlink()
        assert [peer.ask(number=number).parts["out"] for number in range(5)] == [0, 3, 6, 9, 12]
        assert (service.state, service.info()["worker_pid"]) == ("READY", served_by)


def test_changes_while_other_bundles_take_over_are_made_for_one_of_them_or_refused(acting, better):
    with serving(acting) as (service, peer):
        outcomes, is_over = [], threading.Event()

        def change():
            while not is_over.is_set():
                before = service.parameters().revision
                try:
                    outcomes.append(service.set_parameters({"k": before + 10}, before))
                except (RevisionConflict, ServiceError) as refusal:
                    outcomes.append(refusal)

        changing = threading.Thread(target=change)
        changing.start()
        for _ in range(3):
            service.deploy(better)
            service.rollback()
        is_over.set()
        changing.join()
        made = [outcome.revision for outcome in outcomes if not isinstance(outcome, Exception)]
        assert made == sorted(set(made))
        answer, current = peer.ask(number=5), service.parameters()
        assert (answer.parts["out"], answer.revision) == (5 * current.entries["k"]["value"], current.revision)


@pytest.mark.soak
def test_a_change_that_did_not_come_in_time_is_not_made_later(acting, tmp_path):
    with serving(acting) as (service, peer):
        peer.send(f"hold:{tmp_path}", 1)
        until((tmp_path / "started").exists)
        with pytest.raises(ServiceError, match="longer than 10 s, so nothing was changed"):
            service.set_parameters({"k": 77})
        (tmp_path / "release").touch()
        peer.take()
        assert peer.ask(number=1).parts["out"] == 2
        assert service.parameters().revision == 0
        assert service.set_parameters({"k": 7}).revision == 1
        assert peer.ask(number=1).parts["out"] == 7


# -- drain, stop, pause ---------------------------------------------------------------------------------------------


def test_a_service_that_was_drained_twice_resumes_where_it_was(acting, tmp_path):
    with serving(acting) as (service, peer):
        sub = service.service_state.sub
        peer.send(f"hold:{tmp_path}", 1)
        until((tmp_path / "started").exists)
        assert not service.drain(0.01)
        assert service.service_state.sub == sub
        (tmp_path / "release").touch()
        assert service.drain()
        service.resume()
        assert service.service_state.sub == sub
        peer.take()
        assert peer.ask(number=2).parts["out"] == 4


@pytest.mark.parametrize("how", ["stop", "resume"])
def test_a_drain_that_waits_holds_up_neither_the_stop_nor_a_resume(acting, tmp_path, how):
    with serving(acting, drain_timeout_s=0.2) as (service, peer):
        peer.send(f"hold:{tmp_path}", 1)
        until((tmp_path / "started").exists)
        drained = []
        draining = threading.Thread(target=lambda: drained.append(service.drain(1000)))
        draining.start()
        until(lambda: service.state == "DRAINING")
        getattr(service, how)()
        draining.join(TIMEOUT_S)
        assert not draining.is_alive()
        assert service.state == {"stop": "STOPPED", "resume": "READY"}[how]
        (tmp_path / "release").touch()
        peer.take()


# -- what is seen of it ---------------------------------------------------------------------------------------------


def test_what_another_bundle_has_shown_is_not_shown_for_this_one(acting, tmp_path):
    gate = tmp_path / "gate"
    gated = gated_bundle(tmp_path / "gated", gate, k=3, expected=9)
    with serving(acting) as (service, peer):
        peer.ask(number=5)
        assert service.preview("k")[1].splitlines()[0] == b"2"
        service.deploy(gated)
        gate.touch()
        os.kill(service.info()["worker_pid"], signal.SIGKILL)
        until(lambda: service.state == "DEGRADED")
        with pytest.raises(ServiceError, match="no worker"):
            service.preview("k")
        gate.unlink()


def test_answers_that_are_kept_for_when_there_is_no_worker_are_bounded_in_bytes():
    bundle = SimpleNamespace(digest="d", path="bundle")
    answer = WorkerMessage("answer", 1, {"media_type": "image/png"}, [memoryview(bytes(1024**2))])
    worker = SimpleNamespace(bundle=bundle, about={}, query=lambda what, **arguments: answer)
    workers = [worker]
    queries = WorkerQueries(lambda: bundle, lambda: workers[0])
    for side_px in range(60):
        queries.preview("out", side_px)
    workers[0] = None
    kept = []
    for side_px in range(60):
        with suppress(ServiceError):
            kept.append(queries.preview("out", side_px))
    assert len(kept) == 32
