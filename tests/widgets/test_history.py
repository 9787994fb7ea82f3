"""Does a history know where the hand stopped, find the way back, and show its thumbnails as a table?"""

from __future__ import annotations

import copy
import enum
import gc
import pickle
import threading
from typing import Any

import numpy as np
import pandas as pd
import pytest

import epypes as ep
from epypes.display import Picture, encode_image
from epypes_widgets.history import Entry, History, changed, history_of


class Method(enum.Enum):
    CANNY = 1
    SOBEL = 2


def thumbnail(seed: int = 0) -> Picture:
    image = np.random.default_rng(seed).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    return encode_image(image, 96, most_bytes=5_000)


def committed(*values: Any, limit: int = 1_000) -> History:
    history = History(limit)
    for value in values:
        history.commit({"k": value})
    return history


def numbers(history: History) -> list[int]:
    return [entry.number for entry in history.entries]


def test_entries_say_what_was_seen_and_when() -> None:
    picture = thumbnail()
    entry = History().commit({"k": 3}, token="edges", picture=picture, compute_ms=2.5, label="good", image=1)
    assert entry is not None
    assert (entry.number, dict(entry.values), entry.token, entry.compute_ms) == (1, {"k": 3}, "edges", 2.5)
    assert (entry.picture, entry.label, entry.image) == (picture, "good", 1)
    assert entry.at.tzinfo is not None


@pytest.mark.parametrize(
    "value",
    [3, 2.5, float("nan"), -0.0, True, None, "canny", Method.CANNY, np.uint8(7), np.float32("nan"), (3, 5), [1, (2, 3)],
     {"a": 1}, np.ones(3), 10**40, b"x"],
)  # fmt: skip
def test_the_same_values_again_are_no_entry(value: Any) -> None:
    history = committed(value)
    assert history.commit({"k": value if isinstance(value, np.ndarray) else copy.deepcopy(value)}) is None
    assert len(history) == 1


@pytest.mark.parametrize(
    ("one", "other"),
    [(1, 1.0), (1, True), (0, False), (0.0, -0.0), (np.uint8(1), 1), (np.uint8(1), np.int64(1)), ((1, 2), [1, 2]),
     ((1, 2), (1, 2.0)), (Method.CANNY, Method.SOBEL), (Method.CANNY, 1), (None, 0), ("1", 1), ([1], [1, 1]),
     ({"a": 1}, {"a": 2}), ({"a": 1}, {"b": 1}), (np.ones(3), np.ones(3)), (object(), object())],
)  # fmt: skip
def test_values_that_compute_something_else_are_an_entry(one: Any, other: Any) -> None:
    assert numbers(committed(one, other)) == [1, 2]


def test_another_nan_is_no_entry_but_another_unit_of_time_is() -> None:
    assert numbers(committed(float("nan"), float("nan"), [float("nan")], [float("nan")])) == [1, 2]
    assert numbers(committed(np.datetime64(1, "D"), np.datetime64(1, "h"))) == [1, 2]


def test_an_array_read_twice_from_a_runner_is_the_same() -> None:
    runner = ep.CompGraphRunner(ep.CompGraph({"add": np.add}, {"add": (("x", "k"), "y")}), {"k": np.ones(3)})
    assert numbers(committed(runner["k"], runner["k"], runner.hyperparameters["k"])) == [1]


def test_a_value_whose_comparison_fails_is_an_entry() -> None:
    class Hostile:
        def __eq__(self, other: object) -> bool:
            raise RuntimeError("not comparable")

        __hash__ = None  # type: ignore[assignment]

    assert numbers(committed(Hostile(), Hostile())) == [1, 2]
    loop: list[Any] = []
    loop.append(loop)
    again: list[Any] = []
    again.append(again)
    assert numbers(committed(loop, again)) == [1, 2]


def test_another_image_with_the_same_values_is_an_entry() -> None:
    history = History()
    history.commit({"k": 1}, image=0)
    assert history.commit({"k": 1}, image=1) is not None
    assert history.commit({"k": 1}, image=1) is None


def test_what_the_caller_does_to_its_values_later_is_not_history() -> None:
    values = {"k": [1, 2]}
    history = History()
    history.commit(values)
    values["k"].append(3)
    values["more"] = []
    assert dict(history.entries[0].values) == {"k": [1, 2]}
    with pytest.raises(TypeError):
        history.entries[0].values["k"] = 0  # type: ignore[index]


def test_undo_and_redo_walk_the_path_and_stop_at_its_ends() -> None:
    history = committed(1, 2, 3)
    assert (history.can_undo, history.can_redo) == (True, False)
    assert [entry and entry.values["k"] for entry in (history.undo(), history.undo(), history.undo())] == [2, 1, None]
    assert (history.can_undo, history.can_redo) == (False, True)
    assert [entry and entry.values["k"] for entry in (history.redo(), history.redo(), history.redo())] == [2, 3, None]
    assert history.current is history.entries[-1]


def test_an_empty_history_has_nothing_to_go_back_to() -> None:
    history = History()
    assert (history.undo(), history.redo(), history.current, history.can_undo, history.can_redo) == (
        None, None, None, False, False,
    )  # fmt: skip
    with pytest.raises(LookupError, match="It is empty"):
        history.goto(1)


def test_a_commit_after_undo_cuts_off_the_way_ahead_but_forgets_nothing() -> None:
    history = committed(1, 2, 3)
    history.undo()
    history.undo()
    history.commit({"k": 9})
    assert not history.can_redo
    assert [entry.values["k"] for entry in history.entries] == [1, 2, 3, 9]
    back = history.undo()
    assert back is not None
    assert back.values["k"] == 1
    assert not history.can_undo


def test_a_commit_of_where_undo_led_to_keeps_the_way_ahead() -> None:
    history = committed(1, 2)
    history.undo()
    assert history.commit({"k": 1}) is None
    assert history.can_redo


def test_goto_finds_entries_on_the_path_and_beside_it() -> None:
    history = committed(1, 2, 3)
    assert history.goto(1).values["k"] == 1
    assert history.can_redo
    history.commit({"k": 9})
    assert history.goto(3).values["k"] == 3
    back = history.undo()
    assert back is not None
    assert back.values["k"] == 9
    with pytest.raises(LookupError, match="No entry 7 in this history. It has 1 to 4"):
        history.goto(7)


def test_the_oldest_are_dropped_also_from_undo() -> None:
    history = committed(*range(10), limit=3)
    assert numbers(history) == [8, 9, 10]
    assert [bool(history.undo()) for _ in range(3)] == [True, True, False]
    history.goto(8)
    history.commit({"k": "new"})
    assert numbers(history) == [9, 10, 11]
    assert not history.can_undo, "what was before is gone"


def test_threads_that_commit_at_once_lose_nothing() -> None:
    history = History()

    def commit(start: int) -> None:
        for value in range(start, start + 200):
            history.commit({"k": value})

    threads = [threading.Thread(target=commit, args=(1_000 * index,)) for index in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert numbers(history) == list(range(1, 801))


@pytest.mark.slow
def test_a_runner_keeps_its_history_and_takes_it_along_when_it_goes(runner: ep.CompGraphRunner) -> None:
    history_of(runner).commit({"gain": 1})
    assert len(history_of(runner)) == 1
    other = ep.CompGraphRunner(runner.cg, runner.hyperparameters)
    assert history_of(other) is not history_of(runner)
    from epypes_widgets import history

    before = len(history._histories)
    del other
    gc.collect()
    assert len(history._histories) == before - 1


def test_a_change_is_said_in_few_words() -> None:
    history = History()
    kernel = np.ones((5, 5), np.uint8)
    first = history.commit({"lo": 70, "m": Method.CANNY, "kernel": kernel})
    second = history.commit({"lo": 90, "m": Method.SOBEL, "kernel": kernel.copy()})
    assert isinstance(first, Entry)
    assert isinstance(second, Entry)
    assert changed(first, second) == "lo 70 -> 90, m Method.CANNY -> Method.SOBEL, kernel changed"
    assert changed(None, first) == ""
    assert changed(first, first) == ""


def test_a_change_of_everything_is_still_short() -> None:
    history = History()
    one = history.commit({f"hyperparameter_{place}": "x" * 500 for place in range(50)}, image=0)
    two = history.commit({f"hyperparameter_{place}": "y" * 500 for place in range(50)}, image=1)
    assert one is not None
    assert two is not None
    assert len(changed(one, two)) < 150
    assert changed(one, two).endswith("image 1 -> 2")
    few = history.commit({"a": 1, "b": 1, "c": 1, "d": 1, "e": 1})
    last = history.commit({"a": 2, "b": 2, "c": 2, "d": 2, "f": 2})
    assert few is not None
    assert last is not None
    assert changed(few, last) == "a 1 -> 2, b 1 -> 2, c 1 -> 2, and 3 more"


# -- as a table --------------------------------------------------------------------------------------------------


def test_a_history_is_a_table_by_number() -> None:
    history = History()
    history.commit({"lo": 70, "sigma": 1.5}, token="edges", compute_ms=2.5)
    history.commit({"lo": 90, "sigma": 1.5, "kernel": np.ones((2, 2))}, token="edges", compute_ms=3.5)
    frame = history.to_frame()
    assert isinstance(frame, pd.DataFrame)
    assert (frame.index.name, list(frame.index)) == ("number", [1, 2])
    assert list(frame.columns) == [
        "lo", "sigma", "kernel", "at", "token", "image", "compute_ms", "label", "picture",
    ]  # fmt: skip
    assert (frame["lo"].dtype, frame["sigma"].dtype) == (np.int64, np.float64)
    assert frame["kernel"][1] is None
    assert frame["kernel"][2].shape == (2, 2)
    assert frame["compute_ms"].sum() == 6.0


def test_values_of_several_types_keep_theirs_in_the_table() -> None:
    frame = committed(1, 2.5, True, None, "x", (1, 2), np.uint8(3)).to_frame()
    assert [type(value) for value in frame["k"]] == [int, float, bool, type(None), str, tuple, np.uint8]


def test_an_empty_history_is_an_empty_table() -> None:
    frame = History().to_frame()
    assert frame.shape == (0, 6)
    assert "picture" in frame._repr_html_()


def test_hyperparameters_called_like_the_other_columns_are_told_apart() -> None:
    history = History()
    history.commit({"label": 3, "label_": 4}, label="good")
    frame = history.to_frame()
    assert (frame["label"][1], frame["label_"][1], frame["label__"][1]) == (3, 4, "good")
    assert frame.columns.is_unique


def pictured(count: int) -> Any:
    history = History()
    for place in range(count):
        history.commit({"k": place, "<b>": "<script>alert(1)</script>"}, picture=thumbnail(place), label="<i>&")
    return history.to_frame()


def test_a_table_shows_its_thumbnails_and_escapes_all_else() -> None:
    html = pictured(3)._repr_html_()
    assert html.count('<img src="data:image/jpeg;base64,') == 3
    assert 'alt="picture of 2"' in html
    assert "<script>alert" not in html
    assert "<b>" not in html
    assert "<i>" not in html
    assert "&lt;script&gt;" in html


def test_parts_of_a_table_show_their_thumbnails_too() -> None:
    frame = pictured(6)
    for part, shown in (
        (frame.tail(2), 2), (frame[["k", "picture"]], 6), (frame[frame["k"] > 3], 2), (frame.sort_values("k"), 6),
        (frame.copy(), 6), (frame.loc[[3]], 1), (frame[["k"]], 0), (frame.reset_index(drop=True), 6),
    ):  # fmt: skip
        assert part._repr_html_().count("<img") == shown
    assert "<img" not in frame.groupby("label")[["k"]].mean()._repr_html_()


def test_a_long_table_is_cut_where_pandas_cuts_it() -> None:
    html = pictured(200)._repr_html_()
    assert html.count("<img") == pd.get_option("display.min_rows")
    assert "200 rows" in html


def test_a_table_is_small_even_if_all_rows_are_asked_for() -> None:
    frame = pictured(200)
    with pd.option_context("display.max_rows", None):
        html = frame._repr_html_()
    assert len(html) < 400_000
    assert 'alt="picture of 200"' in html
    assert 'alt="picture of 1"' not in html
    assert "(picture)" in html


def test_a_table_without_pictures_or_of_foreign_signs_is_shown() -> None:
    assert "<img" not in committed(1, 2).to_frame()._repr_html_()
    history = committed("\U000f0000", "\U000f0001 and \U000fffef")
    assert "<img" not in history.to_frame()._repr_html_()


def test_a_table_can_be_printed_copied_and_stored() -> None:
    frame = pictured(3)
    assert "\\xff" not in repr(frame)
    assert pickle.loads(pickle.dumps(frame)).equals(frame)
    assert copy.deepcopy(frame)._repr_html_().count("<img") == 3


def test_showing_a_table_leaves_it_as_it_is() -> None:
    frame = pictured(2)
    frame._repr_html_()
    assert all(isinstance(picture, Picture) for picture in frame["picture"])
