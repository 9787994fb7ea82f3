"""In which state is a service, and why?

A state is told from facts, each time that somebody asks: there are no transitions that could be missed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

State = Literal["LOADING", "READY", "PAUSED", "DEGRADED", "DRAINING", "FAULTED", "STOPPED"]
NOT_STARTED: Final = "It was not started."


@dataclass(frozen=True, slots=True)
class Facts:
    """What a state is told from.

    Attributes
    ----------
    is_running
        Whether the service was started and has not stopped.
    is_draining
        Whether it takes no more events, and works off what it has.
    is_paused
        Whether events wait since somebody asked for it.
    has_worker
        Whether there is a worker that has proved its bundle.
    was_ready
        Whether there has been one.
    fault
        Why there will be none any more; empty if that is not so.
    trouble
        Why there is none just now.
    away
        Why a broker can't be reached just now; empty if all can.
    is_joining
        Whether it reads yet which parameters the other replicas of its bundle have.
    """

    is_running: bool = False
    is_draining: bool = False
    is_paused: bool = False
    has_worker: bool = False
    was_ready: bool = False
    fault: str = ""
    trouble: str = ""
    away: str = ""
    is_joining: bool = False


def state_of(facts: Facts) -> tuple[State, str]:
    """Return the state, and a sentence that says why; empty where there is nothing to say."""
    if not facts.is_running:
        return "STOPPED", ""
    if facts.is_draining:
        return "DRAINING", "It takes no more events, and works off what it has."
    if facts.fault:
        return "FAULTED", facts.fault
    if not facts.has_worker:
        return _without_worker(facts)
    if facts.away:
        return "DEGRADED", facts.away
    if facts.is_joining:
        return "LOADING", "The parameters that the other replicas have agreed on are read."
    if facts.is_paused:
        return "PAUSED", "Events wait until it is resumed."
    return "READY", ""


def _without_worker(facts: Facts) -> tuple[State, str]:
    if facts.was_ready:
        return "DEGRADED", facts.trouble or "The worker is started again."
    return "LOADING", facts.trouble or "The bundle is loaded, and its samples are replayed."
