"""Making a panel for what a user wants to tune."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from epypes.errors import PayloadError, run_call
from epypes.run import CompGraphRunner
from epypes.store import Store
from epypes_widgets.controls import controls
from epypes_widgets.hand import Hand
from epypes_widgets.looking.films import Payload, payloads
from epypes_widgets.panel import Panel
from epypes_widgets.places import Tunable, tunable
from epypes_widgets.searching import search_of
from epypes_widgets.session import Session
from epypes_widgets.stored import StoredHistory
from epypes_widgets.verdicts import case_payloads, cases_to_show

if TYPE_CHECKING:
    from epypes.batch.optimize import Direction
    from epypes.service.remote.connection import Connection


def tune(
    tuned: CompGraphRunner | Connection,
    /,
    *,
    images: Iterable[Any] | None = None,
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
        what somebody else sets at the same time is never overwritten unseen.
    images
        Test images to switch between: values of the one free source token, or dicts by token. A service has none.
    cases
        A labelled set as ``ep.check`` takes it, in the place of ``images``: the inputs are the test images, and each
        says whether it passes with the values that were committed last. A service has none.
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
        Without, the annotation of the function that takes it says it, then the table of OpenCV's and scikit-image's
        parameters, then its value; what can't be moved is shown. A hyperparameter called as one of the above gets
        its hint from its annotation.

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
        The cases can't be understood, or the file of an input can't be read.
    TypeError, ValueError
        There are images and cases; a hint can't be read, or the hyperparameter's value lies outside of it.
    ServiceError
        The service is gone.
    StoreError
        There can be no such database. One that is away for now is told in the panel's log.

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
    runner = tunable(tuned)
    if token is not None:
        runner.cg.require_token(token)
    found = cases_to_show(runner, images, cases)
    given = case_payloads(runner, found) if found else () if images is None else payloads(runner, images)
    session = Session(runner, given)
    if not session.place.is_shared:
        _require_payload(runner, given)
    elif given:
        runner.trial({}, payload=given[0].values)  # refuses it
    stored = StoredHistory(runner, store, name)
    hand = Hand(controls(runner, hints))
    looked_at: list[Any] | None = [case for case, _ in found] or [film.values for film in given] or None
    search = search_of(runner, metric, direction, looked_at, lambda: hand.params)
    session.begin()
    return Panel(hand, session, token, found, stored, search)


def _require_payload(runner: Tunable, given: Sequence[Payload]) -> None:
    if runner.last is None and not given:
        free = runner.free_source_tokens
        text = f"Nothing has been run yet, so there is nothing to tune on. Call {run_call(free)} first."
        raise PayloadError(free, text)
