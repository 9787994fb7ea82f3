from __future__ import annotations

import cv2
import numpy as np
import pytest

from epypes.acquisition import read_image, write_image
from epypes.acquisition.files import quiet_opencv
from epypes.errors import ImageFileError


@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 3), (20, 30, 4)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_keeps_every_value(tmp_path, shape, dtype):
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    write_image(tmp_path / "a.png", image)
    back = read_image(tmp_path / "a.png")
    assert back.dtype == dtype
    assert np.array_equal(back, image)


def test_masks_of_bool_are_written_black_and_white(tmp_path):
    write_image(tmp_path / "m.png", np.eye(9, dtype=bool))
    assert np.array_equal(read_image(tmp_path / "m.png"), np.eye(9, dtype=np.uint8) * 255)


def test_a_path_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(ImageFileError, match=r"Image '.*nothing\.png' can't be read: No such file.*Check the path"):
        read_image(tmp_path / "nothing.png")


@pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n broken"])
def test_a_file_that_is_no_image_is_named_without_noise(tmp_path, content, capfd):
    (tmp_path / "x.png").write_bytes(content)
    with pytest.raises(ImageFileError, match="is not an image that OpenCV can read"):
        read_image(tmp_path / "x.png")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "image"),
    [("a.png", np.zeros((4, 4))), ("a.png", np.zeros(4, np.uint8)), ("a.xyz", np.zeros((4, 4), np.uint8)),
     ("no/such/a.png", np.zeros((4, 4), np.uint8)), ("a", np.zeros((4, 4), np.uint8))],
)  # fmt: skip
def test_what_cannot_be_written_is_refused_with_a_way_out(tmp_path, name, image):
    with pytest.raises(ImageFileError):
        write_image(tmp_path / name, image)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_file_holds_the_colours_and_the_caller_says_their_order(tmp_path, channels):
    rgb = np.zeros((4, 5, channels), np.uint16)
    rgb[..., 0] = 700
    image = rgb[:, :, 0] if channels == 1 else rgb
    write_image(tmp_path / "red.png", image, "rgb")
    assert np.array_equal(read_image(tmp_path / "red.png", "rgb"), image)
    as_opencv = read_image(tmp_path / "red.png")
    assert (as_opencv if channels == 1 else as_opencv[:, :, 2]).max() == 700
    assert (as_opencv if channels == 1 else as_opencv[:, :, 2]).min() == 700


def test_opencv_stays_quiet_until_the_last_reader_has_done():
    # Up to OpenCV 4.12 the functions are in cv2 itself.
    logging = getattr(cv2.utils, "logging", cv2)
    before = logging.getLogLevel()
    with quiet_opencv():
        with quiet_opencv():
            pass
        assert logging.getLogLevel() == 0
    assert logging.getLogLevel() == before
