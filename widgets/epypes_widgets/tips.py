"""What is said about a hyperparameter where the pointer rests on it?"""

from __future__ import annotations

from epypes.graph import CompGraph
from epypes.hints import Param, Roi, Text
from epypes_widgets.ranges import described


def tip(cg: CompGraph, token: str, param: Param | Roi | Text | None) -> str:
    """Return what a hyperparameter is and which values it takes, as plain text."""
    about = param.about if isinstance(param, Param) else ""
    return " ".join(filter(None, (about, described(param) if param is not None else "Shown only.")))
