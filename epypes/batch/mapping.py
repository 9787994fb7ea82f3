"""Map and sweep: run a graph on many images, with many settings. A map is a sweep of one empty setting."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.cache import OutcomeCache, outcome_cache
from epypes.batch.contact_sheet import Sheet, sheet_of, sheet_page
from epypes.batch.executors import progress_bar, run_jobs, runs_here, worker_count
from epypes.batch.grid import Setting, functions_after, require_room, running_order, settings_of, steps
from epypes.batch.items import ImageSet, Item, SeriesKeys, detached_runner, image_set, items_of, with_series
from epypes.batch.job import NO_SETTING, Done, Job, SeriesRuns, SharedStart, State, whole_series
from epypes.batch.results import BatchResult, Outcome, outcomes_frame, outcomes_html
from epypes.errors import PayloadError, ScaleError, run_call
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.store import Store
from epypes.wording import counted

if TYPE_CHECKING:
    import pandas as pd

# Progress is seen, and a stop is heard, between two parts; and workers are done at about the same time.
_PARTS: Final = 16
_MOST_SETTINGS: Final = 256
_JOBS_PER_WORKER: Final = 2
# Each of at most 5 KB, and some belong to several outcomes.
_MOST_PICTURES: Final = 200_000
_UNITS: Final = {"map": "image", "sweep": "setting"}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MapResult(BatchResult[Outcome]):
    """The results of a map: a sequence of outcomes in the order of the images, shown as a table.

    Attributes
    ----------
    cg
        The graph.
    outcomes
        One per image.
    """

    cg: CompGraph
    outcomes: tuple[Outcome, ...]

    def to_frame(self) -> pd.DataFrame:
        """Return a table: name, failure, the sink tokens, total_ms, and the time of each function in ms.

        Of frames of a video it has frame and time_s after name: the number, from 0, and the time since the first frame.
        Sink tokens that are no numbers, texts or truth values stand there as a short text.
        """
        return outcomes_frame(self.outcomes, self.cg)

    def sheet(self, token: str | None = None) -> Sheet:
        """Return the contact sheet of a token: the images side by side with their numbers, those that failed first.

        Parameters
        ----------
        token
            One of those that ``show`` named. None: the last sink token that has pictures, else the last token that has
            some.

        Raises
        ------
        UnknownName
            There is no such token.
        ScaleError
            Nothing of the token was kept to be shown.
        """
        return sheet_of(self.cg, self.outcomes, token)

    @property
    def _caption(self) -> str:
        return f"{counted(len(self), 'image')}, {len(self.failures)} failed"

    def _page(self) -> str:
        return outcomes_html(self.outcomes, self.cg, self._caption)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SweepResult(BatchResult[Outcome]):
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
        varied = {name: [outcome.setting.get(name) for outcome in self.outcomes] for name in self.names}
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

    @property
    def _caption(self) -> str:
        failed, varied = len(self.failures), ", ".join(self.names)
        return f"{counted(len(self), 'outcome')} of {varied:.40}; {failed} failed"

    def _page(self) -> str:
        return sheet_page(self.sheet())


def map_images(
    runner: CompGraphRunner,
    images: Any,
    executor: Executor | None = None,
    *,
    keep: Sequence[str] = (),
    show: Sequence[str] | None = (),
    series: SeriesKeys | None = None,
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
        A folder, a glob, a video (its path, or ``ep.video(path)``), or an iterable of images, frames of ``ep.camera``,
        paths of image files and videos, or dicts by free source token; read when their turn comes, so that they may be
        more than fit into memory. A generator may fill one array again and again. In a dict a text stands for itself,
        unless it has the ending of an image or a video and there is such a file.
    executor
        None: this thread runs the images. A ThreadPoolExecutor runs the graph as it is; any other executor, of
        processes or a Dask cluster (``client.get_executor()``), a bundle that is made of it. The results are the
        same, unless a function keeps something from one item to the next: a bundle refuses it, threads can't notice it.
        ``ep.delay`` keeps it in a token.
        Modules of the project that the functions import go along.
    keep
        Tokens whose values are kept, in ``outcome.kept``; nothing else but numbers and texts is.
    show
        Tokens of which thumbnails are kept, which the table and ``result.sheet(token)`` show; None: all that have a
        picture.
    series
        How the images are divided into series: a key per image, or a function that is called with an image and returns
        its key (of a file with its Path, of several free source tokens with a dict):
        ``series=lambda path: path.parent.name``. Without, each video is a series, and so are all other images together.
        The table gets a column of the keys. A graph with state (``ep.delay``) runs a series in order, wherever there is
        a worker: it begins with the initial state, and each image with the state that the one before has left; one that
        fails leaves it as it was. Several series are run side by side.
    store
        A path, a URL or an ep.Store, where outcomes are written as they come. What is there already is not run again,
        unless ``keep`` is given: so a map that was interrupted goes on. Of a graph with state an outcome counts for its
        image and all images before it in its series; series of which some is missing are run from their beginning, and
        so are those of a generator.
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
        One outcome per image, in order; of a video one per frame, with its number and time. An image that can't be
        read, a frame that is damaged, and what a function fails on is one with its error.

    Raises
    ------
    ScaleError
        The set is empty; an item does not give the free source tokens; the graph or a value can't travel.
    ImageFileError
        A video can't be opened; nothing is run then.
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
    batch = _Batch(
        runner=detached_runner(runner), images=image_set(images), settings=(NO_SETTING,), executor=executor, kind="map",
        keep=tokens_of(runner, keep), show=None if show is None else tokens_of(runner, show), series=series,
        store=store, name=name, progress=progress, ahead=ahead,
    )  # fmt: skip
    return MapResult(runner.cg, batch.run())


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
    series: SeriesKeys | None = None,
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
        As for ``map``; None: the runner's last payload, and the state that the last run began with.
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
    series
        As for ``map``: of a graph with state each series is run whole with each setting, from its beginning.
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
        A name is none of a hyperparameter or token, or a value no branch of the switch that it selects.
    HyperparameterError
        A name is that of a token that is no hyperparameter.
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
    state: State | None = None
    if images is None:
        images = [Item(0, "last payload", _last_payload(runner))]
        state = None if runner.last is None else runner.last.state_before or None
    settings = settings_of(runner, grid, how=how, n=n, seed=seed)
    batch = _Batch(
        runner=detached_runner(runner), images=image_set(images), settings=settings, executor=executor, kind="sweep",
        keep=tokens_of(runner, keep), show=None if show is None else tokens_of(runner, show), series=series,
        store=store, name=name, progress=progress, state=state,
    )  # fmt: skip
    return SweepResult(batch.run(), tuple(settings[0]), runner)


def _last_payload(runner: CompGraphRunner) -> dict[str, Any]:
    free, last = runner.free_source_tokens, runner.last
    missing = free if last is None else tuple(token for token in free if not last.tokens.is_computed(token))
    if missing:
        raise PayloadError(missing, f"Nothing has been run yet. Give images=..., or call {run_call(free)} first.")
    return {} if last is None else {token: last[token] for token in free}


# -- items and settings as jobs -------------------------------------------------------------------------------------


@dataclass(slots=True, kw_only=True)
class _Batch:
    """What is run on which images: the attributes are the parameters of ``map`` and ``sweep``.

    ``kind`` is ``"map"`` or ``"sweep"``. Each series begins with ``state``, without it with the initial state of the
    graph. The runner is detached: if the caller changes hyperparameters meanwhile, that does not change what is
    computed and stored.
    """

    runner: CompGraphRunner
    images: ImageSet
    settings: tuple[Setting, ...]
    executor: Executor | None
    kind: str
    keep: tuple[str, ...]
    show: tuple[str, ...] | None
    series: SeriesKeys | None
    store: str | Path | Store | None
    name: str | None
    progress: bool | None
    state: State | None = None
    ahead: int | None = None

    def run(self) -> tuple[Outcome, ...]:
        """Return the outcomes of items under settings: item by item, in each in the order of its settings."""
        runner, images = self.runner, self.images
        state = runner.state or None if self.state is None else self.state
        # By object: a setting comes back as the very mapping that was sent.
        places = {id(setting): place for place, setting in enumerate(self.settings)}
        self.settings = tuple(self.settings[place] for place in running_order(runner.cg, self.settings))
        if self.kind == "sweep":
            self._require_room(images.count or 1)
        # Where what is stored decides which series are run, the items are gone through twice.
        is_read = state is None or not (isinstance(images.values, Iterator) or isinstance(self.series, Iterator))
        outcomes: list[Outcome] = []
        total = None if images.count is None else images.count * len(self.settings)
        with (
            outcome_cache(
                self.store, self.kind, runner, self.name,
                keep=self.keep, show=self.show, settings=self.settings, state=state, is_read=is_read,
            ) as cache,
            progress_bar(self.progress, total, self.kind, unit=_UNITS[self.kind]) as advance,
        ):  # fmt: skip

            def take(found: Sequence[Outcome]) -> None:
                outcomes.extend(found)
                advance(len(found), sum(outcome.has_failed for outcome in found))

            runs = None if state is None else self._series_runs(state, cache, take)
            jobs = self._jobs(cache, take) if runs is None else runs
            for found in run_jobs(runner, jobs, self.executor, ahead=self.ahead):
                settled = found if runs is None else runs.settle(found)
                if cache is not None:
                    cache.add(settled)
                take(settled)
        return tuple(sorted(outcomes, key=lambda outcome: (outcome.number, places[id(outcome.setting)])))

    def _require_room(self, images: int) -> None:
        """Raise ScaleError if the outcomes of a sweep, or the pictures of tokens that vary, are too many to hold."""
        settings, cg = self.settings, self.runner.cg
        require_room(len(settings), settings[0], images)
        varying = {token for name in functions_after(cg, *settings[0]) for token in cg.func_outputs(name)}
        tokens = varying if self.show is None else varying.intersection(self.show)
        pictures = len(settings) * images * len(tokens)
        if pictures > _MOST_PICTURES:
            raise ScaleError(
                f"Thumbnails of {len(tokens)} tokens with {len(settings):,} settings on {images:,} images are up to "
                f"{pictures:,} pictures, and at most {_MOST_PICTURES:,} can be held. Name fewer, as show=(), or take "
                "fewer values."
            )

    def _items(self) -> Iterator[Item]:
        items = with_series(items_of(self.images, self.runner), self.series)
        # How many a generator gives is known when it gives them; a map may be of any number.
        return self._limited(items) if self.kind == "sweep" and self.images.count is None else items

    def _limited(self, items: Iterator[Item]) -> Iterator[Item]:
        for item in items:
            self._require_room(item.number + 1)
            yield item
            # This generator waits for its caller, and must not keep the item alive meanwhile.
            del item

    def _jobs(self, cache: OutcomeCache | None, take: Callable[[Sequence[Outcome]], None]) -> Iterator[Job]:
        """Yield the jobs of each item: what is not stored, in parts, which in this process share the first run."""
        for item in self._items():
            missing = self.settings
            if cache is not None:
                stored = cache.found(item)
                take([outcome for outcome in stored if outcome is not None])
                missing = tuple(one for one, outcome in zip(missing, stored, strict=True) if outcome is None)
            parts = self._parts(missing)
            start = SharedStart() if len(parts) > 1 and runs_here(self.executor) else None
            for part in parts:
                yield Job(item, part, self.keep, self.show, start)
            del item, start

    def _parts(self, settings: tuple[Setting, ...]) -> list[tuple[Setting, ...]]:
        """Cut the settings of an item into parts that several workers run at the same time."""
        if self.executor is None or len(settings) < 2:
            return [settings] if settings else []
        workers = worker_count(self.executor)
        # Outside of this process each part computes what all have in common: there are only as many as keep all
        # workers at work.
        count = -(-workers // max(self.images.count or workers, 1))
        count *= _PARTS if count > 1 and runs_here(self.executor) else 1
        # What the slowest hyperparameter has made is computed once if no part begins amid one of its values.
        places = steps(self.runner.cg, settings)
        places = places if len(places) >= workers else list(range(len(settings)))
        return _cut(settings, max(count, -(-len(settings) // _MOST_SETTINGS)), places)

    def _series_runs(
        self, state: State, cache: OutcomeCache | None, take: Callable[[Sequence[Outcome]], None]
    ) -> SeriesRuns:
        """Return the runs of series; those of which all is stored are taken from there."""
        items, done = self._items(), frozenset[Done]()
        if cache is not None and cache.has_outcomes:
            stored, done = whole_series(self._items(), self.settings, cache.found)
            take(stored)
        elif cache is not None:
            items = cache.noting(items)
        room = 1 if self.executor is None else _JOBS_PER_WORKER * worker_count(self.executor)
        template = Job(Item(0, "", {}), keep=self.keep, show=self.show)
        parts = [replace(template, settings=part) for part in _cut(self.settings, room, range(len(self.settings)))]
        # Of what is in memory anyway, or in files, so many are taken that all series begin.
        is_taken = self.images.is_held and self.executor is not None
        return SeriesRuns(items, parts, state, math.inf if is_taken else room, done)


def _cut(settings: tuple[Setting, ...], most: int, places: Sequence[int]) -> list[tuple[Setting, ...]]:
    """Cut settings into at most so many parts of about the same size, each of which begins at one of some places."""
    count = min(most, len(places))
    cuts = [*(places[len(places) * part // count] for part in range(count)), len(settings)]
    return [settings[first:end] for first, end in pairwise(cuts)]


def tokens_of(runner: CompGraphRunner, given: str | Sequence[str]) -> tuple[str, ...]:
    """Return the tokens that a caller names, one or several; UnknownName if the graph does not have one."""
    tokens = (given,) if isinstance(given, str) else tuple(given)
    for token in tokens:
        runner.cg.require_token(token)
    return tokens
