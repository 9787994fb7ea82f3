"""What does a graph compute of each of many images?"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from epypes.batch.cache import StoredOutcomes, series_of
from epypes.batch.executors import JobSizes, run_jobs, worker_count
from epypes.batch.items import Item, count_of, detached_runner, items_of
from epypes.batch.job import Job
from epypes.batch.progress import Advance, progress_bar
from epypes.batch.results import Outcome, outcomes_frame, outcomes_html
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.store import Store, opened_store
from epypes.wording import counted

if TYPE_CHECKING:
    import pandas as pd


class MapResult(Sequence[Outcome]):
    """What a graph computed of many images: a sequence of outcomes in the order of the images, shown as a table.

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
        Who does it: this thread without. A ThreadPoolExecutor runs the graph as it is; any other executor, of
        processes or a Dask cluster (``client.get_executor()``), a bundle that is made of it. The results are the
        same, unless a function keeps something from one item to the next: a bundle refuses it, threads can't know.
        Functions of a module that is not installed, such as a file next to the notebook, can't go to other processes.
    keep
        Tokens whose values are kept, in ``outcome.kept``; nothing else but numbers and texts is.
    show
        Tokens of which thumbnails are kept, which the table shows; None: all that have a picture.
    store
        A path, a URL or an ep.Store, where outcomes are written as they come. What is there already is not run again,
        unless ``keep`` is given: so a map that was interrupted goes on.
    name
        What the series in the store is called; without, a digest of graph, hyperparameters, and all that functions
        reach: code, globals, attributes, the modules that they import. A series of other code is refused. All is run
        again if lists, dicts, arrays or objects that functions use have changed, or one can't be seen through.
    progress
        Whether there is a bar; without, in a terminal and in a notebook.
    ahead
        How many jobs are at work or waiting at most; twice as many as there are workers without.

    Returns
    -------
    MapResult
        One outcome per image, in order. An image that can't be read or on which a function fails is one that says so.

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
    # Whoever sets values on theirs meanwhile, or writes into them, does not change what is computed and stored.
    runner = detached_runner(runner)
    with ExitStack() as stack:
        opened = stack.enter_context(opened_store(store))
        memory = None
        if opened is not None:
            series, fingerprint = series_of(opened, "map", runner, name)
            how = "" if show == () else f"show={show and list(show)}"
            memory = stack.enter_context(StoredOutcomes(series, how, not keep, fingerprint))
        advance = stack.enter_context(progress_bar(progress, count_of(images), "map"))
        work = _Map(memory, advance, tuple(keep), None if show is None else tuple(show))
        is_copied = executor is not None or opened is not None or bool(keep)
        work.run(runner, items_of(images, runner, is_copied=is_copied), count_of(images), executor, ahead)
    return MapResult(runner.cg, sorted(work.outcomes, key=lambda outcome: outcome.number))


class _Map:
    """One map: the outcomes that have come."""

    def __init__(
        self, memory: StoredOutcomes | None, advance: Advance, keep: tuple[str, ...], show: tuple[str, ...] | None
    ) -> None:
        self._memory, self._advance, self._keep, self._show = memory, advance, keep, show
        self.outcomes: list[Outcome] = []

    def run(
        self,
        runner: CompGraphRunner,
        items: Iterable[Item],
        count: int | None,
        executor: Executor | None,
        ahead: int | None,
    ) -> None:
        """Run what has to be run."""
        workers = 0 if executor is None else worker_count(executor)
        batches = JobSizes(self._unknown(items), workers, count)
        jobs = (Job(batch, keep=self._keep, show=self._show) for batch in batches)
        for outcomes in run_jobs(runner, jobs, executor, ahead=ahead):
            batches.learn(outcomes)
            if self._memory is not None:
                self._memory.add(outcomes)
            self._take(outcomes)

    def _unknown(self, items: Iterable[Item]) -> Iterator[Item]:
        """Give the items that have to be run; take the outcomes of the others."""
        for item in items:
            found = None if self._memory is None else self._memory.recall(item)
            if found is None:
                yield item
            else:
                self._take([found])
            # Whoever waits for the next one must not keep this one alive.
            del item

    def _take(self, outcomes: list[Outcome]) -> None:
        self.outcomes += outcomes
        self._advance(len(outcomes), sum(outcome.has_failed for outcome in outcomes))
