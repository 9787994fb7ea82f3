"""How does a numpy array travel? As its dtype, its shape and its bytes, or as an image's rows.

Nothing here trusts a description: sizes are compared as Python integers before an array is made.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

from epypes.errors import MessageError
from epypes.images import swapped

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    AnyArray = npt.NDArray[Any]

# numpy's kinds without object, void and the dates: what has a meaning byte by byte, everywhere.
KINDS = "biufcUS"
_DTYPE = re.compile(r"[<>|=]?[biufcUS][0-9]{1,9}")
_MAX_NDIM = 32
_MAX_SIDE = 2**48
_MAX_CODE_POINT = 0x10FFFF

# encoding -> channels, dtype. Three channels are BGR, as in OpenCV, unless the sender says rgb.
ENCODINGS: dict[str, tuple[int, str]] = {
    f"{colours}{bits}": (channels, dtype)
    for colours, channels in (("mono", 1), ("bgr", 3), ("rgb", 3), ("bgra", 4), ("rgba", 4))
    for bits, dtype in ((8, "|u1"), (16, "<u2"))
}


def image_encoding(array: AnyArray, order: str = "bgr") -> str | None:
    """Return the image encoding of an array, or None if it travels as a tensor.

    Parameters
    ----------
    array
        Images are uint8, or little-endian uint16, of shape (height, width), (height, width, 3) or
        (height, width, 4), not empty.
    order
        ``"bgr"`` or ``"rgb"``: what three and four channels are.
    """
    bits = {"|u1": 8, "<u2": 16}.get(array.dtype.str)
    if bits is None or array.size == 0 or array.ndim not in {2, 3} or max(array.shape) >= 2**31:
        return None
    channels = 1 if array.ndim == 2 else array.shape[2]
    colours = {3: order, 4: f"{order}a"}.get(channels) if array.ndim == 3 else "mono"
    return None if colours is None else f"{colours}{bits}"


def recoloured(value: Any) -> Any:
    """Return a value whose coloured images, also in tuples, lists and dicts, have red and blue exchanged."""
    if type(value) in (tuple, list):
        return type(value)(map(recoloured, value))
    if type(value) is dict:
        return {key: recoloured(item) for key, item in value.items()}
    is_coloured = getattr(value, "ndim", 0) == 3 and image_encoding(value) is not None
    return swapped(value) if is_coloured else value


def flat_bytes(array: AnyArray) -> memoryview:
    """Return the bytes of an array in C order, without a copy where it is C-contiguous already."""
    import numpy as np

    if array.nbytes == 0:
        return memoryview(b"")
    contiguous = np.ascontiguousarray(array)
    if contiguous is not array:
        # Nobody else knows this copy; now it can be seen that it does not change.
        contiguous.flags.writeable = False
    # memoryview.cast knows only native formats; the view as bytes knows all of them.
    return contiguous.reshape(-1).view(np.uint8).data.toreadonly()


def is_settled(view: memoryview) -> bool:
    """Return whether nobody can change what a view of `flat_bytes` shows: all arrays under it are read-only."""
    import numpy as np

    owner: object = view.obj
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None or isinstance(owner, bytes)


def read_dtype(text: str, where: str) -> np.dtype[Any]:
    """Return the dtype that a message names.

    Raises
    ------
    MessageError
        Of reason ``"bad dtype"`` for anything but a plain boolean, number or text.
    """
    import numpy as np

    if _DTYPE.fullmatch(text):
        try:
            dtype = np.dtype(text)
        except (TypeError, ValueError):
            dtype = None
        if dtype is not None and dtype.kind in KINDS:
            return dtype
    raise MessageError("bad dtype", f"{where} has dtype {text[:40]!r}, which is not accepted from a message.")


def read_tensor(dtype: np.dtype[Any], shape: tuple[int, ...], data: memoryview, where: str) -> AnyArray:
    """Return a read-only array over the bytes of a message.

    Parameters
    ----------
    dtype
        From `read_dtype`.
    shape
        As the message has it; it may be anything.
    data
        The bytes, one-dimensional. The array keeps them, and is a copy only where they are not aligned for its
        dtype.
    where
        What the errors call it.

    Raises
    ------
    MessageError
        Of reason ``"bad shape"``, ``"size differs"`` or ``"bad data"``.
    """
    import numpy as np

    if len(shape) > _MAX_NDIM or any(not 0 <= side <= _MAX_SIDE for side in shape):
        raise MessageError("bad shape", f"{where} has a shape that no array has: {str(shape)[:80]}.")
    wanted = math.prod(shape) * dtype.itemsize
    if dtype.itemsize == 0 or wanted != data.nbytes:
        raise MessageError(
            "size differs",
            f"{where} has {data.nbytes} bytes, but its shape {shape} of {dtype.str} takes {wanted}.",
        )
    try:
        array: AnyArray = np.ndarray(shape, dtype, buffer=data if wanted else None)
    except (ValueError, TypeError, MemoryError) as error:
        raise MessageError("bad shape", f"{where} can't be an array of shape {shape}: {error}.") from error
    _check_content(array, where)
    return frozen(array)


def read_image(width: int, height: int, encoding: str, step: int, data: memoryview, where: str) -> AnyArray:
    """Return a read-only image over the bytes of a message: uint8 or uint16, (height, width[, channel]).

    Rows may be padded, as other senders' are: ``step`` bytes from one to the next.

    Raises
    ------
    MessageError
        Of reason ``"bad encoding"``, ``"bad step"`` or ``"size differs"``.
    """
    import numpy as np

    known = ENCODINGS.get(encoding)
    if known is None:
        raise MessageError("bad encoding", f"{where} has encoding {encoding[:40]!r}; known are {', '.join(ENCODINGS)}.")
    channels, dtype_text = known
    dtype = np.dtype(dtype_text)
    row = width * channels * dtype.itemsize
    if row == 0 or height == 0 or step < row:
        raise MessageError(
            "bad step", f"{where} is {width} x {height} {encoding} with step {step}; a row takes {row} bytes."
        )
    if step * height != data.nbytes:
        raise MessageError(
            "size differs",
            f"{where} has {data.nbytes} bytes, but {height} rows of {step} take {step * height}.",
        )
    shape = (height, width) if channels == 1 else (height, width, channels)
    strides = (step, channels * dtype.itemsize, dtype.itemsize)[: len(shape)]
    return frozen(np.ndarray(shape, dtype, buffer=data, strides=strides))


def frozen(array: AnyArray) -> AnyArray:
    """Return the array read-only; as a copy if it is not aligned, since compiled code may need that."""
    if not array.flags.aligned:
        array = array.copy()
    array.flags.writeable = False
    return array


def _check_content(array: AnyArray, where: str) -> None:
    # numpy takes any bytes for booleans and code points, and fails later, or answers nonsense.
    import numpy as np

    if array.size == 0:
        return
    flat = array.reshape(-1)
    if array.dtype.kind == "b" and flat.view(np.uint8).max() > 1:
        raise MessageError("bad data", f"{where} has booleans that are neither 0 nor 1.")
    if array.dtype.kind == "U":
        code = np.dtype(np.uint32).newbyteorder(array.dtype.byteorder)
        if flat.view(code).max() > _MAX_CODE_POINT:
            raise MessageError("bad data", f"{where} has text with code points that don't exist.")
