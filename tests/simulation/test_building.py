"""The emulated building: people climb, ride, crawl and fall, and barometers feel the air."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from relpos.errors import DataError, RelposError
from relpos.measurements import Height, Motion, Range
from relpos.runs import load_run, save_run
from relpos.simulation import building
from relpos.simulation.paper import SimulatedRun
from relpos.simulation.scenarios import simulate, simulate_run

QUIET = {
    "noise_m": 0, "bias_m": 0, "drift_m": 0, "weather_pa_h": 0, "warm_k": 0, "way_noise_m": 0,
    "heading_noise_deg": 0, "turn_noise": 0, "sigma_range_m": 0,
}  # fmt: skip


@cache
def made(condition: str, seconds: float = 300.0, **settings: float) -> SimulatedRun:
    return simulate(f"building-{condition}", 2, {"seconds": seconds, **QUIET, **settings})


def true_m(run: SimulatedRun, node: int, time_s: np.ndarray, *names: str) -> np.ndarray:
    rows = [t for t in run.truth if t.node == node]
    times = [t.time_s for t in rows]
    columns = [np.interp(time_s, times, [getattr(t, k) for t in rows]) for k in names]
    return np.stack(columns, axis=-1)


def heights(run: SimulatedRun, node: int) -> tuple[np.ndarray, np.ndarray]:
    rows = [m for m in run.measurements if isinstance(m, Height) and m.node == node]
    return np.array([m.time_s for m in rows]), np.array([m.height_m for m in rows])


def off_m(run: SimulatedRun, node: int) -> tuple[np.ndarray, np.ndarray]:
    """Reported minus true height."""
    time_s, height_m = heights(run, node)
    return time_s, height_m - true_m(run, node, time_s, "z_m")[:, 0]


def during(run: SimulatedRun, node: int, *words: str) -> list[tuple[float, float]]:
    """When a node's true episode is one of these words."""
    own = [e for e in run.events if e.node == node]
    ends = [e.time_s for e in own[1:]] + [run.truth[-1].time_s]
    return [(e.time_s, end) for e, end in zip(own, ends, strict=True) if e.value in words]


def test_the_same_seed_is_the_same_run_and_another_seed_another() -> None:
    short = {"seconds": 60}
    assert simulate("building", 3, short).truth == simulate("building-calm", 3, short).truth
    assert simulate("building", 3, short) == simulate("building", 3, short)
    assert simulate("building", 3, short) != simulate("building", 4, short)


@pytest.mark.parametrize("condition", building.CONDITIONS)
def test_every_condition_is_simulated(condition: str) -> None:
    run = simulate(f"building-{condition}", 1, {"seconds": 60, "late_s": 0})
    assert {type(m) for m in run.measurements} == {Motion, Range, Height}
    assert 0.0 in run.floors_m


def test_heights_without_noise_follow_everybody_through_the_building() -> None:
    run = made("calm", seconds=600.0)
    climbed_m = 0.0
    for node in range(1, 7):
        time_s, wrong_m = off_m(run, node)
        assert np.abs(wrong_m).max() < 0.45, "0.4 s late at half a metre a second"
        climbed_m = max(climbed_m, true_m(run, node, time_s, "z_m").max())
    assert climbed_m == pytest.approx(10.5)


def test_dead_reckoning_claims_twice_the_way_on_stairs_and_the_true_one_on_the_level() -> None:
    run = made("calm", seconds=600.0)
    for words, low, high in ((("up",), 1.8, 2.4), (("down",), 1.6, 2.2), (("level",), 0.95, 1.05)):
        claimed_m = way_m = 0.0
        for node in range(1, 7):
            chords = [m for m in run.measurements if isinstance(m, Motion) and m.node == node]
            for begin_s, end_s in during(run, node, *words):
                for before, m in pairwise(chords):
                    if begin_s < before.time_s and m.time_s < end_s:
                        ends = true_m(run, node, np.array([before.time_s, m.time_s]), "x_m", "y_m")
                        claimed_m += math.hypot(m.dx_m, m.dy_m)
                        way_m += float(np.hypot(*(ends[1] - ends[0])))
        assert way_m > 20.0
        assert low < claimed_m / way_m < high, words


@pytest.mark.parametrize("stairs", range(3))
def test_nobody_moves_faster_than_people_walk(stairs: int) -> None:
    truth = made("calm", 600.0, stairs=stairs).truth
    for node in {row.node for row in truth}:
        at = np.array([(row.x_m, row.y_m) for row in truth if row.node == node])
        assert np.hypot(*np.diff(at, axis=0).T).max() < 1.15


def test_a_step_on_stairs_rises_by_a_riser_or_by_two() -> None:
    run = made("stairs", two_share=0.5)
    risers_m = []
    for node in range(1, 7):
        reports = [m for m in run.measurements if isinstance(m, Motion) and m.node == node]
        for begin_s, end_s in during(run, node, "up"):
            inside = [m for m in reports if begin_s + 1.0 < m.time_s < end_s]
            steps = sum(m.steps for m in inside[1:])
            if steps >= 5:
                z = true_m(run, node, np.array([inside[0].time_s, inside[-1].time_s]), "z_m")
                risers_m.append(float(z[1, 0] - z[0, 0]) / steps)
    assert 0.12 < min(risers_m) < 0.22
    assert 0.24 < max(risers_m) < 0.44


def test_nobody_takes_a_step_in_a_lift_that_rises_at_a_metre_a_second() -> None:
    run = made("lift")
    rides = [(node, *ride) for node in range(1, 7) for ride in during(run, node, "lift")]
    assert rides
    for node, begin_s, end_s in rides:
        inside = [
            m for m in run.measurements
            if isinstance(m, Motion) and m.node == node and begin_s + 1.0 < m.time_s < end_s
        ]  # fmt: skip
        assert sum(m.steps for m in inside) == 0
        z = true_m(run, node, np.array([begin_s + 2.0, begin_s + 2.2]), "z_m")[:, 0]
        assert abs(z[1] - z[0]) == pytest.approx(0.2, abs=0.05)


def test_a_fan_is_felt_in_one_stairwell_or_in_the_whole_building_and_no_longer_than_it_blows() -> (
    None
):
    times = {"fan_s": 100.0, "fan_off_s": 200.0}
    for condition, all_feel in (("fan", False), ("fan-whole", True)):
        run = made(condition, **times)
        for node in range(1, 7):
            time_s, wrong_m = off_m(run, node)
            blows = (time_s > 112.0) & (time_s < 198.0)
            assert np.abs(wrong_m[(time_s < 99.0) | (time_s > 212.0)]).max() < 0.45
            assert (np.max(wrong_m[blows]) < -1.2) == all_feel
        low_m = min(off_m(run, node)[1].min() for node in range(1, 7))
        assert low_m == pytest.approx(-25.0 / 12.0, abs=0.6)


def test_weather_is_common_to_all_and_to_a_post_that_lies_still() -> None:
    run = made("weather-post", seconds=600.0, weather_pa_h=100.0)
    ends = [off_m(run, node)[1][-1] for node in range(1, 8)]
    assert 1.0 < abs(np.mean(ends)) < 2.0
    assert np.ptp(ends) < 0.5
    assert not np.ptp(true_m(run, 7, np.arange(600.0), "x_m", "y_m", "z_m"), axis=0).any()


def test_one_who_joins_late_counts_from_another_floor_and_has_no_start() -> None:
    run = made("late", late_s=100.0)
    assert {p.node for p in run.priors} == set(range(1, 6))
    assert min(m.time_s for m in run.measurements if 6 in (m.node, getattr(m, "peer", 0))) >= 100.0
    time_s, height_m = heights(run, 6)
    assert abs(height_m[0]) < 0.05
    assert true_m(run, 6, time_s[:1], "z_m")[0, 0] == pytest.approx(7.0)


def test_one_who_falls_loses_height_in_two_seconds_without_a_step_and_lies() -> None:
    run = made("fall", fall_s=60.0)
    ((begin_s, end_s),) = during(run, 2, "falling")
    z = true_m(run, 2, math.ceil(begin_s) + np.array([0.0, 1.0, 3.0, 20.0]), "z_m")[:, 0]
    assert end_s - begin_s == pytest.approx(2.0)
    assert z[0] - z[1] == pytest.approx(1.7 / 2.0, abs=0.01)
    assert z[2] == z[3]
    after = [m for m in run.measurements if isinstance(m, Motion) and m.time_s > begin_s + 1.0]
    assert sum(m.steps for m in after if m.node == 2) == 0


@pytest.mark.parametrize("fall_s", [20.0, 80.0, 140.0, 200.0, 240.0, 260.0])
def test_whoever_is_to_fall_falls_also_after_the_last_change_of_floors(fall_s: float) -> None:
    ((begin_s, _),) = during(made("fall", fall_s=fall_s), 2, "falling")
    assert fall_s < begin_s < fall_s + 90.0


@pytest.mark.parametrize(
    ("seed", "changes"),
    [
        (3, {"lift_share": 1, "late_s": 60}),  # is on the floor that the first ride leads to
        (11, {"lift_share": 1, "fall_s": 50, "storeys": 2}),  # lies on the top floor
    ],
)
def test_no_lift_takes_who_is_there_already_or_lies(seed: int, changes: dict[str, float]) -> None:
    settings = {"seconds": 400, "nodes": 2, "crew": 1, **changes}
    run = building.simulate_building("building", seed, settings)
    assert {row.node for row in run.truth} == {1, 2}


@pytest.mark.parametrize("fault", ["lost_s", "reboot_s", "carried_s"])
def test_steps_go_with_the_way_that_they_make_up(fault: str) -> None:
    run = made("calm", seconds=120.0, **{fault: 20.0})
    own = [m for m in run.measurements if isinstance(m, Motion) and m.node == 2]
    (after, *_) = (m for m in own if m.time_s >= 80.0)
    assert after.steps <= 4, "nobody makes twenty seconds' steps in one"
    assert all(m.steps == 0 for m in own if 60.0 <= m.time_s < 80.0)


def test_two_teams_stay_one_above_the_other() -> None:
    run = made("teams")
    last = {t.node: t.z_m for t in run.truth}
    assert [last[node] for node in range(1, 7)] == pytest.approx([3.5] * 3 + [7.0] * 3)


def test_a_slab_lets_near_people_hear_each_other_late_and_two_slabs_nobody() -> None:
    run = made("teams", seconds=600.0)
    excess_m = []
    for m in run.measurements:
        if isinstance(m, Range) and m.time_s > 200.0 and (m.node <= 3) != (m.peer <= 3):
            ends = [true_m(run, n, np.array([m.time_s]), "x_m", "y_m", "z_m")[0]
                    for n in (m.node, m.peer)]  # fmt: skip
            excess_m.append(m.range_m - float(np.linalg.norm(ends[1] - ends[0])))
            assert m.range_m < 15.0
    assert 0.2 < np.median(excess_m) < 0.45
    deaf = made("teams", seconds=600.0, slab_db=40.0)
    heard = [m for m in deaf.measurements if isinstance(m, Range) and m.time_s > 200.0]
    assert {m.node <= 3 for m in heard} == {True, False}
    assert not [m for m in heard if (m.node <= 3) != (m.peer <= 3)]


def test_a_barometer_dies_sticks_or_was_never_there() -> None:
    assert heights(made("dead", dead_s=100.0), 2)[0].max() <= 100.0
    time_s, height_m = heights(made("stuck", dead_s=100.0), 2)
    assert np.ptp(height_m[time_s > 101.0]) == 0.0
    assert {n for n in range(1, 7) if heights(made("without"), n)[0].size} == set(range(1, 6))


def test_hot_air_and_crawling_change_heights_but_no_floor() -> None:
    run = made("heat", seconds=600.0, door_pa=0.0, stack_pa=0.0)
    assert any(during(run, node, "crawl") for node in range(1, 7))
    wrong_m = np.concatenate([off_m(run, node)[1] for node in range(1, 7)])
    assert 0.3 < np.abs(wrong_m).max() < 1.0


def test_a_run_directory_keeps_floors_and_episodes(tmp_path) -> None:
    run = simulate_run("building-basement", 1, {"seconds": "60"})
    save_run(run, tmp_path / "run")
    again = load_run(tmp_path / "run")
    assert again.description.floors_m == (-3.5, 0.0, 3.5, 7.0)
    assert again.events == run.events
    assert [m.steps for m in again.motions] == [m.steps for m in run.motions]


@pytest.mark.parametrize("floors", ["3.5", "[3.5]", "[0.0, -1.0]", '["low", 0.0]'])
def test_floors_that_are_none_are_refused_in_one_line(tmp_path, floors: str) -> None:
    (tmp_path / "run.toml").write_text(f"[building]\nfloors_m = {floors}\n")
    with pytest.raises(DataError, match=r"run.toml: key building.(floors|z)_m"):
        load_run(tmp_path)


def test_a_wrong_setting_is_named() -> None:
    with pytest.raises(RelposError, match="no setting 'abreast'"):
        simulate("building", 1, {"abreast": 1})
    with pytest.raises(RelposError, match="no storey left"):
        simulate("building", 1, {"basements": 4})
    with pytest.raises(RelposError, match="unknown scenario"):
        simulate("building-moon", 1)
