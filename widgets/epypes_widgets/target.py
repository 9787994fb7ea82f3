"""What a panel tunes: a runner of this process, or a running service.

What is tried on a runner changes nothing, only the user's own cells change it, and what was found is promoted.
What is tried on a service is done there, others may tune it at the same time, its events come by themselves, and what
was found is written back into its bundle.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from epypes.run import CompGraphRunner, Run

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


class Target:
    """What a panel does otherwise for a runner of this process and for a service.

    Attributes
    ----------
    owner
        The object that the line of code calls: the runner, or the connection.
    name, verb
        What that is called if it has no name, and its method that sets hyperparameters.
    is_service
        Whether others may set hyperparameters too, whose changes are not to be overwritten unseen, and values are
        written back.
    """

    def __init__(self, runner: Any) -> None:
        self._runner = runner
        self.is_service = not isinstance(runner, CompGraphRunner)
        self.owner = runner.connection if self.is_service else runner
        self.name, self.verb = ("service", "set") if self.is_service else ("runner", "rerun")

    def compared(self, values: Mapping[str, Any], *targets: str) -> Run:
        """Return a run to compare with, with these hyperparameters and tokens; LookupError if there is none."""
        run: Run = (self._runner.remembered if self.is_service else self._runner.trial)(values, *targets)
        return run

    def put(self, values: Mapping[str, Any]) -> None:
        """Set hyperparameters, whatever runs."""
        if self.is_service:
            self._runner.put(values)
        else:
            self._runner.set(**values)

    def catch_up(self) -> None:
        """Take over what others have changed, before the hyperparameters are read."""
        if self.is_service:
            self._runner.catch_up()

    @property
    def notice(self) -> str:
        """What is wrong with the place where the functions run; empty if nothing is."""
        return str(self._runner.notice) if self.is_service else ""
