"""Bias and spread of ranges at a known distance, and how the bias is shared."""

import numpy as np
import pytest

from relpos.calibration.antenna import fit_ranges, new_offsets_mm
from relpos.errors import DataError


def test_the_bias_is_found_under_noise_and_outliers():
    rng = np.random.default_rng(1)
    ranges = 5.31 + 0.03 * rng.standard_normal(200)
    ranges[::20] += rng.uniform(1.0, 15.0, 10)  # somebody walked through
    fit = fit_ranges(list(ranges), 5.0)
    assert fit.bias_m == pytest.approx(0.31, abs=3 * fit.sigma_m)
    assert fit.spread_m == pytest.approx(0.03, rel=0.25)
    assert fit.sigma_m < 0.004


def test_the_stated_deviation_is_that_of_the_bias():
    rng = np.random.default_rng(2)
    fits = [fit_ranges(list(5.0 + 0.05 * rng.standard_normal(50)), 5.0) for _ in range(400)]
    assert np.std([fit.bias_m for fit in fits]) == pytest.approx(
        np.mean([fit.sigma_m for fit in fits]), rel=0.15
    )


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ([5.0] * 19, "only 19 ranges"),
        (list(np.linspace(4.0, 6.0, 50)), "spread"),
        ([9.0] * 50, "is the distance 5 m"),
    ],
)
def test_ranges_that_cannot_be_believed_are_refused(ranges, words):
    with pytest.raises(DataError, match=words):
        fit_ranges(ranges, 5.0)


def test_shares_add_up_and_a_reference_keeps_its_own():
    assert new_offsets_mm(0.301, (10, -20)) == (160, 131)
    assert new_offsets_mm(-0.301, (0, 0)) == (-151, -150)
    assert new_offsets_mm(0.3, (10, 20), 0) == (10, 320)
    assert new_offsets_mm(0.3, (10, 20), 1) == (310, 20)
    with pytest.raises(DataError, match="at most 5 m"):
        new_offsets_mm(1.0, (4900, 0))
