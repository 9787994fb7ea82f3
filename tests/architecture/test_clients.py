"""Clients of brokers and middleware are used as they come: by public names, and nothing of theirs is overridden."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import epypes.transport.brokers as brokers
import epypes.transport.peers as peers

CLIENTS = {"aio_pika", "aiormq", "cyclonedds", "nats", "paho", "pamqp", "rosbags"}
# A type of messages of cyclonedds is declared as a subclass.
BASES = {"IdlStruct"}
MODULES = [*sorted(Path(brokers.__path__[0]).glob("*.py")), *sorted(Path(peers.__path__[0]).glob("dds*.py"))]


def is_private(name):
    return name.startswith("_") and not name.startswith("__")


def imported(tree):
    """Return the names that a module has from the clients' packages."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.asname or alias.name.partition(".")[0] for alias in node.names if package(alias.name)}
        elif isinstance(node, ast.ImportFrom) and package(node.module or ""):
            found |= {alias.asname or alias.name for alias in node.names}
    return found


def package(name):
    return name.partition(".")[0] in CLIENTS


def targets(node):
    if isinstance(node, ast.Assign):
        return node.targets
    return [node.target] if isinstance(node, ast.AugAssign | ast.AnnAssign) else []


def root(node):
    while isinstance(node, ast.Attribute):
        node = node.value
    return getattr(node, "id", "")


def liberties(source):
    """Return what a module does that a client's public interface does not have, each with its line."""
    tree = ast.parse(source)
    clients, found = imported(tree), []
    for node in ast.walk(tree):
        what = ""
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            # Those of `self` are the module's own, since no class here inherits from a client's.
            if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
                what = ast.unparse(node)
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in (
            "getattr",
            "setattr",
            "delattr",
            "hasattr",
        ):
            name = node.args[1]
            if not isinstance(name, ast.Constant) or is_private(name.value) or node.func.id in ("setattr", "delattr"):
                what = ast.unparse(node)
        elif isinstance(node, ast.ClassDef):
            bases = {leaf.id for base in node.bases for leaf in ast.walk(base) if isinstance(leaf, ast.Name)}
            what = f"class {node.name}" if bases & clients - BASES else ""
        elif isinstance(node, ast.ImportFrom) and package(node.module or ""):
            private = [
                part for part in (*node.module.split("."), *(alias.name for alias in node.names)) if is_private(part)
            ]
            what = ", ".join(private)
        elif any(isinstance(target, ast.Attribute) and root(target) in clients for target in targets(node)):
            # An attribute of a class or module of theirs, as `paho.Client.ack = ...`.
            what = ast.unparse(node)
        if what:
            found.append(f"{node.lineno}: {what}")
    return found


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.stem)
def test_a_client_is_used_by_its_public_interface_alone(module):
    assert liberties(module.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "line",
    [
        "self._client._transport.abort()",
        "client._pending = []",
        "getattr(client, '_reading_task')",
        "setattr(client, name, None)",
        "class Mine(Client): pass",
        "Client.publish = faster",
        "from nats.aio import _private",
    ],
)
def test_a_liberty_is_found(line):
    assert len(liberties(f"from nats.aio.client import Client\n{line}\n")) == 1


def test_what_is_public_or_our_own_is_no_liberty():
    source = "from nats.aio.client import Client\nself._client = Client()\nself._client.publish(self._subject)\n"
    assert liberties(source + "getattr(error, 'description', None)\n") == []
