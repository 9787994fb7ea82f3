"""Every command that fails exits non-zero with one actionable line.

Each command has a row here: a new one without a row fails the first test.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.bundle.manifest import write_manifest
from epypes.cli.app import app
from epypes.wire import load_sample, save_sample

# By command: what it is given, and what its line says. {bundle} is a good bundle, {broken} one whose pipeline.toml is no
# TOML, {other} one that computes something else, {folder} an empty folder, {text} a file of text, {cases} cases that
# fail, {wrong} a file of cases with a mistake.
ROWS = {
    "promote": [
        (["{folder}/none.ipynb", "--to", "{folder}/b"], "Notebook {folder}/none.ipynb can't be read: No such file"),
        (["{text}", "--to", "{folder}/b"], "{text} is not a notebook"),
    ],
    "verify": [
        (["{folder}/none"], "{folder}/none does not exist. Make a bundle with: epypes promote"),
        (["{folder}"], "{folder} is not a bundle"),
        (["{text}"], "{text} is a file. Name the folder of a bundle"),
        (["{broken}"], "pipeline.toml can't be read: "),
        (["{other}"], "{other} does not compute what was recorded: in 1 place, token 'edges'. Likely: "),
        (["{other}", "--json"], "does not compute what was recorded"),
    ],
    "check": [
        (["{folder}/none", "{cases}"], "{folder}/none does not exist"),
        (["{broken}", "{cases}"], "pipeline.toml can't be read: "),
        (["{bundle}", "{folder}/none.toml"], "There is no file '{folder}/none.toml'. Check the path."),
        (["{bundle}", "{text}"], "{text} is not TOML: "),
        (["{bundle}", "{wrong}"], "line 1: No key 'metrc' for metric 'value' of case 'left'. Did you mean 'metric'?"),
        (
            ["{bundle}", "{cases}"],
            "{bundle} does not pass {cases}: 1 of 1 case failed: none.png. First: none.png, runs: ",
        ),
        (["{bundle}", "{cases}", "--json"], "1 of 1 case failed"),
        (
            ["{bundle}", "{cases}", "--junit", "{folder}/none/a.xml"],
            "'{folder}/none/a.xml' can't be written: there is no folder",
        ),
    ],
    "serve": [
        (["{folder}/none"], "{folder}/none does not exist"),
        (["{broken}"], "pipeline.toml can't be read: "),
        (["{bundle}", "--sub", "nonsense"], "nonsense"),
    ],
    "call": [
        (["{folder}/none", "image.png"], "{folder}/none does not exist"),
        (["{bundle}", "{folder}/none.png"], "Image '{folder}/none.png' can't be read"),
        (["{broken}", "image.png"], "pipeline.toml can't be read: "),
    ],
    "deploy": [
        (["{bundle}", "--http", "http://127.0.0.1:9"], "No service answers at http://127.0.0.1:9. Start one: "),
        (["{bundle}", "--service", "{bundle}"], "No service of yours runs for {bundle}."),
    ],
    "rollback": [(["--http", "nonsense"], "nonsense does not exist. Name the bundle that is served, or its http URL.")],
    "reset": [
        (["{bundle}"], "No service of yours runs for {bundle}."),
        (["http://127.0.0.1:9", "--source", "left"], "No service answers at http://127.0.0.1:9. Start one: "),
    ],
    "status": [
        (["{folder}/none"], "{folder}/none does not exist. Name the bundle that is served"),
        (["{bundle}"], "No service of yours runs for {bundle}. Start it: epypes serve {bundle}"),
        (["http://127.0.0.1:9"], "No service answers at http://127.0.0.1:9. Start one: "),
    ],
    "set": [
        (["{bundle}", "lo"], "'lo' sets nothing. Write NAME=VALUE, as sigma=1.4."),
        (["{bundle}", "lo=60"], "No service of yours runs for {bundle}."),
    ],
    "stop": [
        (["{bundle}"], "No service of yours runs for {bundle}."),
        (["http://127.0.0.1:9"], "No service of yours runs for http://127.0.0.1:9."),
    ],
    "failures": [(["{folder}/none"], "{folder}/none does not exist")],
    "replay": [(["latest", "{folder}/none"], "{folder}/none does not exist"), (["abc"], "No failure 'abc' here")],
    "cameras": [],  # it lists what there is, and what is missing to look for more
    "keys": [(["a/b"], "is no name for keys")],
    "doctor": [(["{folder}"], "Not ready: bundle")],
    "export": [
        (["systemd", "{folder}/none"], "{folder}/none does not exist"),
        (["docker", "{broken}", "--to", "{folder}/image"], "pipeline.toml can't be read: "),
        (["cpp", "{broken}", "--to", "{folder}/cpp"], "pipeline.toml can't be read: "),
    ],
    "record": [(["nonsense", "{folder}/a.mcap"], "'nonsense' is not the beginning of an address that EPypes knows")],
    "play": [
        (["{folder}/none.mcap"], "can't be read"),
        (["{text}"], "is no MCAP file"),
    ],
    "experiment": [(["--camera", "left.png"], "cameras must be two")],
    "demo": [(["{folder}/none.ipynb", "--to", "{folder}/demo"], "Notebook {folder}/none.ipynb can't be read")],
    "lab": [(["{folder}/none"], "There is no folder '{folder}/none' to show in JupyterLab")],
    "completion": [],  # writes a text; a shell that it does not know is click's error
}


# By command: what does not fail before it is looked for what an extra brings.
FIRST = {
    "promote": ["{text}", "--to", "{folder}/b"],
    "lab": ["{folder}"],
    "serve": ["{bundle}"],
}


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Folders and files by the names that the rows have for them."""
    base = tmp_path_factory.mktemp("failing")
    runner = ep.CompGraphRunner(
        ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")}), {"lo": 70, "hi": 200}
    )
    runner.run(image=np.random.default_rng(3).integers(0, 255, (60, 80), np.uint8))
    found = {name: base / name for name in ("bundle", "broken", "other", "folder", "text", "cases", "wrong")}
    ep.promote(runner, found["bundle"])
    for name in ("broken", "other"):
        shutil.copytree(found["bundle"], found[name])
    (found["broken"] / "pipeline.toml").write_text("[ports\n")
    write_manifest(found["broken"])
    sample = found["other"] / "samples" / "000.npz"
    inputs, outputs = load_sample(sample)
    save_sample(sample, inputs, {"edges": outputs["edges"] ^ 255})
    write_manifest(found["other"])
    found["folder"].mkdir()
    found["text"].write_text("some text")
    found["cases"].write_text('[[case]]\ninputs = {image = "none.png"}\n')
    found["wrong"].write_text('[[case]]\nname = "left"\ninputs = 1\n[[case.check]]\nmetrc = "iou"\n')
    return {name: str(path) for name, path in found.items()}


def one_line(done):
    """Return the line that says why; what a progress display has left may stand above it."""
    lines = done.stderr.strip().splitlines()
    said = [line for line in lines if line.strip() not in ("", "executing the notebook")]
    assert done.returncode == 1, done
    assert len(said) == 1, lines
    assert said[0].startswith("epypes: "), lines
    return said[0]


def test_every_command_has_a_row():
    commands = set(app.commands)
    assert commands - ROWS.keys() == set(), "give each new command a row of what makes it fail, and what it says then"


@pytest.mark.slow
@pytest.mark.parametrize(("command", "row"), [(command, row) for command, rows in ROWS.items() for row in rows])
def test_a_command_that_fails_says_so_in_one_line(command, row, places, epypes):
    arguments, says = row
    done = epypes(command, *(argument.format(**places) for argument in arguments))
    assert says.format(**places) in one_line(done)


@pytest.mark.parametrize("command", sorted(app.commands))
def test_an_option_that_there_is_not_exits_with_2(command, epypes):
    done = epypes(command, "--no-such-option")
    assert done.returncode == 2
    assert "No such option" in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        "record tcp://127.0.0.1:5555 {folder}/a.mcap --seconds nan",
        "record tcp://127.0.0.1:5555 {folder}/a.mcap --seconds -1",
        "play {folder}/none.mcap --speed nan",
        "stop {bundle} --timeout nan",
        "serve {bundle} --job-timeout nan",
        "serve {bundle} --threads 65",
        "experiment --requests 1.5",
    ],
)
def test_a_number_out_of_range_exits_with_2(words, places, epypes):
    done = epypes(*words.format(**places).split())
    assert done.returncode == 2
    assert "Error: Invalid value for '--" in done.stderr


@pytest.mark.parametrize("words", ["deploy {bundle}", "rollback"])
def test_a_service_that_is_not_named_exits_with_2_and_the_options_that_name_it(words, places, epypes):
    done = epypes(*words.format(**places).split())
    assert done.returncode == 2
    assert "Missing option '--http' / '--service'" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "module", "package", "extra"),
    [
        ("promote", "nbclient", "nbclient", "service"),
        ("promote", "nbformat", "nbformat", "service"),
        ("lab", "jupyterlab", "jupyterlab", "notebook"),
        ("serve", "zmq", "pyzmq", "serve"),
    ],
)
def test_without_an_extra_a_command_says_what_to_install(command, module, package, extra, places):
    arguments = [argument.format(**places) for argument in FIRST[command]]
    code = f"import sys; sys.modules[{module!r}] = None; from epypes.cli import main; main({[command, *arguments]!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert f"Package {package!r} is missing. Run: pip install 'epypes[{extra}]'" in one_line(done)


@pytest.mark.slow
def test_verify_prints_the_report_and_as_json_every_field(places, epypes):
    done = epypes("verify", places["other"])
    assert "sample 000, token 'edges': 4800 of 4800 values differ, first at [0, 0]: expected " in done.stdout
    assert "Likely: Neither the bundle nor what it runs on has changed as far as is known" in done.stdout
    done = epypes("verify", places["other"], "--json")
    found = json.loads(done.stdout)
    assert (found["identical"], found["bundle"]) == (False, places["other"])
    (difference,) = found["differences"]
    assert (difference["token"], difference["index"], difference["count"]) == ("edges", "[0, 0]", 4800)
    assert found["environment"]["opencv"]
    done = epypes("verify", places["bundle"], "--json")
    assert (done.returncode, json.loads(done.stdout)["identical"]) == (0, True)
    done = epypes("verify", places["broken"], "--json")
    assert json.loads(done.stdout)["identical"] is False
