"""A running service with its HTTP control, for the tests of this folder."""

from __future__ import annotations

import httpx
import pytest

from epypes.bundle.adapters import REQUEST
from epypes.service import Service
from epypes.service.http import HttpServer
from epypes.wire import Envelope
from tests.service.served import peer_of


def pytest_ignore_collect(collection_path, config):
    """Leave out the fuzz test where its plugin, which takes 2 s to load, is not asked for; make test asks for it."""
    is_missing = not config.pluginmanager.hasplugin("schemathesis.pytest.plugin")
    return True if is_missing and collection_path.name == "test_fuzz.py" else None


@pytest.fixture(scope="module")
def service(edge_bundle, photograph, tmp_path_factory):
    """A running service of the edge bundle that has answered one event."""
    with pytest.MonkeyPatch.context() as own:
        own.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        with Service(edge_bundle.path) as service, peer_of(service) as peer:
            peer.requests.put(Envelope(type=REQUEST, parts={"image": photograph}))
            peer.take()
            yield service


@pytest.fixture(scope="module")
def http(service, tmp_path_factory):
    """The control of a service, with its token as ``token``."""
    with HttpServer(service, "127.0.0.1:*", access_key_file=tmp_path_factory.mktemp("token") / "token") as server:
        server.token = server.access_key_file.read_text().strip()
        yield server


@pytest.fixture
def client(http):
    """Who may look."""
    with httpx.Client(base_url=http.url, trust_env=False, timeout=60) as client:
        yield client


@pytest.fixture
def changing(http):
    """Who may change."""
    headers = {"Authorization": f"Bearer {http.token}"}
    with httpx.Client(base_url=http.url, trust_env=False, timeout=60, headers=headers) as client:
        yield client
