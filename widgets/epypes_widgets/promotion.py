"""What becomes of a promotion that was asked for by a button?"""

from __future__ import annotations

import io
import logging
import re
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from epypes.bundle import promote
from epypes.errors import EpypesError, PromotionRefused
from epypes.run import CompGraphRunner
from epypes.wording import counted
from epypes_widgets.values import listed

_LOG: Final = logging.getLogger(__name__)
_PRINTED_CHARACTERS: Final = 4_000
_NOT_IN_A_NAME: Final = re.compile(r"[^\w.-]+")

State = Literal["running", "done", "refused"]


@dataclass(frozen=True, slots=True)
class Outcome:
    """How far a promotion has come.

    Attributes
    ----------
    state
        ``"running"``, ``"done"`` or ``"refused"``.
    text
        For the user, on several lines if there are several reasons.
    to
        The folder, as it was named.
    printed
        What the functions printed meanwhile, its end if it is long; for the log.
    """

    state: State
    text: str
    to: str
    printed: str = ""


class Promotion:
    """Promotes runners on a thread of its own, one at a time.

    Parameters
    ----------
    report
        Is called with each ``Outcome``, the first on the caller's thread, the last on the promotion's. What it raises
        is logged.

    Notes
    -----
    The runner's own runs are left alone: its graph is run anew, with its hyperparameters and its last payload, since
    its last run may be a partial one and the next one may begin meanwhile.
    """

    def __init__(self, report: Callable[[Outcome], None]) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._ended.set()
        self._last: Outcome | None = None

    @property
    def is_running(self) -> bool:
        """Whether a promotion has begun and not ended."""
        return not self._ended.is_set()

    @property
    def last(self) -> Outcome | None:
        """What was reported last; None before the first."""
        return self._last

    def start(self, runner: CompGraphRunner, to: str, outputs: Sequence[str] | None = None) -> bool:
        """Begin a promotion and return at once; False, and nothing else, if one is running.

        Parameters
        ----------
        runner
            Has been run.
        to
            The folder of the bundle, as for ``ep.promote``; ``~`` is the home folder.
        outputs
            The tokens that the service answers with; the sink tokens without.
        """
        with self._lock:
            if self.is_running:
                return False
            self._ended.clear()
        self._tell(Outcome("running", f"Promoting to {to} ...", to))
        thread = threading.Thread(target=self._work, args=(runner, to, outputs), name="epypes-promotion", daemon=True)
        try:
            thread.start()
        except RuntimeError as error:  # no more threads
            self._end(Outcome("refused", f"Not promoted: {error}.", to))
        return True

    def wait(self, timeout_s: float) -> Outcome | None:
        """Return the outcome once nothing is running; TimeoutError if that takes longer."""
        if not self._ended.wait(timeout_s):
            raise TimeoutError(f"The promotion did not end within {timeout_s:g} s.")
        return self._last

    def _work(self, runner: CompGraphRunner, to: str, outputs: Sequence[str] | None) -> None:
        printed = io.StringIO()
        try:
            with _output_of_this_thread(printed):
                state, text = _promoted(runner, to, outputs)
        except BaseException as error:  # a function of the user's may raise anything, SystemExit too
            state, text = "refused", f"Not promoted: {_told(error)}"
        said = printed.getvalue()[-_PRINTED_CHARACTERS:]
        if said:
            _LOG.info("Printed while promoting to %s:\n%s", to, said)
        self._end(Outcome(state, text, to, said))

    def _end(self, outcome: Outcome) -> None:
        self._tell(outcome)
        self._ended.set()

    def _tell(self, outcome: Outcome) -> None:
        self._last = outcome
        try:
            self._report(outcome)
        except Exception:
            _LOG.exception("The outcome of the promotion to %s could not be shown", outcome.to)


def proposal(token: str | None) -> str:
    """Return a folder to promote to, by the token that is shown.

    Examples
    --------
    >>> proposal("edges"), proposal("a/b c"), proposal(None)
    ('services/edges', 'services/a-b-c', 'services/graph')
    """
    name = _NOT_IN_A_NAME.sub("-", token or "").strip("-.")[:60]
    return f"services/{name or 'graph'}"


def _promoted(runner: CompGraphRunner, to: str, outputs: Sequence[str] | None) -> tuple[State, str]:
    if not to.strip():
        return "refused", "Not promoted: name a folder, such as services/edges."
    try:
        folder = Path(to.strip()).expanduser()
        bundle = promote(_complete(runner), folder, outputs=outputs)
    except PromotionRefused as refusal:
        return "refused", str(refusal)
    samples = counted(len(bundle.samples), "sample")
    names = f"output{'s' * (len(bundle.settings.outputs) != 1)} {listed(bundle.settings.outputs)}"
    return "done", f"Promoted to {to.strip()}: {names}; {samples} replayed in a fresh process, identical."


def _complete(runner: CompGraphRunner) -> CompGraphRunner:
    """Return a runner like this one that has run everything on the last payload; as it is if there is none."""
    last = runner.last
    if last is None:
        return runner
    # One function after another: what they print is told from other output by its thread.
    own = CompGraphRunner(runner.cg, runner.hyperparameters, guard=runner.guard, check_mutation=runner.check_mutation)
    own.run(**{token: last[token] for token in own.free_source_tokens})
    return own


def _told(error: BaseException) -> str:
    notes = "".join(f"\n{note}" for note in getattr(error, "__notes__", ()))
    text = str(error) if isinstance(error, EpypesError) else f"{type(error).__name__}: {error}"
    return f"{text}{notes}"


class _Routed:
    """A stream that keeps what one thread writes; all others go on writing where they did."""

    def __init__(self, stream: Any, kept: io.StringIO) -> None:
        self.stream, self._kept = stream, kept
        self._thread: int | None = threading.get_ident()

    def end(self) -> None:
        """Pass everything on from now: an identity of a thread that has ended may be given to another."""
        self._thread = None

    def write(self, text: str) -> int:
        stream = self._kept if threading.get_ident() == self._thread else self.stream
        return int(stream.write(text) or 0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextmanager
def _output_of_this_thread(kept: io.StringIO) -> Iterator[None]:
    """Keep what this thread prints; contextlib's redirection would take the output of the user's cells too."""
    routed = {name: _Routed(getattr(sys, name), kept) for name in ("stdout", "stderr")}
    for name, stream in routed.items():
        setattr(sys, name, stream)
    try:
        yield
    finally:
        for name, stream in routed.items():
            stream.end()
            # Somebody else may have redirected it meanwhile, and will put ours back: it passes everything on.
            if getattr(sys, name) is stream:
                setattr(sys, name, stream.stream)
