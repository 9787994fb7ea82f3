"""Which of the events that take too long are stuck, and in which function?"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Final

from epypes.errors import ServiceError
from epypes.service.link import Link

# How long a worker that seems stuck may take to say where it is.
_ASK_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Where:
    """Where a worker is.

    Attributes
    ----------
    functions
        By the number of the event, the function that it is in; empty where that can't be known.
    elapsed_ns
        How long the worker has worked on it. What is missing here waits, for a change of parameters or for something
        else that the worker does.
    has_answered
        Whether the worker said so itself. Otherwise none of its threads gets on.
    """

    functions: Mapping[int, str]
    elapsed_ns: Mapping[int, int]
    has_answered: bool

    def waiting(self, seqs: Collection[int]) -> list[int]:
        """Return those of some events that the worker has not begun, while it works on others."""
        return [seq for seq in seqs if self.elapsed_ns and seq not in self.elapsed_ns]


def whereabouts(link: Link, seqs: Collection[int]) -> Where:
    """Return where a worker is with some events: what it says, or what the system can tell if it says nothing."""
    try:
        header, _ = link.ask("running", _ASK_S)
    except ServiceError:
        # A function holds the interpreter, or the process is stopped.
        names = link.process.functions_by_trace()
        known = [name for name in names if name in link.about.get("functions", ())] or list(names)
        return Where(dict.fromkeys(seqs, ", ".join(dict.fromkeys(known))), {}, has_answered=False)
    slots: list[Mapping[str, Any]] = list(header.get("slots", ()))
    functions = dict.fromkeys(seqs, "") | {slot["seq"]: ", ".join(slot["functions"]) for slot in slots}
    return Where(functions, {slot["seq"]: slot["ns"] for slot in slots}, has_answered=True)
