"""``epypes keys`` and the options --keys and --allow admit known peers alone."""

from __future__ import annotations

import json
import queue
import subprocess
import sys

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.acquisition import write_image
from epypes.errors import KeysError, ServiceError
from epypes.service import Service, call
from epypes.service.failures.source import follow_failures
from epypes.service.state_file import StateLock
from epypes.transport import make_keys, read_keys, recording_info
from tests.transport.peers import wait_until

WAIT_S = 60.0
LOCAL = "tcp://127.0.0.1:*"


@pytest.fixture(scope="module")
def bundle(photograph, tmp_path_factory):
    runner = ep.CompGraphRunner(ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")}))
    runner.freeze(lo=70, hi=200)
    runner.run(image=photograph)
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "edges").path


@pytest.fixture
def keys(tmp_path):
    """A folder with the pairs of a service, of a caller that it knows, and of a stranger."""
    for name in ("service", "known/caller", "stranger"):
        make_keys(tmp_path / "keys" / name)
    return tmp_path / "keys"


@pytest.fixture
def guarded(bundle, keys):
    """A service that lets in the known caller alone."""
    with (
        StateLock(bundle) as lock,
        Service(bundle, keys=keys / "service.key_secret", allow=[keys / "known"]) as service,
    ):
        lock.publish(service.service_state)
        yield service


def test_keys_are_made_and_it_is_said_who_gets_what(epypes, tmp_path):
    done = epypes("keys", "camera", "--to", tmp_path / "keys")
    made = read_keys(tmp_path / "keys" / "camera")
    assert (tmp_path / "keys" / "camera.key_secret").stat().st_mode & 0o777 == 0o600
    assert made.public in done.stdout
    assert made.secret not in done.stdout
    assert "camera.key  is public: copy it to every machine that shall talk to camera" in done.stdout
    assert "camera.key_secret  is secret: it stays here" in done.stdout
    assert "--allow" in done.stdout
    done = epypes("keys", "camera", "--to", tmp_path / "keys")
    assert done.returncode == 1
    assert "exists. Take another name" in done.stderr


def test_public_keys_are_listed_and_secret_ones_never(epypes, keys):
    (keys / "known" / "caller.key_secret").unlink()
    shown = epypes("keys", "--list", "--to", keys).stdout
    for name in ("service", "stranger"):
        pair = read_keys(keys / name)
        assert pair.public in shown
        assert pair.secret not in shown
    assert "elsewhere" in epypes("keys", "--list", "--to", keys / "known").stdout
    assert "stranger" not in epypes("keys", "service", "--list", "--to", keys).stdout
    (keys / "service.key_secret").chmod(0o644)
    assert "chmod" in epypes("keys", "service", "--list", "--to", keys).stdout


def test_keys_without_a_folder_are_this_users(epypes):
    assert epypes("keys", "robot").returncode == 0
    assert "robot" in epypes("keys", "--list").stdout


@pytest.mark.parametrize("name", ["", "a/b", "..", "/x"])
def test_what_is_no_name_is_refused(epypes, name, tmp_path):
    done = epypes("keys", name, "--to", tmp_path)
    assert done.returncode == 1
    assert "is no name for keys" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_folder_without_keys_says_how_to_make_some(epypes, tmp_path):
    assert "There are no keys in" in epypes("keys", "--list", "--to", tmp_path).stderr


@pytest.mark.slow
def test_a_caller_with_a_known_key_is_answered(guarded, bundle, keys, epypes, photograph, tmp_path):
    write_image(tmp_path / "photo.png", photograph)
    own = ("--keys", keys / "known" / "caller.key_secret", "--allow", keys / "service.key")
    done = epypes("call", bundle, tmp_path / "photo.png", "--out", tmp_path / "edges.png", *own)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "edges.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("own", "server", "hint"),
    [
        ("stranger", "service.key", "started without this side's .key file under --allow"),
        ("known/caller", "stranger.key", "--allow here may not be its .key file"),
        (None, None, "If it was started with --keys, give --keys and --allow here too"),
    ],
)
def test_a_caller_that_is_not_let_in_is_told_why_that_may_be(guarded, bundle, keys, photograph, own, server, hint):
    given = {} if own is None else {"keys": keys / own, "allow": keys / server}
    with pytest.raises(ServiceError, match=f"can't be reached within 0.5 s.*{hint}"):
        call(bundle, {"image": photograph}, timeout_s=0.5, **given)
    assert guarded.counts()["received"] == 0


def test_keys_without_allow_are_refused_on_every_side(bundle, keys, epypes, tmp_path):
    for arguments in (
        ("serve", bundle, "--keys", keys / "service"),
        ("record", "tcp://127.0.0.1:1", tmp_path / "x.mcap", "--keys", keys / "service"),
        ("serve", bundle, "--allow", keys / "known"),
        ("record", "tcp://127.0.0.1:1", tmp_path / "x.mcap", "--allow", keys / "known"),
    ):
        done = epypes(*arguments)
        assert done.returncode == 1
        assert done.stderr.startswith("epypes: ")
        assert "allow" in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("option", ["--sub", "--pub", "--failures"])
def test_an_address_that_other_machines_reach_needs_keys(epypes, bundle, option):
    done = epypes("serve", bundle, option, "tcp://0.0.0.0:5998")
    assert done.returncode == 1
    assert "tcp://0.0.0.0:5998 can be reached from other machines" in done.stderr


@pytest.mark.slow
def test_the_failures_socket_is_guarded_too(guarded, bundle, keys):
    own = {"keys": keys / "known" / "caller", "allow": keys / "service.key"}
    heard = follow_failures(bundle, **own)
    assert next(heard) is None
    requests = queue.SimpleQueue()
    with ep.ZMQPublisher(guarded.service_state.sub, requests, bind=False, **own) as publisher:
        assert publisher.wait_for_subscriber(WAIT_S)
        requests.put(b"no envelope")
        assert next(heard).exception == "MessageError"
    heard.close()
    stranger = {"keys": keys / "stranger", "allow": keys / "service.key"}
    nothing = queue.SimpleQueue()
    with ep.ZMQSubscriber(guarded.service_state.failures, nothing, **stranger) as subscriber:
        assert not subscriber.wait_joined(0.3)


@pytest.mark.slow
def test_a_service_with_keys_is_started_on_the_command_line(bundle, keys, photograph):
    command = [sys.executable, "-m", "epypes.cli", "serve", str(bundle), "--keys", str(keys / "service")]
    with subprocess.Popen(
        [*command, "--allow", str(keys / "known"), "--allow", str(keys / "stranger.key")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout.readline().startswith("READY")
            for name in ("known/caller", "stranger"):
                own = {"keys": keys / name, "allow": keys / "service.key"}
                answer = call(bundle, {"image": photograph}, timeout_s=WAIT_S, **own)
                assert np.array_equal(answer.tokens["edges"], cv2.Canny(photograph, 70, 200))
        finally:
            process.terminate()
            process.communicate(timeout=WAIT_S)


@pytest.mark.slow
def test_what_is_recorded_and_played_is_guarded(keys, epypes, tmp_path):
    out, into = queue.SimpleQueue(), queue.SimpleQueue()
    known, service = keys / "known" / "caller", keys / "service"
    with ep.ZMQPublisher(LOCAL, out, keys=service, allow=keys / "known") as publisher:
        for number in range(3):
            out.put(b"%d" % number)
        command = [sys.executable, "-m", "epypes.cli", "record", publisher.address, str(tmp_path / "a.mcap")]
        options = ["--messages", "2", "--keys", str(known), "--allow", f"{service}.key"]
        with subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True) as recorder:
            try:
                assert "has confirmed yet" not in recorder.stdout.readline()
                out.put(b"one")
                out.put(b"two")
                recorder.wait(WAIT_S)
            finally:
                recorder.kill()
    assert recording_info(tmp_path / "a.mcap").messages == 2
    with ep.ZMQSubscriber(LOCAL, into, bind=True, keys=service, allow=keys / "known") as subscriber:
        done = epypes("play", tmp_path / "a.mcap", f"connect:{subscriber.address}", "--speed", 0, *options[2:])
        assert "PLAYED" in done.stdout
        assert [into.get(timeout=WAIT_S) for _ in range(2)] == [b"one", b"two"]
        refused = epypes("play", tmp_path / "a.mcap", f"connect:{subscriber.address}", "--keys", known)
        assert refused.returncode == 1
        assert "not whose are allowed" in refused.stderr


@pytest.mark.slow
def test_a_stranger_that_connects_is_named_by_its_key_in_the_log(guarded, keys, caplog):
    own = {"keys": keys / "stranger", "allow": keys / "service.key"}
    stranger = read_keys(keys / "stranger").public
    with ep.ZMQSubscriber(guarded.service_state.pub, queue.SimpleQueue(), **own):
        wait_until(lambda: f"refused a peer with the unknown key {stranger}" in caplog.text, WAIT_S)


def test_a_key_file_that_is_none_is_named(bundle, keys, tmp_path):
    (tmp_path / "x.key").write_text(json.dumps({}))
    with pytest.raises(KeysError, match=r"x\.key is no key file"):
        Service(bundle, keys=keys / "service", allow=tmp_path / "x.key")
