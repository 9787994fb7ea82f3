"""Libraries as one process has them: their settings, and what their modules hold, as texts to be compared.

A notebook may set a library otherwise or patch it in ways that no syntax shows: by a helper, through ``vars``, or deep
in another module. What it has changed is found by comparison with a process that has imported the same modules and
nothing else. What differs between two such processes too, such as the time of an import, is no change.

A number, text, tuple or array is described by its content; a function by its home, instructions and defaults; a class
by its home, and by its attributes where it is defined; any other object by its type alone. Left out is what libraries
count and remember in: private values, and names that are neither constants nor named by the bundle. So are modules that
only one of the processes has loaded.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import operator
import sys
import types
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from epypes.run.snapshot import is_own

Attributes = Mapping[str, Mapping[str, str]]

# Only where a function catches warnings, errors in their place change what it computes.
WARNINGS: Final = "warnings.simplefilter"
# What the name of a variable of the context follows.
CONTEXT_VARIABLE: Final = "ContextVar "
_ATOMS: Final = (int, float, complex, bool, str, bytes, type(None), type(...))
# Longer descriptions are digests.
_MOST_TEXT: Final = 60
_MOST_ENTRIES: Final = 500
_MOST_BYTES: Final = 65_536
# They hold the interpreter's own state, which is another one in each kind of process.
OF_THE_PROCESS: Final = frozenset({"sys", "warnings", "threading", "signal", "epypes"})
# What these put into other modules, every notebook has.
_OF_NOTEBOOKS: Final = ("IPython", "ipykernel", "matplotlib_inline", "debugpy", "pydevd", "_pydev", "nest_asyncio")
# A name in modules that pytest has compiled otherwise, as it does with tests and plugins.
_OF_PYTEST: Final = "@pytest_ar"
_OWN: Final = ("__main__.", "unittest.mock.")
_ALWAYS: Final = frozenset({"builtins", "numpy"})


# -- settings --------------------------------------------------------------------------------------------------------


class Setting(NamedTuple):
    """How Python or a library is set in this process, where that changes what functions compute.

    Attributes
    ----------
    name
        What sets it, as a reason names it.
    module
        The module that has it; it is looked at only where this is loaded.
    reader
        Returns, of the module, what reads the setting as a value to compare.
    write
        Sets it, of the module and a value that was read.
    words
        It is compared after each call of a function whose code has one of these names; of every function if there are
        none.
    texts
        Returns a value as texts by name, which promotion compares with those of a fresh process; None where that has
        another value anyway.
    is_quiet
        Of two values, whether no function computes anything else with the other one, so that it is put back without a
        failure: many notebooks set a number of threads or ignore a warning where they need it.
    """

    name: str
    module: str
    reader: Callable[[Any], Callable[[], Any]]
    write: Callable[[Any, Any], object]
    words: frozenset[str] = frozenset()
    texts: Callable[[Any], dict[str, str]] | None = None
    is_quiet: Callable[[Any, Any], bool] = lambda before, now: False


def library_settings() -> dict[str, str]:
    """Return how Python and libraries are set in this process, as texts by name."""
    found: dict[str, str] = {}
    for setting in SETTINGS:
        if setting.texts is not None and setting.module in sys.modules:
            found |= setting.texts(setting.reader(sys.modules[setting.module])())
    return found


def is_setting(name: str) -> bool:
    """Whether this is the name of a setting or of a variable of the context."""
    return name.startswith(CONTEXT_VARIABLE) or any(name == setting.name for setting in SETTINGS)


def is_of_texts(setting: str) -> bool:
    """Whether a setting changes nothing but how values are written as text."""
    return setting.startswith(("numpy.set_printoptions", "pandas.set_option display."))


def _filters_text(filters: Any) -> dict[str, str]:
    kinds = [kind for action, _, kind, *_ in filters if action == "error"]
    own = (kind for kind in kinds if isinstance(kind, type) and not kind.__module__.startswith(_OF_NOTEBOOKS))
    return {WARNINGS: ", ".join(f"{kind.__name__} is an error" for kind in own)}


def _filters_reader(warnings: Any) -> Callable[[], Any]:
    """Return what reads the filters; not those that ``catch_warnings`` puts in their place, for all threads at once."""
    filters = warnings.filters
    return lambda: filters


def _set_filters(warnings: Any, filters: Any) -> None:
    warnings.simplefilter("ignore", append=True)  # has Python forget what it has decided by the old ones
    warnings.filters[:] = filters


def _errors_text(errors: Mapping[str, str]) -> dict[str, str]:
    raising = {error: way for error, way in errors.items() if way not in ("ignore", "warn", "print", "log")}
    return {"numpy.seterr": f"{raising or 'no errors are raised'}"}


def _raises_as(before: Mapping[str, str], now: Mapping[str, str]) -> bool:
    return _errors_text(before) == _errors_text(now)


def _print_text(options: Mapping[str, Any]) -> dict[str, str]:
    return {"numpy.set_printoptions": f"{options}"}


_PARTS_OF_DECIMAL: Final = "prec", "rounding", "Emin", "Emax", "capitals", "clamp"


def _decimal_reader(decimal: Any) -> Callable[[], Any]:
    parts, context_of = operator.attrgetter(*_PARTS_OF_DECIMAL), decimal.getcontext
    return lambda: (*parts(context := context_of()), dict(context.traps))


def _set_decimal(decimal: Any, value: Any) -> None:
    context = decimal.getcontext()
    for part, saved in zip(_PARTS_OF_DECIMAL, value, strict=False):
        setattr(context, part, saved)
    context.traps.update(value[-1])


def _decimal_text(value: Any) -> dict[str, str]:
    traps = sorted(signal.__name__ for signal, is_on in value[-1].items() if is_on)
    text = ", ".join(f"{part}={saved}" for part, saved in zip(_PARTS_OF_DECIMAL, value, strict=False))
    return {"decimal.getcontext": f"{text}, traps={' '.join(traps)}"}


_PARTS_OF_LOCALE: Final = "LC_NUMERIC", "LC_TIME", "LC_COLLATE", "LC_CTYPE"


def _locale_reader(locale: Any) -> Callable[[], Any]:
    return lambda: {part: locale.setlocale(getattr(locale, part)) for part in _PARTS_OF_LOCALE}


def _set_locale(locale: Any, parts: Mapping[str, str]) -> None:
    for part, name in parts.items():
        locale.setlocale(getattr(locale, part), name)


def _locale_text(parts: Mapping[str, str]) -> dict[str, str]:
    # All numbers, dates and orders of C.UTF-8 are those of C; the encoding is another one in each kind of process.
    named = ((part, name) for part, name in parts.items() if part != "LC_CTYPE")
    others = (f"{part}={name}" for part, name in named if name.partition(".")[0] not in ("C", "POSIX"))
    return {"locale.setlocale": ", ".join(others)}


def _pandas_options(options: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in dir(options):
        value = getattr(options, name)
        is_group = type(value) is type(options)
        found |= {f"{name}.{key}": part for key, part in _pandas_options(value).items()} if is_group else {name: value}
    return found


def _pandas_reader(pandas: Any) -> Callable[[], Any]:
    def read() -> dict[str, Any]:
        with warnings.catch_warnings(action="ignore"):  # of options that are deprecated
            return _pandas_options(pandas.options)

    return read


def _set_pandas_options(pandas: Any, options: Mapping[str, Any]) -> None:
    for name, value in options.items():
        if pandas.get_option(name) != value:
            pandas.set_option(name, value)


def _texts_of(prefix: str, left_out: tuple[str, ...]) -> Callable[[Mapping[str, Any]], dict[str, str]]:
    """Return what writes options as texts, but for those that pandas or a notebook sets itself."""
    return lambda options: {
        f"{prefix} {name}": f"{value!r}" for name, value in options.items() if not name.startswith(left_out)
    }


def _set_environment(os: Any, variables: Mapping[bytes, bytes]) -> None:
    os.environ.clear()
    os.environ.update({os.fsdecode(name): os.fsdecode(value) for name, value in variables.items()})


def _of_functions(name: str, getter: str, words: str = "", by_keyword: bool = False, **more: Any) -> Setting:
    """Return a setting that one function of a module reads and another one, which gives it its name, writes."""
    module, _, setter = name.rpartition(".")

    def write(module: Any, value: Any) -> None:
        set_to = getattr(module, setter)
        set_to(**value) if by_keyword else set_to(value)

    return Setting(name, module, operator.attrgetter(getter), write, frozenset(words.split()), **more)


def _is_quiet(before: Any, now: Any) -> bool:
    return True


SETTINGS: Final = (
    _of_functions("sys.setrecursionlimit", "getrecursionlimit", is_quiet=_is_quiet),
    _of_functions("sys.set_int_max_str_digits", "get_int_max_str_digits"),
    Setting(
        WARNINGS,
        "warnings",
        _filters_reader,
        _set_filters,
        texts=_filters_text,
        is_quiet=lambda before, now: all(action != "error" for action, *_ in (*before, *now)),
    ),
    _of_functions("cv2.setNumThreads", "getNumThreads", is_quiet=_is_quiet),
    _of_functions("cv2.setUseOptimized", "useOptimized", texts=lambda is_on: {"cv2.setUseOptimized": f"{is_on}"}),
    # As bytes: to decode all variables takes 20 us.
    Setting("os.environ", "os", lambda os: lambda: os.environ._data, _set_environment, frozenset({"os"})),
    _of_functions("os.chdir", "getcwd", "os"),
    Setting("locale.setlocale", "locale", _locale_reader, _set_locale, frozenset({"locale"}), _locale_text),
    Setting("decimal.getcontext", "decimal", _decimal_reader, _set_decimal, frozenset({"decimal"}), _decimal_text),
    # From NumPy 2 on these are variables of the context, which are all compared.
    _of_functions("numpy.seterr", "geterr", "seterr", by_keyword=True, texts=_errors_text, is_quiet=_raises_as),
    _of_functions("numpy.set_printoptions", "get_printoptions", "set_printoptions", by_keyword=True, texts=_print_text),
    Setting(
        "pandas.set_option",
        "pandas",
        _pandas_reader,
        _set_pandas_options,
        frozenset({"set_option", "reset_option", "options"}),
        _texts_of("pandas.set_option", ("display.encoding", "display.max_columns")),
    ),
    Setting(
        "matplotlib.rcParams",
        "matplotlib",
        lambda matplotlib: lambda: dict(matplotlib.rcParams),
        lambda matplotlib, value: matplotlib.rcParams.update(value),
        frozenset({"rcParams", "rc", "rcdefaults", "use"}),
        _texts_of("matplotlib.rcParams", ("backend", "interactive")),
    ),
)


# -- what modules hold -----------------------------------------------------------------------------------------------


def library_attributes(named: Collection[str], new: Iterable[str]) -> Attributes:
    """Return what the libraries of a bundle hold, by module and attribute.

    Parameters
    ----------
    named
        The modules that the bundle names.
    new
        The modules that it has imported.
    """
    own = {name.partition(".")[0] for name in named}
    packages = own | _ALWAYS | ({name.partition(".")[0] for name in new} - sys.stdlib_module_names)
    packages = {name for name in packages - OF_THE_PROCESS if not name.startswith(("__", "epypes_"))}
    # The user's own modules are looked at by what the functions refer to.
    return attributes_of(name for name in [*sys.modules] if name.partition(".")[0] in packages and not is_own(name))


def attributes_of(modules: Iterable[str]) -> Attributes:
    """Return what modules hold by module and attribute, of those that are loaded."""
    loaded = {name: sys.modules[name] for name in modules if isinstance(sys.modules.get(name), types.ModuleType)}
    return {name: dict(_attributes(module, name)) for name, module in loaded.items() if _OF_PYTEST not in vars(module)}


def changed_attributes(
    here: Attributes, there: Attributes, text: str, named_here: Collection[str]
) -> dict[tuple[str, str], tuple[str, str]]:
    """Return by module and attribute what differs here from there, as the descriptions of both.

    Parameters
    ----------
    here, there
        What modules hold in two processes.
    text
        A bundle's code. What is only here counts if it names it.
    named_here
        The names that the notebook may have given another value. Private values, and those that are no constants and
        not named by the bundle, are mostly what libraries count and remember: they count if they are among these.
    """
    mentioned = _mentioned(text)
    found: dict[tuple[str, str], tuple[str, str]] = {}
    for module, described in here.items():
        others = there.get(module, {})
        for name, value in described.items() if others else ():
            other = others.get(name, "")
            last = name.rpartition(".")[2]
            if not other:
                # A lazy package gets its modules, and what they are for, when these are first asked for.
                is_lazy = value.startswith((f"{module.partition('.')[0]}.", "module "))
                is_changed = last in mentioned and not is_lazy
            else:
                # Not what a loop over a set has left behind in a module, nor what libraries do to each other.
                is_changed = last.isupper() or "." in name or last in mentioned or f".{last}" in other
                is_changed &= not last.startswith("_") or value.startswith(_OWN)
                is_changed |= last in named_here
                is_changed &= other != value and (other != "None" or last in named_here)
                is_changed &= not value.startswith(_OF_NOTEBOOKS)
            if is_changed:
                found[module, name] = value, other
    return found


def _mentioned(text: str) -> set[str]:
    """Return the names that a module asks objects for: attributes, imported names and texts."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.ImportFrom):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
    return found


def _attributes(owner: Any, home: str, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Give the attributes of a module or class with their descriptions."""
    for name, value in [*vars(owner).items()]:
        is_function = isinstance(value, (type, *_FUNCTIONS)) or type(value) in _INNER
        if name.startswith("_repr_") or (name.startswith("__") and (not prefix or not is_function)):
            continue
        yield f"{prefix}{name}", _described(value)
        if isinstance(value, type) and value.__module__ == home and value.__qualname__ == f"{prefix}{name}":
            yield from _attributes(value, home, f"{prefix}{name}.")
        elif type(value) is dict and len(value) <= _MOST_ENTRIES:
            entries = ((key, entry) for key, entry in value.items() if type(key) in (str, int))
            yield from ((f"{prefix}{name}[{key!r}]", _described(entry)) for key, entry in entries)


def _described(value: Any) -> str:
    """Describe a value by a short text that is the same in each process."""
    try:
        text = _text(value)
    except Exception:  # whatever an object raises that is made only to be imported
        return "unknown"
    if len(text) <= _MOST_TEXT:
        return text
    digest = _digest(text.encode("utf-8", "surrogatepass"))
    return digest if isinstance(value, _ATOMS) else f"{text.partition(' ')[0]} {digest}"


def _text(value: Any) -> str:
    kind = type(value)
    if kind in _ATOMS:
        return repr(value)
    if isinstance(value, types.ModuleType):
        return f"module {vars(value).get('__name__')}"
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}"
    if kind is types.FunctionType:
        home = f"{value.__globals__.get('__name__')}.{value.__qualname__}"
        wrapped = value.__dict__.get("__wrapped__")
        if isinstance(wrapped, types.FunctionType):
            # The wrapper of networkx gets its own code when it is first called.
            return f"{home} {_text(wrapped)}"
        # Without objects such as sys.stdout; of functions the name, since they may refer to each other.
        given = [*enumerate(value.__defaults__ or ()), *sorted((value.__kwdefaults__ or {}).items())]
        defaults = [
            (key, _name(default) if callable(default) else default)
            for key, default in given
            if callable(default) or isinstance(default, (*_ATOMS, tuple, frozenset))
        ]
        return f"{home} {_code_text(value.__code__)} {_text(tuple(defaults))}"
    if inner := _INNER.get(kind) or (("_implementation",) if kind.__name__ == "_ArrayFunctionDispatcher" else ()):
        return f"{' '.join(_text(getattr(value, name)) for name in inner)} {kind.__name__}"
    if kind in (tuple, frozenset):
        # Many tuples of names are made of sets.
        is_ordered = kind is tuple and not all(isinstance(part, str) for part in value)
        parts = [*map(_text, value)]
        return f"{kind.__name__} {parts if is_ordered else sorted(parts)}"
    if kind.__module__ == "numpy" and kind.__name__ == "ndarray" and not value.dtype.hasobject:
        content = _digest(value.tobytes()) if value.nbytes <= _MOST_BYTES else ""
        return f"array {value.dtype} {value.shape} {content}"
    return f"{_text(kind)} .{_name(value)}" if callable(value) else _text(kind)


def _name(value: Any) -> str:
    """Return the name of a function of a C library; not its module, which NumPy sets when another one is imported."""
    try:
        return str(getattr(value, "__name__", ""))
    except Exception:  # whatever an object raises that imports or connects when it is asked for an attribute
        return ""


def _code_text(code: types.CodeType) -> str:
    constants = [_code_text(part) if isinstance(part, types.CodeType) else _text(part) for part in code.co_consts]
    return _digest(code.co_code + repr((code.co_names, constants)).encode("utf-8", "surrogatepass"))


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=8).hexdigest()


_FUNCTIONS: Final = (types.FunctionType, types.BuiltinFunctionType)
# What objects that stand for a function have it in.
_INNER: Final[Mapping[type, tuple[str, ...]]] = {
    types.MethodType: ("__func__",),
    staticmethod: ("__func__",),
    classmethod: ("__func__",),
    property: ("fget", "fset"),
    functools.partial: ("func", "args"),
    functools._lru_cache_wrapper: ("__wrapped__",),
}
