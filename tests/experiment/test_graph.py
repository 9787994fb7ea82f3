"""The graph is that of the paper's Figure 13."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.experiment import orb_graph, orb_hyperparameters, stereo_pair

SHARED = ("nfeatures", "scaleFactor", "nlevels", "edgeThreshold", "WTA_K", "scoreType", "patchSize", "fastThreshold")


def test_functions_and_tokens_are_called_as_in_the_paper():
    cg = orb_graph()
    for i in ("1", "2"):
        detect = f"detect_and_describe_features_{i}"
        assert cg.func_inputs(detect) == (f"image_{i}", f"mask_{i}", *SHARED)
        assert cg.func_outputs(detect) == (f"keypoints_{i}", f"descriptors_{i}")
    assert cg.func_inputs("match") == ("descriptors_1", "descriptors_2", "normType", "crossCheck")
    assert cg.func_outputs("match") == ("matches",)
    assert cg.func_inputs("gather_keypoints") == ("keypoints_1", "keypoints_2", "matches")
    assert cg.func_outputs("gather_keypoints") == ("keypoints_paired",)
    assert len(cg.functions) == 4
    runner = ep.CompGraphRunner(cg, orb_hyperparameters())
    assert runner.free_source_tokens == ("image_1", "image_2")


def test_the_graph_computes_what_opencv_computes_line_by_line():
    pair = stereo_pair()
    run = ep.CompGraphRunner(orb_graph(), orb_hyperparameters()).run(image_1=pair[0], image_2=pair[1])
    orb = cv2.ORB.create()
    (keypoints_1, descriptors_1), (keypoints_2, descriptors_2) = (orb.detectAndCompute(image, None) for image in pair)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors_1, descriptors_2)
    matches = sorted(matches, key=lambda found: found.distance)
    expected = [(*keypoints_1[found.queryIdx].pt, *keypoints_2[found.trainIdx].pt) for found in matches]
    paired = run["keypoints_paired"]
    assert paired.dtype == np.float32
    assert len(paired) > 100
    assert np.array_equal(paired, np.array(expected, np.float32))


def test_a_mask_keeps_keypoints_out():
    pair = stereo_pair()
    mask = np.zeros_like(pair[0])
    mask[:, 400:] = 255
    hparams = {**orb_hyperparameters(), "mask_1": mask}
    paired = ep.CompGraphRunner(orb_graph(), hparams).run(image_1=pair[0], image_2=pair[1])["keypoints_paired"]
    assert len(paired) > 20
    assert paired[:, 0].min() >= 400


@pytest.mark.parametrize("blank", ["image_1", "image_2"])
def test_an_image_without_keypoints_has_no_matches(blank):
    pair = dict(zip(("image_1", "image_2"), stereo_pair(), strict=True))
    pair[blank] = np.zeros_like(pair[blank])
    paired = ep.CompGraphRunner(orb_graph(), orb_hyperparameters()).run(**pair)["keypoints_paired"]
    assert paired.shape == (0, 4)


def test_the_stereo_pair_is_two_gray_images():
    left, right = stereo_pair()
    assert left.shape == right.shape == (500, 741)
    assert left.dtype == right.dtype == np.uint8
    assert not np.array_equal(left, right)
