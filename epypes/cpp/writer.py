"""The folder of a C++ project: its files, from the templates of Jinja2 in ``templates/``."""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes import __version__
from epypes.cpp import types as t
from epypes.cpp.project import Project
from epypes.cpp.samples import write_sample
from epypes.errors import BundleError
from epypes.optional import optional_import

if TYPE_CHECKING:
    from jinja2 import Environment

MARK: Final = "Written by EPypes from the bundle"
BY_HAND: Final = "by_hand.cpp"
_SERVICE: Final = "service/"
_WIDTH: Final = 110
# The methods of Reader and Writer for numbers and texts of Python, and for lists of records of OpenCV.
_READERS: Final = {"double": "number", "bool": "boolean", "str": "text", "None": "none"}
_RECORDS: Final = {"KeyPoint": "keypoints", "DMatch": "matches"}
# A function as it is added to the file: nothing in it is by hand yet.
_STUB: Final = re.compile(
    r"\nnamespace \w+ \{\n\n// By hand: [^\n]*\n(?://[^\n]*\n)*[^\n]*\{\n"
    r"    throw std::logic_error\(\"\w+ is still to be written by hand: [^\n]*\n\}\n\n\}  // namespace \w+\n"
)
# What is no code, or may hold a brace that is none: comments, directives, texts and characters.
_UNREAD: Final = re.compile(r"//[^\n]*|^#[^\n]*|/\*.*?\*/|\"(?:\\.|[^\"\\\n])*\"|'(?:\\.|[^'\\\n])'", flags=re.S | re.M)


def write_project(project: Project, folder: Path, *, is_served: bool = False) -> None:
    """Write the files of a project, with a service or without; what is written by hand stays as it is.

    Raises
    ------
    BundleError
        The folder is there and is no such project, or it can't be written; or there is to be a service, and an event
        can't bring a value of such a type, or no answer can carry it.
    """
    templates = _templates(project)
    try:
        if folder.exists() and not _is_own(folder):
            raise BundleError(folder, f"{folder} is there and was not written by this command. Name another folder.")
        (folder / "samples").mkdir(parents=True, exist_ok=True)
        _write_by_hand(project, folder / BY_HAND, templates)
        values = _values(project, is_served) | {"has_by_hand": (folder / BY_HAND).exists()}
        names = [name for name in templates.list_templates() if name != BY_HAND]
        values["service_sources"] = [name for name in names if name.startswith(_SERVICE) and name.endswith(".cpp")]
        texts = {name: templates.get_template(name).render(values) for name in names if _is_needed(name, values)}
        for name in names:
            if name in texts:
                (folder / name).parent.mkdir(exist_ok=True)
                (folder / name).write_text(texts[name], encoding="utf-8")
            else:
                (folder / name).unlink(missing_ok=True)
        if not is_served:
            with suppress(OSError):
                (folder / _SERVICE).rmdir()
        _write_samples(project, folder / "samples")
    except OSError as error:
        raise BundleError(folder, f"{folder} can't be written: {error}. Name another folder.") from error


def _is_own(folder: Path) -> bool:
    first = folder / "CMakeLists.txt"
    return folder.is_dir() and (
        not any(folder.iterdir()) or (first.is_file() and MARK in first.read_text("utf-8", "replace"))
    )


def _is_needed(name: str, values: Mapping[str, Any]) -> bool:
    """Whether a project has a file."""
    if name in ("array.hpp", "python.hpp"):
        return bool(values["has_arrays"] or {"array.hpp", name} & {*values["includes"]})
    is_array = name == f"{_SERVICE}arrays.hpp"
    return not name.startswith(_SERVICE) or bool(values["is_served"] and (values["has_served_arrays"] or not is_array))


def _templates(project: Project) -> Environment:
    """Return the templates, in which an expression is @{...}, since C++ has {{ }} of its own."""
    with optional_import():
        import jinja2
    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("epypes.cpp"), undefined=jinja2.StrictUndefined, autoescape=False,  # noqa: S701
        keep_trailing_newline=True, trim_blocks=True, lstrip_blocks=True,
        variable_start_string="@{", variable_end_string="}"
    )  # fmt: skip
    templates.filters |= {
        "quoted": t.quoted, "json": json.dumps, "one_line": _one_line, "wrapped": _wrapped, "initial": _initial,
        "source": functools.partial(_source, project)
    }  # fmt: skip
    # As in: kind is ListType.
    kinds = t.Type.__subclasses__()
    templates.tests |= {each.__name__: lambda value, kind=each: isinstance(value, kind) for each in kinds}
    return templates


def _values(project: Project, is_served: bool) -> dict[str, Any]:
    """Return what the templates speak of."""
    recording, settings = project.recording, project.recording.bundle.settings
    cg, tokens = recording.bundle.cg, recording.tokens
    inputs, outputs = ([tokens[token] for token in names] for names in (settings.inputs, settings.outputs))
    odd = [token for token in (*inputs, *outputs) if is_served and not _is_carried(token.type)]
    if odd:
        text = f"An event can't bring {odd[0].token!r} to a service in C++, nor an answer carry it"
        raise BundleError(settings.name, f"{text}: {t.describe(odd[0].type)}.")
    called = [each for each, _ in project.called.values()]
    code = "\n".join(line for each in (*called, *project.functions) for line in each.lines or ())
    begins = {**settings.hyperparameters, **{token: delay.initial for token, delay in cg.delays.items()}}
    members = [
        *(each.cpp for each in tokens.values()),
        *(each.signature for each in (*called, *project.functions)),
        *(_initial(value, tokens[token]) for token, value in begins.items()),
    ]
    return {
        "mark": f"{MARK} {settings.name}: the next export replaces it.",
        "title": f"The graph {settings.name}: {', '.join(settings.inputs)} -> {', '.join(settings.outputs)}",
        "ns": namespace_of(project),
        "by_hand": BY_HAND,
        "epypes_version": __version__,
        "opencv_version": recording.opencv_version,
        "is_served": is_served,
        "recording": recording,
        "settings": settings,
        "cg": cg,
        "functions": project.functions,
        "called": called,
        "includes": [f"{name}.hpp" for name, mark in (("array", "numpy::"), ("python", "python::")) if mark in code],
        "hyperparameters": recording.hyperparameters,
        "inputs": inputs,
        "outputs": outputs,
        "states": [tokens[token] for token in cg.delays],
        "has_arrays": "numpy::" in "".join(members),
        "has_served_arrays": "numpy::" in "".join(each.cpp for each in (*inputs, *outputs)),
        "entries": _entries(project),
        "depths": t.DEPTHS,
        "elements": t.ELEMENTS,
        "readers": _READERS,
        "records": _RECORDS,
        "about": functools.partial(_about, project),
        "bounds_of": functools.partial(_bounds, project),
    }


def _is_carried(kind: t.Type) -> bool:
    """Whether messages have a form for a value."""
    if isinstance(kind, t.ListType) and isinstance(kind.item, t.RecordType):
        return kind.item.name in _RECORDS
    if isinstance(kind, t.ListType | t.OptionalType):
        return _is_carried(kind.item)
    return all(map(_is_carried, kind.items)) if isinstance(kind, t.TupleType) else not isinstance(kind, t.RecordType)


def _entries(project: Project) -> dict[str, dict[str, object]]:
    """Return by name in C++ the hyperparameters as pipeline.toml has them, without numbers that JSON lacks."""

    def is_json(part: object) -> bool:
        numbers = part if isinstance(part, list) else [part]
        return all(math.isfinite(number) for number in numbers if isinstance(number, float))

    return {
        project.recording.tokens[token].name: {key: part for key, part in entry.items() if is_json(part)}
        for token, entry in project.recording.bundle.settings.entries.items()
    }


def _source(project: Project, token: t.TokenType, *, is_recorded: bool = False) -> str:
    """Return where a function finds a token: in a run, or in the replay of a sample."""
    settings = project.recording.bundle.settings
    if token.token in settings.hyperparameters:
        return f"h.{token.name}"
    if token.token in project.recording.bundle.cg.delays and not is_recorded:
        return f"state_.{token.name}"
    return f"inputs.{token.name}" if token.token in settings.inputs and not is_recorded else token.name


def _about(project: Project, token: t.TokenType) -> str:
    """Return what the comment beside a member says."""
    settings = project.recording.bundle.settings
    kind: Any = token.type
    if token.token in settings.hyperparameters:
        entry = settings.entries.get(token.token, {})
        unit = f"in {entry['unit']}" if "unit" in entry else ""
        words = [entry.get("about", "").rstrip("."), *_bounds(project, token), unit]
        return _one_line("; ".join(filter(None, words)))
    order = settings.order(token.token) if token.token in settings.colours else ""
    is_image = isinstance(kind, t.ArrayType) and kind.is_mat and kind.ndim > 1
    shape = ("(height, width)", f"(height, width, {kind.channels})")[kind.ndim - 2] if is_image else ""
    return ", ".join(filter(None, (kind.dtype, shape, order)))


def _bounds(project: Project, token: t.TokenType) -> dict[str, str]:
    """Return the limits of a hyperparameter in words, each with its test in C++."""
    entry = project.recording.bundle.settings.entries.get(token.token, {})
    signs = (("low", "at least", ">="), ("high", "at most", "<="))
    found = {f"{word} {entry[key]}": f"{token.name} {sign} {entry[key]!r}" for key, word, sign in signs if key in entry}
    return found | ({"odd": f"{token.name} % 2 != 0"} if entry.get("odd") else {})


def _initial(value: Any, token: t.TokenType) -> str:
    """Return what follows the name of a member that begins with a value."""
    kind = token.type
    if not isinstance(kind, t.ArrayType):
        return f" = {t.literal(value, kind)}"
    if value is None:
        return ""
    numbers = ", ".join(t.literal(item, t.number(kind.dtype)) for item in value.reshape(-1))
    shape = ", ".join(map(str, value.shape))
    array = f"numpy::array<{t.ELEMENTS[kind.dtype]}, {value.ndim}>({{{shape}}}, {{{numbers}}})"
    return f" = numpy::mat({array})" if kind.is_mat else f" = {array}"


def _write_samples(project: Project, folder: Path) -> None:
    recording = project.recording
    hyperparameters = recording.bundle.settings.hyperparameters
    for old in folder.glob("*.yml.gz"):
        if old.name.removesuffix(".yml.gz") not in recording.runs:
            old.unlink()
    for name, run in recording.runs.items():
        tokens = {token: value for token, value in run.items() if token not in hyperparameters}
        write_sample(folder / f"{name}.yml.gz", recording.tokens, tokens)


def _write_by_hand(project: Project, path: Path, templates: Environment) -> None:
    """Write what is by hand: the functions that stand there remain, also in place of a translation; others are added.

    A function that is still as it was added is no one's work: it goes, or is added anew.
    """
    text = _STUB.sub("", path.read_text("utf-8")) if path.exists() else ""
    code = _UNREAD.sub("", text)
    namespace = namespace_of(project)
    added = []
    for each in project.functions:
        pattern = rf"[^;{{}}]*?(?P<space>(?:\w+::)*)\b{each.name}\s*\([^;{{}}]*\)(?=\s*\{{)"
        definitions = [(_namespace_around(code, found), found[0]) for found in re.finditer(pattern, code)]
        if definitions:
            wanted = _types_of(each.signature)
            spaces = [space for space, head in definitions if _types_of(head) == wanted]
            if not spaces:
                was = " ".join(definitions[-1][1].split())
                each.reason = f"signature of {each.name} has changed: was {was}, is {each.signature}"
                each.line = ""
            elif namespace not in spaces:
                each.reason = f"namespace of {each.name} has changed: was {spaces[-1] or 'none'}, is {namespace}"
                each.line = ""
            elif each.is_by_hand:
                each.reason = f"written in {BY_HAND}: {each.reason}"
            else:
                each.reason = f"it stands in {BY_HAND}: delete it there to have it translated"
            each.lines = None
        elif each.is_by_hand:
            added.append(each)
    template = templates.get_template(BY_HAND)
    values = {"ns": namespace, "by_hand": BY_HAND}
    if not added and text in ("", template.render(values, text="", added=[])):
        path.unlink(missing_ok=True)
    else:
        path.write_text(template.render(values, text=text.removesuffix("\n"), added=added), encoding="utf-8")


def _namespace_around(code: str, definition: re.Match[str]) -> str:
    """Return the namespace of a function that is defined in code, by the blocks around it and by its name."""
    around: list[str] = []
    for found in re.finditer(r"(?:namespace\s+([\w:]+)\s*)?\{|\}", code[: definition.start("space")]):
        if found[0] == "}":
            del around[-1:]
        else:
            around.append(found[1] or "")
    return "::".join(filter(None, (*around, definition["space"].removesuffix("::"))))


def _types_of(signature: str) -> tuple[str, ...]:
    """Return the types and the name in the head of a function, without parameters' names and namespaces."""
    text = re.sub(r"\[\[\w+\]\]|\w+::", "", " ".join(signature.split()))
    while re.search("<[^<>]*>", text):  # the commas of a template's arguments part no parameters
        text = re.sub(r"<([^<>]*)>", lambda found: f"[{found[1].replace(',', ';')}]", text)
    head, _, parameters = text.removesuffix(")").partition("(")
    named = r"(?<=[\w&*\]])(?:\s+|(?<=[&*\]]))(?!(?:int|bool|float|double)$)\w+$"
    parts = (head, *(re.sub(named, "", each.strip()) for each in parameters.split(",")))
    return tuple(re.sub(r"\s*(\W)\s*", r"\1", each.strip()) for each in parts)


def namespace_of(project: Project) -> str:
    """Return the namespace, which is named after the bundle."""
    return t.identifiers([project.recording.bundle.settings.name], t.data("names")["global"]).popitem()[1]


def _one_line(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").rstrip("\\")


def _wrapped(text: str) -> str:
    """Return C++ in lines that are no longer than a reader likes where they have a comma to break at."""
    return "\n".join(short for line in text.split("\n") for short in _lines(line))


def _lines(line: str, *, is_continued: bool = False) -> list[str]:
    if len(line) <= _WIDTH or line.lstrip().startswith("//"):
        return [line]
    depth, is_text = 0, False
    breaks: dict[int, int] = {}
    for place, character in enumerate(line):
        is_text ^= character == '"' and line[place - 1] != "\\"
        depth += 0 if is_text else (character in "({[") - (character in ")}]")
        if place > _WIDTH and breaks:
            break
        # Not within <...>, the arguments of a template.
        if depth and not is_text and re.match(r"(, (?!(?:[\w:]+, )*[\w:]+>)| && | \|\| )", line[place : place + 80]):
            breaks[depth] = place + line[place:].index(" ", 1)
    if not breaks:
        return [line]
    # The outermost place keeps together what belongs together.
    end, indent = breaks[min(breaks)], line[: len(line) - len(line.lstrip())]
    more = indent if is_continued else f"{indent}        "
    return [line[:end].rstrip(), *_lines(f"{more}{line[end:].strip()}", is_continued=True)]
