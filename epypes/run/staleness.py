"""Token values of a run and which of them are out of date.

Staleness never looks at data: a step is dirty when something that it reads has got a new version since it last ran.
The cost does not depend on the size of the values.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from epypes.deprecation import OldNames
from epypes.errors import NotComputed, StaleToken
from epypes.graph import CompGraph
from epypes.nothing import Nothing, NothingType
from epypes.run.guard import is_plain_array, is_same_guarded_array, lend_to_reader
from epypes.run.program import Program, Step

if TYPE_CHECKING:
    from epypes.run.result import Run

_SCALARS: Final = frozenset({int, float, complex, bool, type(None), NothingType})
_TEXTS: Final = frozenset({str, bytes})
_SMALL_TUPLE: Final = 16
# Longer texts (an encoded image) are taken for new unless they are the same object.
_SHORT_TEXT: Final = 1_000


class _NotComputed:
    """The state of a token without value; None is a value."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "NOT_COMPUTED"


NOT_COMPUTED: Final = _NotComputed()


class NestedRun(NamedTuple):
    """The run of a nested pipeline, and the slots of its inputs that have got new values since."""

    run: Run
    new: tuple[int, ...] = ()


def with_new_input(nested: Any, slot: int) -> Any:
    """Note that an input of a nested pipeline has a new value, if the pipeline has run."""
    return NestedRun(nested.run, (*nested.new, slot)) if type(nested) is NestedRun else nested


class TokenManager(OldNames):
    """The values of a graph's tokens; they do not change any more when their run has ended.

    A runner delegates storage to it: each run works on values of its own, so concurrent runs never see each other's,
    and leaves them as ``run.tokens``.

    Parameters
    ----------
    cg
        The graph.
    values
        By token, the values that are known and up to date; none without.

    Raises
    ------
    UnknownName
        The graph has no such token.

    Attributes
    ----------
    program
        What is run.
    values
        By slot.
    dirty
        By step, 1 if it has to run before its outputs can be read: it never ran, failed, or one of its inputs has a
        new value. A bytearray while steps run one by one.
    has_payload
        Whether every source token has a value; if not, each run has to see whether it needs one that has none.
    revisions
        Those of nested pipelines, when the run began.
    running
        The step that is being run, -1 for none. Steps that run side by side are in ``program.running`` alone.
    origin
        The steps that were dirty before anything was changed, of which it is not known what was new to them; None in a
        run from scratch.
    changed
        The source tokens that have got new values since then.
    durations_ns
        Nanoseconds by step that ran.
    wanted
        By step, 1 for those that the run needs; None for all.
    side_by_side
        Whether threads were used.

    Notes
    -----
    Semeniuta and Falkman 2019, "Computational graphs".

    Examples
    --------
    >>> cg = CompGraph({"add": lambda x, y: x + y}, {"add": (("x", "y"), "total")})
    >>> tokens = TokenManager(cg, {"x": 1})
    >>> tokens["x"], "total" in tokens
    (1, False)
    """

    # Slots: a class attribute that an object reads in their place takes several times as long.
    __slots__ = (
        "_new", "_stale", "changed", "dirty", "durations_ns", "has_payload", "origin", "program", "revisions",
        "running", "side_by_side", "values", "wanted",
    )  # fmt: skip
    program: Program
    values: list[Any]
    dirty: Any
    has_payload: bool
    durations_ns: dict[int, int]
    revisions: tuple[Any, ...]
    running: int
    origin: bytes | None
    changed: tuple[str, ...]
    wanted: bytes | None
    side_by_side: bool
    # Slots with new values.
    _new: set[int]
    _stale: set[int] | None

    def __init__(self, cg: CompGraph, values: Mapping[str, Any] | None = None) -> None:
        program = Program(cg, True)
        stored: list[Any] = [NOT_COMPUTED] * len(program.tokens)
        for token, value in (values or {}).items():
            cg.require_token(token)
            stored[program.slots[token]] = value
        # No function is out of date; but not every token has a value.
        self.fill(program, stored, program.no_steps, False, None)

    def fill(
        self, program: Program, values: list[Any], dirty: bytes, has_payload: bool, origin: bytes | None
    ) -> TokenManager:
        """Make these the tokens of a run that has not begun; return them."""
        self.program, self.values, self.dirty, self.has_payload = program, values, dirty, has_payload
        self.origin = origin
        self.running, self.changed, self.side_by_side, self.durations_ns = -1, (), False, {}
        self.wanted = self._stale = None
        self.revisions = program.revisions() if program.revised else ()
        return self

    # -- while functions run ------------------------------------------------------------------------------------

    def branch(
        self,
        changes: Mapping[str, Any] = MappingProxyType({}),
        *,
        are_new: bool = False,
        unsure: Collection[str] = (),
    ) -> TokenManager:
        """Return tokens for a run that goes on from these; what reads a changed one is dirty when that has begun.

        Parameters
        ----------
        changes
            New values of source tokens.
        are_new
            Whether it is known that they differ from the present ones.
        unsure
            The tokens whose arrays may have been written to since, so that one and the same array counts as new.
        """
        program, values, origin = self.program, self.values.copy(), bytes(self.dirty)
        branch = new_tokens().fill(program, values, origin, self.has_payload, origin)
        if program.revised:
            renewed = zip(program.revised, self.revisions, branch.revisions, strict=True)
            places = {place for place, before, now in renewed if before != now}
            branch.dirty = branch.origin = bytes(at in places or is_dirty for at, is_dirty in enumerate(self.dirty))
        slots = program.settable
        if not are_new:
            old = {token: values[slots[token]] for token in changes}
            is_new = [
                not is_unchanged(old[token], value, (), program.guard and token not in unsure)
                for token, value in changes.items()
            ]
            changes = dict(itertools.compress(changes.items(), is_new))
        for token, value in changes.items():
            values[slots[token]] = value
        branch.changed = (*changes,)
        return branch

    def begin(self) -> TokenManager:
        """Make what reads a changed token dirty; return these tokens, whose steps can be run now."""
        self.dirty, self._new = bytearray(self.dirty), set()
        for token in self.changed:
            self.mark(self.program.settable[token])
        return self

    def store(self, step: Step, made: Sequence[Any] | None) -> None:
        """Store what a step has made, guarded if the program is; the steps that read something new become dirty.

        None stands for a step that was skipped, since one of its inputs is Nothing: so are all its outputs.
        """
        if made is None:
            self.program.has_skipped, made = True, [Nothing] * len(step.outputs)
        self.dirty[step.place] = 0
        if self.origin is None:
            for slot, value in zip(step.outputs, made, strict=True):
                self.values[slot] = value
            return
        given: Sequence[Any] = ()
        if not self.origin[step.place]:
            given = [self.values[slot] for slot in step.inputs if slot not in self._new]
        for slot, value in zip(step.outputs, made, strict=True):
            if not is_unchanged(self.values[slot], value, given, self.program.guard):
                self.values[slot] = value
                self.mark(slot)

    def mark(self, slot: int) -> None:
        """Take note that a slot has a new value: the steps that read it are dirty."""
        program = self.program
        self._new.add(slot)
        for place in program.consumers[slot]:
            step = program.steps[place]
            if step.switch is None or slot in program.read_by(step, self.values):
                self.dirty[place] = 1
        for run in program.inside.get(slot, ()) if program.inside else ():
            self.values[run] = with_new_input(self.values[run], slot)

    def forget(self, steps: Iterable[int]) -> None:
        """Make the outputs of these steps read as not computed."""
        for place in steps:
            self.dirty[place] = 1
            for slot in self.program.steps[place].outputs:
                self.values[slot] = NOT_COMPUTED

    # -- reading ------------------------------------------------------------------------------------------------

    @property
    def stale(self) -> set[int]:
        """The steps whose outputs are out of date: the dirty ones and what depends on them."""
        if self._stale is None:
            starts = [place for place, is_dirty in enumerate(self.dirty) if is_dirty] if 1 in self.dirty else ()
            self._stale = self.program.downstream(starts, self.values)
        return self._stale

    def is_computed(self, token: str) -> bool:
        """Whether the token has a value, be it stale."""
        return self.values[self.program.slots[token]] is not NOT_COMPUTED

    def is_nothing(self, token: str) -> bool:
        """Whether the token's value, be it stale, is Nothing."""
        return self.values[self.program.slots[token]] is Nothing

    def lacking(self) -> dict[str, tuple[str, ...]]:
        """Return by function, of those that read a token whose value is Nothing, these tokens."""
        program, values = self.program, self.values
        found: dict[str, tuple[str, ...]] = {}
        for step in program.steps:
            slots = [slot for slot in dict.fromkeys(program.required_by(step, values)) if values[slot] is Nothing]
            if slots:
                found[step.name] = tuple(program.tokens[slot] for slot in slots)
        return found

    def is_stale(self, token: str) -> bool:
        """Whether the token has a value that is out of date."""
        if not self.stale:
            return False
        slot = self.program.slots[token]
        return self.program.makers[slot] in self.stale and self.values[slot] is not NOT_COMPUTED

    def is_readable(self, token: str) -> bool:
        """Whether the token has a value that is up to date."""
        return self.is_computed(token) and not self.is_stale(token)

    def read(self, token: str) -> Any:
        """Return a token's value, arrays as read-only views.

        Raises
        ------
        UnknownName
            There is no such token.
        StaleToken
            Its value is out of date.
        NotComputed
            It has none.
        """
        program = self.program
        program.cg.require_token(token)
        if self.is_stale(token):
            raise StaleToken(token)
        slot = program.slots[token]
        value = self.values[slot]
        if value is NOT_COMPUTED:
            is_source = program.makers[slot] < 0
            way_out = f"Call rerun({token!r}), or run() with the graph's payload."
            way_out = f"Pass it: run({token}=...)." if is_source else way_out
            raise NotComputed(token, f"Token {token!r} has not been computed. {way_out}")
        return lend_to_reader(value) if program.guard else value

    def __getitem__(self, token: str) -> Any:
        return self.read(token)

    def __contains__(self, token: str) -> bool:
        return self.program.cg.has_token(token) and self.is_readable(token)

    def __iter__(self) -> Iterator[str]:
        return (token for token in self.program.cg.tokens if self.is_readable(token))


# Half the time of TokenManager(...).
new_tokens: Final[Callable[[], TokenManager]] = partial(object.__new__, TokenManager)


def skipped_steps(program: Program, values: Sequence[Any], dirty: Sequence[int]) -> tuple[int, ...]:
    """Return the steps that are up to date without having run, since an input that they read is Nothing."""
    if not program.has_skipped:
        return ()
    return tuple(
        step.place
        for step in program.steps
        if not dirty[step.place] and any(values[slot] is Nothing for slot in program.required_by(step, values))
    )


def is_same_value(old: Any, new: Any) -> bool:
    """Whether two immutable values are cheaply known to be equal: numbers, None, Nothing, short texts, small tuples.

    The types must agree, so that True is not 1 and 1 is not 1.0; NaN is not equal to itself, so it counts as new.
    Arrays are never compared.
    """
    kind = type(old)
    if kind is not type(new):
        return False
    if kind in _SCALARS:
        # 0.0 == -0.0, but they do not always compute the same: the sign is in the repr.
        return bool(old == new) and (kind not in (float, complex) or repr(old) == repr(new))
    if kind in _TEXTS:
        return old is new or (len(old) == len(new) <= _SHORT_TEXT and bool(old == new))
    if kind is tuple:
        return len(old) == len(new) <= _SMALL_TUPLE and all(map(is_same_value, old, new))
    return False


def is_unchanged(old: Any, new: Any, given: Sequence[Any], guard: bool) -> bool:
    """Whether a function's new value is cheaply known to be what it was.

    ``given`` are the values that the function read and that are not new. A guarded array that was passed through from
    them is known to be unchanged; of other values small immutable ones are compared.
    """
    if is_same_value(old, new):
        return True
    return guard and is_plain_array(new) and is_plain_array(old) and is_same_guarded_array(old, new, given)
