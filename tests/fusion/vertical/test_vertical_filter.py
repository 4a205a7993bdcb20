"""Heights, episodes and floors from outside: what a vertical filter makes of somebody's way."""

from __future__ import annotations

import pickle
from collections.abc import Sequence

import numpy as np
import pytest
from climbing import FALL, FAN_ON, Outcome, Part, blown, follow, lift, stairs, stand, walk

from relpos.fusion.estimator import Episode, Vertical
from relpos.fusion.timeline import Advance
from relpos.fusion.vertical.filter import VerticalFilter
from relpos.measurements import Height, Range

BESIDE = [walk(110)]
"""Somebody else, who stays on the level."""


def _episodes(told: Sequence[Vertical]) -> list[Episode]:
    """Return what is told one after another, each once, without the level."""
    found: list[Episode] = []
    last = None
    for one in told:
        if one.episode not in (last, None, Episode.LEVEL):
            found.append(one.episode)
        last = one.episode
    return found


def _error_m(outcome: Outcome, node: int = 1) -> np.ndarray:
    return np.array([v.z_m for v in outcome.told[node]]) - outcome.z_m[node]


@pytest.mark.parametrize("with_steps", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_two_flights_are_found_and_not_taken_for_level_way(seed: int, with_steps: bool) -> None:
    life = [walk(30), stairs(1.75), Part(2, 1.5, 1.2), stairs(1.75), walk(60)]
    outcome = follow({1: life, 2: BESIDE}, seed=seed, with_steps=with_steps)
    assert set(_episodes(outcome.told[1])) == {Episode.UP}
    assert 0.95 < outcome.claimed_m[1] / outcome.true_m[1] < 1.05
    assert np.abs(_error_m(outcome)).max() < 0.5
    assert outcome.told[1][-1].floor == 1
    assert outcome.told[1][-1].floor_probability > 0.9


@pytest.mark.parametrize(("riser_m", "tread_m"), [(0.15, 0.30), (0.175, 0.28), (0.20, 0.25)])
def test_the_way_on_stairs_is_right_for_usual_treads(riser_m: float, tread_m: float) -> None:
    life = [stand(10), *[stairs(3.5, riser_m, tread_m)] * 3, stand(20)]
    outcome = follow({1: life, 2: BESIDE})
    assert 0.85 < outcome.claimed_m[1] / outcome.true_m[1] < 1.15


def test_two_steps_at_a_time_are_stairs_as_well() -> None:
    outcome = follow({1: [walk(30), Part(7, 1.5, 0.84, 0.5, claims=1.25), walk(60)], 2: BESIDE})
    assert _episodes(outcome.told[1]) == [Episode.UP]
    assert abs(_error_m(outcome)[-1]) < 0.5


@pytest.mark.parametrize("rise_m", [7.0, -3.5])
def test_a_lift_is_a_lift_and_moves_its_rider(rise_m: float) -> None:
    outcome = follow({1: [walk(30), stand(5), lift(rise_m), stand(3), walk(60)], 2: BESIDE})
    assert _episodes(outcome.told[1]) == [Episode.LIFT]
    assert outcome.told[1][-1].floor == round(rise_m / 3.5)
    assert np.abs(_error_m(outcome)).max() < 0.8
    assert abs(_error_m(outcome)[-1]) < 0.4


@pytest.mark.parametrize("seed", range(3))
def test_a_fan_moves_nobody_to_another_floor(seed: int) -> None:
    stands, goes = (
        [walk(30), FAN_ON, stand(60)],
        [walk(30), Part(10, 1.8, 1.3, 0.0, -0.21), walk(60)],
    )
    outcome = follow({1: goes, 2: stands, 3: goes, 4: [walk(40), stand(60)]}, seed=seed)
    for node in (1, 2, 3, 4):
        assert {v.floor for v in outcome.told[node]} == {0}
        assert np.abs(_error_m(outcome, node)).max() < 1.0
    assert Episode.DISTURBED in _episodes(outcome.told[2])


def test_a_fan_that_all_walk_through_moves_nobody() -> None:
    lives = {n: [walk(30), Part(10, 1.5 + 0.1 * n, 1.3, 0.0, -0.21), walk(60)] for n in range(1, 7)}
    outcome = follow(lives)
    for node in range(1, 7):
        assert {v.floor for v in outcome.told[node]} == {0}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("starts_s", [36, 38, 42])
def test_a_fan_that_starts_while_most_climb_and_all_walk_moves_nobody_else(
    seed: int, starts_s: int
) -> None:
    climbs = {n: [walk(30 + n), stairs(3.5), walk(60)] for n in range(1, 5)}
    lives = {**climbs, 5: [walk(105)], 6: [walk(105)]}
    outcome = follow({n: blown(life, starts_s) for n, life in lives.items()}, seed=seed)
    for node, floor in zip(range(1, 7), [1] * 4 + [0] * 2, strict=True):
        assert outcome.told[node][-1].floor == floor
        assert np.abs(_error_m(outcome, node)).max() < 1.0
        sure = {v.floor for v in outcome.told[node] if (v.floor_probability or 0.0) > 0.9}
        assert sure <= {0, floor, None}


def test_a_door_is_no_lift() -> None:
    shuts, opens = Part(1, pressure_m=0.8), Part(1, pressure_m=-0.8)
    outcome = follow({1: [stand(30), shuts, stand(30), opens, stand(20)], 2: BESIDE})
    assert set(_episodes(outcome.told[1])) == {Episode.DISTURBED}
    assert abs(_error_m(outcome)[-1]) < 0.3


def test_a_fall_down_stairs_is_followed_and_told_within_three_seconds() -> None:
    before = [walk(30), stairs(3.5), walk(20), stairs(-1.75)]
    outcome = follow({1: [*before, FALL, stand(40)], 2: BESIDE})
    falls_s = sum(part.seconds for part in before)
    told = outcome.told[1][falls_s : falls_s + 4]
    assert Episode.FALLING in {v.episode for v in told}
    assert np.abs(_error_m(outcome)[falls_s + 3 :]).max() < 0.5


def test_weather_is_no_climb() -> None:
    outcome = follow(
        {1: [walk(150), stairs(3.5), walk(300)], 2: [walk(450)], 3: [walk(450)]},
        weather_m_s=0.0023,
    )
    assert np.abs(_error_m(outcome)).max() < 0.5
    assert _episodes(outcome.told[1]) == [Episode.UP]
    assert outcome.told[1][-1].floor == 1


def test_a_group_that_climbs_together_climbs() -> None:
    lives = {n: [walk(30 + 2 * n), stairs(3.5), walk(60 - 2 * n)] for n in range(1, 6)}
    outcome = follow(lives)
    for node in range(1, 6):
        assert _episodes(outcome.told[node]) == [Episode.UP]
        assert outcome.told[node][-1].floor == 1


def test_a_stop_half_way_up_is_between_floors() -> None:
    outcome = follow({1: [walk(30), stairs(1.75), stand(15)], 2: BESIDE})
    at_the_landing = outcome.told[1][sum(p.seconds for p in (walk(30), stairs(1.75))) + 10]
    assert at_the_landing.floor is None


def test_somebody_who_crawls_stays_on_the_floor() -> None:
    crawl = [walk(30), Part(4, 0.5, 0.2, -0.22), Part(40, 0.5, 0.3), Part(3, rise_m=0.3), walk(30)]
    outcome = follow({1: crawl, 2: BESIDE})
    told = outcome.told[1]
    assert {v.floor for v in told} <= {0, None}
    assert sum(v.floor is None for v in told) < 8


def test_who_joins_late_is_anywhere() -> None:
    outcome = follow({1: [walk(200)], 2: [walk(200)]}, begins_s={2: 100.0})
    assert outcome.told[2][-1].sigma_z_m > 3.0
    assert outcome.told[2][-1].floor_probability < 0.5
    assert outcome.told[1][-1].sigma_z_m < 0.5


def _goes_on(vertical: VerticalFilter, node: int, second: int) -> None:
    """A second on the level, whichever it is."""
    time_s = float(second)
    vertical.move(Advance(time_s, node, 1.0, 1.3, 0.0, 0.0, steps=1.8))
    vertical.measure(Height(time_s, node, 0.02 * (second % 3)), time_s)


def test_a_team_that_comes_long_after_its_post_starts_on_the_floor_of_the_start() -> None:
    vertical = VerticalFilter(posts=frozenset({7}))
    for second in range(400):
        time_s = float(second)
        vertical.measure(Height(time_s, 7, 0.0), time_s)
        for node in (1, 2):
            if second >= 300:
                _goes_on(vertical, node, second)
        vertical.close(time_s)
    for node in (1, 2, 7):
        told = vertical.of(node, 399.0)
        assert told.floor == 0
        assert (told.floor_probability or 0.0) > 0.9
        assert told.sigma_z_m < 0.5


def test_a_team_without_barometers_is_on_one_level_whatever_its_post_has() -> None:
    vertical = VerticalFilter(posts=frozenset({7}))
    for second in range(400):
        vertical.measure(Height(float(second), 7, 0.0), float(second))
        vertical.move(Advance(float(second), 1, 1.0, 1.3, 0.0, 0.0, steps=1.8))
        vertical.close(float(second))
    assert vertical.of(1, 399.0).sigma_z_m < 0.2


def test_a_short_range_tells_the_floor_of_who_joined_late() -> None:
    outcome = follow({1: [walk(30), stairs(3.5), walk(100)], 2: [walk(200)]}, begins_s={2: 100.0})
    vertical = outcome.filter
    vertical.ranged(Range(200.0, 1, 2, 1.2))
    assert vertical.of(2, 200.0).sigma_z_m < 1.0
    assert abs(vertical.of(2, 200.0).z_m - vertical.of(1, 200.0).z_m) < 0.5
    assert vertical.of(1, 200.0).sigma_z_m < 0.5


def test_who_joined_late_stays_where_a_short_range_found_them_whatever_others_show() -> None:
    vertical, climbed_m = VerticalFilter(), np.clip((np.arange(320) - 30) * 0.28, 0.0, 3.5)
    for second in range(1, 320):
        time_s, climbs = float(second), 0.0 < climbed_m[second] < 3.5
        vertical.move(Advance(time_s, 1, 1.0, 0.9, 0.0, 0.0, steps=1.6 if climbs else 1.8))
        height_m = round(float(climbed_m[second]), 2) + 0.02 * (second % 3)
        vertical.measure(Height(time_s, 1, height_m), time_s)
        for node in (2, 3, 4, *((5,) if second > 100 else ())):
            _goes_on(vertical, node, second)
        if second == 200:
            vertical.ranged(Range(time_s, 1, 5, 1.2))
        vertical.close(time_s)
    met, late = vertical.of(1, 319.0), vertical.of(5, 319.0)
    assert (met.floor, late.floor) == (1, 1)
    assert abs(late.z_m - met.z_m) < 3.0 * late.sigma_z_m < 2.0


def test_who_was_off_for_a_minute_may_have_climbed() -> None:
    """Its height goes on from the last one; its first report knows next to nothing of its way."""
    vertical = VerticalFilter()
    for second in range(1, 220):
        if second == 121:
            off = Advance(121.0, 4, 61.0, 0.0, 0.0, 0.0, 1.0, 90.0, 90.0, 4.0, 90.0, 0.0)
            vertical.move(off)
        for node in (1, 2, 3, 4):
            if node < 4 or not 60 < second < 121:
                _goes_on(vertical, node, second)
        vertical.close(float(second))
    back, other = vertical.of(4, 219.0), vertical.of(1, 219.0)
    assert other.floor == 0
    assert other.sigma_z_m < 0.3
    assert back.sigma_z_m > 1.0
    assert (back.floor_probability or 0.0) < 0.9


def test_the_variance_and_the_floor_say_that_a_sensor_died() -> None:
    outcome = follow({1: [stand(300)], 2: [stand(300)]}, silent={2: (40.0, 500.0)})
    before, soon, later = (outcome.told[2][k] for k in (38, 100, 299))
    assert before.sigma_z_m < 0.3
    assert soon.sigma_z_m > 1.0
    sure = [v.floor_probability or 0.0 for v in (before, soon, later)]
    assert sure[0] > 0.95 > sure[1] > sure[2]
    assert sure[2] < 0.5


def test_a_height_that_never_changes_while_its_wearer_walks_is_no_height() -> None:
    lives = {1: [walk(60), stairs(3.5), walk(200)], 2: [walk(60), stairs(3.5), walk(200)]}
    stuck = follow(lives, stuck_s={2: 50.0}).told[2]
    dead = follow(lives, silent={2: (50.0, 1e9)}).told[2]
    assert stuck[45].sigma_z_m < 0.3
    for at_s in (70, 100, 250):
        assert stuck[at_s].sigma_z_m > 0.9 * dead[at_s].sigma_z_m
        assert (stuck[at_s].floor_probability or 0.0) < (dead[at_s].floor_probability or 0.0) + 0.02
    assert stuck[250].sigma_z_m > 2.0
    # Who stands still may well have one height.
    stands = follow({1: [walk(300)], 2: [walk(60), stand(240)]}, stuck_s={2: 60.0}).told[2]
    assert stands[-1].sigma_z_m < 0.5


@pytest.mark.filterwarnings("error")
def test_nobody_reporting_for_a_while_is_no_error() -> None:
    gap = (20.0, 40.0)
    outcome = follow({1: [walk(60)], 2: [walk(60)]}, silent={1: gap, 2: gap})
    assert abs(_error_m(outcome)[-1]) < 0.5


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("minutes", [2, 15])
def test_a_team_that_nobody_heard_for_minutes_is_somewhere_and_doubts_it(minutes: int) -> None:
    back_s = 60 * minutes + 50
    climbs = [walk(60), stairs(7.0), walk(back_s)]
    outcome = follow({1: climbs, 2: [walk(back_s)], 3: [walk(back_s)]}, away_s=(50.0, back_s))
    for node in (1, 2, 3):
        error_m = np.abs(_error_m(outcome, node)[back_s:])
        sigma_m = np.array([v.sigma_z_m for v in outcome.told[node][back_s:]])
        assert np.isfinite(error_m).all()
        # Until it is decided what happened, nobody is sure to be where they were.
        assert sigma_m[:3].min() > 1.0
        assert error_m[10:40].max() < 1.2
    soon = [v.floor_probability or 0.0 for v in outcome.told[1][back_s : back_s + 4]]
    assert max(soon) < 0.9
    assert outcome.told[1][back_s + 20].floor == 2
    assert {v.episode for v in outcome.told[2][back_s:]} == {Episode.LEVEL}


def test_who_shows_no_height_takes_no_memory() -> None:
    vertical = VerticalFilter(posts=frozenset({7}))
    sizes = []
    for tenth in range(1, 2001):
        time_s = 0.1 * tenth
        for node in (1, 2, 7):
            vertical.move(Advance(time_s, node, 0.1, 0.13, 0.0, 0.0, steps=0.18))
        if tenth < 20:
            vertical.measure(Height(time_s, 1, 0.01 * tenth), time_s)
        vertical.close(time_s)
        sizes.append(len(pickle.dumps(vertical)))
    assert sizes[-1] < 1.5 * sizes[200]


def test_what_was_climbed_without_pressure_is_known_once_it_is_back() -> None:
    outcome = follow({1: BESIDE, 2: [walk(30), stairs(3.5), walk(60)]}, silent={2: (25.0, 60.0)})
    assert abs(_error_m(outcome, 2)[-1]) < 0.7
    assert outcome.told[2][-1].floor == 1


def test_before_any_height_there_is_nothing() -> None:
    outcome = follow({1: BESIDE, 2: BESIDE}, begins_s={1: 1e9, 2: 1e9})
    assert outcome.told[1][-1] == Vertical()
    assert not outcome.filter.active


@pytest.mark.parametrize("seed", range(2))
def test_a_fan_that_starts_on_the_stairs_claims_no_wrong_floor(seed: int) -> None:
    hidden = stairs(3.5)._replace(pressure_m=-0.17)
    life = [walk(30), hidden, walk(100)]
    fan = Part(hidden.seconds, pressure_m=-0.17)
    other = [stand(30), fan, stand(100)]
    outcome = follow({1: life, 2: other, 3: other}, seed=seed)
    assert np.abs(_error_m(outcome))[60:].max() < 1.0
    assert not any(
        v.floor != 1 and (v.floor_probability or 0.0) > 0.9 for v in outcome.told[1][60:]
    )


def test_who_came_to_a_floor_unseen_is_found_there() -> None:
    outcome = follow({1: [walk(30), Part(1, rise_m=3.5), walk(100)], 2: [walk(131)]})
    assert outcome.told[1][-1].floor == 1
    assert abs(_error_m(outcome)[-1]) < 0.7


def test_a_climb_is_over_the_floor_where_it_began_and_teaches_one_storey() -> None:
    up, down = stairs(3.0), stairs(-3.0)
    life = [walk(20), up, walk(30), up, walk(30), down, walk(30), down, walk(30)]
    outcome = follow({1: life, 2: BESIDE})
    floors = outcome.filter.floors
    assert abs(floors.height_of(2, 0.0)[0] - 6.0) < 0.5
    assert abs(_error_m(outcome)[-1]) < 0.3
    assert outcome.told[1][-1].floor == 0


def test_climbs_that_agree_make_heights_surer_than_climbs_that_do_not() -> None:
    there_and_back = [stairs(3.5), walk(20), stairs(-3.5), walk(20)]
    life = [walk(20), *there_and_back * 8, stairs(3.5), walk(20)]
    sigma_m = {}
    for bias_m in (0.1, 0.6):
        outcome = follow({1: life, 2: BESIDE}, bias_m=bias_m)
        sigma_m[bias_m] = outcome.told[1][-1].sigma_z_m
        assert abs(_error_m(outcome)[-1]) < 2.0 * sigma_m[bias_m]
    assert sigma_m[0.1] < 0.65 * sigma_m[0.6]


def test_who_climbs_is_told_as_high_as_he_is_by_now() -> None:
    errors_m = []
    for seed in range(4):
        outcome = follow({1: [walk(30), lift(21.0), walk(30)], 2: BESIDE}, seed=seed)
        errors_m.append(_error_m(outcome)[36:50].mean())
    assert abs(np.mean(errors_m)) < 0.2, "a height is that of 0.4 s before"
