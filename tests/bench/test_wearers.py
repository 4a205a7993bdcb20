"""Wearers doing anything: one consistent motion, labels that add up, ranges that are wide."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest

from relpos.errors import DataError
from relpos.simulation.team import make_team
from relpos.simulation.world import GRAVITY_M_S2
from support.strapdown import strapdown
from wearers.activities import ACTIVITIES, SCRIPTS, Activity, make_itinerary
from wearers.indoor import INDOOR
from wearers.motion import WearerTruth
from wearers.solo import make_walker
from wearers.wearer import PLACES, Wearer, make_wearer

STAND = Activity("stand", seconds=4.0)


@pytest.fixture(scope="module")
def mixed() -> list[WearerTruth]:
    return [make_walker("mixed", seed)[0] for seed in range(3)]


def only(kind: str, seed: int, **given: float) -> WearerTruth:
    return make_walker([STAND, Activity(kind, **given), STAND], seed)[0]  # type: ignore[arg-type]


@pytest.mark.soak
def test_integrating_the_sensors_returns_the_path_of_every_activity(
    mixed: list[WearerTruth],
) -> None:
    errors = []
    for walker in mixed[:2]:
        # Ten seconds of every twenty: crawls, falls, stairs and a sensor that turns are in them.
        for begin in range(200, len(walker.time_s) - 2001, 4000):
            end = begin + 2000
            path, attitude = strapdown(walker, begin, end)
            error = np.linalg.norm(path - walker.position_m[begin : end + 1 : 2], axis=1)
            errors.append(float(error.max()))
            assert np.abs(attitude - walker.attitude[end]).max() < 1e-3
    # Loose straps swing at up to 45 Hz: what is left is the integration's own error at 200 Hz.
    assert max(errors) < 0.006
    assert np.median(errors) < 0.0005


def test_every_label_occurs_and_the_labels_fill_the_time(mixed: list[WearerTruth]) -> None:
    for walker in mixed:
        assert {kind for _, _, kind in walker.intervals} == set(ACTIVITIES)
        ends = [end for _, end, _ in walker.intervals]
        begins = [begin for begin, _, _ in walker.intervals]
        np.testing.assert_allclose(begins[1:], ends[:-1])
        assert begins[0] == 0.0
        assert walker.time_s[-1] == pytest.approx(ends[-1] + 2.0, abs=0.03)
        for begin, end, kind in walker.intervals:
            inside = (walker.time_s > begin + 0.01) & (walker.time_s < end - 0.01)
            assert np.all(walker.activity[inside] == ACTIVITIES.index(kind))


def test_moved_distance_is_that_of_the_script(mixed: list[WearerTruth]) -> None:
    for walker in mixed:
        falls = [k for _, _, k in walker.intervals].count("fall")
        # Steps leave out what a fall slides, and count the rest up to the last mid-stance.
        rest = walker.distance_m - walker.steps.length_m.sum()
        assert 0.0 < rest < 0.8 * falls + 1.0
        assert np.all(np.diff(walker.path_m) > -1e-3)
    for kind in ("walk", "carry", "shuffle", "backward", "crawl"):
        walker = only(kind, 4, distance_m=6.0)
        assert walker.distance_m == pytest.approx(6.0, rel=0.15)
    assert only("side", 4, distance_m=-3.0).distance_m == pytest.approx(3.0, rel=0.05)


def test_the_moved_distance_is_the_length_of_the_bodys_path() -> None:
    walker = only("walk", 8, distance_m=20.0)
    # At 1 Hz the step's own motion hardly counts; sensor on the body's middle within 0.3 m.
    chords = np.linalg.norm(np.diff(walker.position_m[::200, :2], axis=0), axis=1).sum()
    assert walker.distance_m == pytest.approx(chords, rel=0.03)


@pytest.mark.parametrize(
    ("kind", "distance_m", "angle_deg"),
    [("walk", 5.0, 0.0), ("backward", 5.0, 180.0), ("side", 4.0, 90.0), ("side", -4.0, -90.0)],
)
def test_the_body_goes_where_the_label_says(kind: str, distance_m: float, angle_deg: float) -> None:
    walker = only(kind, 12, distance_m=distance_m)
    gone = walker.position_m[-1, :2] - walker.position_m[0, :2]
    away = math.atan2(gone[1], gone[0]) - walker.facing_rad[0] - math.radians(angle_deg)
    assert abs(math.remainder(away, 2 * math.pi)) < math.radians(12)
    direction = walker.steps.direction_rad
    np.testing.assert_allclose(np.degrees(direction), angle_deg, atol=1.0)


def test_turning_on_the_spot_turns_and_hardly_moves() -> None:
    for seed in range(5):
        walker = only("turn", seed, turn_rad=3.0)
        assert walker.facing_rad[-1] - walker.facing_rad[0] == pytest.approx(3.0, abs=0.02)
        assert walker.distance_m < 0.8
        assert len(walker.steps.time_s) >= 2


def test_stairs_change_the_height_by_a_riser_a_step() -> None:
    for kind, sign in (("stairs_up", 1.0), ("stairs_down", -1.0)):
        walker = only(kind, 5, count=12)
        climbed = sign * (walker.position_m[-1, 2] - walker.position_m[0, 2])
        assert 12 * 0.14 < climbed < 12 * 0.21
        assert len(walker.steps.time_s) == 12
        assert walker.pressure_pa[0] - walker.pressure_pa[-1] == pytest.approx(
            sign * climbed * 12.0, rel=0.02
        )


def up_in_body(walker: WearerTruth, begin_s: float, end_s: float) -> np.ndarray:
    """Mean direction of the world's up in the body's axes."""
    part = (walker.time_s > begin_s) & (walker.time_s < end_s)
    body = walker.attitude[part] @ walker.wearer.axes_matrix.T
    mean = body[:, 2, :].mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def test_crawling_lays_gravity_along_the_trunks_back() -> None:
    walker = only("crawl", 3, distance_m=4.0)
    begin, end = next((a, b) for a, b, k in walker.intervals if k == "crawl")
    # Body axes forward, left, up: prone, the world's up is the body's back.
    assert up_in_body(walker, begin + 5.0, end - 5.0)[0] < -0.8
    assert up_in_body(walker, 0.5, 3.0)[2] > 0.95
    level = (walker.time_s > begin + 5.0) & (walker.time_s < end - 5.0)
    assert walker.position_m[level, 2].max() < 0.85


def test_a_fall_hits_hard_ends_low_and_gets_up() -> None:
    peaks, lows = [], []
    for seed in range(12):
        walker = only("fall", seed, seconds=3.0)
        peaks.append(np.linalg.norm(walker.specific_force_m_s2, axis=1).max() / GRAVITY_M_S2)
        lows.append(walker.position_m[:, 2].min())
        assert walker.position_m[-1, 2] == pytest.approx(walker.position_m[0, 2], abs=0.03)
        assert up_in_body(walker, walker.time_s[-1] - 2.0, walker.time_s[-1])[2] > 0.95
        assert len(walker.steps.time_s) == 0
    assert min(lows) > 0.0
    assert max(lows) < 0.6
    assert 2.0 < min(peaks) < 5.0 < max(peaks) < 15.0


def test_a_sensor_turned_on_the_body_keeps_the_body_where_it_is() -> None:
    for seed in range(4):
        walker = only("remount", seed)
        before = walker.attitude[200] @ walker.wearer.axes_matrix.T
        after = walker.attitude[-200] @ walker.wearer.axes_matrix.T
        turned = math.degrees(math.acos(np.clip((np.trace(before.T @ after) - 1) / 2, -1, 1)))
        assert 12.0 < turned <= 180.0
        assert walker.distance_m == 0.0


def test_people_cover_the_ranges_that_are_promised() -> None:
    people = [make_wearer(np.random.default_rng(k)) for k in range(300)]

    def spread(name: str) -> tuple[float, float]:
        values = [float(getattr(p, name)) for p in people]
        return min(values), max(values)

    low, high = spread("speed_m_s")
    assert low < 0.35
    assert high > 1.75
    assert spread("stature_m")[1] - spread("stature_m")[0] > 0.4
    assert spread("excursion_m")[1] / spread("excursion_m")[0] > 1.5
    low, high = spread("excursion_by_length")
    assert low < 0.6
    assert high > 1.9
    assert spread("walk_ratio_m_s")[1] / spread("walk_ratio_m_s")[0] > 1.6
    assert {p.place for p in people} == set(PLACES)
    assert 0.05 < np.mean([p.limp > 0 for p in people]) < 0.2
    assert 0.2 < np.mean([p.tissue_hz == 0 for p in people]) < 0.4
    # The sensor's x axis points anywhere in the body, up most often.
    x = np.array([p.axes_matrix[:, 0] for p in people])
    assert x.min() < -0.95
    assert x.max() > 0.95
    for p in people:
        np.testing.assert_allclose(p.axes_matrix @ p.axes_matrix.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(p.axes_matrix) == pytest.approx(1.0)


def test_slow_people_vary_more_from_step_to_step() -> None:
    def spread(speed: float) -> float:
        out = []
        for seed in range(6):
            wearer = make_wearer(np.random.default_rng(seed), speed_m_s=speed, limping=False)
            script = [STAND, Activity("walk", 40.0)]
            plan = make_itinerary(np.random.default_rng(seed), wearer, script)
            duration = np.diff(plan.knot_time_s)[4:-3:2]
            out.append(float(np.std(duration) / np.mean(duration)))
        return float(np.mean(out))

    assert spread(0.4) > 2.0 * spread(1.4)


def test_a_limp_shows_from_one_side_to_the_other() -> None:
    def unevenness(limping: bool) -> float:
        wearer = make_wearer(np.random.default_rng(3), speed_m_s=0.9, limping=limping)
        plan = make_itinerary(np.random.default_rng(3), wearer, [STAND, Activity("walk", 30.0)])
        step = np.diff(plan.knot_time_s)[4:-3]
        return abs(float(np.mean(step[::2]) / np.mean(step[1::2])) - 1.0)

    assert unevenness(True) > 0.12
    assert unevenness(False) < 0.1


def test_the_papers_walk_is_310_metres_in_380_seconds_closed_or_open() -> None:
    away = []
    for name in ("paper310", "paper310_open"):
        for seed in range(3):
            walker, _ = make_walker(name, seed)
            assert walker.time_s[-1] == pytest.approx(380.0)
            assert walker.distance_m == pytest.approx(310.0, abs=3.0)
            inside = walker.position_m[:, :2] - walker.position_m[0, :2]
            away.append(np.abs(inside).max())
            still = walker.path_m[-1] - walker.path_m[-200]
            assert still < 0.01
    # Laps stay in a hall of 25 m x 15 m; the others leave it.
    assert max(away[:3]) < 30.0
    assert max(away[3:]) > 40.0


def test_switched_on_while_walking_the_walk_goes_on() -> None:
    for seed in range(4):
        late, _ = make_walker("straight", seed, begin_walking=True)
        whole, _ = make_walker("straight", seed)
        shift = whole.time_s[-1] - late.time_s[-1]
        assert shift > whole.walk_start_s
        assert late.time_s[0] == 0.0
        first = round(shift * 200)
        np.testing.assert_array_equal(late.specific_force_m_s2, whole.specific_force_m_s2[first:])
        assert late.path_m[0] == 0.0
        assert late.distance_m == pytest.approx(whole.path_m[-1] - whole.path_m[first])
        assert late.steps.length_m.sum() <= late.distance_m
        assert late.distance_m - late.steps.length_m.sum() < 0.8
        assert late.walk_start_s == 0.0


def test_a_field_carried_on_the_body_is_fixed_to_the_body() -> None:
    wearer = make_wearer(np.random.default_rng(1), rigid=True, place="chest")
    script = [STAND, Activity("turn", turn_rad=3.0), STAND]
    bare, _ = make_walker(script, 2, wearer=wearer)
    with_it, _ = make_walker(script, 2, wearer=wearer, carried_ut=(10.0, 5.0, 0.0))
    added = (with_it.magnetic_field_ut - bare.magnetic_field_ut) @ wearer.axes_matrix.T
    np.testing.assert_allclose(added.mean(axis=0), [10.0, 5.0, 0.0], atol=0.3)
    assert added.std(axis=0).max() < 0.5


def test_a_buildings_field_has_neither_curl_nor_sources() -> None:
    field = replace(INDOOR.magnetic, seed=5)
    rng = np.random.default_rng(2)
    place = np.column_stack([rng.uniform(-20, 20, (200, 2)), rng.uniform(0.8, 1.8, 200)])
    h = 1e-4
    gradient = np.empty((200, 3, 3))  # of component i along axis j
    for j in range(3):
        step = h * np.eye(3)[j]
        gradient[:, :, j] = (field.field_ut(place + step) - field.field_ut(place - step)) / (2 * h)
    size = np.abs(gradient).max(axis=(1, 2))
    # Within 0.7 m of a column's or an item's middle the field is held: no path leads there.
    outside = np.abs(np.trace(gradient, axis1=1, axis2=2)) < 1e-3 * size
    assert outside.mean() > 0.85
    curl = np.abs(gradient - gradient.transpose(0, 2, 1)).max(axis=(1, 2))
    assert np.all(curl[outside] < 1e-3 * size[outside] + 1e-6)
    assert 1.0 < np.median(size) < 30.0  # microtesla a metre


def test_buildings_differ_and_a_seed_repeats_them() -> None:
    place = np.array([[0.0, 0.0, 1.2], [3.0, 1.0, 1.2], [30.0, -12.0, 1.2]])
    one, two = (replace(INDOOR.magnetic, seed=k).field_ut(place) for k in (1, 2))
    np.testing.assert_array_equal(one, replace(INDOOR.magnetic, seed=1).field_ut(place))
    assert np.abs(one - two).max() > 0.5
    # The same place, whatever else is asked for: the columns stand in the world.
    np.testing.assert_allclose(replace(INDOOR.magnetic, seed=1).field_ut(place[1:2])[0], one[1])


@pytest.mark.parametrize("name", sorted(set(SCRIPTS) - {"paper310", "paper310_open"}))
def test_every_script_is_made_and_repeats_with_its_seed(name: str) -> None:
    first, world = make_walker(name, 21)
    again, _ = make_walker(name, 21)
    np.testing.assert_array_equal(first.specific_force_m_s2, again.specific_force_m_s2)
    assert np.all(np.isfinite(first.specific_force_m_s2))
    assert np.linalg.norm(first.specific_force_m_s2, axis=1).max() < 20 * GRAVITY_M_S2
    assert isinstance(first.person, Wearer)
    assert world.magnetic.seed == 21


def test_an_unknown_script_or_activity_is_refused_by_name() -> None:
    with pytest.raises(DataError, match="unknown script 'swim'"):
        make_walker("swim", 1)
    with pytest.raises(DataError, match="unknown activity 'swim'"):
        Activity("swim")
    with pytest.raises(DataError, match="seed"):
        make_walker("straight", -1)
    with pytest.raises(DataError, match="at least one"):
        make_walker([], 1)


def test_a_walk_of_six_minutes_is_made_in_a_second() -> None:
    begin = time.process_time()
    make_walker("paper310", 1)
    assert time.process_time() - begin < 2.0  # 0.2 s alone on a machine


def test_teams_are_as_they_were() -> None:
    # Samples of the teams before there were wearers of any kind; the golden walks rest on them.
    for name, nodes, seconds, seed, force, place in (
        (
            "paper",
            3,
            60.0,
            5,
            (4.48847956011752, 9.230260249081626, 8.371748416897915),
            (15.48123143511891, 18.856084685785238, 29.606196479867574),
        ),
        (
            "lab",
            2,
            40.0,
            9,
            (8.367413959353247, 12.06627416358754),
            (31.395104628591696, 28.184735258129905),
        ),
    ):
        team, _ = make_team(name, nodes, seconds, seed)
        got = [float(w.specific_force_m_s2[5000].sum()) for w in team]
        assert got == pytest.approx(force, abs=1e-9)
        assert [float(w.position_m[-1].sum()) for w in team] == pytest.approx(place, abs=1e-9)
