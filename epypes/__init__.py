"""EPypes: vision algorithms as computational graphs, seen, tuned, promoted and served.

The rooms, from the bottom up; imports point downwards only (checked by ``lint-imports``):

- ``deprecation``: how names of EPypes 0.1 answer; ``compat``, above all other rooms: the table of them
- ``errors``: every error EPypes raises; ``optional``: which extra brings a package that is missing;
  ``rich_display``: the registry that objects ask for their picture
- ``annotations``: what a function's annotations say, once evaluated
- ``hints``: which values a hyperparameter may take; ``images``: which arrays a function takes as images;
  ``nothing``: the value of a token for which nothing was found
- ``graph``: what is connected to what
- ``parameters``: which values the functions of OpenCV and scikit-image take
- ``run``: which functions must run, and running them
- ``pipeline``: the paper's ladder of nodes and pipelines; ``acquisition``: where images come from;
  ``display``: how a graph, a run and a value look; ``wire``: how a value travels
- ``bundle``: from notebook to a folder of text; ``transport``: sockets; ``store``: results and history in a database
- ``scale``: many images and settings; ``service``: a bundle as a running process; ``experiment``: the paper's own
- ``cli``: the commands; ``epypes_widgets``: the notebook front end

Names are loaded when they are first used, so ``import epypes`` costs little and imports no other package.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from epypes import errors
    from epypes.acquisition import ImageAcquisition, camera
    from epypes.acquisition.video import video
    from epypes.batch import MapResult, map  # noqa: A004 - as in ep.map(runner, images)
    from epypes.batch.cases import Case
    from epypes.batch.check import check
    from epypes.batch.mapping import SweepResult, sweep
    from epypes.batch.optimize import optimize
    from epypes.bundle import load, load_pipeline, promote, to_source, verify
    from epypes.cpp import export_cpp
    from epypes.display import Preview, register_preview, reset_display_ranges, show
    from epypes.graph import (
        CompGraph,
        Placeholder,
        delay,
        extend,
        group,
        outputs,
        rename,
        subgraph,
        suffix,
        switch,
        union,
    )
    from epypes.hints import Param, Roi
    from epypes.images import Image
    from epypes.nothing import Nothing, NothingType
    from epypes.pipeline import (
        EventLoop,
        EventView,
        FullPipeline,
        Mailbox,
        Node,
        NodeBasedCompGraph,
        Pipeline,
        SinkPipeline,
        SourcePipeline,
        Stage,
        Stages,
        wait,
    )
    from epypes.run import (
        CompGraphRunner,
        Failure,
        LogNormal,
        Plan,
        Run,
        RunReport,
        TimingSummary,
        TokenManager,
        summarize,
    )
    from epypes.run.guard import unguarded
    from epypes.service.failures.reopen import load_failure
    from epypes.service.remote.connection import connect
    from epypes.store import Store
    from epypes.transport import Publisher, Subscriber, ZMQPublisher, ZMQSubscriber

_HOMES = {
    "errors": "epypes",
    "ImageAcquisition": "epypes.acquisition",
    "camera": "epypes.acquisition",
    "video": "epypes.acquisition.video",
    "show": "epypes.display",
    "CompGraph": "epypes.graph",
    "Placeholder": "epypes.graph",
    "delay": "epypes.graph",
    "extend": "epypes.graph",
    "group": "epypes.graph",
    "outputs": "epypes.graph",
    "rename": "epypes.graph",
    "subgraph": "epypes.graph",
    "suffix": "epypes.graph",
    "switch": "epypes.graph",
    "union": "epypes.graph",
    "CompGraphRunner": "epypes.run",
    "Failure": "epypes.run",
    "LogNormal": "epypes.run",
    "Plan": "epypes.run",
    "Run": "epypes.run",
    "RunReport": "epypes.run",
    "TimingSummary": "epypes.run",
    "TokenManager": "epypes.run",
    "summarize": "epypes.run",
    "unguarded": "epypes.run.guard",
    "EventLoop": "epypes.pipeline",
    "EventView": "epypes.pipeline",
    "FullPipeline": "epypes.pipeline",
    "Image": "epypes.images",
    "Mailbox": "epypes.pipeline",
    "Nothing": "epypes.nothing",
    "NothingType": "epypes.nothing",
    "Node": "epypes.pipeline",
    "NodeBasedCompGraph": "epypes.pipeline",
    "Case": "epypes.batch.cases",
    "check": "epypes.batch.check",
    "Param": "epypes.hints",
    "Roi": "epypes.hints",
    "Preview": "epypes.display",
    "register_preview": "epypes.display",
    "reset_display_ranges": "epypes.display",
    "Pipeline": "epypes.pipeline",
    "SinkPipeline": "epypes.pipeline",
    "SourcePipeline": "epypes.pipeline",
    "Stage": "epypes.pipeline",
    "Stages": "epypes.pipeline",
    "wait": "epypes.pipeline",
    "Store": "epypes.store",
    "Publisher": "epypes.transport",
    "Subscriber": "epypes.transport",
    "ZMQPublisher": "epypes.transport",
    "ZMQSubscriber": "epypes.transport",
    "connect": "epypes.service.remote.connection",
    "export_cpp": "epypes.cpp",
    "load": "epypes.bundle",
    "load_failure": "epypes.service.failures.reopen",
    "load_pipeline": "epypes.bundle",
    "optimize": "epypes.batch.optimize",
    "MapResult": "epypes.batch",
    "map": "epypes.batch",
    "promote": "epypes.bundle",
    "SweepResult": "epypes.batch.mapping",
    "sweep": "epypes.batch.mapping",
    "to_source": "epypes.bundle",
    "verify": "epypes.bundle",
}

__all__ = [
    "Case",
    "CompGraph",
    "CompGraphRunner",
    "EventLoop",
    "EventView",
    "Failure",
    "FullPipeline",
    "Image",
    "ImageAcquisition",
    "LogNormal",
    "Mailbox",
    "MapResult",
    "Node",
    "NodeBasedCompGraph",
    "Nothing",
    "NothingType",
    "Param",
    "Pipeline",
    "Placeholder",
    "Plan",
    "Preview",
    "Publisher",
    "Roi",
    "Run",
    "RunReport",
    "SinkPipeline",
    "SourcePipeline",
    "Stage",
    "Stages",
    "Store",
    "Subscriber",
    "SweepResult",
    "TimingSummary",
    "TokenManager",
    "ZMQPublisher",
    "ZMQSubscriber",
    "camera",
    "check",
    "connect",
    "delay",
    "errors",
    "export_cpp",
    "extend",
    "group",
    "load",
    "load_failure",
    "load_pipeline",
    "map",
    "optimize",
    "outputs",
    "promote",
    "register_preview",
    "rename",
    "reset_display_ranges",
    "show",
    "subgraph",
    "suffix",
    "summarize",
    "sweep",
    "switch",
    "to_source",
    "unguarded",
    "union",
    "verify",
    "video",
    "wait",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # Its import takes some 20 ms.
        from importlib.metadata import version

        return globals().setdefault(name, version("epypes"))
    home = _HOMES.get(name)
    if home is None:
        from epypes.errors import UnknownAttribute, nearest

        near = nearest(name, __all__)
        way_out = f" Did you mean {near!r}?" if near else ""
        if name in ("interact", "pick", "tune"):
            way_out = f" Write: from epypes_widgets import {name}"
        raise UnknownAttribute(f"Module 'epypes' has no attribute {name!r}.{way_out}")
    from epypes.optional import optional_import

    with optional_import():
        module = importlib.import_module("epypes.errors" if name == "errors" else home)
    value = module if name == "errors" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


class _OldModules:
    """Finds the modules of EPypes 0.1 that are gone, after all others have found none of that name."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> Any:
        if not name.startswith("epypes.") or name == "epypes.compat":
            return None
        return importlib.import_module("epypes.compat").find_spec(name)


# Also when epypes is imported again by importlib.reload.
if not any(getattr(finder, "__qualname__", "") == _OldModules.__qualname__ for finder in sys.meta_path):
    sys.meta_path.append(_OldModules)
