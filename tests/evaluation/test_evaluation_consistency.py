"""NEES and coverage on errors whose distribution is known."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from relpos.evaluation import consistency, metrics
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus
from relpos.tracks import PairTrack, Track

Floats = npt.NDArray[np.float64]


def _lasting(rng: np.random.Generator, count: int, keeps: float) -> Floats:
    """A first-order autoregressive series of variance 1."""
    noise = rng.standard_normal(count)
    result = np.empty(count)
    result[0] = noise[0]
    for k in range(1, count):
        result[k] = keeps * result[k - 1] + math.sqrt(1.0 - keeps**2) * noise[k]
    return result


def test_chi_square_intervals_are_the_tables() -> None:
    """Percentage points of chi-square: 10 degrees 3.247 and 20.483, 100 degrees 74.22, 129.56."""
    assert consistency.chi_square_interval(10.0) == pytest.approx((0.3247, 2.0483), abs=1e-4)
    assert consistency.chi_square_interval(100.0) == pytest.approx((0.7422, 1.2956), abs=1e-4)


@pytest.mark.parametrize(("runs", "length"), [(1, 1500), (20, 300)])
@pytest.mark.parametrize("keeps", [0.0, 0.95])
def test_an_honest_estimate_is_within_the_interval_as_often_as_promised(
    runs: int, length: int, keeps: float
) -> None:
    rng = np.random.default_rng(1)
    inside = [
        consistency.nees([_lasting(rng, length, keeps) ** 2 for _ in range(runs)]).honest
        for _ in range(150)
    ]
    # The spread itself is estimated, so a little is lost; 150 trials: standard error 2 %.
    assert 0.85 <= np.mean(inside) <= 1.0


def test_lasting_errors_are_worth_fewer() -> None:
    """Squares of an AR(1) of 0.9 keep 0.81: (1 - 0.81) / (1 + 0.81) of their number."""
    rng = np.random.default_rng(2)
    result = consistency.nees([_lasting(rng, 20_000, 0.9) ** 2])
    assert result.effective == pytest.approx(20_000 * 0.19 / 1.81, rel=0.25)
    assert result.values == 20_000


def test_an_overconfident_estimate_is_caught() -> None:
    rng = np.random.default_rng(3)
    result = consistency.nees([2.0 * _lasting(rng, 600, 0.5) ** 2 for _ in range(4)])
    assert result.mean == pytest.approx(2.0, rel=0.2)
    assert not result.honest


def test_missing_values_are_left_out() -> None:
    assert math.isnan(consistency.nees([np.full(5, np.nan)]).mean)
    one = consistency.nees([np.array([[1.0, np.nan], [3.0, 5.0]] * 20)])
    assert one.mean == pytest.approx(2.5)
    assert one.values == 60


def test_the_nees_of_distances_has_the_mean_that_the_run_format_gives() -> None:
    """Also where a third node comes late, and what is said of it errs more."""
    early, late = np.arange(100.0), np.arange(90.0, 100.0)
    truth = {n: Track(t, 0.0 * t, n + 0.0 * t) for n, t in ((1, early), (2, early), (3, late))}
    pairs = {
        (1, 2): PairTrack(early, 1.0 + np.resize([0.5, 1.0], 100), 1.0 + 0.0 * early),
        (1, 3): PairTrack(late, 5.0 + 0.0 * late, 1.0 + 0.0 * late),
        (2, 3): PairTrack(late[2:], 4.0 + 0.0 * late[2:], 1.0 + 0.0 * late[2:]),
    }
    one = metrics.evaluate(truth, truth, pairs)
    assert one.nees_distance == pytest.approx((62.5 + 18 * 9.0) / 118)
    assert consistency.of_distances([one]).mean == pytest.approx(one.nees_distance)
    without = metrics.evaluate(truth, truth)
    assert math.isnan(consistency.of_distances([without]).mean)


def _estimate(time_s: float, x: float, y: float, heading: float, sigma: float) -> Estimate:
    node = NodeEstimate(1, x, y, heading, 4.0, 1.0, 0.5, sigma, NodeStatus.OK)
    return Estimate(time_s, (node,), ())


def test_poses_are_scored_with_their_covariance_and_on_the_circle() -> None:
    truth = {1: Track([0.0, 1.0], [0.0, 1.0], [0.0, 0.0], [3.1, 3.1])}  # type: ignore[arg-type]
    position, heading = consistency.of_poses(
        [_estimate(0.0, 1.0, 2.0, 3.1, 0.1), _estimate(1.0, 1.0, 0.0, -3.1, 0.1)], truth
    )
    error = np.array([1.0, 2.0])
    square = error @ np.linalg.inv([[4.0, 0.5], [0.5, 1.0]]) @ error / 2
    assert position[:, 0] == pytest.approx([square, 0.0])
    assert heading[:, 0] == pytest.approx([0.0, ((2 * math.pi - 6.2) / 0.1) ** 2])


def test_coverage_counts_what_lasts_once() -> None:
    rng = np.random.default_rng(5)
    lasting = [(_lasting(rng, 400, 0.98) < 1.2816) for _ in range(60)]
    apart = [rng.random(400) < 0.9 for _ in range(60)]
    for hits in (lasting, apart):
        found = consistency.coverage(hits)
        assert found.low < 0.9 < found.high
    assert consistency.coverage(lasting).effective < 0.2 * consistency.coverage(apart).effective
    always = consistency.coverage([np.ones(100, dtype=bool)] * 3)
    assert always.share == 1.0
    assert always.low < 0.6
