"""The edge graph of the paper, run, read and tuned as in EPypes 0.1."""

import cv2
import numpy as np
from epypes.compgraph import CompGraph, CompGraphRunner

image = np.random.default_rng(1).integers(0, 255, (60, 80, 3), np.uint8)


def grayscale(im):
    return cv2.cvtColor(im, cv2.COLOR_BGR2GRAY)


def gaussian_blur(img, kernel):
    return cv2.GaussianBlur(img, (kernel, kernel), 0)


func_dict = {"grayscale": grayscale, "canny": cv2.Canny, "blur": gaussian_blur}
func_io = {
    "grayscale": ("image", "image_gray"),
    "blur": (("image_gray", "blur_kernel"), "image_blurred"),
    "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
}
cg = CompGraph(func_dict, func_io)
runner = CompGraphRunner(cg, frozen_tokens={"blur_kernel": 5, "canny_lo": 30, "canny_hi": 90})
runner.run(image=image)

assert set(runner.required_source_tokens) == {"image"}
assert runner.frozen_tokens["blur_kernel"] == 5
expected = cv2.Canny(cv2.GaussianBlur(grayscale(image), (5, 5), 0), 30, 90)
assert np.array_equal(runner.token_value("edges"), expected)
assert np.array_equal(runner["edges"], expected)

runner.freeze_token("blur_kernel", 9)
runner.run(image=image)
assert np.array_equal(runner["edges"], cv2.Canny(cv2.GaussianBlur(grayscale(image), (9, 9), 0), 30, 90))
assert set(cg.source_tokens) == {"image", "blur_kernel", "canny_lo", "canny_hi"}
