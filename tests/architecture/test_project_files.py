"""The files that a stranger and the repository's host look for: they parse, and what they name exists."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PYTHONS = [each.rpartition(" ")[2] for each in PROJECT["classifiers"] if " :: 3." in each]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
BIN = Path(sys.executable).parent


def read(path):
    return yaml.safe_load(path.read_text())


def commands():
    """Return the commands that workflows and hooks run, each once."""
    steps = [step for path in WORKFLOWS for job in read(path)["jobs"].values() for step in job.get("steps", ())]
    lines = [line for step in steps for line in step.get("run", "").splitlines()]
    hooks = [hook["entry"] for repo in read(ROOT / ".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]]
    return sorted({*lines, *hooks})


@pytest.mark.parametrize("line", commands())
def test_what_a_workflow_or_a_hook_runs_exists(line):
    words = shlex.split(line)
    if words[0] == "make":
        done = subprocess.run([*words, "--dry-run"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
        assert done.returncode == 0, done.stderr
    elif words[0] in {"sh", "bash"}:
        assert (ROOT / words[1]).is_file()
    elif words[0].startswith(".venv/bin/"):
        assert (BIN / Path(words[0]).name).exists()
    else:
        assert shutil.which(words[0])


def test_the_workflows_test_every_python_that_is_declared():
    tested = read(ROOT / ".github" / "workflows" / "tests.yml")["jobs"]["python"]["strategy"]["matrix"]["python"]
    assert tested == PYTHONS
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"


def test_a_release_waits_for_the_tests_and_alone_may_publish():
    jobs = read(ROOT / ".github" / "workflows" / "release.yml")["jobs"]
    called = jobs[jobs["publish"]["needs"][0]]["uses"]
    assert (ROOT / called).is_file()
    assert [name for name, job in jobs.items() if "id-token" in job.get("permissions", ())] == ["publish"]


def test_updates_are_looked_for_where_the_workflows_are():
    (update,) = read(ROOT / ".github" / "dependabot.yml")["updates"]
    assert update["package-ecosystem"] == "github-actions"


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.stem)
def test_a_form_asks_for_something_under_ids_of_its_own(form):
    fields = [field for field in read(form)["body"] if field["type"] != "markdown"]
    assert len({field["id"] for field in fields}) == len(fields)
    assert any(field.get("validations", {}).get("required") for field in fields)
    assert all(field["attributes"]["label"] for field in fields)


def test_the_citation_is_of_the_paper_that_the_package_names():
    citation = read(ROOT / "CITATION.cff")
    paper = citation["preferred-citation"]
    assert PROJECT["urls"]["Paper"].endswith(f"/{paper['doi']}")
    assert [author["family-names"] for author in paper["authors"]] == ["Semeniuta", "Falkman"]
    assert citation["license"] == PROJECT["license"]


def test_binder_has_a_tested_python_and_every_extra_that_the_tutorials_use():
    (line,) = [line for line in (ROOT / ".binder" / "requirements.txt").read_text().splitlines() if line[0] != "#"]
    binder = Requirement(f"epypes{line.removeprefix('.')}")
    assert binder.extras <= PROJECT["optional-dependencies"].keys()
    assert PYTHONS[0] == (ROOT / ".binder" / "runtime.txt").read_text().strip().removeprefix("python-")
