"""Images from files, videos and cameras, and image files that are written.

- ``acquisition``: several cameras at once, each with a thread (``worker``) that keeps its recent frames (``frames``)
- ``cameras``: a camera of any source; ``captures`` those of OpenCV's VideoCapture, ``pace`` their frames per second
- ``files``: image files and folders
"""

from epypes.acquisition.acquisition import ImageAcquisition
from epypes.acquisition.cameras import camera
from epypes.acquisition.files import read_image, write_image
from epypes.acquisition.frames import Frame, Ring
from epypes.acquisition.pace import Camera
from epypes.acquisition.worker import Counts

__all__ = ["Camera", "Counts", "Frame", "ImageAcquisition", "Ring", "camera", "read_image", "write_image"]
