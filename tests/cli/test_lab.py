"""``epypes lab`` starts JupyterLab; the kernel websocket of every JupyterLab sends at once."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import re
import subprocess
import sys
import time

import pytest

from epypes.cli.lab import lab_command
from epypes.jupyter_server_extension import _load_jupyter_server_extension
from tests.apart import apart
from tests.browser.jupyter import JupyterLab

# Tells about the sockets between pages and kernels that the server has open.
TELLS = """
import socket
from jupyter_server.base.handlers import JupyterHandler
from jupyter_server.services.kernels.connection.channels import ZMQChannelsWebsocketConnection
from tornado.web import authenticated

class Sockets(JupyterHandler):
    @authenticated
    def get(self):
        streams = [each.websocket_handler.ws_connection.stream for each in ZMQChannelsWebsocketConnection._open_sockets]
        self.finish({"nodelay": [s.socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) for s in streams]})

def _jupyter_server_extension_points():
    return [{"module": __name__}]

def _load_jupyter_server_extension(server):
    server.web_app.add_handlers(".*", [("/api/sockets", Sockets)])
"""
DEADLINE_S = 60


def run_lab(*words):
    command = [sys.executable, "-m", "epypes.cli", "lab", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=DEADLINE_S)


@pytest.fixture
def state(tmp_path, monkeypatch):
    """A folder for a server's settings, by which it tells about its sockets."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "tells.py").write_text(TELLS)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "modules"), *filter(None, sys.path)]))
    settings = tmp_path / "state" / "config" / "jupyter_server_config.d" / "tells.json"
    settings.parent.mkdir(parents=True)
    settings.write_text(json.dumps({"ServerApp": {"jpserver_extensions": {"tells": True}}}))
    return tmp_path / "state"


async def nodelay_of(lab):
    """Open a websocket to a new kernel; return TCP_NODELAY of the server's end of it."""
    from tornado.websocket import websocket_connect

    kernel = await asyncio.to_thread(lab.api, "kernels", "POST")
    address = f"ws://127.0.0.1:{lab.port}/api/kernels/{kernel['id']}/channels?session_id=x&token={lab.token}"
    connection = await websocket_connect(address)
    deadline = time.monotonic() + DEADLINE_S
    while not (said := await asyncio.to_thread(lab.api, "sockets"))["nodelay"]:
        assert time.monotonic() < deadline
    connection.close()
    while await connection.read_message() is not None:
        pass
    (nodelay,) = said["nodelay"]
    return bool(nodelay)


@pytest.mark.slow
@pytest.mark.parametrize("command", [("jupyterlab",), ("epypes", "lab", ".", "--")], ids=" ".join)
def test_a_kernels_websocket_sends_at_once(command, state, tmp_path):
    with JupyterLab(tmp_path, state, command=command) as lab:
        assert apart(lambda: asyncio.run(nodelay_of(lab)))


@pytest.mark.slow
def test_options_reach_jupyterlab_and_its_exit_status_comes_back(tmp_path):
    import jupyterlab

    done = run_lab(tmp_path, "--", "--version")
    assert (done.stdout.strip(), done.returncode) == (jupyterlab.__version__, 0)
    assert run_lab(tmp_path, "--", "--ServerApp.port=none").returncode == 1


def test_it_listens_on_this_machine_alone_unless_told_otherwise(tmp_path):
    assert "--ip=127.0.0.1" in lab_command(str(tmp_path))
    told = lab_command(str(tmp_path), "--ServerApp.ip=0.0.0.0")
    assert "--ServerApp.ip=0.0.0.0" in told
    assert "--ip=127.0.0.1" not in told, "JupyterLab refuses two"


def test_without_a_folder_it_opens_the_current_one():
    assert lab_command()[:4] == lab_command(".")[:4]
    assert lab_command("--version")[-1] == "--version"


def test_root_may_start_it_too():
    assert "--allow-root" in lab_command(is_root=True)
    assert "--allow-root" not in lab_command()


def test_a_folder_that_is_not_there_is_refused_in_one_line(tmp_path, epypes):
    done = epypes("lab", tmp_path / "nowhere")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert re.search("There is no folder '.*nowhere' to show in JupyterLab", line)


def test_without_jupyterlab_it_says_what_to_install(tmp_path, epypes, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "jupyterlab" else find(name, *rest)
    )
    done = epypes("lab", tmp_path)
    assert done.returncode == 1
    assert done.stderr.strip() == "epypes: Package 'jupyterlab' is missing. Run: pip install 'epypes[notebook]'"


SETTING = "kernel_websocket_connection_class"


class Server:
    """As much of a server as an extension changes."""

    def __init__(self, chosen):
        self.web_app = self
        self.settings = {SETTING: chosen}


def test_the_websocket_of_a_gateway_is_left_alone():
    from jupyter_server.gateway.connections import GatewayWebSocketConnection

    server = Server(GatewayWebSocketConnection)
    _load_jupyter_server_extension(server)
    assert server.settings[SETTING] is GatewayWebSocketConnection


def test_a_websocket_that_was_configured_is_kept():
    from jupyter_server.services.kernels.connection.channels import ZMQChannelsWebsocketConnection

    class Own(ZMQChannelsWebsocketConnection):
        pass

    server = Server(Own)
    _load_jupyter_server_extension(server)
    assert issubclass(server.settings[SETTING], Own)
    assert server.settings[SETTING] is not Own
