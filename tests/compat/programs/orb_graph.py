"""The ORB graph of the paper: a union of one graph with itself, hyperparameters shared, then extended."""

import cv2
import numpy as np
from epypes.compgraph import (
    CompGraph,
    FunctionPlaceholder,
    UndefinedSourceTokensException,
    add_new_vertices,
    graph_union,
    graph_union_with_suffixing,
)
from epypes.pipeline import Pipeline

rng = np.random.default_rng(2)
im1 = cv2.resize(rng.integers(0, 255, (15, 20), np.uint8), (200, 150), interpolation=cv2.INTER_NEAREST)
im2 = np.roll(im1, 7, axis=1)


def detect(image, mask, nfeatures):
    return cv2.ORB_create(nfeatures=nfeatures).detectAndCompute(image, mask)


def match(d1, d2, cross):
    found = cv2.BFMatcher(cv2.NORM_HAMMING, cross).match(d1, d2)
    return sorted(found, key=lambda m: m.distance)


def gather(kp1, kp2, matches):
    return np.array([kp1[m.queryIdx].pt + kp2[m.trainIdx].pt for m in matches])


one = CompGraph({"detect": detect}, {"detect": (("image", "mask", "nfeatures"), ("keypoints", "descriptors"))})
two = graph_union_with_suffixing(one, one, exclude=["nfeatures"])
assert set(two.functions) == {"detect_1", "detect_2"}
assert set(two.source_tokens) == {"image_1", "mask_1", "image_2", "mask_2", "nfeatures"}

cg = add_new_vertices(
    two,
    {"match": match, "gather": FunctionPlaceholder()},
    {
        "match": (("descriptors_1", "descriptors_2", "crossCheck"), "matches"),
        "gather": (("keypoints_1", "keypoints_2", "matches"), "keypoints_paired"),
    },
)
cg = add_new_vertices(
    cg, {"gather": gather}, {"gather": (("keypoints_1", "keypoints_2", "matches"), "keypoints_paired")}
)
cg = graph_union(cg, CompGraph({"count": len}, {"count": ("matches", "n_matches")}))

pipe = Pipeline("orb", cg, frozen_tokens={"nfeatures": 60, "crossCheck": True, "mask_1": None, "mask_2": None})
try:
    pipe.run(image_1=im1)
except UndefinedSourceTokensException as error:
    missing = error.missing_source_tokens
assert missing == {"image_2"}

pipe.run(image_1=im1, image_2=im2)
k1, d1 = detect(im1, None, 60)
k2, d2 = detect(im2, None, 60)
assert np.array_equal(pipe.token_value("keypoints_paired"), gather(k1, k2, match(d1, d2, True)))
assert pipe["n_matches"] == len(pipe["matches"]) > 0

pipe.modify_frozen_token("nfeatures", 30)
pipe.run(image_1=im1, image_2=im2)
assert len(pipe["keypoints_1"]) <= 31
