"""What did a replay find?"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from epypes.bundle.compare import Unlike
from epypes.wording import counted


@dataclass(frozen=True, slots=True)
class Difference:
    """Where a token first is not what was recorded.

    Attributes
    ----------
    sample
        The sample's name.
    token
        The token's.
    text
        What differs, with the first index and both values.
    index
        The first index, ``""`` for a value that has none.
    expected, got
        The values there, as text.
    count, size
        How many values of the token differ, of how many.
    largest
        The largest difference of numbers, None for what is none.
    """

    sample: str
    token: str
    text: str
    index: str = ""
    expected: str = ""
    got: str = ""
    count: int = 0
    size: int = 0
    largest: float | None = None

    def __str__(self) -> str:
        return f"sample {self.sample}, token {self.token!r}: {self.text}"


def difference(sample: str, token: str, found: Iterable[Unlike]) -> Difference | None:
    """Return the difference of a token of all places where it differs; None if there are none."""
    places = [*found]
    if not places:
        return None
    first = places[0]
    more = len(places) - 1
    text = first.text + (f"; {counted(more, 'other place')} of it differ{'s' * (more == 1)}" if more else "")
    count, size = (sum(getattr(place, name) for place in places) for name in ("count", "size"))
    numbers = [place.largest for place in places if place.largest is not None]
    largest = max(numbers, default=None)
    return Difference(sample, token, text, first.where, first.expected, first.got, count, size, largest)


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """What a replay found.

    Attributes
    ----------
    samples
        How many samples were replayed.
    tokens
        How many tokens were compared.
    differences
        The first difference of each token that differs.
    requirements
        The lines of requirements.txt, from what the replay imported; empty where it ran in this process.
    environment
        What the replay ran on: Python, platform, processor, OpenCV's build and threads.
    unsteady
        The tokens that differ from what was recorded, and from run to run as well.
    causes
        What the differences likely come from, the likeliest first.
    notes
        What else is worth knowing, as sentences.
    outside
        The files outside of the bundle that its functions open or name, as sentences.
    """

    samples: int
    tokens: int
    differences: tuple[Difference, ...]
    requirements: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    unsteady: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    outside: tuple[str, ...] = ()

    @property
    def identical(self) -> bool:
        """Whether every token was what had been recorded, and there was one."""
        return self.tokens > 0 and not self.differences

    def __str__(self) -> str:
        if self.identical:
            return f"identical: {counted(self.tokens, 'token')} of {counted(self.samples, 'sample')}"
        found = [*map(str, self.differences)] or ["nothing was compared: the bundle has no samples"]
        return "\n".join([*found, *(f"Likely: {cause}" for cause in self.causes)])

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values, as JSON has them."""
        from dataclasses import asdict

        return {"identical": self.identical, **asdict(self)}


def report_from(outcome: Mapping[str, Any]) -> ReplayReport:
    """Return the report that a process has written as JSON."""
    found = (Difference(**entry) for entry in outcome["differences"])
    texts = {name: tuple(outcome[name]) for name in ("requirements", "unsteady", "causes", "notes", "outside")}
    return ReplayReport(
        outcome["samples"], outcome["tokens"], tuple(found), environment=outcome["environment"], **texts
    )
