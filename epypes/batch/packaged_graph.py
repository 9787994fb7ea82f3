"""A graph as a bundle that travels to other processes, the serialization of values, and the worker side that runs jobs.

The graph is promoted once, which proves that it computes there what it computes here, and the bundle's files travel.
Numbers, texts, paths and plain arrays travel as they are; any other value by wire's codecs, which know what pickle does
not, such as OpenCV's keypoints. Nothing of the notebook is ever pickled.
"""

from __future__ import annotations

import os
import socket
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PosixPath, WindowsPath
from typing import Any, Final, TypeVar

from epypes.batch.cache import graph_fingerprint
from epypes.batch.items import Item, frames_of, payload_of
from epypes.batch.job import Job, run_job
from epypes.batch.results import Outcome
from epypes.bundle import promote
from epypes.bundle.load import Bundle, read_bundle
from epypes.bundle.manifest import MANIFEST, REQUIREMENTS, SAMPLES, bundle_files
from epypes.bundle.settings import Unwritable, decode_value, encode_value, members_in
from epypes.bundle.source.clone import clone_runner
from epypes.errors import BundleError, MessageError, PromotionRefused, ScaleError
from epypes.run import CompGraphRunner
from epypes.run.guard import is_plain_array
from epypes.run.runner import branched
from epypes.wire import Envelope, decode, encode
from epypes.wording import ended

_K = TypeVar("_K")
_V = TypeVar("_V")
_NAME: Final = "graph"
# Stands in the reasons in place of the temporary folder.
_BUNDLE: Final = "the graph's bundle"
_MOST_PACKAGES: Final = 16
_NOTE: Final = (
    "Other processes run a graph as a bundle, never pickled: use a ThreadPoolExecutor, which runs it as it is, "
    "or no executor if a function keeps something from one item to the next."
)


@dataclass(frozen=True, slots=True)
class PackagedGraph:
    """A bundle that travels.

    Attributes
    ----------
    digest
        The bundle's; a worker process knows by it what it has unpacked.
    files
        Their contents by path, without samples; None where they are left out.
    """

    digest: str
    files: Mapping[str, bytes] | None


# The packages that this process has made, by what they compute; the oldest ones go.
_PACKAGES: Final[dict[tuple[str, ...] | None, PackagedGraph]] = {}


def package_of(runner: CompGraphRunner, item: Item) -> PackagedGraph | None:
    """Return the package of a runner's graph, once made in this process; None if the item can't be run.

    A run of the item is the sample that proves the bundle.

    Raises
    ------
    PromotionRefused
        With every reason why the graph can't become a bundle.
    """
    key = _key_of(runner)
    if key in _PACKAGES:
        return _PACKAGES[key]
    own = clone_runner(runner)
    try:
        own.run_on(payload_of(next(frames_of(item, own)), own.cg))
    except (Exception, SystemExit):  # whatever a function raises: it will be that item's failure
        return None
    with tempfile.TemporaryDirectory(prefix="epypes-package-") as place:
        folder = Path(place).resolve() / _NAME
        try:
            bundle = promote(own, folder)
        except PromotionRefused as error:
            # The user has not named the temporary folder.
            refused = PromotionRefused(_BUNDLE, [reason.replace(str(folder), _BUNDLE) for reason in error.reasons])
            refused.add_note(_NOTE)
            raise refused from error
        except BundleError as error:
            error.add_note(_NOTE)
            raise
        names = (name for name in (*bundle_files(bundle.path), MANIFEST) if not name.startswith(f"{SAMPLES}/"))
        files = {name: (bundle.path / name).read_bytes() for name in names}
    package = PackagedGraph(bundle.digest, files)
    if key is not None:
        _keep(_PACKAGES, key, package, _MOST_PACKAGES)
    return package


def _keep(kept: dict[_K, _V], key: _K, value: _V, most: int) -> None:
    """Keep a value; the oldest ones go."""
    kept[key] = value
    for old in list(kept)[:-most]:
        kept.pop(old, None)


def _key_of(runner: CompGraphRunner) -> tuple[str, ...] | None:
    """Return what differs for graphs that compute something else; None if nothing says so.

    Values of hyperparameters are not in it: they travel beside the package.
    """
    found = graph_fingerprint(runner.cg)
    # A file that a function reads beside its module may be another one by now.
    is_known = not found.unknown and not found.reader
    types = (f"{token} {type(value)}" for token, value in runner.hyperparameters.items())
    return None if not is_known else (found.code, found.state, *runner.free_source_tokens, *types)


# -- serialization --------------------------------------------------------------------------------------------------

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
    if isinstance(value, WireValue | TomlValue):  # a state that goes on as it came
        return value
    if type(value) in _AS_THEY_ARE or (is_plain_array(value) and not value.dtype.hasobject):
        return value
    try:
        if any(members_in(value)):
            return TomlValue(encode_value(value))
        return WireValue(tuple(bytes(frame) for frame in encode(Envelope(_PART, {_PART: value}))))
    except (MessageError, Unwritable) as error:
        way_out = "Use a ThreadPoolExecutor, or none, where values stay in this process."
        raise ScaleError(f"{what} can't travel to or from another process: {error} {way_out}") from error


def unpacked(value: Any, enums: Mapping[str, Any] | None = None) -> Any:
    """Return the value that ``packed`` packed."""
    if isinstance(value, WireValue):
        return decode(value.frames).parts[_PART]
    return decode_value(value.written, enums) if isinstance(value, TomlValue) else value


def packed_values(values: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Return values by token as they travel."""
    return {token: packed(value, f"{what} {token!r}") for token, value in values.items()}


def unpacked_values(values: Mapping[str, Any], enums: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the values by token that ``packed_values`` packed."""
    return {token: unpacked(value, enums) for token, value in values.items()}


def packed_job(job: Job) -> Job:
    """Return a job as it travels: without where it starts, since that has a lock and a runner of this process."""
    return replace(_with_values(job, packed_values), start=None)


def unpacked_job(job: Job, enums: Mapping[str, Any]) -> Job:
    """Return the job that ``packed_job`` packed."""
    return _with_values(job, lambda values, _: unpacked_values(values, enums))


def _with_values(job: Job, convert: Callable[[Mapping[str, Any], str], dict[str, Any]]) -> Job:
    def converted(item: Item) -> Item:
        frames = tuple(map(converted, item.frames)) if isinstance(item.frames, tuple) else item.frames
        # The key of a series may be anything, and only this process needs it.
        return replace(item, payload=convert(item.payload, "Input"), series=None, frames=frames)

    return replace(
        job,
        item=converted(job.item),
        settings=tuple(convert(setting, "Hyperparameter") for setting in job.settings),
        states=tuple(convert(state, "The state of") for state in job.states),
    )


def unpacked_outcomes(outcomes: list[Outcome], job: Job) -> list[Outcome]:
    """Return the outcomes of a job that came back; their arrays are read-only, as those of a run are."""
    unpacked: list[Outcome] = []
    for outcome, setting in zip(outcomes, job.settings, strict=True):
        kept = unpacked_values(outcome.kept)
        for value in kept.values():
            if is_plain_array(value):
                value.flags.writeable = False
        unpacked.append(replace(outcome, setting=setting, kept=kept, series=job.item.series))
    return unpacked


# -- the worker side ----------------------------------------------------------------------------------------------

_MOST_LOADED: Final = 8


@dataclass(frozen=True, slots=True)
class PackagedJob:
    """A job as it travels to a worker process.

    Attributes
    ----------
    id
        Another one each time, since a Dask cluster takes equal calls for one.
    package
        The graph.
    hyperparameters
        The runner's, packed.
    job
        The job, packed.
    options
        Of the runner, by name.
    """

    id: str
    package: PackagedGraph
    hyperparameters: Mapping[str, Any]
    job: Job
    options: tuple[tuple[str, Any], ...] = ()

    def __dask_tokenize__(self) -> str:
        return self.id


_Folder = tempfile.TemporaryDirectory[str]
# By package and options: the members of the bundle's enumerations, a runner that each job branches from, and the folder
# of the bundle, whose functions may read files there.
_LOADED: Final[dict[tuple[str, tuple[tuple[str, Any], ...]], tuple[Mapping[str, Any], CompGraphRunner, _Folder]]] = {}
_LOAD_LOCK: Final = threading.Lock()


def run_packaged_job(packaged: PackagedJob) -> list[Outcome] | str | None:
    """Run a job in this worker process; the executor calls it.

    Returns
    -------
    list, str or None
        The outcomes, packed; or why this process can't run the job; None if it has not unpacked the package yet, and
        the files have not come with the job.
    """
    key = packaged.package.digest, packaged.options
    with _LOAD_LOCK:
        if key not in _LOADED:
            if packaged.package.files is None:
                return None
            try:
                folder = tempfile.TemporaryDirectory(prefix="epypes-package-")
                bundle = _unpacked(packaged.package.files, Path(folder.name))
                values = unpacked_values(packaged.hyperparameters, bundle.enums)
                # Those of pipelines inside are set for each job: not all have one.
                values = {token: value for token, value in values.items() if token in bundle.cg.tokens}
                loaded = bundle.enums, CompGraphRunner(bundle.cg, values, **dict(packaged.options)), folder
            except (Exception, SystemExit) as error:  # whatever the module of a bundle does when it is imported
                return _load_error(packaged.package.files, error)
            _keep(_LOADED, key, loaded, _MOST_LOADED)
        enums, runner, _ = _LOADED[key]
    own = branched(runner)
    own.set(**unpacked_values(packaged.hyperparameters, enums))
    try:
        # Without its setting, which the process that sent the job has.
        return [
            replace(
                outcome,
                setting={},
                kept=packed_values(outcome.kept, "Token"),
                state=packed_values(outcome.state, "The state of"),
            )
            for outcome in run_job(own, unpacked_job(packaged.job, enums))
        ]
    except ScaleError as error:
        return str(error)


def _unpacked(files: Mapping[str, bytes], folder: Path) -> Bundle:
    for name, content in files.items():
        file = folder / _NAME / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
    # Its digest has come with it, and what was left out is in its manifest.
    return read_bundle(folder / _NAME, compare=False)


def _load_error(files: Mapping[str, bytes], error: BaseException) -> str:
    where = f"Worker process {os.getpid()} on {socket.gethostname()}"
    requirements = files.get(REQUIREMENTS, b"").decode()
    needs = ", ".join(line for line in requirements.splitlines() if line and not line.startswith("#"))
    way_out = f"Install there what the graph needs: {needs}" if needs else "Look at what its modules do there"
    cause = error.__cause__ if isinstance(error.__cause__, ImportError) else error
    reason = ended(f"{type(cause).__name__}: {cause}")
    return f"{where} can't load the graph: {reason} {way_out}; or use an executor of this machine."
