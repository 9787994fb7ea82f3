"""How does an image file become an array, and an array a file?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from epypes.acquisition.quiet import quiet
from epypes.errors import ImageFileError
from epypes.images import swapped
from epypes.optional import optional_import

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from epypes.images import Order


def read_image(path: str | Path, order: Order = "bgr") -> npt.NDArray[np.uint8 | np.uint16]:
    """Read an image file as OpenCV does, unchanged: (y, x), (y, x, 3) BGR or (y, x, 4) BGRA, uint8 or uint16.

    With ``order="rgb"``, RGB and RGBA.

    Raises
    ------
    ImageFileError
        There is no such file, or OpenCV does not know what is in it.
    """
    with optional_import("vision"):
        import cv2
        import numpy as np

    file = Path(path)
    try:
        data = np.frombuffer(file.read_bytes(), np.uint8)
    except OSError as error:
        text = f"Image {str(path)!r} can't be read: {error.strerror}. Check the path."
        raise ImageFileError(str(path), text) from error
    # Reading the bytes first tells a missing file from a broken one; what OpenCV would print of that is ours to say.
    with quiet():
        image: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        text = f"{str(path)!r} is not an image that OpenCV can read. Use PNG, JPEG, TIFF, BMP or WebP."
        raise ImageFileError(str(path), text)
    return image if order == "bgr" else _in_other_order(image)  # type: ignore[no-any-return]


def write_image(path: str | Path, image: npt.NDArray[Any], order: Order = "bgr") -> None:
    """Write an array as an image file, by its ending; ``.png`` keeps every value.

    Parameters
    ----------
    path
        The file.
    image
        bool, uint8 or uint16; (y, x), (y, x, 3) or (y, x, 4).
    order
        ``"bgr"`` or ``"rgb"``: what three and four channels are.

    Raises
    ------
    ImageFileError
        The array is no image that the format can hold, or the file can't be written.
    """
    with optional_import("vision"):
        import cv2
        import numpy as np

    shown = image.astype(np.uint8) * 255 if image.dtype == np.bool_ else image
    if shown.dtype not in (np.uint8, np.uint16) or shown.ndim not in (2, 3):
        kind = f"{image.dtype} {image.shape}"
        raise ImageFileError(str(path), f"An array of {kind} can't be written as an image. Use a file ending in .npy.")
    try:
        done, data = cv2.imencode(Path(path).suffix, shown if order == "bgr" else _in_other_order(shown))
        if not done:
            raise ImageFileError(str(path), f"OpenCV could not encode {path}. Use .png.")
        Path(path).write_bytes(data.tobytes())
    except cv2.error as error:
        text = f"OpenCV can't write {str(path)!r}: no such format as {Path(path).suffix!r}. Use .png."
        raise ImageFileError(str(path), text) from error
    except OSError as error:
        if isinstance(error, ImageFileError):
            raise
        raise ImageFileError(str(path), f"{str(path)!r} can't be written: {error.strerror}.") from error


def _in_other_order(image: Any) -> Any:
    return swapped(image) if image.ndim == 3 and image.shape[2] in (3, 4) else image
