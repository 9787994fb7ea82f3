"""The values of hyperparameters in a TOML file that a person can read and edit."""

from __future__ import annotations

import enum
import os
import secrets
import stat
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from epypes.bundle.settings import decode_value, encode_value, fits
from epypes.catalog import plain
from epypes.errors import InvalidValue, SettingsError, UnknownName
from epypes.hints import Param
from epypes.optional import optional_import
from epypes_widgets.controls.ranges import range_text
from epypes_widgets.picture.picture_settings import PictureSettings
from epypes_widgets.values import numpy_type

FORMAT: Final = "epypes settings 1"
_SUFFIX: Final = ".toml"
_SECTION: Final = "hyperparameters"
_PICTURES: Final = "pictures"
_PANEL: Final = "panel"
_ABOUT: Final = "Values of hyperparameters, saved by a panel of EPypes. They may be edited; the rest may not."
_COMMENT_CHARACTERS: Final = 80
# A longer file, or more reasons, are no settings that a panel has saved.
_MAX_BYTES: Final = 1_000_000
_MAX_REASONS: Final = 20
_MEMBER: Final = "enum"


def save(
    path: str | Path,
    values: Mapping[str, Any],
    params: Mapping[str, object] | None = None,
    pictures: Mapping[str, PictureSettings] | None = None,
    tiles: Sequence[str] = (),
) -> Path:
    """Write values as TOML, in one step: a file that was there is whole at every moment.

    Parameters
    ----------
    path
        The file; ``.toml`` is added if it is missing.
    values
        By hyperparameter.
    params
        By hyperparameter, the ranges and units that stand beside the values.
    pictures
        By token, how its picture is shown; only what is not as at first is written.
    tiles
        The tokens whose numbers are shown.

    Returns
    -------
    Path
        The file that was written.

    Raises
    ------
    SettingsError
        With every reason: values that TOML can't hold, or a place that can't be written to. Nothing is written then.
    """
    file = _with_suffix(path)
    reasons = [reason for token, value in values.items() for reason in _unwritable(token, value)]
    if reasons:
        raise SettingsError(file, reasons)
    text = _document(values, params or {}, pictures or {}, tiles)
    try:
        if file.is_file() and not _is_ours(file):
            raise SettingsError(file, [f"{file} exists and has no settings of a panel. Choose another name."])
        _replace(file.resolve(), text)
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links; a zero byte in the name
        # Not the name of the draft that is written first.
        reason = getattr(error, "strerror", None) or error
        raise SettingsError(file, [f"{file} can't be written: {reason}. Name another file."]) from error
    return file


@dataclass(frozen=True)
class Settings:
    """What a file has that a panel saved.

    Attributes
    ----------
    values
        By hyperparameter.
    pictures
        By token, how its picture is shown.
    tiles
        The tokens whose numbers were shown, each once; None if the file does not say.
    """

    values: dict[str, Any]
    pictures: dict[str, PictureSettings]
    tiles: tuple[str, ...] | None


def load(path: str | Path, present: Mapping[str, Any]) -> Settings:
    """Return what is in a file; the caller checks whether a range allows the values.

    Parameters
    ----------
    path
        The file; ``.toml`` is added if it is missing.
    present
        The values of all hyperparameters now: they say which names there are, which numbers are NumPy's and of which
        enumeration a member is.

    Raises
    ------
    SettingsError
        With every reason: the file is not there, is no TOML or has none of our settings; a name or a value in it
        does not fit.
    """
    file = _with_suffix(path)
    document = _read(file)
    values: dict[str, Any] = {}
    reasons: list[str] = []
    for token, entry in _entries(file, document).items():
        try:
            if token not in present:
                raise UnknownName("hyperparameter", token, present, f"that is in {file.name}")
            values[token] = _value(entry, token, present[token])
        except (UnknownName, ValueError) as error:
            reasons.append(str(error))
    pictures: dict[str, PictureSettings] = {}
    sections = document.get(_PICTURES)
    for token, section in sections.items() if isinstance(sections, dict) else ():
        try:
            pictures[token] = PictureSettings.of(section if isinstance(section, dict) else {"": section})
        except ValueError as error:
            reasons.append(f"[{_PICTURES}.{token}]: {error}")
    if reasons:
        raise SettingsError(file, reasons[:_MAX_REASONS])
    panel = document.get(_PANEL)
    tiles = panel.get("tiles") if isinstance(panel, dict) else None
    if isinstance(tiles, list):
        return Settings(values, pictures, tuple(dict.fromkeys(token for token in tiles if isinstance(token, str))))
    return Settings(values, pictures, None)


def names(folder: str | Path) -> tuple[str, ...]:
    """Return the names of the settings in a folder, sorted, without ``.toml``; other files are passed over."""
    try:
        found = sorted(Path(folder).glob(f"*{_SUFFIX}"))
    except (OSError, ValueError):
        return ()
    return tuple(file.name.removesuffix(_SUFFIX) for file in found if _is_ours(file))


def _with_suffix(path: str | Path) -> Path:
    try:
        file = Path(path).expanduser()
    except RuntimeError as error:
        raise SettingsError(path, [f"{path} is in the home folder of no user. Name another file."]) from error
    if not file.name:
        raise SettingsError(path, ["Settings need a name, such as 'good'."])
    return file if file.suffix == _SUFFIX else file.with_name(file.name + _SUFFIX)


def _is_ours(file: Path) -> bool:
    try:
        _entries(file, _read(file))
    except SettingsError:
        return False
    return True


# -- writing ----------------------------------------------------------------------------------------------------


def _unwritable(token: str, value: Any) -> Iterator[str]:
    try:
        f"{token}{value if isinstance(value, str) else ''}".encode()
    except UnicodeEncodeError:
        yield f"Hyperparameter {token!r} has characters that no file can hold: half of a surrogate pair."
        return
    if isinstance(value, enum.Enum):
        if value.name not in type(value).__members__:
            yield f"Hyperparameter {token!r} is {value!r:.60}, which has no name of its own. Set one that has."
    elif not fits(plain(value)):
        yield (
            f"Hyperparameter {token!r} is a {type(value).__name__}, which TOML can't hold. Leave it out, or make it a "
            "number, string, bool, None, a member of an enumeration, a small array, or a tuple, list or dict of these."
        )


def _document(
    values: Mapping[str, Any],
    params: Mapping[str, object],
    pictures: Mapping[str, PictureSettings],
    tiles: Sequence[str],
) -> str:
    with optional_import("widgets"):
        import tomlkit

    document = tomlkit.document()
    document.add(tomlkit.comment(_ABOUT))
    document.add("format", tomlkit.item(FORMAT))
    table = tomlkit.table()
    for token, value in values.items():
        entry = {"value": value.name, "kind": _MEMBER} if isinstance(value, enum.Enum) else encode_value(plain(value))
        item: Any = tomlkit.inline_table()
        item.update(entry)
        if entry.keys() == {"value"}:  # else its kind must stand beside it
            item = tomlkit.item(entry["value"])
        comment = _comment(params.get(token))
        if comment:
            item.comment(comment)
        table.add(token, item)
    document.add(_SECTION, table)
    if any(each.changed for each in pictures.values()):
        document.add(_PICTURES, tomlkit.item({token: each.changed for token, each in pictures.items() if each.changed}))
    if tiles:
        document.add(_PANEL, {"tiles": list(tiles)})
    return tomlkit.dumps(document)


def _comment(param: object) -> str:
    """Return range and unit as a comment, which in TOML is one line without control characters."""
    if not isinstance(param, Param):
        return ""
    line = " ".join(f"{range_text(param)} {param.unit}".split())
    return "".join(sign for sign in line if sign.isprintable())[:_COMMENT_CHARACTERS]


def _replace(file: Path, text: str) -> None:
    draft = file.with_name(f".{file.name[:40]}-{secrets.token_hex(4)}")
    try:
        draft.write_text(text, encoding="utf-8")
        os.replace(draft, file)
    finally:
        draft.unlink(missing_ok=True)


# -- reading ----------------------------------------------------------------------------------------------------


def _read(file: Path) -> dict[str, Any]:
    try:
        found = file.stat()
        if not stat.S_ISDIR(found.st_mode) and not (stat.S_ISREG(found.st_mode) and found.st_size <= _MAX_BYTES):
            raise SettingsError(file, [f"{file} is no plain file of at most {_MAX_BYTES / 1e6:g} MB."])
        return tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        folder = "in this folder" if file.parent == Path() else f"in {file.parent.resolve()}"
        unknown = UnknownName("settings", file.name.removesuffix(_SUFFIX), names(file.parent), folder)
        raise SettingsError(file, [str(unknown)]) from error
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(file, [f"{file} is not TOML: {error}."]) from error
    except (OSError, ValueError, RecursionError) as error:  # also bytes that are no text, and a zero byte in the name
        raise SettingsError(file, [f"{file} can't be read: {error}."]) from error


def _entries(file: Path, document: Mapping[str, Any]) -> dict[str, Any]:
    entries = document.get(_SECTION)
    if document.get("format") != FORMAT or not isinstance(entries, dict):
        found_format = document.get("format", "no format")
        text = f"{file} has no settings of a panel: its format is {found_format!r:.40}, not {FORMAT!r}"
        raise SettingsError(file, [f"{text} with [{_SECTION}]."])
    return entries


def _value(entry: Any, token: str, present: Any) -> Any:
    """Return a value as the kind that the present one is of, where the file can't say it."""
    try:
        if isinstance(entry, dict) and entry.get("kind") == _MEMBER:
            return _member(entry["value"], token, present)
        value = decode_value(entry) if isinstance(entry, dict) else entry
    except (KeyError, TypeError) as error:
        raise InvalidValue(f"Hyperparameter {token!r} is a table without a value.") from error
    if not fits(value):
        raise InvalidValue(f"Hyperparameter {token!r} is {value!r:.60}, which is no value that a panel saves.")
    return _scalar(value, token, present) if numpy_type(present) is not None else value


def _member(name: Any, token: str, present: Any) -> enum.Enum:
    if not isinstance(present, enum.Enum):
        raise InvalidValue(
            f"Hyperparameter {token!r} is a member of an enumeration in the file, and {present!r:.40} now."
        )
    known = type(present).__members__
    if name not in known:
        raise InvalidValue(str(UnknownName("member", name, known, f"of {type(present).__name__}, for {token!r}")))
    return known[name]


def _scalar(value: Any, token: str, present: Any) -> Any:
    kind = type(present)
    if type(value) not in (bool, int, float, str) or isinstance(value, str) != isinstance(present, str):
        return value
    try:
        restored = kind(value)
        is_held = restored == value or present.dtype.kind == "f"
    except (OverflowError, ValueError, TypeError, Warning):  # a number too large is a warning of NumPy 1
        is_held = False
    if not is_held:
        raise InvalidValue(f"Hyperparameter {token!r} can't be {value!r:.40}: it is a {kind.__name__}.")
    return restored
