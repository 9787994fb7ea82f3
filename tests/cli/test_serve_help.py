"""Does a user find what an address may say?"""

from __future__ import annotations

import pytest
from epypes.transport.channels import place, place_of

from epypes.cli.serve import serve


@pytest.mark.parametrize("told", [serve.__doc__, place_of.__doc__], ids=["serve --help", "place_of"])
def test_every_option_of_an_address_is_told(told):
    assert [option for option in place._OPTIONS if f"{option}=" not in told] == []
