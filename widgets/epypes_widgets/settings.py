"""How do the values of hyperparameters get into a file that a person can read, and back?"""

from __future__ import annotations

import difflib
import enum
import os
import secrets
import stat
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from epypes.bundle.settings import decode_value, encode_value, fits
from epypes.catalog import plain
from epypes.errors import SettingsError, UnknownName
from epypes.graph import CompGraph, annotated_params
from epypes.hints import Param
from epypes.optional import optional_import
from epypes_widgets.ranges import described

FORMAT: Final = "epypes settings 1"
_SUFFIX: Final = ".toml"
_SECTION: Final = "hyperparameters"
_ABOUT: Final = "Values of hyperparameters, saved by a panel of EPypes. They may be edited; the rest may not."
_COMMENT_CHARACTERS: Final = 80
# Ours say at the top what they are. A longer file, or more reasons, are nobody's settings.
_BEGINNING_BYTES: Final = 1_000
_MOST_BYTES: Final = 1_000_000
_MOST_REASONS: Final = 20
_MEMBER: Final = "enum"


def save(
    path: str | Path, values: Mapping[str, Any], cg: CompGraph, params: Mapping[str, object] | None = None
) -> Path:
    """Write values as TOML, in one step: a file that was there is whole at every moment.

    Parameters
    ----------
    path
        The file; ``.toml`` is added if it is missing.
    values
        By hyperparameter.
    cg
        Its annotations give the ranges and units that stand beside the values.
    params
        Hints that take their place, by hyperparameter.

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
    if _is_foreign(file):
        raise SettingsError(file, [f"{file} exists and has no settings of a panel. Choose another name."])
    reasons = [reason for token, value in values.items() for reason in _unwritable(token, value)]
    if reasons:
        raise SettingsError(file, reasons)
    hints = {token: next(annotated_params(cg, token), None) for token in values if token in cg.tokens}
    text = _document(values, {**hints, **(params or {})})
    try:
        _replace(file.resolve(), text)
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links; a zero byte in the name
        raise SettingsError(file, [f"{file} can't be written: {error}. Name another file."]) from error
    return file


def load(path: str | Path, present: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values in a file, by hyperparameter; whether a range allows them is for whoever sets them.

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
    entries = _entries(file)
    values: dict[str, Any] = {}
    reasons: list[str] = []
    for token, entry in entries.items():
        try:
            if token not in present:
                raise UnknownName("hyperparameter", token, present, f"that is in {file.name}")
            values[token] = _restored(_value(token, entry), entry, token, present[token])
        except (UnknownName, ValueError) as error:
            reasons.append(str(error))
    if reasons:
        raise SettingsError(file, reasons[:_MOST_REASONS])
    return values


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
        raise SettingsError(path, [f"{path} is in the home folder of nobody. Name another file."]) from error
    if not file.name:
        raise SettingsError(path, ["Settings need a name, such as 'good'."])
    return file if file.suffix == _SUFFIX else file.with_name(file.name + _SUFFIX)


# -- writing ----------------------------------------------------------------------------------------------------


def _unwritable(token: str, value: Any) -> Iterator[str]:
    if not _is_text(token) or (isinstance(value, str) and not _is_text(value)):
        yield f"Hyperparameter {token!r} has characters that no file can hold: half of a surrogate pair."
    elif isinstance(value, enum.Enum):
        if value.name not in type(value).__members__:
            yield f"Hyperparameter {token!r} is {value!r:.60}, which has no name of its own. Set one that has."
    elif not fits(plain(value)):
        yield (
            f"Hyperparameter {token!r} is a {type(value).__name__}, which TOML can't hold. Leave it out, or make it a "
            "number, string, bool, None, a member of an enumeration, a small array, or a tuple, list or dict of these."
        )


def _is_text(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _document(values: Mapping[str, Any], params: Mapping[str, object]) -> str:
    with optional_import("widgets"):
        import tomlkit

    document = tomlkit.document()
    document.add(tomlkit.comment(_ABOUT))
    document.add("format", tomlkit.item(FORMAT))
    table = tomlkit.table()
    for token, value in values.items():
        item = tomlkit.item(_entry(value))
        about = _beside(params.get(token))
        if about:
            item.comment(about)
        table.add(token, item)
    document.add(_SECTION, table)
    return tomlkit.dumps(document)


def _entry(value: Any) -> Any:
    """Return what stands behind the name: the value itself, or an inline table where its kind must be said."""
    with optional_import("widgets"):
        import tomlkit

    entry = {"value": value.name, "kind": _MEMBER} if isinstance(value, enum.Enum) else encode_value(plain(value))
    if entry.keys() == {"value"}:
        return entry["value"]
    table = tomlkit.inline_table()
    table.update(entry)
    return table


def _beside(param: object) -> str:
    """Return range and unit as a comment, which in TOML is one line without control characters."""
    if not isinstance(param, Param):
        return ""
    unit = f" {param.unit}" if param.unit else ""
    line = " ".join(f"{described(param)}{unit}".split())
    return "".join(sign for sign in line if sign.isprintable())[:_COMMENT_CHARACTERS]


def _replace(file: Path, text: str) -> None:
    draft = file.with_name(f".{file.name[:40]}-{secrets.token_hex(4)}")
    try:
        draft.write_text(text, encoding="utf-8")
        os.replace(draft, file)
    finally:
        draft.unlink(missing_ok=True)


# -- reading ----------------------------------------------------------------------------------------------------


def _entries(file: Path) -> dict[str, Any]:
    try:
        if (
            file.exists()
            and not file.is_dir()
            and not (stat.S_ISREG(file.stat().st_mode) and file.stat().st_size <= _MOST_BYTES)
        ):
            raise SettingsError(file, [f"{file} is no plain file of at most {_MOST_BYTES / 1e6:g} MB."])
        document = tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise SettingsError(file, [_missing(file)]) from error
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(file, [f"{file} is not TOML: {error}."]) from error
    except RecursionError as error:
        raise SettingsError(file, [f"{file} is nested too deeply."]) from error
    except (OSError, ValueError) as error:  # also bytes that are no text, and a zero byte in the name
        raise SettingsError(file, [f"{file} can't be read: {error}."]) from error
    entries = document.get(_SECTION)
    if document.get("format") != FORMAT or not isinstance(entries, dict):
        said = document.get("format", "no format")
        text = f"{file} has no settings of a panel: its format is {said!r:.40}, not {FORMAT!r} with [{_SECTION}]."
        raise SettingsError(file, [text])
    return entries


def _missing(file: Path) -> str:
    known = names(file.parent)
    near = difflib.get_close_matches(file.name.removesuffix(_SUFFIX), known, n=1, cutoff=0.6)
    if near:
        hint = f"Did you mean {near[0]!r}?"
    else:
        hint = f"There are: {', '.join(known[:12])}." if known else "There are no settings in that folder."
    return f"There is no file {file}. {hint}"


def _is_ours(file: Path) -> bool:
    """Whether a file begins as ours do; nothing but its beginning is read, and only of a plain file."""
    try:
        if not stat.S_ISREG(file.stat().st_mode) or file.stat().st_size > _MOST_BYTES:
            return False
        with file.open("rb") as opened:
            beginning = opened.read(_BEGINNING_BYTES).decode("utf-8", "replace")
    except (OSError, ValueError):
        return False
    return f'format = "{FORMAT}"' in beginning


def _is_foreign(file: Path) -> bool:
    """Whether there is a file that is not ours to replace."""
    try:
        return file.is_file() and not _is_ours(file)
    except (OSError, ValueError):  # a name that no file can have is refused when it is written
        return False


def _value(token: str, entry: Any) -> Any:
    try:
        if _is_member(entry):
            return entry["value"]
        value = decode_value(entry) if isinstance(entry, dict) else entry
    except (KeyError, TypeError) as error:
        raise ValueError(f"Hyperparameter {token!r} is a table without a value.") from error
    if not fits(value):
        raise ValueError(f"Hyperparameter {token!r} is {value!r:.60}, which is no value that a panel saves.")
    return value


def _is_member(entry: Any) -> bool:
    """Whether an entry names a member of an enumeration; of which, the present value says."""
    return isinstance(entry, dict) and entry.get("kind") == _MEMBER


def _restored(value: Any, entry: Any, token: str, present: Any) -> Any:
    """Return a value as the kind that the present one is of, where the file can't say it."""
    if _is_member(entry):
        return _member(value, token, present)
    if type(present).__module__ == "numpy" and getattr(present, "shape", None) == ():
        return _scalar(value, token, present)
    return value


def _member(name: Any, token: str, present: Any) -> enum.Enum:
    if not isinstance(present, enum.Enum):
        raise ValueError(
            f"Hyperparameter {token!r} is a member of an enumeration in the file, and {present!r:.40} now."
        )
    known = type(present).__members__
    if name not in known:
        raise ValueError(str(UnknownName("member", name, known, f"of {type(present).__name__}, for {token!r}")))
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
        raise ValueError(f"Hyperparameter {token!r} can't be {value!r:.40}: it is a {kind.__name__}.")
    return restored
