"""Why can't this be run, and what is the way out?"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from epypes.errors import NotComputed, PayloadError, UnknownName, run_call

if TYPE_CHECKING:
    from epypes.graph import CompGraph


def nothing_run(free: tuple[str, ...]) -> PayloadError:
    """Return the error of who wants to go on from a run that there has not been."""
    return PayloadError(free, f"Nothing has been run yet, so there is no payload. Call {run_call(free)} first.")


def nothing_computed(token: str, free: Iterable[str]) -> NotComputed:
    """Return the error of who reads a token before there was a run."""
    text = f"Token {token!r} has not been computed: nothing has been run. Call {run_call(free)}."
    return NotComputed(token, text)


def wrong_payload(cg: CompGraph, token: str, free: Iterable[str]) -> Exception:
    """Return the error that says why this token can't be given to ``run``."""
    if token not in cg.tokens:
        return UnknownName("token", token, free)
    maker = cg.digraph.producer.get(token)
    if maker is not None:
        text = f"Token {token!r} is made by function {maker!r}; run() takes free source tokens only."
    else:
        text = f"Token {token!r} is a hyperparameter. Set runner[{token!r}], or call unfreeze({token!r})."
    return PayloadError((token,), text)


def require_targets(cg: CompGraph, targets: Sequence[object], free: tuple[str, ...]) -> None:
    """Raise unless all of these are names of tokens."""
    for token in targets:
        if not isinstance(token, str):
            kind = type(token).__name__
            text = f"A target is the name of a token, not {kind!r}. Payload goes by name: {run_call(free)}."
            raise PayloadError(free, text)
        cg.require_token(token)
