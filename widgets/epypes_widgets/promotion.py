"""What is done with the bundle of a panel: promotion by a button, and the values of a service written back into it."""

from __future__ import annotations

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
from epypes_widgets.worker import Worker

_NOT_IN_A_NAME: Final = re.compile(r"[^\w.-]+")
_DIFF_CHARACTERS: Final = 20_000
_DIGEST_CHARACTERS: Final = 12


@dataclass(frozen=True, slots=True)
class Outcome:
    """How far a promotion, or writing back, has come.

    Attributes
    ----------
    kind
        ``"promoted"`` or ``"written"``: which of the two.
    state
        ``"running"``, ``"diff"`` when it is shown what would change, ``"done"`` or ``"refused"``.
    text
        For the user, on several lines if there are several reasons.
    to
        The folder that is promoted to, as it was named.
    diff
        What writing back would change, or has changed.
    """

    kind: Literal["promoted", "written"]
    state: Literal["running", "diff", "done", "refused"]
    text: str
    to: str = ""
    diff: str = ""


class BundleJob:
    """Promotes a runner or writes the values of a service back: one at a time, on a thread of its own.

    Parameters
    ----------
    report
        Is called with each ``Outcome``, on that thread: what is running, then what came of it. What it raises is
        logged.
    """

    def __init__(self, report: Callable[[Outcome], object]) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._last: Outcome | None = None
        self._worker = Worker("epypes-bundle")

    def promote(self, runner: CompGraphRunner, to: str, outputs: Sequence[str] | None = None) -> bool:
        """Begin to promote a runner and return at once; False, and nothing else, if something is running.

        The runner's own runs are left alone: its graph is run anew, with its hyperparameters and its last payload,
        since its last run may be a partial one and the next one may begin meanwhile.

        Parameters
        ----------
        runner
            Has been run.
        to
            The folder of the bundle, as for ``ep.promote``; ``~`` is the home folder.
        outputs
            The tokens that the service answers with; the sink tokens without.
        """
        running = Outcome("promoted", "running", f"Promoting to {to} ...", to)
        return self._start(running, lambda: _promoted(runner, to, outputs))

    def write_back(self, write: Callable[[bool], Any], *, dry_run: bool) -> bool:
        """Begin to write the values of a service into its bundle and return at once; False if something is running.

        Parameters
        ----------
        write
            Is called with ``dry_run``; its answer has ``diff`` and ``digest``.
        dry_run
            Whether to show what would change; nothing is written then.
        """
        text = "Looking at what would change ..." if dry_run else "Writing, and replaying the samples ..."
        return self._start(Outcome("written", "running", text), lambda: _written(write(dry_run), dry_run))

    def wait(self, timeout_s: float) -> Outcome | None:
        """Return what came of the last one; None if there was none. TimeoutError if it takes longer."""
        self._worker.wait(timeout_s)
        return self._last

    def _start(self, running: Outcome, work: Callable[[], Outcome]) -> bool:
        with self._lock:
            if self._last is not None and self._last.state == "running":
                return False
            self._last = running
        self._worker.post("running", lambda: self._report(running))
        self._worker.post("outcome", lambda: self._do(running, work))
        return True

    def _do(self, running: Outcome, work: Callable[[], Outcome]) -> None:
        try:
            self._last = work()
        except BaseException as error:  # a function of the user's may raise anything, SystemExit too
            self._last = Outcome(running.kind, "refused", _text_of(error), running.to)
        self._report(self._last)


def _text_of(error: BaseException) -> str:
    notes = "".join(f"\n{note}" for note in getattr(error, "__notes__", ()))
    text = str(error) if isinstance(error, EpypesError) else f"{type(error).__name__}: {error}"
    return text if isinstance(error, PromotionRefused) else f"Not done: {text}{notes}"


def proposal(outputs: Sequence[str]) -> str:
    """Return a folder to promote to, by the tokens that the service will answer with.

    Examples
    --------
    >>> proposal(["edges"]), proposal(["mask", "a/b c"]), proposal([])
    ('services/edges', 'services/mask-a-b-c', 'services/graph')
    """
    name = _NOT_IN_A_NAME.sub("-", "-".join(outputs)).strip("-.")[:60]
    return f"services/{name or 'graph'}"


def _promoted(runner: CompGraphRunner, to: str, outputs: Sequence[str] | None) -> Outcome:
    if not to.strip():
        return Outcome("promoted", "refused", "Not promoted: name a folder, such as services/edges.", to)
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
    return Outcome("promoted", "done", f"{text}\n{assumptions}" if assumptions else text, to)


def _written(answer: Any, dry_run: bool) -> Outcome:
    diff, digest = str(answer.diff), str(answer.digest)[:_DIGEST_CHARACTERS]
    if not diff:
        return Outcome("written", "done", f"pipeline.toml has these values already; the bundle is {digest}.")
    diff = diff if len(diff) <= _DIFF_CHARACTERS else f"{diff[:_DIFF_CHARACTERS]}\n..."
    if dry_run:
        return Outcome("written", "diff", "This would change in pipeline.toml.", diff=diff)
    text = f"Written to pipeline.toml and replayed; the bundle is {digest} now."
    return Outcome("written", "done", text, diff=diff)
