"""NumPy arrays in messages: tensors by dtype and shape, images by encoding and rows, NumPy scalars.

The reader trusts no description: it compares sizes as Python integers before it makes an array.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

from epypes.errors import MessageError
from epypes.images import Order, swapped
from epypes.wire.limits import Path, format_path, no_codec

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from epypes.wire.decoder import ValueReader
    from epypes.wire.encoder import ValueWriter

    AnyArray = npt.NDArray[Any]

# numpy's kinds without object, void and dates: those whose bytes have one meaning on every machine.
_KINDS = frozenset("biufcUS")
_TEXT_KINDS = frozenset("US")
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


def row_bytes(width: int, encoding: str) -> int:
    """Return how many bytes a row of an image takes without padding."""
    channels, dtype = ENCODINGS[encoding]
    return width * channels * int(dtype[-1])


def image_encoding(array: AnyArray, order: str = "bgr") -> str | None:
    """Return the image encoding of an array, or None if it is sent as a tensor.

    Parameters
    ----------
    array
        Images are uint8, or little-endian uint16, of shape (height, width), (height, width, 3) or
        (height, width, 4), not empty.
    order
        ``"bgr"`` or ``"rgb"``: the order of three and four channels.
    """
    bits = {"|u1": 8, "<u2": 16}.get(array.dtype.str)
    if bits is None or array.size == 0 or array.ndim not in {2, 3} or max(array.shape) >= 2**31:
        return None
    channels = 1 if array.ndim == 2 else array.shape[2]
    colours = {3: order, 4: f"{order}a"}.get(channels) if array.ndim == 3 else "mono"
    return None if colours is None else f"{colours}{bits}"


def exchange_colours(value: Any) -> Any:
    """Return a value in which red and blue of coloured images are exchanged, also in tuples, lists and dicts."""
    if type(value) in (tuple, list):
        return type(value)(map(exchange_colours, value))
    if type(value) is dict:
        return {key: exchange_colours(item) for key, item in value.items()}
    is_coloured = getattr(value, "ndim", 0) == 3 and image_encoding(value) is not None
    return swapped(value) if is_coloured else value


def flat_bytes(array: AnyArray) -> memoryview:
    """Return the bytes of an array in C order, without a copy where it is C-contiguous already."""
    import numpy as np

    if array.nbytes == 0:
        return memoryview(b"")
    contiguous = np.ascontiguousarray(array)
    if contiguous is not array:
        # Nothing else refers to this copy; `is_immutable` then sees that it can't change.
        contiguous.flags.writeable = False
    # memoryview.cast supports native formats only; the view as bytes supports all of them.
    return contiguous.reshape(-1).view(np.uint8).data.toreadonly()


def is_immutable(view: memoryview) -> bool:
    """Return whether the memory of a view from `flat_bytes` can't change: all arrays under it are read-only."""
    import numpy as np

    owner: object = view.obj
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None or isinstance(owner, bytes)


def freeze(array: AnyArray) -> AnyArray:
    """Return the array read-only; as a copy if it is not aligned, since compiled code may need that."""
    if not array.flags.aligned:
        array = array.copy()
    array.flags.writeable = False
    return array


def write_array(writer: ValueWriter, message: Any, value: Any, path: Path) -> None:
    """Write a NumPy array or scalar into a Value message."""
    import numpy as np

    dtype = value.dtype
    is_array = isinstance(value, np.ndarray)
    if dtype.kind not in _KINDS or (is_array and type(value) is not np.ndarray):
        raise no_codec(value, path, f" of {dtype!r}")
    if not is_array:
        _write_scalar(message.tensor, value)
    elif dtype.itemsize == 0:
        raise no_codec(value, path, " of text of no length")
    elif (encoding := image_encoding(value, writer.order)) is None:
        write_tensor(writer, message.tensor, value, path)
    else:
        image = message.image
        image.height, image.width = value.shape[:2]
        image.encoding, image.step = encoding, value.nbytes // value.shape[0]
        writer.store(image, value, value.nbytes, path)


def write_tensor(writer: ValueWriter, message: Any, array: AnyArray, path: Path) -> None:
    """Write an array into a Tensor message."""
    message.dtype = array.dtype.str
    message.shape.extend(array.shape)
    writer.store(message, array, array.nbytes, path)


def _write_scalar(message: Any, value: Any) -> None:
    kind = value.dtype.kind
    message.dtype, message.scalar, message.inline = value.dtype.str, True, value.tobytes()
    if kind in _TEXT_KINDS:
        # tobytes() and the dtype leave out trailing zeros.
        raw = bytes(value) if kind == "S" else value.encode("utf-32-le", "surrogatepass")
        message.dtype, message.inline = f"|S{len(raw)}" if kind == "S" else f"<U{len(raw) // 4}", raw


def read_tensor(reader: ValueReader, message: Any, path: Path) -> Any:
    """Return the array, or the scalar, of a Tensor message: a read-only view of its bytes, a copy if not aligned.

    Raises
    ------
    MessageError
        Of reason ``"bad dtype"``, ``"bad shape"``, ``"size differs"`` or ``"bad data"``.
    """
    import numpy as np

    where = format_path(path)
    data, shape, text = reader.stored(message, path), tuple(message.shape), message.dtype
    if message.scalar and shape:
        raise MessageError("bad shape", f"{where} is a scalar, but has the shape {shape}.")
    if message.scalar and text[1:2] in _TEXT_KINDS:
        return _read_text_scalar(text, bytes(data), where)
    dtype = _read_dtype(text, where)
    if len(shape) > _MAX_NDIM or any(not 0 <= side <= _MAX_SIDE for side in shape):
        raise MessageError("bad shape", f"{where} has a shape that no array has: {str(shape)[:80]}.")
    wanted = math.prod(shape) * dtype.itemsize
    if dtype.itemsize == 0 or wanted != data.nbytes:
        text = f"{where} has {data.nbytes} bytes, but its shape {shape} of {dtype.str} takes {wanted}."
        raise MessageError("size differs", text)
    try:
        array: AnyArray = np.ndarray(shape, dtype, buffer=data if wanted else None)
    except (ValueError, TypeError, MemoryError) as error:
        raise MessageError("bad shape", f"{where} can't be an array of shape {shape}: {error}.") from error
    if array.size and dtype.kind in "bU":
        _check_content(array, where)
    return freeze(array)[()] if message.scalar else freeze(array)


def _read_dtype(text: str, where: str) -> np.dtype[Any]:
    import numpy as np

    if _DTYPE.fullmatch(text):
        try:
            dtype = np.dtype(text)
        except (TypeError, ValueError):
            dtype = None
        if dtype is not None and dtype.kind in _KINDS:
            return dtype
    raise MessageError("bad dtype", f"{where} has dtype {text[:40]!r}, which is not accepted from a message.")


def _read_text_scalar(dtype: str, data: bytes, where: str) -> Any:
    import numpy as np

    try:
        if dtype == f"|S{len(data)}":
            return np.bytes_(data)
        if dtype == f"<U{len(data) // 4}" and len(data) % 4 == 0:
            return np.str_(data.decode("utf-32-le", "surrogatepass"))
    except UnicodeDecodeError as error:
        raise MessageError("bad data", f"{where} has text with code points that don't exist.") from error
    raise MessageError("size differs", f"{where} is a scalar of {dtype[:40]!r}, but has {len(data)} bytes.")


def _check_content(array: AnyArray, where: str) -> None:
    # numpy accepts any bytes for booleans and code points, and fails later, or computes nonsense.
    import numpy as np

    flat = array.reshape(-1)
    if array.dtype.kind == "b" and flat.view(np.uint8).max() > 1:
        raise MessageError("bad data", f"{where} has booleans that are neither 0 nor 1.")
    code = np.dtype(np.uint32).newbyteorder(array.dtype.byteorder)
    if array.dtype.kind == "U" and flat.view(code).max() > _MAX_CODE_POINT:
        raise MessageError("bad data", f"{where} has text with code points that don't exist.")


def read_image(reader: ValueReader, message: Any, path: Path) -> AnyArray:
    """Return the image of an Image message: uint8 or uint16, (height, width[, channel]), read-only.

    Rows may be padded, as those of other senders are: ``step`` bytes from one to the next. An image in another colour
    order than the first one of its part is converted.

    Raises
    ------
    MessageError
        Of reason ``"bad encoding"``, ``"bad step"`` or ``"size differs"``.
    """
    import numpy as np

    data = reader.stored(message, path)
    width, height, encoding, step = message.width, message.height, message.encoding, message.step
    if encoding not in ENCODINGS:
        raise MessageError(
            "bad encoding", f"{format_path(path)} has encoding {encoding[:40]!r}; known are {', '.join(ENCODINGS)}."
        )
    channels, dtype_text = ENCODINGS[encoding]
    image = view_rows(data, (height, width), channels, np.dtype(dtype_text), step, f"{format_path(path)}, {encoding},")
    if channels == 1:
        return image
    order: Order = "rgb" if encoding.startswith("rgb") else "bgr"
    reader.order = reader.order or order
    return image if order == reader.order else freeze(swapped(image))


def view_rows(
    data: memoryview, size: tuple[int, int], channels: int, dtype: np.dtype[Any], step: int, where: str
) -> AnyArray:
    """Return an image, read-only, in the memory of its rows; a copy if that is not aligned.

    Parameters
    ----------
    data
        The rows.
    size
        Height and width, as a message describes them: they are checked here.
    channels
        With one channel the image is of shape (height, width).
    dtype
        Of a channel.
    step
        Bytes from one row to the next, as a message describes them.
    where
        What the image is, for the error.

    Raises
    ------
    MessageError
        Of reason ``"bad step"`` or ``"size differs"``.
    """
    import numpy as np

    height, width = size
    row = width * channels * dtype.itemsize
    if row == 0 or height == 0 or step < row:
        text = f"{where} is {width} x {height} pixels with step {step}; a row takes {row} bytes."
        raise MessageError("bad step", text)
    if step * height != data.nbytes:
        text = f"{where} has {data.nbytes} bytes, but {height} rows of {step} take {step * height}."
        raise MessageError("size differs", text)
    shape = (height, width) if channels == 1 else (height, width, channels)
    strides = (step, channels * dtype.itemsize, dtype.itemsize)[: len(shape)]
    return freeze(np.ndarray(shape, dtype, buffer=data, strides=strides))
