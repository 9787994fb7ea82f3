"""A running service is found, read and changed from a notebook; every refusal is a sentence with a way out."""

from __future__ import annotations

import http.server
import json
import threading
import traceback
from contextlib import contextmanager

import numpy as np
import pytest

import epypes as ep
from epypes.errors import NotComputed, ParametersRefused, RevisionConflict, ServiceError
from epypes.graph import annotated_params, colour_order
from epypes.service.state_file import StateLock
from tests.conftest import EDGE_FUNCTIONS, EDGE_HPARAMS, EDGE_IO
from tests.service.served import until
from tests.service.standing import Standing, standing

TIMEOUT_S = 60.0


@pytest.fixture
def service(tmp_path):
    runner = ep.CompGraphRunner(ep.CompGraph(EDGE_FUNCTIONS, EDGE_IO), EDGE_HPARAMS)
    return Standing(runner, tmp_path, {"blur_kernel": {"low": 1, "high": 31, "odd": True}})


@pytest.fixture
def server(service):
    with standing(service) as server:
        yield server


@pytest.fixture
def connection(server):
    with ep.connect(server.url, token=server.token) as connection:
        yield connection


@contextmanager
def runner_following(runner):
    """Have a remote runner follow the events of its service."""
    heard = threading.Event()
    forget = runner.watch(heard.set)
    assert heard.wait(TIMEOUT_S)
    yield
    forget()


@pytest.mark.parametrize(
    "url", ["", "127.0.0.1:8642", "ftp://127.0.0.1", "http://", "http://127.0.0.1:x", "http://[::1"]
)
def test_what_is_no_address_is_refused_with_one_that_is(url):
    with pytest.raises(ServiceError, match=r"is no address of a service. Write it as http://127.0.0.1:8642"):
        ep.connect(url)


def test_where_nothing_answers_the_way_out_is_told():
    with pytest.raises(ServiceError, match=r"No service answers at http://127.0.0.1:9. Start one: epypes serve"):
        ep.connect("http://127.0.0.1:9")


@pytest.mark.slow
@pytest.mark.parametrize("body", [b"<html>hello</html>", b"[]", b'{"name": "nginx"}'])
def test_what_is_no_service_of_ours_is_said_to_be_none(body):
    class Other(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *args):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Other) as other:
        thread = threading.Thread(target=other.serve_forever, args=(0.01,))
        thread.start()
        try:
            with pytest.raises(ServiceError, match="is no EPypes service"):
                ep.connect(f"http://127.0.0.1:{other.server_port}")
        finally:
            other.shutdown()
            thread.join()


def test_a_service_of_another_version_is_refused(service, server):
    info = service.info()
    service.info = lambda: {**info, "versions": {"epypes": "2.3"}}
    with pytest.raises(ServiceError, match=r"runs EPypes 2.3, and this is 1\..* Install the same version here"):
        ep.connect(server.url)


def test_a_proxy_of_the_environment_is_passed_by_on_this_machine(server, monkeypatch):
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:9")
    monkeypatch.setenv("ALL_PROXY", "http://127.0.0.1:9")
    with ep.connect(server.url) as connection:
        assert connection.info()["name"] == "edges"


def test_looking_needs_no_access_key_and_changing_says_where_it_is(service, server):
    with ep.connect(server.url) as connection:
        assert connection.parameters().revision == 0
        with pytest.raises(ServiceError, match="ep.connect\\(url, access_key=...\\), or set EPYPES_ACCESS_KEY"):
            connection.set(canny_lo=60)
    assert service.revision == 0


@pytest.mark.slow
def test_the_access_key_is_taken_from_the_address_the_environment_or_the_state_of_the_service(
    service, server, monkeypatch
):
    revision = 0
    for link in ("?access_key={}", "#token={}"):
        revision += 1
        with ep.connect(f"{server.url}/{link.format(server.token)}") as connection:
            assert connection.url == server.url
            assert connection.set(canny_lo=60 + revision).revision == revision
    for name in ("EPYPES_ACCESS_KEY", "EPYPES_TOKEN"):
        revision += 1
        with monkeypatch.context() as patch:
            patch.setenv(name, server.token)
            with ep.connect(server.url) as connection:
                assert connection.set(canny_lo=60 + revision).revision == revision
    for keyword in ("access_key", "token"):
        revision += 1
        with ep.connect(server.url, **{keyword: server.token}) as connection:
            assert connection.set(canny_lo=60 + revision).revision == revision
    from epypes.service.state_file import ServiceState

    with StateLock(service.folder) as lock:
        state = ServiceState(1, "tcp://a", "tcp://b", "d", http=server.url, access_key_file=str(server.access_key_file))
        lock.publish(state)
        with ep.connect(server.url) as connection:
            assert connection.set(canny_lo=82).revision == revision + 1


def test_no_error_shows_the_access_key_of_a_link(server):
    for url in (f"ftp://127.0.0.1/?access_key={'s' * 43}", f"http://127.0.0.1:1/?access_key={'s' * 43}"):
        with pytest.raises(ServiceError) as raised:
            ep.connect(url)
        assert "sss" not in str(raised.value)
        assert "sss" not in raised.value.path


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", ["{}\x00", "{}\r\nX: 1", "\n{} {}", "{}é"])
def test_no_error_shows_an_access_key_that_a_header_cant_hold(server, spoilt):
    with pytest.raises(ServiceError, match="no access key") as refused:
        ep.connect(server.url, access_key=spoilt.format(server.token, server.token))
    assert server.token not in "".join(traceback.format_exception(refused.value))
    with pytest.raises(ServiceError, match="no access key"):
        ep.connect(f"{server.url}/?access_key=a%0Ab")


def test_an_access_key_may_be_as_it_is_read_from_its_file(server):
    with ep.connect(server.url, access_key=server.access_key_file.read_text()) as connection:
        assert connection.set(canny_lo=61).revision == 1


def test_values_are_set_all_or_none_and_only_with_the_revision_that_was_seen(connection, service):
    seen = connection.parameters()
    assert connection.set(seen.revision, canny_lo=60, canny_hi=180).revision == 1
    with pytest.raises(RevisionConflict) as conflict:
        connection.set(seen.revision, canny_lo=90)
    assert (conflict.value.current.revision, conflict.value.current.entries["canny_lo"]["value"]) == (1, 60)
    with pytest.raises(ParametersRefused) as refused:
        connection.set(canny_lo=1, blur_kernel=4)
    assert refused.value.problems == {"blur_kernel": "'blur_kernel' is odd, and 4 is not."}
    with pytest.raises(ServiceError, match="can't be sent"):
        connection.set(canny_lo=float("nan"))
    assert connection.set() == connection.parameters()
    assert service.entries["canny_lo"]["value"] == 60


@pytest.mark.slow
def test_values_of_the_last_run_come_as_they_are(connection, service, photograph, straight_edges):
    with pytest.raises(NotComputed, match="No event has been completed yet"):
        connection.run()
    service.event(image=photograph)
    assert list(connection.run()) == ["edges"]
    assert np.array_equal(connection.run()["edges"], straight_edges)
    assert set(connection.run(["image_gray", "image"])) == {"image_gray", "image"}
    with pytest.raises(ServiceError, match="Did you mean 'edges'"):
        connection.run("edgse")
    assert connection.preview("blur_kernel") == ("text/plain", b"11")


@pytest.mark.slow
def test_the_addresses_of_the_line_are_told(connection, service):
    assert (connection.addresses.sub, connection.addresses.pub) == ("tcp://127.0.0.1:1", "tcp://127.0.0.1:2")
    assert connection.addresses.failures == ""


def test_the_graph_to_tune_has_the_ranges_of_the_service_and_its_functions_refuse_to_be_called(connection):
    cg = connection.to_tune().cg
    assert cg.func_inputs("canny") == ("image_blurred", "canny_lo", "canny_hi")
    (param,) = annotated_params(cg, "blur_kernel")
    assert (param.low, param.high, param.odd) == (1, 31, True)
    assert colour_order(cg, "image") == "bgr"
    with pytest.raises(ServiceError, match="'canny' runs in the service at http://.*, not here"):
        cg.functions["canny"](1, 2, 3)


@pytest.mark.slow
def test_colours_of_the_service_are_those_of_the_graph_to_tune(service, server):
    view = json.loads(service.view())
    for token in view["tokens"]:
        token["order"] = "rgb" if token["name"] == "image" else token.get("order")
    service.view = lambda: json.dumps(view).encode()
    with ep.connect(server.url) as connection:
        assert colour_order(connection.to_tune().cg, "image") == "rgb"


@pytest.mark.slow
def test_runs_of_the_service_are_runs_with_its_values_times_and_revision(connection, service, photograph):
    service.event(image=photograph)
    runner = connection.to_tune()
    assert np.array_equal(runner.last["edges"], service.completed[0]["edges"])
    run = runner.trial({"canny_lo": 60}, "edges")
    assert (run.revision, run.hyperparameters["canny_lo"], run.first_hyperparameters["canny_lo"]) == (1, 60, 70)
    assert set(run.report.durations_ns) == set(runner.cg.functions)
    assert runner.adopt(run)
    assert runner.last is run
    service.event(image="no image")
    with runner_following(runner):
        service.event(image="no image")
        until(lambda: runner.trial({}, "edges").failure is not None)
    failed = runner.trial({}, "edges")
    assert failed.failure.function == "grayscale"
    assert set(failed) & {"image_gray", "edges"} == set()


def test_what_happens_is_told_as_it_happens(connection, service, photograph):
    events = connection.events()
    name, _ = next(events)
    service.event(image=photograph)
    while name != "run":
        name, said = next(events)
    assert said["revision"] == 0
    events.close()


@pytest.mark.slow
def test_a_connection_shows_the_graph_it_has_seen_also_when_the_service_is_gone(service, photograph):
    service.event(image=photograph)
    with standing(service) as server:
        connection = ep.connect(server.url)
    assert len(repr(connection)) < 100
    shown = connection._repr_mimebundle_()
    assert "canny" in shown["image/svg+xml"]
    assert "edges is READY" in shown["text/html"]
    assert "tcp://127.0.0.1:1" in shown["text/html"]
    with pytest.raises(ServiceError, match="No service answers|broke off"):
        connection.info()
    assert connection._repr_mimebundle_() == shown
    connection.close()
    connection.close()
    with pytest.raises(ServiceError, match="is closed"):
        connection.info()
