"""The order of a token's colours, as the source of functions says it."""

from __future__ import annotations

import functools
import linecache
import subprocess
import sys
from typing import Annotated

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest
import skimage.color
from skimage.color import rgb2gray

import epypes as ep
from epypes.errors import GraphError
from epypes.graph import colour_order


def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def saturation(image):
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    return hsv[..., 1]


def to_rgb(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def reversed_channels(image):
    return image[..., ::-1]


def blur(image, k):
    size = (k, k)
    out = cv2.GaussianBlur(image, size, 0)
    return out  # noqa: RET504 - as it is written in notebooks


def cropped(image):
    return image[10:20, ::2].copy() / 255.0


def outlined(image, lines):
    out = np.copy(image)
    for x0, y0, x1, y1 in lines:
        cv2.line(out, (x0, y0), (x1, y1), (255, 0, 0), 3)
    out[0, 0] = (255, 0, 0)
    return out


def graph(**functions):
    return ep.CompGraph(
        {name: f for name, (f, _) in functions.items()}, {name: io for name, (_, io) in functions.items()}
    )


def orders(**functions):
    return {token: found.order for token, found in graph(**functions).colours.items()}


# -- one function ------------------------------------------------------------------------------------------------------


def if_coloured(image):
    if image.ndim == 2:
        return image
    if len(image.shape) == 3 and image.shape[2] == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return image


def by_helper(image):
    return if_coloured(blur(image, 3))


def scikit_image(image):
    return rgb2gray(image)


def scikit_image_of_bgr(image):
    return skimage.color.rgb2lab(image[:, :, ::-1])


def shown(image):
    _, axes = plt.subplots(1, 2)
    axes[1].imshow(image)
    return axes


def shown_by_pyplot(image):
    plt.imshow(image)


def shown_as_rgb(image):
    plt.imshow(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def imported_inside(image):
    import cv2 as vision

    return vision.cvtColor(src=image, code=vision.COLOR_RGB2HSV)


def written_by_opencv(image):
    copy = image.copy()
    cv2.cvtColor(copy, cv2.COLOR_BGR2RGB, copy)
    return cv2.cvtColor(copy, cv2.COLOR_RGB2GRAY)


class Camera:
    def gray(self, image):
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


@pytest.mark.parametrize(
    ("function", "order"),
    [
        (gray, "rgb"),
        (saturation, "bgr"),
        (if_coloured, "rgb"),
        (by_helper, "rgb"),
        (scikit_image, "rgb"),
        (scikit_image_of_bgr, "bgr"),
        (shown, "rgb"),
        (shown_by_pyplot, "rgb"),
        (shown_as_rgb, "bgr"),
        (imported_inside, "rgb"),
        (Camera().gray, "rgb"),
        (skimage.color.rgb2hsv, "rgb"),
        (functools.partial(cv2.cvtColor, code=cv2.COLOR_RGB2GRAY), "rgb"),
        (functools.partial(cv2.cvtColor, code=cv2.COLOR_BGR2Lab), "bgr"),
        (functools.lru_cache(gray), "rgb"),
        (ep.Node("node", gray), "rgb"),
        (ep.Pipeline("inner", ep.CompGraph({"gray": gray}, {"gray": ("image", "grey")})), "rgb"),
        (lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), "rgb"),
        (to_rgb, "bgr"),
        (written_by_opencv, "bgr"),
    ],
)
def test_a_function_says_the_order_in_which_it_takes_an_image(function, order):
    cg = graph(f=(function, ("image", "out")))
    assert colour_order(cg, "image") == order
    assert (cg.colours["image"].function, str(cg.colours["image"])) == ("f", f"{order}, as in function 'f'")


def asks(image, is_bgr):
    if is_bgr:
        return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def both(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def perhaps(image, convert):
    if convert:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def perhaps_before(image, convert):
    if convert:
        return image
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def of_something_else(image):
    other = np.zeros_like(image)
    return cv2.cvtColor(other, cv2.COLOR_RGB2GRAY)


def exchanged_in_place(image):
    copy = image.copy()
    copy[..., [0, 2]] = copy[..., [2, 0]]
    return cv2.cvtColor(copy, cv2.COLOR_RGB2GRAY)


def repeated(image):
    for _ in range(2):
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def of_a_sensor(image):
    return cv2.cvtColor(image, cv2.COLOR_BayerBG2GRAY)


def of_a_map(image):
    plt.imshow(image, cmap="gray")


def of_a_map_by_position(image):
    plt.imshow(image, "gray")


def other_axis(image):
    return skimage.color.rgb2gray(image, channel_axis=0)


def another_library(image):
    class cv2:
        COLOR_RGB2GRAY = 1

        @staticmethod
        def cvtColor(image, code):
            return image

    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def converting(function):
    @functools.wraps(function)
    def wrapper(image):
        return function(image[..., ::-1])

    return wrapper


class Odd:
    def __init__(self):
        self.__wrapped__ = gray

    def __call__(self, image):
        return image


@pytest.mark.parametrize(
    ("function", "inputs"),
    [
        (asks, 2), (both, 1), (perhaps, 2), (perhaps_before, 2), (of_something_else, 1), (exchanged_in_place, 1),
        (repeated, 1), (of_a_sensor, 1), (of_a_map, 1), (of_a_map_by_position, 1), (other_axis, 1),
        (another_library, 1),
        (converting(gray), 1), (Odd(), 1), (cv2.cvtColor, 2), (functools.partial(cv2.cvtColor, code=4), 1),
    ],
)  # fmt: skip
def test_where_nothing_is_sure_nothing_is_inferred(function, inputs):
    assert orders(f=(function, (("image", "more")[:inputs], ()))) == {}


def test_of_two_lambdas_in_one_line_each_says_its_own():
    a, b = (lambda im: cv2.cvtColor(im, cv2.COLOR_RGB2GRAY)), (lambda im: cv2.cvtColor(im, cv2.COLOR_BGR2GRAY))
    assert orders(a=(a, ("x", "y")), b=(b, ("z", "w"))) == {"x": "rgb", "z": "bgr"}


def test_a_function_without_source_says_nothing():
    names = {"cv2": cv2}
    exec("def f(image):\n    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)\n", names)
    assert orders(f=(names["f"], ("image", "out"))) == {}


def test_a_file_that_was_changed_since_says_nothing(tmp_path):
    path = tmp_path / "changed.py"
    source = "def f(image):\n    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)\n"
    names = {"cv2": cv2}
    exec(compile(source, str(path), "exec"), names)
    path.write_text(source.replace("BGR", "RGB"))
    linecache.checkcache(str(path))
    assert orders(f=(names["f"], ("image", "out"))) == {}


# -- from token to token -----------------------------------------------------------------------------------------------


def test_an_image_that_is_passed_on_has_the_order_on_both_sides():
    found = orders(
        resize=(cv2.resize, (("photo", "size"), "image")),
        blur=(blur, (("image", "k"), "smooth")),
        gray=(gray, ("smooth", "grey")),
        crop=(cropped, ("image", "part")),
        draw=(outlined, (("image", "lines"), "drawing")),
    )
    assert found == dict.fromkeys(("photo", "image", "smooth", "part", "drawing"), "rgb")


def test_a_delayed_image_has_the_order_of_the_image():
    def mixed(image, previous):
        return cv2.addWeighted(image, 0.5, previous, 0.5, 0)

    cg = ep.delay(
        graph(mix=(mixed, (("image", "before"), "mixture")), gray=(gray, ("image", "grey"))), "mixture", "before"
    )
    assert {token: found.order for token, found in cg.colours.items()} == dict.fromkeys(
        ("image", "mixture", "before"), "rgb"
    )


def test_behind_a_conversion_the_order_is_the_other():
    assert orders(convert=(to_rgb, ("image", "rgb")), gray=(gray, ("rgb", "grey"))) == {"image": "bgr", "rgb": "rgb"}
    found = orders(turn=(reversed_channels, ("image", "turned")), gray=(saturation, ("turned", "s")))
    assert found == {"image": "rgb", "turned": "bgr"}


def test_the_names_of_an_exchange_say_less_than_another_conversion():
    found = orders(convert=(to_rgb, ("image", "other")), gray=(gray, ("image", "grey")))
    assert found == {"image": "rgb", "other": "bgr"}, "COLOR_BGR2RGB and COLOR_RGB2BGR are one operation"
    found = orders(convert=(to_rgb, ("image", "other")), s=(saturation, ("other", "s")))
    assert found == {"image": "rgb", "other": "bgr"}
    assert orders(there=(to_rgb, ("image", "other")), back=(to_rgb, ("other", "end"))) == {}, "the names disagree"


def test_an_image_that_is_made_in_an_order_has_it():
    def read(path):
        return cv2.imread(path)

    def lightened(image):
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
        return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), hsv

    found = orders(read=(read, ("path", "photo")), light=(lightened, ("image", ("out", "hsv"))))
    assert found == {"photo": "bgr", "out": "rgb", "image": "rgb"}


def test_a_mark_says_more_than_the_source():
    def marked(image: Annotated[np.ndarray, ep.Image(order="bgr")]):
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

    cg = graph(marked=(marked, ("image", "grey")), s=(saturation, ("image", "s")))
    assert (cg.colours["image"].order, cg.colours["image"].is_marked) == ("bgr", True)


# -- contradictions ----------------------------------------------------------------------------------------------------


def findings(**functions):
    with pytest.raises(GraphError) as error:
        graph(**functions)
    return error.value.findings


def test_two_functions_that_surely_take_an_image_in_different_orders_make_no_graph():
    (finding,) = findings(gray=(gray, ("image", "grey")), s=(saturation, ("image", "s")))
    assert (finding.kind, finding.names) == ("colour", ("image", "gray", "s"))
    assert finding.text == (
        "Function 'gray' takes token 'image' as rgb, but 's' takes it as bgr. Convert it in a function before 's': "
        "cv2.cvtColor(image, cv2.COLOR_RGB2BGR). Or, if that is not so, annotate what the function takes: "
        "Annotated[np.ndarray, ep.Image(order='rgb')]."
    )


def test_so_do_two_of_which_one_takes_what_the_other_has_passed_on():
    (finding,) = findings(
        gray=(gray, ("image", "grey")), blur=(blur, (("image", "k"), "smooth")), s=(saturation, ("smooth", "s"))
    )
    assert finding.text.startswith(
        "Function 's' takes token 'smooth' as bgr, but it is rgb since 'gray' takes 'image' as rgb. "
        "Convert it in a function between them: cv2.cvtColor(smooth, cv2.COLOR_RGB2BGR)."
    )


def test_a_mark_and_a_source_can_contradict_each_other():
    def marked(image: Annotated[np.ndarray, ep.Image(order="bgr")]):
        return image

    (finding,) = findings(marked=(marked, ("image", "out")), gray=(gray, ("image", "grey")))
    assert finding.kind == "colour"
    converted = graph(
        marked=(marked, ("image", "out")), convert=(to_rgb, ("image", "rgb")), gray=(gray, ("rgb", "grey"))
    )
    assert {token: found.order for token, found in converted.colours.items()} == {
        "image": "bgr", "out": "bgr", "rgb": "rgb",
    }  # fmt: skip


# -- cost --------------------------------------------------------------------------------------------------------------


def test_the_source_of_a_function_is_read_once_and_only_where_it_may_say_something(monkeypatch):
    read = []
    getlines = linecache.getlines
    monkeypatch.setattr(linecache, "getlines", lambda *args: read.append(args[0]) or getlines(*args))
    count = 1_000

    def step(x):
        return x + 1

    graph(**{f"f{index}": (step, (f"t{index}", f"t{index + 1}")) for index in range(count)})
    assert read == []

    def fresh(image):
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

    for _ in range(2):
        graph(**{f"f{index}": (fresh, ("image", f"t{index}")) for index in range(count)})
    assert len(read) == 1


def test_no_library_is_imported_for_it():
    code = (
        "import sys, linecache; import epypes as ep\n"
        "source = 'def f(image):\\n    import cv2\\n    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)\\n'\n"
        "linecache.cache['<cell>'] = (len(source), None, source.splitlines(True), '<cell>'); names = {}\n"
        "exec(compile(source, '<cell>', 'exec'), names)\n"
        "print(ep.CompGraph({'f': names['f']}, {'f': ('image', 'y')}).colours['image'].order, 'cv2' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["rgb", "False"]
