"""``--help`` of every command prints its text without importing what the command needs."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import click
import pytest

import epypes as ep
from epypes.cli.app import app
from epypes.errors import AddressError
from epypes.transport.address import parse_address

COMMANDS = [[name] for name in app.commands] + [["export", name] for name in app.commands["export"].commands]
# The rooms of EPypes that the command line may import before it knows what to do.
LIGHT = {"cli", "deprecation", "errors", "optional", "tracebacks", "wording"}
# Besides the standard library.
LIBRARIES = {"click", "epypes"}
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


def test_help_imports_no_library_but_click_and_no_other_room():
    calls = [[], *COMMANDS]
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", f"import sys; sys.path[:] = {sys.path!r}\n{CODE}", json.dumps(calls)],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    rows = [json.loads(line.removeprefix("LOADED ")) for line in done.stdout.splitlines() if line.startswith("LOADED ")]
    assert [(arguments, code) for arguments, code, _ in rows] == [(call, 0) for call in calls], done.stdout
    for arguments, _, modules in rows:
        packages = {name.partition(".")[0] for name in modules if not name.startswith("__")}
        assert packages - sys.stdlib_module_names == LIBRARIES, arguments
        rooms = {name.split(".")[1] for name in modules if name.startswith("epypes.")}
        assert rooms <= LIGHT, arguments


def test_help_has_a_whole_line_for_every_command(epypes, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    said = epypes("--help").stdout
    topics = said.partition("From a notebook to a bundle:")[2].partition("Examples:")[0]
    lines = {line.split()[0]: line for line in topics.splitlines() if line.startswith("  ")}
    assert lines.keys() == app.commands.keys()
    columns = {line.index(re.split("  +", line)[2]) for line in lines.values()}
    assert len(columns) == 1, "the topics are one table"
    assert [line for line in lines.values() if line.rstrip().endswith("...") or len(line.split()) < 3] == []


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_argument_and_option_is_explained(words):
    command = app
    for word in words:
        command = command.commands[word]
    assert command.help
    assert [each.name for each in command.params if not each.help] == []


@pytest.mark.parametrize("package", ["epypes", "epypes.cli"])
def test_the_command_runs_as_a_module_too(package):
    done = subprocess.run(
        [sys.executable, "-m", package, "serve"], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 2
    assert "Usage: epypes serve" in done.stderr


@pytest.mark.parametrize(
    "text", [click.unstyle(app.commands["serve"].help), parse_address.__doc__], ids=["serve --help", "parse_address"]
)
def test_every_option_of_an_address_is_described(text):
    with pytest.raises(AddressError, match="There are: ") as refused:
        parse_address("amqp://127.0.0.1/events?no_such_option=1")
    options = str(refused.value).partition("There are: ")[2].rstrip(".").split(", ")
    assert "create" in options
    assert [option for option in options if f"{option}=" not in text] == []


def test_the_help_of_check_documents_the_keys_of_a_case(epypes):
    said = epypes("check", "--help").stdout
    for key in (
        "[[case]]",
        "[[case.check]]",
        "inputs = ",
        "hyperparameters = ",
        "token = ",
        "expected = ",
        "metric = ",
    ):
        assert key in said


def test_without_a_command_the_help_is_printed(epypes):
    done = epypes()
    assert done.returncode == 2
    assert "A running service:" in done.stderr


@pytest.mark.parametrize("words", [[], *COMMANDS], ids=" ".join)
def test_every_help_has_an_example_that_its_command_takes(words, epypes):
    text = epypes(*words, "--help").stdout
    examples = [line.strip() for line in text.partition("Example")[2].splitlines()[1:]]
    assert examples
    assert "<bool>" not in text
    assert "BOOLEAN" not in text
    for line in examples:
        given = shlex.split(line)[1:]
        assert given[: len(words)] == words
        found = app
        while isinstance(found, click.Group):
            found = found.commands[given.pop(0)]
        if "-h" not in given:
            found.make_context("epypes", given)


def complete(words, tmp_path):
    """Return what bash offers for the last word of a command line."""
    script = 'source <(epypes completion bash); _epypes_completion epypes; printf "%s\\n" "${COMPREPLY[@]}"'
    line = f"COMP_WORDS=({' '.join(map(repr, words))}); COMP_CWORD={len(words) - 1}; {script}"
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-c", line], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stderr == ""
    return set(done.stdout.split())


@pytest.mark.slow
def test_bash_completes_commands_options_and_choices(tmp_path):
    assert complete(["epypes", "se"], tmp_path) == {"serve", "set"}
    assert complete(["epypes", "serve", "edges", "--job"], tmp_path) == {"--job-timeout"}
    assert complete(["epypes", "serve", "edges", "--state-per", ""], tmp_path) == {"one", "source"}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_gets_a_script_that_asks_epypes(shell, epypes):
    assert f"_EPYPES_COMPLETE={shell}_complete" in epypes("completion", shell).stdout


@pytest.mark.parametrize("words", [[], ["serve"], ["export"], ["export", "docker"]], ids=" ".join)
def test_h_is_help(epypes, words):
    assert epypes(*words, "-h").stdout == epypes(*words, "--help").stdout


def test_version_is_that_of_the_package(epypes):
    module = subprocess.run([sys.executable, "-m", "epypes", "--version"], capture_output=True, text=True, check=True)
    assert epypes("--version").stdout.split() == module.stdout.split() == ["epypes", ep.__version__]
    assert ep.__version__ == metadata.version("epypes")
