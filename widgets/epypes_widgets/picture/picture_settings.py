"""How the picture of a token is shown: contrast limits, colour map, what it lies over, and how it is enlarged.

These are the view controls of an image tool. Limits are applied in the kernel when a frame is encoded, since the
browser has 8 of 16 bits only; all others in the browser, where they take no time of a run.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from epypes.display import Backdrop
from epypes.display.previews.images import Range, some_of
from epypes.errors import InvalidValue

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

COLOUR_MAPS: Final = ("gray", "inverted", "viridis", "inferno", "turbo", "coolwarm")
ZOOMS: Final = ("auto", "nearest", "smooth")
# Of the pixels, as ImageJ's Auto has it: that many may be black, and as many white.
_SATURATED_PERCENT: Final = 0.35


@dataclass(frozen=True, slots=True)
class PictureSettings:
    """How the picture of a token is shown.

    Attributes
    ----------
    limits
        The values that are shown black and white; None for those of the dtype, or of the token's first image.
    colour_map
        One of ``COLOUR_MAPS``, for an image of one channel.
    over
        The token of an image of the same size that a mask or labels lie over; empty for none.
    opacity
        Of the mask or labels, from 0 to 1.
    zoom
        ``"nearest"`` shows pixels as squares, ``"smooth"`` interpolates, ``"auto"`` shows squares from 300 % on.

    Raises
    ------
    ValueError
        A setting is none of these.
    """

    limits: Range | None = None
    colour_map: str = "gray"
    over: str = ""
    opacity: float = 0.6
    zoom: str = "auto"

    def __post_init__(self) -> None:
        if self.limits is not None:
            object.__setattr__(self, "limits", _checked_limits(self.limits))
        for name, value, known in (("colour_map", self.colour_map, COLOUR_MAPS), ("zoom", self.zoom, ZOOMS)):
            if value not in known:
                raise InvalidValue(f"{name} can't be {value!r:.40}: it is one of {', '.join(known)}.")
        if not isinstance(self.over, str):
            raise InvalidValue(f"over can't be {self.over!r:.40}: it is the name of a token.")
        if type(self.opacity) not in (int, float) or not 0 <= self.opacity <= 1:
            raise InvalidValue(f"opacity can't be {self.opacity!r:.40}: it is a number from 0 to 1.")

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> PictureSettings:
        """Return the settings in a message or a file; ValueError if they are none."""
        known = [field.name for field in fields(cls)]
        unknown = [name for name in content if name not in known]
        if unknown:
            raise InvalidValue(f"{unknown[0]!r:.40} is no setting of a picture. Those are {', '.join(known)}.")
        return cls(**content)

    @property
    def content(self) -> dict[str, Any]:
        """All of them, ready for JSON."""
        return {**asdict(self), "limits": None if self.limits is None else list(self.limits)}

    @property
    def changed(self) -> dict[str, Any]:
        """Those that are not as they are at first, ready for a file."""
        return {name: value for name, value in self.content.items() if value != getattr(_DEFAULTS, name)}


def _checked_limits(given: Any) -> Range:
    try:
        # An integer of a file may be larger than any float; texts and the keys of tables are no numbers.
        low, high = (float(end) if isinstance(end, numbers.Real) else math.nan for end in given)
    except (TypeError, ValueError, OverflowError):
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InvalidValue(f"limits can't be {given!r:.60}: give two numbers, black and white, the lower first.")
    return low, high


_DEFAULTS: Final = PictureSettings()
# By token, of those that have limits.
Limits = Mapping[str, Range]
NO_LIMITS: Final[Limits] = MappingProxyType({})


def within_limits(seen: Backdrop, limits: Limits) -> Backdrop:
    """Return an image as it is shown within the limits of its token."""
    return replace(seen, ends=limits[seen.name]) if seen.name in limits else seen


def auto_limits(image: npt.NDArray[Any]) -> Range | None:
    """Return the limits at which very few pixels are black or white; None if nothing in the image differs."""
    import numpy as np

    values = some_of(image[:, :, :3] if image.ndim == 3 else image).reshape(-1)
    if values.dtype.kind == "b":
        return None
    finite: npt.NDArray[np.floating[Any]] = values[np.isfinite(values)]
    if not finite.size:
        return None
    ends = np.percentile(finite, (_SATURATED_PERCENT, 100 - _SATURATED_PERCENT), method="nearest")
    low, high = (float(end) for end in ends)
    if low == high:
        # Hardly a pixel differs from the others.
        low, high = float(finite.min()), float(finite.max())
    return (low, high) if low < high else None
