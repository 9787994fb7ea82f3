"""Pictures of a run's tokens that are larger than thumbnails: some kept with the page, all from the kernel of the run.

A saved page has those that matter, at 512 pixels. While the kernel lives, the page asks it for the full picture of the
token that is looked at (``explore.js``), by an execute request over the websocket of Jupyter's server: a page of
JupyterLab has no other way to its kernel that needs neither an extension of the server nor a widget, whose place in a
saved notebook would be an error. Nothing is kept alive for that: a run that was forgotten has no full pictures.
"""

from __future__ import annotations

import re
import secrets
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any, Final
from weakref import WeakKeyDictionary, ref

from epypes.display.previews import THUMBNAIL_PX, Picture, Scene
from epypes.display.previews.drawing import scene_picture
from epypes.display.previews.images import is_mask, one_channel, sampled
from epypes.display.text import KEPT_CHARACTERS
from epypes.display.views.graphview import GraphView, TokenView, has_picture
from epypes.display.views.surroundings import scene_of
from epypes.display.views.tokens import is_locked_array
from epypes.run import CompGraphRunner, Run
from epypes.run.program import Program

_KEPT_PX: Final = 512
# A mask is made smaller by whole numbers; one of 640 x 480 stays as it is.
_KEPT_MASK_PX: Final = 640
_KEPT_BYTES: Final = 28_000
# What a picture of 512 pixels shows in fewer bytes is hardly more than the thumbnail.
_LEAST_BYTES: Final = 6_000
# An image of 1 MP is whole, one of 12 MP is halved.
_FULL_PX: Final = 2_048
_FULL_BYTES: Final = 2_000_000

# What a page names a run by. A kernel that was started again has the same id, but never the same names.
_names: WeakKeyDictionary[Run, str] = WeakKeyDictionary()
# By program and token the last picture that a page keeps, with the image that it is of and its range.
_Made = tuple[Callable[[], Any], tuple[Any, int], Picture]
_made: WeakKeyDictionary[Program, dict[str, _Made]] = WeakKeyDictionary()
_process, _numbers = secrets.token_hex(6), count()


def run_of(shown: Any) -> Run | None:
    """Return the run whose values a graph, a runner, a run, a plan or a pipeline shows; None if there is none."""
    runner = getattr(shown, "runner", shown)
    run = runner.last if isinstance(runner, CompGraphRunner) else runner
    return run if isinstance(run, Run) else None


def kept_pictures(graph: GraphView, run: Run) -> dict[str, Picture]:
    """Return by token the pictures that a page keeps, as far as they fit: of sinks, of sources, then of others."""
    sinks, producer = frozenset(run.cg.sink_tokens), run.cg.digraph.producer
    ranked = sorted(drawn_tokens(graph), key=lambda token: 0 if token.name in sinks else 1 + (token.name in producer))
    left, kept = KEPT_CHARACTERS, dict[str, Picture]()
    for token in ranked:
        most_bytes = min(_KEPT_BYTES, left * 3 // 4)
        if most_bytes < _LEAST_BYTES:
            break
        scene = scene_of(run, token.name)
        if scene is not None and max(scene.backdrop.image.shape[:2]) > THUMBNAIL_PX:
            kept[token.name] = picture = _kept_picture(run, token.name, scene, most_bytes)
            left -= len(picture.uri)
    return kept


def _kept_picture(run: Run, token: str, scene: Scene, most_bytes: int) -> Picture:
    """Return a token's picture for the page; that of an image that nobody can change is made once."""
    made, image = _made.setdefault(run.tokens.program, {}), scene.backdrop.image
    key = (scene.backdrop.ends, most_bytes)
    if token not in made or made[token][0]() is not image or made[token][1] != key:
        side_px = _KEPT_MASK_PX if scene.marks is None and is_mask(one_channel(sampled(image))) else _KEPT_PX
        picture = scene_picture(scene, side_px, most_bytes)
        if scene.marks is not None or not is_locked_array(image):
            return picture
        made[token] = ref(image), key, picture
    return made[token][2]


def drawn_tokens(graph: GraphView) -> list[TokenView]:
    """Return the tokens whose thumbnail is a picture, those inside closed groups included."""
    parts = (graph, *(group.graph for group in graph.groups))
    return [token for part in parts for token in part.tokens if has_picture(token)]


def address_of(run: Run | None) -> str:
    """Return where a page finds a run: this kernel's id, and the run's name; empty outside of Jupyter's kernels."""
    kernels = sys.modules.get("ipykernel.kernelapp")
    if run is None or kernels is None or not kernels.IPKernelApp.initialized():
        return ""
    # Jupyter's server names the file after the kernel.
    kernel = re.fullmatch(r"kernel-([\w-]+)\.json", Path(kernels.IPKernelApp.instance().connection_file).name)
    return f"{kernel[1]}/{_names.setdefault(run, f'{_process}-{next(_numbers)}')}" if kernel else ""


class _Address(str):
    """A text that stands in an answer of the kernel without quotes."""

    __slots__ = ()
    __repr__ = str.__str__


def full_picture(name: str, token: str) -> str:
    """Return a token's picture as a data URI; empty if it has none, or the run with this name is gone."""
    run = next((run for run, each in _names.items() if each == name), None)
    scene = scene_of(run, token) if run is not None and token in run.cg.tokens else None
    return _Address("" if scene is None else scene_picture(scene, _FULL_PX, _FULL_BYTES).uri)
