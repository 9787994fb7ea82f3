"""The runner of a graph: run, tune, run again."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from threading import get_ident
from time import perf_counter_ns
from typing import Any, Final
from weakref import ref

from epypes.deprecation import OldNames, takes_old_keywords
from epypes.errors import (
    InvalidType,
    InvalidValue,
    NotComputed,
    PayloadError,
    StaleToken,
    UnknownName,
    require_mapping,
    run_call,
)
from epypes.graph import CompGraph, redefined
from epypes.run.execute import Executor, Way
from epypes.run.failure import Failure, failure_of
from epypes.run.guard import keep, lend_to_reader
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.nested import NestedCall
from epypes.run.plan import Plan, check_ready, plan, wanted_steps
from epypes.run.program import MAX_UNCOUNTED, Program
from epypes.run.result import Run, TokenMapping, TrialOf, new_run, readable_state
from epypes.run.staleness import NOT_COMPUTED, TokenManager, skipped_steps
from epypes.run.timing import Reports, packed
from epypes.wording import counted

Payload = Mapping[str, Any]

_LOG: Final = logging.getLogger(__name__)
_MAX_TARGETS: Final = 64


class CompGraphRunner(OldNames, TokenMapping):
    """Runs a graph; a mapping of its tokens that can be read now.

    These are the hyperparameters, and what the last run has left that is not stale, in graph order. Reading any other
    token raises; ``get`` returns its default. If other threads run it meanwhile, ``dict(runner.last)`` is of one run.

    Parameters
    ----------
    cg
        The graph.
    hparams
        Values of hyperparameter tokens; source tokens that are not among them are free: ``run`` takes them.
    workers
        How many functions may run at once, in threads. They run side by side where that is faster, which is tried; the
        results, the order of the report and the errors are those of one after another.
    guard
        Whether functions get arrays as read-only views and containers as copies, and iterators are refused.
    check_mutation
        Whether every call is checked for changes to what is deeper inside its inputs, such as a list in a list: they
        are put back, and InputMutated is raised. It takes a look at all objects that the inputs reach, and runs one
        function at a time; without it nothing is looked at.

    Raises
    ------
    UnknownName
        A hyperparameter is not a token of the graph.
    HyperparameterError
        A hyperparameter is made by a function.

    Notes
    -----
    Every run works on a token store of its own and becomes ``last`` when it ends, completed or failed: so runs in
    several threads do not mix. Semeniuta and Falkman 2019, "Computational graphs".

    Examples
    --------
    >>> cg = CompGraph({"add": lambda x, y: x + y}, {"add": (("x", "y"), "total")})
    >>> runner = CompGraphRunner(cg, {"y": 1})
    >>> runner.run(x=2)["total"]
    3
    >>> runner.rerun(y=5)["total"]
    7
    """

    @takes_old_keywords
    def __init__(
        self,
        cg: CompGraph,
        hparams: Mapping[str, Any] | None = None,
        *,
        workers: int = 1,
        guard: bool = True,
        check_mutation: bool = False,
    ) -> None:
        if not isinstance(cg, CompGraph):
            kind = type(cg).__name__
            raise InvalidType(f"A CompGraphRunner runs a CompGraph, not {kind!r}: CompGraphRunner(cg, hparams).")
        hparams = {} if hparams is None else hparams
        require_mapping("hparams", hparams, "of tokens to values")
        if type(workers) is not int or workers < 1:
            raise InvalidValue(f"workers is how many functions may run at once, 1 or more, not {workers!r}.")
        self.cg = cg
        self.workers = workers
        self.guard = guard
        self.check_mutation = check_mutation
        self._program = Program(cg, guard, check_mutation)
        self._executor = Executor(self._program, workers)
        self._ways = self._executor.ways
        # The steps that targets need, where no switch has a say in it.
        self._wanted: dict[tuple[str, ...], bytes] = {}
        self._own_state()
        self.last: Run | None = None
        self._kept = self._initial_state()
        given = {**cg.defaults, **hparams}
        inside = {token: given.pop(token) for token in [*given] if token in self._program.inner_names}
        self._hparams = Hyperparameters(self._program, {}).frozen(given)
        if self._program.nested:
            self._hparams = self._hparams.current.frozen(inside, are_first=True)

    def _own_state(self) -> None:
        """Make what no two runners share, besides hyperparameters and the last run."""
        self._lock = threading.Lock()
        # What a trial remembers of its runner.
        self._key = object()
        # Replaced as a whole, so that calling them needs no lock.
        self._watchers: tuple[Callable[[], object], ...] = ()
        self.reports = Reports()
        self._keep_times = self.reports.kept.append
        # The run that failed last on each thread: `last` may be another thread's run by then.
        self._failed = threading.local()
        # By thread, the call of this one's pipeline by a graph around it.
        self.nested_calls: dict[int, NestedCall] = {}
        # Held by a run with state: the next one begins with what it leaves.
        self._series = threading.RLock()

    # -- running ------------------------------------------------------------------------------------------------

    def run(self, /, *targets: str, **payload: Any) -> Run:
        """Run everything, or only what ``targets`` need, on a payload that counts as new.

        Parameters
        ----------
        targets
            Tokens; all without.
        payload
            The free source tokens by name.

        Returns
        -------
        Run
            The tokens, the times.

        Raises
        ------
        PayloadError
            A free source token that is needed is missing, or a token is given that is not one.
        IteratorRefused
            A value that is given, or that a function returns, can be read only once.
        InputMutated
            With ``check_mutation``: a function has changed an object inside its input.
        PlaceholderNeeded
            Functions that are needed are still to be written.
        UnknownName
            A name is not a token of the graph, or not a branch of a switch.
        Exception
            Whatever a function raises, unchanged, with a note; ``last`` is then the failed run.
        """
        __tracebackhide__ = True
        return self.run_on(payload, targets)

    def run_on(self, payload: Payload, targets: Sequence[str] = ()) -> Run:
        """Do what ``run`` does, with the payload as a mapping by free source token."""
        __tracebackhide__ = True
        start_ns = perf_counter_ns()
        if targets:
            self._require_targets(targets)
        if self.nested_calls and (call := self.nested_calls.get(get_ident())) is not None:
            return self._run_nested(call, payload, targets, start_ns)
        hparams = self.current if self._program.nested else self._hparams
        if not self._program.states:
            return self._run(hparams.tokens(payload, ()), hparams, targets, start_ns)
        with self._series:
            return self._run(hparams.tokens(payload, self._kept), hparams, targets, start_ns)

    def _run_nested(self, call: NestedCall, payload: Payload, targets: Sequence[str], start_ns: int) -> Run:
        """Run with what a graph gives to this one's pipeline, on from its last call."""
        __tracebackhide__ = True
        hparams, before, is_passed_on = call.hparams, call.before, call.is_passed_on(payload)
        if before is not None and is_passed_on and [*before.hparams.free_slots] == [*payload]:
            changes = dict(hparams.changes_since(before.hparams))
            new = {token: value for place, (token, value) in enumerate(payload.items()) if place in call.new}
            tokens = before.tokens.branch(changes | new, unsure=new)
            del before
        else:
            tokens = hparams.tokens(payload, self._kept)
        call.before = None
        try:
            run = self._run(tokens, hparams, targets, start_ns)
        except BaseException as error:
            call.run = self.failed_run(error) if is_passed_on else None
            raise
        call.run = run if is_passed_on else None
        return run

    def rerun(self, /, *targets: str, **changes: Any) -> Run:
        """Set hyperparameters, all or none of them, then run the stale functions on the last payload.

        Those of a pipeline in the graph are called as in scikit-learn: ``rerun(geometry__threshold=2)``. They are this
        runner's own: the pipeline, and other graphs that it is in, keep theirs. What is set in the pipeline itself
        afterwards counts here too.

        Raises
        ------
        PayloadError
            Nothing has been run yet.
        PlaceholderNeeded
            Functions that are needed are still to be written.
        HyperparameterError, UnknownName
            A name is not a hyperparameter; nothing is set then.
        Exception
            Whatever a function raises, unchanged, with a note.
        """
        __tracebackhide__ = True
        if not self._program.states:
            return self._go_on(changes, targets)
        with self._series:
            return self._go_on(changes, targets)

    def _go_on(self, changes: Mapping[str, Any], targets: tuple[str, ...], is_trial: bool = False) -> Run:
        """Change hyperparameters, and run the stale functions on the tokens of the last run."""
        __tracebackhide__ = True
        start_ns = perf_counter_ns()
        if targets:
            self._require_targets(targets)
        with self._lock:
            first = self._hparams.current if self._program.nested else self._hparams
            last = self.last
            hparams = first.frozen(changes, also_new=False)
            self._hparams = first if is_trial else hparams
        if last is None:
            free = self.free_source_tokens
            raise PayloadError(free, f"Nothing has been run yet, so there is no payload. Call {run_call(free)} first.")
        trial_of = (self._key, first, ref(last), self._kept) if is_trial else None
        before = last.hparams
        is_next = hparams.follows == before.revision
        changes = hparams.changed if is_next else hparams.changes_since(before)
        tokens = last.tokens.branch(changes, are_new=is_next)
        # A failure keeps this frame, with all that is named in it: the run before, which may have failed too.
        del last
        return self._run(tokens, hparams, targets, start_ns, trial_of)

    def _wanted_steps(self, tokens: TokenManager, hparams: Hyperparameters, targets: Sequence[str]) -> bytes | None:
        """Return 1 for each step that is needed, None if all are; raise unless all of them can be run."""
        program, values, key = self._program, tokens.values, tuple(targets)
        wanted = self._wanted.get(key)
        if wanted is None:
            wanted = wanted_steps(program, values, targets)
            if wanted is not None and not program.switches and len(self._wanted) < _MAX_TARGETS:
                self._wanted[key] = wanted
        if program.placeholders or not tokens.has_payload:
            given = [token for token, slot in hparams.free_slots.items() if values[slot] is not NOT_COMPUTED]
            check_ready(program, values, wanted, given)
        return wanted

    def _run(
        self, tokens: TokenManager, hparams: Hyperparameters, targets: Sequence[str], start_ns: int,
        trial_of: TrialOf | None = None, way: Way | None = None,
    ) -> Run:  # fmt: skip
        """Run the dirty steps that the targets need, all without, and record what is left.

        The run becomes the last one unless it is a trial. With a way, that is taken in place of the executor's.
        """
        __tracebackhide__ = True
        program, failed_at, error, failure = self._program, -1, None, None
        if way is None:
            if targets or program.is_conditional or not tokens.has_payload:
                tokens.wanted = self._wanted_steps(tokens, hparams, targets)
            key = hparams.plain, tokens.wanted, tokens.origin, tokens.changed
            way = self._ways.get(key) or self._executor.way(key, tokens)
        durations_ns, running = tokens.durations_ns, program.running
        running.add(tokens)
        try:
            way(tokens)
        except BaseException as raised:
            error = raised
        finally:
            running.discard(tokens)
        if error is not None:
            failed_at = max(0, tokens.running)
            failure = _failed(tokens, failed_at, error, hparams)
        skipped = skipped_steps(program, tokens.values, tokens.dirty) if program.has_skipped else ()
        total_ns = perf_counter_ns() - start_ns
        kept_ns = packed(program, durations_ns) if program.is_large else durations_ns
        times = program, tokens.wanted, kept_ns, total_ns, tokens.side_by_side, failed_at, skipped
        run = new_run()
        run.tokens, run.hparams, run.times, run._failure = tokens, hparams, times, failure
        if (uncounted := program.uncounted) is not None:
            uncounted.append(durations_ns)
            if len(uncounted) > MAX_UNCOUNTED:
                program.count_calls()
        if trial_of is not None:
            run.trial_of = trial_of
            return run
        with self._lock:
            self.last = run
            if program.states:
                self._kept = self._kept_after(run)
        self._keep_times(times)
        if self._watchers:
            self._tell_watchers()
        if error is not None:
            self._failed.run = ref(run)
            # Not while an exception is being handled, which would become the context of the user's.
            raise error
        return run

    def failed_run(self, exception: BaseException) -> Run | None:
        """Return the run of this thread that raised an exception; None if it did not come out of this runner."""
        last: ref[Run] | None = getattr(self._failed, "run", None)
        run = None if last is None else last()
        return run if run is not None and run.failure is not None and run.failure.exception is exception else None

    def trial(
        self,
        values: Mapping[str, Any],
        /,
        *targets: str,
        payload: Mapping[str, Any] | None = None,
        state: Mapping[str, Any] | None = None,
    ) -> Run:
        """Run with other hyperparameters, or on another payload, and leave the runner as it is.

        Parameters
        ----------
        values
            Hyperparameters by token; the others are the runner's.
        targets
            Tokens; only what they need is run, everything without.
        payload
            The free source tokens by name, which count as new; without, all that is not stale in the last run is used.
        state
            With a payload, the state that the run begins with, such as that of the trial before: ``run.state``. What is
            not in it, all of it without, is the runner's.

        Returns
        -------
        Run
            If a function failed, its ``failure`` says so: nothing is raised for it.

        Raises
        ------
        HyperparameterError, PayloadError, PlaceholderNeeded, UnknownName
            As ``rerun`` and ``run`` do.
        """
        if payload is None:
            if state is not None:
                raise PayloadError(self.free_source_tokens, "A trial with a state needs a payload: payload={...}.")
            return self._go_on(values, targets, True)
        start_ns = perf_counter_ns()
        self._require_targets(targets)
        before, last = self._state
        hparams = before.frozen(values, also_new=False)
        trial_of = self._key, before, None if last is None else ref(last), self._kept
        begin = self._kept if state is None else self._state_of(state)
        return self._run(hparams.tokens(payload, begin), hparams, targets, start_ns, trial_of)

    def adopt(self, run: Run, /) -> bool:
        """Make a run of ``trial`` the last one and its hyperparameters the runner's, in one step.

        Return False, and do nothing, if the runner has changed since the trial began.

        Raises
        ------
        ValueError
            The run was not tried by this runner.
        """
        key, before, last, kept = getattr(run, "trial_of", (None,) * 4)
        if key is not self._key:
            raise InvalidValue("Only a run that this runner's trial() returned can be adopted.")
        with self._series, self._lock:
            now = self._hparams.current if self._program.nested else self._hparams
            is_as_it_was = before is now and (None if last is None else last()) is self.last
            if not is_as_it_was or kept is not self._kept:
                return False
            self._hparams, self.last, self._kept = run.hparams, run, self._kept_after(run)
        self._keep_times(run.times)
        self._tell_watchers()
        return True

    def watch(self, callback: Callable[[], object], /) -> Callable[[], None]:
        """Call something without arguments when a run has ended or hyperparameters have changed; return what ends that.

        It is called on the thread that did it, so it must return at once. What it raises is logged.
        """
        # A callable of its own for each call, so that one callback may be added twice and taken out once.
        entry = lambda: callback()  # noqa: E731
        with self._lock:
            self._watchers = (*self._watchers, entry)

        def remove() -> None:
            with self._lock:
                self._watchers = tuple(other for other in self._watchers if other is not entry)

        return remove

    def _tell_watchers(self) -> None:
        for callback in self._watchers:
            try:
                callback()
            except Exception:
                _LOG.exception("A watcher of a runner has failed")

    def plan(self, /, *targets: str) -> Plan:
        """Return what ``rerun(*targets)`` would do, and why."""
        self._require_targets(targets)
        hparams, last = self._state
        changed = () if last is None else tuple(hparams.changes_since(last.hparams))
        return plan(self._tokens_now(hparams, last), targets, changed, hparams)

    def _require_targets(self, targets: Sequence[object]) -> None:
        """Raise unless all of these are names of tokens."""
        for token in targets:
            if type(token) is str and token in self._program.slots:
                continue
            if not isinstance(token, str):
                kind, free = type(token).__name__, self.free_source_tokens
                text = f"A target is the name of a token, not {kind!r}. Payload goes by name: {run_call(free)}."
                raise PayloadError(free, text)
            self.cg.require_token(token)

    # -- hyperparameters ----------------------------------------------------------------------------------------

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        """The values of the hyperparameters by token, those of pipelines by ``"function__token"``: a snapshot."""
        return self.current.values

    @property
    def current(self) -> Hyperparameters:
        """The hyperparameters with their versions."""
        if self._program.nested:
            with self._lock:
                self._hparams = self._hparams.current
        return self._hparams

    @property
    def first_hyperparameters(self) -> Mapping[str, Any]:
        """The values that the hyperparameters had when they were made or frozen, by token: a snapshot."""
        return self.current.first_values

    @property
    def revision(self) -> int:
        """How often the hyperparameters have changed."""
        return self.current.revision

    @property
    def free_source_tokens(self) -> tuple[str, ...]:
        """The source tokens that ``run`` takes, in order of first appearance in func_io."""
        return tuple(self._hparams.free_slots)

    def freeze(self, /, **values: Any) -> None:
        """Make source tokens hyperparameters, all or none of them."""
        self._change(values, also_new=True)

    def unfreeze(self, token: str) -> None:
        """Make a hyperparameter a free source token again."""
        with self._lock:
            self._hparams = self._hparams.current.unfrozen(token)
        self._tell_watchers()

    def set(self, /, **values: Any) -> None:
        """Set hyperparameters, all or none of them, at once: a run has all of the new values or none.

        Raises
        ------
        HyperparameterError, UnknownName
            As ``rerun`` does; nothing is set then.
        """
        self._change(values, also_new=False)

    def __setitem__(self, token: str, value: Any) -> None:
        self._change({token: value}, also_new=False)

    def _change(self, values: Mapping[str, Any], also_new: bool) -> None:
        with self._lock:
            self._hparams = self._hparams.current.frozen(values, also_new=also_new)
        self._tell_watchers()

    # -- state --------------------------------------------------------------------------------------------------

    @property
    def state(self) -> Mapping[str, Any]:
        """What the next run begins with, by delayed token (``ep.delay``): a snapshot, arrays read-only.

        Of a nested pipeline the keys are ``"function.token"``. Set it, or some of its keys, to go on from there.
        """
        return readable_state(self._program, self._kept)

    @state.setter
    def state(self, values: Mapping[str, Any]) -> None:
        self._begin_with(self._state_of(values))

    def reset(self) -> None:
        """Have the next run begin with the initial state; the last run stays, and ``rerun`` repeats it as it was."""
        self._begin_with(self._initial_state())

    def call_with_state(self, state: Mapping[str, Any], call: Callable[[], Any]) -> tuple[Any, Mapping[str, Any]]:
        """Call what runs this graph with a state that the caller keeps; return its value and the state after."""
        __tracebackhide__ = True
        with self._series:
            own = self._kept
            self.state = state
            try:
                return call(), self.state
            finally:
                self._kept = own

    def _begin_with(self, kept: tuple[Any, ...]) -> None:
        with self._series, self._lock:
            self._kept = kept
        self._tell_watchers()

    def _initial_state(self) -> tuple[Any, ...]:
        return tuple(slots.initial for slots in self._program.states)

    def _kept_after(self, run: Run) -> tuple[Any, ...]:
        """Return what the run after this one begins with."""
        return self._kept if run.failure is not None else self._kept_of(run.state_after())

    def _kept_of(self, values: Sequence[Any]) -> tuple[Any, ...]:
        """Return a state as it is kept; arrays that others may fill again, as a payload's, are copied."""
        program = self._program
        if not program.guard:
            return tuple(values)
        return tuple(
            keep(value, 0, program, slots.before, ()) for slots, value in zip(program.states, values, strict=True)
        )

    def _state_of(self, values: Mapping[str, Any]) -> tuple[Any, ...]:
        """Return a state as it is stored; what is not among the values stays as it is.

        Raises
        ------
        UnknownName
            No token of this name is delayed.
        """
        require_mapping("state", values, "of delayed tokens to values")
        known = {slots.key: now for slots, now in zip(self._program.states, self._kept, strict=True)}
        for key in values:
            if key not in known:
                raise UnknownName("delayed token", key, known, "in this graph: see ep.delay")
        return self._kept_of([*{**known, **values}.values()])

    # -- reading ------------------------------------------------------------------------------------------------

    @property
    def stale(self) -> tuple[str, ...]:
        """The functions that ``rerun()`` would run, in run order."""
        return self.plan().order

    @property
    def running(self) -> tuple[str, ...]:
        """The functions that are being run at this moment, in whatever thread, in run order."""
        return self._program.running_functions()

    @property
    def _state(self) -> tuple[Hyperparameters, Run | None]:
        """The hyperparameters and the last run, of one moment."""
        with self._lock:
            if self._program.nested:
                self._hparams = self._hparams.current
            return self._hparams, self.last

    @property
    def tokens_now(self) -> TokenManager:
        """The tokens of the last run as they are to be read with the hyperparameters of now."""
        return self._tokens_now(*self._state)

    def _tokens_now(self, hparams: Hyperparameters, last: Run | None) -> TokenManager:
        """Return a run's tokens as they are to be read with these hyperparameters.

        Both are given, so that what is read beside a rerun in another thread is decided from one state.
        """
        if last is None:
            return hparams.tokens({}, self._kept)
        if last.hparams is hparams and not self._program.revised:
            return last.tokens
        return last.tokens.branch(hparams.changes_since(last.hparams)).begin()

    def __getitem__(self, token: str) -> Any:
        hparams, last = self._state
        if token in hparams.entries:
            value = hparams.entries[token][0]
            return lend_to_reader(value) if self.guard else value
        if last is None:
            self.cg.require_token(token)
            text = f"Token {token!r} has not been computed: nothing has been run. Call {run_call(hparams.free_slots)}."
            raise NotComputed(token, text)
        value = last[token]
        if self._tokens_now(hparams, last).is_stale(token):
            raise StaleToken(token)
        return value

    def __contains__(self, token: object) -> bool:
        return isinstance(token, str) and self.cg.has_token(token) and super().__contains__(token)

    def __iter__(self) -> Iterator[str]:
        hparams, last = self._state
        now, frozen = self._tokens_now(hparams, last), hparams.entries
        return iter([token for token in self.cg.tokens if token in frozen or now.is_readable(token)])

    def __repr__(self) -> str:
        last, redefinitions = self.last, len(redefined(self.cg))
        old = f" ({redefinitions} redefined)" * bool(redefinitions)
        if last is None:
            state = "not run yet"
        elif last.failure:
            state = f"failed in {last.failure.function!r:.{24 - len(old)}}"
        else:
            state = f"{counted(len(self.stale), 'function')} stale" if self.stale else "up to date"
        functions, frozen = counted(len(self.cg.functions), "function"), len(self.hyperparameters)
        return f"<CompGraphRunner: {functions}{old}, {counted(frozen, 'hyperparameter')}; {state}>"


def branched(runner: CompGraphRunner) -> CompGraphRunner:
    """Return a runner with the hyperparameters and the last run of another one, that goes its own way from there.

    Both share values and what is compiled, and no state: each may be used on a thread of its own.
    """
    hparams, last = runner._state
    branch = copy(runner)
    branch._own_state()
    branch._hparams, branch.last = hparams, last
    return branch


def stop_at(
    runner: CompGraphRunner, payload: Payload, function: str | None = None, why: BaseException | None = None
) -> Run:
    """Run what a function needs, and have it fail without being called; the run becomes the runner's last.

    ``rerun`` goes on from there, and calls it. It is for functions that are known to kill or to hang.

    Parameters
    ----------
    payload
        The free source tokens by name.
    function
        Without, no function at all is called, and the run has the payload alone.
    why
        What the function fails with. If one that it needs fails, the run is that one's.

    Raises
    ------
    PayloadError, PlaceholderNeeded, UnknownName
        As ``run`` does.
    """
    start_ns, hparams, program, cg = perf_counter_ns(), runner._state[0], runner._program, runner.cg
    needed = [] if function is None else [token for token in cg.func_inputs(function) if token not in cg.source_tokens]
    tokens = hparams.tokens(payload, runner._kept)
    if needed:
        before = runner.trial({}, *needed, payload=payload)
        if before.failure is not None:
            runner.adopt(before)
            return before
        tokens = before.tokens.branch()
        tokens.durations_ns |= before.report.ran_ns
    # No other step was come to.
    tokens.wanted = program.no_steps
    if function is not None:
        tokens.running = next(step.place for step in program.steps if step.name == function)

    def way(tokens: TokenManager) -> None:
        if why is not None:
            raise why

    try:
        return runner._run(tokens, hparams, (), start_ns, way=way)
    except BaseException as raised:
        if raised is not why or runner.last is None:
            raise
        return runner.last


def _failed(tokens: TokenManager, place: int, error: BaseException, hparams: Hyperparameters) -> Failure:
    """Describe the failure of a step; what depends on it reads as not computed.

    Of the steps that were not reached none was reused: they were not wanted.
    """
    program, durations_ns = tokens.program, tokens.durations_ns
    durations_ns.setdefault(place, 0)
    tokens.dirty = bytearray(left and at not in durations_ns for at, left in enumerate(tokens.dirty))
    failure = failure_of(tokens, place, error, hparams.entries)
    tokens.forget(program.downstream([place], tokens.values))
    reached = bytearray(tokens.wanted or program.all_steps)
    for stale in tokens.stale:
        reached[stale] = 0
    tokens.wanted = bytes(reached)
    return failure
