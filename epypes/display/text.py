"""How does a graph look where nothing but text can be shown?"""

from __future__ import annotations

from epypes.display.view import GraphView, duration_text

_MOST_LINES = 40


def paint_text(graph: GraphView) -> str:
    """Paint a graph as one line per function, in run order: ``canny(image_blurred, canny_lo, canny_hi) -> edges``."""
    lines = []
    for (inputs, outputs), function in zip(graph.io(), graph.functions[:_MOST_LINES], strict=False):
        line = f"{function.name}({', '.join(inputs)}) -> {', '.join(outputs) or 'nothing'}"
        if function.duration_ns is not None:
            line += f"  [{duration_text(function.duration_ns)}]"
        lines.append(f"{line}  {function.message}".rstrip())
    if len(graph.functions) > _MOST_LINES:
        lines.append(f"... and {len(graph.functions) - _MOST_LINES} functions more")
    values = [
        f"{token.name} = {token.preview.text}"
        for token in graph.tokens
        if token.role == "hyperparameter" and token.preview
    ]
    return "\n".join(lines + (["with " + ", ".join(values[:_MOST_LINES])] if values else []))
