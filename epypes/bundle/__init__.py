"""From a notebook's graph to a folder of text that proves what it computes, and back."""

from epypes.bundle.load import load, load_pipeline
from epypes.bundle.promote import promote
from epypes.bundle.proof.replay_process import verify
from epypes.bundle.source.to_source import to_source
from epypes.bundle.writeback import WriteBack, write_back

__all__ = ["WriteBack", "load", "load_pipeline", "promote", "to_source", "verify", "write_back"]
