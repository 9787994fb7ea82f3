"""Sweep: run a graph with many settings, on one image or many."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.cache import outcome_cache
from epypes.batch.contact_sheet import Sheet, sheet_of
from epypes.batch.executors import run_jobs, runs_here, worker_count
from epypes.batch.grid import Grid, Setting, functions_after, grid_of, running_order, steps
from epypes.batch.items import Item, count_of, detached_runner, items_of
from epypes.batch.job import Job, SharedStart
from epypes.batch.mapping import OutcomeCollector
from epypes.batch.progress import progress_bar
from epypes.batch.results import FIXED_COLUMNS, Outcome, outcomes_frame
from epypes.errors import PayloadError, ScaleError, run_call
from epypes.run import CompGraphRunner
from epypes.store import Store
from epypes.wording import counted

if TYPE_CHECKING:
    import pandas as pd

# Each of at most 5 KB, and some belong to several outcomes.
_MOST_PICTURES: Final = 200_000
# Progress is seen, and a stop is heard, between two parts; and workers are done at about the same time.
_PARTS: Final = 16
_MOST_SETTINGS: Final = 256


@dataclass(frozen=True, slots=True, eq=False)
class SweepResult:
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
    runner: CompGraphRunner = field(repr=False)

    def __len__(self) -> int:
        return len(self.outcomes)

    def __getitem__(self, place: int) -> Outcome:
        return self.outcomes[place]

    def __iter__(self) -> Iterator[Outcome]:
        return iter(self.outcomes)

    @property
    def failures(self) -> tuple[Outcome, ...]:
        """The outcomes in which something failed."""
        return tuple(outcome for outcome in self.outcomes if outcome.error_info is not None)

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
    given, runner = runner, detached_runner(runner)
    kept, shown = _tokens(runner, keep), None if show is None else _tokens(runner, show)
    plan = grid_of(runner, grid, how=how, n=n, seed=seed)
    count = 1 if images is None else count_of(images)
    _require_room(runner, plan, shown, count or 1)
    settings = plan.settings()
    # By object: a setting comes back as the very mapping that was sent.
    places = {id(setting): place for place, setting in enumerate(settings)}
    in_order = tuple(settings[place] for place in running_order(runner.cg, settings))
    with (
        progress_bar(progress, count and count * plan.size, "sweep", unit="setting") as advance,
        outcome_cache(store, "sweep", runner, name, keep=kept, show=shown, varied=plan.names) as cache,
    ):
        collector = OutcomeCollector(cache, advance)
        is_copied = executor is not None or cache is not None or bool(kept)
        items = _items(given, images, plan, is_copied=is_copied)
        make = partial(Job, keep=kept, show=shown)
        for outcomes in run_jobs(runner, _jobs(runner, make, in_order, items, collector, executor, count), executor):
            collector.add(outcomes)
    found = sorted(collector.outcomes, key=lambda outcome: (outcome.number, places[id(outcome.setting)]))
    return SweepResult(tuple(found), plan.names, given)


def _jobs(
    runner: CompGraphRunner,
    make: Callable[..., Job],
    in_order: tuple[Setting, ...],
    items: Iterator[Item],
    collector: OutcomeCollector,
    executor: Executor | None,
    images: int | None,
) -> Iterator[Job]:
    """Yield the jobs of each item: its settings in parts, which in this process share the item's first run."""
    for item in items:
        settings = collector.missing_settings(item, in_order)
        cuts = _cuts(runner, settings, executor, images) if settings else []
        start = SharedStart() if len(cuts) > 2 and runs_here(executor) else None
        for first, end in pairwise(cuts):
            yield make(item, settings[first:end], start=start)
        # This generator waits for its caller, and must not keep the item alive meanwhile.
        del item, start


def _tokens(runner: CompGraphRunner, given: str | Sequence[str]) -> tuple[str, ...]:
    tokens = (given,) if isinstance(given, str) else tuple(given)
    for token in tokens:
        runner.cg.require_token(token)
    return tokens


def _require_room(runner: CompGraphRunner, plan: Grid, shown: Sequence[str] | None, images: int) -> None:
    plan.require_room(images)
    varying = {name for varied in plan.names for name in _made_after(runner, varied)}
    tokens = varying if shown is None else varying.intersection(shown)
    pictures = plan.size * images * len(tokens)
    if pictures > _MOST_PICTURES:
        raise ScaleError(
            f"Thumbnails of {len(tokens)} tokens with {plan.size:,} settings on {images:,} images are up to "
            f"{pictures:,} pictures, and at most {_MOST_PICTURES:,} can be held. Name fewer, as show=(), or take "
            "fewer values."
        )


def _made_after(runner: CompGraphRunner, name: str) -> Iterator[str]:
    """Yield the tokens that depend on a hyperparameter."""
    for function in functions_after(runner.cg, name):
        yield from runner.cg.func_outputs(function)


def _items(runner: CompGraphRunner, images: Any, plan: Grid, *, is_copied: bool) -> Iterator[Item]:
    if images is None:
        yield Item(0, "last payload", _last_payload(runner))
        return
    for item in items_of(images, runner, is_copied=is_copied):
        # How many a generator gives is known when it gives them.
        plan.require_room(item.number + 1)
        yield item
        del item


def _last_payload(runner: CompGraphRunner) -> dict[str, Any]:
    free, last = runner.free_source_tokens, runner.last
    missing = free if last is None else tuple(token for token in free if not last.tokens.is_computed(token))
    if missing:
        raise PayloadError(missing, f"Nothing has been run yet. Give images=..., or call {run_call(free)} first.")
    return {} if last is None else {token: last[token] for token in free}


# -- parts of a grid ------------------------------------------------------------------------------------------------


def _cuts(
    runner: CompGraphRunner, settings: Sequence[Setting], executor: Executor | None, images: int | None
) -> list[int]:
    """Return where the settings of an item are cut into parts: from 0 to their number."""
    if executor is None:
        # Each begins where the one before has ended, so they are for progress only.
        parts, places = _PARTS, list(range(len(settings)))
    else:
        workers = worker_count(executor)
        # Outside of this process each part computes what all have in common: there are only as many as keep all
        # workers at work.
        parts = -(-workers // max(images or workers, 1))
        parts *= _PARTS if parts > 1 and runs_here(executor) else 1
        # What the slowest hyperparameter has made is computed once if no part begins amid one of its values.
        places = steps(runner.cg, settings)
        places = places if len(places) >= workers else list(range(len(settings)))
    parts = min(max(parts, -(-len(settings) // _MOST_SETTINGS)), len(places))
    return [*(places[len(places) * part // parts] for part in range(parts)), len(settings)]
