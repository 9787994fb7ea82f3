"""How do items and outcomes travel to another process and back?

Numbers, texts, paths and plain arrays go as they are; any other value by wire's codecs, which know what pickle does
not, such as OpenCV's keypoints. Nothing of the notebook is ever pickled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PosixPath, WindowsPath
from typing import Any, Final

from epypes.batch.job import Job
from epypes.batch.outcome import Outcome
from epypes.bundle.entries import Unwritable, members_in, read, written
from epypes.errors import MessageError, ScaleError
from epypes.run.guard import is_plain_array
from epypes.wire import Envelope, decode, encode

_AS_THEY_ARE: Final = frozenset({bool, int, float, complex, str, bytes, type(None), Path, PosixPath, WindowsPath})
_PART: Final = "value"


@dataclass(frozen=True, slots=True)
class Wired:
    """A value as the frames of a message."""

    frames: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class Entry:
    """A value with members of enumerations, which the bundle's module has: as it stands in pipeline.toml."""

    written: Mapping[str, Any]


def packed(value: Any, what: str) -> Any:
    """Return what travels in place of a value; ``what`` it is, for errors.

    Raises
    ------
    ScaleError
        There is no codec for values of its type.
    """
    if type(value) in _AS_THEY_ARE or (is_plain_array(value) and not value.dtype.hasobject):
        return value
    try:
        if any(members_in(value)):
            return Entry(written(value))
        return Wired(tuple(bytes(frame) for frame in encode(Envelope(_PART, {_PART: value}))))
    except (MessageError, Unwritable) as error:
        way_out = "Use a ThreadPoolExecutor, or none, where values stay in this process."
        raise ScaleError(f"{what} can't travel to or from another process: {error} {way_out}") from error


def unpacked(value: Any, enums: Mapping[str, Any] | None = None) -> Any:
    """Return the value that ``packed`` packed."""
    if isinstance(value, Wired):
        return decode(value.frames).parts[_PART]
    return read(value.written, enums) if isinstance(value, Entry) else value


def packed_values(values: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Return values by token as they travel."""
    return {token: packed(value, f"{what} {token!r}") for token, value in values.items()}


def unpacked_values(values: Mapping[str, Any], enums: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the values by token that ``packed_values`` packed."""
    return {token: unpacked(value, enums) for token, value in values.items()}


def packed_job(job: Job) -> Job:
    """Return a job as it travels: where it starts, with a lock and a runner, is of this process alone."""
    items = tuple(replace(item, payload=packed_values(item.payload, "Input")) for item in job.items)
    settings = tuple(packed_values(setting, "Hyperparameter") for setting in job.settings)
    return replace(job, items=items, settings=settings, start=None)


def unpacked_job(job: Job, enums: Mapping[str, Any]) -> Job:
    """Return the job that ``packed_job`` packed."""
    items = tuple(replace(item, payload=unpacked_values(item.payload)) for item in job.items)
    return replace(job, items=items, settings=tuple(unpacked_values(setting, enums) for setting in job.settings))


def packed_outcomes(outcomes: list[Outcome]) -> list[Outcome]:
    """Return outcomes as they travel back: without their settings, which whoever sent the job knows."""
    return [replace(outcome, setting={}, kept=packed_values(outcome.kept, "Token")) for outcome in outcomes]


def unpacked_outcomes(outcomes: list[Outcome], job: Job) -> list[Outcome]:
    """Return the outcomes of a job that came back."""
    settings = len(job.settings)
    return [
        replace(outcome, setting=job.settings[place % settings], kept=_locked(unpacked_values(outcome.kept)))
        for place, outcome in enumerate(outcomes)
    ]


def _locked(values: dict[str, Any]) -> dict[str, Any]:
    """Make arrays read-only, as those of a run are."""
    for value in values.values():
        if is_plain_array(value):
            value.flags.writeable = False
    return values
