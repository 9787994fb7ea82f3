"""What does a node of a graph call, if it does nothing else?"""

from __future__ import annotations

from typing import Any, Final, TypeGuard

from epypes.pipeline import Node, Pipeline
from epypes.run.guard import as_written

# A node may be made to wrap itself; nobody wraps this deep on purpose.
_DEEPEST: Final = 100


def called_by(function: Any) -> Any:
    """Return the function of a node that does nothing else than call it; anything else as it is."""
    for _ in range(_DEEPEST):
        kind = type(function)
        if not isinstance(function, Node) or isinstance(function, Pipeline):
            break
        if kind.compute is not Node.compute or kind.__call__ is not Node.__call__:
            break
        function = as_written(function.func)
    return function


def is_plain_pipeline(function: Any) -> TypeGuard[Pipeline]:
    """Whether this is a pipeline that does nothing else than run its graph."""
    kind = type(function)
    hooks = ("__call__", "compute", "run")
    return isinstance(function, Pipeline) and all(getattr(kind, hook) is getattr(Pipeline, hook) for hook in hooks)
