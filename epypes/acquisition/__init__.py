"""Where images come from, and where they go."""

from epypes.acquisition.acquisition import ImageAcquisition
from epypes.acquisition.cameras import camera
from epypes.acquisition.files import read_image, write_image
from epypes.acquisition.frames import Frame
from epypes.acquisition.pace import Camera
from epypes.acquisition.ring import Ring
from epypes.acquisition.worker import Counts

__all__ = ["Camera", "Counts", "Frame", "ImageAcquisition", "Ring", "camera", "read_image", "write_image"]
