"""What does it cost that a bundle's functions are watched for changes of what outlives a call?

The limit is the same bundle with its functions as they are. The first two reach nothing that can change, as most do: of
them the settings of the process alone are compared. In the third every function reads constants in lists, dicts, objects
and caches.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from skimage import data

import epypes as ep
from epypes.bundle.manifest import write_manifest
from epypes.experiment.graph import orb_hyperparameters, stereo_pair
from epypes.run.guard import WATCH
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort

PLAIN = "functions as they are"
_ROUNDS = 60

_COINS = """
import cv2
import numpy as np
from skimage.filters import sobel
from skimage.segmentation import watershed


def smooth(image, side):
    return cv2.medianBlur(image, side)


def flood(image_smooth, lo, hi):
    seeds = np.where(image_smooth > hi, 2, np.where(image_smooth < lo, 1, 0))
    return watershed(sobel(image_smooth), seeds) == 2


def find(mask, area):
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return [outline for outline in outlines if cv2.contourArea(outline) > area]


func_dict = {"smooth": smooth, "flood": flood, "find": find, "count": len}
func_io = {
    "smooth": (("image", "side"), "image_smooth"),
    "flood": (("image_smooth", "lo", "hi"), "mask"),
    "find": (("mask", "area"), "coins"),
    "count": ("coins", "n_coins"),
}
"""
_READING = """
import functools

SIZES = [*range(100)]
TABLE = {name: [1, 2, 3] for name in "abcdefgh"}


class Options:
    def __init__(self):
        self.names, self.shift = ["a", "b"], 0


OPTIONS = Options()


@functools.lru_cache
def shift():
    return SIZES[0] + len(TABLE) - 8 + OPTIONS.shift


def counted(coins):
    return len(coins) + shift()

"""


# What four such calls may cost is 1 % of an event of the coins, some 20 ms.
_CALL = Goal("above", 50_000)


def rows(effort: Effort) -> list[Row]:
    coins = {"side": 5, "lo": 50, "hi": 130, "area": 300}
    orb = "from epypes.experiment.graph import orb_graph\n\ncg = orb_graph()\nfunc_dict, func_io = cg.functions, cg.func_io\n"
    left, right = stereo_pair()
    one, pair = {"image": data.coins()}, {"image_1": left, "image_2": right}
    bundles = (
        ("coins bundle", _COINS, coins, one, "n_coins"),
        ("ORB bundle", orb, orb_hyperparameters(), pair, "matches"),
        ("coins bundle, constants that can change", _reading(), coins, one, "n_coins"),
    )
    trivial = f'{_READING}def f(x):\n    return x + shift()\n\n\nfunc_dict, func_io = {{"f": f}}, {{"f": ("x", "y")}}\n'
    with tempfile.TemporaryDirectory() as folder:
        return [
            *(_row(effort, Path(folder), Goal("ratio", 1.01), *bundle) for bundle in bundles),
            _row(effort, Path(folder), _CALL, "trivial function of such constants", trivial, {}, {"x": 1}, "y"),
        ]


def _reading() -> str:
    """Return the coins' module, with functions that read what could be changed."""
    source = _COINS.replace(
        "    return cv2.medianBlur(image, side)", "    return cv2.medianBlur(image, side + shift())"
    )
    source = source.replace("lo, 1, 0))", "lo, 1, shift()))").replace("> area]", "> area + shift()]")
    return _READING + source.replace('"count": len', '"count": counted')


def _row(
    effort: Effort,
    folder: Path,
    goal: Goal,
    work: str,
    source: str,
    hyperparameters: Mapping[str, Any],
    payload: Mapping[str, Any],
    output: str,
) -> Row:
    bundle = folder / work
    bundle.mkdir()
    (bundle / "pipeline.py").write_text(source)
    inputs = ", ".join(f'"{token}"' for token in payload)
    settings = f'[bundle]\nformat = 1\nname = "b"\n[ports]\ninputs = [{inputs}]\noutputs = ["{output}"]\n'
    (bundle / "pipeline.toml").write_text(settings)
    write_manifest(bundle)
    guarded = ep.load(bundle)
    guarded.freeze(**hyperparameters)
    plain = ep.load(bundle).cg.functions
    watched = [vars(function).pop(WATCH) for function in plain.values() if WATCH in getattr(function, "__dict__", ())]
    runner = ep.CompGraphRunner(ep.CompGraph(plain, guarded.cg.func_io), hyperparameters)
    contenders = {
        PLAIN: lambda: runner.run(**payload)[output],
        OURS: lambda: guarded.run(**payload)[output],
    }
    times = effort.measure(contenders, _ROUNDS, same=False)
    note = f"{len(watched)} of {len(plain)} functions are watched"
    return row(f"{work}: changes watched", times, functions=len(plain), goal=goal, limit=PLAIN, note=note)
