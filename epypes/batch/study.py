"""Which values are tried next, after what was found so far?

Optuna's tree-structured Parzen estimator says it (Bergstra, Bardenet, Bengio and Kegl 2011, "Algorithms for
hyper-parameter optimization", NeurIPS 24). A study is computed in memory; each trial that has ended is written to a
database, if there is one, in Optuna's own tables, so that its dashboard reads them too.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from epypes.batch.objective import changed_in
from epypes.batch.ranges import Axis, Choices, SearchSpan, setting_of, suggestion_of
from epypes.batch.steps import ends_on_step
from epypes.errors import ScaleError
from epypes.optional import optional_import
from epypes.store.place import connect_options

if TYPE_CHECKING:
    import optuna
    from sqlalchemy import URL


Direction = Literal["maximize", "minimize"]
_FAILURE, _NANOSECONDS, _ABOUT = "failure", "total_ns", "about"


@dataclass(frozen=True, slots=True)
class Trial:
    """One setting that was tried.

    Attributes
    ----------
    number
        Of the trial in its study, from 0.
    setting
        The hyperparameters that vary, by token.
    value
        The metric, averaged over the cases; None if the trial failed.
    failure
        Why it failed; empty if it did not.
    total_ns
        Nanoseconds of the functions that ran, over all cases.
    """

    number: int
    setting: Mapping[str, Any]
    value: float | None
    failure: str = ""
    total_ns: int = 0


@dataclass(frozen=True, slots=True)
class Asked:
    """A setting that is to be tried."""

    number: int
    setting: Mapping[str, Any]
    trial: optuna.trial.Trial


class Search:
    """Asks for settings, and is told what they gave. Not for several threads at once.

    Parameters
    ----------
    axes
        What is searched.
    present
        All hyperparameters; the first trial has these values, or the nearest ones within the axes.
    direction
        ``"maximize"`` or ``"minimize"``.
    seed
        Of the sampler: the same one suggests the same again, if one trial is run at a time.
    at_once
        How many trials are run at a time; with several, those that are still under way count as bad ones.
    url
        Of a database; None for none.
    name
        Of the study in there. If it is there, it goes on.
    about
        What is searched: digests by what they are of, "" where there is none. They are kept with the study.

    Raises
    ------
    ScaleError
        The study that is there searches something else, or the database can't be used.
    """

    def __init__(
        self,
        axes: Sequence[Axis],
        present: Mapping[str, Any],
        direction: Direction,
        *,
        seed: int = 0,
        at_once: int = 1,
        url: URL | None = None,
        name: str = "",
        about: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        with optional_import():
            import optuna
        self.axes, self.direction = tuple(axes), direction
        self._present, self._about = dict(present), dict(about)
        self._distributions = {axis.token: _distribution(axis) for axis in axes}
        self._written: optuna.Study | None = None
        with _quietly():
            self._written = None if url is None else self._opened(url, name)
            before = () if self._written is None else self._done_before(self._written, name)
            # Who goes on begins anew with chance: the same numbers again would be the same trials again.
            sampler = optuna.samplers.TPESampler(seed=seed + len(before), constant_liar=at_once > 1)
            self.study: optuna.Study = optuna.create_study(
                sampler=sampler, study_name=name or None, direction=direction
            )
        if before:
            self.study.add_trials(before)
        else:
            self.study.enqueue_trial(suggestion_of(self.axes, present))

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Those that have ended, by number."""
        return tuple(
            self._told(frozen) for frozen in self.study.get_trials(deepcopy=False) if frozen.state.is_finished()
        )

    def ask(self) -> Asked:
        """Return the next setting to try."""
        trial = self.study.ask(self._distributions)
        return Asked(trial.number, setting_of(self.axes, trial.params, self._present), trial)

    def tell(self, asked: Asked, value: float | None, failure: str = "", total_ns: int = 0) -> Trial:
        """Take down what a setting gave, and return that; without a value it has failed."""
        import optuna

        asked.trial.set_user_attr(_NANOSECONDS, total_ns)
        if value is None:
            asked.trial.set_user_attr(_FAILURE, failure)
            frozen = self.study.tell(asked.trial, state=optuna.trial.TrialState.FAIL)
        else:
            frozen = self.study.tell(asked.trial, value)
        if self._written is not None:
            self._written.add_trial(frozen)
        return self._told(frozen)

    def forget(self, what: str) -> None:
        """Take down that this part of what is searched can't be told from others, since it changes by itself."""
        self._about[what] = ""
        if self._written is not None:
            self._note(self._written)

    def _note(self, written: optuna.Study) -> None:
        # What could not be told once is not told from then on.
        before = written.user_attrs.get(_ABOUT, self._about)
        about = {what: digest and self._about.get(what, digest) for what, digest in {**self._about, **before}.items()}
        if about != before or _ABOUT not in written.user_attrs:
            written.set_user_attr(_ABOUT, about)

    def close(self) -> None:
        """Let go of the database. May be called twice."""
        written, self._written = self._written, None
        if written is not None:
            _close(written._storage)

    def _told(self, frozen: optuna.trial.FrozenTrial) -> Trial:
        setting = setting_of(self.axes, frozen.params, self._present)
        noted = frozen.user_attrs
        failure = noted.get(_FAILURE, "") or ("" if frozen.value is not None else "it was given up")
        return Trial(frozen.number, setting, frozen.value, failure, noted.get(_NANOSECONDS, 0))

    def _opened(self, url: URL, name: str) -> optuna.Study:
        import optuna
        import sqlalchemy.exc

        refusals = (RuntimeError, sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.StorageInternalError)
        given = url.render_as_string(hide_password=False)
        try:
            storage = optuna.storages.RDBStorage(given, engine_kwargs={"connect_args": connect_options(url)})
            return optuna.create_study(storage=storage, study_name=name, direction=self.direction, load_if_exists=True)
        except refusals as error:
            text = f"The trials can't be kept in {url.render_as_string()}: {str(error).splitlines()[0]}"
            raise ScaleError(f"{text} Give another store=, or none.") from error

    def _done_before(self, written: optuna.Study, name: str) -> list[optuna.trial.FrozenTrial]:
        """Return the trials of a study that goes on, numbered as they will be in memory."""
        found = [trial for trial in written.get_trials() if trial.state.is_finished()]
        others = next((trial for trial in found if trial.distributions != self._distributions), None)
        # A study without trials is of nothing yet.
        changed = changed_in(written.user_attrs.get(_ABOUT, {}), self._about) if found else ""
        if written.direction.name.lower() == self.direction and others is None and not changed:
            self._note(written)
            return found
        self.close()
        _close(written._storage)
        what = changed if changed and others is None else f"to {written.direction.name.lower()}"
        what = what if others is None else _said_of(others.distributions)
        text = f"There is a study {name!r} in this store, and it searches something else ({what})."
        raise ScaleError(f"{text} Give another name=, or search the same.")


def importances(study: optuna.Study) -> dict[str, float]:
    """Return how much each hyperparameter matters for reaching good values, the most important first; they sum to 1.

    By PED-ANOVA (Watanabe, Bansal and Hutter 2023, IJCAI). Empty with fewer than two trials that completed.
    """
    import optuna

    done = [trial for trial in study.get_trials(deepcopy=False) if trial.state == optuna.trial.TrialState.COMPLETE]
    if len({trial.value for trial in done}) < 2:
        return {}
    with _quietly():
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        return dict(optuna.importance.get_param_importances(study, evaluator=evaluator))


def _distribution(axis: Axis) -> optuna.distributions.BaseDistribution:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(axis, Choices):
        return CategoricalDistribution(axis.labels)
    # On a logarithmic scale Optuna has no steps, nor such as end beside the range: what it suggests is brought onto
    # the grid.
    step = None if axis.log or not _ends_on_step(axis) else axis.step
    if axis.is_integer:
        return IntDistribution(int(axis.low), int(axis.high), log=axis.log, step=int(step or 1))
    return FloatDistribution(axis.low, axis.high, log=axis.log, step=step)


def _ends_on_step(axis: SearchSpan) -> bool:
    return axis.step is not None and ends_on_step(axis.low, axis.high, axis.step)


def _said_of(distributions: Mapping[str, Any]) -> str:
    return f"{', '.join(f'{token} in {_ends(found)}' for token, found in distributions.items()):.200}"


def _ends(distribution: Any) -> str:
    choices = getattr(distribution, "choices", None)
    return ", ".join(map(str, choices)) if choices else f"{distribution.low:g} to {distribution.high:g}"


def _close(storage: Any) -> None:
    """End the connections of a storage, which may be wrapped in a cache."""
    storage = getattr(storage, "_backend", storage)
    storage.scoped_session.remove()
    storage.engine.dispose()


@contextmanager
def _quietly() -> Iterator[None]:
    """Keep Optuna from printing and from warning that what is used here was once experimental."""
    import optuna

    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            yield
    finally:
        optuna.logging.set_verbosity(before)
