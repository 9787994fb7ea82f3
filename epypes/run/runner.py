"""The runner of a graph: run, tune, run again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from time import perf_counter_ns
from typing import Any

from epypes.errors import StaleToken, require_mapping
from epypes.graph import CompGraph
from epypes.rich_display import mimebundle
from epypes.run.attempt import AttemptsByKind, Outcome
from epypes.run.call import StepFailed
from epypes.run.draft import draft_after, tokens_now
from epypes.run.guard import COPIERS, lend, require_reusable
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.plan import Plan, plan
from epypes.run.program import Program
from epypes.run.record import Run, new_run
from epypes.run.refused import nothing_computed, nothing_run, require_targets
from epypes.run.report import Reports
from epypes.run.told import one_line
from epypes.run.trials import Trials
from epypes.run.underway import running_functions
from epypes.run.watchers import Watchers

Payload = Mapping[str, Any]


class CompGraphRunner:
    """Runs a graph; reads like a dictionary of its tokens.

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
            raise TypeError(f"A CompGraphRunner runs a CompGraph, not {kind!r}: CompGraphRunner(cg, hparams).")
        hparams = {} if hparams is None else hparams
        require_mapping("hparams", hparams, "of tokens to values")
        if type(workers) is not int or workers < 1:
            raise ValueError(f"workers is how many functions may run at once, 1 or more, not {workers!r}.")
        self.cg = cg
        self.workers = workers
        self.guard = guard
        self.check_mutation = check_mutation
        self.reports = Reports()
        self._program = Program(cg, guard, check_mutation)
        self._attempts = AttemptsByKind(self._program, workers)
        self._lock = threading.Lock()
        self._trials = Trials()
        self._watchers = Watchers()
        self.last: Run | None = None
        given = {**cg.defaults, **hparams}
        self._hparams = Hyperparameters(self._program, {}).frozen(given)

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
        return self.run_on(payload, targets)

    def run_on(self, payload: Payload, targets: Sequence[str] = ()) -> Run:
        """Do what ``run`` does, with the payload as a mapping by free source token."""
        start_ns = perf_counter_ns()
        hparams = self._hparams
        if hparams.start is None:
            hparams.start = hparams.base, hparams.free_slots, self._attempts[hparams.plain]
        base, slots, attempts = hparams.start
        compiled = attempts.short_way.whole
        if compiled is None or targets or len(payload) != len(slots):
            return self._run_anyhow(payload, targets, start_ns, hparams)
        # The way of a stream of images: as short as can be.
        values = base.copy()
        try:
            for token in payload:
                value = values[slots[token]] = payload[token]
                if type(value) not in COPIERS:
                    require_reusable(value, self._program, slots[token])
        except KeyError:
            return self._run_anyhow(payload, targets, start_ns, hparams)
        try:
            durations_ns = compiled(values)
        except StepFailed as failed:
            outcome = attempts.run_broken_off(values, failed, None, True, start_ns)
        else:
            times = (self._program, None, durations_ns, perf_counter_ns() - start_ns, False, -1)
            run = new_run()
            run.record = values, attempts.clean, hparams, times, None
            self._lock.acquire()  # half the time of a with statement
            try:
                self.last = run
            finally:
                self._lock.release()
            self.reports.kept.append(times)
            if self._watchers.callbacks:
                self._watchers.tell()
            return run
        return self._ended(outcome, hparams)

    def _run_anyhow(self, payload: Payload, targets: Sequence[str], start_ns: int, hparams: Hyperparameters) -> Run:
        if targets:
            require_targets(self.cg, targets, tuple(hparams.free_slots))
        values, has_payload = hparams.with_payload(payload), len(payload) == len(hparams.free_slots)
        attempts = self._attempts[hparams.plain]
        return self._ended(attempts.whole(values, payload, has_payload, targets, start_ns), hparams)

    def rerun(self, /, *targets: str, **changes: Any) -> Run:
        """Set hyperparameters, all or none of them, then run the stale functions on the last payload.

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
        start_ns = perf_counter_ns()
        if targets:
            require_targets(self.cg, targets, self.free_source_tokens)
        with self._lock:
            hparams, last = self._hparams.frozen(changes, also_new=False), self.last
            self._hparams = hparams
        changed, compiled = hparams.changed, None
        if last is None:
            raise nothing_run(self.free_source_tokens)
        attempts = self._attempts[hparams.plain]
        stored, freshness, before = last.record[:3]
        if freshness.is_clean and not targets and hparams.follows == before.revision:
            compiled = attempts.short_way.of_changes(changed)
        if compiled is None:
            outcome = attempts.stale(draft_after(self._program, last, hparams), targets, start_ns)
        else:
            # The way of a slider: as short as can be.
            values = stored.copy()
            try:
                durations_ns = compiled(values, changed.values())
            except StepFailed as failed:
                outcome = attempts.rerun_broken_off(values, failed, changed, start_ns)
            else:
                times = (self._program, None, durations_ns, perf_counter_ns() - start_ns, False, -1)
                run = Run((values, freshness, hparams, times, None))
                with self._lock:
                    self.last = run
                self.reports.kept.append(times)
                if self._watchers.callbacks:
                    self._watchers.tell()
                return run
        # A failure keeps this frame, with all that is named in it: the Run before, which may have failed too ...
        del last, stored, freshness
        return self._ended(outcome, hparams)

    def _ended(self, outcome: Outcome, hparams: Hyperparameters) -> Run:
        """Make what was run the last Run; raise the user's exception if a function failed.

        To be called where no exception is being handled, which would become the context of the user's.
        """
        run = Run((*outcome[:2], hparams, *outcome[2:]))
        with self._lock:
            self.last = run
        self.reports.add(run.record[3])
        self._watchers.tell()
        if run.failure is not None:
            raise run.failure.exception
        return run

    def trial(self, values: Mapping[str, Any], /, *targets: str, payload: Mapping[str, Any] | None = None) -> Run:
        """Run with other hyperparameters, or on another payload, and leave the runner as it is.

        Parameters
        ----------
        values
            Hyperparameters by token; the others are the runner's.
        targets
            Tokens; only what they need is run, everything without.
        payload
            The free source tokens by name, which count as new; without, all that is not stale in the last run is used.

        Returns
        -------
        Run
            If a function failed, its ``failure`` says so: nothing is raised for it.

        Raises
        ------
        HyperparameterError, PayloadError, PlaceholderNeeded, UnknownName
            As ``rerun`` and ``run`` do.
        """
        start_ns = perf_counter_ns()
        require_targets(self.cg, targets, self.free_source_tokens)
        before, last = self._state
        hparams = before.frozen(values, also_new=False)
        attempts = self._attempts[hparams.plain]
        if payload is not None:
            has_payload = len(payload) == len(hparams.free_slots)
            outcome = attempts.whole(hparams.with_payload(payload), payload, has_payload, targets, start_ns)
        elif last is None:
            raise nothing_run(self.free_source_tokens)
        else:
            outcome = attempts.stale(draft_after(self._program, last, hparams), targets, start_ns)
        run = Run((*outcome[:2], hparams, *outcome[2:]))
        self._trials.add(run, before, last)
        return run

    def adopt(self, run: Run, /) -> bool:
        """Make a run of ``trial`` the last one and its hyperparameters the runner's, in one step.

        Return False, and do nothing, if the runner has changed since the trial began.

        Raises
        ------
        ValueError
            The run was not tried by this runner.
        """
        if run not in self._trials:
            raise ValueError("Only a run that this runner's trial() returned can be adopted.")
        with self._lock:
            if not self._trials.began_from(run, self._hparams, self.last):
                return False
            self._hparams, self.last = run.record[2], run
        self.reports.add(run.record[3])
        self._watchers.tell()
        return True

    def watch(self, callback: Callable[[], object], /) -> Callable[[], None]:
        """Call something without arguments when a run has ended or hyperparameters have changed; return what ends that.

        It is called on the thread that did it, so it must return at once. What it raises is logged.
        """
        return self._watchers.add(callback)

    def plan(self, /, *targets: str) -> Plan:
        """Return what ``rerun(*targets)`` would do, and why."""
        require_targets(self.cg, targets, self.free_source_tokens)
        hparams, last = self._state
        changed = () if last is None else tuple(hparams.changes_since(last.record[2]))
        return plan(tokens_now(self._program, last, hparams), targets, changed, hparams)

    # -- hyperparameters ----------------------------------------------------------------------------------------

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        """The values of the hyperparameters by token: a snapshot."""
        return self._hparams.values

    @property
    def first_hyperparameters(self) -> Mapping[str, Any]:
        """The values that the hyperparameters had when they were made or frozen, by token: a snapshot."""
        return self._hparams.first_values

    @property
    def revision(self) -> int:
        """How often the hyperparameters have changed."""
        return self._hparams.revision

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
            self._hparams = self._hparams.unfrozen(token)
        self._watchers.tell()

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
            self._hparams = self._hparams.frozen(values, also_new=also_new)
        self._watchers.tell()

    # -- reading ------------------------------------------------------------------------------------------------

    @property
    def stale(self) -> tuple[str, ...]:
        """The functions that ``rerun()`` would run, in run order."""
        return self.plan().order

    @property
    def running(self) -> tuple[str, ...]:
        """The functions that are being run at this moment, in whatever thread, in run order."""
        return running_functions(self._program)

    @property
    def _state(self) -> tuple[Hyperparameters, Run | None]:
        """The hyperparameters and the last run, of one moment."""
        with self._lock:
            return self._hparams, self.last

    def __getitem__(self, token: str) -> Any:
        hparams, last = self._state
        if token in hparams.entries:
            value = hparams.entries[token][0]
            return lend(value) if self.guard else value
        if last is None:
            self.cg.require_token(token)
            raise nothing_computed(token, hparams.free_slots)
        value = last[token]
        if tokens_now(self._program, last, hparams).is_stale(token):
            raise StaleToken(token)
        return value

    def __contains__(self, token: object) -> bool:
        return token in self.keys()

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def __len__(self) -> int:
        return len(self.keys())

    def keys(self) -> tuple[str, ...]:
        """Return the tokens that can be read now, in graph order."""
        hparams, last = self._state
        now, frozen = tokens_now(self._program, last, hparams), hparams.entries
        return tuple(token for token in self.cg.tokens if token in frozen or now.is_readable(token))

    def __repr__(self) -> str:
        return one_line(self)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return mimebundle(self)
