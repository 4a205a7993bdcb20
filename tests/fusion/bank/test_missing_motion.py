"""A node whose motion is missing: where its ranges show it, and how sure the estimate is."""

from __future__ import annotations

import cmath
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


@pytest.mark.parametrize(("off_s", "nodes", "seed"), [(5, 6, 1000), (8, 6, 1000), (8, 24, 11)])
def test_a_node_that_was_off_for_seconds_is_not_ok_where_its_next_report_alone_leads(
    off_s: int, nodes: int, seed: int
) -> None:
    # It walked seven metres meanwhile; its first report afterwards is of one second.
    run = relpos.simulate("mission-base", seed, nodes=nodes, seconds=120, reboot_s=off_s)
    back_s = 60.0 + off_s
    true = {(t.time_s, t.node): np.array([t.x_m, t.y_m]) for t in run.truth}
    heard = [m for m in run.measurements if m.time_s < back_s + 12.0]
    for e in relpos.fuse(run, measurements=heard).estimates:
        if not back_s - 1.0 < e.time_s < back_s + 10.0:
            continue
        at_s = float(round(e.time_s))
        for pair, status in zip(e.pairs, e.pair_statuses(), strict=True):
            distance_m = float(np.linalg.norm(true[at_s, pair.node] - true[at_s, pair.peer]))
            # Up to half a second of walking of both lies between the two times.
            assert status is not NodeStatus.OK or abs(pair.distance_m - distance_m) < 2.0


def test_a_gap_in_all_data_is_no_restart_and_the_reports_after_it_count() -> None:
    run = relpos.simulate("mission-base", 2001, seconds=80)
    kept, way, turned = [], dict.fromkeys(run.node_ids, 0j), dict.fromkeys(run.node_ids, 0.0)
    for m in run.measurements:
        missing = 60.0 <= m.time_s < 66.0
        if isinstance(m, Motion):
            # The first report after the gap has the sum.
            step = complex(m.dx_m, m.dy_m) * cmath.rect(1.0, turned[m.node])
            way[m.node], turned[m.node] = way[m.node] + step, turned[m.node] + m.dtheta_rad
            if not missing:
                dx_m, dy_m = way[m.node].real, way[m.node].imag
                kept.append(replace(m, dx_m=dx_m, dy_m=dy_m, dtheta_rad=turned[m.node]))
                way[m.node], turned[m.node] = 0j, 0.0
        elif not missing:
            kept.append(m)
    result = relpos.fuse(replace(run, measurements=tuple(kept)))
    afterwards = [e for e in result.estimates if e.time_s > 68.0]
    assert all(status is NodeStatus.OK for e in afterwards for status in e.pair_statuses())


@pytest.mark.parametrize(("nodes", "since_s"), [(6, -1.0), (24, 30.0)])
def test_somebody_who_reports_to_stand_and_is_carried_is_followed_by_his_ranges(
    nodes: int, since_s: float
) -> None:
    run = relpos.simulate("mission-base", 1, nodes=nodes, seconds=80)
    kept = []
    for m in run.measurements:
        if isinstance(m, Motion) and m.node == 3 and m.time_s > since_s:
            # An inertial sensor that never worked, or a person on a stretcher.
            if since_s < 0.0:
                continue
            m = replace(m, dx_m=0.0, dy_m=0.0, dtheta_rad=0.0)
        kept.append(m)
    result = relpos.fuse(replace(run, measurements=tuple(kept)))
    true = {(t.time_s, t.node): np.array([t.x_m, t.y_m]) for t in run.truth}
    square, over = [], []
    for e in result.estimates:
        if e.time_s < 45.0:
            continue
        at_s = float(round(e.time_s))
        for pair, status in zip(e.pairs, e.pair_statuses(), strict=True):
            if 3 in (pair.node, pair.peer):
                distance_m = float(np.linalg.norm(true[at_s, pair.node] - true[at_s, pair.peer]))
                off = (pair.distance_m - distance_m) / pair.sigma_distance_m
                square.append(off**2)
                over.append(status is NodeStatus.OK and abs(off) > 3.0)
    assert np.mean(square) < 1.6
    assert np.mean(over) < 0.015
