"""The study of a search: which settings are tried next, after what was found so far, and where trials are stored.

Optuna's tree-structured Parzen estimator suggests settings (Bergstra, Bardenet, Bengio and Kegl 2011, "Algorithms for
hyper-parameter optimization", NeurIPS 24). A study is computed in memory; each trial that has ended is written to a
database, if there is one, in Optuna's own tables, so that its dashboard reads them too. A study that is computed in the
database itself took 179 ms per trial.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.batch.ranges import Axis, bounded
from epypes.errors import ScaleError
from epypes.optional import optional_import

if TYPE_CHECKING:
    import optuna
    from sqlalchemy import URL

Direction = Literal["maximize", "minimize"]
# The attributes of trials and studies in Optuna's tables.
_FAILURE: Final = "failure"
_NANOSECONDS: Final = "total_ns"
_DIGESTS: Final = "about"


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
class Suggestion:
    """A setting that is to be tried, and Optuna's trial of it."""

    setting: Mapping[str, Any]
    trial: optuna.trial.Trial


class Search:
    """Asks the sampler for settings, and reports what they gave. Not for several threads at once.

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
        How many trials are run at a time; with several, those that still run count as bad ones.
    url
        Of a database; None for none.
    name
        Of the study in there. If it is there, it goes on.
    digests
        What is searched: digests by what they are of, "" where there is none. They are stored with the study.

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
        digests: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        with optional_import():
            import optuna
        self.axes, self.direction = tuple(axes), direction
        self._present, self._digests = dict(present), dict(digests)
        self._distributions = {axis.token: axis.distribution for axis in axes}
        self._storage: optuna.storages.RDBStorage | None = None
        self._stored: optuna.Study | None = None
        with quiet_optuna():
            before = [] if url is None else self._open(url, name)
            # A search that goes on has another seed: the same numbers again would be the same trials again.
            sampler = optuna.samplers.TPESampler(seed=seed + len(before), constant_liar=at_once > 1)
            self.study: optuna.Study = optuna.create_study(
                sampler=sampler, study_name=name or None, direction=direction
            )
        if before:
            self.study.add_trials(before)
        else:
            self.study.enqueue_trial({axis.token: axis.suggestion(present[axis.token]) for axis in self.axes})

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Those that have ended, by number."""
        return tuple(map(self._trial, _finished(self.study)))

    def ask(self) -> Suggestion:
        """Return the next setting to try."""
        trial = self.study.ask(self._distributions)
        return Suggestion(self._setting(trial.params), trial)

    def tell(self, asked: Suggestion, value: float | None, failure: str = "", total_ns: int = 0) -> Trial:
        """Store what a setting gave, and return that; without a value it has failed."""
        import optuna

        asked.trial.set_user_attr(_NANOSECONDS, total_ns)
        if value is None:
            asked.trial.set_user_attr(_FAILURE, failure)
            frozen = self.study.tell(asked.trial, state=optuna.trial.TrialState.FAIL)
        else:
            frozen = self.study.tell(asked.trial, value)
        if self._stored is not None:
            self._stored.add_trial(frozen)
        return self._trial(frozen)

    def forget_changed(self, digests: Mapping[str, str]) -> None:
        """Blank the stored digests that are others by now, as of a function that notes its calls in a list."""
        changed = {what: "" for what, digest in digests.items() if digest != self._digests[what]}
        if changed and self._stored is not None:
            self._stored.set_user_attr(_DIGESTS, {**self._digests, **changed})

    def close(self) -> None:
        """Close the database. May be called twice."""
        storage, self._storage, self._stored = self._storage, None, None
        if storage is not None:
            storage.scoped_session.remove()
            storage.engine.dispose()

    def _setting(self, suggested: Mapping[str, Any]) -> dict[str, Any]:
        values = {axis.token: axis.value(suggested[axis.token]) for axis in self.axes}
        return bounded(self.axes, values, self._present)

    def _trial(self, frozen: optuna.trial.FrozenTrial) -> Trial:
        noted = frozen.user_attrs
        failure = noted.get(_FAILURE, "") or ("" if frozen.value is not None else "no reason is stored")
        return Trial(frozen.number, self._setting(frozen.params), frozen.value, failure, noted.get(_NANOSECONDS, 0))

    def _open(self, url: URL, name: str) -> list[optuna.trial.FrozenTrial]:
        """Open the study in the database and return the trials that have ended, if it searches the same."""
        import optuna
        import sqlalchemy.exc

        from epypes.store.database import connect_options

        refusals = (RuntimeError, sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.StorageInternalError)
        given = url.render_as_string(hide_password=False)
        try:
            self._storage = optuna.storages.RDBStorage(given, engine_kwargs={"connect_args": connect_options(url)})
            stored = optuna.create_study(
                storage=self._storage, study_name=name, direction=self.direction, load_if_exists=True
            )
        except refusals as error:
            self.close()
            text = f"The trials can't be stored in {url.render_as_string()}: {str(error).splitlines()[0]}"
            raise ScaleError(f"{text} Give another store=, or none.") from error
        found = _finished(stored)
        # A study without trials is of nothing yet.
        difference = self._difference(stored, found) if found else ""
        if difference:
            self.close()
            text = f"There is a study {name!r} in this store, and it searches something else ({difference})."
            raise ScaleError(f"{text} Give another name=, or search the same.")
        # A digest that is blank once stays blank.
        before = stored.user_attrs.get(_DIGESTS, {}) if found else {}
        self._digests = {what: digest and before.get(what, digest) for what, digest in self._digests.items()}
        stored.set_user_attr(_DIGESTS, self._digests)
        self._stored = stored
        return found

    def _difference(self, stored: optuna.Study, found: Sequence[optuna.trial.FrozenTrial]) -> str:
        """Return what a study in a database searches that this search does not; empty if it is the same search."""
        others = next((trial.distributions for trial in found if trial.distributions != self._distributions), None)
        if others is not None:
            return f"{', '.join(f'{token} in {_range_text(other)}' for token, other in others.items()):.200}"
        before = stored.user_attrs.get(_DIGESTS, {})
        changed = [
            what for what, digest in self._digests.items() if digest and before.get(what) and digest != before[what]
        ]
        if changed:
            return f"other {' and '.join(changed)}"
        direction = stored.direction.name.lower()
        return f"to {direction}" if direction != self.direction else ""


def importances(study: optuna.Study) -> dict[str, float]:
    """Return how much each hyperparameter matters for reaching good values, the most important first; they sum to 1.

    By PED-ANOVA (Watanabe, Bansal and Hutter 2023, IJCAI). Empty with fewer than two different values.
    """
    import optuna

    if len({trial.value for trial in _finished(study) if trial.value is not None}) < 2:
        return {}
    with quiet_optuna():
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        return dict(optuna.importance.get_param_importances(study, evaluator=evaluator))


def _finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]


def _range_text(distribution: Any) -> str:
    choices = getattr(distribution, "choices", None)
    return ", ".join(map(str, choices)) if choices else f"{distribution.low:g} to {distribution.high:g}"


@contextmanager
def quiet_optuna() -> Iterator[None]:
    """Keep Optuna from printing, and from warning that a feature used here was once experimental."""
    import optuna

    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            yield
    finally:
        optuna.logging.set_verbosity(before)
