"""Values of a service's runs, fetched over HTTP, as Runs that a panel shows."""

from __future__ import annotations

import inspect
from collections import Counter, OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from types import GenericAlias
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

from epypes.bundle.adapters import in_order
from epypes.bundle.settings import decode_value
from epypes.catalog import plain
from epypes.errors import EpypesError, RemoteFailure, ServiceError
from epypes.graph import CompGraph, colour_order, delay, subgraph
from epypes.hints import Param
from epypes.images import Image, Order
from epypes.run import Failure, Run
from epypes.run.result import RunImporter
from epypes.service.parameters import Parameters

if TYPE_CHECKING:
    from epypes.service.remote.connection import Connection
    from epypes.wire import Envelope

_MAX_VALUES: Final = 1_000
_MAX_REVISIONS: Final = 64
# After so many refusals a token is not requested any more: no codec knows it, or it is too large.
_MAX_REFUSALS: Final = 3
_MAX_NAME_CHARACTERS: Final = 100
_MAX_SHOWN_RUNS: Final = 32
_MAX_SHOWN_BYTES: Final = 128 * 1024**2
_PARAM_KEYS: Final = tuple(field.name for field in fields(Param))
_TUPLES: Final = ("soft", "choices", "labels")


# -- the graph --------------------------------------------------------------------------------------------------------


def remote_graph(
    url: str,
    func_io: Mapping[str, Sequence[Any]],
    entries: Mapping[str, Mapping[str, Any]],
    orders: Mapping[str, Order],
    states: Mapping[str, str],
) -> CompGraph:
    """Return the graph of a service, whose functions say where they run when they are called here.

    Parameters
    ----------
    url
        The service's address.
    func_io
        As JSON has it: lists are tuples.
    entries
        Of the hyperparameters, by token: their ranges become annotations.
    orders
        The orders of colours by token, where a function of the service says them.
    states
        By key of the state between events, the token that is delayed.

    Raises
    ------
    GraphError
        This is no graph.
    """
    hints: dict[str, Any] = {token: Annotated[Any, Image(order=order)] for token, order in orders.items()}
    for token, entry in entries.items():
        known: dict[str, Any] = {
            key: tuple(entry[key]) if key in _TUPLES else entry[key]
            for key in _PARAM_KEYS
            if entry.get(key) is not None
        }
        with suppress(ValueError, TypeError):  # a range that contradicts itself
            if known:
                hints[token] = Annotated[Any, Param(**known)]
    io: dict[str, Any] = {name: (_as_tuple(taken), _as_tuple(made)) for name, (taken, made) in func_io.items()}
    functions = {name: RemoteFunction(url, name, taken, made, hints) for name, (taken, made) in io.items()}
    cg = CompGraph(functions, io, types=False)
    for previous, token in states.items():
        # Those of nested pipelines are no tokens of this graph.
        if cg.has_token(previous) and cg.has_token(token):
            cg = delay(cg, token, previous)
    return cg


def _as_tuple(side: Any) -> Any:
    return tuple(side) if isinstance(side, list) else side


class RemoteFunction:
    """A function of a service: it declares in its signature what is known of its tokens, and can't be called here."""

    def __init__(self, url: str, name: str, inputs: Any, outputs: Any, hints: Mapping[str, Any]) -> None:
        taken = () if inputs is None else (inputs,) if isinstance(inputs, str) else inputs
        made: Any = hints.get(outputs, Any)
        if isinstance(outputs, tuple):
            made = GenericAlias(tuple, tuple(hints.get(token, Any) for token in outputs)) if outputs else Any
        annotations = {f"input_{place}": hints.get(token, Any) for place, token in enumerate(taken)}
        kind = inspect.Parameter.POSITIONAL_ONLY
        parameters = [inspect.Parameter(each, kind, annotation=hint) for each, hint in annotations.items()]
        self._url, self.__name__ = url, name
        self.__annotations__ = {**annotations, "return": made}
        self.__signature__ = inspect.Signature(parameters, return_annotation=made)

    def __call__(self, *values: Any) -> NoReturn:
        """Raise ServiceError."""
        text = f"Function {self.__name__!r} runs in the service at {self._url}, not here."
        raise ServiceError(self._url, f"{text} Load its bundle to run it: ep.load(...).")


# -- runs -------------------------------------------------------------------------------------------------------------


class RemoteRuns:
    """Fetches runs of a service.

    Parameters
    ----------
    connection
        To the service.
    cg
        Its graph.
    first
        Its hyperparameters when the connection was made.
    outputs
        The tokens that are fetched in any case.
    """

    def __init__(self, connection: Connection, cg: CompGraph, first: Parameters, outputs: Sequence[str] = ()) -> None:
        self._connection, self._cg, self._outputs = connection, cg, tuple(outputs)
        self._importer = RunImporter(cg)
        self._values: dict[tuple[str, str], Any] = {}
        self._by_revision: dict[int, dict[str, Any]] = {}
        self._refusals: Counter[str] = Counter()
        self._images: set[str] = set()
        self._rgb = [token for token in cg.tokens if colour_order(cg, token) == "rgb"]
        self._first = self.values(first)

    def values(self, parameters: Parameters) -> dict[str, Any]:
        """Return the hyperparameters by token; equal values are one object, by which a panel sees changes."""
        found = {}
        for token, entry in parameters.entries.items():
            value = decode_value(entry)
            if len(self._values) >= _MAX_VALUES:
                self._values.clear()
            found[token] = self._values.setdefault((token, _key(value)), value)
        if len(self._by_revision) >= _MAX_REVISIONS:
            del self._by_revision[next(iter(self._by_revision))]
        self._by_revision[parameters.revision] = found
        return found

    def is_same(self, parameters: Parameters, token: str, value: Any) -> bool:
        """Whether a hyperparameter has this value."""
        entry = parameters.entries.get(token)
        return entry is not None and _key(decode_value(entry)) == _key(value)

    def fetch(self, targets: Sequence[str], parameters: Parameters) -> Run:
        """Return the last run with these hyperparameters or later ones; of the tokens, what the targets need.

        Raises
        ------
        NotComputed
            The service has not worked on an event yet.
        ServiceError
            It is gone.
        """
        tokens = self._needed(targets)
        try:
            envelopes = [self._connection.envelope(tokens, parameters.revision)] if tokens else []
        except EpypesError as error:
            # The service names a function that failed as "canny: ValueError: ...".
            function, _, rest = str(error).partition(": ")
            exception, _, message = rest.partition(": ")
            if function in self._cg.functions and exception.isidentifier():
                record = {"function": function, "exception": exception, "message": message}
                return self._run({}, parameters, failure=self._failure(record))
            envelopes = self._fetch_one_by_one(tokens, parameters.revision)
        from epypes.display import is_image

        parts = {name: value for each in envelopes for name, value in in_order(each, self._rgb).items()}
        self._images.update(token for token, value in parts.items() if is_image(value))
        return self._run(parts, parameters, envelopes[0] if envelopes else None)

    def failed(self, last: Run, record: Mapping[str, Any], parameters: Parameters) -> Run:
        """Return a run that failed: the failure, and the tokens of the last run that do not depend on it.

        Parameters
        ----------
        last
            The last run that completed.
        record
            As ``FailedEvent``, JSON-ready.
        parameters
            The hyperparameters.
        """
        failure = self._failure(record)
        lost: set[str] = set()
        for name in self._cg.digraph.run_order():
            if name == failure.function or lost.intersection(self._cg.func_inputs(name)):
                lost.update(self._cg.func_outputs(name))
        return self._run({token: last[token] for token in last if token not in lost}, parameters, failure=failure)

    def _needed(self, targets: Sequence[str]) -> list[str]:
        """Return the tokens to fetch: marks are drawn over the images that they were made from."""
        wanted = dict.fromkeys((*targets, *self._outputs) if targets else self._cg.tokens)
        for target in targets:
            if target not in self._images:
                wanted.update(dict.fromkeys(subgraph(self._cg, target).tokens))
        return [token for token in wanted if self._refusals[token] < _MAX_REFUSALS and token not in self._first]

    def _fetch_one_by_one(self, tokens: Sequence[str], revision: int) -> list[Envelope]:
        """Fetch what can be, token by token; the refusal of the first one is raised, since it may be that of all."""
        found = [self._connection.envelope(tokens[:1], revision)]
        for token in tokens[1:]:
            try:
                found.append(self._connection.envelope([token], revision))
            except EpypesError:
                self._refusals[token] += 1
        # An event may have come in between, and a run has the values of one.
        return [envelope for envelope in found if envelope.correlation_id == found[-1].correlation_id]

    def _run(
        self,
        parts: Mapping[str, Any],
        parameters: Parameters,
        envelope: Envelope | None = None,
        failure: Failure | None = None,
    ) -> Run:
        revision = parameters.revision if envelope is None else envelope.revision
        values = self._by_revision.get(revision) or self.values(parameters)
        timings = {} if envelope is None else envelope.timings
        total_ns = None if envelope is None else envelope.attributes.get("total_ns")
        return self._importer.run(
            parts,
            values,
            first_hyperparameters=self._first,
            revision=revision,
            durations_ns=timings,
            total_ns=sum(timings.values()) if total_ns is None else int(total_ns),
            failure=failure,
        )

    def _failure(self, record: Mapping[str, Any]) -> Failure:
        function, message = str(record.get("function", "")), str(record.get("message", ""))
        tokens = tuple(map(str, record.get("tokens") or ()))
        # A service may name an exception with any text.
        kind = str(record.get("exception") or record.get("kind") or "failed")[:_MAX_NAME_CHARACTERS]
        # The exception is shown by the name and text that it has in the service.
        raised: type[RemoteFailure] = type(kind, (RemoteFailure,), {"__str__": lambda error: error.message})
        exception = raised(self._connection.url, function, kind, message)
        return Failure(function, tokens, {}, exception, str(record.get("event_id", "")))


class ShownRuns:
    """The last run for each setting of the hyperparameters that was shown; the run with the first one is kept.

    A service does not run on other values on the side: a panel can compare only with what was shown.
    """

    def __init__(self) -> None:
        self._runs: OrderedDict[str, tuple[Run, int]] = OrderedDict()
        self._first = ""

    def add(self, run: Run) -> None:
        """Add a run, and drop the oldest of too many."""
        key = _setting(run.hyperparameters)
        self._first = self._first or key
        before = self._runs.pop(key, None)
        # The first picture is what "default" means: later runs with its values are those of other frames.
        is_kept = before is not None and key == self._first and set(run) <= set(before[0])
        size = sum(int(getattr(value, "nbytes", 0)) for value in run.values())
        self._runs[key] = before if before is not None and is_kept else (run, size)
        while len(self._runs) > _MAX_SHOWN_RUNS or sum(size for _, size in self._runs.values()) > _MAX_SHOWN_BYTES:
            oldest = next((each for each in self._runs if each not in (self._first, key)), None)
            if oldest is None:
                break
            del self._runs[oldest]

    def find(self, values: Mapping[str, Any]) -> Run | None:
        """Return the run with these values; None if none was shown."""
        found = self._runs.get(_setting(values))
        return None if found is None else found[0]


def _setting(values: Mapping[str, Any]) -> str:
    return repr(sorted(values.items()))


def _key(value: Any) -> str:
    """Return text that differs for values of hyperparameters that differ: 1, 1.0 and True are three."""
    known = plain(value)
    return f"{type(known).__name__} {known!r}"
