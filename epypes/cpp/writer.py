"""The folder of a C++ project: the text of its files, from templates."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from epypes.cpp import types as t
from epypes.cpp.project import CppFunction, Project
from epypes.cpp.samples import write_sample
from epypes.cpp.service import cmake_lines, readme_lines, remove_service, write_service
from epypes.errors import BundleError

MARK: Final = "Written by EPypes from the bundle"
BY_HAND: Final = "by_hand.cpp"
_ALWAYS: Final = ("graph.hpp", "graph.cpp", "main.cpp", "test.cpp", "values.hpp", "CMakeLists.txt", "README.md")
_WIDTH: Final = 110
_NAME: Final = r"@([A-Z_]+)@"
# Parts that stand inside of a class or a function.
_INSIDE: Final = ("STATE_MEMBER", "STATE_TEST", "IMAGE_IN", "RGB_IN")
_ON_TOP: Final = """\
// The functions that are written by hand. EPypes changes nothing here: it adds what is missing at the end.
#include <stdexcept>

#include <opencv2/opencv.hpp>

#include "graph.hpp"
"""
# A function as it is added to the file: nothing in it is by hand yet.
_STUB: Final = re.compile(
    r"\nnamespace \w+ \{\n\n// By hand: [^\n]*\n(?://[^\n]*\n)*[^\n]*\{\n"
    r"    throw std::logic_error\(\"\w+ is still to be written by hand: [^\n]*\n\}\n\n\}  // namespace \w+\n"
)


def write_project(project: Project, folder: Path, *, is_served: bool = False) -> None:
    """Write the files of a project, with a service or without; what is written by hand stays as it is.

    Raises
    ------
    BundleError
        The folder is there and is no such project, or it can't be written.
    """
    try:
        if folder.exists() and not _is_own(folder):
            raise BundleError(folder, f"{folder} is there and was not written by this command. Name another folder.")
        (folder / "samples").mkdir(parents=True, exist_ok=True)
        _write_by_hand(project, folder / BY_HAND)
        values = _Values(project, (folder / BY_HAND).exists()).all()
        if is_served:
            values |= {
                "EXTRA": cmake_lines(namespace_of(project)),
                "SERVICE_TEXT": readme_lines(namespace_of(project)),
            }
            write_service(project.recording, namespace_of(project), folder)
        else:
            remove_service(folder)
        headers = [
            name for name in ("array.hpp", "python.hpp") if f'"{name}"' in values["GRAPH_INCLUDES"] + values["INCLUDES"]
        ]
        if "array.hpp" in headers and "python.hpp" not in headers:
            headers.append("python.hpp")
        for name in (*_ALWAYS, *headers):
            (folder / name).write_text(_filled(name, values), encoding="utf-8")
        for name in {"array.hpp", "python.hpp"} - {*headers}:
            (folder / name).unlink(missing_ok=True)
        _write_samples(project, folder / "samples")
    except OSError as error:
        raise BundleError(folder, f"{folder} can't be written: {error}. Name another folder.") from error


def _is_own(folder: Path) -> bool:
    first = folder / "CMakeLists.txt"
    return folder.is_dir() and (
        not any(folder.iterdir()) or (first.is_file() and MARK in first.read_text("utf-8", "replace"))
    )


def _filled(name: str, values: Mapping[str, str]) -> str:
    text = (files("epypes.cpp") / "templates" / name).read_text("utf-8")
    for _ in range(3):  # a part has names of its own
        text = re.sub(_NAME, lambda found: values.get(found[1], found[0]), text)
    if not name.endswith(("cpp", "hpp")):
        return text
    return "\n".join(short for line in text.split("\n") for short in wrapped(line))


def _parts(name: str, is_used: bool) -> dict[str, str]:
    """Return the parts of a template that stands in others only where it is used."""
    text = (files("epypes.cpp") / "templates" / f"{name}_parts.hpp").read_text("utf-8")
    found = re.findall(r"// @(\w+)\n(.*?)(?=// @)", text, flags=re.S)
    return {
        part: f"{lines.rstrip()}\n" + "\n" * (part not in _INSIDE) if is_used and lines else "" for part, lines in found
    }


def _write_samples(project: Project, folder: Path) -> None:
    recording = project.recording
    hyperparameters = recording.bundle.settings.hyperparameters
    for old in folder.glob("*.yml.gz"):
        if old.name.removesuffix(".yml.gz") not in recording.runs:
            old.unlink()
    for name, run in recording.runs.items():
        tokens = {token: value for token, value in run.items() if token not in hyperparameters}
        write_sample(folder / f"{name}.yml.gz", recording.tokens, tokens)


def _write_by_hand(project: Project, path: Path) -> None:
    """Write what is by hand: the functions that stand there remain, also in place of a translation; others are added.

    A function that is still as it was added is no one's work: it goes, or is added anew.
    """
    text = _STUB.sub("", path.read_text("utf-8")) if path.exists() else ""
    code = re.sub(r"//[^\n]*|^#[^\n]*|/\*.*?\*/", "", text, flags=re.S | re.M)
    namespace, stubs = namespace_of(project), ""
    for each in project.functions:
        definitions = re.findall(rf"[^;{{}}]*\b{each.name}\s*\([^;{{}}]*\)(?=\s*\{{)", code)
        if definitions:
            each.lines, each.reason = None, each.reason or f"it stands in {BY_HAND}"
            wanted = _types_of(each.signature)
            if wanted not in map(_types_of, definitions):
                was = " ".join(definitions[-1].split())
                each.reason = f"signature of {each.name} has changed: was {was}, is {each.signature}"
                each.line = ""
        elif each.is_by_hand:
            message = t.quoted(f"{each.name} is still to be written by hand: see {BY_HAND}")
            lines = [
                f"// By hand: {each.reason_with_line}",
                "//",
                *(f"//     {line}".rstrip() for line in each.source.splitlines()),
            ]
            lines += [f"{_unnamed(each)} {{", f"    throw std::logic_error({message});", "}"]
            stubs += f"\nnamespace {namespace} {{\n\n" + "\n".join(lines) + f"\n\n}}  // namespace {namespace}\n"
    if not stubs and text in ("", _ON_TOP):
        path.unlink(missing_ok=True)
    else:
        path.write_text((text or _ON_TOP) + stubs, encoding="utf-8")


def _types_of(signature: str) -> tuple[str, ...]:
    """Return the types and the name in the head of a function, without parameters' names and namespaces."""
    text = re.sub(r"\[\[\w+\]\]|\w+::", "", " ".join(signature.split()))
    while re.search("<[^<>]*>", text):  # the commas of a template's arguments part no parameters
        text = re.sub(r"<([^<>]*)>", lambda found: f"[{found[1].replace(',', ';')}]", text)
    head, _, parameters = text.removesuffix(")").partition("(")
    named = r"(?<=[\w&*\]])(?:\s+|(?<=[&*\]]))(?!(?:int|bool|float|double)$)\w+$"
    parts = (head, *(re.sub(named, "", each.strip()) for each in parameters.split(",")))
    return tuple(re.sub(r"\s*(\W)\s*", r"\1", each.strip()) for each in parts)


def _unnamed(function: CppFunction) -> str:
    """Return the head of a function whose parameters are not used yet."""
    return re.sub(r" (\w+)(?=[,)])(?=(?:[^<>]|<[^<>]*>)*$)", r" /*\1*/", function.signature)


def namespace_of(project: Project) -> str:
    """Return the namespace, which is named after the bundle."""
    return t.identifiers([project.recording.bundle.settings.name], _taken()).popitem()[1]


@functools.cache
def _taken() -> tuple[str, ...]:
    """Return the names of the project's other namespaces and targets, and the global names of the C library."""
    return tuple((files("epypes.cpp") / "data" / "global_names.txt").read_text("utf-8").split())


class _Values:
    """What stands in the templates in the place of names."""

    def __init__(self, project: Project, has_by_hand: bool) -> None:
        self.project, self.recording, self.has_by_hand = project, project.recording, has_by_hand
        self.settings = self.recording.bundle.settings
        self.namespace = namespace_of(project)
        self.hyperparameters = self.recording.hyperparameters
        self.inputs = [self.recording.tokens[token] for token in self.settings.inputs]
        self.outputs = [self.recording.tokens[token] for token in self.settings.outputs]

    def all(self) -> dict[str, str]:
        """Return them all."""
        names = [each.name for each in self.project.functions]
        declared = [*self.project.called.values()]
        signatures = [*(each.signature for each, _ in declared), *(each.signature for each in self.project.functions)]
        members = self._members(self.hyperparameters, self._hyperparameter)
        has_array = "numpy::" in "".join([members, *signatures, *(each.cpp for each in self.recording.tokens.values())])
        helpers = self.project.helpers
        delays = self.recording.bundle.cg.delays
        states = [(self.recording.tokens[token], delay.initial) for token, delay in delays.items()]
        ends = f"{', '.join(self.settings.inputs)} -> {', '.join(self.settings.outputs)}"
        array = '#include "array.hpp"\n'
        includes = [array * ("array" in helpers), '#include "python.hpp"\n' * ("python" in helpers)]
        return {
            "MARK": f"{MARK} {self.settings.name}: the next export replaces it.",
            "TITLE": f"The graph {self.settings.name}: {ends}",
            "NAME": self.namespace,
            "NS": self.namespace,
            "SOURCES": " ".join(["graph.cpp", *([BY_HAND] if self.has_by_hand else [])]),
            "TESTS": " ".join([*names, "whole_graph"]),
            "EXTRA": "",
            "SERVICE_TEXT": "",
            "GRAPH_INCLUDES": f"\n{array}" if has_array else "",
            "INCLUDES": "\n" + "".join(includes),
            "HYPERPARAMETERS": members,
            "INPUTS": self._members(self.inputs, self._member),
            "OUTPUTS": self._members(self.outputs, self._member),
            "EACH_HYPERPARAMETER": self._each(self.hyperparameters),
            "EACH_INPUT": self._each(self.inputs),
            "EACH_OUTPUT": self._each(self.outputs),
            "DECLARATIONS": "\n".join(f"{each.signature};" for each in self.project.functions),
            "COUNT": str(len(names)),
            "FUNCTION_NAMES": ", ".join(map(t.quoted, names)),
            "HELPERS": "".join(f"{each.signature};\n" for each, _ in declared) + ("\n" if declared else ""),
            "FUNCTIONS": self._functions(),
            "CHECKS": "".join(self._checks()),
            "RUN": self._run(),
            "STATE_MEMBERS": "".join(f"    {self._initial(*each)}\n" for each in states),
            "EACH_STATE": self._each(token for token, _ in states),
            **_parts("array", has_array),
            **_parts("state", bool(states)),
            **self._image(),
            "TOKENS": ", ".join(t.quoted(token.name) for token in self._compared()),
            "TOLERANCES": ", ".join(
                f"{{{t.quoted(self.recording.tokens[token].name)}, {{{bound.absolute!r}, {bound.relative!r}}}}}"
                for token, bound in self.settings.tolerances.items()
            ),
            "CASES": self._cases(),
            "CASE_LIST": ", ".join(f"{{{t.quoted(name)}, test_{name}}}" for name in [*names, "whole_graph"]),
            "SAMPLES": ", ".join(map(t.quoted, self.recording.runs)),
            "TABLE": self._table(),
            "BY_HAND_TEXT": self._by_hand_text()
        }  # fmt: skip

    # -- members ------------------------------------------------------------------------------------------------------

    @staticmethod
    def _members(tokens: Iterable[t.TokenType], text: Any) -> str:
        lines = "".join(f"    {text(each)}\n" for each in tokens)
        return f"{lines}" if lines else ""

    @staticmethod
    def _each(tokens: Iterable[t.TokenType]) -> str:
        return "\n".join(f"        visit({t.quoted(each.name)}, self.{each.name});" for each in tokens)

    def _member(self, token: t.TokenType) -> str:
        about = self._about(token)
        return f"{token.cpp} {token.name}{{}};{about and f'  // {about}'}"

    def _about(self, token: t.TokenType) -> str:
        kind: Any = token.type
        order = self.settings.order(token.token) if token.token in self.settings.colours else ""
        is_image = isinstance(kind, t.ArrayType) and kind.is_mat and kind.ndim > 1
        shape = ("(height, width)", f"(height, width, {kind.channels})")[kind.ndim - 2] if is_image else ""
        return ", ".join(part for part in (kind.dtype, shape, order) if part)

    def _entry(self, token: t.TokenType) -> Mapping[str, Any]:
        return self.settings.entries.get(token.token, {})

    def _hyperparameter(self, token: t.TokenType) -> str:
        entry = self._entry(token)
        text = self._initial(token, self.settings.hyperparameters[token.token])
        words = [
            entry.get("about", "").rstrip("."),
            *self._limits(entry),
            f"in {entry['unit']}" if "unit" in entry else "",
        ]
        about = _one_line("; ".join(filter(None, words)))
        return f"{text}{about and f'  // {about}'}"

    @staticmethod
    def _limits(entry: Mapping[str, Any]) -> list[str]:
        limits = [f"at {word} {entry[key]}" for key, word in (("low", "least"), ("high", "most")) if key in entry]
        return limits + ["odd"] * bool(entry.get("odd"))

    def _checks(self) -> Iterable[str]:
        for token in self.hyperparameters:
            entry, name = self._entry(token), token.name
            is_number = isinstance(token.type, t.Int) or token.cpp == "double"
            signs = (("low", ">="), ("high", "<="))
            tests = [f"{name} {sign} {entry[key]!r}" for key, sign in signs if key in entry]
            tests += [f"{name} % 2 != 0"] * bool(entry.get("odd"))
            if tests and is_number:
                message = t.quoted(f"{token.token} has to be {' and '.join(self._limits(entry))}")
                yield f"    if (!({' && '.join(tests)})) {{\n        throw std::invalid_argument({message});\n    }}\n"

    @staticmethod
    def _initial(token: t.TokenType, value: Any) -> str:
        """Return a member that begins with a value."""
        text = (
            _array_literal(value, token.type)
            if isinstance(token.type, t.ArrayType)
            else f" = {t.literal(value, token.type)}"
        )
        return f"{token.cpp} {token.name}{text};"

    # -- functions ----------------------------------------------------------------------------------------------------

    def _functions(self) -> str:
        local = [each for each, _ in self.project.called.values()]
        texts = ["\n".join(each.lines or ()) for each in local]
        inner = "namespace {\n\n" + "\n\n".join(texts) + "\n\n}  // namespace\n\n" if local else ""
        own = ["\n".join(each.lines) for each in self.project.functions if each.lines is not None]
        return inner + "".join(f"{text}\n\n" for text in own)

    def _argument(self, token: t.TokenType) -> str:
        if token.token in self.settings.hyperparameters:
            return f"h.{token.name}"
        if token.token in self.recording.bundle.cg.delays:
            return f"state_.{token.name}"
        return f"inputs.{token.name}" if token.token in self.settings.inputs else token.name

    def _run(self) -> str:
        lines = []
        for index, each in enumerate(self.project.functions):
            arguments = ", ".join(map(self._argument, self.recording.inputs_of(each.function)))
            made = self.recording.outputs_of(each.function)
            single = self.recording.bundle.cg.has_single_output(each.function)
            target = made[0].name if single else f"[{', '.join(token.name for token in made)}]"
            kind = made[0].cpp if single else "auto"
            lines += [
                f"running_ = {index};",
                "begin = Clock::now();",
                f"const {kind} {target} = {self.namespace}::{each.name}({arguments});",
                f"seconds_[{index}] = seconds_since(begin);",
                "",
            ]
        delays = self.recording.bundle.cg.delays
        if delays:
            lines.append("State state;")
            pairs = [
                (self.recording.tokens[token], self.recording.tokens[each.token]) for token, each in delays.items()
            ]
            lines += [f"state.{state.name} = owned({self._argument(token)});" for state, token in pairs]
            lines.append("state_ = state;")
        lines += ["total_seconds_ = seconds_since(first);", "Outputs outputs;"]
        lines += [f"outputs.{each.name} = {self._argument(each)};" for each in self.outputs]
        return "".join(f"    {line}\n" if line else "\n" for line in lines)

    def _cases(self) -> str:
        texts = []
        for each in self.project.functions:
            given, made = self.recording.inputs_of(each.function), self.recording.outputs_of(each.function)
            inputs = [token for token in given if token.token not in self.settings.hyperparameters]
            lines = [
                f"const auto {token.name} = read<{token.cpp}>(sample[{t.quoted(token.name)}]);" for token in {*inputs}
            ]
            arguments = [token.name if token in inputs else f"h.{token.name}" for token in given]
            lines = [*sorted(lines), *[f"const {self.namespace}::Hyperparameters h;"] * (len(inputs) < len(given))]
            call = f"{self.namespace}::{each.name}({', '.join(arguments)})"
            is_single = self.recording.bundle.cg.has_single_output(each.function)
            lines += [] if is_single else [f"const auto results = {call};"]
            for index, token in enumerate(made):
                got = call if is_single else f"std::get<{index}>(results)"
                lines.append(f"report.compare({t.quoted(token.name)}, sample[{t.quoted(token.name)}], {got});")
            texts.append(_function(f"void test_{each.name}(const cv::FileNode& sample, Report& report)", lines))
        return "\n".join(texts)

    def _compared(self) -> list[t.TokenType]:
        """Return the tokens that the replay compares."""
        return [token for each in self.project.functions for token in self.recording.outputs_of(each.function)]

    # -- the program --------------------------------------------------------------------------------------------------

    def _image(self) -> dict[str, str]:
        """Return how the program reads its only input from an image file: as cv2.imread reads what was recorded."""
        token = self.inputs[0] if len(self.inputs) == 1 else None
        kind: Any = token.type if token is not None else None
        parts = _parts("image", isinstance(kind, t.ArrayType) and kind.is_mat)
        if token is None or not parts["IMAGE_IN"]:
            return parts
        depth = "" if kind.dtype == "uint8" else "cv::IMREAD_ANYDEPTH"
        colour = {2: "cv::IMREAD_GRAYSCALE", 3: "cv::IMREAD_COLOR"}.get(kind.ndim, "cv::IMREAD_ANYCOLOR")
        is_whole = kind.channels not in (0, 1, 3)
        flags = "cv::IMREAD_UNCHANGED" if is_whole else " | ".join(filter(None, (colour, depth)))
        tests = [f"image.depth() != {t.DEPTHS[kind.dtype]}"] * bool(kind.dtype)
        tests += [f"image.channels() != {kind.channels or 1}"] * (kind.ndim == 2 or kind.channels > 0)
        is_rgb = token.token in self.settings.rgb and kind.ndim != 2
        code = "RGBA" if kind.channels == 4 else "RGB"
        return {
            "IMAGE_IN": parts["IMAGE_IN"],
            "RGB_IN": parts["RGB_IN"] if is_rgb else "",
            "RGB_CODE": f"cv::COLOR_{code.replace('RGB', 'BGR')}2{code}",
            "IMREAD_FLAGS": flags,
            "IS_OTHER_IMAGE": " || ".join(tests) or "false",
            "IMAGE": token.name,
            "IMAGE_TEXT": f"an array of {self._about(token)}",
        }

    # -- README -------------------------------------------------------------------------------------------------------

    def _table(self) -> str:
        rows = ["| function | translated | by hand, why |", "|--|--|--|"]
        for each in self.project.functions:
            translated = "" if each.is_by_hand else "yes"
            rows.append(f"| `{each.function}` | {translated} | {_one_line(each.reason_with_line)} |")
        return "\n".join(rows)

    def _by_hand_text(self) -> str:
        if not any(each.is_by_hand for each in self.project.functions):
            return "All functions are translated."
        return f"What is by hand stands in `{BY_HAND}`, with its Python source; its test fails until it is written."


def _function(head: str, lines: Sequence[str]) -> str:
    return "".join([f"{head} {{\n", *(f"    {line}\n" for line in lines), "}\n"])


def _one_line(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").rstrip("\\")


def _array_literal(value: Any, kind: t.ArrayType) -> str:
    """Return what follows the name of a member that begins with an array."""
    if value is None:
        return ""
    numbers = ", ".join(t.literal(item, t.number(kind.dtype)) for item in value.reshape(-1))
    array = (
        f"numpy::array<{t.ELEMENTS[kind.dtype]}, {value.ndim}>({{{', '.join(map(str, value.shape))}}}, {{{numbers}}})"
    )
    return f" = numpy::mat({array})" if kind.is_mat else f" = {array}"


def wrapped(line: str, *, is_continued: bool = False) -> list[str]:
    """Return the lines of a statement, none longer than a reader likes where it has a comma to break at."""
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
    return [line[:end].rstrip(), *wrapped(f"{more}{line[end:].strip()}", is_continued=True)]
