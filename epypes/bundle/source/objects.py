"""Objects: what a value is made of, as a kind, exact content, and named parts that are values again.

Two walks stand on it: the comparison of a notebook's objects with a module's (`equivalence`), and the digest of a value
and of all that it refers to (`fingerprint`). What this module leaves out of an object is seen by neither.

Functions and classes of the user are described by what they do; what an installed package or Python's library has under
a name, by that name. An object of the user's classes is made of its attributes and slots; one of a library, of what
`pickle` would write of it; what pickle can't write, such as a key point of OpenCV, of the message that carries it.
"""

from __future__ import annotations

import copyreg
import dataclasses
import enum
import functools
import importlib.util
import inspect
import re
import sys
import threading
import types
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from epypes.bundle.private_import import import_module, loaded_module, plain_name
from epypes.bundle.proof.compare import exact_text
from epypes.bundle.source.expressions import has_steady_order
from epypes.bundle.source.references import defaults_of, imported_modules, meanings_of, nested_codes, reads_of
from epypes.errors import InvalidType
from epypes.graph import CompGraph
from epypes.pipeline import Node, Pipeline
from epypes.run import CompGraphRunner
from epypes.run.guard import as_written, is_plain_array, is_unguarded
from epypes.run.snapshot import cached_properties, is_own
from epypes.wire.encoder import ValueWriter, set_sort_key
from epypes.wire.protobuf import message_class

ATOMS: Final = frozenset(
    {int, float, complex, bool, str, bytes, type(None), type(...), type(NotImplemented)}
)  # fmt: skip
# The labels of what the comparison or the digest leaves out begin like this.
ANNOTATION: Final = " annotation of "
CACHED: Final = " cached "
CODE: Final = " code"
_ADDRESS: Final = re.compile(r" at 0x[0-9a-fA-F]+")
# What Python adds to a class, and what is described in another way.
_OF_EVERY_CLASS: Final = frozenset(
    {"__module__", "__qualname__", "__doc__", "__annotations__", "__annotate__", "__annotate_func__"}
    | {"__annotations_cache__", "__static_attributes__", "__firstlineno__", "__slotnames__", "_abc_impl"}
    | {"__dataclass_params__"}
)
# Tables of an enumeration's members, some of which grow when it is used; a member's own names.
_OF_ENUMS: Final = frozenset(
    {"_member_names_", "_member_map_", "_value2member_map_", "_hashable_values_", "_unhashable_values_"}
    | {"_unhashable_values_map_", "_name_", "_value_", "_inverted_"}
)
_OF_A_NODE: Final = frozenset({*vars(Node("", len))})
# The registry of these is described without their cache, which each call may fill.
_SINGLE_DISPATCH: Final = frozenset(nested_codes(functools.singledispatch.__code__))
# Builtins by which code reads attributes that its names don't say.
ATTRIBUTES_BY_TEXT: Final = frozenset({"getattr", "vars", "__dict__"})
# The folders that pip, and Debian's packages, install into.
INSTALLED: Final = frozenset({"site-packages", "dist-packages"})
_NUMBERS_AND_TEXTS: Final[tuple[Any, ...]] = (tuple, str, bytes, int, float, complex)
_CONTENTS: Final[Mapping[type, Callable[[Any], Any]]] = {
    **{kind: kind.__getnewargs__ for kind in _NUMBERS_AND_TEXTS},
    list: list.copy,
    dict: dict.copy,
}


class Description(NamedTuple):
    """What a value is made of.

    Attributes
    ----------
    kind
        What it is, as text: the name of its type.
    content
        Its own content, exactly.
    parts
        What else it is made of: labels as a reason gives them, such as ``" default of 'k'"`` or ``"[0]"``, and values.
    is_state
        Whether a call may change it: lists, dicts, arrays and other objects.
    is_pickled
        Whether it is described as pickle does it, which may be a name in place of the content.
    module
        The name of the module that defines it; "" if none does.
    """

    kind: str
    content: tuple[str | bytes | memoryview, ...] = ()
    parts: Iterable[tuple[str, Any]] = ()
    is_state: bool = False
    is_pickled: bool = False
    module: str = ""


def describe(value: Any) -> Description:
    """Return what a value is made of.

    Raises
    ------
    Exception
        Whatever an object raises that neither pickle nor a message can carry.
    """
    kind = type(value)
    if kind in ATOMS:
        return Description(kind.__name__, (atom_content(value),))
    if is_plain_array(value) and not value.dtype.hasobject:
        return _array(value)
    if home := _home(value):
        return Description("installed", (".".join(home),), module=home[0])
    way = next((way for kinds, way in _WAYS if isinstance(value, kinds)), _object)
    return way(value)


def atom_content(value: Any) -> str | bytes:
    """Return a number or text exactly."""
    if type(value) in (str, bytes):
        return cast("str | bytes", value)
    if type(value) in (float, complex):
        return exact_text(value)
    # Python refuses to write very long numbers as decimals.
    return hex(value) if type(value) is int else repr(value)


def without_nodes(value: Any) -> Any:
    """Return the function of a plain node; anything else, also a node of the user's own class, as it was written."""
    value = as_written(value)
    while type(value) is Node:
        value = as_written(value.func)
    return value


# -- containers ------------------------------------------------------------------------------------------------------


def _array(array: Any) -> Description:
    import numpy as np

    data = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data if array.nbytes else b""
    return Description("array", (repr(array.dtype), repr(array.shape), data), is_state=True)


def _sequence(value: Any) -> Description:
    if type(value) not in (tuple, list):
        return _object(value)
    parts = [(f"[{number}]", part) for number, part in enumerate(value)]
    return Description(type(value).__name__, parts=parts, is_state=type(value) is list)


def _set(value: Any) -> Description:
    if type(value) not in (set, frozenset):
        return _object(value)
    # The order of most sets is another one in each process.
    steady = has_steady_order(value)
    elements = [*value] if steady else sorted(value, key=lambda part: _ADDRESS.sub("", set_sort_key(part)))
    return Description(type(value).__name__, parts=[(" elements", tuple(elements))], is_state=type(value) is set)


def _mapping(value: Any) -> Description:
    kind = type(value)
    if kind not in _MAPPINGS:
        return _object(value)
    parts: list[tuple[str, Any]] = [(f"[{key!r}]", part) for key, part in value.items()]
    if not all(type(key) in ATOMS and key == key for key in value):
        parts = [(" keys", [*value]), (" values", [*value.values()])]
    return Description(kind.__name__, parts=parts, is_state=True)


# -- code ------------------------------------------------------------------------------------------------------------


def _code(code: types.CodeType) -> Description:
    counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    names = code.co_name, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    instructions = repr((counts, names)), code.co_code, code.co_exceptiontable
    return Description("code", instructions, [(" constants", code.co_consts)])


def _function(function: types.FunctionType) -> Description:
    code = function.__code__
    # The code of a library says what it reads of its own module.
    home = str(function.__globals__.get("__name__")) if is_of_library(function) else ""
    meanings = meanings_of(function, code.co_freevars) if home else reads_of(function)
    parts: list[tuple[str, Any]] = [(CODE, code)]
    parts += ((f" default of {name!r}", value) for name, value in sorted(defaults_of(function).items()))
    parts += _annotations(function)
    if code in _SINGLE_DISPATCH:
        parts.append((" attribute 'registry'", meanings.get("registry", vars(function).get("registry"))))
    else:
        parts += ((f" {name!r}", meanings[name]) for name in sorted(meanings))
        parts += _marks(function)
    return Description("function", (home,), parts, module=str(function.__module__))


def is_of_library(function: types.FunctionType) -> bool:
    """Whether a function has the names of a module that is installed."""
    name = str(function.__globals__.get("__name__"))
    return getattr(sys.modules.get(name), "__dict__", None) is function.__globals__ and is_installed(name)


def _annotations(value: Any) -> Iterator[tuple[str, Any]]:
    with suppress(NameError):  # from Python 3.14 on they are evaluated when they are read
        yield from ((f"{ANNOTATION}{name!r}", found) for name, found in inspect.get_annotations(value).items())


def _marks(function: Any) -> list[tuple[str, Any]]:
    """Return the attributes of a function but for those of EPypes and what functools.wraps copies."""
    own = getattr(function, "__dict__", {})
    left_out = {*functools.WRAPPER_ASSIGNMENTS, *(name for name in own if name.startswith("__epypes_"))}
    found = {name: own[name] for name in own.keys() - left_out}
    if isinstance(function, types.FunctionType) and "__wrapped__" not in found:
        found["__doc__"] = function.__doc__
        # The module may have it under another name, unlike one that was set later.
        if function.__name__ != function.__code__.co_name:
            found["__name__"] = function.__name__
    if is_unguarded(function):
        found["@ep.unguarded"] = True
    return _attributes(found)


def _cached_function(cached: Any) -> Description:
    parts = [(" parameters", cached.cache_parameters()), (" function", cached.__wrapped__), *_marks(cached)]
    return Description("lru_cache", parts=parts)


def _module(module: types.ModuleType) -> Description:
    return Description("module", (plain_name(module.__name__),), module=module.__name__)


def _class(kind: type) -> Description:
    left_out = {*_OF_EVERY_CLASS}
    parts: list[tuple[str, Any]] = [(" metaclass", type(kind)), (" bases", kind.__bases__), *_annotations(kind)]
    if isinstance(kind.__doc__, str):  # a class of C code may have a descriptor for it
        parts.append((f"{ANNOTATION}its docstring", kind.__doc__))
    if "__dataclass_params__" in vars(kind):
        parts.append((" options", repr(vars(kind)["__dataclass_params__"])))
    if isinstance(kind, enum.EnumMeta):
        members: Mapping[str, Any] = kind.__members__
        left_out |= {*members, *_OF_ENUMS}
        parts += ((f" member {name!r}", member) for name, member in members.items())
    slots = types.MemberDescriptorType, types.GetSetDescriptorType
    own = {name: value for name, value in vars(kind).items() if name not in left_out and not isinstance(value, slots)}
    # What the user has named comes first in a reason.
    names = sorted(own, key=lambda name: (name.startswith("__"), name))
    parts += ((f" {name!r}", own[name]) for name in names)
    return Description("class", (kind.__name__,), parts, module=kind.__module__)


# -- graphs ----------------------------------------------------------------------------------------------------------


def _graph(cg: CompGraph) -> Description:
    parts: list[tuple[str, Any]] = [(" class", type(cg))]
    parts += ((f" function {name!r}", function) for name, function in cg.functions.items())
    parts += ((f" io of {name!r}", io) for name, io in cg.func_io.items())
    parts += ((f" default of {token!r}", value) for token, value in cg.defaults.items())
    parts += ((f" delay of {token!r}", (delay.token, delay.initial)) for token, delay in cg.delays.items())
    return Description("graph", parts=parts)


def _node(node: Node) -> Description:
    """Describe a node by what it was made with, and the attributes that not every node has."""
    parts: list[tuple[str, Any]] = [(" class", type(node)), (" name", node.name)]
    parts += _graph_parts(node) if isinstance(node, Pipeline) else [(" function", node.func)]
    has_own = not is_installed(type(node).__module__)
    if has_own:
        parts += _attributes({name: value for name, value in vars(node).items() if name not in _OF_A_NODE})
    return Description("node", parts=parts, is_state=has_own)


def _runner(runner: CompGraphRunner) -> Description:
    return Description("runner", parts=[(" class", type(runner)), *_graph_parts(runner)])


def _graph_parts(value: Any) -> list[tuple[str, Any]]:
    runner = value.runner if isinstance(value, Pipeline) else value
    parts: list[tuple[str, Any]] = [(" graph", getattr(value, "source_cg", runner.cg)), (" workers", runner.workers)]
    parts.append((" guard", runner.guard))
    return parts + [(f" hyperparameter {token!r}", given) for token, given in runner.hyperparameters.items()]


# -- objects ---------------------------------------------------------------------------------------------------------


def _member(member: enum.Enum) -> Description:
    own = {name: value for name, value in vars(member).items() if name not in _OF_ENUMS}
    parts = [(" class", type(member)), (" name", member.name), (" value", member.value), *_attributes(own)]
    return Description(type(member).__name__, parts=parts)


def _by_attributes(value: Any) -> Description:
    kind = type(value)
    names = next(names for base, names in _ATTRIBUTES.items() if isinstance(value, base))
    parts: list[tuple[str, Any]] = [(f" {name.strip('_')}", getattr(value, name)) for name in names]
    parts += _marks(value) if kind in _ATTRIBUTES else [(" class", kind), *_own(value)]
    return Description(kind.__name__, parts=parts)


def _lock(value: Any) -> Description:
    return Description("lock", (repr(value).partition(" ")[0],), is_state=True)


def _object(value: Any) -> Description:
    kind = type(value)
    if is_installed(kind.__module__):
        return _library_object(value)
    parts = [(" class", kind), *_own(value)]
    # What it is besides: a tuple, a list, a dict, a number; or what C keeps in it, which is seen only by a copy of it.
    base = next(base for base in kind.__mro__ if is_installed(base.__module__))
    if base in _CONTENTS:
        parts.append((" content", _CONTENTS[base](value)))
    elif base is not object:
        parts += _library_object(value).parts
    return Description(kind.__name__, parts=parts, is_state=True)


def _own(value: Any) -> list[tuple[str, Any]]:
    """Return the attributes of an object, also those in slots."""
    own = {**getattr(value, "__dict__", {})}
    for name, slot in _slots(type(value)).items():
        with suppress(AttributeError):
            own[name] = slot.__get__(value)
    return _attributes(own, cached_properties(type(value)))


def _slots(kind: type) -> dict[str, types.MemberDescriptorType]:
    return {
        name: part
        for base in kind.__mro__
        for name, part in vars(base).items()
        if isinstance(part, types.MemberDescriptorType)
    }


def _attributes(own: Mapping[str, Any], cached: Iterable[str] = ()) -> list[tuple[str, Any]]:
    return [(f"{CACHED if name in cached else ' attribute '}{name!r}", own[name]) for name in sorted(own)]


def _library_object(value: Any) -> Description:
    kind = type(value)
    try:
        with warnings.catch_warnings(action="ignore"):
            reduce = copyreg.dispatch_table.get(kind)
            made: Any = reduce(value) if reduce else value.__reduce_ex__(4)
    except Exception:  # whatever an object raises that pickle can't write
        return describe_message(value)
    if isinstance(made, str):
        module = getattr(value, "__module__", None)
        module = module or next((home for home in [*sys.modules] if _found(home, made) is value), "")
        if _found(module, made) is not value:
            raise InvalidType(f"{made!r} can't be found in {module!r}")
        return Description("global", (module, made), module=module)
    by, arguments, state, items, pairs = (*made, None, None, None)[:5]
    parts = [(" class", kind), (" maker", by), (" arguments", arguments), (" state", _without_computed(kind, state))]
    parts += [(" items", [*(items or ())]), (" entries", [*(pairs or ())])]
    # A method of an object is no state, but the object is.
    is_state = not isinstance(value, types.BuiltinFunctionType)
    return Description(kind.__name__, parts=parts, is_state=is_state, is_pickled=True)


def _without_computed(kind: type, state: Any) -> Any:
    """Return a state without what is computed from the rest when it is first needed, and without addresses."""
    if type(state) is tuple and any(base.__name__ == "cKDTree" for base in kind.__mro__):
        return state[1:]  # the nodes, which are in the order of the indices that follow, point to each other
    if type(state) is tuple and len(state) == 2 and type(state[0]) is dict:
        return _without_computed(kind, state[0]), state[1]
    computed = {*cached_properties(kind), *({"_ufunc"} if (kind.__module__, kind.__name__) == _VECTORIZE else ())}
    return (
        {name: state[name] for name in sorted(state, key=str) if name not in computed} if type(state) is dict else state
    )


_VECTORIZE: Final = ("numpy", "vectorize")


def describe_message(value: Any) -> Description:
    """Describe a value by the message that carries it.

    Raises
    ------
    MessageError
        None can.
    """
    message, writer = message_class("epypes.v1.Value")(), ValueWriter()
    writer.write_named(message, value, "value")
    payloads = tuple(payload.data for payload in writer.payloads)
    return Description("message", (message.SerializeToString(deterministic=True),), [("", payloads)], is_state=True)


# -- modules ---------------------------------------------------------------------------------------------------------


def is_installed(module: str) -> bool:
    """Whether a module is of an installed package, of Python's library or of EPypes."""
    return module != "__main__" and not is_own(module.partition(".")[0])


def will_be_installed(module: str) -> bool:
    """Whether a module, which is not imported for it, is of an installed package."""
    top = module.partition(".")[0]
    if loaded_module(top):
        return is_installed(top)
    spec = importlib.util.find_spec(top)
    return spec is not None and not INSTALLED.isdisjoint(Path(spec.origin or "").parts)


def module_reads(function: types.FunctionType) -> list[tuple[str, Any]]:
    """Return what a function reads of modules of the user, by name, also of those that it imports when it is called."""
    codes = [*nested_codes(function.__code__)]
    used = {name for code in codes for name in code.co_names}
    found: list[tuple[str, Any]] = []
    for name in imported_modules(function):
        with suppress(Exception):  # the function raises the same when it is called
            if not will_be_installed(name):
                found.append((plain_name(name), import_module(name)))
    waiting, seen = [*reads_of(function).items(), *found], set[str]()
    while waiting:
        name, value = waiting.pop()
        if isinstance(value, types.ModuleType) and value.__name__ not in seen and not is_installed(value.__name__):
            seen.add(value.__name__)
            own = {one: part for one, part in vars(value).items() if not one.startswith("__")}
            read = own.keys() if ATTRIBUTES_BY_TEXT & used else used & own.keys()
            new = [(f"{name}.{one}", own[one]) for one in sorted(read)]
            found += new
            waiting += new
    return found


def _home(value: Any) -> tuple[str, str] | None:
    """Return the module and the name by which a function or class of an installed package is imported."""
    if not callable(value):
        return None
    owner = getattr(value, "__self__", None)
    module = owner.__name__ if isinstance(owner, types.ModuleType) else getattr(value, "__module__", None)
    module = module or type(value).__module__
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    if not isinstance(name, str) or not isinstance(module, str) or _found(module, name) is not value:
        return None
    return (module, name) if is_installed(module) else None


def _found(module: str, name: str) -> Any:
    first, *rest = name.split(".")
    # Not by getattr, which would run the module's own __getattr__.
    found: Any = getattr(loaded_module(module), "__dict__", {}).get(first)
    for part in rest:
        found = getattr(found, part, None)
    return found


# -- kinds -----------------------------------------------------------------------------------------------------------

_MAPPINGS: Final = (dict, types.MappingProxyType, weakref.WeakKeyDictionary, weakref.WeakValueDictionary)
_ATTRIBUTES: Final[Mapping[type, tuple[str, ...]]] = {
    functools.partial: ("func", "args", "keywords"),
    types.MethodType: ("__func__", "__self__"),
    property: ("fget", "fset", "fdel"),
    functools.cached_property: ("func", "attrname"),
    staticmethod: ("__func__",),
    classmethod: ("__func__",),
    dataclasses.Field: (
        "name", "default", "default_factory", "init", "repr", "hash", "compare", "metadata", "kw_only", "_field_type",
    ),
}  # fmt: skip
_WAYS: Final[tuple[tuple[Any, Callable[[Any], Description]], ...]] = (
    (types.FunctionType, _function),
    (types.CodeType, _code),
    (type, _class),
    (enum.Enum, _member),
    ((tuple, list), _sequence),
    ((set, frozenset), _set),
    (_MAPPINGS, _mapping),
    (types.ModuleType, _module),
    (functools._lru_cache_wrapper, _cached_function),
    ((type(threading.Lock()), type(threading.RLock())), _lock),
    (tuple(_ATTRIBUTES), _by_attributes),
    (CompGraph, _graph),
    (Node, _node),
    (CompGraphRunner, _runner),
)
