"""The two lines of the lane in which a car drives, found in the picture of a camera behind its windscreen.

Images are uint8, (height, width, 3), RGB. A line is (x at the bottom of the image, x at the horizon), float64, in
pixels; a lane is two of them, float64, (2, 2), left and right, and NaN where no line was found.
"""

import cv2
import numpy as np

# Where the road ends, as a share of the image's height.
HORIZON = 0.55


def gray(image):
    """Return an RGB image as uint8, (height, width)."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def road(edges):
    """Return edges with nothing but a trapezoid before the car."""
    height, width = edges.shape
    corners = [(0.02, 1.0), (0.42, HORIZON + 0.03), (0.58, HORIZON + 0.03), (0.98, 1.0)]
    mask = np.zeros_like(edges)
    cv2.fillConvexPoly(mask, np.array([(x * width, y * height) for x, y in corners], np.int32), 255)
    return cv2.bitwise_and(edges, mask)


def segments(edges, votes, min_length, max_gap):
    """Return the straight segments of edges as x1, y1, x2, y2: int32, (n, 4)."""
    found = cv2.HoughLinesP(edges, 1, np.pi / 180, votes, minLineLength=min_length, maxLineGap=max_gap)
    return np.zeros((0, 4), np.int32) if found is None else found.reshape(-1, 4)


def lane(found, edges):
    """Return the lane that segments make: the mean line of those that lean to the right, and of those to the left."""
    height, width = edges.shape
    x1, y1, x2, y2 = found.T.astype(float)
    rise = np.where(y1 == y2, 1e-9, y2 - y1)
    lean = (x2 - x1) / rise
    bottom, top = x1 + (height - y1) * lean, x1 + (HORIZON * height - y1) * lean
    lines = np.full((2, 2), np.nan)
    for side, is_side in enumerate(((lean < -0.3) & (bottom < width / 2), (lean > 0.3) & (bottom > width / 2))):
        is_side &= np.abs(lean) < 3
        if is_side.any():
            weights = np.hypot(x2 - x1, y2 - y1)[is_side]
            lines[side] = np.average(bottom[is_side], weights=weights), np.average(top[is_side], weights=weights)
    return lines


def smooth(lines, before, weight):
    """Return a lane as the mean of this frame's and the one before; a line that is missing stays where it was."""
    if before is None:
        return lines
    mixed = weight * lines + (1 - weight) * before
    return np.where(np.isnan(lines), before, np.where(np.isnan(before), lines, mixed))


def offset(steady, image):
    """Return how far the car stands right of the lane's middle, as a share of the lane's width."""
    left, right = steady[:, 0]
    return float((image.shape[1] / 2 - (left + right) / 2) / (right - left))


def draw(image, steady):
    """Return the image with the lane on it."""
    height = image.shape[0]
    shown = image.copy()
    if not np.isnan(steady).any():
        (left, far_left), (right, far_right) = steady
        corners = [(left, height), (far_left, HORIZON * height), (far_right, HORIZON * height), (right, height)]
        cv2.fillConvexPoly(shown, np.array(corners, np.int32), (0, 160, 90))
    return cv2.addWeighted(image, 0.6, shown, 0.4, 0)
