"""The worker side of an executor: a process unpacks a packaged graph and runs its jobs."""

from __future__ import annotations

import os
import queue
import socket
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from epypes.batch.job import Job, run_job
from epypes.batch.packaged_graph import PackagedGraph, packed_outcomes, unpacked_job, unpacked_values
from epypes.batch.results import Outcome
from epypes.bundle.load import Bundle, read_bundle
from epypes.errors import ScaleError
from epypes.run import CompGraphRunner
from epypes.wording import ended

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
    workers, guard, check_mutation
        Options of the runner.
    """

    id: str
    package: PackagedGraph
    hyperparameters: Mapping[str, Any]
    job: Job
    workers: int = 1
    guard: bool = True
    check_mutation: bool = False

    def __dask_tokenize__(self) -> str:
        return self.id


@dataclass(frozen=True, slots=True)
class WorkerRefusal:
    """Why a worker process can't run a job; ``needs_files``: it has not unpacked the package yet."""

    reason: str
    needs_files: bool = False


class _LoadedGraph:
    """A bundle that was unpacked in this process, and the runners of it that are idle."""

    def __init__(self, bundle: Bundle) -> None:
        self._bundle = bundle
        self._idle: queue.SimpleQueue[CompGraphRunner] = queue.SimpleQueue()

    def run(self, packaged: PackagedJob) -> list[Outcome]:
        """Run a job, on a runner that no other thread uses meanwhile."""
        enums = self._bundle.enums
        hyperparameters = unpacked_values(packaged.hyperparameters, enums)
        try:
            own = self._idle.get_nowait()
        except queue.Empty:
            options = {name: getattr(packaged, name) for name in ("workers", "guard", "check_mutation")}
            own = CompGraphRunner(self._bundle.cg, hyperparameters, **options)
        try:
            own.set(**hyperparameters)
            return run_job(own, unpacked_job(packaged.job, enums))
        finally:
            self._idle.put(own)


_LOADED: Final[OrderedDict[tuple[str, int, bool, bool], _LoadedGraph]] = OrderedDict()
_LOCK: Final = threading.Lock()


def run_packaged_job(packaged: PackagedJob) -> list[Outcome] | WorkerRefusal:
    """Run a job in this worker process; the executor calls it."""
    key = packaged.package.digest, packaged.workers, packaged.guard, packaged.check_mutation
    with _LOCK:
        loaded = _LOADED.get(key)
        if loaded is None:
            if packaged.package.files is None:
                return WorkerRefusal("the files of the bundle are missing", needs_files=True)
            try:
                loaded = _LoadedGraph(_unpacked(packaged.package.files))
            except (Exception, SystemExit) as error:  # whatever the module of a bundle does when it is imported
                return WorkerRefusal(_load_error(packaged.package, error))
            _LOADED[key] = loaded
            while len(_LOADED) > _MOST_LOADED:
                _LOADED.popitem(last=False)
    try:
        return packed_outcomes(loaded.run(packaged))
    except ScaleError as error:
        return WorkerRefusal(str(error))


def _unpacked(files: Mapping[str, bytes]) -> Bundle:
    with tempfile.TemporaryDirectory(prefix="epypes-package-") as folder:
        for name, content in files.items():
            file = Path(folder) / "graph" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        # Its digest has come with it, and what was left out is in its manifest.
        return read_bundle(Path(folder) / "graph", sealed=False)


def _load_error(package: PackagedGraph, error: BaseException) -> str:
    where = f"Worker process {os.getpid()} on {socket.gethostname()}"
    needs = ", ".join(line for line in package.requirements.splitlines() if line and not line.startswith("#"))
    way_out = f"Install there what the graph needs: {needs}" if needs else "Look at what its modules do there"
    reason = ended(f"{type(error).__name__}: {error}")
    return f"{where} can't load the graph: {reason} {way_out}; or use an executor of this machine."
