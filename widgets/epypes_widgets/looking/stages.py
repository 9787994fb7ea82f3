"""Which tokens of a run can be looked at, which first, and which pictures are up to date?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from epypes.display import is_image, scene_of
from epypes.display.previews.arrays import is_strip
from epypes.run import Run
from epypes.run.guard import ARRAYLESS
from epypes_widgets.places import Tunable

State = Literal["fresh", "stale", "failed", "absent"]


@dataclass(frozen=True, slots=True)
class Stage:
    """A token that can be looked at.

    Attributes
    ----------
    token
        Its name.
    is_picture
        Whether it is an image, or can be drawn over one; any other is shown as text.
    """

    token: str
    is_picture: bool


def stages(run: Run, kept: Iterable[Stage] = (), asked: str | None = None) -> tuple[Stage, ...]:
    """Return the tokens that have a picture, and the sink tokens whatever they are, in graph order.

    Parameters
    ----------
    run
        Its values are looked at, those that are stale only for whether they are images.
    kept
        The stages of an earlier run: what had a picture stays, whether or not it has one now, so that nothing comes
        and goes under the hand.
    asked
        A token that is a stage in any case.

    Returns
    -------
    tuple of Stage
        Of a run that has neither pictures nor sink tokens, all tokens that have a value.
    """
    known = {stage.token: stage.is_picture for stage in kept}
    sinks = run.cg.sink_tokens
    found: dict[str, bool] = {}
    for token in run.cg.tokens:
        is_picture = known.get(token, False) or _has_picture(run, token)
        if is_picture or token == asked or token in known or token in sinks:
            found[token] = is_picture
    found = found or dict.fromkeys(run, False)
    return tuple(Stage(token, is_picture) for token, is_picture in found.items())


def best_stage(run: Run, stages: Iterable[Stage]) -> str | None:
    """Return the token to show first: the last that has a picture, of sink tokens if one has; None of none.

    An image of a few columns, such as descriptors are, comes after all other pictures.
    """
    sinks, offered = run.cg.sink_tokens, tuple(stages)

    def rank(place: int) -> tuple[int, bool, int]:
        stage = offered[place]
        value = _value(run, stage.token)
        is_wide = not (is_image(value) and is_strip(value))
        return stage.is_picture * (1 + is_wide), stage.token in sinks, place

    best = max(range(len(offered)), key=rank, default=None)
    return None if best is None else offered[best].token


def states(looked_at: Run | Tunable, stages: Iterable[Stage]) -> dict[str, State]:
    """Return the state of every stage.

    ``"failed"`` is what the function that failed would have made, ``"absent"`` what was not computed; of a runner, a
    value is stale, too, if a hyperparameter has changed since its last run.
    """
    run: Run | None
    if isinstance(looked_at, Run):
        run, outdated = looked_at, frozenset[str]()
    else:
        run, outdated = looked_at.last, frozenset(looked_at.stale)
    return {stage.token: "absent" if run is None else _state(run, stage.token, outdated) for stage in stages}


def is_fresh(run: Run, token: str) -> bool:
    """Whether a run has a value of a token that belongs to its other values."""
    return _state(run, token, frozenset()) == "fresh"


def _state(run: Run, token: str, outdated: frozenset[str]) -> State:
    maker = run.cg.digraph.producer.get(token)
    if run.failure is not None and maker == run.failure.function:
        return "failed"
    if not run.tokens.is_computed(token):
        return "fresh" if run.failure is None and _was_in(run, token, maker) else "absent"
    return "stale" if run.tokens.is_stale(token) or maker in outdated else "fresh"


def _was_in(run: Run, token: str, maker: str | None) -> bool:
    """Whether a run had a token whose value is not here: that of a service sends what is looked at."""
    ran = run.report.ran
    return any(name in ran for name in ((maker,) if maker else run.cg.digraph.consumers.get(token, ())))


def _has_picture(run: Run, token: str) -> bool:
    value = _value(run, token)
    # Numbers and texts are known at a glance: a graph of a thousand of them is looked at after every run.
    return type(value) not in ARRAYLESS and (is_image(value) or scene_of(run, token) is not None)


def _value(run: Run, token: str) -> Any:
    """Return a token's value even if it is stale; what stands for none of a token that was not computed."""
    return run.tokens.values[run.tokens.program.slots[token]]
