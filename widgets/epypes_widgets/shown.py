"""What does the user want to see, and which tokens must be computed for it?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

from epypes.run import Run
from epypes_widgets.looking.stages import Stage, best_stage
from epypes_widgets.places import Tunable


@dataclass(frozen=True, slots=True)
class Comparison:
    """What the picture is compared with.

    Attributes
    ----------
    kind
        ``"default"`` for the first values of all hyperparameters, ``"history"`` for committed ones, ``"stage"`` for
        another token of the same run.
    number
        Of the entry of the history.
    token
        Of the stage.
    """

    kind: str
    number: int = 0
    token: str = ""


@dataclass(frozen=True, slots=True)
class Shown:
    """What is on the screen; replaced as a whole.

    Attributes
    ----------
    token
        Whose picture is the big one; None before the first run.
    pinned
        Whose pictures are shown small beneath it.
    comparison
        None if it is not compared.
    has_histogram
        Whether the histogram of the picture is shown.
    cut
        The tokens whose histograms are shown with thresholds on them.
    """

    token: str | None = None
    pinned: tuple[str, ...] = ()
    comparison: Comparison | None = None
    has_histogram: bool = False
    cut: tuple[str, ...] = ()

    @property
    def other(self) -> str:
        """The stage that the big picture is compared with; empty if it is none."""
        return self.comparison.token if self.comparison is not None and self.comparison.kind == "stage" else ""

    @property
    def targets(self) -> tuple[str, ...]:
        """The tokens that must be computed, the big picture's first."""
        cut = self.cut if self.has_histogram else ()
        return tuple(dict.fromkeys(token for token in (self.token, self.other, *self.pinned, *cut) if token))

    def within(self, stages: Sequence[Stage], run: Run) -> Shown:
        """Return what of this can be shown with these stages; another big picture if this one can't."""
        known = {stage.token for stage in stages}
        token = self.token if self.token in known else best_stage(run, stages)
        pinned = tuple(name for name in self.pinned if name in known)
        comparison = self.comparison if not self.other or self.other in known else None
        return replace(self, token=token, pinned=pinned, comparison=comparison)

    def with_pin(self, token: str, *, on: bool) -> Shown:
        """Return this with a token pinned, or not."""
        others = tuple(name for name in self.pinned if name != token)
        return replace(self, pinned=(*others, token) if on else others)


# A cell that is run again makes a new panel, in which the hand goes on where it was.
_last: WeakKeyDictionary[Tunable, Shown] = WeakKeyDictionary()


def remember_shown(runner: Tunable, shown: Shown) -> None:
    """Keep what is shown of a runner for its next panel."""
    _last[runner] = shown


def shown_before(runner: Tunable) -> Shown:
    """Return what the last panel of a runner has shown; nothing of one that had none."""
    return _last.get(runner, Shown())
