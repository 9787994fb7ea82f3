"""Functions of NumPy and methods of arrays, by the templates of array.hpp."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from epypes.cpp import arrays
from epypes.cpp import types as t
from epypes.cpp.expressions import arguments, value_of
from epypes.cpp.scope import Expr, Scope, is_number, refuse, shares, tuple_of

Bound = dict[str, Expr]


def call(scope: Scope, function: Any, name: str, node: Any) -> Expr:
    """Translate a call of a function of NumPy."""
    import numpy as np

    if isinstance(function, type) and issubclass(function, np.generic):
        return _converted(scope, np.dtype(function).name, node)
    given, named = arguments(scope, node)
    if isinstance(function, np.ufunc):
        name = function.__name__
        name = {"divide": "true_divide", "conjugate": ""}.get(name, name)
        refuse(named or len(given) != function.nin, f"np.{name} with these arguments: {_listed(node)}", node)
        elementwise, tests, compared = t.data("numpy")["ufuncs"].values()
        if name in tests:
            return _test(name, given[0], node)
        refuse(name not in elementwise + compared, f"np.{name}, whose last digits are others in C++", node)
        return arrays.calculate(name, given, node)
    return _function(scope, name, given, named, node)


def _function(scope: Scope, name: str, given: Sequence[Expr], named: Mapping[str, Expr], node: Any) -> Expr:
    entry = t.data("numpy")["functions"].get(name, {})
    refuse(not entry, f"np.{name} has no translation", node)
    names, options = entry["takes"], {key: entry[key] for key in entry.keys() - {"takes", "build", "is_method"}}
    is_other = not given or len(given) > len(names) or named.keys() - {*names}
    refuse(is_other, f"np.{name} with these arguments: {_listed(node)}", node)
    return _BUILDERS[entry["build"]](scope, dict(zip(names, given, strict=False)) | dict(named), node, **options)


def _listed(node: Any) -> str:
    """Return the arguments of a call as they are written."""
    return ", ".join(ast.unparse(each) for each in (*node.args, *node.keywords))


def method(scope: Scope, owner: Expr, name: str, node: Any) -> Expr:
    """Translate a call of a method of an array or a number of NumPy."""
    given, named = arguments(scope, node)
    is_array = isinstance(owner.type, t.ArrayType)
    if name == "astype" and len(given) == 1 and not named:
        return _cast(owner, _dtype(given[0], node), node)
    if name == "item" and not given and not is_array:
        refuse(owner.type.dtype in ("uint64", "bool"), f"item() of {t.describe(owner.type)}", node)
        is_float = owner.type.dtype.startswith("float")
        return Expr(f"{'double' if is_float else 'std::int64_t'}{{{owner.text}}}", t.FLOAT if is_float else t.Int())
    if name == "flatten" and is_array and not given:
        owner, name = _ravel(scope, {"a": owner}, node), "copy"
    refuse(
        not is_array or not t.data("numpy")["functions"].get(name, {}).get("is_method"),
        f"the method {name!r} of {t.describe(owner.type)}",
        node,
    )
    if name == "reshape" and len(given) != 1:
        given = [tuple_of(given)]
    found = _function(scope, name, [owner, *given], named, node)
    # This copy alone has the usual layout.
    return replace(found, type=replace(found.type, is_other=False)) if name == "copy" else found


def _dtype(given: Expr | None, node: Any, default: str = "") -> str:
    """Return the name of a dtype that is given; the default if none is."""
    import numpy as np

    if given is None and default:
        return default
    try:
        name: str = np.dtype(given.value if given else None).name
    except TypeError:
        name = ""
    is_known = given is not None and given.value is not None and name in t.ELEMENTS
    refuse(not is_known, "a dtype that C++ does not have, or that is not known", node)
    return name


def _cast(given: Expr, dtype: str, node: Any) -> Expr:
    if not isinstance(given.type, t.ArrayType):
        return Expr(f"numpy::cast<{t.ELEMENTS[dtype]}>({given.text})", t.number(dtype))
    array = arrays.as_array(given, node)
    kind = arrays.made(dtype, array.type.ndim, array.type.channels, [array])
    return Expr(f"numpy::astype<{t.ELEMENTS[dtype]}>({array.text})", kind)


def _converted(scope: Scope, dtype: str, node: Any) -> Expr:
    """Translate np.uint8(x): of an array a copy, of a number one of NumPy."""
    refuse(len(node.args) != 1 or node.keywords or dtype not in t.ELEMENTS, ast.unparse(node), node)
    given = value_of(scope, node.args[0])
    if isinstance(given.type, t.ArrayType) or given.type.dtype:
        return _cast(given, dtype, node)
    if given.parts is not None or isinstance(given.type, t.ListType):
        return _array(scope, {"object": given, "dtype": _written(dtype)}, node)
    refuse(not is_number(given.type) or ("float" not in dtype and given.type == t.FLOAT), ast.unparse(node), node)
    return Expr(_number(given, dtype, node), t.number(dtype))


def _written(dtype: str) -> Expr:
    import numpy as np

    return Expr("", t.NONE, np.dtype(dtype))


def _number(given: Expr, dtype: str, node: Any) -> str:
    """Return a number as an element; one of Python that does not fit raises."""
    element = t.ELEMENTS[dtype]
    if isinstance(given.type, t.Int) and "int" in dtype:
        return arrays.as_element(given, dtype, node)
    return (
        f"static_cast<{element}>({given.text})"
        if "float" in dtype or given.type.dtype
        else f"numpy::element<{element}>({given.text})"
    )


def _test(name: str, given: Expr, node: Any) -> Expr:
    arrays.dtype_of(given, node)
    if not isinstance(given.type, t.ArrayType):
        return Expr(f"numpy::{name}({given.text})", t.number("bool"))
    array = arrays.as_array(given, node)
    return Expr(f"numpy::{name}({array.text})", arrays.joint_type("bool", [array]))


def _axis(given: Expr | None, ndim: int, node: Any) -> int | None:
    if given is None or given.value is None:
        return None
    refuse(type(given.value) is not int or not -ndim <= given.value < ndim, "an axis that is not written out", node)
    return int(given.value % ndim)


def _reduced(scope: Scope, bound: Bound, node: Any, name: str) -> Expr:
    import numpy as np

    array = arrays.as_array(bound["a"], node)
    kind, text = array.type, array.text
    axis = _axis(bound.get("axis"), kind.ndim, node)
    is_sum, is_float = name in ("sum", "mean", "std", "var"), kind.dtype.startswith("float")
    dtype = {"argmax": "int64", "argmin": "int64", "count_nonzero": "int64", "any": "bool", "all": "bool"}.get(
        name, kind.dtype
    )
    if is_sum and not is_float:
        dtype = "float64" if name != "sum" else "uint64" if kind.dtype.startswith("uint") else "int64"
        is_long = name != "sum" and kind.dtype in ("int64", "uint64", "uint32")
        refuse(is_long, f"the {name} of {kind.dtype}, which may have more digits than a double", node)
    refuse(
        is_sum and is_float and (kind.is_strided or kind.is_other),
        "floats that may not lie side by side, which NumPy adds in another order",
        node,
    )
    template = f"<{t.ELEMENTS[dtype]}>" if name == "sum" else ""
    if axis is None or kind.ndim == 1:
        text = f"std::sqrt(numpy::var({text}))" if name == "std" else f"numpy::{name}{template}({text})"
        is_plain = name == "count_nonzero" and type(np.count_nonzero(np.zeros(1))) is int  # type: ignore[comparison-overlap]
        return Expr(text, t.Int(0, 2**62) if is_plain else t.number(dtype))
    refuse(name not in ("sum", "mean", "min", "max"), f"{name} along an axis", node)
    return Expr(f"numpy::{name}{template}({text}, {axis})", arrays.made(dtype, kind.ndim - 1, operands=[array]))


# -- functions ---------------------------------------------------------------------------------------------------------


def _shape(given: Expr, node: Any) -> tuple[Expr, ...]:
    parts = given.parts if given.parts is not None else (given,)
    refuse(given.name == "shape of unknown length", "the dimensions of an array are not known", node)
    refuse(
        not parts or not all(isinstance(part.type, t.Int) for part in parts), f"a shape: {t.describe(given.type)}", node
    )
    return parts


def _channels(parts: Sequence[Expr]) -> int:
    """Return the size of the third dimension where it is written out."""
    return max(0, parts[2].value) if len(parts) == 3 and type(parts[2].value) is int else 0


def _full(scope: Scope, bound: Bound, node: Any, value: str = "") -> Expr:
    fill, like = bound.get("fill_value"), []
    if "a" in bound:
        array = arrays.as_array(bound["a"], node)
        ndim, channels, shape = array.type.ndim, array.type.channels, f"{array.text}.shape"
        dtype, like = _dtype(bound.get("dtype"), node, array.type.dtype), [array]
    else:
        parts = _shape(bound["shape"], node)
        ndim, channels, shape = len(parts), _channels(parts), f"{{{', '.join(part.text for part in parts)}}}"
        dtype = _dtype(bound.get("dtype"), node, "float64" if fill is None else arrays.own_dtype(fill.type))
    if fill is not None:
        is_float = fill.type == t.FLOAT and "float" not in dtype
        refuse(not is_number(fill.type) or is_float, f"{t.describe(fill.type)} in an array of {dtype}", node)
    text = f"static_cast<{t.ELEMENTS[dtype]}>({value})" if fill is None else _number(fill, dtype, node)
    kind = arrays.made(dtype, ndim, channels, like)
    return Expr(f"numpy::full<{t.ELEMENTS[dtype]}, {ndim}>({shape}, {text})", kind)


def _array(scope: Scope, bound: Bound, node: Any) -> Expr:
    import numpy as np

    given, wanted = bound["object"], _dtype(bound["dtype"], node) if "dtype" in bound else ""
    if isinstance(given.type, t.ArrayType):
        return _cast(given, wanted or given.type.dtype, node)
    if isinstance(given.type, t.ListType) and not given.parts:
        return _of_list(given, wanted, node)
    shape, flat = _nested(given, node)
    refuse(
        not flat or not all(is_number(item.type) for item in flat), "an array of what is not written as numbers", node
    )
    dtype = wanted or np.result_type(*(arrays.own_dtype(item.type) for item in flat)).name
    refuse(dtype not in t.ELEMENTS, f"an array of {dtype}", node)
    is_cast = any(item.type.dtype and not np.can_cast(item.type.dtype, dtype, "same_kind") for item in flat)
    refuse(is_cast, f"numbers of NumPy in an array of {dtype}", node)
    numbers = ", ".join(_number(item, dtype, node) for item in flat)
    text = f"numpy::array<{t.ELEMENTS[dtype]}, {len(shape)}>({{{', '.join(map(str, shape))}}}, {{{numbers}}})"
    return Expr(text, arrays.made(dtype, len(shape), shape[2] if len(shape) == 3 else 0))


def _nested(given: Expr, node: Any) -> tuple[tuple[int, ...], list[Expr]]:
    """Return the shape of an array that is written out, and its numbers."""
    if given.parts is None:
        return (), [given]
    inner = [_nested(part, node) for part in given.parts]
    refuse(len({shape for shape, _ in inner}) != 1, "an array of rows of different lengths, or of none", node)
    return (len(inner), *inner[0][0]), [number for _, numbers in inner for number in numbers]


def _of_list(given: Expr, wanted: str, node: Any) -> Expr:
    item = given.type.item
    if is_number(item):
        own = arrays.own_dtype(item)
        # Of an empty list NumPy makes an array of float64.
        text = given.text if wanted or own == "float64" else f"numpy::filled({given.text})"
        refuse(item.dtype and wanted not in ("", own), f"an array of {wanted} of a list of {own}", node)
        return Expr(f"numpy::from_list<{t.ELEMENTS[wanted or own]}>({text})", arrays.made(wanted or own, 1))
    kinds = item.items if isinstance(item, t.TupleType) else ()
    is_sure = all(isinstance(each, t.Int) or each in (t.FLOAT, t.MIXED, t.number("float64")) for each in kinds)
    refuse(not kinds or not is_sure, f"an array of {t.describe(given.type)}", node)
    dtype = wanted or ("int64" if all(isinstance(each, t.Int) for each in kinds) else "float64")
    return Expr(f"numpy::from_rows<{t.ELEMENTS[dtype]}>({given.text})", arrays.made(dtype, 2))


def _reshape(scope: Scope, bound: Bound, node: Any) -> Expr:
    array, parts = arrays.as_array(bound["a"], node), _shape(bound["shape"], node)
    text = f"{array.text[:-1]}, true)" if array.text.startswith("numpy::from_rows<") else array.text
    # It may be a view or a copy: nothing writes to it.
    shares(scope, array, node)
    kind = replace(array.type, ndim=len(parts), channels=_channels(parts), is_readonly=True)
    return Expr(f"numpy::reshape<{len(parts)}>({text}, {{{', '.join(part.text for part in parts)}}})", kind)


def _ravel(scope: Scope, bound: Bound, node: Any) -> Expr:
    array = arrays.as_array(bound["a"], node)
    shares(scope, array, node)
    return Expr(f"numpy::ravel({array.text})", replace(array.type, ndim=1, channels=0, is_readonly=True))


def _clip(scope: Scope, bound: Bound, node: Any) -> Expr:
    refuse(len(bound) < 3 or any(each.value is None for each in bound.values()), "np.clip with one bound", node)
    return arrays.calculate("clip", [bound["a"], bound["a_min"], bound["a_max"]], node)


def _where(scope: Scope, bound: Bound, node: Any) -> Expr:
    import numpy as np

    if len(bound) < 3:
        return _nonzero(scope, {"a": bound["condition"]}, node)
    kinds = [arrays.dtype_of(bound[name], node) for name in ("x", "y")]
    dtype = np.result_type(*(kind(0) if kind is int or kind is float else kind for kind in kinds)).name
    refuse(dtype not in t.ELEMENTS, f"np.where makes {dtype}", node)
    operands = [arrays.operand(bound["condition"], "bool", node, is_compared=True)]
    operands += [arrays.operand(bound[name], dtype, node) for name in ("x", "y")]
    kind = arrays.joint_type(dtype, operands)
    refuse(not isinstance(kind, t.ArrayType), "np.where of numbers alone", node)
    return Expr(f"numpy::where<{t.ELEMENTS[dtype]}>({', '.join(each.text for each in operands)})", kind)


def _nonzero(scope: Scope, bound: Bound, node: Any) -> Expr:
    array = scope.hold("mask", arrays.as_array(bound["a"], node))
    # NumPy's are the columns of one array.
    kind = t.ArrayType("int64", 1, is_mat=False, is_other=True)
    return tuple_of([Expr(f"numpy::nonzero<{axis}>({array.text})", kind) for axis in range(array.type.ndim)])


def _arange(scope: Scope, bound: Bound, node: Any) -> Expr:
    parts = [bound[name] for name in ("start", "stop", "step") if name in bound]
    refuse(not all(isinstance(part.type, t.Int) for part in parts), "np.arange of floats", node)
    dtype = _dtype(bound.get("dtype"), node, "int64")
    texts = [part.text for part in parts]
    low, high, step = ["0", texts[0], "1"] if len(texts) == 1 else [*texts, "1"][:3]
    return Expr(f"numpy::arange<{t.ELEMENTS[dtype]}>({low}, {high}, {step})", arrays.made(dtype, 1))


def _joined(scope: Scope, bound: Bound, node: Any, axis: int | None = None, is_stack: bool = False) -> Expr:
    """Join arrays along an axis, or in a new one."""
    parts = [arrays.as_array(part, node) for part in bound["arrays"].parts or ()]
    kinds = {(part.type.dtype, part.type.ndim) for part in parts}
    refuse(len(kinds) != 1, "arrays that are not written out, or of different dtypes or dimensions, are joined", node)
    dtype, ndim = kinds.pop()
    # np.vstack makes rows of what has one dimension, and np.hstack goes on in the first.
    is_new = is_stack or (axis == 0 and ndim == 1)
    chosen = min(axis, ndim - 1) if axis is not None else 0
    if "axis" in bound:
        chosen = _axis(bound["axis"], ndim + is_new, node) or 0
    element = f"numpy::Array<{t.ELEMENTS[dtype]}, {ndim + is_new}>"
    texts = ", ".join(f"numpy::raised({part.text}, {chosen})" if is_new else part.text for part in parts)
    kind = arrays.made(dtype, ndim + is_new, len(parts) if is_new and chosen == 2 else 0, parts)
    return Expr(f"numpy::concatenate(std::vector<{element}>{{{texts}}}, {chosen})", kind)


def _sort(scope: Scope, bound: Bound, node: Any) -> Expr:
    array = arrays.as_array(bound["a"], node)
    return Expr(f"numpy::sort({array.text})", arrays.joint_type(array.type.dtype, [array]))


def _argsort(scope: Scope, bound: Bound, node: Any) -> Expr:
    array, kind = arrays.as_array(bound["a"], node), bound.get("kind")
    is_stable = kind is not None and kind.value == "stable"
    refuse(not is_stable, 'np.argsort without kind="stable", whose order of equal elements is not defined', node)
    refuse(array.type.ndim != 1, "np.argsort of several dimensions", node)
    return Expr(f"numpy::argsort({array.text})", arrays.made("int64", 1))


def _average(scope: Scope, bound: Bound, node: Any) -> Expr:
    refuse("weights" not in bound, "np.average without weights", node)
    array, weights = (arrays.as_array(bound[name], node) for name in ("a", "weights"))
    kinds = {(each.type.dtype, each.type.ndim) for each in (array, weights)}
    refuse(kinds != {("float64", array.type.ndim)}, "np.average of other arrays than float64", node)
    total = _reduced(scope, {"a": arrays.calculate("multiply", [array, weights], node)}, node, "sum")
    return Expr(f"numpy::weighted({total.text}, {_reduced(scope, {'a': weights}, node, 'sum').text})", total.type)


def _copy(scope: Scope, bound: Bound, node: Any) -> Expr:
    if isinstance(bound["a"].type, t.ArrayType) and bound["a"].type.is_mat:
        return Expr(f"{bound['a'].atom}.clone()", replace(bound["a"].type, is_readonly=False))
    return _cast(bound["a"], bound["a"].type.dtype, node)


def _rounded(scope: Scope, bound: Bound, node: Any) -> Expr:
    is_integer = "int" in bound["a"].type.dtype
    return _copy(scope, bound, node) if is_integer else arrays.calculate("rint", [bound["a"]], node)


def _same(scope: Scope, bound: Bound, node: Any) -> Expr:
    """Return an array that is no copy where NumPy makes none."""
    given = bound["object"]
    kind = given.type
    if not isinstance(kind, t.ArrayType) or _dtype(bound.get("dtype"), node, kind.dtype) != kind.dtype:
        return _array(scope, bound, node)
    array = arrays.as_array(given, node)
    if ast.unparse(node.func).endswith("asarray"):
        return given
    shares(scope, array, node)
    return replace(array, text=f"numpy::contiguous({array.text})")


def _transposed(scope: Scope, bound: Bound, node: Any) -> Expr:
    return arrays.attribute(bound["a"], "T", node)


_BUILDERS: Final[Mapping[str, Callable[..., Expr]]] = {
    "full": _full, "array": _array, "same": _same, "copy": _copy, "reshape": _reshape, "ravel": _ravel,
    "transposed": _transposed, "clip": _clip, "where": _where, "nonzero": _nonzero, "arange": _arange,
    "joined": _joined, "sort": _sort, "argsort": _argsort, "average": _average, "rounded": _rounded, "reduced": _reduced
}  # fmt: skip
