"""Which values do OpenCV's functions take that find something in an image?

Checked against the documentation of OpenCV 4.12 and 5.0, and by calling each at both ends (``tests/catalog``).
"""

from __future__ import annotations

from typing import Final

from epypes.catalog.entry import Entry, Named, entries
from epypes.hints import Param

_YES_NO: Final = (False, True)
_OCTAVES: Final = Param(1, soft=(1, 8), about="Octaves of the scale space.")
_QUALITY: Final = Param(0.001, soft=(0.001, 0.3), log=True, about="Least quality, as a share of the best corner's.")
_HARRIS: Final = Param(0.0, soft=(0.0, 0.25), step=0.005, about="Harris' free parameter k.")
_CORNER_BLOCK: Final = Param(1, soft=(1, 31), unit="px", about="Side of the neighbourhood of a corner.")
_RANSAC: Final = Param(0.0, soft=(0.5, 20.0), unit="px", about="How far an inlier may be off.")
_TRIALS: Final = Param(1, soft=(100, 10000), about="At most so many trials.")
_CONFIDENCE: Final = Param(0.001, 0.9999, soft=(0.5, 0.999), step=0.001, about="Confidence that the result is right.")
_CONNECTED: Final = Param(choices=(4, 8), about="Neighbours that count as connected.")
_DISPARITIES: Final = Param(16, soft=(16, 256), step=16, unit="px", about="Disparities searched, a multiple of 16.")
_NORM: Final = Named(("NORM_L1", "NORM_L2", "NORM_HAMMING", "NORM_HAMMING2"), "How descriptors are compared.")
_CROSS: Final = Param(choices=_YES_NO, about="Whether both must be the other's nearest.")
_DIFFUSIVITY: Final = Named(
    ("KAZE_DIFF_PM_G1", "KAZE_DIFF_PM_G2", "KAZE_DIFF_WEICKERT", "KAZE_DIFF_CHARBONNIER"), "Kind of diffusion."
)

FEATURES: Final[tuple[Entry, ...]] = entries(
    "cv2",
    {
        "HoughLines": {
            "rho": Param(0.1, soft=(0.5, 10.0), unit="px", about="Resolution of the distance."),
            "theta": Param(0.0005, soft=(0.002, 0.2), log=True, unit="rad", about="Resolution of the angle."),
            "threshold": Param(1, soft=(1, 300), about="Least votes of a line."),
        },
        "HoughLinesP": {
            "rho": Param(0.1, soft=(0.5, 10.0), unit="px", about="Resolution of the distance."),
            "theta": Param(0.0005, soft=(0.002, 0.2), log=True, unit="rad", about="Resolution of the angle."),
            "threshold": Param(1, soft=(1, 300), about="Least votes of a line."),
            "minLineLength": Param(0, soft=(0, 300), unit="px", about="Shorter lines are dropped."),
            "maxLineGap": Param(0, soft=(0, 100), unit="px", about="Largest gap within one line."),
        },
        "HoughCircles": {
            "method": Named(("HOUGH_GRADIENT", "HOUGH_GRADIENT_ALT"), "The method."),
            "dp": Param(0.1, soft=(1.0, 4.0), step=0.1, about="Image's resolution by the accumulator's."),
            "minDist": Param(1, soft=(1, 200), unit="px", about="Least distance of two centres."),
            "param1": Param(1, soft=(1, 500), about="The higher threshold of the edges."),
            "param2": Param(0.1, soft=(1, 200), about="Least votes of a centre."),
            "minRadius": Param(0, soft=(0, 500), unit="px", about="Smallest radius."),
            "maxRadius": Param(soft=(0, 500), unit="px", about="Largest radius; 0: that of the image."),
        },
        "goodFeaturesToTrack": {
            "maxCorners": Param(0, soft=(0, 2000), about="At most so many corners; 0: all."),
            "qualityLevel": _QUALITY,
            "minDistance": Param(0, soft=(0, 100), unit="px", about="Least distance of two corners."),
            "blockSize": _CORNER_BLOCK,
            "useHarrisDetector": Param(choices=_YES_NO, about="Whether Harris' measure is taken."),
            "k": _HARRIS,
        },
        "GFTTDetector_create": {
            "maxCorners": Param(0, soft=(0, 2000), about="At most so many corners; 0: all."),
            "qualityLevel": _QUALITY,
            "minDistance": Param(0, soft=(0, 100), unit="px", about="Least distance of two corners."),
            "blockSize": _CORNER_BLOCK,
        },
        "cornerHarris": {
            "blockSize": _CORNER_BLOCK,
            "ksize": Param(choices=(1, 3, 5, 7), about="Side of the Sobel operator."),
            "k": _HARRIS,
        },
        "cornerMinEigenVal": {
            "blockSize": _CORNER_BLOCK,
            "ksize": Param(choices=(1, 3, 5, 7), about="Side of the Sobel operator."),
        },
        "FastFeatureDetector_create": {
            "threshold": Param(0, 255, soft=(1, 100), about="How different the circle must be from its centre."),
            "nonmaxSuppression": Param(choices=_YES_NO, about="Whether only the best of neighbours is kept."),
            "type": Named(
                (
                    "FAST_FEATURE_DETECTOR_TYPE_5_8", "FAST_FEATURE_DETECTOR_TYPE_7_12",
                    "FAST_FEATURE_DETECTOR_TYPE_9_16",
                ),
                "Pixels in a row of the circle's.",
            ),
        },
        "ORB_create": {
            "nfeatures": Param(0, soft=(0, 5000), about="At most so many keypoints."),
            "scaleFactor": Param(1.01, soft=(1.05, 2.0), step=0.01, about="Ratio of a level to the next."),
            "nlevels": Param(1, soft=(1, 16), about="Levels of the pyramid."),
            "edgeThreshold": Param(0, soft=(0, 100), unit="px", about="Border without keypoints."),
            "firstLevel": Param(0, soft=(0, 4), about="The level that is the image itself."),
            "WTA_K": Param(choices=(2, 3, 4), about="Points that make one element of a descriptor."),
            "scoreType": Named(("ORB_HARRIS_SCORE", "ORB_FAST_SCORE"), "What ranks the keypoints."),
            "patchSize": Param(2, soft=(5, 101), unit="px", about="Side of the patch described."),
            "fastThreshold": Param(0, 255, soft=(1, 100), about="Threshold of FAST."),
        },
        "SIFT_create": {
            "nfeatures": Param(0, soft=(0, 5000), about="The best so many keypoints; 0: all."),
            "nOctaveLayers": Param(1, soft=(1, 8), about="Layers per octave."),
            "contrastThreshold": Param(0.0, soft=(0.0, 0.2), step=0.001, about="Weaker keypoints are dropped."),
            "edgeThreshold": Param(0.0, soft=(1.0, 30.0), about="Keypoints more like edges are dropped."),
            "sigma": Param(0.1, soft=(0.5, 4.0), unit="px", about="Blur of the first octave."),
        },
        "AKAZE_create": {
            "threshold": Param(0.00001, soft=(0.0001, 0.1), log=True, about="Least response of a keypoint."),
            "nOctaves": _OCTAVES,
            "nOctaveLayers": Param(1, soft=(1, 8), about="Layers per octave."),
            "descriptor_channels": Param(choices=(1, 2, 3), about="Channels of the descriptor."),
            "diffusivity": _DIFFUSIVITY,
        },
        "KAZE_create": {
            "threshold": Param(0.00001, soft=(0.0001, 0.1), log=True, about="Least response of a keypoint."),
            "nOctaves": _OCTAVES,
            "diffusivity": _DIFFUSIVITY,
        },
        "BRISK_create": {
            "thresh": Param(1, 255, soft=(1, 100), about="Threshold of AGAST."),
            "octaves": Param(0, 8, about="Octaves of the scale space; 0: one scale."),
            "patternScale": Param(0.1, soft=(0.5, 3.0), step=0.1, about="Scale of the pattern sampled."),
        },
        "MSER_create": {
            "delta": Param(1, soft=(1, 30), about="Change of threshold over which a region must be stable."),
            "min_area": Param(0, soft=(0, 5000), unit="px²", about="Smaller regions are dropped."),
            "max_area": Param(1, soft=(100, 100000), unit="px²", about="Larger regions are dropped."),
            "max_variation": Param(0.0, soft=(0.0, 1.0), about="Largest change of a region's area."),
            "min_diversity": Param(0.0, soft=(0.0, 1.0), about="Least difference from the region around it."),
        },
        "BFMatcher_create": {"normType": _NORM, "crossCheck": _CROSS},
        "findContours": {
            "mode": Named(("RETR_EXTERNAL", "RETR_LIST", "RETR_CCOMP", "RETR_TREE"), "Which contours are returned."),
            "method": Named(
                ("CHAIN_APPROX_NONE", "CHAIN_APPROX_SIMPLE", "CHAIN_APPROX_TC89_L1", "CHAIN_APPROX_TC89_KCOS"),
                "Which of their points are kept.",
            ),
        },
        "approxPolyDP": {
            "epsilon": Param(0.0, soft=(0.0, 50.0), unit="px", about="How far the polygon may be off the curve."),
            "closed": Param(choices=_YES_NO, about="Whether the last point is joined to the first."),
        },
        "connectedComponents": {"connectivity": _CONNECTED},
        "connectedComponentsWithStats": {"connectivity": _CONNECTED},
        "matchTemplate": {
            "method": Named(
                (
                    "TM_SQDIFF", "TM_SQDIFF_NORMED", "TM_CCORR", "TM_CCORR_NORMED", "TM_CCOEFF", "TM_CCOEFF_NORMED",
                ),
                "How the template is compared.",
            )
        },
        "kmeans": {
            "K": Param(1, soft=(1, 20), about="Clusters."),
            "attempts": Param(1, soft=(1, 20), about="How often it begins anew; the best is kept."),
            "flags": Named(("KMEANS_RANDOM_CENTERS", "KMEANS_PP_CENTERS"), "Where it begins."),
        },
        "StereoBM_create": {
            "numDisparities": Param(0, soft=(16, 256), step=16, unit="px", about=_DISPARITIES.about),
            "blockSize": Param(5, 255, soft=(5, 51), odd=True, unit="px", about="Side of the blocks compared, odd."),
        },
        "StereoSGBM_create": {
            "minDisparity": Param(soft=(-64, 64), unit="px", about="Smallest disparity."),
            "numDisparities": _DISPARITIES,
            "blockSize": Param(1, soft=(1, 21), odd=True, unit="px", about="Side of the blocks compared, odd."),
            "P1": Param(0, soft=(0, 2000), about="Penalty of a change by one."),
            "P2": Param(0, soft=(0, 5000), about="Penalty of a larger change; above P1."),
            "disp12MaxDiff": Param(-1, soft=(-1, 50), unit="px", about="Largest difference left to right; -1: any."),
            "preFilterCap": Param(0, 63, about="Cut of the image's derivative."),
            "uniquenessRatio": Param(0, 100, soft=(0, 30), unit="%", about="How much better the best must be."),
            "speckleWindowSize": Param(0, soft=(0, 300), unit="px²", about="Smaller blobs are dropped; 0: none."),
            "speckleRange": Param(0, soft=(0, 20), unit="px", about="Largest change within a blob."),
        },
        "calcOpticalFlowFarneback": {
            "pyr_scale": Param(0.1, 0.95, step=0.05, about="Scale of a level to the one below."),
            "levels": Param(1, soft=(1, 8), about="Levels of the pyramid."),
            "winsize": Param(1, soft=(1, 51), unit="px", about="Side of the window averaged."),
            "iterations": Param(1, soft=(1, 10), about="How often the flow is improved, per level."),
            "poly_n": Param(choices=(5, 7), about="Side of the neighbourhood approximated."),
            "poly_sigma": Param(0.1, soft=(0.5, 3.0), unit="px", about="Blur of the approximation."),
        },
        "calcOpticalFlowPyrLK": {
            "winSize": Param(3, soft=(3, 51), unit="px", about="Side of the window searched."),
            "maxLevel": Param(0, soft=(0, 6), about="Levels of the pyramid above the image."),
            "minEigThreshold": Param(0.0, soft=(0.0, 0.01), step=0.0001, about="Weaker points are dropped."),
        },
        "findHomography": {"ransacReprojThreshold": _RANSAC, "maxIters": _TRIALS, "confidence": _CONFIDENCE},
        "estimateAffine2D": {"ransacReprojThreshold": _RANSAC, "maxIters": _TRIALS, "confidence": _CONFIDENCE},
        "estimateAffinePartial2D": {"ransacReprojThreshold": _RANSAC, "maxIters": _TRIALS, "confidence": _CONFIDENCE},
        "createBackgroundSubtractorMOG2": {
            "history": Param(1, soft=(1, 2000), about="Frames that are remembered."),
            "varThreshold": Param(0.0, soft=(1.0, 100.0), about="How different the foreground must be."),
            "detectShadows": Param(choices=_YES_NO, about="Whether shadows are marked."),
        },
        "createBackgroundSubtractorKNN": {
            "history": Param(1, soft=(1, 2000), about="Frames that are remembered."),
            "dist2Threshold": Param(0.0, soft=(1.0, 2000.0), about="How different the foreground must be, squared."),
            "detectShadows": Param(choices=_YES_NO, about="Whether shadows are marked."),
        },
        "drawContours": {"thickness": Param(-1, soft=(-1, 20), unit="px", about="Of the line; -1: filled.")},
    },
)  # fmt: skip
