"""The walkers' truth: one consistent motion, whose forces and rates belong to its path."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from relpos.errors import DataError
from relpos.simulation.gait import pendulum_rise_m
from relpos.simulation.spectral import Spectral
from relpos.simulation.team import MAX_WALKERS, make_team
from relpos.simulation.torso import vertical_shape
from relpos.simulation.walker import Route, WalkerTruth
from relpos.simulation.world import GRAVITY_M_S2
from support.strapdown import strapdown

SEED = 11


@pytest.fixture(scope="module")
def team() -> list[WalkerTruth]:
    return make_team("paper", 3, 120.0, SEED)[0]


def test_integrating_the_sensors_returns_the_path(team: list[WalkerTruth]) -> None:
    walker = team[0]
    begin = 200  # standing; the walk and its first corners follow
    end = begin + 60 * 200
    path, attitude = strapdown(walker, begin, end)
    error = np.linalg.norm(path - walker.position_m[begin : end + 1 : 2], axis=1)
    walked = np.linalg.norm(np.diff(walker.position_m[begin:end, :2], axis=0), axis=1).sum()
    assert walked > 25.0
    assert error.max() < 0.002  # 0.1 to 0.5 mm over six walkers
    assert np.abs(attitude - walker.attitude[end]).max() < 1e-5


def test_angular_rate_about_the_vertical_adds_up_to_the_heading(team: list[WalkerTruth]) -> None:
    for walker in team:
        vertical = np.einsum("nj,nj->n", walker.attitude[:, 2, :], walker.angular_rate_rad_s)
        turned = np.trapezoid(vertical, walker.time_s)
        assert turned == pytest.approx(walker.heading_rad[-1] - walker.heading_rad[0], abs=0.03)


def test_standing_people_feel_gravity_alone(team: list[WalkerTruth]) -> None:
    for walker in team:
        still = walker.time_s < walker.walk_start_s - 1.5
        force = np.linalg.norm(walker.specific_force_m_s2[still], axis=1)
        assert force.mean() == pytest.approx(GRAVITY_M_S2, abs=0.01)
        assert 0.001 < force.std() < 0.05  # sways, but hardly
        assert np.degrees(walker.angular_rate_rad_s[still]).std(axis=0).max() < 1.5
        assert np.abs(walker.position_m[still] - walker.position_m[0]).max() < 0.05


def test_sensor_axes_are_up_left_and_back_but_for_the_mounting(team: list[WalkerTruth]) -> None:
    for walker in team:
        force = walker.specific_force_m_s2[:400].mean(axis=0) / GRAVITY_M_S2
        assert math.degrees(math.acos(force[0])) < 25.0
        heading = walker.heading_rad[0]
        back = -np.array([math.cos(heading), math.sin(heading), 0.0])
        left = np.array([-math.sin(heading), math.cos(heading), 0.0])
        assert walker.attitude[0, :, 2] @ back > 0.9
        assert walker.attitude[0, :, 1] @ left > 0.9


def test_a_turn_to_the_left_is_positive_about_the_upward_axis(team: list[WalkerTruth]) -> None:
    walker = team[0]
    # Counter-clockwise round the rectangle: more than one corner in two minutes.
    assert walker.heading_rad[-1] > math.radians(80)
    mean = walker.angular_rate_rad_s.mean(axis=0)
    assert mean[0] > 0


def test_step_lengths_add_up_to_the_path_along_the_route(team: list[WalkerTruth]) -> None:
    walker = team[1]
    smooth = walker.position_m[::100, :2]  # at 2 Hz the step's own motion hardly counts
    until = walker.steps.time_s[-1]
    way = np.linalg.norm(np.diff(smooth, axis=0), axis=1)[walker.time_s[100::100] <= until].sum()
    assert walker.steps.length_m.sum() == pytest.approx(way, rel=0.03)
    assert np.all(np.diff(walker.steps.time_s) > 0.3)
    assert np.all(walker.steps.length_m > 0.1)


def test_mid_stance_is_the_top_of_the_vault(team: list[WalkerTruth]) -> None:
    walker = team[0]
    height = walker.position_m[:, 2]
    inner = walker.steps.time_s[5:-5]
    steady = np.diff(inner, prepend=inner[0] - 0.7) < 1.0
    at_top = np.interp(inner[steady], walker.time_s, height)
    between = np.interp(inner[steady] - 0.35, walker.time_s, height)
    assert np.mean(at_top > between) > 0.97


def test_people_differ_and_a_seed_repeats_them() -> None:
    first, _ = make_team("paper", 2, 20.0, 5)
    again, _ = make_team("paper", 3, 20.0, 5)
    other, _ = make_team("paper", 2, 20.0, 6)
    np.testing.assert_array_equal(first[1].specific_force_m_s2, again[1].specific_force_m_s2)
    assert not np.array_equal(first[0].specific_force_m_s2, other[0].specific_force_m_s2)
    assert first[0].person != first[1].person


def test_walkers_of_the_paper_follow_each_other_by_eight_metres() -> None:
    team, _ = make_team("paper", 4, 10.0, SEED)
    start = [w.walk_start_s for w in team]
    for before, after, walker in zip(start, start[1:], team, strict=False):
        assert (after - before) * walker.person.speed_m_s == pytest.approx(8.0)
        assert 0.5 <= walker.person.speed_m_s <= 1.1


def test_the_lab_walk_covers_its_distance_in_its_time() -> None:
    team, world = make_team("lab", 3, 380.0, SEED)
    assert world.size_m == (25.0, 15.0)
    for walker in team:
        assert 290.0 < walker.steps.length_m.sum() < 313.0


@pytest.mark.parametrize("nodes", [1, MAX_WALKERS])
@pytest.mark.parametrize("seconds", [0.004, 1.0, 7.003])
def test_any_team_size_and_duration_is_made(nodes: int, seconds: float) -> None:
    team, _ = make_team("lab", nodes, seconds, 0)
    assert [w.node for w in team] == list(range(1, nodes + 1))
    for walker in team:
        count = math.floor(seconds * 200 + 1e-9) + 1
        assert walker.position_m.shape == walker.magnetic_field_ut.shape == (count, 3)
        assert walker.time_s[0] == 0.0
        assert np.all(np.isfinite(walker.specific_force_m_s2))


@pytest.mark.parametrize(
    ("scenario", "nodes", "seconds", "seed"),
    [
        ("pub", 3, 10.0, 0),
        ("paper", 0, 10.0, 0),
        ("paper", 21, 10.0, 0),
        ("paper", [1, 1], 10.0, 0),
        ("paper", 3, -1.0, 0),
        ("paper", 3, math.nan, 0),
        ("paper", 3, 10.0, -1),
    ],
)
def test_an_impossible_team_is_refused_by_name(
    scenario: str, nodes: int | list[int], seconds: float, seed: int
) -> None:
    with pytest.raises(DataError):
        make_team(scenario, nodes, seconds, seed)


def test_six_walkers_for_ten_minutes_are_made_in_seconds() -> None:
    begin = time.process_time()
    make_team("paper", 6, 600.0, 1)
    assert time.process_time() - begin < 6.0  # about 2 s alone on a machine


def test_the_route_closes_and_turns_once_a_lap() -> None:
    corners = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 10.0], [0.0, 10.0]])
    route = Route(corners, 1.8)
    assert route.turn_rad == pytest.approx(2 * math.pi)
    way = np.array([5.0, 5.0 + route.lap_m, 5.0 + 7 * route.lap_m])
    place, heading = route.at(way)
    np.testing.assert_allclose(place, np.broadcast_to([5.0, 0.0], (3, 2)), atol=1e-6)
    np.testing.assert_allclose(heading, [0.0, 2 * math.pi, 14 * math.pi], atol=1e-9)
    # Never far from the sides, and as long as its own chords say.
    s = np.linspace(0, route.lap_m, 20_001)
    place, _ = route.at(s)
    chords = np.linalg.norm(np.diff(place, axis=0), axis=1).sum()
    assert chords == pytest.approx(route.lap_m, abs=1e-3)


def test_sides_too_short_for_the_corners_are_refused() -> None:
    with pytest.raises(DataError):
        Route(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), 2.0)


def test_the_pendulum_inverts_to_the_step_length() -> None:
    # Zijlstra and Hof: s = k 2 sqrt(2 l h - h^2).
    length = np.linspace(0.1, 0.9, 9)
    h = pendulum_rise_m(length, 0.9, 1.2)
    np.testing.assert_allclose(1.2 * 2 * np.sqrt(2 * 0.9 * h - h**2), length, rtol=1e-12)


def test_the_vault_is_lowest_in_double_support_and_one_high() -> None:
    phase = np.linspace(0.0, 1.0, 201)
    for support in (0.55, 0.65, 0.75):
        shape = vertical_shape(phase, np.full_like(phase, support))
        assert shape[0] == pytest.approx(0.0, abs=1e-12)
        assert shape[100] == pytest.approx(1.0, abs=1e-9)
        assert np.argmin(shape) in (0, 200)
        np.testing.assert_allclose(shape, shape[::-1], atol=1e-12)


def test_spectral_derivatives_are_those_of_a_known_signal() -> None:
    t = (np.arange(4000) - 600) / 200.0
    omega = 2 * math.pi * 3.3
    value = 5.0 * t + 0.02 * np.sin(omega * t)
    _, first, second = Spectral(4000, 600).derivatives(value, 2)
    inner = slice(800, 3200)
    np.testing.assert_allclose(
        first[inner], (5 + 0.02 * omega * np.cos(omega * t))[inner], atol=1e-5
    )
    np.testing.assert_allclose(
        second[inner], (-0.02 * omega**2 * np.sin(omega * t))[inner], atol=1e-3
    )
