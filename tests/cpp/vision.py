"""Functions as vision engineers write them, in the form of `tests.cpp.differences`."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from skimage import data

SOURCE = '''\
import math

import cv2
import numpy as np

ASPECT = (0.5, 2.0)
LOWER_RED = np.array([0, 60, 50])
UPPER_RED = np.array([12, 255, 255])


def large_contours(mask, min_area=40.0):
    """Return the contours whose area is large enough, the largest first."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    kept = [c for c in contours if cv2.contourArea(c) >= min_area]
    return sorted(kept, key=cv2.contourArea, reverse=True)


def boxes_of_contours(mask, min_area=40):
    boxes = []
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_TREE, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        x, y, w, h = cv2.boundingRect(contour)
        if w * h < min_area or not ASPECT[0] <= w / h <= ASPECT[1]:
            continue
        boxes.append((x, y, w, h))
    return np.array(boxes, np.int32).reshape(-1, 4)


def red_mask(image):
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    low = cv2.inRange(hsv, LOWER_RED, UPPER_RED)
    high = cv2.inRange(hsv, (168, 60, 50), (180, 255, 255))
    return cv2.bitwise_or(low, high)


def share_of_colour(image, hue_lo=5, hue_hi=25):
    hue = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)[:, :, 0]
    return float(((hue >= hue_lo) & (hue <= hue_hi)).mean())


def cleaned(mask, size=3, iterations=2):
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel, iterations=iterations)
    return cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel)


def hough_lines(gray, votes=30):
    edges = cv2.Canny(gray, 50, 150, apertureSize=3)
    lines = cv2.HoughLinesP(edges, 1, np.pi / 180, votes, minLineLength=20, maxLineGap=5)
    if lines is None:
        return np.zeros((0, 4), np.int32)
    return lines.reshape(-1, 4)


def straight_parts(gray):
    return cv2.HoughLinesP(cv2.Canny(gray, 50, 150), 1, np.pi / 180, 30, minLineLength=20, maxLineGap=5)


def white_pixels(mask):
    return cv2.findNonZero(mask)


def corner_points(gray):
    return cv2.goodFeaturesToTrack(gray, 20, 0.01, 5)


def half_size(gray):
    return cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST)


def angles_of_lines(lines):
    angles = []
    for x1, y1, x2, y2 in lines:
        angle = math.degrees(math.atan2(y2 - y1, x2 - x1)) % 180
        if 20 < angle < 160:
            angles.append(angle)
    return np.median(angles) if angles else -1.0


def circles(gray):
    found = cv2.HoughCircles(gray, cv2.HOUGH_GRADIENT, dp=1, minDist=20, param1=100, param2=20, minRadius=8, maxRadius=30)
    return 0 if found is None else len(found.reshape(-1, 3))


def from_above(image, corners, width=60, height=40):
    target = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    matrix = cv2.getPerspectiveTransform(corners, target)
    return cv2.warpPerspective(image, matrix, (width, height), flags=cv2.INTER_NEAREST)


def ordered_corners(points):
    """Return four points clockwise, the top left one first."""
    ordered = np.zeros((4, 2), np.float32)
    s = points.sum(axis=1)
    ordered[0] = points[np.argmin(s)]
    ordered[2] = points[np.argmax(s)]
    d = np.diff(points, axis=1)
    ordered[1] = points[np.argmin(d)]
    ordered[3] = points[np.argmax(d)]
    return ordered


def components(mask, smallest=20):
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(mask, connectivity=8)
    kept = np.zeros_like(mask)
    areas = []
    for label in range(1, count):
        area = stats[label, cv2.CC_STAT_AREA]
        if area >= smallest:
            kept[labels == label] = 255
            areas.append(int(area))
    return kept, areas


def centre_of_mass(mask):
    m = cv2.moments(mask, binaryImage=True)
    if m["m00"] == 0:
        return -1.0, -1.0
    return m["m10"] / m["m00"], m["m01"] / m["m00"]


def histogram(gray, bins=16):
    counts = cv2.calcHist([gray], [0], None, [bins], [0, 256])
    return (counts / counts.sum()).ravel()


def otsu_by_hand(gray):
    counts = np.bincount(gray.ravel(), minlength=256)
    total = gray.size
    best, best_variance = 0, -1.0
    for level in range(1, 256):
        low, high = counts[:level].sum(), counts[level:].sum()
        if low == 0 or high == 0:
            continue
        mean_low = (np.arange(level) * counts[:level]).sum() / low
        mean_high = (np.arange(level, 256) * counts[level:]).sum() / high
        variance = low / total * (high / total) * (mean_low - mean_high) ** 2
        if variance > best_variance:
            best, best_variance = level, variance
    return best


def matched_template(gray, template, least=0.8):
    scores = cv2.matchTemplate(gray, template, cv2.TM_CCOEFF_NORMED)
    _, best, _, place = cv2.minMaxLoc(scores)
    return place if best >= least else (-1, -1)


def blob_statistics(gray, labels):
    rows = []
    for label in range(1, labels.max() + 1):
        pixels = gray[labels == label]
        if pixels.size == 0:
            continue
        rows.append((label, pixels.size, float(pixels.mean()), int(pixels.max()) - int(pixels.min())))
    return rows


def cut_out(image, region, margin=4):
    """Return the part of the image, with a margin, as far as it is in the image."""
    x, y, w, h = region
    height, width = image.shape[:2]
    x0, y0 = max(0, x - margin), max(0, y - margin)
    x1, y1 = min(width, x + w + margin), min(height, y + h + margin)
    if x1 <= x0 or y1 <= y0:
        return np.zeros((0, 0, 3), np.uint8)
    return image[y0:y1, x0:x1]


def moving_threshold(gray, previous, alpha=0.1):
    """Return the mask of what has changed, and the new background."""
    background = previous * (1 - alpha) + gray * alpha
    changed = np.abs(gray - background) > 25
    return changed.astype(np.uint8) * 255, background


def threshold_of_row(profile, window=5, offset=3.0):
    out = []
    for i in range(len(profile)):
        lo, hi = max(0, i - window), min(len(profile), i + window + 1)
        local = sum(int(v) for v in profile[lo:hi]) / (hi - lo)
        out.append(profile[i] > local + offset)
    return np.array(out)


def sharpness(gray):
    return cv2.Laplacian(gray, cv2.CV_64F).var()


def unsharp(gray, amount=1.5):
    blurred = cv2.GaussianBlur(gray, (0, 0), 2)
    return np.clip(gray + amount * (gray.astype(np.float32) - blurred), 0, 255).astype(np.uint8)


def gamma(gray, value=0.7):
    table = ((np.arange(256) / 255.0) ** value * 255).astype(np.uint8)
    return cv2.LUT(gray, table)


def stretched(gray):
    lo, hi = np.percentile(gray, (2, 98))
    return np.clip((gray - lo) * 255.0 / max(hi - lo, 1), 0, 255).astype(np.uint8)


def gradient(gray):
    gx = cv2.Sobel(gray, cv2.CV_32F, 1, 0)
    gy = cv2.Sobel(gray, cv2.CV_32F, 0, 1)
    magnitude, angle = cv2.cartToPolar(gx, gy, angleInDegrees=True)
    return magnitude > 100, angle.max() < 361


def iou(a, b):
    ax, ay, aw, ah = a
    bx, by, bw, bh = b
    w = max(0, min(ax + aw, bx + bw) - max(ax, bx))
    h = max(0, min(ay + ah, by + bh) - max(ay, by))
    intersection = w * h
    union = aw * ah + bw * bh - intersection
    return intersection / union if union else 0.0


def suppressed(boxes, scores, overlap=0.3):
    """Return the indices of the boxes that remain: greedy non-maximum suppression."""
    order = np.argsort(-scores)
    kept = []
    for i in order:
        if all(iou(boxes[i], boxes[j]) <= overlap for j in kept):
            kept.append(int(i))
    return kept


def drawn_boxes(image, boxes):
    shown = image.copy()
    for i, (x, y, w, h) in enumerate(boxes):
        colour = (0, 255, 0) if i % 2 == 0 else (0, 0, 255)
        cv2.rectangle(shown, (x, y), (x + w, y + h), colour, 2)
        cv2.putText(shown, f"{i}", (x, y - 2), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1)
    return shown


def rotated(image, angle=30.0, scale=0.8):
    h, w = image.shape[:2]
    matrix = cv2.getRotationMatrix2D((w / 2, h / 2), angle, scale)
    return cv2.warpAffine(image, matrix, (w, h), flags=cv2.INTER_NEAREST, borderValue=(9, 9, 9))


def largest_rectangle(mask):
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not contours:
        return None
    biggest = max(contours, key=cv2.contourArea)
    (cx, cy), (w, h), angle = cv2.minAreaRect(biggest)
    return round(cx), round(cy), int(w), int(h)


def polygon_corners(mask, tolerance=0.02):
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    counts = []
    for contour in contours:
        approximated = cv2.approxPolyDP(contour, tolerance * cv2.arcLength(contour, True), True)
        counts.append(len(approximated))
    return counts, cv2.isContourConvex(contours[0])


def focus_map(gray, block=20):
    h, w = gray.shape
    result = np.zeros((h // block, w // block), np.float32)
    for i in range(h // block):
        for j in range(w // block):
            tile = gray[i * block : (i + 1) * block, j * block : (j + 1) * block]
            result[i, j] = tile.std()
    return result


def peaks(profile, least=100):
    found = []
    for i in range(1, len(profile) - 1):
        if profile[i - 1] < profile[i] >= profile[i + 1] and profile[i] >= least:
            found.append(i)
    return np.array(found)
'''

_COINS = data.coins()[20:140, 30:190]
_GRAYS = [(_COINS,), (cv2.flip(data.coins()[100:220, 100:260], 1),)]
_MASKS = [((image > 120).astype(np.uint8) * 255,) for (image,) in _GRAYS]
_COFFEE = cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)
_IMAGES = [(np.ascontiguousarray(_COFFEE[60:180, 200:360]),), (np.ascontiguousarray(_COFFEE[200:320, 20:180]),)]
_LINES = np.array([[0, 0, 10, 10], [5, 40, 8, 3], [2, 2, 60, 3]], np.int32)
_BOXES = np.array([[10, 10, 30, 20], [12, 11, 30, 20], [60, 40, 10, 12], [100, 90, 40, 40]], np.int32)
_CORNERS = np.float32([[20, 10], [140, 20], [150, 110], [10, 100]])
_BLOBS = [cv2.connectedComponents(mask)[1] for (mask,) in _MASKS]

INPUTS: dict[str, list[tuple[Any, ...]]] = {
    "large_contours": [(*mask, 40.0) for mask in _MASKS],
    "boxes_of_contours": [(*mask, 40) for mask in _MASKS],
    "red_mask": _IMAGES,
    "share_of_colour": [(*image, 5, 25) for image in _IMAGES],
    "cleaned": [(*mask, 3, 2) for mask in _MASKS],
    "hough_lines": [(*gray, 30) for gray in _GRAYS],
    "straight_parts": _GRAYS,
    "white_pixels": _MASKS,
    "corner_points": _GRAYS,
    "half_size": _GRAYS,
    "angles_of_lines": [(_LINES,), (_LINES[2:],)],
    "circles": _GRAYS,
    "from_above": [(*image, _CORNERS, 60, 40) for image in _IMAGES],
    "ordered_corners": [(_CORNERS[[2, 0, 1, 3]],), (_CORNERS[::-1].copy(),)],
    "components": [(*mask, 20) for mask in _MASKS],
    "centre_of_mass": [*_MASKS, (np.zeros((5, 5), np.uint8),)],
    "histogram": [(*gray, 16) for gray in _GRAYS],
    "otsu_by_hand": _GRAYS,
    "matched_template": [(_COINS, _COINS[30:60, 40:75].copy(), 0.8), (_COINS, 255 - _COINS[30:60, 40:75], 0.8)],
    "blob_statistics": [(*gray, labels) for gray, labels in zip(_GRAYS, _BLOBS, strict=True)],
    "cut_out": [
        (_IMAGES[0][0], (10, 20, 30, 40), 4),
        (_IMAGES[0][0], (-3, 100, 30, 40), 4),
        (_IMAGES[0][0], (500, 1, 2, 2), 4),
    ],
    "moving_threshold": [(*gray, np.roll(*gray, 7).astype(np.float32), 0.1) for gray in _GRAYS],
    "threshold_of_row": [(_COINS[60], 5, 3.0), (_COINS[80], 4, -1.0)],
    "sharpness": _GRAYS,
    "unsharp": [(*gray, 1.5) for gray in _GRAYS],
    "gamma": [(*gray, 0.7) for gray in _GRAYS],
    "stretched": _GRAYS,
    "gradient": _GRAYS,
    "iou": [((0, 0, 10, 10), (5, 5, 10, 10)), ((0, 0, 1, 1), (5, 5, 0, 0)), ((0, 0, 0, 0), (0, 0, 0, 0))],
    "suppressed": [(_BOXES, np.array([0.5, 0.9, 0.3, 0.4]), 0.3), (_BOXES, np.array([0.9, 0.5, 0.3, 0.4]), 0.9)],
    "drawn_boxes": [(image, _BOXES) for (image,) in _IMAGES],
    "rotated": [(*image, 30.0, 0.8) for image in _IMAGES],
    "largest_rectangle": _MASKS,
    "polygon_corners": [(*mask, 0.02) for mask in _MASKS],
    "focus_map": [(*gray, 20) for gray in _GRAYS],
    "peaks": [(_COINS[60], 100), (_COINS[80], 120)],
}
