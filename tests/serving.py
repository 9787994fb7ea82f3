"""How does a server that tests start end with them, and as whom does it run?"""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Callable
from typing import Any


def with_parent(number: signal.Signals = signal.SIGKILL) -> Callable[[], object]:
    """Return what a new process calls first, so that it gets a signal when the tests' process ends, however it does."""
    set_death_signal = 1
    return lambda: ctypes.CDLL(None).prctl(set_death_signal, number)


def account(name: str) -> dict[str, Any]:
    """Return what Popen is told so that a server runs as another account, where the tests may choose it."""
    return {"user": name, "group": name, "extra_groups": []} if os.geteuid() == 0 else {}
