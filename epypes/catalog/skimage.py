"""Which values do scikit-image's functions take?

Checked against the documentation of scikit-image 0.26, and by calling each at both ends (``tests/catalog``).
"""

from __future__ import annotations

from typing import Final

from epypes.catalog.entry import Cutting, Entry, entries
from epypes.hints import Param

_SIGMA: Final = Param(0.0, soft=(0.0, 10.0), unit="px", about="Standard deviation of the Gaussian.")
_YES_NO: Final = (False, True)
_SIDE: Final = Param(1, soft=(3, 101), odd=True, unit="px", about="Side of the neighbourhood, odd.")
_STRUCTURE: Final = Param(0, soft=(0, 50), unit="px", about="Radius of the structuring element.")
_SPLINE: Final = Param(choices=(0, 1, 3, 4, 5), about="Order of the interpolation.")
_BLOB_LOW: Final = Param(0.1, soft=(0.5, 30.0), unit="px", about="Smallest standard deviation of a blob.")
_BLOB_HIGH: Final = Param(0.1, soft=(1.0, 100.0), unit="px", about="Largest standard deviation of a blob.")
_BLOB_THRESHOLD: Final = Param(0.0, soft=(0.0, 1.0), step=0.01, about="Weaker blobs are dropped.")
_BLOB_OVERLAP: Final = Param(0.0, 1.0, step=0.01, about="Blobs that overlap more are one.")
_STEPS: Final = Param(1, soft=(1, 30), about="Standard deviations tried in between.")
_ROUNDS: Final = Param(1, soft=(1, 500), about="At most so many iterations.")
_PEAKS: Final = Param(1, soft=(1, 50), unit="px", about="Least distance of two peaks.")

SKIMAGE: Final[tuple[Entry, ...]] = entries(
    "skimage",
    {
        "filters.gaussian": {
            "sigma": _SIGMA,
            "truncate": Param(0.5, soft=(1.0, 8.0), about="Where the Gaussian ends, in standard deviations."),
        },
        "filters.difference_of_gaussians": {
            "low_sigma": Param(0.0, soft=(0.0, 10.0), unit="px", about="The narrower Gaussian."),
            "high_sigma": Param(0.0, soft=(0.0, 30.0), unit="px", about="The wider Gaussian."),
        },
        "filters.threshold_local": {
            "block_size": _SIDE,
            "method": Param(choices=("gaussian", "mean", "median"), about="How the neighbourhood is averaged."),
            "offset": Param(soft=(-20, 20), about="Taken off the mean of the neighbourhood."),
        },
        "filters.threshold_niblack": {
            "window_size": _SIDE,
            "k": Param(soft=(-1.0, 1.0), step=0.01, about="Weight of the standard deviation."),
        },
        "filters.threshold_sauvola": {
            "window_size": _SIDE,
            "k": Param(soft=(0.0, 1.0), step=0.01, about="Weight of the standard deviation."),
        },
        "filters.apply_hysteresis_threshold": {
            "low": Cutting(Param(soft=(0, 255), about="Regions are followed down to this value."), "image"),
            "high": Cutting(Param(soft=(0, 255), about="Regions begin above this value."), "image"),
        },
        "filters.unsharp_mask": {
            "radius": Param(0.0, soft=(0.0, 20.0), unit="px", about="Blur that is taken off."),
            "amount": Param(soft=(0.0, 5.0), step=0.05, about="How much the details are amplified."),
        },
        "filters.laplace": {"ksize": Param(choices=(3, 5, 7), about="Side of the operator.")},
        "filters.butterworth": {
            "cutoff_frequency_ratio": Param(0.001, 0.5, step=0.001, about="Where it cuts, in sampling frequencies."),
            "high_pass": Param(choices=_YES_NO, about="Whether what is fast is kept."),
            "order": Param(0.1, soft=(1.0, 10.0), about="How sharply it cuts."),
        },
        "filters.gabor": {
            "frequency": Param(0.02, soft=(0.1, 0.5), step=0.01, unit="1/px", about="Frequency of the stripes."),
            "theta": Param(soft=(0.0, 3.1416), step=0.01, unit="rad", about="Direction of the stripes."),
            "bandwidth": Param(0.3, soft=(0.5, 3.0), about="Bandwidth, in octaves."),
        },
        "filters.threshold_multiotsu": {"classes": Param(2, soft=(2, 4), about="Classes; slow above 4.")},
        "feature.canny": {
            "sigma": _SIGMA,
            "low_threshold": Param(0.0, soft=(0.0, 1.0), step=0.01, about="Gradient from which an edge is followed."),
            "high_threshold": Param(0.0, soft=(0.0, 1.0), step=0.01, about="Gradient at which an edge begins."),
            "use_quantiles": Param(choices=_YES_NO, about="Whether the thresholds are shares of all pixels."),
        },
        "feature.peak_local_max": {
            "min_distance": _PEAKS,
            "threshold_abs": Cutting(Param(soft=(0, 255), about="Lower peaks are dropped."), "image"),
            "threshold_rel": Param(0.0, 1.0, step=0.01, about="Lower peaks, as a share of the highest, are dropped."),
        },
        "feature.corner_peaks": {
            "min_distance": _PEAKS,
            "threshold_rel": Param(0.0, 1.0, step=0.01, about="Lower peaks, as a share of the highest, are dropped."),
        },
        "feature.blob_log": {
            "min_sigma": _BLOB_LOW,
            "max_sigma": _BLOB_HIGH,
            "num_sigma": _STEPS,
            "threshold": _BLOB_THRESHOLD,
            "overlap": _BLOB_OVERLAP,
        },
        "feature.blob_dog": {
            "min_sigma": _BLOB_LOW,
            "max_sigma": _BLOB_HIGH,
            "sigma_ratio": Param(1.01, soft=(1.1, 3.0), step=0.1, about="Ratio of a standard deviation to the next."),
            "threshold": _BLOB_THRESHOLD,
            "overlap": _BLOB_OVERLAP,
        },
        "feature.blob_doh": {
            "min_sigma": Param(1.0, soft=(1.0, 30.0), unit="px", about=_BLOB_LOW.about),
            "max_sigma": Param(1.0, soft=(1.0, 100.0), unit="px", about=_BLOB_HIGH.about),
            "num_sigma": _STEPS,
            "threshold": Param(0.0, soft=(0.0, 0.1), step=0.001, about=_BLOB_THRESHOLD.about),
            "overlap": _BLOB_OVERLAP,
        },
        "feature.corner_harris": {
            "k": Param(0.0, 0.25, step=0.005, about="Harris' free parameter k."),
            "sigma": _SIGMA,
        },
        "feature.corner_shi_tomasi": {"sigma": _SIGMA},
        "feature.corner_fast": {
            "n": Param(1, 16, soft=(7, 14), about="Pixels in a row of the circle's 16."),
            "threshold": Param(0.0, soft=(0.0, 1.0), step=0.01, about="How different the circle must be."),
        },
        "feature.hog": {
            "orientations": Param(1, soft=(1, 18), about="Directions that are told apart."),
            "pixels_per_cell": Param(1, soft=(4, 32), unit="px", about="Side of a cell."),
            "cells_per_block": Param(1, soft=(1, 5), about="Cells along a block."),
        },
        "feature.local_binary_pattern": {
            "P": Param(1, soft=(4, 24), about="Points on the circle."),
            "R": Param(0.0, soft=(1.0, 8.0), unit="px", about="Radius of the circle."),
            "method": Param(choices=("default", "ror", "uniform", "nri_uniform", "var"), about="What is counted."),
        },
        "feature.match_descriptors": {
            "max_ratio": Param(0.0, 1.0, step=0.01, about="Nearest distance by the second nearest, at most."),
            "cross_check": Param(choices=_YES_NO, about="Whether both must be the other's nearest."),
        },
        "feature.ORB": {
            "downscale": Param(1.01, soft=(1.05, 2.0), step=0.01, about="Ratio of a level to the next."),
            "n_scales": Param(1, soft=(1, 16), about="Levels of the pyramid."),
            "n_keypoints": Param(1, soft=(10, 5000), about="At most so many keypoints."),
            "fast_n": Param(1, 16, soft=(7, 14), about="Pixels in a row of the circle's 16."),
            "fast_threshold": Param(0.0, soft=(0.0, 0.5), step=0.01, about="Threshold of FAST."),
            "harris_k": Param(0.0, 0.25, step=0.005, about="Harris' free parameter k."),
        },
        "restoration.denoise_tv_chambolle": {
            "weight": Param(0.001, soft=(0.01, 1.0), log=True, about="Strength: removes noise, and with it details."),
            "max_num_iter": _ROUNDS,
        },
        "restoration.denoise_tv_bregman": {
            "weight": Param(0.1, soft=(0.5, 50.0), log=True, about="Smaller values smooth more."),
            "max_num_iter": _ROUNDS,
        },
        "restoration.denoise_bilateral": {
            "win_size": Param(1, soft=(3, 31), odd=True, unit="px", about="Side of the neighbourhood, odd."),
            "sigma_color": Param(0.001, soft=(0.01, 1.0), about="How different colours may be to be mixed."),
            "sigma_spatial": Param(0.1, soft=(0.5, 20.0), unit="px", about="How far pixels may be to be mixed."),
        },
        "restoration.denoise_nl_means": {
            "patch_size": Param(1, soft=(3, 15), unit="px", about="Side of the patch compared."),
            "patch_distance": Param(1, soft=(1, 21), unit="px", about="How far patches are searched."),
            "h": Param(0.001, soft=(0.01, 0.5), step=0.01, about="Strength: removes noise, and with it details."),
            "sigma": Param(0.0, soft=(0.0, 0.5), step=0.01, about="Standard deviation of the noise."),
        },
        "restoration.rolling_ball": {"radius": Param(1, soft=(1, 200), unit="px", about="Radius of the ball.")},
        "segmentation.felzenszwalb": {
            "scale": Param(0.0, soft=(1.0, 1000.0), about="Larger values make larger segments."),
            "sigma": Param(0.0, soft=(0.0, 5.0), unit="px", about="Blur before."),
            "min_size": Param(0, soft=(0, 500), unit="px²", about="Smaller segments are merged."),
        },
        "segmentation.slic": {
            "n_segments": Param(1, soft=(2, 1000), about="About so many segments."),
            "compactness": Param(0.001, soft=(0.01, 100.0), log=True, about="Larger values make squarer segments."),
            "max_num_iter": Param(1, soft=(1, 50), about="At most so many iterations."),
            "sigma": Param(0.0, soft=(0.0, 5.0), unit="px", about="Blur before."),
        },
        "segmentation.quickshift": {
            "ratio": Param(0.0, 1.0, step=0.01, about="Weight of colours against distance."),
            "kernel_size": Param(1.0, soft=(1.0, 15.0), unit="px", about="Larger values make fewer segments."),
            "max_dist": Param(0.1, soft=(1.0, 50.0), about="Largest distance within a segment."),
            "sigma": Param(0.0, soft=(0.0, 5.0), unit="px", about="Blur before."),
        },
        "segmentation.watershed": {
            "compactness": Param(0.0, soft=(0.0, 1.0), about="Larger values make more regular basins."),
            "connectivity": Param(choices=(1, 2), about="1: neighbours by side, 2: by corner too."),
            "watershed_line": Param(choices=_YES_NO, about="Whether a line parts the basins."),
        },
        "segmentation.random_walker": {
            "beta": Param(0.0, soft=(1.0, 1000.0), about="Larger values make the walk harder."),
        },
        "segmentation.chan_vese": {
            "mu": Param(0.0, soft=(0.0, 1.0), step=0.01, about="Weight of the contour's length."),
            "lambda1": Param(0.0, soft=(0.0, 5.0), about="Weight of the inside."),
            "lambda2": Param(0.0, soft=(0.0, 5.0), about="Weight of the outside."),
            "max_num_iter": _ROUNDS,
        },
        "segmentation.expand_labels": {
            "distance": Param(0.0, soft=(0.0, 50.0), unit="px", about="How far labels grow."),
        },
        "segmentation.clear_border": {
            "buffer_size": Param(0, soft=(0, 10), unit="px", about="Width of the border looked at."),
        },
        "morphology.disk": {"radius": _STRUCTURE},
        "morphology.ball": {"radius": _STRUCTURE},
        "morphology.diamond": {"radius": _STRUCTURE},
        "morphology.remove_small_objects": {
            "min_size": Param(0, soft=(0, 1000), unit="px²", about="Smaller objects are removed."),
            "max_size": Param(0, soft=(0, 1000), unit="px²", about="Objects up to this size are removed."),
            "connectivity": Param(choices=(1, 2), about="1: neighbours by side, 2: by corner too."),
        },
        "morphology.remove_small_holes": {
            "area_threshold": Param(0, soft=(0, 1000), unit="px²", about="Smaller holes are filled."),
            "max_size": Param(0, soft=(0, 1000), unit="px²", about="Holes up to this size are filled."),
        },
        "morphology.h_maxima": {"h": Param(0.001, soft=(0.001, 100.0), log=True, about="Lower maxima are dropped.")},
        "morphology.h_minima": {"h": Param(0.001, soft=(0.001, 100.0), log=True, about="Other minima are dropped.")},
        "morphology.area_opening": {
            "area_threshold": Param(0, soft=(0, 1000), unit="px²", about="Smaller bright structures are removed."),
        },
        "exposure.equalize_adapthist": {
            "clip_limit": Param(0.0, 1.0, soft=(0.0, 0.1), step=0.001, about="Limit of the contrast."),
            "nbins": Param(2, soft=(2, 256), about="Bins of the histogram."),
        },
        "exposure.adjust_gamma": {
            "gamma": Param(0.0, soft=(0.0, 5.0), step=0.05, about="Above 1 is darker, below is brighter."),
            "gain": Param(0.0, soft=(0.0, 5.0), about="Factor."),
        },
        "exposure.adjust_sigmoid": {
            "cutoff": Param(soft=(0.0, 1.0), step=0.01, about="Brightness that stays in the middle."),
            "gain": Param(soft=(0.0, 30.0), step=0.1, about="Contrast."),
        },
        "exposure.adjust_log": {"gain": Param(soft=(0.0, 5.0), step=0.05, about="Factor.")},
        "transform.rescale": {
            "scale": Param(0.01, soft=(0.05, 4.0), about="Size of the result by that of the image."),
            "order": _SPLINE,
        },
        "transform.rotate": {
            "angle": Param(soft=(-180.0, 180.0), step=0.5, unit="deg", about="Angle, against the clock."),
            "order": _SPLINE,
            "resize": Param(choices=_YES_NO, about="Whether the whole result is kept."),
        },
        "transform.swirl": {
            "strength": Param(soft=(0.0, 20.0), step=0.1, about="How much is turned."),
            "radius": Param(0.1, soft=(1.0, 500.0), unit="px", about="How far it reaches."),
            "rotation": Param(soft=(-3.1416, 3.1416), step=0.01, unit="rad", about="Turn of the whole."),
        },
        "transform.pyramid_reduce": {"downscale": Param(1.01, soft=(1.1, 8.0), about="How much smaller.")},
        "transform.probabilistic_hough_line": {
            "threshold": Param(0, soft=(1, 300), about="Least votes of a line."),
            "line_length": Param(0, soft=(0, 300), unit="px", about="Shorter lines are dropped."),
            "line_gap": Param(0, soft=(0, 100), unit="px", about="Largest gap within one line."),
        },
        "transform.hough_line_peaks": {
            "min_distance": Param(1, soft=(1, 100), unit="px", about="Least distance of two lines."),
            "min_angle": Param(1, soft=(1, 90), about="Least difference of two angles, in steps."),
        },
        "transform.hough_circle_peaks": {
            "min_xdistance": Param(1, soft=(1, 200), unit="px", about="Least distance of two centres along x."),
            "min_ydistance": Param(1, soft=(1, 200), unit="px", about="Least distance of two centres along y."),
        },
        "measure.find_contours": {"level": Cutting(Param(soft=(0, 255), about="Value along the contours."), "image")},
        "measure.approximate_polygon": {
            "tolerance": Param(0.0, soft=(0.0, 50.0), unit="px", about="How far the polygon may be off the curve."),
        },
        "measure.label": {"connectivity": Param(choices=(1, 2), about="1: neighbours by side, 2: by corner too.")},
        "measure.ransac": {
            "min_samples": Param(1, soft=(2, 20), about="Points that a model is made of."),
            "residual_threshold": Param(0.0, soft=(0.1, 20.0), about="How far an inlier may be off."),
            "max_trials": Param(0, soft=(10, 5000), about="At most so many trials."),
            "stop_probability": Param(0.0, 1.0, step=0.01, about="Confidence at which it stops."),
        },
    },
)
