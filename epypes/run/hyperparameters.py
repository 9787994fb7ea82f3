"""The hyperparameters of a runner: which tokens are frozen, to which values, and which source tokens remain free."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from operator import is_
from types import MappingProxyType
from typing import Any, Final

from epypes.errors import HyperparameterError, PayloadError, UnknownName, nearest, run_call
from epypes.run.guard import ARRAYLESS, COPIERS, keep, require_reusable
from epypes.run.program import Program
from epypes.run.staleness import NOT_COMPUTED, TokenManager, is_same_value, new_tokens

# The revision of hyperparameters that a graph gives to a call of a pipeline.
_OF_A_CALL: Final = -2
# Of a longer value an error has dots.
_BRIEF: Final = 40


class Hyperparameters:
    """The hyperparameters of a runner; replaced as a whole, never changed in place.

    Attributes
    ----------
    entries
        By token, a tuple that holds its value, and the first one that it had since it was frozen. Setting a token
        makes a new tuple: it is the token's version.
    revision
        How often they have changed.
    changed
        The values that differ from the revision before.
    follows
        That revision; -1 if other tokens were hyperparameters in it.
    plain
        The tokens whose values are numbers, texts or None: they hold no arrays, so functions get them as they are.
    """

    # Made at every move of a slider, so what is rarely asked for is made when it is.
    changed: Mapping[str, Any] = MappingProxyType({})
    follows = -1
    _start: tuple[list[Any], dict[str, int]] | None = None
    # Those of nested pipelines as they were when they were last asked for.
    _seen: tuple[Hyperparameters, ...] = ()

    def __init__(
        self,
        program: Program,
        entries: dict[str, tuple[Any, Any]],
        revision: int = 0,
        plain: frozenset[str] = frozenset(),
    ) -> None:
        self.program, self.entries, self.revision, self.plain = program, entries, revision, plain

    @property
    def values(self) -> Mapping[str, Any]:
        """The values by token."""
        return MappingProxyType({token: entry[0] for token, entry in self.entries.items()})

    @property
    def first_values(self) -> Mapping[str, Any]:
        """The values that the tokens were frozen with, by token."""
        return MappingProxyType({token: entry[1] for token, entry in self.entries.items()})

    @property
    def free_slots(self) -> dict[str, int]:
        """The slots of the source tokens that are neither frozen nor delayed, by first appearance in func_io."""
        return (self._start or self._started())[1]

    def _started(self) -> tuple[list[Any], dict[str, int]]:
        """Return the values by slot with which a run begins, and the free slots."""
        slots, cg = self.program.slots, self.program.cg
        base: list[Any] = [NOT_COMPUTED] * len(self.program.tokens)
        for token, entry in self.entries.items():
            if token in slots:
                base[slots[token]] = entry[0]
            else:  # what a nested pipeline gets, with its version
                base[self.program.settable[token]] = entry
        free = {
            token: slots[token] for token in cg.source_tokens if token not in self.entries and token not in cg.delays
        }
        # Only when it is complete: other threads read it without a lock.
        self._start = base, free
        return self._start

    def frozen(self, changes: Mapping[str, Any], *, also_new: bool = True, are_first: bool = False) -> Hyperparameters:
        """Return these with tokens given values; all or nothing. An equal value changes nothing.

        Parameters
        ----------
        changes
            Values by token; of nested pipelines by ``"function__token"``.
        also_new
            Whether source tokens that are not hyperparameters become some.
        are_first
            Whether these are the first values, also of hyperparameters of nested pipelines.

        Raises
        ------
        UnknownName
            There is no such token, or a switch has no such branch.
        HyperparameterError
            A function makes the token, or it is not a hyperparameter.
        IteratorRefused
            A value can be read only once.
        """
        program, revision = self.program, self.revision
        entries, new, follows, plain = self.entries.copy(), {}, revision, self.plain
        for token, value in changes.items():
            entry = entries.get(token)
            # An integer after an integer, which most sliders give, takes no more than a comparison.
            is_count = entry is not None and type(value) is int is type(entry[0])
            if entry is None:
                (self.require_source if also_new else self.require)(token)
                follows = -1
            elif entry[0] == value if is_count else is_same_value(entry[0], value):
                continue
            if program.selectors:
                self.require_branches({token: value})
            is_nested = token in program.inner_names
            if is_nested:
                self._require_nested_branches(token, value)
            if not is_count:
                if not is_nested:
                    plain = plain if (type(value) in ARRAYLESS) == (token in plain) else plain ^ {token}
                # A copy of what others could write to: a change in place would not be noticed.
                value = keep(value, 0, program, program.settable[token], ()) if program.guard else value
            entries[token] = made_entry = (value, value if entry is None or are_first else entry[1])
            new[token] = made_entry if is_nested else value
        if not new:
            return self
        made = _new_hyperparameters()
        made._seen = self._seen
        made.program, made.entries, made.revision, made.plain = program, entries, revision + 1, plain
        made.changed, made.follows = new, follows
        return made

    def unfrozen(self, token: str) -> Hyperparameters:
        """Return these without a token, which becomes a free source token."""
        self.require(token)
        entries = {name: entry for name, entry in self.entries.items() if name != token}
        made = Hyperparameters(self.program, entries, self.revision + 1, self.plain - {token})
        if token in self.program.slots:
            made._seen = self._seen
        return made.current

    @property
    def current(self) -> Hyperparameters:
        """These, with what has changed in nested pipelines since: of the two the value that was set last counts."""
        program, seen = self.program, self._seen
        now = tuple([nested.runner.current for nested in program.nested.values()])
        if len(seen) == len(now) and all(map(is_, seen, now)):
            return self
        entries = self.entries.copy()
        before = [known.entries for known in seen] or [dict[str, tuple[Any, Any]]()] * len(now)
        for nested, old, hparams in zip(program.nested.values(), before, now, strict=True):
            for token, name in nested.names.items():
                entry = hparams.entries.get(token)
                if entry is None:
                    entries.pop(name, None)
                elif entry is not old.get(token) and (seen or name not in entries):
                    entries[name] = entry
        made = Hyperparameters(program, entries, self.revision + bool(seen), self.plain)
        made._seen = now
        return made

    def with_entries(self, entries: Mapping[str, tuple[Any, Any]]) -> Hyperparameters:
        """Return those of a call that gets some values, with their versions, from the graph around its pipeline."""
        if all(self.entries.get(token) is entry for token, entry in entries.items()):
            return self
        both, slots = {**self.entries, **entries}, self.program.slots
        plain = frozenset(token for token, (value, _) in both.items() if type(value) in ARRAYLESS and token in slots)
        # No revision follows this one.
        made = Hyperparameters(self.program, both, _OF_A_CALL, plain)
        made._seen = self._seen
        return made

    @property
    def own(self) -> Mapping[str, Any]:
        """The values by token, without those that nested pipelines have themselves."""
        known = [
            (name, hparams.entries.get(token))
            for nested, hparams in zip(self.program.nested.values(), self._seen, strict=False)
            for token, name in nested.names.items()
        ]
        theirs = {name for name, entry in known if entry is self.entries.get(name)}
        return {token: entry[0] for token, entry in self.entries.items() if token not in theirs}

    def tokens(self, payload: Mapping[str, Any], state: Sequence[Any]) -> TokenManager:
        """Return the tokens of a run from scratch on a payload and a state, before its first step.

        Raises
        ------
        PayloadError, UnknownName
            A token is not a free source token, or a switch has no such branch.
        IteratorRefused
            A value can be read only once.
        """
        program, (base, free) = self.program, self._start or self._started()
        values = base.copy()
        for token, value in payload.items():
            slot = free.get(token)
            if slot is None:
                raise self._wrong_payload(token, value, free)
            values[slot] = value
            if type(value) not in COPIERS:
                require_reusable(value, program, slot)
        if program.selectors:
            self.require_branches(payload)
        if program.states:
            for slots, value in zip(program.states, state, strict=True):
                values[slots.before] = value
        return new_tokens().fill(program, values, program.all_steps, len(payload) == len(free), None)

    def changes_since(self, earlier: Hyperparameters) -> Mapping[str, Any]:
        """Return the tokens that have another version than in an earlier or later revision, with their values."""
        if earlier is self:
            return {}
        if self.follows == earlier.revision:
            return self.changed
        slots, old = self.program.slots, earlier.entries
        new = [(token, entry) for token, entry in self.entries.items() if old.get(token) is not entry]
        changes = {token: entry[0] if token in slots else entry for token, entry in new}
        if self.program.nested:
            lost = (token for token in old if token in self.program.inner_names and token not in self.entries)
            changes |= dict.fromkeys(lost, NOT_COMPUTED)
        return changes

    def require_source(self, token: str) -> None:
        """Raise unless the token exists and no function makes it."""
        cg = self.program.cg
        if token in self.program.inner_names:
            text = f"{token!r} is free in its pipeline, not a hyperparameter. Freeze it there: pipeline.runner.freeze."
            raise HyperparameterError(token, text)
        if self.program.nested and token not in cg.tokens:
            raise UnknownName("token", token, self.program.settable)
        cg.require_token(token)
        maker = cg.digraph.producer.get(token)
        if maker is not None:
            text = f"Token {token!r} is made by function {maker!r}, so it can't be a hyperparameter."
            raise HyperparameterError(token, text)
        if token in cg.delays:
            raise HyperparameterError(token, _is_delayed(token, cg.delays[token].token))

    def require_branches(self, values: Mapping[str, Any]) -> None:
        """Raise UnknownName, with the nearest name, unless switches have the branches that these tokens select."""
        for token, selector in values.items():
            for switch in self.program.selectors.get(token, ()):
                switch.branch_index(selector)

    def _require_nested_branches(self, name: str, value: Any) -> None:
        for nested in self.program.nested.values():
            for token in [token for token, known in nested.names.items() if known == name]:
                inner = nested.runner.current
                if token in inner.program.slots:
                    inner.require_branches({token: value})
                else:
                    inner._require_nested_branches(token, value)

    def require(self, token: str) -> None:
        """Raise unless the token is a hyperparameter, with the way out for one that is not."""
        if token in self.entries:
            return
        self.require_source(token)
        raise HyperparameterError(
            token,
            f"Token {token!r} is a free source token, not a hyperparameter. "
            f"Pass it to run({token}=...), or make it one: freeze({token}=...).",
        )

    def _wrong_payload(self, token: str, value: Any, free: Iterable[str]) -> Exception:
        """Return the error that says why a token can't be given to ``run``."""
        cg = self.program.cg
        text = repr(value) if type(value) in ARRAYLESS else ""
        text = text if 0 < len(text) <= _BRIEF else "..."

        def change(name: str) -> str:
            return f"Change it with rerun({name}={text}), or with runner[{name!r}] = {text} before {run_call(free)}."

        if not cg.has_token(token) and token not in self.entries:
            near = nearest(token, (*free, *self.entries))
            advice = f" Did you mean the hyperparameter {near!r}? {change(near)}" if near in self.entries else ""
            return UnknownName("token", token, free, advice=advice)
        maker = cg.digraph.producer.get(token)
        if maker is not None:
            text = f"Token {token!r} is made by function {maker!r}; run() takes free source tokens only."
        elif token in cg.delays:
            text = _is_delayed(token, cg.delays[token].token)
        else:
            text = f"Token {token!r} is a hyperparameter, which run() does not take. {change(token)}"
        return PayloadError((token,), text)


def _is_delayed(token: str, of: str) -> str:
    return f"Token {token!r} is the previous value of {of!r}. Set it by runner.state = {{{token!r}: ...}}."


# Half the time of Hyperparameters(...).
_new_hyperparameters: Final[Callable[[], Hyperparameters]] = partial(object.__new__, Hyperparameters)
