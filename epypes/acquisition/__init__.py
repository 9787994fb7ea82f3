"""Where images come from, and where they go."""

from epypes.acquisition.files import read_image, write_image

__all__ = ["read_image", "write_image"]
