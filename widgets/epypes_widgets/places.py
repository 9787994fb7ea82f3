"""What can be tuned, where do its functions run, and what does a panel do otherwise there?

A runner is in this process: what is tried on it changes nothing, nobody but the user's own cells changes it, and what
was found is promoted. A service is somewhere else: what is tried is done there, others may tune it at the same time,
its events come by themselves, and what was found is written back into its bundle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from epypes.graph import CompGraph
from epypes.run import Run


@runtime_checkable
class Tunable(Protocol):
    """What a panel tunes: a CompGraphRunner, or what is like one."""

    @property
    def cg(self) -> CompGraph:
        """The graph."""
        ...

    @property
    def last(self) -> Run | None:
        """The last run; None before the first."""
        ...

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        """The values of the hyperparameters by token: a snapshot."""
        ...

    @property
    def first_hyperparameters(self) -> Mapping[str, Any]:
        """Those that they had at first."""
        ...

    @property
    def free_source_tokens(self) -> tuple[str, ...]:
        """The tokens of the payload."""
        ...

    @property
    def stale(self) -> tuple[str, ...]:
        """The functions whose outputs are out of date."""
        ...

    @property
    def running(self) -> tuple[str, ...]:
        """The functions that are being run."""
        ...

    def trial(self, values: Mapping[str, Any], /, *targets: str, payload: Mapping[str, Any] | None = None) -> Run:
        """Return a run with other hyperparameters."""
        ...

    def adopt(self, run: Run, /) -> bool:
        """Make it the last one, and its hyperparameters those of now; False if somebody has changed them meanwhile."""
        ...

    def watch(self, callback: Callable[[], object], /) -> Callable[[], None]:
        """Call something when it has changed; return what ends that."""
        ...


@dataclass(frozen=True, slots=True)
class Place:
    """What a panel does otherwise for a runner of this process and for a service.

    Attributes
    ----------
    owner
        What the line of code calls.
    word
        What that is called if it has no name.
    verb
        Its method that sets hyperparameters.
    is_shared
        Whether others may set them too, whose changes are not to be overwritten unseen.
    is_written_back
        Whether what was found is written back, not promoted.
    compared
        Returns a run to compare with, with these hyperparameters and tokens; LookupError if there is none.
    put
        Sets hyperparameters, whatever runs.
    catch_up
        Is called before the hyperparameters are read.
    notice
        Returns what is to be said of the place beside the picture; empty if nothing is.
    """

    owner: Any
    word: str
    verb: str
    is_shared: bool
    is_written_back: bool
    compared: Callable[..., Run]
    put: Callable[[Mapping[str, Any]], object]
    catch_up: Callable[[], object]
    notice: Callable[[], str]


def tunable(given: object) -> Tunable:
    """Return what is tuned: what was given, or what it has for that, as a connection to a service does.

    Raises
    ------
    TypeError
        It can't be tuned.
    """
    to_tune = getattr(given, "to_tune", None)
    found = given if to_tune is None else to_tune()
    if not isinstance(found, Tunable):
        raise TypeError(
            f"tune() takes a CompGraphRunner or a connection to a service, not {type(given).__name__!r}: "
            "tune(CompGraphRunner(cg, hparams)), tune(ep.connect(url))."
        )
    return found


def place_of(runner: Any) -> Place:
    """Return where the functions of what is tuned run."""
    connection = getattr(runner, "connection", None)
    if connection is None:
        return Place(
            runner,
            "runner",
            "rerun",
            False,
            False,
            runner.trial,
            lambda values: runner.set(**values),
            _nothing,
            _nothing,
        )
    return Place(
        connection, "service", "set", True, True, runner.remembered, runner.put, runner.catch_up, lambda: runner.notice
    )


def _nothing() -> str:
    return ""
