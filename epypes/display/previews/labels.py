"""How does an image of region numbers look?

The colour of a label depends on nothing but its number, so that a region keeps its colour when others come and go.
"""

from __future__ import annotations

import colorsys
import functools
from typing import TYPE_CHECKING, Any, Final

from epypes.optional import optional_import
from epypes.wording import counted

if TYPE_CHECKING:
    import numpy.typing as npt
    from PIL import Image

    Array = npt.NDArray[Any]

# Byte 0 is black, for label 0; byte 255 is white, for what is negative, as the borders of cv2.watershed.
_COLOURS: Final = 254
_WHITE: Final = 255
_GOLDEN: Final = 0.618033988749895
# Neighbouring numbers get hues far apart, and four numbers in a row differ in brightness, too.
_TONES: Final = ((0.60, 0.95), (0.85, 0.75), (0.45, 1.00), (0.75, 0.88))


@functools.cache
def palette() -> bytes:
    """Return 256 colours of three bytes."""
    colours = bytearray(3)
    for index in range(_COLOURS):
        saturation, brightness = _TONES[index % len(_TONES)]
        colour = colorsys.hsv_to_rgb((0.58 + index * _GOLDEN) % 1.0, saturation, brightness)
        colours += bytes(round(255 * channel) for channel in colour)
    return bytes(colours) + b"\xff\xff\xff"


def label_picture(labels: Array, max_side_px: int | None) -> Image.Image:
    """Return a picture with a palette; made smaller by leaving out pixels, since labels have no mean."""
    import numpy as np

    with optional_import():
        from PIL import Image

    stride = 1 if max_side_px is None else -(-max(labels.shape) // max_side_px)
    kept = labels[::stride, ::stride]
    numbers = np.where(kept > 0, (kept.astype(np.int64) - 1) % _COLOURS + 1, np.where(kept < 0, _WHITE, 0))
    picture = Image.fromarray(np.ascontiguousarray(numbers, dtype=np.uint8)).copy()
    picture.putpalette(palette())
    return picture


def label_text(sample: Array) -> str:
    """Return how many labels there are besides 0."""
    import numpy as np

    positive = sample[sample > 0]
    is_narrow = positive.size > 0 and int(positive.max()) <= 10 * sample.size
    count = int(np.count_nonzero(np.bincount(positive))) if is_narrow else len(np.unique(positive))
    return counted(count, "label")
