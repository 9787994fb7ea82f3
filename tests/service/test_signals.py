from __future__ import annotations

import os
import signal
import socket
import subprocess
from contextlib import contextmanager

import psutil
import pytest

from epypes.errors import DeployRefused
from epypes.service import Service
from epypes.service.sd_notify import notify
from tests.service.processes import running
from tests.service.served import SOURCE, TIMEOUT_S, acting_bundle, peer_at, until
from tests.service.states import read_state

pytestmark = pytest.mark.slow  # each starts a service in a process of its own


@contextmanager
def served_apart(bundle, *options):
    """Serve a bundle in a process of its own, and talk to it."""
    with running(bundle, *options) as process:
        assert process.ready.startswith("READY"), process.stderr.read()
        state = read_state(bundle)
        with peer_at(state.sub, state.pub, state.failures) as peer:
            yield process, peer


def ended(process):
    """Return what a process has printed, once it has ended."""
    return process.communicate(timeout=TIMEOUT_S)


def worker_of(process):
    (worker,) = psutil.Process(process.pid).children()
    return worker


def test_ctrl_c_drains_what_was_accepted_and_ends_with_0(acting, tmp_path):
    with served_apart(acting, "--mailbox-size", "2") as (process, peer):
        worker = worker_of(process)
        peer.send(f"hold:{tmp_path}", 1)
        until((tmp_path / "started").exists)
        for value in (2, 3, 4):
            peer.send(number=value)
        # That the second is dropped tells that the last has come.
        assert peer.take()[0].correlation_id == peer.sent[1]
        # A stop of the terminal goes to the worker too.
        process.send_signal(signal.SIGINT)
        worker.send_signal(signal.SIGINT)
        until(lambda: not _accepts(read_state(acting)))
        (tmp_path / "release").touch()
        assert [answer.parts["out"] for answer in peer.take(3)] == [2, 6, 8]
        out, err = ended(process)
        assert process.returncode == 0, err
        assert "STOPPED received 4, answered 3, failed 0, dropped 1" in out
        assert not worker.is_running()


def _accepts(state):
    """Whether a service takes events yet: its port is bound."""
    host, _, port = state.sub.removeprefix("tcp://").rpartition(":")
    with socket.socket() as probe:
        return probe.connect_ex((host, int(port))) == 0


def test_what_does_not_return_is_reported_within_the_drain_and_the_exit_is_0(acting, tmp_path):
    with served_apart(acting, "--drain-timeout", "0.5", "--mailbox-size", "1") as (process, peer):
        worker = worker_of(process)
        peer.send(f"hold:{tmp_path}", 1)
        until((tmp_path / "started").exists)
        for number in (2, 3):
            peer.send(number=number)
        # That the second is dropped tells that the last has come.
        assert peer.take()[0].correlation_id == peer.sent[1]
        process.send_signal(signal.SIGTERM)
        answers = {answer.correlation_id: answer.failure.message for answer in peer.take(2)}
        assert "the service stops while it is in act" in answers[peer.sent[0]]
        assert "the service stops" in answers[peer.sent[2]]
        out, err = ended(process)
        assert process.returncode == 0, err
        assert "received 3, answered 0, failed 1, dropped 2" in out
        assert not worker.is_running()


def test_a_second_signal_stops_at_once(acting, tmp_path):
    with served_apart(acting, "--drain-timeout", "1000") as (process, peer):
        worker = worker_of(process)
        peer.send(f"hold:{tmp_path}", 1)
        until((tmp_path / "started").exists)
        process.send_signal(signal.SIGTERM)
        until(lambda: not _accepts(read_state(acting)))
        process.send_signal(signal.SIGTERM)
        _, err = ended(process)
        assert process.returncode == 1
        assert "Stopped at once by a second signal; 1 event" in err
        assert "Traceback" not in err
        until(lambda: not worker.is_running())


def test_a_signal_while_it_loads_ends_it(tmp_path):
    source = SOURCE + f"\n    open({str(tmp_path / 'loading')!r}, 'w').close()\n    time.sleep(1000)\n"
    bundle = acting_bundle(tmp_path / "slow", source=source)
    command = [os.sys.executable, "-m", "epypes.cli", "serve", str(bundle)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        until((tmp_path / "loading").exists)
        process.send_signal(signal.SIGTERM)
        out, err = ended(process)
        assert process.returncode == 0, err
        assert "STOPPED received 0" in out


def test_without_http_a_service_that_can_not_be_served_any_more_ends_with_1(tmp_path):
    copy = acting_bundle(tmp_path / "copy")
    with served_apart(copy) as (process, _):
        (copy / "pipeline.py").write_text("")
        worker_of(process).kill()
        _, err = ended(process)
        assert process.returncode == 1
        assert "pipeline.py was changed" in err
        assert "Traceback" not in err


def test_a_front_that_is_killed_takes_its_worker_along(acting, tmp_path):
    with served_apart(acting) as (process, peer):
        worker = worker_of(process)
        peer.send("regex", 1)
        peer.send(f"hold:{tmp_path}", 2)
        process.kill()
        process.wait(TIMEOUT_S)
        until(lambda: not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE)


@pytest.fixture
def notified(tmp_path, monkeypatch):
    """Returns a function that gives what systemd has been sent since."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))

        def read():
            lines = []
            try:
                while True:
                    lines += receiver.recv(4096).decode().splitlines()
            except BlockingIOError:
                return lines

        yield read


def test_systemd_is_notified_of_the_state(acting, notified, tmp_path, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    with Service(acting) as service:
        lines = []
        until(lambda: lines.extend(notified()) or {"READY=1", "WATCHDOG=1"} <= set(lines))
        wrong = acting_bundle(tmp_path / "wrong", expected=7)
        with pytest.raises(DeployRefused):
            service.deploy(wrong)
        lines = [line.partition("=")[0] for line in notified() if not line.startswith("WATCHDOG")]
        assert lines == ["RELOADING", "MONOTONIC_USEC", "READY"]
        environment = psutil.Process(service.info()["worker_pid"]).environ()
        assert not {"NOTIFY_SOCKET", "WATCHDOG_USEC"} & environment.keys()
    assert "STOPPING=1" in notified()


def test_a_socket_of_systemd_that_is_not_there_is_no_trouble(monkeypatch, tmp_path):
    assert not notify("READY=1")
    for address in (str(tmp_path / "none"), "@epypes-none", "tcp://127.0.0.1:1", "vsock:1"):
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        assert not notify("READY=1")


def test_a_standard_error_that_is_not_read_holds_nothing_up(acting):
    with served_apart(acting) as (process, peer):
        # More than a pipe holds, of the front's own log lines and of what the worker prints.
        for _ in range(60):
            assert peer.ask("fail:" + "x" * 2000).failure.exception == "ValueError"
        for _ in range(2):
            assert peer.ask("say:" + "y" * 100_000, 4).parts["out"] == 8
        process.send_signal(signal.SIGTERM)
        assert process.wait(TIMEOUT_S) == 0
