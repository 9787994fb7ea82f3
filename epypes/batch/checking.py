"""Does a graph still do on a labelled set what it must?"""

from __future__ import annotations

import enum
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.cases import Case, Check, cases_of, checks_of
from epypes.batch.executors import run_jobs
from epypes.batch.items import detached_runner, is_file, items_of
from epypes.batch.job import Job
from epypes.batch.measuring import CheckOutcome, measured
from epypes.batch.progress import progress_bar
from epypes.batch.results import object_column
from epypes.bundle.entries import Member
from epypes.errors import UnknownName
from epypes.optional import optional_import
from epypes.run import CompGraphRunner
from epypes.wording import counted

if TYPE_CHECKING:
    import os

    import pandas as pd

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
    return [(_placed(case, runner), checks_of(case, runner.cg)) for case in cases_of(cases)]


def _placed(case: Case, runner: CompGraphRunner) -> Case:
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
        from epypes.batch.junit import write_junit

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
        from epypes.batch.checkshown import check_html

        return check_html(self)
