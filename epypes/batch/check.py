"""Does a graph still do on a labelled set what it must?"""

from __future__ import annotations

import base64
import enum
import math
import os
import re
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.cases import ABSENT, Case, Check, cases_of, checks_of, with_labels_read
from epypes.batch.executors import run_jobs
from epypes.batch.items import detached_runner, is_file, items_of, read_value
from epypes.batch.job import Job
from epypes.batch.metrics import METRICS
from epypes.batch.progress import progress_bar
from epypes.batch.results import ErrorInfo, Outcome, Thumbnail, object_column
from epypes.batch.thumbnails import LEGEND, pictures_of
from epypes.bundle.compare import first_difference
from epypes.bundle.hyperparameters import Member
from epypes.display.markup import content, escape, fitted
from epypes.errors import EpypesError, ScaleError, UnknownName
from epypes.graph import CompGraph
from epypes.optional import optional_import
from epypes.run import CompGraphRunner
from epypes.wording import counted

if TYPE_CHECKING:
    import os

    import pandas as pd


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


# More than a page shows; of thousands of cases the pictures would be most of the memory.
_MOST_PICTURED: Final = 200

Checks = Sequence[tuple[Case, tuple[Check, ...]]]


def check(
    runner: CompGraphRunner,
    cases: str | os.PathLike[str] | Iterable[Any],
    executor: Executor | None = None,
    *,
    progress: bool | None = None,
) -> CheckResult:
    """Run a labelled set and say which cases pass.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used; it is left as it is.
    cases
        ``ep.Case``s, dicts with the parts of one, or the path of a CASES.toml.
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
    found = prepared(runner, cases)
    outcomes: list[CheckOutcome] = []
    pictured: Counter[bool] = Counter()
    with progress_bar(progress, len(found), "check", unit="case") as advance:
        for of_case in checked(runner, found, executor):
            outcomes += (_bounded(outcome, pictured) for outcome in of_case)
            advance(1, int(not all(outcome.passed for outcome in of_case)))
    outcomes.sort(key=lambda outcome: outcome.number)
    return CheckResult(tuple(outcomes))


def _bounded(outcome: CheckOutcome, pictured: Counter[bool]) -> CheckOutcome:
    """Return an outcome, without its pictures if there are many of those that have passed, or that have not."""
    pictured[outcome.passed] += bool(outcome.pictures)
    return outcome if pictured[outcome.passed] <= _MOST_PICTURED else replace(outcome, pictures={})


def prepared(runner: CompGraphRunner, cases: Any) -> Checks:
    """Return cases with their checks.

    Raises
    ------
    ScaleError, UnknownName
        As ``check`` does.
    """
    return [(_with_members(case, runner), checks_of(case, runner.cg)) for case in cases_of(cases)]


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


def checked(
    runner: CompGraphRunner,
    cases: Checks,
    executor: Executor | None = None,
    *,
    has_pictures: bool = True,
    stop: threading.Event | None = None,
) -> Iterator[tuple[CheckOutcome, ...]]:
    """Give what came of the cases, case by case as they come.

    Parameters
    ----------
    runner, cases, executor
        As of ``check``; the cases with their checks.
    has_pictures
        Whether pictures are made of what is measured.
    stop
        Ends it in bounded time, once it is set.
    """
    jobs = _jobs(runner, cases, has_pictures=has_pictures)
    for outcomes in run_jobs(runner, jobs, executor, stop=stop):
        for outcome in outcomes:
            case, checks = cases[outcome.number]
            yield measured(outcome, case, checks, runner.cg)


def _jobs(runner: CompGraphRunner, cases: Checks, *, has_pictures: bool) -> Iterator[Job]:
    """Give a job per case, when it is asked for."""
    items = items_of([inputs_of(case) for case, _ in cases], runner)
    for item, (case, checks) in zip(items, cases, strict=True):
        looked_at = tuple(dict.fromkeys(check.token for check in checks if check.token is not None))
        keep = tuple(dict.fromkeys(token for check in checks for token in check.keep))
        named = replace(item, name=case.name or item.name)
        yield Job((named,), (dict(case.hyperparameters or {}),), keep, looked_at if has_pictures else ())


def inputs_of(case: Case) -> Any:
    """Return the inputs of a case as ``ep.map`` takes them: what names a file is its path."""
    if not isinstance(case.inputs, Mapping):
        return _input(case.inputs)
    return {token: _input(value) for token, value in case.inputs.items()}


def _input(value: Any) -> Any:
    return Path(value) if is_file(value) else value


@dataclass(frozen=True, slots=True, repr=False)
class CheckResult:
    """What came of a labelled set; true if all of it has passed.

    Attributes
    ----------
    outcomes
        Check by check, in the order of the cases.
    """

    outcomes: tuple[CheckOutcome, ...]

    @property
    def passed(self) -> bool:
        """Whether every check of every case has passed."""
        return all(outcome.passed for outcome in self.outcomes)

    @property
    def failures(self) -> tuple[CheckOutcome, ...]:
        """The checks that have not passed."""
        return tuple(outcome for outcome in self.outcomes if not outcome.passed)

    @property
    def cases(self) -> dict[str, bool]:
        """Whether each case has passed, by name."""
        found: dict[str, bool] = {}
        for outcome in self.outcomes:
            found[outcome.case] = found.get(outcome.case, True) and outcome.passed
        return found

    def to_frame(self) -> pd.DataFrame:
        """Return a pandas table with a row per check: case, check, token, value, threshold, passed, failure, run_ms."""
        rows = [
            {
                "case": outcome.case,
                "check": outcome.check,
                "token": outcome.token,
                "value": float("nan") if outcome.value is None else outcome.value,
                "threshold": outcome.threshold,
                "passed": outcome.passed,
                "failure": None,
                "run_ms": outcome.total_ns / 1e6,
            }
            for outcome in self.outcomes
        ]
        with optional_import():
            import pandas as pd
        frame = pd.DataFrame(rows)
        frame["failure"] = object_column([outcome.reason or None for outcome in self.outcomes])
        return frame

    def to_junit(self, path: str | os.PathLike[str], name: str = "epypes check") -> Path:
        """Write JUnit XML, as continuous integration reads it, and return its path.

        A case is a class, a check a test case; what could not be measured is an error, what falls short a failure.

        Raises
        ------
        ScaleError
            The file can't be written, or junitparser is missing.
        """
        return write_junit(Path(path), self.outcomes, name)

    def __bool__(self) -> bool:
        return self.passed

    def __len__(self) -> int:
        return len(self.outcomes)

    def __str__(self) -> str:
        cases = self.cases
        failed = [name for name, has_passed in cases.items() if not has_passed]
        if not failed:
            return f"{counted(len(cases), 'case')} passed"
        named = ", ".join(failed[:5])
        return f"{len(failed)} of {counted(len(cases), 'case')} failed: {named}{', ...' if len(failed) > 5 else ''}"

    def __repr__(self) -> str:
        cases = self.cases
        failed = sum(not passed for passed in cases.values())
        return f"<CheckResult: {counted(len(cases), 'case')}, {f'{failed} failed' if failed else 'all passed'}>"

    def _repr_html_(self) -> str:

        return check_html(self)


_MOST_ROWS: Final = 100
_MOST_PICTURE_BYTES: Final = 60_000
_CELL_ROOM: Final = 100
_REASON_ROOM: Final = 300
_PICTURES: Final = ("expected", "got", "difference")
_HEAD: Final = ("case", "check", "value", "must be", "passed", *_PICTURES)
_LEFT: Final = ' style="text-align:left"'
# Colours that are read on a white and on a black ground; the sign and the word say the same.
_PASSED: Final = '<span style="color:#2e8b57">✓</span> passed'
_FAILED: Final = '<b style="color:#d9482b">✗</b> <b>failed</b>'


def check_html(result: CheckResult) -> str:
    """Return a table with a row per check, those that have not passed first, of at most about 120 kB."""
    outcomes = sorted(result.outcomes, key=lambda outcome: outcome.passed)
    room = _MOST_PICTURE_BYTES
    rows = []
    for outcome in outcomes[:_MOST_ROWS]:
        row, room = _html_row(outcome, room)
        rows.append(row)
    has_pictures = [any(outcome.pictures.get(name) for outcome in outcomes[:_MOST_ROWS]) for name in _PICTURES]
    head = "".join(f"<th{_LEFT}>{name}</th>" for name in _shown(_HEAD, has_pictures))
    more = len(outcomes) - _MOST_ROWS
    body = "".join(
        f"<tr>{''.join(f'<td{_LEFT}>{cell}</td>' for cell in _shown(row, has_pictures))}</tr>" for row in rows
    )
    below = f"<tr><td{_LEFT}>and {counted(more, 'check')} more</td></tr>" if more > 0 else ""
    legend = f"<p>difference of masks: {LEGEND}</p>" if has_pictures[-1] else ""
    caption = content(fitted(str(result), _REASON_ROOM))
    return f"<table><caption{_LEFT}>{caption}</caption><tr>{head}</tr>{body}{below}</table>{legend}"


def _shown(cells: Sequence[str], has_pictures: Sequence[bool]) -> list[str]:
    """Return the cells of a row without the columns of pictures in which there is none."""
    first = len(cells) - len(_PICTURES)
    return [*cells[:first], *(cell for cell, is_there in zip(cells[first:], has_pictures, strict=True) if is_there)]


def _html_row(outcome: CheckOutcome, room: int) -> tuple[list[str], int]:
    """Return the cells of a check, and how many bytes of pictures there is still room for."""
    value = "" if outcome.value is None else f"{outcome.value:.6g}"
    verdict = _PASSED if outcome.passed else f"{_FAILED}<br>{content(fitted(outcome.reason, _REASON_ROOM))}"
    cells = [content(fitted(text, _CELL_ROOM)) for text in (outcome.case, outcome.check, value, outcome.threshold)]
    cells.append(verdict)
    for name in _PICTURES:
        picture = outcome.pictures.get(name)
        size = 0 if picture is None else len(picture.data) * 4 // 3
        if picture is None or size > room:
            cells.append("")
            continue
        room -= size
        about = f"{name} of {outcome.case}: {picture.caption}"
        data = base64.b64encode(picture.data).decode()
        cells.append(f'<img src="data:{picture.media_type};base64,{data}" alt="{escape(fitted(about, _CELL_ROOM))}">')
    return cells, room


# What XML 1.0 does not allow, in a name or in what an exception says, would make the whole file unreadable.
_NOT_XML: Final = re.compile("[^\\t\\n\\r\\x20-\\ud7ff\\ue000-\\ufffd\\U00010000-\\U0010ffff]")


def write_junit(path: Path, outcomes: Sequence[CheckOutcome], name: str) -> Path:
    """Write the checks as a file of JUnit XML, and return its path.

    Parameters
    ----------
    path
        The file; one that is there is replaced.
    outcomes
        The checks.
    name
        Of the suite.

    Raises
    ------
    ScaleError
        It can't be written.
    MissingPackage
        junitparser is missing.
    """
    with optional_import():
        import junitparser as junit
    suite = junit.TestSuite(_text(name))
    timed: set[int] = set()
    for outcome in outcomes:
        # The run of a case counts once, so that the sum is what the set has taken.
        is_first = outcome.number not in timed
        timed.add(outcome.number)
        suite.add_testcase(_test_case(junit, outcome, outcome.total_ns / 1e9 if is_first else 0.0))
    suite.update_statistics()
    document = junit.JUnitXml()
    document.add_testsuite(suite)
    document.update_statistics()
    try:
        document.write(str(path), pretty=True)
    except OSError as error:
        raise ScaleError(f"{str(path)!r} can't be written: {error.strerror}. Name another file.") from error
    return path


def check_place(path: Path) -> None:
    """Raise ScaleError if no JUnit XML can be written there, before what it is to tell of is run."""
    with optional_import():
        import junitparser  # noqa: F401 - missing here, rather than after all cases have run
    if path.is_dir():
        raise ScaleError(f"{str(path)!r} is a folder. Name a file in it.")
    if not path.parent.is_dir():
        folder = str(path.parent)
        raise ScaleError(f"{str(path)!r} can't be written: there is no folder {folder!r}. Make it, or name another.")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise ScaleError(f"{str(path)!r} can't be written: that is not allowed. Name another file.")


def _test_case(junit: Any, outcome: CheckOutcome, time_s: float) -> Any:
    test = junit.TestCase(_text(outcome.check), classname=_text(outcome.case), time=round(time_s, 6))
    if outcome.passed:
        return test
    is_error = outcome.error_info is not None
    kind = outcome.error_info.kind if outcome.error_info is not None else "threshold"
    problem = (junit.Error if is_error else junit.Failure)(_text(outcome.reason), _text(kind))
    problem.text = _text(_told(outcome))
    test.result = [problem]
    return test


def _told(outcome: CheckOutcome) -> str:
    value = "nothing measured" if outcome.value is None else f"measured {outcome.value!r}"
    wanted = f", wanted {outcome.threshold}" if outcome.threshold else ""
    return f"{outcome.case}: {outcome.check}: {outcome.reason}\n{value}{wanted}"


def _text(text: str) -> str:
    return _NOT_XML.sub("\ufffd", text)
