"""The check of a labelled set: its cases are run and measured; the result shows itself, or becomes JUnit XML.

A metric that raises, or a file of expected values that can't be read, fails the check that it belongs to, with the
reason; the others go on.
"""

from __future__ import annotations

import enum
import math
import os
import re
import threading
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.cases import ABSENT, Case, Check, case_items, cases_of, checks_of, with_labels_read
from epypes.batch.executors import progress_bar, run_jobs
from epypes.batch.items import detached_runner, read_value
from epypes.batch.job import Job
from epypes.batch.metrics import METRICS
from epypes.batch.results import BatchResult, ErrorInfo, HtmlColumn, Outcome, failure_column, frame_of, html_table
from epypes.batch.thumbnails import DIFFERENCE_LEGEND, Thumbnail, comparison_thumbnails
from epypes.bundle.proof.compare import first_difference
from epypes.bundle.settings import Member
from epypes.errors import EpypesError, ScaleError, UnknownName
from epypes.graph import CompGraph
from epypes.nothing import Nothing
from epypes.run import CompGraphRunner
from epypes.wording import counted, error_message

if TYPE_CHECKING:
    import pandas as pd

Checks = Sequence[tuple[Case, tuple[Check, ...]]]

# The check of a case that has none: it runs.
_RUNS: Final = Check("runs", None, "runs")
_REASON_CHARACTERS: Final = 300


@dataclass(frozen=True, slots=True)
class CheckOutcome:
    """The result of one check of one case.

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
        The bounds, as ``"at least 0.9"``; empty if the metric returns true or false.
    reason
        Why it has not passed; empty if it has.
    error_info
        The error because of which nothing could be measured: of the run, the metric, or reading what was expected.
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
    reason: str = ""
    error_info: ErrorInfo | None = None
    total_ns: int = 0
    pictures: Mapping[str, Thumbnail] = field(default_factory=dict, repr=False)

    @property
    def passed(self) -> bool:
        """Whether the check has passed."""
        return not self.reason

    @property
    def has_failed(self) -> bool:
        """Whether the check has not passed."""
        return bool(self.reason)


def check(
    runner: CompGraphRunner,
    cases: str | os.PathLike[str] | Iterable[Any],
    executor: Executor | None = None,
    *,
    progress: bool | None = None,
) -> CheckResult:
    """Run a labelled set and return which cases pass.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used; it is left as it is.
    cases
        ``ep.Case`` objects, dicts with the parts of one, or the path of a CASES.toml. Of a graph with state the inputs
        of a case are a sequence: what it gives at its end is measured.
    executor
        None runs the cases in this thread; any ``concurrent.futures.Executor`` elsewhere. Metrics are computed here.
    progress
        Whether a bar is shown; None: in a terminal or a notebook.

    Returns
    -------
    CheckResult
        True if every check of every case has passed. A case that fails, whose metric raises or gives NaN, or whose
        file of what was expected can't be read, has not, with its reason; the others go on.

    Raises
    ------
    ScaleError
        There are no cases, or one can't be understood.
    UnknownName
        A case names a token, a hyperparameter or a metric that is not there.

    Examples
    --------
    >>> from epypes import Case, CompGraph, CompGraphRunner
    >>> cg = CompGraph({"double": lambda x, k: x * k}, {"double": (("x", "k"), "y")})
    >>> result = check(CompGraphRunner(cg, {"k": 2}), [Case(2, {"y": 4}), Case(3, {"y": 7}, name="odd")])
    >>> print(result)
    1 of 2 cases failed: odd
    >>> result.failures[0].reason
    'expected 7, got 6'
    """
    runner = detached_runner(runner)
    found = prepare_cases(runner, cases)
    outcomes: list[CheckOutcome] = []
    with progress_bar(progress, len(found), "check", unit="case") as advance:
        for of_case in run_checks(runner, found, executor):
            outcomes += of_case
            advance(1, int(not all(outcome.passed for outcome in of_case)))
    outcomes.sort(key=lambda outcome: outcome.number)
    return CheckResult(tuple(outcomes))


def prepare_cases(runner: CompGraphRunner, cases: Any) -> Checks:
    """Return cases with their checks.

    Raises
    ------
    ScaleError, UnknownName
        As ``check`` does.
    """
    found = cases_of(cases, are_series=bool(runner.state))
    return [(_with_members(case, runner), checks_of(case, runner.cg)) for case in found]


def _with_members(case: Case, runner: CompGraphRunner) -> Case:
    """Return a case whose hyperparameters the runner has, with members of enumerations in place of their names."""
    now, given = runner.hyperparameters, case.hyperparameters or {}
    for token in given:
        if token not in now:
            raise UnknownName("hyperparameter", token, now, f"for {case}")
    return replace(case, hyperparameters={token: _member(value, now[token], case) for token, value in given.items()})


def _member(value: Any, present: Any, case: Case) -> Any:
    """Return the member of an enumeration that a file names; any other value as it is."""
    if not isinstance(value, Member):
        return value
    members = type(present).__members__ if isinstance(present, enum.Enum) else {}
    if value.name not in members:
        raise UnknownName(f"member of {value.enum}", value.name, members, f"for {case}")
    return members[value.name]


def run_checks(
    runner: CompGraphRunner,
    cases: Checks,
    executor: Executor | None = None,
    *,
    has_pictures: bool = True,
    stop: threading.Event | None = None,
) -> Iterator[tuple[CheckOutcome, ...]]:
    """Yield the outcomes of the checks, case by case as they come.

    Parameters
    ----------
    runner, cases, executor
        As of ``check``; the cases with their checks.
    has_pictures
        Whether pictures are made of what is measured.
    stop
        Ends it in bounded time, once it is set.
    """

    def jobs() -> Iterator[Job]:
        items = case_items([case for case, _ in cases], runner)
        for item, (case, checks) in zip(items, cases, strict=True):
            show = tuple(dict.fromkeys(check.token for check in checks if check.token is not None))
            keep = tuple(dict.fromkeys(token for check in checks for token in check.keep))
            yield Job(item, (dict(case.hyperparameters or {}),), keep, show if has_pictures else ())

    for outcomes in run_jobs(runner, jobs(), executor, stop=stop):
        for outcome in outcomes:
            case, checks = cases[outcome.number]
            yield tuple(_measured(outcome, case, check, runner.cg) for check in checks or (_RUNS,))


@dataclass(frozen=True, slots=True, repr=False)
class CheckResult(BatchResult[CheckOutcome]):
    """The result of a labelled set; true if all of it has passed.

    Attributes
    ----------
    outcomes
        Check by check, in the order of the cases.
    """

    outcomes: tuple[CheckOutcome, ...]

    @property
    def passed(self) -> bool:
        """Whether every check of every case has passed."""
        return not self.failures

    @property
    def cases(self) -> dict[str, bool]:
        """Whether each case has passed, by name."""
        found: dict[str, bool] = {}
        for outcome in self.outcomes:
            found[outcome.case] = found.get(outcome.case, True) and outcome.passed
        return found

    def to_frame(self) -> pd.DataFrame:
        """Return a pandas table with a row per check: case, check, token, value, threshold, passed, failure, run_ms."""
        outcomes = self.outcomes
        columns = [
            (name, [getattr(outcome, name) for outcome in outcomes], "")
            for name in ("case", "check", "token", "value", "threshold", "passed")
        ]
        # As numbers, even if there is none.
        columns[3] = "value", [math.nan if outcome.value is None else outcome.value for outcome in outcomes], ""
        failure = failure_column(outcome.reason for outcome in outcomes)
        return frame_of([*columns, failure, ("run_ms", [outcome.total_ns / 1e6 for outcome in outcomes], "")])

    def to_junit(self, path: str | os.PathLike[str], name: str = "epypes check") -> Path:
        """Write JUnit XML, as continuous integration reads it, and return its path.

        A case is a class, a check a test case; what could not be measured is an error, what falls short a failure.

        Raises
        ------
        ScaleError
            The file can't be written.
        """
        path = Path(path)
        suite = _junit(self.outcomes, name)
        ET.indent(suite)
        try:
            ET.ElementTree(suite).write(path, encoding="utf-8", xml_declaration=True)
        except OSError as error:
            raise ScaleError(f"{str(path)!r} can't be written: {error.strerror}. Name another file.") from error
        return path

    def __bool__(self) -> bool:
        return self.passed

    def __str__(self) -> str:
        cases = self.cases
        failed = [name for name, has_passed in cases.items() if not has_passed]
        if not failed:
            return f"{counted(len(cases), 'case')} passed"
        named = ", ".join(failed[:5])
        return f"{len(failed)} of {counted(len(cases), 'case')} failed: {named}{', ...' if len(failed) > 5 else ''}"

    @property
    def _caption(self) -> str:
        failed = list(self.cases.values()).count(False)
        return f"{counted(len(self.cases), 'case')}, {f'{failed} failed' if failed else 'all passed'}"

    def _page(self) -> str:
        outcomes, kinds = self.outcomes, ("expected", "got", "difference")
        pictured = [kind for kind in kinds if any(kind in outcome.pictures for outcome in outcomes)]
        columns: list[HtmlColumn] = [
            ("case", [outcome.case for outcome in outcomes]),
            ("check", [outcome.check for outcome in outcomes]),
            ("value", ["" if outcome.value is None else f"{outcome.value:.6g}" for outcome in outcomes]),
            ("must be", [outcome.threshold for outcome in outcomes]),
            *((kind, [outcome.pictures.get(kind) for outcome in outcomes]) for kind in pictured),
        ]
        legend = f"<p>difference of masks: {DIFFERENCE_LEGEND}</p>" if "difference" in pictured else ""
        return html_table(str(self), columns, [outcome.reason for outcome in outcomes]) + legend


# -- measuring --------------------------------------------------------------------------------------------------


def check_value(check: Check, case: Case, value: Any, cg: CompGraph) -> CheckOutcome:
    """Return the outcome of a check of one token for a value that it has; whatever a metric raises is its reason."""
    return _measured(Outcome(0, case.name or "", kept={str(check.token): value}), case, check, cg)


def _measured(outcome: Outcome, case: Case, check: Check, cg: CompGraph) -> CheckOutcome:
    """Return the outcome of a check by the outcome of its case's run, which keeps the tokens that are measured."""
    value = expected = number = None
    error_info, reason = outcome.error_info, ""
    if error_info is not None:
        reason = str(error_info)
    elif check is not _RUNS:
        try:
            value, expected = _compared(outcome, check, cg)
            if value is Nothing and not (callable(check.metric) or METRICS[check.metric].measures_nothing):
                reason = f"nothing was found of {check.token!r}"
            else:
                number = _number(_measure(outcome, case, check, cg, value, expected), check)
                reason = _shortfall(number, check, value, expected)
        except (Exception, SystemExit) as error:  # whatever a user's metric raises
            number, error_info, reason = None, *_failure(error, check)
    pictures: dict[str, Thumbnail] = {}
    if reason and check.token is not None and expected is not None and (outcome.thumbnails or outcome.texts):
        pictures = comparison_thumbnails(value, expected, cg, check.token)
    seen = outcome.thumbnails.get(check.token or "")
    if seen is not None:  # it has what was found drawn over its image
        pictures["got"] = seen
    return CheckOutcome(
        outcome.number,
        outcome.name,
        check.name,
        check.token,
        number,
        check.threshold,
        " ".join(reason.split())[:_REASON_CHARACTERS],
        error_info,
        outcome.total_ns,
        pictures,
    )


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


def _failure(error: BaseException, check: Check) -> tuple[ErrorInfo, str]:
    """Return the error because of which nothing could be measured, and the reason that is shown."""
    message = error_message(error)
    if isinstance(error, KeyError) and check.token is None:
        message = f"no token {message} is kept. If the graph has it, give the metric keep=[{message}]."
    error_info = ErrorInfo("", type(error).__name__, message)
    # The messages of EPypes say all; for a user's metric, and where there is no text, the kind of error is named.
    is_ours = bool(message) and (isinstance(error, EpypesError) or not callable(check.metric))
    return error_info, message if is_ours else str(error_info)


# -- JUnit XML --------------------------------------------------------------------------------------------------

# What XML 1.0 does not allow, in a name or in an exception's message, would make the whole file unreadable.
_NOT_XML: Final = re.compile("[^\\t\\n\\r\\x20-\\ud7ff\\ue000-\\ufffd\\U00010000-\\U0010ffff]")


def require_writable(path: Path) -> None:
    """Raise ScaleError if no file can be written there, before the cases are run."""
    if path.is_dir():
        raise ScaleError(f"{str(path)!r} is a folder. Name a file in it.")
    if not path.parent.is_dir():
        folder = str(path.parent)
        raise ScaleError(f"{str(path)!r} can't be written: there is no folder {folder!r}. Make it, or name another.")


def _junit(outcomes: Sequence[CheckOutcome], name: str) -> ET.Element:
    """Return one suite, in which a case is a class and each of its checks a test case."""
    failed = [outcome for outcome in outcomes if not outcome.passed]
    errors = sum(outcome.error_info is not None for outcome in failed)
    # The run of a case counts once, so that the sum is the time of the set.
    times_s = {outcome.number: outcome.total_ns / 1e9 for outcome in outcomes}
    counts = {"tests": len(outcomes), "failures": len(failed) - errors, "errors": errors}
    totals = {key: str(count) for key, count in counts.items()} | {"time": f"{sum(times_s.values()):.6f}"}
    root = ET.Element("testsuites", totals)
    suite = ET.SubElement(root, "testsuite", {"name": _xml_text(name), **totals})
    for outcome in outcomes:
        time_s = times_s.pop(outcome.number, 0.0)
        named = {"classname": _xml_text(outcome.case), "name": _xml_text(outcome.check)}
        test = ET.SubElement(suite, "testcase", {**named, "time": f"{time_s:.6f}"})
        if outcome.passed:
            continue
        error = outcome.error_info
        problem = ET.SubElement(test, "failure" if error is None else "error")
        problem.set("type", "threshold" if error is None else _xml_text(error.kind))
        problem.set("message", _xml_text(outcome.reason))
        value = "nothing measured" if outcome.value is None else f"measured {outcome.value!r}"
        wanted = f", wanted {outcome.threshold}" if outcome.threshold else ""
        problem.text = _xml_text(f"{outcome.case}: {outcome.check}: {outcome.reason}\n{value}{wanted}")
    return root


def _xml_text(text: str) -> str:
    return _NOT_XML.sub("\ufffd", text)
