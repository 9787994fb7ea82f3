"""Pictures that are larger than thumbnails: kept with a page, and asked of the kernel."""

from __future__ import annotations

import base64
import gc
import io
import re
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import epypes as ep
from epypes.display import full_picture, mimebundle

EDGE_TOKENS = ["edges", "image", "image_gray", "image_blurred"]


def kept_of(html: str) -> dict[str, Image.Image]:
    """Return by token the pictures that a page keeps."""
    found = re.findall(r'<img src="data:image/\w+;base64,([^"]*)" alt="(\w+)"', html)
    return {name: Image.open(io.BytesIO(base64.b64decode(data))) for data, name in found}


def large(photograph: np.ndarray) -> np.ndarray:
    return np.tile(photograph, (2, 2, 1))


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """This process as a kernel that Jupyter's server has started."""
    app = SimpleNamespace(connection_file="/run/kernel-0a1b-2c.json")
    kernels = SimpleNamespace(IPKernelApp=SimpleNamespace(initialized=lambda: True, instance=lambda: app))
    monkeypatch.setitem(__import__("sys").modules, "ipykernel.kernelapp", kernels)
    return app


def address_in(html: str) -> list[str]:
    return re.search(r'data-run="([^"]*)"', html)[1].split("/")


def test_a_page_keeps_pictures_of_512_pixels_sinks_and_sources_first(edge_runner, photograph):
    html = mimebundle(edge_runner.run(image=large(photograph)))["text/html"]
    kept = kept_of(html)
    assert list(kept) == EDGE_TOKENS
    assert [picture.size for picture in kept.values()] == [(600, 400), *[(512, 341)] * 3]
    assert "<img" not in mimebundle(edge_runner.last)["image/svg+xml"]


def test_kept_pictures_stay_within_their_room(photograph):
    noise = np.random.default_rng(0).integers(0, 255, (600, 600, 3)).astype(np.uint8)
    functions = {f"f{index}": lambda x: x + np.uint8(1) for index in range(20)}
    cg = ep.CompGraph(functions, {f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(20)})
    html = mimebundle(ep.CompGraphRunner(cg).run(t0=noise))["text/html"]
    sizes = [len(each) for each in re.findall(r'<img src="data:image/[jp][^"]*"', html)]
    assert 3 <= len(sizes) < 20
    assert 60_000 < sum(sizes) <= 150_000
    assert list(kept_of(html))[:2] == ["t20", "t0"]


def test_what_a_thumbnail_shows_whole_is_not_kept(edge_runner, photograph):
    assert kept_of(mimebundle(edge_runner.run(image=photograph[:100, :100].copy()))["text/html"]) == {}


def test_what_is_drawn_over_an_image_is_kept_with_it(photograph):
    cg = ep.CompGraph({"find": lambda image: np.array([[[20, 10]], [[300, 200]]])}, {"find": ("image", "points")})
    kept = kept_of(mimebundle(ep.CompGraphRunner(cg).run(image=photograph))["text/html"])
    assert list(kept) == ["points", "image"]
    red, green, blue = np.moveaxis(np.asarray(kept["points"].convert("RGB")).astype(int), 2, 0)
    assert (green - np.maximum(red, blue)).max() > 60


def test_after_a_rerun_only_what_changed_is_encoded_again(edge_runner, photograph, monkeypatch):
    mimebundle(edge_runner.run(image=photograph))
    from epypes.display.views import full_pictures

    made = []
    encode = full_pictures.scene_picture
    monkeypatch.setattr(
        full_pictures, "scene_picture", lambda scene, *room: (made.append(scene), encode(scene, *room))[1]
    )
    mimebundle(edge_runner.rerun(canny_lo=90))
    assert [scene.backdrop.name for scene in made] == ["edges", "image"], "a payload may have been filled again"


def test_the_kernel_gives_the_full_picture_of_any_token_of_a_run(edge_runner, photograph, kernel):
    run = edge_runner.run(image=photograph)
    process, name = address_in(mimebundle(run)["text/html"])
    assert process == "0a1b-2c"
    for token, mode in (("image", "RGB"), ("image_gray", "L"), ("edges", "1")):
        media, _, data = full_picture(name, token).partition(";base64,")
        picture = Image.open(io.BytesIO(base64.b64decode(data)))
        assert (picture.size, picture.mode) == ((600, 400), mode)
        assert repr(full_picture(name, token)).startswith(media), "no quotes in the kernel's answer"
    assert full_picture(name, "canny_lo") == full_picture(name, "no such token") == full_picture("other", "image") == ""


def test_an_image_of_12_mp_is_halved(edge_runner, kernel):
    run = edge_runner.run(image=np.zeros((3000, 4000, 3), np.uint8))
    data = full_picture(address_in(mimebundle(run)["text/html"])[1], "image").partition(",")[2]
    assert Image.open(io.BytesIO(base64.b64decode(data))).size == (2048, 1536)


def test_a_run_has_one_name_and_every_run_another(edge_runner, photograph, kernel):
    first, second = edge_runner.run(image=photograph), edge_runner.rerun(canny_lo=3)
    names = [
        address_in(mimebundle(shown)["text/html"])[1] for shown in (first, first, ep.show(first), second, edge_runner)
    ]
    assert names[0] == names[1] == names[2] != names[3] == names[4]


def test_a_page_keeps_no_run_alive(edge_runner, photograph, kernel):
    name = address_in(mimebundle(edge_runner.run(image=photograph))["text/html"])[1]
    run = weakref.ref(edge_runner.last)
    edge_runner.run(image=photograph)
    gc.collect()
    assert run() is None
    assert full_picture(name, "image") == ""


def test_a_figure_keeps_the_run_that_it_shows(edge_runner, photograph, kernel):
    figure = ep.show(edge_runner.run(image=photograph))
    edge_runner.run(image=photograph)
    gc.collect()
    assert full_picture(address_in(figure.html)[1], "image")


def test_outside_of_a_kernel_of_jupyters_server_a_page_names_none(edge_runner, photograph, kernel):
    kernel.connection_file = "/tmp/tmpabcd.json"
    run = edge_runner.run(image=photograph)
    assert "data-run" not in mimebundle(run)["text/html"].partition("<style")[0]
    assert "data-run" not in mimebundle(edge_runner.cg)["text/html"].partition("<style")[0]
