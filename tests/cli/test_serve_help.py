"""The help of ``epypes serve``."""

from __future__ import annotations

import pytest

from epypes.cli.serve import serve
from epypes.errors import AddressError
from epypes.transport.address import parse_address


@pytest.mark.parametrize("text", [serve.__doc__, parse_address.__doc__], ids=["serve --help", "parse_address"])
def test_every_option_of_an_address_is_described(text):
    with pytest.raises(AddressError, match="There are: ") as refused:
        parse_address("amqp://127.0.0.1/events?no_such_option=1")
    options = str(refused.value).partition("There are: ")[2].rstrip(".").split(", ")
    assert "create" in options
    assert [option for option in options if f"{option}=" not in text] == []
