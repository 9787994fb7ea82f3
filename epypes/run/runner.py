"""How is a graph run, tuned and run again?"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from time import perf_counter_ns
from typing import Any

from epypes.errors import NotComputed, PayloadError, StaleToken, UnknownName, run_call
from epypes.graph import CompGraph
from epypes.run.engine import StepFailed, execute
from epypes.run.failure import Failure
from epypes.run.guard import own_view, read_only
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.plan import Plan, missing_sources, needed_steps, plan
from epypes.run.program import Program, compile_graph
from epypes.run.record import Run
from epypes.run.report import FunctionTime, RunReport
from epypes.run.tokens import TokenManager

_KEPT_REPORTS = 1000


class CompGraphRunner:
    """Runs a graph; reads like a dictionary of its tokens.

    Parameters
    ----------
    cg
        The graph.
    hparams
        Values of hyperparameter tokens; source tokens that are not among them are free: ``run`` takes them.
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

    def __init__(self, cg: CompGraph, hparams: Mapping[str, Any] | None = None, *, guard: bool = True) -> None:
        if not isinstance(cg, CompGraph):
            kind = type(cg).__name__
            raise TypeError(f"A CompGraphRunner runs a CompGraph, not {kind!r}: CompGraphRunner(cg, hparams).")
        self.cg = cg
        self.guard = guard
        self.reports: deque[RunReport] = deque(maxlen=_KEPT_REPORTS)
        self._program = compile_graph(cg)
        self._next_version = itertools.count(1).__next__
        self._lock = threading.Lock()
        self._last: Run | None = None
        self._hparams = Hyperparameters(cg, {}, {}, 0).frozen(hparams or {}, self._next_version, guard)

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
        UnknownName
            A name is not a token of the graph.
        Exception
            Whatever a function raises, unchanged, with a note; ``last`` is then the failed run.
        """
        hparams = self._hparams
        self._check_targets(targets)
        self._check_payload(hparams, payload)
        manager = TokenManager(self._program)
        hparams.apply(manager)
        for token, value in payload.items():
            manager.put(token, read_only(value) if self.guard else value, self._next_version())
        return self._run(manager, targets, hparams)

    def rerun(self, /, *targets: str, **hparams: Any) -> Run:
        """Set hyperparameters, all or none of them, then run the stale functions on the last payload.

        Raises
        ------
        PayloadError
            Nothing has been run yet.
        HyperparameterError, UnknownName
            A name is not a hyperparameter; nothing is set then.
        Exception
            Whatever a function raises, unchanged, with a note.
        """
        self._check_targets(targets)
        current = self._set(hparams)
        last = self._last
        if last is None:
            free = self.free_source_tokens
            text = f"Nothing has been run yet, so there is no payload. Call {run_call(free)} first."
            raise PayloadError(free, text)
        manager = last.tokens.copy()
        current.apply(manager)
        return self._run(manager, targets, current)

    def plan(self, /, *targets: str) -> Plan:
        """Return what ``rerun(*targets)`` would do."""
        self._check_targets(targets)
        return plan(_tokens_now(self._program, self._last, self._hparams), targets)

    def _run(self, manager: TokenManager, targets: Sequence[str], hparams: Hyperparameters) -> Run:
        start_ns = perf_counter_ns()
        order = needed_steps(manager, targets)
        missing = missing_sources(manager, order)
        if missing:
            listed = ", ".join(map(repr, missing))
            raise PayloadError(missing, f"Missing payload: {listed}. Call {run_call(missing)}.")
        durations_ns: dict[str, int] = {}
        failure: Failure | None = None
        try:
            execute(manager, order, self._next_version, self.guard, durations_ns)
        except StepFailed as failed:
            failure = failed.failure
            manager.forget(self._program.downstream([failed.step.index]))
        partial = failure is not None or len(order) < len(self._program.steps)
        manager.stale = frozenset(manager.stale_steps(range(len(self._program.steps)))) if partial else frozenset()
        report = RunReport(
            tuple(
                FunctionTime(name, durations_ns.get(name, 0), name in durations_ns)
                for name in (self._program.steps[index].name for index in order)
            ),
            perf_counter_ns() - start_ns,
        )
        run = Run(manager, report, failure, hparams.values, hparams.revision)
        with self._lock:
            self._last = run
            self.reports.append(report)
        if failure is not None:
            raise failure.exception
        return run

    def _check_targets(self, targets: Sequence[object]) -> None:
        for token in targets:
            if not isinstance(token, str):
                free = self.free_source_tokens
                kind = type(token).__name__
                text = f"A target is the name of a token, not {kind!r}. Payload goes by name: {run_call(free)}."
                raise PayloadError(free, text)
            self.cg.require_token(token)

    def _check_payload(self, hparams: Hyperparameters, payload: Mapping[str, Any]) -> None:
        for token in payload:
            if token not in self._program.slots:
                raise UnknownName("token", token, hparams.free_source_tokens)
            maker = self.cg.digraph.producer.get(token)
            if maker is not None:
                text = f"Token {token!r} is made by function {maker!r}; run() takes free source tokens only."
                raise PayloadError((token,), text)
            if token in hparams.values:
                text = f"Token {token!r} is a hyperparameter. Set runner[{token!r}], or call unfreeze({token!r})."
                raise PayloadError((token,), text)

    # -- hyperparameters ----------------------------------------------------------------------------------------

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        """The values of the hyperparameters by token: a snapshot."""
        return self._hparams.values

    @property
    def free_source_tokens(self) -> tuple[str, ...]:
        """The source tokens that ``run`` takes, in order of first appearance in func_io."""
        return self._hparams.free_source_tokens

    def freeze(self, /, **values: Any) -> None:
        """Make source tokens hyperparameters, all or none of them."""
        with self._lock:
            self._hparams = self._hparams.frozen(values, self._next_version, self.guard)

    def unfreeze(self, token: str) -> None:
        """Make a hyperparameter a free source token again."""
        with self._lock:
            self._hparams = self._hparams.unfrozen(token)

    def __setitem__(self, token: str, value: Any) -> None:
        self._set({token: value})

    def _set(self, values: Mapping[str, Any]) -> Hyperparameters:
        with self._lock:
            for token in values:
                self._hparams.require(token)
            self._hparams = self._hparams.frozen(values, self._next_version, self.guard)
            return self._hparams

    # -- reading ------------------------------------------------------------------------------------------------

    @property
    def last(self) -> Run | None:
        """The last run that ended, completed or failed."""
        return self._last

    @property
    def stale(self) -> tuple[str, ...]:
        """The functions that ``rerun()`` would run, in run order."""
        return self._stale_since(self._last, self._hparams)

    def _stale_since(self, last: Run | None, hparams: Hyperparameters) -> tuple[str, ...]:
        """Return the functions that these hyperparameters make stale in this run.

        Both are given, so that what is read beside a rerun in another thread is decided from one state.
        """
        if last is not None and last.revision == hparams.revision and not last.tokens.stale and not last.failure:
            return ()
        return plan(_tokens_now(self._program, last, hparams), ()).order

    def __getitem__(self, token: str) -> Any:
        hparams, last = self._hparams, self._last
        if token in hparams.values:
            return own_view(hparams.values[token])
        if last is None:
            self.cg.require_token(token)
            call = run_call(hparams.free_source_tokens)
            text = f"Token {token!r} has not been computed: nothing has been run. Call {call}."
            raise NotComputed(token, text)
        value = last[token]
        if self.cg.digraph.producer.get(token) in self._stale_since(last, hparams):
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
        stale = self._stale_since(last, hparams)
        producer = self.cg.digraph.producer
        readable = set(last or ()) | set(hparams.values)
        return tuple(token for token in self.cg.tokens if token in readable and producer.get(token) not in stale)

    def __repr__(self) -> str:
        if self._last is None:
            state = "not run yet"
        elif self._last.failure:
            state = f"failed in {self._last.failure.function!r:.24}"
        else:
            stale = len(self.stale)
            state = f"{stale} functions stale" if stale else "up to date"
        count = len(self.cg.functions)
        return f"<CompGraphRunner: {count} functions, {len(self.hyperparameters)} hyperparameters; {state}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        from epypes.display import mimebundle

        return mimebundle(self)


def _tokens_now(program: Program, last: Run | None, hparams: Hyperparameters) -> TokenManager:
    """Return a run's tokens with these hyperparameters."""
    manager = TokenManager(program) if last is None else last.tokens.copy()
    hparams.apply(manager)
    return manager
