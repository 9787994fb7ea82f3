"""Put an object that is loaded once, such as a trained model, into a graph as a node.

Every function of a graph runs as an `ep.Node`. A subclass loads what it needs when it is made, and releases it when its
pipeline stops.
"""

import cv2
from skimage import data
from skimage.feature import Cascade

import epypes as ep


class FaceDetector(ep.Node):
    """Finds faces; its model is loaded once, not at every run."""

    def __init__(self, name, model_file):
        self.model = Cascade(model_file)
        super().__init__(name, self.detect)

    def detect(self, image_gray, scale, least):
        """Return the boxes of faces, or Nothing: then functions that take the boxes are skipped."""
        boxes = self.model.detect_multi_scale(image_gray, scale, 1, (least, least), (3 * least, 3 * least))
        return boxes or ep.Nothing

    def stop(self):
        """Release the model; a pipeline calls it for each of its nodes when it stops."""
        self.model = None


def grayscale(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def cut_out(image, faces):
    """Return the image of the first face."""
    top, left = faces[0]["r"], faces[0]["c"]
    return image[top : top + faces[0]["height"], left : left + faces[0]["width"]]


detector = FaceDetector("detector", data.lbp_frontal_face_cascade_filename())
cg = ep.CompGraph(
    {"grayscale": grayscale, "detector": detector, "cut_out": cut_out},
    {
        "grayscale": ("image", "image_gray"),
        "detector": (("image_gray", "scale", "least"), "faces"),
        "cut_out": (("image", "faces"), "portrait"),
    },
)
pipe = ep.Pipeline("portraits", cg, {"scale": 1.2, "least": 60})
for name in ("astronaut", "coffee"):
    portrait = pipe(getattr(data, name)())
    print(f"{name}: {'no face' if portrait is ep.Nothing else portrait.shape}")
print(f"the detector ran {detector.run_count} times, the last time for {detector.time * 1e3:.0f} ms")
pipe.stop()
