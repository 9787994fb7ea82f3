"""How does a labelled set stand in a file, CASES.toml?

::

    [[case]]
    name = "left"                        # without: the name of its first file, or its number
    inputs = {image = "left.png"}        # by free source token; a value alone is that of the one free source token
    hyperparameters = {canny_lo = 90}    # values that differ from the bundle's in this case

    [[case.check]]
    token = "edges"                      # whose value is measured; without: the one sink token
    expected = "left_edges.png"          # what it is compared with: a value, or an image, .npy or .npz; not of count
                                         # and value, which compare nothing
    metric = "iou"                       # without: equal if there is something expected, else value
    min = 0.9                            # the least that passes; of equal and close 1 without min and max
    max = 1.0                            # the most that passes

    [[case.check]]
    token = "points"
    metric = "count"
    min = 100
    max = 300

A text that ends like the name of an image, of ``.npy`` or of ``.npz`` is a file, whose path is relative to that of the
cases; other texts and numbers stand for themselves. The metrics are ``equal``, ``close`` (``atol``, ``rtol``), ``iou``
(``boxes``), ``count`` (``of``), ``value``, ``mean_abs_difference`` and ``psnr`` (``data_range``): see
``epypes.batch.metrics``, whose options stand beside ``min`` and ``max``. Of label images, integers with more than one
value besides 0, ``iou`` is the mean over the objects, paired one with one; one that is left over on either side counts
0. A check may have a ``name``. A case without a check passes if it runs.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from epypes.batch.cases import SINK, Case
from epypes.batch.items import is_file
from epypes.bundle.entries import read
from epypes.errors import EpypesError, ScaleError, UnknownName
from epypes.wording import ended

_CASE_KEYS: Final = ("name", "inputs", "hyperparameters", "check")
_HEADER: Final = re.compile(r"^[ \t]*\[\[[ \t]*case[ \t]*\]\]", re.MULTILINE)
_SHOWN: Final = 60


def read_cases(path: Path) -> list[Case]:
    """Return the cases in a file, in their order; no file that they name is read.

    Raises
    ------
    ScaleError
        The file can't be read, or says something else than cases; with every reason.
    """
    text, document = _document(path)
    reasons = [str(error) for error in _unknown(document, ("case",), f"in {path.name}")]
    tables = document.get("case")
    if not (isinstance(tables, list) and tables and all(isinstance(table, dict) for table in tables)):
        reasons.append(f"{path} has no cases. Write one: [[case]] with inputs and [[case.check]].")
        raise ScaleError(" ".join(reasons))
    cases = []
    for table, line in zip(tables, _lines(text, len(tables)), strict=True):
        try:
            cases.append(_case(table, path.parent))
        except (EpypesError, ValueError) as error:
            reasons.append(f"{path.name}, line {line}: {error}")
    if reasons:
        raise ScaleError(" ".join(reasons))
    return cases


def _document(path: Path) -> tuple[str, dict[str, Any]]:
    if path.is_dir():
        text = f"{str(path)!r} is a folder. Give the path of a CASES.toml, or a list of cases that say what is expected"
        raise ScaleError(f"{text}: [ep.Case('{path.name}/a.png', expected={{...}}), ...].")
    try:
        text = path.read_text(encoding="utf-8-sig")
        return text, tomllib.loads(text)
    except FileNotFoundError as error:
        raise ScaleError(f"There is no file {str(path)!r}. Check the path.") from error
    except tomllib.TOMLDecodeError as error:
        raise ScaleError(f"{path} is not TOML: {error}.") from error
    except (OSError, ValueError, RecursionError) as error:  # also bytes that are no text
        said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ScaleError(f"{str(path)!r} can't be read: {said}.") from error


def _lines(text: str, count: int) -> list[int]:
    """Return the line at which each case begins; cases that are written as an inline array begin at the first line."""
    found = [text.count("\n", 0, match.start()) + 1 for match in _HEADER.finditer(text)]
    return found if len(found) == count else [1] * count


def _unknown(table: Mapping[str, Any], known: tuple[str, ...], where: str) -> Iterator[UnknownName]:
    for key in table:
        if key not in known:
            yield UnknownName("key", key, known, where)


# -- a case -----------------------------------------------------------------------------------------------------


def _case(table: Mapping[str, Any], folder: Path) -> Case:
    name = table.get("name")
    where = f"in case {name!r:.{_SHOWN}}" if name else "in this case"
    for error in _unknown(table, _CASE_KEYS, where):
        raise error
    if name is not None and not isinstance(name, str):
        raise ValueError(f"The name of a case is a text, not {name!r:.{_SHOWN}}.")
    if "inputs" not in table:
        raise ValueError(f'There are no inputs {where}. Write: inputs = {{image = "a.png"}}.')
    metrics, expected = _checks(table.get("check", []), folder, where)
    hyperparameters = _table(table.get("hyperparameters", {}), "hyperparameters", where)
    values = {token: _hyperparameter(token, entry) for token, entry in hyperparameters.items()}
    return Case(_inputs(table["inputs"], folder), expected, metrics, name, values)


def _inputs(given: Any, folder: Path) -> Any:
    if isinstance(given, Mapping):
        return {token: _value(value, folder) for token, value in given.items()}
    return _value(given, folder)


def _hyperparameter(token: str, entry: Any) -> Any:
    """Return a value as pipeline.toml has it: what TOML has none like is a table with its kind."""
    if not isinstance(entry, Mapping):
        return entry
    try:
        return read(entry)
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise ValueError(
            f"Hyperparameter {token!r} can't be read: {ended(str(error))} Write it as in pipeline.toml, such as "
            '{value = [3, 5], kind = "tuple"}.'
        ) from error


def _value(value: Any, folder: Path) -> Any:
    return folder / Path(value).expanduser() if is_file(value) else value


def _table(given: Any, key: str, where: str) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        raise ValueError(f"{key} {where} is a table, not {given!r:.{_SHOWN}}.")
    return given


# -- its checks -------------------------------------------------------------------------------------------------


def _checks(given: Any, folder: Path, where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the metrics of a case by name, and what is expected by token."""
    if not (isinstance(given, list) and all(isinstance(table, Mapping) for table in given)):
        raise ValueError(f"The checks {where} are tables: [[case.check]].")
    metrics: dict[str, Any] = {}
    expected: dict[str, Any] = {}
    for table in given:
        spec = {key: _value(value, folder) if key == "expected" else value for key, value in table.items()}
        spec.setdefault("metric", "equal" if "expected" in spec else "value")
        label = _label(spec, metrics)
        metrics[label] = {"token": SINK, **spec}
        if "expected" in spec and "token" in spec:
            expected.setdefault(spec["token"], spec["expected"])
    return metrics, expected


def _label(spec: dict[str, Any], taken: Mapping[str, Any]) -> str:
    """Take the name of a check out of it, or make one that no other check of the case has."""
    token = spec.get("token")
    name = str(spec.pop("name", spec["metric"] if token is None else f"{spec['metric']} of {token}"))
    number = next(
        number for number in range(1, len(taken) + 2) if (name if number == 1 else f"{name} ({number})") not in taken
    )
    return name if number == 1 else f"{name} ({number})"
