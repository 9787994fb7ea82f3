"""Measure every image of a folder, and print a table with a row per image.

    python folder_of_images.py FOLDER

Without a folder it takes the images that come with scikit-image. An image that fails becomes a row with the reason; the
others go on.
"""

import sys

import cv2
import skimage

import epypes as ep


def gray(image):
    """Return one channel of an image, which may be gray already."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def edges(gray, low=70, high=200):
    """Return the edges; a parameter with a default is a hyperparameter."""
    return cv2.Canny(gray, low, high)


def edge_share(edges):
    """Return the share of pixels that are edges."""
    return float((edges > 0).mean())


def main(folder):
    """Print the share of edge pixels of each image for two values of a hyperparameter."""
    # The parameter `gray` takes the value of the function `gray`: names connect functions.
    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(gray, edges, edge_share))
    for low in (20, 70):
        runner["low"] = low
        table = ep.map(runner, folder).to_frame()
        print(f"low = {low}")
        print(table[["name", "edge_share", "failure"]].to_string(index=False))


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else skimage.data_dir)
