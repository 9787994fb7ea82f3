"""Arrays as the bytes of a JPEG or PNG.

Pillow encodes: it comes with every notebook that has matplotlib, and unlike OpenCV's it has one wheel, so no OpenCV
build is forced on anybody. Masks are packed here: Pillow takes five times as long, and a mask of 1 MP is written ten
times while a slider is dragged for a moment. Three channels are BGR, as in OpenCV, unless the caller says rgb.
"""

from __future__ import annotations

import colorsys
import functools
import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews import THUMBNAIL_BYTES, THUMBNAIL_PX, Picture
from epypes.display.previews.images import Range, display_range, image_kind, is_mask, one_channel, sampled
from epypes.display.previews.introspection import silent_numpy
from epypes.optional import LazyModule

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from PIL import Image

    from epypes.display.previews import Array
    from epypes.images import Order
else:
    np, Image = LazyModule("numpy"), LazyModule("PIL.Image")

JPEG_QUALITY: Final = 80
_QUALITIES: Final = (68, 55, 42)
_COLOURS: Final = 48
_LEAST_SIDE_PX: Final = 16
_MOST_LEVELS: Final = 2**16


def encode_image(
    array: Array,
    max_side_px: int | None = None,
    order: Order = "bgr",
    ends: Range | None = None,
    most_bytes: int | None = None,
) -> Picture:
    """Encode an image: masks as 1-bit PNG without loss, labels as PNG with a palette, all others as JPEG.

    Pictures with alpha become PNG.

    Parameters
    ----------
    array
        An image as ``is_image`` has it; dtype bool, integer or float.
    max_side_px
        The longer side of the result at most; None keeps the size.
    order
        ``"bgr"`` or ``"rgb"``: what three and four channels are.
    ends
        The values that are shown black and white; None takes those of ``display_range``.
    most_bytes
        The size of the file at most: at a lower quality if need be, then smaller. None for as many as it takes.
    """
    with silent_numpy():
        sample = sampled(array)
        kind = image_kind(array, sample)
        if kind == "mask" and sample is not array and not is_mask(one_channel(array)):
            kind = "photograph"
        if kind == "mask" and most_bytes is None and not _is_thumbnail(array, max_side_px):
            bits = _mask_bits(one_channel(array), max_side_px)
            return Picture(bitmap_png(bits), "image/png", bits.shape[1], bits.shape[0], kind)
        picture = pillow_image(array, max_side_px, order, ends, kind)
        return replace(_save(picture) if most_bytes is None else encode_small(picture, most_bytes), kind=kind)


def pillow_image(array: Array, max_side_px: int | None, order: Order, ends: Range | None, kind: str) -> Image.Image:
    """Return an image of this kind as a picture that is not encoded yet."""
    image = one_channel(array)
    if kind == "mask":
        is_small = max_side_px is not None and _is_thumbnail(image, max_side_px)
        return _mask_thumbnail(image, max_side_px) if is_small and max_side_px else _mask_picture(image, max_side_px)
    if kind == "labels":
        return label_picture(image, max_side_px)
    black_to_white = display_range(image) if ends is None else ends
    return _resized(_pillow(_as_bytes(_strided(image, max_side_px), black_to_white), order), max_side_px)


def encode_small(picture: Image.Image, most_bytes: int = THUMBNAIL_BYTES, *, has_small_marks: bool = False) -> Picture:
    """Encode a thumbnail within so many bytes: at a lower quality if need be, then smaller.

    JPEG has colours at half the size, which makes small marks grey, unless they are known to be there.
    """
    encoded = _save(picture, full_colours=has_small_marks)
    for attempt, quality in _attempts(picture):
        if len(encoded.data) <= most_bytes:
            break
        encoded = _save(attempt, quality, full_colours=has_small_marks)
    return encoded


def _attempts(picture: Image.Image) -> Iterator[tuple[Image.Image, int]]:
    """Yield pictures of ever fewer bytes, with the quality of their JPEG."""
    sharp = Image.Resampling.NEAREST if picture.mode in ("1", "P") else Image.Resampling.BOX
    if picture.mode in ("L", "RGB"):
        for quality in _QUALITIES:
            yield picture, quality
    small = picture
    while max(small.size) * 3 // 4 >= _LEAST_SIDE_PX:
        if picture.mode == "RGBA":
            yield small.quantize(_COLOURS, Image.Quantize.FASTOCTREE), 0
        small = picture.resize((max(1, small.width * 3 // 4), max(1, small.height * 3 // 4)), sharp)
        yield small, _QUALITIES[-1]


def _strided(image: Array, max_side_px: int | None) -> Array:
    """Drop rows and columns down to twice the wanted size: averaging all of them costs most of the time."""
    if max_side_px is None:
        return image
    stride = max(1, max(image.shape[:2]) // (2 * max_side_px))
    return image[::stride, ::stride]


def _as_bytes(image: Array, ends: Range) -> npt.NDArray[np.uint8]:
    """Return an image whose bytes 0 and 255 stand for the two ends; what lies outside of them is clipped."""
    low, high = ends
    if image.dtype == np.uint8 and ends == (0.0, 255.0):
        return np.ascontiguousarray(image, dtype=np.uint8)
    if image.dtype == np.uint16 and low == 0.0 and high >= 255.0 and (int(high) & (int(high) + 1)) == 0:
        bits = int(high).bit_length()
        return np.ascontiguousarray(np.right_shift(np.minimum(image, np.uint16(high)), bits - 8), dtype=np.uint8)
    levels = 2 ** (8 * image.dtype.itemsize)
    if image.dtype.kind == "u" and levels <= _MOST_LEVELS and image.size > levels:
        # Of each level once: a photograph has many more pixels.
        return _as_bytes(np.arange(levels, dtype=image.dtype), ends)[image]
    is_wide = image.dtype.itemsize > 4 or (image.dtype.kind in "iu" and image.dtype.itemsize == 4)
    values: npt.NDArray[np.floating[Any]] = image.astype(np.float64 if is_wide else np.float32)
    # Halves, since the two ends may be further apart than the largest float.
    scaled = (values / 2 - low / 2) * (255.0 / max(high / 2 - low / 2, 5e-324))
    return np.ascontiguousarray(np.nan_to_num(scaled, nan=0.0).clip(0, 255), dtype=np.uint8)


def _pillow(image: npt.NDArray[np.uint8], order: Order) -> Image.Image:
    mode = "L" if image.ndim == 2 else "RGB" if image.shape[2] == 3 else "RGBA"
    raw = "L" if mode == "L" else f"{order.upper()}{mode[3:]}"
    return Image.frombuffer(mode, image.shape[1::-1], image, "raw", raw, 0, 1)


def _resized(picture: Image.Image, max_side_px: int | None) -> Image.Image:
    if max_side_px is None or max(picture.size) <= max_side_px:
        return picture
    scale = max_side_px / max(picture.size)
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    return picture.resize(size, Image.Resampling.BOX)


def _save(picture: Image.Image, quality: int = JPEG_QUALITY, *, full_colours: bool = False) -> Picture:
    stream = io.BytesIO()
    kind = "JPEG" if picture.mode in ("L", "RGB") else "PNG"
    if kind == "JPEG":
        picture.save(stream, kind, quality=quality, subsampling=0 if full_colours else -1)
    else:
        picture.save(stream, kind, compress_level=1 if max(picture.size) > THUMBNAIL_PX else 6)
    return Picture(stream.getvalue(), f"image/{kind.lower()}", picture.width, picture.height)


# -- masks -------------------------------------------------------------------------------------------------------------

# Of a line, half or a quarter is left by mean: it is made brighter again. Few greys, which compress well.
_GREYS: Final = 4
_BRIGHTER: Final = [round((_GREYS - 1) * (level / 255) ** 0.5) for level in range(256)]
_MOST_POOLED_PX: Final = 16_000_000
# So many pixels of a very large mask, along each side, make one of the thumbnail.
_SAMPLED: Final = 4


def _mask_thumbnail(mask: Array, max_side_px: int) -> Image.Image:
    """Shrink to twice the size by maximum, and from there by mean: thin lines stay, and stay thinner than areas."""
    doubled = _mask_picture(mask, 2 * max_side_px).convert("L")
    indices = _resized(doubled, max_side_px).point(_BRIGHTER)
    picture = Image.frombytes("P", indices.size, indices.tobytes())
    picture.putpalette([level * 255 // (_GREYS - 1) for level in range(_GREYS) for _ in "rgb"])
    return picture


def _is_thumbnail(image: Array, max_side_px: int | None) -> bool:
    """Whether an image is to become so small that its masks get grey edges."""
    return max_side_px is not None and max_side_px <= THUMBNAIL_PX < max(image.shape[:2])


def _mask_picture(mask: Array, max_side_px: int | None) -> Image.Image:
    picture = Image.fromarray(_mask_bits(mask, max_side_px))
    return picture.convert("1")


def _mask_bits(mask: Array, max_side_px: int | None) -> npt.NDArray[np.bool_]:
    """Shrink by maximum: thin lines averaged over their black surroundings would vanish."""
    bits = mask.view(np.uint8) if mask.dtype.kind == "b" else mask
    if max_side_px is not None and not is_pooled(mask):
        stride = max(1, max(mask.shape) // (_SAMPLED * max_side_px))
        bits = bits[::stride, ::stride]
    pool = 1 if max_side_px is None else -(-max(bits.shape) // max_side_px)
    if pool > 1:
        # Every pixel counts, or lines between those of a sample would vanish; by whole rows, 12 MP take 0.4 ms.
        bits = _pooled(np.ascontiguousarray(_pooled(bits, pool).T), pool).T
    return np.ascontiguousarray(bits != 0)


def is_pooled(mask: Array) -> bool:
    """Whether all pixels of a mask are looked at when it is made smaller: of a very large one that takes too long."""
    return mask.size <= _MOST_POOLED_PX


def _pooled(bits: Array, pool: int) -> Array:
    """Return each so many rows as one, with what is set in any of them."""
    whole = bits.shape[0] // pool * pool
    pooled = np.bitwise_or.reduce(bits[:whole].reshape(-1, pool, bits.shape[1]), axis=1)
    rest = bits[whole:]
    return np.concatenate([pooled, np.bitwise_or.reduce(rest, axis=0, keepdims=True)]) if len(rest) else pooled


_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_DEPTH: Final = 1
_GRAYSCALE: Final = 0
# Masks are runs: longer matches than those of one byte are rarely found, and looking for them takes most of the time.
_LEVEL: Final = 1
_MEMORY: Final = 9


def bitmap_png(mask: Array) -> bytes:
    """Return a mask as a grayscale PNG whose pixels are black and white.

    Parameters
    ----------
    mask
        (height, width), bool or bytes; what is not 0 is white.
    """
    height, width = mask.shape
    packed = np.packbits(mask, axis=1)
    rows = np.zeros((height, packed.shape[1] + 1), np.uint8)
    rows[:, 1:] = packed  # each row begins with its filter, which is none
    packer = zlib.compressobj(_LEVEL, zlib.DEFLATED, zlib.MAX_WBITS, _MEMORY, zlib.Z_RLE)
    data = packer.compress(rows.tobytes()) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, _DEPTH, _GRAYSCALE, 0, 0, 0)
    return _SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


# -- labels ------------------------------------------------------------------------------------------------------------

# Byte 0 is black, for label 0; byte 255 is white, for what is negative, as the borders of cv2.watershed.
_LABEL_COLOURS: Final = 254
_WHITE: Final = 255
_GOLDEN: Final = 0.618033988749895
# Neighbouring numbers get hues far apart, and four numbers in a row differ in brightness, too.
_TONES: Final = ((0.60, 0.95), (0.85, 0.75), (0.45, 1.00), (0.75, 0.88))


@functools.cache
def palette() -> bytes:
    """Return 256 colours of three bytes."""
    colours = bytearray(3)
    for index in range(_LABEL_COLOURS):
        saturation, brightness = _TONES[index % len(_TONES)]
        colour = colorsys.hsv_to_rgb((0.58 + index * _GOLDEN) % 1.0, saturation, brightness)
        colours += bytes(round(255 * channel) for channel in colour)
    return bytes(colours) + b"\xff\xff\xff"


def label_picture(labels: Array, max_side_px: int | None) -> Image.Image:
    """Return a picture with a palette; made smaller by leaving out pixels, since labels have no mean."""
    stride = 1 if max_side_px is None else -(-max(labels.shape) // max_side_px)
    kept = labels[::stride, ::stride]
    numbers = np.where(kept > 0, (kept.astype(np.int64) - 1) % _LABEL_COLOURS + 1, np.where(kept < 0, _WHITE, 0))
    picture = Image.fromarray(np.ascontiguousarray(numbers, dtype=np.uint8)).copy()
    picture.putpalette(palette())
    return picture
