"""The state file of a service that a test has started."""

from __future__ import annotations

from epypes.service.state_file import read_states


def read_state(bundle, replica=""):
    """Return the state of the first running service of a bundle; None if none is ready."""
    return next(iter(read_states(bundle, replica)), None)
