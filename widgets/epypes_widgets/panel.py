"""How does a user see, move and read the hyperparameters of a runner, or of a running service?"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ipywidgets

from epypes.batch.check import CheckResult, Checks
from epypes.errors import NotComputed
from epypes.hints import Roi
from epypes.run import Run
from epypes_widgets import code, settings
from epypes_widgets.controls import column
from epypes_widgets.cuts import cuts_of, made_from
from epypes_widgets.hand import Hand
from epypes_widgets.history import history_of
from epypes_widgets.latency import Latency, latency_of
from epypes_widgets.messages import Messages
from epypes_widgets.picture import PictureView
from epypes_widgets.plain import plain_values
from epypes_widgets.promotion import proposal
from epypes_widgets.route import listen_beside_cells
from epypes_widgets.screen import Screen
from epypes_widgets.searching import Searching, told
from epypes_widgets.session import Session
from epypes_widgets.static import static_html
from epypes_widgets.still import Still
from epypes_widgets.stored import StoredHistory
from epypes_widgets.tuning import Tuning
from epypes_widgets.verdicts import Verdicts

if TYPE_CHECKING:
    import pandas as pd

    from epypes_widgets.historyframe import HistoryFrame


class Panel:
    """Controls and a picture, bound to a runner; made by ``tune``.

    Values may be set from any thread. They are computed on a thread of the panel's own, the latest first; a cell that
    needs the result calls ``wait``. The runner changes when a run has completed, hyperparameters and tokens together.
    What cells set on the runner moves the controls.

    Parameters
    ----------
    hand
        The controls.
    session
        Its runner is run by the panel.
    token
        The token to show first; None for the best one.
    cases
        With their checks; their inputs are the payloads of the session.
    stored
        Where the history is kept, if it is.
    search
        Of hyperparameters; None if there is no metric.

    Attributes
    ----------
    search
        What the "Optimise" button starts: ``start(n)``, ``stop()``, ``wait(timeout_s)``, ``result``; None without a
        metric.
    """

    def __init__(
        self,
        hand: Hand,
        session: Session,
        token: str | None,
        cases: Checks,
        stored: StoredHistory,
        search: Searching | None,
    ) -> None:
        self._hand, self._session, self._runner = hand, session, session.runner
        self._history = history_of(self._runner)
        if session.payloads:
            self._history.use_images(tuple(value for film in session.payloads for value in film.values.values()))
        self._column = column(self._runner.cg, hand.controls)
        self._still = Still(self._static)
        self._tuning = tuning = Tuning(hand, session, self._history, self._still.update)
        self.search = search
        self._messages = Messages(tuning, self.save, self.load, search)
        self._verdicts = Verdicts(self._runner, cases, self._history, tuning)
        handlers = self._verdicts.beside(self._messages.handlers)
        view = PictureView(tuning.worker.later, handlers, tuning.report)
        self._screen = tuning.screen = Screen(view, session, self._history, token, self._setup, self.code)
        self._cuts = cuts_of(hand)
        tuning.screen.change(cut=tuple(self._cuts), has_histogram=bool(self._cuts))
        columns = ipywidgets.HBox([self._column.widget, view], _dom_classes=("epypes-columns",))
        self._widget = ipywidgets.VBox([columns], _dom_classes=("epypes-panel",))
        listen_beside_cells(self._widget)
        tuning.begin()
        self._stored = stored
        stored.follow(self._history, self._screen.log)
        self._verdicts.begin()

    # -- values -------------------------------------------------------------------------------------------------

    @property
    def values(self) -> dict[str, Any]:
        """The values that the controls are at, by hyperparameter."""
        return self._hand.values

    def __getitem__(self, name: str) -> Any:
        return self._hand.control(name).read()[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self._require_open()
        self._tuning.want({name: value})

    def set(self, **values: Any) -> None:
        """Move controls, all or none, and have the values computed.

        Raises
        ------
        UnknownName
            There is no such hyperparameter.
        ValueError
            A value is outside of its range.
        """
        self._require_open()
        self._tuning.want(values)

    def reset(self, *names: str) -> None:
        """Set hyperparameters to the values that the runner had them frozen with; all without names."""
        self._require_open()
        first = self._runner.first_hyperparameters
        for name in names:
            self._hand.control(name)
        self._tuning.want({name: first[name] for name in names or self._hand.values if name in first})

    def code(self) -> str:
        """Return the line that leads from the runner's first hyperparameters to those of the panel."""
        first, place = self._runner.first_hyperparameters, self._session.place
        name = code.name_of(place.owner, word=place.word)
        return code.line(name, first, {**first, **self._hand.values}, self._hand.params, verb=place.verb)

    # -- results ------------------------------------------------------------------------------------------------

    @property
    def result(self) -> Run:
        """The last run that completed: of the tokens that are not looked at it may have none, or those of before.

        Raises
        ------
        NotComputed
            None has completed.
        """
        if self._session.result is None:
            text = f"No run of this panel has completed. {self._screen.error or 'Call wait(timeout_s) first.'}"
            raise NotComputed(self.token or "", text)
        return self._session.result

    @property
    def error(self) -> str:
        """What failed with the last values, as shown under the picture; empty if nothing did."""
        return self._screen.error

    @property
    def log(self) -> tuple[str, ...]:
        """What went wrong in the panel itself, as in its log drawer."""
        return self._screen.lines

    @property
    def latency(self) -> Latency:
        """How long the last frames took from the hand to the screen."""
        return latency_of(self._screen.compute_ms, self._screen.view.to_screen_ms)

    def wait(self, timeout_s: float) -> None:
        """Return when everything that was set has been computed and committed; TimeoutError if that takes longer.

        What waits for a hand to let go, or with live off to be run, is not waited for.
        """
        self._tuning.worker.wait(timeout_s)

    def check(self, timeout_s: float) -> CheckResult | None:
        """Return what came of the cases with the values that were committed last; None if there is nothing to check.

        TimeoutError if that takes longer.
        """
        self.wait(timeout_s)
        return self._verdicts.wait(timeout_s)

    # -- looking ------------------------------------------------------------------------------------------------

    @property
    def token(self) -> str | None:
        """The token that is shown; None before the first run has completed."""
        return self._screen.shown.token

    @token.setter
    def token(self, token: str) -> None:
        self._require_open()
        self._runner.cg.require_token(token)
        self._screen.change(token=self._screen.require_stage(token))
        self._tuning.look()

    @property
    def widget(self) -> Any:
        """The ipywidgets box that is shown, to be put into a layout of one's own."""
        return self._widget

    # -- remembering --------------------------------------------------------------------------------------------

    @property
    def history(self) -> HistoryFrame:
        """The values that were committed, a row each, with the pictures that they made; the pandas table is a copy."""
        return self._history.to_frame()

    @property
    def stored(self) -> pd.DataFrame:
        """What was committed under this panel's name, in earlier sessions too, as a pandas table; needs a store."""
        return self._stored.to_frame()

    def undo(self) -> bool:
        """Go back to the values before; False if there are none."""
        self._require_open()
        return self._tuning.go_to(self._history.undo)

    def redo(self) -> bool:
        """Go on to the values that ``undo`` left; False if there are none."""
        self._require_open()
        return self._tuning.go_to(self._history.redo)

    def save(self, path: str | Path) -> Path:
        """Write the values of all controls that can be moved to a TOML file, and return its path.

        Raises
        ------
        SettingsError
            With every reason why not.
        """
        return settings.save(path, self._hand.movable, self._runner.cg, self._hand.params)

    def load(self, path: str | Path) -> None:
        """Set the values that are in a TOML file, all or none.

        Raises
        ------
        SettingsError
            The file is not there or can't be read, or names what is no hyperparameter of the runner.
        ValueError
            A value is outside of its range.
        """
        self._require_open()
        self._tuning.want(settings.load(path, {**self._runner.hyperparameters, **self.values}))

    # -- itself -------------------------------------------------------------------------------------------------

    def close(self, timeout_s: float = 5.0) -> None:
        """Stop following the controls; the picture stays. May be called twice and from any thread.

        Raises
        ------
        StillRunning
            A function did not return in time.
        """
        for control in self._hand.controls:
            if control.widget.has_trait("disabled"):
                control.widget.disabled = True
        with ExitStack() as last:  # all are closed, whichever does not stop in time; the last one first
            last.callback(self._stored.close, timeout_s)
            if self.search is not None:
                self.search.stop()
                last.callback(self.search.close, timeout_s)
            last.callback(self._tuning.close, timeout_s)
            last.callback(self._verdicts.close, timeout_s)

    def _require_open(self) -> None:
        if self._tuning.worker.closed:
            raise RuntimeError("This panel is closed. Make a new one: tune(runner).")

    def __repr__(self) -> str:
        worker = self._tuning.worker
        state = "closed" if worker.closed else "failed" if self.error else "up to date"
        if state == "up to date" and not worker.idle:
            state = "computing"
        return f"<Panel: {len(self.values)} hyperparameters, shows {str(self.token)!r:.30}; {state}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, Any]:
        bundle: dict[str, Any] = self._widget._repr_mimebundle_() or {}
        return {**bundle, "text/plain": repr(self)}

    def _ipython_display_(self) -> None:
        from IPython.display import display

        display(self._repr_mimebundle_(), raw=True)
        self._still.display()

    def _static(self) -> str:
        run = self._session.result
        if run is None:
            return ""
        index = self._session.image
        title = "" if index is None else self._session.payloads[index].title
        first = self._runner.first_hyperparameters
        return static_html(run, self.token, run.hyperparameters, first, image=title, code=self.code())

    def _setup(self) -> tuple[dict[str, Any], list[bytes]]:
        """Return what a view has to know of the controls and images."""
        films, params, values = self._session.payloads, self._hand.params, plain_values(self.values)
        content = {
            "rows": [{**row, "value": [values.get(name) for name in row["names"]]} for row in self._column.rows],
            "folders": list(self._column.folders),
            "images": [{"index": index, "title": film.title} for index, film in enumerate(films)],
            "live": self._tuning.is_live,
            "cuts": [{"token": token, "names": names} for token, names in self._cuts.items()],
            "rois": [
                {"name": name, "token": param.on, "cuts_out": made_from(self._runner.cg, name)}
                for name, param in params.items()
                if isinstance(param, Roi)
            ],
            "promote_to": proposal(self.token),
            "writes_back": self._session.place.is_written_back,
            "settings": list(settings.names(".")),
            "optimise": told(self.search),
        }
        return content, [film.thumbnail for film in films]
