"""The graph of the paper's Figure 13: keypoints that two images have in common, by ORB."""

# ruff: noqa: N803  hyperparameters are called as in OpenCV

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from epypes.graph import CompGraph, extend, union
from epypes.optional import optional_import

if TYPE_CHECKING:
    import numpy as np

    Array = np.ndarray[Any, np.dtype[Any]]

# The hyperparameters that both images share, in the order in which the function takes them.
OPTIONS: Final = (
    *("nfeatures", "scaleFactor", "nlevels", "edgeThreshold"),
    *("WTA_K", "scoreType", "patchSize", "fastThreshold"),
)


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

    orb = cv2.ORB.create(
        nfeatures=nfeatures,
        scaleFactor=scaleFactor,
        nlevels=nlevels,
        edgeThreshold=edgeThreshold,
        WTA_K=WTA_K,
        scoreType=scoreType,
        patchSize=patchSize,
        fastThreshold=fastThreshold,
    )
    return orb.detectAndCompute(image, mask)


def match(descriptors_1: Any, descriptors_2: Any, normType: int, crossCheck: bool) -> list[Any]:
    """Return the matches of two images' descriptors, the nearest ones first."""
    with optional_import():
        import cv2

    if descriptors_1 is None or descriptors_2 is None:
        return []
    matches = cv2.BFMatcher(normType, crossCheck).match(descriptors_1, descriptors_2)
    return sorted(matches, key=lambda found: found.distance)


def gather_keypoints(keypoints_1: Any, keypoints_2: Any, matches: Any) -> Array:
    """Return the matched coordinates, float32, (matches, 4): x and y in the first image, x and y in the second."""
    import numpy as np

    pairs = [(*keypoints_1[found.queryIdx].pt, *keypoints_2[found.trainIdx].pt) for found in matches]
    return np.array(pairs, np.float32).reshape(-1, 4)


def single_image_graph() -> CompGraph:
    """Return the graph of one image."""
    io = {"detect_and_describe_features": (("image", "mask", *OPTIONS), ("keypoints", "descriptors"))}
    return CompGraph({"detect_and_describe_features": detect_and_describe_features}, io)


def orb_graph() -> CompGraph:
    """Return the graph of Figure 13: the graph of one image, joined to itself, extended by what needs both.

    Examples
    --------
    >>> orb_graph().sink_tokens
    ('keypoints_paired',)
    """
    single = single_image_graph()
    return extend(
        union(single, single, suffixes=("_1", "_2"), keep=OPTIONS),
        {"match": match, "gather_keypoints": gather_keypoints},
        {
            "match": (("descriptors_1", "descriptors_2", "normType", "crossCheck"), "matches"),
            "gather_keypoints": (("keypoints_1", "keypoints_2", "matches"), "keypoints_paired"),
        },
    )


def orb_hyperparameters() -> dict[str, Any]:
    """Return the values of the hyperparameters: OpenCV's own defaults, no masks, and matches that are mutual."""
    with optional_import():
        import cv2

    values = (500, 1.2, 8, 31, 2, cv2.ORB_HARRIS_SCORE, 31, 20)
    return {
        **dict(zip(OPTIONS, values, strict=True)),
        "mask_1": None,
        "mask_2": None,
        "normType": cv2.NORM_HAMMING,
        "crossCheck": True,
    }


def stereo_pair() -> tuple[Array, Array]:
    """Return the stereo pair that comes with scikit-image (a motorcycle): two gray images, uint8, (500, 741)."""
    with optional_import():
        import cv2
        from skimage import data

    left, right, _ = data.stereo_motorcycle()
    return cv2.cvtColor(left, cv2.COLOR_RGB2GRAY), cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)
