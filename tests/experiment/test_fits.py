"""The log-normal distributions are those of maximum likelihood, and the summary is that of the table."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from epypes.experiment.results import PAPER, lognormal_fit, summary


def test_it_finds_the_distribution_that_the_values_were_drawn_from():
    values = np.random.default_rng(1).lognormal(math.log(15e-6), 0.4, 50_000)
    fitted = lognormal_fit(values)
    assert fitted.mu == pytest.approx(math.log(15e-6), abs=0.01)
    assert fitted.sigma == pytest.approx(0.4, abs=0.01)
    assert fitted.mode == pytest.approx(15e-6 * math.exp(-(0.4**2)), rel=0.02)
    assert (fitted.count, fitted.left_out) == (50_000, 0)


@pytest.mark.parametrize("seed", range(3))
def test_it_is_what_scipy_fits_with_the_place_held_at_zero(seed):
    values = np.random.default_rng(seed).lognormal(-9, 0.3, 500)
    sigma, _, scale = stats.lognorm.fit(values, floc=0)
    fitted = lognormal_fit(values)
    assert fitted.sigma == pytest.approx(sigma, rel=1e-6)
    assert math.exp(fitted.mu) == pytest.approx(scale, rel=1e-6)
    times = np.geomspace(values.min(), values.max(), 50)
    assert np.allclose(fitted.pdf(times), stats.lognorm.pdf(times, sigma, 0, scale), rtol=1e-4)


@pytest.mark.fuzz
@given(
    st.lists(st.floats(1e-9, 1e3), min_size=1, max_size=30),
    st.permutations([0.0, -1e-6, math.nan, math.inf, -math.inf]),
)
def test_what_is_no_positive_number_is_counted_and_changes_nothing_else(values, others):
    fitted, alone = lognormal_fit([*others, *values]), lognormal_fit(values)
    assert (fitted.mu, fitted.sigma) == (alone.mu, alone.sigma)
    assert (fitted.count, fitted.left_out) == (len(values), 5)
    assert (alone.count, alone.left_out) == (len(values), 0)


@pytest.mark.fuzz
@given(st.floats(1e-9, 1e3), st.integers(1, 50))
def test_values_that_are_equal_have_their_mode_there_and_no_curve(value, count):
    fitted = lognormal_fit([value] * count)
    assert fitted.sigma == 0
    assert fitted.mode == pytest.approx(value, rel=1e-12)
    assert not fitted.has_curve
    assert np.isnan(fitted.pdf(np.array([value]))).all()


@pytest.mark.parametrize("values", [[], [0.0, -1.0], [math.nan]])
def test_where_nothing_is_positive_there_is_no_number(values):
    fitted = lognormal_fit(values)
    assert math.isnan(fitted.mode)
    assert (fitted.count, fitted.left_out) == (0, len(values))


def test_the_summary_stands_beside_the_papers_values(measured):
    rows = summary(measured)
    assert rows.loc["vision.o_cg", "paper_mode_ms"] == 0.3
    assert rows.loc["vision.o_epypes", "paper_mode_ms"] == 0.02
    assert rows["paper_mode_ms"].notna().sum() == len(PAPER) == 2
    for time in ("t_trip", "o_network", "vision.o_cg", "acquisition.t_rp"):
        in_ms = 1e3 * measured[time]
        assert rows.loc[time, "median_ms"] == pytest.approx(in_ms.median())
        assert (rows.loc[time, "least_ms"], rows.loc[time, "most_ms"]) == pytest.approx((in_ms.min(), in_ms.max()))
        assert rows.loc[time, "mode_ms"] == pytest.approx(1e3 * lognormal_fit(measured[time]).mode)


def test_the_summary_leaves_out_requests_that_failed_and_counts_what_is_not_positive(measured, fail):
    spoilt = fail(measured, 0, 1)
    spoilt.loc[[5, 6, 7], "vision.o_cg"] = [0.0, -1e-6, -2e-6]
    rows = summary(spoilt)
    assert set(rows["requests"]) == {298}
    assert rows.loc["vision.o_cg", "not_positive"] == 3
    assert rows.loc["vision.o_cg", "least_ms"] == pytest.approx(-2e-3)
    assert rows["not_positive"].sum() == 3


def test_the_summary_of_nothing_is_told_in_numbers_too(measured, fail):
    assert len(summary(pd.DataFrame())) == 0
    rows = summary(fail(measured[:2], 0, 1))
    assert set(rows["requests"]) == {0}
    assert rows["median_ms"].isna().all()
    with pytest.raises(ValueError, match="no column 'failure'"):
        summary(measured[["experiment", "t_trip"]])
