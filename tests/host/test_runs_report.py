"""The report: what its pictures show, looked at through the figures they are drawn from."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from relpos.evaluation import report, tracks
from relpos.evaluation.metrics import Track, evaluate
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus

TIMES = np.arange(0.0, 21.0)


def circle(radius_m: float, angle_rad: float = 0.0, shift_m: float = 0.0) -> Track:
    turn = TIMES / 5.0 + angle_rad
    return Track(TIMES, radius_m * np.cos(turn) + shift_m, radius_m * np.sin(turn), turn)


def content(fused: dict[int, Track], truth: dict[int, Track]) -> report.Content:
    return report.Content(
        title="a <walk>",
        subtitle="made up",
        truth=truth,
        fused=fused,
        metrics=evaluate(fused, truth),
        dead_reckoning=fused,
        baseline=evaluate(fused, truth),
    )


def test_tracks_are_drawn_on_the_truth_whatever_their_frame() -> None:
    truth = {1: circle(3.0), 2: circle(5.0)}
    fused = {1: circle(3.0, 1.0, 40.0), 2: circle(5.0, 1.0, 40.0)}
    axes = report.draw_tracks(content(fused, truth)).axes[1]
    lines = {line.get_label(): line for line in axes.get_lines()}
    for node, true in truth.items():
        x_m, y_m = lines[f"node {node}"].get_data()
        np.testing.assert_allclose(x_m, true.x_m, atol=1e-9)
        np.testing.assert_allclose(y_m, true.y_m, atol=1e-9)
    assert axes.get_aspect() == 1.0
    assert axes.get_xlabel() == "x (m)"


def test_no_line_joins_rows_across_a_gap() -> None:
    truth = {1: circle(3.0), 2: circle(5.0)}
    there = (TIMES < 5) | (TIMES > 12)
    holey = Track(TIMES[there], truth[1].x_m[there], truth[1].y_m[there])
    axes = report.draw_tracks(content({1: holey, 2: truth[2]}, truth)).axes[1]
    line = next(line for line in axes.get_lines() if line.get_label() == "node 1")
    assert np.isnan(np.asarray(line.get_xdata(), dtype=float)).sum() == 1


def test_a_node_that_was_not_located_is_no_track() -> None:
    def at(time_s: float, status: NodeStatus) -> Estimate:
        return Estimate(time_s, (NodeEstimate(1, 2.0, 3.0, 0.0, 1, 1, 0, 1, status),), ())

    (track,) = tracks.located_tracks(
        [at(0.0, NodeStatus.UNLOCATED), at(1.0, NodeStatus.AMBIGUOUS), at(2.0, NodeStatus.OK)]
    ).values()
    assert np.isnan(track.x_m).tolist() == [True, True, False]


@pytest.mark.parametrize("nodes", [2, 3, 8])
def test_the_page_holds_everything_for_teams_of_any_size(tmp_path: Path, nodes: int) -> None:
    truth = {n: circle(1.0 + n) for n in range(1, nodes + 1)}
    page = report.write_report(tmp_path, content(truth, truth)).read_text()
    assert "a &lt;walk&gt;" in page
    assert page.count("data:image/png;base64,") == 3
    assert page.count("<tr>") == 5 + 1 + math.comb(nodes, 2)


def test_a_team_without_a_common_second_still_gets_its_page(tmp_path: Path) -> None:
    truth = {1: circle(3.0), 2: circle(4.0)}
    nowhere = {n: Track(TIMES, TIMES * np.nan, TIMES * np.nan) for n in truth}
    assert report.write_report(tmp_path, content(nowhere, truth)).exists()
