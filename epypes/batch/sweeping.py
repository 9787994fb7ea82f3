"""Sweep: run a graph with many settings, on one image or many."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.contact_sheet import Sheet, sheet_of
from epypes.batch.grid import Grid, functions_after, grid_of
from epypes.batch.items import Item, count_of
from epypes.batch.mapping import run_items, tokens_of
from epypes.batch.results import FIXED_COLUMNS, Outcome, OutcomeSequence, outcomes_frame
from epypes.errors import PayloadError, ScaleError, run_call
from epypes.run import CompGraphRunner
from epypes.store import Store
from epypes.wording import counted

if TYPE_CHECKING:
    import pandas as pd

# Each of at most 5 KB, and some belong to several outcomes.
_MOST_PICTURES: Final = 200_000


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SweepResult(OutcomeSequence):
    """The results of a sweep; shows itself as a contact sheet.

    Attributes
    ----------
    outcomes
        Image by image, in each the settings in the order of the grid.
    names
        The hyperparameters that were varied.
    runner
        The one that was given.
    """

    outcomes: tuple[Outcome, ...]
    names: tuple[str, ...]
    runner: CompGraphRunner

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row per outcome.

        Its columns are name, the hyperparameters that were varied, failure (None, or what failed), the sink tokens,
        total_ms and the milliseconds of each function that ran: what did not depend on what changed has none.
        """
        varied = {
            f"{name} (hyperparameter)" if name in FIXED_COLUMNS else name: [
                one.setting.get(name) for one in self.outcomes
            ]
            for name in self.names
        }
        return outcomes_frame(self.outcomes, self.runner.cg, varied)

    def sheet(self, token: str | None = None, rows: str | None = None, columns: str | None = None) -> Sheet:
        """Return the contact sheet of a token.

        Parameters
        ----------
        token
            Any that was shown, as a picture or as text. None: the last sink token that has pictures, else
            the last token that has some.
        rows, columns
            Hyperparameters by which the pictures are laid out; None: the first two that vary. What else varies, and
            several images, give further blocks.

        Raises
        ------
        UnknownName
            A name is none of a token, or of a hyperparameter that was varied.
        ScaleError
            Nothing of the token was kept to be shown, or rows and columns are the same.
        """
        return sheet_of(self.runner.cg, self.outcomes, token, rows, columns)

    def __repr__(self) -> str:
        failed = f"{len(self.failures)} failed"
        varied = ", ".join(self.names)
        return f"<SweepResult: {counted(len(self), 'outcome')} of {varied:.40}; {failed}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        shown = self.sheet()
        bundle = shown._repr_mimebundle_()
        return {**bundle, "text/plain": bundle["text/plain"].replace(repr(shown), repr(self))}


def sweep(
    runner: CompGraphRunner,
    grid: Any,
    images: Any = None,
    executor: Executor | None = None,
    *,
    how: str = "product",
    n: int | None = None,
    seed: int = 0,
    keep: Sequence[str] = (),
    show: Sequence[str] | None = None,
    store: str | Path | Store | None = None,
    name: str | None = None,
    progress: bool | None = None,
) -> SweepResult:
    """Run a graph with many settings, on one image or many; functions that depend on none of them run once an image.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used; it is left as it was.
    grid
        Values by hyperparameter: lists, arrays, or an ``ep.Param`` whose values can be counted; None for those that
        its hint allows. Or a list of settings, each a dict, taken as they are.
    images
        As for ``map``; None: the runner's last payload.
    executor
        Any of ``concurrent.futures``, as for ``map``. Threads share what the settings have in common; processes that
        run parts of the grid on one image compute it each.
    how
        ``"product"``: each value with each other; ``"zip"``: the first values of all, then the second ones, and so on;
        ``"random"``: ``n`` settings drawn from ranges ``(low, high)``, ``ep.Param``, lists of choices, or None for the
        hint's; ``"latin"``: the same by Latin hypercubes, which spread more evenly.
    n
        How many settings are drawn.
    seed
        The same one draws the same settings.
    keep
        Tokens whose values are kept in ``outcome.kept``; of all others only thumbnails, numbers and texts are.
    show
        Tokens of which thumbnails are made; None: all that have a picture. Of others a text is kept.
    store, name
        As for ``map``: settings that are stored already are not run again.
    progress
        As for ``map``.

    Returns
    -------
    SweepResult
        Its contact sheet, its table, its outcomes. A setting that fails is an outcome with its trouble.

    Raises
    ------
    ScaleError
        The grid is empty, or too large to hold; there is no image; a package is missing.
    UnknownName
        A name is none of a hyperparameter or token.
    PayloadError
        ``images`` is None and nothing has been run yet.

    Examples
    --------
    >>> from epypes import CompGraph, CompGraphRunner
    >>> runner = CompGraphRunner(CompGraph({"add": lambda x, y: x + y}, {"add": (("x", "y"), "total")}), {"y": 1})
    >>> result = sweep(runner, {"y": [10, 20]}, images=[1, 2])
    >>> [outcome.values["total"] for outcome in result]
    [11, 21, 12, 22]
    """
    if images is None:
        images = [Item(0, "last payload", _last_payload(runner))]
    plan = grid_of(runner, grid, how=how, n=n, seed=seed)
    _require_room(runner, plan, show, count_of(images) or 1)
    outcomes = run_items(
        runner, images, plan.settings(), executor,
        kind="sweep", keep=keep, show=show, store=store, name=name, progress=progress,
    )  # fmt: skip
    return SweepResult(outcomes, plan.names, runner)


def _require_room(runner: CompGraphRunner, plan: Grid, show: Sequence[str] | None, images: int) -> None:
    """Raise ScaleError if the outcomes, or their thumbnails, are too many to hold."""
    plan.require_room(images)
    after = {function for name in plan.names for function in functions_after(runner.cg, name)}
    varying = {token for function in after for token in runner.cg.func_outputs(function)}
    tokens = varying if show is None else varying.intersection(tokens_of(runner, show))
    pictures = plan.size * images * len(tokens)
    if pictures > _MOST_PICTURES:
        raise ScaleError(
            f"Thumbnails of {len(tokens)} tokens with {plan.size:,} settings on {images:,} images are up to "
            f"{pictures:,} pictures, and at most {_MOST_PICTURES:,} can be held. Name fewer, as show=(), or take "
            "fewer values."
        )


def _last_payload(runner: CompGraphRunner) -> dict[str, Any]:
    free, last = runner.free_source_tokens, runner.last
    missing = free if last is None else tuple(token for token in free if not last.tokens.is_computed(token))
    if missing:
        raise PayloadError(missing, f"Nothing has been run yet. Give images=..., or call {run_call(free)} first.")
    return {} if last is None else {token: last[token] for token in free}
