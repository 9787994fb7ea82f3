"""The README's commands and code do what it says."""

from __future__ import annotations

import re
import shlex
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import epypes as ep
from epypes.acquisition import read_image, write_image
from tests.brokers.nats import is_installed
from tests.service.processes import run_cli, running
from tests.service.served import until

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands() -> list[str]:
    return [line for block in blocks("sh") for line in block.splitlines() if line.startswith("epypes ")]


# What needs a broker, and what is said to the services on it.
BROKER = "nats://127.0.0.1"
BESIDE_A_BROKER = ("epypes serve services/edges --sub", "epypes set", "epypes status", "epypes stop")


def test_the_code_runs_from_top_to_bottom(straight_edges, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in blocks("python"):
        if BROKER in block:
            continue
        exec(compile(block, "README.md", "exec"), names)
    assert np.array_equal(names["run"]["edges"], straight_edges)
    assert np.array_equal(names["edges"], straight_edges)


@pytest.mark.notebook
def test_the_epypes_commands_run_in_order(tmp_path, monkeypatch, photograph, straight_edges):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "notebooks", tmp_path / "notebooks", ignore=shutil.ignore_patterns("edge_service"))
    Path("demo-output").mkdir()
    write_image("demo-output/image.png", photograph)
    lines = [line for line in commands() if not line.startswith(BESIDE_A_BROKER)]
    assert [line.split()[1] for line in lines] == ["promote", "verify", "serve", "call", "experiment"]
    promote, verify, serve, call, experiment = (shlex.split(line)[1:] for line in lines)
    for command in (promote, verify):
        done = run_cli(*command)
        assert done.returncode == 0, done.stderr
    with running(serve[1], *serve[2:]) as process:
        assert process.ready.startswith("READY"), process.stderr.read()
        done = run_cli(*call)
        assert done.returncode == 0, done.stderr
    assert np.array_equal(read_image("edges.png"), straight_edges)
    done = run_cli(*experiment)
    assert done.returncode == 0, done.stderr
    assert len(Path("results/requests.csv").read_text().splitlines()) == 1 + 2 * 100


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Start the server by the README's line, on a port of its own; what the addresses begin with then."""
    if not is_installed():
        pytest.skip("nats is not installed on this machine: sh .ci/brokers")
    (line,) = (line for block in blocks("sh") for line in block.splitlines() if " nats-server " in line)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    monkeypatch.chdir(tmp_path)
    # The shell becomes the server, which is ended then.
    line = f"{line.replace('nats-server', 'exec nats-server', 1)} --port {port}"
    with subprocess.Popen(["sh", "-c", line], stderr=subprocess.PIPE, text=True) as server:
        try:
            assert any("Server is ready" in said for said in server.stderr)
            yield f"{BROKER}:{port}"
        finally:
            server.terminate()
            server.communicate(timeout=60)


@pytest.mark.notebook
def test_the_commands_beside_a_broker_run_in_order(
    tmp_path, monkeypatch, own_folders, edge_runner, photograph, straight_edges, here
):
    monkeypatch.chdir(tmp_path)
    edge_runner.run(image=photograph)
    ep.promote(edge_runner, "services/edges", outputs=["edges"])
    lines = [line.replace(BROKER, here) for line in commands() if line.startswith(BESIDE_A_BROKER)]
    serve, change, status, stop = (shlex.split(line)[1:] for line in lines)
    (client,) = (block.replace(BROKER, here) for block in blocks("python") if BROKER in block)
    names: dict = {}
    with running(serve[1], *serve[2:]) as one, running(serve[1], *serve[2:]) as other:
        assert "(replica 1)" in one.ready
        assert "(replica 2)" in other.ready
        exec(compile(client, "README.md", "exec"), names)
        assert np.array_equal(names["answer"].parts["edges"], straight_edges)
        done = run_cli(*change)
        assert "canny_lo 70 -> 90: revision 1" in done.stdout, done.stderr
        until(lambda: run_cli(*status).stdout.count(" answered, revision 1, ") == 2)
        told = run_cli(*status).stdout
        assert "Parameters, revision 1: blur_kernel=11, canny_lo=90" in told
        assert "replicas 2, ready 2, all with the same bundle and parameters" in told
        done = run_cli(*stop)
        assert done.stdout.count("STOPPED") == 2, done.stdout + done.stderr


@pytest.mark.parametrize("target", ["demo", "test", "lab", "bench", "fix"])
def test_the_make_targets_exist(target):
    done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f"make {target}" in README + (ROOT / "CONTRIBUTING.md").read_text()


def test_the_files_it_points_to_exist():
    for link in re.findall(r"\]\(([^)]+)\)|src=\"([^\"]+)\"", README):
        assert (ROOT / (link[0] or link[1])).exists()


def test_the_command_is_installed():
    assert (Path(sys.executable).parent / "epypes").exists()
