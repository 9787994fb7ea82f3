"""A graph as a bundle that travels to other processes, and the serialization of values beside it."""

from __future__ import annotations

import functools
import hashlib
import json
import re
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PosixPath, WindowsPath
from typing import Any, Final

from epypes.batch.job import Job
from epypes.batch.results import Outcome
from epypes.bundle import promote, to_source
from epypes.bundle.hyperparameters import Unwritable, members_in, read, written
from epypes.bundle.load import SAMPLES
from epypes.errors import BundleError, MessageError, PlaceholderNeeded, PromotionRefused, ScaleError, SourceRefused
from epypes.run import CompGraphRunner
from epypes.run.guard import is_plain_array
from epypes.wire import Envelope, decode, encode

_NAME: Final = "graph"
# What stands in the reasons in place of the temporary folder.
_BUNDLE: Final = "the graph's bundle"
_MISSING: Final = re.compile(r"ModuleNotFoundError: No module named '([^']+)'")
_MOST_PROVEN: Final = 16
_NOTE: Final = (
    "To be run by other processes or a cluster, a graph is promoted to a bundle first. "
    "A ThreadPoolExecutor runs it as it is. If a function keeps something from one item to the next, "
    "run it without an executor: on threads its results are others."
)


@dataclass(frozen=True, slots=True)
class PackagedGraph:
    """A bundle that travels.

    Attributes
    ----------
    digest
        Of its files; who has unpacked it knows it by that.
    files
        Their contents by path, without samples; None where it is left out.
    requirements
        What is to be installed where it is unpacked.
    """

    digest: str
    files: Mapping[str, bytes] | None
    requirements: str = ""

    @property
    def size(self) -> int:
        """How many bytes its files have."""
        return sum(map(len, (self.files or {}).values()))


class _Proven:
    """The parcels that were made in this process, by what they compute; those used last are kept."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._by_source: OrderedDict[str, PackagedGraph] = OrderedDict()

    def find(self, source: str) -> PackagedGraph | None:
        """Return the parcel of this source, if there is one."""
        with self._lock:
            parcel = self._by_source.get(source)
            if parcel is not None:
                self._by_source.move_to_end(source)
            return parcel

    def add(self, source: str, parcel: PackagedGraph) -> None:
        """Keep a parcel."""
        with self._lock:
            self._by_source[source] = parcel
            while len(self._by_source) > _MOST_PROVEN:
                self._by_source.popitem(last=False)


_PROVEN: Final = _Proven()


def known_package(runner: CompGraphRunner) -> PackagedGraph | None:
    """Return the parcel of a runner's graph if this process has made it before."""
    source = _source_of(runner)
    return None if source is None else _PROVEN.find(source)


def package_of(runner: CompGraphRunner) -> PackagedGraph:
    """Make a parcel of a runner's graph; its last run is what proves it.

    Raises
    ------
    PromotionRefused
        With every reason why it can't be a bundle.
    """
    with tempfile.TemporaryDirectory(prefix="epypes-parcel-") as folder:
        try:
            bundle = promote(runner, Path(folder) / _NAME)
        except PromotionRefused as error:
            refused = PromotionRefused(_BUNDLE, _told(error.reasons, Path(folder) / _NAME))
            refused.add_note(_NOTE)
            raise refused from error
        except BundleError as error:
            error.add_note(_NOTE)
            raise
        files = {str(file.relative_to(bundle.path)): file.read_bytes() for file in _files(bundle.path)}
    digest = hashlib.sha256()
    for name, content in sorted(files.items()):
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    parcel = PackagedGraph(digest.hexdigest(), files, files.get("requirements.txt", b"").decode())
    source = _source_of(runner)
    if source is not None:
        _PROVEN.add(source, parcel)
    return parcel


def _told(reasons: Sequence[str], folder: Path) -> list[str]:
    """Return the reasons without a folder that nobody has named and that is gone; first which modules are missing."""
    places = sorted({str(folder), str(folder.resolve())}, key=len, reverse=True)
    said = [functools.reduce(lambda text, place: text.replace(place, _BUNDLE), places, reason) for reason in reasons]
    missing = dict.fromkeys(name for reason in said for name in _MISSING.findall(reason))
    first = [
        f"Module {name!r} is not installed, so no other process can import it: install it as a package, or take a "
        "ThreadPoolExecutor, or no executor, which run the graph as it is."
        for name in missing
    ]
    return [*first, *said]


def _files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.is_file() and SAMPLES not in file.parts)


def _source_of(runner: CompGraphRunner) -> str | None:
    """Return what tells a graph from others that compute something else; None if that can't be written as text.

    Values of hyperparameters are not in it: they travel beside the parcel.
    """
    try:
        source = to_source(runner.cg)
    except (SourceRefused, PlaceholderNeeded):
        return None
    kinds = {
        token: f"{type(value).__module__}.{type(value).__qualname__}" for token, value in runner.hyperparameters.items()
    }
    io = {name: [runner.cg.func_inputs(name), runner.cg.func_outputs(name)] for name in runner.cg.functions}
    return json.dumps([source, io, kinds, list(runner.free_source_tokens)])


_AS_THEY_ARE: Final = frozenset({bool, int, float, complex, str, bytes, type(None), Path, PosixPath, WindowsPath})
_PART: Final = "value"


@dataclass(frozen=True, slots=True)
class WireValue:
    """A value as the frames of a message."""

    frames: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class TomlValue:
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
            return TomlValue(written(value))
        return WireValue(tuple(bytes(frame) for frame in encode(Envelope(_PART, {_PART: value}))))
    except (MessageError, Unwritable) as error:
        way_out = "Use a ThreadPoolExecutor, or none, where values stay in this process."
        raise ScaleError(f"{what} can't travel to or from another process: {error} {way_out}") from error


def unpacked(value: Any, enums: Mapping[str, Any] | None = None) -> Any:
    """Return the value that ``packed`` packed."""
    if isinstance(value, WireValue):
        return decode(value.frames).parts[_PART]
    return read(value.written, enums) if isinstance(value, TomlValue) else value


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
