"""Which functions must run, and running them."""

from epypes.run.failure import Failure
from epypes.run.plan import Plan
from epypes.run.result import Run
from epypes.run.runner import CompGraphRunner
from epypes.run.staleness import NOT_COMPUTED, TokenManager
from epypes.run.timing import FunctionTime, LogNormal, RunReport, TimingSummary, summarize

__all__ = [
    "NOT_COMPUTED",
    "CompGraphRunner",
    "Failure",
    "FunctionTime",
    "LogNormal",
    "Plan",
    "Run",
    "RunReport",
    "TimingSummary",
    "TokenManager",
    "summarize",
]
