"""What is to be seen of the tokens of a graph, and which of them get a thumbnail?"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

from epypes.display.previews.preview import preview
from epypes.display.views.graphview import TokenState, TokenView
from epypes.run import Run

# Base64 makes four characters of three bytes; together the thumbnails of one picture take at most this many.
THUMBNAIL_CHARACTERS: Final = 80_000
# More are no overview.
MOST_THUMBNAILS: Final = 24


def token_view(token: TokenView, run: Run, hparams: Mapping[str, Any], stale: frozenset[str]) -> TokenView:
    """Look at a token of a run; functions in ``stale`` are out of date since."""
    if token.name in hparams or not run.tokens.is_computed(token.name):
        return valueless_view(token, hparams, "not computed")
    value = run.tokens.values[run.tokens.program.slots[token.name]]
    is_old = run.cg.digraph.producer.get(token.name) in stale
    return replace(_in_state(token, "stale" if is_old else "fresh"), preview=preview(value, token.order))


def valueless_view(token: TokenView, hparams: Mapping[str, Any], state: TokenState) -> TokenView:
    """Look at a token of which only a hyperparameter's value is known; any other has this state."""
    if token.name not in hparams:
        return _in_state(token, state)
    token = replace(_in_state(token, "fresh"), role="hyperparameter")
    return replace(token, preview=preview(hparams[token.name], token.order))


def _in_state(token: TokenView, state: TokenState) -> TokenView:
    """Return a token in this state, unless it is left out."""
    return token if token.state == "left out" else replace(token, state=state)


def within_budget(
    tokens: list[TokenView], first: Iterable[str], most: int = MOST_THUMBNAILS
) -> tuple[tuple[TokenView, ...], int]:
    """Drop thumbnails until the rest fit, and are ``most``; those of ``first`` are kept longest, then others in order.

    Returns
    -------
    tuple
        The tokens, and how many thumbnails were dropped.
    """
    rank = {name: place for place, name in enumerate(dict.fromkeys(first))}
    spent = dropped = count = 0
    kept: dict[str, TokenView] = {}
    for token in sorted(tokens, key=lambda token: rank.get(token.name, len(rank))):
        picture = token.preview.picture if token.preview else None
        size = len(picture.data) * 4 // 3 + 100 if picture else 0
        if token.preview and picture and (count == most or spent + size > THUMBNAIL_CHARACTERS):
            dropped += 1
            token = replace(token, preview=replace(token.preview, picture=None))
        else:
            spent += size
            count += picture is not None
        kept[token.name] = token
    return tuple(kept[token.name] for token in tokens), dropped
