"""Do named settings come back as they were, and does a bad file say what is wrong with it?"""

from __future__ import annotations

import enum
import os
import tomllib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import SettingsError
from epypes_widgets import tune
from epypes_widgets.settings import load, names, save


class Method(enum.Enum):
    CANNY = 1
    SOBEL = 2


class Flags(enum.IntFlag):
    A = 1
    B = 2


def there_and_back(tmp_path: Path, values: dict[str, Any], present: dict[str, Any] | None = None) -> dict[str, Any]:
    return load(save(tmp_path / "x", values), values if present is None else present).values


def refused(path: Path, present: dict[str, Any]) -> tuple[str, ...]:
    with pytest.raises(SettingsError) as caught:
        load(path, present)
    assert all(reason in str(caught.value) for reason in caught.value.reasons)
    return caught.value.reasons


def hand_written(tmp_path: Path, lines: str) -> Path:
    file = tmp_path / "hand.toml"
    file.write_text(f'format = "epypes settings 1"\n[hyperparameters]\n{lines}\n')
    return file


VALUES = [3, -(2**63), 2.5, -0.0, 1e300, 0.1 + 0.2, float("inf"), True, False, None, "", 'a"b\n\\\t\x00é🙂', (3, 5), (), [1, 2.0, "x"],
          Method.SOBEL, Flags.B, np.uint8(7), np.int64(-3), np.float32(0.1), np.float64(1.5), np.bool_(True), np.str_("q")]  # fmt: skip


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_a_value_comes_back_with_its_type_to_the_last_bit(tmp_path: Path, value: Any) -> None:
    back = there_and_back(tmp_path, {"k": value})["k"]
    assert (type(back), repr(back)) == (type(value), repr(value))


def test_nan_comes_back(tmp_path: Path) -> None:
    back = there_and_back(tmp_path, {"k": float("nan"), "n": np.float32("nan")})
    assert np.isnan(back["k"])
    assert np.isnan(back["n"])
    assert type(back["n"]) is np.float32


def test_names_of_any_kind_come_back(tmp_path: Path) -> None:
    values = {name: place for place, name in enumerate(["a.b", "with blank", 'q"uote', "größe", "a]b", "#", "x = 1"])}
    assert there_and_back(tmp_path, values) == values


def test_a_file_can_be_read_and_edited_by_a_person(tmp_path: Path) -> None:
    params = {"side": ep.Param(1, 31, odd=True, unit="px"), "lo": ep.Param(0, 255, unit="gray\nlevels\x07")}
    file = save(tmp_path / "good", {"side": 5, "lo": (1, 2)}, params)
    assert file == tmp_path / "good.toml"
    assert file.read_text().splitlines() == [
        "# Values of hyperparameters, saved by a panel of EPypes. They may be edited; the rest may not.",
        'format = "epypes settings 1"',
        "",
        "[hyperparameters]",
        "side = 5 # odd 1 to 31 px",
        'lo = {value = [1, 2], kind = "tuple"} # 0 to 255 gray levels',
    ]
    file.write_text(file.read_text().replace("side = 5", "side = 7"))
    assert load(file, {"side": 5, "lo": (1, 2)}).values == {"side": 7, "lo": (1, 2)}


def test_the_file_of_a_panel_has_the_ranges_and_units_of_annotations(tmp_path: Path) -> None:
    def smooth(image: Any, side: Annotated[int, ep.Param(1, 31, odd=True, unit="px")]) -> Any:
        return image

    runner = ep.CompGraphRunner(ep.CompGraph({"smooth": smooth}, {"smooth": (("im", "k"), "s")}), {"k": 5})
    runner.run(im=np.zeros((8, 8), np.uint8))
    panel = tune(runner)
    assert "k = 5 # odd 1 to 31 px" in panel.save(tmp_path / "good").read_text()
    panel.close(60)


def test_a_hint_that_is_no_range_is_passed_over(tmp_path: Path) -> None:
    file = save(tmp_path / "x.toml", {"k": 1, "of_no_graph": 2}, {"k": object(), "of_no_graph": None})
    assert tomllib.loads(file.read_text())["hyperparameters"] == {"k": 1, "of_no_graph": 2}


def test_a_number_in_the_file_becomes_the_kind_that_the_runner_has(tmp_path: Path) -> None:
    file = hand_written(tmp_path, "a = 7\nb = 2\nc = 0.1\nd = true")
    back = load(file, {"a": np.uint8(1), "b": np.float32(1), "c": np.float32(0), "d": np.bool_(False)}).values
    assert [type(value) for value in back.values()] == [np.uint8, np.float32, np.float32, np.bool_]


def test_a_value_of_another_kind_than_the_runner_has_is_as_the_file_says(tmp_path: Path) -> None:
    file = hand_written(tmp_path, 'a = "text"\nb = [1, 2]\nc = {kind = "none"}')
    assert load(file, {"a": np.uint8(1), "b": np.uint8(1), "c": np.uint8(1)}).values == {
        "a": "text",
        "b": [1, 2],
        "c": None,
    }


def test_a_number_that_the_kind_can_not_hold_is_refused(tmp_path: Path) -> None:
    file = hand_written(tmp_path, "a = 300\nb = 2.5")
    assert refused(file, {"a": np.uint8(1), "b": np.int32(1)}) == (
        "Hyperparameter 'a' can't be 300: it is a uint8.",
        "Hyperparameter 'b' can't be 2.5: it is a int32.",
    )


def test_all_that_is_wrong_is_said_at_once_with_the_nearest_names(tmp_path: Path) -> None:
    file = hand_written(
        tmp_path,
        'tresh = 3\nmethod = {value = "SOBL", kind = "enum"}\ngain = {value = "A", kind = "enum"}\nday = 2020-01-01\nempty = {}',
    )
    present = {"thresh": 1, "method": Method.CANNY, "gain": 2, "day": 1, "empty": 1}
    assert refused(file, present) == (
        "No hyperparameter 'tresh' that is in hand.toml. Did you mean 'thresh'?",
        "No member 'SOBL' of Method, for 'method'. Did you mean 'SOBEL'?",
        "Hyperparameter 'gain' is a member of an enumeration in the file, and 2 now.",
        "Hyperparameter 'day' is datetime.date(2020, 1, 1), which is no value that a panel saves.",
        "Hyperparameter 'empty' is a table without a value.",
    )


def test_values_that_can_not_be_written_are_all_named_and_nothing_is_written(tmp_path: Path) -> None:
    values = {"kernel": np.ones(1_000), "f": len, "flags": Flags.A | Flags.B, "half": "\ud800", "fine": 1}
    with pytest.raises(SettingsError) as caught:
        save(tmp_path / "x", values)
    assert [reason.split("'")[1] for reason in caught.value.reasons] == ["kernel", "f", "flags", "half"]
    assert "which TOML can't hold" in caught.value.reasons[0]
    assert list(tmp_path.iterdir()) == []


def test_a_missing_file_names_the_nearest_one(tmp_path: Path) -> None:
    assert refused(tmp_path / "good", {}) == (f"No settings 'good' in {tmp_path}. There is none.",)
    save(tmp_path / "good", {"k": 1})
    assert refused(tmp_path / "goood.toml", {})[0].endswith("Did you mean 'good'?")
    assert refused(tmp_path / "other", {})[0].endswith("There are: good.")


def test_a_file_that_is_no_toml_says_where(tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text("format = 1\nlo = = 3\n")
    assert "at line 2, column 6" in refused(tmp_path / "x.toml", {})[0]


@pytest.mark.parametrize(
    "data",
    [b"", b"a = 1", b'format = "epypes settings 2"\n[hyperparameters]', b'format = "epypes settings 1"',
     b'format = "epypes settings 1"\nhyperparameters = 3', b"\xff\xfe\x00", b"[bundle]\nformat = 1"],
)  # fmt: skip
def test_a_file_of_something_else_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "x.toml").write_bytes(data)
    assert len(refused(tmp_path / "x.toml", {"a": 1})) == 1


def test_a_file_with_a_mark_of_its_byte_order_is_read(tmp_path: Path) -> None:
    file = hand_written(tmp_path, "k = 2")
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert load(file, {"k": 1}).values == {"k": 2}


@pytest.mark.parametrize("name", ["", ".", "/", "~nobody-of-this-name/x", "a\0b", "x" * 300])
def test_a_name_that_is_none_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name if name.startswith(("a", "x")) else name
    with pytest.raises(SettingsError):
        save(path, {"k": 1})
    with pytest.raises(SettingsError):
        load(path, {"k": 1})


def test_a_folder_that_is_missing_or_a_file_that_is_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.toml").mkdir()
    for path in (tmp_path / "none" / "x", tmp_path / "x.toml"):
        with pytest.raises(SettingsError, match="can't be written"):
            save(path, {"k": 1})
    with pytest.raises(SettingsError, match="can't be read"):
        load(tmp_path / "x.toml", {})
    assert names(tmp_path) == ()
    assert [path.name for path in tmp_path.iterdir()] == ["x.toml"], "no draft is left"


def test_a_save_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = save(tmp_path / "good", {"k": 1})

    def full(*_args: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(SettingsError, match="No space left"):
        save(file, {"k": 2})
    assert load(file, {"k": 0}).values == {"k": 1}
    assert list(tmp_path.iterdir()) == [file]


def test_a_link_goes_on_naming_the_file(tmp_path: Path) -> None:
    save(tmp_path / "v1", {"k": 1})
    (tmp_path / "current.toml").symlink_to("v1.toml")
    save(tmp_path / "current", {"k": 2})
    assert (tmp_path / "current.toml").is_symlink()
    assert load(tmp_path / "v1", {"k": 0}).values == {"k": 2}


def test_only_our_files_are_listed_by_name(tmp_path: Path) -> None:
    for name in ("b", "a.v2", "größe"):
        save(tmp_path / name, {"k": 1})
    (tmp_path / "pyproject.toml").write_text("[project]\nname = 'x'")
    (tmp_path / "broken.toml").write_text("= =")
    (tmp_path / "huge.toml").write_text('format = "epypes settings 1"\n[hyperparameters]\n' + "# \n" * 400_000)
    assert names(tmp_path) == ("a.v2", "b", "größe")
    assert load(tmp_path / "a.v2", {"k": 0}).values == {"k": 1}
    assert names(tmp_path / "none") == ()
