"""Requests that no honest client sends are refused, and the server goes on."""

from __future__ import annotations

import socket
from contextlib import ExitStack, suppress

import httpx
import pytest

from epypes.service.http.server import MAX_CONNECTIONS
from tests.service.http.raw import connection, received, request

CHANGES = [
    ("PATCH", "/v1/parameters"),
    ("POST", "/v1/parameters/write-back"),
    ("POST", "/v1/access"),
    ("POST", "/v1/deploy"),
    ("POST", "/v1/rollback"),
    ("POST", "/v1/reset"),
    ("POST", "/v1/pause"),
    ("POST", "/v1/resume"),
    ("POST", "/v1/drain"),
]


def sentence(answer):
    """Return what a refusal says; each says it as JSON, in a sentence with a way out."""
    assert answer.headers["content-type"] == "application/json"
    detail = answer.json()["detail"]
    assert detail.endswith(".")
    return detail


def is_well(http):
    return httpx.get(f"{http.url}/livez", trust_env=False).status_code == 200


@pytest.mark.slow
@pytest.mark.parametrize(("method", "path"), CHANGES)
def test_a_change_without_the_token_is_refused_and_says_where_it_is(client, http, method, path):
    answer = client.request(method, path, json={})
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"].startswith("Bearer")
    assert str(http.access_key_file) in sentence(answer)


@pytest.mark.parametrize(("method", "path"), CHANGES)
def test_a_change_with_another_token_is_refused(client, http, method, path):
    for given in ("Bearer wrong", "Basic {token}", "{token}", "Bearer {token}x", "bearer é"):
        headers = {"Authorization": given.format(token=http.token).encode()}
        answer = client.request(method, path, json={}, headers=headers)
        assert answer.status_code == 403
        assert "not the service's access key" in sentence(answer)


def test_who_still_sends_a_body_has_the_refusal_of_its_token_all_the_same(http):
    for _ in range(10):
        host, port = http.url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), 10) as line:
            head = f"POST /v1/deploy HTTP/1.1\r\nHost: {host}\r\nContent-Length: 60000\r\nAuthorization: Bearer wrong"
            line.sendall(f"{head}\r\nContent-Type: application/json\r\nConnection: close\r\n\r\n".encode())
            for part in (b"{" + b" " * 999, *[b" " * 1000] * 58, b" " * 999 + b"}"):
                line.sendall(part)
            answered = line.makefile("rb").read()
        assert answered.startswith(b"HTTP/1.1 403"), answered[:200]


def test_the_token_can_be_tried_without_changing_anything(changing):
    assert changing.post("/v1/access").json() == {"allowed": True}


def test_all_that_the_description_says_needs_a_token_needs_it_and_nothing_else_changes(client):
    paths = client.get("/openapi.json").json()["paths"]
    operations = {(method.upper(), path): each for path, of in paths.items() for method, each in of.items()}
    assert {key for key in operations if key[0] != "GET"} == set(CHANGES)
    assert {key for key, each in operations.items() if "security" in each} == set(CHANGES)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example", "", "[::2]"])
def test_a_foreign_name_for_this_machine_is_refused(http, host):
    port = http.url.rpartition(":")[2]
    status, body = request(http.url, "GET /v1/info HTTP/1.1", f"Host: {host.format(port=port)}")
    assert status == 400
    assert "host" in body


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "LOCALHOST:80", "[::1]:9"])
def test_this_machines_own_names_are_taken(http, host):
    assert request(http.url, "GET /livez HTTP/1.1", f"Host: {host}")[0] == 200


def test_no_foreign_page_may_read_answers(client):
    for path in ("/", "/v1/info", "/v1/graph.svg", "/metrics", "/nothing"):
        answer = client.get(path, headers={"Origin": "http://evil.example"})
        assert not [name for name in answer.headers if name.startswith("access-control")]
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"
        assert answer.headers["x-content-type-options"] == "nosniff"
        policy = answer.headers["content-security-policy"]
        assert policy.startswith("default-src 'none'")
        assert "frame-ancestors 'none'" in policy
        assert "unsafe-eval" not in policy
        assert "script-src 'self'" in policy if path == "/" else "script-src" not in policy


def test_the_page_needs_nothing_inline(client):
    page = client.get("/")
    assert "style-src 'self'" in page.headers["content-security-policy"]
    assert "<style" not in page.text
    assert " style=" not in page.text
    assert "<script>" not in page.text
    assert "https://" not in page.text


@pytest.mark.parametrize(
    "path", ["/page/page.py", "/page/..%2fapp.py", "/page/../app.py", "/page/%2e%2e/page.py", "/page/"]
)
def test_nothing_but_the_pages_files_is_given(http, path):
    assert request(http.url, f"GET {path} HTTP/1.1")[0] == 404


def test_a_body_that_says_it_is_too_long_is_refused_at_once(http):
    head = f"Authorization: Bearer {http.token}", "Content-Type: application/json", "Content-Length: 1000000000000"
    assert request(http.url, "POST /v1/deploy HTTP/1.1", *head)[0] == 413


def test_a_body_without_end_is_refused_after_64_kb(http):
    head = "\r\n".join(
        ["POST /v1/deploy HTTP/1.1", "Host: localhost", f"Authorization: Bearer {http.token}",
         "Content-Type: application/json", "Transfer-Encoding: chunked", "", ""]
    ).encode()  # fmt: skip
    with connection(http.url) as end:
        end.sendall(head)
        sent = 0
        try:
            while sent < 100_000_000:
                end.sendall(b"1000\r\n" + b" " * 4096 + b"\r\n")
                sent += 4096
        except (ConnectionResetError, BrokenPipeError):
            pass
        assert sent < 50_000_000, "the server went on reading"
    assert is_well(http)


@pytest.mark.parametrize(
    "body",
    [
        b'{"values": {"lo": NaN}}', b'{"values": {"lo": Infinity}}', b'{"values": {"lo": -1e999}}',
        b'{"values": {"lo": ' + b"9" * 6000 + b"}}", b'{"values": {"\\ud800": 1}}', b"[" * 60_000, b'{"a":' * 10_000,
        b"{", b"\xff\xfe", b"\x00", b"nothing", b'{"values": {"lo": 1}} {}',
    ],
)  # fmt: skip
def test_what_is_no_json_or_no_value_of_the_parameter_is_refused(client, http, body):
    headers = {"Authorization": f"Bearer {http.token}", "Content-Type": "application/json"}
    before = client.get("/v1/parameters").json()
    answer = client.patch("/v1/parameters", content=body, headers=headers)
    assert answer.status_code in (400, 422)
    assert answer.json()["detail"]
    assert client.get("/v1/parameters").json() == before


@pytest.mark.parametrize(
    "body", [[], 1, None, "x", {}, {"values": {}}, {"values": []}, {"values": {"lo": 1}, "more": 1}, {"values": {"lo": 1}, "revision": -1},
             {"values": {"lo": 1}, "revision": True}, {"values": {"lo": 1}, "revision": 1.5}]
)  # fmt: skip
def test_json_of_another_shape_is_refused_and_the_place_is_named(changing, body):
    answer = changing.patch("/v1/parameters", json=body)
    assert answer.status_code == 422
    assert "openapi.json" in sentence(answer)
    assert answer.json()["problems"]


def test_a_body_that_is_not_said_to_be_json_is_refused(changing):
    answer = changing.post("/v1/deploy", content=b'{"bundle": "/x"}', headers={"Content-Type": "text/plain"})
    assert answer.status_code == 422


@pytest.mark.parametrize(
    "data", [b"\x16\x03\x01\x02\x00\x01", b"GET\r\n\r\n", b"\r\n" * 9, b"GET / HTTP/9.9\r\n\r\n", b"\x00" * 99]
)
def test_what_is_no_http_ends_the_connection(http, data):
    with connection(http.url) as end:
        end.sendall(data)
        end.shutdown(1)
        received(end)
    assert is_well(http)


@pytest.mark.parametrize(
    "token",
    ["nothing", "a/b", "../../etc/passwd", "%00", "é😀", "a%2Fb", "%ff", "{}", "'; drop", "/", "a" * 400, "a?b"],
)
def test_a_token_that_is_not_there_is_named_whatever_it_is_called(client, token):
    from urllib.parse import quote

    answer = client.get(f"/v1/tokens/{quote(token, safe='')}/preview")
    assert answer.status_code == 404
    assert sentence(answer).startswith("No token")


@pytest.mark.parametrize("name", ["..%2f..%2fetc%2fpasswd", "%2e%2e", "a%00b", "x" * 200, "é", "nothing", "'", "*"])
@pytest.mark.parametrize("end", ["", "/event"])
def test_a_failure_that_is_not_there_is_refused_whatever_it_is_called(http, name, end):
    status, said = request(http.url, f"GET /v1/failures/{name.encode().decode('latin-1')}{end} HTTP/1.1")
    assert status in (404, 422, 400)
    assert "passwd:" not in said


@pytest.mark.parametrize(
    "path", ["relative", "../x", "", "\n/x", "/nothing/there", "/etc/passwd", "/tmp", "/\u0000", "/" + "a" * 3000]
)
def test_a_path_without_a_bundle_is_refused(changing, path):
    answer = changing.post("/v1/deploy", json={"bundle": path})
    assert answer.status_code == (409 if path == "/tmp" else 422)
    assert sentence(answer)
    assert is_well_of(changing)


def is_well_of(client):
    return client.get("/readyz").status_code == 200


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [("DELETE", "/v1/parameters", "GET, PATCH"), ("GET", "/v1/pause", "POST"), ("PUT", "/livez", "GET")],
)
def test_a_method_that_a_path_does_not_take_is_refused_with_those_it_takes(changing, method, path, allowed):
    answer = changing.request(method, path)
    assert answer.status_code == 405
    assert answer.headers["allow"] == allowed
    assert "/openapi.json" in sentence(answer)


def test_a_path_that_is_not_there_says_where_to_look(client):
    assert "/openapi.json" in sentence(client.get("/v2/info"))


@pytest.mark.slow
def test_connections_without_a_whole_request_do_not_keep_others_out_and_the_oldest_are_closed(http):
    with ExitStack() as opened:
        lines = [opened.enter_context(connection(http.url)) for _ in range(2 * MAX_CONNECTIONS)]
        for line in lines[:MAX_CONNECTIONS]:
            with suppress(ConnectionError):
                line.sendall(b"GET / HT")
        assert is_well(http)
        for line in lines[:MAX_CONNECTIONS]:
            with suppress(ConnectionError):
                assert received(line) == b""
        # The newest one is still open.
        lines[-1].sendall(b"GET /livez HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert received(lines[-1]).startswith(b"HTTP/1.1 200")
