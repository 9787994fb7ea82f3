from __future__ import annotations

import json
import queue
import shutil

import click
import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.acquisition import read_image, write_image
from epypes.bundle.load import read_bundle
from epypes.bundle.manifest import write_manifest
from epypes.bundle.proof.replay import ReplayReport
from epypes.cli import main
from epypes.cli.app import app
from epypes.service import Service
from epypes.service.state_file import StateLock
from tests.bundle.test_slicer import notebook
from tests.colours import red_image, red_runner

ANY = "tcp://127.0.0.1:*"


@pytest.fixture(scope="module")
def promoted(photograph, tmp_path_factory):
    cg = ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")})
    runner = ep.CompGraphRunner(cg, {"lo": 70, "hi": 200})
    runner.run(image=photograph)
    return ep.promote(runner, tmp_path_factory.mktemp("bundles") / "edges")


@pytest.fixture
def bundle(promoted, tmp_path):
    """A copy that a test may spoil."""
    return read_bundle(shutil.copytree(promoted.path, tmp_path / "edges"))


def one_line(done) -> str:
    """Return what a failing command says: one actionable line, no traceback, exit status 1."""
    assert done.returncode == 1, done
    assert done.stderr.startswith("epypes: ")
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    return done.stderr


def test_what_looks_like_markup_is_printed_as_it_is(epypes, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    folder = tmp_path / "4]a>O]PvB[)ZdSU8ZPY?0+]c[r5vV]7Gr>oaju[/f] :dog:"
    assert epypes("keys", "camera", "--to", folder).stdout.count(str(folder)) == 3
    assert f"Public keys in {folder}" in epypes("keys", "--list", "--to", folder).stdout


@pytest.mark.slow
def test_call_writes_the_answer_and_prints_the_times(epypes, bundle, photograph, tmp_path):
    write_image(tmp_path / "photo.png", photograph)
    with StateLock(bundle.path) as lock, Service(bundle.path, ANY, ANY) as service:
        lock.publish(service.start())
        done = epypes("call", bundle.path, tmp_path / "photo.png", "--out", tmp_path / "edges.png", "--count", 2)
        assert done.returncode == 0, done.stderr
        for words in ("function canny", "graph overhead", "round trip"):
            assert words in done.stdout
        assert np.array_equal(read_image(tmp_path / "edges.png"), cv2.Canny(photograph, 70, 200))
        done = epypes(
            "call", bundle.path, f"image={tmp_path}/photo.png", "--out", f"edges={tmp_path}/edges.npy", "--json"
        )
        assert done.returncode == 0, done.stderr
        assert '"round_trip_ns"' in done.stdout
        assert np.array_equal(np.load(tmp_path / "edges.npy"), cv2.Canny(photograph, 70, 200))
        done = epypes("call", bundle.path, tmp_path / "photo.png")
        assert "edges = uint8 400 x 600" in done.stdout, "what goes to no file is printed"
        said = one_line(epypes("call", bundle.path, tmp_path / "photo.png", "--out", tmp_path / "no" / "e.npy"))
        assert "can't be written: [Errno 2] No such file" in said


@pytest.mark.slow
def test_an_image_path_that_does_not_exist_is_one_line(epypes, bundle):
    assert "Image 'nothing.png' can't be read" in one_line(epypes("call", bundle.path, "nothing.png", "--out", "x.png"))


def test_calling_where_nothing_serves_is_one_line(epypes, bundle, photograph, tmp_path):
    write_image(tmp_path / "photo.png", photograph)
    said = one_line(epypes("call", bundle.path, tmp_path / "photo.png", "--out", "x.png"))
    assert "No service runs for" in said


def test_verify_never_prints_the_password_of_a_running_service(tmp_path, monkeypatch, capsys):
    addresses = [f"amqp://me:secret@127.0.0.1/{queue}" for queue in ("events", "answers")]
    monkeypatch.setattr("epypes.service.verify_service", lambda path, *addresses, **options: ReplayReport(1, 1, ()))
    with pytest.raises(SystemExit):
        main(["verify", str(tmp_path), "--against", ",".join(addresses)])
    with pytest.raises(SystemExit) as failed:
        main(["verify", str(tmp_path), "--against", addresses[0]])
    printed = capsys.readouterr()
    assert "by the service at amqp://me@127.0.0.1:5672/events,amqp://me@127.0.0.1:5672/answers" in printed.out
    assert "Give both: --against EVENTS,ANSWERS" in f"{failed.value.code}{printed.err}"
    assert "secret" not in f"{failed.value.code}{printed.out}{printed.err}"


@pytest.mark.slow
def test_verify_says_identical_or_what_differs(epypes, bundle):
    done = epypes("verify", bundle.path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "identical: 1 token of 1 sample" in done.stdout
    (bundle.path / "pipeline.py").write_text("")
    assert "pipeline.py was changed" in one_line(epypes("verify", bundle.path))


@pytest.mark.parametrize("command", ["verify", "serve"])
def test_a_folder_that_is_not_there_is_one_line(epypes, command, tmp_path):
    assert "does not exist" in one_line(epypes(command, tmp_path / "nothing"))


@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:99999", "tcp://0.0.0.0:5555", "tcp://"])
def test_an_address_that_makes_no_sense_is_one_line(epypes, bundle, address):
    one_line(epypes("serve", bundle.path, "--sub", address))


def test_wrong_usage_exits_with_2(epypes):
    assert epypes("serve").returncode == 2
    assert epypes("nonsense").returncode == 2


def test_help_names_every_command(epypes):
    done = epypes("--help")
    assert done.returncode == 0
    for command in ("promote", "verify", "serve", "call", "record", "play", "demo"):
        assert command in done.stdout


@pytest.mark.parametrize(
    ("tokens", "given", "said"),
    [
        ("image", ["imag=a.png"], "Did you mean 'image'"),
        ("image", ["a-b=c.png"], "Image 'a-b=c.png' can't be read"),
        ("image", ["image=a-b=c.png"], "Image 'a-b=c.png' can't be read"),
        ("image", ["a.png", "--out", "edge=b.png"], "No output token 'edge'"),
        (
            "image",
            ["a.png", "b.png"],
            "Two values for the input 'image': 'a.png' and 'b.png'. Give one. Many images: ep",
        ),
        ("image", ["image=a.png", "image=b.png"], "Two values for the input 'image': 'a.png' and 'b.png'. Give one."),
        ("image", ["a.png", "--out", "a.png", "--out", "b.png"], "Two values for the output 'edges': 'a.png' and"),
        ("left right", ["left=l.png"], "Missing input: right=FILE"),
        ("left right", ["l.png", "r.png"], "Which input is 'l.png'? Write one of: left=FILE, right=FILE"),
        ("left right", ["lefd=l.png", "right=r.png"], "Did you mean 'left'"),
        ("left right", ["right=r.png", "left=l.png"], "Image 'r.png' can't be read"),
    ],
)
def test_files_are_given_to_tokens(epypes, bundle, tokens, given, said):
    settings = bundle.path / "pipeline.toml"
    text = settings.read_text().replace('inputs = ["image"]', f"inputs = {tokens.split()}".replace("'", '"'))
    settings.write_text(text)
    write_manifest(bundle.path)
    assert said in one_line(epypes("call", bundle.path, *given))


@pytest.mark.parametrize(
    ("module", "said"),
    [("tomlkit", "epypes: Package 'tomlkit' is missing. Run: pip install 'epypes[serve]'"), ("nonsense", None)],
)
def test_a_missing_module_is_named_with_its_extra_or_is_a_bug(epypes, monkeypatch, module, said):
    @click.command()
    def probe():
        raise ModuleNotFoundError(name=module)

    monkeypatch.setitem(app.commands, "probe", probe)
    if said is None:
        with pytest.raises(ModuleNotFoundError):
            main(["probe"])
    else:
        assert one_line(epypes("probe")).strip() == said


@pytest.mark.slow
def test_files_have_the_right_colours_whatever_the_order_of_the_tokens(epypes, tmp_path):
    runner = red_runner()
    runner.run(image=red_image())
    bundle = ep.promote(runner, tmp_path / "red", outputs=["red", "unsaid"])
    write_image(tmp_path / "photo.png", red_image(), "rgb")
    with StateLock(bundle.path) as lock, Service(bundle.path, ANY, ANY) as service:
        lock.publish(service.start())
        outs = [word for name in ("red", "unsaid") for word in ("--out", f"{name}={tmp_path}/{name}.png")]
        done = epypes("call", bundle.path, tmp_path / "photo.png", *outs)
    assert done.returncode == 0, done.stderr
    assert cv2.imread(str(tmp_path / "red.png"))[5, 5].tolist() == [0, 0, 200], "OpenCV reads BGR: it is red"
    assert cv2.imread(str(tmp_path / "unsaid.png"))[5, 5].tolist() == [200, 0, 0], "unmarked is BGR"


@pytest.mark.slow
def test_an_answer_of_an_f_out_of_the_users_own_is_printed_as_text_and_as_json(epypes, photograph, tmp_path):
    names = notebook(
        "from epypes.wire import Envelope\n\n\n"
        "def total(image, k):\n    return float(image.sum()) * k\n\n\n"
        "def f_in(event):\n    return {'image': event.parts['image']}\n\n\n"
        "def f_out(view):\n"
        "    parts = {'total': view['sum'], 'most': np.array([np.inf, 2.0]), 'image': view['image'], 'names': ['a', None]}\n"
        "    return Envelope('answer', parts, correlation_id=view.event.id)\n"
    )
    cg = ep.CompGraph({"total": names["total"]}, {"total": (("image", "k"), "sum")})
    pipe = ep.FullPipeline("own", cg, queue.Queue(), queue.Queue(), names["f_in"], names["f_out"], {"k": 2})
    pipe.run(image=photograph)
    bundle = ep.promote(pipe, tmp_path / "own")
    write_image(tmp_path / "photo.png", photograph)
    with StateLock(bundle.path) as lock, Service(bundle.path, ANY, ANY) as service:
        lock.publish(service.start())
        text = epypes("call", bundle.path, tmp_path / "photo.png")
        answer = epypes("call", bundle.path, tmp_path / "photo.png", "--json")
        absent = epypes("call", bundle.path, tmp_path / "photo.png", "--out", tmp_path / "x.png")
    assert text.returncode == answer.returncode == 0, text.stderr + answer.stderr
    total = 2 * float(photograph.sum())
    assert f"\ntotal = {total}\n" in f"\n{text.stdout}"
    assert "round trip" in text.stdout
    found = json.loads(answer.stdout)
    assert found["tokens"] == {
        "total": total, "most": ["inf", 2.0], "image": {"dtype": "uint8", "shape": [400, 600, 3]}, "names": ["a", None],
    }  # fmt: skip
    assert (found["total_ns"], found["overhead_ns"]) == (None, None)
    assert found["round_trip_ns"] > 0
    assert "The answer has no 'sum'; it has: total, most, image, names." in one_line(absent)
