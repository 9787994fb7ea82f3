"""Arrays: operators, subscripts and assignments, with NumPy's dtypes and views.

NumPy itself says which dtype a calculation has (``ufunc.resolve_dtypes``); what C++ does is in templates/array.hpp.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from epypes.cpp import types as t
from epypes.cpp.scope import UNKNOWN, ByHand, Expr, Scope, is_number, refuse, writes

SIZE: Final = t.Int(0, 2**31 - 1)


def as_array(given: Expr, node: Any) -> Expr:
    """Return an array as an Array of C++, which shares the memory of a cv::Mat."""
    kind = given.type
    refuse(not isinstance(kind, t.ArrayType), f"an array is needed, not {t.describe(kind)}", node)
    if not kind.is_mat:
        return given
    refuse(not kind.dtype or kind.ndim not in (2, 3), "the dtype or the dimensions of an array are not known", node)
    made = replace(kind, is_mat=False, is_nullable=False)
    return Expr(f"numpy::array<{t.ELEMENTS[kind.dtype]}, {kind.ndim}>({given.text})", made)


def made(dtype: str, ndim: int, channels: int = 0, operands: Sequence[Expr] = ()) -> t.Type:
    """Return the type of a new array; of no dimensions, of a number."""
    kinds = [each.type for each in operands if isinstance(each.type, t.ArrayType)]
    # What has one dimension has one order.
    is_other = ndim > 1 and any(kind.is_strided or kind.is_other for kind in kinds)
    return t.ArrayType(dtype, ndim, channels, is_mat=False, is_other=is_other) if ndim else t.number(dtype)


def dtype_of(given: Expr, node: Any) -> Any:
    """Return the dtype of an operand, or the type of Python's numbers, which take the dtype of the others."""
    import numpy as np

    kind = given.type
    if isinstance(kind, t.ArrayType) and not kind.dtype:
        raise ByHand(f"the dtype of {given.name or 'an array'} is not known: OpenCV's function does not say it", node)
    if isinstance(kind, t.ArrayType) or kind.dtype:
        return np.dtype(kind.dtype)
    plain = {t.FLOAT: float, t.BOOL: np.dtype(bool)}.get(kind, int if isinstance(kind, t.Int) else None)
    refuse(plain is None, f"NumPy calculates with {t.describe(kind)}", node)
    return plain


def resolved(name: str, operands: Sequence[Expr], node: Any) -> tuple[str, str]:
    """Return the dtypes in which a function of NumPy calculates, and of what it returns."""
    import numpy as np

    given = [dtype_of(each, node) for each in operands]
    if name == "clip":
        given = _clipped(given, node)
    ufunc: Any = getattr(np, "minimum" if name == "clip" else name)
    try:
        found = ufunc.resolve_dtypes((*given, *(None,) * ufunc.nout))
    except TypeError as error:
        raise ByHand(f"NumPy refuses np.{name}: {str(error).splitlines()[0]:.80}", node) from None
    refuse(any(each.name not in t.ELEMENTS for each in found), f"np.{name} calculates in {found[0].name}", node)
    return found[0].name, found[-1].name


def _clipped(given: Sequence[Any], node: Any) -> list[Any]:
    """Return two operands that have a common dtype as those of np.clip have; NumPy does not say it of three."""
    dtypes = {each for each in given if each is not int and each is not float}
    is_sure = len(dtypes) == 1 and given[0] in dtypes and not any(each.kind == "b" for each in dtypes)
    refuse(not is_sure, "np.clip of several dtypes, or of bool", node)
    return [given[0], float if float in given else int if int in given else given[0]]


def operand(given: Expr, dtype: str, node: Any, *, is_compared: bool = False) -> Expr:
    """Return an operand of a calculation in a dtype; an integer of Python that does not fit raises, as in NumPy."""
    kind = given.type
    if isinstance(kind, t.ArrayType):
        return as_array(given, node)
    if not isinstance(kind, t.Int) or is_compared or "int" not in dtype:
        return given
    return Expr(fitting(given, dtype, node), t.number(dtype))


def fitting(given: Expr, dtype: str, node: Any) -> str:
    """Return an integer of Python as an element, one that is written out as it is."""
    import numpy as np

    limits = np.iinfo(dtype)
    kind = given.type
    if isinstance(kind, t.Int) and limits.min <= kind.low and kind.high <= limits.max:
        return given.text if given.value is not UNKNOWN else f"static_cast<{t.ELEMENTS[dtype]}>({given.text})"
    refuse(given.value is not UNKNOWN, f"{given.value} is out of bounds for {dtype}", node)
    return f"python::narrow<{t.ELEMENTS[dtype]}>({given.text})"


def as_element(given: Expr, dtype: str, node: Any) -> str:
    """Return an integer of Python as an element that has its type in C++."""
    text = fitting(given, dtype, node)
    return text if given.value is UNKNOWN else f"static_cast<{t.ELEMENTS[dtype]}>({text})"


def own_dtype(kind: t.Type) -> str:
    """Return the dtype that NumPy gives a number alone."""
    return {t.FLOAT: "float64", t.BOOL: "bool"}.get(kind) or kind.dtype or "int64"  # type: ignore[call-overload]


def joint_type(dtype: str, operands: Sequence[Expr]) -> t.Type:
    """Return the type of what is calculated of operands, element by element."""
    arrays = [each.type for each in operands if isinstance(each.type, t.ArrayType)]
    ndim = max((each.ndim for each in arrays), default=0)
    channels = {each.channels for each in arrays if each.ndim == 3}
    return made(dtype, ndim, channels.pop() if len(channels) == 1 else 0, operands)


def calculate(name: str, operands: Sequence[Expr], node: Any) -> Expr:
    """Return what a function of NumPy makes of its operands, element by element."""
    inner, outer = resolved(name, operands, node)
    is_compared = name in t.data("numpy")["ufuncs"]["compared"]
    given = [operand(each, inner, node, is_compared=is_compared) for each in operands]
    element = t.ELEMENTS[inner if is_compared else outer]
    function = "negated" if name == "negative" and "float" in outer else f"{name}<{element}>"
    return Expr(f"numpy::{function}({', '.join(each.text for each in given)})", joint_type(outer, given))


def binary(operator: ast.operator, left: Expr, right: Expr, node: Any) -> Expr:
    """Return the result of an operator."""
    name = t.operator(operator).get("numpy")
    if isinstance(operator, ast.Pow) and isinstance(left.type, t.ArrayType) and right.value == 2:
        return calculate("square", [left], node)
    if name is None:
        raise ByHand(f"{type(operator).__name__} of arrays", node)
    return calculate(name, [left, right], node)


# -- subscripts --------------------------------------------------------------------------------------------------------


def attribute(owner: Expr, name: str, node: Any) -> Expr:
    """Return an attribute of an array."""
    import numpy as np

    from epypes.cpp.expressions import written
    from epypes.cpp.scope import tuple_of

    kind = owner.type
    refuse(not isinstance(kind, t.ArrayType), f"the attribute {name!r} of {t.describe(kind)}", node)
    if name == "dtype" and kind.dtype:
        return written(np.dtype(kind.dtype), name, node)
    if name == "ndim" and kind.ndim >= 0:
        return written(kind.ndim, name, node)
    if name == "T":
        transposed = replace(kind, is_mat=False, channels=0, is_strided=kind.ndim > 1)
        return Expr(f"numpy::transpose({as_array(owner, node).text})", transposed)
    if name == "shape" and kind.is_mat:
        if kind.is_nullable:
            owner = replace(owner, text=f"python::required({owner.text})")
        sizes = [f"{owner.atom}.rows", f"{owner.atom}.cols", f"{owner.atom}.channels()"]
        # Of an image whose dimensions aren't known, the height and the width are.
        parts = [Expr(size, replace(SIZE, is_int=True)) for size in sizes[: kind.ndim if kind.ndim > 0 else 2]]
        return replace(tuple_of(parts), name="" if kind.ndim > 0 else "shape of unknown length")
    if name in ("shape", "size"):
        array = as_array(owner, node)
        if name == "size":
            return Expr(f"{array.text}.size()", t.Int(0, 2**62))
        return tuple_of([Expr(f"{array.text}.shape[{axis}]", SIZE) for axis in range(kind.ndim)])
    raise ByHand(f"the attribute {name!r} of an array", node)


def _steps(scope: Scope, owner: t.ArrayType, part: ast.expr, node: Any) -> tuple[list[str], int, bool, bool]:
    """Return the steps of a subscript, the dimensions that are left, whether all are indices, and if channels stay."""
    parts = part.elts if isinstance(part, ast.Tuple) else [part]
    used = sum(not _is_axis(each) and not _is_ellipsis(each) for each in parts)
    refuse(used > owner.ndim or sum(map(_is_ellipsis, parts)) > 1, f"{used} indices into {owner.ndim} dimensions", node)
    steps: list[str] = []
    ndim = owner.ndim
    for each in parts:
        if _is_ellipsis(each):
            steps += ["numpy::all()"] * (owner.ndim - used)
        elif _is_axis(each):
            steps.append("numpy::axis()")
            ndim += 1
        elif isinstance(each, ast.Slice):
            steps.append(_slice(scope, each, node))
        else:
            steps.append(f"numpy::at({_index(scope, each, node)})")
            ndim -= 1
    is_last_whole = len(steps) < owner.ndim or steps[-1] == "numpy::all()"
    keeps_channels = owner.ndim == ndim == 3 and is_last_whole and "numpy::axis()" not in steps
    return steps, ndim, ndim == 0, keeps_channels


def _is_axis(node: ast.expr) -> bool:
    return (isinstance(node, ast.Constant) and node.value is None) or (
        isinstance(node, ast.Attribute) and node.attr == "newaxis"
    )


def _is_ellipsis(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is ...


def _index(scope: Scope, node: ast.expr, where: Any) -> str:
    from epypes.cpp.expressions import value_of

    found = value_of(scope, node)
    if isinstance(found.type, t.Int) or (is_number(found.type) and "int" in found.type.dtype):
        return found.text
    raise ByHand(f"an index that is {t.describe(found.type)}", where)


def _slice(scope: Scope, part: ast.Slice, node: Any) -> str:
    low, high, step = (None if end is None else _index(scope, end, node) for end in (part.lower, part.upper, part.step))
    pace = "" if step is None else f", {step}"
    if low is None and high is None:
        return "numpy::all()" if step is None else f"numpy::every({step})"
    if high is None:
        return f"numpy::from({low}{pace})"
    return f"numpy::to({high}{pace})" if low is None else f"numpy::between({low}, {high}{pace})"


def _selector(scope: Scope, part: ast.expr, node: Any) -> Expr | None:
    """Return the array by which a subscript selects; None if it has indices and slices alone."""
    from epypes.cpp.expressions import value_of

    if isinstance(part, ast.Slice | ast.Tuple | ast.Constant) or _is_axis(part):
        if isinstance(part, ast.Tuple) and any(
            isinstance(each, ast.Name) and isinstance(getattr(scope.env.get(each.id), "type", None), t.ArrayType)
            for each in part.elts
        ):
            raise ByHand("a subscript of several arrays", node)
        return None
    size = len(scope.block.items)
    found = value_of(scope, part)
    if isinstance(found.type, t.ArrayType):
        return as_array(found, node)
    del scope.block.items[size:]
    return None


def subscript(scope: Scope, owner: Expr, part: ast.expr, node: Any) -> Expr:
    """Return an element, a view or the elements that a mask or indices select."""
    array = as_array(owner, node)
    kind = array.type
    selector = _selector(scope, part, node)
    if selector is not None:
        chosen = selector.type
        assert isinstance(chosen, t.ArrayType)  # noqa: S101 - for the type checker
        if chosen.dtype == "bool" and chosen.ndim <= kind.ndim:
            ndim = kind.ndim - chosen.ndim + 1
        elif "int" in chosen.dtype and chosen.ndim == 1:
            ndim = kind.ndim
        else:
            raise ByHand(f"a subscript by {t.describe(chosen)}", node)
        return Expr(
            f"numpy::take({array.text}, {selector.text})",
            made(kind.dtype, ndim, kind.channels if ndim == kind.ndim == 3 else 0, [array]),
        )
    steps, ndim, is_element, keeps = _steps(scope, kind, part, node)
    if is_element:
        return Expr(f"{array.text}[{{{', '.join(step[10:-1] for step in steps)}}}]", t.number(kind.dtype))
    channels = kind.channels if keeps else 0
    # Whole rows lie side by side.
    has_pace = any(isinstance(each, ast.Slice) and each.step is not None for each in ast.walk(part))
    is_apart = has_pace or not all(step.startswith("numpy::at(") for step in steps[:-1])
    kind = replace(kind, is_strided=kind.is_strided or is_apart)
    return Expr(
        f"numpy::view<{ndim}>({array.text}, {{{', '.join(steps)}}})", replace(kind, ndim=ndim, channels=channels)
    )


def store(scope: Scope, owner: Expr, target: ast.Subscript, value: Expr, node: Any) -> None:
    """Assign to an element, a view or the elements of a mask."""
    writes(scope, owner, node)
    array = as_array(owner, node)
    kind = array.type
    text = _stored(scope, kind, value, node)
    selector = _selector(scope, target.slice, node)
    if selector is not None:
        chosen = selector.type
        assert isinstance(chosen, t.ArrayType)  # noqa: S101 - for the type checker
        rank = value.type.ndim if isinstance(value.type, t.ArrayType) else int(value.parts is not None)
        # One number or row for all that is selected, or one for each in order.
        is_sure = chosen.dtype == "bool" and rank <= kind.ndim - chosen.ndim + 1
        refuse(not is_sure, f"an assignment to the elements that {t.describe(chosen)} selects", node)
        scope.emit(f"numpy::put({array.text}, {selector.text}, {text});")
        return
    steps, ndim, is_element, _ = _steps(scope, kind, target.slice, node)
    if is_element:
        refuse(isinstance(value.type, t.ArrayType), "an array is assigned to an element", node)
        scope.emit(f"{array.text}[{{{', '.join(step[10:-1] for step in steps)}}}] = {text};")
        return
    if isinstance(value.type, t.ArrayType) and value.type.ndim > ndim:
        raise ByHand("an array of more dimensions is assigned to a view", node)
    scope.emit(f"numpy::assign(numpy::view<{ndim}>({array.text}, {{{', '.join(steps)}}}), {text});")


def _stored(scope: Scope, kind: t.ArrayType, value: Expr, node: Any) -> str:
    """Return a value that is written to an array."""
    import numpy as np

    if value.parts is not None and value.type != t.TEXT:
        element = t.ELEMENTS[kind.dtype]
        if not value.parts or not all(is_number(part.type) for part in value.parts):
            raise ByHand("a nested sequence is assigned to a part of an array", node)
        texts = [_stored(scope, kind, part, node) for part in value.parts]
        return f"numpy::array<{element}, 1>({{{len(texts)}}}, {{{', '.join(texts)}}})"
    if isinstance(value.type, t.ArrayType):
        return as_array(value, node).text
    if isinstance(value.type, t.Int) and "int" in kind.dtype:
        return as_element(value, kind.dtype, node)
    refuse(not is_number(value.type), f"{t.describe(value.type)} is assigned to a part of an array", node)
    source = {t.FLOAT: "float64", t.BOOL: "bool"}.get(value.type) or value.type.dtype or "int64"
    is_safe = np.can_cast(source, kind.dtype, "same_kind" if source == "float64" else "safe")
    if not is_safe and not (isinstance(value.type, t.Int) and "float" in kind.dtype):
        raise ByHand(f"a {source} is assigned to a part of an array of {kind.dtype}", node)
    return f"static_cast<{t.ELEMENTS[kind.dtype]}>({value.text})"


def augmented(scope: Scope, left: Expr, operator: ast.operator, right: Expr, node: Any) -> None:
    """Calculate in place, as `+=` does."""
    import numpy as np

    writes(scope, left, node)
    found = binary(operator, left, right, node)
    kind = left.type
    if not isinstance(kind, t.ArrayType) or not isinstance(found.type, t.ArrayType) or found.type.ndim != kind.ndim:
        raise ByHand("an operator in place that changes the dimensions", node)
    if not np.can_cast(found.type.dtype, kind.dtype, "same_kind"):
        raise ByHand(f"an operator in place that makes {found.type.dtype} of {kind.dtype}", node)
    scope.emit(f"numpy::assign({as_array(left, node).text}, {found.text});")


def augmented_item(scope: Scope, owner: Expr, node: Any, value: Expr) -> None:
    """Calculate in place with an element, a view or the elements of a mask."""
    if any(isinstance(each, ast.Call) for each in ast.walk(node.target)):
        raise ByHand("a call in the target of an operator in place", node)
    before = subscript(scope, owner, node.target.slice, node)
    store(scope, owner, node.target, binary(node.op, before, value, node), node)


def unpacked(scope: Scope, value: Expr, count: int, node: Any) -> Sequence[Expr]:
    """Return the rows of an array that is unpacked."""
    array = as_array(value, node)
    kind = array.type
    refuse(not isinstance(kind, t.ArrayType) or kind.ndim < 1, "an array of unknown dimensions is unpacked", node)
    name = scope.hold("rows", array).text
    scope.emit(f"numpy::check_rows({name}, {count});")
    return [row(name, kind, str(index)) for index in range(count)]


def row(name: str, kind: t.ArrayType, index: str) -> Expr:
    """Return what an array has at an index into its first axis."""
    if kind.ndim == 1:
        return Expr(f"{name}[{{{index}}}]", t.number(kind.dtype))
    return Expr(
        f"numpy::view<{kind.ndim - 1}>({name}, {{numpy::at({index})}})",
        replace(kind, ndim=kind.ndim - 1, channels=0, is_mat=False),
    )


def fitted(value: Expr, wanted: t.ArrayType, node: Any) -> str:
    """Return an array in the form that a function has to return."""
    own = value.type
    if wanted.dtype and own.dtype and (own.dtype != wanted.dtype or (own.ndim >= 0 and own.ndim != wanted.ndim)):
        raise ByHand(f"it returns {t.describe(own)}, and {t.describe(wanted)} was recorded", node)
    if own.is_mat == wanted.is_mat:
        return value.text
    is_other = own.is_mat and wanted.ndim not in (2, 3)
    refuse(is_other, f"OpenCV makes {t.describe(wanted)}, which has another shape in OpenCV 4", node)
    if wanted.is_mat:
        return f"numpy::mat({value.text})"
    return f"numpy::array<{t.ELEMENTS[wanted.dtype]}, {wanted.ndim}>({value.text})"
