"""The laboratory's simulation: its geometry, its radio, its landmarks, and what was calibrated."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from relpos.errors import RelposError
from relpos.evaluation import executors, study
from relpos.evaluation.study import Case
from relpos.measurements import Motion, Range
from relpos.runs import load_run
from relpos.simulation import lab, scenarios
from support.command import relpos

QUIET = {"noise_scale": 0, "sigma_range_m": 0, "wall_delay_max_m": 0, "body_delay_max_m": 0,
         "reflection": 0}  # fmt: skip


def test_three_people_walk_310_m_of_380_s_round_the_room() -> None:
    run = scenarios.simulate("lab", 1)
    assert {t.node for t in run.truth} == {1, 2, 3}
    assert run.truth[-1].time_s == 380.0
    for node in (1, 2, 3):
        way = np.array([(t.x_m, t.y_m) for t in run.truth if t.node == node])
        assert way.min(axis=0) == pytest.approx([0.0, 0.0], abs=0.5)
        assert way.max(axis=0) == pytest.approx([23.0, 13.0], abs=0.5)
        walked = np.hypot(*np.diff(way, axis=0).T).sum()
        # Corners cut by the seconds shorten the polygon a little.
        assert 300.0 < walked <= 310.0


def test_motions_without_noise_follow_the_truth_and_clear_ranges_are_distances() -> None:
    run = scenarios.simulate("lab", 2, QUIET)
    truth = {(t.time_s, t.node): complex(t.x_m, t.y_m) for t in run.truth}
    place = {p.node: complex(p.x_m, p.y_m) for p in run.priors}
    heading = {p.node: p.heading_rad for p in run.priors}
    for m in run.measurements:
        if isinstance(m, Motion):
            turned = complex(math.cos(heading[m.node]), math.sin(heading[m.node]))
            place[m.node] += complex(m.dx_m, m.dy_m) * turned
            heading[m.node] += m.dtheta_rad
            assert abs(place[m.node] - truth[m.time_s, m.node]) < 1e-9
        elif isinstance(m, Range):
            assert m.range_m == pytest.approx(
                abs(truth[m.time_s, m.node] - truth[m.time_s, m.peer])
            )


def test_the_block_of_rooms_obstructs_links_across_and_not_along_a_side() -> None:
    first = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 5.0], [23.0, 0.0]])
    second = np.array([[20.0, 0.0], [10.0, 13.0], [23.0, 5.0], [0.0, 13.0]])
    # Along a side; across one room; through all three; corner to corner.
    assert lab.walls_between(first, second).tolist() == [0, 2, 4, 4]
    assert np.array_equal(lab.walls_between(first, second), lab.walls_between(second, first))


def test_the_person_ahead_obstructs_the_link_to_their_own_tag() -> None:
    behind, ahead = np.array([[0.0, 0.0]]), np.array([[4.0, 0.0]])
    east, west = np.array([0.0]), np.array([math.pi])
    assert lab.bodies_between(behind, ahead, east, east) == [1]
    assert lab.bodies_between(behind, ahead, east, west) == [0]
    assert lab.bodies_between(behind, ahead, west, east) == [2]


def test_detection_and_delays_are_those_stated() -> None:
    settings = lab.LabSettings()
    attempts = [
        lab.attempt(settings, lab.walk(settings, rng), rng)
        for rng in map(np.random.default_rng, range(30))
    ]
    walls, bodies, distance, received, measured = (
        np.concatenate([getattr(a, name) for a in attempts])
        for name in ("walls", "bodies", "distance_m", "heard", "range_m")
    )
    for many_walls, many_bodies, factor, delay in ((0, 0, 1.0, 0.0), (0, 1, 0.5, 0.25),
                                                   (2, 1, 0.125, 0.55)):  # fmt: skip
        these = (walls == many_walls) & (bodies == many_bodies)
        assert these.sum() > 300
        near = 0.9 - 0.4 * distance[these] / 30.0
        assert received[these].mean() == pytest.approx(factor * near.mean(), abs=0.03)
        excess = (measured - distance)[these]
        assert np.median(excess[excess < 1.9]) == pytest.approx(delay, abs=0.1)
        reflected = (excess > 1.9).mean()
        assert reflected == pytest.approx(0.35 if many_walls + many_bodies else 0.0, abs=0.05)
    # Even close ones are often not received, as in the paper.
    assert 0.2 < received[distance < 5.0].mean() < 0.6


def test_everything_is_a_function_of_settings_and_seed() -> None:
    assert scenarios.simulate("lab", 5) == scenarios.simulate("lab", 5)
    assert scenarios.simulate("lab", 5) != scenarios.simulate("lab", 6)
    with pytest.raises(RelposError, match="scenario lab has no setting 'wals'"):
        scenarios.simulate("lab", 5, {"wals": 1})
    with pytest.raises(RelposError, match="body_transmission: 2 is not within 0 to 1"):
        scenarios.simulate("lab", 5, {"body_transmission": 2})
    with pytest.raises(RelposError, match="unknown scenario 'labb'"):
        scenarios.simulate("labb")


def test_presses_name_the_landmark_that_was_passed(tmp_path: Path) -> None:
    made = relpos("simulate", "--scenario", "lab", "--seed", 4, "--out", tmp_path / "run")
    assert made.exit_code == 0, made.output
    run = load_run(tmp_path / "run")
    assert len(run.landmarks) == 112
    places = {m.landmark: complex(m.x_m, m.y_m) for m in run.landmarks}
    truth = {(t.time_s, t.node): complex(t.x_m, t.y_m) for t in run.truth}
    for press in run.events:
        near = truth[round(press.time_s), press.node]
        assert abs(places[press.value] - near) < 0.88 * 0.76 + 1e-6
    assert len(run.events) > 300
    (tmp_path / "run" / "truth.csv").unlink()
    from_presses = load_run(tmp_path / "run")
    assert len(from_presses.truth) == len(run.events)


def test_who_has_not_set_off_yet_presses_nothing() -> None:
    assert not lab.simulate_lab(1, {"seconds": 1}).events


def test_dead_reckoning_errs_by_the_papers_3_m_and_ranges_help() -> None:
    """24 seeds of dead reckoning, within three standard errors of the paper's; 8 of the filter."""
    reckoned = study.run(
        [Case("", "lab", estimator="deadreckoning")], range(24), executors.Serial()
    )[0].distance_m
    assert abs(reckoned.mean - 3.0) < 3.0 * reckoned.error
    assert reckoned.error < 0.25
    fused = study.run([Case("", "lab")], range(8), executors.Serial())[0].distance_m
    assert fused.mean == pytest.approx(2.2, rel=0.25)
    least = study.bounds_of([Case("", "lab")], range(2), executors.Serial())[0]
    assert 0.1 < least.filtering_distance_m < 0.5 * fused.mean
