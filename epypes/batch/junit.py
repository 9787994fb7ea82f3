"""How does continuous integration read what came of a labelled set?

As JUnit XML: one suite, in which a case is a class and each of its checks a test case.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from epypes.batch.measuring import CheckOutcome
from epypes.errors import ScaleError
from epypes.optional import optional_import

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
