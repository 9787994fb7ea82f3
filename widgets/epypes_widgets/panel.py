"""The panel of a notebook: controls for the hyperparameters of a runner or a running service, and the picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ipywidgets

from epypes.batch.check import CheckResult, Checks
from epypes.errors import InvalidType, InvalidValue, NotComputed, PayloadError, ServiceError, run_call
from epypes.hints import Roi
from epypes.run import CompGraphRunner, Run
from epypes.store import Store
from epypes_widgets import code, settings
from epypes_widgets.cases import Cases, read_cases
from epypes_widgets.controls.column import column
from epypes_widgets.controls.control import ControlSet, controls
from epypes_widgets.feed import SETTINGS, CameraFeed
from epypes_widgets.functions import Made, are_functions, made_runner
from epypes_widgets.history import StoredHistory, history_of
from epypes_widgets.messages import Messages
from epypes_widgets.picture.images import Payloads, payloads
from epypes_widgets.picture.picture_settings import PictureSettings
from epypes_widgets.picture.screen import Screen
from epypes_widgets.picture.static import Displayed, StaticOutput, static_html
from epypes_widgets.picture.tiles import Tiles
from epypes_widgets.promotion import proposal
from epypes_widgets.search import Search
from epypes_widgets.session import Session, tunable
from epypes_widgets.tuning import Tuning
from epypes_widgets.values import differing, json_values, setting_text
from epypes_widgets.view import Latency, PictureView, use_subshell
from epypes_widgets.worker import Worker

if TYPE_CHECKING:
    import pandas as pd

    from epypes.batch.optimize import Direction
    from epypes.bundle.writeback import WriteBack
    from epypes.graph import CompGraph
    from epypes.service.remote.connection import Connection
    from epypes_widgets.history_table import HistoryTable


class Panel(Displayed):
    """Controls and a picture, bound to a runner; made by ``tune``.

    Values may be set from any thread. They are computed on a thread of the panel's own, the latest first; a cell that
    needs the result calls ``wait``. The runner changes when a run has completed, hyperparameters and tokens together.
    What cells set on the runner moves the controls.

    Parameters
    ----------
    controls
        The controls.
    session
        Its runner is run by the panel.
    token
        The token to show first; None for the best one.
    cases
        With their checks; their inputs are the payloads of the session.
    store, name
        Where each committed setting is kept, and under which name; None to keep nothing.
    search
        Of hyperparameters; None if there is no metric.
    is_made
        Whether the runner was made for the panel, so that no name of the notebook has it.

    Attributes
    ----------
    search
        What the "Optimise" button starts: ``start(n)``, ``stop()``, ``wait(timeout_s)``, ``result``; None without a
        metric.
    """

    def __init__(
        self,
        controls: ControlSet,
        session: Session,
        token: str | None,
        cases: Checks,
        store: str | Path | Store | None,
        name: str | None,
        search: Search | None,
        is_made: bool = False,
    ) -> None:
        self._controls, self._session, self._runner, self.search = controls, session, session.runner, search
        self._is_made = is_made
        cg: CompGraph = self._runner.cg
        self._history = history_of(self._runner)
        self._column = column(cg, controls.controls)
        self._worker = worker = Worker(failed=self._report)
        view = PictureView(worker, self._report)
        self._static = StaticOutput(self._static_html)
        tiles = Tiles(session, self._history, cases, controls.movable)
        self._screen = Screen(view, session, self._history, tiles, token, tuple(controls.thresholds))
        self._screen.setup, self._screen.code = self._setup, self.code
        self._stored: StoredHistory | None = None
        if store is not None:
            self._stored = StoredHistory(self._runner, store, name, self._history, self._screen.log)
        self._tuning = Tuning(controls, session, self._history, worker, self._screen, self._static.update)
        self._cases = Cases(self._runner, cases, self._history, self._tuning)
        view.handlers = Messages(self, self._tuning, self._cases).handlers
        columns = ipywidgets.HBox([self._column.widget, view], _dom_classes=("epypes-columns",))
        self._widget = ipywidgets.VBox([columns], _dom_classes=("epypes-panel",))
        use_subshell(self._widget)
        self._tuning.begin()
        self._cases.begin()

    # -- values -------------------------------------------------------------------------------------------------

    @property
    def runner(self) -> CompGraphRunner:
        """What is tuned: the runner that was given, or was made of functions; its graph is ``panel.runner.cg``.

        Raises
        ------
        TypeError
            A service is tuned, whose runner is in its worker process.
        """
        if not isinstance(self._runner, CompGraphRunner):
            raise InvalidType("A service is tuned, so there is no runner here. Ask what ep.connect has returned.")
        return self._runner

    @property
    def values(self) -> dict[str, Any]:
        """The values that the controls are at, by hyperparameter."""
        return self._controls.values

    def __getitem__(self, name: str) -> Any:
        return self._controls.control(name).read()[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self.set(**{name: value})

    def set(self, /, **values: Any) -> None:
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

    def reset(self, /, *names: str) -> None:
        """Set hyperparameters to the values that the runner had them frozen with; all without names."""
        self._require_open()
        self._tuning.want(self._tuning.first_values(names), is_return=True)

    def code(self) -> str:
        """Return the line that leads from the runner's first hyperparameters to those of the panel.

        Of a camera whose settings were changed, another one before it.
        """
        first, runner, feed = self._runner.first_hyperparameters, self._runner, self._session.feed
        values = {name: value for name, value in {**first, **self.values}.items() if name in first}
        if isinstance(runner, CompGraphRunner):
            default = f"{code.name_of(self, default='panel')}.runner" if self._is_made else "runner"
            text = code.line(code.name_of(runner, default=default), first, values, self._controls.params)
            if feed is None or feed.values == feed.first:
                return text
            camera = code.name_of(feed.camera, default="camera")
            settings_text = code.line(camera, feed.first, feed.values, verb="settings.set")
            return f"{settings_text}\n{text}" if differing(first, values) else settings_text
        name = code.name_of(runner.connection, default="service")
        return code.line(name, first, values, self._controls.params, verb="set")

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
            text = f"No run of this panel has completed. {self.error or 'Call wait(timeout_s) first.'}"
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
        """How long the last frames took from a value to the screen."""
        return self._screen.view.latency(self._screen.compute_ms)

    def wait(self, timeout_s: float) -> None:
        """Return when everything that was set has been computed and committed; TimeoutError if that takes longer.

        What waits for a control to be released, or with live off to be run, is not waited for.
        """
        self._worker.wait(timeout_s)

    def check(self, timeout_s: float) -> CheckResult | None:
        """Return the result of the cases with the values that were committed last; None if there is nothing to check.

        TimeoutError if that takes longer.
        """
        self.wait(timeout_s)
        return self._cases.wait(timeout_s)

    # -- looking ------------------------------------------------------------------------------------------------

    @property
    def token(self) -> str | None:
        """The token that is shown; None before the first run has completed."""
        return self._screen.shown.token

    @token.setter
    def token(self, token: str) -> None:
        self._require_open()
        self._runner.cg.require_token(token)
        self._tuning.look(token=self._screen.require_stage(token))

    @property
    def pictures(self) -> Mapping[str, PictureSettings]:
        """How pictures are shown, by the token of the image, where that was changed."""
        return dict(self._screen.shown.pictures)

    def show_as(self, token: str, **settings: Any) -> None:
        """Change how the picture of a token is shown, as the controls above the picture do.

        Parameters
        ----------
        token
            The image: of what is drawn over one, that one.
        settings
            ``limits=(0, 4095)``, ``colour_map="viridis"``, ``over="image"``, ``opacity=0.5``, ``zoom="nearest"``; see
            ``PictureSettings``.

        Raises
        ------
        UnknownName
            There is no such token.
        ValueError
            A setting can't be so.
        """
        self._require_open()
        self._screen.change_picture(token, settings)
        self._screen.send_setup()
        self._tuning.look()

    @property
    def tiles(self) -> tuple[str, ...]:
        """The tokens whose numbers are shown beside the picture; at first the sinks and what a control changes.

        Set others, or none. They are saved with the values.
        """
        return self._screen.pinned_tiles

    @tiles.setter
    def tiles(self, tokens: Iterable[str]) -> None:
        self._require_open()
        found = tuple(dict.fromkeys([tokens] if isinstance(tokens, str) else tokens))
        for token in found:
            self._runner.cg.require_token(token)
        self._tuning.look(tiles=found)

    @property
    def widget(self) -> Any:
        """The ipywidgets box that is shown, to be put into a layout of one's own."""
        return self._widget

    # -- remembering --------------------------------------------------------------------------------------------

    @property
    def history(self) -> HistoryTable:
        """The values that were committed, a row each, with the pictures that they made; the pandas table is a copy."""
        return self._history.to_frame()

    @property
    def stored(self) -> pd.DataFrame:
        """What was committed under this panel's name, in earlier sessions too, as a pandas table; needs a store."""
        if self._stored is None:
            raise RuntimeError("This panel has no store. Name one: tune(runner, store='history.sqlite').")
        return self._stored.to_frame()

    def undo(self) -> bool:
        """Go back to the values before, which are the last that completed if a function failed; False without any."""
        self._require_open()
        return self._tuning.undo()

    def redo(self) -> bool:
        """Go on to the values that ``undo`` left; False if there are none."""
        self._require_open()
        return self._tuning.go_to(self._history.redo)

    def save(self, path: str | Path) -> Path:
        """Write the values of all controls that can be moved, how pictures are shown, and the tiles, to a TOML file.

        Raises
        ------
        SettingsError
            With every reason why not.
        """
        return settings.save(path, self._controls.movable, self._controls.params, self.pictures, self.tiles)

    def load(self, path: str | Path) -> None:
        """Set the values that are in a TOML file, all or none, and show pictures and tiles as it says.

        What it says of tokens that the graph does not have is passed over.

        Raises
        ------
        SettingsError
            The file is not there or can't be read, or names what is no hyperparameter of the runner.
        ValueError
            A value is outside of its range.
        """
        loaded, cg = settings.load(path, {**self._session.hyperparameters, **self.values}), self._runner.cg
        self.set(**loaded.values)
        for token, each in loaded.pictures.items():
            if all(map(cg.has_token, filter(None, (token, each.over)))):
                self.show_as(token, **each.content)
        if loaded.tiles is not None:
            self._tuning.look(tiles=loaded.tiles)

    def write_back(self, dry_run: bool = False, timeout_s: float = 60.0) -> WriteBack:
        """Write the values of the panel into the bundle of its service, when all that was set is set there.

        Parameters
        ----------
        dry_run
            Whether only to return what would change.
        timeout_s
            How long to wait for the values that were set before.

        Raises
        ------
        TypeError
            A runner is tuned, which has no bundle: promote it.
        TimeoutError
            The values were not set in time.
        ServiceError
            The service is gone, refuses a value or the changed bundle.
        """
        if isinstance(self._runner, CompGraphRunner):
            raise InvalidType("A runner has no bundle to write to. Promote it: ep.promote(runner, folder).")
        if self._session.is_wanting and not self._tuning.is_live:
            self._tuning.run()
        self.wait(timeout_s)
        left = self._session.wanted
        if left:
            reason = self.error or "They wait for a control to be released."
            raise ServiceError(self._runner.connection.url, f"Not set in the service: {setting_text(left)}. {reason}")
        return self._runner.connection.write_back(dry_run=dry_run)

    # -- itself -------------------------------------------------------------------------------------------------

    def close(self, timeout_s: float = 5.0) -> None:
        """Stop following the controls; the picture stays. May be called twice and from any thread.

        Raises
        ------
        StillRunning
            A function did not return in time.
        """
        for control in self._controls.controls:
            if control.widget.has_trait("disabled"):
                control.widget.disabled = True
        with ExitStack() as last:  # all are closed, also if one does not stop in time; the last one first
            if self._stored is not None:
                last.callback(self._stored.close, timeout_s)
            if self.search is not None:
                self.search.stop()
                last.callback(self.search.close, timeout_s)
            if self._session.feed is not None:
                last.callback(self._session.feed.close, timeout_s)
            last.callback(self._tuning.close, timeout_s)
            last.callback(self._cases.close, timeout_s)

    def _require_open(self) -> None:
        if self._worker.closed:
            raise RuntimeError("This panel is closed. Make a new one: tune(runner).")

    def _report(self, error: BaseException) -> None:
        self._tuning.report(error)

    def __repr__(self) -> str:
        state = "closed" if self._worker.closed else "failed" if self.error else "up to date"
        if state == "up to date" and self._worker.is_pending("compute"):
            state = "computing"
        shows = "" if self.token is None else f", shows {self.token!r:.30}"
        return f"<Panel: {len(self.values)} hyperparameters{shows}; {state}>"

    def _static_html(self) -> str:
        run = self._session.result
        if run is None:
            return ""
        first = self._runner.first_hyperparameters
        image = self._session.image
        title = "" if image is None else self._session.payloads.title(image)
        return static_html(
            run, self.token, run.hyperparameters, first, image=title, code=self.code(), limits=self._screen.shown.limits
        )

    def _setup(self) -> tuple[dict[str, Any], list[bytes]]:
        """Return what a view has to know of the controls and images."""
        values, payloads = json_values(self.values), self._session.payloads
        numbers, frames = payloads.numbers, None
        if numbers is not None:
            counted = {"start": numbers.start, "step": numbers.step, "count": len(numbers)}
            frames = {"name": payloads.name, "numbers": counted}
        images = [payloads[index] for index in range(len(payloads))] if numbers is None else []
        content = {
            "rows": [{**row, "value": [values.get(name) for name in row["names"]]} for row in self._column.rows],
            "folders": list(self._column.folders),
            "images": [{"index": index, "title": image.title} for index, image in enumerate(images)],
            "frames": frames,
            "live": self._tuning.is_live,
            "cuts": [{"token": token, "names": names} for token, names in self._controls.thresholds.items()],
            "rois": [
                {"name": name, "token": param.on, "cuts_out": _made_from(self._runner.cg, name)}
                for name, param in self._controls.params.items()
                if isinstance(param, Roi)
            ],
            "promote_to": proposal(self._runner.cg.sink_tokens),
            "writes_back": self._session.is_service,
            "settings": list(settings.names(".")),
            "optimise": None if self.search is None else self.search.content(),
        }
        return content, [image.thumbnail for image in images]


def _made_from(cg: CompGraph, token: str) -> list[str]:
    """Return the tokens that depend on a token: on a picture that it has cut out, it means something else."""
    found = {token}
    for function in cg.functions:
        if found.intersection(cg.func_inputs(function)):
            found.update(cg.func_outputs(function))
    return sorted(found)


def interact(functions: Any, /, *payload: Any, **abbreviations: Any) -> Panel:
    """Show controls for the parameters of a function, and the picture that it makes: one line for one function.

    It is ``tune`` on a runner that is made inside, as ``panel.runner``.

    Parameters
    ----------
    functions
        A function. Or a list of functions, each of which takes what others make by the names of its parameters, as
        ``CompGraph.from_functions`` joins them; or a graph. Of a function that returns several values, an image among
        them, each is a token: ``edges_1``, ``edges_2``, or as ``@ep.outputs`` names them.
    payload
        What the first parameters get: the image. They have no controls.
    abbreviations
        By parameter, as in ``ipywidgets.interact``: a number, a text or a truth value, where the control begins; a
        range ``(low, high)`` or ``(low, high, step)``; a list of choices, or a dict of choices by their labels; an
        ``ep.Param`` or ``ep.Roi``. A range begins at the parameter's default, else in its middle. Arrays, and
        ``ipywidgets.fixed(value)``, have no controls. A parameter without any of these has its default, and the range
        that its annotation or the tables of OpenCV and scikit-image know.

    Returns
    -------
    Panel
        As the last expression of a cell it shows itself.

    Raises
    ------
    GraphError, TypeError, ValueError, UnknownName, PayloadError
        The functions can't be tuned, such as a lambda or one with ``*args``; a parameter has no value; a keyword is for
        no parameter; the image is None, or what the functions return. Each says the way out.
    Exception
        Whatever a function raises on the first run.

    Examples
    --------
    >>> def scale(x, factor, offset=1):
    ...     return factor * x + offset
    >>> panel = interact(scale, 10, factor=(0, 4))
    >>> panel.values, panel.result["scale"]
    ({'factor': 2, 'offset': 1}, 21)
    >>> panel.code()
    'panel.runner.rerun()'
    """
    return tune(made_runner(functions, payload, abbreviations, "interact"))


def tune(
    tuned: CompGraphRunner | Connection | Callable[..., Any] | Sequence[Callable[..., Any]] | CompGraph | Made,
    /,
    *,
    images: Iterable[Any] | str | Path | None = None,
    camera: Any = None,
    cases: Any = None,
    token: str | None = None,
    metric: Any = None,
    direction: Direction = "maximize",
    store: str | Path | Store | None = None,
    name: str | None = None,
    **hints: Any,
) -> Panel:
    """Show controls for the hyperparameters of a runner or a running service, and the picture that they make.

    Parameters
    ----------
    tuned
        A runner that has been run, so that there is a payload, unless ``images`` are given. Or what ``ep.connect``
        has returned: then the picture follows the service's own events, values are set there, with their revision, and
        what other clients set at the same time is never overwritten unseen. Or a function, a list of functions or a
        graph, with its payload by name, ``tune(edges, image=image, lo=(0, 255))``: see ``interact``.
    images
        Test images to switch between: values of the one free source token, or dicts by token. Or a video, as
        ``ep.video(path)`` or its path: then the panel has a slider of its frames, each of which is read when it is
        asked for. A service has none. Of a graph with state (``ep.delay``) they are the frames of a sequence, with a
        slider too: each is shown with the state that runs over all frames before it leave, from the initial state, with
        the same hyperparameters. What the delayed tokens do not need is not run on those.
    camera
        A camera, or what ``ep.camera`` takes, in the place of ``images``: the panel shows its newest frame, computed
        and painted as fast as it can be, and never an older one. The settings of a camera with a node map (exposure,
        gain, trigger, pixel format, frame rate, region) have controls, too; hints may give them narrower ranges. The
        panel has the camera until ``close``.
    cases
        A labelled set as ``ep.check`` takes it, in the place of ``images``: the inputs are the test images, and each
        shows whether it passes with the values that were committed last. A service has none.
    token
        The token whose picture is shown at first; without, the last sink token that is an image, else the last
        image.
    metric, direction
        What the "Optimise" button makes as large (``"maximize"``) or as small (``"minimize"``) as it can, within the
        ranges of the controls: ``metric(tokens, case)``, or the name of a token that is a number. Without, there is no
        such button. Looked at are the cases, else the images, else the last payload. The search runs beside the panel;
        "Use best" sets what it has found, and undo goes back.
    store
        Where each committed setting is kept: a SQLite file, a database's URL, or an ``ep.Store``. Nothing waits for it.
    name
        The name of the series there; without, those of the sink tokens.
    hints
        By hyperparameter: an ``ep.Param``, an ``ep.Roi``, a tuple as a range (low, high[, step]), a list of choices.
        Without, the annotation of the function that takes it counts, then the table of OpenCV's and scikit-image's
        parameters, then its value; what can't be moved is shown. A hyperparameter called as one of the above gets
        its hint from its annotation. With functions also their payload, and values, as ``interact`` takes them.

    Returns
    -------
    Panel
        As the last expression of a cell it shows itself. Running the cell again makes a new panel, which goes on from
        the runner's values and its history.

    Raises
    ------
    PayloadError
        The runner has not been run and there are no images, or they don't fit its free source tokens; or there are
        images for a service.
    Exception
        Whatever a function raises on the first image, if the runner has not been run.
    UnknownName
        A hint is for no hyperparameter of the runner, or ``token`` is not in its graph.
    ScaleError, ImageFileError
        The cases can't be understood, the file of an input can't be read, or the video can't be opened.
    TypeError, ValueError
        There are images and cases; a hint can't be read, or the hyperparameter's value lies outside of it.
    ServiceError
        The service is gone.
    CameraUnavailable
        The camera can't be opened, or gives no frame within ten seconds.
    StoreError
        There can be no such database. One that is away for now is reported in the panel's log.

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
    # Those of a camera's settings.
    own: dict[str, Any] = {name: hints.pop(name) for name in SETTINGS if camera is not None and name in hints}
    if are_functions(tuned):
        has_images = not (images is None and cases is None and camera is None)
        tuned = made_runner(tuned, (), hints, "tune", has_images=has_images, has_camera=camera is not None)
    runner, hints = (tuned.runner, tuned.hints) if isinstance(tuned, Made) else (tunable(tuned), hints)
    if token is not None:
        runner.cg.require_token(token)
    elif isinstance(tuned, Made):
        token = tuned.token
    found = read_cases(runner, images, cases)
    if found:
        given = payloads(runner, [case.inputs for case, _ in found], [case.name or "" for case, _ in found])
    else:
        given = Payloads() if images is None else payloads(runner, images)
    if camera is not None and (images is not None or cases is not None):
        raise InvalidValue("A camera takes the place of images and cases. Give one of them.")
    with ExitStack() as undone:
        feed = None if camera is None else undone.enter_context(closing(CameraFeed(runner, camera, own)))
        session = Session(runner, given, feed)
        if session.is_service and len(given):
            runner.trial({}, payload=given[0].values)  # refuses it
        elif runner.last is None and not len(given) and not session.is_service and feed is None:
            free = runner.free_source_tokens
            text = f"Nothing has been run yet, so there is nothing to tune on. Call {run_call(free)} first."
            raise PayloadError(free, text)
        control_set = ControlSet(controls(runner, hints, {} if feed is None else feed.controlled))
        looked_at: Any = [case for case, _ in found] or (given.inputs if len(given) else None)
        if looked_at is not None and session.states is not None:
            looked_at = [looked_at]  # the frames of one case
        search = None if metric is None else Search(runner, metric, direction, looked_at, control_set.params)
        session.begin()
        panel = Panel(control_set, session, token, found, store, name, search, isinstance(tuned, Made))
        undone.pop_all()
    return panel
