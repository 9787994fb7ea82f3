"""Values that were tuned on a running service, written into its bundle, which still proves what it computes."""

from __future__ import annotations

import difflib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epypes.bundle.manifest import SETTINGS, check_manifest, digest
from epypes.bundle.promote import draft_folder, swap_folders
from epypes.bundle.proof.determinism import prove
from epypes.bundle.proof.replay_process import REPLAY_TIMEOUT_S, replay_isolated
from epypes.bundle.settings import MOST_NUMBERS, Unwritable, cast_like, decode_value, encode_value
from epypes.errors import BundleError, HyperparameterError, PromotionRefused, UnknownName
from epypes.optional import optional_import


@dataclass(frozen=True, slots=True)
class WriteBack:
    """What was written back, or would be.

    Attributes
    ----------
    diff
        The lines of pipeline.toml that are others now, as ``diff -u`` writes them; "" if there are none.
    digest
        That of the bundle with these values.
    """

    diff: str
    digest: str


def write_back(
    path: str | Path, values: Mapping[str, Any], *, dry_run: bool = False, timeout_s: float = REPLAY_TIMEOUT_S
) -> WriteBack:
    """Write values of hyperparameters into a bundle's pipeline.toml, and record what its samples give with them.

    The samples are run in an isolated process and replayed in another; then the new bundle replaces the old one in one
    step.

    Parameters
    ----------
    path
        The bundle.
    values
        By hyperparameter; all others stay as they are.
    dry_run
        Do all of it, but leave the bundle alone.
    timeout_s
        When a process is ended.

    Raises
    ------
    UnknownName
        There is no such hyperparameter.
    HyperparameterError
        TOML can't hold a value.
    BundleError
        The folder is not the bundle that was promoted, or a function fails with these values; then the bundle stays as
        it is.
    """
    folder = Path(path).resolve()
    before = check_manifest(folder)
    text = (folder / SETTINGS).read_text(encoding="utf-8")
    changed = changed_settings(text, values)
    if changed == text:
        return WriteBack("", before)
    try:
        with draft_folder(folder) as draft:
            shutil.copytree(folder, draft, ignore=shutil.ignore_patterns("__pycache__"))
            (draft / SETTINGS).write_text(changed, encoding="utf-8")
            _record(draft, folder, timeout_s)
            old, new = (part.splitlines(True) for part in (text, (draft / SETTINGS).read_text(encoding="utf-8")))
            diff = "".join(difflib.unified_diff(old, new, f"a/{SETTINGS}", f"b/{SETTINGS}"))
            found = WriteBack(diff, digest(draft))
            if check_manifest(folder) != before:
                raise BundleError(folder, f"{folder} was replaced meanwhile. Write the values back again.")
            if not dry_run:
                swap_folders(draft, folder)
    except OSError as error:
        raise BundleError(folder, f"{folder} can't be written: {error}. The bundle stays as it is.") from error
    return found


def changed_settings(text: str, values: Mapping[str, Any]) -> str:
    """Return the text of pipeline.toml with other values of hyperparameters; all other lines stay as they are.

    Raises
    ------
    UnknownName
        There is no such hyperparameter.
    HyperparameterError
        TOML can't hold a value.
    """
    with optional_import():
        import tomlkit

    document = tomlkit.parse(text)
    entries: Any = document.get("hyperparameters", {})
    for token, value in values.items():
        if token not in entries:
            raise UnknownName("hyperparameter", token, entries, "in this bundle")
        entry = entries[token]
        try:
            new = encode_value(cast_like(entry, value))
        except Unwritable as error:
            text = f"Hyperparameter {token!r} can't be {error}: {SETTINGS} can't hold it. Give a number, a string, an"
            text += f" array of at most {MOST_NUMBERS} numbers, or tuples, lists and dicts of them; or set"
            raise HyperparameterError(token, f"{text} the value in the notebook, and promote again.") from error
        # Its range stays.
        old = encode_value(decode_value(entry.unwrap()))
        for key in old.keys() - new.keys():
            del entry[key]
        for key, part in new.items():
            # 1, 1.0 and true are equal, but not the same.
            if key not in old or repr(old[key]) != repr(part):
                entry[key] = part
    return tomlkit.dumps(document)


def _record(draft: Path, target: Path, timeout_s: float) -> None:
    """Record the outputs of a draft's samples again, and prove it."""
    try:
        replay_isolated(draft, record=True, timeout_s=timeout_s)
        prove(draft, target, timeout_s)
    except BundleError as error:
        reasons = error.reasons if isinstance(error, PromotionRefused) else (str(error),)
        why = " ".join(reasons).replace(str(draft.resolve()), str(target)).rstrip(".")
        text = f"The values were not written back: {why}. The bundle stays as it is: try other values."
        raise BundleError(target, text) from error
