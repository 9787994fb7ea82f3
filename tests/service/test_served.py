"""What keeps a bundle from taking the place of another one is told in sentences."""

from __future__ import annotations

from epypes.bundle.settings import Settings
from epypes.service.served import differing_ports


def test_other_ports_are_told_apart_from_those_that_are_served():
    before = Settings("a", ("image",), ("best", "objects", "ok"), {})
    after = Settings("b", ("image",), ("edges",), {})
    (reason,) = differing_ports(before, after)
    assert "its outputs are [edges]; those of the bundle that is served are [best, objects, ok]. Serve it" in reason
    assert differing_ports(before, before) == []
