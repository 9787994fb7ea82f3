"""The worker side of an executor: a process unpacks a packaged graph and runs its jobs."""

from __future__ import annotations

import os
import queue
import socket
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from epypes.batch.job import Job, do
from epypes.batch.packaged_graph import PackagedGraph, packed_outcomes, unpacked_job, unpacked_values
from epypes.batch.results import Outcome
from epypes.bundle.load import Bundle, read_bundle
from epypes.errors import ScaleError
from epypes.run import CompGraphRunner
from epypes.wording import ended

_MOST_LOADED: Final = 8


@dataclass(frozen=True, slots=True)
class PackagedJob:
    """A job that travels.

    Attributes
    ----------
    id
        Another one each time, since a cluster takes what is equal for the same.
    parcel
        The graph.
    hyperparameters
        The runner's, as they travel.
    job
        What is to be done, as it travels.
    workers, guard, check_mutation
        As the runner has them.
    """

    id: str
    parcel: PackagedGraph
    hyperparameters: Mapping[str, Any]
    job: Job
    workers: int = 1
    guard: bool = True
    check_mutation: bool = False

    def __dask_tokenize__(self) -> str:
        return self.id


@dataclass(frozen=True, slots=True)
class Refusal:
    """What comes back in place of outcomes: why the job can't be done here; ``is_missing``: the parcel's files are."""

    text: str
    is_missing: bool = False


class _Loaded:
    """A bundle that was unpacked in this process, and the runners that are idle."""

    def __init__(self, bundle: Bundle) -> None:
        self._bundle = bundle
        self._idle: queue.SimpleQueue[CompGraphRunner] = queue.SimpleQueue()

    def do(self, sent: PackagedJob) -> list[Outcome]:
        """Do a job, on a runner that no other thread uses meanwhile."""
        enums = self._bundle.enums
        hyperparameters = unpacked_values(sent.hyperparameters, enums)
        try:
            own = self._idle.get_nowait()
        except queue.Empty:
            own = CompGraphRunner(
                self._bundle.cg,
                hyperparameters,
                workers=sent.workers,
                guard=sent.guard,
                check_mutation=sent.check_mutation,
            )
        try:
            own.set(**hyperparameters)
            return do(own, unpacked_job(sent.job, enums))
        finally:
            self._idle.put(own)


_LOADED: Final[OrderedDict[tuple[str, int, bool, bool], _Loaded]] = OrderedDict()
_LOCK: Final = threading.Lock()


def work(sent: PackagedJob) -> list[Outcome] | Refusal:
    """Do a job in this process; called by whatever executor there is."""
    key = sent.parcel.digest, sent.workers, sent.guard, sent.check_mutation
    with _LOCK:
        loaded = _LOADED.get(key)
        if loaded is None:
            if sent.parcel.files is None:
                return Refusal("the files of the bundle are missing", is_missing=True)
            try:
                loaded = _Loaded(_unpacked(sent.parcel.files))
            except (Exception, SystemExit) as error:  # whatever the module of a bundle does when it is imported
                return Refusal(_why_not(sent.parcel, error))
            _LOADED[key] = loaded
            while len(_LOADED) > _MOST_LOADED:
                _LOADED.popitem(last=False)
    try:
        return packed_outcomes(loaded.do(sent))
    except ScaleError as error:
        return Refusal(str(error))


def _unpacked(files: Mapping[str, bytes]) -> Bundle:
    with tempfile.TemporaryDirectory(prefix="epypes-parcel-") as folder:
        for name, content in files.items():
            file = Path(folder) / "graph" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        # Its digest has come with it, and what was left out is in its manifest.
        return read_bundle(Path(folder) / "graph", sealed=False)


def _why_not(parcel: PackagedGraph, error: BaseException) -> str:
    where = f"Worker process {os.getpid()} on {socket.gethostname()}"
    needs = ", ".join(line for line in parcel.requirements.splitlines() if line and not line.startswith("#"))
    way_out = f"Install there what the graph needs: {needs}" if needs else "Look at what its modules do there"
    said = ended(f"{type(error).__name__}: {error}")
    return f"{where} can't load the graph: {said} {way_out}; or use an executor of this machine."


def lighter(sent: PackagedJob) -> PackagedJob:
    """Return what is sent without the files of its parcel, for who may have them."""
    return replace(sent, parcel=replace(sent.parcel, files=None))
