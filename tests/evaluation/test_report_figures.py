"""The report: what its figures show, looked at through the figures they are drawn from."""

from __future__ import annotations

import math
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from relpos import tracks
from relpos.evaluation import report
from relpos.evaluation.result import Result
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus, pairs_of
from relpos.measurements import Motion, Range, Status, Truth
from relpos.runs import Description, NodeInfo, Run
from relpos.tracks import Track

TIMES = np.arange(0.0, 21.0)


def circle(radius_m: float, angle_rad: float = 0.0, shift_m: float = 0.0) -> Track:
    turn = TIMES / 5.0 + angle_rad
    return Track(TIMES, radius_m * np.cos(turn) + shift_m, radius_m * np.sin(turn), turn)


def truth_of(ways: dict[int, Track]) -> tuple[Truth, ...]:
    return tuple(
        Truth(*row[:1], node, *row[1:])
        for node, way in ways.items()
        for row in zip(
            way.time_s.tolist(), way.x_m.tolist(), way.y_m.tolist(), way.heading_rad.tolist(),
            strict=True,
        )
    )  # fmt: skip


def estimates_of(
    ways: dict[int, Track], status: NodeStatus = NodeStatus.OK
) -> tuple[Estimate, ...]:
    found = []
    for time_s in TIMES.tolist():
        nodes = []
        for node, way in ways.items():
            at = way.time_s == time_s
            if at.any():
                pose = float(way.x_m[at][0]), float(way.y_m[at][0]), float(way.heading_rad[at][0])
                nodes.append(NodeEstimate(node, *pose, 0.01, 0.01, 0.0, 0.1, status))
        found.append(Estimate(time_s, tuple(nodes), pairs_of(nodes)))
    return tuple(found)


def content(
    fused: dict[int, Track], truth: dict[int, Track], names: dict[int, str] | None = None
) -> report.Content:
    motions = [Motion(t, node, 0.1, 0.0, 0.0) for t in TIMES.tolist() for node in fused]
    ranges = [
        Range(t, a, b, 2.0 + 0.01 * t)
        for t in TIMES.tolist()
        for a in fused
        for b in fused
        if a < b
    ]
    named = {node: NodeInfo(name=name) for node, name in (names or {}).items()}
    run = Run(
        "a <walk>",
        Description(nodes=named),
        tuple(sorted((*motions, *ranges), key=lambda m: m.time_s)),
        truth=truth_of(truth),
    )
    return report.gather(run, Result("ours", estimates_of(fused)))


def lines(figure: Any, panel: int) -> dict[str, np.ndarray]:
    return {
        str(line.get_label()): np.asarray(line.get_data(), dtype=float)
        for line in figure.axes[panel].get_lines()
    }


def test_tracks_are_drawn_on_the_truth_whatever_their_frame() -> None:
    truth = {1: circle(3.0), 2: circle(5.0)}
    fused = {1: circle(3.0, 1.0, 40.0), 2: circle(5.0, 1.0, 40.0)}
    figure = report.draw(content(fused, truth), "tracks")
    for node, true in truth.items():
        x_m, y_m = lines(figure, 1)[f"node {node}"]
        np.testing.assert_allclose(x_m, true.x_m, atol=1e-9)
        np.testing.assert_allclose(y_m, true.y_m, atol=1e-9)
    assert figure.axes[1].get_aspect() == 1.0
    assert figure.axes[1].get_xlabel() == "x (m)"


def test_no_line_joins_rows_across_a_gap() -> None:
    truth = {1: circle(3.0), 2: circle(5.0)}
    there = (TIMES < 5) | (TIMES > 12)
    holey = Track(
        TIMES[there], truth[1].x_m[there], truth[1].y_m[there], truth[1].heading_rad[there]
    )
    figure = report.draw(content({1: holey, 2: truth[2]}, truth), "tracks")
    assert np.isnan(lines(figure, 1)["node 1"][0]).sum() == 1


@pytest.mark.parametrize(("floors_m", "start_m"), [((0.0, 3.5), 7.0), ((), 0.0)])
def test_true_heights_count_from_where_the_estimated_ones_do(
    floors_m: tuple[float, ...], start_m: float
) -> None:
    # Two floors up from the start on; its truth begins after the first estimate.
    ways = {1: circle(3.0)}
    plain = content(ways, {1: Track(TIMES, ways[1].x_m, ways[1].y_m, ways[1].heading_rad)})
    climbed = replace(ways[1], time_s=TIMES + 0.1, z_m=7.0 + 0.1 * TIMES)
    told = replace(ways[1], z_m=0.0 * TIMES)
    run = replace(plain.run, description=Description(floors_m=floors_m))
    seen = replace(plain, run=run, truth={1: climbed}, guessed={1: told})
    assert lines(report.draw(seen, "height"), 0)["truth"][1][0] == pytest.approx(start_m)


def test_a_node_that_was_not_located_is_no_track() -> None:
    def at(time_s: float, status: NodeStatus) -> Estimate:
        return Estimate(time_s, (NodeEstimate(1, 2.0, 3.0, 0.0, 1, 1, 0, 1, status),), ())

    (track,) = tracks.located_tracks(
        [at(0.0, NodeStatus.UNLOCATED), at(1.0, NodeStatus.AMBIGUOUS), at(2.0, NodeStatus.OK)]
    ).values()
    assert np.isnan(track.x_m).tolist() == [True, True, False]


class Rows(HTMLParser):
    """Counts the rows of each table by its caption."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: dict[str, int] = {}
        self._caption: str | None = None
        self._inside = self._body = False

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag == "caption":
            self._inside = True
        if tag == "tr" and self._caption is not None and self._body:
            self.rows[self._caption] += 1
        self._body = tag == "tbody" or (self._body and tag != "table")

    def handle_data(self, data: str) -> None:
        if self._inside:
            self._caption = data
            self.rows[data] = 0
            self._inside = False


@pytest.mark.parametrize("nodes", [2, *(pytest.param(n, marks=pytest.mark.soak) for n in (3, 8))])
def test_the_page_holds_everything_for_teams_of_any_size(tmp_path: Path, nodes: int) -> None:
    ways = {n: circle(1.0 + n) for n in range(1, nodes + 1)}
    page = report.write(content(ways, ways, {1: "Kim <3"}), tmp_path / "r.html").read_text()
    assert "a &lt;walk&gt;" in page
    assert "Kim &lt;3 (1)" in page
    rows = Rows()
    rows.feed(page)
    assert rows.rows["Each pair"] == rows.rows["Ranges of each pair"] == math.comb(nodes, 2)
    assert rows.rows["At the end (20.0 s)"] == nodes
    assert page.count('role="img"') >= 6


def test_a_team_without_a_common_second_still_gets_its_page(tmp_path: Path) -> None:
    truth = {1: circle(3.0), 2: circle(4.0)}
    late = {n: Track(TIMES + 100.0, way.x_m, way.y_m, way.heading_rad) for n, way in truth.items()}
    given = content(truth, late)
    assert given.evaluation is None
    page = report.write(given, tmp_path / "r.html").read_text()
    assert "no truth at a time of which there is an estimate" in page


def test_an_estimate_of_nothing_still_gets_its_page(tmp_path: Path) -> None:
    given = content({1: circle(3.0), 2: circle(4.0)}, {1: circle(3.0)})
    empty = report.gather(replace(given.run, truth=()), Result("ours", ()))
    assert "Nothing could be estimated." in report.write(empty, tmp_path / "r.html").read_text()


def test_a_node_with_motion_but_without_status_is_a_row_of_the_health_figure() -> None:
    ways = {1: circle(3.0), 2: circle(4.0)}
    given = content(ways, ways)
    silent = tuple(m for m in given.run.measurements if not (m.node == 2 and 5.0 < m.time_s < 15.0))
    status = tuple(Status(t, 1, "battery_v", 4.9) for t in (0.0, 10.0, 20.0))
    run = replace(given.run, measurements=silent, statuses=status)
    drawn = report.draw(report.gather(run, given.result), "health")
    assert [label.get_text() for label in drawn.axes[0].get_yticklabels()] == ["node 1", "node 2"]
