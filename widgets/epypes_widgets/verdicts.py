"""The test images that pass with the values that were committed last.

They are checked on a thread of their own, image by image, when the big picture needs nothing; the newest values always
win, and a check of older ones is given up.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import monotonic
from typing import Any, Final

from epypes.batch.cases import Case, Check
from epypes.batch.check import CheckOutcome, CheckResult, Checks, prepare_cases, run_checks
from epypes.batch.items import items_of, payload_of, read_value
from epypes.errors import EpypesError, PayloadError
from epypes.run import CompGraphRunner
from epypes.wording import counted
from epypes_widgets.history import Entry, History
from epypes_widgets.looking.films import Payload, payloads
from epypes_widgets.places import Tunable
from epypes_widgets.tuning import Tuning
from epypes_widgets.values import differing
from epypes_widgets.worker import Worker

Handler = Callable[[Mapping[str, Any]], object]

# The eye follows no more, and hundreds of cases are told at a time.
_TELL_S: Final = 0.2
_LOOK_S: Final = 0.005
_TEXT_CHARACTERS: Final = 300


class Verdicts:
    """Checks the cases of a panel.

    Parameters
    ----------
    runner
        Its graph is run, with the values that are committed; it is left alone itself.
    cases
        With their checks; if none has a check, or there are none, nothing is ever run.
    history
        Tells which values are committed.
    tuning
        Computes the big picture; its screen is told which cases pass.
    """

    def __init__(
        self,
        runner: Tunable,
        cases: Checks,
        history: History,
        tuning: Tuning,
    ) -> None:
        self._runner = runner
        self._cases = cases if any(checks for _, checks in cases) else ()
        self._tuning = tuning
        self._worker = Worker(self._check, tuning.report, "epypes-cases")
        self._lock = threading.Lock()
        self._wanted: Mapping[str, Any] | None = None
        self._over = threading.Event()
        self._has_left = False
        self._result: CheckResult | None = None
        self._forget = history.watch(self._went_to)

    @property
    def is_there(self) -> bool:
        """Whether there is anything to check."""
        return bool(self._cases)

    def beside(self, handlers: Mapping[str, Handler]) -> dict[str, Handler]:
        """Return handlers of a view's messages that also tell us whether there is a view."""
        ready, left = handlers["ready"], handlers["left"]

        def comes_back(message: Mapping[str, Any]) -> None:
            ready(message)
            self.come_back()

        def leaves(message: Mapping[str, Any]) -> None:
            left(message)
            self.leave()

        return {**handlers, "ready": comes_back, "left": leaves}

    def begin(self) -> None:
        """Check with the values that the runner has, unless newer ones were committed."""
        if self._wanted is None:
            self._want(self._runner.hyperparameters)

    def leave(self) -> None:
        """Know that no view is left, so that nobody looks at the verdicts."""
        self._has_left = True
        self._over.set()

    def come_back(self) -> None:
        """Know that there is a view, and check what was not checked meanwhile."""
        if not self._has_left:
            return
        self._has_left = False
        if self._wanted is not None and self._result is None:
            self._ask()

    def wait(self, timeout_s: float) -> CheckResult | None:
        """Return what came of the cases; None if there is nothing to check. TimeoutError if that takes longer."""
        self._worker.wait(timeout_s)
        return self._result

    def close(self, timeout_s: float) -> None:
        """Check nothing any more; StillRunning if a function does not return in time."""
        self._forget()
        self._over.set()
        self._worker.close(timeout_s)

    def _went_to(self, entry: Entry) -> None:
        now = self._runner.hyperparameters
        self._want({**now, **{name: value for name, value in entry.values.items() if name in now}})

    def _want(self, values: Mapping[str, Any]) -> None:
        if not self.is_there or self._worker.closed:
            return
        with self._lock:
            if self._wanted is not None and not differing(self._wanted, values):
                return
            self._wanted, self._result = dict(values), None
        self._ask()

    def _ask(self) -> None:
        self._over.set()
        if not self._has_left:
            self._worker.ask()

    # -- on its own thread --------------------------------------------------------------------------------------

    def _check(self, _asked_ns: int) -> None:
        with self._lock:
            values, self._over = self._wanted, threading.Event()
            over = self._over
        if values is None or self._worker.closed or self._has_left:
            return
        own = CompGraphRunner(self._runner.cg, values, guard=getattr(self._runner, "guard", True))
        came: dict[int, tuple[CheckOutcome, ...]] = {}
        told_s = 0.0
        self._tuning.screen.tell_verdicts(self._content(came))
        for outcomes in run_checks(own, self._cases, has_pictures=False, stop=over):
            came[outcomes[0].number] = outcomes
            if monotonic() - told_s >= _TELL_S:
                self._tuning.screen.tell_verdicts(self._content(came))
                told_s = monotonic()
            while not self._tuning.worker.idle and not over.wait(_LOOK_S):
                pass
        if over.is_set():
            return
        self._tuning.screen.tell_verdicts(self._content(came))
        self._result = CheckResult(tuple(outcome for number in sorted(came) for outcome in came[number]))

    def _content(self, came: Mapping[int, tuple[CheckOutcome, ...]]) -> dict[str, Any]:
        """Return what the view shows, by the index of the test image."""
        verdicts = [_verdict(came.get(number)) for number in range(len(self._cases))]
        passed = sum(verdict["state"] == "passed" for verdict in verdicts)
        waiting = sum(verdict["state"] == "waiting" for verdict in verdicts)
        more = f", {waiting} still to be checked" if waiting else ""
        return {"verdicts": verdicts, "text": f"{passed} of {counted(len(verdicts), 'case')} pass{more}"}


def case_payloads(runner: Tunable, cases: Checks) -> tuple[Payload, ...]:
    """Return the inputs of cases as what a panel can be switched to."""
    return payloads(runner, [case.inputs for case, _ in cases], [case.name or "" for case, _ in cases])


def cases_to_show(runner: Tunable, images: object, cases: Any) -> Checks:
    """Return the cases of a panel with their checks; files are read once, for all checks.

    Raises
    ------
    TypeError
        There are images too.
    PayloadError
        It is a service.
    ScaleError, UnknownName
        As ``ep.check`` does.
    ImageFileError
        An input can't be read, so there is no test image to show.
    """
    if cases is None:
        return ()
    if images is not None:
        raise TypeError("tune() takes images or cases, not both: the inputs of the cases are the test images.")
    if not isinstance(runner, CompGraphRunner):
        free = runner.free_source_tokens
        raise PayloadError(free, "A service makes its own events, so it takes no cases. Check its bundle: ep.check().")
    return _held(runner, prepare_cases(runner, cases))


def _held(runner: CompGraphRunner, cases: Checks) -> Checks:
    """Return cases whose files have been read; what was expected and can't be read is left to fail each time."""
    items = items_of((case.inputs for case, _ in cases), runner)
    return [
        (replace(case, inputs=payload_of(item, runner.cg), expected=_labels(case, runner)), _with_label(checks, runner))
        for item, (case, checks) in zip(items, cases, strict=True)
    ]


def _labels(case: Case, runner: CompGraphRunner) -> dict[str, Any]:
    return {token: _label(value, runner, token) for token, value in (case.expected or {}).items()}


def _with_label(checks: Sequence[Check], runner: CompGraphRunner) -> tuple[Check, ...]:
    return tuple(
        check if check.token is None else replace(check, expected=_label(check.expected, runner, check.token))
        for check in checks
    )


def _label(value: Any, runner: CompGraphRunner, token: str) -> Any:
    try:
        return read_value(value, runner.cg, token)
    except (EpypesError, OSError):
        return value


def _verdict(outcomes: tuple[CheckOutcome, ...] | None) -> dict[str, str]:
    if outcomes is None:
        return {"state": "waiting", "text": "not checked yet"}
    failures = [outcome for outcome in outcomes if not outcome.passed]
    if not failures:
        return {"state": "passed", "text": f"{counted(len(outcomes), 'check')} passed"}
    more = f", and {counted(len(failures) - 1, 'check')} more" if len(failures) > 1 else ""
    return {"state": "failed", "text": f"{failures[0].check}: {failures[0].reason}"[:_TEXT_CHARACTERS] + more}
