"""What two threads do at once: changes of parameters, deploys, restarts, drains."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import psutil
import pytest

from epypes.errors import RevisionConflict, ServiceError
from epypes.service import parameters, worker_queries
from tests.service.bundles import written_bundle
from tests.service.served import SOURCE, TIMEOUT_S, acting_bundle, serving, until

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
    many = {"k": 2, "table": list(range(50_000))}
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


def workers():
    """Return the process numbers of all workers of this process."""
    return [each.pid for each in psutil.Process().children() if "epypes.service.worker" in each.cmdline()]


def test_a_worker_started_while_another_bundle_takes_over_is_not_used(better, tmp_path):
    held, begun = tmp_path / "held", tmp_path / "begun"
    waits = f"""
    if os.path.exists({str(held)!r}):
        open({str(begun)!r}, "w").close()
    while os.path.exists({str(held)!r}):
        time.sleep(0.01)
"""
    with serving(acting_bundle(tmp_path / "first", source=SOURCE + waits)) as (service, peer):
        held.touch()
        os.kill(service.info()["worker_pid"], signal.SIGKILL)
        until(begun.exists)
        served_by = service.deploy(better)["worker_pid"]
        held.unlink()
        assert peer.ask(number=5).parts["out"] == 15
        until(lambda: workers() == [served_by])
        assert (service.state, service.info()["worker_pid"]) == ("READY", served_by)


@pytest.mark.parametrize("revision", [None, 0])
def test_a_change_that_another_bundle_overtakes_is_made_for_that_one_or_refused(acting, better, monkeypatch, revision):
    real, looked, deployed = parameters.changed_entries, threading.Event(), threading.Event()

    def late(*arguments):
        found = real(*arguments)
        if not looked.is_set():
            looked.set()
            deployed.wait(TIMEOUT_S)
        return found

    monkeypatch.setattr(parameters, "changed_entries", late)
    with serving(acting) as (service, peer):
        outcome = []

        def change():
            try:
                outcome.append(service.set_parameters({"k": 50}, revision))
            except RevisionConflict as conflict:
                outcome.append(conflict)

        changing = threading.Thread(target=change)
        changing.start()
        assert looked.wait(TIMEOUT_S)
        service.deploy(better)
        deployed.set()
        changing.join()
        if revision is None:
            assert (outcome[0].revision, outcome[0].entries["k"]["value"]) == (2, 50)
        else:
            assert outcome[0].current.entries["k"]["value"] == 3
        answer = peer.ask(number=5)
        current = service.parameters()
        assert (answer.parts["out"], answer.revision) == (5 * current.entries["k"]["value"], current.revision)


def test_a_change_that_did_not_come_in_time_is_not_made_later(acting, tmp_path, monkeypatch):
    monkeypatch.setattr("epypes.service.service._CHANGE_TIMEOUT_S", 0.3)
    with serving(acting, job_timeout_s=20) as (service, peer):
        peer.send(f"hold:{tmp_path}", 1)
        until((tmp_path / "started").exists)
        with pytest.raises(ServiceError, match="nothing was changed"):
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
        assert service.state == "DRAINING"
        service.resume()
        assert (service.state, service.service_state.sub) == ("READY", sub)
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


def faulted(service):
    """Have a service be without a worker: its bundle is spoilt, and the worker killed."""
    (Path(service.info()["bundle"]) / "pipeline.py").write_text("")
    os.kill(service.info()["worker_pid"], signal.SIGKILL)
    until(lambda: service.state == "FAULTED")


def test_what_another_bundle_has_shown_is_not_shown_for_this_one(acting, better):
    with serving(acting) as (service, peer):
        peer.ask(number=5)
        assert service.preview("k")[1].splitlines()[0] == b"2"
        service.deploy(better)
        faulted(service)
        with pytest.raises(ServiceError, match="no worker"):
            service.preview("k")


def test_what_is_remembered_for_when_there_is_no_worker_is_bounded_in_bytes(better, monkeypatch):
    monkeypatch.setattr(worker_queries, "_MAX_BYTES", 50)
    with serving(better) as (service, peer):
        peer.ask(number=5)
        for side in range(100, 120):
            service.preview("out", side)
        faulted(service)
        assert service.preview("out", 119)[1].splitlines()[0] == b"15"
        with pytest.raises(ServiceError, match="no worker"):
            service.preview("out", 100)
