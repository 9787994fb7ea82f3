"""How does a bundle become a runner or a pipeline again?"""

from __future__ import annotations

import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from epypes.bundle.ports import answer_with, payload_of
from epypes.bundle.seal import check_seal
from epypes.bundle.settings import Settings, read_settings
from epypes.errors import BundleError
from epypes.graph import CompGraph, with_defaults
from epypes.pipeline import FullPipeline
from epypes.run import CompGraphRunner

MODULE: Final = "pipeline.py"
SETTINGS: Final = "pipeline.toml"
SAMPLES: Final = "samples"


@dataclass(frozen=True, slots=True, repr=False)
class Bundle:
    """A bundle that was read: its graph, its settings and its digest (empty while it is not sealed)."""

    path: Path
    cg: CompGraph
    settings: Settings
    digest: str

    @property
    def samples(self) -> tuple[Path, ...]:
        """The files of its samples, sorted."""
        return tuple(sorted((self.path / SAMPLES).glob("*.npz")))

    def __repr__(self) -> str:
        ends = f"{', '.join(self.settings.inputs)} -> {', '.join(self.settings.outputs)}"
        return f"<Bundle {self.settings.name!r:.30}: {ends:.40}>"


def read_bundle(path: str | Path, *, sealed: bool = True) -> Bundle:
    """Read a bundle; its module's code is executed.

    Raises
    ------
    BundleError
        A file was changed, is missing or was added, or the folder is no bundle.
    GraphError
        The graph in its module is not valid.
    """
    folder = Path(path).resolve()
    while True:
        before = _identity(folder)
        try:
            digest = check_seal(folder) if sealed else ""
            settings, source = read_settings(folder / SETTINGS), (folder / MODULE).read_bytes()
        except (BundleError, OSError):
            if _identity(folder) == before:
                raise
            continue
        # A promotion puts another folder in this one's place: then what was read may be of both.
        if _identity(folder) == before:
            break
    module = _execute(folder / MODULE, source)
    try:
        cg = CompGraph(module.func_dict, module.func_io, types=settings.types)
    except AttributeError as error:
        text = f"{folder / MODULE} defines no {error.name!r}. Promote the graph again."
        raise BundleError(folder, text) from error
    return Bundle(folder, with_defaults(cg, settings.defaults), settings, digest)


def _identity(folder: Path) -> tuple[int, int] | None:
    """Return what tells a folder from another one of its name, also from one that was there before."""
    try:
        found = folder.stat()
    except OSError:
        return None
    return found.st_ino, found.st_ctime_ns


def _execute(path: Path, source: bytes) -> Any:
    """Execute the module's source as it was checked; a cached .pyc, which the seal does not cover, is not looked at."""
    module = types.ModuleType(f"epypes_bundle_{path.parent.name}")
    module.__file__ = str(path)
    exec(compile(source, str(path), "exec"), module.__dict__)  # noqa: S102 - loading code is its purpose
    return module


def load(path: str | Path) -> CompGraphRunner:
    """Return a runner with a bundle's graph and hyperparameters.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    """
    bundle = read_bundle(path)
    return CompGraphRunner(bundle.cg, bundle.settings.hyperparameters)


def load_pipeline(path: str | Path, q_in: Any, q_out: Any) -> FullPipeline:
    """Return the FullPipeline that ``epypes serve`` runs.

    Parameters
    ----------
    path
        The bundle's folder.
    q_in
        Gives Envelopes whose parts are the bundle's input tokens.
    q_out
        Gets Envelopes whose parts are its output tokens.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    """
    return pipeline_of(read_bundle(path), q_in, q_out)


def pipeline_of(bundle: Bundle, q_in: Any, q_out: Any) -> FullPipeline:
    """Return the FullPipeline of a bundle that was read."""
    settings = bundle.settings
    return FullPipeline(
        settings.name,
        bundle.cg,
        q_in,
        q_out,
        payload_of(settings.inputs, settings.rgb),
        answer_with(settings.outputs, bundle.digest, settings.rgb),
        settings.hyperparameters,
    )
