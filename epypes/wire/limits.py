"""Limits of what a message may hold: sizes, counts, keys and types.

Encoder and decoder check the same limits, and the decoder checks them before it allocates anything.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from epypes.errors import MessageError

# Where a value is: the name of its part, then the indices and keys into it.
Path = tuple[object, ...]

# Counting plain hashes would collide as the keys do.
_SALT: Final = secrets.randbits(60)
_PLAIN: Final = (
    "Make it None, a bool, int, float, complex, str, bytes, list, tuple, dict, set, a numpy array of booleans, numbers "
    "or text, keypoints or matches of OpenCV, or a table of pandas."
)
# What to return in place of a value without codec, by module and name of its class or of one of its bases.
_REPLACEMENTS: Final = {
    **dict.fromkeys(("builtins.generator", "builtins.map", "builtins.zip", "builtins.range"), "list(value)"),
    **dict.fromkeys(("builtins.dict_keys", "builtins.dict_values", "collections.deque"), "list(value)"),
    **dict.fromkeys(("builtins.bytearray", "builtins.memoryview"), "bytes(value)"),
    "collections.abc.Mapping": "dict(value)",
    "types.SimpleNamespace": "vars(value)",
    "enum.Enum": "value.value",
    **dict.fromkeys(("datetime.date", "datetime.time"), "value.isoformat()"),
    "datetime.timedelta": "value.total_seconds()",
    **dict.fromkeys(("decimal.Decimal", "pathlib.PurePath"), "str(value)"),
    "fractions.Fraction": "(value.numerator, value.denominator)",
    # The second name is that of NumPy 1.
    **dict.fromkeys(("numpy.ma.MaskedArray", "numpy.ma.core.MaskedArray"), "value.filled()"),
    **dict.fromkeys(("numpy.datetime64", "numpy.timedelta64"), "value.astype('int64')"),
    **dict.fromkeys(("numpy.ndarray", "pandas.Categorical", "PIL.Image.Image"), "np.asarray(value)"),
    "pandas.Index": "value.to_numpy()",
    **dict.fromkeys(("scipy.sparse.sparray", "scipy.sparse.spmatrix"), "value.toarray()"),
    "torch.Tensor": "value.numpy()",
    "cv2.UMat": "value.get()",
}
# The same for NumPy arrays, by the kind of their dtype.
_ARRAY_REPLACEMENTS: Final = {
    "O": "value.tolist()",
    "V": "{name: value[name] for name in value.dtype.names}",
    "M": "value.astype('int64')",
    "m": "value.astype('int64')",
}


# The topic and the header of a message, before its payloads.
LEADING_FRAMES: Final = 2


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that a decoder accepts and an encoder keeps.

    Attributes
    ----------
    total_bytes
        Size of all frames of a message together.
    header_bytes
        Size of the Envelope frame. A parsed header takes many times its bytes, so this limit is lower.
    frames
        Number of payload frames.
    parts
        Number of parts; also of attributes, and of timings.
    values
        Number of values in the Envelope, including those in lists and mappings.
    keys
        Number of mapping keys and set items in a message that are neither str nor bytes. Python hashes those two with
        a secret; a peer can choose other keys so that building the dict or the set takes quadratic time.
    equal_hashes
        Number of such keys with one hash in one mapping or set. A few collide in honest data: hash(-1) == hash(-2),
        so the eight tuples over these two numbers share one hash.
    depth
        Depth of containers within containers. Protobuf parsers stop at 100 nested messages, and a mapping takes three
        of them.
    """

    total_bytes: int = 256 * 1024**2
    header_bytes: int = 16 * 1024**2
    frames: int = 1024
    parts: int = 1024
    values: int = 1_000_000
    keys: int = 16_384
    equal_hashes: int = 64
    depth: int = 24

    def check_frames(self, frames: Sequence[bytes | memoryview]) -> None:
        """Check the number and the sizes of a message's frames: topic, Envelope, payloads.

        Raises
        ------
        MessageError
            Of reason ``"too few frames"``, ``"too many frames"`` or ``"too large"``.
        """
        payloads, total = len(frames) - LEADING_FRAMES, sum(map(len, frames))
        if payloads < 0:
            raise MessageError("too few frames", f"{len(frames)} frames; a v1 message has a topic and an Envelope.")
        if payloads > self.frames:
            raise MessageError("too many frames", f"{payloads} payload frames; the limit is {self.frames}.")
        if total > self.total_bytes:
            raise MessageError("too large", f"The message has {total:,} bytes; the limit is {self.total_bytes:,}.")
        if len(frames[1]) > self.header_bytes:
            text = f"The Envelope has {len(frames[1]):,} bytes; the limit is {self.header_bytes:,}."
            raise MessageError("too large", f"{text} Send long lists as numpy arrays.")

    def check_names(self, message: Any) -> None:
        """Raise MessageError if an Envelope, or its protobuf message, has too many parts, attributes or timings."""
        for kind in ("parts", "attributes", "timings"):
            count = len(getattr(message, kind))
            if count > self.parts:
                text = f"The message has {count:,} {kind}; the limit is {self.parts:,}."
                raise MessageError(f"too many {kind}", text)


DEFAULT_LIMITS = Limits()


class ValueCounter:
    """Checks the values of one message against `Limits.values`, `depth`, `keys` and `equal_hashes`."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._values = self._keys = 0

    def count(self, path: Path, values: int = 1) -> None:
        """Count values at a path; raise MessageError of reason ``"too many values"``."""
        self._values += values
        if self._values > self._limits.values:
            text = f"{format_path(path)}: the message holds more than {self._limits.values:,} values."
            raise MessageError("too many values", f"{text} Make them a numpy array.")

    def enter(self, path: Path, items: int) -> None:
        """Count the items of a container at a path; raise MessageError also of reason ``"too deep"``."""
        if items and len(path) > self._limits.depth:
            text = f"{path[0]!r} nests deeper than {self._limits.depth} containers, or holds itself. Flatten it."
            raise MessageError("too deep", text)
        self.count(path, items)

    def key_check(self, path: Path) -> Callable[[object], None]:
        """Return the check of each key or item of a new mapping or set, to be called before it is inserted.

        It raises MessageError of reason ``"bad key"`` for an unhashable key, ``"too many keys"`` or
        ``"colliding keys"``.
        """
        hashes: Counter[int] = Counter()

        def check(key: object) -> None:
            if type(key) is str or type(key) is bytes:
                return
            try:
                salted = hash((_SALT, hash(key)))
            except TypeError as error:
                text = f"{format_path(path)} has a key or an item that can't be hashed: {error}."
                raise MessageError("bad key", text) from error
            self._keys += 1
            hashes[salted] += 1
            if self._keys > self._limits.keys:
                text = f"{format_path(path)} exceeds {self._limits.keys:,} keys and set items that are not text."
                raise MessageError("too many keys", f"{text} Use text as keys, a numpy array or a table.")
            if hashes[salted] > self._limits.equal_hashes:
                text = f"{format_path(path)} has more than {self._limits.equal_hashes} keys or items with one hash."
                raise MessageError("colliding keys", f"{text} Use text as keys, or a list of pairs.")

        return check


def format_path(path: Path) -> str:
    """Return a path as Python code: ``keypoints[0]['size']``."""
    return str(path[0]) + "".join(f"[{step!r}]"[:60] for step in path[1:])


def no_codec(value: object, path: Path, detail: str = "") -> MessageError:
    """Return the error for a value of a type without codec: where it is, its type, and what to return instead.

    Parameters
    ----------
    value
        The value; only its class is read, and the dtype of an array.
    path
        Where it is.
    detail
        More about its type.
    """
    kind = type(value)
    name = kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"
    replacement = _replacement(value)
    way_out = f"Return {replacement} instead of the value." if replacement else _PLAIN
    return MessageError("no codec", f"{format_path(path)} is of type {name}{detail}, which has no codec. {way_out}")


def _replacement(value: Any) -> str:
    kind = type(value)
    names = [f"{base.__module__}.{base.__qualname__}" for base in kind.__mro__]
    found = _ARRAY_REPLACEMENTS.get(value.dtype.kind, "") if "numpy.ndarray" in names else ""
    found = found or next((_REPLACEMENTS[name] for name in names if name in _REPLACEMENTS), "")
    if found or isinstance(value, type):
        return found
    if hasattr(kind, "__dataclass_fields__"):
        return "dataclasses.asdict(value)"
    plain = next((base.__name__ for base in (tuple, list, dict, set, str, int, float) if issubclass(kind, base)), "")
    return f"{plain}(value)" if plain else ""
