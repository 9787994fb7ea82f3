"""Received bytes never make this process run code."""

from __future__ import annotations

import ast
import io
import pickle
import queue
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

import epypes
from epypes.errors import MessageError
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.wire import (
    AttributeList,
    Envelope,
    Event,
    JustBytes,
    add_attribute,
    attributes,
    decode,
    encode,
    load_sample,
    parsed,
    save_sample,
)
from epypes.wire.protobuf import message_class

PICKLERS = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
# What would read a pickle without importing one of them.
UNPICKLING = {"send_pyobj", "recv_pyobj", "read_pickle", "unsafe_load"}
PACKAGE = Path(epypes.__file__).parent
# The experiment reads pickles of a peer of 2019 where its user gives --unsafe-pickle.
MODULES = [path for path in PACKAGE.rglob("*.py") if PACKAGE / "experiment" not in path.parents]


# Parsing every module takes a second; most of them have none of these names.
SUSPICIOUS = re.compile("|".join([*PICKLERS, *UNPICKLING, "read_array", "write_array", r"(np|numpy)\.(load|save)"]))


class Trap:
    """Unpickled, it touches a file."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self):
        return Path.touch, (self.canary,)


@pytest.fixture
def canary(tmp_path):
    """A file that must not come into being."""
    path = tmp_path / "canary"
    yield path
    assert not path.exists()


@pytest.fixture
def poison(canary) -> bytes:
    return pickle.dumps(Trap(canary))


def test_the_trap_works(tmp_path):
    pickle.loads(pickle.dumps(Trap(tmp_path / "sprung")))
    assert (tmp_path / "sprung").exists()


def test_a_pickle_as_an_event_is_bytes_and_stays_bytes(poison):
    out, into = queue.SimpleQueue(), queue.SimpleQueue()
    with ZMQPublisher("tcp://127.0.0.1:*", out) as pub, ZMQSubscriber(pub.address, into) as sub:
        assert sub.wait_joined(60)
        out.put(poison)
        out.put(Envelope("x", {"small": poison, "large": poison + bytes(10_000)}))
        assert into.get(timeout=60) == poison
        assert into.get(timeout=60).parts["small"] == poison


@pytest.mark.parametrize("place", ["alone", "topic", "header", "payload"])
def test_a_pickle_in_the_place_of_a_frame_is_refused(poison, place):
    topic, header, payload = encode(Envelope("x", {"a": np.zeros(8)}), inline_below=0)
    frames = {
        "alone": [poison],
        "topic": [poison, header, payload],
        "header": [topic, poison, payload],
        "payload": [topic, header, poison],
    }
    with pytest.raises(MessageError):
        decode(frames[place])


@pytest.mark.parametrize("dtype", ["|O8", "O", "|V8", "object"])
def test_an_array_of_objects_is_refused(poison, dtype):
    message = message_class("epypes.v1.Envelope")()
    tensor = message.parts.add(name="a").value.tensor
    tensor.dtype, tensor.inline = dtype, poison[:8]
    tensor.shape.append(1)
    with pytest.raises(MessageError) as caught:
        decode([b"/", message.SerializeToString()])
    assert caught.value.reason == "bad dtype"


def test_a_pickle_in_a_message_of_2019_is_left_alone(poison):
    assert parsed(JustBytes, JustBytes(contents=poison).SerializeToString()).contents == poison
    with pytest.raises(MessageError):
        parsed(Event, poison)
    message = AttributeList()
    with pytest.raises(MessageError):
        add_attribute(message, "key", poison)
    assert attributes(message) == {}


@pytest.mark.parametrize("entry", ["inputs.image", "description", "only"])
def test_a_pickle_in_a_sample_is_refused(canary, tmp_path, entry):
    path = tmp_path / "s.npz"
    save_sample(path, {"image": np.zeros((20, 20))}, {})
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.array([Trap(canary)], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    assert entry == "only" or f"{entry}.npy" in entries
    entries = {f"{entry}.npy": buffer.getvalue()} if entry == "only" else {**entries, f"{entry}.npy": buffer.getvalue()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    with pytest.raises(MessageError) as caught:
        load_sample(path)
    assert caught.value.reason == "bad sample"


def names_of(tree: ast.AST):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield (node.module or "").partition(".")[0]
        elif isinstance(node, ast.Attribute):
            yield node.attr


WRITING = {"pickle": {"HIGHEST_PROTOCOL", "Pickler", "dump", "dumps"}, "marshal": {"dump", "dumps"}}


def only_writing(tree: ast.AST) -> set[str]:
    """Return the modules of which this one uses only what writes."""
    parts = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    taken_from = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    used = {name: {part.attr for part in parts if ast.unparse(part.value) == name} for name in WRITING}
    return {name for name, writing in WRITING.items() if used[name] <= writing and name not in taken_from}


def test_no_module_unpickles_and_numpy_is_forbidden_to():
    for path in MODULES:
        text = path.read_text()
        if not SUSPICIOUS.search(text):
            continue
        tree = ast.parse(text)
        assert not (set(names_of(tree)) & (PICKLERS | UNPICKLING)) - only_writing(tree), path
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                owner, name = ast.unparse(node.func.value), node.func.attr
                if name in {"read_array", "write_array"} or (owner in {"np", "numpy"} and name in {"load", "save"}):
                    given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                    assert given.get("allow_pickle") == "False", f"{path}:{node.lineno}"
