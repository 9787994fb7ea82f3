"""Is a search that is in a store the same one, so that it may go on?"""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from epypes.batch.cache import NoDigest, combined_digest, graph_fingerprint, payload_digest, value_digest
from epypes.batch.items import Item
from epypes.batch.ranging import Axis, Choices
from epypes.batch.scoring import Scoring
from epypes.bundle import to_source
from epypes.errors import EpypesError, PlaceholderNeeded, ScaleError, SourceRefused
from epypes.run import CompGraphRunner

GRAPH: Final = "graph"
METRIC: Final = "metric"
_PYTHON: Final = "Python"


def about_search(
    runner: CompGraphRunner, axes: Sequence[Axis], scoring: Scoring, items: Sequence[Item], *, is_named: bool
) -> dict[str, str]:
    """Return digests of all that decides about the trials of a search, by what they are of.

    Parameters
    ----------
    runner
        Its graph and the hyperparameters that do not vary.
    axes
        What varies.
    scoring
        The metric and the cases.
    items
        What goes into the cases.
    is_named
        Whether the user tells searches apart by a name; what has no digest has "" then.

    Raises
    ------
    ScaleError
        Something has no digest, and the search no name.
    """
    varied = {axis.token for axis in axes}
    fixed = {token: value for token, value in runner.hyperparameters.items() if token not in varied}
    choices = {axis.token: axis.values for axis in axes if isinstance(axis, Choices)}
    labels = [(case.name, case.expected, case.hyperparameters) for case in scoring.cases]
    ways: dict[str, Callable[[], str]] = {
        GRAPH: lambda: _graph_digest(runner, is_named),
        "hyperparameters": lambda: value_digest(fixed),
        "choices": lambda: value_digest(choices),
        METRIC: scoring.digest,
        "inputs of the cases": lambda: value_digest([(item.name, payload_digest(item.payload)) for item in items]),
        "labels of the cases": lambda: value_digest(
            [[part if part is None or isinstance(part, str) else dict(part) for part in label] for label in labels]
        ),
    }
    found = {_PYTHON: ".".join(platform.python_version_tuple()[:2])}
    for what, way in ways.items():
        try:
            found[what] = way()
        except (EpypesError, NoDigest) as error:
            if not is_named:
                text = f"What is searched has no name for the store. Nothing tells its {what} from others: {error}"
                raise ScaleError(f"{text}.\nGive one: name='...'.") from error
            found[what] = ""
    return found


def _graph_digest(runner: CompGraphRunner, is_named: bool) -> str:
    try:
        source = to_source(runner.cg)
    except (SourceRefused, PlaceholderNeeded):
        if not is_named:
            raise
        source = None
    found = graph_fingerprint(runner.cg, source)
    if found.unknown:
        raise NoDigest(found.unknown)
    return combined_digest("graph", found.code, found.state).hex()


def name_of(metric: str, direction: str, axes: Sequence[Axis], about: Mapping[str, str]) -> str:
    """Return what a search is called in a store if the user does not say: a digest of what it computes."""
    said = [axis.labels if isinstance(axis, Choices) else repr(axis) for axis in axes]
    digest = combined_digest("search", repr((direction, [axis.token for axis in axes], said, sorted(about.items()))))
    return f"optimize {metric} {digest.hex()[:12]}"


def changed_meanwhile(runner: CompGraphRunner, scoring: Scoring, about: Mapping[str, str]) -> list[str]:
    """Return what is another one now than before the search, as a function is that takes notes in a list."""
    ways = {GRAPH: lambda: _graph_digest(runner, True), METRIC: scoring.digest}
    return [what for what, way in ways.items() if about.get(what) and _or_none(way) != about[what]]


def _or_none(way: Callable[[], str]) -> str | None:
    try:
        return way()
    except (EpypesError, NoDigest):
        return None


def changed_in(before: Mapping[str, str], about: Mapping[str, str]) -> str:
    """Return what is another one than before, in words; "" if nothing is, as far as that can be told."""
    # Another Python has other code for the same function.
    untold = {_PYTHON} if before.get(_PYTHON) == about.get(_PYTHON) else {_PYTHON, METRIC}
    changed = [what for what in about if what not in untold and before.get(what) and about[what]]
    changed = [what for what in changed if before[what] != about[what]]
    return f"other {' and '.join(changed)}" if changed else ""
