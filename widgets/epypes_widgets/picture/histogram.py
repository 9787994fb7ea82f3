"""The histogram of an image: how often it has which value; of labels, how many there are and how large they are.

Bins are counted from the value ``low`` to the value ``high``, both included: bin i holds what is nearest to
``low + i * (high - low) / (bins - 1)``. What lies beyond, as it may in an image whose display range was kept, is in
the first and the last bin; what is not a number is in none.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from epypes.display import Backdrop, is_image, scene_of
from epypes.display.previews.images import image_kind, label_areas, label_text, one_channel, sampled
from epypes.display.previews.introspection import silent_numpy
from epypes.run import Run
from epypes_widgets.picture.picture_settings import NO_LIMITS, Limits, within_limits

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Array = npt.NDArray[Any]

_BINS: Final = 256
# To count more takes longer than a picture may wait, and the shape is the same.
MOST_PX: Final = 262_144
_COLOURS: Final = {"bgr": "BGR", "rgb": "RGB"}


def histogram_of(run: Run, token: str, limits: Limits = NO_LIMITS) -> dict[str, Any] | None:
    """Return the histogram of a token that is an image and up to date, within its limits; None of any other."""
    is_shown = is_image(run.tokens.values[run.tokens.program.slots[token]])
    scene = scene_of(run, token) if is_shown else None
    return None if scene is None else histogram(within_limits(scene.backdrop, limits))


def histogram(seen: Backdrop) -> dict[str, Any]:
    """Return how often which value is in an image, ready for JSON.

    Parameters
    ----------
    seen
        The image, at most so many pixels of which are counted: evenly spread ones. Masks are counted whole, labels
        up to 1 MP.

    Returns
    -------
    dict
        ``low`` and ``high``: the values of the first and of the last bin; ``bins``: how many there are: one for each
        value of bytes and masks, else at most 256 over the display range; ``channels``: ``name`` and ``counts`` of each
        but alpha; ``sampled``: whether not all pixels were counted; ``labels``: of labels how many there are, and how
        large; ``counts`` are then their areas in pixels, the largest first, of very many evenly chosen ones.
    """
    image = one_channel(seen.image)
    kind = image_kind(image, few := sampled(image))
    if kind == "mask":
        return _of_mask(image)
    if kind == "labels":
        return _of_labels(few, image.size)
    stride = max(1, math.ceil(math.sqrt(image.shape[0] * image.shape[1] / MOST_PX)))
    sample = image[::stride, ::stride]
    with silent_numpy():
        low, high = seen.ends
        if sample.dtype.kind in "bui":
            low, high = int(low), int(high)
        bins = _bins(sample, low, high)
        channels = [sample] if sample.ndim == 2 else [sample[:, :, place] for place in range(3)]
        counts = [_counted(channel, low, high, bins).tolist() for channel in channels]
    names = ["gray"] if sample.ndim == 2 else list(_COLOURS[seen.order])
    return _plain(low, high, dict(zip(names, counts, strict=True)), sample.shape != image.shape)


def _plain(low: float, high: float, channels: dict[str, list[int]], is_sampled: bool) -> dict[str, Any]:
    return {
        "low": low,
        "high": high,
        "bins": max(map(len, channels.values())),
        "channels": [{"name": name, "counts": counts} for name, counts in channels.items()],
        "sampled": is_sampled,
    }


def _of_mask(mask: Array) -> dict[str, Any]:
    import numpy as np

    set_px = int(np.count_nonzero(mask))
    # A mask without any pixel set does not tell what would be set: in OpenCV that is 255.
    white = 1 if mask.dtype.kind == "b" or (set_px and int(mask.max()) == 1) else 255
    return _plain(0, white, {"gray": [mask.size - set_px, set_px]}, False)


def _of_labels(labels: Array, pixels: int) -> dict[str, Any]:
    import numpy as np

    areas = label_areas(labels, pixels)
    kept = areas[np.linspace(0, max(len(areas) - 1, 0), min(len(areas), _BINS)).astype(np.intp)].tolist()
    background = np.count_nonzero(labels == 0) / labels.size
    is_sample = labels.size < pixels
    text = f"{label_text(areas, is_sample=is_sample)}; background {background:.0%}"
    return {**_plain(1, max(len(areas), 1), {"areas": kept}, is_sample), "labels": text}


def _bins(sample: Array, low: float, high: float) -> int:
    if sample.dtype.kind == "f":
        return _BINS
    return min(int(high) - int(low) + 1, _BINS)


def _counted(channel: Array, low: float, high: float, bins: int) -> npt.NDArray[np.intp]:
    import numpy as np

    if channel.dtype.str[1:] == "u1" and (low, high) == (0, bins - 1):
        return np.bincount(channel.reshape(-1), minlength=bins)
    is_wide = channel.dtype.itemsize > 2 + 2 * (channel.dtype.kind == "f")
    values: npt.NDArray[np.floating[Any]] = channel.reshape(-1).astype(np.float64 if is_wide else np.float32)
    if channel.dtype.kind == "f":
        values = values[~np.isnan(values)]
    # Halves, since the two ends may be further apart than the largest float.
    span = high / 2 - low / 2
    places = (values / 2 - low / 2) * ((bins - 1) / span) if span > 0 and bins > 1 else np.zeros_like(values)
    # Of very small spans the factor is infinite, and the lowest value then nowhere.
    nearest = np.nan_to_num(places, nan=0.0).clip(0, bins - 1).round().astype(np.intp)
    return np.bincount(nearest, minlength=bins)
