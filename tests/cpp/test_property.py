"""What is translated computes what Python computes, to the last bit: known differences, usual functions, random ones."""

from __future__ import annotations

import gzip
import re

import pytest

import epypes as ep
from epypes.errors import BundleError
from tests.cpp import differences, vision
from tests.cpp.building import bundle_of, each_alone, export_and_replay, replay
from tests.cpp.random_functions import HELPERS, call, functions

# They compile. What NumPy warns of, such as numbers that wrap, is what is compared.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]

QUICKLY = ("-DCMAKE_BUILD_TYPE=Debug",)
# What C++ leaves undefined ends the replay.
CHECKED = (*QUICKLY, "-DCMAKE_CXX_FLAGS=-fsanitize=undefined,address -fno-sanitize-recover -D_GLIBCXX_ASSERTIONS")
# Arrays of int64 or of float64, for which a token of C++ has no type.
OF_SEVERAL_TYPES = ("peaks",)
# OpenCV 4.6 computes something else than the one of Python: test_examples shows that it is the version.
OTHER_IN_4_6 = ("drawn_boxes", "rotated")
# Integers of Python have no end: C++ raises where it can't hold one.
TOO_LARGE = "an integer has more than 64 bits"
# What can't be seen when a function is translated is found when it runs.
RAISES = ("growing",)
# What many graphs have. Others have several items, of which one has no translation.
TRANSLATED = [
    "added_in_a_loop_over_itself", "argument_of_either_sign", "array_division", "array_of_either_kind", "astype_wraps", "augmented_float", "backwards", "bits",
    "boxes_of_contours", "calculated_of_transposed", "centre_of_mass", "chained", "changed_bound", "changed_loop_variable", "channels", "circles",
    "cleaned", "clipped_to_nan", "compared_out_of_range", "compared_sums", "compared_types", "components", "contours",
    "corner_points", "cut_out", "drawn_boxes", "drawn_on_a_copy", "drifting", "drifting_branch", "drifting_while", "early_return", "empty", "enclosing_circle", "extremes_of_two_types",
    "float_floor_division", "focus_map", "forever", "from_above", "growing", "half_size", "hough_lines", "integers_of_pixels",
    "iou", "keywords", "large", "last_of_loop", "masked_assignment", "masked_rows", "matched_template", "minus_of_sum",
    "moving_threshold", "negative_index", "none_of_opencv", "numbers_of_int64", "outputs_of_opencv", "overflow_uint8", "overlapping",
    "polygon_corners", "promoted", "reshaped", "reshaped_columns", "returned_views", "rotated", "rounded", "row_of_copy", "rows_of_helper", "saturated",
    "scalars_of_numpy", "several_names", "shape_and_size", "share_of_colour", "sharpness", "shifts", "slices", "straight_parts",
    "sum_of_bools",
    "sum_of_mask", "sum_of_uint8", "sums_of_columns", "swapped", "ternary_of_two_types", "true_division",
    "truncated_points", "truth", "two_lists", "unsharp", "view_in_place", "views", "views_in_lists", "views_of_helper", "where_mixed", "white_pixels",
]  # fmt: skip
# What C++ would do otherwise without a word.
BY_HAND = [
    "chained_once", "drawn_meanwhile", "late_binding", "list_chosen", "list_given_back", "list_grows_in_its_loop",
    "list_in_list", "nested_function", "nested_input_in_place", "order_of_arguments", "order_of_calls", "raised", "recursive",
    "returns_none", "same_list", "shadowed_builtin", "short_circuit", "sorted_with_ties", "unbound_after_branch",
    "written_after_nonzero", "written_after_transposed",
]  # fmt: skip


def known(*names):
    """Return the source and the inputs of all known differences and usual functions, but for some."""
    inputs = {**differences.INPUTS, **vision.INPUTS}
    return f"{differences.SOURCE}\n\n{vision.SOURCE}", {name: inputs[name] for name in inputs if name not in names}


def random_bundle(folder, seed, count):
    """Write a bundle of random functions, and return them."""
    found = functions(seed, count)
    source = "\n\n\n".join([HELPERS, *(each.source for each in found)])
    return bundle_of(folder, source, {each.name: [(*each_.values(),) for each_ in each.inputs] for each in found}, call)


def shown(done):
    """Return what is wrong, with the source of each function; that C++ raises for a large integer is not."""
    sources = {each.function: each.source for each in done.export.functions}
    wrong = {name: [line for line in lines if TOO_LARGE not in line] for name, lines in done.wrong.items()}
    return "\n\n".join("\n".join([sources[name], *lines[:4]]) for name, lines in wrong.items() if lines)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """The known differences and the usual functions, exported, compiled and replayed."""
    folder = tmp_path_factory.mktemp("known") / "known"
    return export_and_replay(bundle_of(folder, *known(*OF_SEVERAL_TYPES), call), *QUICKLY)


@pytest.fixture(scope="module")
def randoms(tmp_path_factory):
    """Sixty random functions, exported, compiled and replayed."""
    return export_and_replay(random_bundle(tmp_path_factory.mktemp("random") / "randoms", 1, 60), *QUICKLY)


def test_what_python_and_cpp_do_differently_is_translated_right_or_not_at_all(project):
    assert {name: lines for name, lines in project.wrong.items() if name not in (*RAISES, *OTHER_IN_4_6)} == {}
    assert all(TOO_LARGE in line for name in RAISES for line in project.lines[name])


def test_what_engineers_write_is_translated(project):
    assert {name: reason for name, reason in project.by_hand.items() if name in TRANSLATED} == {}
    assert len(project.translated) >= len(TRANSLATED)


def test_what_a_function_by_hand_lacks_is_named_with_its_line(project):
    assert set(BY_HAND) <= project.by_hand.keys()
    lines = {each.function: each.line for each in project.export.functions if each.is_by_hand}
    assert all(reason and "\n" not in reason for reason in project.by_hand.values())
    for name in ("raised", "nested_function", "late_binding"):
        assert re.search(r"try:|def inner|lambda", lines[name]), (name, project.by_hand[name])


def test_a_token_whose_arrays_have_several_types_is_refused_by_its_name(tmp_path):
    source, inputs = known()
    bundle = bundle_of(tmp_path / "mixed", source, {name: inputs[name] for name in OF_SEVERAL_TYPES}, call)
    with pytest.raises(BundleError, match="The values of token 'peaks_out' are"):
        ep.export_cpp(bundle, tmp_path / "cpp")


def test_random_functions_are_translated_right_or_not_at_all(randoms):
    assert shown(randoms) == ""
    assert len(randoms.translated) >= 0.6 * len(randoms.export.functions)


def test_the_replay_finds_every_value_that_is_not_the_recorded_one(randoms, tmp_path):
    """The inputs of one sample, with the outputs of another."""
    samples = randoms.export.path / "samples"
    first, other = (gzip.decompress((samples / f"{name}.yml.gz").read_bytes()).decode() for name in ("000", "001"))
    outputs = {each.name for each in randoms.export.functions}
    one, two = ({entry.split(":", 1)[0]: entry for entry in re.split(r"\n(?=\w)", text)[1:]} for text in (first, other))
    made = {name: re.match(r"f\d+_(\d+|out)$", name) for name in one}
    mixed = [two[name] if made[name] else one[name] for name in one]
    for sample in sorted(samples.glob("*.yml.gz")):
        (tmp_path / sample.name).write_bytes(gzip.compress("\n".join(["%YAML 1.2\n---", *mixed, ""]).encode()))
    lines = replay(randoms.export, randoms.program, "--samples", tmp_path)
    differing = {name.split("_")[0] for name in one if made[name] and one[name] != two[name]} & outputs
    assert {name for name in differing if name in randoms.translated and not lines[name]} == set()
    assert len(differing & set(randoms.translated)) > 20


@pytest.mark.soak
@pytest.mark.parametrize("part", range(4))
def test_every_item_of_the_known_differences_alone(tmp_path, part):
    source, inputs = each_alone(*known(*OF_SEVERAL_TYPES))
    names = [name for index, name in enumerate(inputs) if index % 4 == part]
    done = export_and_replay(
        bundle_of(tmp_path / "alone", source, {name: inputs[name] for name in names}, call), *CHECKED
    )
    accepted = re.compile("|".join((*RAISES, *OTHER_IN_4_6)))
    assert {name: lines for name, lines in done.wrong.items() if not accepted.match(name)} == {}


@pytest.mark.soak
@pytest.mark.fuzz
@pytest.mark.parametrize("seed", range(2, 22))
def test_many_random_functions(tmp_path, seed):
    done = export_and_replay(random_bundle(tmp_path / "randoms", seed, 120), *CHECKED)
    assert shown(done) == ""
