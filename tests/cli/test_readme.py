"""Do the README's commands and code do what it says?"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from epypes.acquisition import read_image, write_image
from tests.service.processes import run_cli, running

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_code_runs_from_top_to_bottom(straight_edges, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    assert np.array_equal(names["run"]["edges"], straight_edges)
    assert np.array_equal(names["edges"], straight_edges)


@pytest.mark.notebook
def test_the_epypes_commands_run_in_order(tmp_path, monkeypatch, photograph, straight_edges):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "notebooks", tmp_path / "notebooks", ignore=shutil.ignore_patterns("edge_service"))
    Path("demo-output").mkdir()
    write_image("demo-output/image.png", photograph)
    lines = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("epypes ")]
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
