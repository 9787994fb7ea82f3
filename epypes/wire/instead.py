"""What may a value be made of instead, when its type has no codec?"""

from __future__ import annotations

from typing import Any, Final

from epypes.errors import MessageError

# Where a value is: its name, then the indices and keys into it.
Path = tuple[object, ...]

_PLAIN: Final = (
    "Make it None, a bool, int, float, complex, str, bytes, list, tuple, dict, set, a numpy array of booleans, numbers "
    "or text, keypoints or matches of OpenCV, or a table of pandas."
)
# By module and name of a class, or of one of its bases: what to write in the function's return statement.
_INSTEAD: Final = {
    "builtins.generator": "list(value)",
    "builtins.dict_keys": "list(value)",
    "builtins.dict_values": "list(value)",
    "builtins.map": "list(value)",
    "builtins.zip": "list(value)",
    "builtins.range": "list(value)",
    "builtins.bytearray": "bytes(value)",
    "builtins.memoryview": "bytes(value)",
    "collections.deque": "list(value)",
    "collections.abc.Mapping": "dict(value)",
    "cv2.UMat": "value.get()",
    "datetime.date": "value.isoformat()",
    "datetime.time": "value.isoformat()",
    "datetime.timedelta": "value.total_seconds()",
    "decimal.Decimal": "str(value)",
    "enum.Enum": "value.value",
    "fractions.Fraction": "(value.numerator, value.denominator)",
    "numpy.ma.MaskedArray": "value.filled()",
    "numpy.ma.core.MaskedArray": "value.filled()",  # as NumPy 1 says it
    "numpy.datetime64": "value.astype('int64')",
    "numpy.timedelta64": "value.astype('int64')",
    "numpy.ndarray": "np.asarray(value)",
    "pandas.Categorical": "np.asarray(value)",
    "pandas.Index": "value.to_numpy()",
    "pathlib.PurePath": "str(value)",
    "PIL.Image.Image": "np.asarray(value)",
    "scipy.sparse.sparray": "value.toarray()",
    "scipy.sparse.spmatrix": "value.toarray()",
    "torch.Tensor": "value.numpy()",
    "types.SimpleNamespace": "vars(value)",
}
_BY_KIND: Final = {
    "O": "value.tolist()",
    "V": "{name: value[name] for name in value.dtype.names}",
    "M": "value.astype('int64')",
    "m": "value.astype('int64')",
}


def spoken(path: Path) -> str:
    """Return a path as it is written in Python: ``keypoints[0]['size']``."""
    return str(path[0]) if len(path) == 1 else str(path[0]) + "".join(f"[{step!r}]"[:60] for step in path[1:])


def no_codec(value: object, path: Path, detail: str = "") -> MessageError:
    """Return the error that names where a value is, its type, and what to return instead.

    Parameters
    ----------
    value
        The value; only its class is looked at, and the dtype of an array.
    path
        Where it is: its name, then the indices and keys into it.
    detail
        What else is to be said of its type.
    """
    name = _name(type(value))
    instead = _instead(value)
    way_out = f"Return {instead} instead of the value." if instead else _PLAIN
    return MessageError("no codec", f"{spoken(path)} is of type {name}{detail}, which has no codec. {way_out}")


def _name(kind: type) -> str:
    return kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"


def _instead(value: Any) -> str:
    kind = type(value)
    names = [f"{base.__module__}.{base.__qualname__}" for base in kind.__mro__]
    found = _BY_KIND.get(value.dtype.kind, "") if "numpy.ndarray" in names else ""
    found = found or next((_INSTEAD[name] for name in names if name in _INSTEAD), "")
    if found or isinstance(value, type):
        return found
    if hasattr(kind, "__dataclass_fields__"):
        return "dataclasses.asdict(value)"
    plain = next((base.__name__ for base in (tuple, list, dict, set, str, int, float) if issubclass(kind, base)), "")
    return f"{plain}(value)" if plain else ""
