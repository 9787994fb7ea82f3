"""How does a graph read as one straight-line function?"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain

from epypes.bundle.branches import Placement, Region
from epypes.bundle.lines import (
    LINE,
    Group,
    Piece,
    assignment,
    call,
    condition,
    fits,
    laid_out,
    piece_of,
    prefixed,
    quoted,
)
from epypes.bundle.words import words_of
from epypes.graph import CompGraph

_SHOWN = 40


@dataclass(frozen=True, slots=True)
class Straight:
    """A graph with all that is needed to write it.

    Attributes
    ----------
    name
        What the function is called.
    cg
        The graph.
    placement
        Which functions are written, and where.
    returns
        The tokens that the function returns.
    references
        By function, the expression that refers to it.
    defaults
        By hyperparameter, the expression of its value.
    keys
        By function of a switch, the expressions of its selector's values, by value.
    is_pipeline
        Whether a function of another graph is written, which returns a value even if there is no token to return.
    """

    name: str
    cg: CompGraph
    placement: Placement
    returns: tuple[str, ...]
    references: Mapping[str, str]
    defaults: Mapping[str, str]
    keys: Mapping[str, Mapping[object, str]]
    is_pipeline: bool


def emit_function(straight: Straight) -> str:
    """Write the function."""
    words = words_of(straight.placement.tokens, _hidden_by(straight).__contains__)
    sources = [token for token in straight.cg.source_tokens if token in words]
    free = [token for token in sources if token not in straight.defaults]
    given = [token for token in sources if token in straight.defaults]
    from_outside: list[Piece] = [words[token] for token in free]
    named = [prefixed(f"{words[token]}=", piece_of(straight.defaults[token])) for token in given]
    signature = call(f"def {straight.name}", [*from_outside, *["*"][: len(named)], *named])
    lines = [*laid_out(signature, 0, ":"), *_docstring(straight, [*sources, *straight.returns], words)]
    lines += _Body(straight, words).region(straight.placement.root, 1)
    return "\n".join([*lines, *_return(straight, words)])


def _hidden_by(straight: Straight) -> set[str]:
    """Return the names of the module that the function uses: a variable of that name would hide them."""
    keys = chain.from_iterable(values.values() for values in straight.keys.values())
    sources = [*straight.references.values(), *(key for key in keys if not key.startswith(("'", '"')))]
    tops = {source.partition(".")[0].partition("(")[0] for source in sources}
    return {*tops, "ValueError"} if straight.placement.branches else tops


class _Body:
    """Writes the functions of a region, and of the branches in it."""

    def __init__(self, straight: Straight, words: Mapping[str, str]) -> None:
        self.straight, self.words = straight, words

    def region(self, region: Region, depth: int) -> list[str]:
        cg, words, lines = self.straight.cg, self.words, list[str]()
        for name in region.functions:
            if name in self.straight.placement.branches:
                lines += self._switch(name, depth)
                continue
            called = call(self.straight.references[name], [words[token] for token in cg.func_inputs(name)])
            targets = [words[token] for token in cg.func_outputs(name)]
            lines += assignment(targets, cg.has_single_output(name), called, depth)
        return lines

    def _switch(self, name: str, depth: int) -> list[str]:
        cg, words, keyword, lines = self.straight.cg, self.words, "if", list[str]()
        selector = words[cg.func_inputs(name)[0]]
        for branch in self.straight.placement.branches[name]:
            operator, right = _test([self.straight.keys[name][key] for key in branch.keys])
            lines += condition(keyword, selector, operator, right, depth)
            body = self.region(branch, depth + 1)
            targets = [words[token] for token in cg.func_outputs(name)]
            if targets:
                body += assignment(targets, cg.has_single_output(name), words[branch.token], depth + 1)
            lines += body or laid_out("pass", depth + 1)
            keyword = "elif"
        refusal = call("raise ValueError", [f'f"Unknown {selector}: {{{selector}!r}}"'])
        return [*lines, *laid_out("else:", depth), *laid_out(refusal, depth + 1)]


def _test(keys: list[str]) -> tuple[str, Piece]:
    """Return how a selector is compared; as style checkers want it for None, True and False."""
    if len(keys) == 1 and keys[0] not in ("True", "False"):
        return ("is" if keys[0] == "None" else "=="), piece_of(keys[0])
    return "in", Group("(", tuple(map(piece_of, keys)), ")", is_display=True)


def _return(straight: Straight, words: Mapping[str, str]) -> list[str]:
    returned = [words[token] for token in straight.returns]
    if not returned:
        return laid_out("return ()", 1) if straight.is_pipeline else []
    whole = f"return {', '.join(returned)}"
    if len(returned) == 1 or fits(1, whole):
        return laid_out(whole, 1)
    return laid_out(Group("return (", tuple(returned), ")", is_display=True), 1)


def _docstring(straight: Straight, shown: Iterable[str], words: Mapping[str, str]) -> list[str]:
    """Write what is returned, and which parameters and results are called otherwise than their tokens."""
    summary = f"Return {', '.join(words[token] for token in straight.returns)}." if straight.returns else "Run."
    if not fits(1, f'"""{summary}"""'):
        summary = f"Return {len(straight.returns)} values." if len(straight.returns) > 1 else "Return the result."
    other = [f"{words[token]} is {_shown(token)}" for token in dict.fromkeys(shown) if words[token] != token]
    if not other:
        return laid_out(f'"""{summary}"""', 1)
    text = f"In the graph {', '.join(other)}."
    # Half as many characters where they may be twice as wide.
    wrapped = textwrap.wrap(text, (LINE - 4) // (1 if text.isascii() else 2), break_on_hyphens=False)
    return [f'    """{summary}', "", *(f"    {line.strip()}" for line in wrapped), '    """']


def _shown(token: str) -> str:
    """Return a token as it may stand in a docstring, whatever it holds."""
    plain = "".join(character if character.isprintable() and character != "\\" else "?" for character in token)
    return quoted((plain if len(plain) <= _SHOWN else f"{plain[: _SHOWN - 3]}...").replace('"', "?")).replace('"', "'")
