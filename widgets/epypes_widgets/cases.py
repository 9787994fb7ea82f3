"""The cases of a panel: which test images pass with the values that were committed last.

They are checked on a thread of their own, image by image, when the big picture needs nothing; a check of older values
is given up.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from time import monotonic
from typing import Any, Final

from epypes.batch.check import CheckOutcome, CheckResult, Checks, prepare_cases, run_checks
from epypes.batch.items import items_of, payload_of, read_value
from epypes.errors import EpypesError, InvalidType, PayloadError, ScaleError
from epypes.run import CompGraphRunner
from epypes.wording import counted
from epypes_widgets.history import History
from epypes_widgets.session import Tunable
from epypes_widgets.tuning import Tuning
from epypes_widgets.values import differing
from epypes_widgets.worker import Worker

# The eye follows no more, and hundreds of cases are reported at a time.
_REPORT_S: Final = 0.2
_LOOK_S: Final = 0.005
_TEXT_CHARACTERS: Final = 300


class Cases:
    """Checks the cases of a panel.

    Parameters
    ----------
    runner
        Its graph is run, with the values that are committed; it is left alone itself.
    cases
        With their checks; if none has a check, or there are none, nothing is ever run.
    history
        Its entries are the values that are committed.
    tuning
        Computes the big picture; its screen shows which cases pass.
    """

    def __init__(self, runner: Tunable, cases: Checks, history: History, tuning: Tuning) -> None:
        self._runner, self._tuning = runner, tuning
        self._cases = cases if any(checks for _, checks in cases) else ()
        self._worker = Worker("epypes-cases", tuning.report)
        self._lock = threading.Lock()
        self._wanted: Mapping[str, Any] | None = None
        self._over = threading.Event()
        self._has_left = False
        self._result: CheckResult | None = None
        self._forget = history.watch(lambda entry: self._want(entry.values))

    def begin(self) -> None:
        """Check with the values that the runner has, unless newer ones were committed."""
        if self._wanted is None:
            self._want(self._runner.hyperparameters)

    def leave(self) -> None:
        """Take note that no view is left: nothing is checked without one."""
        self._has_left = True
        self._over.set()

    def come_back(self) -> None:
        """Take note that there is a view, and check what was not checked meanwhile."""
        if self._has_left:
            self._has_left = False
            if self._result is None:
                self._request()

    def wait(self, timeout_s: float) -> CheckResult | None:
        """Return the result of the check; None if there is nothing to check. TimeoutError if that takes longer."""
        self._worker.wait(timeout_s)
        return self._result

    def close(self, timeout_s: float) -> None:
        """Check nothing any more; StillRunning if a function does not return in time."""
        self._forget()
        self._over.set()
        self._worker.close(timeout_s)

    def _want(self, committed: Mapping[str, Any]) -> None:
        now = self._runner.hyperparameters
        values = {name: committed.get(name, value) for name, value in now.items()}
        with self._lock:
            if self._wanted is not None and not differing(self._wanted, values):
                return
            self._wanted, self._result = values, None
        self._request()

    def _request(self) -> None:
        with self._lock:
            values, before, self._over = self._wanted, self._over, threading.Event()
            before.set()
            if self._cases and values is not None and not self._has_left:
                self._worker.post("check", partial(self._check, values, self._over))

    def _check(self, values: Mapping[str, Any], over: threading.Event) -> None:
        """Check all cases with some values, on the worker's thread, until it is over."""
        screen, pending = self._tuning.screen, self._tuning.worker.is_pending
        own = CompGraphRunner(self._runner.cg, values, guard=getattr(self._runner, "guard", True))
        done: dict[int, tuple[CheckOutcome, ...]] = {}
        reported_s = 0.0
        screen.tell("cases", self._content(done))
        for outcomes in run_checks(own, self._cases, has_pictures=False, stop=over):
            done[outcomes[0].number] = outcomes
            if monotonic() - reported_s >= _REPORT_S:
                screen.tell("cases", self._content(done))
                reported_s = monotonic()
            while pending("compute") and not over.wait(_LOOK_S):
                pass
        if not over.is_set():
            screen.tell("cases", self._content(done))
            self._result = CheckResult(tuple(outcome for number in sorted(done) for outcome in done[number]))

    def _content(self, done: Mapping[int, tuple[CheckOutcome, ...]]) -> dict[str, Any]:
        """Return what the view shows, by the index of the test image."""
        verdicts = [_verdict(done.get(number)) for number in range(len(self._cases))]
        states = [verdict["state"] for verdict in verdicts]
        waiting = states.count("waiting")
        more = f", {waiting} still to be checked" if waiting else ""
        return {"verdicts": verdicts, "text": f"{states.count('passed')} of {counted(len(states), 'case')} pass{more}"}


def _verdict(outcomes: tuple[CheckOutcome, ...] | None) -> dict[str, str]:
    if outcomes is None:
        return {"state": "waiting", "text": "not checked yet"}
    failures = [outcome for outcome in outcomes if not outcome.passed]
    if not failures:
        return {"state": "passed", "text": f"{counted(len(outcomes), 'check')} passed"}
    more = f", and {counted(len(failures) - 1, 'check')} more" if len(failures) > 1 else ""
    return {"state": "failed", "text": f"{failures[0].check}: {failures[0].reason}"[:_TEXT_CHARACTERS] + more}


def read_cases(runner: Tunable, images: object, cases: Any) -> Checks:
    """Return the cases of a panel with their checks.

    Files are read once, for all checks; what was expected and can't be read is left to fail each time.

    Raises
    ------
    TypeError
        There are images too, or a case is of a video.
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
        raise InvalidType("tune() takes images or cases, not both: the inputs of the cases are the test images.")
    if not isinstance(runner, CompGraphRunner):
        free = runner.free_source_tokens
        raise PayloadError(free, "A service makes its own events, so it takes no cases. Check its bundle: ep.check().")
    if runner.state:
        text = "The graph has state between runs, so a case is a sequence, and no image that a panel can show."
        raise ScaleError(f"{text} Tune on one, images=[...], and check them all: ep.check(runner, cases).")
    prepared = prepare_cases(runner, cases)
    items = items_of((case.inputs for case, _ in prepared), runner)
    read = []
    for item, (case, checks) in zip(items, prepared, strict=True):
        if item.frame is not None:
            text = f"{item.name} is a frame of a video, which a panel does not check. Give the video as images, or"
            raise InvalidType(f"{text} frames of it as inputs: ep.Case(video[17]); ep.check checks each frame.")
        labels = {token: _label(value, runner, token) for token, value in (case.expected or {}).items()}
        with_labels = tuple(
            check if check.token is None else replace(check, expected=_label(check.expected, runner, check.token))
            for check in checks
        )
        read.append((replace(case, inputs=payload_of(item, runner.cg), expected=labels), with_labels))
    return read


def _label(value: Any, runner: CompGraphRunner, token: str) -> Any:
    try:
        return read_value(value, runner.cg, token)
    except (EpypesError, OSError):
        return value
