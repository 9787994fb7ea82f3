"""How does a graph get into other processes?

As a bundle: it is promoted once, which proves that it computes there what it computes here, and its files travel.
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from epypes.bundle import promote, to_source
from epypes.bundle.load import SAMPLES
from epypes.errors import BundleError, PlaceholderNeeded, PromotionRefused, SourceRefused
from epypes.run import CompGraphRunner

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
class Parcel:
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
        self._by_source: OrderedDict[str, Parcel] = OrderedDict()

    def find(self, source: str) -> Parcel | None:
        """Return the parcel of this source, if there is one."""
        with self._lock:
            parcel = self._by_source.get(source)
            if parcel is not None:
                self._by_source.move_to_end(source)
            return parcel

    def add(self, source: str, parcel: Parcel) -> None:
        """Keep a parcel."""
        with self._lock:
            self._by_source[source] = parcel
            while len(self._by_source) > _MOST_PROVEN:
                self._by_source.popitem(last=False)


_PROVEN: Final = _Proven()


def known_parcel(runner: CompGraphRunner) -> Parcel | None:
    """Return the parcel of a runner's graph if this process has made it before."""
    source = _source_of(runner)
    return None if source is None else _PROVEN.find(source)


def parcel_of(runner: CompGraphRunner) -> Parcel:
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
    parcel = Parcel(digest.hexdigest(), files, files.get("requirements.txt", b"").decode())
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
