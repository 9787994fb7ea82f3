"""Loops, comprehensions and Python's own functions of sequences and numbers."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from epypes.cpp import arrays
from epypes.cpp import types as t
from epypes.cpp.expressions import arguments, condition, list_of, value_of, widened, written
from epypes.cpp.scope import UNKNOWN, Binding, ByHand, Expr, Scope, is_number, names_in, refuse, tuple_of

_ROUNDS: Final = 5


@dataclass(frozen=True, slots=True)
class Iteration:
    """The head of a loop in C++, and what its variable is in each turn, made when the loop has begun."""

    head: str
    item: Callable[[], Expr]


def iterate(scope: Scope, node: ast.expr, names: Sequence[str]) -> Iteration:
    """Return the loop over what Python iterates over; its lines before are added."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id not in scope.locals:
        if node.func.id == "range":
            return _range(scope, node, names)
        if node.func.id in ("enumerate", "zip"):
            return _side_by_side(scope, node)
    given = value_of(scope, node)
    kind = given.type
    if given.parts:
        given = list_of(scope, [*given.parts], node)
        kind = given.type
    if isinstance(kind, t.ListType) and kind.item != t.NONE:
        name = _named(scope, given)
        item = scope.fresh(names[0] if len(names) == 1 else "item")
        reference = kind.item.cpp if isinstance(kind.item, t.Int | t.Plain) else f"{kind.item.cpp}&"
        return Iteration(f"for (const {reference} {item} : {name}) {{", lambda: Expr(item, kind.item, name=item))
    index, (head, (make,)) = scope.fresh("index"), _sequences(scope, [given], node)
    return Iteration(head.replace("@", index), lambda: make(index))


def _named(scope: Scope, given: Expr) -> str:
    """Return a sequence as a variable that lasts as long as the loop and keeps its items."""
    if given.text.isidentifier() and given.text not in {variable.name for variable in scope.variables.values()}:
        return given.text
    return scope.hold("items", given).text


def _whole(given: Expr) -> Expr:
    """Return an integer of NumPy or a truth value as an integer of Python."""
    dtype = given.type.dtype
    if isinstance(given.type, t.ArrayType) or "int" not in dtype or dtype == "uint64":
        return widened(given) if dtype != "bool" else Expr(f"std::int64_t{{{given.text}}}", t.Int(0, 1))
    import numpy as np

    return Expr(f"std::int64_t{{{given.text}}}", t.Int(int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)))


def place(node: Any) -> tuple[int, int]:
    """Return the place of an expression in the source."""
    return node.lineno, node.col_offset


def _range(scope: Scope, node: Any, names: Sequence[str]) -> Iteration:
    given, named = arguments(scope, node)
    given = [_whole(each) for each in given]
    if named or not 1 <= len(given) <= 3 or not all(isinstance(each.type, t.Int) for each in given):
        raise ByHand("a range of these arguments", node)
    low, high = (written(0, "", node), given[0]) if len(given) == 1 else given[:2]
    step = given[2].value if len(given) == 3 else 1
    refuse(type(step) is not int or step == 0, "a range with a step that is not written out", node)
    ends = [end.type for end in (low, high) if isinstance(end.type, t.Int)]
    name = scope.fresh(names[0] if len(names) == 1 else "index")
    if high.value is UNKNOWN:
        high = scope.hold("last", replace(high, type=replace(high.type, is_int=False)))
    sign = "<" if step > 0 else ">"
    pace = f"++{name}" if step == 1 else f"--{name}" if step == -1 else f"{name} += {step}"
    if abs(step) > 1 and not (all(end.is_within(62) for end in ends) and abs(step) < 2**62):
        pace = f"{name} = python::add({name}, {step})"
    kind = t.Int(ends[0].low, max(ends[1].high - 1, ends[0].low))
    if step < 0:
        kind = t.Int(min(ends[1].low + 1, ends[0].high), ends[0].high)
    head = f"for (std::int64_t {name} = {low.text}; {name} {sign} {high.text}; {pace}) {{"
    return Iteration(head, lambda: Expr(name, kind, name=name))


def _sequences(scope: Scope, given: Sequence[Expr], node: Any) -> tuple[str, Sequence[Callable[[str], Expr]]]:
    """Return the head of a loop whose index is @, and what makes an item of each sequence of an index."""
    sizes, items = [], []
    for each in given:
        whole = list_of(scope, [*each.parts], node) if each.parts else each
        size, item = _sequence(scope, whole, node)
        sizes.append(f"@ < static_cast<std::int64_t>({size})")
        items.append(item)
    return f"for (std::int64_t @ = 0; {' && '.join(sizes)}; ++@) {{", items


def _sequence(scope: Scope, given: Expr, node: Any) -> tuple[str, Callable[[str], Expr]]:
    kind = given.type
    if isinstance(kind, t.ListType) and kind.item != t.NONE:
        name = _named(scope, given)
        return f"{name}.size()", lambda index: Expr(f"{name}[{index}]", kind.item, name=f"{name}[]")
    refuse(not isinstance(kind, t.ArrayType), f"a loop over {t.describe(kind)}", node)
    rows = scope.hold("rows", arrays.as_array(given, node))
    return f"{rows.text}.shape[0]", lambda index: arrays.row(rows.text, rows.type, index)


def _side_by_side(scope: Scope, node: Any) -> Iteration:
    is_zip = node.func.id == "zip"
    options = {str(each.arg): each.value for each in node.keywords}
    given, starts = (node.args, []) if is_zip else (node.args[:1], node.args[1:])
    start = getattr(options.get("start", starts[0] if starts else ast.Constant(0)), "value", None)
    is_strict = "strict" in options and getattr(options["strict"], "value", True)
    if not given or is_strict or type(start) is not int or abs(start) > t.INT.high:
        raise ByHand(f"{node.func.id} of these arguments", node)
    head, makes = _sequences(scope, [value_of(scope, each) for each in given], node)
    index = scope.fresh("index")

    def item() -> Expr:
        number = Expr(f"{index} + {start}" if start else index, t.Int(start, start + 2**31), is_atom=not start)
        return tuple_of(
            [*([] if is_zip else [replace(number, name="" if start else index)]), *(make(index) for make in makes)]
        )

    return Iteration(head.replace("@", index), item)


# -- statements --------------------------------------------------------------------------------------------------------


def bind(scope: Scope, target: ast.expr, value: Expr, node: Any, *, is_local: bool) -> None:
    """Give the variables of a loop their values; those that only the loop knows need no variable of their own."""
    if isinstance(target, ast.Tuple):
        from epypes.cpp.statements import unpacked

        for each, part in zip(target.elts, unpacked(scope, value, len(target.elts), node), strict=True):
            bind(scope, each, part, node, is_local=is_local)
    elif isinstance(target, ast.Name):
        if not is_local:
            scope.assign(target.id, value, node)
        elif value.name and value.text.isidentifier():
            scope.env[target.id] = Binding(value.text, value.type)
        else:
            scope.env[target.id] = Binding(scope.hold(target.id, value).text, value.type)
    else:
        raise ByHand(f"a loop over {ast.unparse(target):.40}", node)


def is_loops_own(scope: Scope, names: Sequence[str]) -> bool:
    """Whether names are assigned by loops alone, and read inside of these."""
    inside: set[int] = set()
    for loop in ast.walk(scope.node):
        if isinstance(loop, ast.For):
            inside |= {id(each) for each in names_in(loop.target)}
            own = {each.id for each in names_in(loop.target)}
            read = (each for part in loop.body for each in names_in(part, ast.Load))
            inside |= {id(each) for each in read if each.id in own}
    if any(each.id in names and id(each) not in inside for each in names_in(scope.node)):
        return False
    return not any(arg.arg in names for arg in scope.node.args.args)


def loop(scope: Scope, head: str, turn: Callable[[], None]) -> None:
    """Add a loop: translate its body until the types of variables are those that a turn leaves."""
    entry = dict(scope.env)
    for _ in range(_ROUNDS):
        saved = scope.snapshot()
        scope.env, scope.is_dead = dict(entry), False
        scope.loops.append(([], []))
        with scope.inside(head):
            turn()
        breaks, continues = scope.loops.pop()
        ends = [*continues, *([] if scope.is_dead else [scope.env])]
        scope.merge([entry, *ends])
        after = _widened(entry, scope.env)
        if all(after[name] == bound for name, bound in entry.items()):
            scope.merge([entry, *ends, *breaks])
            scope.is_dead = False
            return
        scope.restore(saved)
        entry = {name: after[name] for name in entry}
    raise ByHand("the types of variables in a loop are not clear", scope.node)


def _widened(entry: Mapping[str, Binding], after: Mapping[str, Binding]) -> dict[str, Binding]:
    """Return what variables are after a turn; an integer that has changed may be any."""
    found = {}
    for name, bound in after.items():
        before = entry.get(name)
        if before is not None and isinstance(bound.type, t.Int) and bound.type != before.type:
            bound = replace(bound, type=t.Int(), value=UNKNOWN)
        found[name] = bound
    return found


def for_statement(scope: Scope, node: ast.For, returned: t.Type | None) -> None:
    """Translate a for loop."""
    from epypes.cpp.statements import body

    refuse(node.orelse, "a loop with else", node)
    names = [each.id for each in names_in(node.target)]
    is_made = isinstance(node.iter, ast.Call) and getattr(node.iter.func, "id", "") not in ("enumerate", "zip")
    over = {each.id for each in names_in(node.iter)} if not is_made else set()
    grown = {
        ast.unparse(each.value) for each in ast.walk(node) if isinstance(each, ast.Attribute) and each.attr == "append"
    }
    refuse(over & grown, "a loop changes the list that it goes over", node)
    empty = scope.env.get(getattr(node.iter, "id", ""))
    if empty is not None and isinstance(empty.type, t.ListType) and empty.type.item == t.NONE and empty.type.origin[0]:
        return  # it is empty until the next round knows what is added to it
    is_local = is_loops_own(scope, names)
    iteration = iterate(scope, node.iter, names if is_local else ())

    def turn() -> None:
        bind(scope, node.target, iteration.item(), node, is_local=is_local)
        body(scope, node.body, returned)

    loop(scope, iteration.head, turn)
    for name in names if is_local else ():
        scope.env.pop(name, None)


def while_statement(scope: Scope, node: ast.While, returned: t.Type | None) -> None:
    """Translate a while loop."""
    from epypes.cpp.statements import body

    refuse(node.orelse, "a loop with else", node)

    def turn() -> None:
        test = condition(scope, node.test)
        if test.value is UNKNOWN:
            with scope.inside(f"if (!{test.atom}) {{"):
                scope.emit("break;")
            scope.loops[-1][0].append(dict(scope.env))
        elif not test.value:
            raise ByHand("a loop that never runs", node)
        body(scope, node.body, returned)

    loop(scope, "while (true) {", turn)
    if not any(isinstance(each, ast.Break) for each in ast.walk(node)) and isinstance(node.test, ast.Constant):
        scope.is_dead = True


def leave(scope: Scope, node: ast.Break | ast.Continue, returned: t.Type | None) -> None:
    """Translate break and continue."""
    scope.emit("break;" if isinstance(node, ast.Break) else "continue;")
    scope.loops[-1][isinstance(node, ast.Continue)].append(dict(scope.env))
    scope.is_dead = True


# -- comprehensions ----------------------------------------------------------------------------------------------------


def comprehension(scope: Scope, node: Any) -> Expr:
    """Return the list of a comprehension, which a loop before the expression fills."""
    if isinstance(node.elt, ast.ListComp) or any(each.is_async for each in node.generators):
        raise ByHand("a comprehension in a comprehension", node)
    saved_env, outer = dict(scope.env), scope.block
    name = scope.fresh("items")
    place = len(outer.items)
    block, elements = outer, []

    def generate(index: int) -> None:
        if index == len(node.generators):
            found = value_of(scope, node.elt)
            elements.append(t.kept(found.type))
            from epypes.cpp.statements import fitted

            scope.emit(f"{name}.push_back({fitted(scope, found, elements[0], node)});")
            return
        each = node.generators[index]
        names = [part.id for part in names_in(each.target)]
        iteration = iterate(scope, each.iter, names)
        with scope.inside(iteration.head):
            bind(scope, each.target, iteration.item(), node, is_local=True)
            tests = [condition(scope, test) for test in each.ifs]
            if tests:
                with scope.inside(f"if ({' && '.join(test.atom for test in tests)}) {{"):
                    generate(index + 1)
            else:
                generate(index + 1)

    generate(0)
    scope.env, scope.block = saved_env, block
    kind = t.ListType(elements[0], origin=(node.lineno, node.col_offset))
    outer.items.insert(place, f"{kind.cpp} {name};")
    return Expr(name, kind)


# -- Python's own functions --------------------------------------------------------------------------------------------


def call(scope: Scope, name: str, node: Any) -> Expr:
    """Translate a call of a function that Python has itself."""
    options = {str(each.arg): each.value for each in node.keywords}
    known = {"sorted": {"key", "reverse"}, "min": {"key"}, "max": {"key"}}.get(name, set())
    translator = _FUNCTIONS.get(name) or _OF_SEQUENCES.get(name)
    refuse(translator is None or not node.args or options.keys() - known, f"{name}() with these arguments", node)
    if name in _FUNCTIONS:
        refuse(len(node.args) > 1, f"{name}() with these arguments", node)
        return _FUNCTIONS[name](scope, value_of(scope, node.args[0]), node)
    given = _items(scope, node.args[0]) if len(node.args) == 1 else None
    if given is None:
        refuse(name not in ("min", "max") or options, f"{name}() with these arguments", node)
        given = list_of(scope, [_whole(value_of(scope, each)) for each in node.args], node)
    refuse(
        not isinstance(given.type, t.ListType) or given.type.item == t.NONE,
        f"{name}() of {t.describe(given.type)}",
        node,
    )
    return _OF_SEQUENCES[name](scope, given, name, options, node)


def of_math(scope: Scope, name: str, node: Any) -> Expr:
    """Translate a call of a function of math; what the C library has gives the same."""
    given, named = arguments(scope, node)
    count = 2 if name in ("atan2", "copysign") else 1
    refuse(named or len(given) != count or not all(is_number(each.type) for each in given), f"math.{name}", node)
    first = given[0]
    if name in ("floor", "ceil", "trunc"):
        whole = _whole(first)
        return whole if isinstance(whole.type, t.Int) else Expr(f"python::integer(std::{name}({first.text}))", t.Int())
    if name in ("isnan", "isinf", "isfinite"):
        return Expr(f"std::{name}(static_cast<double>({first.text}))", t.BOOL)
    if name in ("radians", "degrees"):
        return Expr(
            f"{first.atom} * ({'CV_PI / 180.0' if name == 'radians' else '180.0 / CV_PI'})", t.FLOAT, is_atom=False
        )
    total, partial = t.data("python")["math"].values()
    refuse(name not in (*total, *partial), f"math.{name} has no translation", node)
    numbers = ", ".join(each.text if each.type == t.FLOAT else f"static_cast<double>({each.text})" for each in given)
    # Where Python raises, C++ would go on with NaN or infinity.
    return Expr(
        f"std::{name}({numbers})" if name in total else f"python::finite(std::{name}({numbers}), {numbers})", t.FLOAT
    )


def _items(scope: Scope, node: ast.expr) -> Expr:
    """Return a sequence as a list; a generator is one too, since it is read at once and whole."""
    if isinstance(node, ast.GeneratorExp):
        return comprehension(scope, node)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("range", "enumerate", "zip"):
        each = ast.comprehension(ast.Name("each_of_it", ast.Store()), node, [], 0)
        scope.locals.add("each_of_it")
        return comprehension(scope, ast.copy_location(ast.ListComp(ast.Name("each_of_it", ast.Load()), [each]), node))
    given = value_of(scope, node)
    return list_of(scope, [*given.parts], node) if given.parts and isinstance(given.type, t.TupleType) else given


def _len(scope: Scope, given: Expr, node: Any) -> Expr:
    if given.parts is not None and isinstance(given.type, t.TupleType):
        return written(len(given.parts), "", node)
    if isinstance(given.type, t.ArrayType):
        is_mat = given.type.is_mat
        text = f"python::required({given.text}).rows" if is_mat else f"{given.text}.shape[0]"
        return Expr(text, replace(arrays.SIZE, is_int=is_mat))
    refuse(not isinstance(given.type, t.ListType), f"the length of {t.describe(given.type)}", node)
    return Expr(f"python::length({given.text})", t.Int(0, 2**31))


def _int(scope: Scope, given: Expr, node: Any) -> Expr:
    whole = _whole(given)
    if isinstance(whole.type, t.Int):
        return whole
    refuse(not is_number(given.type) and given.type != t.MIXED, f"int() of {t.describe(given.type)}", node)
    name = "narrow<std::int64_t>" if given.type.dtype == "uint64" else "integer"
    return Expr(f"python::{name}({given.text})", t.Int())


def _float(scope: Scope, given: Expr, node: Any) -> Expr:
    refuse(not is_number(given.type) and given.type != t.MIXED, f"float() of {t.describe(given.type)}", node)
    is_double = given.type in (t.FLOAT, t.MIXED)
    return replace(given, type=t.FLOAT) if is_double else Expr(f"static_cast<double>({given.text})", t.FLOAT)


def _abs(scope: Scope, given: Expr, node: Any) -> Expr:
    if given.type == t.FLOAT:
        return Expr(f"std::abs({given.text})", t.FLOAT)
    if isinstance(given.type, t.Int):
        top = max(abs(given.type.low), abs(given.type.high))
        return Expr(f"python::absolute({given.text})", t.Int(0, min(top, t.HIGH)))
    return arrays.calculate("absolute", [given], node)


def _round(scope: Scope, given: Expr, node: Any) -> Expr:
    if isinstance(given.type, t.Int):
        return widened(given)
    refuse(given.type != t.FLOAT and given.type.dtype != "float64", f"round() of {t.describe(given.type)}", node)
    return Expr(f"python::round({given.text})", t.Int())


def _extreme(scope: Scope, given: Expr, name: str, options: Mapping[str, ast.expr], node: Any) -> Expr:
    item = given.type.item
    if "key" in options:
        key = _key(scope, options["key"], item)
        return Expr(f"python::extreme({given.text}, {key}, {str(name == 'max').lower()})", item)
    if item == t.MIXED and given.parts:
        # What it is in Python depends on which one is chosen; as a number both are the same.
        is_large = any(isinstance(part.type, t.Int) and not part.type.is_within(53) for part in given.parts)
        refuse(is_large, "a float beside an integer of more than 53 bits", node)
        texts = [_float(scope, part, node).text for part in given.parts]
        return Expr(f"python::{name}(std::vector<double>{{{', '.join(texts)}}})", item)
    refuse(not isinstance(item, t.Int) and item != t.FLOAT, f"{name}() of {t.describe(given.type)}", node)
    if isinstance(item, t.Int) and given.parts:
        choose = min if name == "min" else max
        item = t.Int(choose(part.type.low for part in given.parts), choose(part.type.high for part in given.parts))
    return Expr(f"python::{name}({given.text})", item)


def _sum(scope: Scope, given: Expr, name: str, options: Mapping[str, ast.expr], node: Any) -> Expr:
    if given.type.item == t.BOOL:
        return Expr(f"std::count({given.text}.begin(), {given.text}.end(), true)", t.Int(0, 2**31))
    is_sure = isinstance(given.type.item, t.Int)
    refuse(not is_sure, f"sum() of {t.describe(given.type)}: Python's has other last digits than a plain sum", node)
    return Expr(f"python::sum({given.text})", t.Int())


def _sorted(scope: Scope, given: Expr, name: str, options: Mapping[str, ast.expr], node: Any) -> Expr:
    item = given.type.item
    reverse: Any = options.get("reverse", ast.Constant(False))
    refuse(not isinstance(reverse, ast.Constant), "sorted() whose order is computed", node)
    refuse("key" not in options and not is_number(item), f"sorted() of {t.describe(given.type)}", node)
    key = f"{_key(scope, options['key'], item)}, " if "key" in options else ""
    return Expr(
        f"python::sorted({given.text}, {key}{str(bool(reverse.value)).lower()})", t.ListType(item, origin=place(node))
    )


def _list(scope: Scope, given: Expr, name: str, options: Mapping[str, ast.expr], node: Any) -> Expr:
    return replace(given, type=replace(given.type, is_tuple=name == "tuple", origin=place(node)), name="")


def _key(scope: Scope, node: ast.expr, item: t.Type) -> str:
    """Return a key function as a lambda of C++."""
    if isinstance(node, ast.Name | ast.Attribute):
        call = ast.Call(node, [ast.Name("item", ast.Load())], [])
        node = ast.copy_location(ast.Lambda(ast.arguments([], [ast.arg("item")], None, [], [], None, []), call), node)
        ast.fix_missing_locations(node)
    is_lambda = isinstance(node, ast.Lambda) and len(node.args.args) == 1 and not node.args.defaults
    if not isinstance(node, ast.Lambda) or not is_lambda:
        raise ByHand("a key that is no lambda of one argument", node)
    name, body = node.args.args[0].arg, node.body
    saved, known, cpp = dict(scope.env), set(scope.locals), scope.fresh(name)
    scope.locals.add(name)
    scope.env[name] = Binding(cpp, item)
    found = scope.captured(lambda: value_of(scope, body))
    scope.env, scope.locals = saved, known
    refuse(not isinstance(found.type, t.Int) and found.type != t.FLOAT, f"a key that is {t.describe(found.type)}", node)
    return f"[&](const {item.cpp}& {cpp}) {{ return {found.text}; }}"


_FUNCTIONS: Final[Mapping[str, Callable[[Scope, Expr, ast.AST], Expr]]] = {
    "len": _len, "int": _int, "float": _float, "abs": _abs, "round": _round,
}  # fmt: skip
_OF_SEQUENCES: Final[Mapping[str, Callable[[Scope, Expr, str, Mapping[str, ast.expr], Any], Expr]]] = {
    "sum": _sum, "min": _extreme, "max": _extreme, "sorted": _sorted, "list": _list, "tuple": _list,
}  # fmt: skip
