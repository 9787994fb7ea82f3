"""Each entry of the table is what the library itself takes."""

from __future__ import annotations

import inspect
import subprocess
import sys
from typing import Any, Final

import cv2
import pytest

from epypes.catalog import CatalogEntry, entry_of, parameter_names, table
from tests.catalog.calls import called, function_of, names_of

# Just outside of what is allowed, the library refuses these too.
_REFUSED: Final[dict[str, dict[str, tuple[Any, ...]]]] = {
    "GaussianBlur": {"ksize": (2,)},
    "medianBlur": {"ksize": (-1, 2)},
    "stackBlur": {"ksize": (-1, 2)},
    "blur": {"ksize": (0,)},
    "boxFilter": {"ksize": (0,)},
    "sqrBoxFilter": {"ksize": (0,)},
    "getStructuringElement": {"ksize": (0,)},
    "adaptiveThreshold": {"blockSize": (1, 4)},
    "Canny": {"apertureSize": (8,)},
    "Sobel": {"dx": (-1, 3), "dy": (-1, 3), "ksize": (8,)},
    "Laplacian": {"ksize": (8,)},
    "resize": {"fx": (-0.09,), "fy": (-0.09,)},
    "copyMakeBorder": {"top": (-1,), "bottom": (-1,), "left": (-1,), "right": (-1,)},
    "pyrMeanShiftFiltering": {"maxLevel": (-1, 9)},
    "floodFill": {"loDiff": (-1,), "upDiff": (-1,)},
    "HoughLines": {"rho": (0.0,), "theta": (-0.0995,)},
    "HoughLinesP": {"rho": (0.0,), "theta": (-0.0995,)},
    "HoughCircles": {"dp": (0.0,), "minDist": (0,), "param1": (0,), "param2": (0.0,)},
    "goodFeaturesToTrack": {"maxCorners": (-1,), "qualityLevel": (-0.001,), "minDistance": (-1,), "blockSize": (0,)},
    "GFTTDetector_create": {"maxCorners": (-1,), "qualityLevel": (-0.001,), "minDistance": (-1,), "blockSize": (0,)},
    "cornerHarris": {"blockSize": (0,), "ksize": (8,)},
    "cornerMinEigenVal": {"blockSize": (0,), "ksize": (8,)},
    "ORB_create": {"scaleFactor": (0.91,), "firstLevel": (-1,), "patchSize": (1,)},
    "SIFT_create": {"nOctaveLayers": (0,), "sigma": (0.0,)},
    "approxPolyDP": {"epsilon": (-0.1,)},
    "connectedComponents": {"connectivity": (9,)},
    "connectedComponentsWithStats": {"connectivity": (9,)},
    "kmeans": {"K": (0,)},
    "StereoBM_create": {"numDisparities": (17,), "blockSize": (3, 257, 6)},
    "calcOpticalFlowFarneback": {"pyr_scale": (1.05,)},
    "calcOpticalFlowPyrLK": {"winSize": (2,), "maxLevel": (-1,)},
    "findHomography": {"confidence": (-0.001, 1.0999)},
    "estimateAffine2D": {"confidence": (-0.001, 1.0999)},
    "estimateAffinePartial2D": {"confidence": (-0.001, 1.0999)},
    "filters.gaussian": {"sigma": (-0.1,)},
    "filters.difference_of_gaussians": {"low_sigma": (-0.1,), "high_sigma": (-0.1,)},
    "filters.threshold_local": {"block_size": (-1, 4), "method": ('nonsense',)},
    "filters.threshold_niblack": {"window_size": (-1, 4)},
    "filters.threshold_sauvola": {"window_size": (-1, 4)},
    "filters.unsharp_mask": {"radius": (-0.1,)},
    "filters.butterworth": {"cutoff_frequency_ratio": (-0.001, 0.6)},
    "feature.canny": {"sigma": (-0.1,), "high_threshold": (-0.1,)},
    "feature.blob_dog": {"sigma_ratio": (0.91,)},
    "feature.corner_harris": {"sigma": (-0.1,)},
    "feature.corner_shi_tomasi": {"sigma": (-0.1,)},
    "feature.hog": {"pixels_per_cell": (0,)},
    "feature.local_binary_pattern": {"method": ('nonsense',)},
    "feature.ORB": {"downscale": (0.91,)},
    "restoration.denoise_tv_chambolle": {"max_num_iter": (0,)},
    "segmentation.felzenszwalb": {"sigma": (-0.1,)},
    "segmentation.slic": {"n_segments": (0,)},
    "segmentation.quickshift": {"kernel_size": (0.9,), "sigma": (-0.1,)},
    "morphology.h_maxima": {"h": (-0.001,)},
    "morphology.h_minima": {"h": (-0.001,)},
    "exposure.adjust_gamma": {"gamma": (-0.1,)},
    "transform.rescale": {"order": (6,)},
    "transform.rotate": {"order": (6,)},
    "transform.pyramid_reduce": {"downscale": (0.91,)},
    "measure.label": {"connectivity": (3,)},
    "measure.ransac": {"min_samples": (0,), "residual_threshold": (-0.1,), "max_trials": (-1,), "stop_probability": (-0.1, 1.1)},
    "AKAZE_create": {"nOctaves": (0,), "nOctaveLayers": (0,)},
    "KAZE_create": {"nOctaves": (0,)},
    "BRISK_create": {"octaves": (-1, 9)},
}  # fmt: skip
# Beyond these the library ends the process instead of raising.
_DEADLY: Final = (
    ("createCLAHE", "tileGridSize", 0),
    ("ORB_create", "nlevels", 0),
    ("filters.threshold_multiotsu", "classes", 1),
)
# Allowed, and too slow for a test: they take seconds on an image of 40 x 48 pixels.
_SLOW: Final = (("filters.gabor", "frequency", 0.02), ("feature.hog", "pixels_per_cell", 1))
# Not in OpenCV 5, where they went to another package.
_GONE: Final = ("AKAZE_create", "KAZE_create", "BRISK_create")


_ERRORS: Final = (cv2.error, ValueError, TypeError, LookupError, NameError, ArithmeticError, MemoryError)


def named(entry: CatalogEntry) -> str:
    return f"{entry.library}.{entry.function}-{entry.parameter}"


def is_there(entry: CatalogEntry) -> bool:
    """Whether this version of the library has the function; one that is missing unexpectedly is tested, and fails."""
    return function_of(entry) is not None or entry.function not in _GONE


PRESENT: Final = tuple(filter(is_there, table()))


def ends(entry: CatalogEntry) -> list[Any]:
    """Return the choices, or both ends of what is usual and of what is allowed."""
    param = entry.resolved()
    assert param is not None
    if param.choices is not None:
        return list(param.choices)
    low, high = (
        [bounds[place] for bounds in (param.soft or (), (param.low, param.high)) if bounds] for place in (0, 1)
    )
    found = [*((end, 1) for end in low), *((end, -1) for end in high)]
    inward = (end + step if param.odd and end % 2 == 0 else end for end, step in found if end is not None)
    return [end for end in dict.fromkeys(inward) if (entry.function, entry.parameter, end) not in _SLOW]


def default(entry: CatalogEntry) -> Any:
    try:
        return inspect.signature(function_of(entry)).parameters[entry.parameter].default
    except ValueError:  # OpenCV's signatures don't say
        return inspect.Parameter.empty


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Parameter:FutureWarning", "ignore:No inliers found:UserWarning")
@pytest.mark.parametrize("entry", PRESENT, ids=named)
def test_the_library_takes_what_the_table_allows(entry: CatalogEntry) -> None:
    assert entry.parameter in names_of(function_of(entry))
    assert entry_of(function_of(entry), entry.parameter) is entry
    assert not entry.cuts or entry.cuts in parameter_names(function_of(entry))
    param = entry.resolved()
    assert param is not None
    assert param.about
    assert param.soft or param.choices or None not in (param.low, param.high)
    usual = default(entry)
    if isinstance(usual, int | float | str) and usual != 0:
        assert param.allows(usual)
    for value in ends(entry):
        assert param.allows(value)
        called(entry, value)


@pytest.mark.parametrize("entry", [entry for entry in PRESENT if entry.constants], ids=named)
def test_all_constants_are_there(entry: CatalogEntry) -> None:
    param = entry.resolved()
    assert param is not None
    missing = set(entry.constants) - set(param.labels or ())
    assert missing <= {"MORPH_DIAMOND"}, "which OpenCV has from 4.12 on"


@pytest.mark.parametrize(
    "entry", [entry for entry in table() if entry.parameter in _REFUSED.get(entry.function, ())], ids=named
)
def test_what_the_library_refuses_is_outside_of_the_table(entry: CatalogEntry) -> None:
    param = entry.resolved()
    assert param is not None
    for value in _REFUSED[entry.function][entry.parameter]:
        # A slider moves by steps; what is typed is not held to them.
        between = param.step is not None and param.step >= 1 and value % param.step != 0
        assert between or not param.allows(value)
        with pytest.raises(_ERRORS):
            called(entry, value)


def test_every_refusal_is_of_an_entry() -> None:
    known = {(entry.function, entry.parameter) for entry in table()}
    assert {(function, name) for function, names in _REFUSED.items() for name in names} <= known


@pytest.mark.parametrize(("function", "parameter", "value"), _DEADLY)
def test_what_ends_the_process_is_outside_of_the_table(function: str, parameter: str, value: int) -> None:
    entry = next(entry for entry in table() if (entry.function, entry.parameter) == (function, parameter))
    assert not entry.param.allows(value)


def test_the_table_is_as_large_as_promised_and_has_no_entry_twice() -> None:
    keys = [(entry.library, entry.function, entry.parameter) for entry in table()]
    assert len(keys) == len(set(keys)) >= 110


@pytest.mark.slow
def test_the_table_loads_no_library_and_says_nothing_of_constants_then() -> None:
    code = (
        "import sys; from epypes.catalog import entry_of, table; "
        "assert all(entry.resolved() is None for entry in table() if entry.constants); "
        "assert entry_of(len, 'obj') is None; print(*{'cv2', 'skimage', 'numpy'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
