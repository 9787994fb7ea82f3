"""Identity of functions: what they wrap, whether two are the same, and whether one was redefined since."""

from __future__ import annotations

import sys
from types import CodeType, FunctionType, MethodType
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from epypes.graph.compgraph import CompGraph

# A mock object wraps itself without end, and no function is wrapped this deep on purpose.
_DEEPEST: Final = 100


def innermost(function: object) -> object:
    """Follow ``__wrapped__`` to the function that a node or a decorator wraps, which is called in the same way."""
    for _ in range(_DEEPEST):
        try:
            function = vars(function)["__wrapped__"]
        except Exception:  # it has no attributes, it wraps nothing, or it raises when it is looked at
            break
    return function


def unwrapped(function: Any) -> Any:
    """Return the Python function in a decorated one, a node, a partial or a method."""
    for _ in range(_DEEPEST):
        names = ("__wrapped__", "__func__", "func")
        inner = next((found for name in names if callable(found := getattr(function, name, None))), None)
        if inner is None:
            break
        function = inner
    return function


def inner_graph(function: Any) -> CompGraph | None:
    """Return the graph that a pipeline runs, None for anything else. Never raises."""
    if type(function) is FunctionType:
        return None
    from epypes.graph.compgraph import CompGraph

    try:
        inner = getattr(function, "cg", None) if hasattr(type(function), "cg") else None
        return inner if isinstance(inner, CompGraph) else None
    except Exception:  # whatever an object's __getattr__ raises
        return None


def inside_of(cg: CompGraph, token: str) -> tuple[CompGraph, str]:
    """Return the graph of the pipeline that ``"geometry__threshold"`` is a hyperparameter of, and its token there.

    Of any other name the graph itself, and the name.
    """
    for name, function in cg.functions.items() if "__" in token and token not in cg.tokens else ():
        inner = inner_graph(function) if token.startswith(f"{name}__") else None
        if inner is not None:
            found = inside_of(inner, token.removeprefix(f"{name}__"))
            if found[1] in found[0].source_tokens:
                return found
    return cg, token


def redefined(cg: CompGraph) -> tuple[str, ...]:
    """Return the functions whose module now binds their name to another function, in run order.

    A function that was defined again in the same words counts as the same. A pipeline counts as redefined if a function
    of its graph does. Never raises.

    Examples
    --------
    >>> from epypes.graph import CompGraph
    >>> redefined(CompGraph({"f": lambda x: x}, {"f": ("x", "y")}))
    ()
    """
    return tuple(name for name, function in cg.functions.items() if _is_redefined(function))


def is_redefined_inside(function: Any) -> bool:
    """Whether a function is a pipeline, and a function of its graph is redefined. Never raises."""
    inner = inner_graph(function)
    return inner is not None and bool(redefined(inner))


def _is_redefined(function: Any) -> bool:
    try:
        if is_redefined_inside(function):
            return True
        old = unwrapped(function)
        if not isinstance(old, FunctionType):
            return False
        new = unwrapped(_bound_now(old.__module__, old.__qualname__))
        return isinstance(new, FunctionType) and new is not old and not _is_defined_alike(old, new)
    except Exception:  # a repr shows this; whatever odd objects do, it must not fail
        return False


def _bound_now(module: str, qualname: str) -> Any:
    """Return what the module binds to the name, without asking anything that runs code; None if there is nothing."""
    found: Any = sys.modules.get(module)
    for part in qualname.split("."):
        if found is None or part == "<locals>":
            return None
        found = vars(found).get(part)
    return found


def is_same_function(left: Any, right: Any) -> bool:
    """Whether two callables are one function: the same object, bound method or definition, run again unchanged."""
    # A bound method is a new object each time it is read; two are equal if they are bound to one object.
    if type(left) is MethodType and type(right) is MethodType:
        return left == right
    return left is right or (have_one_name(left, right) and _is_defined_alike(left, right))


def have_one_name(left: object, right: object) -> bool:
    """Whether these are functions of one name in one module, as a function and its later definition are."""
    if not isinstance(left, FunctionType) or not isinstance(right, FunctionType):
        return False
    return left.__globals__ is right.__globals__ and left.__qualname__ == right.__qualname__ != "<lambda>"


def _is_defined_alike(old: FunctionType, new: FunctionType) -> bool:
    """Whether two functions were defined in the same words, defaults included, and depend on nothing around them."""
    if old.__closure__ or new.__closure__:
        return False
    declared = [(each.__defaults__, each.__kwdefaults__, each.__annotations__) for each in (old, new)]
    return is_same_default(*declared) and _at_line_one(old.__code__) == _at_line_one(new.__code__)


def _at_line_one(code: CodeType) -> CodeType:
    """Return the code as if it were defined in the first line: a line more above it in the cell changes nothing."""
    constants = tuple(_at_line_one(item) if isinstance(item, CodeType) else item for item in code.co_consts)
    return code.replace(co_firstlineno=1, co_consts=constants)


def is_same_default(left: Any, right: Any) -> bool:
    """Whether two defaults or annotations are the same, to the last bit: 2 is not 2.0, nor 0.0 -0.0, nor 1 True."""
    if left is right:
        return True
    if type(left) is not type(right):
        return False
    if type(left) in (tuple, list):
        return len(left) == len(right) and all(map(is_same_default, left, right))
    if type(left) is dict:
        return is_same_default(list(left.items()), list(right.items()))
    if hasattr(type(left), "tobytes") and hasattr(type(left), "dtype"):
        # An array: NumPy is not imported here.
        same = left.dtype == right.dtype and left.shape == right.shape and not left.dtype.hasobject
        return bool(same and left.tobytes() == right.tobytes())
    try:
        # Objects that are equal may differ in what they hold, as a range from 1 and one from 1.0; NaN equals nothing.
        return repr(left) == repr(right) and (bool(left == right) or bool(left != left))
    except Exception:  # whatever an object's own comparison raises
        return False
