"""Map: run a graph on each of many images."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from epypes.batch.cache import OutcomeCache, outcome_cache
from epypes.batch.executors import run_jobs
from epypes.batch.items import Item, count_of, detached_runner, items_of
from epypes.batch.job import NO_SETTING, Job, Setting
from epypes.batch.progress import Advance, progress_bar
from epypes.batch.results import Outcome, outcomes_frame, outcomes_html
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.store import Store
from epypes.wording import counted

if TYPE_CHECKING:
    import pandas as pd


class MapResult(Sequence[Outcome]):
    """The results of a map: a sequence of outcomes in the order of the images, shown as a table.

    Attributes
    ----------
    cg
        The graph.
    outcomes
        One per image.
    """

    __slots__ = ("cg", "outcomes")

    def __init__(self, cg: CompGraph, outcomes: Iterable[Outcome]) -> None:
        self.cg, self.outcomes = cg, tuple(outcomes)

    @property
    def failures(self) -> tuple[Outcome, ...]:
        """The outcomes of images that could not be read or on which a function failed."""
        return tuple(outcome for outcome in self.outcomes if outcome.has_failed)

    def to_frame(self) -> pd.DataFrame:
        """Return a table: name, failure, the sink tokens, total_ms, and the time of each function in ms.

        Sink tokens that are no numbers, texts or truth values stand there as a short text.
        """
        return outcomes_frame(self.outcomes, self.cg)

    @overload
    def __getitem__(self, index: int) -> Outcome: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Outcome, ...]: ...
    def __getitem__(self, index: int | slice) -> Outcome | tuple[Outcome, ...]:
        return self.outcomes[index]

    def __len__(self) -> int:
        return len(self.outcomes)

    def __repr__(self) -> str:
        return f"<MapResult: {self._caption}>"

    @property
    def _caption(self) -> str:
        return f"{counted(len(self), 'image')}, {len(self.failures)} failed"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return {"text/plain": repr(self), "text/html": outcomes_html(self.outcomes, self.cg, self._caption)}


def map_images(
    runner: CompGraphRunner,
    images: Any,
    executor: Executor | None = None,
    *,
    keep: Sequence[str] = (),
    show: Sequence[str] | None = (),
    store: str | Path | Store | None = None,
    name: str | None = None,
    progress: bool | None = None,
    ahead: int | None = None,
) -> MapResult:
    """Run a graph on many images, with the runner's hyperparameters; the runner is left as it is.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used.
    images
        A folder, a glob, or an iterable of images, paths of image files, or dicts by free source token; read when
        their turn comes, so that they may be more than fit into memory. A generator may fill one array again and again.
        In a dict a text stands for itself, unless it has the ending of an image and there is such a file.
    executor
        None: this thread runs the images. A ThreadPoolExecutor runs the graph as it is; any other executor, of
        processes or a Dask cluster (``client.get_executor()``), a bundle that is made of it. The results are the
        same, unless a function keeps something from one item to the next: a bundle refuses it, threads can't notice it.
        Functions of a module that is not installed, such as a file next to the notebook, can't go to other processes.
    keep
        Tokens whose values are kept, in ``outcome.kept``; nothing else but numbers and texts is.
    show
        Tokens of which thumbnails are kept, which the table shows; None: all that have a picture.
    store
        A path, a URL or an ep.Store, where outcomes are written as they come. What is there already is not run again,
        unless ``keep`` is given: so a map that was interrupted goes on.
    name
        What the series in the store is called; without, a digest of the graph, its hyperparameters and all that its
        functions use: code, globals, attributes, modules. Under a name that is taken, other code or other
        hyperparameters are refused. Every item is run again if lists, dicts, arrays or objects that functions use have
        changed, or if the content of one can't be compared. What functions read from files or the environment is not
        compared. Where a function has a name such as ``open``, ``imread``, ``load`` or ``environ`` in its code, every
        item is run again unless ``name`` is given: then give another one when a file or a variable has changed. What a
        library reads by itself, the network and the clock are not recognised.
    progress
        Whether there is a bar; without, in a terminal and in a notebook.
    ahead
        How many jobs are in flight at most; twice as many as there are workers without.

    Returns
    -------
    MapResult
        One outcome per image, in order. An image that can't be read or on which a function fails is one with its error.

    Raises
    ------
    ScaleError
        The set is empty; an item does not give the free source tokens; the graph or a value can't travel.
    ExecutorBroken
        The executor can't go on.
    PromotionRefused
        The graph can't become a bundle, which processes and clusters need.
    UnknownName
        ``keep`` or ``show`` names no token of the graph.

    Examples
    --------
    >>> import numpy as np
    >>> cg = CompGraph({"mean": lambda image: float(image.mean())}, {"mean": ("image", "brightness")})
    >>> result = map_images(CompGraphRunner(cg), (np.full((2, 2), level) for level in (3, 7)))
    >>> [outcome.values["brightness"] for outcome in result]
    [3.0, 7.0]
    """
    for token in (*keep, *(show or ())):
        runner.cg.require_token(token)
    # If the caller changes hyperparameters meanwhile, that does not change what is computed and stored.
    runner = detached_runner(runner)
    count = count_of(images)
    with (
        outcome_cache(store, "map", runner, name, keep=keep, show=show) as cache,
        progress_bar(progress, count, "map") as advance,
    ):
        collector = OutcomeCollector(cache, advance)
        items = items_of(images, runner, is_copied=executor is not None or cache is not None or bool(keep))
        shown = None if show is None else tuple(show)
        jobs = (Job(item, keep=tuple(keep), show=shown) for item in collector.missing_items(items))
        for outcomes in run_jobs(runner, jobs, executor, ahead=ahead):
            collector.add(outcomes)
    return MapResult(runner.cg, sorted(collector.outcomes, key=lambda outcome: outcome.number))


class OutcomeCollector:
    """The outcomes of a map or a sweep: those in the cache, and those that come from workers.

    Parameters
    ----------
    cache
        What was stored before, and where new outcomes go; None for none.
    advance
        Moves the progress bar on.
    """

    def __init__(self, cache: OutcomeCache | None, advance: Advance) -> None:
        self._cache, self._advance = cache, advance
        self.outcomes: list[Outcome] = []

    def missing_items(self, items: Iterable[Item]) -> Iterator[Item]:
        """Yield the items that have to be run without a setting; take the stored outcomes of the others."""
        for item in items:
            if self.missing_settings(item, (NO_SETTING,)):
                yield item
            # This generator waits for its caller, and must not keep the item alive meanwhile.
            del item

    def missing_settings(self, item: Item, settings: tuple[Setting, ...]) -> tuple[Setting, ...]:
        """Return the settings with which an item has to be run; take the stored outcomes of the others."""
        if self._cache is None:
            return settings
        found = self._cache.found(item, settings)
        self._take([outcome for outcome in found if outcome is not None])
        return tuple(setting for setting, outcome in zip(settings, found, strict=True) if outcome is None)

    def add(self, outcomes: list[Outcome]) -> None:
        """Take outcomes that were computed, and store them."""
        if self._cache is not None:
            self._cache.add(outcomes)
        self._take(outcomes)

    def _take(self, outcomes: list[Outcome]) -> None:
        self.outcomes += outcomes
        self._advance(len(outcomes), sum(outcome.has_failed for outcome in outcomes))
