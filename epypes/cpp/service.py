"""The service around an exported graph: a program that stands behind ZeroMQ, as `epypes serve` does.

Its C++ is in ``templates/service``; what depends on the graph is how events and answers carry its tokens (tokens.cpp).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from epypes import __version__
from epypes.cpp.types import (
    BOOL,
    DEPTHS,
    ELEMENTS,
    FLOAT,
    NONE,
    TEXT,
    ArrayType,
    Int,
    ListType,
    OptionalType,
    Plain,
    RecordType,
    TokenType,
    TupleType,
    Type,
    describe,
    quoted,
)
from epypes.errors import BundleError

if TYPE_CHECKING:
    from epypes.bundle.settings import Settings
    from epypes.cpp.recorded import Recording

FOLDER: Final = "service"
# For arrays that are no cv::Mat.
_ARRAYS: Final = "arrays.hpp"
_TEMPLATES: Final = Path(__file__).parent / "templates" / FOLDER
# The methods of Reader and Writer for the records of OpenCV, in a list or a tuple.
_RECORDS: Final = {"KeyPoint": "keypoints", "DMatch": "matches"}
_READERS: Final = {FLOAT: "number", BOOL: "boolean", TEXT: "text", NONE: "none"}
_SETTERS: Final = {FLOAT: "number", BOOL: "boolean", TEXT: "text"}
_INDENT: Final = "    "


def write_service(recording: Recording, namespace: str, folder: Path) -> None:
    """Write the sources of the service into a project.

    Parameters
    ----------
    recording
        Of the bundle.
    namespace
        Of the graph in C++.
    folder
        Of the project.

    Raises
    ------
    BundleError
        An event can't bring a value of such a type, or no answer can carry it; the token is named.
    """
    bundle, cg, settings = recording.bundle, recording.bundle.cg, recording.bundle.settings
    inputs, outputs = ([recording.tokens[token] for token in tokens] for tokens in (settings.inputs, settings.outputs))
    own = {
        "MARK": f"Written by EPypes from the bundle {settings.name}: the next export replaces it.",
        "NS": namespace,
        "BUNDLE": quoted(settings.name),
        "DIGEST": quoted(bundle.digest),
        "VERSION": quoted(__version__),
        "INPUTS": "".join(f"{_INDENT}{quoted(token)},\n" for token in settings.inputs),
        "OUTPUTS": "".join(f"{_INDENT}{quoted(token)},\n" for token in settings.outputs),
        "INPUTS_OF_FUNCTIONS": "".join(f"{_INDENT}{{{_names(cg.func_inputs(name))}}},\n" for name in cg.functions),
        "HYPERPARAMETERS": _json_literal(_entries(recording)),
        "FUNC_IO": _json_literal({name: cg.func_io[name] for name in cg.functions}),
        "READ": "".join(
            f"{_INDENT}found.{token.name} = {_reading(token, settings, f'*values[{place}]')};\n"
            for place, token in enumerate(inputs)
        ),
        "WRITE": "".join(f"{_INDENT}{_writing(token, settings)}\n" for token in outputs),
    }
    has_arrays = "_array" in own["READ"] + own["WRITE"]
    own["INCLUDES"] = f'#include "{_ARRAYS}"\n' if has_arrays else ""
    remove_service(folder)
    (folder / FOLDER).mkdir(exist_ok=True)
    for path in _sources():
        if path.name == _ARRAYS and not has_arrays:
            continue
        text = re.sub(r"@([A-Z_]+)@", lambda found: own[found[1]], path.read_text(encoding="utf-8"))
        (folder / FOLDER / path.name).write_text(text, encoding="utf-8")


def remove_service(folder: Path) -> None:
    """Remove what an earlier export has written of a service."""
    for path in _sources():
        (folder / FOLDER / path.name).unlink(missing_ok=True)
    with suppress(OSError):
        (folder / FOLDER).rmdir()


def cmake_lines(name: str) -> str:
    """Return what CMakeLists.txt of a project has for its service."""
    sources = " ".join(f"{FOLDER}/{path.name}" for path in _sources() if path.suffix == ".cpp")
    return f"""
# The service: {name}_service --help
find_package(Protobuf REQUIRED)
find_package(nlohmann_json REQUIRED)
find_package(PkgConfig REQUIRED)
pkg_check_modules(MESSAGES REQUIRED IMPORTED_TARGET libzmq protobuf)
# In Debian a library; elsewhere a header alone.
find_library(HTTPLIB_LIBRARY cpp-httplib)
if(NOT HTTPLIB_LIBRARY)
  set(HTTPLIB_LIBRARY "")
endif()
protobuf_generate_cpp(PROTOBUF_SOURCES PROTOBUF_HEADERS {FOLDER}/envelope.proto)
add_executable({name}_service {sources} ${{PROTOBUF_SOURCES}})
target_include_directories({name}_service PRIVATE ${{CMAKE_CURRENT_BINARY_DIR}})
target_link_libraries({name}_service PRIVATE
  {name}_graph PkgConfig::MESSAGES nlohmann_json::nlohmann_json ${{HTTPLIB_LIBRARY}})
"""


def readme_lines(name: str) -> str:
    """Return what README.md of a project says of its service."""
    return f"""
## Serve

`{name}_service` takes events and publishes answers over ZeroMQ, as `epypes serve` does: `build/{name}_service --help`.
It needs ZeroMQ, protobuf, nlohmann-json and cpp-httplib (Debian: `libzmq3-dev cppzmq-dev libprotobuf-dev
protobuf-compiler nlohmann-json3-dev libcpp-httplib-dev pkg-config`). The messages are in `{FOLDER}/envelope.proto`.
"""


def _sources() -> list[Path]:
    return sorted(path for path in _TEMPLATES.iterdir() if path.suffix in (".cpp", ".hpp", ".proto"))


def _names(tokens: Sequence[str]) -> str:
    return ", ".join(map(quoted, tokens))


def _json_literal(value: Mapping[str, object]) -> str:
    """Return JSON as a raw literal of C++, with a line for each item."""
    lines = ",\n".join(f" {json.dumps(key)}: {json.dumps(part)}" for key, part in value.items())
    return f'R"json({{\n{lines}\n}})json"'


def _entries(recording: Recording) -> dict[str, dict[str, object]]:
    """Return by name in C++ the hyperparameters as pipeline.toml has them, without numbers that JSON lacks."""

    def is_json(part: object) -> bool:
        numbers = part if isinstance(part, list) else [part]
        return all(math.isfinite(number) for number in numbers if isinstance(number, float))

    return {
        recording.tokens[token].name: {key: part for key, part in entry.items() if is_json(part)}
        for token, entry in recording.bundle.settings.entries.items()
    }


def _order(token: TokenType, settings: Settings) -> str:
    return f"Order::{settings.order(token.token)}"


# -- reading ----------------------------------------------------------------------------------------------------------


def _reading(token: TokenType, settings: Settings, value: str) -> str:
    """Return the expression that reads an input."""
    name, order, where = settings.name, _order(token, settings), quoted(token.token)

    def read(kind: Type, value: str) -> str:
        if isinstance(kind, Int):
            return f"reader.integer({value}, {where})"
        if kind in _READERS:
            return f"reader.{_READERS[kind]}({value}, {where})"
        if isinstance(kind, Plain):
            return f"reader.scalar<{kind.cpp}>({value}, {where})"
        if isinstance(kind, ArrayType) and kind.is_mat:
            depth = DEPTHS.get(kind.dtype, "-1")
            array = f"reader.array({value}, {where}, {depth}, {max(kind.ndim, 0)}, {kind.channels}, {order})"
            return f"({value}).has_none() ? cv::Mat() : {array}" if kind.is_nullable else array
        if isinstance(kind, ArrayType):
            return f"read_array<{ELEMENTS[kind.dtype]}, {kind.ndim}>(reader, {value}, {where})"
        if isinstance(kind, ListType) and isinstance(kind.item, RecordType) and kind.item.name in _RECORDS:
            return f"reader.{_RECORDS[kind.item.name]}({value}, {where})"
        if isinstance(kind, ListType):
            return f"reader.list({value}, {where}, [&](const Value& item) {{ return {read(kind.item, 'item')}; }})"
        if isinstance(kind, TupleType):
            items = ", ".join(read(each, f"items[{place}]") for place, each in enumerate(kind.items))
            found = f"const auto& items = reader.items(of, {where}, {len(kind.items)});"
            return f"[&](const Value& of) {{ {found} return {kind.cpp}({items}); }}({value})"
        if isinstance(kind, OptionalType):
            return f"({value}).has_none() ? {kind.cpp}() : {kind.cpp}({read(kind.item, value)})"
        raise BundleError(name, f"An event can't bring {token.token!r} to a service in C++: {describe(kind)}.")

    return read(token.type, value)


# -- writing ----------------------------------------------------------------------------------------------------------


def _writing(token: TokenType, settings: Settings) -> str:
    """Return the statement that writes an output."""
    name, order = settings.name, _order(token, settings)

    def write(kind: Type, target: str, value: str) -> str:
        if isinstance(kind, Int):
            return f"{target}.set_integer({value});"
        if kind == NONE:
            return f"{target}.set_none(true);"
        if kind in _SETTERS:
            return f"{target}.set_{_SETTERS[kind]}({value});"
        if isinstance(kind, Plain):
            return f"writer.scalar({target}, {value});"
        if isinstance(kind, ArrayType) and kind.is_mat:
            axes = kind.ndim if kind.ndim > 0 else f"{value}.channels() > 1 ? 3 : 2"
            array = f"writer.array({target}, {value}, {axes}, {order});"
            is_none = f"if ({value}.empty()) {{ {target}.set_none(true); }} else {{ {array} }}"
            return is_none if kind.is_nullable else array
        if isinstance(kind, ArrayType):
            return f"write_array(writer, {target}, {value});"
        if isinstance(kind, ListType):
            holder = f"Holder::{'tuple' if kind.is_tuple else 'list'}"
            if isinstance(kind.item, RecordType) and kind.item.name in _RECORDS:
                return f"writer.{_RECORDS[kind.item.name]}({target}, {value}, {holder});"
            item = write(kind.item, "item", "each")
            return f"writer.list({target}, {value}, {holder}, [&](Value& item, const auto& each) {{ {item} }});"
        if isinstance(kind, TupleType):
            items = " ".join(
                write(each, "(*items.add_items())", f"std::get<{place}>(of)") for place, each in enumerate(kind.items)
            )
            of = f"const auto& of = {value};"
            return f"{{ {of} auto& items = *{target}.mutable_tuple(); {items} }}"
        if isinstance(kind, OptionalType):
            return f"if ({value}) {{ {write(kind.item, target, f'(*{value})')} }} else {{ {target}.set_none(true); }}"
        raise BundleError(name, f"No answer of a service in C++ can carry {token.token!r}: {describe(kind)}.")

    return write(token.type, f"part({quoted(token.token)})", f"outputs.{token.name}")
