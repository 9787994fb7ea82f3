"""Groups of replicas whose heartbeats come sooner than those of a user's services."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module", autouse=True)
def quick_heartbeats():
    """Replicas in this process tell each other of themselves ten times a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("epypes.service.group.group.BEAT_S", 0.1)
        patch.setattr("epypes.service.group.talk.TICK_S", 0.05)
        yield
