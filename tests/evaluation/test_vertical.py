"""Heights, floors and stairs against numbers worked out by hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import relpos
from relpos.evaluation import vertical
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.measurements import Event
from relpos.tracks import Track

FLOORS_M = (-3.0, 0.0, 3.0)
TIMES = np.arange(41.0)
CLIMB_M = np.interp(TIMES, [10.0, 20.0], [0.0, 3.0])
"""Everybody stands for 10 s, climbs for 10 s, and stands."""


@dataclass
class Stated:
    """What an estimate states of a node."""

    node: int
    x_m: float
    y_m: float
    z_m: float
    sigma_z_m: float = 1.0
    heading_rad: float = 0.0
    status: NodeStatus = NodeStatus.OK
    floor: int | None = None
    floor_probability: float | None = None
    episode: str | None = None


def place(node: int, time_s: float) -> tuple[float, float]:
    """Along x on the stairs, each person two metres from the next."""
    return float(np.interp(time_s, [10.0, 20.0], [0.0, 4.0])), 2.0 * node


def truth(nodes: int = 3) -> dict[int, Track]:
    return {
        node: Track(
            TIMES,
            [place(node, t)[0] for t in TIMES],
            0.0 * TIMES + 2.0 * node,
            0.0 * TIMES,
            CLIMB_M,
        )
        for node in range(1, nodes + 1)
    }


def events(nodes: int = 3) -> list[Event]:
    rows = ((0.0, "level"), (10.0, "up"), (20.0, "level"))
    return [Event(t, n, "episode", word) for n in range(1, nodes + 1) for t, word in rows]


def estimates(off_m=lambda node: 0.0, nodes: int = 3, stretch: float = 1.0, **stated):
    """What ``stated`` makes of (node, time) beside a height that is off by ``off_m``."""
    made = []
    for t, z in zip(TIMES, CLIMB_M, strict=True):
        rows = []
        for node in range(1, nodes + 1):
            x, y = place(node, t)
            told = {name: make(node, t) for name, make in stated.items()}
            rows.append(Stated(node, stretch * x, y, z + off_m(node), **told))
        made.append(Estimate(float(t), tuple(rows), ()))
    return made


def scored(found, floors_m=FLOORS_M, marks=None, nodes: int = 3):
    return vertical.score(found, truth(nodes), floors_m, events(nodes) if marks is None else marks)


def test_errors_common_to_all_count_in_height_but_not_between_two() -> None:
    found = scored(estimates(lambda node: 0.5))
    assert (found.rmse_m, found.ve95_m) == pytest.approx((0.5, 0.5))
    assert (found.relative_rmse_m, found.aligned_3d_rmse_m) == pytest.approx((0.0, 0.0))
    assert found.nees == pytest.approx(0.25)
    assert found.se95_m == pytest.approx(0.5)
    assert found.seconds == 3 * 41


def test_an_error_of_one_counts_in_the_pairs_that_it_has() -> None:
    # Of the pairs 1-2, 1-3, 2-3 two are off by 0.6 m; off the mean they are .4, .2, .2.
    found = scored(estimates(lambda node: 0.6 * (node == 1)))
    assert found.relative_rmse_m == pytest.approx(np.sqrt(2 * 0.36 / 3))
    assert found.aligned_3d_rmse_m == pytest.approx(np.sqrt((0.16 + 0.04 + 0.04) / 3))


def test_without_floors_one_shift_is_taken_out() -> None:
    found = scored(estimates(lambda node: 7.0), floors_m=())
    assert found.rmse_m == pytest.approx(0.0)
    assert "floors: the run has no [building] floors_m" in found.not_scored


def test_an_estimate_without_the_columns_is_not_scored_for_them_and_says_so() -> None:
    found = scored(estimates(lambda node: 2.0))
    # 2 m up is nearer to the next floor, of which the upper one has none.
    assert found.floor_by_height == pytest.approx(21.0 / 31.0)
    assert np.isnan(found.floor_right)
    assert np.isnan(found.flights_found)
    assert found.not_scored == (
        "floors: the estimate states none",
        "flights: the estimate states none",
    )


def test_floors_are_scored_off_stairs_and_wrong_claims_everywhere() -> None:
    # Right until 20 s, then still the lower floor; on the stairs either floor is right.
    found = scored(
        estimates(floor=lambda n, t: 0, floor_probability=lambda n, t: 0.95 if t < 30 else 0.5)
    )
    off_stairs = [t for t in TIMES if not 10.0 <= t < 20.0]
    assert found.floor_right == pytest.approx(10.0 / len(off_stairs))
    assert found.wrong_claimed == pytest.approx(10.0 / 41.0)


def test_an_unknown_floor_is_not_right_and_claims_nothing() -> None:
    found = scored(
        estimates(
            floor=lambda n, t: 0 if n == 1 and t < 20 else None, floor_probability=lambda n, t: 0.95
        )
    )
    assert found.floor_right == pytest.approx(10.0 / 31.0 / 3.0)
    assert found.wrong_claimed == 0.0


@pytest.mark.parametrize(
    ("begin_s", "word", "found", "false"),
    [(14.0, "up", 1.0, 0), (25.0, "up", 0.0, 0), (14.0, "down", 0.0, 3), (33.0, "up", 0.0, 3)],
)
def test_a_flight_is_found_late_but_not_in_the_wrong_direction(begin_s, word, found, false) -> None:
    result = scored(
        estimates(episode=lambda n, t: word if begin_s <= t < begin_s + 6.0 else "level")
    )
    assert result.flights == 3
    assert result.flights_found == found
    assert result.false_flights_h == pytest.approx(false / (3 * 41 / 3600.0))


def test_false_flights_are_counted_over_the_time_that_has_an_estimate() -> None:
    stated = estimates(episode=lambda n, t: "down" if 5.0 <= t < 8.0 else "level")
    assert scored(stated[:11]).false_flights_h == pytest.approx(3600.0 / 13.0), "and 2 s more"


def test_a_flight_that_the_run_ends_in_is_neither_missed_nor_false() -> None:
    stated = estimates(episode=lambda n, t: "up" if t >= 14.0 else "level")
    result = scored(stated, marks=[e for e in events() if e.time_s < 20.0])
    assert (result.flights, result.false_flights_h) == (0, 0.0)


def test_the_way_on_flights_is_estimated_over_true() -> None:
    assert scored(estimates()).stairs_way == pytest.approx(1.0)
    assert scored(estimates(stretch=2.0)).stairs_way == pytest.approx(2.0)


def test_a_truth_without_heights_is_not_scored() -> None:
    flat = {node: Track(t.time_s, t.x_m, t.y_m) for node, t in truth().items()}
    assert vertical.score(estimates(), flat, FLOORS_M, ()) is None


def test_a_building_is_scored_by_evaluate() -> None:
    run = relpos.simulate("building", 4, seconds=200)
    result = relpos.fuse(run, estimator="deadreckoning")
    score = relpos.evaluate(result, run)
    numbers = score.as_json()["vertical"]
    assert 0.0 < numbers["relative_rmse_m"] < 1.0
    assert numbers["floor_by_height"] > 0.9
    assert 1.7 < numbers["stairs_way"] < 2.3
    assert numbers["floor_right"] is None
    assert "vertical error" in str(score)
    figure = relpos.plot(result, run, "section")
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.texts] == [f"floor {k}" for k in range(4)]
    assert {line.get_label() for line in axes.lines} >= {
        "truth",
        *(f"node {k}" for k in range(1, 7)),
    }
    flat = relpos.simulate("paper", 1, seconds=20)
    without = relpos.evaluate(relpos.fuse(flat, estimator="deadreckoning"), flat)
    assert without.as_json()["vertical"] is None
