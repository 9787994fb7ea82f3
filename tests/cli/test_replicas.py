from __future__ import annotations

import json
import queue
import re
import signal
import subprocess
from contextlib import ExitStack

import pytest

import epypes as ep
from epypes.errors import ServiceError
from epypes.service.state_file import ServiceState, StateLock, read_states
from tests.service.processes import running
from tests.service.served import TIMEOUT_S, acting_bundle, event, until
from tests.service.states import read_state

pytestmark = pytest.mark.usefixtures("own_folders")


@pytest.fixture(scope="module")
def acting(tmp_path_factory):
    return acting_bundle(tmp_path_factory.mktemp("bundles") / "acting")


def state(pid, **more):
    return ServiceState(pid, "nats://127.0.0.1/a", "nats://127.0.0.1/b", "d", **more)


def test_replicas_take_the_first_number_that_is_free_and_are_found_in_order(tmp_path):
    with ExitStack() as held:
        locks = []
        for number in range(1, 12):
            lock = StateLock.of_next(tmp_path)
            locks.append(held.enter_context(ExitStack()))
            locks[-1].enter_context(lock)
            assert lock.replica == str(number)
            lock.publish(state(number, replica=lock.replica))
        assert [found.pid for found in read_states(tmp_path)] == list(range(1, 12))
        assert read_state(tmp_path, "10").pid == 10
        assert read_state(tmp_path, "x") is None
        locks[3].close()
        assert [found.pid for found in read_states(tmp_path)] == [1, 2, 3, *range(5, 12)]
        assert held.enter_context(StateLock.of_next(tmp_path)).replica == "4"


@pytest.mark.slow
def test_two_replicas_of_one_name_and_names_that_are_no_file_names_are_refused(tmp_path):
    with StateLock(tmp_path, "left"), StateLock(tmp_path, "right"), StateLock(tmp_path):
        with pytest.raises(ServiceError, match="being served already as replica 'left'"):
            StateLock(tmp_path, "left")
        for name in ("../x", "a b", "-x", "x" * 41):
            with pytest.raises(ServiceError, match="can't be called"):
                StateLock(tmp_path, name)


@pytest.mark.slow
def test_a_replica_that_says_nothing_keeps_nobody_from_hearing_of_the_others(acting, epypes):
    with StateLock(acting, "1") as mute, StateLock(acting, "2") as other:
        mute.publish(state(11, http="http://127.0.0.1:1", replica="1"))
        other.publish(state(12, replica="2"))
        told = epypes("status", acting).stdout
        alone = epypes("status", acting, "--replica", "1")
    assert "SILENT" in told
    assert re.search(r"^- 1: SILENT \(.+process 11$", told, re.MULTILINE)
    assert re.search(r"^- 2: RUNNING, .+process 12, no --http$", told, re.MULTILINE)
    assert alone.returncode == 1


@pytest.mark.slow
def test_all_replicas_are_stopped_though_one_is_late_and_one_has_just_ended(acting, epypes):
    sleeping, deaf = ["sleep", "100"], ["bash", "-c", "trap '' TERM; echo deaf; read line"]
    ended = subprocess.Popen(["true"])
    ended.wait()
    with (
        subprocess.Popen(sleeping) as last,
        subprocess.Popen(deaf, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as late,
        ExitStack() as held,
    ):
        assert late.stdout.readline() == b"deaf\n"
        for number, process in enumerate((ended, late, last), 1):
            lock = held.enter_context(StateLock(acting, str(number)))
            lock.publish(state(process.pid, replica=str(number)))
        done = epypes("stop", acting, "--timeout", "1")
        late.stdin.close()
        assert last.wait(TIMEOUT_S) == -signal.SIGTERM
    assert (done.returncode, done.stdout.count("STOPPED")) == (1, 2)
    assert f"Process {late.pid}, which serves {acting}, has not ended within 1 s" in done.stderr


@pytest.mark.slow
def test_three_replicas_on_a_real_broker_are_told_apart_and_stopped_together(acting, nats, tmp_path, epypes):
    secret = tmp_path / "password"
    secret.write_text(nats.password)
    open_address = nats.address("three.events", create=True)
    where = {
        name: f"nats://{nats.user}@127.0.0.1:{nats.port}/three.{name}?create=true&password_file={secret}"
        for name in ("events", "answers")
    }
    options = ["--sub", where["events"], "--pub", where["answers"], "--http", "127.0.0.1:0"]
    requests, answers = queue.Queue(), queue.Queue()
    with ExitStack() as held:
        first, second, third = (
            held.enter_context(running(acting, *options, *more)) for more in ((), (), ("--replica", "c"))
        )
        assert "(replica 1): events at nats://epypes@127.0.0.1" in first.ready
        assert "(replica 2)" in second.ready
        assert "(replica c)" in third.ready
        held.enter_context(ep.Subscriber(where["answers"], answers, acknowledge="received"))
        held.enter_context(ep.Publisher(open_address, requests))
        sent = [event("sleep:0.01", number) for number in range(60)]
        for each in sent:
            requests.put(each)
        answered = {answers.get(timeout=TIMEOUT_S).correlation_id for _ in sent}
        assert answered == {each.id for each in sent}

        def counted():
            return [found["counts"] for found in json.loads(epypes("status", acting, "--json").stdout)]

        until(lambda: sum(counts["answered"] for counts in counted()) == 60)
        assert all(counts["answered"] for counts in counted()), "all have had some"
        told = epypes("status", acting).stdout
        assert told.count(": READY, ") == 3
        assert "- c: READY, " in told
        assert "failures at" not in told + first.ready
        assert "0 redelivered, 0 duplicates, 0 given back" in told
        assert epypes("status", acting, "--replica", "2").stdout.count(f"READY {acting}") == 1
        assert "replica 'x'" in epypes("status", acting, "--replica", "x").stderr
        for found in read_states(acting):
            with ep.connect(found.http) as service:
                assert "password_file" not in json.dumps(service.info())
        assert "would take answers from it" in epypes("call", acting, "what=x", "number=y").stderr + refused(acting)
        assert f"STOPPED {acting}, replica 2" in epypes("stop", acting, "--replica", "2").stdout
        stopped = epypes("stop", acting).stdout
        assert ("replica 1" in stopped, "replica 2" in stopped, "replica c" in stopped) == (True, False, True)
        said = [process.communicate(timeout=TIMEOUT_S) for process in (first, second, third)]
    assert nats.password not in str(said)
    assert all("given_back 0" in out for out, _ in said)


def refused(bundle):
    from epypes.service import call

    with pytest.raises(ServiceError) as found:
        call(bundle, {"what": "plain", "number": 1})
    return str(found.value)


@pytest.mark.slow
def test_a_caller_gets_its_answer_where_answers_are_for_all(acting, nats):
    where = [nats.address("called.events", create=True), nats.address("called.answers", kind="broadcast")]
    from epypes.service import Client

    with running(acting, "--sub", where[0], "--pub", where[1]) as process:
        assert "kind=broadcast" in process.ready
        with Client(acting, sub=where[0], pub=where[1], timeout_s=TIMEOUT_S) as client:
            assert client.call({"what": "plain", "number": 4}).tokens["out"] == 8


@pytest.mark.slow
def test_a_wrong_password_is_said_without_it(acting, nats, epypes):
    address = nats.address("events", create=True).replace(f"{nats.user}:", f"{nats.user}:wrong")
    done = epypes("serve", acting, "--sub", address)
    assert done.returncode == 1
    assert "nats://epypes@127.0.0.1" in done.stderr
    assert "wrong" not in done.stderr.replace("wrong password", "").replace("password is wrong", "")
    assert "Traceback" not in done.stderr
