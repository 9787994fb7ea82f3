"""Promotion by a button, and the values of a service written back: one job at a time, on a thread of its own."""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from epypes.bundle import promote
from epypes.errors import EpypesError, PromotionRefused
from epypes.run import CompGraphRunner
from epypes.wording import counted
from epypes_widgets.values import listed

_LOG: Final = logging.getLogger(__name__)
_NOT_IN_A_NAME: Final = re.compile(r"[^\w.-]+")
_DIFF_CHARACTERS: Final = 20_000
_DIGEST_CHARACTERS: Final = 12


class Job:
    """Work on a thread of its own, one at a time.

    Parameters
    ----------
    name
        Of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._ended.set()

    @property
    def is_running(self) -> bool:
        """Whether work has begun and not ended."""
        return not self._ended.is_set()

    def run(self, work: Callable[[], object]) -> bool:
        """Begin work and return at once; False, and nothing else, if some is running."""
        with self._lock:
            if self.is_running:
                return False
            self._ended.clear()
        threading.Thread(target=self._work, args=(work,), name=self._name, daemon=True).start()
        return True

    def wait_end(self, timeout_s: float) -> None:
        """Return once nothing is running; TimeoutError if that takes longer."""
        if not self._ended.wait(timeout_s):
            raise TimeoutError(f"{self._name} did not end within {timeout_s:g} s.")

    def _work(self, work: Callable[[], object]) -> None:
        try:
            work()
        finally:
            self._ended.set()


@dataclass(frozen=True, slots=True)
class Outcome:
    """How far a promotion, or writing back, has come.

    Attributes
    ----------
    state
        ``"running"``, ``"diff"`` when it is shown what would change, ``"done"`` or ``"refused"``.
    text
        For the user, on several lines if there are several reasons.
    to
        The folder that is promoted to, as it was named.
    diff
        What writing back would change, or has changed.
    """

    state: Literal["running", "diff", "done", "refused"]
    text: str
    to: str = ""
    diff: str = ""


class ReportingJob(Job):
    """A job that reports its outcomes.

    Parameters
    ----------
    name
        Of the thread.
    report
        Is called with each ``Outcome``, on the job's thread. What it raises is logged.
    """

    def __init__(self, name: str, report: Callable[[Outcome], None]) -> None:
        super().__init__(name)
        self._report = report
        self._last: Outcome | None = None

    def start(self, running: Outcome, work: Callable[[], Outcome]) -> bool:
        """Report what is running, then do it, and report what came of it; return at once, False if some is running."""

        def report_both() -> None:
            self._tell(running)
            try:
                outcome = work()
            except BaseException as error:  # a function of the user's may raise anything, SystemExit too
                outcome = Outcome("refused", _text_of(error), running.to)
            self._tell(outcome)

        return self.run(report_both)

    def wait(self, timeout_s: float) -> Outcome | None:
        """Return what was reported last once nothing is running; TimeoutError if that takes longer."""
        self.wait_end(timeout_s)
        return self._last

    def _tell(self, outcome: Outcome) -> None:
        self._last = outcome
        try:
            self._report(outcome)
        except Exception:
            _LOG.exception("The outcome of %s could not be shown", self._name)


def _text_of(error: BaseException) -> str:
    notes = "".join(f"\n{note}" for note in getattr(error, "__notes__", ()))
    text = str(error) if isinstance(error, EpypesError) else f"{type(error).__name__}: {error}"
    return text if isinstance(error, PromotionRefused) else f"Not done: {text}{notes}"


def start_promotion(job: ReportingJob, runner: CompGraphRunner, to: str, outputs: Sequence[str] | None = None) -> bool:
    """Begin to promote a runner and return at once; False, and nothing else, if a promotion is running.

    The runner's own runs are left alone: its graph is run anew, with its hyperparameters and its last payload, since
    its last run may be a partial one and the next one may begin meanwhile.

    Parameters
    ----------
    job
        Reports the outcome.
    runner
        Has been run.
    to
        The folder of the bundle, as for ``ep.promote``; ``~`` is the home folder.
    outputs
        The tokens that the service answers with; the sink tokens without.
    """
    return job.start(Outcome("running", f"Promoting to {to} ...", to), lambda: _promoted(runner, to, outputs))


def proposal(token: str | None) -> str:
    """Return a folder to promote to, by the token that is shown.

    Examples
    --------
    >>> proposal("edges"), proposal("a/b c"), proposal(None)
    ('services/edges', 'services/a-b-c', 'services/graph')
    """
    name = _NOT_IN_A_NAME.sub("-", token or "").strip("-.")[:60]
    return f"services/{name or 'graph'}"


def _promoted(runner: CompGraphRunner, to: str, outputs: Sequence[str] | None) -> Outcome:
    if not to.strip():
        return Outcome("refused", "Not promoted: name a folder, such as services/edges.", to)
    own, last = runner, runner.last
    if last is not None:
        own = CompGraphRunner(
            runner.cg, runner.hyperparameters, guard=runner.guard, check_mutation=runner.check_mutation
        )
        own.run(**{token: last[token] for token in own.free_source_tokens})
    # What it assumes is in the outcome.
    bundle = promote(own, Path(to.strip()).expanduser(), outputs=outputs, on_progress=lambda text: None)
    samples = counted(len(bundle.samples), "sample")
    names = f"output{'s' * (len(bundle.settings.outputs) != 1)} {listed(bundle.settings.outputs)}"
    text = f"Promoted to {to.strip()}: {names}; {samples} replayed in a fresh process, identical."
    assumptions = bundle.settings.assumptions()
    return Outcome("done", f"{text}\n{assumptions}" if assumptions else text, to)


def start_write_back(job: ReportingJob, write: Callable[[bool], Any], *, dry_run: bool) -> bool:
    """Begin to write the values of a service back into its bundle and return at once; False if that is running.

    Parameters
    ----------
    job
        Reports the outcome.
    write
        Is called with ``dry_run``; its answer has ``diff`` and ``digest``.
    dry_run
        Whether to show what would change; nothing is written then.
    """
    text = "Looking at what would change ..." if dry_run else "Writing, and replaying the samples ..."
    return job.start(Outcome("running", text), lambda: _written(write(dry_run), dry_run))


def _written(answer: Any, dry_run: bool) -> Outcome:
    diff, digest = str(answer.diff), str(answer.digest)[:_DIGEST_CHARACTERS]
    if not diff:
        return Outcome("done", f"pipeline.toml has these values already; the bundle is {digest}.")
    diff = diff if len(diff) <= _DIFF_CHARACTERS else f"{diff[:_DIFF_CHARACTERS]}\n..."
    if dry_run:
        return Outcome("diff", "This would change in pipeline.toml.", diff=diff)
    return Outcome("done", f"Written to pipeline.toml and replayed; the bundle is {digest} now.", diff=diff)
