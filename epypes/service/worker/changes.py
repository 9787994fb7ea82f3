"""How do parameters change in all slots at once, or in none?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from epypes.bundle.entries import Member, read
from epypes.pipeline import Pipeline
from epypes.run import Failure


class Changes:
    """The parameters of a worker.

    Parameters
    ----------
    trial
        A pipeline of the same graph that answers no events: values are tried on it first.
    pipelines
        Those of the slots.
    enums
        The bundle's enumerations, whose members may be values.

    Attributes
    ----------
    revision
        That of the last change; 0 as long as the bundle's own values hold.
    """

    def __init__(self, trial: Pipeline, pipelines: Sequence[Pipeline], enums: Mapping[str, Any]) -> None:
        self._trial, self._pipelines, self._enums = trial, pipelines, enums
        self.revision = 0

    def apply(self, revision: int, entries: Mapping[str, Any]) -> dict[str, str]:
        """Set these values everywhere; return the reason by token for those that can't be set: then none was.

        To be called while no slot works.

        Parameters
        ----------
        revision
            Counts the changes.
        entries
            Values by token, written as in pipeline.toml.
        """
        values, problems = _values(entries, self._enums)
        problems |= self._tried(values)
        if not problems:
            problems = self._set(values)
        if not problems:
            self.revision = revision
        return problems

    def refusals(self, entries: Mapping[str, Any]) -> dict[str, str]:
        """Return the reason by token for values that could not be set; nothing is set. While no slot works."""
        before = self._trial.runner.hyperparameters
        values, problems = _values(entries, self._enums)
        problems |= self._tried(values)
        if not problems:
            self._trial.runner.set(**before)
        return problems

    def _tried(self, values: Mapping[str, Any]) -> dict[str, str]:
        before, problems = self._trial.runner.hyperparameters, {}
        for token, value in values.items():
            try:
                self._trial.set(**{token: value})
            except BaseException as error:  # a value's own comparison may raise whatever it likes
                problems[token] = _said(error)
        if problems:
            self._trial.runner.set(**before)
        return problems

    def _set(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Set values that were found to be allowed; a pipeline of one's own may refuse them yet."""
        before = [dict(pipeline.runner.hyperparameters) for pipeline in self._pipelines]
        try:
            for pipeline in self._pipelines:
                pipeline.set(**values)
        except BaseException as error:  # see above
            for pipeline, its_values in zip((self._trial, *self._pipelines), (before[0], *before), strict=True):
                pipeline.runner.set(**its_values)
            token = getattr(error, "token", None)
            return {name: _said(error) for name in values if token not in values or name == token}
        return {}


def _values(entries: Mapping[str, Any], enums: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    values, problems = {}, {}
    for token, entry in entries.items():
        try:
            values[token] = read(entry, enums)
        except Exception as error:  # an entry of a kind may fail in the making of a value of that kind
            problems[token] = f"This value can't be read: {_said(error)}."
            continue
        if isinstance(values[token], Member):
            problems[token] = f"The bundle has no enumeration {values[token].enum!r}."
    return values, problems


def _said(error: BaseException) -> str:
    failure = Failure("", (), {}, error)
    return failure.message or failure.kind
