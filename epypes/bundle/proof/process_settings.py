"""Settings of the process: how Python and libraries are set, where that changes what functions compute.

Promotion compares them with those of a fresh process, as texts. A loaded bundle compares them after each call of a
function, with the variables of the context: what a call has set is put back, and the call fails, or does not where no
function computes anything else with it. The random generators of the whole process begin each event anew.
"""

from __future__ import annotations

import copy
import inspect
import operator
import random
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import suppress
from contextvars import Context, copy_context
from typing import Any, Final, NamedTuple

from epypes.run.snapshot import is_global_generator, is_own

# Only where a function catches warnings, errors in their place change what it computes.
WARNINGS: Final = "warnings.simplefilter"
# What the name of a variable of the context follows.
CONTEXT_VARIABLE: Final = "ContextVar "
# What these put into other modules and settings, every notebook has.
OF_NOTEBOOKS: Final = ("IPython", "ipykernel", "matplotlib_inline", "debugpy", "pydevd", "_pydev", "nest_asyncio")


# Code with one of these names may draw from a generator of the whole process, unless it makes its own.
_DRAWS_OF_CV2: Final = frozenset(
    {"setRNGSeed", "randu", "randn", "randShuffle", "kmeans", "grabCut", "BOWKMeansTrainer", "DescriptorMatcher_create"}
    | {"FlannBasedMatcher", "FlannBasedMatcher_create", "flann_Index"}
)
_DRAWS: Final = _DRAWS_OF_CV2 | {"random"}
_OWN_GENERATORS: Final = frozenset({"default_rng", "Generator", "RandomState", "Random"})
# The functions that draw from these generators or seed them, and that are no methods of one; the methods of objects of
# SciPy and pandas that draw from NumPy's, unless they are given another one.
_OF_GENERATORS: Final = {
    "numpy.random": frozenset({"seed", "ranf", "sample"}),
    "cv2": _DRAWS_OF_CV2,
}
_METHODS_THAT_DRAW: Final = {"rvs": "scipy", "sample": "pandas"}
_SEEDS: Final = frozenset({"seed", "setstate", "set_state", "setRNGSeed"})
# By these parameters functions of libraries take a seed or a generator; without, they draw from NumPy's, or these from
# one that the operating system seeds.
SEED_PARAMETERS: Final = frozenset({"random_state", "rng", "seed"})
OPERATING_SYSTEM: Final = "the operating system"
_OF_OPERATING_SYSTEM: Final = frozenset({"skimage"})


# -- the table of settings -------------------------------------------------------------------------------------------


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


# What writes arrays and tables as texts, as these are set.
_WRITES_TEXTS: Final = frozenset({"array2string", "array_repr", "array_str", "to_string"})


def is_of_texts(setting: str, words: AbstractSet[str]) -> bool:
    """Whether a setting changes nothing but how values are written as text, which code with these names hardly does."""
    is_text = setting.startswith(("numpy.set_printoptions", "pandas.set_option display."))
    return is_text and words.isdisjoint(_WRITES_TEXTS)


def _filters_text(filters: Any) -> dict[str, str]:
    kinds = [kind for action, _, kind, *_ in filters if action == "error"]
    own = (kind for kind in kinds if isinstance(kind, type) and not kind.__module__.startswith(OF_NOTEBOOKS))
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
    time.tzset()  # C code has its own copy of TZ


def _raising(errors: Mapping[str, str]) -> list[str]:
    return sorted(error for error, way in errors.items() if way == "raise")


def _dialects_reader(csv: Any) -> Callable[[], Any]:
    return lambda: {name: csv.get_dialect(name) for name in csv.list_dialects()}


def _set_dialects(csv: Any, dialects: Mapping[str, Any]) -> None:
    for name in {*csv.list_dialects()} - dialects.keys():
        csv.unregister_dialect(name)
    for name, dialect in dialects.items():
        csv.register_dialect(name, dialect)


def _of_functions(
    name: str, getter: str, words: str = "", by_keyword: bool = False, shown: Any = None, **more: Any
) -> Setting:
    """Return a setting that one function of a module reads and another one, which gives it its name, writes.

    ``shown`` returns what promotion compares of a value.
    """
    module, _, setter = name.rpartition(".")
    if shown is not None:
        more["texts"] = lambda value: {name: f"{shown(value)}"}

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
    _of_functions("cv2.setUseOptimized", "useOptimized", shown=bool),
    # As bytes: to decode all variables takes 20 us.
    Setting("os.environ", "os", lambda os: lambda: os.environ._data, _set_environment, frozenset({"os"})),
    _of_functions("os.chdir", "getcwd", "os"),
    Setting("locale.setlocale", "locale", _locale_reader, _set_locale, frozenset({"locale"}), _locale_text),
    Setting("decimal.getcontext", "decimal", _decimal_reader, _set_decimal, frozenset({"decimal"}), _decimal_text),
    # From NumPy 2 on these are variables of the context, which are all compared.
    _of_functions("numpy.seterr", "geterr", "seterr", by_keyword=True, texts=_errors_text, is_quiet=_raises_as),
    _of_functions("scipy.special.seterr", "geterr", "seterr special", by_keyword=True, shown=_raising),
    _of_functions("calendar.setfirstweekday", "firstweekday", "calendar", shown=int),
    _of_functions("csv.field_size_limit", "field_size_limit", "csv", shown=int),
    Setting(
        "csv.register_dialect",
        "csv",
        _dialects_reader,
        _set_dialects,
        frozenset({"csv"}),
        lambda dialects: {"csv.register_dialect": f"{sorted(dialects)}"},
    ),
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


# -- what calls change -----------------------------------------------------------------------------------------------


class ProcessSettings:
    """How Python and libraries are set, and the context, as calls find them and leave them."""

    def __init__(self) -> None:
        self._compared: list[Setting] = []
        # What reads each of them, and what it has read.
        self._known: list[tuple[Callable[[], Any], Any]] = []
        self.add(frozenset())

    def add(self, words: AbstractSet[str]) -> None:
        """Compare from now on what code with these names may set, and what is always compared."""
        loaded = (one for one in SETTINGS if one.module in sys.modules)
        self._compared = [one for one in loaded if one in self._compared or not one.words or one.words & words]
        self._known = [(one.reader(sys.modules[one.module]), None) for one in self._compared]
        self._known = self.now()

    @staticmethod
    def is_set_by(function: Any) -> bool:
        """Whether a function of a library is one that sets something."""
        name = getattr(function, "__name__", "")
        return any(name == one.name.rpartition(".")[2] for one in SETTINGS)

    def is_known(self) -> bool:
        """Whether all settings are as they are known."""
        for read, known in self._known:  # noqa: SIM110 - all() takes twice as long
            if read() != known:
                return False
        return True

    def now(self) -> list[tuple[Callable[[], Any], Any]]:
        """Return the settings as they are now, for ``set_to``."""
        return [(read, copy.copy(read())) for read, _ in self._known]

    def set_to(self, known: list[tuple[Callable[[], Any], Any]]) -> None:
        """Set all as they were, and know them so from now on."""
        self._known = known
        self.restored()

    def changed(self, context: Context, modules: int) -> str | None:
        """Return what a call has set, in its context or elsewhere; None if nothing is set otherwise than before.

        It is "" if no function computes anything else with it. What a module sets when it is imported is put back, and
        is no change: ``modules`` is how many there were.
        """
        now = copy_context()
        if self.is_known() and _is_same(context, now):
            return None
        others = [*self._others()]
        loud = (one.name for one, read, known in others if not one.is_quiet(known, read()))
        name = _set_in(context, now) or next(loud, "" if others else None)
        if len(sys.modules) > modules:
            self.restored()
            return None
        return name

    def _others(self) -> Iterator[tuple[Setting, Callable[[], Any], Any]]:
        for one, (read, known) in zip(self._compared, self._known, strict=True):
            if read() != known:
                yield one, read, known

    def restored(self) -> bool:
        """Put the settings back, and return whether that was possible."""
        for one, _, known in self._others():
            with suppress(Exception):
                one.write(sys.modules[one.module], known)
        return self.is_known()


def global_generator(name: str, function: Any) -> tuple[str, bool]:
    """Return whose generator of the whole process a function draws from or seeds, "" if none, and whether it seeds.

    ``function`` is None for a method of an object that isn't known.
    """
    name, owner, home = getattr(function, "__name__", name), getattr(function, "__self__", None), ""
    if function is None:
        home = "numpy.random" if _METHODS_THAT_DRAW.get(name) in sys.modules else ""
    elif is_global_generator(owner):
        home = "random" if isinstance(owner, random.Random) else "numpy.random"
    else:
        homes = [(sys.modules[one], names) for one, names in _OF_GENERATORS.items() if one in sys.modules]
        named = ((one.__name__, getattr(one, each, None)) for one, names in homes for each in names)
        home = next((one for one, known in named if known is function), "")
    return home, name in _SEEDS


def default_generator(function: Any) -> str:
    """Return whose generator a function of a library draws from where it is given no seed; "" if it takes none."""
    top = str(getattr(function, "__module__", None)).partition(".")[0]
    if top in ("numpy", "random") or is_own(top):
        return ""
    try:
        parameters = inspect.signature(function).parameters
    except Exception:  # it is written in C, or whatever an object raises that is asked for its signature
        return ""
    takes_seed = any(parameters[name].default is None for name in SEED_PARAMETERS & parameters.keys())
    return "" if not takes_seed else OPERATING_SYSTEM if top in _OF_OPERATING_SYSTEM else "numpy.random"


class GlobalGenerators:
    """The random generators of the whole process, which begin each event as they were when the bundle was loaded.

    They can't be compared, since a function may seed them for another one. An event begins on a thread when a function
    is called there again.
    """

    # The replays of a proof turn it off, to find draws without a seed.
    are_put_back = True

    def __init__(self) -> None:
        self._numpy = sys.modules.get("numpy.random")
        self._first = random.getstate(), self._numpy.get_state() if self._numpy else None
        self._local = threading.local()

    @staticmethod
    def are_drawn_by(words: AbstractSet[str]) -> bool:
        """Whether code with these names may draw from them."""
        return not words.isdisjoint(_DRAWS) and words.isdisjoint(_OWN_GENERATORS)

    def begin(self, name: str) -> None:
        """Note that a function is called which may draw from them; put them back where an event begins."""
        called = vars(self._local).setdefault("called", set())
        if (name in called or not called) and self.are_put_back:
            called.clear()
            random.setstate(self._first[0])
            if self._numpy is not None:
                self._numpy.set_state(self._first[1])
            if "cv2" in sys.modules:
                sys.modules["cv2"].setRNGSeed(0)  # as OpenCV begins
        called.add(name)


# The names of variables of a context, and what sets them.
_SET_BY: Final = {"numpy.ufunc.extobj": "numpy.seterr", "format_options": "numpy.set_printoptions"}


def _set_in(context: Context, now: Context) -> str | None:
    """Return which variable of a context has another value than now, or what sets it; None if there is none."""
    for variable in {**context, **now}:
        before, after = (each.get(variable, _NO_VALUE) for each in (now, context))
        # Python makes the context of decimal numbers when it is first asked for.
        if after is not before and not (
            (variable.name == "decimal_context" and before is _NO_VALUE)
            or (variable.name == "numpy.ufunc.extobj" and _raises_alike(context, now))
        ):
            return _SET_BY.get(variable.name, f"{CONTEXT_VARIABLE}{variable.name}")
    return None


_NO_VALUE: Final = object()


def _is_same(context: Context, now: Context) -> bool:
    """Whether the variables of two contexts have equal values, as far as these can be compared."""
    try:
        return context == now
    except Exception:  # whatever values raise when they are compared, as arrays do
        return False


def _raises_alike(context: Context, now: Context) -> bool:
    """Whether NumPy raises the same errors in two contexts."""
    read = sys.modules["numpy"].geterr
    return _raises_as(now.run(read), context.run(read))
