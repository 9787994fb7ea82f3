"""An RGB notebook computes the same in the notebook, in its service, and from a file."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image
from skimage import data

import epypes as ep
from epypes.acquisition import write_image
from epypes.service import Client, Service
from epypes.service.state_file import StateLock
from tests.bundle.test_slicer import notebook

pytestmark = pytest.mark.slow

ANY = "tcp://127.0.0.1:*"

LANE = '''
def grayscale(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def weighted(image, red, green):
    """Yellow and white paint: much red and green."""
    return image[..., 0] * red + image[..., 1] * green


def edges(grey, low, high):
    return cv2.Canny(cv2.GaussianBlur(grey, (5, 5), 0), low, high)


def lines(edge_image):
    found = cv2.HoughLinesP(edge_image, 1, np.pi / 180, 40, minLineLength=30, maxLineGap=10)
    return np.zeros((0, 4), np.int32) if found is None else found.reshape(-1, 4)


def score(paint, edge_image):
    return float(paint[edge_image > 0].mean())


def paint_by_column(paint):
    return paint.mean(axis=0)


def mean_line(segments):
    return {"from": segments[:, :2].mean(axis=0), "to": segments[:, 2:].mean(axis=0)}


def overlay(image, segments):
    drawn = np.copy(image)
    for x0, y0, x1, y1 in segments.tolist():
        cv2.line(drawn, (x0, y0), (x1, y1), (255, 0, 0), 2)
    return drawn
'''
IO = {
    "grayscale": ("image", "grey"),
    "weighted": (("image", "red", "green"), "paint"),
    "edges": (("grey", "low", "high"), "edge_image"),
    "lines": ("edge_image", "segments"),
    "score": (("paint", "edge_image"), "score"),
    "paint_by_column": ("paint", "columns"),
    "mean_line": ("segments", "line"),
    "overlay": (("image", "segments"), "drawing"),
}


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    """A file, and the image as Matplotlib and Pillow read it: RGB."""
    path = tmp_path_factory.mktemp("photos") / "coffee.png"
    Image.fromarray(data.coffee()[::2, ::2]).save(path)
    return path, np.asarray(Image.open(path))


@pytest.fixture(scope="module")
def lane(photo, tmp_path_factory):
    names = notebook(LANE)
    runner = ep.CompGraphRunner(
        ep.CompGraph({name: names[name] for name in IO}, IO), {"red": 0.7, "green": 0.3, "low": 60, "high": 160}
    )
    run = runner.run(image=photo[1])
    lines = []
    bundle = ep.promote(
        runner,
        tmp_path_factory.mktemp("bundles") / "lane",
        outputs=["score", "columns", "line", "drawing"],
        on_progress=lines.append,
    )
    assert not [line for line in lines if "assumed" in line]
    return run, bundle


@pytest.fixture
def served(own_folders):
    def serve(bundle):
        lock = StateLock(bundle.path)
        service = Service(bundle.path, ANY, ANY)
        started.extend((service, lock))
        lock.__enter__()
        lock.publish(service.start())
        return service

    started: list = []
    yield serve
    for service, lock in zip(started[::2], started[1::2], strict=True):
        service.stop()
        lock.__exit__(None, None, None)


def test_an_rgb_graph_gives_the_same_numbers_from_notebook_service_and_file(epypes, served, lane, photo, tmp_path):
    run, bundle = lane
    path, image = photo
    assert run["score"] != ep.load(bundle.path).run(image=image[..., ::-1].copy())["score"], "the order does matter"
    served(bundle)
    with Client(bundle.path, timeout_s=60) as client:
        answer = client.call({"image": image}).tokens
    done = epypes("call", bundle.path, path, "--out", f"drawing={tmp_path}/drawing.png")
    assert done.returncode == 0, done.stderr
    assert answer["score"] == run["score"]
    assert f"\nscore = {run['score']!r}\n" in done.stdout
    assert np.array_equal(answer["drawing"], run["drawing"])
    assert np.array_equal(np.asarray(Image.open(tmp_path / "drawing.png")), run["drawing"])
    assert f"image = {path}, read as rgb, as in function 'grayscale'" in done.stdout
    assert done.stderr == ""
    columns, line = run["columns"].tolist(), {key: value.tolist() for key, value in run["line"].items()}
    shown = ", ".join([*map(str, columns[:6]), "...", *map(str, columns[-6:])])
    assert f"\ncolumns = [{shown}] (300 in all)\n" in done.stdout, "a vector is its numbers"
    assert f"\nline = {line!r}\n" in done.stdout


def test_many_files_are_read_in_the_order_that_the_graph_takes(lane, photo):
    run, bundle = lane
    (row,) = ep.map(ep.load(bundle.path), [photo[0]]).to_frame().to_dict("records")
    assert row["score"] == run["score"]


def test_the_service_says_which_orders_it_uses(served, lane):
    assert served(lane[1]).info()["colours"] == {
        "image": "rgb, as in function 'grayscale'",
        "drawing": "rgb, as in function 'grayscale'",
    }


def test_a_file_on_an_assumed_order_is_a_warning_of_one_line(epypes, served, photograph, tmp_path):
    cg = ep.CompGraph({"split": cv2.split}, {"split": ("image", ("first", "second", "third"))})
    runner = ep.CompGraphRunner(cg)
    runner.run(image=photograph)
    bundle = ep.promote(runner, tmp_path / "split", outputs=["first"])
    write_image(tmp_path / "photo.png", photograph)
    served(bundle)
    done = epypes("call", bundle.path, tmp_path / "photo.png", "--out", tmp_path / "first.png")
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("Warning: no function says the order of the colours of 'image'; the file is read or written")
    assert f"image = {tmp_path / 'photo.png'}, read as bgr, assumed" in done.stdout
