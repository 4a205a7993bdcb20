"""Missions: repeatable, combined by settings, with the faults that they name and no others."""

from __future__ import annotations

import math

import numpy as np
import pytest

import relpos
from relpos.errors import RelposError
from relpos.measurements import Heading, Height, Motion, Range
from relpos.simulation import missions
from relpos.simulation.paper import SimulatedRun
from relpos.simulation.scenarios import simulate

SHORT = {"seconds": 60}


def mission(condition: str, seed: int = 3, **settings: float) -> SimulatedRun:
    return simulate(f"mission-{condition}", seed, SHORT | settings)


def true_m(run: SimulatedRun, node: int, time_s: float) -> np.ndarray:
    rows = [t for t in run.truth if t.node == node]
    times = [t.time_s for t in rows]
    return np.array(
        [np.interp(time_s, times, [getattr(t, k) for t in rows]) for k in ("x_m", "y_m")]
    )


def walked(run: SimulatedRun, node: int) -> tuple[np.ndarray, float]:
    """Where a node's reported motions lead to from its prior, and until when."""
    prior = next(p for p in run.priors if p.node == node)
    place, heading, end_s = complex(prior.x_m, prior.y_m), prior.heading_rad, 0.0
    for m in run.measurements:
        if isinstance(m, Motion) and m.node == node:
            turn = complex(math.cos(heading), math.sin(heading))
            place += complex(m.dx_m, m.dy_m) * turn
            heading, end_s = heading + m.dtheta_rad, m.time_s
    return np.array([place.real, place.imag]), end_s


def test_the_same_seed_is_the_same_mission_and_another_seed_another() -> None:
    assert mission("base") == mission("base")
    assert mission("base") != mission("base", 4)


@pytest.mark.parametrize("condition", missions.CONDITIONS)
def test_every_condition_is_simulated(condition: str) -> None:
    shorter = {"split_s": 20} if condition.startswith("split") else {}
    run = simulate(f"mission-{condition}", 1, SHORT | shorter)
    assert {m.node for m in run.measurements} >= {p.node for p in run.priors}
    assert any(isinstance(m, Range) for m in run.measurements)


@pytest.mark.parametrize("gap_s", [0, 5, 20])
def test_motion_without_noise_leads_to_the_true_place_whatever_the_gaps(gap_s: int) -> None:
    quiet = {"way_noise_m": 0, "heading_noise_deg": 0, "turn_noise": 0}
    run = mission("base", gap_s=gap_s, **quiet)
    for node in range(1, 7):
        place, end_s = walked(run, node)
        assert np.linalg.norm(place - true_m(run, node, end_s)) < 0.3


def test_ranges_without_noise_are_the_true_distances() -> None:
    run = mission("base", sigma_range_m=0)
    for m in run.measurements:
        if isinstance(m, Range):
            apart_m = np.linalg.norm(true_m(run, m.node, m.time_s) - true_m(run, m.peer, m.time_s))
            assert m.range_m == pytest.approx(apart_m, abs=0.35)  # of truth once a second


def test_a_late_range_is_dated_late_and_nothing_else_changes() -> None:
    sent = [m for m in mission("base").measurements if isinstance(m, Range)]
    late = [m for m in mission("late-1").measurements if isinstance(m, Range)]
    assert [m.range_m for m in sent] == [m.range_m for m in late]
    assert {round(b.time_s - a.time_s, 6) for a, b in zip(sent, late, strict=True)} == {1.0}


def test_a_shadow_only_lengthens_and_never_by_more_than_it_says() -> None:
    plain = [m for m in mission("base").measurements if isinstance(m, Range)]
    shadowed = [m for m in mission("shadow").measurements if isinstance(m, Range)]
    longer = [b.range_m - a.range_m for a, b in zip(plain, shadowed, strict=True)]
    assert min(longer) >= 0.0
    assert 0.5 < max(longer) <= 0.8 + 1e-9


def test_a_range_is_longer_by_the_antenna_delays_of_both_tags() -> None:
    plain = [m for m in mission("base").measurements if isinstance(m, Range)]
    delayed = [m for m in mission("delays").measurements if isinstance(m, Range)]
    longer_m: dict[tuple[int, ...], list[float]] = {}
    for a, b in zip(plain, delayed, strict=True):
        if a.range_m > 2.0:
            pair = tuple(sorted((a.node, a.peer)))
            longer_m.setdefault(pair, []).append(b.range_m - a.range_m)
    of = {pair: np.mean(those) for pair, those in longer_m.items()}
    assert max(np.ptp(those) for those in longer_m.values()) < 1e-9
    assert of[1, 2] + of[3, 4] == pytest.approx(of[1, 3] + of[2, 4])
    assert 0.05 < np.std(list(of.values())) < 0.6


def test_who_is_carried_reports_to_turn_and_not_to_step() -> None:
    plain, carried = (
        [m for m in mission(name).measurements if isinstance(m, Motion)]
        for name in ("base", "carried")
    )
    for a, b in zip(plain, carried, strict=True):
        if a.node == 2 and a.time_s >= 30.0:
            assert (b.dx_m, b.dy_m, b.dtheta_rad) == (0.0, 0.0, a.dtheta_rad)
        else:
            assert a == b


def test_half_of_the_team_is_away_while_the_team_is_split() -> None:
    run = simulate("mission-split", 2, {"seconds": 600, "split_s": 300})
    apart_m = np.linalg.norm(true_m(run, 1, 400.0) - true_m(run, 6, 400.0))
    assert apart_m > 40.0
    assert np.linalg.norm(true_m(run, 1, 599.0) - true_m(run, 6, 599.0)) < 45.0
    ranges = [m for m in run.measurements if isinstance(m, Range) and 300 < m.time_s < 440]
    assert not [m for m in ranges if (m.node <= 3) != (m.peer <= 3)]


def test_sensors_report_only_where_the_condition_has_them() -> None:
    kinds = {type(m) for m in mission("base").measurements}
    assert kinds == {Motion, Range}
    assert {type(m) for m in mission("floors").measurements} == {Motion, Range, Height}
    assert {type(m) for m in mission("compass").measurements} == {Motion, Range, Heading}


def test_a_wrong_setting_is_named() -> None:
    with pytest.raises(RelposError, match="no setting 'gaps'"):
        mission("base", gaps=1)
    with pytest.raises(RelposError, match="unknown scenario"):
        simulate("mission-moon", 1)


def test_a_mission_is_scored_without_a_bound() -> None:
    run = relpos.simulate("mission-base", 1, seconds=20)
    score = relpos.evaluate(relpos.fuse(run, estimator="deadreckoning"), run)
    assert score.bound is None
    assert score.metrics.relative_distance_rmse_m > 0.0
