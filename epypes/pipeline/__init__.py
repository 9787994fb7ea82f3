"""The paper's ladder: Node, Pipeline, and the pipelines that answer events."""

from typing import TYPE_CHECKING

from epypes.deprecation import old_names
from epypes.pipeline.event_loop import EventLoop, wait
from epypes.pipeline.mailbox import Mailbox
from epypes.pipeline.node import Node, NodeBasedCompGraph
from epypes.pipeline.pipeline import Pipeline, Stage, Stages
from epypes.pipeline.reactive import EventView, FullPipeline, SinkPipeline, SourcePipeline, Stamps

__all__ = [
    "EventLoop",
    "EventView",
    "FullPipeline",
    "Mailbox",
    "Node",
    "NodeBasedCompGraph",
    "Pipeline",
    "SinkPipeline",
    "SourcePipeline",
    "Stage",
    "Stages",
    "Stamps",
    "wait",
]

if not TYPE_CHECKING:
    __getattr__ = old_names(__name__)
