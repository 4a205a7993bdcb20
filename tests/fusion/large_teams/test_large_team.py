"""Large teams through the public interface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import relpos
from crowd import Crowd, CrowdSettings, simulate_crowd
from relpos import fusion, tracks
from relpos.evaluation import metrics
from relpos.fusion import Estimate, NodeStatus, switching
from relpos.fusion.bank.estimator import Bank
from relpos.fusion.bank.storage import PER_NODE
from relpos.fusion.large_teams.estimator import LargeTeam
from relpos.fusion.models.motion_variances import ALONG, WHITE
from relpos.fusion.switching import LARGE_TEAM
from relpos.measurements import Height, Measurement, Motion, Prior, Range
from relpos.runs import NodeInfo
from relpos.simulation.missions import simulate_mission

CROWD = CrowdSettings(nodes=60, seconds=50)


@pytest.fixture(scope="module")
def crowd() -> Crowd:
    return simulate_crowd(CROWD, 7)


@pytest.fixture(scope="module")
def estimates(crowd: Crowd) -> list[Estimate]:
    """Of the crowd with known initial poses."""
    return estimates_of(crowd.priors(), crowd.measurements())[0]


def estimates_of(
    priors: Sequence[Prior], measurements: Sequence[Measurement]
) -> tuple[list[Estimate], fusion.Estimator]:
    made = fusion.make("bank", priors, {}, 0)
    result = [e for m in measurements for e in made.process(m)]
    return result + made.finish(), made


def distance_errors(crowd: Crowd, estimate: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the listed pairs' distances and the sigmas reported."""
    truth = crowd.poses[round(estimate.time_s)]
    node = np.array([p.node for p in estimate.pairs]) - 1
    peer = np.array([p.peer for p in estimate.pairs]) - 1
    real = np.hypot(*(truth[node, :2] - truth[peer, :2]).T)
    return (
        np.array([p.distance_m for p in estimate.pairs]) - real,
        np.array([p.sigma_distance_m for p in estimate.pairs]),
    )


def rms_and_nees(crowd: Crowd, estimates: Sequence[Estimate]) -> tuple[float, float]:
    pairs = [distance_errors(crowd, e) for e in estimates]
    square = np.concatenate([e**2 for e, _ in pairs])
    scaled = np.concatenate([(e / s) ** 2 for e, s in pairs])
    return float(np.sqrt(square.mean())), float(scaled.mean())


def test_a_large_team_is_known_to_a_decimetre_and_honestly(
    crowd: Crowd, estimates: list[Estimate]
) -> None:
    assert len(estimates) == CROWD.seconds
    rms, nees = rms_and_nees(crowd, estimates)
    assert rms < 0.12
    assert 0.6 < nees < 1.4


def test_pairs_in_reach_are_listed_in_order_and_no_others(
    crowd: Crowd, estimates: list[Estimate]
) -> None:
    listed = [(p.node, p.peer) for p in estimates[-1].pairs]
    assert listed == sorted(set(listed))
    assert all(node < peer for node, peer in listed)
    truth = crowd.poses[-1]
    off = np.hypot(*(truth[:, None, :2] - truth[:, :2]).transpose(2, 0, 1))
    near = {(i + 1, j + 1) for i, j in zip(*np.nonzero(np.triu(off < 14.0, 1)), strict=True)}
    far = {(i + 1, j + 1) for i, j in zip(*np.nonzero(np.triu(off > 17.0, 1)), strict=True)}
    assert near <= set(listed)
    assert not far & set(listed)


def off_in_the_team(estimate: Estimate, truth: np.ndarray) -> dict[int, float]:
    """Each located node's error (m), after the best rigid motion of all: the frame is arbitrary."""
    located = [n for n in estimate.nodes if n.status is not NodeStatus.UNLOCATED]
    poses = np.array([(n.x_m, n.y_m) for n in located])
    real = truth[[n.node - 1 for n in located], :2]
    square = metrics.aligned_squared_distances(poses, real)
    return {n.node: math.sqrt(s) for n, s in zip(located, square, strict=True)}


def test_nodes_without_a_prior_join_at_their_true_position(crowd: Crowd) -> None:
    known = [p for p in crowd.priors() if p.node % 6]
    estimates, made = estimates_of(known, crowd.measurements())
    first, last = estimates[1], estimates[-1]
    assert sum(n.status is NodeStatus.UNLOCATED for n in first.nodes) == 10
    located = [n for n in last.nodes if n.status is not NodeStatus.UNLOCATED]
    assert len(located) >= 58
    truth = crowd.poses[-1]
    joined = [n for n in located if n.node % 6 == 0]
    assert joined
    off = off_in_the_team(last, truth)
    assert max(off[n.node] for n in joined) < 0.5
    assert made.counters()["joined"] == len(joined)


def test_a_node_that_is_elsewhere_than_its_prior_is_inflated_and_found(crowd: Crowd) -> None:
    wrong = [replace(p, x_m=p.x_m + (6.0 if p.node == 20 else 0.0)) for p in crowd.priors()]
    estimates, made = estimates_of(wrong, crowd.measurements())
    assert off_in_the_team(estimates[-1], crowd.poses[-1])[20] < 0.3
    assert made.counters()["jumps"] >= 1


def test_ranges_without_line_of_sight_do_little_harm() -> None:
    late = simulate_crowd(replace(CROWD, nlos_probability=0.2), 7)
    estimates, made = estimates_of(late.priors(), late.measurements())
    rms, nees = rms_and_nees(late, estimates)
    assert rms < 0.16
    assert 0.5 < nees < 1.5
    assert made.counters()["ranges_distrusted"] > 0.1 * len(late.range_m)


def test_walls_that_stay_between_two_people_move_neither() -> None:
    """While what was known to be an outlier moved them, 0.30 m."""
    run = relpos.simulate("mission-nlos", 11, seconds=50, nodes=21, range_rate_hz=0.4)
    scored = relpos.evaluate(relpos.fuse(run), run, bound=False).metrics
    assert scored.relative_distance_rmse_m < 0.2
    assert 0.5 < scored.nees_distance < 1.6


def test_rooms_through_whose_walls_everybody_ranges_grow_little() -> None:
    """While ranges had no bias in common and none that grows with the distance, 0.52 m."""
    run = relpos.simulate("mission-walls", 12, seconds=100, nodes=21)
    scored = relpos.evaluate(relpos.fuse(run), run, bound=False).metrics
    assert scored.relative_distance_rmse_m < 0.42
    assert 0.7 < scored.nees_distance < 1.4


def test_a_bias_of_all_ranges_is_found_as_far_as_its_setting_allows(crowd: Crowd) -> None:
    long = [
        replace(m, range_m=m.range_m + 0.5) if isinstance(m, Range) else m
        for m in crowd.measurements()
        if m.time_s <= 16.0
    ]

    def error_m(bias_m: float) -> float:
        made = fusion.make("bank", crowd.priors(), {"bias_m": bias_m}, 0)
        result = [e for m in long for e in made.process(m)]
        return float(distance_errors(crowd, result[-1])[0].mean())

    assert error_m(0.3) < 0.5 * error_m(0.0)


def test_late_ranges_give_the_estimates_of_ranges_in_time(crowd: Crowd) -> None:
    measurements = [m for m in crowd.measurements() if m.time_s <= 16.0]
    late = [m for m in measurements if isinstance(m, Range) and m.time_s == 10.0]
    rest = [m for m in measurements if m not in late]
    at = next(k for k, m in enumerate(rest) if m.time_s > 12.5)
    shuffled = rest[:at] + late + rest[at:]
    usual, _ = estimates_of(crowd.priors(), measurements)
    other, _ = estimates_of(crowd.priors(), shuffled)
    for a, b in zip(usual[-1].nodes, other[-1].nodes, strict=True):
        assert a.x_m == pytest.approx(b.x_m, abs=1e-9)


def test_a_team_that_becomes_large_continues_from_its_last_poses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(switching, "LARGE_TEAM", 8)
    crowd = simulate_crowd(CrowdSettings(nodes=12, neighbours=9, seconds=24), 3)
    few = 6
    measurements = [
        m
        for m in crowd.measurements()
        if m.time_s > 8.0 or (m.node <= few and (not isinstance(m, Range) or m.peer <= few))
    ]
    made = fusion.make("bank", crowd.priors()[:few], {"hypotheses": 20}, 0)
    estimates = [e for m in measurements for e in made.process(m)] + made.finish()
    times = [e.time_s for e in estimates]
    assert times == sorted(set(times))
    assert made.counters()["teams_handed_over"] == 1
    truth = crowd.poses[-1]
    for n in estimates[-1].nodes:
        if n.node <= few:
            assert math.hypot(n.x_m - truth[n.node - 1, 0], n.y_m - truth[n.node - 1, 1]) < 1.5


def shared(pose: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Variances of shift (m^2) and turn (rad^2) about its middle of a team, poses (N, 3)."""
    g = np.tile(np.eye(3), (len(pose), 1))
    x_m, y_m = (pose[:, :2] - pose[:, :2].mean(axis=0)).T
    g[0::3, 2], g[1::3, 2] = -y_m, x_m
    told = covariance + 1e-9 * np.eye(len(covariance))
    return np.linalg.inv(g.T @ np.linalg.solve(told, g)).diagonal()


def test_a_team_that_becomes_large_knows_no_better_where_its_frame_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As independent errors of each it had a fifth of the variance; places had a NEES of 2.4."""
    monkeypatch.setattr(switching, "LARGE_TEAM", 8)
    run = simulate_mission("mission-base", 3, {"nodes": 9, "seconds": 42})
    few = {p.node for p in run.priors[:8]}
    made = fusion.make("bank", run.priors[:8], {"hypotheses": 20}, 0)
    assert isinstance(made, switching.SwitchingEstimator)
    before = np.zeros(3)
    for m in run.measurements:
        if m.time_s > 40.0:
            core = made.estimator.core
            if isinstance(core, LargeTeam):
                break
            assert isinstance(core, Bank)
            mean, covariance, common = core.core.moments()
            poses = (PER_NODE * np.arange(8)[:, None] + np.arange(3)).ravel()
            before = shared(mean[poses].reshape(8, 3), (covariance + common)[np.ix_(poses, poses)])
        if m.time_s > 40.0 or (m.node in few and (not isinstance(m, Range) or m.peer in few)):
            made.process(m)
    assert isinstance(core, LargeTeam)
    large = core.filter
    states = (5 * np.arange(8)[:, None] + np.arange(3)).ravel()
    x_m, y_m = large.pose[:8, :2].T
    g = np.tile(np.eye(3), (8, 1))
    g[0::3, 2], g[1::3, 2] = -y_m, x_m
    own = large._dense()[np.ix_(states, states)]
    after = shared(large.pose[:8], own + g @ large.common @ g.T)
    assert (after > 0.9 * before).all()
    assert (after < 2.0 * before).all()


@pytest.mark.parametrize("first_range_s", [0.0, 30.0])
def test_the_few_known_starts_of_a_large_team_define_its_frame(first_range_s: float) -> None:
    """In the frame of those who have most ranges: 23 and 30 m."""
    run = simulate_mission("mission-base", 5, {"nodes": LARGE_TEAM + 2, "seconds": 55})
    known = run.priors[:3]
    unknown = [Prior(p.node, 0.0, 0.0, 0.0, math.inf, math.inf) for p in run.priors[3:]]
    measurements = [
        m for m in run.measurements if not isinstance(m, Range) or m.time_s > first_range_s
    ]
    last = estimates_of([*known, *unknown], measurements)[0][-1]
    truth = tracks.true_tracks(run.truth)
    for n in last.nodes:
        if n.status is NodeStatus.OK:
            there = truth[n.node]
            off_x = n.x_m - np.interp(last.time_s, there.time_s, there.x_m)
            off_y = n.y_m - np.interp(last.time_s, there.time_s, there.y_m)
            assert math.hypot(off_x, off_y) < 3.0
    assert sum(n.status is NodeStatus.OK for n in last.nodes) > 15


def test_time_goes_on_when_a_team_of_which_nobody_is_known_becomes_large() -> None:
    run = simulate_mission("mission-base", 5, {"nodes": LARGE_TEAM + 2, "seconds": 30})
    few = {p.node for p in run.priors[:8]}
    measurements = [
        m
        for m in run.measurements
        if m.time_s > 8.0 or (m.node in few and (not isinstance(m, Range) or m.peer in few))
    ]
    times = [e.time_s for e in estimates_of([], measurements)[0]]
    assert len(times) > 20
    assert times == sorted(set(times))


def test_the_same_measurements_give_the_same_estimates(crowd: Crowd) -> None:
    measurements = [m for m in crowd.measurements() if m.time_s <= 12.0]
    one, _ = estimates_of(crowd.priors(), measurements)
    two, _ = estimates_of(crowd.priors(), measurements)
    assert one == two


def test_the_noise_of_each_nodes_steps_is_learned(crowd: Crowd) -> None:
    made = fusion.make("bank", crowd.priors(), {}, 0)
    for m in crowd.measurements():
        made.process(m)
    assert isinstance(made, switching.SwitchingEstimator)
    assert isinstance(made.estimator.core, LargeTeam)
    factor = made.estimator.core._components.factor
    # The crowd's six levels of step noise are 5 10 20 10 15 10 % in turn, 9 % is the base's.
    steady, uneven = (
        np.median(factor[0::6, ALONG]),
        np.median(factor[2::6, ALONG]),
    )
    assert uneven > 2.0 * steady
    assert uneven > 1.2
    # No heading wanders on a straight walk here.
    assert np.median(factor[:, WHITE]) < 0.2


def test_a_large_team_without_priors_is_located() -> None:
    crowd = simulate_crowd(CrowdSettings(nodes=40, seconds=90), 6)
    estimates, made = estimates_of([], crowd.measurements())
    assert len(estimates[9].nodes) == 40  # who is not found yet is listed as such
    last = estimates[-1]
    located = [n for n in last.nodes if n.status is NodeStatus.OK]
    assert len(located) >= 37
    found = np.array([(n.x_m, n.y_m) for n in located])
    truth = crowd.poses[-1][[n.node - 1 for n in located], :2]
    assert np.sqrt(metrics.aligned_squared_distances(found, truth).mean()) < 0.5
    assert made.counters()["joined"] >= 31


def test_a_node_of_a_large_team_whose_motion_is_missing_is_found_by_its_ranges() -> None:
    run = relpos.simulate("mission-base", 5, nodes=LARGE_TEAM + 4, seconds=50, range_rate_hz=0.15)
    gap = [m for m in run.measurements if isinstance(m, Motion) and m.node == 3 and m.time_s > 33]
    kept = [m for m in run.measurements if m not in gap]
    result = relpos.fuse(run, measurements=kept)
    assert result.counters["diffusions"] > 0
    score = relpos.evaluate(result, run, bound=False).metrics
    late = score.time_s > 38
    own = [k for k, pair in enumerate(score.pair_ids) if 3 in pair]
    error_m = (score.pair_distance_m - score.pair_true_distance_m)[late][:, own]
    assert np.nanmean(np.abs(error_m)) < 0.6


def test_people_of_a_large_team_walk_on_while_their_motion_is_missing_and_face_their_way() -> None:
    run = relpos.simulate("mission-gap-20", 11, nodes=LARGE_TEAM + 1, seconds=45)
    result = relpos.fuse(run)
    scored = relpos.evaluate(result, run, bound=False).metrics
    # Who has not reported yet is taken to stand.
    late = scored.time_s > 20.0
    error_m = (scored.pair_distance_m - scored.pair_true_distance_m)[late]
    assert math.sqrt(np.nanmean(error_m**2)) < 0.2
    truth = tracks.true_tracks(run.truth)
    turned = []
    for e in (e for e in result.estimates if e.time_s > 20.0):
        for n in e.nodes:
            true = truth[n.node]
            heading = np.interp(e.time_s, true.time_s, np.unwrap(true.heading_rad))
            off_rad = math.remainder(n.heading_rad - heading, math.tau)
            turned.append((off_rad / n.sigma_heading_rad) ** 2)
    assert np.mean(turned) < 2.0


@pytest.mark.parametrize(
    ("condition", "wrong"),
    [
        ("base", {"drift_deg_min": 6.0, "step_scale": 0.85}),
        ("late-0.3", {}),
        pytest.param("shadow", {}, marks=pytest.mark.soak),
    ],
)
def test_what_the_team_has_in_common_is_learned_and_told(
    condition: str, wrong: dict[str, float]
) -> None:
    run = relpos.simulate(
        f"mission-{condition}", 21, nodes=LARGE_TEAM + 1, seconds=45.0, range_rate_hz=0.3, **wrong
    )
    result = relpos.fuse(run)
    scored = relpos.evaluate(result, run, bound=False).metrics
    assert scored.relative_distance_rmse_m < 0.13
    assert 0.6 < scored.nees_distance < 1.5
    learned = {p.name: p.value for p in result.estimates[-1].parameters}
    assert learned["range_lateness_s"] == pytest.approx(
        0.3 if condition == "late-0.3" else 0.0, abs=0.05
    )
    # The simulator's shadow grows with the square of how far somebody is behind: its half.
    assert learned["body_shadow_m"] == pytest.approx(0.4 if condition == "shadow" else 0.0, abs=0.1)


def test_a_tag_whose_ranges_are_all_too_long_is_no_surer_than_right() -> None:
    """While tags had no antenna delays: 0.25 m, NEES 3.3."""
    run = relpos.simulate("mission-base", 2, nodes=LARGE_TEAM + 1, seconds=35.0, range_rate_hz=0.3)
    long = [
        replace(m, range_m=m.range_m + 0.3) if isinstance(m, Range) and 3 in (m.node, m.peer) else m
        for m in run.measurements
    ]
    truth = tracks.true_tracks(run.truth)
    error_m, scaled = [], []
    estimates = relpos.fuse(run, measurements=long).estimates
    for e in estimates[20:]:
        at = {
            n: [np.interp(e.time_s, t.time_s, a) for a in (t.x_m, t.y_m)] for n, t in truth.items()
        }
        for p in (p for p in e.pairs if 3 in (p.node, p.peer)):
            error_m.append(p.distance_m - math.dist(at[p.node], at[p.peer]))
            scaled.append(error_m[-1] / p.sigma_distance_m)
    assert math.sqrt(np.mean(np.square(error_m))) < 0.15
    assert np.mean(np.square(scaled)) < 2.0
    delays = {p.node: p for p in estimates[-1].parameters if p.name == "antenna_delay_m"}
    assert len(delays) == LARGE_TEAM + 1
    off = [(p.value - 0.3 * ((n == 3) - 1 / len(delays))) / p.sigma for n, p in delays.items()]
    assert np.mean(np.square(off)) < 2.0
    assert delays[3].sigma < 0.03


def test_a_clock_that_is_a_second_off_is_found_in_a_large_team_and_put_right() -> None:
    """While a large team learned no clock of one node: 0.22 m, NEES 1.6, 3.1 %."""
    run = relpos.simulate(
        "mission-clock", 22, nodes=LARGE_TEAM + 1, seconds=60.0, range_rate_hz=0.3
    )
    result = relpos.fuse(run)
    scored = relpos.evaluate(result, run, bound=False).metrics
    assert scored.relative_distance_rmse_m < 0.15
    assert scored.nees_distance < 1.2
    assert scored.ok_over_3_sigma < 0.015
    clocks = {p.node: p for p in result.estimates[-1].parameters if p.name == "clock_offset_s"}
    assert clocks[2].value == pytest.approx(1.0, abs=0.1)
    assert all(abs(p.value) < 0.1 for n, p in clocks.items() if n != 2)


def test_a_large_team_on_two_floors_without_heights_is_no_surer_than_right() -> None:
    """While the slant between floors counted as noise: 0.24 m, NEES 4.1."""
    run = relpos.simulate("mission-floors-no-heights", 1, nodes=LARGE_TEAM + 1, seconds=80.0)
    scored = relpos.evaluate(relpos.fuse(run), run, bound=False).metrics
    assert scored.relative_distance_rmse_m < 0.26
    assert 0.4 < scored.nees_distance < 2.0


def test_a_large_team_in_an_office_is_no_surer_than_right() -> None:
    """Not knowing walls by the ranges that they take: NEES 4.2, 14 % beyond three sigmas."""
    run = relpos.simulate("mission-office", 3, nodes=LARGE_TEAM + 1, seconds=70.0)
    result = relpos.fuse(run)
    scored = relpos.evaluate(result, run, bound=False).metrics
    assert 0.4 < scored.nees_distance < 1.4
    assert scored.ok_over_3_sigma < 0.015
    told = [p.sigma for p in result.estimates[-1].parameters if p.name == "range_scale"]
    assert min(told) > 0.02


@pytest.mark.parametrize("size", [3, LARGE_TEAM + 2])
@pytest.mark.parametrize("climbs", [False, True], ids=["level", "with heights"])
def test_a_tag_is_as_high_as_it_is_worn_and_its_wearer_has_climbed(size: int, climbs: bool) -> None:
    nodes = range(1, size + 1)
    priors = [Prior(n, 3.0 * n, 0.0, 0.0, 0.1, 0.1) for n in nodes]
    worn = {n: NodeInfo(height_m=1.3) for n in nodes}
    made, estimates = fusion.make("bank", priors, {}, 0, worn), []
    for second in range(1, 20):
        for n in nodes:
            estimates += made.process(Motion(float(second), n, 0.5, 0.0, 0.0))
            if climbs:
                estimates += made.process(Height(float(second), n, 0.0, 0.1))
        for n in nodes[:-1]:
            estimates += made.process(Range(second - 0.5, n, n + 1, 3.0))
    for estimate in [*estimates, *made.finish()]:
        assert [n.z_m for n in estimate.nodes] == pytest.approx([1.3] * size, abs=0.3)


@pytest.mark.parametrize(
    ("amiss", "most_m", "most_nees"),
    [
        # While ranges before the first heights taught of all later ones: .18 m, NEES .9.
        ({"floors": 2, "heights": 1, "area_m": 15}, 0.14, 0.7),
        # While reports of six seconds were taken for even walks: NEES 1.6.
        ({"range_late_s": 0.6, "gap_s": 5, "range_rate_hz": 0.3}, 0.26, 1.4),
    ],
)
def test_ranges_before_heights_and_within_long_reports_mislead_no_large_team(
    amiss: dict[str, float], most_m: float, most_nees: float
) -> None:
    errors_m, nees = [], []
    for seed in (31, 32):
        run = relpos.simulate("mission-base", seed, nodes=LARGE_TEAM + 1, seconds=40, **amiss)
        scored = relpos.evaluate(relpos.fuse(run), run, bound=False).metrics
        errors_m.append(scored.relative_distance_rmse_m)
        nees.append(scored.nees_distance)
    assert np.mean(errors_m) < most_m
    assert np.mean(nees) < most_nees


def test_a_large_team_that_ranges_between_floors_alone_learns_nothing_of_what_is_lost() -> None:
    nodes = range(1, LARGE_TEAM + 3)
    priors = [Prior(n, 3.0 * n, 0.0, 0.0, 0.1, 0.1) for n in nodes]
    made, estimates = fusion.make("bank", priors, {}, 0), []
    for second in range(1, 12):
        for n in nodes:
            estimates += made.process(Motion(float(second), n, 0.0, 0.0, 0.0))
            estimates += made.process(Height(float(second), n, 4.0 * (n % 2), 0.1))
        for n in nodes[:-1]:
            estimates += made.process(Range(second - 0.5, n, n + 1, 5.0))
    estimates += made.finish()
    told = [p.sigma for p in estimates[-1].parameters if p.name == "range_scale"]
    assert told == [0.0] * len(nodes)


def test_places_and_bearings_in_the_common_frame_are_no_surer_than_right() -> None:
    """Of two missions: no range tells how a whole team has turned and shifted."""
    places, bearings = [], []
    for seed in (7, 8):
        run = simulate_mission("mission-base", seed, {"nodes": 24, "seconds": 60})
        truth = tracks.true_tracks(run.truth)
        for e in estimates_of(run.priors, run.measurements)[0][20:]:
            at = {
                node: np.array([np.interp(e.time_s, t.time_s, axis) for axis in (t.x_m, t.y_m)])
                for node, t in truth.items()
            }
            for n in e.nodes:
                off = np.array([n.x_m, n.y_m]) - at[n.node]
                xy = n.covariance_xy_m2
                told = np.array([[n.variance_x_m2, xy], [xy, n.variance_y_m2]])
                places.append(off @ np.linalg.solve(told, off) / 2.0)
            for p in e.pairs:
                east, north = at[p.peer] - at[p.node]
                off_rad = math.remainder(p.bearing_rad - math.atan2(north, east), math.tau)
                bearings.append((off_rad / p.sigma_bearing_rad) ** 2)
    assert np.mean(places) < 1.5
    assert np.mean(bearings) < 1.5
