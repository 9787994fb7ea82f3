"""The figures of the experiment show the right numbers, or say why there is nothing to show."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from io import BytesIO

import matplotlib
import matplotlib.style
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from epypes.experiment.figures import figure_14, figure_15, figure_16
from epypes.experiment.results import lognormal_fit

pytestmark = pytest.mark.slow  # each draws figures

OF_OVERHEADS = [(figure_15, "vision.o_cg", "300"), (figure_16, "vision.o_epypes", "20")]
ALL = [figure_14, figure_15, figure_16]


def texts(figure: Figure) -> str:
    """Everything that can be read in a figure."""
    axes, legends = figure.axes[0], figure.legends
    found = [figure.get_suptitle(), *(axes.get_title(loc=side) for side in ("left", "center")), axes.get_xlabel()]
    found += [axes.get_ylabel(), *(text.get_text() for text in axes.texts)]
    return "\n".join(found + [text.get_text() for legend in legends for text in legend.get_texts()])


def test_the_bars_of_a_request_add_up_to_its_trip(measured):
    bars = figure_14(measured).axes[0].containers
    assert [container.get_label() for container in bars] == ["acquisition", "vision", "network"]
    tops = [bar.get_y() + bar.get_height() for bar in bars[2]]
    assert np.allclose(tops, 1e3 * measured["t_trip"][:100])
    assert [bar.get_height() for bar in bars[0]] == pytest.approx(list(1e3 * measured["acquisition.t_rp"][:100]))


def test_a_request_that_failed_is_a_cross_and_no_bar(measured, fail):
    figure = figure_14(fail(measured, 5, 17))
    axes = figure.axes[0]
    assert [list(line.get_xdata()) for line in axes.lines] == [[5, 17]]
    assert [len(container) for container in axes.containers] == [98, 98, 98]
    assert {5, 17}.isdisjoint(round(bar.get_x() + bar.get_width() / 2) for bar in axes.containers[0])
    assert "2 requests failed" in texts(figure)


def test_a_negative_time_is_told_and_not_drawn(measured):
    measured.loc[3, "o_network"] = -1e-3
    figure = figure_14(measured)
    assert min(bar.get_height() for bars in figure.axes[0].containers for bar in bars) >= 0
    assert "1 negative time not drawn" in texts(figure)


def test_the_rows_given_are_drawn_whatever_their_index(measured):
    second = measured[measured["experiment"] == 2]
    assert figure_14(second).axes[0].containers[0][0].get_height() == pytest.approx(
        1e3 * second["acquisition.t_rp"].iloc[0]
    )
    doubled = pd.concat([measured[:30], measured[:30]])
    assert [len(bars) for bars in figure_14(doubled).axes[0].containers] == [60, 60, 60]


@pytest.mark.parametrize(("draw", "column", "paper"), OF_OVERHEADS)
def test_what_was_measured_is_seen_beside_what_was_fitted(measured, draw, column, paper):
    figure = draw(measured)
    (bars,) = figure.axes[0].containers
    assert sum(bar.get_width() * bar.get_height() for bar in bars) == pytest.approx(1)
    assert bars[0].get_x() == pytest.approx(1e6 * measured[column].min())
    assert "histogram" in texts(figure)


@pytest.mark.parametrize(("draw", "column", "paper"), OF_OVERHEADS)
def test_lines_stand_at_the_mode_the_measured_range_and_the_papers_mode(measured, draw, column, paper):
    figure = draw(measured)
    least, most, mode, papers = (line.get_xdata()[0] for line in figure.axes[0].lines[:4])
    assert (least, most) == pytest.approx((1e6 * measured[column].min(), 1e6 * measured[column].max()))
    assert mode == pytest.approx(1e6 * lognormal_fit(measured[column]).mode)
    assert papers == pytest.approx(float(paper))
    thick, _, thin, _ = (line.get_linewidth() for line in figure.axes[0].lines[:4])
    assert thick > 2 * thin
    assert f"the paper's mode: {paper} µs" in texts(figure)
    low, high = figure.axes[0].get_xlim()
    assert low < min(least, papers)
    assert max(most, papers) < high


@pytest.mark.parametrize(("draw", "column", "_"), OF_OVERHEADS)
def test_the_curve_over_all_data_is_a_density_that_is_highest_at_the_mode(measured, draw, column, _):
    axes = draw(measured).axes[0]
    times, density = axes.lines[-1].get_data()
    assert np.sum(np.diff(times) * (density[1:] + density[:-1]) / 2) == pytest.approx(1, abs=1e-3)
    assert times[np.argmax(density)] == pytest.approx(1e6 * lognormal_fit(measured[column]).mode, rel=0.05)
    assert axes.lines[-1].get_linewidth() > 2


@pytest.mark.parametrize("draw", [figure_15, figure_16])
def test_each_experiment_has_a_shape_of_its_own(measured, draw):
    shapes = draw(measured).axes[0].collections
    assert len(shapes) == 3
    assert len({shape.get_paths()[0].vertices[:, 1].max() for shape in shapes}) == 3


def test_values_that_are_not_positive_are_counted_and_not_fitted(measured):
    spoilt = measured.copy()
    spoilt.loc[[4, 5, 6], "vision.o_cg"] = [-1e-6, 0.0, -2e-3]
    figure = figure_15(spoilt)
    assert "3 values not positive, left out" in texts(figure)
    assert "297 values of 3 experiments" in texts(figure)
    times, density = figure.axes[0].lines[-1].get_data()
    others = figure_15(measured.drop([4, 5, 6])).axes[0].lines[-1].get_data()
    assert np.array_equal([times, density], others)


def test_functions_side_by_side_are_told_in_the_label(measured):
    assert "critical path" in texts(figure_15(measured, side_by_side=True))
    assert "critical path" not in texts(figure_15(measured))


@pytest.mark.parametrize("draw", ALL)
@pytest.mark.parametrize("empty", [pd.DataFrame(), pd.DataFrame({"experiment": [], "failure": []})])
def test_without_a_request_it_says_so(draw, empty):
    assert "There is no request." in texts(drawn(draw(empty)))


@pytest.mark.parametrize("draw", ALL)
def test_where_all_requests_failed_it_says_so(draw, measured, fail):
    assert "All 4 requests failed." in texts(drawn(draw(fail(measured[:4], 0, 1, 2, 3))))
    assert "The only request failed." in texts(drawn(draw(fail(measured[:1], 0))))


@pytest.mark.parametrize("draw", [figure_15, figure_16])
def test_where_nothing_can_be_fitted_it_says_so(draw, measured):
    measured[["vision.o_cg", "vision.o_epypes"]] = 0.0
    assert "Of 300 values none is positive" in texts(drawn(draw(measured)))
    measured[["vision.o_cg", "vision.o_epypes"]] = math.nan
    assert "Of 300 values none is positive" in texts(drawn(draw(measured)))


@pytest.mark.parametrize("draw", [figure_15, figure_16])
@pytest.mark.parametrize("rows", [1, 2, 300])
def test_values_that_are_equal_have_a_line_and_no_curve(draw, rows, measured):
    measured[["vision.o_cg", "vision.o_epypes"]] = 12e-6
    figure = drawn(draw(measured[:rows]))
    assert "no curve, since there are no values that differ" in texts(figure)
    assert "measured: 12 µs" in texts(figure)
    assert not figure.axes[0].collections
    assert not figure.axes[0].yaxis.get_visible()


def test_an_experiment_of_one_request_is_without_a_curve_and_told(measured):
    figure = drawn(figure_15(measured[:201]))
    assert "1 experiment without a curve" in texts(figure)
    assert len(figure.axes[0].collections) == 2


def test_one_request_is_one_bar(measured):
    assert [len(bars) for bars in drawn(figure_14(measured[:1])).axes[0].containers] == [1, 1, 1]


@pytest.mark.parametrize("draw", ALL)
def test_a_table_that_was_saved_and_read_gives_the_same_figure(draw, measured, fail, tmp_path):
    table = fail(measured, 7)
    table.to_csv(tmp_path / "requests.csv", index=False)
    again = pd.read_csv(tmp_path / "requests.csv")
    assert texts(draw(again)) == texts(draw(table))
    assert "1 request failed" in texts(draw(again))


@pytest.mark.parametrize("draw", ALL)
def test_what_is_no_table_is_refused_with_what_is_missing(draw, measured):
    with pytest.raises(ValueError, match=r"needed, as run_experiment\(...\).table, not 'list'"):
        draw([1, 2])
    with pytest.raises(ValueError, match=r"no column 'failure', .*run_experiment"):
        draw(measured[["experiment"]])


@pytest.mark.parametrize("draw", ALL)
def test_it_shows_itself_as_svg_and_png_and_always_as_the_same_bytes(draw, measured):
    bundle = draw(measured)._repr_mimebundle_()
    assert bundle["image/png"].startswith(b"\x89PNG")
    assert ET.fromstring(bundle["image/svg+xml"]).tag.endswith("svg")
    assert len(bundle["image/svg+xml"]) < 150_000
    assert draw(measured)._repr_mimebundle_() == bundle


@pytest.mark.parametrize("draw", ALL)
def test_it_looks_the_same_in_whatever_style_the_user_has_set(draw, measured):
    plain = png(draw(measured[:150]))
    with matplotlib.rc_context():
        matplotlib.style.use("dark_background")
        matplotlib.rcParams.update({"font.size": 30, "axes.grid": True})
        assert png(draw(measured[:150])) == plain
        assert matplotlib.rcParams["font.size"] == 30, "and leaves the user's as it is"


def test_the_colours_of_the_bars_differ_in_lightness_as_well(measured):
    colours = [to_hex(bars[0].get_facecolor()) for bars in figure_14(measured).axes[0].containers]
    lightness = sorted(
        0.2126 * int(colour[1:3], 16) + 0.7152 * int(colour[3:5], 16) + 0.0722 * int(colour[5:], 16)
        for colour in colours
    )
    assert min(np.diff(lightness)) > 20


def png(figure: Figure) -> bytes:
    file = BytesIO()
    figure.savefig(file)
    return file.getvalue()


def drawn(figure: Figure) -> Figure:
    """The figure, once it has been laid out without an error."""
    figure.draw_without_rendering()
    return figure


def test_a_page_has_the_texts_of_a_figure_as_text(measured):
    shown = figure_14(measured)._repr_mimebundle_()
    assert "Figure 14: where the time of each request goes</text>" in shown["image/svg+xml"]
    assert "Figure 14: where the time of each request goes</text>" in shown["text/html"]
