"""What a panel tunes: a runner of this process, or a running service.

What is tried on a runner changes nothing, only the user's own cells change it, and what was found is promoted.
What is tried on a service is done there, others may tune it at the same time, its events come by themselves, and what
was found is written back into its bundle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from epypes.run import CompGraphRunner

if TYPE_CHECKING:
    from epypes.service.remote.runner import RemoteRunner

Tunable: TypeAlias = "CompGraphRunner | RemoteRunner"


def tunable(given: object) -> Tunable:
    """Return what is tuned: what was given, or what it has for that, as a connection to a service does.

    Raises
    ------
    TypeError
        It can't be tuned.
    """
    found: Any = given.to_tune() if hasattr(given, "to_tune") else given
    if not isinstance(found, CompGraphRunner) and not hasattr(found, "connection"):
        raise TypeError(
            f"tune() takes a CompGraphRunner or a connection to a service, not {type(given).__name__!r}: "
            "tune(CompGraphRunner(cg, hparams)), tune(ep.connect(url))."
        )
    tuned: Tunable = found
    return tuned
