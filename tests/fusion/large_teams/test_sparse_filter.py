"""The filter for large teams beside the dense one it stands for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import block_diag

from crowd import Crowd, CrowdSettings, side_of, simulate_crowd
from reference import neighbourhood as dense
from relpos.fusion.large_teams.kernels import RangeModel, Ranges, displacements
from relpos.fusion.large_teams.sparse_filter import (
    JITTER_CONSTANT,
    JITTER_M2,
    TERMS,
    NeighbourhoodFilter,
    OwnTerm,
)

Floats = npt.NDArray[np.float64]

SIGMA_M = 0.1
DRIFT_AND_SCALE = (0.05, 0.1)


def covariance_of(filter_: NeighbourhoodFilter) -> Floats:
    """All blocks, far ones by the chain."""
    filter_._catch_up()
    return filter_._dense()


def pairs_within(pose: Floats, reach_m: float) -> tuple[npt.NDArray[np.int64], ...]:
    off = pose[:, None, :2] - pose[:, :2]
    near = np.triu(np.hypot(off[..., 0], off[..., 1]) < reach_m, 1)
    i, j = np.nonzero(near)
    return i.astype(np.int64), j.astype(np.int64)


def dense_start(pose: Floats, variance: Sequence[float]) -> tuple[Floats, Floats]:
    """Give states (N, 5) at poses (N, 3), and their covariance of variances (5,)."""
    jitter = 3 * [JITTER_M2] + 2 * [JITTER_CONSTANT]
    return np.pad(pose, ((0, 0), (0, 2))), np.diag(np.tile(np.add(variance, jitter), len(pose)))


def started(
    pose: Floats, width_m: float, sigma: float = 0.3
) -> tuple[NeighbourhoodFilter, Floats, Floats]:
    """Give a filter over independent starts, and the same as dense states and covariance."""
    made = NeighbourhoodFilter(width_m, RangeModel(SIGMA_M))
    variance = [sigma**2, sigma**2, 0.1**2]
    made.add(pose.copy(), np.tile(np.diag(variance), (len(pose), 1, 1)), DRIFT_AND_SCALE)
    return made, *dense_start(pose, [*variance, *np.square(DRIFT_AND_SCALE)])


def plain(
    made: NeighbourhoodFilter, node: np.ndarray, peer: np.ndarray, measured_m: Floats
) -> Ranges:
    """Ranges that are alike, and depend on no terms."""
    count = len(node)
    no_slopes, level = np.zeros((count, len(made.terms))), np.zeros(count)
    known, outliers = np.zeros(count), np.zeros((count, 3))
    return Ranges(node, peer, measured_m, level, np.ones(count), known, outliers, no_slopes)


def random_moves(rng: np.random.Generator, count: int) -> Floats:
    moved = np.abs(rng.normal(0.3, 0.2, (count, 7)))
    moved[:, :3] = rng.normal(0.0, 0.5, (count, 3))
    return moved


def test_within_one_strip_it_is_the_dense_filter() -> None:
    rng = np.random.default_rng(1)
    pose = np.column_stack([rng.uniform(0, 12, (9, 2)), rng.uniform(-3, 3, 9)])
    made, pose, covariance = started(pose, width_m=50.0)
    node, peer = np.triu_indices(9, 1)
    for _ in range(4):
        moved_s = np.zeros(9)
        for _ in range(2):
            moved = 0.3 * random_moves(rng, 9)
            made.predict(np.arange(9), moved)
            dense.advance(pose, covariance, np.arange(9), moved)
            moved_s += moved[:, 6]
        dense.wander(covariance, np.arange(9), moved_s)
        true = np.hypot(*(pose[node, :2] - pose[peer, :2]).T)
        lift_m2 = rng.uniform(0.0, 9.0, node.size)
        measured = np.sqrt(true**2 + lift_m2) + rng.normal(0.0, SIGMA_M, node.size)
        made.update(plain(made, node, peer, measured)._replace(lift_m2=lift_m2))
        dense.update(pose, covariance, node, peer, measured, SIGMA_M, lift_m2)
    assert np.abs(pose[:, 3:]).max() > 0.01
    # Ways are turned by the next motion, even if it is none.
    made.predict(np.arange(9), np.zeros((9, 7)))
    dense.advance(pose, covariance, np.arange(9), np.zeros((9, 7)))
    assert np.allclose(made.state, pose, atol=1e-7)
    assert np.allclose(covariance_of(made), covariance, rtol=1e-6, atol=1e-10)


def test_terms_delays_and_clocks_are_those_of_a_dense_filter_with_them_as_states() -> None:
    rng = np.random.default_rng(7)
    pose = np.column_stack([rng.uniform(0, 12, (7, 2)), rng.uniform(-3, 3, 7)])
    made = NeighbourhoodFilter(50.0, RangeModel(SIGMA_M), own_sd=(0.1, 0.07))
    variance = np.array([0.09, 0.09, 0.01])
    # Without scales no ways are turned.
    for some in (pose[:5], pose[5:]):
        made.add(some.copy(), np.tile(np.diag(variance), (len(some), 1, 1)), (0.05, 0.0))
    state, covariance = dense_start(pose, [*variance, 0.05**2, 0.0])
    terms = np.zeros(TERMS + 14)
    joint = block_diag(covariance, np.linalg.inv(made.terms_information))
    node, peer = np.triu_indices(7, 1)
    for _ in range(3):
        moved = 0.3 * random_moves(rng, 7)
        made.predict(np.arange(7), moved)
        dense.advance(state, joint, np.arange(7), moved)
        dense.wander(joint, np.arange(7), moved[:, 6])
        common = rng.normal(0.0, 1.0, (node.size, TERMS))
        peer_m_s = rng.normal(0.0, 1.0, node.size)
        slopes = np.hstack([common, np.zeros((node.size, 14))])
        for ends, sign in ((node, -1.0), (peer, 1.0)):
            slopes[np.arange(node.size), TERMS + 2 * ends] = 1.0
            slopes[np.arange(node.size), TERMS + 2 * ends + 1] = sign * peer_m_s
        assert (made.slopes_in_terms(node, peer, common, peer_m_s) == slopes).all()
        true = np.hypot(*(state[node, :2] - state[peer, :2]).T)
        measured = true + rng.normal(0.0, SIGMA_M, node.size) + slopes[:, TERMS + 6] * 0.3
        sure, none = np.ones(node.size), np.zeros((node.size, 3))
        made.update(Ranges(node, peer, measured, none[:, 0], sure, none[:, 0], none, slopes))
        dense.update_with_terms(state, terms, joint, (node, peer), measured, slopes, SIGMA_M)
    own, carried = dense.given_terms(joint, 7)
    assert np.allclose(made.state, state, atol=1e-4)
    assert np.allclose(made.terms, terms, atol=1e-5)
    assert np.allclose(covariance_of(made), own, atol=1e-5)
    assert np.allclose(made._carried.reshape(carried.shape), carried, atol=1e-3)
    about_terms = joint[state.size :, state.size :]
    assert np.allclose(np.linalg.inv(made.terms_information), about_terms, atol=1e-6)
    whole, told = (dense.spread(state, c, node, peer) for c in (joint[: len(own), : len(own)], own))
    added = made.spread_of_terms(node, peer, told[3])
    assert np.allclose(added, (whole - told)[1:3], atol=1e-6)
    assert added.max() > 0.01
    for term in OwnTerm:
        own_terms, sigma = made.own_terms(term)
        theirs = slice(TERMS + term, None, 2)
        assert own_terms == pytest.approx(terms[theirs] - terms[theirs].mean(), abs=1e-5)
        difference = np.eye(7)[3] - 1.0 / 7.0
        variance = difference @ about_terms[theirs, theirs] @ difference
        assert sigma[3] == pytest.approx(np.sqrt(variance), rel=1e-3)


def test_a_team_that_outgrows_delays_and_clocks_keeps_what_all_ranges_have_in_common() -> None:
    rng = np.random.default_rng(8)
    pose = np.column_stack([rng.uniform(0, 12, (6, 2)), np.zeros(6)])
    made = NeighbourhoodFilter(50.0, RangeModel(SIGMA_M), own_sd=(0.1, 0.07))
    variance = np.diag([0.09, 0.09, 0.01])
    made.add(pose[:5].copy(), np.tile(variance, (5, 1, 1)))
    node, peer = np.triu_indices(5, 1)
    measured = np.hypot(*(pose[node, :2] - pose[peer, :2]).T) + 0.2
    ones, none = np.ones(node.size), np.zeros((node.size, 3))
    common = rng.normal(0.0, 1.0, (node.size, TERMS))
    slopes = made.slopes_in_terms(node, peer, common, rng.normal(0.0, 1.0, node.size))
    made.update(Ranges(node, peer, measured, none[:, 0], ones, none[:, 0], none, slopes))
    terms, sigma = made.terms[:TERMS], made.sigma_of_terms()[:TERMS]
    made.own_sd = ()
    made.add(pose[5:].copy(), variance[None])
    assert made.terms.tolist() == terms.tolist()
    assert made.sigma_of_terms() == pytest.approx(sigma)
    assert made.own_terms(OwnTerm.DELAY)[0].size == 0
    made.update(plain(made, node, peer, measured))


def test_a_chain_of_strips_is_exact_where_the_ranges_form_one() -> None:
    rng = np.random.default_rng(2)
    pose = np.column_stack([rng.uniform(0, 60, 40), rng.uniform(0, 8, 40), rng.uniform(-3, 3, 40)])
    made, pose, covariance = started(pose, width_m=10.0)
    assert len(made._layout.sizes) >= 5
    node, peer = pairs_within(pose, 10.0)
    measured = np.hypot(*(pose[node, :2] - pose[peer, :2]).T) + rng.normal(0, SIGMA_M, node.size)
    made.update(plain(made, node, peer, measured))
    dense.update(pose, covariance, node, peer, measured, SIGMA_M)
    assert np.allclose(made.state, pose, atol=1e-7)
    assert np.allclose(covariance_of(made), covariance, atol=1e-9)


def test_time_passes_within_the_strips_as_in_the_dense_filter() -> None:
    rng = np.random.default_rng(3)
    pose = np.column_stack([rng.uniform(0, 30, 12), rng.uniform(0, 8, 12), rng.uniform(-3, 3, 12)])
    made, pose, covariance = started(pose, width_m=11.0)
    node, peer = pairs_within(pose, 11.0)
    measured = np.hypot(*(pose[node, :2] - pose[peer, :2]).T)
    made.update(plain(made, node, peer, measured))
    dense.update(pose, covariance, node, peer, measured, SIGMA_M)
    # Some nodes twice, some not at all: pieces of motion come as they come.
    who = np.array([0, 3, 3, 5, 7, 11, 0])
    moved = random_moves(rng, who.size)
    made.predict(who, moved)
    dense.advance(pose, covariance, who, moved)
    dense.wander(covariance, who, moved[:, 6])
    assert np.allclose(made.state, pose)
    got = made.pairs(node, peer)
    expected = dense.spread(pose, covariance, node, peer)
    assert np.allclose(got, expected, atol=1e-9)


def test_a_displacement_errs_along_its_way_more_than_across_it_and_takes_no_time_at_rest() -> None:
    rng = np.random.default_rng(5)
    moves, variances = rng.normal(size=(20, 4)), rng.uniform(size=(20, 3))
    moves[:2, :3] = 0.0
    moves[1, 2] = 0.1
    moved = displacements(moves, variances)
    forward, left = moves[:, :2].T
    way = np.maximum(np.hypot(forward, left), 1e-6)
    along = variances[:, 0]
    expected = np.sqrt(along * (forward**2 + 0.1 * left**2)) / way
    assert moved[:, 3] == pytest.approx(expected, rel=1e-12)
    assert moved[:, 4] == pytest.approx(np.sqrt(along * (left**2 + 0.1 * forward**2)) / way)
    assert moved[:, 5] == pytest.approx(np.sqrt(variances[:, 1] + variances[:, 2]), rel=1e-12)
    assert moved[:, 6].tolist() == [0.0, *moves[1:, 3]]
    assert (moved[:, :3] == moves[:, :3]).all()


def test_the_way_under_a_vague_heading_is_as_uncertain_across_as_along_it() -> None:
    made = NeighbourhoodFilter(math.inf)
    heading_rad, way_m = np.array([0.1, 0.7, 1.4, 1.8]), 5.0
    start = np.diag([0.0, 0.0, 1.0]) * heading_rad[:, None, None] ** 2
    made.add(np.zeros((4, 3)), start)
    made.predict(np.arange(4), np.tile([way_m, 0, 0, 0, 0, 0, 1.0], (4, 1)))
    along_m2, across_m2, *_ = made.marginals().T
    # The moments of cosine and sine of a normal angle.
    kept = np.exp(-(heading_rad**2))
    assert made.state[:, 0] == pytest.approx(way_m * np.sqrt(kept), rel=1e-6)
    assert along_m2 == pytest.approx(0.5 * (way_m * (1.0 - kept)) ** 2, abs=1e-6)
    assert across_m2 == pytest.approx(0.5 * way_m**2 * (1.0 - kept**2), rel=1e-3)


@pytest.mark.parametrize("known_m", [0.0, 1.0])
def test_a_range_as_far_off_as_it_is_known_to_err_is_no_outlier(known_m: float) -> None:
    made = NeighbourhoodFilter(math.inf, RangeModel(SIGMA_M, 0.05, 3.0))
    made.add(np.array([[0.0, 0, 0], [5.0, 0, 0]]), np.tile(1e-4 * np.eye(3), (2, 1, 1)))
    far = plain(made, np.array([0]), np.array([1]), np.array([6.5]))
    inlier = made.update(far._replace(variance_m2=np.array([known_m**2])))
    assert (inlier[0] > 0.8) == (known_m > 0.0)
    assert np.hypot(*(made.pose[1, :2] - made.pose[0, :2])) == pytest.approx(5.0, abs=0.01)


@pytest.mark.parametrize("steps_an_epoch", [1, 5])
def test_steps_under_one_heading_are_no_surer_than_the_way_at_once(steps_an_epoch: int) -> None:
    made, heading_rad, steps = NeighbourhoodFilter(math.inf), 0.35, 10
    made.add(np.zeros((1, 3)), np.diag([0.0, 0.0, heading_rad**2])[None])
    for _ in range(steps // steps_an_epoch):
        made.predict(np.zeros(steps_an_epoch, int), np.tile([1.0, *6 * [0]], (steps_an_epoch, 1)))
        along_m2, across_m2, *_ = made.marginals()[0]
    kept = math.exp(-(heading_rad**2))
    assert made.state[0, 0] == pytest.approx(steps * math.sqrt(kept), rel=1e-6)
    assert math.sqrt(along_m2) == pytest.approx(math.sqrt(0.5) * steps * (1.0 - kept), rel=0.05)
    assert math.sqrt(across_m2) == pytest.approx(math.sqrt(0.5 * (1.0 - kept**2)) * steps, rel=0.01)


@pytest.mark.parametrize(
    ("apart_m", "sigma_m", "true_m"), [(1.5, 0.4, 1.2), (3.0, 0.4, 2.8), (1.0, 0.2, 1.2)]
)
def test_a_range_from_above_tells_of_the_plane_what_the_grid_of_all_places_tells(
    apart_m: float, sigma_m: float, true_m: float
) -> None:
    height_m = 3.5
    measured_m = math.hypot(true_m, height_m)
    made = NeighbourhoodFilter(
        math.inf, RangeModel(SIGMA_M), terms_information=1e12 * np.eye(TERMS)
    )
    starts = np.array([np.zeros(3), [sigma_m**2, sigma_m**2, 0.01]])
    made.add(np.array([[0.0, 0.0, 0.0], [apart_m, 0.0, 0.0]]), starts[:, None] * np.eye(3))
    above = plain(made, np.array([0]), np.array([1]), np.array([measured_m]))
    made.update(above._replace(lift_m2=np.array([height_m**2])))
    # The posterior of the upper one's place, by brute force.
    off_m = np.linspace(-6.0 * sigma_m, 6.0 * sigma_m, 1201)
    x, y = apart_m + off_m[:, None], off_m
    misfit = (measured_m - np.sqrt(x**2 + y**2 + height_m**2)) / SIGMA_M
    density = np.exp(-0.5 * (((x - apart_m) ** 2 + y**2) / sigma_m**2 + misfit**2))
    weight = density.sum(axis=1) / density.sum()
    mean_m = weight @ x[:, 0]
    spread_m = math.sqrt(weight @ (x[:, 0] - mean_m) ** 2)
    assert made.pose[1, 0] == pytest.approx(mean_m, abs=0.1 * spread_m)
    # As a level distance the rest of the range left half of it.
    assert math.sqrt(made.marginals()[1, 0]) == pytest.approx(spread_m, rel=0.1)


def test_a_node_that_walks_into_the_next_strip_takes_its_covariance_along() -> None:
    rng = np.random.default_rng(4)
    pose = np.column_stack([rng.uniform(0, 60, 50), rng.uniform(0, 8, 50), rng.uniform(-3, 3, 50)])
    made, *_ = started(pose, width_m=10.0)
    node, peer = pairs_within(pose, 10.0)
    measured = np.hypot(*(pose[node, :2] - pose[peer, :2]).T)
    made.update(plain(made, node, peer, measured))
    before = covariance_of(made)
    strip = made._layout.strip
    for direction, at in ((1, 1), (-1, 3), (1, 3)):
        movers = np.flatnonzero(made._layout.strip == at)[:2]
        cell = made._cell.copy()
        cell[movers] += direction
        made._cut(cell, made._dense(3))
    assert (made._layout.strip != strip).sum() >= 2
    layout = made._layout
    close = np.abs(layout.strip[:, None] - layout.strip) <= 1
    kept = np.repeat(np.repeat(close, 5, axis=0), 5, axis=1)
    assert np.allclose(covariance_of(made)[kept], before[kept], atol=1e-12)


def play(crowd: Crowd) -> dict[str, float]:
    """Errors and NEES of pairs in reach, of the filter and of the dense one beside it."""
    count = crowd.settings.nodes
    made = NeighbourhoodFilter(crowd.settings.max_range_m, RangeModel(crowd.settings.sigma_range_m))
    made.add(crowd.poses[0].copy(), np.zeros((count, 3, 3)))
    pose, covariance = dense_start(crowd.poses[0], 5 * [0.0])
    everybody = np.arange(count)
    squares: dict[str, list[float]] = {"filter": [], "dense": [], "nees": [], "nees_all": []}
    one, two = np.triu_indices(count, 1)
    for t, motion in enumerate(crowd.motions, 1):
        moved = np.column_stack([motion, crowd.sigmas[t - 1], np.ones(count)])
        made.predict(everybody, moved)
        dense.advance(pose, covariance, everybody, moved)
        dense.wander(covariance, everybody, moved[:, 6])
        if t % crowd.settings.range_period_s:
            continue
        k = t // crowd.settings.range_period_s - 1
        at = slice(crowd.first[k], crowd.first[k + 1])
        node, peer, measured = crowd.node[at], crowd.peer[at], crowd.range_m[at]
        made.update(plain(made, node, peer, measured))
        truth = crowd.poses[t]

        def errors(of: Floats, a: Floats, b: Floats, truth: Floats = truth) -> Floats:
            off, real = of[a, :2] - of[b, :2], truth[a, :2] - truth[b, :2]
            return np.asarray(np.hypot(*off.T) - np.hypot(*real.T))

        squares["filter"].append(float(np.mean(errors(made.pose, node, peer) ** 2)))
        near = errors(made.pose, node, peer) ** 2 / made.pairs(node, peer)[1]
        squares["nees"].append(float(np.mean(near)))
        every = dense_spread_along(made, one, two)
        squares["nees_all"].append(float(np.mean(errors(made.pose, one, two) ** 2 / every)))
        dense.update(pose, covariance, node, peer, measured, crowd.settings.sigma_range_m)
        squares["dense"].append(float(np.mean(errors(pose, node, peer) ** 2)))
    return {
        "filter": float(np.sqrt(np.mean(squares["filter"]))),
        "dense": float(np.sqrt(np.mean(squares["dense"]))),
        "nees": float(np.mean(squares["nees"])),
        "nees_all": float(np.mean(squares["nees_all"])),
    }


def dense_spread_along(
    made: NeighbourhoodFilter, one: npt.NDArray[np.intp], two: npt.NDArray[np.intp]
) -> Floats:
    """Variance of every pair's distance, far pairs by the chain."""
    covariance = covariance_of(made)
    off = made.pose[two, :2] - made.pose[one, :2]
    u = off / np.hypot(*off.T)[:, None]
    total = np.zeros(one.size)
    for a, b, sign in ((one, one, 1), (two, two, 1), (one, two, -1), (two, one, -1)):
        for p in range(2):
            for q in range(2):
                total += sign * u[:, p] * u[:, q] * covariance[5 * a + p, 5 * b + q]
    return total


@pytest.mark.parametrize(
    ("nodes", "seconds", "seed"),
    [(60, 24, 11), pytest.param(90, 60, 12, marks=pytest.mark.soak)],
)
def test_in_a_crowd_it_is_within_a_tenth_of_the_dense_filter_and_honest(
    nodes: int, seconds: int, seed: int
) -> None:
    got = play(simulate_crowd(CrowdSettings(nodes=nodes, seconds=seconds), seed))
    assert got["filter"] < 1.10 * got["dense"]
    assert 0.8 < got["nees"] < 1.3
    assert 0.7 < got["nees_all"] < 1.4  # one run: far pairs share few errors


def test_far_pairs_come_from_the_chain_and_ranges_beyond_a_strip_are_taken() -> None:
    rng = np.random.default_rng(5)
    pose = np.column_stack([np.arange(8) * 10.0, rng.uniform(0, 3, 8), np.zeros(8)])
    made, *_ = started(pose, width_m=10.0)
    # 35 m reach over three strips: the strips have to give way, the range has to count.
    true = float(np.hypot(*(pose[0, :2] - pose[3, :2])))
    before = made.pairs(np.array([0]), np.array([3]))[1, 0]
    made.update(plain(made, np.array([0]), np.array([3]), np.array([true])))
    assert made.pairs(np.array([0]), np.array([3]))[1, 0] < 0.2 * before
    assert made.counters["strips_widened"] == 1


def test_a_crowd_has_the_neighbours_it_was_asked_for() -> None:
    crowd = simulate_crowd(CrowdSettings(nodes=300, seconds=40, neighbours=8), 3)
    epochs = len(crowd.first) - 1
    assert 2 * len(crowd.range_m) / (300 * epochs) == pytest.approx(8.0, rel=0.12)
    assert crowd.side_m == pytest.approx(side_of(300, 8, 15.0))
    assert np.array_equal(
        crowd.range_m, simulate_crowd(CrowdSettings(nodes=300, seconds=40), 3).range_m
    )
    steps = np.linalg.norm(np.diff(crowd.poses[:, :, :2], axis=0), axis=2)
    assert steps.max() <= 0.5 + 1e-9


@pytest.mark.parametrize(("width_m", "left_share"), [(100.0, 0.01), (10.0, 0.5)])
def test_the_teams_common_motion_is_kept_apart_and_told(width_m: float, left_share: float) -> None:
    """Far strips, whose covariance the chain infers anew, seem to contain some of it again."""
    rng = np.random.default_rng(6)
    pose = np.column_stack([rng.uniform(0, 60, 30), rng.uniform(0, 8, 30), rng.uniform(-3, 3, 30)])
    made, *_ = started(pose, width_m)
    node, peer = pairs_within(pose, 10.0)
    measured = np.hypot(*(pose[node, :2] - pose[peer, :2]).T)
    made.update(plain(made, node, peer, measured))
    made.predict(np.arange(30), random_moves(rng, 30))
    before, marginals, between = covariance_of(made), made.marginals(), made.pairs(node, peer)
    made.take_out_common_motion()
    # By its definition: shifts east and north and a turn about the origin, of every pose.
    motion = np.zeros((30, 5, 3))
    motion[:, [0, 1, 2], [0, 1, 2]] = 1.0
    motion[:, 0, 2], motion[:, 1, 2] = -made.pose[:, 1], made.pose[:, 0]
    g = motion.reshape(-1, 3)
    contained = np.linalg.inv(g.T @ np.linalg.solve(before, g))
    assert np.allclose(made.common, contained, rtol=1e-2, atol=1e-4)
    left = covariance_of(made)
    again = np.linalg.inv(g.T @ np.linalg.solve(left, g))
    assert again[2, 2] < left_share * contained[2, 2]
    layout = made._layout
    close = np.abs(layout.strip[:, None] - layout.strip) <= 1
    kept = np.repeat(np.repeat(close, 5, axis=0), 5, axis=1)
    assert np.allclose((left + g @ made.common @ g.T)[kept], before[kept], atol=1e-9)
    assert np.allclose(made.marginals() + made.common_marginals(), marginals, atol=1e-9)
    assert np.allclose(made.pairs(node, peer)[:2], between[:2], atol=1e-9)
