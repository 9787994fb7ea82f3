"""How does a user see, move and read a runner's hyperparameters?"""

from __future__ import annotations

import enum
import threading
from collections.abc import Mapping
from itertools import count
from typing import Any, Final

import ipywidgets

from epypes.errors import NotComputed, PayloadError, UnknownName, run_call
from epypes.run import CompGraphRunner, Run
from epypes_widgets.controls import Control, column, controls
from epypes_widgets.frames import best_token, make_frame, showable
from epypes_widgets.picture import PictureView
from epypes_widgets.worker import Worker


def tune(runner: CompGraphRunner, /, *, token: str | None = None, **hints: Any) -> Panel:
    """Show sliders for a runner's hyperparameters, and the picture that they make.

    Parameters
    ----------
    runner
        Has been run, so that there is a payload.
    token
        The token whose picture is shown at first; without, the last sink token that is an image, else the last
        image. A hyperparameter of this very name gets no hint.
    hints
        By hyperparameter: an ``ep.Param``, a tuple as a range (low, high[, step]), a list of choices. Without, the
        annotation of the function that takes it says it, then its value; what can't be moved is shown.

    Returns
    -------
    Panel
        As the last expression of a cell it shows itself. Running the cell again makes a new panel; the old one goes
        on working, on the same runner, wherever it is still shown.

    Raises
    ------
    PayloadError
        The runner has not been run.
    UnknownName
        A hint is for no hyperparameter of the runner, or ``token`` is not in its graph.
    TypeError, ValueError
        A hint can't be read, or the hyperparameter's value lies outside of it.

    Examples
    --------
    >>> from epypes import CompGraph, CompGraphRunner
    >>> runner = CompGraphRunner(CompGraph({"add": lambda x, y: x + y}, {"add": (("x", "y"), "total")}), {"y": 1})
    >>> run = runner.run(x=2)
    >>> panel = tune(runner, y=(0, 10))
    >>> panel["y"] = 5
    >>> panel.wait(10)
    >>> panel.result["total"]
    7
    >>> panel.code()
    'runner.rerun(y=5)'
    """
    if not isinstance(runner, CompGraphRunner):
        kind = type(runner).__name__
        raise TypeError(f"tune() takes a CompGraphRunner, not {kind!r}: tune(CompGraphRunner(cg, hparams)).")
    if runner.last is None:
        free = runner.free_source_tokens
        text = f"Nothing has been run yet, so there is nothing to tune on. Call {run_call(free)} first."
        raise PayloadError(free, text)
    if token is not None:
        runner.cg.require_token(token)
    return Panel(runner, controls(runner, hints), token)


class Panel:
    """Controls and a picture, bound to a runner; made by ``tune``.

    Values may be set from any thread. They are computed on a thread of the panel's own, the latest first; a cell that
    needs the result calls ``wait``. What cells set on the runner itself is used by the panel's next run, but does not
    move its controls.

    Parameters
    ----------
    runner
        Is run by the panel.
    controls
        Of its hyperparameters, in the order in which they are listed.
    token
        The token to show first; None for the best one.
    """

    def __init__(self, runner: CompGraphRunner, controls: tuple[Control, ...], token: str | None) -> None:
        self._runner = runner
        self._controls = {name: entry for entry in controls for name in entry.names}
        self._initial = self.values
        self._asked = token
        self._seq = count(1).__next__
        self._moving = threading.RLock()
        self._result: Run | None = None
        self._failed: set[str] = set()
        self._worker = Worker(self._compute)
        self._view = PictureView(lambda: self._worker.idle)
        self._tokens = ipywidgets.ToggleButtons(options=[], style={"button_width": "auto"})
        listed = column(runner.cg, controls)
        folders = zip(listed.folders, listed.widget.children[1:], strict=True)
        self._headings = {folder["function"]: box.children[0] for folder, box in folders}
        self._widget = _laid_out(self._tokens, listed.widget, self._view)
        for entry in controls:
            entry.on_change(self._moved)
        self._tokens.observe(self._chosen, names="value")
        self._begin()

    # -- for users ----------------------------------------------------------------------------------------------

    @property
    def widget(self) -> Any:
        """The ipywidgets box that is shown, to be put into a layout of one's own."""
        return self._widget

    @property
    def values(self) -> dict[str, Any]:
        """The values that the controls are at, by hyperparameter."""
        return {name: entry.read()[name] for name, entry in self._controls.items()}

    @property
    def token(self) -> str | None:
        """The token that is shown; None before the first run has completed."""
        chosen: str | None = self._tokens.value
        return chosen or self._asked

    @property
    def result(self) -> Run:
        """The last run that completed.

        Raises
        ------
        NotComputed
            None has, since the panel was made.
        """
        if self._result is None:
            text = f"No run of this panel has completed. {self._view.error or 'Call wait(timeout_s) first.'}"
            raise NotComputed(self.token or "", text)
        return self._result

    @property
    def error(self) -> str:
        """What failed with the last values, as shown under the picture; empty if nothing did."""
        return self._view.error

    def code(self) -> str:
        """Return the line that does what the hand has done since the panel was made."""
        values = self.values
        changed = {name: value for name, value in values.items() if _differs(value, self._initial[name])}
        words = [f"{name}={_source(value)}" for name, value in changed.items() if name.isidentifier()]
        others = [f"{name!r}: {_source(value)}" for name, value in changed.items() if not name.isidentifier()]
        if others:
            words.append(f"**{{{', '.join(others)}}}")
        return f"runner.rerun({', '.join(words)})"

    def wait(self, timeout_s: float) -> None:
        """Return when everything that was set has been computed; TimeoutError if that takes longer."""
        self._worker.wait(timeout_s)

    def close(self, timeout_s: float = 5.0) -> None:
        """Stop following the controls; the picture stays. May be called twice and from any thread.

        Raises
        ------
        StillRunning
            A function did not return in time.
        """
        for entry in self._controls.values():
            if entry.widget.has_trait("disabled"):
                entry.widget.disabled = True
        self._tokens.disabled = True
        self._worker.close(timeout_s)

    def __getitem__(self, name: str) -> Any:
        return self._control(name).read()[name]

    def __setitem__(self, name: str, value: Any) -> None:
        entry = self._control(name)
        if self._worker.closed:
            raise RuntimeError("This panel is closed. Make a new one: tune(runner).")
        with self._moving:
            entry.write({name: value})
            self._moved({name: value})

    def __repr__(self) -> str:
        state = "closed" if self._worker.closed else "failed" if self._view.error else "up to date"
        if state == "up to date" and not self._worker.idle:
            state = "computing"
        return f"<Panel: {len(self._controls)} hyperparameters, shows {str(self.token)!r:.30}; {state}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, Any]:
        bundle: dict[str, Any] = self._widget._repr_mimebundle_() or {}
        return {**bundle, "text/plain": repr(self)}

    # -- what moves ---------------------------------------------------------------------------------------------

    def _control(self, name: str) -> Control:
        if name not in self._controls:
            raise UnknownName("hyperparameter", name, self._controls, "of this panel")
        return self._controls[name]

    def _moved(self, values: Mapping[str, Any]) -> None:
        # Read and submitted in one step, so that of two threads the one whose value stands submits last.
        with self._moving:
            self._worker.submit({name: self._controls[name].read()[name] for name in values})

    def _chosen(self, _change: object) -> None:
        self._worker.submit({})

    # -- what runs on the worker's thread, after _begin --------------------------------------------------------

    def _begin(self) -> None:
        """Show what the runner has, if that is up to date; else let the worker compute it."""
        last = self._runner.last
        if last is None or last.failure is not None or self._runner.stale:
            self._worker.submit({})
            return
        self._result = last
        self._offer_tokens(last)
        self._compute({}, 0)

    def _compute(self, values: Mapping[str, Any], changed_ns: int) -> None:
        """Run what is stale and show it; without values only show, since another token was chosen."""
        try:
            run = self._result
            if values or run is None:
                run = self._runner.rerun(**values)
                self._completed(run)
            self._show(run, changed_ns)
        except BaseException as exception:  # it is the user's function that raised: SystemExit, too, is for the screen
            self._fail(exception)

    def _completed(self, run: Run) -> None:
        self._result = run
        for function in self._failed:
            self._headings[function].remove_class("epypes-failed")
        self._failed.clear()
        self._offer_tokens(run)

    def _show(self, run: Run, changed_ns: int) -> None:
        token = self.token
        if token is not None:  # a graph may have no tokens
            self._view.show(make_frame(run, token, self._seq(), changed_ns, stale=bool(self._failed)))

    def _fail(self, exception: BaseException) -> None:
        last = self._runner.last
        failure = last.failure if last is not None else None
        if failure is None or failure.exception is not exception:
            self._view.fail(self._seq(), f"{type(exception).__name__}: {exception}")
            return
        self._view.fail(self._seq(), str(failure), failure.function)
        self._failed.add(failure.function)
        if failure.function in self._headings:
            self._headings[failure.function].add_class("epypes-failed")

    def _offer_tokens(self, run: Run) -> None:
        """Let the user choose among the tokens that this run has pictures of; keep the choice if it is there."""
        tokens = showable(run, self._asked)
        if tokens == tuple(self._tokens.options):
            return
        shown = self.token
        # Setting the options chooses the first of them: that is not the user's choice.
        self._tokens.unobserve(self._chosen, names="value")
        self._tokens.options = tokens
        self._tokens.value = shown if shown in tokens else best_token(run, tokens)
        self._tokens.observe(self._chosen, names="value")


_COLUMNS: Final = {"flex_flow": "row wrap", "width": "100%"}


def _laid_out(tokens: Any, column: Any, view: Any) -> Any:
    # A box, so that a page of CSS can reach what is in it without styling other people's widgets.
    chooser = ipywidgets.Box([tokens])
    right = ipywidgets.VBox([chooser, view], layout={"flex": "3 1 420px", "min_width": "320px"})
    columns = ipywidgets.HBox([column, right], layout=_COLUMNS)
    for box, name in ((chooser, "epypes-tokens"), (columns, "epypes-columns")):
        box.add_class(name)
    panel = ipywidgets.VBox([columns])
    panel.add_class("epypes-panel")
    return panel


def _differs(value: Any, other: Any) -> bool:
    if value is other:
        return False
    try:
        return bool(value != other)
    except ValueError:  # arrays: another object counts as another value
        return True


def _source(value: Any) -> str:
    return f"{type(value).__name__}.{value.name}" if isinstance(value, enum.Enum) else repr(value)
