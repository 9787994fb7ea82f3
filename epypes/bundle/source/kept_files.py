"""Files by which functions would keep something from event to event: one writes what another, or itself, reads later.

Libraries in C open files where no audit hook sees it, and no sample may take the branch. So the calls that write and
read files are found in the texts of the functions, with the names of the files as far as the texts say them. A file
that is only written changes no answer. One that may be a file that the functions write is not to be read, unless the
same call has written it before, or no other call has its name, as those of ``tempfile``.
"""

from __future__ import annotations

import ast
import builtins
import functools
import itertools
import os
import re
import tempfile
import types
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any, Final, NamedTuple

from epypes.bundle.source.objects import without_nodes
from epypes.bundle.source.references import captured_by, defaults_of, namespace_of
from epypes.bundle.source.resolve import Definition, as_function, definition_of, evaluated, layers
from epypes.bundle.source.side_effects import CHANGING, imported_by
from epypes.graph import CompGraph
from epypes.pipeline import Pipeline
from epypes.run.snapshot import is_own
from epypes.wording import keep_as_state

# What stands in the name of a file for a part that may be any text, for a file that no other call has, and before the
# token that brings the whole name with each event.
_ANY, _FRESH, _TOKEN = "\ue000", "\ue001", "\ue002"
_TEXTS, _PATHS = "{}{}", "{}/{}"
# What is a path more likely than another text.
_PATH: Final = re.compile(rf"[^{_ANY}{_FRESH}{_TOKEN}\n]*(/[^{_FRESH}{_TOKEN}\n]*|\.\w+)")
# A variable that may have more is any text.
_MOST_NAMES: Final = 16


# -- the calls that read and write files -------------------------------------------------------------------------------

# By name, since many libraries have functions and methods of these names.
_WRITE: Final = frozenset({
    "VideoWriter", "imsave", "imwrite", "imwriteanimation", "imwritemulti", "mimsave", "mimwrite", "save", "savefig",
    "savemat", "savetxt", "savez", "savez_compressed", "to_csv", "to_excel", "to_feather", "to_hdf", "to_json",
    "to_parquet", "to_pickle", "tofile", "volwrite", "write_bytes", "write_image", "write_text",
})  # fmt: skip
# These leave something of what was there, or change whether it is there.
_CHANGE: Final = frozenset({
    "TiffWriter", "get_writer", "makedirs", "mkdir", "mkfifo", "rmdir", "rmtree", "touch", "truncate", "unlink",
})  # fmt: skip
_ASK: Final = frozenset({"exists", "is_dir", "is_file", "isdir", "isfile", "lexists"})
_READ: Final = frozenset({
    *_ASK, "TiffFile", "VideoCapture", "fromfile", "genfromtxt", "get_reader", "getctime", "getmtime", "getsize",
    "haveImageReader", "imcount", "imread", "imread_collection", "imreadmulti", "load", "loadmat", "loadtxt", "lstat",
    "mimread", "read_bytes", "read_csv", "read_excel", "read_feather", "read_hdf", "read_json", "read_parquet",
    "read_pickle", "read_text", "stat", "volread",
})  # fmt: skip
_LIST: Final = frozenset({"glob", "iglob", "iterdir", "listdir", "rglob", "scandir", "walk"})
# By name: where an argument says what these do, and what they do without it: read and write.
_OPEN: Final = {
    **dict.fromkeys(("File", "FileStorage", "ZipFile", "open"), (1, True, False)),
    **dict.fromkeys(("SharedMemory", "memmap"), (2, True, True)),
    "open_memmap": (1, True, True),
}
# Methods of paths; all others are given the name of the file.
_OF_PATHS: Final = frozenset({
    *_ASK, *_CHANGE, *_LIST, "lstat", "open", "read_bytes", "read_text", "stat", "write_bytes", "write_text",
})  # fmt: skip
READERS: Final = frozenset({*_READ, *_LIST, *_OPEN})
_KNOWN: Final = READERS | _WRITE | _CHANGE
# Of a module alone, since methods of others have these names: the arguments that are read and written.
_OF_MODULES: Final[Mapping[tuple[str, str], tuple[tuple[int, ...], tuple[int, ...]]]] = {
    **dict.fromkeys([("shutil", name) for name in ("copy", "copy2", "copyfile", "copytree", "move")], ((0,), (1,))),
    **dict.fromkeys([("os", name) for name in ("rename", "renames", "replace", "link", "symlink")], ((0,), (0, 1))),
    **dict.fromkeys([("dbm", "open"), ("shelve", "open"), ("sqlite3", "connect")], ((0,), (0,))),
    ("os", "remove"): ((), (0,)),
    ("joblib", "dump"): ((), (1,)),
    ("torch", "save"): ((), (1,)),
    ("scipy", "write"): ((), (0,)),
}
_PROCESSES: Final = frozenset({"Popen", "call", "check_call", "check_output", "popen", "run", "system"})
_IN_MEMORY: Final = ("<bytes>", ":memory:")
_MODES: Final = frozenset("rwxabt+U")
# Statements of these calls compute nothing.
_IDLE: Final = frozenset({
    *_CHANGE, "debug", "info", "print", "remove", "warning", "write", "writelines", "writerow", "writerows",
})  # fmt: skip
# These give a path that is made of the first.
_SAME_PATH: Final = frozenset(
    {"str", "fspath", "abspath", "realpath", "normpath", "resolve", "absolute", "as_posix", "expanduser"}
)
# What is given a path, and leaves the file alone.
_NEITHER: Final = frozenset({*_SAME_PATH, *CHANGING, "debug", "format", "info", "joinpath", "print", "warning"})
_NO_FILES: Final = frozenset({"builtins", "os", "pathlib", "posixpath", "tempfile"})
# What is called so writes most likely.
_WRITING: Final = re.compile("writ|save|dump|store|export|append|record", re.IGNORECASE)


class _FileUse(NamedTuple):
    """A call that reads or writes a file.

    Attributes
    ----------
    call, path
        The call, and the expression that names the file; None for any file.
    reads, writes
        Whether it reads the file or asks for it, and whether it writes or removes it.
    is_whole
        Whether it leaves nothing of what was in the file.
    is_known
        Whether the function is known to do so; any other one that is given a name may do both.
    """

    call: ast.Call
    path: ast.expr | None
    reads: bool = True
    writes: bool = True
    is_whole: bool = False
    is_known: bool = True


def _called(call: ast.Call, names: Mapping[str, Any]) -> tuple[Any, ast.Call]:
    """Return the function that is called, None if no name says it, and its call: of a partial, with all it has."""
    function = evaluated(call.func, names)
    while isinstance(function, functools.partial):
        known = [ast.keyword(name, _constant(value)) for name, value in function.keywords.items()]
        whole = ast.Call(call.func, [*map(_constant, function.args), *call.args], [*known, *call.keywords])
        function, call = function.func, ast.copy_location(whole, call)
    return function, call


def _constant(value: Any) -> ast.Constant:
    """Return the text of a path or number as an expression; of any other value, one of no text."""
    return ast.Constant(str(value) if isinstance(value, str | int | PurePath) else None)


def _uses_of(written: ast.Call, names: Mapping[str, Any]) -> list[_FileUse]:
    """Return what a call of a library's function or of a method reads and writes."""
    function, call = _called(written, names)
    return [use._replace(call=written) for use in _uses_by(function, call, names)]


def _uses_by(function: Any, call: ast.Call, names: Mapping[str, Any]) -> list[_FileUse]:
    owner = call.func.value if isinstance(call.func, ast.Attribute) else None
    name = str(getattr(function, "__name__", _last_name(call.func)))
    module = str(getattr(function, "__module__", "")).partition(".")[0].lstrip("_")
    module = {"posix": "os", "nt": "os"}.get(module, module)
    if owner is not None and isinstance(evaluated(owner, names), types.ModuleType | type):
        owner = None
    arguments = [*call.args, *(keyword.value for keyword in call.keywords)]
    if isinstance(function, types.FunctionType) and is_own(str(function.__globals__.get("__name__"))):
        return []
    if (module, name) in _OF_MODULES:
        read, written = _OF_MODULES[module, name]
        places = [(place, argument) for place, argument in enumerate(arguments) if place in {*read, *written}]
        return [
            _FileUse(call, argument, place in read, place in written, place not in read) for place, argument in places
        ]
    if owner is not None and name in ("rename", "replace"):
        # A text is replaced by two arguments, and columns are renamed by a keyword.
        paths = [owner, *call.args] if len(call.args) == 1 and not call.keywords else []
        return [_FileUse(call, path, path is owner, True, path is not owner) for path in paths]
    if name in _KNOWN:
        return _known_uses(call, name, owner, arguments)
    if module in ("subprocess", "os") and name in _PROCESSES:
        return [_FileUse(call, None, reads=False), *_unknown_uses(call, arguments)]
    return [] if name in _NEITHER or module in _NO_FILES else _unknown_uses(call, arguments)


def _known_uses(call: ast.Call, name: str, owner: ast.expr | None, arguments: Sequence[ast.expr]) -> list[_FileUse]:
    is_of_path = owner is not None and name in _OF_PATHS and not (name == "open" and not _mode_of(call, 0))
    path = owner if is_of_path else next(iter(arguments), ast.Constant(".") if name in _LIST else None)
    if path is None:  # it returns what it would write
        return []
    if name not in _OPEN:
        is_read = name in _READ or name in _LIST
        return [_FileUse(call, path, is_read, not is_read, name in _WRITE)]
    place, reads, writes = _OPEN[name]
    mode = _mode_of(call, 0 if is_of_path else place)
    if mode:
        reads, writes = not {*"rx"}.isdisjoint(mode), not {*"wxa+"}.isdisjoint(mode)
        reads |= "a" in mode and name != "open"  # as of an archive
    return [_FileUse(call, path, reads, writes, "w" in mode)]


def _unknown_uses(call: ast.Call, arguments: Iterable[ast.expr]) -> list[_FileUse]:
    lists = [part.elts if isinstance(part, ast.List | ast.Tuple) else [part] for part in arguments]
    return [_FileUse(call, path, is_known=False) for path in itertools.chain.from_iterable(lists)]


def _mode_of(call: ast.Call, place: int) -> str:
    """Return the mode by which a call opens a file, as ``open`` has it: "" if it has none, "r+" if it is computed."""
    by_keyword = (keyword.value for keyword in call.keywords if keyword.arg in ("mode", "flags", "flag"))
    given = next(by_keyword, call.args[place] if len(call.args) > place else None)
    if given is None:
        return "" if place else "r"
    text, value = ast.unparse(given), getattr(given, "value", None)
    if isinstance(value, str):
        return value if value and _MODES.issuperset(value) else ""
    if value == 1 or re.search(r"WRITE\b|O_TRUNC", text):
        return "w"
    return "r" if value == 0 or re.search(r"READ\b|O_RDONLY", text) else "r+"


def _last_name(function: ast.expr) -> str:
    return str(getattr(function, "attr", getattr(function, "id", "")))


# -- functions and the names of files in them --------------------------------------------------------------------------


# What executes all of its parts.
_ALWAYS: Final = (ast.With, ast.withitem, ast.Expr, ast.Assign, ast.Call, ast.UnaryOp, ast.Compare)


class _FunctionText:
    """A function of the user, with what its names mean."""

    def __init__(self, found: Definition) -> None:
        self.found, function = found, found.function
        self.names = {**vars(builtins), **found.names, **imported_by(found)}
        self.key = id(function) if function is not None else id(found)
        self.defaults = defaults_of(function) if function is not None else {}
        self.parameters = function.__code__.co_varnames[: function.__code__.co_argcount] if function is not None else ()
        self.nodes = [*ast.walk(found.node)]
        self.parents = {child: parent for parent in self.nodes for child in ast.iter_child_nodes(parent)}
        inside = ast.walk(found.node.args) if isinstance(found.node, ast.FunctionDef) else ()
        self.arguments = [part for part in inside if isinstance(part, ast.arg)]
        # By variable: what it is given, each an expression, or None for what no text says.
        self.given: dict[str, list[ast.expr | None]] = {}
        for part in self.nodes:
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                self.given.setdefault(part.id, []).append(self._value_of(part))
            elif isinstance(part, ast.arg) and part not in self.arguments:
                self.given.setdefault(part.arg, []).append(None)
        # What names mean that no statement of it gives another value than another name has.
        self.meanings = {name: value for name, value in self.names.items() if name not in self.given}
        for name, values in self.given.items():
            if len(values) == 1 and isinstance(values[0], ast.Name | ast.Attribute):
                self.meanings[name] = evaluated(values[0], self.names)
        self.uses = [use for part in self.nodes if isinstance(part, ast.Call) for use in _uses_of(part, self.meanings)]

    def _value_of(self, target: ast.Name) -> ast.expr | None:
        """Return the expression that a statement assigns to a variable: of a loop, all that it goes through."""
        parent = self.parents[target]
        if isinstance(parent, ast.Tuple):
            place, parent = parent.elts.index(target), self.parents[parent]
            value = parent.value if isinstance(parent, ast.Assign) else None
            if isinstance(value, ast.Tuple) and len(value.elts) > place:
                return value.elts[place]
            return value if isinstance(value, ast.Call) else None  # as ``handle, path = tempfile.mkstemp()``
        if isinstance(parent, ast.Assign | ast.AnnAssign | ast.NamedExpr):
            return parent.value
        if isinstance(parent, ast.withitem):
            return parent.context_expr
        if isinstance(parent, ast.For | ast.comprehension) and isinstance(parent.iter, ast.Tuple | ast.List):
            return ast.BoolOp(ast.Or(), parent.iter.elts)
        return None

    def text(self, call: ast.Call) -> str:
        """Return a call with its place; one of the graph has none."""
        return f"{ast.unparse(call):.80} ({self.found.place_in(call)})" if self.found.file else ast.unparse(call.func)

    # -- in which order ----------------------------------------------------------------------------------------------

    def is_written_before(self, use: _FileUse) -> bool:
        """Whether each call of the function that reads a file has written it before."""
        writes = (one for one in self.uses if one.is_whole and not one.reads)
        path = use.path or ast.Constant(None)
        variables = [part.id for part in ast.walk(path) if isinstance(part, ast.Name)]
        same = [one for one in writes if one.path is not None and ast.unparse(one.path) == ast.unparse(path)]
        is_one = all(len(self.given.get(name, ())) < 2 for name in variables)
        return is_one and any(self._is_after(use.call, one.call) for one in same)

    def _is_after(self, node: ast.AST, first: ast.AST) -> bool:
        """Whether a part of the function is executed only when another one has been, and after it."""
        later = self._places(node)
        for block, number in self._places(first, only_always=True).items():
            if block in later and later[block] > number:
                return True
        around = self._statement(first)
        return isinstance(around, ast.With) and around is not self._statement(node) and around in self._above(node)

    def _statement(self, node: ast.AST) -> ast.AST:
        while not isinstance(node, ast.stmt):
            node = self.parents[node]
        return node

    def _above(self, node: ast.AST) -> Iterator[ast.AST]:
        while node in self.parents:
            node = self.parents[node]
            yield node

    def _places(self, node: ast.AST, *, only_always: bool = False) -> dict[tuple[ast.AST, str], int]:
        """Return the blocks of statements around a node, each with the number of the statement in which it is."""
        found: dict[tuple[ast.AST, str], int] = {}
        for parent in self._above(node):
            for name, block in ast.iter_fields(parent):
                if isinstance(block, list) and isinstance(node, ast.stmt) and node in block:
                    found[parent, name] = block.index(node)
            is_always = isinstance(parent, _ALWAYS) or (isinstance(parent, ast.If) and node is parent.test)
            if only_always and not is_always:
                break
            node = parent
        return found

    def is_idle(self, use: _FileUse) -> bool:
        """Whether it only asks for a file before it makes it or removes it, and computes nothing with the answer."""
        if _last_name(use.call.func) not in _ASK:
            return False
        statement = self._statement(use.call)
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            name = statement.targets[0].id
            reads = [part for part in self.nodes if isinstance(part, ast.Name) and part.id == name]
            return all(self._is_idle_test(part) for part in reads if isinstance(part.ctx, ast.Load))
        return self._is_idle_test(use.call)

    def _is_idle_test(self, node: ast.AST) -> bool:
        statement = self._statement(node)
        if not isinstance(statement, ast.If) or node not in ast.walk(statement.test):
            return False
        calls = [getattr(part, "value", None) for part in (*statement.body, *statement.orelse)]
        return all(isinstance(call, ast.Call) and _last_name(call.func) in _IDLE for call in calls)


class _FileNames:
    """The names that files have in some functions, as far as their texts say them."""

    def __init__(self, functions: Iterable[_FunctionText]) -> None:
        self.functions = {one.key: one for one in functions}
        # By function: its calls, each with the function that makes it; and those that are handed on.
        self.calls: dict[int, list[tuple[_FunctionText, ast.Call]]] = {}
        self.handed_on: set[int] = set()
        for caller in self.functions.values():
            callees = set[ast.AST]()
            for node in caller.nodes:
                function, call = _called(node, caller.meanings) if isinstance(node, ast.Call) else (None, None)
                if call is not None and id(function) in self.functions:
                    self.calls.setdefault(id(function), []).append((caller, call))
                    callees.add(call.func)
            for node in caller.nodes:
                if isinstance(node, ast.Name | ast.Attribute) and node not in callees:
                    self.handed_on.add(id(evaluated(node, caller.meanings)))
        self._begun: set[tuple[int, str]] = set()

    def of_use(self, use: _FileUse, function: _FunctionText) -> frozenset[str]:
        """Return the names that the file of a call may have; of an unknown one only what is surely a path."""
        texts, owner = self.of(use.path, function), getattr(use.call.func, "value", None)
        if owner is not None and _FRESH in self.of(owner, function):
            return frozenset()  # what is inside of a file that was opened
        if _last_name(use.call.func) in _LIST:
            texts = _joined(_PATHS, [_filled(r"[*?\[].*", texts), frozenset({_ANY})])
        return texts if use.is_known or use.path is None else frozenset(filter(_PATH.fullmatch, texts))

    def of(self, node: ast.expr | None, function: _FunctionText) -> frozenset[str]:
        """Return the texts that an expression of a function may have."""
        match node:
            case ast.Constant(value=str() | int() as value):
                return frozenset({_FRESH if value in _IN_MEMORY else str(value)})
            case ast.Name(id=name):
                return self._of_variable(name, function)
            case ast.JoinedStr(values=parts):
                return _joined(_TEXTS, [self.of(part, function) for part in parts])
            case ast.FormattedValue(value=inner, format_spec=None):
                return self.of(inner, function)
            case ast.BinOp(left=left, op=ast.Add() | ast.Div() as operator, right=right):
                pattern = _TEXTS if isinstance(operator, ast.Add) else _PATHS
                return _joined(pattern, [self.of(left, function), self.of(right, function)])
            case ast.BinOp(left=left, op=ast.Mod()):
                return _filled(r"%[-+ #0-9.]*[a-zA-Z]", self.of(left, function))
            case ast.IfExp(body=one, orelse=other):
                return self.of(one, function) | self.of(other, function)
            case ast.BoolOp(values=values):
                return frozenset().union(*(self.of(value, function) for value in values))
            case ast.Attribute(value=inner) | ast.Subscript(value=inner):
                value = evaluated(node, function.meanings)
                if isinstance(value, str | PurePath):
                    return frozenset({str(value)})
                return _fresh_or_any(self.of(inner, function))
            case ast.Call():
                return self._of_call(node, function)
        return frozenset({_ANY})

    def _of_call(self, call: ast.Call, function: _FunctionText) -> frozenset[str]:
        called, name = evaluated(call.func, function.meanings), _last_name(call.func)
        owner = call.func.value if isinstance(call.func, ast.Attribute) else None
        parts = [self.of(argument, function) for argument in call.args]
        if called is tempfile.gettempdir:
            return frozenset({tempfile.gettempdir()})
        if getattr(called, "__module__", "") == "tempfile" or name in ("BytesIO", "StringIO"):
            return frozenset({_FRESH})
        if id(called) in self.functions:
            inner = self.functions[id(called)]
            returned = (part.value for part in inner.nodes if isinstance(part, ast.Return))
            return frozenset[str]().union(*(self.of(value, inner) for value in returned)) or frozenset({_ANY})
        if called is os.path.join or (isinstance(called, type) and issubclass(called, PurePath)):
            return _joined(_PATHS, parts)
        is_own = owner is not None and not isinstance(evaluated(owner, function.meanings), types.ModuleType | type)
        whole = self.of(owner, function) if is_own else parts[0] if parts else frozenset({_ANY})
        if name == "joinpath":
            return _joined(_PATHS, [whole, *parts])
        if name == "format":
            return _filled(r"\{[^}]*\}", whole)
        if (name in _OPEN and parts) or name == "fdopen":
            return frozenset({_FRESH})  # to open it is a use of its own
        return whole if name in {*_SAME_PATH, "enter_context"} else _fresh_or_any(whole)

    def _of_variable(self, name: str, function: _FunctionText) -> frozenset[str]:
        key = function.key, name
        if key in self._begun:
            return frozenset({_ANY})
        self._begun.add(key)
        found = frozenset[str]()
        for value in function.given.get(name, ()):
            found |= self.of(value, function)
        if any(argument.arg == name for argument in function.arguments):
            found |= self._of_parameter(name, function)
        elif name not in function.given:
            value = function.names.get(name)
            found = frozenset({str(value)}) if isinstance(value, str | PurePath) else frozenset({_ANY})
        self._begun.discard(key)
        return found if len(found) <= _MOST_NAMES else frozenset({_ANY})

    def _of_parameter(self, name: str, function: _FunctionText) -> frozenset[str]:
        """Return what callers give a parameter, one of which is the graph, and its default."""
        found, default = frozenset[str](), function.defaults.get(name)
        if isinstance(default, str | PurePath):
            found |= {str(default)}
        for caller, call in self.calls.get(function.key, ()):
            given = dict(zip(function.parameters, call.args, strict=False))
            given |= {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg}
            if name in given or default is None:
                found |= self.of(given.get(name), caller)
        is_known = function.key in self.calls and function.key not in self.handed_on
        return found if found and is_known else found | {_ANY}


def _joined(pattern: str, parts: Iterable[frozenset[str]]) -> frozenset[str]:
    """Return all texts of some parts, one behind the other: of paths, an absolute one is not behind another."""
    found = frozenset({""})
    for part in parts:
        known = [_ANY if text[:1] == _TOKEN else text for text in part]
        found = frozenset(
            two if not one or (pattern == _PATHS and two[:1] == "/") else pattern.format(one, two)
            for one, two in itertools.product(found, known)
        )
        if len(found) > _MOST_NAMES:
            return frozenset({_ANY})
    return found


def _filled(field: str, texts: frozenset[str]) -> frozenset[str]:
    return frozenset(re.sub(field, _ANY, text) for text in texts)


def _fresh_or_any(texts: frozenset[str]) -> frozenset[str]:
    return frozenset({_FRESH if any(_FRESH in text for text in texts) else _ANY})


def _may_be_one(one: str, other: str) -> bool:
    """Whether two names may be those of one file."""
    if _FRESH in one + other:
        return False
    if _TOKEN in one[:1] + other[:1]:
        return one == other
    one, other = (text if text[:1] in ("", _ANY) else os.path.abspath(text) for text in (one, other))
    if _ANY not in one + other:
        return one == other
    starts, ends = ([text.split(_ANY)[place] for text in (one, other)] for place in (0, -1))
    return (starts[0].startswith(starts[1]) or starts[1].startswith(starts[0])) and (
        ends[0].endswith(ends[1]) or ends[1].endswith(ends[0])
    )


# -- the check ---------------------------------------------------------------------------------------------------------


def check_files(
    functions: Iterable[types.FunctionType], cg: CompGraph, hyperparameters: Mapping[str, Any], inputs: Iterable[str]
) -> list[str]:
    """Return why functions may not read what they, or others of them, write; one reason for each call.

    Parameters
    ----------
    functions
        The user's functions that the graph reaches.
    cg, hyperparameters, inputs
        The graph, the values of its hyperparameters, and the tokens that each event brings.
    """
    known = [*_graphs(cg, hyperparameters, {*inputs})]
    for function in functions:
        code, node = function.__code__, definition_of(function.__code__)[1]
        if node is not None:
            what, node = f"Function {code.co_name!r}", as_function(node) if isinstance(node, ast.Lambda) else node
            names, captured = namespace_of(function), captured_by(function)
            known.append(_FunctionText(Definition(what, node, code.co_filename, (), names, function, captured, ())))
    files, found = _FileNames(known), list[str]()
    uses = [(one, use) for one in known for use in one.uses]
    if not any(use.writes and (use.is_known or _WRITING.search(ast.unparse(use.call))) for _, use in uses):
        return []
    named = [(one, use, texts) for one, use in uses if (texts := files.of_use(use, one))]
    for one, use, texts in named:
        if not use.reads or one.is_written_before(use) or one.is_idle(use):
            continue
        for writer, write, others in named:
            pairs = itertools.product(texts, others) if write.writes and _may_meet(use, write) else ()
            if any(_may_be_one(*pair) for pair in pairs):
                text = f"{one.found.what} calls {one.text(use.call)}, which may read what {writer.text(write.call)}"
                text += " has written in an earlier event: no answer may depend on that. Write what one event alone"
                text += " needs into a folder of its own, tempfile.TemporaryDirectory()."
                found.append(f"{text} {keep_as_state('kept', is_object=True)}.")
                break
    return list(dict.fromkeys(found))


def _may_meet(read: _FileUse, write: _FileUse) -> bool:
    """Whether one call may read what another one writes, as far as their functions are known."""
    if read.is_known or write.is_known:
        return read.call is not write.call or (read.is_known and write.is_known)
    return bool(_WRITING.search(ast.unparse(write.call))) and not _WRITING.search(_last_name(read.call.func))


def _graphs(cg: CompGraph, hyperparameters: Mapping[str, Any], inputs: Collection[str]) -> Iterator[_FunctionText]:
    """Give a graph and those of its pipelines as functions that call theirs with the tokens."""
    node, names = ast.FunctionDef("graph", ast.arguments([], [], None, [], [], None, []), [], []), dict[str, Any]()
    for name, made in cg.functions.items():
        function = without_nodes(made)
        if isinstance(function, Pipeline):
            yield from _graphs(function.cg, {}, ())
            continue
        names[name] = layers(function)[-1]
        tokens = [
            ast.Constant(_TOKEN + token) if token in inputs else _constant(hyperparameters.get(token))
            for token in cg.func_inputs(name)
        ]
        node.body.append(ast.Expr(ast.Call(ast.Name(name, ast.Load()), [*tokens], [])))
    yield _FunctionText(Definition("The graph", node, "", (), names, None, {}, ()))
