"""The benchmark beside other libraries: what it runs of relpos still fits relpos."""

import sys
from functools import partial
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "bench" / "peers"))
import ours
from case import paper_case, run_filter


@pytest.fixture(scope="module")
def case():
    return paper_case("paper-p1", 1, 30)


@pytest.mark.parametrize(
    "make",
    [ours.JointAlone, ours.Joint, ours.Strips, partial(ours.Particles, size=500, alpha=0.0)],
)
def test_a_contender_follows_the_team(case, make):
    assert run_filter(case, make, 0).distance_m < 0.3


@pytest.mark.soak
def test_the_smoother_is_closer_than_the_filter_that_it_begins_from(case):
    begun = run_filter(case, ours.JointAlone, 0)
    assert ours.smoother(case, ours.begin_of(case)).distance_m < begun.distance_m
