"""The slice of a notebook that some of its functions need to stand in a module of their own.

Imports, constants, classes and other functions of the notebook are followed; everything else is refused by name.
"""

from __future__ import annotations

import ast
import builtins
import dataclasses
import enum
import sys
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, Final

from epypes.bundle.classes import class_definition, class_names
from epypes.bundle.definitions import (
    Definition,
    FactoryCall,
    default_values,
    defaults_in,
    factory_call,
    found_definition,
    global_names,
    method_of,
    only_in_annotations,
    submodules,
)
from epypes.bundle.expressions import Arrays, expression
from epypes.bundle.module import AnyDefinition, Position, Positions, Remark, imported_as, remark_on
from epypes.bundle.notebook_source import names_of, renamed, with_defaults
from epypes.bundle.resolve import Importable, Refused, evaluated, holds_functions, importable, is_function
from epypes.bundle.side_effects import check_asked, check_home, check_patches, check_state
from epypes.bundle.syntax import (
    identifier_of,
    is_data,
    is_identifier,
    is_same_data,
    laid_out,
    literal_source,
    literal_value,
)
from epypes.run.guard import WATCH

Meaning = tuple[str, object]


def of_object(value: object) -> Meaning:
    """Return the meaning of a name for an object."""
    return "object", id(value)


class Names:
    """The names of a module.

    Parameters
    ----------
    reserved
        The names that the module keeps for the graph.

    Attributes
    ----------
    read
        What functions read by name: these names are theirs before anything is named freely.
    """

    def __init__(self, reserved: Collection[str]) -> None:
        self.reserved = reserved
        self.read: dict[str, object] = {}
        self._meanings: dict[str, Meaning] = {}

    def claim(self, name: str, meaning: Meaning, what: str) -> None:
        """Make a name mean one thing in the module.

        Raises
        ------
        Refused
            It means another.
        """
        if name in self.reserved:
            raise Refused(f"{what} uses the name {name!r}, which the module keeps for the graph. Rename it.")
        if not self.may_mean(name, meaning):
            raise Refused(
                f"{what} uses the name {name!r}, which means something else in another function of the graph. "
                "Rename one of the two."
            )

    def may_mean(self, name: str, meaning: Meaning) -> bool:
        """Whether a name means this, or does from now on because it meant nothing."""
        return self._meanings.setdefault(name, meaning) == meaning

    def is_taken(self, name: str) -> bool:
        """Whether a name means something in the module already."""
        return name in self.reserved or name in self._meanings or name in self.read or hasattr(builtins, name)

    def is_free(self, name: str, value: object) -> bool:
        """Whether a name can mean an object, and hides nothing."""
        if name in self.read:
            return self.read[name] is value
        if name in self.reserved or self._meanings.get(name, of_object(value)) != of_object(value):
            return False
        return not hasattr(builtins, name) and name not in sys.modules

    def name_for(self, function: object, found: Definition, wanted: str) -> str:
        """Return what a function is called in the module: as in the notebook, if that means nothing else there."""
        own, bound = "" if found.is_lambda else found.name, names_of(function, found.names)
        is_known_otherwise = bool(found.captured) or found.names.get(own, function) is not function
        others = [wanted, own] if is_known_otherwise else [own, wanted]
        candidates = [*(name for name in bound if name == own), *bound, *others]
        free = (name for name in candidates if is_identifier(name) and self.is_free(name, function))
        return next(free, "") or identifier_of(own or wanted or found.name, self.is_taken)

    def alias_for(self, value: object, notebook: Mapping[str, object], own: str) -> str:
        """Return the name that a notebook has for an object besides its own; "" if it has none that is free."""
        known = names_of(value, notebook)
        return "" if own in known else next((name for name in known if self.is_free(name, value)), "")


_CONSTANT_CHARACTERS: Final = 400
RESERVED: Final = frozenset({"func_dict", "func_io"})


@dataclasses.dataclass(frozen=True, slots=True)
class Written:
    """What the module defines under a name: a function, or what an expression makes."""

    name: str
    text: str


class Slice:
    """What a module needs, gathered from several functions.

    Parameters
    ----------
    reserved
        The names that the module keeps for the graph.
    keeps_arrays
        Whether large arrays are kept as files beside the module.
    uncalled
        The ids of closures that are written with what they have captured, since a call of their factory gives another.

    Attributes
    ----------
    names
        What its names mean.
    imports
        Import statements, by the name that each binds and what it binds it to.
    constants
        Source of values, by name.
    remarks
        What the notebook says about constants, by name.
    definitions
        Functions, classes, and objects made of them, by name.
    positions
        Where the notebook has them, as far as that is known.
    reads
        The names that they read from outside, as far as that is known.
    refusals
        Why something can't be promoted.
    called
        The names of closures that are made by a call of their factory, by id.
    """

    def __init__(
        self, reserved: Collection[str] = RESERVED, *, keeps_arrays: bool = False, uncalled: Collection[int] = ()
    ) -> None:
        self.names = Names(reserved)
        self.keeps_arrays, self.arrays = keeps_arrays, Arrays(keeps_arrays)
        self.imports: dict[tuple[str, str], str] = {}
        self.constants: dict[str, str] = {}
        self.remarks: dict[str, Remark] = {}
        self.definitions: dict[str, Written] = {}
        self.refusals: list[str] = []
        self.uncalled = frozenset(uncalled)
        self.called: dict[int, str] = {}
        self._known: dict[int, str] = {}
        self.positions: dict[str, Position] = {}
        self.reads: dict[str, frozenset[str]] = {}
        self._places = Positions()

    def add_graph_function(self, what: str, function: Callable[..., Any], wanted: str = "") -> str:
        """Add a function of the graph; return the expression by which the module refers to it.

        ``what`` is how reasons call it, as ``"Function 'blur'"``; ``wanted`` its name if it has none of its own.
        """
        try:
            return self._callable(function, what, wanted)
        except Refused as refusal:
            self.refusals.append(str(refusal))
            return "None"

    def reference(self, home: Importable, what: str) -> str:
        """Return the expression for what can be imported: ``cv2.Canny``, or ``len``, which needs no import."""
        check_home(home, what)
        top = home.qualname.partition(".")[0]
        known = [name for name, imported in self.imports if imported == f"{home.module}.{top}"]
        if known:
            return min(known) + home.qualname.removeprefix(top)
        builtin = ("builtin", top)
        if home.module == "builtins" and self.names.may_mean(top, builtin):
            return home.qualname
        return f"{self.module_name(home.module, what)}.{home.qualname}"

    def is_taken(self, name: str) -> bool:
        """Whether a name means something in the module already."""
        return self.names.is_taken(name)

    def add_made_constant(self, name: str, source: str) -> None:
        """Add a constant under a name that is not taken."""
        self.names.claim(name, ("constant", name), f"Constant {name!r}")
        self.constants[name] = source

    def keep_name(self, name: str) -> None:
        """Keep a name that is not taken for what is written below the functions."""
        self.names.claim(name, ("kept", name), f"Function {name!r}")

    def module_name(self, module: str, what: str) -> str:
        """Import a module, unless a function has brought it already under a name of its own (``np``)."""
        aliases = [name for name, imported in self.imports if imported == module]
        if aliases:
            return min(aliases)
        name = self.names.alias_for(sys.modules.get(module), self._places.notebook, module)
        if not name:
            self._import_module(module, what)
            return module
        self._import_as(module, name, what)
        return name

    def _callable(self, function: Any, what: str, wanted: str) -> str:
        """Return the expression of anything that can be called, with what it needs."""
        home = importable(function)
        if home is not None:
            return self.reference(home, what)
        if id(function) in self._known:
            return self._known[id(function)]
        if isinstance(function, type):
            return self.add_class(function, None, what)
        owner = method_of(function)
        if owner is not None:
            of, method = owner
            return f"{of if isinstance(of, str) else self.reference(of, what)}.{method}"
        if type(function) is partial and not function.__dict__.keys() - {WATCH}:
            return self._add_partial(function, what, wanted)
        source = "" if isinstance(function, types.FunctionType) else expression(self, function, what)
        return source or self._add_definition(function, what, wanted).name

    def _add_partial(self, function: partial[Any], what: str, wanted: str) -> str:
        """Return the expression of a partial, or the name that functions call it by."""
        inner = f"The function of {what[0].lower()}{what[1:]}"
        called = self._callable(function.func, inner, wanted)
        given = [("", value) for value in function.args] + [
            (f"{name}=", value) for name, value in function.keywords.items()
        ]
        parts = [called, *(name + self._argument(value, what) for name, value in given)]
        source = f"{self.module_name('functools', what)}.partial({', '.join(parts)})"
        names = (name for name, value in self.names.read.items() if value is function)
        name = min(names, default="")
        if not name:
            return source
        self.names.claim(name, of_object(function), what)
        self._known[id(function)] = name
        self._write(name, f"{name} = {source}\n", self._places.of_name(name))
        return name

    def _argument(self, value: Any, what: str) -> str:
        """Return the expression of what a function of the notebook was given."""
        inner = f"A function that {what[0].lower()}{what[1:]} has"
        source = expression(self, value, what, lambda function: self._callable(function, inner, ""))
        if not source or (len(source) > _CONSTANT_CHARACTERS and not callable(value)):
            text = f"{what} has a value of type {type(value).__name__} inside, which no short expression makes again"
            raise Refused(f"{text}. Make it a token, or make it inside the function.")
        return source

    def _add_definition(self, function: Any, what: str, wanted: str = "") -> Written:
        """Add a function of the notebook."""
        found = found_definition(function, what)
        self._places.learn(found)
        name = self.names.name_for(function, found, wanted)
        self.names.claim(name, of_object(function), what)
        self._known[id(function)] = name
        check_state(found.function, found.node, what)
        is_plain = function is found.function and id(function) not in self.uncalled
        made = factory_call(found) if found.captured and is_plain else None
        if made is not None:
            self.called[id(function)] = name
            self._add_made(name, made, found, what)
            return self.definitions[name]
        defaults = self._defaults(found, what)
        self._add_names(name, list(global_names(found, defaults)), found, what)
        text = with_defaults(found.text, [defaults.get(default, "") for default in defaults_in(found.node)])
        self._write(name, renamed(text, found.name, name), self._places.of_definition(found))
        return self.definitions[name]

    def _defaults(self, found: Definition, what: str) -> dict[ast.expr, str]:
        """Return the defaults whose text makes another value than the function has, with an expression that does."""
        return {
            default: self._default(parameter, default, value, found, what)
            for parameter, default, value in default_values(found.node, found.function)
            if not _is_kept(parameter, default, value, found)
        }

    def _default(self, parameter: str, default: ast.expr, value: Any, found: Definition, what: str) -> str:
        text = f"{what} has the default {ast.unparse(default)!r} ({found.place_in(default)})"
        if isinstance(default, ast.List | ast.Dict | ast.Set):
            raise Refused(f"{text}, which has another value by now. Copy it in the function, and define that again.")
        owner = evaluated(default.value, found.names) if isinstance(default, ast.Attribute) else None
        if isinstance(owner, types.ModuleType) and not _is_constant(value):
            raise Refused(f"{text}, which is no literal and no constant of a module. Write the value itself.")
        inner = f"Its default of {parameter!r}"
        source = expression(self, value, what, lambda function: self._callable(function, inner, ""))
        if not source or len(source) > _CONSTANT_CHARACTERS:
            raise Refused(
                f"{text}, which no short expression makes again. Make it a token, or make it in the function."
            )
        return source

    def _add_names(self, name: str, names: Sequence[str], found: AnyDefinition, what: str) -> None:
        """Add what a definition has from outside."""
        check_patches(found, what)
        self.reads[name] = frozenset(names)
        for needed in names:
            try:
                self._add_name(needed, found, what)
            except Refused as refusal:
                self.refusals.append(str(refusal))

    def add_class(self, kind: type, around: Mapping[str, Any] | None, what: str) -> str:
        """Add a class, which reads the names ``around`` it if it is the notebook's; return its expression."""
        home = importable(kind)
        if home is not None:
            return self.reference(home, what)
        found = class_definition(kind, self._places.names_with(kind) if around is None else around, what)
        self.names.claim(found.name, of_object(kind), what)
        if id(kind) not in self._known:
            self._known[id(kind)] = found.name
            self._places.learn(found)
            self._add_names(found.name, list(class_names(found)), found, what)
            self._write(found.name, found.text, self._places.of_definition(found))
        return found.name

    def _add_made(self, name: str, made: FactoryCall, found: Definition, what: str) -> None:
        """Add a closure as a call of the function that made it."""
        arguments = [self._argument(value, what) for value in made.positional]
        arguments += [f"{word}={self._argument(value, what)}" for word, value in made.named.items()]
        inner = f"Function {made.factory.__name__!r}, which makes {what[0].lower()}{what[1:]}".rstrip(",") + ","
        factory = self._callable(made.factory, inner, "")
        position = self._places.of_name(name) or self._places.of_definition(found)
        self._write(name, f"{name} = {factory}({', '.join(arguments)})\n", position)

    def _write(self, name: str, text: str, position: Position) -> None:
        self.definitions[name] = Written(name, text)
        if position:
            self.positions[name] = position

    def _add_name(self, name: str, found: AnyDefinition, what: str) -> None:
        """Add what one global name of a function means at the time of promotion."""
        names = found.names
        value = names.get(name)
        check_asked(name, value, found, what)
        if name not in names:
            if isinstance(found, Definition) and not hasattr(builtins, name) and name in only_in_annotations(found):
                self.imports["annotations", "__future__.annotations"] = "from __future__ import annotations"
                return
            if not hasattr(builtins, name):
                place = found.place_of(name)
                raise Refused(f"{what} uses {name!r}, which is not defined ({place}). Define it, or rename.")
            self.names.claim(name, ("builtin", name), what)
            return
        self.names.read[name] = value
        if isinstance(value, types.ModuleType):
            self._add_module(name, value, found, what)
            return
        home = importable(value, name) if callable(value) or not is_data(value) else None
        if home is not None:
            self.names.claim(name, of_object(value), what)
            self._import_from(home, name)
        elif is_function(value) or isinstance(value, type):
            around = f"which {what[0].lower()}{what[1:]}"
            if isinstance(value, type):
                source = self.add_class(value, found.names, f"Class {value.__name__!r}, {around} uses,")
            else:
                source = self._callable(value, f"Function {name!r}, {around} calls,", name)
            if source != name and name not in self.definitions:
                self.names.claim(name, of_object(value), what)
                self._write(name, f"{name} = {source}\n", self._places.of_name(name))
        else:
            self._add_constant(name, value, found, what)

    def _add_constant(self, name: str, value: Any, found: AnyDefinition, what: str) -> None:
        module, own = imported_as(name, value, found.names, found.file) if name not in found.captured else ("", "")
        if module:
            self.names.claim(name, ("constant", name), what)
            self._import_from(Importable(module, own), name)
            return
        if self._add_table(name, value, found, what):
            return
        source = self._constant_source(name, value, found, what)
        if self.constants.get(name, source) != source:
            text = f"{what} uses {name!r} ({found.place_of(name)}), which has another value elsewhere"
            way_out = (
                f"Make {name} a parameter of the function around it"
                if name in found.captured
                else "Rename one of the two"
            )
            raise Refused(f"{text}. {way_out}.")
        if name in self.constants or name in self.definitions:
            return
        self.names.claim(name, ("constant", name), what)
        if name in found.captured and isinstance(found, Definition):
            factory = found.function.__code__.co_qualname.partition(".")[0]
            remark: Remark | None = Remark(
                self._places.of_definition(found), beside=f"# as {factory}() had it in the notebook"
            )
        else:
            remark = remark_on(name, value, source, found.names, found.file)
        if remark is not None:
            self.remarks[name] = remark
        self.constants[name] = source

    def _add_table(self, name: str, value: Any, found: AnyDefinition, what: str) -> bool:
        """Add a dict or sequence with functions of the notebook in it; return whether it is one."""
        if not isinstance(value, dict | list | tuple) or not holds_functions(value):
            return False
        self.names.claim(name, of_object(value), what)
        if name not in self.definitions:
            source = self._argument(value, f"{name!r}, which {what[0].lower()}{what[1:]} uses,")
            text = "\n".join(laid_out(source, before=f"{name} = "))
            self._write(name, f"{text}\n", self._places.of_name(name))
        return True

    def _constant_source(self, name: str, value: Any, found: AnyDefinition, what: str) -> str:
        called = f"{what}, by {name!r} ({found.place_of(name)}),"
        source = self.arrays.short(lambda: expression(self, value, called))
        if not source:
            kind = f"the class {name!r}" if isinstance(value, type) else f"of type {type(value).__name__}"
            raise Refused(
                f"{what} is defined in the notebook ({found.place_of(name)}) and uses {name!r} from it, {kind}. "
                f"Make {name} a token, make it inside the function, or move both into a module that is installed."
            )
        return source

    def _add_module(self, name: str, module: types.ModuleType, found: AnyDefinition, what: str) -> None:
        if module.__name__ == "__main__":
            raise Refused(f"{what} uses the notebook itself as module {name!r} ({found.place_of(name)}).")
        if name != module.__name__:
            self._import_as(module.__name__, name, what)
            return
        for dotted in submodules(found.node, name, module) or (name,):
            self._import_module(dotted, what)

    def _import_as(self, module: str, name: str, what: str) -> None:
        self.names.claim(name, of_object(sys.modules.get(module)), what)
        self.imports[name, module] = f"import {module} as {name}"

    def _import_module(self, module: str, what: str) -> None:
        top = module.partition(".")[0]
        self.names.claim(top, ("module", top), what)
        self.imports[module, module] = f"import {module}"

    def _import_from(self, home: Importable, name: str) -> None:
        check_home(home, f"A function that uses {name!r}")
        top, _, rest = home.qualname.partition(".")
        alias = "" if name == top else f" as {name}"
        if rest:
            # A nested name can't be imported by itself.
            raise Refused(
                f"{name!r} is {home.module}.{home.qualname}, a name inside a class. Use it through the class."
            )
        self.imports[name, f"{home.module}.{top}"] = f"from {home.module} import {top}{alias}"


def _is_kept(parameter: str, default: ast.expr, value: Any, found: Definition) -> bool:
    """Whether the text of a default makes its value: a literal, or a name or attribute that means the same by now."""
    if isinstance(default, ast.Name | ast.Attribute):
        # A lambda's default is often the variable of a loop.
        is_own = isinstance(default, ast.Name) and default.id == parameter and found.is_lambda and literal_source(value)
        is_fixed = isinstance(default, ast.Name) or _is_constant(value)
        return is_fixed and not is_own and evaluated(default, {**vars(builtins), **found.names}) is value
    return is_same_data(literal_value(default), value)


def _is_constant(value: object) -> bool:
    return (
        callable(value)
        or isinstance(value, enum.Enum)
        or type(value) in (bool, int, float, complex, str, bytes, type(None))
    )


def slice_functions(gathered: Slice, functions: Sequence[tuple[str, Callable[..., Any]]]) -> list[str]:
    """Add functions of graphs, each given with how reasons call it; return the expressions that refer to them."""
    survey = Slice(gathered.names.reserved, keeps_arrays=gathered.keeps_arrays, uncalled=gathered.uncalled)
    _add_all(survey, functions)
    gathered.names.read.update(survey.names.read)
    return _add_all(gathered, functions)


def _add_all(gathered: Slice, functions: Sequence[tuple[str, Callable[..., Any]]]) -> list[str]:
    homes = {id(function): importable(function) for _, function in functions}
    # The notebook's own functions first: they know by which names they import modules.
    own_first = sorted(range(len(functions)), key=lambda index: homes[id(functions[index][1])] is not None)
    references: dict[int, str] = {}
    known: dict[int, str] = {}
    for index in own_first:
        what, function = functions[index]
        refused = len(gathered.refusals)
        wanted = what.partition("'")[2].partition("'")[0]
        references[index] = known.get(id(function)) or gathered.add_graph_function(what, function, wanted)
        if len(gathered.refusals) == refused:
            known[id(function)] = references[index]
    return [references[index] for index in range(len(functions))]
