"""Ranges without what the online estimator has learned of their errors."""

import math

import pytest

from relpos.fusion.estimator import Estimate, Parameter
from relpos.fusion.smoother.as_learned import as_learned
from relpos.measurements import Range


def learned(sigma_m):
    grown = Parameter(60.0, 1, None, "range_growth_m", 0.11, sigma_m)
    return [Estimate(60.0, (), (), parameters=(grown,))]


def test_what_grows_with_the_distance_is_taken_out_where_it_is_sure():
    true_m = (0.5, 3.8, 20.0)
    ranges = [Range(t, 1, 2, t + 0.11 * math.log(t / 3.8)) for t in true_m]
    corrected = as_learned(ranges, learned(0.01))
    assert [r.range_m for r in corrected] == pytest.approx(true_m, abs=0.05)
    assert as_learned(ranges, learned(0.1)) == ranges
