"""What does a notebook function need to stand in a module of its own?

Imports, small constants and other plain functions are followed; everything else is refused by name.
"""

from __future__ import annotations

import ast
import builtins
import dataclasses
import sys
import types
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Annotated, Any, Final, get_origin

from epypes.bundle.classes import ClassDefinition, class_definition, class_names, made_again
from epypes.bundle.literal import is_data, is_same_data, literal_source
from epypes.bundle.source import Definition, Importable, Refused, definition, importable
from epypes.bundle.uses import global_names, in_module, submodules
from epypes.hints import Param
from epypes.images import Image
from epypes.run.guard import is_plain_array

AnyDefinition = Definition | ClassDefinition

_CONSTANT_CHARACTERS: Final = 400
RESERVED: Final = frozenset({"func_dict", "func_io"})


class Slice:
    """What a module needs, gathered from several functions.

    Parameters
    ----------
    reserved
        The names that the module keeps for the graph.

    Attributes
    ----------
    imports
        Import statements, by the name that each binds and what it binds it to.
    constants
        Source of values, by name.
    definitions
        Functions by name, each after those that it calls.
    refusals
        Why something can't be promoted.
    """

    def __init__(self, reserved: Collection[str] = RESERVED) -> None:
        self.reserved = reserved
        self.imports: dict[tuple[str, str], str] = {}
        self.constants: dict[str, str] = {}
        self.definitions: dict[str, AnyDefinition] = {}
        self.refusals: list[str] = []
        self._meanings: dict[str, tuple[str, object]] = {}
        self._seen: set[int] = set()

    def add_graph_function(self, what: str, function: Callable[..., Any]) -> str:
        """Add a function of the graph; return the expression by which the module refers to it.

        ``what`` is how reasons call it, as ``"Function 'blur'"``.
        """
        home = importable(function)
        try:
            return self._add_definition(function, what).name if home is None else self.reference(home, what)
        except Refused as refusal:
            self.refusals.append(str(refusal))
            return "None"

    def reference(self, home: Importable, what: str) -> str:
        """Return the expression for what can be imported: ``cv2.Canny``, or ``len``, which needs no import."""
        top = home.qualname.partition(".")[0]
        builtin = ("builtin", top)
        if home.module == "builtins" and self._meanings.setdefault(top, builtin) == builtin:
            return home.qualname
        return f"{self.module_name(home.module, what)}.{home.qualname}"

    def is_taken(self, name: str) -> bool:
        """Whether a name means something in the module already."""
        return name in self.reserved or name in self._meanings or hasattr(builtins, name)

    def add_made_constant(self, name: str, source: str) -> None:
        """Add a constant under a name that is not taken."""
        self._claim(name, ("constant", name), f"Constant {name!r}")
        self.constants[name] = source

    def keep_name(self, name: str) -> None:
        """Keep a name that is not taken for what is written below the functions."""
        self._claim(name, ("kept", name), f"Function {name!r}")

    def module_name(self, module: str, what: str) -> str:
        """Import a module, unless a function has brought it already under a name of its own (``np``)."""
        aliases = [name for name, imported in self.imports if imported == module]
        if not aliases:
            self._import_module(module, what)
        return min(aliases, default=module)

    def add_class(self, kind: type, around: Mapping[str, Any] | None, what: str) -> str:
        """Add a class, which reads the names ``around`` it if it is the notebook's; return its expression."""
        home = importable(kind)
        return self.reference(home, what) if home else self._add_definition(kind, what, around).name

    def _add_definition(
        self, function: Callable[..., Any], what: str, around: Mapping[str, Any] | None = None
    ) -> AnyDefinition:
        found = self._found(function, what, around)
        self._claim(found.name, ("object", id(function)), what)
        if id(function) in self._seen:
            return found
        self._seen.add(id(function))
        if isinstance(found, Definition):
            _check_defaults(found, what)
        for name in global_names(found, what) if isinstance(found, Definition) else class_names(found):
            try:
                self._add_name(name, found, what)
            except Refused as refusal:
                self.refusals.append(str(refusal))
        self.definitions[found.name] = found
        return found

    def _found(self, function: Callable[..., Any], what: str, around: Mapping[str, Any] | None) -> AnyDefinition:
        if isinstance(function, type):
            return class_definition(function, self._around(function) if around is None else around, what)
        return definition(function, what)

    def _around(self, kind: type) -> Mapping[str, Any]:
        """Return the names of the notebook that has a class."""
        known = (found.names for found in self.definitions.values())
        return next((names for names in known if names.get(kind.__name__) is kind), vars(sys.modules["__main__"]))

    def _claim(self, name: str, meaning: tuple[str, object], what: str) -> None:
        """Make a name mean one thing in the module."""
        if name in self.reserved:
            raise Refused(f"{what} uses the name {name!r}, which the module keeps for the graph. Rename it.")
        if self._meanings.setdefault(name, meaning) != meaning:
            raise Refused(
                f"{what} uses the name {name!r}, which means something else in another function of the graph. "
                "Rename one of the two."
            )

    def _add_name(self, name: str, found: AnyDefinition, what: str) -> None:
        """Add what one global name of a function means at the time of promotion."""
        names = found.names
        if name not in names:
            if not hasattr(builtins, name):
                raise Refused(f"{what} uses {name!r}, which is not defined ({found.place}). Define it, or rename.")
            return
        value = names[name]
        if isinstance(value, types.ModuleType):
            self._add_module(name, value, found, what)
            return
        home = importable(value, name) if callable(value) or not is_data(value) else None
        if home is not None:
            self._claim(name, ("object", id(value)), what)
            self._import_from(home, name)
        elif isinstance(value, types.FunctionType):
            self._add_helper(name, value, found, what)
        elif isinstance(value, type):
            self._add_notebook_class(name, value, found, what)
        else:
            self._add_constant(name, value, found, what)

    def _add_notebook_class(self, name: str, kind: type, found: AnyDefinition, what: str) -> None:
        if kind.__name__ != name:
            raise Refused(
                f"{what} uses {name!r} ({found.place}), which was defined as class {kind.__name__!r}. "
                "Call it by the name that it was defined with."
            )
        self.add_class(kind, found.names, f"Class {name!r}, which {what[0].lower()}{what[1:]} uses,")

    def _add_helper(self, name: str, helper: types.FunctionType, found: AnyDefinition, what: str) -> None:
        if helper.__name__ != name and helper.__name__ != "<lambda>":
            raise Refused(
                f"{what} calls {name!r} ({found.place}), which was defined as {helper.__name__!r}. "
                "Call it by the name that it was defined with."
            )
        self._add_definition(helper, f"Function {name!r}, which {what[0].lower()}{what[1:]} calls,")

    def _add_constant(self, name: str, value: Any, found: AnyDefinition, what: str) -> None:
        if is_plain_array(value):
            source = self.array_source(value, what)
        else:
            source = self.annotation_source(value, what) or literal_source(value) or self._made(value, found, what)
        if not source or len(source) > _CONSTANT_CHARACTERS:
            kind = f"the class {name!r}" if isinstance(value, type) else f"of type {type(value).__name__}"
            raise Refused(
                f"{what} is defined in the notebook ({found.place}) and uses {name!r} from it, {kind}. "
                f"Make {name} a token, make it inside the function, or move both into a module that is installed."
            )
        if self.constants.get(name, source) != source:
            raise Refused(f"{what} uses {name!r}, which has another value elsewhere. Rename one of the two.")
        if name not in self.constants:
            self._claim(name, ("constant", name), what)
            self.constants[name] = source

    def _made(self, value: Any, found: AnyDefinition, what: str) -> str:
        """Return the expression that makes a member of an enumeration, or a record of literals, again."""

        def class_of(kind: type) -> str:
            told = f"Class {kind.__name__!r} of a value that {what[0].lower()}{what[1:]} uses"
            return self.add_class(kind, found.names, told)

        return made_again(value, lambda part: literal_source(part) or self._made(part, found, what), class_of)

    def annotation_source(self, value: Any, what: str) -> str:
        """Return the source of a mark, or of ``Annotated`` with marks, as annotations use them; "" for any other."""
        if isinstance(value, Image | Param):
            given = [(field.name, getattr(value, field.name), field.default) for field in dataclasses.fields(value)]
            words = [(name, literal_source(setting)) for name, setting, default in given if setting != default]
            if not all(source for _, source in words):
                return ""
            listed = ", ".join(f"{name}={source}" for name, source in words)
            return f"{self.module_name('epypes', what)}.{type(value).__name__}({listed})"
        home = importable(value.__origin__) if get_origin(value) is Annotated else None
        parts = [self.annotation_source(mark, what) for mark in value.__metadata__] if home else [""]
        if home is None or not all(parts):
            return ""
        plain = home.qualname if home.module == "builtins" else f"{self.module_name(home.module, what)}.{home.qualname}"
        return f"{self.module_name('typing', what)}.Annotated[{plain}, {', '.join(parts)}]"

    def array_source(self, array: Any, what: str) -> str:
        """Return a small array of numbers as source that makes it again, to the last bit; "" for any other."""
        import numpy as np

        if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8 or array.size * 2 > _CONSTANT_CHARACTERS:
            return ""
        listed = repr(array.tolist())
        if "nan" in listed or "inf" in listed or np.array(array.tolist(), array.dtype).shape != array.shape:
            return ""
        return f"{self.module_name('numpy', what)}.array({listed}, dtype={str(array.dtype)!r})".replace("'", '"')

    def _add_module(self, name: str, module: types.ModuleType, found: AnyDefinition, what: str) -> None:
        if module.__name__ == "__main__":
            raise Refused(f"{what} uses the notebook itself as module {name!r} ({found.place}).")
        if name != module.__name__:
            self._claim(name, ("object", id(module)), what)
            self.imports[name, module.__name__] = f"import {module.__name__} as {name}"
            return
        for dotted in submodules(found.node, name, module) or (name,):
            self._import_module(dotted, what)

    def _import_module(self, module: str, what: str) -> None:
        top = module.partition(".")[0]
        self._claim(top, ("module", top), what)
        self.imports[module, module] = f"import {module}"

    def _import_from(self, home: Importable, name: str) -> None:
        top, _, rest = home.qualname.partition(".")
        alias = "" if name == top else f" as {name}"
        if rest:
            # A nested name can't be imported by itself.
            raise Refused(
                f"{name!r} is {home.module}.{home.qualname}, a name inside a class. Use it through the class."
            )
        self.imports[name, f"{home.module}.{top}"] = f"from {home.module} import {top}{alias}"


def _check_defaults(found: Definition, what: str) -> None:
    for default, value in _defaults(found, what):
        text = f"{what} has the default {ast.unparse(default)!r} ({found.place})"
        try:
            written = ast.literal_eval(default)
        except ValueError:
            if _is_constant(value) and in_module(default, found.function.__globals__) is value:
                continue
            raise Refused(f"{text}, which is no literal and no constant of a module. Write the value itself.") from None
        if not is_same_data(written, value):
            raise Refused(f"{text}, which has another value by now. Define the function again, with that value.")


def _defaults(found: Definition, what: str) -> Iterator[tuple[ast.expr, Any]]:
    """Return every default as it is written, with its value."""
    arguments, function = found.node.args, found.function
    by_position, by_name = function.__defaults__ or (), function.__kwdefaults__ or {}
    named = zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    written = {argument.arg: default for argument, default in named if default}
    if len(by_position) != len(arguments.defaults) or by_name.keys() != written.keys():
        text = f"{what} has other parameters with defaults by now than its text says ({found.place})."
        raise Refused(f"{text} Define the function again, with these defaults.")
    yield from zip(arguments.defaults, by_position, strict=True)
    yield from ((default, by_name[name]) for name, default in written.items())


def _is_constant(value: object) -> bool:
    return isinstance(value, type) or type(value) in (bool, int, float, complex, str, bytes)


def slice_functions(gathered: Slice, functions: Sequence[tuple[str, Callable[..., Any]]]) -> list[str]:
    """Add functions of graphs, each given with how reasons call it; return the expressions that refer to them."""
    homes = {id(function): importable(function) for _, function in functions}
    # The notebook's own functions first: they know by which names they import modules.
    own_first = sorted(range(len(functions)), key=lambda index: homes[id(functions[index][1])] is not None)
    references: dict[int, str] = {}
    known: dict[int, str] = {}
    for index in own_first:
        what, function = functions[index]
        refused = len(gathered.refusals)
        references[index] = known.get(id(function)) or gathered.add_graph_function(what, function)
        if len(gathered.refusals) == refused:
            known[id(function)] = references[index]
    return [references[index] for index in range(len(functions))]


def slice_graph(functions: Mapping[str, Callable[..., Any]]) -> tuple[Slice, dict[str, str]]:
    """Slice all functions of a graph.

    Returns
    -------
    tuple
        What the module needs, and by function of the graph the expression that refers to it.
    """
    gathered = Slice()
    references = slice_functions(gathered, [(f"Function {name!r}", function) for name, function in functions.items()])
    return gathered, dict(zip(functions, references, strict=True))
