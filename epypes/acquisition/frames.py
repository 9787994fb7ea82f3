"""What is a frame, and may it share the camera's memory?"""

from __future__ import annotations

from dataclasses import dataclass
from sys import getrefcount
from typing import Any, Final

Array = Any


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Frame:
    """One image of a camera.

    Attributes
    ----------
    image
        (y, x) or (y, x, channels), read-only; colours as from OpenCV, BGR.
    captured_ns
        When the camera gave it, Unix time in ns.
    number
        Its place in the camera's stream, from 1.
    """

    image: Array
    captured_ns: int
    number: int

    def __repr__(self) -> str:
        shape = getattr(self.image, "shape", "?")
        return f"<Frame {self.number}: {shape} {getattr(self.image, 'dtype', '')}>"


def take_image(given: list[Any]) -> Array:
    """Take what a camera gave out of a list, as a read-only array that nobody else will write to.

    It comes in a list of one, so that references to it can be counted: a camera that fills one buffer again and again
    knows its array, and that is copied. A new array that nobody else knows, the usual case, is locked as it is.

    Raises
    ------
    TypeError, ValueError
        It is no image.
    """
    import numpy as np

    _require_image(given[0], np)
    # Before there is a name for it here, which would be one more reference.
    is_settled = _is_settled(given, np)
    image = given.pop()
    if not is_settled:
        image = np.array(image, order="K")
    image.setflags(write=False)
    return image


def lasting_copy(image: Array) -> Array:
    """Return a copy of an image that nobody can ever write to, so that `take_image` will not copy it.

    Raises
    ------
    TypeError, ValueError
        It is no image.
    """
    import numpy as np

    _require_image(image, np)
    # A lock could be opened again by whoever has the array; bytes have none.
    return np.frombuffer(image.tobytes(), image.dtype).reshape(image.shape)


def _require_image(given: Any, np: Any) -> None:
    if not isinstance(given, np.ndarray):
        kind = type(given).__name__
        raise TypeError(f"A camera must give NumPy arrays, (y, x) or (y, x, channels), not {kind!r}.")
    if given.ndim not in (2, 3) or not given.size or given.dtype.kind not in "buif":
        raise ValueError(f"A frame must be (y, x) or (y, x, channels) of numbers, not {given.dtype} {given.shape}.")


def _is_settled(given: list[Any], np: Any) -> bool:
    """Whether nobody but the holder of this list can write to the array in it."""
    array = given[0]
    if type(array) is not np.ndarray:
        return False
    owner = array if array.base is None else array.base
    if bytes in (type(owner), type(getattr(owner, "base", None))):
        return True
    # Memory of anything else, such as a driver's buffer, is filled again as soon as the driver likes.
    if type(owner) is not np.ndarray or not owner.flags.owndata:
        return False
    del array, owner
    return _references(given) <= _ALONE and _is_owned_alone(given[0])


def _is_owned_alone(array: Any) -> bool:
    return array.base is None or getrefcount(array.base) <= _ALONE


def _references(given: list[Any]) -> int:
    return getrefcount(given[0])


# Measured, since interpreters differ in which references they count.
_ALONE: Final = _references([object()])
