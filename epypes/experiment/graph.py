"""The graph of the paper's Figure 13: keypoints that two images have in common, by ORB."""

# ruff: noqa: N803  hyperparameters are called as in OpenCV

from __future__ import annotations

from typing import Any, Final

import numpy as np

from epypes.graph import CompGraph, outputs, union
from epypes.optional import optional_import

Array = np.ndarray[Any, np.dtype[Any]]

# Of OpenCV's ORB, which both images share; in the order in which the function takes them.
_ORB: Final = {
    "nfeatures": 500,
    "scaleFactor": 1.2,
    "nlevels": 8,
    "edgeThreshold": 31,
    "WTA_K": 2,
    # cv2.ORB_HARRIS_SCORE
    "scoreType": 0,
    "patchSize": 31,
    "fastThreshold": 20,
}
OPTIONS: Final = tuple(_ORB)


@outputs("keypoints", "descriptors")
def detect_and_describe_features(
    image: Any,
    mask: Any,
    nfeatures: int,
    scaleFactor: float,
    nlevels: int,
    edgeThreshold: int,
    WTA_K: int,
    scoreType: int,
    patchSize: int,
    fastThreshold: int,
) -> Any:
    """Return the keypoints of an image and their descriptors; None for the descriptors where there is no keypoint.

    Parameters
    ----------
    image
        uint8, (height, width) or (height, width, 3).
    mask
        None, or uint8, (height, width): keypoints are looked for where it is not 0.
    """
    with optional_import():
        import cv2

    options = {"WTA_K": WTA_K, "scoreType": scoreType, "patchSize": patchSize, "fastThreshold": fastThreshold}
    orb = cv2.ORB.create(nfeatures, scaleFactor, nlevels, edgeThreshold, **options)
    return orb.detectAndCompute(image, mask)


@outputs("matches")
def match(descriptors_1: Any, descriptors_2: Any, normType: int, crossCheck: bool) -> list[Any]:
    """Return the matches of two images' descriptors, the nearest ones first."""
    with optional_import():
        import cv2

    if descriptors_1 is None or descriptors_2 is None:
        return []
    matches = cv2.BFMatcher(normType, crossCheck).match(descriptors_1, descriptors_2)
    return sorted(matches, key=lambda found: found.distance)


@outputs("keypoints_paired")
def gather_keypoints(keypoints_1: Any, keypoints_2: Any, matches: Any) -> Array:
    """Return the matched coordinates, float32, (matches, 4): x and y in the first image, x and y in the second."""
    pairs = [(*keypoints_1[found.queryIdx].pt, *keypoints_2[found.trainIdx].pt) for found in matches]
    return np.array(pairs, np.float32).reshape(-1, 4)


def orb_graph() -> CompGraph:
    """Return the graph of Figure 13: the graph of one image, joined to itself, extended by what needs both.

    Examples
    --------
    >>> orb_graph().sink_tokens
    ('keypoints_paired',)
    """
    single = CompGraph.from_functions(detect_and_describe_features)
    pair = union(single, single, suffixes=("_1", "_2"), keep=OPTIONS)
    return union(pair, CompGraph.from_functions(match, gather_keypoints))


def orb_hyperparameters() -> dict[str, Any]:
    """Return the values of the hyperparameters: OpenCV's own defaults, no masks, and matches that are mutual."""
    with optional_import():
        import cv2

    return {**_ORB, "mask_1": None, "mask_2": None, "normType": cv2.NORM_HAMMING, "crossCheck": True}


def stereo_pair() -> tuple[Array, Array]:
    """Return the stereo pair that comes with scikit-image (a motorcycle): two gray images, uint8, (500, 741)."""
    with optional_import():
        import cv2
        from skimage import data

    left, right, _ = data.stereo_motorcycle()
    return cv2.cvtColor(left, cv2.COLOR_RGB2GRAY), cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)
