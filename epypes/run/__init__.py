"""Which functions must run, and running them."""

from epypes.run.failure import Failure
from epypes.run.plan import Plan
from epypes.run.record import Run
from epypes.run.report import FunctionTime, RunReport
from epypes.run.runner import CompGraphRunner
from epypes.run.summary import LogNormal, TimingSummary, summarize
from epypes.run.tokens import NOT_COMPUTED, TokenManager

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
