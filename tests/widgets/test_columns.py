"""Do the controls stand in folders, and is the page told what it has to know of each?"""

from __future__ import annotations

import json
from typing import Any

import ipywidgets
import pytest

import epypes as ep
from epypes_widgets.controls.column import Column, column
from epypes_widgets.controls.control import controls


def listed(runner: ep.CompGraphRunner, **hints: Any) -> Column:
    return column(runner.cg, controls(runner, hints))


@pytest.fixture
def edges() -> ep.CompGraphRunner:
    """image -> blur -> canny, with a pair, an odd size and a choice."""
    cg = ep.CompGraph(
        {"blur": lambda *_: 0, "canny": lambda *_: 0},
        {"blur": (("image", "ksize", "border"), "smooth"), "canny": (("smooth", "ksize", "lo", "hi"), "edges")},
    )
    return ep.CompGraphRunner(cg, {"ksize": 5, "border": "reflect", "lo": 70, "hi": 200})


HINTS: dict[str, Any] = {
    "ksize": ep.Param(1, 31, odd=True, unit="px", soft=(1, 15)),
    "border": ["reflect", "wrap"],
    "lo": ep.Param(0, 255, below="hi"),
    "hi": (0, 255),
}


def test_each_control_stands_once_and_what_several_functions_take_under_a_heading_of_its_own(
    edges: ep.CompGraphRunner,
) -> None:
    found = listed(edges, **HINTS)
    assert [(row["names"], row["functions"]) for row in found.rows] == [
        (["border"], ["blur"]),
        (["ksize"], ["blur", "canny"]),
        (["lo", "hi"], ["canny"]),
    ]
    assert found.folders == (
        {"css": "epypes-folder-0", "functions": ["blur"]},
        {"css": "epypes-folder-1", "functions": ["blur", "canny"]},
        {"css": "epypes-folder-2", "functions": ["canny"]},
    )
    assert ">shared: blur, canny</span>" in found.widget.children[1].children[1].children[0].value


def test_the_page_is_told_the_hard_range_the_steps_and_the_first_values(edges: ep.CompGraphRunner) -> None:
    edges["lo"] = 80
    border, size, pair = listed(edges, **HINTS).rows
    assert {key: size[key] for key in ("kind", "integer", "odd", "log", "low", "high", "step", "unit")} == {
        "kind": "slider", "integer": True, "odd": True, "log": False, "low": [1], "high": [31], "step": [2], "unit": "px"
    }  # fmt: skip
    assert (border["kind"], border["low"], border["default"]) == ("choice", [None], ["reflect"])
    assert (pair["kind"], pair["default"]) == ("range", [70, 200])
    assert (pair["low"], pair["high"], pair["step"]) == ([0, 0], [255, 255], [1, 1])


def test_rows_and_folders_are_found_by_their_classes(edges: ep.CompGraphRunner) -> None:
    found = listed(edges, **HINTS)
    assert "epypes-controls" in found.widget._dom_classes
    search, folders = found.widget.children
    blur, _shared, canny = folders.children
    assert (search._dom_classes, search.placeholder) == (("epypes-filter",), "Filter")
    assert blur._dom_classes == ("epypes-folder", "epypes-folder-0")
    heading, border = blur.children
    assert heading._dom_classes == ("epypes-heading",)
    assert border._dom_classes == ("epypes-row", "epypes-row-0")
    assert border.children[0].model_id == found.rows[0]["model"]
    assert canny.children[1].children[0].description == "lo .. hi"
    assert border.children[0].description == "border"


def test_names_with_markup_in_them_stay_names() -> None:
    cg = ep.CompGraph({"<b>f</b>": lambda x: x}, {"<b>f</b>": ("<i>x", "y")})
    (entry,) = controls(ep.CompGraphRunner(cg, {"<i>x": 5}), {})
    found = column(cg, [entry])
    (folder,) = found.widget.children[1].children
    assert folder.children[0].value.startswith('<span class="epypes-name">&lt;b&gt;f&lt;/b&gt;</span>')
    assert not entry.widget.description_allow_html
    assert found.folders[0]["functions"] == ["<b>f</b>"]


def test_all_controls_share_their_layout_and_their_styles(edges: ep.CompGraphRunner) -> None:
    made = controls(edges, HINTS)
    assert len({entry.widget.layout.model_id for entry in made}) == 1
    assert len({entry.widget.style.model_id for entry in made}) == 1
    search, folders = column(edges.cg, made).widget.children
    boxes = [search, folders, *folders.children]
    assert len({box.layout.model_id for box in boxes}) == 1


def test_sliders_leave_the_number_to_the_box_beside_them(edges: ep.CompGraphRunner) -> None:
    sliders = [entry.widget for entry in controls(edges, HINTS) if entry.widget.has_trait("readout")]
    assert len(sliders) == 2
    assert not any(slider.readout for slider in sliders)


def test_what_is_only_shown_has_no_default_for_the_page() -> None:
    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})
    (row,) = listed(ep.CompGraphRunner(cg, {"x": [float("nan")]})).rows
    assert (row["kind"], row["default"]) == ("shown", [None])
    assert json.loads(json.dumps(row)) == row


def test_a_runner_without_hyperparameters_has_an_empty_column() -> None:
    found = listed(ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})))
    assert (found.rows, found.folders) == ((), ())
    assert isinstance(found.widget, ipywidgets.VBox)
