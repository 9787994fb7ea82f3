"""Cases of a labelled set, in Python and in CASES.toml: their checks, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

import epypes as ep
from epypes.acquisition import write_image
from epypes.batch.cases import cases_of, checks_of, with_labels_read
from epypes.batch.items import read_value
from epypes.errors import ScaleError, UnknownName

CG = ep.CompGraph(
    {"cut": lambda image, level: image > level, "count": lambda mask: int(mask.sum())},
    {"cut": (("image", "level"), "mask"), "count": ("mask", "n")},
)


def checks(*given, **parts):
    return checks_of(ep.Case(*given, **parts), CG)


def test_what_is_expected_must_be_equal_unless_a_metric_looks_at_it():
    mask = np.eye(3, dtype=bool)
    [first, second] = checks(0, {"mask": mask, "n": 3}, {"iou": {"token": "mask", "min": 0.5}})
    assert (first.name, first.token, first.metric, first.threshold) == ("equal of n", "n", "equal", "at least 1")
    assert (second.name, second.token, second.threshold) == ("iou of mask", "mask", "at least 0.5")
    assert second.expected is mask


@pytest.mark.parametrize(
    ("name", "spec", "threshold"),
    [
        ("iou", 0.9, "at least 0.9"),
        ("mean_abs_difference", 2, "at most 2"),
        ("value", (100, 300), "at least 100, at most 300"),
        ("value", (None, 300), "at most 300"),
        ("close", {"atol": 1}, "at least 1"),
        ("mine", {"metric": "iou", "max": 0.5}, "at most 0.5"),
        ("mine", lambda run, case: True, ""),
        ("mine", {"metric": lambda run, case: 1, "min": 0}, "at least 0"),
    ],
)
def test_a_threshold_is_said_in_one_of_these_ways(name, spec, threshold):
    [check] = checks(0, {"mask": np.eye(3)}, {name: spec})[-1:]
    assert check.threshold == threshold


def test_a_metric_without_a_token_looks_at_what_is_expected_or_at_the_one_sink_token():
    assert [check.token for check in checks(0, {"mask": np.eye(3)}, {"iou": 0.9})] == ["mask"]
    assert [check.token for check in checks(0, metrics={"value": (0, 9)})] == ["n"]
    with pytest.raises(ScaleError, match="does not say which token it looks at. Give token, one of: 'mask', 'n'"):
        checks(0, {"mask": 1, "n": 2}, {"iou": 0.9})


def test_an_expected_of_its_own_is_that_of_the_one_sink_token():
    [equal_of_mask, check] = checks(0, {"mask": 1}, {"mine": {"metric": "equal", "expected": 5}})
    assert (equal_of_mask.token, equal_of_mask.expected) == ("mask", 1)
    assert (check.token, check.expected) == ("n", 5)


def test_what_is_expected_must_be_equal_unless_a_metric_compares_it():
    for metric, names in (("value", ["equal of n", "value of n"]), ("close", ["close of n"])):
        case = ep.Case(0, {"n": 999}, {metric: {"token": "n", "min": 1}})
        assert [check.name for check in checks_of(case, CG)] == names
        assert f": {len(names)} check" in repr(case)
    found = checks(0, {"n": 999}, {"mine": {"metric": lambda value, expected: True, "token": "n"}})
    assert [check.name for check in found] == ["mine"]


@pytest.mark.parametrize("metric", ["value", "count"])
def test_a_metric_that_compares_nothing_takes_no_expected(tmp_path, metric):
    said = f"compares nothing: '{metric}' takes no expected. Leave it out, or take a metric that compares: equal, close"
    with pytest.raises(ScaleError, match=said):
        ep.Case(0, metrics={"mine": {"metric": metric, "token": "n", "expected": 999, "min": 1}})
    with pytest.raises(ScaleError, match=f"cases.toml, line 1: .*{said}"):
        read(tmp_path, f'[[case]]\ninputs = 1\n[[case.check]]\nexpected = 999\nmetric = "{metric}"\nmin = 1\n')


@pytest.mark.parametrize(
    ("metrics", "error", "said"),
    [
        ({"iuo": 0.9}, UnknownName, "No metric 'iuo' for case 'left'. Did you mean 'iou'?"),
        ({"iou": {"mni": 0.9}}, UnknownName, "No key 'mni' for metric 'iou' of case 'left'. Did you mean 'min'?"),
        ({"iou": {"atol": 1, "min": 0}}, UnknownName, "No key 'atol' for metric 'iou'"),
        ({"iou": {}}, ScaleError, "Metric 'iou' of case 'left' has no threshold. Give min, max or both."),
        ({"count": 3}, ScaleError, "'count' of case 'left' needs a pair"),
        ({"value": (3, 1)}, ScaleError, "has min 3, which is more than max 1"),
        ({"iou": float("nan")}, ScaleError, "min of metric 'iou' of case 'left' is nan, which is no number"),
        ({"iou": True}, ScaleError, "is a 'bool'. Give a number, a pair"),
        ({"iou": {"metric": ["iou"], "min": 1}}, UnknownName, "No metric"),
        ([1], ScaleError, "metrics of case 'left' must be a dict, not 'list'"),
    ],
)
def test_a_case_that_says_something_else_is_refused_where_it_is_made(metrics, error, said):
    with pytest.raises(error) as refused:
        ep.Case(0, metrics=metrics, name="left")
    assert said in str(refused.value)


def test_a_token_that_the_graph_has_not_is_refused_with_the_nearest():
    with pytest.raises(UnknownName, match="Did you mean 'mask'"):
        checks(0, {"maks": 1})
    with pytest.raises(UnknownName, match="Did you mean 'mask'"):
        checks(0, metrics={"value": {"token": "maks", "min": 1}})
    with pytest.raises(UnknownName, match="Did you mean 'mask'"):
        checks(0, metrics={"mine": {"metric": lambda run, case: 1, "min": 1, "keep": ["maks"]}})
    with pytest.raises(ScaleError, match="Metric 'iou' of a case has nothing to compare 'n' with"):
        checks(0, metrics={"iou": {"token": "n", "min": 1}})


def test_a_metric_of_the_run_gets_the_sink_tokens_and_what_it_keeps():
    [check] = checks(0, metrics={"mine": {"metric": lambda run, case: 1, "min": 1, "keep": "mask"}})
    assert check.keep == ("n", "mask")
    assert check.token is None


def test_cases_have_names_that_no_other_has():
    given = ["a/x.png", {"image": "b/x.png"}, ep.Case(3, name="x.png"), {"inputs": 4, "name": "four"}, np.ones(3)]
    assert [case.name for case in cases_of(given)] == ["x.png", "x.png (2)", "x.png (3)", "four", "#4"]


def test_no_cases_and_what_is_no_list_of_them_are_refused():
    with pytest.raises(ScaleError, match="There are no cases. Give at least one: ep.Case"):
        cases_of([])
    for single in (ep.Case(3), {"image": 3}, 3):
        with pytest.raises(ScaleError, match="cases is a list of cases or the path of a file of them, not a single"):
            cases_of(single)


# -- files ------------------------------------------------------------------------------------------------------


def test_files_of_what_is_expected_are_read_when_they_are_asked_for(tmp_path):
    image = np.random.default_rng(2).integers(0, 255, (4, 5, 3), np.uint8)
    write_image(tmp_path / "a.png", image)
    np.save(tmp_path / "b.npy", image)
    np.savez(tmp_path / "c.npz", image)
    np.savez(tmp_path / "d.npz", one=image, two=image + 1)
    for name in ("a.png", "b.npy", "c.npz"):
        assert np.array_equal(read_value(str(tmp_path / name), CG, "mask"), image)
    assert np.array_equal(read_value(tmp_path / "d.npz", CG, "mask")["two"], image + 1)
    case = ep.Case(0, {"mask": tmp_path / "b.npy", "n": 3})
    assert np.array_equal(with_labels_read(case, CG).expected["mask"], image)
    assert read_value("a text", CG, "mask") == "a text"


@pytest.mark.parametrize(
    ("name", "content"), [("none.npy", None), ("text.npy", b"text"), ("text.npz", b"PK text"), ("empty.npy", b"")]
)
def test_a_file_that_is_no_array_is_refused(tmp_path, name, content):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ScaleError, match=f"{name}' can't be read as an array: .* Check the path"):
        read_value(tmp_path / name, CG, "mask")


def test_a_pickle_is_never_read(tmp_path):
    np.save(tmp_path / "objects.npy", np.array([{}, []], object), allow_pickle=True)
    with pytest.raises(ScaleError, match="can't be read as an array"):
        read_value(tmp_path / "objects.npy", CG, "mask")


# -- CASES.toml -------------------------------------------------------------------------------------------------


def read(tmp_path, text):
    path = tmp_path / "cases.toml"
    path.write_text(text)
    return cases_of(path)


def test_a_file_of_cases_says_what_goes_in_and_what_must_come_out(tmp_path):
    [left, right] = read(
        tmp_path,
        """
        [[case]]
        name = "left"
        inputs = {image = "left.png", text = "stands for itself", k = 3}
        hyperparameters = {level = 9, size = {value = [3, 5], kind = "tuple"}}
        [[case.check]]
        token = "mask"
        expected = "left_mask.png"
        metric = "iou"
        min = 0.9
        [[case.check]]
        token = "n"
        metric = "value"
        min = 100
        max = 300
        [[case.check]]
        token = "n"
        expected = 4

        [[case]]
        inputs = "sub/right.png"
        """,
    )
    assert left.inputs == {"image": tmp_path / "left.png", "text": "stands for itself", "k": 3}
    assert left.hyperparameters == {"level": 9, "size": (3, 5)}
    found = [(check.name, check.token, check.threshold, check.expected) for check in checks_of(left, CG)]
    assert found[0] == ("iou of mask", "mask", "at least 0.9", tmp_path / "left_mask.png")
    assert found[1][:3] == ("value of n", "n", "at least 100, at most 300")
    assert found[2] == ("equal of n", "n", "at least 1", 4)
    assert (right.name, right.inputs) == ("right.png", tmp_path / "sub" / "right.png")
    assert checks_of(right, CG) == ()


def test_a_check_without_a_token_is_of_the_one_sink_token_whatever_others_of_its_case_expect(tmp_path):
    other = '[[case]]\ninputs = 1\n[[case.check]]\ntoken = "mask"\nexpected = 2\n'
    [case] = read(tmp_path, f"{other}[[case.check]]\nexpected = 3\n")
    assert [(check.token, check.expected) for check in checks_of(case, CG)] == [("mask", 2), ("n", 3)]
    [case] = read(tmp_path, f'{other}[[case.check]]\nmetric = "iou"\nmin = 0.5\n')
    with pytest.raises(ScaleError, match="has nothing to compare 'n' with. Give it expected"):
        checks_of(case, CG)


def test_two_checks_of_one_metric_and_token_are_both_made(tmp_path):
    check = '[[case.check]]\ntoken = "n"\nmin = 1\n'
    [case] = read(tmp_path, f"[[case]]\ninputs = 1\n{check}{check}{check}name = 'mine'\n")
    assert [check.name for check in checks_of(case, CG)] == ["value of n", "value of n (2)", "mine"]


def test_every_mistake_in_a_file_is_told_with_its_line_and_case(tmp_path):
    with pytest.raises(ScaleError) as refused:
        read(
            tmp_path,
            """cse = 1
[[case]]
name = "left"
inputs = 1
[[case.check]]
token = "n"
metrc = "iou"

[[case]]
name = "right"
input = 3
[[case]]
inputs = 3
check = 3
[[case]]
[[case]]
inputs = 1
hyperparameters = 3
[[case]]
inputs = 1
name = 3
[[case]]
inputs = 1
hyperparameters = {k = {value = 3, kind = "tupel"}}
""",
        )
    told = str(refused.value)
    assert "No key 'cse' in cases.toml. Did you mean 'case'?" in told
    assert "cases.toml, line 2: No key 'metrc' for metric 'value of n' of case 'left'. Did you mean 'metric'?" in told
    assert "cases.toml, line 9: No key 'input' in case 'right'. Did you mean 'inputs'?" in told
    assert "cases.toml, line 12: The checks in this case are tables: [[case.check]]." in told
    assert "cases.toml, line 15: There are no inputs in this case." in told
    assert "cases.toml, line 16: hyperparameters of a case must be a dict, not 'int'." in told
    assert "cases.toml, line 22: Hyperparameter 'k' can't be read: no value has the kind 'tupel'. Write it as" in told
    assert "cases.toml, line 19: The name of a case is a text, not 3." in told


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no cases. Write one: [[case]]"),
        ("case = 3", "has no cases"),
        ("[[case]", "is not TOML"),
    ],
)
def test_a_file_without_cases_is_refused(tmp_path, text, said):
    with pytest.raises(ScaleError) as refused:
        read(tmp_path, text)
    assert said in str(refused.value)


def test_a_file_that_can_t_be_read_is_refused(tmp_path):
    with pytest.raises(match="There is no file"):
        cases_of(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(match="can't be read"):
        cases_of(tmp_path / "bytes.toml")


def test_a_folder_of_images_is_no_set_of_cases_and_what_is_one_is_said(tmp_path):
    for given in (tmp_path, str(tmp_path)):
        with pytest.raises(ScaleError, match=r"is a folder. Give the path of a CASES.toml, or a list .*ep.Case\("):
            cases_of(given)
