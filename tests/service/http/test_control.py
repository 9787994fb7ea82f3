"""The HTTP control reads and changes a service."""

from __future__ import annotations

import shutil
import threading

import cv2
import httpx
import numpy as np
import psutil
import pytest

from epypes.bundle.adapters import REQUEST
from epypes.bundle.load import read_bundle
from epypes.bundle.manifest import write_manifest
from epypes.service import Service
from epypes.service.http import HttpServer
from epypes.service.supervision.packing import unpack, unpack_event
from epypes.wire import Envelope, decode
from tests.service.http.raw import until
from tests.service.served import acting_bundle, peer_of


@pytest.mark.slow
def test_info_says_what_is_served(client, service, edge_bundle):
    info = client.get("/v1/info").json()
    assert info == service.info()
    assert info["digest"] == edge_bundle.digest
    assert info["func_io"].keys() == {"smooth", "canny"}


def test_it_is_alive_and_ready(client):
    assert client.get("/livez").json() == {"alive": True, "reason": ""}
    assert client.get("/readyz").json() == {"ready": True, "state": "READY", "reason": ""}


def test_the_graph_is_drawn_with_the_latest_run(client):
    answer = client.get("/v1/graph.svg")
    assert answer.headers["content-type"] == "image/svg+xml"
    assert 'id="token-edges"' in answer.text
    assert "data:image/" in answer.text
    assert {token["name"] for token in client.get("/v1/view").json()["tokens"]} >= {"image", "edges", "lo"}


def test_a_token_is_previewed_in_the_size_that_is_asked_for(client):
    answer = client.get("/v1/tokens/edges/preview", params={"max_side_px": 64})
    assert answer.headers["content-type"].startswith("image/")
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert max(picture.shape[:2]) == 64
    assert client.get("/v1/tokens/lo/preview").headers["content-type"].startswith("text/plain")
    assert "Did you mean 'edges'?" in client.get("/v1/tokens/edge/preview").json()["detail"]


def test_values_of_the_latest_run_come_as_an_envelope(changing, photograph, service):
    lo = service.parameters().entries["lo"]["value"]
    answer = changing.get("/v1/run", params={"tokens": ["edges", "lo"]})
    assert answer.headers["content-type"] == "application/vnd.epypes.v1+frames"
    envelope = decode(unpack(answer.content))
    assert np.array_equal(envelope.parts["edges"], cv2.Canny(cv2.medianBlur(photograph, 5), lo, 200))
    revision = changing.patch("/v1/parameters", json={"values": {"lo": lo - 1}}).json()["revision"]
    answer = changing.get("/v1/run", params={"tokens": ["edges"], "revision": revision})
    envelope = decode(unpack(answer.content))
    assert envelope.revision == revision
    assert np.array_equal(envelope.parts["edges"], cv2.Canny(cv2.medianBlur(photograph, 5), lo - 1, 200))
    answer = changing.get("/v1/run", params={"tokens": ["edges"], "revision": revision + 1})
    assert answer.status_code == 409


def test_a_change_that_does_not_know_the_latest_revision_changes_nothing(changing):
    now = changing.get("/v1/parameters").json()
    first = changing.patch("/v1/parameters", json={"revision": now["revision"], "values": {"lo": 33}})
    assert first.status_code == 200
    assert first.json()["parameters"]["lo"]["value"] == 33
    assert first.json()["parameters"]["lo"]["type"] == "int"
    second = changing.patch("/v1/parameters", json={"revision": now["revision"], "values": {"lo": 44, "hi": 180}})
    assert second.status_code == 409
    assert second.json()["revision"] == first.json()["revision"]
    assert (
        second.json()["parameters"] == first.json()["parameters"] == changing.get("/v1/parameters").json()["parameters"]
    )


def test_of_a_change_with_one_bad_value_none_is_taken(changing):
    before = changing.get("/v1/parameters").json()
    answer = changing.patch("/v1/parameters", json={"values": {"lo": 20, "low": 1, "hi": "much"}})
    assert answer.status_code == 422
    assert answer.json()["problems"].keys() == {"low", "hi"}
    assert changing.get("/v1/parameters").json() == before


def test_a_failure_can_be_had_with_its_event(client, service):
    with peer_of(service) as peer:
        event = Envelope(type=REQUEST, parts={"image": "no image"})
        peer.requests.put(event)
        peer.take()
    assert service.failure_store.flush()
    failure = client.get("/v1/failures", params={"limit": 1}).json()["failures"][0]
    assert failure["event_id"] == event.id
    assert client.get(f"/v1/failures/{failure['id']}").json() == failure
    kept = unpack_event(client.get(f"/v1/failures/{failure['id']}/event").content)
    assert kept.parts == event.parts


def test_pause_and_resume_say_what_they_did(changing):
    assert changing.post("/v1/pause").json()["state"] == "PAUSED"
    ready = changing.get("/readyz")
    assert (ready.status_code, ready.json()["state"]) == (503, "PAUSED")
    assert changing.get("/livez").status_code == 200
    assert changing.post("/v1/resume").json()["state"] == "READY"


@pytest.mark.slow
def test_parameters_are_written_back_after_a_look_at_what_would_change(edge_bundle, tmp_path):
    folder = shutil.copytree(edge_bundle.path, tmp_path / "edges")
    with Service(folder) as service, HttpServer(service, "127.0.0.1:*") as http:
        headers = {"Authorization": f"Bearer {http.access_key_file.read_text().strip()}"}
        with httpx.Client(base_url=http.url, trust_env=False, timeout=60, headers=headers) as client:
            client.patch("/v1/parameters", json={"values": {"lo": 64}})
            would = client.post("/v1/parameters/write-back", json={"dry_run": True}).json()
            assert "+value = 64" in would["diff"]
            assert read_bundle(folder).digest == edge_bundle.digest
            written = client.post("/v1/parameters/write-back", json={"dry_run": False}).json()
            assert written == would
            assert read_bundle(folder).digest == written["digest"]
            assert client.post("/v1/parameters/write-back", json={"dry_run": True}).json()["diff"] == ""


# -- another bundle -------------------------------------------------------------------------------------------------


@pytest.fixture
def changed(edge_bundle, tmp_path):
    """Make another state of the edge bundle, sealed anew."""

    def change(name, before, after, file="pipeline.toml"):
        folder = shutil.copytree(edge_bundle.path, tmp_path / name)
        text = (folder / file).read_text()
        assert before in text
        (folder / file).write_text(text.replace(before, after))
        write_manifest(folder)
        return folder

    return change


@pytest.fixture
def epypes(epypes, monkeypatch, http):
    """The commands, with the access key of the service."""
    monkeypatch.setenv("EPYPES_ACCESS_KEY", http.token)
    return epypes


@pytest.mark.slow
def test_a_bundle_that_computes_something_else_does_not_take_over(changing, changed, epypes, http, edge_bundle):
    bad = changed("bad", "value = 200", "value = 20")
    answer = changing.post("/v1/deploy", json={"bundle": str(bad)})
    assert answer.status_code == 409
    assert "edges" in " ".join(answer.json()["reasons"])
    done = epypes("deploy", bad, "--http", http.url)
    assert done.returncode == 1
    begun, why = done.stderr.splitlines()
    assert "is replayed" in begun
    assert "edges" in why
    info = changing.get("/v1/info").json()
    assert (info["digest"], info["state"]) == (edge_bundle.digest, "READY")


def test_a_bundle_that_was_changed_since_its_promotion_is_none(changing, edge_bundle, tmp_path, epypes, http):
    folder = shutil.copytree(edge_bundle.path, tmp_path / "broken")
    (folder / "pipeline.py").write_text("import os\n")
    answer = changing.post("/v1/deploy", json={"bundle": str(folder)})
    assert answer.status_code == 409
    assert "pipeline.py was changed" in answer.json()["detail"]
    done = epypes("deploy", tmp_path / "nothing", "--http", http.url)
    assert done.returncode == 1
    assert "no folder" in done.stderr


@pytest.mark.slow
def test_a_good_bundle_takes_over_and_a_rollback_brings_the_one_before(changing, changed, epypes, http, edge_bundle):
    good = changed("good", 'name = "edges"', 'name = "edges-2"')
    done = epypes("deploy", good, "--http", http.url)
    assert done.returncode == 0
    # Values that others have tuned before are told after it.
    assert done.stdout.startswith(
        f"DEPLOYED {good} ({read_bundle(good).digest[:12]}) in place of {edge_bundle.path} ({edge_bundle.digest[:12]}): READY."
    )
    assert changing.get("/v1/info").json()["name"] == "edges-2"
    done = epypes("rollback", "--http", http.url)
    assert done.returncode == 0
    assert done.stdout.startswith(f"ROLLED BACK {edge_bundle.path}")
    assert changing.get("/v1/info").json()["digest"] == edge_bundle.digest


def test_without_a_service_or_its_token_nothing_is_deployed(epypes, http, edge_bundle, tmp_path, monkeypatch):
    done = epypes("deploy", edge_bundle.path, "--http", "http://127.0.0.1:1")
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (1, "", 1)
    (tmp_path / "token").write_text("x" * 43)
    done = epypes("deploy", edge_bundle.path, "--http", http.url, "--token-file", tmp_path / "token")
    assert done.returncode == 1
    assert "access key" in done.stderr
    link = f"{http.url}/?access_key={'x' * 43}"
    for arguments in (("deploy", edge_bundle.path, "--http", link), ("stop", link), ("failures", f"{link}#part")):
        done = epypes(*arguments)
        assert "xxx" not in done.stdout + done.stderr, arguments
    assert f"{http.url}/?access_key=..." in epypes("stop", link).stderr
    (tmp_path / "token").write_text(http.token)
    done = epypes("deploy", tmp_path / "none", "--http", http.url, "--access-key-file", tmp_path / "token")
    assert "is no folder" in done.stderr


@pytest.mark.slow
def test_while_a_bundle_is_deployed_another_one_is_refused_and_all_else_is_answered(tmp_path):
    slow = acting_bundle(tmp_path / "slow")
    waiting = acting_bundle(tmp_path / "waiting")
    (waiting / "pipeline.py").write_text(
        f"import os, time\nopen({str(tmp_path / 'begun')!r}, 'w').close()\nwhile not os.path.exists({str(tmp_path / 'go')!r}): time.sleep(0.01)\n"
        + (waiting / "pipeline.py").read_text()
    )
    write_manifest(waiting)
    with Service(slow) as service, HttpServer(service, "127.0.0.1:*") as http:
        headers = {"Authorization": f"Bearer {http.access_key_file.read_text().strip()}"}
        with httpx.Client(base_url=http.url, trust_env=False, timeout=60, headers=headers) as client:
            answers = []
            first = threading.Thread(
                target=lambda: answers.append(client.post("/v1/deploy", json={"bundle": str(waiting)}))
            )
            first.start()
            until((tmp_path / "begun").exists)
            for refused in (client.post("/v1/deploy", json={"bundle": str(slow)}), client.post("/v1/rollback")):
                assert refused.status_code == 503
                assert "running already" in refused.json()["detail"]
            assert client.get("/readyz").status_code == 200
            assert client.post("/v1/pause").status_code == 200
            assert client.post("/v1/resume").status_code == 200
            (tmp_path / "go").touch()
            first.join(60)
            assert answers[0].json()["bundle"] == str(waiting)


# -- FAILURES 46 to 48 ----------------------------------------------------------------------------------------------


def test_a_bundle_that_does_not_compute_what_was_recorded_is_never_ready_and_another_one_may_be_deployed(
    acting, tmp_path
):
    bundle = acting_bundle(tmp_path / "wrong", expected=7)
    with Service(bundle) as service, HttpServer(service, "127.0.0.1:*") as http:
        answer = httpx.get(f"{http.url}/readyz", trust_env=False)
        assert answer.status_code == 503
        assert answer.json()["state"] == "FAULTED"
        assert "'out'" in answer.json()["reason"]
        service.deploy(acting)
        assert httpx.get(f"{http.url}/readyz", trust_env=False).status_code == 200


def test_health_is_red_when_a_function_does_not_return_and_not_while_it_merely_holds_the_interpreter(acting):
    """A catastrophic regular expression holds the interpreter of the worker; the front answers all the same."""
    with (
        Service(acting, job_timeout_s=2.0) as service,
        HttpServer(service, "127.0.0.1:*") as http,
        peer_of(service) as peer,
        httpx.Client(base_url=http.url, trust_env=False, timeout=60.0) as client,
    ):
        answers = []

        def is_unwell():
            answers.append(client.get("/livez"))
            return answers[-1].status_code == 503 and "act" in answers[-1].json()["reason"]

        worker = psutil.Process(service.info()["worker_pid"])
        peer.send("regex", 1)
        peer.send("plain", 2)
        until(is_unwell)
        assert [answer.status_code for answer in answers].count(200) > 5, "while it was merely busy"
        assert "Function 'act' did not return within 2 s" in answers[-1].json()["reason"]
        stuck, good = peer.take(2)
        assert (stuck.failure.function, good.parts["out"]) == ("act", 4)
        until(lambda: client.get("/readyz").status_code == 200)
        until(lambda: client.get("/livez").status_code == 200)
        assert service.failure_store.flush()
        assert [failure["kind"] for failure in client.get("/v1/failures").json()["failures"]] == ["stuck"]
        assert (service.counts()["failed"], worker.is_running()) == (1, False)
