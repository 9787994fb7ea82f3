"""Addresses and token files of the HTTP server."""

from __future__ import annotations

import os
import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from epypes.errors import AddressError, KeysError
from epypes.service.http import HttpServer
from tests.service.http.raw import request


def token_of(service, path):
    """Return the token of a server that is started with a token file."""
    with HttpServer(service, "127.0.0.1:*", access_key_file=path) as server:
        return server.access_key_file.read_text().strip()


def test_a_token_is_made_once_and_only_its_owner_can_read_it(service, tmp_path):
    path = tmp_path / "token"
    old = os.umask(0)
    try:
        token = token_of(service, path)
    finally:
        os.umask(old)
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(token) >= 43
    assert token_of(service, path) == token
    assert os.listdir(tmp_path) == ["token"]
    assert token_of(service, tmp_path / "other") != token


@pytest.mark.slow
def test_servers_that_make_a_token_at_once_agree_on_it(service, tmp_path):
    start = threading.Barrier(4)

    def make(_):
        start.wait()
        return token_of(service, tmp_path / "token")

    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(make, range(4)))) == 1


@pytest.mark.parametrize("text", ["", "short", "a" * 40 + "\nb" * 40, "ü" * 40, "a b" * 20])
def test_a_file_without_a_token_is_refused(service, tmp_path, text):
    path = tmp_path / "token"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(KeysError, match="token"):
        token_of(service, path)


def test_a_token_that_others_can_read_is_refused(service, tmp_path):
    path = tmp_path / "token"
    path.write_text("a" * 43)
    path.chmod(0o644)
    with pytest.raises(KeysError, match="chmod 600"):
        token_of(service, path)


def test_a_token_file_that_cannot_be_made_is_refused(service, tmp_path):
    for path in (tmp_path / "nowhere" / "token", tmp_path):
        with pytest.raises(KeysError, match="can't be used"):
            token_of(service, path)


@pytest.mark.parametrize("address", ["localhost:*", "*", "0", "http://localhost:*/", "127.0.0.2:0", "[::1]:*"])
def test_a_server_answers_at_the_url_of_its_loopback_address(service, address):
    with HttpServer(service, address) as server:
        assert server.url.startswith(("http://127.0.0.", "http://[::1]:"))
        assert httpx.get(f"{server.url}/livez", trust_env=False).status_code == 200


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
    ],
)
def test_text_that_is_no_address_is_refused_with_an_example(service, address):
    with pytest.raises(AddressError, match=r"127\.0\.0\.1:8642"):
        HttpServer(service, address).start()


@pytest.mark.parametrize("address", ["0.0.0.0:0", "*:0", "[::]:0", "192.168.1.1:0", "example.com:0"])
def test_an_address_that_others_can_reach_is_refused(service, address):
    with pytest.raises(AddressError, match="--insecure"):
        HttpServer(service, address).start()


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
def test_an_insecure_server_may_be_called_by_any_name(service):
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
