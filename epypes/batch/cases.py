"""What is one case of a labelled set: what goes in, and what must come out?

A case is inputs with checks. A check is a metric, of one token or of the whole run, and how large or small it must be.
"""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.batch.items import defensive_copy, holds_its_arrays, is_file, read_value
from epypes.batch.metrics import METRICS, Metric
from epypes.bundle.hyperparameters import read
from epypes.errors import EpypesError, ScaleError, UnknownName
from epypes.graph import CompGraph
from epypes.wording import ended

# What a threshold spec may say besides the options of its metric.
SPEC_KEYS: Final = ("token", "metric", "expected", "min", "max", "keep")
_CASE_CHARACTERS: Final = 80


class _Absent:
    """Stands for what was not given; None is a value."""

    def __repr__(self) -> str:
        return "absent"


ABSENT: Final = _Absent()


class _SinkToken:
    """Stands for the one sink token, which only the graph knows."""

    def __repr__(self) -> str:
        return "the sink token"


SINK: Final = _SinkToken()


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """One thing that must be so in a case.

    Attributes
    ----------
    name
        What it is called in tables: ``"iou of edges"``.
    token
        The token whose value is measured; None: the metric is given the whole run, and the case.
    metric
        The name of a built-in metric, or a function.
    expected
        What the value is compared with: a value, or the path of its file; ABSENT if there is nothing.
    at_least, at_most
        The smallest and the largest number that passes; None where there is no bound.
    options
        Of the metric.
    keep
        The tokens that the metric needs the values of.
    is_of_case
        Without a token: whether it may be the one that the case expects something of, not the one sink token.
    """

    name: str
    token: str | None
    metric: str | Callable[..., Any]
    expected: Any = field(default=ABSENT, repr=False)
    at_least: float | None = None
    at_most: float | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    keep: tuple[str, ...] = ()
    is_of_case: bool = False

    @property
    def threshold(self) -> str:
        """What must be so, in words: ``at least 0.9``; empty if the metric itself says true or false."""
        bounds = ((self.at_least, "at least"), (self.at_most, "at most"))
        return ", ".join(f"{word} {bound:g}" for bound, word in bounds if bound is not None)


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One case of a labelled set.

    Attributes
    ----------
    inputs
        By free source token: a value, or the path of its file; a text is a path if it ends like an image, ``.npy`` or
        ``.npz`` and there is such a file. A value that is no mapping is that of the one free source token.
    expected
        By token: the value that it must have, or the path of a file that holds it (an image, ``.npy`` or ``.npz``);
        a text with such an ending is a path. Where no function and no metric that compares looks at a token, it must
        be equal to it.
    metrics
        By name, what must be so; see below.
    name
        What it is called; without, its file is, or its number.
    hyperparameters
        Values that differ from the runner's in this case.

    Notes
    -----
    An entry of ``metrics`` is named like a built-in metric (``equal``, ``close``, ``iou``, ``count``, ``value``,
    ``mean_abs_difference``, ``psnr``), or as you like if it says ``metric``. It is one of:

    - a number: the least that passes, where more is better (``iou=0.9``); the most, where less is
      (``mean_abs_difference=2.0``);
    - a pair ``(least, most)``;
    - a function, which must return True;
    - a dict with ``min``, ``max`` or both, and if need be ``token``, ``metric``, ``expected``, ``keep`` and options of
      the metric: ``{"token": "points", "min": 100}``. ``count`` and ``value`` compare nothing and take no
      ``expected``.

    ``iou`` compares masks as a whole, but of label images (integers with more than one value besides 0) object by
    object: it is the mean over the objects, paired one with one, where one that is left over on either side counts 0.

    Without ``token`` a metric that compares looks at the one token of the case's ``expected``, any other one, and one
    with an ``expected`` of its own, at the one sink token. A function is called as ``metric(value, expected)`` if there
    is a ``token`` (``expected`` is None if nothing is), else as ``metric(run, case)``: a dict of the sink tokens'
    values, and of those that ``keep`` names, and this case with the files of ``expected`` read. It returns a number, or
    True or False if there is no threshold.

    Raises
    ------
    ScaleError
        What must be so is not said, or not in these words.
    UnknownName
        There is no such metric, or no such option.

    Examples
    --------
    >>> case = Case("coins.png", metrics={"count": {"token": "coins", "min": 24, "max": 24}}, name="coins")
    >>> case
    <Case 'coins': 1 check>
    """

    inputs: Any
    expected: Mapping[str, Any] | None = None
    metrics: Mapping[str, Any] | None = None
    name: str | None = None
    hyperparameters: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        for part in ("expected", "metrics", "hyperparameters"):
            given = getattr(self, part)
            if given is not None and not isinstance(given, Mapping):
                raise ScaleError(f"{part} of {self} must be a dict, not {type(given).__name__!r}.")
        for name, spec in (self.metrics or {}).items():
            _check(self, name, spec)

    def __str__(self) -> str:
        return f"case {self.name!r:.{_CASE_CHARACTERS}}" if self.name else "a case"

    def __repr__(self) -> str:
        looked_at = _looked_at(_check(self, name, spec) for name, spec in (self.metrics or {}).items())
        number = len(self.metrics or ()) + sum(token not in looked_at for token in self.expected or ())
        name = "" if self.name is None else f" {self.name!r:.{_CASE_CHARACTERS}}"
        return f"<Case{name}: {number} check{'s' * (number != 1)}>"


def cases_of(given: Any) -> tuple[Case, ...]:
    """Return cases with names, whatever they were given as.

    Parameters
    ----------
    given
        The path of a CASES.toml, or an iterable of cases, of dicts with a case's parts, or of inputs alone.

    Raises
    ------
    ScaleError
        There is none, or one is not a case.
    """
    if isinstance(given, str | os.PathLike):
        return _named(read_cases(Path(given)))
    if isinstance(given, Case | Mapping) or not isinstance(given, Iterable):
        raise ScaleError(
            f"cases is a list of cases or the path of a file of them, not a single {type(given).__name__!r}."
        )
    cases = map(_case, given)
    found = _named(list(cases if holds_its_arrays(given) else map(_lasting, cases)))
    if not found:
        raise ScaleError("There are no cases. Give at least one: ep.Case(inputs, expected={...}).")
    return found


def checks_of(case: Case, cg: CompGraph) -> tuple[Check, ...]:
    """Return what must be so in a case, each with its token.

    Raises
    ------
    UnknownName
        The graph has no such token.
    ScaleError
        Which token is meant is not said.
    """
    expected = dict(case.expected or {})
    for token in expected:
        cg.require_token(token)
    checks = [_placed(_check(case, name, spec), case, cg) for name, spec in (case.metrics or {}).items()]
    looked_at = _looked_at(checks)
    alone = [
        Check(f"equal of {token}", token, "equal", wanted, METRICS["equal"].least, keep=(token,))
        for token, wanted in expected.items()
        if token not in looked_at
    ]
    return (*alone, *checks)


def with_labels_read(case: Case, cg: CompGraph) -> Case:
    """Return a case whose expected values are no paths any more but what stands in their files.

    Raises
    ------
    ScaleError, ImageFileError
        A file can't be read.
    """
    read = {token: read_value(value, cg, token) for token, value in (case.expected or {}).items()}
    return replace(case, expected=read or case.expected)


# -- cases ------------------------------------------------------------------------------------------------------


def _lasting(case: Case) -> Case:
    """Return a case that stays as it is when whoever gave it fills its arrays for the next one."""
    return replace(case, inputs=defensive_copy(case.inputs), expected=defensive_copy(case.expected))


def _case(item: Any) -> Case:
    if isinstance(item, Case):
        return item
    parts = {part.name for part in fields(Case)}
    if isinstance(item, Mapping) and "inputs" in item and parts.issuperset(item):
        return Case(**item)
    return Case(item)


def _named(cases: Iterable[Case]) -> tuple[Case, ...]:
    """Return the cases with a name each, which no other has."""
    taken: dict[str, int] = {}
    named = []
    for number, case in enumerate(cases):
        name = case.name or _file_name(case.inputs) or f"#{number}"
        taken[name] = taken.get(name, 0) + 1
        named.append(replace(case, name=name if taken[name] == 1 else f"{name} ({taken[name]})"))
    return tuple(named)


def _file_name(inputs: Any) -> str:
    values = inputs.values() if isinstance(inputs, Mapping) else (inputs,)
    return next((PurePath(value).name for value in values if is_file(value)), "")


# -- checks -----------------------------------------------------------------------------------------------------


def _looked_at(checks: Iterable[Check]) -> frozenset[Any]:
    """Return the tokens whose values are compared with what is expected of them, or given to a function with it."""
    return frozenset(check.token for check in checks if _takes_expected(check.metric))


def _takes_expected(metric: str | Callable[..., Any]) -> bool:
    return callable(metric) or METRICS[metric].compares


def _check(case: Case, name: str, spec: Any) -> Check:
    """Return what an entry of ``metrics`` asks for; its token may still be missing."""
    given = _spelled_out(case, name, spec)
    metric = given.get("metric", name)
    built_in = _built_in(case, metric)
    allowed = (*SPEC_KEYS, *(built_in.options if built_in else ()))
    for key in given:
        if key not in allowed:
            raise UnknownName("key", key, allowed, f"for metric {name!r} of {case}")
    if "expected" in given and not _takes_expected(metric):
        raise ScaleError(
            f"Metric {name!r} of {case} compares nothing: {metric!r} takes no expected. Leave it out, or take a metric "
            f"that compares: {', '.join(known for known in METRICS if METRICS[known].compares)}."
        )
    at_least, at_most = (_bound(case, name, given, key) for key in ("min", "max"))
    if at_least is None and at_most is None and built_in is not None:
        at_least = built_in.least
        if at_least is None:
            raise ScaleError(f"Metric {name!r} of {case} has no threshold. Give min, max or both.")
    if at_least is not None and at_most is not None and at_least > at_most:
        raise ScaleError(f"Metric {name!r} of {case} has min {at_least:g}, which is more than max {at_most:g}.")
    options = {key: value for key, value in given.items() if key not in SPEC_KEYS}
    expected, keep = given.get("expected", ABSENT), given.get("keep", ())
    keep = (keep,) if isinstance(keep, str) else tuple(keep)
    token = given.get("token")
    is_of_case = token is None and built_in is not None and built_in.compares and expected is ABSENT
    token = None if token is SINK else token
    return Check(name, token, metric, expected, at_least, at_most, options, keep, is_of_case)


def _spelled_out(case: Case, name: str, spec: Any) -> Mapping[str, Any]:
    if isinstance(spec, Mapping):
        return spec
    if callable(spec):
        return {"metric": spec}
    if isinstance(spec, tuple | list) and len(spec) == 2:
        return {key: bound for key, bound in zip(("min", "max"), spec, strict=True) if bound is not None}
    if not _is_number(spec):
        raise ScaleError(
            f"Metric {name!r} of {case} is a {type(spec).__name__!r}. Give a number, a pair (least, most), a function, "
            "or a dict with 'min' or 'max'."
        )
    better = METRICS[name].better if name in METRICS else None
    if name in METRICS and better is None:
        raise ScaleError(f"Metric {name!r} of {case} needs a pair (least, most), since neither end is better.")
    return {"max" if better == "less" else "min": spec}


def _built_in(case: Case, metric: Any) -> Metric | None:
    if callable(metric):
        return None
    if not isinstance(metric, str) or metric not in METRICS:
        raise UnknownName("metric", metric, METRICS, f"for {case}")
    return METRICS[metric]


def _bound(case: Case, name: str, given: Mapping[str, Any], key: str) -> float | None:
    bound = given.get(key)
    if bound is not None and (not _is_number(bound) or math.isnan(bound)):
        raise ScaleError(f"{key} of metric {name!r} of {case} is {bound!r:.40}, which is no number.")
    return None if bound is None else float(bound)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _placed(check: Check, case: Case, cg: CompGraph) -> Check:
    """Return a check with its token, with what is expected of it and with a name that says both."""
    if check.token is None and callable(check.metric):
        for kept in check.keep:
            cg.require_token(kept)
        return replace(check, keep=tuple(dict.fromkeys((*cg.sink_tokens, *check.keep))))
    token = check.token if check.token is not None else _meant(check, case, cg)
    cg.require_token(token)
    expected = check.expected if check.expected is not ABSENT else (case.expected or {}).get(token, ABSENT)
    if expected is ABSENT and not callable(check.metric) and _takes_expected(check.metric):
        raise ScaleError(f"Metric {check.name!r} of {case} has nothing to compare {token!r} with. Give it expected.")
    name = f"{check.name} of {token}" if check.name in METRICS else check.name
    return replace(check, token=token, expected=expected, name=name, keep=(token,))


def _meant(check: Check, case: Case, cg: CompGraph) -> str:
    tokens = tuple(case.expected) if check.is_of_case and case.expected else cg.sink_tokens
    if len(tokens) == 1:
        return tokens[0]
    among = ", ".join(map(repr, tokens))
    raise ScaleError(
        f"Metric {check.name!r} of {case} does not say which token it looks at. Give token, one of: {among}."
    )


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
            cases.append(_case_of_table(table, path.parent))
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


def _case_of_table(table: Mapping[str, Any], folder: Path) -> Case:
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
        return {token: _file_or_value(value, folder) for token, value in given.items()}
    return _file_or_value(given, folder)


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


def _file_or_value(value: Any, folder: Path) -> Any:
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
        spec = {key: _file_or_value(value, folder) if key == "expected" else value for key, value in table.items()}
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
