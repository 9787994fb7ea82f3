"""How does what a service sends of a run become a Run here?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from epypes.bundle.entries import plain, read
from epypes.bundle.ports import in_order
from epypes.errors import EpypesError, RemoteFailure
from epypes.graph import colour_order
from epypes.run import Failure, Run
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.program import Program
from epypes.run.tokens import NOT_COMPUTED, Freshness
from epypes.service.parameters import Parameters

if TYPE_CHECKING:
    from epypes.service.remote.connection import Connection
    from epypes.wire import Envelope

_MOST_VALUES: Final = 1_000
_MOST_REVISIONS: Final = 64
_MOST_REFUSALS: Final = 3
# An exception's name may be anybody's text.
_NAME_CHARACTERS: Final = 100


class RemoteRuns:
    """Fetches runs of a service.

    Parameters
    ----------
    connection
        To the service.
    program
        Its graph.
    first
        Its hyperparameters when it was connected to.
    outputs
        The tokens that are fetched in any case.
    """

    def __init__(
        self, connection: Connection, program: Program, first: Parameters, outputs: Sequence[str] = ()
    ) -> None:
        self._connection, self._program, self._outputs = connection, program, tuple(outputs)
        self._values: dict[tuple[str, str], Any] = {}
        self._by_revision: dict[int, Mapping[str, Any]] = {}
        # What no codec knows, or is too large, is not asked for all the time.
        self._refused: Counter[str] = Counter()
        self._images: set[str] = set()
        self._rgb = [token for token in program.cg.tokens if colour_order(program.cg, token) == "rgb"]
        self._first = self.values(first)

    # -- hyperparameters ----------------------------------------------------------------------------------------

    def values(self, parameters: Parameters) -> dict[str, Any]:
        """Return the values by token; an equal one is the same object each time, as a panel expects it."""
        found = {token: self._value(token, entry) for token, entry in parameters.entries.items()}
        if len(self._by_revision) >= _MOST_REVISIONS:
            del self._by_revision[next(iter(self._by_revision))]
        self._by_revision[parameters.revision] = found
        return found

    def is_same(self, parameters: Parameters, token: str, value: Any) -> bool:
        """Whether a hyperparameter has this value."""
        entry = parameters.entries.get(token)
        return entry is not None and _key(read(entry)) == _key(value)

    def _value(self, token: str, entry: Mapping[str, Any]) -> Any:
        value = read(entry)
        if len(self._values) >= _MOST_VALUES:
            self._values.clear()
        return self._values.setdefault((token, _key(value)), value)

    # -- runs ---------------------------------------------------------------------------------------------------

    def fetched(self, targets: Sequence[str], parameters: Parameters) -> Run:
        """Return the last run with these hyperparameters or later ones; of the tokens, what the targets need.

        Raises
        ------
        NotComputed
            The service has not worked on an event yet.
        ServiceError
            It is gone.
        """
        asked = self._needed(targets)
        try:
            envelopes = [self._connection.envelope(asked, parameters.revision)] if asked else []
        except EpypesError as error:
            failure = self._failure_told(str(error))
            if failure is not None:
                return self._run({}, parameters, failure=failure)
            envelopes = self._one_by_one(asked, parameters.revision)
        return self._run(self._parts(envelopes), parameters, envelopes[0] if envelopes else None)

    def failed(self, last: Run, record: Mapping[str, Any], parameters: Parameters) -> Run:
        """Return what is known of an event that failed: its failure, and the tokens of the last run before it.

        Parameters
        ----------
        last
            The last run that completed.
        record
            As ``FailureRecord``, JSON-ready.
        parameters
            The hyperparameters.
        """
        failure = self._failure(record)
        places = [step.place for step in self._program.steps if step.name == failure.function]
        lost = {
            slot
            for place in self._program.downstream(places, last.record[0])
            for slot in self._program.steps[place].outputs
        }
        tokens = self._program.tokens
        parts = {tokens[slot]: value for slot, value in enumerate(last.record[0]) if slot not in lost}
        return self._run(parts, parameters, failure=failure)

    def _needed(self, targets: Sequence[str]) -> list[str]:
        """Return the tokens to fetch: marks are drawn over the images that they were made from."""
        wanted = dict.fromkeys((*targets, *self._outputs) if targets else self._program.cg.tokens)
        for target in targets:
            if target not in self._images:
                wanted.update(dict.fromkeys(self._ancestors(target)))
        return [token for token in wanted if self._refused[token] < _MOST_REFUSALS and token not in self._first]

    def _ancestors(self, token: str) -> Iterable[str]:
        seen, waiting = {token}, [token]
        digraph = self._program.cg.digraph
        while waiting:
            maker = digraph.producer.get(waiting.pop())
            for name in () if maker is None else (*digraph.inputs[maker], *digraph.outputs[maker]):
                if name not in seen:
                    seen.add(name)
                    waiting.append(name)
                    yield name

    def _one_by_one(self, tokens: Sequence[str], revision: int) -> list[Envelope]:
        """Fetch what can be, token by token; raise what the first one is refused with, since that may be the rest's."""
        found = [self._connection.envelope(tokens[:1], revision)]
        for token in tokens[1:]:
            try:
                found.append(self._connection.envelope([token], revision))
            except EpypesError:
                self._refused[token] += 1
        # An event may have come in between, and a run has the values of one.
        return [envelope for envelope in found if envelope.correlation_id == found[-1].correlation_id]

    def _parts(self, envelopes: Iterable[Envelope]) -> dict[str, Any]:
        from epypes.display import is_image

        parts = {name: value for envelope in envelopes for name, value in in_order(envelope, self._rgb).items()}
        self._images.update(token for token, value in parts.items() if is_image(value))
        return parts

    def _run(
        self,
        parts: Mapping[str, Any],
        parameters: Parameters,
        sent: Envelope | None = None,
        *,
        failure: Failure | None = None,
    ) -> Run:
        program = self._program
        revision = parameters.revision if sent is None else sent.revision
        values = self._by_revision.get(revision) or self.values(parameters)
        slots = [NOT_COMPUTED] * len(program.tokens)
        for token, value in {**parts, **values}.items():
            if token in program.slots:
                slots[program.slots[token]] = value
        entries = {token: (value, self._first.get(token, value)) for token, value in values.items()}
        # Every function is up to date; but not every token has come, so that a run must not be taken for a whole one.
        freshness = Freshness(program, bytes(len(program.steps)), False, program.revisions())
        timings = {} if sent is None else sent.timings
        durations_ns = {step.place: timings[step.name] for step in program.steps if step.name in timings}
        total_ns = sum(durations_ns.values())
        if sent is not None:
            total_ns = int(sent.attributes.get("total_ns", total_ns))
        at = next((step.place for step in program.steps if failure and step.name == failure.function), -1)
        times = (program, None, durations_ns, total_ns, False, at)
        return Run((slots, freshness, Hyperparameters(program, entries, revision), times, failure))

    # -- failures -----------------------------------------------------------------------------------------------

    def _failure_told(self, text: str) -> Failure | None:
        """Return the failure that a refusal tells of, as ``"canny: ValueError: ..."``."""
        function, _, rest = text.partition(": ")
        exception, _, message = rest.partition(": ")
        if function not in self._program.cg.functions or not exception.isidentifier():
            return None
        return self._failure({"function": function, "exception": exception, "message": message})

    def _failure(self, record: Mapping[str, Any]) -> Failure:
        function, message = str(record.get("function", "")), str(record.get("message", ""))
        tokens = tuple(map(str, record.get("tokens") or ()))
        kind = str(record.get("exception") or record.get("kind") or "failed")[:_NAME_CHARACTERS]
        # It is shown as if it had been raised here, by the name that it has there.
        raised: type[RemoteFailure] = type(kind, (RemoteFailure,), {"__str__": lambda error: error.message})
        exception = raised(self._connection.url, function, kind, message)
        return Failure(function, tokens, {}, exception, str(record.get("event_id", "")))


def _key(value: Any) -> str:
    """Return what tells values of hyperparameters apart: 1, 1.0 and True are three."""
    known = plain(value)
    return f"{type(known).__name__} {known!r}"
