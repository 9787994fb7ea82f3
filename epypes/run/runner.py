"""How is a graph run, tuned and run again?"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from time import perf_counter_ns
from typing import Any

from epypes.errors import NotComputed, PayloadError, StaleToken, UnknownName, require_mapping, run_call
from epypes.graph import CompGraph
from epypes.graph.redefined import redefined
from epypes.run.attempt import AttemptsByKind, Outcome
from epypes.run.call import StepFailed
from epypes.run.draft import Draft
from epypes.run.guard import lend
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.plan import Plan, plan
from epypes.run.program import Program
from epypes.run.record import Run
from epypes.run.report import Reports
from epypes.run.tokens import TokenManager
from epypes.run.underway import running_functions


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
        Whether functions get arrays as read-only views.

    Raises
    ------
    UnknownName
        A hyperparameter is not a token of the graph.
    HyperparameterError
        A hyperparameter is made by a function.

    Notes
    -----
    Every run works on a token store of its own and becomes ``last`` when it ends, so runs in several threads do
    not mix. Semeniuta and Falkman 2019, "Computational graphs".

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
        self, cg: CompGraph, hparams: Mapping[str, Any] | None = None, *, workers: int = 1, guard: bool = True
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
        self.reports = Reports()
        self._program = Program(cg, guard)
        self._attempts = AttemptsByKind(self._program, workers)
        self._lock = threading.Lock()
        self._last: Run | None = None
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
        PlaceholderNeeded
            Functions that are needed are still to be written.
        UnknownName
            A name is not a token of the graph, or not a branch of a switch.
        Exception
            Whatever a function raises, unchanged, with a note; ``last`` is then the failed run.
        """
        start_ns = perf_counter_ns()
        if targets:
            self._check_targets(targets)
        hparams, program = self._hparams, self._program
        values, free = hparams.base.copy(), hparams.free_slots
        for token, value in payload.items():
            slot = free.get(token)
            if slot is None:
                raise self._wrong_payload(hparams, token)
            values[slot] = value
        if program.selectors:
            hparams.require_branches(payload)
        attempts, has_payload = self._attempts[hparams.plain], len(payload) == len(free)
        compiled = attempts.short_way.whole
        if compiled is None or targets or not has_payload:
            return self._ended(attempts.whole(values, payload, has_payload, targets, start_ns), hparams)
        # The way of a stream of images: as short as can be.
        try:
            durations_ns = compiled(values)
        except StepFailed as failed:
            outcome = attempts.run_broken_off(values, failed, None, True, start_ns)
        else:
            times = (program, None, durations_ns, perf_counter_ns() - start_ns, False, -1)
            run = self._last = Run((values, attempts.clean, hparams, times, None))
            self.reports.kept.append(times)
            return run
        return self._ended(outcome, hparams)

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
            self._check_targets(targets)
        with self._lock:
            hparams = self._hparams = self._hparams.frozen(changes, also_new=False)
        last, changed, compiled = self._last, hparams.changed, None
        if last is None:
            free = self.free_source_tokens
            text = f"Nothing has been run yet, so there is no payload. Call {run_call(free)} first."
            raise PayloadError(free, text)
        attempts = self._attempts[hparams.plain]
        stored, freshness, before = last.record[:3]
        if freshness.is_clean and not targets and hparams.follows == before.revision:
            compiled = attempts.short_way.of_changes(changed)
        if compiled is None:
            outcome = attempts.stale(self._draft(last, hparams), targets, start_ns)
        else:
            # The way of a slider: as short as can be.
            values = stored.copy()
            try:
                durations_ns = compiled(values, changed.values())
            except StepFailed as failed:
                outcome = attempts.rerun_broken_off(values, failed, changed, start_ns)
            else:
                times = (self._program, None, durations_ns, perf_counter_ns() - start_ns, False, -1)
                run = self._last = Run((values, freshness, hparams, times, None))
                self.reports.kept.append(times)
                return run
        # A failure keeps this frame, with all that is named in it: the Run before, which may have failed too ...
        del last, stored, freshness
        return self._ended(outcome, hparams)

    def _ended(self, outcome: Outcome, hparams: Hyperparameters) -> Run:
        """Make what was run the last Run; raise the user's exception if a function failed.

        To be called where no exception is being handled, which would become the context of the user's.
        """
        values, freshness, times, failure = outcome
        run = self._last = Run((values, freshness, hparams, times, failure))
        self.reports.add(times)
        if failure is not None:
            raise failure.exception
        return run

    def plan(self, /, *targets: str) -> Plan:
        """Return what ``rerun(*targets)`` would do, and why."""
        self._check_targets(targets)
        last, hparams = self._last, self._hparams
        changed = () if last is None else tuple(hparams.changes_since(last.record[2]))
        return plan(self._now(last, hparams), targets, changed, hparams)

    def _check_targets(self, targets: Sequence[object]) -> None:
        for token in targets:
            if not isinstance(token, str):
                free = self.free_source_tokens
                kind = type(token).__name__
                text = f"A target is the name of a token, not {kind!r}. Payload goes by name: {run_call(free)}."
                raise PayloadError(free, text)
            self.cg.require_token(token)

    def _wrong_payload(self, hparams: Hyperparameters, token: str) -> Exception:
        """Return the error that says why this token can't be given to ``run``."""
        if token not in self._program.slots:
            return UnknownName("token", token, hparams.free_slots)
        maker = self.cg.digraph.producer.get(token)
        if maker is not None:
            text = f"Token {token!r} is made by function {maker!r}; run() takes free source tokens only."
        else:
            text = f"Token {token!r} is a hyperparameter. Set runner[{token!r}], or call unfreeze({token!r})."
        return PayloadError((token,), text)

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
        with self._lock:
            self._hparams = self._hparams.frozen(values)

    def unfreeze(self, token: str) -> None:
        """Make a hyperparameter a free source token again."""
        with self._lock:
            self._hparams = self._hparams.unfrozen(token)

    def __setitem__(self, token: str, value: Any) -> None:
        with self._lock:
            self._hparams = self._hparams.frozen({token: value}, also_new=False)

    # -- reading ------------------------------------------------------------------------------------------------

    @property
    def last(self) -> Run | None:
        """The last run that ended, completed or failed."""
        return self._last

    @property
    def stale(self) -> tuple[str, ...]:
        """The functions that ``rerun()`` would run, in run order."""
        hparams = self._hparams
        return plan(self._now(self._last, hparams), (), (), hparams).order

    @property
    def running(self) -> tuple[str, ...]:
        """The functions that are being run at this moment, in whatever thread, in run order."""
        return running_functions(self._program)

    def _draft(self, last: Run | None, hparams: Hyperparameters) -> Draft:
        """Return a run's tokens with these hyperparameters, to go on from.

        Both are given, so that what is read beside a rerun in another thread is decided from one state.
        """
        if last is None:
            return Draft.of_sources(self._program, hparams.base.copy(), not hparams.free_slots)
        draft = Draft.after(last.tokens)
        for token, value in hparams.changes_since(last.record[2]).items():
            draft.change(token, value)
        return draft

    def _now(self, last: Run | None, hparams: Hyperparameters) -> TokenManager:
        """Return a run's tokens as they are to be read with these hyperparameters."""
        if last is not None and last.record[2] is hparams and not self._program.revised:
            return last.tokens
        return self._draft(last, hparams).tokens()

    def __getitem__(self, token: str) -> Any:
        hparams, last = self._hparams, self._last
        if token in hparams.entries:
            value = hparams.entries[token][0]
            return lend(value) if self.guard else value
        if last is None:
            self.cg.require_token(token)
            call = run_call(hparams.free_slots)
            text = f"Token {token!r} has not been computed: nothing has been run. Call {call}."
            raise NotComputed(token, text)
        value = last[token]
        if self._now(last, hparams).is_stale(token):
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
        hparams, last = self._hparams, self._last
        now = self._now(last, hparams)
        return tuple(
            token
            for token in self.cg.tokens
            if token in hparams.entries or (now.is_computed(token) and not now.is_stale(token))
        )

    def __repr__(self) -> str:
        redefinitions = len(redefined(self.cg))
        old = f" ({redefinitions} redefined)" * bool(redefinitions)
        if self._last is None:
            state = "not run yet"
        elif self._last.failure:
            state = f"failed in {self._last.failure.function!r:.{24 - len(old)}}"
        else:
            stale = len(self.stale)
            state = f"{stale} function{'s' * (stale != 1)} stale" if stale else "up to date"
        functions, frozen = len(self.cg.functions), len(self.hyperparameters)
        counts = f"{functions} function{'s' * (functions != 1)}{old}, {frozen} hyperparameter{'s' * (frozen != 1)}"
        return f"<CompGraphRunner: {counts}; {state}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        from epypes.display import mimebundle

        return mimebundle(self)
