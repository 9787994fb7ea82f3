"""What may a number be that is called like this, whatever function takes it?

A name says less than a function: these ranges are careful, and a name that means several things says nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from epypes.catalog.entry import Entry
from epypes.catalog.lookup import TABLE
from epypes.hints import Param

_ODD: Final = (Param(1, soft=(1, 31), odd=True, unit="px"),)
_WINDOW: Final = (Param(1, soft=(1, 101), odd=True, unit="px"),)
_SIGMA: Final = (Param(0.0, soft=(0.0, 10.0), unit="px"),)
_LENGTH: Final = (Param(0, soft=(0, 100), unit="px"),)
_AREA: Final = (Param(0, soft=(0, 5000), unit="px²"),)
_LEVEL: Final = (Param(0.0, soft=(0.0, 1.0)), Param(0, soft=(0, 255)))
_WEIGHT: Final = (Param(0.0, soft=(0.0, 1.0)), Param(0.0, soft=(0.0, 5.0)))
_DEGREES: Final = (Param(soft=(-180.0, 180.0), step=0.5, unit="deg"),)

# Of several, the first whose usual values hold the present one is taken. Written without what parts their words.
_COMMON: Final[dict[str, tuple[Param, ...]]] = {
    "ksize": _ODD, "kernelsize": _ODD, "kernel": _ODD, "blurkernel": _ODD, "aperture": _ODD,
    "blocksize": _WINDOW, "windowsize": _WINDOW, "winsize": _WINDOW, "window": _WINDOW,
    "sigma": _SIGMA, "sigmax": _SIGMA, "sigmay": _SIGMA, "minsigma": _SIGMA, "maxsigma": _SIGMA,
    "sigmacolor": (Param(0.0, soft=(0.0, 1.0)), Param(0, soft=(0, 200))),
    "radius": _LENGTH, "minradius": _LENGTH, "maxradius": _LENGTH, "distance": _LENGTH, "mindistance": _LENGTH,
    "mindist": _LENGTH, "maxdistance": _LENGTH, "padding": _LENGTH, "margin": _LENGTH,
    "area": _AREA, "minarea": _AREA, "maxarea": _AREA, "minsize": _AREA, "maxsize": _AREA,
    "iterations": (Param(0, soft=(0, 20)),), "iters": (Param(0, soft=(0, 20)),),
    "gamma": (Param(0.0, soft=(0.0, 5.0), step=0.05),),
    "alpha": _WEIGHT, "weight": _WEIGHT, "gain": (Param(0.0, soft=(0.0, 5.0)), Param(0.0, soft=(0.0, 30.0))),
    "threshold": _LEVEL, "thresh": _LEVEL, "level": _LEVEL, "cutoff": _LEVEL, "lowthreshold": _LEVEL,
    "highthreshold": _LEVEL, "threshold1": (Param(0, soft=(0, 500)),), "threshold2": (Param(0, soft=(0, 500)),),
    "scale": (Param(0.0, soft=(0.05, 4.0)), Param(0.0, soft=(0.0, 1000.0))),
    "angle": _DEGREES,
    "cliplimit": (Param(0.0, soft=(0.0, 0.1)), Param(0.0, soft=(0.0, 40.0))),
    "connectivity": (Param(choices=(4, 8)), Param(choices=(1, 2))),
    "quality": (Param(0.0, soft=(0.0, 1.0)), Param(0, soft=(0, 100))),
}  # fmt: skip

# In the table, and common words with other meanings too.
_VAGUE: Final = frozenset((
    "type", "mode", "method", "flags", "code", "shape", "order", "delta", "distance", "level", "levels", "left",
    "right", "top", "bottom", "high", "low", "scale", "theta", "offset", "beta", "ratio", "weight", "history",
    "amount", "closed", "strength", "truncate", "bandwidth", "rotation", "resize", "classes", "attempts",
    "frequency", "compactness", "tolerance", "overlap",
))  # fmt: skip
_SHORTEST: Final = 3


def _by_name() -> Mapping[str, tuple[Entry, ...]]:
    """Return the entries by the parameter's name: ``blockSize`` and ``block_size`` are one."""
    found: dict[str, tuple[Entry, ...]] = {}
    for entry in TABLE:
        name = entry.parameter.replace("_", "").lower()
        if len(name) >= _SHORTEST and name not in _VAGUE:
            found[name] = (*found.get(name, ()), entry)
    return found


_BY_NAME: Final = _by_name()


def usual(name: str, value: float | str) -> Param | None:
    """Return the usual values of a parameter of this name; None if nothing fits.

    Parameters
    ----------
    name
        A parameter, or a token: of ``blur_sigma_1`` its last words count too.
    value
        What it is now. A range that does not hold it is not returned.
    """
    for known in _bare_names(name):
        found = _first_fitting(_COMMON.get(known, ()), value) or _agreed(known, value)
        if found is not None:
            return found
    return None


def _bare_names(name: str) -> list[str]:
    """Return a name without what parts its words, then its last two words and its last one."""
    words = [word.lower() for word in re.findall(r"[A-Z]*[a-z]+\d*|[A-Z]+\d*|\d+", name)]
    while len(words) > 1 and words[-1].isdigit():
        words.pop()  # the suffix of one of several graphs
    return list(dict.fromkeys(("".join(words), "".join(words[-2:]), "".join(words[-1:]))))


def _first_fitting(params: Sequence[Param], value: Any) -> Param | None:
    fitting = [param for param in map(_for_kind_of(value), params) if _allows(param, value)]
    return next((param for param in fitting if _is_usual(param, value)), fitting[-1] if fitting else None)


def _for_kind_of(value: Any) -> Any:
    """Return what makes whole ends of a range for a whole number: by its name alone, it may be used as an index."""

    def fitted(param: Param) -> Param:
        if not isinstance(value, int) or param.choices is not None or param.soft is None or param.soft[1] <= 1:
            return param
        low, high = (None if end is None else int(end) for end in (param.low, param.high))
        soft = (int(param.soft[0]), int(param.soft[1]))
        return replace(param, low=low, high=high, soft=soft, step=None if (param.step or 1) < 1 else param.step)

    return fitted


def _is_usual(param: Param, value: Any) -> bool:
    if param.choices is not None or param.soft is None:
        return True
    if isinstance(value, int) and param.soft[1] <= 1:
        return False  # a whole number is no share
    return bool(param.soft[0] <= value <= param.soft[1])


def _allows(param: Param, value: Any) -> bool:
    if param.choices is not None and isinstance(value, bool) != isinstance(param.choices[0], bool):
        return False  # 1 equals True
    if isinstance(value, str | bool) and param.choices is None:
        return False
    return param.allows(value) and (isinstance(value, int) or not param.odd)


def _agreed(name: str, value: Any) -> Param | None:
    """Return what all entries of a name say, if it is the same."""
    params = [entry.resolved() for entry in _BY_NAME.get(name, ())]
    first = params[0] if params else None
    if first is None or any(param is None or _plain(param) != _plain(first) for param in params):
        return None
    return _first_fitting((first,), value)


def _plain(param: Param) -> Param:
    return replace(param, about="", unit="")
