"""What each frame of a sequence begins with: the state that the runs over the frames before it leave.

The state as of a frame is that of runs over all frames before it, from the initial state, with the same
hyperparameters; what the delayed tokens do not need is not run for it. States are kept at checkpoints, so going to
another frame runs those since the last checkpoint. They count as long as nothing changes that the state depends on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from time import monotonic
from typing import Any, Final

from epypes.batch.cache import NoDigest, value_digest
from epypes.batch.grid import identity
from epypes.errors import ImageFileError
from epypes.graph import subgraph
from epypes.run import CompGraphRunner, Run
from epypes.run.guard import is_array
from epypes.run.program import INITIAL_STATE, REVISION
from epypes_widgets.picture.images import Payloads

State = Mapping[str, Any]

_MOST_CHECKPOINTS: Final = 64
_MOST_BYTES: Final = 256 * 2**20
# The values that are tuned, and those that the picture is compared with.
_MOST_KEPT: Final = 2
_REPORT_S: Final = 0.2


class Superseded(Exception):
    """Something newer is wanted; the states that were computed until then are kept."""


class _Checkpoints:
    """States by frame: every ``stride``-th, and the last one that was computed."""

    def __init__(self, initial: State) -> None:
        self.stride = 1
        self._states: dict[int, State] = {0: initial}
        self._last = 0, initial

    def nearest(self, frame: int) -> tuple[int, State]:
        """Return the last frame until the given one whose state is known, and that state."""
        place = max(place for place in self._states if place <= frame)
        return self._last if place <= self._last[0] <= frame else (place, self._states[place])

    def add(self, frame: int, state: State) -> None:
        """Keep a state, and fewer of the others if there is no room."""
        self._last = frame, state
        if frame % self.stride:
            return
        self._states[frame] = state
        most = min(_MOST_CHECKPOINTS, max(2, _MOST_BYTES // max(1, _nbytes(state))))
        while len(self._states) > most:
            self.stride *= 2
            self._states = {place: kept for place, kept in self._states.items() if place % self.stride == 0}


def _nbytes(state: State) -> int:
    values = [item for value in state.values() for item in (value if isinstance(value, tuple | list) else (value,))]
    return sum(value.nbytes for value in values if is_array(value))


def _identity(value: Any) -> object:
    """Return what is equal for values with which a function computes the same, as far as that can be seen."""
    try:
        return value_digest(value)
    except NoDigest:
        return identity(value)


class FrameStates:
    """The states as of the frames of a sequence.

    Parameters
    ----------
    runner
        Its graph is run, by trials: it is left as it is.
    payloads
        The frames.

    Attributes
    ----------
    targets
        The tokens from which the state is taken.
    """

    def __init__(self, runner: CompGraphRunner, payloads: Payloads) -> None:
        self._runner, self._payloads = runner, payloads
        cg = runner.cg
        self._initial: State = dict(CompGraphRunner(cg, runner.hyperparameters, guard=runner.guard).state)
        nested = [name for name, function in cg.functions.items() if getattr(function, INITIAL_STATE, None)]
        tokens = [delay.token for delay in cg.delays.values()]
        tokens += [token for name in nested for token in cg.func_outputs(name)]
        self.targets = tuple(dict.fromkeys(tokens))
        needed = subgraph(cg, self.targets)
        self._tokens, self._inside = needed.source_tokens, tuple(f"{name}__" for name in needed.functions)
        # The one that was used last stands last.
        self._known: dict[object, _Checkpoints] = {}

    def key(self, values: Mapping[str, Any]) -> object:
        """Return what is equal as long as the states with these hyperparameters are the same."""
        functions = self._runner.cg.functions.values()
        revisions = [getattr(one, REVISION)(()) for one in functions if hasattr(type(one), REVISION)]
        inside = [token for token in values if token not in self._tokens and token.startswith(self._inside)]
        tokens = (*(token for token in self._tokens if token in values), *sorted(inside))
        return (*(_identity(values[token]) for token in tokens), *revisions)

    def trial(
        self,
        frame: int,
        changes: Mapping[str, Any],
        *targets: str,
        is_superseded: Callable[[], bool] = lambda: False,
        report: Callable[[str], object] = lambda text: None,
    ) -> Run:
        """Return a run on a frame, with changes of hyperparameters and the state that these give.

        Parameters
        ----------
        frame
            Its index.
        changes
            Hyperparameters by token; the others are the runner's.
        targets
            Tokens; only what they need is run, everything without.
        is_superseded
            Is asked before each run on a frame before it whether something newer is wanted.
        report
            Is called with a line of text, now and then, if that takes long.

        Raises
        ------
        Superseded
            Something newer is wanted.
        """
        state = self._before(frame, {**self._runner.hyperparameters, **changes}, is_superseded, report)
        return self._runner.trial(changes, *targets, payload=self._payloads[frame].values, state=state)

    def _before(
        self,
        frame: int,
        values: Mapping[str, Any],
        is_superseded: Callable[[], bool],
        report: Callable[[str], object],
    ) -> State:
        key = self.key(values)
        self._known[key] = known = self._known.pop(key, None) or _Checkpoints(self._initial)
        for old in list(self._known)[:-_MOST_KEPT]:
            del self._known[old]
        place, state = known.nearest(frame)
        first, begun_s, reports = place, monotonic(), 0
        try:
            while place < frame:
                if is_superseded():
                    raise Superseded
                # A frame that can't be read leaves the state as it was, as one on which a function fails does.
                with suppress(ImageFileError):
                    payload = self._payloads[place].values
                    state = self._runner.trial(values, *self.targets, payload=payload, state=state).state
                place += 1
                known.add(place, state)
                if monotonic() - begun_s >= _REPORT_S * (reports + 1):
                    reports += 1
                    report(f"Running the frames before this one: {place - first} of {frame - first}")
        finally:
            if reports:
                report("")
        return state
