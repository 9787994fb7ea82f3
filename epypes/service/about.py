"""What is said of a service to whoever asks?"""

from __future__ import annotations

import os
import sys
from typing import Any

from epypes.service.link import Link
from epypes.service.served import Served


def about(served: Served, link: Link | None) -> dict[str, Any]:
    """Return what there is to know of the bundle and the processes of a service, JSON-ready."""
    import epypes

    settings = served.settings
    return {
        "name": settings.name,
        "bundle": str(served.path),
        "digest": served.digest,
        "inputs": list(settings.inputs),
        "outputs": list(settings.outputs),
        "rgb": list(settings.rgb),
        "func_io": {} if link is None else dict(link.about.get("func_io", {})),
        "pid": os.getpid(),
        "worker_pid": None if link is None else link.pid,
        "versions": {"epypes": epypes.__version__, "python": sys.version.split()[0]},
    }
