"""The result of a run: its tokens, its times, its failure."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import NotComputed, StaleToken, UnknownName
from epypes.graph import CompGraph, redefined
from epypes.nothing import Nothing
from epypes.rich_display import mimebundle
from epypes.run.failure import Failure
from epypes.run.guard import READ_AS_STORED, lend, lend_to_reader
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.plan import wanted_steps
from epypes.run.program import Program, StateSlots
from epypes.run.staleness import NOT_COMPUTED, NestedRun, TokenManager
from epypes.run.timing import RunReport, Times
from epypes.wording import counted

if TYPE_CHECKING:
    from weakref import ref


# The state of a runner when a trial began: the runner's key, its hyperparameters, its last run, and what the next run
# would have begun with. The last run is not kept alive, since a run's memory is that of its images.
TrialOf = tuple[object, Hyperparameters, "ref[Run] | None", tuple[Any, ...]]


class TokenMapping(Mapping[str, Any]):
    """What is read by token and shows itself; compared by identity, since values may be arrays."""

    __slots__ = ()
    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return mimebundle(self)


class Run(TokenMapping):
    """A run that has ended: a mapping from tokens to values, which does not change any more.

    Reading a token that was not computed raises NotComputed; iterating gives those that were. Arrays are read-only:
    draw on a copy, ``run["edges"].copy()``. A payload array is not copied: if its owner fills it again, the run and its
    picture show what is in it then.

    Attributes
    ----------
    tokens
        The token store.
    hparams
        The hyperparameters with their versions.
    times
        What ``report`` is made of.
    trial_of
        Of a trial, the state of its runner when it began.
    """

    # What can be made of these is made when it is read: to record a run takes a good part of what EPypes adds to its
    # functions.
    __slots__ = ("__weakref__", "_failure", "hparams", "times", "tokens", "trial_of")
    trial_of: TrialOf

    def __init__(self, tokens: TokenManager, hparams: Hyperparameters, times: Times, failure: Failure | None) -> None:
        self.tokens, self.hparams, self.times, self._failure = tokens, hparams, times, failure

    @property
    def report(self) -> RunReport:
        """The times of the run."""
        return RunReport(*self.times)

    @property
    def failure(self) -> Failure | None:
        """None, or the function that failed; the tokens that were computed before keep their values."""
        return self._failure

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        """The values that the run was computed with."""
        return self.hparams.values

    @property
    def first_hyperparameters(self) -> Mapping[str, Any]:
        """The values that they had when they were made or frozen, by token."""
        return self.hparams.first_values

    @property
    def revision(self) -> int:
        """The runner's count of hyperparameter changes when the run began."""
        return self.hparams.revision

    @property
    def state(self) -> Mapping[str, Any]:
        """What the next run begins with, by delayed token; see ``ep.delay``.

        Of a failed run, and where nothing was found, it is what the run began with.
        """
        return readable_state(self.tokens.program, self.state_after())

    @property
    def state_before(self) -> Mapping[str, Any]:
        """What the run began with, by delayed token; ``runner.trial`` takes it to repeat the run on its payload."""
        values, program = self.tokens.values, self.tokens.program
        return readable_state(program, [values[slots.before] for slots in program.states])

    def state_after(self) -> tuple[Any, ...]:
        """Return the values of ``state`` as they are stored, in the order of the program's states."""
        values, program, wanted, failure = self.tokens.values, self.tokens.program, self.times[1], self._failure
        needed = wanted_steps(program, values, ()) if program.switches else None

        def value_after(slots: StateSlots) -> Any:
            after, maker = values[slots.after], program.makers[slots.after]
            # A rerun that chose another branch still has the value of the run before.
            is_left_out = needed is not None and maker >= 0 and not needed[maker] and not (wanted and wanted[maker])
            # Of a rerun for other targets the value may be stale: it is still what the frame has left.
            is_kept = failure or is_left_out or after is NOT_COMPUTED or after is Nothing
            return values[slots.before] if is_kept else after

        return tuple(map(value_after, program.states))

    @property
    def nested(self) -> Mapping[str, Run]:
        """The runs of the pipelines in the graph, by function: ``run.nested["geometry"]["inliers"]``.

        Of a function that failed, the run that failed. A pipeline that makes its own runs otherwise has none.
        """
        program, values = self.tokens.program, self.tokens.values
        failed = self._failure.function if self._failure is not None else ""
        found = {
            name: values[nested.run]
            for name, nested in program.nested.items()
            if name == failed or any(map(self.tokens.is_computed, program.cg.func_outputs(name)))
        }
        return MappingProxyType({name: kept.run for name, kept in found.items() if type(kept) is NestedRun})

    @property
    def cg(self) -> CompGraph:
        """The graph that was run."""
        return self.tokens.program.cg

    def __getitem__(self, token: str) -> Any:
        tokens = self.tokens
        program = tokens.program
        # Of a run that is whole every token has a value, and none is out of date.
        slot = program.slots.get(token)
        if slot is not None and tokens.has_payload and 1 not in tokens.dirty:
            value = tokens.values[slot]
            return value if type(value) in READ_AS_STORED or not program.guard else lend(value)
        if slot is None and (inside := self._place_inside(token)):
            advice = f" What is inside a pipeline is in its run: {inside}."
            raise UnknownName("token", token, self.cg.tokens, advice=advice)
        try:
            return tokens.read(token)
        except StaleToken:
            raise
        except NotComputed as error:
            if self.failure is None:
                raise
            text = f"Token {token!r} has not been computed, since {self.failure}."
            raise NotComputed(token, text) from error

    def _place_inside(self, token: object) -> str:
        """Return the expression for a token of a nested pipeline; empty if none has it."""
        for function, nested in self.tokens.program.nested.items():
            name = str(token).removeprefix(f"{function}__")
            if nested.runner.cg.has_token(name):
                return f"run.nested[{function!r}][{name!r}]"
        return ""

    def __iter__(self) -> Iterator[str]:
        tokens = self.tokens
        return (token for token in self.cg.tokens if tokens.is_readable(token))

    def __repr__(self) -> str:
        state = f"failed in {self.failure.function!r:.30}" if self.failure else "completed"
        redefinitions = len(redefined(self.cg))
        old = f"; {counted(redefinitions, 'function')} redefined" * bool(redefinitions)
        return f"<Run: {state}; {len(self)} of {len(self.cg.tokens)} tokens{old}>"


def readable_state(program: Program, values: Sequence[Any]) -> Mapping[str, Any]:
    """Return values in the order of the program's states as the user reads them, by key; those that are there."""
    known = {slots.key: value for slots, value in zip(program.states, values, strict=True) if value is not NOT_COMPUTED}
    return MappingProxyType({key: lend_to_reader(value) if program.guard else value for key, value in known.items()})


# Half the time of Run(...).
new_run: Final[Callable[[], Run]] = partial(object.__new__, Run)


class RunImporter:
    """Makes Runs of one graph from the values, times and failure of runs that another process executed.

    Parameters
    ----------
    cg
        The graph; its functions are not called.
    """

    def __init__(self, cg: CompGraph) -> None:
        self._program = Program(cg, True)

    def run(
        self,
        tokens: Mapping[str, Any],
        hyperparameters: Mapping[str, Any],
        *,
        first_hyperparameters: Mapping[str, Any] | None = None,
        revision: int = 0,
        durations_ns: Mapping[str, int] | None = None,
        total_ns: int = 0,
        failure: Failure | None = None,
    ) -> Run:
        """Return a run in which these tokens are computed and up to date, and all others are not computed.

        Parameters
        ----------
        tokens
            Values by token; what is no token of the graph is left out.
        hyperparameters, first_hyperparameters
            Their values in this run, and when they were frozen.
        revision
            Of the hyperparameters.
        durations_ns
            Nanoseconds by function.
        total_ns
            Of the whole run.
        failure
            Of the function that failed, if one did.
        """
        program, first = self._program, first_hyperparameters or {}
        known = [(token, value) for token, value in hyperparameters.items() if token in program.settable]
        entries = {token: (value, first.get(token, value)) for token, value in known}
        hparams = Hyperparameters(program, entries, revision)
        stored = hparams.tokens({}, [NOT_COMPUTED] * len(program.states))
        # No function is out of date; but not every token has a value, so the run must not be taken for a whole one.
        stored.dirty, stored.has_payload = program.no_steps, False
        for token, value in tokens.items():
            if token in program.slots and token not in entries:
                stored.values[program.slots[token]] = value
        durations_ns = durations_ns or {}
        by_step = {step.place: durations_ns[step.name] for step in program.steps if step.name in durations_ns}
        failed_at = next((step.place for step in program.steps if failure and step.name == failure.function), -1)
        skipped = tuple(self._skip(stored.values, by_step))
        times = (program, None, by_step, total_ns, False, failed_at, skipped)
        return Run(stored, hparams, times, failure)

    def _skip(self, slots: list[Any], ran: Container[int]) -> Iterator[int]:
        """Give the steps that were skipped, as far as the tokens say, whose outputs become Nothing."""
        program = self._program
        for step in program.steps:
            seen = [slots[slot] is Nothing for slot in (*program.required_by(step, slots), *step.outputs)]
            if step.place not in ran and any(seen):
                program.has_skipped = True
                for slot in step.outputs:
                    slots[slot] = Nothing
                yield step.place
