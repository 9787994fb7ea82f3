"""Tiles: the numbers of a run beside its picture, with what has changed since the last commit and whether they pass.

A tile goes to the screen in the frame of the run that its value is of. What only a tile needs is run along with the
picture while that takes next to no time beside it; otherwise when the values rest, and until then the tile is stale.
"""

from __future__ import annotations

import enum
import math
import numbers
from collections.abc import Collection, Sequence
from functools import cache
from typing import Any, Final

from epypes.batch.cases import ABSENT, Check
from epypes.batch.check import Checks, check_value
from epypes.batch.metrics import METRICS
from epypes.graph import subgraph
from epypes.run import Run
from epypes.run.guard import is_array
from epypes_widgets.history import Entry, History
from epypes_widgets.picture.stages import Stages
from epypes_widgets.session import Session
from epypes_widgets.values import differing, numpy_type, short_text

MOST_PINNED: Final = 6
MOST_CHOSEN: Final = 24
_MOST_NUMBERS: Final = 8
_MOST_CHARACTERS: Final = 40
_TITLE_CHARACTERS: Final = 600
# Less than it takes to encode a picture, or a tenth of what the functions behind the picture take.
_FREE_NS: Final = 4_000_000
_SHARE: Final = 0.1
# Of integers with more digits, and of floats, so many are shown.
_DIGITS: Final = 6
_CHANGE_DIGITS: Final = 4
_EXACT_DIGITS: Final = 12
_LARGEST: Final = 10**12
_GREATEST: Final = 1e300


def numbers_of(value: Any) -> tuple[Any, ...] | None:
    """Return what a tile shows of a value, as Python has it; None if the value is for no tile.

    That is one number, truth value, short text or member of an enumeration, or the numbers of a vector of at most 8.
    """
    if isinstance(value, enum.Enum):
        return (value.name or str(value.value),)
    if isinstance(value, str):
        return (value,) if len(value) <= _MOST_CHARACTERS else None
    if is_array(value):
        is_vector = value.dtype.kind in "biuf" and value.size == max(value.shape, default=1)
        items = value.reshape(-1) if is_vector and value.size <= _MOST_NUMBERS else ()
    else:
        items = value if type(value) in (tuple, list) else (value,)
    if not (1 <= len(items) <= _MOST_NUMBERS and all(map(_is_number, items))):
        return None
    try:
        return tuple(map(_plain, items))
    except Exception:  # a user's own number that can't be one of Python's
        return None


def _is_number(value: Any) -> bool:
    # A duration of NumPy calls itself an integer.
    return isinstance(value, numbers.Real) if numpy_type(value) is None else value.dtype.kind in "biuf"


def _plain(number: Any) -> bool | int | float:
    if isinstance(number, bool | int | float):
        return number
    if numpy_type(number) is not None and number.dtype.kind == "b":
        return bool(number)
    return int(number) if isinstance(number, numbers.Integral) else float(number)


def _text(items: Sequence[Any], digits: int = _DIGITS, sign: str = "") -> str:
    """Return what was made by ``numbers_of`` as text."""
    return ", ".join([_item_text(item, digits, sign) for item in items])


def _item_text(item: Any, digits: int, sign: str) -> str:
    if isinstance(item, bool | str):
        return str(item)
    try:
        if isinstance(item, int) and abs(item) < _LARGEST:
            return f"{item:{sign}d}"
        # Without an exponent where that is not needed.
        kind = ".0f" if 10**digits <= abs(item) < _LARGEST else f".{digits}g"
        return f"{float(item):{sign}{kind}}"
    except OverflowError:  # an integer beyond all floats
        return "over 1e308" if item > 0 else "under -1e308"


def change_of(now: Sequence[Any] | None, before: Sequence[Any] | None) -> str:
    """Return how numbers have changed, as ``"+3"``; empty if they can't be compared."""
    if now is None or before is None or len(now) != len(before):
        return ""
    # What is not seen in the numbers is no change: 0.30000000000000004 after 0.3, or NaN after NaN.
    if _text(now) == _text(before):
        return "±0"
    if not all(type(item) in (int, float) and abs(item) < _GREATEST for item in (*now, *before)):
        return f"was {_text(before)}"
    return _text([new - old for new, old in zip(now, before, strict=True)], _CHANGE_DIGITS, "+")


class Tiles:
    """The tiles of a panel; all but ``chosen`` belongs to the worker's thread.

    Parameters
    ----------
    session
        Its runs have the numbers.
    history
        Its entries keep them.
    cases
        By test image, the checks that a tile passes or not.
    moved
        The hyperparameters that have a control.

    Attributes
    ----------
    offered
        The tokens that have been numbers, in graph order.
    failures
        By token, why a number can't be computed with the present values, as far as that was tried.
    """

    def __init__(self, session: Session, history: History, cases: Checks, moved: Collection[str]) -> None:
        self._session, self._history, self._cases = session, history, cases
        self._cg, self._moved = session.runner.cg, frozenset(moved)
        self._behind = cache(self._functions_behind)
        self._only_for_tiles = cache(self._functions_only_for)
        self.offered: dict[str, None] = {}
        self._defaults: tuple[str, ...] = ()
        # How long each function took; endless for one that has failed for a tile.
        self._costs_ns = dict.fromkeys(self._cg.functions, 0.0)
        # What each tile showed last.
        self._last: dict[str, str] = {}
        self.failures: dict[str, str] = {}
        self._payloads = session.foreign_payloads

    # -- which there are ----------------------------------------------------------------------------------------

    def pinned(self, chosen: Sequence[str] | None) -> tuple[str, ...]:
        """Return the tokens that have a tile: those that were chosen, else at most 6 that matter."""
        return self._defaults if chosen is None else tuple(filter(self._cg.has_token, chosen))[:MOST_CHOSEN]

    def follow(self, run: Run, stages: Stages) -> bool:
        """Offer the tokens that are numbers in a run and no pictures; return whether some are new."""
        slots, values, offered = run.tokens.program.slots, run.tokens.values, self.offered
        others = [token for token in self._cg.digraph.producer if token not in offered and not stages.get(token)]
        found = [token for token in others if numbers_of(values[slots[token]]) is not None]
        if not found:
            return False
        found += offered
        sinks = self._cg.sink_tokens
        self.offered = {token: None for token in self._cg.tokens if token in found}
        matter = [token for token in self.offered if token in sinks or self._is_moved(token)]
        best = sorted(matter, key=lambda token: token not in sinks)[:MOST_PINNED]
        self._defaults = tuple(token for token in matter if token in best)
        return True

    def _is_moved(self, token: str) -> bool:
        return not self._moved.isdisjoint(subgraph(self._cg, token).source_tokens)

    # -- when they are computed ---------------------------------------------------------------------------------

    def prompt(self, pinned: tuple[str, ...], targets: tuple[str, ...]) -> tuple[str, ...]:
        """Return the pinned tokens that are run along with the targets of the picture, which does not wait for it."""
        costs = self._costs_ns
        if self._session.is_service or sum(map(costs.__getitem__, self._only_for_tiles(pinned, targets))) <= _FREE_NS:
            return pinned
        room = max(_FREE_NS, _SHARE * sum(costs[name] for target in targets for name in self._behind(target)))
        found = []
        for token in sorted(pinned, key=lambda token: self._cost_ns(token, targets)):
            room -= self._cost_ns(token, targets)
            if room >= 0:
                found.append(token)
        return tuple(found)

    def late(self, run: Run, pinned: tuple[str, ...]) -> tuple[str, ...]:
        """Return the pinned tokens that a run does not have."""
        return tuple(token for token in pinned if not run.tokens.is_readable(token))

    def is_at_fault(self, run: Run, targets: tuple[str, ...]) -> bool:
        """Whether a run has failed in a function that only a tile needs; that tile is then not prompt any more."""
        failure = run.failure
        if failure is None or not targets or self._session.is_service:
            return False
        states = self._session.states
        if any(failure.function in self._behind(token) for token in (*targets, *(states.targets if states else ()))):
            return False
        self._costs_ns[failure.function] = math.inf
        for token in self.offered:
            if failure.function in self._behind(token):
                self.failures[token] = str(failure)
        return True

    def _cost_ns(self, token: str, targets: tuple[str, ...]) -> float:
        return sum(map(self._costs_ns.__getitem__, self._only_for_tiles((token,), targets)))

    def _functions_behind(self, token: str) -> frozenset[str]:
        return frozenset(subgraph(self._cg, token).functions)

    def _functions_only_for(self, pinned: tuple[str, ...], targets: tuple[str, ...]) -> frozenset[str]:
        return frozenset().union(*map(self._behind, pinned)).difference(*map(self._behind, targets))

    # -- what they show -----------------------------------------------------------------------------------------

    def content(self, run: Run, pinned: tuple[str, ...], *, has_failed: bool = False) -> list[dict[str, str]]:
        """Return the tiles of the run that is shown, ready for JSON; ``has_failed``: a newer one did not complete."""
        if not pinned:
            return []
        for name, took_ns in run.report.durations_ns.items():
            # A first call loads what it needs, and any may be held up.
            self._costs_ns[name] = min(took_ns, 2 * self._costs_ns.get(name, 0.0) or took_ns / 4)
        before = self._entry_before(run)
        return [self._tile(run, token, before, has_failed) for token in pinned]

    def numbers(self, run: Run) -> dict[str, tuple[Any, ...]]:
        """Return the numbers that a run has, for the entry of the history that it is committed as."""
        slots, values = run.tokens.program.slots, run.tokens.values
        found = {token: numbers_of(values[slots[token]]) for token in self.offered if run.tokens.is_readable(token)}
        return {token: items for token, items in found.items() if items is not None}

    def _tile(self, run: Run, token: str, before: Entry | None, has_failed: bool) -> dict[str, str]:
        text = exact = self._last.get(token, "…")
        tile = {"token": token, "change": "", "state": "stale", "verdict": ""}
        if not run.tokens.is_readable(token):
            reason = self.failures.get(token, "")
            lines = [reason or "Not computed with these values yet."]
            tile["state"] = "failed" if reason else "stale"
        else:
            self.failures.pop(token, None)
            items = numbers_of(run[token])
            text = exact = short_text(run[token]) if items is None else _text(items)
            self._last[token] = text
            if items is not None:
                exact = _text(items, _EXACT_DIGITS)
            if has_failed:
                lines = ["Of the picture that is shown: the run after it has failed."]
            else:
                lines, tile["verdict"] = self._verdict(run, token)
                tile["state"] = "fresh"
                known = None if before is None else before.numbers.get(token)
                if before is not None and known is not None and (change := change_of(items, known)):
                    tile["change"] = change
                    lines.insert(0, f"{change} since #{before.number}, where it was {_text(known)}")
        return {**tile, "text": text, "title": "\n".join([f"{token}: {exact}", *lines])[:_TITLE_CHARACTERS]}

    def _verdict(self, run: Run, token: str) -> tuple[list[str], str]:
        """Return what the checks of the present test image say of a token, and ``"passed"`` or ``"failed"``."""
        image = self._session.image
        if not self._cases or image is None:
            return [], ""
        case, checks = self._cases[image]
        own, now = [check for check in checks if check.token == token], run.hyperparameters
        if not own or differing(now, {**now, **(case.hyperparameters or {})}):  # a case may have values of its own
            return [], ""
        reasons = [check_value(check, case, run[token], self._cg).reason for check in own]
        lines = [
            f"{requirement(check)}: {f'failed, {reason}' if reason else 'passed'}"
            for check, reason in zip(own, reasons, strict=True)
        ]
        return [f"{case}:", *lines], "failed" if any(reasons) else "passed"

    def _entry_before(self, run: Run) -> Entry | None:
        """Return the entry of the history that changes are counted from: the last one with other values."""
        history, payloads = self._history, self._session.foreign_payloads
        before = shown = history.current
        if shown is not None and self._is_of_image(shown) and not differing(shown.values, run.hyperparameters):
            before = history.previous
        if payloads != self._payloads:  # the numbers of all entries are of another one
            self._payloads = payloads
            for entry in history.entries:
                entry.numbers.clear()
            if shown is not None and before is not shown:
                shown.numbers.update(self.numbers(run))
        return before if before is not None and self._is_of_image(before) else None

    def _is_of_image(self, entry: Entry) -> bool:
        return not len(self._session.payloads) or entry.image == self._session.image


def requirement(check: Check) -> str:
    """Return what a check requires, with the tolerance of its metric."""
    expected = [] if check.expected is ABSENT else [f"expected {short_text(check.expected)}"]
    metric = None if callable(check.metric) else METRICS[check.metric]
    defaults = getattr(metric.function, "__kwdefaults__", None) or {} if metric else {}
    options = [f"{name} {value}" for name, value in {**defaults, **check.options}.items() if value is not None]
    # What "equal" and "close" require without a bound goes without saying.
    bounds = [check.threshold] if check.threshold and not (expected and check.threshold == "at least 1") else []
    return f"{check.name}: {', '.join([*expected, *bounds, *options]) or 'true'}"
