"""State between events, in the worker: what each series of events has left, for the slots that go on with it.

The front says with each event which series it belongs to, and where its state is: ``"held"`` here since the event
before, ``"initial"``, or ``"given"`` as the last frame of the message. Events of one series come one after the other.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import MessageError
from epypes.service.supervision.packing import BytesLike, pack_state, unpack_state

if TYPE_CHECKING:
    from epypes.pipeline import Pipeline
    from epypes.service.supervision.frame_socket import WorkerMessage

# The values by key, as `CompGraphRunner.state`; None for the initial state.
State = Mapping[str, Any] | None
_DIGEST_CHARACTERS: Final = 16


def describe_delays(pipeline: Pipeline, states: Mapping[str, str]) -> dict[str, list[str]]:
    """Return, by key of the state, the token that is delayed and a digest of the initial value.

    Parameters
    ----------
    pipeline
        Before its first event.
    states
        Of its bundle, as ``Settings.states``.
    """
    return {key: [token, _digest(key, pipeline.state[key])] for key, token in states.items()}


def _digest(key: str, value: Any) -> str:
    try:
        block = pack_state({key: value})
    except MessageError:
        # The first event fails, which says why.
        return type(value).__name__
    return hashlib.sha256(block).hexdigest()[:_DIGEST_CHARACTERS]


class WorkerStates:
    """The states of all series of events; slots share it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # By key: the number of the last event that was answered, and the state that it has left.
        self._kept: dict[str, tuple[int, State]] = {}

    def begin(self, message: WorkerMessage) -> tuple[State, Sequence[BytesLike]]:
        """Return the state that an event begins with, and the frames of the event."""
        where, frames = message.content["state"], message.frames
        state: State = None
        if where == "given":
            *frames, block = frames
            state = unpack_state(block)
        with self._lock:
            for other, last_seq in message.content.get("forget", {}).items():
                if other in self._kept and self._kept[other][0] <= last_seq:
                    del self._kept[other]
            if where == "held":
                state = self._kept[message.content["key"]][1]
        return state, frames

    def keep(self, message: WorkerMessage, state: State) -> None:
        """Keep what an event has left. After one that fails the front gives the state again."""
        with self._lock:
            self._kept[message.content["key"]] = message.number, state
