"""The values that are wanted of a runner, and the last run that it has completed.

Values that are set wait here. They are tried on the runner, and taken over by it together with what was computed from
them, in one step; so cells never see the one without the other. Values with which a function fails go on waiting.

What is tuned is a runner of this process, or a running service. What is tried on a runner changes nothing, and only the
user's own cells change it. What is tried on a service is done there, others may tune it at the same time, and its
events come by themselves.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from operator import is_, is_not
from typing import TYPE_CHECKING, Any, TypeAlias

from epypes.errors import InvalidType
from epypes.run import CompGraphRunner, Run
from epypes_widgets.feed import CameraFeed
from epypes_widgets.picture.frame_states import FrameStates
from epypes_widgets.picture.images import Payloads, is_alike

if TYPE_CHECKING:
    from epypes.service.remote.runner import RemoteRunner

Tunable: TypeAlias = "CompGraphRunner | RemoteRunner"


def tunable(given: object) -> Tunable:
    """Return what is tuned: what was given, or what it has for that, as a connection to a service does.

    Raises
    ------
    TypeError
        It can't be tuned.
    """
    found: Any = given.to_tune() if hasattr(given, "to_tune") else given
    if not isinstance(found, CompGraphRunner) and not hasattr(found, "connection"):
        text = f"tune() takes a CompGraphRunner, a connection to a service, or functions, not {type(given).__name__!r}."
        way_out = "Call tune(runner), tune(ep.connect(url)) or tune(function, image=image)."
        if isinstance(given, Run):
            way_out = "Give the runner that made the run: tune(runner)."
        raise InvalidType(f"{text} {way_out}")
    tuned: Tunable = found
    return tuned


class Session:
    """Tries what is wanted on a runner.

    Parameters
    ----------
    runner
        Its hyperparameters and its last run change when a run has completed.
    payloads
        That may be chosen among.
    feed
        The camera whose frames are the payload; its settings are values that may be wanted, too.

    Attributes
    ----------
    result
        The last run that completed; None before the first.
    image
        The index of the payload that it was computed from; None for one that is not among them.
    foreign_payloads
        How many payloads have come from elsewhere, as from a cell.
    is_service
        Whether the functions run in a service: others may set hyperparameters too, whose changes are not to be
        overwritten unseen, and values are written back.
    """

    def __init__(self, runner: Tunable, payloads: Payloads, feed: CameraFeed | None = None) -> None:
        self.runner, self.payloads, self.feed = runner, payloads, feed
        self.is_service = not isinstance(runner, CompGraphRunner)
        self.result: Run | None = None
        self.foreign_payloads = 0
        self.image = self._image_of(runner.last, is_alike)
        # Of a graph with state the payloads are a sequence: each begins with what those before it leave.
        self.states: FrameStates | None = None
        # The frame of ``result`` and the key of the state that it began with.
        self._begun: tuple[int, object] | None = None
        # The runner's last run as of ``result``.
        self._followed: Run | None = None
        self._lock = threading.Lock()
        self._is_closed = False
        self._wanted: dict[str, Any] = {}
        self._refused: list[str] = []
        self._image_wanted: int | None = None
        self._seen = dict(self.hyperparameters)
        if isinstance(runner, CompGraphRunner) and runner.state and len(payloads):
            self.states = FrameStates(runner, self.payloads)
            # Cells may have run this frame with another state.
            self._image_wanted = self.image or 0

    def begin(self) -> None:
        """Have the first payload run if nothing has been; what a function raises on it is raised."""
        if self.feed is None and (self.runner.last is not None or not len(self.payloads)):
            return
        run = self.runner.trial({}, payload=self.payloads[0].values if self.feed is None else self.feed.payload())
        self.runner.adopt(run)
        if run.failure is not None:
            raise run.failure.exception
        self.image = 0 if self.feed is None else None

    # -- from any thread ----------------------------------------------------------------------------------------

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """The hyperparameters of the runner, and the settings of the camera."""
        settings = {} if self.feed is None else self.feed.values
        return {**settings, **self.runner.hyperparameters}

    @property
    def first_hyperparameters(self) -> dict[str, Any]:
        """The same as they were at first."""
        settings = {} if self.feed is None else self.feed.first
        return {**settings, **self.runner.first_hyperparameters}

    @property
    def wanted(self) -> dict[str, Any]:
        """The values that the runner has not taken over, by token."""
        with self._lock:
            return dict(self._wanted)

    @property
    def is_wanting(self) -> bool:
        """Whether anything is asked for that has not been computed."""
        return bool(self._wanted) or self._image_wanted is not None

    @property
    def image_wanted(self) -> int | None:
        """The index of the payload that is asked for; the present one if none is."""
        return self.image if self._image_wanted is None else self._image_wanted

    @property
    def payload(self) -> tuple[Any, ...]:
        """The values of the free source tokens in the last run that completed."""
        run, free = self.result, self.runner.free_source_tokens
        return () if run is None else tuple(_value(run, token) for token in free)

    @property
    def notice(self) -> str:
        """What is wrong with the camera, or with the place where the functions run; empty if nothing is."""
        if self.feed is not None:
            return self.feed.notice
        return "" if isinstance(self.runner, CompGraphRunner) else self.runner.notice

    def want(self, values: Mapping[str, Any]) -> None:
        """Ask for values of hyperparameters; they are newer than what a cell has set on the runner until now.

        What others have set on a service at the same time is not overwritten: see ``changes_of_others``.
        """
        now = self.hyperparameters
        with self._lock:
            self._wanted.update(values)
            if not self.is_service:
                self._seen.update({name: now[name] for name in values if name in now})

    def want_image(self, index: int) -> None:
        """Ask for another payload; IndexError if there is none of this index."""
        if not 0 <= index < len(self.payloads):
            raise IndexError(f"There is no image {index}; this panel has {len(self.payloads)}.")
        with self._lock:
            self._image_wanted = index

    def close(self) -> None:
        """Change the runner no more."""
        self._is_closed = True

    def changes_of_others(self) -> dict[str, Any]:
        """Return the hyperparameters that others have changed since the last call, with their values.

        They count from then on: what was asked for these tokens before is dropped, and so is what was asked for a token
        that is no hyperparameter any more.
        """
        if not isinstance(self.runner, CompGraphRunner):
            self.runner.catch_up()
        if self.feed is not None:
            self.feed.read_again()
        now = self.hyperparameters
        with self._lock:
            changed = {name: value for name, value in now.items() if self._seen.get(name, self) is not value}
            self._seen = now
            self._wanted = {n: value for n, value in self._wanted.items() if n in now and n not in changed}
        return changed

    # -- on the worker's thread ---------------------------------------------------------------------------------

    def bring_up_to_date(
        self,
        targets: Sequence[str],
        *,
        is_wanted: bool = True,
        is_superseded: Callable[[], bool] = lambda: False,
        report: Callable[[str], object] = lambda text: None,
    ) -> tuple[Run, bool]:
        """Compute what is wanted, as far as the targets need it.

        Parameters
        ----------
        targets
            Tokens; everything without.
        is_wanted
            Whether to compute what is wanted; if not, the targets are computed from what the runner has.
        is_superseded
            Is asked, while the frames before a frame are run, whether something newer is wanted.
        report
            Is called with a line of text if that takes long.

        Returns
        -------
        Run
            It may have failed; the runner and ``result`` are then what they were.
        bool
            Whether that is settled. If not, the runner was changed meanwhile: it is to be tried again.

        Raises
        ------
        Superseded
            Something newer is wanted.
        """
        if is_wanted:
            self._write_settings()
        with self._lock:
            wanted, image = (dict(self._wanted), self._image_wanted) if is_wanted else ({}, None)
        last = self.runner.last
        is_own = last is self._followed
        frame = self.image if image is None and is_own else image  # what a cell has run begins as it did there
        begun: tuple[int, object] | None = None
        if self.states is not None and frame is not None:
            begun = frame, self.states.key({**self.runner.hyperparameters, **wanted})
        if self.states is not None and begun is not None and not (begun == self._begun and is_own):
            # So that the runner has the state after the frame, too.
            needed = (*targets, *self.states.targets) if targets else ()
            run = self.states.trial(begun[0], wanted, *needed, is_superseded=is_superseded, report=report)
        else:
            payload = self.payloads[image].values if image is not None and begun is None else None
            if self.feed is not None:
                payload = self.feed.payload()
            run = self.runner.trial(wanted, *targets, payload=payload)
        if run.failure is not None or self._is_closed:
            return run, True
        is_new = bool(wanted) or image is not None or bool(run.report.ran)
        if is_new and not self.runner.adopt(run):
            return run, False
        before = () if is_own else self.payload
        with self._lock:
            self.result = run
            for name, value in wanted.items():
                if self._wanted.get(name, self) is value:
                    del self._wanted[name]
                self._seen[name] = run.hyperparameters[name]
            if image is not None:
                self.image = image
            elif not is_own and (len(before) != len(self.payload) or any(map(is_not, before, self.payload))):
                self.image = self._image_of(run)
                self.foreign_payloads += 1
            if self._image_wanted == image:
                self._image_wanted = None
        self._begun, self._followed = begun, run if is_new else last
        return run, True

    def refusals(self) -> list[str]:
        """Return what the camera has refused since the last call, a sentence each."""
        refused, self._refused = self._refused, []
        return refused

    def _write_settings(self) -> None:
        """Set what is wanted of the camera; what it refuses is wanted no more."""
        if self.feed is None:
            return
        with self._lock:
            wanted = {name: value for name, value in self._wanted.items() if name in self.feed.values}
        self._refused += self.feed.write(wanted) if wanted else []
        with self._lock:
            for name, value in wanted.items():
                if self._wanted.get(name, self) is value:
                    del self._wanted[name]
                self._seen[name] = value

    def insist(self) -> None:
        """Set what is wanted on a runner that is changed all the time; its next run has it."""
        with self._lock:
            wanted, self._wanted = self._wanted, {}
        if isinstance(self.runner, CompGraphRunner):
            self.runner.set(**wanted)
        else:
            self.runner.put(wanted)

    def compared(self, values: Mapping[str, Any], token: str, is_superseded: Callable[[], bool] = lambda: False) -> Run:
        """Return a run with these hyperparameters, on the present payload; LookupError if it can't be had.

        Of a frame of a sequence it begins with the state that these hyperparameters give; Superseded as above.
        """
        known = self.runner.hyperparameters
        values = {name: value for name, value in values.items() if name in known}
        if self.states is not None and self.image is not None:
            return self.states.trial(self.image, values, token, is_superseded=is_superseded)
        if isinstance(self.runner, CompGraphRunner):
            return self.runner.trial(values, token)
        return self.runner.remembered(values, token)

    def _image_of(self, run: Run | None, is_one: Callable[[Any, Any], bool] = is_) -> int | None:
        """Return the index of the payload that a run was computed from."""
        if run is None or not len(self.payloads):
            return None
        return self.payloads.index_of({token: _value(run, token) for token in self.runner.free_source_tokens}, is_one)


def _value(run: Run, token: str) -> Any:
    return run.tokens.values[run.tokens.program.slots[token]]
