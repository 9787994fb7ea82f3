"""Has a case passed?

Whatever a metric does wrong, or a file of what was expected, fails the check that it belongs to, with its reason; the
others go on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from epypes.batch.cases import ABSENT, Case, Check, with_labels_read
from epypes.batch.differing import pictures_of
from epypes.batch.items import read_value
from epypes.batch.metrics import METRICS
from epypes.batch.results import ErrorInfo, Outcome, Thumbnail
from epypes.bundle.compare import first_difference
from epypes.errors import EpypesError, ScaleError
from epypes.graph import CompGraph

# What a case without a check has to do.
RUNS: Final = "runs"
_REASON_CHARACTERS: Final = 300


@dataclass(frozen=True, slots=True)
class CheckOutcome:
    """What came of one check of one case.

    Attributes
    ----------
    number, case
        Place and name of the case.
    check
        The name of the check; ``"runs"`` of a case that has none.
    token
        The token that was measured; None if the metric was given the whole run.
    value
        The number that the metric gave; None if there is none.
    threshold
        What must be so, as ``"at least 0.9"``; empty if the metric says true or false.
    passed
        Whether it is.
    reason
        Why it has not passed; empty if it has.
    trouble
        What failed, so that nothing could be measured: the run, the metric, or reading what was expected.
    total_ns
        Nanoseconds of the case's run.
    pictures
        ``"expected"``, ``"got"`` and ``"difference"``, as far as they have one; of what has passed ``"got"`` alone.
    """

    number: int
    case: str
    check: str
    token: str | None
    value: float | None
    threshold: str
    passed: bool
    reason: str = ""
    error_info: ErrorInfo | None = None
    total_ns: int = 0
    pictures: Mapping[str, Thumbnail] = field(default_factory=dict, repr=False)


def measured(outcome: Outcome, case: Case, checks: tuple[Check, ...], cg: CompGraph) -> tuple[CheckOutcome, ...]:
    """Return what came of a case, check by check.

    Parameters
    ----------
    outcome
        Of its run; it keeps the tokens that the checks look at.
    case
        The case.
    checks
        Its checks, with their tokens.
    cg
        The graph that was run.
    """
    if not checks:
        checks = (Check(RUNS, None, RUNS),)
    return tuple(_outcome(outcome, case, check, cg) for check in checks)


@dataclass(frozen=True, slots=True)
class _Verdict:
    """What was measured, why it does not do, what failed, and how it looks."""

    value: float | None
    reason: str = ""
    error_info: ErrorInfo | None = None
    pictures: Mapping[str, Thumbnail] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether nothing failed, and there is no reason why it does not do."""
        return self.error_info is None and not self.reason


def _outcome(outcome: Outcome, case: Case, check: Check, cg: CompGraph) -> CheckOutcome:
    verdict = _judged(outcome, case, check, cg)
    seen = outcome.thumbnails.get(check.token or "")
    return CheckOutcome(
        outcome.number,
        case.name or outcome.name,
        check.name,
        check.token,
        verdict.value,
        check.threshold,
        verdict.passed,
        " ".join(verdict.reason.split())[:_REASON_CHARACTERS],
        verdict.error_info,
        outcome.total_ns,
        # That of the run has what was found drawn over its image.
        verdict.pictures if seen is None else {**verdict.pictures, "got": seen},
    )


def _judged(outcome: Outcome, case: Case, check: Check, cg: CompGraph) -> _Verdict:
    """Return the number, why it does not do, what failed, and pictures of the difference."""
    if outcome.error_info is not None:
        return _Verdict(None, str(outcome.error_info), outcome.error_info)
    if check.metric == RUNS:
        return _Verdict(None)
    value = expected = None
    try:
        value, expected = _compared(outcome, check, cg)
        number = _number(_measure(outcome, case, check, cg, value, expected), check)
        verdict = _Verdict(number, _shortfall(number, check, value, expected))
    except (Exception, SystemExit) as error:  # whatever a user's metric raises
        verdict = _failed(error, check)
    if check.token is None or expected is None or verdict.passed or not (outcome.thumbnails or outcome.texts):
        return verdict
    return replace(verdict, pictures=pictures_of(value, expected, cg, check.token))


def _compared(outcome: Outcome, check: Check, cg: CompGraph) -> tuple[Any, Any]:
    """Return the value of the check's token and what it is compared with; None for what there is not."""
    if check.token is None:
        return None, None
    if check.token not in outcome.kept:
        raise ScaleError(f"Token {check.token!r} has not been computed in this case: no branch that ran makes it.")
    expected = None if check.expected is ABSENT else read_value(check.expected, cg, check.token)
    return outcome.kept[check.token], expected


def _measure(outcome: Outcome, case: Case, check: Check, cg: CompGraph, value: Any, expected: Any) -> Any:
    if not callable(check.metric):
        metric = METRICS[check.metric]
        return metric.function(*((value, expected) if metric.compares else (value,)), **check.options)
    if check.token is not None:
        return check.metric(value, expected)
    kept = {token: outcome.kept[token] for token in check.keep if token in outcome.kept}
    return check.metric(kept, with_labels_read(case, cg))


def _number(given: Any, check: Check) -> float:
    """Return what a metric gave as a number.

    Raises
    ------
    ScaleError
        It is none, or NaN, or nothing says which numbers pass.
    """
    item = given.item() if getattr(given, "shape", None) == () else given
    if not isinstance(item, bool | int | float):
        raise ScaleError(f"The metric returned a {type(given).__name__}, not a number. Return one.")
    if not (check.threshold or isinstance(item, bool)):
        raise ScaleError(f"The metric returned {item:g} and there is no threshold. Give min or max, or return True.")
    if math.isnan(item):
        raise ScaleError("The metric is NaN.")
    return float(item)


def _shortfall(number: float, check: Check, value: Any, expected: Any) -> str:
    """Return why a number does not pass; empty if it does."""
    if not check.threshold:
        return "" if number else "the metric says False"
    is_low = check.at_least is not None and number < check.at_least
    is_high = check.at_most is not None and number > check.at_most
    if not (is_low or is_high):
        return ""
    if check.metric == "equal" and check.at_least == 1:
        return _differing(value, expected)
    bound = f"at least {check.at_least:g}" if is_low else f"at most {check.at_most:g}"
    # 0.9999999 is not to read as 1.
    shown = f"{number:.6g}" if f"{number:g}" not in bound else repr(number)
    return f"{shown} is not {bound}"


def _differing(value: Any, expected: Any) -> str:
    """Return what differs where all must be equal, which the share that does does not tell."""
    if getattr(value, "size", 0) > 1:
        differing = round((1 - METRICS["equal"].function(value, expected)) * value.size)
        return f"{differing} of {value.size} values differ"
    return first_difference(expected, value) or "they differ"


def _failed(error: BaseException, check: Check) -> _Verdict:
    """Return the verdict where nothing could be measured."""
    message = str(error).strip()
    if isinstance(error, KeyError) and check.token is None:
        message = f"no token {message} is kept. If the graph has it, give the metric keep=[{message}]."
    error_info = ErrorInfo("", type(error).__name__, message)
    # Our own sentences say all; of a user's metric, and where there is no text, the kind of error does.
    is_ours = bool(message) and (isinstance(error, EpypesError) or not callable(check.metric))
    return _Verdict(None, message if is_ours else str(error_info), error_info)
