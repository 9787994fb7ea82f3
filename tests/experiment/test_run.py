"""The experiment runs, and refuses options that make no sense."""

from __future__ import annotations

import math

import numpy as np
import pytest

from epypes.errors import ExperimentError
from epypes.experiment import Results, run_experiment
from epypes.experiment.results import COLUMNS

SMALL = {"requests": 3, "experiments": 2, "fps": 50.0}


def check(results: Results, layout: str, requests: int, experiments: int) -> None:
    table = results.table
    assert results.layout == layout
    assert tuple(table) == COLUMNS
    assert list(table["experiment"]) == [i for i in range(experiments) for _ in range(requests)]
    assert list(table["request"]) == [*range(requests)] * experiments
    assert table["id"].is_unique
    assert list(table["failure"].unique()) == [""]
    for name in ("t_trip", "acquisition.t_rp", "vision.t_rp", "vision.t_p", "vision.o_cg", "o_network"):
        assert (table[name] > 0).all(), name
    parts = table["acquisition.t_rp"] + table["vision.t_rp"] + table["o_network"]
    assert np.allclose(parts, table["t_trip"])
    # A stamp is a double of Unix time, with a quarter of a microsecond.
    assert (table["vision.t_rp"] > table["vision.t_p"] + table["vision.t_fin"] + table["vision.t_fout"] - 2e-6).all()


@pytest.mark.slow
def test_the_experiment_in_one_process(images):
    seen = []
    results = run_experiment("one", **SMALL, cameras=images, progress=lambda *counts: seen.append(counts))
    check(results, "one", 3, 2)
    assert seen == [(done, 6) for done in range(1, 7)]
    assert not results.counts


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["paper", "three"])
def test_the_experiment_in_several_processes(layout, images):
    check(run_experiment(layout, requests=5, experiments=1, cameras=images, workers=2), layout, 5, 1)


@pytest.mark.slow
def test_the_experiment_as_it_is_by_default_but_shorter():
    check(run_experiment(requests=5, experiments=1), "paper", 5, 1)


@pytest.mark.slow
def test_pickled_contents_are_sent_and_read_when_they_are_asked_for(images):
    check(run_experiment("one", **SMALL, cameras=images, unsafe_pickle=True), "one", 3, 2)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"layout": "papr"}, "There is no layout 'papr'. There are: paper, one, three."),
        ({"layout": 3}, "There is no layout 3. There are: paper, one, three."),
        ({"layout": ["one"]}, "There is no layout ['one']. There are: paper, one, three."),
        ({"transport": "zmq"}, "There is no transport 'zmq'. There are: zeromq, dds, zenoh."),
        ({"requests": 0}, "requests must be a whole number from 1, not 0."),
        ({"requests": True}, "requests must be a whole number from 1, not True."),
        ({"experiments": -1}, "experiments must be a whole number from 1, not -1."),
        ({"experiments": 2.5}, "experiments must be a whole number from 1, not 2.5."),
        ({"workers": "2"}, "workers must be a whole number from 1, not '2'."),
        ({"fps": 0}, "fps must be a number above 0, and at most 9223372036, not 0."),
        ({"fps": math.nan}, "fps must be a number above 0, and at most 9223372036, not nan."),
        ({"fps": math.inf}, "fps must be a number above 0, and at most 9223372036, not inf."),
        ({"timeout_s": "5"}, "timeout_s must be a number above 0, and at most 9223372036, not '5'."),
        ({"cameras": ["left.png"]}, "cameras must be two, each a path or the number of a device, not ['left.png']."),
        ({"cameras": "left.png"}, "cameras must be two, each a path or the number of a device, not ['left.png']."),
        ({"cameras": [1.5, 2]}, "cameras must be two, each a path or the number of a device, not [1.5, 2]."),
    ],
)
def test_what_makes_no_sense_is_refused(wrong, says):
    with pytest.raises(ExperimentError) as error:
        run_experiment(**wrong)
    assert str(error.value) == says
    assert error.value.name == next(iter(wrong))


def test_nobody_waits_for_all_requests_when_none_is_answered(images):
    with pytest.raises(ExperimentError, match=r"None of 3 requests in a row was answered within 1e-09 s each\."):
        run_experiment("one", cameras=images, timeout_s=1e-9)
