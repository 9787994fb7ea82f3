"""The slice of a notebook that some of its objects need to stand in a module of their own.

Imports, constants, classes and other functions of the notebook are followed; everything else is refused by name.
"""

from __future__ import annotations

import ast
import builtins
import importlib
import sys
import types
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, TypeVar

from epypes.bundle.definitions import Definition, annotated_names, class_definition, defaults_of, function_definition
from epypes.bundle.expressions import (
    LINE,
    UNKNOWN,
    expression,
    identifier_of,
    is_data,
    is_identifier,
    is_same_data,
    is_short,
    laid_out,
    literal_source,
    literal_value,
    names_in,
)
from epypes.bundle.notebook_source import (
    Position,
    Statement,
    cell_of,
    code_on_its_own,
    comment_above,
    inside_function,
    names_from_outside,
    names_of,
    nested_codes,
    renamed,
    statements_of,
    with_defaults,
    written_defaults,
)
from epypes.bundle.resolve import Importable, Refused, evaluated, importable
from epypes.bundle.side_effects import CHANGING, check_asked, check_home, check_patches, check_state, dotted_name
from epypes.run.guard import WATCH, is_plain_array

T = TypeVar("T")
RESERVED: Final = frozenset({"func_dict", "func_io"})
Meaning = tuple[str, object]


def gather(
    write: Callable[[Slice], T], reserved: Collection[str] = RESERVED, *, stores_arrays: bool = False
) -> tuple[Slice, T]:
    """Write a module's objects into a slice; return it, and what ``write`` returns.

    It is called twice: only then is it known which names functions read, which nothing else may take.
    """
    survey = Slice(reserved, stores_arrays=stores_arrays)
    write(survey)
    gathered = Slice(reserved, stores_arrays=stores_arrays)
    gathered.read.update(survey.read)
    return gathered, write(gathered)


class Slice:
    """What a module needs, gathered from several functions.

    Parameters
    ----------
    reserved
        The names that the module keeps for the graph.
    stores_arrays
        Whether large arrays are stored as files beside the module.

    Attributes
    ----------
    read
        What functions read by name: these names are theirs alone.
    arrays
        The arrays that are stored in files, by name.
    imports
        Import statements, by the name that each binds and what it binds it to.
    constants
        Values, by name.
    definitions
        Text of functions, classes and closures, by name.
    positions
        Where the notebook has them, as far as that is known.
    reads
        The names that they read from outside.
    closures
        The names of closures.
    refusals
        Why something can't be promoted.
    """

    def __init__(self, reserved: Collection[str] = RESERVED, *, stores_arrays: bool = False) -> None:
        self.stores_arrays = stores_arrays
        self.arrays: dict[str, Any] = {}
        self.read: dict[str, object] = {}
        self.imports: dict[tuple[str, str], str] = {}
        self.constants: dict[str, Constant] = {}
        self.definitions: dict[str, str] = {}
        self.positions: dict[str, Position] = {}
        self.reads: dict[str, frozenset[str]] = {}
        self.closures: set[str] = set()
        self.refusals: list[str] = []
        self._reserved = reserved
        self._meanings: dict[str, Meaning] = {}
        self._known: dict[int, str] = {}
        self._unfinished: set[int] = set()
        self._makers: dict[tuple[str, str], str] = {}
        self._notebook: Mapping[str, Any] = {}

    @contextmanager
    def noted_refusals(self) -> Iterator[None]:
        """Note what is refused inside, and go on after it."""
        try:
            yield
        except Refused as refusal:
            self.refusals.append(str(refusal))

    # -- names -------------------------------------------------------------------------------------------------------

    def claim(self, name: str, meaning: Meaning, what: str) -> None:
        """Make a name mean one thing in the module.

        Raises
        ------
        Refused
            It means another.
        """
        if name in self._reserved:
            raise Refused(f"{what} uses the name {name!r}, which the module keeps for the graph. Rename it.")
        if self._meanings.setdefault(name, meaning) != meaning:
            raise Refused(
                f"{what} uses the name {name!r}, which means something else in another function of the graph. "
                "Rename one of the two."
            )

    def is_taken(self, name: str) -> bool:
        """Whether a name means something in the module already."""
        return name in self._reserved or name in self._meanings or name in self.read or hasattr(builtins, name)

    def reserve(self, name: str) -> None:
        """Reserve a name that is not taken for what is written below the functions."""
        self.claim(name, ("reserved", name), f"Function {name!r}")

    def free_name(self, name: str) -> str:
        """Reserve a name that is like this one and not taken."""
        free = identifier_of(name, self.is_taken)
        self.reserve(free)
        return free

    def _is_free(self, name: str, value: object) -> bool:
        """Whether a name can mean an object, and hides nothing."""
        if name in self.read:
            return self.read[name] is value
        if name in self._reserved or self._meanings.get(name, _of_object(value)) != _of_object(value):
            return False
        return is_identifier(name) and not hasattr(builtins, name) and name not in sys.modules

    # -- imports -----------------------------------------------------------------------------------------------------

    def reference(self, home: Importable, what: str) -> str:
        """Return the expression for what can be imported: ``cv2.Canny``, or ``len``, which needs no import."""
        check_home(home, what)
        top = home.qualname.partition(".")[0]
        builtin = ("builtin", top)
        if home.module == "builtins" and self._meanings.setdefault(top, builtin) == builtin:
            return home.qualname
        return f"{self.module_name(home.module, what)}.{home.qualname}"

    def module_name(self, module: str, what: str) -> str:
        """Import a module, under the name that functions or the notebook have for it (``np``); return that name."""
        value = importlib.import_module(module)
        imported = [name for name, known in self.imports if known == module]
        names = [name for name, known in self.read.items() if known is value] or names_of(value, self._notebook)
        if not imported and module not in names:
            imported = [name for name in names if self._is_free(name, value)]
        name = min(imported, default=module)
        self._import_module(module, name, what)
        return name

    def _import_module(self, module: str, name: str, what: str) -> None:
        if name == module:
            self.claim(module.partition(".")[0], ("module", module.partition(".")[0]), what)
            self.imports[module, module] = f"import {module}"
        else:
            self.claim(name, _of_object(sys.modules.get(module)), what)
            self.imports[name, module] = f"import {module} as {name}"

    def _import_from(self, home: Importable, name: str) -> None:
        check_home(home, f"A function that uses {name!r}")
        if "." in home.qualname:  # a nested name can't be imported by itself
            raise Refused(
                f"{name!r} is {home.module}.{home.qualname}, a name inside a class. Use it through the class."
            )
        alias = "" if name == home.qualname else f" as {name}"
        self.imports[name, f"{home.module}.{home.qualname}"] = f"from {home.module} import {home.qualname}{alias}"

    # -- functions and classes ---------------------------------------------------------------------------------------

    def add_class(self, kind: type, what: str) -> str:
        """Add a class; return its expression."""
        home = importable(kind)
        if home is not None:
            return self.reference(home, what)
        if id(kind) not in self._known:
            is_known = self._notebook.get(kind.__name__) is kind
            found = class_definition(kind, self._notebook if is_known else vars(sys.modules["__main__"]), what)
            self.claim(found.name, _of_object(kind), what)
            self._known[id(kind)] = found.name
            self._write(found.name, found.text, found, what, {found.name})
        return self._known[id(kind)]

    def add_function(self, function: Any, what: str, wanted: str = "") -> str:
        """Add what can be called and is the notebook's; return its expression.

        ``what`` is how reasons call it, as ``"Function 'blur'"``; ``wanted`` its name if it has none of its own.
        """
        if id(function) in self._known:
            return self._known[id(function)]
        name, owner = getattr(function, "__name__", ""), _owner_of(function)
        if owner is not UNKNOWN:
            source = expression(self, owner, f"What {what[0].lower()}{what[1:]} is of")
            return f"{f'({source})' if source[0].isdecimal() or source[0] == '-' else source}.{name}"
        if type(function) is partial and not function.__dict__.keys() - {WATCH}:
            inner = f"The function of {what[0].lower()}{what[1:]}"
            parts = [expression(self, function.func, inner, wanted)]
            parts += [self._argument(value, what) for value in function.args]
            parts += [f"{word}={self._argument(value, what)}" for word, value in function.keywords.items()]
            return f"{self.module_name('functools', what)}.partial({', '.join(parts)})"
        return self._add_definition(function, what, wanted)

    def _add_definition(self, function: Any, what: str, wanted: str) -> str:
        """Add a function that has a text; return its name."""
        found = function_definition(function, what)
        self._notebook = self._notebook or found.names
        name = self._name_for(function, found, wanted)
        self.claim(name, _of_object(function), what)
        self._known[id(function)] = name
        self._unfinished.add(id(function))
        if found.function is not None:
            check_state(found.function, found.node, what)
        changed = self._changed_defaults(found, what)
        text = with_defaults(found.text, changed)
        code = code_on_its_own(with_defaults(found.text, dict.fromkeys(changed, "None")))
        found = replace(found, code=code or found.code)
        own = next((each for each, value in found.captured.items() if value is function), "")
        given = {each: self._argument(value, what, each) for each, value in found.captured.items() if each != own}
        # What needs a closure that is not written yet is read by a global name, which may be given its value later.
        unfinished = {self._known[known] for known in self._unfinished}
        given = {each: source for each, source in given.items() if not names_in(source) & unfinished}
        if given or own not in ("", name):
            inner = own or found.name
            self._write_closure(name, renamed(text, found.name, inner), inner, given, found, what)
        else:
            self._write(name, renamed(text, found.name, name), found, what)
        self._unfinished.discard(id(function))
        return name

    def _write_closure(
        self, name: str, text: str, inner: str, given: Mapping[str, str], found: Definition, what: str
    ) -> None:
        """Write a closure as what a function returns that takes what it has captured; closures of one text share it."""
        whole = inside_function(f"({', '.join(given)}):", text, inner)
        qualname = found.function.__code__.co_qualname if found.function else ""
        around = qualname.rpartition(".<locals>")[0].rpartition(".")[2] or f"make_{inner}"
        key = (around, whole)
        if key not in self._makers:
            self._makers[key] = factory = identifier_of(around, self.is_taken)
            self.claim(factory, ("closure", whole), what)
            self._write(factory, f"def {factory}{whole}", found, what, {*given, inner})
        arguments = ", ".join(f"{each}={source}" for each, source in given.items())
        self.definitions[name] = f"{name} = {self._makers[key]}({arguments})\n"
        self.positions[name] = _position(found)
        self.closures.add(name)

    def _name_for(self, function: object, found: Definition, wanted: str) -> str:
        """Return what a function is called in the module: as in the notebook, if that means nothing else there."""
        own = "" if found.is_lambda else found.name
        known = [own] if found.names.get(own) is function else []
        candidates = [*known, *names_of(function, found.names), wanted, own]
        free = (name for name in candidates if name and self._is_free(name, function))
        return next(free, "") or identifier_of(own or wanted or found.name, self.is_taken)

    def _changed_defaults(self, found: Definition, what: str) -> dict[str, str]:
        """Return expressions of the defaults whose text makes another value than the function has, by parameter."""
        if not isinstance(found.node, ast.FunctionDef) or found.function is None:
            return {}
        known, changed = defaults_of(found.function), dict[str, str]()
        for parameter, default in written_defaults(found.node):
            if parameter not in known or _makes(default, known[parameter], found.names):
                continue
            changed[parameter] = source = expression(self, known[parameter], f"Its default of {parameter!r}")
            if not source or not is_short(source):
                text = f"{what} has the default {ast.unparse(default)!r} ({found.place_in(default)})"
                way_out = _way_out(known[parameter], "it")
                raise Refused(f"{text}, which no short expression makes again. {way_out}.")
        return changed

    def _argument(self, value: Any, what: str, name: str = "") -> str:
        """Return the expression of what a partial was given, or what a closure has captured."""
        inner = f"A function that {what[0].lower()}{what[1:]} has" if callable(value) else what
        source = expression(self, value, inner, name)
        if not source or not (is_short(source) or callable(value)):
            text = f"{what} has a value of type {type(value).__name__} inside, which no short expression makes again"
            raise Refused(f"{text}. {_way_out(value, 'it')}.")
        return source

    def _write(self, name: str, text: str, found: Definition, what: str, own: Collection[str] = ()) -> None:
        """Write a definition, after what it reads from outside; ``own`` are the names that are its own."""
        self._notebook = self._notebook or found.names
        check_patches(found, what)
        _check_imports(found, what)
        read = dict.fromkeys(each for code in nested_codes(found.code) for each in names_from_outside(code))
        self.reads[name] = frozenset(read.keys() - set(own))
        for needed in read:
            if needed not in own:
                with self.noted_refusals():
                    self._add_name(needed, found, what)
        self.definitions[name] = text
        self.positions[name] = _position(found)

    # -- what definitions read by name -------------------------------------------------------------------------------

    def _add_name(self, name: str, found: Definition, what: str) -> None:
        """Add what one global name of a definition means at the time of promotion."""
        value = found.names.get(name)
        check_asked(name, value, found, what)
        if name not in found.names:
            self._add_builtin(name, found, what)
            return
        self.read[name] = value
        if isinstance(value, types.ModuleType):
            self._add_module(name, value, found, what)
            return
        home = importable(value, name) if callable(value) or not is_data(value) else None
        if home is not None:
            self.claim(name, _of_object(value), what)
            self._import_from(home, name)
            return
        around = f"which {what[0].lower()}{what[1:]}"
        if isinstance(value, type):
            source = self.add_class(value, f"Class {value.__name__!r}, {around} uses,")
        elif callable(value):
            source = expression(self, value, f"Function {name!r}, {around} calls,", name)
        else:
            source = expression(self, value, f"{what}, by {name!r} ({found.place_of(name)}),", name)
        if not source or not (is_short(source) or callable(value)):
            shared = _home_of_data(value)
            if shared is None:
                text = f"{what} is defined in the notebook ({found.place_of(name)}) and uses {name!r} from it"
                raise Refused(f"{text}, of type {type(value).__name__}. {_way_out(value, name)}.")
            self.claim(name, ("constant", name), what)
            self._import_from(shared, name)
        elif source != name:
            self._add_constant(name, value, source, found, what)

    def _add_builtin(self, name: str, found: Definition, what: str) -> None:
        """Add a name that is no global of the notebook."""
        if hasattr(builtins, name):
            self.claim(name, ("builtin", name), what)
        elif found.has_late_annotations and name in annotated_names(found.node):
            self.imports["annotations", "__future__.annotations"] = "from __future__ import annotations"
        else:
            place = found.place_of(name)
            raise Refused(f"{what} uses {name!r}, which is not defined ({place}). Define it, or rename.")

    def _add_module(self, name: str, module: types.ModuleType, found: Definition, what: str) -> None:
        if module.__name__ == "__main__":
            text = f"{what} uses the notebook itself as module {name!r} ({found.place_of(name)})"
            raise Refused(f"{text}. Use what it has by its own name, without the module.")
        if name != module.__name__:
            self._import_module(module.__name__, name, what)
            return
        for dotted in _submodules(found.node, name, module) or (name,):
            self._import_module(dotted, dotted, what)

    def _add_constant(self, name: str, value: Any, source: str, found: Definition, what: str) -> None:
        self.claim(name, ("constant", name), what)
        known = self.constants.setdefault(name, constant(name, source, value, found.names, found.file))
        if known.source != source:
            place = found.place_of(name)
            raise Refused(f"{what} uses {name!r} ({place}), which has another value elsewhere. Rename one of the two.")

    def add_constant(self, name: str, source: str) -> str:
        """Add a constant that the notebook has under no name; return its name, which is like this one."""
        known = next((name for name, known in self.constants.items() if known.source == source), "")
        if not known:
            known = self.free_name(name)
            self.constants[known] = Constant(source, tuple(laid_out(source, before=f"{known} = ")))
        return known


# -- constants -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Constant:
    """A constant as it stands in a module.

    Attributes
    ----------
    source
        The expression that makes it.
    lines
        Its lines, with the comments of the notebook.
    position
        The cell and line where the notebook gave it this value; () if its text does not say.
    """

    source: str
    lines: tuple[str, ...]
    position: Position = ()


def constant(name: str, source: str, value: Any, names: Mapping[str, Any], file: str) -> Constant:
    """Return a constant as the notebook has it where it last gave the name this value, with its comments.

    Parameters
    ----------
    name, source, value
        The constant, and the expression that makes it again.
    names
        The notebook's names.
    file
        The file of a function that reads it.
    """
    plain = laid_out(source, before=f"{name} = ")
    for statement in statements_of(name, names, file):
        node, given = statement.node, getattr(statement.node, "value", None)
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        is_alone = len(targets) == 1 and isinstance(targets[0], ast.Name) and not isinstance(node, ast.AugAssign)
        written = literal_value(given) if is_alone and given is not None else UNKNOWN
        if given is None or (written is not UNKNOWN and not is_same_data(written, value)):
            continue
        is_computed = written is UNKNOWN and (is_data(value) or is_plain_array(value))
        lines = _with_comments(plain, statement, given, is_computed, written is not UNKNOWN) if is_alone else plain
        return Constant(source, tuple(lines), (statement.cell, node.lineno))
    return Constant(source, tuple(plain))


def _with_comments(
    plain: list[str], statement: Statement, given: ast.expr, is_computed: bool, is_literal: bool
) -> list[str]:
    """Return the lines of a constant as the notebook has them if they are a literal; else with how it was computed."""
    node, lines = statement.node, statement.lines
    above = comment_above(lines, node.lineno)
    beside = lines[(node.end_lineno or 1) - 1].encode()[node.end_col_offset :].decode().strip()
    beside = beside if beside.startswith("#") else ""
    text = ast.get_source_segment("\n".join(lines), node) if isinstance(node, ast.Assign) and is_literal else ""
    own = text.split("\n") if text else plain
    computed = f"# {ast.unparse(given)} in the notebook"
    if is_computed and not beside and len(computed) <= LINE:
        beside = "" if ast.unparse(ast.parse("\n".join(plain))).endswith(f"= {ast.unparse(given)}") else computed
    if beside and (text or len(own) == 1) and len(f"{own[-1]}  {beside}") <= LINE:
        return [*above, *own[:-1], f"{own[-1]}  {beside}"]
    return [*above, *([beside] if beside else []), *own]


# -- meanings and values ----------------------------------------------------------------------------------------------


def _of_object(value: object) -> Meaning:
    return "object", id(value)


def _position(found: Definition) -> Position:
    return cell_of(found.file, found.names), found.line


def _owner_of(function: Any) -> Any:
    """Return what a method is of, if that is a class, or a literal that the method does not change; else UNKNOWN."""
    if isinstance(function, types.MethodDescriptorType | types.WrapperDescriptorType | types.ClassMethodDescriptorType):
        return function.__objclass__
    name, owner = getattr(function, "__name__", ""), getattr(function, "__self__", None)
    if not isinstance(function, types.MethodType | types.BuiltinMethodType) or getattr(owner, name, None) != function:
        return UNKNOWN
    return owner if isinstance(owner, type) or (name not in CHANGING and literal_source(owner)) else UNKNOWN


def _makes(default: ast.expr, value: Any, names: Mapping[str, Any]) -> bool:
    """Whether the text of a default makes its value: a literal, or a name that means the same by now."""
    if isinstance(default, ast.Name) or (isinstance(default, ast.Attribute) and type(value) not in (list, dict, set)):
        return evaluated(default, {**vars(builtins), **names}) is value
    return is_same_data(literal_value(default), value)


def _way_out(value: Any, name: str) -> str:
    """Return what to do about a value that no expression makes again."""
    place = "at module level of a module that is imported"
    if is_data(value) or is_plain_array(value):
        return f"Make {name} a token, make it inside the function, or {place}"
    return f"Make {name} inside the function, or {place}"


def _home_of_data(value: Any) -> Importable | None:
    """Return the name under which an installed module has a container, such as a table that is too long for text."""
    if type(value) not in (list, dict, set, tuple):
        return None
    modules = [(name, module) for name, module in list(sys.modules.items()) if name != "__main__" and "._" not in name]
    found = (
        Importable(name, known)
        for name, module in modules
        for known, other in list(getattr(module, "__dict__", {}).items())
        if other is value and not name.startswith("_")
    )
    return next(found, None)


def _check_imports(found: Definition, what: str) -> None:
    """Refuse a definition that imports the notebook itself."""
    for node in ast.walk(found.node):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [getattr(node, "module", ""), *(alias.name for alias in node.names)]
            if "__main__" in modules:
                text = f"{what} imports the notebook itself, as '__main__' ({found.place_in(node)})"
                raise Refused(f"{text}. Use what it has by its own name, without the module.")


def _submodules(tree: ast.AST, name: str, module: types.ModuleType) -> tuple[str, ...]:
    """Return the submodules that are reached as attributes (``skimage.filters``): each needs an import of its own."""
    found: dict[str, None] = {}
    for node in ast.walk(tree):
        chain = dotted_name(node)
        reached: Any = module
        dotted = name
        for part in chain[1:] if chain[:1] == (name,) else ():
            reached = getattr(reached, part, None)
            if not isinstance(reached, types.ModuleType) or reached.__name__ != f"{dotted}.{part}":
                break
            dotted = f"{dotted}.{part}"
        if dotted != name:
            found[dotted] = None
    return tuple(found)
