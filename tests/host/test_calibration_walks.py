"""What walks of known length say about a wearer's steps."""

import math

import numpy as np
import pytest

from relpos.calibration.walks import weigh_walks
from relpos.errors import DataError


def posterior(ratios, lengths_m, people):
    """Mean and sd of the log scale on a grid: prior of the stature, normal errors of the walks."""
    grid = np.linspace(-0.4, 0.4, 80_001)
    log = -0.5 * (grid / people) ** 2
    for ratio, length_m in zip(ratios, lengths_m, strict=True):
        spread = math.sqrt(0.02**2 + (0.45 / length_m) ** 2)
        log -= 0.5 * ((grid - math.log(ratio)) / spread) ** 2
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = (weight * grid).sum()
    return mean, math.sqrt((weight * (grid - mean) ** 2).sum())


@pytest.mark.parametrize(
    ("ratios", "lengths_m"),
    [([1.06], [20.0]), ([0.95], [60.0]), ([1.02, 1.09, 0.99], [20, 30, 60])],
)
def test_walks_are_weighed_by_bayes(ratios, lengths_m):
    for known, people in ((True, 0.03), (False, math.hypot(0.03, 0.037))):
        found = weigh_walks(
            [length / ratio for ratio, length in zip(ratios, lengths_m, strict=True)],
            lengths_m,
            stature_known=known,
        )
        mean, sigma = posterior(ratios, lengths_m, people)
        assert math.log(found.scale) == pytest.approx(mean, abs=1e-6)
        assert found.sigma == pytest.approx(sigma, rel=1e-4)
        assert all(found.used)


def test_a_single_walk_that_is_far_off_changes_nothing():
    found = weigh_walks([20.0 * 0.8], [20.0])
    assert (found.scale, found.used) == (1.0, (False,))
    beside = weigh_walks([20.0, 20.0 * 0.8], [20.0, 20.0])
    assert beside.used == (True, False)
    assert beside.scale == pytest.approx(1.0)


def test_walks_that_are_far_off_and_agree_are_believed():
    found = weigh_walks([15.9, 16.1, 16.0], [20.0, 20.0, 20.0])
    assert found.scale == pytest.approx(1.25, rel=0.01)
    assert all(found.used)
    assert not any(weigh_walks([13.0, 16.0], [20.0, 20.0]).used)


def test_over_many_people_the_weighed_scale_is_better_than_the_walk_and_honest():
    rng = np.random.default_rng(4)
    true = 0.03 * rng.standard_normal(4000)
    walked = true + math.hypot(0.02, 0.45 / 20.0) * rng.standard_normal(4000)
    found = [weigh_walks([20.0 * math.exp(-log)], [20.0]) for log in walked]
    errors = np.array([math.log(f.scale) for f in found]) - true
    assert np.sqrt(np.mean(errors**2)) < 0.75 * np.sqrt(np.mean((walked - true) ** 2))
    assert np.mean((errors / [f.sigma for f in found]) ** 2) == pytest.approx(1.0, abs=0.1)


def test_lengths_that_are_none_are_refused():
    for measured, true in (([20.0], [0.0]), ([0.0], [20.0]), ([math.nan], [20.0]), ([], [])):
        with pytest.raises(DataError, match="calibration"):
            weigh_walks(measured, true)
