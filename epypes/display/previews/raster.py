"""How does an array become the bytes of a JPEG or PNG?

Pillow encodes: it comes with every notebook that has matplotlib, and unlike OpenCV's it has one wheel, so no OpenCV
build is forced on anybody. Three channels are BGR, as in OpenCV, unless the caller
says rgb.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from PIL import Image

    from epypes.images import Order

    Array = npt.NDArray[np.generic]

SMALLEST_SIDE_PX: Final = 8
JPEG_QUALITY: Final = 80
# Above this, values are looked at on a strided sample: what is decided from them does not need every pixel.
_SAMPLE_PX: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class Picture:
    """An encoded picture.

    Attributes
    ----------
    data
        The bytes of the file.
    media_type
        ``"image/jpeg"`` or ``"image/png"``.
    width, height
        Its size, in pixels.
    """

    data: bytes
    media_type: str
    width: int
    height: int


def is_image(value: Any) -> bool:
    """Whether a value can be seen as an image: (y, x), (y, x, 3) or (y, x, 4), at least 8 x 8 pixels."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if not isinstance(shape, tuple) or getattr(dtype, "kind", "") not in ("b", "u", "i", "f"):
        return False
    channels = shape[2] if len(shape) == 3 else 1
    return len(shape) in (2, 3) and channels in (1, 3, 4) and min(shape[:2]) >= SMALLEST_SIDE_PX


def encode_image(array: Array, max_side_px: int | None = None, order: Order = "bgr") -> Picture:
    """Encode an image: masks as 1-bit PNG without loss, pictures with alpha as PNG, all others as JPEG.

    Parameters
    ----------
    array
        An image as ``is_image`` has it; dtype bool, integer or float.
    max_side_px
        The longer side of the result at most; None keeps the size.
    order
        ``"bgr"`` or ``"rgb"``: what three and four channels are.

    Notes
    -----
    Integers of 8 and 16 bits are shown over the range of their dtype, floats within 0..1 over 0..1, all other
    values from their least to their largest.
    """
    image = array[:, :, 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if is_mask(image):
        return _save(_mask_picture(image, max_side_px), "PNG")
    picture = _resized(_pillow(_as_bytes(_strided(image, max_side_px)), order), max_side_px)
    return _save(picture, "PNG" if picture.mode == "RGBA" else "JPEG")


def is_mask(image: Array) -> bool:
    """Whether an image of one channel has two values only: bool, or uint8 of 0 and 255."""
    if image.ndim != 2 or image.dtype.kind not in "bu" or image.dtype.itemsize > 1:
        return False
    if image.dtype.kind == "b":
        return True
    return _has_two_values(sampled(image)) and _has_two_values(image)


def sampled(image: Array) -> Array:
    """Return every n-th row and column, so that at most about a million pixels remain."""
    stride = max(1, round((image.shape[0] * image.shape[1] / _SAMPLE_PX) ** 0.5))
    return image[::stride, ::stride]


def _has_two_values(image: Array) -> bool:
    import numpy as np

    # 0 and 255 are the two values that adding one, within a byte, brings to at most 1.
    return bool(((image.astype(np.uint8, copy=False) + np.uint8(1)) <= 1).all())


def _strided(image: Array, max_side_px: int | None) -> Array:
    """Drop rows and columns down to twice the wanted size: averaging all of them costs most of the time."""
    if max_side_px is None:
        return image
    stride = max(1, max(image.shape[:2]) // (2 * max_side_px))
    return image[::stride, ::stride]


def _as_bytes(image: Array) -> npt.NDArray[np.uint8]:
    import numpy as np

    if image.dtype == np.uint8:
        return np.ascontiguousarray(image, dtype=np.uint8)
    if image.dtype == np.uint16:
        return np.ascontiguousarray(np.right_shift(image, 8), dtype=np.uint8)
    values = image.astype(np.float32)
    low, high = _display_range(values)
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = (values - low) * (255.0 / (high - low))
    return np.ascontiguousarray(np.nan_to_num(scaled, nan=0.0).clip(0, 255), dtype=np.uint8)


def _display_range(values: npt.NDArray[np.float32]) -> tuple[float, float]:
    import numpy as np

    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    if low >= 0.0 and high <= 1.0:
        return 0.0, 1.0
    return low, high if high > low else low + 1.0


def _pillow(image: npt.NDArray[np.uint8], order: Order) -> Image.Image:
    from PIL import Image

    size = (image.shape[1], image.shape[0])
    if image.ndim == 2:
        return Image.frombuffer("L", size, image, "raw", "L", 0, 1)
    if image.shape[2] == 3:
        return Image.frombuffer("RGB", size, image, "raw", order.upper(), 0, 1)
    return Image.frombuffer("RGBA", size, image, "raw", f"{order.upper()}A", 0, 1)


def _resized(picture: Image.Image, max_side_px: int | None) -> Image.Image:
    if max_side_px is None or max(picture.size) <= max_side_px:
        return picture
    from PIL import Image

    scale = max_side_px / max(picture.size)
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    return picture.resize(size, Image.Resampling.BOX)


def _mask_picture(mask: Array, max_side_px: int | None) -> Image.Image:
    """Shrink by maximum: thin lines averaged over their black surroundings would vanish."""
    import numpy as np
    from PIL import Image

    white: npt.NDArray[np.bool_] = mask.astype(bool, copy=False)
    pool = 1 if max_side_px is None else -(-max(white.shape) // max_side_px)
    if pool > 1:
        rows, columns = -(-white.shape[0] // pool), -(-white.shape[1] // pool)
        padded = np.zeros((rows * pool, columns * pool), dtype=bool)
        padded[: white.shape[0], : white.shape[1]] = white
        white = np.asarray(padded.reshape(rows, pool, columns, pool).any(axis=(1, 3)))
    return Image.fromarray(np.ascontiguousarray(white)).convert("1")


def _save(picture: Image.Image, kind: str) -> Picture:
    stream = io.BytesIO()
    if kind == "JPEG":
        picture.save(stream, kind, quality=JPEG_QUALITY)
    else:
        picture.save(stream, kind, compress_level=1)
    return Picture(stream.getvalue(), f"image/{kind.lower()}", picture.width, picture.height)
