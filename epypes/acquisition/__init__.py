"""Images from files, videos and cameras, and image files that are written.

- ``acquisition``: several cameras at once, each with a thread that keeps its recent frames (``frames``)
- ``cameras``: a camera of any source, and its frames per second
- ``device``: cameras with a node map, found by ``basler`` and ``genicam``; ``camera_settings``, ``pixel_formats``
- ``device_owner``: which camera of this process has a device
- ``files``: image files and folders
- ``video``: the frames of a video file as a sequence of images
"""

from epypes.acquisition.acquisition import Counts, ImageAcquisition
from epypes.acquisition.camera_settings import CameraSetting, CameraSettings
from epypes.acquisition.cameras import Camera, camera
from epypes.acquisition.device import DeviceCamera, DeviceCounts, FoundCamera, find_cameras
from epypes.acquisition.files import read_image, write_image
from epypes.acquisition.frames import Frame, Ring
from epypes.acquisition.video import Video, VideoFrame

__all__ = [
    "Camera", "CameraSetting", "CameraSettings", "Counts", "DeviceCamera", "DeviceCounts", "FoundCamera", "Frame",
    "ImageAcquisition", "Ring", "Video", "VideoFrame", "camera", "find_cameras", "read_image", "write_image",
]  # fmt: skip
