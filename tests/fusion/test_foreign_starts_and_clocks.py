"""What runs of others have: starts half known, clocks of their own, anchors, zeros for unknown."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import relpos
from relpos.evaluation.metrics import Metrics
from relpos.fusion import NodeStatus
from relpos.measurements import Motion, Prior, Range
from relpos.runs import Run

ANCHOR = 99


@pytest.fixture(scope="module")
def run() -> Run:
    return relpos.simulate("paper-p1", seed=41, seconds=90)


def scored(run: Run, result: relpos.Result) -> Metrics:
    return relpos.evaluate(result, run, bound=False).metrics


def later(run: Run, by_s: float) -> Run:
    return replace(
        run,
        measurements=tuple(replace(m, time_s=m.time_s + by_s) for m in run.measurements),
        truth=tuple(replace(t, time_s=t.time_s + by_s) for t in run.truth),
    )


def test_places_without_headings_are_a_start(run: Run) -> None:
    headless = replace(run, truth=tuple(replace(t, heading_rad=None) for t in run.truth))
    found = scored(run, relpos.fuse(headless, initial="truth"))
    assert found.relative_distance_rmse_m < 0.4
    assert found.ok_over_3_sigma < 0.015


@pytest.mark.parametrize("sigma_m", [30.0, 10_000.0])
def test_a_start_of_which_hardly_anything_is_known_is_an_unknown_one(
    run: Run, sigma_m: float
) -> None:
    starts = [Prior(n, 3.0 * n, 0.0, 0.0, sigma_m, 4.0) for n in run.node_ids]
    result = relpos.fuse(run, initial=starts)
    assert {node.status for node in result.estimates[-1].nodes} == {NodeStatus.OK}
    assert scored(run, result).distance_rmse_over_time_m[-1] < 0.6


def test_an_unknown_part_of_a_start_is_written_and_read(run: Run, tmp_path: Path) -> None:
    starts = (Prior(1, 0.0, 0.0, 0.0, 0.1, math.inf), Prior(2, 3.0, 0.0, 0.0, math.inf, 0.1))
    relpos.save(replace(run, description=replace(run.description, priors=starts)), tmp_path)
    assert relpos.load(tmp_path).priors == starts


@pytest.mark.parametrize(("zero_s", "smooth"), [(3600.0, False), (500_000.0, True)])
def test_the_zero_of_the_clock_does_not_matter(run: Run, zero_s: float, smooth: bool) -> None:
    usual, other = relpos.fuse(run, smooth=smooth), relpos.fuse(later(run, zero_s), smooth=smooth)
    before, after = scored(run, usual), scored(later(run, zero_s), other)
    assert after.relative_distance_rmse_m < 1.1 * before.relative_distance_rmse_m
    widest_m = [
        max(n.sigma_major_m for n in result.estimates[2].nodes) for result in (usual, other)
    ]
    assert widest_m[1] < 1.5 * widest_m[0]


def test_zeros_for_deviations_are_none(run: Run) -> None:
    def fused(sigma: float | None) -> list[tuple[float, float]]:
        reported = [
            replace(
                m, sigma_x_m=sigma, sigma_y_m=sigma, sigma_theta_rad=sigma, sigma_x_alone_m=None
            )
            if isinstance(m, Motion)
            else m
            for m in run.measurements
            if m.time_s < 30.0
        ]
        result = relpos.fuse(replace(run, measurements=tuple(reported)))
        return [(n.x_m, n.sigma_major_m) for e in result.estimates for n in e.nodes]

    assert fused(0.0) == fused(None)


def test_an_anchor_without_a_start_is_located_for_good() -> None:
    run = relpos.simulate("mission-base", seed=41, seconds=90, nodes=4)
    rng = np.random.default_rng(2)
    whole = [t for t in run.truth if t.time_s >= 1.0 and t.time_s % 1.0 == 0.0]
    off_m = 0.1 * rng.standard_normal(len(whole))
    ranges = [
        Range(t.time_s, t.node, ANCHOR, max(math.hypot(t.x_m - 8.0, t.y_m - 5.0) + e, 0.01))
        for t, e in zip(whole, off_m, strict=True)
    ]
    both = tuple(sorted([*run.measurements, *ranges], key=lambda m: m.time_s))
    result = relpos.fuse(replace(run, measurements=both), initial=run.priors)
    told = [n for e in result.estimates if e.time_s > 30.0 for n in e.nodes if n.node == ANCHOR]
    assert sum(n.status is NodeStatus.OK for n in told) > 0.95 * len(told)
    off = [math.hypot(n.x_m - 8.0, n.y_m - 5.0) / n.sigma_major_m for n in told]
    assert np.mean(np.array(off) > 3.0) < 0.05
