"""A node whose motion is missing: where its ranges show it, and how sure the estimate is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import relpos
from relpos.fusion.estimator import NodeStatus
from relpos.measurements import Motion, Range


@pytest.mark.parametrize("gap_s", [pytest.param(2, marks=pytest.mark.soak), 5])
def test_ranges_show_where_a_node_is_while_its_motion_is_missing(gap_s: int) -> None:
    run = relpos.simulate("mission-base", 41, seconds=120, gap_s=gap_s)
    score = relpos.evaluate(relpos.fuse(run), run, bound=False)
    assert score.metrics.relative_distance_rmse_m < 0.35
    assert 0.5 < score.metrics.nees_distance < 1.4
    assert score.metrics.ok_over_3_sigma < 0.015
    assert score.metrics.ok_over_2_m < 0.002


def test_a_node_without_any_news_is_not_ok_after_three_seconds_and_its_sigma_walks() -> None:
    run = relpos.simulate("mission-base", 42, seconds=100)
    gone_s = 60.0
    kept = [
        m
        for m in run.measurements
        if m.time_s < gone_s
        or not (
            (isinstance(m, Motion) and m.node == 3)
            or (isinstance(m, Range) and 3 in (m.node, m.peer))
        )
    ]
    bank = relpos.fusion.make("bank", run.priors)
    estimates = [e for m in kept for e in bank.process(m)] + bank.finish()
    true = {(t.time_s, t.node): np.array([t.x_m, t.y_m]) for t in run.truth}
    for e in estimates:
        if e.time_s < gone_s:
            continue
        (node,) = (n for n in e.nodes if n.node == 3)
        silent_s = e.time_s - gone_s
        if silent_s > 3.0:
            assert node.status is not NodeStatus.OK
        if silent_s > 2.0:
            assert 0.4 * silent_s**0.5 < node.sigma_major_m < 2.0 * silent_s
        pair = next(p for p in e.pairs if (p.node, p.peer) == (1, 3))
        at_s = float(round(e.time_s))
        distance_m = float(np.linalg.norm(true[at_s, 3] - true[at_s, 1]))
        assert abs(pair.distance_m - distance_m) < 3.0 * pair.sigma_distance_m + 1.0


def test_reports_that_say_nothing_of_where_they_lead_do_not_hold_up_the_estimate() -> None:
    run = relpos.simulate("mission-base", 3, nodes=3, seconds=40)
    lost = [
        replace(m, sigma_x_m=30.0, sigma_y_m=30.0, sigma_theta_rad=10.0)
        if isinstance(m, Motion)
        else m
        for m in run.measurements
    ]
    result = relpos.fuse(replace(run, measurements=tuple(lost)))
    # Each search costs as much as a hundred ranges, and each range could begin one.
    assert result.counters["nodes_sought_again"] <= len(run.node_ids) * (40 + 10)
    assert all(n.status is not NodeStatus.OK for e in result.estimates[5:] for n in e.nodes)
