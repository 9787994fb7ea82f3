"""How do numbers become lines, bars and points between 0 and 1?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews.shown import Chart
from epypes.display.previews.statistics import some_of

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Floats = npt.NDArray[np.float64]

MOST_POINTS: Final = 128
MOST_LINES: Final = MOST_POINTS // 4
_BINS: Final = MOST_POINTS // 2
# Of the frame that a chart is painted into.
_ASPECT: Final = 4 / 3


def line_chart(values: Any) -> Chart:
    """Draw a signal; of a long one the least and the largest value of each part, so that no peak is lost."""
    import numpy as np

    signal = _finite_or_nan(values)
    if signal.size > MOST_POINTS:
        parts = np.array_split(signal, _BINS)
        signal = np.array([end for part in parts for end in _ends(part)])
    x = np.linspace(0.0, 1.0, max(signal.size, 2))[: signal.size]
    kept = np.isfinite(signal)
    return Chart("line", (_pairs(x[kept], _scaled(signal[kept])),))


def bar_chart(counts: Any) -> Chart:
    """Draw a histogram; of many bins several are added up to one bar."""
    import numpy as np

    bars = np.nan_to_num(_finite_or_nan(counts), nan=0.0)
    if bars.size > _BINS:
        bars = np.array([part.sum() for part in np.array_split(bars, _BINS)])
    largest = float(np.abs(bars).max(initial=0.0)) or 1.0
    x = (np.arange(bars.size) + 0.5) / max(bars.size, 1)
    return Chart("bars", (_pairs(x, np.clip(bars / largest, 0.0, 1.0)),))


def place_chart(points: Floats, lines: tuple[Floats, ...]) -> Chart:
    """Draw places of an image without the image: in their own extent, both axes alike, y downwards."""
    import numpy as np

    series = _shortened(lines) if lines else (points[spread(len(points), MOST_POINTS)],)
    every = np.concatenate([*series, np.empty((0, 2))])
    if not len(every):
        return Chart("points", ())
    low, high = every.min(axis=0), every.max(axis=0)
    size = max(float(high[0] - low[0]) / _ASPECT, float(high[1] - low[1])) or 1.0
    middle = (low + high) / 2
    placed = []
    for places in series:
        x = 0.5 + (places[:, 0] - middle[0]) / (size * _ASPECT)
        y = 0.5 - (places[:, 1] - middle[1]) / size
        placed.append(_pairs(x, y))
    return Chart("line" if lines else "points", tuple(placed))


def spread(count: int, most: int) -> npt.NDArray[np.intp]:
    """Return the indices of some of so many, from the first to the last."""
    import numpy as np

    return np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.intp)


def drawn_in_chart(points: int, lines: int) -> int:
    """Return how many of so many lines, or without lines of so many points, a chart has."""
    return min(lines, MOST_LINES) or min(points, MOST_POINTS)


def _shortened(lines: tuple[Floats, ...]) -> tuple[Floats, ...]:
    """Return the longest of many lines, each with every n-th of its points."""
    longest = sorted(lines, key=len, reverse=True)[:MOST_LINES]
    most = MOST_POINTS // len(longest)
    return tuple(line[:: -(-len(line) // most)] for line in longest)


def _finite_or_nan(values: Any) -> Floats:
    """Return values as floats; of very many every n-th."""
    import numpy as np

    flat = some_of(values).reshape(-1).astype(np.float64)
    return np.where(np.isfinite(flat), flat, np.nan)


def _ends(part: Floats) -> tuple[float, float]:
    import numpy as np

    finite = part[np.isfinite(part)]
    if not finite.size:
        return np.nan, np.nan
    low, high = int(finite.argmin()), int(finite.argmax())
    first, last = sorted((low, high))
    return float(finite[first]), float(finite[last])


def _scaled(values: Floats) -> Floats:
    """Return values between 0 and 1; of a constant, the middle."""
    import numpy as np

    if not values.size:
        return values
    low, high = values.min() / 2, values.max() / 2
    return (values / 2 - low) / (high - low) if high > low else np.full_like(values, 0.5)


def _pairs(x: Floats, y: Floats) -> tuple[tuple[float, float], ...]:
    return tuple((round(float(a), 4), round(float(b), 4)) for a, b in zip(x, y, strict=True))
