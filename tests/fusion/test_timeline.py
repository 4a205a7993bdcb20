"""The timeline puts asynchronous reports into exact order."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relpos.errors import DataError
from relpos.fusion.timeline import Advance, Displacement, Epoch, Ranging, Sensed, Step, Timeline
from relpos.measurements import Heading, Height, Measurement, Motion, Range

Pose = tuple[float, float, float]


def compose(pose: Pose, dx: float, dy: float, dtheta: float) -> Pose:
    """Compose by complex numbers: independent of the code under test."""
    place = complex(pose[0], pose[1]) + complex(dx, dy) * complex(
        math.cos(pose[2]), math.sin(pose[2])
    )
    return place.real, place.imag, pose[2] + dtheta


def advances(steps: Iterable[Step], node: int) -> list[Advance]:
    return [s for s in steps if isinstance(s, Advance) and s.node == node]


def end_of(steps: Iterable[Step], node: int) -> Pose:
    pose: Pose = (0.0, 0.0, 0.0)
    for a in advances(steps, node):
        pose = compose(pose, a.dx_m, a.dy_m, a.dtheta_rad)
    return pose


def run(timeline: Timeline, measurements: Iterable[Measurement]) -> list[Step]:
    steps = [s for m in measurements for s in timeline.push(m)]
    return steps + timeline.finish()


size = st.floats(-3.0, 3.0)


@given(size, size, size, st.floats(0.0, 1.0))
def test_a_split_increment_composes_exactly_to_the_whole(
    dx: float, dy: float, dtheta: float, cut: float
) -> None:
    first, second = Displacement(dx, dy, dtheta).split(cut)
    half = compose((0.0, 0.0, 0.0), first.dx_m, first.dy_m, first.dtheta_rad)
    whole = compose(half, second.dx_m, second.dy_m, second.dtheta_rad)
    assert whole == pytest.approx((dx, dy, dtheta), abs=1e-12)


def test_a_split_piece_is_the_straight_share_of_the_chord() -> None:
    first, _ = Displacement(4.0, 2.0, 1.0).split(0.25)
    assert (first.dx_m, first.dy_m, first.dtheta_rad) == (1.0, 0.5, 0.25)


def test_both_nodes_are_at_the_time_of_a_range_when_it_is_weighed() -> None:
    steps = run(
        Timeline(),
        [
            Motion(1.0, 1, 1.0, 0.0, 0.0),
            Range(1.2, 1, 2, 5.0),
            Motion(1.6, 2, 3.2, 0.0, 0.0),
            Motion(2.0, 1, 1.0, 0.0, 0.0),
            Motion(2.6, 2, 1.0, 0.0, 0.0),
        ],
    )
    at = next(k for k, s in enumerate(steps) if isinstance(s, Ranging))
    assert end_of(steps[:at], 1) == pytest.approx((1.2, 0.0, 0.0))
    assert end_of(steps[:at], 2) == pytest.approx((2.4, 0.0, 0.0))
    assert end_of(steps, 1) == pytest.approx((2.0, 0.0, 0.0))
    assert end_of(steps, 2) == pytest.approx((4.2, 0.0, 0.0))


@given(
    st.lists(st.tuples(size, size, size), min_size=1, max_size=6),
    st.lists(st.floats(0.01, 7.0), max_size=12),
)
def test_ranges_at_any_time_cost_no_displacement(
    motions: list[tuple[float, float, float]], ranges: list[float]
) -> None:
    pose: Pose = (0.0, 0.0, 0.0)
    measurements: list[Measurement] = []
    for k, (dx, dy, dtheta) in enumerate(motions):
        pose = compose(pose, dx, dy, dtheta)
        measurements.append(Motion(k + 1.0, 1, dx, dy, dtheta))
    measurements += [Range(t, 1, 2, 1.0) for t in ranges]
    steps = run(Timeline(), sorted(measurements, key=lambda m: m.time_s))
    assert end_of(steps, 1) == pytest.approx(pose, abs=1e-9)
    assert sum(a.fraction for a in advances(steps, 1)) == pytest.approx(len(motions))


def test_the_variances_of_the_pieces_add_up_to_the_reports() -> None:
    steps = run(
        Timeline(), [Range(0.3, 1, 2, 1.0), Range(0.8, 1, 2, 1.0),
                     Motion(1.0, 1, 1.0, 0.0, 0.0, 0.1, 0.2, 0.3)]
    )  # fmt: skip
    pieces = advances(steps, 1)
    assert len(pieces) == 3
    assert sum((a.sigma_x_m or 0.0) ** 2 for a in pieces) == pytest.approx(0.01)
    assert sum((a.sigma_theta_rad or 0.0) ** 2 for a in pieces) == pytest.approx(0.09)


def test_measurements_out_of_order_within_the_bound_give_the_same_steps() -> None:
    ordered: list[Measurement] = []
    for k in range(1, 8):
        ordered += [Range(k - 0.5, 1, 2, 3.0), Motion(float(k), 1, 0.5, 0.0, 0.1),
                    Motion(k + 0.1, 2, 0.5, 0.0, 0.1)]  # fmt: skip
    shuffled = ordered[:]
    for k in range(0, len(shuffled) - 1, 2):
        shuffled[k], shuffled[k + 1] = shuffled[k + 1], shuffled[k]
    straight = Timeline(reorder_s=1.0)
    mixed = Timeline(reorder_s=1.0)
    assert run(mixed, shuffled) == run(straight, ordered)
    assert not mixed.counters


def test_a_silent_node_delays_no_other_longer_than_the_bound() -> None:
    timeline = Timeline(nodes=[1, 2], max_lag_s=3.0, reorder_s=0.0)
    closed: list[float] = []
    for k in range(1, 11):
        steps = timeline.push(Motion(float(k), 1, 1.0, 0.0, 0.0))
        closed += [s.time_s for s in steps if isinstance(s, Epoch)]
    assert closed == [float(k) for k in range(1, 11)]


def test_the_displacement_of_a_node_that_comes_back_is_not_lost() -> None:
    timeline = Timeline(nodes=[1, 2], max_lag_s=3.0, reorder_s=0.0)
    measurements: list[Measurement] = [Motion(float(k), 1, 1.0, 0.0, 0.0) for k in range(1, 11)]
    steps = run(timeline, [*measurements, Motion(9.5, 2, 7.0, 0.0, 0.0)])
    assert end_of(steps, 2) == pytest.approx((7.0, 0.0, 0.0))
    assert timeline.counters["motions_late"] == 1


def test_a_range_that_comes_too_late_is_dropped_and_counted() -> None:
    timeline = Timeline(nodes=[1], reorder_s=0.5)
    steps = run(
        timeline,
        [*(Motion(float(k), 1, 1.0, 0.0, 0.0) for k in range(1, 11)), Range(2.0, 1, 2, 3.0)],
    )
    assert not any(isinstance(s, Ranging) for s in steps)
    assert timeline.counters["ranges_late"] == 1


def test_zero_self_and_repeated_ranges_are_dropped_and_counted() -> None:
    timeline = Timeline()
    steps = run(
        timeline,
        [Range(0.5, 1, 2, 0.0), Range(0.5, 1, 1, 2.0), Range(0.6, 1, 2, 2.0),
         Range(0.6, 1, 2, 2.0), Motion(1.0, 1, 1.0, 0.0, 0.0)],
    )  # fmt: skip
    assert [len(s.ranges) for s in steps if isinstance(s, Ranging)] == [1]
    assert timeline.counters == {
        "ranges_failed": 1, "ranges_to_itself": 1, "ranges_duplicate": 1
    }  # fmt: skip


def test_a_report_that_stands_twice_moves_its_node_once() -> None:
    timeline = Timeline(nodes=[1])
    reports = [Motion(float(k), 1, 1.0, 0.0, 0.0) for k in (1, 2, 2, 3)]
    assert end_of(run(timeline, reports), 1) == pytest.approx((3.0, 0.0, 0.0))
    assert timeline.counters == {"motions_duplicate": 1}


@pytest.mark.parametrize("after", [3, 5, 20])
def test_a_report_that_comes_again_behind_later_ones_moves_its_node_once(after: int) -> None:
    timeline = Timeline(nodes=[1])
    reports = [Motion(float(k), 1, 1.0, 0.0, 0.0) for k in range(1, 31)]
    reports.insert(1 + after, reports[1])
    assert end_of(run(timeline, reports), 1) == pytest.approx((30.0, 0.0, 0.0))
    assert timeline.counters == {"motions_duplicate": 1}


def test_a_number_that_is_none_is_an_error() -> None:
    with pytest.raises(DataError, match="finite"):
        Timeline().push(Motion(1.0, 1, math.nan, 0.0, 0.0))


def test_one_epoch_a_round_of_reports_with_everybody_at_its_time() -> None:
    measurements: list[Measurement] = []
    for k in range(1, 6):
        measurements += [Motion(k + 0.2 * n, n, 1.0, 0.0, 0.0) for n in (0, 1, 2)]
    steps = run(Timeline(), measurements)
    epochs = [s.time_s for s in steps if isinstance(s, Epoch)]
    assert epochs == [1.0, 2.0, 3.0, 4.0, 5.0, 5.4]
    for time_s in epochs[1:-1]:
        reached = steps[: steps.index(Epoch(time_s))]
        for node in (0, 1, 2):
            assert advances(reached, node)[-1].time_s == pytest.approx(time_s)


def test_a_motion_takes_the_time_since_the_one_before_it() -> None:
    steps = run(Timeline((1,)), [Motion(float(t), 1, 1.0, 0.0, 0.0) for t in (1, 3)])
    assert [(a.time_s, a.duration_s) for a in advances(steps, 1)] == [(1.0, 1.0), (3.0, 2.0)]


def test_a_motion_behind_its_successor_counts_whole_but_takes_no_time_of_its_own() -> None:
    timeline = Timeline((1,), reorder_s=0.0)
    rows = [Motion(t, 1, 1.0, 0.0, 0.0) for t in (1.0, 3.0, 2.0)]
    durations = [a.duration_s for a in advances(run(timeline, rows), 1)]
    assert durations == [1.0, 2.0, 0.0]


def test_a_run_that_begins_before_zero_takes_its_first_motion_at_its_time() -> None:
    rows: list[Measurement] = [Motion(-2.0, 1, 1.0, 0.0, 0.0), Motion(-1.0, 1, 4.0, 0.0, 0.0)]
    rows.append(Range(-1.5, 1, 2, 3.0))
    steps = run(Timeline((1, 2)), rows)
    assert [(a.time_s, a.duration_s, a.dx_m) for a in advances(steps, 1)] == [
        (-2.0, 0.0, 1.0),
        (-1.5, 0.5, 2.0),
        (-1.0, 0.5, 2.0),
    ]


def rounds(count: int) -> list[Measurement]:
    """Of two nodes, in order of time: a range, two headings, their motions at 1.75, 2.75 s ..."""
    of_all: list[Measurement] = []
    for k in range(1, 1 + count):
        of_all += [
            Range(k + 0.25, 1, 2, 3.0),
            Heading(k + 0.5, 2, 0.2, 0.1, "phone"), Heading(k + 0.5, 1, 0.1, 0.1, "phone"),
            Motion(k + 0.75, 1, 0.5, 0.0, 0.1), Motion(k + 0.75, 2, 0.5, 0.0, 0.1),
        ]  # fmt: skip
    return of_all


def test_taking_in_gives_the_steps_of_pushing_and_says_when_there_are_any() -> None:
    taking, pushing = (Timeline((1, 2), 0.75, keep_late=True) for _ in range(2))
    said = set()
    for measurement in rounds(6):
        certain = taking.take_in(measurement)
        steps = list(taking.push_all(()))
        assert steps == pushing.push(measurement)
        assert certain or not steps
        said.add(certain)
    assert said == {False, True}
    assert taking.finish() == pushing.finish()
    assert not taking.late, "what comes in order is called late"


def test_only_what_may_give_steps_is_worked_off() -> None:
    timeline = Timeline((1, 2), 0.75)
    steps: list[Step] = []
    for measurement in rounds(6):
        if timeline.take_in(measurement):
            steps += timeline.push_all(())
    assert [s.time_s for s in steps if isinstance(s, Epoch)] == [1.75, 2.75, 3.75, 4.75, 5.75]


def test_measurements_of_one_instant_give_the_same_steps_in_any_order() -> None:
    ordered = rounds(4)
    backwards = sorted(ordered, key=lambda m: (m.time_s, -m.node, -ordered.index(m)))
    assert run(Timeline((1, 2), 0.75), backwards) == run(Timeline((1, 2), 0.75), ordered)


def test_what_is_as_old_as_the_bound_is_waited_for_no_longer() -> None:
    timeline = Timeline((1,), reorder_s=0.5)
    assert timeline.push(Motion(1.0, 1, 1.0, 0.0, 0.0)) == []
    assert timeline.push(Motion(1.5, 1, 1.0, 0.0, 0.0)) != []


def test_a_late_displacement_is_late_from_its_beginning() -> None:
    timeline = Timeline((1, 2), reorder_s=0.0, max_lag_s=1.0, keep_late=True)
    for time_s in (1.0, 2.0, 3.0, 6.0, 9.0):
        timeline.push(Motion(time_s, 1, 1.0, 0.0, 0.0))
    for time_s in (3.0, 8.0, 5.0):
        timeline.push(Motion(time_s, 2, 1.0, 0.0, 0.0))
    timeline.push(Motion(10.0, 1, 1.0, 0.0, 0.0))
    timeline.push(Motion(2.0, 2, 1.0, 0.0, 0.0))
    found = [(late.since_s, late.time_s) for late in timeline.late]
    assert found == [(0.0, 3.0), (3.0, 8.0), (3.0, 5.0), (-math.inf, 2.0)]


def moved(time_s: float, node: int) -> Motion:
    return Motion(time_s, node, 1.0, 0.0, 0.0)


def test_what_is_sensed_at_one_instant_comes_by_node_heights_first() -> None:
    expected = [
        Height(1.5, 1, 0.2), Height(1.5, 1, 0.3), Heading(1.5, 1, 0.4, 0.1, "phone"),
        Height(1.5, 2, 0.1), Heading(1.5, 2, -0.4, 0.1, "phone"),
    ]  # fmt: skip
    for given_so in (expected, expected[::-1]):
        steps = run(Timeline((1, 2)), [moved(1.0, 1), *given_so, moved(2.0, 1), moved(2.0, 2)])
        assert [s.measurement for s in steps if isinstance(s, Sensed)] == expected


def test_a_motion_that_its_successor_overtook_while_both_wait_takes_its_place() -> None:
    timeline = Timeline((1, 2), reorder_s=0.0, max_lag_s=10.0)
    rows = [moved(t, 1) for t in (1.0, 5.0, 4.0, 2.0)]
    found = advances(run(timeline, [*rows, moved(6.0, 2)]), 1)
    assert [(a.time_s, a.duration_s) for a in found] == [
        (1.0, 1.0),
        (2.0, 1.0),
        (4.0, 2.0),
        (5.0, 1.0),
    ]
    assert not timeline.counters


def test_the_first_of_a_nodes_motions_may_be_overtaken_too() -> None:
    timeline = Timeline((1, 2), reorder_s=0.0, max_lag_s=10.0)
    found = advances(run(timeline, [moved(t, 1) for t in (5.0, 3.0)]), 1)
    assert [(a.time_s, a.duration_s) for a in found] == [(3.0, 3.0), (5.0, 2.0)]
    assert not timeline.counters


def test_a_second_motion_of_an_instant_counts_whole_and_as_late() -> None:
    timeline = Timeline((1,), reorder_s=0.0, keep_late=True)
    second = replace(moved(1.0, 1), dx_m=2.0)
    steps = run(timeline, [moved(1.0, 1), second, moved(2.0, 1)])
    assert end_of(steps, 1) == (4.0, 0.0, 0.0)
    assert [s.time_s for s in steps if isinstance(s, Epoch)] == [1.0, 2.0]
    assert timeline.counters == {"motions_late": 1}
    assert [(late.since_s, late.time_s) for late in timeline.late] == [(-math.inf, 1.0)]


def test_a_range_behind_the_frontier_or_at_it_is_late_at_its_time() -> None:
    timeline = Timeline((1, 2), reorder_s=0.0, keep_late=True)
    for measurement in (moved(4.0, 1), moved(4.0, 2), Range(4.0, 1, 2, 3.0)):
        timeline.push(measurement)
    assert [late.time_s for late in timeline.late] == [4.0]
    timeline.late.clear()
    assert timeline.push(Range(4.0, 1, 2, 3.1)) == [], "once more of the instant handed out"
    assert timeline.counters == {"ranges_duplicate": 1}
    timeline.counters.clear()
    timeline.push(Range(3.0, 1, 2, 3.0))
    timeline.push(Height(2.0, 1, 3.0))
    assert [late.time_s for late in timeline.late] == [4.0, 3.0, 2.0]
    assert all(late.since_s == math.nextafter(late.time_s, 0.0) for late in timeline.late)
    assert timeline.counters == {"ranges_late": 1, "sensed_late": 1}


def test_a_silent_node_is_waited_for_as_long_as_the_bound() -> None:
    timeline = Timeline((1, 2), max_lag_s=3.0, reorder_s=0.0)
    given_out = [bool(timeline.push(moved(t, 1))) for t in (1.0, 2.0, 3.0, 3.5)]
    assert given_out == [False, False, False, True]
    assert Timeline((1, 2), max_lag_s=3.0, reorder_s=0.0).push(moved(3.0, 1)) == []


@pytest.mark.parametrize(("lazy", "at_range"), [(False, {1, 2, 3}), (True, {1, 2})])
def test_a_lazy_timeline_moves_only_whom_a_range_concerns_until_the_epoch(
    lazy: bool, at_range: set[int]
) -> None:
    timeline = Timeline((1, 2, 3), lazy=lazy)
    rows: list[Measurement] = [moved(k + 0.1 * n, n) for k in (1, 2, 3) for n in (1, 2, 3)]
    steps = run(timeline, sorted([*rows, Range(1.5, 1, 2, 3.0)], key=lambda m: m.time_s))
    at = next(k for k, s in enumerate(steps) if isinstance(s, Ranging))
    assert {s.node for s in steps[:at] if isinstance(s, Advance) and s.time_s == 1.5} == at_range
    epoch = next(k for k, s in enumerate(steps) if isinstance(s, Epoch) and s.time_s > 1.5)
    assert [end_of(steps[:epoch], n)[0] for n in (1, 2, 3)] == pytest.approx([2.0, 1.9, 1.8])
    assert timeline.catch_up((9,), 5.0) == []


def test_a_lazy_timeline_moves_whom_a_heading_concerns_and_not_for_a_height() -> None:
    for sensed, moves in ((Heading(1.5, 2, 0.1, 0.1, "phone"), [1.5]), (Height(1.5, 2, 3.0), [])):
        rows = [moved(1.0, 1), moved(1.0, 2), sensed, moved(2.0, 1), moved(2.0, 2)]
        steps = run(Timeline((1, 2), lazy=True), rows)
        at = next(k for k, s in enumerate(steps) if isinstance(s, Sensed))
        assert [a.time_s for a in advances(steps[:at], 2) if a.time_s > 1.0] == moves


def test_everything_is_handed_out_when_the_bound_is_over_however_much_came_before() -> None:
    timeline = Timeline((1,), reorder_s=0.5)
    for k in range(1, 51):
        timeline.push(moved(0.125 * k, 1))
        assert timeline.frontier_s == (0.125 * k - 0.5 if k > 4 else -math.inf)


def test_what_came_before_something_older_is_held_back_for_its_own_time() -> None:
    timeline = Timeline((1,), reorder_s=1.0)
    steps = [s for t in (2.0, 1.0, 2.5, 1.75) for s in timeline.push(moved(t, 1))]
    assert [s.time_s for s in steps if isinstance(s, Epoch)] == [1.0]
    assert [a.time_s for a in advances(timeline.finish(), 1)] == [1.75, 2.0, 2.5]
    assert not timeline.counters
    assert timeline.finish() == [], "a run ends once"


def test_sensed_values_that_wait_come_in_order_of_time() -> None:
    timeline = Timeline((1, 2), reorder_s=0.0)
    rows = [moved(4.0, 1), Height(3.0, 1, 1.0), Height(2.0, 1, 1.0), moved(4.0, 2)]
    sensed = [s.time_s for s in run(timeline, rows) if isinstance(s, Sensed)]
    assert sensed == [2.0, 3.0]


def test_a_motion_is_placed_behind_one_that_was_begun_but_never_before_it() -> None:
    timeline = Timeline((1, 2), reorder_s=0.0, max_lag_s=10.0)
    rows = [Range(1.5, 1, 2, 3.0), moved(5.0, 1), moved(7.0, 1), moved(2.0, 2)]
    steps = [s for m in rows for s in timeline.push(m)]
    assert [a.time_s for a in advances(steps, 1)] == [1.5, 2.0]
    steps += timeline.push(moved(6.0, 1))
    assert not timeline.counters
    steps += [*timeline.push(moved(3.0, 1)), *timeline.finish()]
    found = [(a.time_s, a.duration_s) for a in advances(steps, 1)]
    assert found == [(1.5, 1.5), (2.0, 0.5), (5.0, 3.0), (6.0, 1.0), (7.0, 1.0), (3.0, 0.0)]
    assert end_of(steps, 1) == pytest.approx((4.0, 0.0, 0.0))
    assert timeline.counters == {"motions_late": 1}


def test_a_motion_at_the_time_that_its_node_has_reached_is_late_though_another_waits() -> None:
    timeline = Timeline((1, 2), reorder_s=0.0, max_lag_s=10.0)
    other = replace(moved(2.0, 1), dx_m=2.0)
    for row in (moved(2.0, 1), moved(2.0, 2), moved(5.0, 1), other):
        timeline.push(row)
    assert timeline.counters == {"motions_late": 1}


def test_a_late_motion_before_one_that_waits_is_late_from_where_its_node_is() -> None:
    timeline = Timeline((1, 2), reorder_s=0.0, max_lag_s=5.0, keep_late=True)
    for row in (moved(3.0, 1), moved(3.0, 2), moved(9.0, 1), moved(10.0, 2)):
        timeline.push(row)
    timeline.late.clear()
    timeline.push(moved(8.0, 2))
    assert [(late.since_s, late.time_s) for late in timeline.late] == [(3.0, 8.0)]


def test_a_node_that_was_only_ranged_is_waited_for() -> None:
    timeline = Timeline(reorder_s=0.0)
    assert timeline.push(Range(0.5, 1, 2, 3.0)) == []
    assert timeline.push(moved(1.0, 1)) == []
    assert timeline.push(moved(1.0, 2)) != []


def test_a_node_has_reported_nothing_before_its_first_motion() -> None:
    timeline = Timeline((1,), reorder_s=0.0)
    timeline.push(Range(0.5, 1, 2, 3.0))
    timeline.push(moved(2.0, 3))
    never = -math.inf
    assert [timeline.reported_s(node) for node in (1, 2, 3, 9)] == [never, never, 2.0, never]


def test_taking_in_says_that_a_silent_node_is_waited_for_no_longer() -> None:
    timeline = Timeline((1, 2), reorder_s=0.5, max_lag_s=3.0)
    times = (1.0, 1.5, 1.25, 3.375, 3.5, 3.625)
    certain = [timeline.take_in(moved(t, 1)) for t in times]
    assert certain == [False, False, False, False, False, True]


def test_taking_in_says_at_once_what_is_as_old_as_the_bound_and_nothing_of_what_is_not() -> None:
    timeline = Timeline((1,), reorder_s=0.5)
    assert not timeline.take_in(moved(1.0, 1))
    assert timeline.take_in(moved(1.5, 1))
    assert list(timeline.push_all(()))
    assert not timeline.take_in(moved(1.25, 1))
