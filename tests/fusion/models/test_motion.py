"""Where a node is within its report."""

from __future__ import annotations

import numpy as np
import pytest

from relpos.fusion.models.motion import WithinReport


def after(before_m: float, walked_m: float, share: float) -> float:
    """Variance after a share of a report of one second, by one whose usual speed is 1 m/s."""
    within = WithinReport()
    within.move(before_m, 1.0, 1.0, 1.0)
    within.move(share * walked_m, share, share, 1.0)
    return within.variance_m2


@pytest.mark.parametrize("stops", [True, False])
def test_who_stops_or_sets_off_within_a_report_is_as_far_off_as_it_says(stops: bool) -> None:
    squares, variances = [], []
    for part in np.linspace(0.05, 0.95, 19):
        for share in np.linspace(0.05, 0.95, 19):
            at = min(share, part) if stops else max(share - (1.0 - part), 0.0)
            squares.append(0.5 * (at - share * part) ** 2)
            variances.append(after(1.0 if stops else 0.0, part, share))
    assert 0.6 < np.mean(variances) / np.mean(squares) < 1.7


def test_an_even_walk_and_the_end_of_a_report_are_exact() -> None:
    assert after(0.6, 0.6, 0.5) == 0.0
    assert after(1.0, 0.5, 1.0) == 0.0
    assert after(0.0, 0.0, 0.5) == 0.0


def test_ranges_of_one_report_share_its_error() -> None:
    within = WithinReport()
    for _ in range(40):
        within.move(1.0, 0.5, 0.5, 1.0)
        for _ in range(10):
            within.range_variance_m2()
        within.move(0.0, 0.5, 0.5, 1.0)
    within.move(0.5, 0.5, 0.5, 1.0)
    assert within.range_variance_m2() == pytest.approx(10 * within.variance_m2, rel=0.01)
