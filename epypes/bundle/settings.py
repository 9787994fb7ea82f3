"""What stands in pipeline.toml, and how is it read back?"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from epypes.bundle.compare import Tolerance
from epypes.bundle.entries import fits, plain, read, written
from epypes.bundle.tolerance import add_tolerances, read_tolerances
from epypes.errors import BundleError
from epypes.graph import CompGraph, annotated_params
from epypes.hints import Param, Roi
from epypes.images import Order

FORMAT: Final = 1


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
        Whether the graph compares annotations, as CompGraph does unless told otherwise.
    tolerances
        How far outputs may be from what was recorded, by token; those of all others not at all.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    hyperparameters: Mapping[str, Any]
    rgb: tuple[str, ...] = ()
    defaults: Mapping[str, Any] = field(default_factory=dict)
    types: bool = True
    tolerances: Mapping[str, Tolerance] = field(default_factory=dict)

    def order(self, token: str) -> Order:
        """Return the order of a token's colours."""
        return "rgb" if token in self.rgb else "bgr"


def unwritable(hyperparameters: Mapping[str, Any]) -> list[str]:
    """Return a reason for each hyperparameter whose value TOML can't hold."""
    return [
        f"Hyperparameter {token!r} is a {type(value).__name__}, which pipeline.toml can't hold. "
        "Use a number, string, bool, None, or a tuple or list of them; or unfreeze it and pass it to run()."
        for token, value in hyperparameters.items()
        if not fits(plain(value))
    ]


def writable_defaults(cg: CompGraph, hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the graph's defaults of hyperparameters, but for those that TOML can't hold.

    They may be missing: in the bundle every hyperparameter has a value. What an event brings has no default there.
    """
    return {token: value for token, value in cg.defaults.items() if token in hyperparameters and fits(plain(value))}


def write_settings(path: Path, settings: Settings, cg: CompGraph) -> None:
    """Write pipeline.toml, with a comment per section and the ranges that annotations give."""
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
    document.add("bundle", bundle)
    ports = tomlkit.table()
    ports.add(tomlkit.comment("The tokens that an event brings, and those that its answer carries."))
    ports.add("inputs", list(settings.inputs))
    ports.add("outputs", list(settings.outputs))
    if settings.rgb:
        ports.add(tomlkit.comment("Their three or four channels are RGB; those of all others are BGR."))
        ports.add("rgb", list(settings.rgb))
    document.add("ports", ports)
    hyperparameters = tomlkit.table(is_super_table=True)
    for token, value in settings.hyperparameters.items():
        hyperparameters.add(token, _entry(plain(value), next(annotated_params(cg, token), None)))
    document.add("hyperparameters", hyperparameters)
    if settings.defaults:
        defaults = tomlkit.table(is_super_table=True)
        for token, value in settings.defaults.items():
            defaults.add(token, _entry(plain(value), None))
        document.add("defaults", defaults)
    add_tolerances(document, settings.tolerances)
    path.write_text(tomlkit.dumps(document), encoding="utf-8")


def _entry(value: Any, hint: Param | Roi | None) -> Any:
    import tomlkit

    table = tomlkit.table()
    for key, part in written(value).items():
        table.add(key, part)
    for key in ("low", "high", "step", "odd", "log", "unit"):
        setting = getattr(hint, key, None)
        if setting:
            table.add(key, setting)
    choices = getattr(hint, "choices", None)
    if choices and all(fits(choice) and choice is not None for choice in choices):
        table.add("choices", list(choices))
    return table


def read_settings(path: Path) -> Settings:
    """Read pipeline.toml.

    Raises
    ------
    BundleError
        It is not TOML, has another format, or lacks an entry; the entry is named.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
        bundle, ports = document["bundle"], document["ports"]
        if bundle["format"] != FORMAT:
            raise BundleError(path, f"{path} has format {bundle['format']}; this EPypes reads format {FORMAT}.")
        return Settings(
            str(bundle["name"]),
            _strings(ports["inputs"]),
            _strings(ports["outputs"]),
            _values(document.get("hyperparameters", {})),
            _strings(ports.get("rgb", [])),
            _values(document.get("defaults", {})),
            bundle.get("types", True) is not False,
            read_tolerances(document),
        )
    except KeyError as error:
        raise BundleError(path, f"{path} lacks {error.args[0]!r}. Promote the graph again.") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, TypeError, AttributeError) as error:
        raise BundleError(path, f"{path} can't be read: {error}.") from error


def _strings(values: Sequence[Any]) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise TypeError(f"{values!r} is not a list of token names")
    if len(set(values)) < len(values):
        raise TypeError(f"{values!r} names a token twice")
    return tuple(values)


def _values(entries: Mapping[str, Any]) -> dict[str, Any]:
    return {token: read(entry) for token, entry in entries.items()}
