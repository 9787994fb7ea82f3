"""What is known of a function that failed."""

from __future__ import annotations

import contextlib
import os
import re
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final

from epypes.run.guard import explain_write, is_array, lend_to_reader
from epypes.run.snapshot import is_numpy_scalar
from epypes.run.staleness import TokenManager
from epypes.tracebacks import fold_end
from epypes.wording import error_message

# A note is one line that names the culprit, so a value in it is short.
_BRIEF: Final = 40
_NUMBERS: Final = frozenset((bool, int, float, complex, type(None)))
_CONTAINERS: Final = frozenset((list, tuple, dict, set, frozenset, deque, bytes, bytearray))
# Of so many items the types are looked at.
_MOST_ITEMS: Final = 1_000
# What functions say that have got None for an image: Python's own operations, and those of OpenCV.
_OF_NONE: Final = re.compile(r"None|\bempty\b|OpenCV\(")
# What OpenCV and Python say that have got a path for an image.
_OF_TEXT: Final = re.compile(r"not a numpy array|(str|Path)' object has no attribute")
# What OpenCV says of the number of channels that an image has.
_OF_CHANNELS: Final = re.compile(r"number of channels.*'scn' is (\d+)", re.DOTALL)
_WAS_IT_FOUND: Final = "Was the file found? cv2.imread returns None for a file that it can't read."
_DOES_IT_RETURN: Final = (
    "Does it return a value? One that has found nothing can return ep.Nothing: what takes that is skipped."
)


@dataclass(frozen=True, slots=True)
class Failure:
    """A function that raised, or a reactive pipeline's f_in, f_out, or hook of its own.

    Attributes
    ----------
    function
        Its name in the graph; ``"f_in"`` also for a payload that the graph refuses, ``"f_out"`` also for the put of the
        answer. ``"compute"``, ``"emit"``, ``"put"`` and ``"handle"`` are hooks of a subclass.
    tokens
        Its input tokens, then its output tokens.
    inputs
        The values that it was called with, by token; by ``"event"`` for f_in, compute and handle.
    exception
        What it raised, unchanged.
    event_id
        The id of the event that was being worked on, if it has one.
    attempt
        Which try of the event with that id this was, from 1, as far as failures are remembered.
    source
        Name of the pipeline that worked on it; empty if it was none that answers events.
    cause
        What is likely wrong with the inputs, as a sentence: a None in place of an image, a value that an annotation or
        the catalog of library functions does not allow. Empty if nothing is.
    """

    function: str
    tokens: tuple[str, ...]
    inputs: Mapping[str, Any]
    exception: BaseException
    event_id: str = ""
    attempt: int = 1
    source: str = ""
    cause: str = ""

    @property
    def kind(self) -> str:
        """Name of the exception's class."""
        # Past what a class of classes may have instead.
        name: str = type.__dict__["__name__"].__get__(type(self.exception))
        return str.__str__(name)

    @property
    def message(self) -> str:
        """The likely cause, then the text of the exception, without OpenCV's place in its own source."""
        return f"{self.cause} {error_message(self.exception)}".strip()

    def __str__(self) -> str:
        text = self.message
        return f"{self.function}: {self.kind}{': ' + text if text else ''}"

    def __repr__(self) -> str:
        try:
            raised = str.__str__(repr(self.exception))
        except BaseException:  # an exception's own __repr__ may raise
            raised = f"<{self.kind}>"
        return (
            f"Failure(function={self.function!r}, tokens={self.tokens!r}, exception={raised}, "
            f"event_id={self.event_id!r}, attempt={self.attempt!r}, source={self.source!r}, cause={self.cause!r})"
        )


def failure_of(tokens: TokenManager, place: int, exception: BaseException, frozen: Collection[str]) -> Failure:
    """Describe the failure of a step, and note on the user's exception which function and tokens it concerns.

    ``frozen`` are the hyperparameters.
    """
    names, step = tokens.program.tokens, tokens.program.steps[place]
    inputs = tuple(names[slot] for slot in step.inputs)
    outputs = tuple(names[slot] for slot in step.outputs)
    values = {token: _lent(tokens.values[slot]) for token, slot in zip(inputs, step.inputs, strict=True)}
    given = ", ".join(f"{token}{_brief(value)}" for token, value in values.items())
    begin, end = f"In function {step.name!r}: (", f") -> ({', '.join(outputs)})"
    note, cause = f"{begin}{given}{end}", ""
    # Whatever the exception's own methods do, the failure is reported.
    with contextlib.suppress(BaseException):
        cause = " ".join(_causes(tokens, place, exception, frozen))
        why = cause or (None if step.unguarded else explain_write(step.name, inputs, exception))
        note = f"{note}\n{why}" if why else note
    with contextlib.suppress(BaseException):
        # One exception may be raised for event after event, with other values each time.
        for earlier in list(getattr(exception, "__notes__", ())):
            if earlier.startswith(begin) and earlier.partition("\n")[0].endswith(end):
                exception.__notes__.remove(earlier)
        exception.add_note(note)
        fold_end(exception)
    return Failure(step.name, (*inputs, *outputs), values, exception, cause=cause)


def _causes(tokens: TokenManager, place: int, exception: BaseException, frozen: Collection[str]) -> Iterator[str]:
    """Say which inputs of a step likely made it fail: None in place of an image, or forbidden values."""
    # Not before a function has failed: it reads the catalog, and the function's source.
    from epypes.catalog import reason_against

    program, step = tokens.program, tokens.program.steps[place]
    for slot in step.inputs:
        token, value = program.tokens[slot], tokens.values[slot]
        if value is None and token not in frozen and _OF_NONE.search(str(exception)):
            maker = program.makers[slot]
            if maker < 0:
                yield f"{token} is None. {_WAS_IT_FOUND}"
                continue
            made = program.steps[maker]
            is_reader = any(isinstance(tokens.values[given], str | os.PathLike) for given in made.inputs)
            why = _WAS_IT_FOUND if is_reader else _DOES_IT_RETURN
            yield f"{token} is None, made by function {made.name!r}. {why}"
        elif isinstance(value, str | os.PathLike) and token not in frozen and _OF_TEXT.search(str(exception)):
            kind = "text" if isinstance(value, str) else "path"
            yield f"{token} is a {kind}, not an image. Read the file first: cv2.imread({str(value)!r:.{_BRIEF}})."
        elif is_array(value) and (found := _OF_CHANNELS.search(str(exception))):
            count = value.shape[2] if value.ndim == 3 else 1
            if value.ndim in (2, 3) and count == int(found[1]):
                yield f"{token} has {count} channel{'s' * (count > 1)}, which this conversion of colours does not take."
                if count == 1:
                    yield "It is grey: leave a conversion to grey out, or pass an image with 3 channels."
        elif value is not None and (type(value) in _NUMBERS or is_numpy_scalar(type(value))):
            reason = reason_against(program.cg, step.name, token, value)
            if reason:
                yield f"{token}{_brief(value)}: {reason}."


def _brief(value: Any) -> str:
    """Return the text of an input in a note: a small value itself, of an array its dtype and shape, else its type."""
    kind = type(value)
    with contextlib.suppress(Exception):  # of an integer with too many digits, or an array's own class
        if is_array(value):
            return f": {value.dtype} {' x '.join(map(str, value.shape)) or 'without axes'}"
        if kind in _NUMBERS or is_numpy_scalar(kind) or (kind is str and len(value) <= _BRIEF):
            return f"={value!r:.{_BRIEF}}"
        return f": {_kind_text(value, kind)}"
    return ""


def _kind_text(value: Any, kind: type) -> str:
    """Return the type of a value that is no array, and of a container how many items of which type it has."""
    name: str = type.__dict__["__name__"].__get__(kind)
    if kind is str:
        return f"str of {len(value)} characters"
    if kind not in _CONTAINERS:
        return name
    kinds = {type.__dict__["__name__"].__get__(type(item)) for item in islice(value, _MOST_ITEMS)}
    of_one_kind = kind is not dict and kind is not bytes and len(kinds) == 1 and len(value) <= _MOST_ITEMS
    return f"{name} of {len(value)}{f' {kinds.pop()}' if of_one_kind else ''}"


def _lent(value: Any) -> Any:
    try:
        return lend_to_reader(value)
    except Exception:  # an array's own class does not let it be viewed, which may be what failed
        return value
