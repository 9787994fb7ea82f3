"""A failure names what is likely wrong with the inputs, and OpenCV's message in one line."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import ContractBroken, PayloadError

FOUND = "Was the file found? cv2.imread returns None for a file that it can't read."


def failure_of(runner, **payload):
    with pytest.raises(Exception) as raised:  # noqa: PT011 - whatever the function raises
        runner.run(**payload)
    return runner.last.failure, raised.value


def one(function, inputs="image", **hparams):
    return ep.CompGraphRunner(ep.CompGraph({"work": function}, {"work": (inputs, "result")}), hparams)


@pytest.mark.parametrize(
    "function",
    [lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), lambda image: image.shape, lambda image: image + 1],
    ids=["cv2", "attribute", "operator"],
)
def test_none_in_place_of_an_image_asks_whether_the_file_was_found(function):
    failure, raised = failure_of(one(function), image=None)
    assert failure.cause == f"image is None. {FOUND}"
    assert failure.message.startswith(failure.cause)
    assert raised.__notes__[-1].endswith(failure.cause)


def test_none_is_asked_about_where_an_annotation_wants_an_image():
    def work(image: Annotated[np.ndarray, ep.Image(order="bgr")]):
        return image

    failure, raised = failure_of(one(work), image=None)
    assert isinstance(raised, ContractBroken)
    assert FOUND in failure.cause


def test_none_from_a_function_that_reads_the_file_names_that_function():
    cg = ep.CompGraph(
        {"read": lambda path: cv2.imread(path), "gray": lambda image: image.mean()},
        {"read": ("path", "image"), "gray": ("image", "mean")},
    )
    failure, _ = failure_of(ep.CompGraphRunner(cg), path="no such file.png")
    assert failure.cause == f"image is None, made by function 'read'. {FOUND}"


@pytest.mark.parametrize(
    "finder", [lambda image: None, lambda image: cv2.convexHull(np.zeros((0, 2), np.float32))], ids=["no return", "cv2"]
)
def test_none_from_a_function_that_reads_no_file_asks_what_it_returns(finder, photograph):
    cg = ep.CompGraph(
        {"find": finder, "measure": cv2.contourArea}, {"find": ("image", "shape"), "measure": ("shape", "area")}
    )
    failure, _ = failure_of(ep.CompGraphRunner(cg), image=photograph)
    assert failure.cause.startswith("shape is None, made by function 'find'. Does it return a value?")
    assert "ep.Nothing" in failure.cause
    assert "file" not in failure.cause


def test_none_as_a_hyperparameter_or_beside_another_failure_is_not_asked_about(photograph):
    def work(image, mask):
        raise ValueError("too dark")

    assert failure_of(one(work, ("image", "mask")), image=photograph, mask=None)[0].cause == ""
    masked = one(lambda image, mask: cv2.Canny(image, "low", mask), ("image", "mask"), mask=None)
    assert failure_of(masked, image=photograph)[0].cause == ""


def blurred(image, k):
    return cv2.GaussianBlur(image, (k, k), 0)


@pytest.mark.parametrize("k", [4, np.int64(4)])
def test_a_value_that_opencv_forbids_is_named_before_opencvs_assertion(edge_runner, photograph, k):
    edge_runner.run(image=photograph)
    with pytest.raises(cv2.error) as raised:
        edge_runner.rerun(blur_kernel=k)
    assert raised.value.__notes__[-1].endswith(f"blur_kernel={k!r}: cv2.GaussianBlur takes an odd number, 1 or more.")
    assert "ksize" in edge_runner.last.failure.message.partition("1 or more.")[2]


def test_a_value_that_an_annotation_forbids_is_named_in_its_words():
    def work(image, k: Annotated[int, ep.Param(1, 31, odd=True)]):
        return blurred(image, k)

    failure, _ = failure_of(one(work, ("image", "k"), k=4), image=np.zeros((9, 9), np.uint8))
    assert failure.cause == "k=4: its annotation allows an odd number from 1 to 31."


def test_a_grey_image_for_a_conversion_of_colours_is_named_and_the_image_beside_it_is_not():
    def work(image, other):
        return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

    grey, coloured = np.zeros((9, 9), np.uint8), np.zeros((9, 9, 3), np.uint8)
    failure, raised = failure_of(one(work, ("image", "other")), image=grey, other=coloured)
    assert failure.cause == (
        "image has 1 channel, which this conversion of colours does not take. "
        "It is grey: leave a conversion to grey out, or pass an image with 3 channels."
    )
    assert raised.__notes__[-1].endswith(failure.cause)


def test_an_image_with_too_many_channels_for_a_conversion_is_named():
    to_colours = one(lambda image: cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    failure, _ = failure_of(to_colours, image=np.zeros((9, 9, 3), np.uint8))
    assert failure.cause == "image has 3 channels, which this conversion of colours does not take."


def test_what_is_only_unusual_is_no_cause(edge_runner, photograph):
    edge_runner["canny_lo"] = 9_000
    failure, _ = failure_of(edge_runner, image=photograph.astype(np.float64))
    assert failure.function == "grayscale"
    assert failure.cause == ""


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda image: cv2.GaussianBlur(image, (4, 4), 0), "(-215:Assertion failed) ksize"),
        (lambda image: cv2.cvtColor(image[..., 0], cv2.COLOR_BGR2GRAY), "Invalid number of channels in input image:"),
        (
            lambda image: cv2.Canny(image, "low", 3),
            "failed: Argument 'threshold1' can not be treated as a double; Canny() missing",
        ),
    ],
    ids=["assertion", "channels", "overloads"],
)
def test_opencvs_message_is_one_line_without_the_place_in_its_source(photograph, call, message):
    failure, _ = failure_of(one(call), image=photograph)
    assert message in failure.message
    assert "\n" not in failure.message
    assert "OpenCV(" not in failure.message
    assert len(failure.message) < 220


def test_images_given_by_position_are_asked_for_by_name(edge_runner, photograph):
    pipe = ep.Pipeline("edges", edge_runner.cg, edge_runner.hyperparameters)
    source = ep.SourcePipeline("edges", edge_runner.cg, None, None, edge_runner.hyperparameters)
    edge_runner.run(image=photograph)
    for call in (edge_runner.run, edge_runner.rerun, pipe.run, source.run):
        with pytest.raises(PayloadError, match=r"Payload goes by name: run\(image=\.\.\.\)"):
            call(photograph)
