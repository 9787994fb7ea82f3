"""The check of a labelled set: which cases pass, the reasons of the others, and what is shown."""

from __future__ import annotations

import enum
import threading
import xml.etree.ElementTree as ET
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import cv2
import numpy as np
import pytest
from skimage import data

import epypes as ep
from epypes.acquisition import write_image
from epypes.batch.check import CheckResult, prepare_cases, run_checks
from epypes.errors import ScaleError, UnknownName


def above(image, level):
    return image > level


def area(mask):
    return int(mask.sum())


def corners(image):
    return cv2.FastFeatureDetector_create(40).detect(image)


@pytest.fixture
def runner():
    functions = {"above": above, "area": area, "corners": corners}
    io = {"above": (("image", "level"), "mask"), "area": ("mask", "n"), "corners": ("image", "points")}
    return ep.CompGraphRunner(ep.CompGraph(functions, io), {"level": 100})


@pytest.fixture(scope="module")
def coins():
    return data.coins()


def reasons(result):
    return {(outcome.case, outcome.check): outcome.reason for outcome in result.failures}


def test_a_set_passes_if_every_check_of_every_case_does(runner, coins, tmp_path):
    write_image(tmp_path / "coins.png", coins)
    write_image(tmp_path / "mask.png", coins > 100)
    runner.run(image=coins[:50])
    before = runner.last
    result = ep.check(
        runner,
        [
            ep.Case(tmp_path / "coins.png", {"mask": tmp_path / "mask.png"}, {"count": {"token": "points", "min": 10}}),
            ep.Case(
                coins, {"mask": coins > 90, "n": int((coins > 90).sum())}, hyperparameters={"level": 90}, name="90"
            ),
            ep.Case(coins),
        ],
    )
    assert result
    assert result.passed
    assert (str(result), repr(result)) == ("3 cases passed", "<CheckResult: 3 cases, all passed>")
    assert [(one.case, one.check) for one in result.outcomes] == [
        ("coins.png", "equal of mask"),
        ("coins.png", "count of points"),
        ("90", "equal of mask"),
        ("90", "equal of n"),
        ("#2", "runs"),
    ]
    assert runner.last is before
    assert runner["level"] == 100


def test_what_goes_wrong_in_a_case_fails_that_case_alone(runner, coins, tmp_path):
    def raises(value, expected):
        raise RuntimeError("out of order")

    def exits(value, expected):
        raise SystemExit(3)

    mask = coins > 100
    write_image(tmp_path / "broken.png", mask)
    (tmp_path / "broken.png").write_bytes(b"no image")
    result = ep.check(
        runner,
        [
            ep.Case(coins, {"mask": mask}, name="good"),
            ep.Case(coins, {"mask": mask[:9]}, name="shapes"),
            ep.Case(coins, {"mask": tmp_path / "none.png", "n": 3}, name="no file"),
            ep.Case(tmp_path / "broken.png", {"mask": mask}, name="no input"),
            ep.Case("text", name="fails"),
            ep.Case(
                coins,
                name="metrics",
                metrics={
                    "raises": {"metric": raises, "token": "n"},
                    "exits": {"metric": exits, "token": "n"},
                    "nan": {"metric": lambda run, case: float("nan"), "max": 1},
                    "text": {"metric": lambda run, case: "0.9", "max": 1},
                    "vague": {"metric": lambda run, case: 0.9},
                    "no": lambda run, case: np.bool_(False),
                    "key": {"metric": lambda run, case: run["mask"], "max": 1},
                    "kept": {"metric": lambda run, case: run["mask"].mean(), "max": 1, "keep": ["mask"]},
                },
            ),
        ],
    )
    found = reasons(result)
    assert result.cases == {
        "good": True,
        "shapes": False,
        "no file": False,
        "no input": False,
        "fails": False,
        "metrics": False,
    }
    assert found["shapes", "equal of mask"].startswith("The shapes differ: the value is bool 303 x 384")
    assert "none.png' can't be read: No such file" in found["no file", "equal of mask"]
    assert found["no file", "equal of n"] == f"expected 3, got {mask.sum()}"
    assert "broken.png' is not an image that OpenCV can read" in found["no input", "equal of mask"]
    assert "text" in found["fails", "runs"]
    assert found["metrics", "raises"] == "RuntimeError: out of order"
    assert found["metrics", "exits"] == "SystemExit: 3"
    assert found["metrics", "nan"] == "The metric is NaN."
    assert found["metrics", "text"] == "The metric returned a str, not a number. Return one."
    assert found["metrics", "vague"].endswith("there is no threshold. Give min or max, or return True.")
    assert found["metrics", "no"] == "the metric says False"
    assert found["metrics", "key"] == (
        "KeyError: no token 'mask' is kept. If the graph has it, give the metric keep=['mask']."
    )
    assert ("metrics", "kept") not in found
    assert str(result) == "5 of 6 cases failed: shapes, no file, no input, fails, metrics"


class Uncountable:
    """What can't be counted, for a reason without a word."""

    def __len__(self):
        raise AssertionError


@pytest.mark.parametrize("text", ["", " \n"])
def test_a_metric_that_raises_without_a_text_fails_and_is_an_error(text, tmp_path):
    def raises(run, case):
        raise MemoryError(text)

    runner = ep.CompGraphRunner(ep.CompGraph({"make": lambda n: Uncountable()}, {"make": ("n", "things")}))
    result = ep.check(runner, [ep.Case(1, metrics={"count": (1, 3), "mine": raises})])
    assert not result
    assert [(one.passed, one.reason, one.value) for one in result.outcomes] == [
        (False, "AssertionError", None),
        (False, "MemoryError", None),
    ]
    assert [one.error_info.kind for one in result.outcomes] == ["AssertionError", "MemoryError"]
    [suite] = ET.parse(result.to_junit(tmp_path / "checks.xml")).getroot()
    assert [suite.get(key) for key in ("tests", "failures", "errors")] == ["2", "0", "2"]
    assert [(error.get("type"), error.get("message")) for error in suite.iter("error")] == [
        ("AssertionError", "AssertionError"),
        ("MemoryError", "MemoryError"),
    ]


def test_inputs_may_be_files_of_arrays(runner, coins, tmp_path):
    np.save(tmp_path / "coins.npy", coins)
    mask = coins > 100
    assert ep.check(runner, [ep.Case(str(tmp_path / "coins.npy"), {"mask": mask}, name="a")])
    result = ep.check(runner, [ep.Case({"image": tmp_path / "none.npy"}, {"mask": mask}, name="b")])
    assert "none.npy' can't be read as an array" in reasons(result)["b", "equal of mask"]


class Side(enum.Enum):
    ABOVE = 1
    BELOW = 2


def test_a_file_names_a_member_of_the_enumeration_that_the_runner_has(tmp_path):
    cg = ep.CompGraph({"which": lambda x, side: side.value * x}, {"which": (("x", "side"), "y")})
    runner = ep.CompGraphRunner(cg, {"side": Side.ABOVE})
    path = tmp_path / "cases.toml"
    for member, passed in (("ABOVE", False), ("BELOW", True)):
        side = f'{{value = "{member}", kind = "enum", enum = "Side"}}'
        path.write_text(f"[[case]]\ninputs = 3\nhyperparameters = {{side = {side}}}\n[[case.check]]\nexpected = 6\n")
        assert bool(ep.check(runner, path)) is passed
    path.write_text(path.read_text().replace("BELOW", "BELLOW"))
    with pytest.raises(UnknownName, match="No member of Side 'BELLOW' for case '#0'. Did you mean 'BELOW'?"):
        ep.check(runner, path)


def test_a_function_that_fails_is_named(runner, coins):
    [outcome] = ep.check(runner, [ep.Case(np.zeros((2, 2, 2, 2)), {"n": 3})]).outcomes
    assert outcome.reason.startswith("corners: error: ")
    assert outcome.error_info.function == "corners"
    assert outcome.value is None


def test_a_number_on_the_threshold_passes_and_the_next_one_does_not(runner, coins):
    n = int((coins > 100).sum())

    def passes(low, high):
        return bool(ep.check(runner, [ep.Case(coins, metrics={"value": {"token": "n", "min": low, "max": high}})]))

    assert passes(n, n)
    assert not passes(n + 1, None)
    assert not passes(None, n - 1)


@pytest.mark.slow
def test_a_share_that_is_almost_one_does_not_read_as_one(runner):
    image = np.full((2000, 2000), 200, np.uint8)
    label = np.ones_like(image, bool)
    label[0, 0] = False
    close = {"token": "mask", "metric": "close"}
    result = ep.check(runner, [ep.Case(image, {"mask": label}, {"close": close, "equal": 1})])
    assert [one.reason for one in result.outcomes] == [
        "0.99999975 is not at least 1",
        "1 of 4000000 values differ",
    ]


@pytest.mark.slow
def test_threads_and_processes_say_the_same(runner, coins):
    masks = [coins > level for level in (100, 101)]
    cases = [ep.Case(coins, {"mask": mask}, {"count": {"token": "points", "min": 1}}) for mask in masks]
    cases.append(ep.Case(np.zeros((2, 2, 2, 2))))

    def seen(executor):
        result = ep.check(runner, cases, executor)
        return [(one.case, one.check, one.value, one.reason) for one in result.outcomes]

    here = seen(None)
    assert here[0][2] == 1.0
    with ThreadPoolExecutor(2) as threads:
        assert seen(threads) == here
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as processes:
        assert seen(processes) == here


def test_it_ends_when_it_is_told_to(runner, coins):
    stop = threading.Event()
    came = []
    for outcomes in run_checks(runner, prepare_cases(runner, [ep.Case(coins)] * 9), stop=stop):
        came += outcomes
        if len(came) == 2:
            stop.set()
    assert len(came) == 2


def test_what_the_runner_has_not_is_refused_before_anything_runs(runner, coins):
    with pytest.raises(UnknownName, match="No hyperparameter 'levle' for case 'a'. Did you mean 'level'?"):
        ep.check(runner, [ep.Case(coins, name="a", hyperparameters={"levle": 3})])
    with pytest.raises(UnknownName, match="Did you mean 'mask'"):
        ep.check(runner, [ep.Case(coins, {"maks": 3})])
    with pytest.raises(ScaleError, match="There are no cases"):
        ep.check(runner, [])
    with pytest.raises(ScaleError, match="imag"):
        ep.check(runner, [ep.Case({"imag": coins})])


# -- what is shown ----------------------------------------------------------------------------------------------


@pytest.fixture
def result(runner, coins):
    label = coins > 100
    label[100:150] = True
    cases = [
        ep.Case(coins, {"mask": label}, {"iou": 0.95}, name="a <b> & c"),
        ep.Case(coins, {"mask": coins > 100}, name="good"),
        ep.Case("none.png", {"n": 3}, name="missing"),
    ]
    return ep.check(runner, cases)


def test_the_table_has_a_row_per_check(result):
    frame = result.to_frame()
    assert list(frame.columns) == ["case", "check", "token", "value", "threshold", "passed", "failure", "run_ms"]
    assert frame["passed"].tolist() == [False, True, False]
    assert frame["value"].isna().tolist() == [False, False, True]
    assert "can't be read" in frame["failure"][2]
    assert frame["failure"][1] is None


def test_a_notebook_shows_what_was_expected_what_came_and_where_they_differ(result):
    page = result._repr_mimebundle_()["text/html"]
    assert page.index("a &lt;b&gt; &amp; c") < page.index("missing") < page.index("good")
    assert page.count("✗") == 2
    assert [f'alt="{name} of a &lt;b&gt; &amp; c' in page for name in ("expected", "got", "difference")] == [True] * 3
    assert 'alt="got of good' in page
    assert 'alt="expected of good' not in page
    assert 1_000 < len(page) < 120_000


def test_one_pixel_that_differs_is_seen_in_the_picture_of_the_difference(runner):
    image = np.zeros((3000, 2000), np.uint8)
    label = np.zeros(image.shape, bool)
    label[1234, 567] = True
    [outcome] = ep.check(runner, [ep.Case(image, {"mask": label})]).outcomes
    picture = cv2.imdecode(np.frombuffer(outcome.pictures["difference"].data, np.uint8), cv2.IMREAD_COLOR)
    blue, _, red = (picture[..., channel].astype(int) for channel in range(3))
    assert ((blue - red) > 50).any()


@pytest.mark.slow
def test_many_failures_stay_a_small_page(runner, coins):
    label = np.random.default_rng(1).integers(0, 2, coins.shape, np.uint8) * 255
    result = ep.check(runner, [ep.Case(coins, {"mask": label}, name=f"case {number}") for number in range(120)])
    page = result._repr_mimebundle_()["text/html"]
    assert len(page) < 150_000
    assert "and 20 more: to_frame() has all of them" in page


def test_junit_says_what_failed_what_could_not_be_measured_and_how_long_it_took(result, tmp_path):
    path = result.to_junit(tmp_path / "checks.xml", name="coins")
    root = ET.parse(path).getroot()
    [suite] = root
    assert (root.tag, suite.tag, suite.get("name")) == ("testsuites", "testsuite", "coins")
    assert [suite.get(key) for key in ("tests", "failures", "errors")] == ["3", "1", "1"]
    first, good, missing = suite
    assert (first.tag, first.get("classname"), first.get("name")) == ("testcase", "a <b> & c", "iou of mask")
    [failure] = first
    assert failure.tag == "failure"
    assert failure.get("message").endswith("is not at least 0.95")
    assert "wanted at least 0.95" in failure.text
    assert list(good) == []
    [error] = missing
    assert (error.tag, error.get("type")) == ("error", "ImageFileError")
    total_s = sum({one.number: one.total_ns for one in result.outcomes}.values()) / 1e9
    times_s = [float(test.get("time")) for test in suite]
    assert float(suite.get("time")) == pytest.approx(total_s, abs=0.002) == pytest.approx(sum(times_s), abs=0.002)


def test_junit_is_xml_whatever_a_name_or_a_message_holds(runner, coins, tmp_path):
    def raises(run, case):
        raise ValueError("\x00\x1b[31m\ud800")

    result = ep.check(runner, [ep.Case(coins, metrics={"\x01m": {"metric": raises, "min": 1}}, name="a\x02")])
    path = result.to_junit(tmp_path / "checks.xml")
    [case] = ET.parse(path).getroot().iter("testcase")
    assert case.get("classname") == "a\ufffd"


def test_junit_that_can_t_be_written_is_told(result, tmp_path):
    with pytest.raises(ScaleError, match="can't be written: No such file or directory. Name another file"):
        result.to_junit(tmp_path / "none" / "checks.xml")


def test_a_result_of_nothing_that_failed_is_true():
    assert CheckResult(())


def found_above(image, level):
    return image > level if (image > level).any() else ep.Nothing


def test_a_check_of_nothing_passes_where_nothing_is_expected_and_falls_short_elsewhere(coins):
    runner = ep.CompGraphRunner(
        ep.CompGraph({"above": found_above}, {"above": (("image", "level"), "mask")}), {"level": 254}
    )
    result = ep.check(
        runner,
        [
            ep.Case(coins, {"mask": ep.Nothing}, {"count": {"token": "mask", "max": 0}}, name="none"),
            ep.Case(coins, {"mask": coins > 100}, {"iou": {"token": "mask", "min": 0.5}}, name="some"),
            ep.Case(coins, {"mask": ep.Nothing}, hyperparameters={"level": 100}, name="too many"),
        ],
    )
    assert result.cases == {"none": True, "some": False, "too many": False}
    assert reasons(result)["some", "iou of mask"] == "nothing was found of 'mask'"
    assert all(outcome.error_info is None for outcome in result.failures)
    assert "nothing was found" in result._repr_mimebundle_()["text/html"]
