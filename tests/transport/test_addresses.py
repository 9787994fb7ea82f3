"""Which addresses stay on this machine?"""

from __future__ import annotations

import pytest

from epypes.errors import AddressError
from epypes.transport import check_bind, is_loopback


@pytest.mark.parametrize(
    "address",
    [
        "tcp://127.0.0.1:5555",
        "tcp://127.0.0.1:*",
        "tcp://127.255.1.2:1",
        "tcp://localhost:5555",
        "tcp://[::1]:5555",
        "ipc:///tmp/x",
        "inproc://x",
    ],
)
def test_loopback_may_be_bound(address):
    assert is_loopback(address)
    check_bind(address)


@pytest.mark.parametrize(
    "address",
    [
        "tcp://*:5555",
        "tcp://0.0.0.0:5555",
        "tcp://[::]:5555",
        "tcp://192.168.1.1:5555",
        "tcp://lo:5555",
        "tcp://127.0.0.1.example.org:5555",
        "tcp://localhost.example.org:5555",
        "tcp://127.1:5555",
        "tcp://:5555",
        "udp://127.0.0.1:5555",
        "ws://127.0.0.1:5555",
        "ipc://",
    ],
)
def test_anything_else_must_be_asked_for(address):
    assert not is_loopback(address)
    with pytest.raises(AddressError) as caught:
        check_bind(address)
    assert caught.value.address == address
    check_bind(address, insecure=True)


@pytest.mark.parametrize("address", ["", "x", None])
def test_what_is_no_address_is_refused_even_so(address):
    with pytest.raises(AddressError, match="is not an address"):
        check_bind(address, insecure=True)
