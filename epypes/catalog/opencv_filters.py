"""Which values do OpenCV's functions take that make an image of an image?

Checked against the documentation of OpenCV 4.12 and 5.0, and by calling each at both ends (``tests/catalog``).
"""

from __future__ import annotations

from typing import Final

from epypes.catalog.entry import Cutting, Entry, Named, entries
from epypes.hints import Param

_SIGMA: Final = Param(0.0, soft=(0.0, 10.0), unit="px", about="Standard deviation of the Gaussian; 0: from the side.")
_SIDE: Final = Param(1, soft=(1, 31), unit="px", about="Side of the window.")
_ODD_SIDE: Final = Param(1, soft=(1, 31), odd=True, unit="px", about="Side of the window, odd.")
_TIMES: Final = Param(0, soft=(0, 10), about="How often it is done, one after the other.")
_GRAY: Final = Param(0, soft=(0, 255), about="Threshold, in values of the image.")
_MAXIMUM: Final = Param(0, soft=(0, 255), about="The value of pixels beyond the threshold.")
_DERIVATIVE: Final = Param(choices=(1, 3, 5, 7), about="Side of the derivative's window.")
_SCALE: Final = Param(0.0, soft=(0.0, 10.0), about="Factor of the result.")
_OFFSET: Final = Param(soft=(-128, 128), about="Added to the result.")
_ORDER: Final = Param(0, 2, about="Order of the derivative along this axis.")
_STYLE_S: Final = Param(0.0, 200.0, soft=(0.0, 200.0), unit="px", about="Size of the neighbourhood.")
_STYLE_R: Final = Param(0.0, 1.0, about="How different colours may be to be mixed.")

_BORDERS: Final = Named(
    ("BORDER_CONSTANT", "BORDER_REPLICATE", "BORDER_REFLECT", "BORDER_REFLECT_101"),
    "What is taken for the pixels beyond the border.",
)
_ALL_BORDERS: Final = Named((*_BORDERS.constants, "BORDER_WRAP"), _BORDERS.about)
_WARPING: Final = Named(
    ("INTER_NEAREST", "INTER_LINEAR", "INTER_CUBIC", "INTER_LANCZOS4"), "How values between pixels are found."
)
_RESIZING: Final = Named(
    (*_WARPING.constants, "INTER_AREA", "INTER_LINEAR_EXACT", "INTER_NEAREST_EXACT"), _WARPING.about
)
_THRESHOLDS: Final = Named(
    (
        "THRESH_BINARY", "THRESH_BINARY_INV", "THRESH_TRUNC", "THRESH_TOZERO", "THRESH_TOZERO_INV",
        "THRESH_BINARY|THRESH_OTSU", "THRESH_BINARY_INV|THRESH_OTSU", "THRESH_TRUNC|THRESH_OTSU",
        "THRESH_TOZERO|THRESH_OTSU", "THRESH_TOZERO_INV|THRESH_OTSU",
        "THRESH_BINARY|THRESH_TRIANGLE", "THRESH_BINARY_INV|THRESH_TRIANGLE",
    ),
    "What becomes of pixels above and below the threshold.",
)  # fmt: skip
_COLOURS: Final = Named(
    (
        "COLOR_BGR2GRAY", "COLOR_RGB2GRAY", "COLOR_BGR2RGB", "COLOR_BGR2HSV", "COLOR_RGB2HSV", "COLOR_BGR2HLS",
        "COLOR_BGR2Lab", "COLOR_RGB2Lab", "COLOR_BGR2Luv", "COLOR_BGR2YCrCb", "COLOR_BGR2YUV", "COLOR_BGR2XYZ",
        "COLOR_HSV2BGR", "COLOR_HSV2RGB", "COLOR_Lab2BGR", "COLOR_YCrCb2BGR",
    ),
    "From which colours to which.",
)  # fmt: skip

FILTERS: Final[tuple[Entry, ...]] = entries(
    "cv2",
    {
        "GaussianBlur": {"ksize": _ODD_SIDE, "sigmaX": _SIGMA, "sigmaY": _SIGMA, "borderType": _BORDERS},
        "medianBlur": {"ksize": _ODD_SIDE},
        "stackBlur": {"ksize": _ODD_SIDE},
        "blur": {"ksize": _SIDE, "borderType": _BORDERS},
        "boxFilter": {
            "ksize": _SIDE,
            "normalize": Param(choices=(False, True), about="Whether the mean is taken, not the sum."),
            "borderType": _BORDERS,
        },
        "sqrBoxFilter": {"ksize": _SIDE},
        "bilateralFilter": {
            "d": Param(1, soft=(1, 15), unit="px", about="Diameter of the neighbourhood; slow above 9."),
            "sigmaColor": Param(0, soft=(0, 200), about="How different colours may be to be mixed."),
            "sigmaSpace": Param(0, soft=(0, 200), unit="px", about="How far pixels may be to be mixed."),
            "borderType": _BORDERS,
        },
        "filter2D": {"delta": _OFFSET, "borderType": _BORDERS},
        "erode": {"iterations": _TIMES},
        "dilate": {"iterations": _TIMES},
        "morphologyEx": {
            "op": Named(
                (
                    "MORPH_ERODE", "MORPH_DILATE", "MORPH_OPEN", "MORPH_CLOSE", "MORPH_GRADIENT",
                    "MORPH_TOPHAT", "MORPH_BLACKHAT", "MORPH_HITMISS",
                ),
                "The operation.",
            ),
            "iterations": _TIMES,
        },
        "getStructuringElement": {
            "shape": Named(("MORPH_RECT", "MORPH_CROSS", "MORPH_ELLIPSE", "MORPH_DIAMOND"), "Shape of the element."),
            "ksize": Param(1, soft=(1, 31), unit="px", about="Side of the element."),
        },
        "threshold": {"thresh": Cutting(_GRAY, "src"), "maxval": _MAXIMUM, "type": _THRESHOLDS},
        "adaptiveThreshold": {
            "maxValue": _MAXIMUM,
            "adaptiveMethod": Named(
                ("ADAPTIVE_THRESH_MEAN_C", "ADAPTIVE_THRESH_GAUSSIAN_C"), "How the neighbourhood is averaged."
            ),
            "thresholdType": Named(("THRESH_BINARY", "THRESH_BINARY_INV"), "Which pixels get the maximum value."),
            "blockSize": Param(3, soft=(3, 101), odd=True, unit="px", about="Side of the neighbourhood, odd."),
            "C": Param(soft=(-20, 20), about="Taken off the mean of the neighbourhood."),
        },
        "inRange": {"lowerb": Cutting(_GRAY, "src"), "upperb": Cutting(_GRAY, "src")},
        "Canny": {
            "threshold1": Param(0, soft=(0, 500), about="Gradient from which an edge is followed."),
            "threshold2": Param(0, soft=(0, 500), about="Gradient at which an edge begins."),
            "apertureSize": Param(choices=(3, 5, 7), about="Side of the Sobel operator."),
            "L2gradient": Param(choices=(False, True), about="Whether the exact norm of the gradient is taken."),
        },
        "Sobel": {"dx": _ORDER, "dy": _ORDER, "ksize": _DERIVATIVE, "scale": _SCALE, "delta": _OFFSET},
        "Scharr": {"scale": _SCALE, "delta": _OFFSET},
        "Laplacian": {"ksize": _DERIVATIVE, "scale": _SCALE, "delta": _OFFSET},
        "getGaborKernel": {
            "sigma": Param(0.1, soft=(0.5, 20.0), unit="px", about="Standard deviation of the envelope."),
            "theta": Param(soft=(0.0, 3.1416), step=0.01, unit="rad", about="Direction of the stripes."),
            "lambd": Param(0.1, soft=(2.0, 50.0), unit="px", about="Wave length of the stripes."),
            "gamma": Param(0.0, soft=(0.1, 2.0), about="Aspect ratio of the envelope."),
            "psi": Param(soft=(0.0, 6.2832), step=0.01, unit="rad", about="Phase."),
        },
        "createCLAHE": {
            "clipLimit": Param(0.0, soft=(0.0, 40.0), about="Limit of the contrast."),
            "tileGridSize": Param(1, soft=(1, 32), about="Tiles per row and per column."),
        },
        "cvtColor": {"code": _COLOURS},
        "resize": {
            "fx": Param(0.01, soft=(0.05, 4.0), about="Scale of the width."),
            "fy": Param(0.01, soft=(0.05, 4.0), about="Scale of the height."),
            "interpolation": _RESIZING,
        },
        "warpAffine": {"flags": _WARPING, "borderMode": _ALL_BORDERS},
        "warpPerspective": {"flags": _WARPING, "borderMode": _ALL_BORDERS},
        "remap": {"interpolation": _WARPING, "borderMode": _ALL_BORDERS},
        "getRotationMatrix2D": {
            "angle": Param(soft=(-180.0, 180.0), step=0.5, unit="deg", about="Angle, against the clock."),
            "scale": Param(soft=(0.1, 4.0), step=0.01, about="Scale."),
        },
        "rotate": {
            "rotateCode": Named(("ROTATE_90_CLOCKWISE", "ROTATE_180", "ROTATE_90_COUNTERCLOCKWISE"), "The turn.")
        },
        "copyMakeBorder": {
            "top": Param(0, soft=(0, 100), unit="px", about="Rows added above."),
            "bottom": Param(0, soft=(0, 100), unit="px", about="Rows added below."),
            "left": Param(0, soft=(0, 100), unit="px", about="Columns added on the left."),
            "right": Param(0, soft=(0, 100), unit="px", about="Columns added on the right."),
            "borderType": _ALL_BORDERS,
        },
        "convertScaleAbs": {
            "alpha": Param(soft=(0.0, 5.0), step=0.01, about="Factor: the contrast."),
            "beta": Param(soft=(-128, 128), about="Added: the brightness."),
        },
        "addWeighted": {
            "alpha": Param(soft=(0.0, 2.0), step=0.01, about="Weight of the first image."),
            "beta": Param(soft=(0.0, 2.0), step=0.01, about="Weight of the second image."),
            "gamma": Param(soft=(-128, 128), about="Added to the sum."),
        },
        "distanceTransform": {
            "distanceType": Named(("DIST_L1", "DIST_L2", "DIST_C"), "How distance is measured."),
            "maskSize": Named(("DIST_MASK_PRECISE", "DIST_MASK_3", "DIST_MASK_5"), "How exactly."),
        },
        "fastNlMeansDenoising": {
            "h": Param(0.0, soft=(1.0, 30.0), about="Strength: removes noise, and with it details."),
            "templateWindowSize": Param(1, soft=(3, 15), odd=True, unit="px", about="Side of the patch compared."),
            "searchWindowSize": Param(1, soft=(3, 41), odd=True, unit="px", about="Side of the area searched."),
        },
        "fastNlMeansDenoisingColored": {
            "h": Param(0.0, soft=(1.0, 30.0), about="Strength for brightness."),
            "hColor": Param(0.0, soft=(1.0, 30.0), about="Strength for colours."),
        },
        "inpaint": {
            "inpaintRadius": Param(0.0, soft=(1.0, 20.0), unit="px", about="How far around a hole is looked."),
            "flags": Named(("INPAINT_NS", "INPAINT_TELEA"), "The method."),
        },
        "pyrMeanShiftFiltering": {
            "sp": Param(0.0, soft=(1.0, 40.0), unit="px", about="Radius of the window in space."),
            "sr": Param(0.0, soft=(1.0, 80.0), about="Radius of the window in colours."),
            "maxLevel": Param(0, 8, soft=(0, 4), about="Levels of the pyramid."),
        },
        "edgePreservingFilter": {
            "flags": Named(("RECURS_FILTER", "NORMCONV_FILTER"), "The method."),
            "sigma_s": _STYLE_S,
            "sigma_r": _STYLE_R,
        },
        "detailEnhance": {"sigma_s": _STYLE_S, "sigma_r": _STYLE_R},
        "stylization": {"sigma_s": _STYLE_S, "sigma_r": _STYLE_R},
        "grabCut": {"iterCount": Param(1, soft=(1, 10), about="How often the result is improved.")},
        "floodFill": {
            "loDiff": Param(0, soft=(0, 100), about="How much darker a neighbour may be."),
            "upDiff": Param(0, soft=(0, 100), about="How much brighter a neighbour may be."),
        },
    },
)  # fmt: skip
