"""Which names and modules from outside does a function use?"""

from __future__ import annotations

import ast
import types
from collections.abc import Collection, Iterator
from typing import Any

from epypes.bundle.source import Definition
from epypes.bundle.text import LATE_ANNOTATIONS, names_from_outside, nested_codes


def global_names(found: Definition, replaced_defaults: Collection[ast.expr] = ()) -> Iterator[str]:
    """Return the global names that a function reads when it is called or defined, each once, in order of use.

    Parameters
    ----------
    found
        Its definition.
    replaced_defaults
        Defaults that are written otherwise.
    """
    names: dict[str, None] = {}
    for code in nested_codes(found.code):
        names.update(dict.fromkeys(names_from_outside(code)))
    arguments = found.node.args
    every = (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg)
    outside = [argument.annotation for argument in every if argument] + [found.node.returns]
    outside += [default for default in defaults_in(found.node) if default not in replaced_defaults]
    for expression in (*outside, *found.node.decorator_list):
        for node in ast.walk(expression) if expression else ():
            if isinstance(node, ast.Name):
                names[node.id] = None
    return iter(names)


def only_in_annotations(found: Definition) -> set[str]:
    """Return the names in annotations of a function that was compiled not to read them; none of any other function."""
    code = found.function.__code__
    if not code.co_flags & LATE_ANNOTATIONS:
        return set()
    read = {name for inner in nested_codes(code) for name in names_from_outside(inner)}
    others = [*defaults_in(found.node), *found.node.decorator_list]
    read |= {part.id for expression in others for part in ast.walk(expression) if isinstance(part, ast.Name)}
    return set(annotated_names(found.node)) - read


def annotated_names(node: ast.AST) -> Iterator[str]:
    """Give the names in all annotations of a definition."""
    for part in ast.walk(node):
        for annotation in (getattr(part, "annotation", None), getattr(part, "returns", None)):
            names = ast.walk(annotation) if annotation is not None else ()
            yield from (name.id for name in names if isinstance(name, ast.Name))


def defaults_in(node: ast.FunctionDef | ast.Lambda) -> list[ast.expr]:
    """Return the defaults of a definition: of parameters by position, then of those by name."""
    return [*node.args.defaults, *(default for default in node.args.kw_defaults if default is not None)]


def default_values(node: ast.FunctionDef, function: types.FunctionType) -> list[tuple[str, ast.expr, Any]]:
    """Return the defaults by parameter, as they are written and as they are; none if it has others than are written."""
    by_position, by_name = function.__defaults__ or (), function.__kwdefaults__ or {}
    every = [*node.args.posonlyargs, *node.args.args]
    named = [
        (one.arg, default) for one, default in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True) if default
    ]
    if len(by_position) != len(node.args.defaults) or by_name.keys() != {name for name, _ in named}:
        return []
    last = every[len(every) - len(by_position) :]
    found = [
        (one.arg, *pair) for one, pair in zip(last, zip(node.args.defaults, by_position, strict=True), strict=True)
    ]
    return found + [(name, default, by_name[name]) for name, default in named]


def submodules(tree: ast.AST, name: str, module: types.ModuleType) -> tuple[str, ...]:
    """Return the submodules that are reached as attributes (``skimage.filters``): each needs an import of its own."""
    found: dict[str, None] = {}
    for node in ast.walk(tree):
        chain = _chain(node)
        if chain and chain[0] == name:
            reached: Any = module
            dotted = name
            for part in chain[1:]:
                reached = getattr(reached, part, None)
                if not isinstance(reached, types.ModuleType) or reached.__name__ != f"{dotted}.{part}":
                    break
                dotted = f"{dotted}.{part}"
            if dotted != name:
                found[dotted] = None
    return tuple(found)


def replaced(tree: ast.AST, name: str, module: types.ModuleType) -> str:
    """Return what of a module a notebook has replaced by a function of its own (``cv2.blur = ...``); "" if nothing."""
    for node in ast.walk(tree):
        chain = _chain(node)
        reached: Any = module if chain and chain[0] == name else None
        for part in chain[1:]:
            reached = getattr(reached, part, None)
        if isinstance(reached, types.FunctionType | type) and reached.__module__ == "__main__":
            return ".".join(chain)
    return ""


def _chain(node: ast.AST) -> list[str]:
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return [node.id, *reversed(parts)] if isinstance(node, ast.Name) and parts else []
