"""The slice of a notebook that some of its objects need to stand in a module of their own.

Imports, constants, classes and other functions of the notebook are followed; everything else is refused by name.
"""

from __future__ import annotations

import ast
import builtins
import io
import re
import sys
import tokenize
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, TypeVar

from epypes.bundle.arrays import CONSTANTS, READER, ArrayFiles, is_storable, reader_text
from epypes.bundle.private_import import import_module, loaded_module, plain_name
from epypes.bundle.source.expressions import (
    LINE,
    UNKNOWN,
    constructed,
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
    quoted,
)
from epypes.bundle.source.objects import is_installed
from epypes.bundle.source.references import defaults_of, is_of_ipython, may_remember
from epypes.bundle.source.resolve import (
    LATE_ANNOTATIONS,
    Definition,
    Importable,
    Position,
    Refused,
    annotated_names,
    assignment_of,
    cell_of,
    class_definition,
    comment_above,
    defaults_in,
    evaluated,
    first_line,
    function_definition,
    importable,
    imports_in,
    is_named_tuple,
    names_of,
    noted_refusals,
    with_defaults,
)
from epypes.bundle.source.side_effects import (
    CHANGING,
    check_home,
    check_notebook_name,
    check_reads,
    check_state,
    patches_in_notebook,
)
from epypes.run.guard import is_plain_array
from epypes.wording import keep_as_state

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


@dataclass(frozen=True, slots=True)
class Written:
    """What stands in a module under a name.

    Attributes
    ----------
    text
        Its lines, with the comments of the notebook.
    reads
        The names that it reads from outside.
    position
        The cell and line where the notebook has it, or gave it this value; () if no text says that.
    source
        Of a constant, the expression that makes it.
    is_closure
        Whether it is a call that makes a closure.
    """

    text: str
    reads: frozenset[str]
    position: Position = ()
    source: str = ""
    is_closure: bool = False


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
        The arrays that are stored in files.
    imports
        Import statements, by the name that each binds and what it binds it to.
    written
        What stands in the module, by name: functions, classes, closures and constants.
    modules
        The modules that all of it imports, by the names that Python knows them by.
    refusals
        Why something can't be promoted.
    patches
        What the notebook has changed in libraries.
    notebook
        The names of the notebook, once a definition was met.
    """

    def __init__(self, reserved: Collection[str] = RESERVED, *, stores_arrays: bool = False) -> None:
        self.arrays = ArrayFiles(CONSTANTS)
        self.read: dict[str, object] = {}
        self.imports: dict[tuple[str, str], str] = {}
        self.written: dict[str, Written] = {}
        self.modules: set[str] = set()
        self.refusals: list[str] = []
        self.patches = patches_in_notebook()
        self._stores_arrays, self._reserved = stores_arrays, reserved
        self._meanings: dict[str, Meaning] = {}
        self._known: dict[int, str] = {}
        self._unfinished: set[str] = set()
        self._makers: dict[tuple[str, str], str] = {}
        self.notebook: Mapping[str, Any] = {}

    def noted_refusals(self) -> AbstractContextManager[None]:
        """Note what is refused inside, and go on after it."""
        return noted_refusals(self.refusals)

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
            text = f"{what} uses the name {name!r}, which means something else in another function of the graph."
            way_out = "Rename one of the two; if its cell was run again, run again what was made of it."
            raise Refused(f"{text} {way_out}")

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

    def define(self, name: str, text: str, reads: Collection[str] | None = None, **more: Any) -> None:
        """Write a definition under a name; without ``reads`` it reads all that its text names."""
        self.written[name] = Written(text.rstrip(), frozenset(names_in(text) if reads is None else reads), **more)

    # -- imports -----------------------------------------------------------------------------------------------------

    def reference(self, home: Importable, what: str) -> str:
        """Return the expression for what can be imported: ``cv2.Canny``, or ``len``, which needs no import."""
        check_home(home.module, home.qualname, what, self.patches)
        top = home.qualname.partition(".")[0]
        builtin = ("builtin", top)
        if home.module == "builtins" and self._meanings.setdefault(top, builtin) == builtin:
            return home.qualname
        return f"{self.module_name(home.module, what)}.{home.qualname}"

    def module_name(self, module: str, what: str) -> str:
        """Import a module, under the name that functions or the notebook have for it (``np``); return that name."""
        value, plain = import_module(module), plain_name(module)
        imported = [name for name, known in self.imports if known == module]
        names = [name for name, known in self.read.items() if known is value] or names_of(value, self.notebook)
        if not imported and plain not in names:
            imported = [name for name in names if self._is_free(name, value)]
        name = min(imported, default=plain)
        self._import_module(module, name, what)
        return name

    def _import_module(self, module: str, name: str, what: str) -> None:
        plain = plain_name(module)
        bound, named = (plain.partition(".")[0], "") if name == plain else (name, f" as {name}")
        home = module if named else module.removesuffix(plain) + bound
        self.claim(bound, _of_object(loaded_module(home)), what)
        self.modules.add(module)
        self.imports[name, module] = f"import {plain}{named}"

    def import_module(self, module: str) -> None:
        """Import a module of the user for what it does when it is imported."""
        self._import_module(module, plain_name(module), f"Module {plain_name(module)!r}")

    def store_array(self, array: Any, name: str, what: str) -> str:
        """Store an array as a file; return the call that reads it, or "" if files can't hold it or there are none."""
        if not self._stores_arrays or not is_storable(array):
            return ""
        if READER not in self.written:
            self.reserve(READER)
            self.define(READER, reader_text(*(self.module_name(module, what) for module in ("numpy", "pathlib"))), ())
        return f'{READER}("{self.arrays.add(array, name)}")'

    # -- functions and classes ---------------------------------------------------------------------------------------

    def add_class(self, kind: type, what: str) -> str:
        """Add a class; return its expression."""
        home = importable(kind)
        if home is not None:
            return self.reference(home, what)
        if id(kind) not in self._known and is_named_tuple(kind):
            self.claim(kind.__name__, _of_object(kind), what)
            self._known[id(kind)] = kind.__name__
            parts: Any = kind
            fields, values = literal_source([*parts._fields]), [*parts._field_defaults.values()]
            defaults = f", defaults={expression(self, values, what)}" if values else ""
            made = f"{self.module_name('collections', what)}.namedtuple({quoted(kind.__name__)}, {fields}{defaults})"
            self.define(kind.__name__, "\n".join(laid_out(made, before=f"{kind.__name__} = ")))
        if id(kind) not in self._known:
            found = class_definition(kind, self.notebook or vars(sys.modules["__main__"]), what)
            check_state(found)
            self.claim(kind.__name__, _of_object(kind), f"{what.rstrip(',')} ({found.place_in(found.node)})")
            self._known[id(kind)] = kind.__name__
            self._write(kind.__name__, _text(found, kind.__name__), found)
            # The statements of these register them with it.
            registered: list[type] = kind.__subclasses__() if "__init_subclass__" in vars(kind) else []
            for derived in registered:
                if found.names.get(derived.__name__) is derived:
                    self.add_class(derived, f"Class {derived.__name__!r}, which is derived from {kind.__name__!r},")
        return self._known[id(kind)]

    def add_function(self, function: Any, what: str, wanted: str = "") -> str:
        """Add what can be called and is the notebook's; return its expression.

        ``what`` is how reasons call it, as ``"Function 'blur'"``; ``wanted`` its name if it has none of its own.
        """
        if id(function) in self._known:
            return self._known[id(function)]
        name, owner = getattr(function, "__name__", ""), getattr(function, "__self__", None)
        is_bound = isinstance(function, types.MethodType | types.BuiltinMethodType)
        can_be_read = isinstance(owner, type) or (name not in CHANGING and literal_source(owner))
        is_bound = is_bound and getattr(owner, name, None) == function
        write = expression if can_be_read else constructed
        source = write(self, owner, f"What {what[0].lower()}{what[1:]} is of") if is_bound else ""
        if source:
            return f"{f'({source})' if source[0].isdecimal() or source[0] == '-' else source}.{name}"
        if type(function) is partial:
            inner = f"The function of {what[0].lower()}{what[1:]}"
            parts = [expression(self, function.func, inner, wanted)]
            parts += [self._argument(value, what) for value in function.args]
            for word, value in function.keywords.items():
                source = self._argument(value, what)
                parts.append(f"{word}={source}" if is_identifier(word) else f"**{{{quoted(word)}: {source}}}")
            return f"{self.module_name('functools', what)}.partial({', '.join(parts)})"
        return self._add_definition(function, what, wanted)

    def _add_definition(self, function: Any, what: str, wanted: str) -> str:
        """Add a function that has a text; return its name."""
        found = function_definition(function, what)
        check_state(found)
        self.notebook = self.notebook or found.names
        name = self._name_for(function, found, wanted)
        self.claim(name, _of_object(function), what)
        self._known[id(function)] = name
        self._unfinished.add(name)
        found = replace(found, changed=self._changed_defaults(found))
        own = next((each for each, value in found.captured.items() if value is function), "")
        given = {each: self._argument(value, what, each) for each, value in found.captured.items() if each != own}
        # What needs a closure that is not written yet is read by a global name, which may be given its value later.
        given = {each: source for each, source in given.items() if not names_in(source) & self._unfinished}
        if given or own not in ("", name):
            self._write_closure(name, own or found.node.name, given, found)
        else:
            self._write(name, _text(found, name), found)
        self._unfinished.discard(name)
        self._register_implementations(name, function, found)
        return name

    def _register_implementations(self, name: str, function: Any, found: Definition) -> None:
        """Write the calls that register the implementations of a function of ``functools.singledispatch``."""
        registry, lines = getattr(function, "registry", None), list[str]()
        for kind, made in registry.items() if isinstance(registry, types.MappingProxyType) else ():
            if made is not function.__wrapped__:
                what = f"The implementation of {found.what[0].lower()}{found.what[1:]} for {kind.__name__!r}"
                written = self._argument(made, what, f"{name}_{kind.__name__}")
                lines.append(f"{name}.register({expression(self, kind, what)}, {written})")
        if lines:
            self.define(f"{name}.register", "\n".join(lines), position=_position(found))

    def _write_closure(self, name: str, inner: str, given: Mapping[str, str], found: Definition) -> None:
        """Write a closure as what a function returns that takes what it has captured; closures of one text share it."""
        node = found.factory()
        around = node.name if node is not None else f"make_{inner}"
        docstring = _docstring(node, found.lines) if node is not None else ""
        whole = f"({', '.join(given)}):\n{docstring}{_text(found, inner, depth=1)}\n    return {inner}\n"
        if (around, whole) not in self._makers:
            self._makers[around, whole] = factory = identifier_of(around, self.is_taken)
            self.claim(factory, ("closure", whole), found.what)
            above = comment_above(found.lines, first_line(node)) if node is not None else []
            self._write(factory, "\n".join([*above, f"def {factory}{whole}"]), found, {*given, inner})
        arguments = ", ".join(f"{each}={source}" for each, source in given.items())
        self.define(
            name, f"{name} = {self._makers[around, whole]}({arguments})", position=_position(found), is_closure=True
        )

    def _name_for(self, function: object, found: Definition, wanted: str) -> str:
        """Return what a function is called in the module: as in the notebook, if that means nothing else there."""
        own = "" if found.is_lambda else found.node.name
        candidates = [*names_of(function, found.names), wanted, own]
        free = (name for name in candidates if name and self._is_free(name, function))
        return next(free, "") or identifier_of(own or wanted or found.node.name, self.is_taken)

    def _changed_defaults(self, found: Definition) -> dict[ast.expr, str]:
        """Return expressions of the defaults whose text makes another value than the function has."""
        changed: dict[ast.expr, str] = {}
        if found.function is None or not isinstance(found.node, ast.FunctionDef):
            return changed
        nodes = defaults_in(found.node.args)
        for parameter, value in defaults_of(found.function).items():
            default = nodes.get(parameter)
            if default is not None and not _makes(default, value, found.names):
                text = f"the default {ast.unparse(default)!r} ({found.place_in(default)})"
                reason = f"{found.what} has {text}, which no short expression makes again"
                changed[default] = self._short(value, f"{found.what}, by {text},", reason)
        return changed

    def _argument(self, value: Any, what: str, name: str = "") -> str:
        """Return the expression of what a partial was given, or what a closure has captured."""
        inner = f"A function that {what[0].lower()}{what[1:]} has" if callable(value) else what
        text = f"{what} has a value of type {type(value).__name__} inside, which no short expression makes again"
        return self._short(value, inner, text, name)

    def _short(self, value: Any, what: str, reason: str, wanted: str = "", name: str = "it") -> str:
        """Return the expression of a value; refuse one without an expression that people still read, with a reason."""
        source = expression(self, value, what, wanted)
        if source and (is_short(source) or callable(value)):
            return source
        place = "inside the function, or in a module that is imported"
        way_out = f"Make {name} {place}"
        if is_data(value) or is_plain_array(value):
            way_out = f"Make {name} a token, make it {place}"
        elif type(value).__module__ == "__main__":
            way_out += ", or make its class a dataclass"
        if may_remember(value):
            way_out += f". {keep_as_state('state' if name == 'it' else name, is_object=True)}"
        raise Refused(f"{reason}. {way_out}.")

    def _write(self, name: str, text: str, found: Definition, own: Collection[str] = ()) -> None:
        """Write a definition, after what it reads from outside but for the names that are its own."""
        self.notebook = self.notebook or found.names
        check_reads(found, self.patches)
        read = [one for one in found.reads() if one not in own]
        self.modules.update(imports_in(found.node, found.names))
        for needed in read:
            with self.noted_refusals():
                self._add_name(needed, found, found.what)
        self.define(name, text, read, position=_position(found))

    # -- what definitions read by name -------------------------------------------------------------------------------

    def _add_name(self, name: str, found: Definition, what: str) -> None:
        """Add what one global name of a definition means at the time of promotion."""
        check_notebook_name(name, found)
        if name not in found.names or is_of_ipython(name, found.names[name]):
            self._add_builtin(name, found)
            return
        self.read[name] = value = found.names[name]
        if isinstance(value, types.ModuleType):
            # Submodules that are reached as attributes (skimage.filters) need imports of their own.
            dotted = _submodules(found.node, name, value)
            is_plain = name == plain_name(value.__name__)
            for module in (*(dotted if is_plain or not is_installed(value.__name__) else ()),):
                self._import_module(module, plain_name(module), what)
            if not dotted or not is_plain:
                self._import_module(value.__name__, name, what)
            return
        written = literal_source(value)
        home = importable(value, name) if not written or not is_short(written) else None
        if home is not None and "." not in home.qualname:  # a nested name can't be imported by itself
            check_home(home.module, home.qualname, what, self.patches)
            self.claim(name, _of_object(value), what)
            alias = "" if name == home.qualname else f" as {name}"
            self.modules.add(home.module)
            source = plain_name(home.module)
            self.imports[name, f"{home.module}.{home.qualname}"] = f"from {source} import {home.qualname}{alias}"
            return
        text = f"{what} is defined in the notebook ({found.place_of(name)}) and uses {name!r} from it"
        inner = f"{what}, by {name!r} ({found.place_of(name)}),"
        if isinstance(value, type):
            inner = f"Class {value.__name__!r}, which {what[0].lower()}{what[1:]} uses,"
        elif callable(value):
            inner = f"Function {name!r}, which {what[0].lower()}{what[1:]} calls,"
        source = self._short(value, inner, f"{text}, of type {type(value).__name__}", name, name)
        if source != name:
            self.claim(name, ("constant", source), what)
            if name not in self.written:
                lines, position = _lines_of_constant(name, source, value, found)
                self.define(name, "\n".join(lines), names_in(source), position=position, source=source)

    def _add_builtin(self, name: str, found: Definition) -> None:
        """Add a name that is no global of the notebook."""
        flags = found.function.__code__.co_flags if found.function else 0
        if hasattr(builtins, name):
            self.claim(name, ("builtin", name), found.what)
        elif flags & LATE_ANNOTATIONS and name in annotated_names(found.node):
            self.imports["annotations", "__future__.annotations"] = "from __future__ import annotations"
        else:
            place = found.place_of(name)
            raise Refused(f"{found.what} uses {name!r}, which is not defined ({place}). Define it, or rename.")

    def add_constant(self, name: str, source: str) -> str:
        """Add a constant that the notebook has under no name; return its name, which is like this one."""
        known = next((name for name, one in self.written.items() if one.source == source), "")
        if not known:
            known = self.free_name(name)
            self.define(known, "\n".join(laid_out(source, before=f"{known} = ")), names_in(source), source=source)
        return known


# -- the text of definitions -----------------------------------------------------------------------------------------


def _text(found: Definition, name: str, depth: int = 0) -> str:
    """Return a definition under a name, with its values as defaults, indented to a depth, with the comment above it.

    Lines that begin inside of a string literal stay as they are.
    """
    node, first, lines, pad = found.node, found.line - 1, [*found.lines], "    " * depth
    above = "".join(f"{pad}{line}\n" for line in comment_above(lines, found.line))
    if found.is_lambda and isinstance(node, ast.FunctionDef):
        sources = {default: ast.parse(source, mode="eval").body for default, source in found.changed.items()}
        head = f"{pad}def {name}({ast.unparse(with_defaults(node.args, sources))}):"
        body = laid_out(ast.unparse(node.body[0]).removeprefix("return "), depth + 1, "return ")
        # The comment is about all lambdas of the line.
        return (above if lines[first].count("lambda") == 1 else "") + "\n".join([head, *body, ""])
    inside = _lines_in_strings("".join(lines[first : node.end_lineno]))
    margin = len(lines[first]) - len(lines[first].lstrip())
    for default in sorted(found.changed, key=lambda each: (each.lineno, each.col_offset), reverse=True):
        start, end = default.lineno - 1, default.end_lineno or 0
        before = lines[start].encode()[: default.col_offset].decode()
        after = lines[end - 1].encode()[default.end_col_offset :].decode()
        lines[start:end] = [before + found.changed[default] + after, *[""] * (end - start - 1)]
    for decorator in found.dropped:
        for number in range(decorator.lineno - 1, decorator.end_lineno or 0):
            lines[number] = ""
    lines[node.lineno - 1] = re.sub(rf"\bdef(\s+){node.name}\b", rf"def\g<1>{name}", lines[node.lineno - 1], count=1)
    for number, line in enumerate(lines[first : node.end_lineno], first):
        if line and number - first + 1 not in inside:
            # Comments and what is in brackets may stand before the margin.
            lines[number] = re.sub(rf"\s{{0,{margin}}}", pad, line, count=1) if line.strip() else "\n"
    return above + "".join(lines[first : node.end_lineno]).rstrip() + "\n"


def _docstring(node: ast.FunctionDef, lines: Sequence[str]) -> str:
    """Return the lines of the docstring of a function at the margin; "" if it has none."""
    if ast.get_docstring(node, clean=False) is None:
        return ""
    return f"    {ast.get_source_segment(''.join(lines), node.body[0])}\n\n"


def _lines_in_strings(text: str) -> set[int]:
    """Return the numbers of the lines that begin inside of a string literal, or of the text of an f-string."""
    found: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if tokenize.tok_name[token.type].endswith(("STRING", "STRING_MIDDLE")):
            found.update(range(token.start[0] + 1, token.end[0] + 1))
    return found


# -- constants -------------------------------------------------------------------------------------------------------


def _lines_of_constant(name: str, source: str, value: Any, found: Definition) -> tuple[list[str], Position]:
    """Return a constant as the notebook has it where it last gave the name this value, with its comments, and where.

    Parameters
    ----------
    name, source, value
        The constant, and the expression that makes it again.
    found
        A function that reads it.
    """
    own = laid_out(source, before=f"{name} = ")
    assignment = assignment_of(name, found.names, found.file)
    if assignment is None:
        return own, ()
    node, lines, cell = assignment
    position, given = (cell, node.lineno), node.value or ast.Constant(None)
    is_alone = isinstance(node, ast.AnnAssign) or [*map(type, getattr(node, "targets", ()))] == [ast.Name]
    written = literal_value(given) if is_alone else UNKNOWN
    if not is_alone or (written is not UNKNOWN and not is_same_data(written, value)):
        return own, position
    behind = lines[(node.end_lineno or 1) - 1].encode()[node.end_col_offset :].decode().strip()
    beside = behind if behind.startswith("#") else ""
    computed = f"# {ast.unparse(given)} in the notebook"
    is_source = written is not UNKNOWN and isinstance(node, ast.Assign)
    if is_source:
        own = (ast.get_source_segment("\n".join(lines), node) or "").split("\n")
    elif written is UNKNOWN and (is_data(value) or is_plain_array(value)) and len(computed) <= LINE:
        beside = beside or ("" if ast.unparse(ast.parse(source)) == ast.unparse(given) else computed)
    above, together = comment_above(lines, node.lineno), f"{own[-1]}  {beside}"
    if beside and (is_source or len(own) == 1) and len(together) <= LINE:
        own[-1] = together
    elif beside:
        above.append(beside)
    return [*above, *own], position


# -- meanings and values ----------------------------------------------------------------------------------------------


def _of_object(value: object) -> Meaning:
    return "object", id(value)


def _position(found: Definition) -> Position:
    return cell_of(found.file, found.names), found.line


def _makes(default: ast.expr, value: Any, names: Mapping[str, Any]) -> bool:
    """Whether the text of a default makes its value: a literal, or a name that means the same by now."""
    if isinstance(default, ast.Name) or (isinstance(default, ast.Attribute) and type(value) not in (list, dict, set)):
        return evaluated(default, {**vars(builtins), **names}) is value
    return is_same_data(literal_value(default), value)


def _submodules(tree: ast.AST, name: str, module: types.ModuleType) -> list[str]:
    """Return the modules that are reached as attributes of one, which a text knows by a name."""
    dotted = {ast.unparse(node): node for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    named = {f"{module.__name__}{text.removeprefix(name)}": node for text, node in dotted.items()}
    reached = {full: evaluated(node, {name: module}) for full, node in named.items() if loaded_module(full)}
    return [full for full, found in reached.items() if found is loaded_module(full)]
