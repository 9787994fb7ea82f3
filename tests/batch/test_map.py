"""Maps: their values, their order, and what is kept and stored of them."""

from __future__ import annotations

import base64
import gc
import os
import re
import subprocess
import sys
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import ScaleError, UnknownName
from tests.calls import log_to


def brightness(image):
    if image.ndim != 2:
        raise ValueError("grey only")
    return float(image.mean())


@pytest.fixture
def bright():
    return ep.CompGraphRunner(ep.CompGraph({"mean": brightness}, {"mean": ("image", "brightness")}))


def values(result, token="brightness"):
    return [outcome.values.get(token) for outcome in result]


def without_times(result):
    return [replace(outcome, times_ns={}, total_ns=0) for outcome in result]


def test_a_folder_becomes_a_table_with_times_and_failures_as_rows(folder, runner):
    (folder / "crop3.png").write_bytes(b"no image")
    result = ep.map(runner, folder)
    frame = result.to_frame()
    assert frame["name"].tolist() == [f"crop{number}.png" for number in range(12)]
    assert list(frame.columns[:4]) == ["name", "failure", "edge_pixels", "keypoints"]
    assert list(frame.columns[4:]) == ["total_ms", "gray ms", "canny ms", "count ms", "corners ms"]
    assert "is not an image" in frame["failure"][3]
    assert frame["failure"].drop(3).tolist() == [None] * 11
    assert ep.map(runner, folder / "crop0.png").to_frame()["failure"].tolist() == [None]
    assert [outcome.name for outcome in result.failures] == ["crop3.png"]
    assert (frame["gray ms"].drop(3) > 0).all()
    assert len(result) == 12
    assert result[4].name == "crop4.png"


def test_values_are_those_of_straight_line_code(runner, crops):
    expected = [int((cv2.Canny(cv2.cvtColor(crop, cv2.COLOR_BGR2GRAY), 70, 200) > 0).sum()) for crop in crops]
    assert values(ep.map(runner, crops), "edge_pixels") == expected


def test_the_runner_is_left_as_it_was(runner, crops):
    before = runner.run(image=crops[0])
    ep.map(runner, crops[1:])
    assert runner.last is before
    assert len(runner.reports) == 1


def test_images_of_other_shapes_are_rows_that_say_so(bright):
    result = ep.map(bright, [np.ones((2, 2)), np.ones((2, 2, 3)), np.ones((7, 3))])
    assert values(result) == [1.0, None, 1.0]
    assert result[1].error_info.function == "mean"
    assert result[1].error_info.message == "grey only"


@pytest.mark.slow
@pytest.mark.parametrize("threads", [0, 2])
def test_a_long_set_is_never_in_memory_as_a_whole(bright, threads):
    alive, most = set(), 0

    def frames():
        nonlocal most
        for number in range(2000):
            frame = np.full((600, 500), number % 7, np.uint8)
            alive.add(number)
            weakref.finalize(frame, alive.discard, number)
            most = max(most, len(alive))
            yield frame
            del frame

    gc.disable()
    try:
        if threads:
            with ThreadPoolExecutor(threads) as pool:
                result = ep.map(bright, frames(), pool)
        else:
            result = ep.map(bright, frames())
    finally:
        gc.enable()
    assert values(result) == [float(number % 7) for number in range(2000)]
    # Four jobs of 4 MB, and one that is being made.
    assert most <= (3 if not threads else 80)


def test_an_unknown_token_is_refused_before_anything_is_run(bright):
    with pytest.raises(UnknownName, match="brightness"):
        ep.map(bright, [np.ones((2, 2))], keep=["brightnes"])


def test_an_empty_set_is_refused(bright, tmp_path):
    with pytest.raises(ScaleError, match="There are no images"):
        ep.map(bright, tmp_path)
    with pytest.raises(ScaleError, match="gave nothing"):
        ep.map(bright, iter(()))


def test_the_bar_counts_images_and_failures(bright, capsys):
    ep.map(bright, [np.ones((2, 2)), np.ones(3)], progress=True)
    told = capsys.readouterr().err
    assert "2/2" in told
    assert "failed=1" in told
    ep.map(bright, [np.ones((2, 2))])
    assert capsys.readouterr().err == ""


def test_it_shows_itself_as_a_table_with_failures_marked(runner, crops):
    result = ep.map(runner, [crops[0], crops[1][..., 0]], show=["edges"])
    html = result._repr_mimebundle_()["text/html"]
    assert "2 images, 1 failed" in html
    assert html.count("data:image/png;base64,") == 1
    assert "\u2717 gray: error" in html
    assert repr(result) == "<MapResult: 2 images, 1 failed>"


@pytest.mark.slow
def test_many_rows_with_thumbnails_stay_small(runner, crops):
    result = ep.map(runner, crops * 10, show=None)
    html = result._repr_mimebundle_()["text/html"]
    assert len(html) < 120_000
    assert "and 20 more: to_frame() has all of them" in html
    assert "pictures more, for which there is no room here" in html


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 12, 60, 100])
def test_every_row_has_its_thumbnail_smaller_where_there_are_many(runner, count):
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (90, 120, 3), dtype=np.uint8) for _ in range(count)]
    html = ep.map(runner, noise, show=["image"])._repr_mimebundle_()["text/html"]
    shown = re.findall('src="data:(image/[a-z]+);base64,([^"]*)"', html)
    assert len(shown) == count
    assert sum(len(data) for _, data in shown) <= 80_000
    assert ({kind for kind, _ in shown} == {"image/webp"}) == (count > 12)
    side = max(cv2.imdecode(np.frombuffer(base64.b64decode(shown[-1][1]), np.uint8), 1).shape)
    assert side >= 32


# -- going on ---------------------------------------------------------------------------------------------------


@pytest.fixture
def calls():
    return []


@pytest.fixture
def noted(calls):
    """A runner whose function notes what it was called with; the first call with 66 is interrupted."""

    def listen(level):
        calls.append(level)
        if calls.count(66) == 1 and level == 66:
            raise KeyboardInterrupt

    logger = log_to(listen)

    def note(image, factor):
        logger.info(int(image.flat[0]))
        return float(image.mean() * factor)

    return ep.CompGraphRunner(ep.CompGraph({"note": note}, {"note": (("image", "factor"), "out")}), {"factor": 2})


def levels(*numbers):
    return [np.full((2, 2), number) for number in numbers]


def test_an_interrupted_map_goes_on_where_it_was(noted, calls, tmp_path):
    store, images = tmp_path / "results.sqlite", levels(1, 2, 66, 3)
    with pytest.raises(KeyboardInterrupt):
        ep.map(noted, images, store=store, name="levels")
    assert calls == [1, 2, 66]
    result = ep.map(noted, images, store=store, name="levels")
    assert calls == [1, 2, 66, 66, 3]
    assert values(result, "out") == [2.0, 4.0, 132.0, 6.0]
    calls.clear()
    again = ep.map(noted, images, store=store, name="levels")
    assert calls == []
    assert list(again) == list(result)


def test_images_that_came_later_are_run_and_others_are_not(runner, folder, crops, tmp_path):
    before = ep.map(runner, folder, store=tmp_path / "r.sqlite")
    cv2.imwrite(str(folder / "crop2b.png"), crops[0])
    cv2.imwrite(str(folder / "crop5.png"), crops[0])
    after = ep.map(runner, folder, store=tmp_path / "r.sqlite")
    assert [outcome.name for outcome in after][2:5] == ["crop2.png", "crop2b.png", "crop3.png"]
    assert [outcome.number for outcome in after] == list(range(13))
    known = {outcome.name: outcome for outcome in before}
    same = {
        outcome.name
        for outcome in after
        if replace(outcome, number=0) == replace(known.get(outcome.name, outcome), number=0)
    }
    assert after[6].name == "crop5.png"
    assert after[6].total_ns != before[5].total_ns
    assert "crop4.png" in same


def test_other_hyperparameters_are_another_series(noted, calls, tmp_path):
    ep.map(noted, levels(1), store=tmp_path / "r.sqlite", name="a")
    noted["factor"] = 3
    with pytest.raises(ScaleError, match="Series 'a' in the store is of another computation: factor was 2 and is 3"):
        ep.map(noted, levels(1), store=tmp_path / "r.sqlite", name="a")
    assert values(ep.map(noted, levels(1), store=tmp_path / "r.sqlite", name="b"), "out") == [3.0]


def test_a_series_that_was_looked_for_before_is_not_of_another_computation(noted, calls, tmp_path):
    with ep.Store(tmp_path / "r.sqlite") as store:
        assert store.series("map", "a").to_frame().empty
        ep.map(noted, levels(1), store=store, name="a")
        ep.map(noted, levels(1, 2), store=store, name="a")
        assert len(store.series("map", "a")) == 2
    assert calls == [1, 2]


def test_without_a_name_the_graph_and_its_hyperparameters_name_the_series(runner, crops, tmp_path):
    with ep.Store(tmp_path / "r.sqlite") as store:
        ep.map(runner, crops[:1], store=store)
        ep.map(runner, crops[:2], store=store)
        runner["canny_lo"] = 10
        ep.map(runner, crops[:1], store=store)
        first, second = (store.series("map", name) for name in store.names("map"))
        assert sorted((len(first), len(second))) == [1, 2]


def test_a_function_without_source_needs_no_name(tmp_path):
    for factor in (1, 2, 1):
        typed = {"__name__": "__main__"}
        exec(f"def scaled(image):\n    return float(image.mean()) * {factor}\n", typed)
        runner = ep.CompGraphRunner(ep.CompGraph({"scaled": typed["scaled"]}, {"scaled": ("image", "out")}))
        assert values(ep.map(runner, levels(4), store=tmp_path / "r.sqlite"), "out") == [4.0 * factor]
    with ep.Store(tmp_path / "r.sqlite") as store:
        assert sorted(len(store.series("map", name)) for name in store.names("map")) == [1, 1]


def read_with_open(image):
    with open("gain.txt") as file:
        return float(image.mean()) * float(file.read())


def read_with_pathlib(image):
    return float(image.mean()) * float(Path("gain.txt").read_text())


def read_with_numpy(image):
    return float(image.mean()) * float(np.loadtxt("gain.txt"))


def read_the_environment(image):
    return float(image.mean()) * float(os.environ["GAIN"])


def read_a_variable(image):
    return float(image.mean()) * float(os.getenv("GAIN", "1"))


def gain_of_the_environment():
    return read_the_environment(np.ones(1))


def read_in_a_helper(image):
    return float(image.mean()) * gain_of_the_environment()


READERS = [
    read_with_open, read_with_pathlib, read_with_numpy, read_the_environment, read_a_variable, read_in_a_helper
]  # fmt: skip


@pytest.mark.parametrize("function", READERS)
def test_rows_of_a_function_that_reads_files_or_the_environment_are_reused_under_a_name_alone(
    function, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    runner = ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": ("image", "out")}))

    def mapped(gain, **options):
        (tmp_path / "gain.txt").write_text(str(gain))
        monkeypatch.setenv("GAIN", str(gain))
        return values(ep.map(runner, levels(1), store=tmp_path / "r.sqlite", **options), "out")

    for gain in (2, 5):
        with pytest.warns(UserWarning, match=r"reads files or the environment .* run again. .* give name="):
            assert mapped(gain) == [gain]
    assert [mapped(gain, name="by hand") for gain in (7, 8)] == [[7.0], [7.0]]


def test_arrays_are_compared_by_content(noted, calls, tmp_path):
    ep.map(noted, levels(1, 2), store=tmp_path / "r.sqlite", name="a")
    result = ep.map(noted, levels(2, 5), store=tmp_path / "r.sqlite", name="a")
    assert values(result, "out") == [4.0, 10.0]


def test_whole_values_are_not_in_the_store_so_they_are_computed_again(noted, calls, tmp_path):
    ep.map(noted, levels(1), store=tmp_path / "r.sqlite", name="a")
    result = ep.map(noted, levels(1), store=tmp_path / "r.sqlite", name="a", keep=["out"])
    assert calls == [1, 1]
    assert result[0].kept == {"out": 2.0}


def test_a_file_that_was_missing_is_tried_again(runner, folder, crops, tmp_path):
    files = [folder / "later.png"]
    assert ep.map(runner, files, store=tmp_path / "r.sqlite").failures
    with ep.Store(tmp_path / "r.sqlite") as store:
        (name,) = store.names("map")
        assert not store.series("map", name).keys()
    cv2.imwrite(str(files[0]), crops[0])
    assert not ep.map(runner, files, store=tmp_path / "r.sqlite").failures


def brightest(image, minimum):
    return int(image.max()) if image.max() >= minimum else ep.Nothing


def outline(image, peak):
    return image > peak / 2


def test_where_nothing_was_found_the_cell_is_empty_and_nothing_has_failed():
    cg = ep.CompGraph(
        {"brightest": brightest, "outline": outline},
        {"brightest": (("image", "minimum"), "peak"), "outline": (("image", "peak"), "mask")},
    )
    with_peak = ep.extend(cg, {"same": abs}, {"same": ("peak", "level")})
    images = [np.full((8, 8), level, np.uint8) for level in (40, 200, 250)]
    for executor in (None, ThreadPoolExecutor(2)):
        result = ep.map(ep.CompGraphRunner(with_peak, {"minimum": 100}), images, executor=executor)
        frame = result.to_frame()
        assert frame["failure"].tolist() == [None] * 3
        assert (str(frame["level"].dtype), frame["level"].mean(), frame["level"].isna().tolist()) == (
            "Int64",
            225,
            [True, False, False],
        )
        assert frame["outline ms"].isna().tolist() == [True, False, False]
        assert [outcome.nothing for outcome in result] == [("mask", "level"), (), ()]
        html = result._repr_mimebundle_()["text/html"]
        assert html.count("nothing found") >= 1


def test_a_stored_outcome_still_says_that_nothing_was_found(tmp_path):
    cg = ep.CompGraph({"brightest": brightest}, {"brightest": (("image", "minimum"), "peak")})
    images = [np.full((8, 8), level, np.uint8) for level in (40, 200)]
    runner = ep.CompGraphRunner(cg, {"minimum": 100})
    first, again = (ep.map(runner, images, store=tmp_path / "results.db", name="peaks") for _ in range(2))
    assert [outcome.nothing for outcome in again] == [outcome.nothing for outcome in first] == [("peak",), ()]
    assert values(again, "peak") == [None, 200]


@pytest.mark.slow  # another interpreter
@pytest.mark.parametrize("module", ["page", "vertices", "style"])
def test_an_import_that_ctrl_c_has_ended_can_be_repeated(module):
    program = f"""
import sys

class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == "epypes.display.paint.{module}" and self in sys.meta_path:
            sys.meta_path.remove(self)
            raise KeyboardInterrupt

sys.meta_path.insert(0, CtrlC())
import epypes as ep

try:
    ep.map
except KeyboardInterrupt:
    print(ep.map.__name__)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (ended.stdout, ended.stderr) == ("map_images\n", "")


def test_a_failure_inside_a_pipeline_names_the_function_there_and_the_cause():
    inner = ep.CompGraph(
        {"find": lambda gray: None, "count": lambda corners: corners.size},
        {"find": ("gray", "corners"), "count": ("corners", "n")},
    )
    outer = ep.CompGraph({"geometry": ep.Pipeline("geometry", inner)}, {"geometry": ("image", "n")})
    failed = ep.map(ep.CompGraphRunner(outer), [np.ones((8, 8), np.uint8)])[0].error_info
    assert (failed.function, failed.kind) == ("geometry", "AttributeError")
    assert failed.message.startswith("in 'count': corners is None, made by function 'find'.")
