"""Cases of a labelled set: inputs, and the checks of what must come of them; in Python, or in a file, CASES.toml.

A check is a metric, of one token or of the whole run, with its bounds. The file:

::

    [[case]]
    name = "left"                        # without: the name of its first file, or its number
    inputs = {image = "left.png"}        # by free source token; a value alone is that of the one free source token;
                                         # of a graph with state a list of these, or a folder or glob of images
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
cases; other texts and numbers stand for themselves. So is a text in ``inputs`` that ends like the name of a video: each
of its frames is a case of its own, with the same checks. The metrics are ``equal``, ``close`` (``atol``, ``rtol``),
``iou`` (``boxes``), ``count`` (``of``), ``value``, ``mean_abs_difference`` and ``psnr`` (``data_range``): see
``epypes.batch.metrics``, whose options stand beside ``min`` and ``max``. Of label images, integers with more than one
value besides 0, ``iou`` is the mean over the objects, paired one with one; one that is left over on either side counts
0. A check may have a ``name``. A case without a check passes if it runs.
"""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.acquisition.files import is_video_name
from epypes.acquisition.video import Video, VideoFrame
from epypes.batch.items import (
    Item,
    VideoInput,
    defensive_copy,
    holds_its_arrays,
    is_file,
    is_one_image,
    items_of,
    only_token,
    opened,
    read_value,
)
from epypes.batch.metrics import METRICS
from epypes.batch.results import short_text
from epypes.bundle.settings import decode_value
from epypes.errors import EpypesError, InvalidValue, ScaleError, UnknownName
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.wording import ended

# The keys of a check, besides the options of its metric.
_CHECK_KEYS: Final = ("token", "metric", "expected", "min", "max", "keep")
_CASE_KEYS: Final = ("name", "inputs", "hyperparameters", "check")
_CASE_HEADER: Final = re.compile(r"^[ \t]*\[\[[ \t]*case[ \t]*\]\]", re.MULTILINE)
_NAME_CHARACTERS: Final = 80
_VALUE_CHARACTERS: Final = 60
# Stands for a value that was not given, since None is a value.
ABSENT: Final = object()


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """One requirement of a case.

    Attributes
    ----------
    name
        The name in tables: ``"iou of edges"``.
    token
        The token whose value is measured; None: the metric is given the whole run, and the case.
    metric
        The name of a built-in metric, or a function.
    expected
        What the value is compared with: a value, or the path of its file; ABSENT if there is nothing.
    at_least, at_most
        The smallest and the largest number that passes; None where there is no bound.
    options
        The options of the metric.
    keep
        The tokens that the metric needs the values of.
    is_of_case
        Without a token: whether the one token of the case's ``expected`` is measured, rather than the one sink token.
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
        """The bounds as text: ``at least 0.9``; empty if the metric itself returns true or false."""
        bounds = (("at least", self.at_least), ("at most", self.at_most))
        return ", ".join(f"{label} {bound:g}" for label, bound in bounds if bound is not None)


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One case of a labelled set.

    Attributes
    ----------
    inputs
        By free source token: a value, or the path of its file; a text is a path if it ends like an image, ``.npy`` or
        ``.npz`` and there is such a file. A value that is no mapping is that of the one free source token. A video, or
        the path of one, stands for a case per frame, each with the same checks. Of a graph with state (``ep.delay``) a
        case is a sequence: of these, a folder or glob of images, or a video. They are run one after another from the
        initial state, and what the last one gives is measured; if one fails, the case has failed. What is to count over
        all of them is a token with state itself, such as a sum. One image is a series of one.
    expected
        By token: the value that it must have, or the path of a file that holds it (an image, ``.npy`` or ``.npz``);
        a text with such an ending is a path. Where no function and no metric that compares looks at a token, it must
        be equal to it.
    metrics
        By name, the requirements; see below.
    name
        Its name in tables; without, that of its file, or its number.
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
        A metric has no threshold, or is not given in one of these ways.
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
        if self.name is not None and not isinstance(self.name, str):
            raise ScaleError(f"The name of a case is a text, not {self.name!r:.60}.")
        for part in ("expected", "metrics", "hyperparameters"):
            given = getattr(self, part)
            if given is not None and not isinstance(given, Mapping):
                raise ScaleError(f"{part} of {self} must be a dict, not {type(given).__name__!r}.")
        for name, spec in (self.metrics or {}).items():
            _check(self, name, spec)

    def __str__(self) -> str:
        return f"case {self.name!r:.{_NAME_CHARACTERS}}" if self.name else "a case"

    def __repr__(self) -> str:
        compared = _compared(_check(self, name, spec) for name, spec in (self.metrics or {}).items())
        number = len(self.metrics or ()) + sum(token not in compared for token in self.expected or ())
        name = "" if self.name is None else f" {self.name!r:.{_NAME_CHARACTERS}}"
        return f"<Case{name}: {number} check{'s' * (number != 1)}>"


def cases_of(given: Any, *, are_series: bool = False) -> tuple[Case, ...]:
    """Return cases, each with a name that no other has.

    Parameters
    ----------
    given
        The path of a CASES.toml; an iterable of cases, of dicts with a case's parts, or of inputs alone; or a video, or
        the path of one, of which each frame is a case. A case with a video becomes one per frame.
    are_series
        Whether the graph has state, so that the inputs of a case are a sequence: a video is one case.

    Raises
    ------
    ScaleError
        There is none, or one is not a case; or of a graph with state, one is an image alone.
    ImageFileError
        A video can't be opened.
    """
    is_path = isinstance(given, str | os.PathLike)
    if isinstance(given, Video) or (is_path and is_video_name(Path(given))):
        given = [given]
    if is_path and not isinstance(given, list):
        found = _read_file(Path(given), are_series)
    elif isinstance(given, Case | Mapping | bytes | bytearray) or not isinstance(given, Iterable):
        raise ScaleError(
            f"cases is a list of cases or the path of a file of them, not a single {type(given).__name__!r}."
        )
    elif holds_its_arrays(given):
        found = [_case(item, are_series) for item in given]
    else:
        found = [_copied(_case(item, are_series)) for item in given]
    if not found:
        raise ScaleError("There are no cases. Give at least one: ep.Case(inputs, expected={...}).")
    if not are_series:
        found = [one for case in found for one in _by_frame(case)]
    taken: dict[str, int] = {}
    return tuple(
        replace(case, name=_unique(case.name or _file_name(case.inputs) or f"#{number}", taken))
        for number, case in enumerate(found)
    )


def _by_frame(case: Case) -> Iterator[Case]:
    """Yield a case, or, of one with a video, a case for each frame."""
    given = opened(case.inputs)
    if not isinstance(given, VideoInput):
        yield case
        return
    for inputs in given:
        frame = next(value for value in _values(inputs) if isinstance(value, VideoFrame))
        yield replace(case, inputs=inputs, name=f"{case.name} #{frame.number}" if case.name else frame.name)


def case_items(cases: Sequence[Case], runner: CompGraphRunner) -> Iterator[Item]:
    """Yield an item for each case of ``cases_of``, with its name: of a graph with state, a series of its own.

    Raises
    ------
    ScaleError
        An item does not give the free source tokens, or a sequence is empty.
    """
    if not runner.state:
        items = items_of([case.inputs for case in cases], runner)
        yield from (replace(item, name=case.name or "") for item, case in zip(items, cases, strict=True))
        return
    for number, case in enumerate(cases):
        given, name = case.inputs, case.name or ""
        if isinstance(given, str | os.PathLike) and not is_one_image(given):
            only_token(runner.free_source_tokens, f"{str(given)!r} gives one image at a time")
            yield Item(number, name, {}, frames=os.path.abspath(Path(given).expanduser()))
        else:
            is_payload = is_one_image(given) or isinstance(given, Mapping)
            try:
                frames = tuple(items_of([given] if is_payload else given, runner))
            except ScaleError as error:
                raise ScaleError(f"The inputs of {case}: {error}") from error
            yield Item(number, name, {}, frames=frames)


def checks_of(case: Case, cg: CompGraph) -> tuple[Check, ...]:
    """Return the checks of a case, each with its token.

    Raises
    ------
    UnknownName
        The graph has no such token.
    ScaleError
        A metric does not name its token, and there are several.
    """
    expected = dict(case.expected or {})
    for token in expected:
        cg.require_token(token)
    checks = [_resolved(_check(case, name, spec), case, cg) for name, spec in (case.metrics or {}).items()]
    compared = _compared(checks)
    alone = [
        Check(f"equal of {token}", token, "equal", wanted, METRICS["equal"].least, keep=(token,))
        for token, wanted in expected.items()
        if token not in compared
    ]
    return (*alone, *checks)


def with_labels_read(case: Case, cg: CompGraph) -> Case:
    """Return a case with the content of files in place of their paths in ``expected``.

    Raises
    ------
    ScaleError, ImageFileError
        A file can't be read.
    """
    read = {token: read_value(value, cg, token) for token, value in (case.expected or {}).items()}
    return replace(case, expected=read or case.expected)


def _case(item: Any, is_series: bool) -> Case:
    if isinstance(item, Case):
        return item
    parts = {part.name for part in fields(Case)}
    if isinstance(item, Mapping) and "inputs" in item and parts.issuperset(item):
        return Case(**item)
    if is_series and is_one_image(item):
        raise ScaleError(
            f"The graph has state between runs, so a case is a sequence of images, and {short_text(item)} is a single "
            "one. For one series of them all write [[...]]; for a case of one image ep.Case(image)."
        )
    return Case(item)


def _copied(case: Case) -> Case:
    """Return a case that stays as it is when a generator fills its arrays for the next one."""
    return replace(case, inputs=defensive_copy(case.inputs), expected=defensive_copy(case.expected))


def _file_name(inputs: Any) -> str:
    return next((PurePath(value).name for value in _values(inputs) if is_file(value)), "")


def _values(inputs: Any) -> Iterable[Any]:
    return inputs.values() if isinstance(inputs, Mapping) else (inputs,)


def _unique(name: str, taken: dict[str, int]) -> str:
    """Return a name, numbered if it is taken, and take it."""
    unique = name
    while unique in taken:
        taken[name] += 1
        unique = f"{name} ({taken[name]})"
    taken[unique] = 1
    return unique


# -- checks -----------------------------------------------------------------------------------------------------


def _compares(metric: str | Callable[..., Any]) -> bool:
    return callable(metric) or METRICS[metric].compares


def _compared(checks: Iterable[Check]) -> frozenset[Any]:
    """Return the tokens whose values are compared with expected ones, or given to a function with them."""
    return frozenset(check.token for check in checks if _compares(check.metric))


def _check(case: Case, name: str, spec: Any) -> Check:
    """Return the check of an entry of ``metrics``; its token may still be missing."""
    given = _as_mapping(case, name, spec)
    metric = given.get("metric", name)
    if not callable(metric) and (not isinstance(metric, str) or metric not in METRICS):
        raise UnknownName("metric", metric, METRICS, f"for {case}")
    built_in = None if callable(metric) else METRICS[metric]
    allowed = (*_CHECK_KEYS, *(built_in.options if built_in else ()))
    for key in given:
        if key not in allowed:
            raise UnknownName("key", key, allowed, f"for metric {name!r} of {case}")
    expected = given.get("expected", ABSENT)
    if expected is not ABSENT and not _compares(metric):
        raise ScaleError(
            f"Metric {name!r} of {case} compares nothing: {metric!r} takes no expected. Leave it out, or take a metric "
            f"that compares: {', '.join(known for known in METRICS if METRICS[known].compares)}."
        )
    at_least, at_most = (_bound(case, name, key, given.get(key)) for key in ("min", "max"))
    if at_least is None and at_most is None and built_in is not None:
        at_least = built_in.least
        if at_least is None:
            raise ScaleError(f"Metric {name!r} of {case} has no threshold. Give min, max or both.")
    if at_least is not None and at_most is not None and at_least > at_most:
        raise ScaleError(f"Metric {name!r} of {case} has min {at_least:g}, which is more than max {at_most:g}.")
    keep = given.get("keep", ())
    return Check(
        name,
        given.get("token"),
        metric,
        expected,
        at_least,
        at_most,
        options={key: value for key, value in given.items() if key not in _CHECK_KEYS},
        keep=(keep,) if isinstance(keep, str) else tuple(keep),
        is_of_case="token" not in given and built_in is not None and built_in.compares and expected is ABSENT,
    )


def _as_mapping(case: Case, name: str, spec: Any) -> Mapping[str, Any]:
    """Return an entry of ``metrics`` in its longest form."""
    if isinstance(spec, Mapping):
        return spec
    if callable(spec):
        return {"metric": spec}
    if isinstance(spec, tuple | list) and len(spec) == 2:
        return {"min": spec[0], "max": spec[1]}
    if not _is_number(spec):
        raise ScaleError(
            f"Metric {name!r} of {case} is a {type(spec).__name__!r}. Give a number, a pair (least, most), a function, "
            "or a dict with 'min' or 'max'."
        )
    better = METRICS[name].better if name in METRICS else "greater"
    if better is None:
        raise ScaleError(f"Metric {name!r} of {case} needs a pair (least, most), since neither end is better.")
    return {"max" if better == "less" else "min": spec}


def _bound(case: Case, name: str, key: str, bound: Any) -> float | None:
    if bound is not None and (not _is_number(bound) or math.isnan(bound)):
        raise ScaleError(f"{key} of metric {name!r} of {case} is {bound!r:.40}, which is no number.")
    return None if bound is None else float(bound)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _resolved(check: Check, case: Case, cg: CompGraph) -> Check:
    """Return a check with its token, its expected value, and a name with both metric and token."""
    if check.token is None and callable(check.metric):
        for kept in check.keep:
            cg.require_token(kept)
        return replace(check, keep=tuple(dict.fromkeys((*cg.sink_tokens, *check.keep))))
    token = check.token
    if token is None:
        tokens = tuple(case.expected) if check.is_of_case and case.expected else cg.sink_tokens
        if len(tokens) != 1:
            among = ", ".join(map(repr, tokens))
            raise ScaleError(
                f"Metric {check.name!r} of {case} does not say which token it looks at. Give token, one of: {among}."
            )
        [token] = tokens
    cg.require_token(token)
    expected = check.expected if check.expected is not ABSENT else (case.expected or {}).get(token, ABSENT)
    if expected is ABSENT and not callable(check.metric) and _compares(check.metric):
        raise ScaleError(f"Metric {check.name!r} of {case} has nothing to compare {token!r} with. Give it expected.")
    name = f"{check.name} of {token}" if check.name in METRICS else check.name
    return replace(check, token=token, expected=expected, name=name, keep=(token,))


# -- CASES.toml -------------------------------------------------------------------------------------------------


def _read_file(path: Path, are_series: bool) -> list[Case]:
    """Return the cases in a file, in their order; no file that they name is read.

    Raises
    ------
    ScaleError
        The file can't be read, or holds something else than cases; with every reason.
    """
    if path.is_dir():
        text = f"{str(path)!r} is a folder. Give the path of a CASES.toml, or a list of cases that say what is expected"
        raise ScaleError(f"{text}: [ep.Case('{path.name}/a.png', expected={{...}}), ...].")
    try:
        text = path.read_text(encoding="utf-8-sig")
        document = tomllib.loads(text)
    except FileNotFoundError as error:
        raise ScaleError(f"There is no file {str(path)!r}. Check the path.") from error
    except tomllib.TOMLDecodeError as error:
        raise ScaleError(f"{path} is not TOML: {error}.") from error
    except (OSError, ValueError, RecursionError) as error:  # also bytes that are no text
        raise ScaleError(f"{str(path)!r} can't be read: {getattr(error, 'strerror', None) or error}.") from error
    reasons = [str(UnknownName("key", key, ("case",), f"in {path.name}")) for key in document if key != "case"]
    tables = document.get("case")
    if not (isinstance(tables, list) and tables and all(isinstance(table, dict) for table in tables)):
        reasons.append(f"{path} has no cases. Write one: [[case]] with inputs and [[case.check]].")
        raise ScaleError(" ".join(reasons))
    headers = [text.count("\n", 0, match.start()) + 1 for match in _CASE_HEADER.finditer(text)]
    # There are none if the cases are written as an inline array.
    lines = headers if len(headers) == len(tables) else [1] * len(tables)
    cases = []
    for table, line in zip(tables, lines, strict=True):
        try:
            cases.append(_case_of_table(table, path.parent, are_series))
        except (EpypesError, ValueError) as error:
            reasons.append(f"{path.name}, line {line}: {error}")
    if reasons:
        raise ScaleError(" ".join(reasons))
    return cases


def _case_of_table(table: Mapping[str, Any], folder: Path, is_series: bool) -> Case:
    name, checks = table.get("name"), table.get("check", [])
    where = f"in case {name!r:.{_VALUE_CHARACTERS}}" if name else "in this case"
    for key in table:
        if key not in _CASE_KEYS:
            raise UnknownName("key", key, _CASE_KEYS, where)
    if "inputs" not in table:
        raise InvalidValue(f'There are no inputs {where}. Write: inputs = {{image = "a.png"}}.')
    if not (isinstance(checks, list) and all(isinstance(check, Mapping) for check in checks)):
        raise InvalidValue(f"The checks {where} are tables: [[case.check]].")
    metrics: dict[str, Any] = {}
    expected: dict[str, Any] = {}
    taken: dict[str, int] = {}
    for check in checks:
        # Without a token it is the one sink token, whatever other checks of the case expect.
        spec = {"token": None, "metric": "equal" if "expected" in check else "value", **check}
        token = spec["token"]
        if "expected" in spec:
            spec["expected"] = _in_folder(spec["expected"], folder)
            if token is not None:
                expected.setdefault(token, spec["expected"])
        label = str(spec.pop("name", spec["metric"] if token is None else f"{spec['metric']} of {token}"))
        metrics[_unique(label, taken)] = spec
    values = table.get("hyperparameters")
    if isinstance(values, Mapping):
        values = {token: _hyperparameter(token, entry) for token, entry in values.items()}
    given = table["inputs"]
    inputs = _series_in_folder(given, folder) if is_series else _in_folder(given, folder, has_videos=True)
    return Case(inputs, expected, metrics, name, values)


def _in_folder(value: Any, folder: Path, *, has_videos: bool = False) -> Any:
    """Return the path of what names a file, relative to that of the cases, by token too; any other value as it is."""
    if isinstance(value, Mapping):
        return {token: _in_folder(item, folder, has_videos=has_videos) for token, item in value.items()}
    names_video = has_videos and isinstance(value, str) and is_video_name(Path(value))
    return folder / Path(value).expanduser() if names_video or is_file(value) else value


def _series_in_folder(inputs: Any, folder: Path) -> Any:
    """Return the inputs of a case of a graph with state, with the paths of files, of a folder or of a glob."""
    if isinstance(inputs, list):
        return [_in_folder(item, folder, has_videos=True) for item in inputs]
    is_path = isinstance(inputs, str) and (not is_one_image(inputs) or (folder / inputs).is_dir())
    return folder / inputs if is_path else _in_folder(inputs, folder, has_videos=True)


def _hyperparameter(token: str, entry: Any) -> Any:
    """Return a value as pipeline.toml has it: what has no counterpart in TOML is a table with its kind."""
    if not isinstance(entry, Mapping):
        return entry
    try:
        return decode_value(entry)
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise InvalidValue(
            f"Hyperparameter {token!r} can't be read: {ended(str(error))} Write it as in pipeline.toml, such as "
            '{value = [3, 5], kind = "tuple"}.'
        ) from error
