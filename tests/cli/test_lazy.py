"""A command imports its own module when it is called, and no other command's."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import typer

from epypes.cli.app import app

COMMANDS = typer.main.get_command(app).commands
# What the command line consists of, besides the modules of the commands.
FRAME = {"epypes", "epypes.errors", "epypes.optional", "epypes.wording", "epypes.cli", "epypes.cli.app"}
SHARED = {"epypes.cli.terminal", "epypes.cli.source", "epypes.cli.options"}
OWN = {"rollback": {"epypes.cli.deploy"}, "demo": {"epypes.cli.demo", "epypes.cli.promote"}}
HEAVY = {"numpy", "cv2", "zmq", "google", "fastapi", "starlette", "uvicorn", "httpx", "PIL", "pandas", "tomlkit",
         "prometheus_client", "sqlalchemy", "nbclient", "nbformat", "jupyterlab", "IPython", "matplotlib"}  # fmt: skip
# Each command has a process of its own, forked from one that has imported what all of them need.
CODE = """
import json, os, sys
import epypes.cli.app
from epypes.cli import main

for arguments in json.loads(sys.argv[1]):
    if not (child := os.fork()):
        try:
            main([*arguments, "--help"])
        except SystemExit as ended:
            print()
            print("LOADED", json.dumps([arguments, ended.code or 0, sorted(sys.modules)]), flush=True)
        os._exit(0)
    os.waitpid(child, 0)
"""


def loaded(*calls):
    """Return what each call of the command line has imported when it has printed its help."""
    done = subprocess.run(
        [sys.executable, "-c", CODE, json.dumps(calls)], capture_output=True, text=True, check=True, timeout=120
    )
    rows = [json.loads(line.removeprefix("LOADED ")) for line in done.stdout.splitlines() if line.startswith("LOADED ")]
    assert [(arguments, code) for arguments, code, _ in rows] == [(list(call), 0) for call in calls], done.stdout
    return [set(modules) for _, _, modules in rows]


def own(modules):
    return {name for name in modules if name.partition(".")[0] == "epypes"}


def packages(modules):
    return {name.partition(".")[0] for name in modules}


def test_help_imports_no_command():
    (modules,) = loaded([])
    assert own(modules) <= FRAME
    assert not packages(modules) & HEAVY


@pytest.mark.slow
def test_the_help_of_a_command_imports_that_command_alone():
    names = sorted(COMMANDS)
    for name, modules in zip(names, loaded(*([name] for name in names)), strict=True):
        mine = OWN.get(name, {f"epypes.cli.{name}"})
        assert own(modules) - FRAME - SHARED == mine, name
        assert not packages(modules) & HEAVY, name


def test_help_has_a_whole_line_for_every_command():
    done = subprocess.run(
        [sys.executable, "-m", "epypes.cli", "--help"],
        capture_output=True, text=True, check=True, timeout=60, env={"COLUMNS": "80"},
    )  # fmt: skip
    lines = {line.split()[0]: line for line in done.stdout.partition("Commands:")[2].splitlines() if line.strip()}
    assert lines.keys() == COMMANDS.keys()
    assert [line for line in lines.values() if line.rstrip().endswith("...") or len(line.split()) < 3] == []
