"""An event that failed in a service opens again at the function that failed, and is run again in a process of its own."""

from __future__ import annotations

import queue
import shutil
import warnings

import pytest

import epypes as ep
from epypes.bundle.manifest import write_manifest
from epypes.display.views.view import view
from epypes.errors import BundleError, FailureNotKept, NotComputed, RemoteFailure, UnknownName
from epypes.service import Service
from epypes.service.failures.record import FailedEvent
from epypes.service.failures.reproduce import reproduce
from epypes.service.failures.source import failures_of, find_failure
from epypes.service.failures.store import FailureStore, failures_folder
from epypes.service.http import HttpServer
from epypes.wire import Envelope
from tests.service.failing import CRASHES, EXITS, FINE, HANGS, KILLS, RAISES, keep, picture, promoted, request
from tests.transport.peers import wait_until

WAIT_S = 60.0


@pytest.fixture(scope="session")
def bright_bundle(tmp_path_factory):
    return promoted(tmp_path_factory.mktemp("bundles"))


@pytest.mark.slow
def test_a_failure_opens_stopped_at_the_function_that_failed_and_goes_on_from_there(bright_bundle):
    failure = keep(bright_bundle, request(RAISES))
    runner = ep.load_failure(failure, bright_bundle)
    assert runner.last.failure.function == "check"
    assert isinstance(runner.last.failure.exception, ValueError)
    assert runner["bright"].max() == 95
    assert dict(runner.hyperparameters) == {"by": 1, "most": 90}
    with pytest.raises(NotComputed):
        runner.last["checked"]
    assert runner.stale == ("check", "half")
    run = runner.rerun(most=99)
    assert run["halved"].max() == 47
    assert run.report.ran == ("check", "half")


def test_the_picture_shows_the_failed_function_in_red_and_the_values_before_it(bright_bundle):
    runner = ep.load_failure(keep(bright_bundle, request(RAISES)), bright_bundle)
    shown = runner.last._repr_mimebundle_()["text/html"]
    assert "too bright: 95" in shown
    states = {function.name: function.state for function in view(runner).functions}
    assert states == {"brighten": "ran", "check": "failed", "half": "not run"}


@pytest.mark.parametrize("kind", ["killed", "stuck"])
def test_a_function_that_kills_or_hangs_is_not_called_in_the_notebook(bright_bundle, kind):
    # Called, it would end this process or hang.
    failure = keep(
        bright_bundle, request(KILLS if kind == "killed" else HANGS), kind=kind, exception="SIGKILL", message="gone"
    )
    runner = ep.load_failure(failure, bright_bundle)
    assert runner.last.failure.function == "check"
    assert isinstance(runner.last.failure.exception, RemoteFailure)
    assert f"{kind}: not called here. gone" in str(runner.last.failure.exception)
    assert runner.last.report.ran == ("brighten", "check")
    assert runner["bright"].max() == (7 if kind == "killed" else 9)
    assert runner.stale == ("check", "half")
    assert runner.rerun(by=40)["halved"].max() == (46 if kind == "killed" else 48) // 2


@pytest.mark.slow
def test_where_a_worker_was_killed_is_found_out_in_a_process_of_its_own(bright_bundle):
    failure = keep(bright_bundle, request(KILLS), kind="killed", function="", exception="SIGKILL", message="")
    runner = ep.load_failure(failure, bright_bundle)
    assert runner.last.failure.function == "check"
    assert "checked" not in runner


@pytest.mark.slow
def test_a_worker_that_was_killed_by_somebody_else_leaves_a_runner_with_the_payload(bright_bundle):
    failure = keep(bright_bundle, request(FINE), kind="killed", function="", exception="SIGKILL", message="")
    with pytest.warns(UserWarning, match="not known in which function, so none was run"):
        runner = ep.load_failure(failure, bright_bundle)
    assert runner.last.failure is None
    assert tuple(runner) == ("image", "by", "most")
    assert runner.rerun("bright")["bright"].max() == 21


def test_an_event_that_does_not_fail_here_is_said_to(bright_bundle):
    failure = keep(bright_bundle, request(FINE))
    with pytest.warns(UserWarning, match=r"nothing fails here; there it was 'check' \(ValueError: too bright: 95\)"):
        runner = ep.load_failure(failure, bright_bundle)
    assert runner["halved"].max() == 10


def test_an_event_that_fails_otherwise_is_said_to(bright_bundle):
    failure = keep(bright_bundle, request(200), function="half", exception="TypeError", message="x")
    with pytest.warns(UserWarning, match=r"here 'check' fails \(ValueError\); there it was 'half' \(TypeError: x\)"):
        ep.load_failure(failure, bright_bundle)


def test_an_event_on_which_f_in_fails_raises_what_f_in_raises(bright_bundle):
    event = Envelope("epypes.request", {"picture": picture(1)})
    failure = keep(bright_bundle, event, function="f_in", exception="MessageError")
    with pytest.raises(ep.errors.MessageError, match="must have the parts 'image'") as error:
        ep.load_failure(failure, bright_bundle)
    assert "fails on this event, so no function" in error.value.__notes__[-1]


def test_a_message_of_2019_reaches_f_in_as_bytes(bright_bundle):
    failure = keep(bright_bundle, b"\x0a\x01x", function="f_in", exception="MessageError")
    with pytest.raises(ep.errors.MessageError, match="The event is a bytes"):
        ep.load_failure(failure, bright_bundle)


def test_an_event_that_was_not_kept_says_so(bright_bundle):
    failure = keep(bright_bundle, None)
    with pytest.raises(FailureNotKept, match="the service had none to give"):
        ep.load_failure(failure, bright_bundle)


@pytest.fixture
def copy(bright_bundle, tmp_path):
    """A bundle of its own, for tests that change it."""
    return shutil.copytree(bright_bundle, tmp_path / "bright")


def test_a_bundle_that_has_changed_since_is_said_to_have(copy):
    failure = keep(copy, request(RAISES))
    (copy / "pipeline.toml").write_text((copy / "pipeline.toml").read_text() + "# more\n")
    write_manifest(copy)
    with pytest.warns(UserWarning, match="has changed since"):
        runner = ep.load_failure(failure, copy)
    assert runner.last.failure.function == "check"
    assert runner.hyperparameters["most"] == 90


def test_the_bundle_that_failed_is_taken_from_where_it_was_served(copy, bright_bundle, tmp_path):
    failure = keep(copy, request(RAISES))
    moved = copy.rename(tmp_path / "moved")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ep.load_failure(failure, copy, bundle=moved).last.failure.function == "check"
    with pytest.raises(BundleError, match="does not exist"):
        ep.load_failure(failure, copy)


def test_failures_are_find_failure_how_their_id_begins_or_ends_and_by_latest(bright_bundle):
    first, second = (keep(bright_bundle, request(RAISES)) for _ in range(2))
    failures = failures_of(bright_bundle)
    assert find_failure(failures, first).id == first
    assert find_failure(failures, second[-5:]).id == second
    assert find_failure(failures, "latest").id == second
    with pytest.raises(UnknownName, match=first):
        find_failure(failures, first[:4])
    with pytest.raises(UnknownName, match=f"Did you mean '{first}'"):
        find_failure(failures, first[:-2] + "zz")
    assert find_failure(failures_of(), first).id == first
    assert failures_of().event(first).id == "77"


def test_an_event_that_failed_in_two_replicas_opens_by_its_id_as_it_failed_last(bright_bundle):
    event = request(RAISES)
    first, last = (keep(bright_bundle, event, message=message) for message in ("in one", "in another"))
    assert first != last
    assert find_failure(failures_of(bright_bundle), event.id).id == last
    assert ep.load_failure(event.id, bright_bundle).last.failure.function == "check"


def test_what_is_no_bundle_and_a_bundle_without_failures_are_told_apart(bright_bundle, tmp_path):
    with pytest.raises(BundleError, match="does not exist"):
        failures_of(tmp_path / "nothing")
    with pytest.raises(UnknownName, match="There is none"):
        find_failure(failures_of(bright_bundle), "latest")


ENDINGS = [
    (RAISES, "failed", "ValueError", "too bright: 95"),
    (FINE, "fine", "", ""),
    (KILLS, "killed", "SIGKILL", "the process ended with it"),
    (CRASHES, "killed", "SIGSEGV", "the process ended with it"),
    (EXITS, "killed", "status 5", "the process ended with it"),
    (HANGS, "stuck", "TimeoutError", "more than 0.5 s"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("value", "ending", "exception", "message"), ENDINGS)
def test_an_event_that_is_run_again_fails_is_fine_kills_or_hangs_and_the_caller_lives(
    bright_bundle, value, ending, exception, message
):
    record = FailureStore(failures_folder(bright_bundle)).keep(
        FailedEvent(hyperparameters={"most": {"value": 90}, "gone": {"value": 1}})
    )
    found = reproduce(record, request(value), bright_bundle, timeout_s=0.5 if value == HANGS else WAIT_S)
    assert (found.ending, found.exception, found.message) == (ending, exception, message)
    if ending != "fine":
        assert found.function == "check"
    module = (bright_bundle / "pipeline.py").read_text().splitlines()
    if value in (RAISES, CRASHES, HANGS):
        assert module[found.line - 1].strip() == found.code
        assert (
            found.code.split("(")[0]
            == {RAISES: "raise ValueError", CRASHES: "ctypes.string_at", HANGS: "time.sleep"}[value]
        )


@pytest.mark.slow
def test_a_bundle_whose_module_fails_is_no_reproduction(copy):
    with (copy / "pipeline.py").open("a") as file:
        file.write("\nraise RuntimeError('no')\n")
    write_manifest(copy)
    with pytest.raises(BundleError, match="fails: RuntimeError: no"):
        reproduce(FailedEvent(), request(1), copy)


@pytest.fixture(scope="session")
def byte_bundle(tmp_path_factory):
    return promoted(tmp_path_factory.mktemp("bundles"), with_f_in=True)


@pytest.mark.slow
def test_the_bundles_own_f_in_makes_the_payload_of_a_message_of_2019(byte_bundle):
    failure = keep(byte_bundle, picture(RAISES).tobytes())
    assert ep.load_failure(failure, byte_bundle)["bright"].max() == 95
    found = reproduce(FailedEvent(), picture(RAISES).tobytes(), byte_bundle)
    assert (found.ending, found.function) == ("failed", "check")


@pytest.mark.slow
def test_an_f_in_that_hangs_is_not_called_in_the_notebook(byte_bundle):
    found = reproduce(FailedEvent(), b"hangs", byte_bundle, timeout_s=0.5)
    assert (found.ending, found.function) == ("stuck", "f_in")
    failure = keep(byte_bundle, b"hangs", kind="stuck", function="f_in")
    with pytest.warns(UserWarning, match="f_in was stuck by this event, so it is not called here"):
        runner = ep.load_failure(failure, byte_bundle)
    assert runner.last is None


def test_hyperparameters_that_the_bundle_has_no_more_are_said_to_be_gone(bright_bundle):
    entries = {"most": {"value": 50}, "gone": {"value": 1}, "odd": {"kind": "enum", "enum": "Way"}}
    failure = keep(bright_bundle, request(RAISES), hyperparameters=entries)
    with pytest.warns(UserWarning, match="'gone', 'odd' can't have the value that failed"):
        runner = ep.load_failure(failure, bright_bundle)
    assert dict(runner.hyperparameters) == {"by": 1, "most": 50}


@pytest.mark.slow
def test_a_failure_is_opened_from_a_running_service_by_its_url_or_connection(bright_bundle):
    requests = queue.SimpleQueue()
    with (
        Service(bright_bundle) as service,
        HttpServer(service, "127.0.0.1:0") as server,
        ep.ZMQPublisher(service.service_state.sub, requests, bind=False) as publisher,
    ):
        assert publisher.wait_for_subscriber(WAIT_S)
        for value in (RAISES, KILLS):
            requests.put(request(value))
        wait_until(lambda: len(service.failure_records()) == 2, WAIT_S)
        killed, raised = service.failure_records()
        assert killed.dead_letter
        runner = ep.load_failure(raised.id, server.url)
        assert isinstance(runner.last.failure.exception, ValueError)
        connection = ep.connect(server.url)
        runner = ep.load_failure("latest", connection)
        assert runner.last.failure.function == "check"
        assert isinstance(runner.last.failure.exception, RemoteFailure)
        with pytest.raises(UnknownName, match="zzz"):
            ep.load_failure("zzz", connection)
        connection.close()
