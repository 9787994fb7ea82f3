"""What is known at a place in a function that is translated: its variables, and the C++ lines so far."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import packages_distributions
from typing import Any, Final

from epypes.cpp import types as t

UNKNOWN: Final = object()
_BODIES: Final = ("body", "orelse")


class ByHand(Exception):
    """A function that has to be written by hand; its text is the reason, ``line`` the line in the source."""

    def __init__(self, reason: str, node: Any | None = None) -> None:
        super().__init__(" ".join(reason.split()))
        self.line = getattr(node, "lineno", 0)


def refuse(is_refused: object, reason: str, node: Any | None = None) -> None:
    """Raise ByHand if something holds."""
    if is_refused:
        raise ByHand(reason, node)


def no_counterpart(function: Callable[..., Any]) -> str:
    """Return the reason why a function of another package is not translated."""
    package = str(function.__module__).partition(".")[0]
    found = packages_distributions().get(package, [package])
    return f"{function.__name__} of {found[0]}, which has no C++ counterpart"


@dataclass(frozen=True, slots=True)
class Expr:
    """An expression in C++.

    Attributes
    ----------
    text
        The expression.
    type
        Its type.
    value
        What it is in Python where that is known before it runs: a constant, a module, a function; else UNKNOWN.
    parts
        The items of a tuple or list that is written out.
    is_atom
        Whether it needs no parentheses.
    name
        The variable of Python that it is.
    """

    text: str
    type: Any
    value: Any = UNKNOWN
    parts: tuple[Expr, ...] | None = None
    is_atom: bool = True
    name: str = ""

    @property
    def atom(self) -> str:
        """The expression, in parentheses where it needs them beside an operator."""
        return self.text if self.is_atom else f"({self.text})"


@dataclass(slots=True, eq=False)
class Variable:
    """A variable in C++ that several blocks assign, and the blocks where it is used."""

    name: str
    cpp: str
    blocks: list[Block] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class Store:
    """An assignment to a variable; the first one may declare it."""

    variable: Variable
    text: str


@dataclass(slots=True, eq=False)
class Block:
    """Lines in braces."""

    head: str = ""
    parent: Block | None = None
    items: list[str | Block | Store] = field(default_factory=list)

    def path(self) -> list[Block]:
        """Return the blocks around this one, the outermost first, and this one."""
        return [*(self.parent.path() if self.parent else []), self]

    def render(self, indent: str = "    ") -> Iterator[str]:
        """Yield the lines."""
        for item in self.items:
            if isinstance(item, Block):
                yield f"{indent}{item.head}"
                yield from item.render(f"{indent}    ")
                if not any(later.head.startswith("} ") for later in self._after(item)):
                    yield f"{indent}}}"
            elif isinstance(item, Store):
                yield f"{indent}{item.variable.name} = {item.text};"
            else:
                yield f"{indent}{item}" if item else ""

    def _after(self, item: Block) -> list[Block]:
        index = self.items.index(item) + 1
        return [each for each in self.items[index : index + 1] if isinstance(each, Block)]


@dataclass(frozen=True, slots=True)
class Binding:
    """What a name of Python is at a place: a variable in C++ and the type that it has there."""

    cpp: str
    type: Any
    variable: Variable | None = None
    value: Any = UNKNOWN
    is_sure: bool = True


class Scope:
    """The state of one translation.

    Parameters
    ----------
    node
        The function.
    names
        Its global names: what they are in Python.
    functions
        Returns the C++ name and the return type of another function of the user for the types of its arguments.
    refined
        The types of items of lists that begin empty, by the place of the list, and of the variables that are an array
        of C++ in one branch and a cv::Mat in another, by name; filled while it is translated.
    """

    def __init__(
        self,
        node: ast.FunctionDef,
        names: Mapping[str, Any],
        functions: Callable[[Any, Sequence[t.Type], ast.AST], tuple[str, t.Type]],
        refined: dict[tuple[int, int] | str, t.Type],
    ) -> None:
        self.node, self.names, self.functions, self.refined = node, names, functions, refined
        self.block = self.body = Block()
        self.env: dict[str, Binding] = {}
        self.stored = {each.id for each in names_in(node, ast.Store)}
        self.locals = self.stored | {arg.arg for arg in node.args.args}
        self.used: set[str] = set()
        self.variables: dict[tuple[str, str], Variable] = {}
        self.returns: list[t.Type] = []
        # By loop: the names where it is left, and where its next turn begins.
        self.loops: list[tuple[list[dict[str, Binding]], list[dict[str, Binding]]]] = []
        # The dtypes of the arrays that are written to, and those of which a view in NumPy may be a copy in C++.
        self.written: set[str] = set()
        self.unsure: dict[str, Any] = {}
        self.is_dead = False
        self.statement: ast.stmt | None = None

    # -- lines --------------------------------------------------------------------------------------------------------

    def emit(self, line: str) -> None:
        """Add a line."""
        self.block.items.append(line)

    def hold(self, name: str, value: Expr) -> Expr:
        """Return a value as a constant of its own, computed here."""
        cpp = self.fresh(name)
        self.emit(f"const {value.type.cpp} {cpp} = {value.text};")
        return replace(value, text=cpp, name=cpp, is_atom=True, parts=None)

    def fresh(self, name: str) -> str:
        """Return a name that no variable has in C++."""
        plain = unique = t.identifier(name)
        count = 1
        while unique in self.used:
            count += 1
            unique = f"{plain}_{count}"
        self.used.add(unique)
        return unique

    @contextmanager
    def inside(self, head: str) -> Iterator[Block]:
        """Add lines to a new block, with the names as they are."""
        outer, block = self.block, Block(head, self.block)
        outer.items.append(block)
        self.block = block
        try:
            yield block
        finally:
            self.block = outer

    def captured(self, translate: Callable[[], Expr]) -> Expr:
        """Return an expression with all that it needs inside of it, for a place where it may not be evaluated."""
        outer, block = self.block, Block("", self.block)
        self.block = block
        try:
            found = translate()
        finally:
            self.block = outer
        if not block.items:
            return found
        lines = " ".join(line.strip() for line in block.render(""))
        return replace(found, text=f"[&] {{ {lines} return {found.text}; }}()", is_atom=True, parts=None)

    def snapshot(self) -> tuple[Any, ...]:
        """Return what `restore` goes back to."""
        blocks = {variable: len(variable.blocks) for variable in self.variables.values()}
        return len(self.block.items), len(self.returns), set(self.used), dict(self.variables), blocks

    def restore(self, saved: tuple[Any, ...]) -> None:
        """Forget the lines and variables since a snapshot in the same block."""
        items, returns, self.used, self.variables, blocks = saved
        del self.block.items[items:]
        del self.returns[returns:]
        for variable, count in blocks.items():
            del variable.blocks[count:]

    # -- variables ----------------------------------------------------------------------------------------------------

    def load(self, node: ast.Name) -> Expr:
        """Return the variable or the global that a name is."""
        if node.id in self.locals:
            binding = self.env.get(node.id)
            if binding is None or not binding.is_sure:
                raise ByHand(f"{node.id!r} may have no value here, or values of different types", node)
            if binding.variable is not None:
                binding.variable.blocks.append(self.block)
            return Expr(binding.cpp, binding.type, binding.value, name=node.id)
        return self.constant(self.names.get(node.id, UNKNOWN), node.id, node)

    def constant(self, value: Any, name: str, node: Any) -> Expr:
        """Return a value that is known before the function runs."""
        refuse(value is UNKNOWN, f"{name!r} is no global that a translation knows", node)
        from epypes.cpp.expressions import written

        return written(value, name, node)

    def is_simple(self, name: str) -> bool:
        """Whether one block assigns a variable, and all statements that read it come later in that block."""
        stores: list[tuple[Any, ...]] = []
        loads: list[tuple[Any, ...]] = []
        for path, each in _places(self.node.body, ()):
            if isinstance(each, ast.Name) and each.id == name:
                (stores if isinstance(each.ctx, ast.Store) else loads).append(path)
            if isinstance(each, ast.AugAssign) and isinstance(each.target, ast.Name) and each.target.id == name:
                loads.append(path)
        blocks = {path[:-1] for path in stores}
        if len(blocks) != 1:
            return False
        block, first = blocks.pop(), min(path[-1] for path in stores)
        if block[-1:] == ("target",):
            return False
        # What the first assignment reads is another value: of an argument, or of the turn of a loop before.
        after = all(path[: len(block)] == block and path[len(block)] > first for path in loads)
        return after or (not block and any(arg.arg == name for arg in self.node.args.args))

    def assign(self, name: str, value: Expr, node: Any) -> None:
        """Assign a value to a name of Python; the C++ variable is a new one where that is possible."""
        kind = value.type
        if not kind.cpp or (isinstance(kind, t.Plain) and kind.name == "None"):
            raise ByHand(f"{name!r} becomes {t.describe(kind)}, which has no type in C++", node)
        is_read = any(each.id == name for each in names_in(self.node, ast.Load))
        if not is_read and all(re.fullmatch(r"[\w.]+", each.text) for each in value.parts or [value]):
            return
        constant = value.value if type(value.value) in (int, float, bool, str) else UNKNOWN
        if self.is_simple(name):
            if value.text in self.used and value.name == "" and value.text not in self._bound():
                self.env[name] = Binding(value.text, kind, None, constant)
                return
            cpp = self.fresh(name)
            self.emit(f"{'const ' if isinstance(kind, t.Int | t.Plain) else ''}{kind.cpp} {cpp} = {value.text};")
            self.env[name] = Binding(cpp, kind, None, constant)
            return
        if isinstance(kind, t.Int):
            kind = replace(kind, is_int=False)
        if name in self.refined and isinstance(kind, t.ArrayType) and kind.is_mat:
            from epypes.cpp.arrays import as_array

            value = as_array(value, node)
            kind = value.type
        variable = self.variables.get((name, kind.cpp))
        if variable is None:
            variable = self.variables[name, kind.cpp] = Variable(self.fresh(name), kind.cpp)
        variable.blocks.append(self.block)
        self.block.items.append(Store(variable, value.text))
        self.env[name] = Binding(variable.name, kind, variable)

    def _bound(self) -> set[str]:
        return {binding.cpp for binding in self.env.values()}

    def merge(self, ends: Sequence[dict[str, Binding]]) -> None:
        """Go on with what several ways have left."""
        self.is_dead = not ends
        if not ends:
            return
        merged: dict[str, Binding] = {}
        for name in dict.fromkeys(name for end in ends for name in end):
            found = [end[name] for end in ends if name in end]
            merged[name] = _merged(found, len(found) == len(ends))
            kinds = [each.type for each in found]
            if len(kinds) == len(ends) and {getattr(kind, "is_mat", None) for kind in kinds} == {True, False}:
                with suppress(TypeError):
                    self.refined[name] = functools.reduce(t.join, kinds)
        self.env = merged

    def declare(self) -> list[str]:
        """Return the lines of the function, with the declarations of its variables where they are needed first."""
        for variable in self.variables.values():
            paths = [block.path() for block in variable.blocks]
            common = [steps[0] for steps in zip(*paths, strict=False) if all(step is steps[0] for step in steps)]
            block = common[-1]
            inner = {id(path[len(common)]) for path in paths if len(path) > len(common)}
            for index, item in enumerate(block.items):
                if isinstance(item, Store) and item.variable is variable:
                    block.items[index] = f"{variable.cpp} {variable.name} = {item.text};"
                    break
                if isinstance(item, Block) and id(item) in inner:
                    while index and isinstance(item, Block) and item.head.startswith("} "):
                        index -= 1
                        item = block.items[index]
                    block.items.insert(index, f"{variable.cpp} {variable.name}{{}};")
                    break
        lines = [*self.body.render()]
        text = "\n".join(lines)
        return [_marked(line, text) for line in lines]


def _marked(line: str, text: str) -> str:
    """Mark a variable that nothing reads, so that compilers don't warn."""
    found = re.match(r"(\s*(?:for \()?)((?:const )?[\w:]+(?:<[^=]*>)?&? (\w+) [=:] .*)", line)
    is_unused = found is not None and len(re.findall(rf"\b{found[3]}\b", text)) == 1
    return f"{found[1]}[[maybe_unused]] {found[2]}" if found is not None and is_unused else line


def _merged(found: Sequence[Binding], is_everywhere: bool) -> Binding:
    first = found[0]
    unsure = replace(first, is_sure=False)
    if not is_everywhere or not all(each.is_sure and each.cpp == first.cpp for each in found):
        return unsure
    kind = first.type
    for each in found[1:]:
        try:
            kind = t.join(kind, each.type)
        except TypeError:
            return unsure
        if kind.cpp != first.type.cpp and not isinstance(kind, t.Int):
            return unsure
    value = first.value if all(each.value is first.value or each.value == first.value for each in found) else UNKNOWN
    return replace(first, type=kind, value=value)


def _places(body: Sequence[ast.stmt], path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], ast.AST]]:
    """Yield the nodes of a body, each with its place: the numbers of statements, and the names of inner bodies."""
    for number, statement in enumerate(body):
        here = (*path, number)
        yield here, statement
        for name, value in ast.iter_fields(statement):
            if name in _BODIES and isinstance(value, list):
                yield from _places(value, (*here, name))
            else:
                inner = (*here, "target", 0) if name == "target" and isinstance(statement, ast.For) else here
                for each in value if isinstance(value, list) else [value]:
                    if isinstance(each, ast.AST):
                        yield from ((inner, node) for node in ast.walk(each))


def names_in(node: ast.AST, context: type[ast.expr_context] = ast.expr_context) -> Iterator[ast.Name]:
    """Yield the names in a part of a function, all or those that are read or assigned."""
    return (each for each in ast.walk(node) if isinstance(each, ast.Name) and isinstance(each.ctx, context))


def is_number(kind: t.Type) -> bool:
    """Whether a type is one of a single number."""
    return isinstance(kind, t.Int) or kind in (t.FLOAT, t.BOOL) or (isinstance(kind, t.Plain) and bool(kind.dtype))


def writes(scope: Scope, array: Expr, node: Any) -> None:
    """Note that an array is written to; raise ByHand if its memory may be that of an argument."""
    if isinstance(array.type, t.ArrayType):
        refuse(array.type.is_readonly, "it writes to an argument, which is read-only in Python", node)
        scope.written.add(array.type.dtype)


def shares(scope: Scope, array: Expr, node: Any) -> None:
    """Note that an array is made which shares memory with another one, or not, as the layout is."""
    if isinstance(array.type, t.ArrayType) and array.type.is_other:
        scope.unsure[array.type.dtype] = node


def tuple_of(parts: Sequence[Expr]) -> Expr:
    """Return a tuple that is written out."""
    items = t.TupleType(tuple(part.type for part in parts))
    values = tuple(part.value for part in parts)
    value = UNKNOWN if any(part is UNKNOWN for part in values) else values
    return Expr(f"{items.cpp}{{{', '.join(part.text for part in parts)}}}", items, value, tuple(parts))
