"""A service short of file descriptors, memory or luck with its workers: it stays, logs that in few lines, and recovers."""

from __future__ import annotations

import json
import os
import resource
import signal
import socket
import subprocess
import threading
import urllib.request
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import psutil
import pytest
import zmq

import epypes as ep
from epypes.service import Service
from tests.brokers.ports import free_ports
from tests.service.processes import lowered, running
from tests.service.served import SOURCE, acting_bundle, check_counts, peer_at, peer_of, until
from tests.service.states import read_state

pytestmark = pytest.mark.slow

WAIT_S = 90.0


def asked(state, path):
    with urllib.request.urlopen(state.http + path, timeout=WAIT_S) as answer:
        return json.load(answer)


def is_ready(state):
    return asked(state, "/v1/info")["state"] == "READY"


def idle_peers(stack, state, count):
    """Connect so many ZeroMQ peers to where events come in, and open as many idle connections to HTTP."""
    context = stack.enter_context(zmq.Context())
    peers = stack.enter_context(context.socket(zmq.XPUB))
    peers.setsockopt(zmq.LINGER, 0)
    for _ in range(count):
        peers.connect(state.sub)
    host, port = state.http.removeprefix("http://").split(":")
    for _ in range(count):
        stack.enter_context(socket.create_connection((host, int(port)), timeout=WAIT_S))


def test_idle_connections_leave_descriptors_for_http_and_a_new_worker_and_write_few_lines(acting, tmp_path):
    log = tmp_path / "log"
    with (
        log.open("wb") as stderr,
        running(acting, "--http", "127.0.0.1:0", limits="ulimit -n 256", stderr=stderr) as process,
    ):
        assert process.ready.startswith("READY"), log.read_text()
        state = read_state(acting)
        with ExitStack() as stack:
            idle_peers(stack, state, 300)
            until(lambda: "connection limit reached" in log.read_text(), WAIT_S)
            assert asked(state, "/livez") == {"alive": True, "reason": ""}
            before = asked(state, "/v1/info")["worker_pid"]
            os.kill(before, signal.SIGKILL)
            until(lambda: asked(state, "/v1/info").get("worker_pid") not in (before, None), WAIT_S)
            until(lambda: is_ready(state), WAIT_S)
            assert psutil.Process(process.pid).num_fds() < 250
        # Who was kept out comes in when the others have gone.
        with peer_at(state.sub, state.pub, state.failures) as peer:
            assert peer.ask(number=4).parts["out"] == 8
    assert process.returncode == 0
    assert len(log.read_bytes()) < 20_000, log.read_text()[:4_000]


def test_without_a_free_descriptor_the_worker_is_not_blamed_and_is_started_once_there_is_one(acting, caplog, quick):
    with Service(acting) as service:
        with no_free_descriptor():
            os.kill(service.info()["worker_pid"], signal.SIGKILL)
            until(lambda: caplog.text.count("The worker can't be started: Too many open files") == 5, WAIT_S)
            assert service.state == "DEGRADED"
        until(lambda: service.state == "READY", WAIT_S)
        with peer_of(service) as peer:
            assert peer.ask(number=4).parts["out"] == 8


@contextmanager
def no_free_descriptor():
    """Use up all descriptors of this process within the block."""
    highest = max(map(int, os.listdir("/proc/self/fd")))
    with lowered(resource.RLIMIT_NOFILE, highest + 1), ExitStack() as opened:
        with suppress(OSError):
            while True:
                opened.callback(os.close, os.dup(0))
        yield


def test_five_kills_while_loading_are_a_fault_until_a_worker_can_be_loaded(tmp_path, quick):
    flag = tmp_path / "dies"
    dying = f"\n    if os.path.exists({str(flag)!r}):\n        os.kill(os.getpid(), signal.SIGKILL)\n"
    bundle = acting_bundle(tmp_path / "dying", source=SOURCE + dying)
    with Service(bundle) as service, peer_of(service) as peer:
        flag.touch()
        os.kill(service.info()["worker_pid"], signal.SIGKILL)
        until(lambda: service.state == "FAULTED", WAIT_S)
        assert "5 workers ended in a row as soon as they were started" in service.reason
        assert "can't be served" in peer.ask().failure.message
        flag.unlink()
        until(lambda: service.state == "READY", WAIT_S)
        assert (service.reason, service.alive()) == ("", "")
        assert peer.ask(number=4).parts["out"] == 8
    check_counts(service.counts())


def test_serve_is_reachable_while_its_bundle_is_faulted_and_says_ready_once_another_one_is_deployed(tmp_path, acting):
    token, log = tmp_path / "token", tmp_path / "log"
    bundle = acting_bundle(tmp_path / "wrong", expected=7)
    token.write_text("t" * 43)
    token.chmod(0o600)
    (port,) = free_ports("127.0.0.1", 1)
    url = f"http://127.0.0.1:{port}"

    def mend():
        until(lambda: f"FAULTED {bundle}: " in log.read_text(), WAIT_S)
        with ep.connect(url, token="t" * 43) as control:
            control.deploy(acting)

    log.touch()
    mending = threading.Thread(target=mend)
    mending.start()
    options = "--http", url, "--token-file", str(token)
    with log.open("wb") as stderr, running(bundle, *options, stderr=stderr) as process:
        mending.join()
        assert process.ready.startswith("READY "), log.read_text()
        assert is_ready(read_state(bundle))


def test_without_memory_every_event_is_answered_or_counted_as_lost_and_the_service_recovers(acting):
    with running(acting, "--http", "127.0.0.1:0", limits="ulimit -Sn 256", stderr=subprocess.DEVNULL) as process:
        assert process.ready.startswith("READY")
        soft, hard = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)
        assert soft == hard, "the service allows itself the descriptors that it may have"
        state = read_state(acting)
        assert is_ready(state)
        with peer_at(state.sub, state.pub, state.failures) as peer:
            vms = psutil.Process(process.pid).memory_info().vms
            with lowered(resource.RLIMIT_AS, vms + 64 * 1024**2, process.pid):
                # Nothing need be loaded for the first event.
                assert peer.ask(number=np.arange(3)).parts["out"].tolist() == [0, 2, 4]
                for _ in range(3):
                    peer.send(number=np.zeros(100 * 1024**2, np.uint8))
                    answered_again(peer)
            assert peer.ask(number=5).parts["out"] == 10
            info = asked(state, "/v1/info")
        assert info["state"] == "READY"
        counts = info["counts"]
        check_counts(counts)
        assert counts["lost"] >= 3
        assert counts["received"] + counts["lost"] == len(peer.sent), counts


def answered_again(peer):
    """Send small events until one of them is answered: those before the peer is connected again are lost."""
    before = len(peer.sent)

    def is_answered():
        peer.send(number=2)
        found = [peer.answers.get() for _ in range(peer.answers.qsize())]
        return any(answer.correlation_id in peer.sent[before:] for answer in found)

    until(is_answered, WAIT_S)
