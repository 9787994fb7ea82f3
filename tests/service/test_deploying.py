"""What a deploy, a rollback and a write-back report, and what is found afterwards."""

from __future__ import annotations

import math
import os
import re
import shutil
import signal

import pytest

from epypes.bundle.manifest import check_manifest, write_manifest
from epypes.errors import DeployRefused, ServiceError, UnknownName
from epypes.service import Service
from epypes.service.failures.source import failures_of, find_failure
from tests.service.processes import running
from tests.service.served import SOURCE, acting_bundle, serving, until
from tests.service.states import read_state

pytestmark = pytest.mark.slow


@pytest.fixture
def better(tmp_path):
    return acting_bundle(tmp_path / "better", k=3, expected=9)


@pytest.fixture
def own(acting, tmp_path):
    return shutil.copytree(acting, tmp_path / "own")


def test_values_that_a_deploy_replaces_are_reported(acting, better):
    with serving(acting) as (service, _):
        service.set_parameters({"k": 14})
        assert service.deploy(better)["changed"] == ["k 14 -> 3 (tuned, not written back)"]
        assert service.rollback()["changed"] == ["k 3 -> 2"]


def test_failures_of_a_bundle_that_was_deployed_are_found_by_its_path_and_by_the_event(acting, better):
    with serving(acting) as (service, peer):
        service.deploy(better)
        failure = peer.ask("fail:here").failure
        assert service.failure_store.flush()
    (record,) = failures_of(better).records()
    assert record.message == "here"
    assert find_failure(failures_of(better), failure.input_id) == record
    assert failures_of(better).event(record.id).id == failure.input_id
    with pytest.raises(UnknownName):
        find_failure(failures_of(better), "0" * 32)


def test_values_that_were_written_back_are_those_of_the_bundle_that_is_served(own, better, caplog):
    caplog.set_level("INFO", "epypes.service")
    deployed = []
    with serving(own) as (service, peer):
        service.listen(lambda kind, data: deployed.append(data) if kind == "deployed" else None)
        before = service.info()["digest"]
        service.set_parameters({"k": 10})
        written = service.write_back()
        assert "+value = 10" in written.diff
        assert service.info()["digest"] == written.digest != before
        assert [data["digest"] for data in deployed] == [written.digest]
        os.kill(service.info()["worker_pid"], signal.SIGKILL)
        assert peer.ask(number=2).parts["out"] == 20
        assert service.deploy(better)["changed"] == ["k 10 -> 3"]
        assert service.rollback()["digest"] == written.digest
        assert peer.ask(number=2).parts["out"] == 20
        with (own / "pipeline.toml").open("a") as file:
            file.write(" ")
        service.deploy(better)
        with pytest.raises(DeployRefused, match=r"pipeline\.toml was changed"):
            service.rollback()
        write_manifest(own)
        with pytest.raises(DeployRefused, match=rf"can't be rolled back to .*: epypes deploy {own}"):
            service.rollback()
    lines = [record.getMessage() for record in caplog.records if record.levelname == "INFO"]
    for begin in (
        "parameters, revision 1: k 2 -> 10",
        "wrote parameters",
        "deployed",
        "rolled back",
        "the worker is st",
    ):
        assert any(line.startswith(begin) for line in lines), begin


def test_a_service_is_found_by_the_bundle_it_was_started_with_and_by_the_one_that_was_deployed(acting, better, epypes):
    with running(acting, "--http", "127.0.0.1:0"):
        state = read_state(acting)
        assert "No service of yours runs" in epypes("status", better).stderr
        assert "k 2 -> 3" in epypes("deploy", better, "--http", state.http).stdout
        until(lambda: read_state(acting).digest == check_manifest(better))
        for bundle in (acting, better):
            assert epypes("status", bundle).stdout.startswith(f"READY {better}")
            answered = epypes("call", bundle, 'what="plain"', "number=5")
            assert answered.stdout.startswith("out = 15"), answered.stderr
        assert epypes("verify", better, "--against", better).returncode == 0
        assert epypes("set", better, "k=5").returncode == 0
        changed = epypes("verify", better, "--against", better).stderr
        assert re.search(r"in 1 place, token 'out'\. Likely: .* at revision \d+: k is 5, in the bundle 3\.", changed)
        other = epypes("verify", acting, "--against", acting).stderr
        assert f"Likely: The service serves another bundle ({check_manifest(better)[:12]})" in other


def test_the_child_of_a_function_that_forks_does_not_go_on_as_a_worker(tmp_path):
    forking = SOURCE.replace(
        "    ACTIONS = {",
        f"""
    def fork(more):
        if not os.fork():
            open({str(tmp_path / "child")!r}, "w").write(str(os.getpid()))


    ACTIONS = {{
        "fork": fork,""",
    )
    with serving(acting_bundle(tmp_path / "forking", source=forking)) as (_, peer):
        assert peer.ask("fork", 3).parts["out"] == 6
        until(lambda: (tmp_path / "child").exists() and (tmp_path / "child").read_text())
        child = int((tmp_path / "child").read_text())
        until(lambda: _has_ended(child))
        assert peer.ask("plain", 4).parts["out"] == 8


def _has_ended(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.parametrize(
    "options", [{"threads": 0}, {"threads": 65}, {"job_timeout_s": math.inf}, {"job_timeout_s": math.nan}]
)
def test_what_a_service_can_not_be_run_with_is_refused(acting, options):
    with pytest.raises(ServiceError, match="events at once|number of seconds"):
        Service(acting, **options)
