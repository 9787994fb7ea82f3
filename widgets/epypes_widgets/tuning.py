"""From a value that is set to its picture on the screen, and to the history.

A value that is set is wanted from then on (``session``), and the worker gets a request. It tries what is wanted, shows
the result, and commits it to the history when the values have stayed the same for a moment.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import inf
from time import perf_counter_ns
from typing import Any, Final

from epypes.errors import NotComputed, StillRunning
from epypes.graph import subgraph
from epypes.run import Failure, Run
from epypes_widgets.controls.control import ControlSet
from epypes_widgets.history import Entry, History
from epypes_widgets.picture.frame_states import Superseded
from epypes_widgets.picture.frames import thumbnail
from epypes_widgets.picture.screen import Comparison, Screen
from epypes_widgets.session import Session
from epypes_widgets.values import is_same, short_text
from epypes_widgets.worker import Worker

_LOG: Final = logging.getLogger(__name__)
# Keys come at most every 30 ms when one is held down; a pause of this length is a choice.
REST_S: Final = 0.25
# The last value of a drag may arrive after the message that the slider was released.
_AFTER_RELEASE_S: Final = 0.06
_STILL_S: Final = 0.5
# A cell that changes the runner all the time must not keep pictures from being shown, or values from counting.
_MAX_ATTEMPTS: Final = 3
_CLOSED: Final = "This panel is closed: the picture and the values are the last ones."


class Tuning:
    """The loop of a panel.

    Parameters
    ----------
    controls, session, history, worker
        What is moved, wanted and remembered, and the thread that computes.
    screen
        Shows what was computed.
    settled
        Is called on the worker's thread some time after values were committed.

    Attributes
    ----------
    is_live
        Whether values are computed as they come; if not, ``run`` computes them.
    """

    def __init__(
        self,
        controls: ControlSet,
        session: Session,
        history: History,
        worker: Worker,
        screen: Screen,
        settled: Callable[[], None],
    ) -> None:
        self.controls, self.session, self.history, self.screen = controls, session, history, screen
        self.runner, self.worker = session.runner, worker
        self.is_live = True
        self._settled, self._is_superseded = settled, partial(worker.is_superseded, "compute")
        self._lock = threading.Lock()
        self._commits = self._is_forced = self._has_looked = self._is_unwell = False
        self._forget: Callable[[], None] | None = self.runner.watch(self._runner_changed)
        for control in controls.controls:
            control.on_change(self._moved)
        if session.feed is not None:
            session.feed.follow(self._frame_arrived)

    def begin(self) -> None:
        """Show what the runner has, if that is up to date; else have it computed."""
        last = self.runner.last
        if last is not None and last.failure is None and not self.runner.stale and not self.session.is_wanting:
            self.session.result = last
            self.screen.follow(last)
            self.screen.show(last, 0)
            self._commit()
        else:
            self._commits = True
            self._request()

    def close(self, timeout_s: float) -> None:
        """Follow nothing any more; StillRunning names the functions that have not returned in time."""
        is_first = not self.worker.closed
        self._unwatch()
        self.session.close()
        try:
            self.worker.close(timeout_s)
        except StillRunning as error:
            raise StillRunning(error.name, self.runner.running, timeout_s) from None
        finally:
            if is_first:  # leave the last picture that completed, with the values that it was made with
                self.controls.release()
                run = self.session.result
                if run is not None:
                    self.screen.log(*self.controls.follow(self.values_of(run)))
                    self.screen.show(run, 0)
                self.screen.close(_CLOSED)
                self._settled()

    # -- from any thread ----------------------------------------------------------------------------------------

    def want(
        self, values: Mapping[str, Any], *, commit: bool = True, by_user: bool = False, is_return: bool = False
    ) -> None:
        """Move controls to values and have them computed; ValueError, and nothing is done, if one is out of range."""
        if by_user:
            values = self.controls.moved(values)
        with self._lock:  # of two threads the one whose value stands is wanted last
            self.session.want(self.controls.set(values, by_user=by_user, is_return=is_return))
        self._wanted(commit=commit)

    def first_values(self, names: Sequence[str] = ()) -> dict[str, Any]:
        """Return the values that the runner had hyperparameters frozen with, by name; all without names."""
        first = self.session.first_hyperparameters
        for name in names:
            self.controls.control(name)
        return {name: first[name] for name in names or self.controls.values if name in first}

    def want_image(self, index: int, *, commit: bool = True) -> None:
        """Have another payload computed; IndexError if there is none."""
        self.session.want_image(index)
        self._wanted(commit=commit)

    def look(self, **shown: Any) -> None:
        """Change what is shown and have it computed, live or not; if not, from the values that the runner has."""
        self.screen.change(**shown)
        self._has_looked = True
        self._request()

    def release(self) -> None:
        """Commit what the user has released."""
        waited, refused = self.controls.release()
        self.screen.log(*refused)
        if waited:
            self.session.want(waited)
            self._request()
        if self.is_live:
            self._commit_later(_AFTER_RELEASE_S)

    def run(self) -> None:
        """Compute what is wanted, live or not."""
        self._is_forced = self._commits = True
        self._request()

    def undo(self) -> bool:
        """Go to the values before, which are those of the present entry if what is wanted now has no run."""
        history = self.history
        return self.go_to(lambda: history.current if self.screen.is_beyond else history.undo())

    def go_to(self, find: Callable[[], Entry | None]) -> bool:
        """Go to the entry of the history that is found after the present values were committed; False if none is."""
        run = self.session.result
        if run is not None and not self.session.is_wanting:
            self._add(run)
        entry = find()
        if entry is None:
            return False
        values = {name: value for name, value in entry.values.items() if name in self.session.hyperparameters}
        with self._lock:
            self.screen.log(*self.controls.follow(values, is_return=True))
            self.session.want(values)
        if entry.image not in (None, self.session.image_wanted) and entry.image in range(len(self.session.payloads)):
            self.session.want_image(entry.image or 0)
        self._is_forced = True
        self._request()
        self.screen.send_history()
        return True

    def leave(self) -> None:
        """Take note that no view is left: a service without one is not listened to."""
        if self.session.is_service:
            self._unwatch()

    def come_back(self) -> None:
        """Take note that there is a view, and show what has happened meanwhile."""
        if self._forget is None and not self.worker.closed:
            self._forget = self.runner.watch(self._runner_changed)
            self._request()

    def seen(self) -> None:
        """Take note that a frame has been painted: what came meanwhile is next."""
        self.worker.hasten("newer")

    def report(self, exception: BaseException) -> None:
        """Say what failed in the panel itself, in its log and in that of the process."""
        _LOG.error("The panel has failed", exc_info=exception)
        self.screen.log(f"{type(exception).__name__}: {exception}")

    def _moved(self, values: Mapping[str, Any]) -> None:
        """Take values that the user has moved, on the thread that handles messages of the front end."""
        with self._lock:
            values = self.controls.moved(values)
            if values:
                self.session.want({name: self.controls.control(name).read()[name] for name in values})
        if values:
            self._wanted(commit=False)

    def _wanted(self, *, commit: bool) -> None:
        self.screen.note("")
        if commit:
            self._commits = True
        else:
            self._commit_later(REST_S)
        self._request()

    def _request(self) -> None:
        self.worker.post("compute", partial(self._compute, perf_counter_ns()))

    def _frame_arrived(self) -> None:
        """Have the newest frame of the camera computed when the picture on its way has been painted."""
        self.worker.post("live", partial(self._compute, 0), is_work=False)

    def values_of(self, run: Run) -> dict[str, Any]:
        """Return the hyperparameters of a run, and the settings of the camera."""
        return {**self.session.hyperparameters, **run.hyperparameters}

    def _runner_changed(self) -> None:
        if not self.worker.is_current:
            self.screen.refer_anew()
            self._request()

    def _unwatch(self) -> None:
        forget, self._forget = self._forget, None
        if forget is not None:
            forget()

    def _commit_later(self, delay_s: float) -> None:
        self.worker.post("commit", self._commit, delay_s)

    # -- on the worker's thread ---------------------------------------------------------------------------------

    def _compute(self, changed_ns: int) -> None:
        """Bring the screen up to date with all that is wanted."""
        is_changed = self._follow_others()
        is_wanted = self.is_live or self._is_forced or self.session.result is None
        is_asked = self._is_forced or self._has_looked or self._is_unwell
        self._is_forced = self._has_looked = False
        if not (is_wanted or is_asked):
            self._show_notice()
            return
        is_moved = is_asked or self.session.is_wanting
        if self.screen.view.frames.left and not is_moved:
            return  # the cell was run again, and another panel shows this runner now
        # Also if the runner was run since its run was shown.
        is_moved = is_moved or is_changed or self.runner.last is not self.session.result
        if is_moved or not self._waits_for_screen():
            self._show_run(is_wanted, changed_ns if is_moved else 0)

    def _show_run(self, is_wanted: bool, changed_ns: int) -> None:
        # Taken here: what is asked for while this is computed is committed by the next run.
        commits, self._commits = self._commits, False
        try:
            run, is_settled = self._tried(is_wanted)
        except Superseded:  # what was computed for it is kept, and the newer request is next
            self._is_forced, self._has_looked, self._commits = is_wanted, True, self._commits or commits
            return
        except Exception as error:  # what is wanted can't be run: a placeholder, a branch that is not there
            self._commits |= commits
            if not self.worker.closed:
                self._refuse(error)
            return
        if self.worker.closed:
            return
        if run.failure is not None:
            self._commits |= commits
            self._fail(run, run.failure)
        else:
            had_failed = bool(self.screen.error)
            self.screen.follow(run)
            self.screen.show(run, changed_ns)
            if had_failed:  # there is nothing left that could be undone
                self.screen.send_history()
            self._show_notice()
            if not is_settled:
                self.session.insist()
                self._commit_later(REST_S)
            elif commits:
                self._commit(is_final=True)
            elif self._late_tiles(run) and not self.worker.is_pending("commit"):
                self._commit_later(REST_S)
        self._compare()

    def _tried(self, is_wanted: bool) -> tuple[Run, bool]:
        for _ in range(_MAX_ATTEMPTS):
            self.screen.tiles.failures.clear()
            run, is_settled = self._run(self.screen.targets, is_wanted=is_wanted)
            while self.screen.tiles.is_at_fault(run, self.screen.shown.targets):
                run, is_settled = self._run(self.screen.targets, is_wanted=is_wanted)
            if is_settled:
                break
            self._follow_others()
        return run, is_settled

    def _run(self, targets: Sequence[str], *, is_wanted: bool) -> tuple[Run, bool]:
        found = self.session.bring_up_to_date(
            targets, is_wanted=is_wanted, is_superseded=self._is_superseded, report=self.screen.note
        )
        for text in self.session.refusals():
            self.screen.log(text)
            self.screen.note(text)
        return found

    def _refuse(self, error: Exception) -> None:
        """Say why there is no run."""
        if isinstance(error, NotComputed) and self.session.is_service:
            if self.session.result is not None:
                self.screen.show(self.session.result, 0)
            self.screen.note(str(error), waits=True)
        else:
            self._is_unwell = bool(self.session.notice)
            self.screen.fail(str(error), names=tuple(getattr(error, "problems", ())))

    def _waits_for_screen(self) -> bool:
        """Whether a newer run is to be fetched only when the picture on its way has been painted."""
        frames = self.screen.view.frames
        if frames.in_flight is None:
            return False
        self.worker.post("newer", self._request, inf, is_work=False)
        if frames.in_flight is None:  # it was painted before that was posted
            self.worker.hasten("newer")
        return True

    def _show_notice(self) -> None:
        """Say what is wrong with the place where the functions run: the picture may not be the newest."""
        notice = self.session.notice
        self._is_unwell = bool(notice)
        if notice and notice != self.screen.error:
            self.screen.fail(notice)

    def _follow_others(self) -> bool:
        """Move the controls to what others have set; return whether they have set anything."""
        wanted = self.session.wanted
        changed = self.session.changes_of_others()
        if changed:
            if self.session.is_service:
                self._show_conflict(wanted, changed)
            self.screen.log(*self.controls.follow(changed))
            self._commit_later(REST_S)
        return bool(changed)

    def _show_conflict(self, wanted: Mapping[str, Any], changed: Mapping[str, Any]) -> None:
        """Say which values of the user are not set, since another client has set them at the same time."""
        held = self.controls.contest(changed)
        for name, value in changed.items():
            if name in held or (name in wanted and not is_same(wanted[name], value)):
                mine = f"{short_text(wanted[name])} was not set" if name in wanted else "it stays so"
                way_out = "Move it again to change it."
                sentence = f"Another client has set {name} to {short_text(value)}; {mine}. {way_out}"
                self.screen.log(sentence)
                self.screen.note(sentence)

    def _fail(self, run: Run, failure: Failure) -> None:
        good = self.session.result
        if good is not None:
            self.screen.show(good, 0, failed=run)
        had_failed = bool(self.screen.error)
        self.screen.fail(_failure_text(run, failure), failure.function, self._at_fault(run, failure.function))
        if not had_failed:  # what failed can be undone
            self.screen.send_history()

    def _at_fault(self, run: Run, function: str) -> list[str]:
        """Return what was set and goes into a function, or into what it is given; if nothing was, all that it takes."""
        cg, wanted = self.runner.cg, self.session.wanted
        if function not in cg.functions:
            return []  # f_in or f_out of a service
        behind = subgraph(cg, cg.func_inputs(function)).tokens
        takes = (*cg.func_inputs(function), *_taken_inside(run))
        given = [name for name in takes if name in wanted] or [name for name in wanted if name in behind]
        return given or [name for name in takes if name in run.hyperparameters]

    def _commit(self, *, is_final: bool = False) -> None:
        """Add the values that the runner has taken over to the history, unless they are there or held."""
        run = self.session.result
        if run is not None and not self.session.wanted:
            run = self._with_late_tiles(run)
        if run is None or ((self.session.wanted or self.controls.is_holding) and not is_final):
            return
        self._add(run)
        entries = self.history.entries
        if entries and entries[-1].number != self.screen.listed:  # another panel may have added some
            self.screen.send_history()
        self.worker.post("still", self._settled, _STILL_S, is_work=False)

    def _add(self, run: Run) -> None:
        current, image = self.history.current, self.session.image
        if not len(self.session.payloads) and current is not None:
            image = current.image  # that of another panel on this runner
        token = self.screen.shown.token
        numbers = self.screen.tiles.numbers(run)
        about = {
            "picture": thumbnail(run, token, self.screen.shown.limits),
            "compute_ms": self.screen.compute_ms,
            "numbers": numbers,
        }
        if self.history.commit(self.values_of(run), image=image, token=token, **about) is None and current is not None:
            current.numbers.update(numbers)

    def _late_tiles(self, run: Run) -> tuple[str, ...]:
        return self.screen.tiles.late(run, self.screen.pinned_tiles)

    def _with_late_tiles(self, run: Run) -> Run:
        """Compute and show the tiles that the picture did not wait for; return the run that has them, if any."""
        tiles, targets = self.screen.tiles, self.screen.shown.targets
        late = () if self.session.is_service else self._late_tiles(run)
        if not (late and targets):
            return run
        is_at_fault = True
        while late and is_at_fault:
            try:
                whole, is_settled = self._run((*targets, *late), is_wanted=False)
            except Exception:  # a newer value is wanted, or a placeholder needed: the tiles stay stale
                return run
            is_at_fault = tiles.is_at_fault(whole, targets)
            late = tuple(token for token in late if token not in tiles.failures)
        if not (is_settled and (is_at_fault or whole.failure is None)):
            return run
        shown = run if is_at_fault else whole
        self.screen.show(shown, 0)
        return shown

    def _compare(self) -> None:
        """Show what the picture is compared with, if that is not part of its own run."""
        comparison, token = self.screen.shown.comparison, self.screen.shown.token
        if comparison is None or token is None or comparison.kind == "stage":
            self.screen.refer_anew(to_nothing=True)
            return
        payload = self.session.payload
        key = comparison, token, self.screen.shown.limits
        if self.screen.refers_to(key, payload):
            return
        try:
            values, label = self._compared(comparison)
            run = self.session.compared(values, token, self._is_superseded)
        except Superseded:
            return
        except LookupError as error:
            self.screen.log(str(error))
            self.screen.note(str(error))
            self.screen.change(comparison=None)
            return
        if run.failure is not None:
            self.screen.log(f"Nothing to compare with: with these values {run.failure}.")
        else:
            self.screen.refer(key, payload, label, run, token)

    def _compared(self, comparison: Comparison) -> tuple[Mapping[str, Any], str]:
        if comparison.kind == "default":
            return self.runner.first_hyperparameters, "default"
        entry = next((entry for entry in self.history.entries if entry.number == comparison.number), None)
        if entry is None:
            raise LookupError(f"No entry {comparison.number} in the history.")
        return entry.values, f"history {entry.number}"


def _failure_text(run: Run, failure: Failure) -> str:
    """Say what failed; inside a pipeline, after its name."""
    inner = run.nested.get(failure.function)
    if inner is None or inner.failure is None:
        return str(failure)
    return f"{failure.function}: {_failure_text(inner, inner.failure)}"


def _taken_inside(run: Run) -> list[str]:
    """Return what the function takes that has failed inside a pipeline."""
    inner = run.nested.get(run.failure.function) if run.failure is not None else None
    if run.failure is None or inner is None or inner.failure is None:
        return []
    names = (*inner.cg.func_inputs(inner.failure.function), *_taken_inside(inner))
    return [f"{run.failure.function}__{name}" for name in names]
