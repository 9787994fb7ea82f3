"""A call of each function of the table, on a small image."""

from __future__ import annotations

import inspect
from typing import Any, Final

import cv2
import numpy as np
import skimage
from skimage import exposure, feature, filters, measure, morphology, restoration, segmentation, transform  # noqa: F401

from epypes.catalog import CatalogEntry, parameter_names

GRAY: Final = np.zeros((40, 48), np.uint8)
GRAY[8:20, 10:30] = 200
GRAY[24:36, 28:44] = 120
GRAY += (np.arange(GRAY.size, dtype=np.uint8).reshape(GRAY.shape) % 7).astype(np.uint8)
COLOUR: Final = np.dstack([GRAY, GRAY[::-1], GRAY[:, ::-1]])
FLOAT: Final = GRAY / 255.0
BINARY: Final = GRAY > 100
BITS: Final = (BINARY * 255).astype(np.uint8)
LABELS: Final = measure.label(BINARY)
MARKERS: Final = np.where(GRAY > 180, 2, np.where(GRAY < 20, 1, 0))
_KERNEL: Final = np.ones((3, 3), np.uint8)
_TURNED: Final = np.array([[1.0, 0.1, 2.0], [-0.1, 1.0, 1.0]])
_FLAT: Final = np.vstack([_TURNED, [0, 0, 1]])
_Y, _X = np.mgrid[0:40, 0:48].astype(np.float32)
_POINTS: Final = np.random.default_rng(1).uniform(0, 40, (30, 2)).astype(np.float32)
_MOVED: Final = _POINTS + np.float32(2)
_CURVE: Final = np.array([[[0, 0]], [[10, 1]], [[20, 0]], [[20, 20]], [[0, 20]]], np.int32)
_STOP: Final = (3, 10, 1.0)  # both: at most 10 times, to within 1
_DESCRIPTORS: Final = np.random.default_rng(2).integers(0, 256, (20, 32)).astype(np.uint8)
_HOUGH: Final = transform.hough_line(BINARY)
_CIRCLES: Final = transform.hough_circle(np.pad(BINARY, 100), [5, 8])
_WIDE: Final = np.tile(GRAY, (1, 8))
_LARGE: Final = np.tile(GRAY, (7, 8))


def _grab_mask() -> Any:
    mask = np.full(GRAY.shape, 2, np.uint8)
    mask[10:18, 12:28] = 3
    return mask


# What is given besides the parameter in question.
_GIVEN: Final[dict[str, dict[str, Any]]] = {
    "GaussianBlur": {"src": GRAY, "ksize": (5, 5), "sigmaX": 1.0},
    "medianBlur": {"src": GRAY},
    "stackBlur": {"src": GRAY},
    "blur": {"src": GRAY, "ksize": (3, 3)},
    "boxFilter": {"src": GRAY, "ddepth": -1, "ksize": (3, 3)},
    "sqrBoxFilter": {"src": GRAY, "ddepth": cv2.CV_32F},
    "bilateralFilter": {"src": GRAY, "d": 5, "sigmaColor": 30, "sigmaSpace": 5},
    "filter2D": {"src": GRAY, "ddepth": -1, "kernel": _KERNEL},
    "erode": {"src": GRAY, "kernel": _KERNEL},
    "dilate": {"src": GRAY, "kernel": _KERNEL},
    "morphologyEx": {"src": GRAY, "op": cv2.MORPH_OPEN, "kernel": _KERNEL},
    "getStructuringElement": {"shape": cv2.MORPH_RECT, "ksize": (3, 3)},
    "threshold": {"src": GRAY, "thresh": 100, "maxval": 255, "type": cv2.THRESH_BINARY},
    "adaptiveThreshold": {
        "src": GRAY, "maxValue": 255, "adaptiveMethod": cv2.ADAPTIVE_THRESH_MEAN_C,
        "thresholdType": cv2.THRESH_BINARY, "blockSize": 11, "C": 2,
    },
    "inRange": {"src": GRAY, "lowerb": 50, "upperb": 150},
    "Canny": {"image": GRAY, "threshold1": 70, "threshold2": 200},
    "Sobel": {"src": GRAY, "ddepth": cv2.CV_32F, "dx": 1, "dy": 1},
    "Scharr": {"src": GRAY, "ddepth": cv2.CV_32F, "dx": 1, "dy": 0},
    "Laplacian": {"src": GRAY, "ddepth": cv2.CV_32F},
    "getGaborKernel": {"ksize": (9, 9), "sigma": 2.0, "theta": 0.0, "lambd": 5.0, "gamma": 0.5},
    "createCLAHE": {},
    "cvtColor": {"src": COLOUR},
    "resize": {"src": _LARGE, "dsize": None, "fx": 0.5, "fy": 0.5},
    "warpAffine": {"src": GRAY, "M": _TURNED, "dsize": (48, 40)},
    "warpPerspective": {"src": GRAY, "M": _FLAT, "dsize": (48, 40)},
    "remap": {"src": GRAY, "map1": _X, "map2": _Y, "interpolation": cv2.INTER_LINEAR},
    "getRotationMatrix2D": {"center": (10, 10), "angle": 0, "scale": 1},
    "rotate": {"src": GRAY},
    "copyMakeBorder": {
        "src": GRAY, "top": 1, "bottom": 1, "left": 1, "right": 1, "borderType": cv2.BORDER_REPLICATE,
    },
    "convertScaleAbs": {"src": GRAY},
    "addWeighted": {"src1": GRAY, "alpha": 1, "src2": GRAY, "beta": 1, "gamma": 0},
    "distanceTransform": {"src": BITS, "distanceType": cv2.DIST_L2, "maskSize": 3},
    "fastNlMeansDenoising": {"src": GRAY[:24, :24], "templateWindowSize": 3, "searchWindowSize": 5},
    "fastNlMeansDenoisingColored": {
        "src": COLOUR[:24, :24].copy(), "templateWindowSize": 3, "searchWindowSize": 5,
    },
    "inpaint": {"src": GRAY, "inpaintMask": BITS, "inpaintRadius": 3, "flags": cv2.INPAINT_TELEA},
    "pyrMeanShiftFiltering": {"src": COLOUR[:16, :16].copy(), "sp": 3, "sr": 10},
    "edgePreservingFilter": {"src": COLOUR},
    "detailEnhance": {"src": COLOUR},
    "stylization": {"src": COLOUR},
    "grabCut": {"img": COLOUR, "rect": None, "mode": cv2.GC_INIT_WITH_MASK},
    "floodFill": {"mask": None, "seedPoint": (2, 2), "newVal": 255},
    "HoughLines": {"image": BITS, "rho": 1, "theta": 0.02, "threshold": 20},
    "HoughLinesP": {"image": BITS, "rho": 1, "theta": 0.02, "threshold": 20},
    "HoughCircles": {"image": GRAY, "method": cv2.HOUGH_GRADIENT, "dp": 1.5, "minDist": 10},
    "goodFeaturesToTrack": {"image": GRAY, "maxCorners": 20, "qualityLevel": 0.1, "minDistance": 3},
    "cornerHarris": {"src": GRAY, "blockSize": 3, "ksize": 3, "k": 0.04},
    "cornerMinEigenVal": {"src": GRAY, "blockSize": 3},
    "findContours": {"image": BITS, "mode": cv2.RETR_LIST, "method": cv2.CHAIN_APPROX_NONE},
    "approxPolyDP": {"curve": _CURVE, "epsilon": 2, "closed": True},
    "connectedComponents": {"image": BITS},
    "connectedComponentsWithStats": {"image": BITS},
    "matchTemplate": {"image": GRAY, "templ": GRAY[5:15, 5:15]},
    "kmeans": {
        "data": _POINTS, "K": 3, "bestLabels": None, "criteria": _STOP, "attempts": 2,
        "flags": cv2.KMEANS_RANDOM_CENTERS,
    },
    "ORB_create": {"nlevels": 3},
    "StereoSGBM_create": {"numDisparities": 16},
    "StereoBM_create": {"numDisparities": 16, "blockSize": 5},
    "calcOpticalFlowFarneback": {
        "prev": GRAY, "next": GRAY, "flow": None, "pyr_scale": 0.5, "levels": 2, "winsize": 5, "iterations": 1,
        "poly_n": 5, "poly_sigma": 1.1, "flags": 0,
    },
    "calcOpticalFlowPyrLK": {"prevImg": GRAY, "nextImg": GRAY, "prevPts": _POINTS, "nextPts": None},
    "findHomography": {"srcPoints": _POINTS, "dstPoints": _MOVED, "method": cv2.RANSAC},
    "estimateAffine2D": {"from_": _POINTS, "to": _MOVED},
    "estimateAffinePartial2D": {"from_": _POINTS, "to": _MOVED},
    "drawContours": {"contours": [_CURVE], "contourIdx": -1, "color": 255},
    "filters.difference_of_gaussians": {"image": FLOAT, "low_sigma": 0.0, "high_sigma": 30.0},
    "filters.threshold_local": {"image": GRAY},
    "filters.apply_hysteresis_threshold": {"image": GRAY, "low": 50, "high": 150},
    "filters.gabor": {"image": FLOAT[:16, :16], "frequency": 0.3},
    "filters.threshold_multiotsu": {"image": GRAY, "nbins": 32},
    "feature.canny": {"image": FLOAT, "low_threshold": 0.0, "high_threshold": 1.0},
    "feature.local_binary_pattern": {"image": GRAY, "P": 8, "R": 1},
    "feature.match_descriptors": {"descriptors1": _DESCRIPTORS, "descriptors2": _DESCRIPTORS[::-1]},
    "feature.blob_dog": {"image": FLOAT, "min_sigma": 1, "max_sigma": 10},
    "feature.hog": {"image": GRAY, "cells_per_block": (1, 1)},
    "feature.ORB": {},
    "restoration.denoise_bilateral": {"image": FLOAT[:16, :16]},
    "restoration.rolling_ball": {"image": GRAY[:20, :20]},
    "segmentation.felzenszwalb": {"image": COLOUR},
    "segmentation.slic": {"image": COLOUR},
    "segmentation.quickshift": {"image": COLOUR[:16, :16], "kernel_size": 1.0, "max_dist": 5.0},
    "segmentation.watershed": {"image": GRAY, "markers": MARKERS},
    "segmentation.random_walker": {"data": FLOAT, "labels": MARKERS, "mode": "cg_j"},
    "segmentation.chan_vese": {"image": FLOAT[:16, :16], "max_num_iter": 3},
    "segmentation.expand_labels": {"label_image": LABELS},
    "segmentation.clear_border": {"labels": LABELS},
    "morphology.disk": {},
    "morphology.ball": {},
    "morphology.diamond": {},
    "morphology.remove_small_objects": {"ar": BINARY},
    "morphology.remove_small_holes": {"ar": BINARY},
    "transform.rescale": {"image": FLOAT, "scale": 0.5},
    "transform.rotate": {"image": FLOAT, "angle": 10},
    "transform.probabilistic_hough_line": {"image": BINARY, "rng": 1},
    "transform.hough_line_peaks": {"hspace": _HOUGH[0], "angles": _HOUGH[1], "dists": _HOUGH[2]},
    "transform.hough_circle_peaks": {"hspaces": _CIRCLES, "radii": [5, 8]},
    "measure.find_contours": {"image": GRAY},
    "measure.approximate_polygon": {"coords": _CURVE[:, 0].astype(float)},
    "measure.label": {"label_image": LABELS},
    "measure.ransac": {
        "data": _POINTS, "model_class": measure.LineModelND, "min_samples": 2, "residual_threshold": 1.0, "max_trials": 5,
    },
}  # fmt: skip
# scikit-image's others take one image.
_PLAIN: Final = {"image": FLOAT}

_SIDES: Final = frozenset(("ksize", "tileGridSize", "winSize", "pixels_per_cell", "cells_per_block"))
_NUMBERS: Final = frozenset(
    ("medianBlur", "Sobel", "Laplacian", "cornerHarris", "cornerMinEigenVal", "filters.laplace")
)


def function_of(entry: CatalogEntry) -> Any:
    """Return the function of an entry; None if this version of the library has none."""
    found: Any = {"cv2": cv2, "skimage": skimage}[entry.library]
    for part in entry.function.split("."):
        found = getattr(found, part, None)
    return found


def names_of(function: Any) -> tuple[str, ...]:
    """Return the names of all parameters, those by keyword too."""
    try:
        return tuple(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        return parameter_names(function)


def called(entry: CatalogEntry, value: Any) -> Any:
    """Call the function of an entry with this value, and use what it makes."""
    is_side = entry.parameter in _SIDES and entry.function not in _NUMBERS
    given = dict(_GIVEN.get(entry.function, {} if entry.library == "cv2" else _PLAIN))
    given[entry.parameter] = (value, value) if is_side else value
    _adapt(entry.function, entry.parameter, given)
    return _used(entry.function, function_of(entry)(**given))


def _adapt(function: str, parameter: str, given: dict[str, Any]) -> None:
    """Give what must be new for each call, or fit the value."""
    if function == "grabCut":
        given |= {"mask": _grab_mask(), "bgdModel": None, "fgdModel": None}
    elif function in ("floodFill", "drawContours"):
        given["image"] = GRAY.copy()
    elif (function, parameter) == ("morphologyEx", "op") and given["op"] == cv2.MORPH_HITMISS:
        given["src"] = BITS
    elif function == "Sobel" and parameter in ("dx", "dy"):
        given["dy" if parameter == "dx" else "dx"] = 1
    elif (function, parameter) == ("feature.blob_dog", "max_sigma"):
        given["min_sigma"] = 0.1
    elif (function, parameter) == ("feature.blob_dog", "min_sigma"):
        given["max_sigma"] = 40
    elif function == "HoughCircles" and given["method"] != cv2.HOUGH_GRADIENT:
        given["param2"] = 0.8


def _used(function: str, made: Any) -> Any:
    """Use an object that finds things; what is no such object is the result."""
    if function == "StereoBM_create":
        return made.compute(_LARGE, _LARGE)
    if function == "StereoSGBM_create":
        return made.compute(_WIDE, _WIDE)
    if function == "BRISK_create":
        return made.detect(_LARGE)
    if function == "MSER_create":
        return made.detectRegions(GRAY)
    if function == "BFMatcher_create":
        return made  # which descriptors it takes depends on the norm
    if function.startswith("create"):
        return made.apply(GRAY)
    if function.endswith("_create"):
        return made.detect(GRAY, None)
    return made.detect(FLOAT) if function == "feature.ORB" else made
