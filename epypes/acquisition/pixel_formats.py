"""Pixel formats of GenICam (PFNC) as images of OpenCV: gray, or BGR."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from epypes.errors import InvalidValue
from epypes.optional import optional_import

# Of the Bayer formats, the first two pixels of the first row. OpenCV has the same names, with both rows.
_BAYER_ROWS: Final = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}
_BITS: Final = ("8", "10", "12", "14", "16")
# By the name of PFNC, or an older one of pylon: the conversion of cv2; "" where an image is as OpenCV has it.
_CONVERSIONS: Final[dict[str, str]] = {
    **{f"Mono{bits}": "" for bits in _BITS},
    **{f"Bayer{cell}{bits}": f"COLOR_Bayer{rows}2BGR" for cell, rows in _BAYER_ROWS.items() for bits in _BITS},
    **dict.fromkeys(("BGR8", "BGR8Packed"), ""),
    **dict.fromkeys(("RGB8", "RGB8Packed"), "COLOR_RGB2BGR"),
    **dict.fromkeys(("YUV422_8_UYVY", "YUV422Packed", "YCbCr422_8_CbYCrY"), "COLOR_YUV2BGR_UYVY"),
    **dict.fromkeys(("YUV422_8", "YUV422_YUYV_Packed", "YCbCr422_8"), "COLOR_YUV2BGR_YUY2"),
}


def to_image(pixel_format: str) -> Callable[[Any], Any]:
    """Return what makes an image of an array in a pixel format: (y, x), uint8 or uint16, or (y, x, channels) BGR.

    The mosaic of a Bayer format is interpolated by ``cv2.cvtColor``. Of 10, 12 and 14 bits the values stay what they
    are, in uint16.

    Raises
    ------
    ValueError
        The pixel format is none of those that work, which are named.
    """
    if pixel_format not in _CONVERSIONS:
        raise unreadable(pixel_format)
    conversion = _CONVERSIONS[pixel_format]
    if not conversion:
        return lambda array: array
    with optional_import("vision"):
        import cv2

    code = getattr(cv2, conversion)
    return lambda array: cv2.cvtColor(array, code)


def unreadable(pixel_format: str) -> InvalidValue:
    """Return the error for a pixel format that can't be read; it names those that work."""
    works = "Mono8 to Mono16, BayerRG8 and its like, RGB8, BGR8 and YUV422_8"
    return InvalidValue(f"Images of the pixel format {pixel_format!r} can't be read. Set one that works: {works}.")
