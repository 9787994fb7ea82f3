"""Compare each frame with the one before: state between frames is a delay, not a global variable.

`ep.delay` gives the graph a token `previous` that has, in each run, the value that `gray` had in the run before. So a
frame can be run again with other hyperparameters and the same previous frame, and a failed frame changes no state.
"""

import cv2
import numpy as np
from skimage import data

import epypes as ep


def frames():
    """Yield frames of a camera that moves over a photograph by 12 pixels to the right and 5 down each time."""
    photograph = data.astronaut()
    for step in range(5):
        yield photograph[5 * step : 5 * step + 400, 12 * step : 12 * step + 400]


def grayscale(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def measure_shift(gray, previous):
    """Return how far the camera has moved since the frame before, in pixels; Nothing for the first frame."""
    if previous is None:
        return ep.Nothing
    (x, y), _ = cv2.phaseCorrelate(gray, previous, cv2.createHanningWindow(gray.shape[::-1], cv2.CV_32F))
    return np.round([x, y], 1)


cg = ep.CompGraph(
    {"grayscale": grayscale, "measure_shift": measure_shift},
    {"grayscale": ("image", "gray"), "measure_shift": (("gray", "previous"), "shift")},
)
runner = ep.CompGraphRunner(ep.delay(cg, "gray", "previous", initial=None))
for number, frame in enumerate(frames()):
    run = runner.run(image=frame)
    print(f"frame {number}: {'the first one' if run['shift'] is ep.Nothing else run['shift'].tolist()}")

print(f"again: {runner.rerun('shift')['shift'].tolist()}")  # a rerun sees the same previous frame
runner.reset()
print(f"after a reset: {runner.run(image=frame)['shift']}")
