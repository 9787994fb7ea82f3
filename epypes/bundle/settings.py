"""The settings of a bundle, written to pipeline.toml and read back."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from epypes.bundle.compare import Tolerance, read_tolerances
from epypes.bundle.hyperparameters import (
    MOST_NUMBERS,
    LargeArray,
    Unwritable,
    fits,
    plain,
    range_of,
    read,
    written,
)
from epypes.errors import BundleError
from epypes.graph import CompGraph
from epypes.hints import Param
from epypes.images import Order
from epypes.optional import optional_import

FORMAT: Final = 1
_LINE: Final = 100


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of a bundle.

    Attributes
    ----------
    name
        The bundle's name.
    inputs
        The free source tokens that an event brings.
    outputs
        The tokens that an answer carries.
    hyperparameters
        Values by token.
    rgb
        Of the inputs and outputs, those whose three or four channels are RGB.
    defaults
        The graph's defaults of hyperparameters by token: what they are where the graph is used without these settings.
    types
        Whether the graph compares annotations, as CompGraph does by default.
    tolerances
        How far outputs may be from what was recorded, by token; those of all others not at all.
    own
        What of the pipeline the module defines itself: ``"f_in"``, ``"f_out"``, ``"make_pipeline"``.
    attributes
        The pipeline's attributes.
    has_groups
        Whether the module says which functions are drawn as one box.
    entries
        The hyperparameters as they stand in the file: value and kind, range, unit; ready for JSON. Empty before that.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    hyperparameters: Mapping[str, Any]
    rgb: tuple[str, ...] = ()
    defaults: Mapping[str, Any] = field(default_factory=dict)
    types: bool = True
    tolerances: Mapping[str, Tolerance] = field(default_factory=dict)
    own: tuple[str, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    has_groups: bool = False
    entries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def order(self, token: str) -> Order:
        """Return the order of a token's colours."""
        return "rgb" if token in self.rgb else "bgr"


def unwritable(values: Mapping[str, Any], what: str = "Hyperparameter") -> list[str]:
    """Return a reason for each value that pipeline.toml can't hold."""
    reasons = []
    for token, value in values.items():
        try:
            written(value)
        except LargeArray as found:
            reasons.append(
                f"{what} {token!r} is or holds {found}; {MOST_NUMBERS} are the most that pipeline.toml holds, where "
                "people read them. Make each array a hyperparameter of its own, or let the function read it from "
                "a variable of the notebook, outside of it: the bundle keeps either as a file. Or "
                "make it in a function; or unfreeze it and pass it to run()."
            )
        except Unwritable as found:
            way_out = "or unfreeze it and pass it to run()" if what == "Hyperparameter" else "or leave it out"
            reasons.append(
                f"{what} {token!r} is {found}, which pipeline.toml can't hold. "
                "Use numbers, strings, a small array or tuples, lists and dicts of them; make it in a function; "
                f"{way_out}."
            )
    return reasons


def writable_defaults(cg: CompGraph, hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the graph's defaults of hyperparameters, but for those that TOML can't hold.

    They may be missing: in the bundle every hyperparameter has a value. What an event brings has no default there.
    """
    return {token: value for token, value in cg.defaults.items() if token in hyperparameters and fits(value)}


def write_settings(path: Path, settings: Settings, cg: CompGraph) -> None:
    """Write pipeline.toml, with a comment per section and the ranges that annotations and usual names give."""
    with optional_import():
        import tomlkit

    document = tomlkit.document()
    document.add(
        tomlkit.comment(
            "What the graph in pipeline.py is run with. It is sealed: change a value in the notebook and promote."
        )
    )
    bundle = tomlkit.table()
    bundle.add("format", FORMAT)
    bundle.add("name", settings.name)
    if not settings.types:
        bundle.add(tomlkit.comment("The annotations of the functions are not compared."))
        bundle.add("types", False)
    if settings.has_groups:
        bundle.add("groups", True)
    document.add("bundle", bundle)
    document.add("ports", _ports(settings))
    hyperparameters = tomlkit.table(is_super_table=True)
    for token, value in settings.hyperparameters.items():
        hyperparameters.add(token, _table(entry_of(cg, token, value), _takers(cg, token)))
    document.add("hyperparameters", hyperparameters)
    for section, values in (("defaults", settings.defaults), ("attributes", settings.attributes)):
        if values:
            table = tomlkit.table(is_super_table=True)
            for name, value in values.items():
                table.add(name, _table(written(value)))
            document.add(section, table)
    path.write_text(tomlkit.dumps(document), encoding="utf-8")


def _ports(settings: Settings) -> Any:
    with optional_import():
        import tomlkit

    ports = tomlkit.table()
    ports.add(tomlkit.comment("The tokens that an event brings, and those that its answer carries."))
    ports.add("inputs", list(settings.inputs))
    ports.add("outputs", list(settings.outputs))
    if settings.rgb:
        ports.add(tomlkit.comment("Their three or four channels are RGB; those of all others are BGR."))
        ports.add("rgb", list(settings.rgb))
    if settings.own:
        ports.add(tomlkit.comment("What pipeline.py has of its own, in place of what a bundle usually does."))
        ports.add("own", list(settings.own))
    return ports


def entry_of(cg: CompGraph, token: str, value: Any) -> dict[str, Any]:
    """Return what stands in pipeline.toml of a hyperparameter: its value, and the range that it may take."""
    entry = written(value)
    hint = range_of(cg, token, value)
    if not isinstance(hint, Param):
        return entry
    limits = {key: getattr(hint, key) for key in ("low", "high", "step")}
    entry.update({key: plain(limit) for key, limit in limits.items() if limit is not None and _is_finite(limit)})
    entry.update({key: True for key in ("odd", "log") if getattr(hint, key)})
    if hint.soft is not None and all(map(_is_finite, hint.soft)):
        entry["soft"] = [plain(end) for end in hint.soft]
    if hint.choices and all(map(fits, hint.choices)):
        entry["choices"] = [_choice(choice, value) for choice in hint.choices]
        entry.update({"labels": list(hint.labels)} if hint.labels else {})
    entry.update({key: getattr(hint, key) for key in ("unit", "about") if getattr(hint, key)})
    return entry


def _is_finite(limit: Any) -> bool:
    return math.isfinite(limit) and fits(plain(limit)) and "kind" not in written(plain(limit))


def _choice(choice: Any, value: Any) -> Any:
    """Return a choice as the value would be written in its place."""
    entry = written(choice)
    same = "kind" not in entry or ("value" in entry and {**entry, "value": 0} == {**written(value), "value": 0})
    return entry["value"] if same else entry


def _takers(cg: CompGraph, token: str) -> str:
    takers = cg.digraph.consumers.get(token, ())
    return f"Taken by {', '.join(takers)}."


def _table(entry: Mapping[str, Any], comment: str = "") -> Any:
    with optional_import():
        import tomlkit

    table = tomlkit.table()
    if comment and comment.isprintable():
        table.add(tomlkit.comment(comment))
    for key, part in entry.items():
        table.add(key, _item(part))
    return table


def _item(part: Any) -> Any:
    """Return a value for TOML: rows of a matrix, and what is long, on lines of their own."""
    with optional_import():
        import tomlkit

    if isinstance(part, dict):
        table = tomlkit.inline_table()
        table.update(part)
        return table
    if not isinstance(part, list):
        return part
    item = tomlkit.array()
    item.extend(part)
    has_rows = any(isinstance(entry, list) for entry in part) and len(part) > 1
    return item.multiline(True) if has_rows or len(item.as_string()) > _LINE else item


def read_settings(path: Path, enums: Mapping[str, Any] | None = None, content: bytes | None = None) -> Settings:
    """Read pipeline.toml.

    Parameters
    ----------
    path
        The file.
    enums
        The enumerations of the bundle's module by name. Without, members of them are read as :class:`Member`.
    content
        What stands in the file, where it is known.

    Raises
    ------
    BundleError
        It is not TOML, has another format, or lacks an entry; the entry is named.
    """
    try:
        document = tomllib.loads((path.read_bytes() if content is None else content).decode())
        bundle, ports = document["bundle"], document["ports"]
        if bundle["format"] != FORMAT:
            raise BundleError(path, f"{path} has format {bundle['format']}; this EPypes reads format {FORMAT}.")
        entries = document.get("hyperparameters", {})
        return Settings(
            str(bundle["name"]),
            _strings(ports["inputs"]),
            _strings(ports["outputs"]),
            _values(entries, enums),
            _strings(ports.get("rgb", [])),
            _values(document.get("defaults", {}), enums),
            bundle.get("types", True) is not False,
            read_tolerances(document),
            _strings(ports.get("own", [])),
            _values(document.get("attributes", {}), enums),
            bundle.get("groups", False) is True,
            entries,
        )
    except KeyError as error:
        raise BundleError(path, f"{path} lacks {error.args[0]!r}. Promote the graph again.") from error
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise BundleError(path, f"{path} can't be read: {error}.") from error


def _strings(values: Sequence[Any]) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise TypeError(f"{values!r} is not a list of token names")
    if len(set(values)) < len(values):
        raise TypeError(f"{values!r} names a token twice")
    return tuple(values)


def _values(entries: Mapping[str, Any], enums: Mapping[str, Any] | None) -> dict[str, Any]:
    return {token: read(entry, enums) for token, entry in entries.items()}
