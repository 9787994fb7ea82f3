"""Where does the server listen, and who gets its token?"""

from __future__ import annotations

import os
import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from epypes.errors import AddressError, KeysError
from epypes.service.http import HttpServer
from epypes.service.http.address import listening, url_of
from epypes.service.http.token import owned_token
from tests.service.http.raw import request


def test_a_token_is_made_once_and_only_its_owner_can_read_it(tmp_path):
    path = tmp_path / "token"
    old = os.umask(0)
    try:
        token = owned_token(path)
    finally:
        os.umask(old)
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(token) >= 43
    assert owned_token(path) == token
    assert os.listdir(tmp_path) == ["token"]
    assert owned_token(tmp_path / "other") != token


def test_processes_that_make_a_token_at_once_agree_on_it(tmp_path):
    start = threading.Barrier(8)

    def make(_):
        start.wait()
        return owned_token(tmp_path / "token")

    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(make, range(8)))) == 1


@pytest.mark.parametrize("text", ["", "short", "a" * 40 + "\nb" * 40, "ü" * 40, "a b" * 20])
def test_a_file_without_a_token_is_refused(tmp_path, text):
    path = tmp_path / "token"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(KeysError, match="token"):
        owned_token(path)


def test_a_token_that_others_can_read_is_refused(tmp_path):
    path = tmp_path / "token"
    path.write_text("a" * 43)
    path.chmod(0o644)
    with pytest.raises(KeysError, match="chmod 600"):
        owned_token(path)


def test_a_token_file_that_cannot_be_made_is_told(tmp_path):
    with pytest.raises(KeysError, match="can't be used"):
        owned_token(tmp_path / "nowhere" / "token")
    with pytest.raises(KeysError, match="can't be used"):
        owned_token(tmp_path)


@pytest.mark.parametrize(
    "address",
    ["127.0.0.1:0", "127.0.0.1:*", "localhost:*", "*", "0", "http://127.0.0.1:0", "http://localhost:*/", "127.0.0.2:0"],
)
def test_an_address_on_loopback_is_listened_at(address):
    with listening(address) as listener:
        assert listener.getsockname()[1] > 0
        assert url_of(listener).startswith("http://127.0.0.")


@pytest.mark.parametrize(
    "address",
    [
        "",
        "x",
        "127.0.0.1",
        "127.0.0.1:99999",
        "tcp://127.0.0.1:80",
        "https://127.0.0.1:1",
        "a b:1",
        "127.0.0.1:1/x",
        80,
        None,
    ],
)
def test_what_is_no_address_is_refused_with_an_example(address):
    with pytest.raises(AddressError, match=r"127\.0\.0\.1:8642"):
        listening(address)


@pytest.mark.parametrize("address", ["0.0.0.0:0", "*:0", "[::]:0", "192.168.1.1:0", "example.com:0"])
def test_an_address_that_others_can_reach_is_refused(address):
    with pytest.raises(AddressError, match="--insecure"):
        listening(address)


@pytest.mark.slow
def test_a_port_in_use_is_named(service):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        server = HttpServer(service, f"127.0.0.1:{port}")
        with pytest.raises(AddressError, match=f"port {port} is in use"):
            server.start()
        server.stop()


@pytest.mark.slow
def test_who_says_insecure_may_be_called_by_any_name(service):
    with HttpServer(service, "0.0.0.0:*", insecure=True) as server:
        assert request(server.url, "GET /livez HTTP/1.1", "Host: line-3.example")[0] == 200


@pytest.mark.slow
def test_a_server_can_be_stopped_twice_and_before_it_was_started_and_its_port_is_free_then(service):
    server, before = HttpServer(service, "127.0.0.1:*"), set(threading.enumerate())
    server.stop()
    url = server.start()
    server.stop()
    server.stop()
    with pytest.raises(httpx.ConnectError):
        httpx.get(url, trust_env=False)
    with HttpServer(service, url) as again:
        assert httpx.get(f"{again.url}/livez", trust_env=False).status_code == 200
    assert not [thread for thread in set(threading.enumerate()) - before if thread.name.startswith("epypes-http")]


@pytest.mark.slow
def test_the_token_stays_the_same_for_the_next_server(service):
    tokens = set()
    for _ in range(2):
        with HttpServer(service, "127.0.0.1:*") as server:
            tokens.add(server.token_file.read_text())
    assert len(tokens) == 1
