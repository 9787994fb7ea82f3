"""The paper's ladder: Node, Pipeline, and the pipelines that answer events."""

from epypes.pipeline.loop import EventLoop
from epypes.pipeline.mailbox import Mailbox
from epypes.pipeline.network import NodeBasedCompGraph
from epypes.pipeline.node import Node
from epypes.pipeline.pipeline import Pipeline
from epypes.pipeline.reactive import FullPipeline, SinkPipeline, SourcePipeline
from epypes.pipeline.stages import Stage, Stages
from epypes.pipeline.stamps import Stamps
from epypes.pipeline.view import EventView

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
]
