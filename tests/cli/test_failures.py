"""``epypes failures`` and ``epypes replay`` report what failed, and whether it fails again."""

from __future__ import annotations

import json
import queue
import shutil
import signal
import subprocess
import sys

import pytest

import epypes as ep
from epypes.bundle.manifest import write_manifest
from epypes.service import Service
from epypes.service.http import HttpServer
from epypes.service.state_file import StateLock
from tests.service.failing import CRASHES, FINE, HANGS, KILLS, RAISES, keep, promoted, request

WAIT_S = 60.0


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return promoted(tmp_path_factory.mktemp("bundles"))


@pytest.mark.slow
def test_failures_are_listed_the_newest_first_with_what_to_do_next(epypes, bundle):
    first = keep(bundle, request(RAISES), attempt=2)
    second = keep(bundle, request(KILLS), kind="killed", function="worker", message="SIGKILL", dead_letter=True)
    lines = epypes("failures", bundle).stdout.splitlines()
    rows = [line.split() for line in lines if line.strip().startswith(("1", "2")) and "─" not in line]
    assert [row[0] for row in rows] == [second, first]
    assert [row[2] for row in rows] == ["worker", "check"]
    assert rows[0][-1] == "yes"
    assert rows[1][-1] == "2"
    assert "killed: SIGKILL" in "\n".join(lines)
    assert f"epypes replay {second}" in "\n".join(lines)
    assert [json.loads(line)["id"] for line in epypes("failures", "--json").stdout.splitlines()] == [second, first]
    assert len(epypes("failures", bundle, "--json", "--limit", 1).stdout.splitlines()) == 1


def test_columns_that_say_nothing_leave_their_room_to_the_exception(epypes, bundle, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    keep(bundle, request(RAISES), message="x" * 30)
    head, _, row = filter(str.strip, epypes("failures", bundle).stdout.splitlines()[:4])
    assert head.split() == ["id", "when", "function", "exception"]
    assert row.rstrip().endswith("x" * 30)


@pytest.mark.parametrize("kind", ["raised", "killed"])
def test_a_message_can_not_dress_up_as_markup_or_as_more_lines(epypes, bundle, kind):
    keep(bundle, request(RAISES), kind=kind, message="[bold]x[/]\n[/nothing]\x1b[31m")
    done = epypes("failures", bundle)
    assert done.returncode == 0
    assert "[bold]" in done.stdout
    assert "\x1b" not in done.stdout


def test_where_nothing_failed_is_said(epypes, bundle, tmp_path):
    assert "No failures of" in epypes("failures", bundle).stdout
    assert epypes("failures").stdout.strip() == "No failures are stored."
    done = epypes("failures", tmp_path / "nothing")
    assert done.returncode == 1
    assert "does not exist" in done.stderr


REPLAYS = [
    (RAISES, 1, "fails again: in 'check', pipeline.py, line "),
    (FINE, 0, "is fine now: no function fails. It was 'check': ValueError: too bright: 95."),
    (KILLS, 1, "kills the process (SIGKILL) in 'check'."),
    (CRASHES, 1, "kills the process (SIGSEGV) in 'check', pipeline.py, line "),
    (HANGS, 1, "is stuck: more than 0.5 s in 'check', pipeline.py, line "),
]


@pytest.mark.slow
@pytest.mark.parametrize(("value", "status", "text"), REPLAYS)
def test_a_replay_tells_whether_it_fails_again(epypes, bundle, value, status, text):
    failure = keep(bundle, request(value))
    done = epypes("replay", failure, "--timeout", 0.5 if value == HANGS else WAIT_S)
    assert done.returncode == status
    assert done.stdout.startswith(f"{failure} {text}")
    if value == RAISES:
        line = int(done.stdout.partition("line ")[2].partition(":")[0])
        assert "raise ValueError" in (bundle / "pipeline.py").read_text().splitlines()[line - 1]


@pytest.mark.slow
def test_a_replay_prints_the_whole_traceback_when_asked_to(epypes, bundle):
    keep(bundle, request(RAISES))
    done = epypes("replay", "latest", bundle, "--trace")
    assert "Traceback (most recent call last):" in done.stdout
    assert "too bright: 95" in done.stdout


@pytest.mark.slow
def test_a_failure_that_is_another_one_now_is_said_to_be(epypes, bundle):
    failure = keep(bundle, request(RAISES), function="half", exception="TypeError", message="x")
    done = epypes("replay", failure)
    assert done.returncode == 1
    assert "fails otherwise than in the service ('half': TypeError: x): in 'check'" in done.stdout


@pytest.mark.slow
def test_a_bundle_that_was_mended_since_is_told_to_have_changed_and_to_be_fine(epypes, bundle, tmp_path):
    mended = shutil.copytree(bundle, tmp_path / "mended")
    failure = keep(mended, request(RAISES))
    module = mended / "pipeline.py"
    module.write_text(module.read_text().replace("raise ValueError", "return bright; raise ValueError"))
    write_manifest(mended)
    done = epypes("replay", failure)
    assert done.returncode == 0
    first, second = done.stdout.splitlines()
    assert "has changed since" in first
    assert "is fine now" in second


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["zzz"], "No failure 'zzz' here. There are: "),
        (["latest", "nowhere"], "does not exist"),
        (["latest", "http://127.0.0.1:1"], "http://127.0.0.1:1"),
    ],
)
def test_what_cannot_be_replayed_is_said_in_one_line(epypes, bundle, arguments, text):
    keep(bundle, request(RAISES))
    done = epypes("replay", *arguments)
    assert done.returncode == 1
    assert done.stderr.startswith("epypes: ")
    assert text in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_an_event_that_was_not_kept_cannot_be_replayed(epypes, bundle):
    failure = keep(bundle, None)
    done = epypes("replay", failure)
    assert done.returncode == 1
    assert "was not kept: the service had none to give" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("way", ["socket", pytest.param("http", marks=pytest.mark.slow)])
def test_failures_are_told_as_they_happen_with_the_id_to_replay_them(epypes, bundle, way):
    requests = queue.SimpleQueue()
    with StateLock(bundle) as lock, Service(bundle) as service, HttpServer(service, "127.0.0.1:0") as server:
        lock.publish(service.service_state)
        source = str(bundle) if way == "socket" else server.url
        command = [sys.executable, "-m", "epypes.cli", "failures", source, "--follow", "--json"]
        with (
            ep.ZMQPublisher(service.service_state.sub, requests, bind=False) as publisher,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as follower,
        ):
            try:
                assert publisher.wait_for_subscriber(WAIT_S)
                assert follower.stderr.readline().startswith("Listening for failures of")
                requests.put(request(RAISES))
                record = json.loads(follower.stdout.readline())
            finally:
                follower.send_signal(signal.SIGINT)
                _, more = follower.communicate(timeout=WAIT_S)
        assert (record["function"], record["exception"], record["message"]) == ("check", "ValueError", "too bright: 95")
        assert record["event_id"] == "77"
        assert follower.returncode == 0, more
        assert service.failure_store.flush()
    done = epypes("replay", record["id"])
    assert "fails again" in done.stdout


def test_who_follows_a_service_that_is_not_there_is_told_so(epypes, bundle):
    assert "No service runs for" in epypes("failures", bundle, "--follow").stderr
    assert "Name the service" in epypes("failures", "--follow").stderr
