"""The colours and lines of a picture."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Final

# What a colour is called in the rules below -> what it is on paper, and what it is in a page: the theme of JupyterLab,
# else that of VS Code, else as on paper. Tints are mixed, so they suit any theme, and text is as readable on them as on
# their ground. On paper they are dark text on light shapes between grey edges: readable on white and on black.
_COLOURS: Final = {
    "text": ("#1f2328", "var(--jp-ui-font-color1,var(--vscode-editor-foreground,#1f2328))"),
    "ground": ("#fff", "var(--jp-layout-color1,var(--vscode-editor-background,#fff))"),
    "accent": ("#1769c2", "var(--jp-brand-color1,var(--vscode-textLink-foreground,#1769c2))"),
    "error": ("#cf222e", "var(--jp-error-color1,var(--vscode-errorForeground,#cf222e))"),
    "warn": ("#bc4c00", "var(--jp-warn-color1,var(--vscode-editorWarning-foreground,#bc4c00))"),
    "good": ("#2e7d32", "var(--jp-success-color1,var(--vscode-testing-iconPassed,#2e7d32))"),
    "quiet": ("#525a64", "color-mix(in srgb,@text 82%,@ground)"),
    "line": ("#868e98", "color-mix(in srgb,@text 50%,@ground)"),
    "track": ("#d3dfef", "color-mix(in srgb,@accent 22%,@ground)"),
    "cool": ("#eaf2fc", "color-mix(in srgb,@accent 9%,@ground)"),
    "grey": ("#e6e8eb", "color-mix(in srgb,@text 12%,@ground)"),
    "alarm": ("#fcebec", "color-mix(in srgb,@error 10%,@ground)"),
}

# Selector -> declarations. The rule of a state stands after that of a kind.
_RULES: Final = {
    "": "max-width:100%;height:auto;font:12px var(--jp-ui-font-family,system-ui,sans-serif)",
    " text": "fill:@text;text-anchor:middle;stroke:none",
    " .small": "font-size:10px;fill:@quiet",
    " .name": "font-weight:600",
    " .shape": "fill:@ground;stroke:@line",
    " image": "outline:1px solid @grey",
    " .function .shape": "fill:@cool;stroke:@accent;stroke-width:1.3",
    " .call .shape": "fill:@cool;stroke:@accent;stroke-width:1.3",
    " .hyperparameter .shape": "fill:@grey",
    " .track": "stroke:@track;stroke-width:3;stroke-linecap:round",
    " .bar": "fill:@accent",
    " .planned .shape": "stroke-width:3",
    " .redefined .shape": "stroke:@warn;stroke-width:3",
    " .missing .shape": "stroke:@error;stroke-width:2",
    " .failed .shape": "fill:@alarm;stroke:@error;stroke-width:3",
    " .stale .shape": "fill:@ground;stroke-dasharray:2 3",
    " .not-computed .shape": "stroke-dasharray:2 3",
    " .not-run .shape": "stroke-dasharray:2 3",
    " .left-out .shape": "fill:@ground;stroke:@line;stroke-dasharray:1 4",
    " .left-out text": "fill:@quiet;font-weight:400",
    " .running .shape": "stroke:@good;stroke-width:2.5",
    " .reused .shape": "stroke-dasharray:9 2",
    " .stopped .shape": "stroke-dasharray:2 3",
    " .placeholder .shape": "stroke-dasharray:7 4",
    " .stale image": "opacity:.35",
    " .stale .chart": "opacity:.5",
    " .row": "font:10px ui-monospace,monospace;fill:@quiet;text-anchor:start;white-space:pre",
    " .chart .paper": "fill:@grey;stroke:none",
    " .chart *": "fill:none;stroke:@accent",
    " .chart .dots": "stroke-width:3;stroke-linecap:round",
    " .function .inner": "fill:none;stroke-width:1",
    " .edge": "fill:none;stroke:@line",
    " .dense": "stroke-width:.5",
    " .tip": "fill:@line",
    " .off": "opacity:.6",
    " .edge.off": "stroke-dasharray:4 4",
    " .changed .dot": "fill:@warn",
    " .frame": "fill:none;stroke:@line",
    " .mark": "fill:none;stroke:@line;stroke-width:1.4",
    " .stage .open": "stroke:none",
    " .queue.running .mark": "stroke:@good",
}


def paper_style(scope: str, rules: Mapping[str, str]) -> str:
    """Return rules, by selectors within a scope, with the colours of paper; ``@accent`` stands for a colour."""
    return "".join(f"{scope}{selector}{{{_coloured(declarations)}}}" for selector, declarations in rules.items())


def page_style(scope: str, rules: Mapping[str, str]) -> str:
    """Return of such rules what depends on the theme of a page, for what knows variables and mixes."""
    themed = "".join(
        f"{scope}{selector}{{{';'.join(coloured)}}}"
        for selector, declarations in rules.items()
        if (coloured := [_named(part) for part in declarations.split(";") if "@" in part or "none" in part])
    )
    names = "".join(f"--epypes-{name}:{_named(page)};" for name, (_, page) in _COLOURS.items())
    return f"@supports(color:color-mix(in srgb,red,red)){{{scope},.epypes-sheet{{{names}}}{themed}}}"


def _coloured(declarations: str) -> str:
    return re.sub(r"@(\w+)", lambda name: _COLOURS[name[1]][0], declarations)


def _named(declarations: str) -> str:
    return re.sub(r"@(\w+)", r"var(--epypes-\1)", declarations)


def paper_declarations(path: Sequence[set[str]]) -> dict[str, str]:
    """Return what the rules say of an element on paper: by property, the declaration that counts.

    Parameters
    ----------
    path
        Of the elements that it is in, and of itself, the tag and the classes: ``{"rect", ".shape"}``.
    """
    found: dict[str, str] = {}
    for (*outer, last), declarations in _by_weight():
        around = iter(path[:-1])
        # The last part means the element itself, the others mean elements around it, in this order.
        if last <= path[-1] and all(any(part <= element for element in around) for part in outer):
            found |= declarations
    return found


@cache
def _by_weight() -> list[tuple[list[set[str]], dict[str, str]]]:
    """Return selectors, as the parts that are inside each other, and declarations; those that count more come later."""
    rules = [
        ([set(re.findall(r"\.?[\w-]+", part)) for part in selector.split()], _coloured(declarations))
        for selector, declarations in sorted(_RULES.items(), key=lambda rule: (rule[0].count("."), rule[0].count(" ")))
    ]
    return [(parts, dict(each.split(":", 1) for each in text.split(";"))) for parts, text in rules if parts]


# A viewer that knows no variables skips the second part, and has what stands on paper.
PAGE_STYLE: Final = page_style(".epypes-graph", _RULES)
STYLE: Final = paper_style(".epypes-graph", _RULES) + PAGE_STYLE
