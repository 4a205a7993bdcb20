"""The team's common rotation: what is taken out of the hypotheses, and what that does."""

from __future__ import annotations

import math

import numpy as np
import pytest

import relpos
from reference import bank as reference
from relpos.fusion.bank import common_rotation, hypothesis_set
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.storage import PER_NODE
from relpos.fusion.estimator_settings import BankSettings
from relpos.measurements import Prior

Floats = np.ndarray
NODES = 4


def team(hypotheses: int = 16, turned_rad: float = 0.2) -> BankCore:
    """A core whose hypotheses differ by a rigid motion, with full covariances."""
    core = BankCore(BankSettings(hypotheses=hypotheses, wrong_starts=0.0), 5)
    rng = np.random.default_rng(6)
    for place in rng.normal(size=(NODES, 2)) * 8.0 + 20.0:
        core.add_node((*place.tolist(), 0.3), 0.1, 0.1)
    these = core.hypotheses
    x, p = these.dense()
    for k in range(hypotheses):
        angle = turned_rad * rng.standard_normal()
        c, s = np.cos(angle), np.sin(angle)
        for n in range(NODES):
            at = PER_NODE * n
            x[k, at : at + 2] = np.array([[c, -s], [s, c]]) @ x[k, at : at + 2] + angle
            x[k, at + 2] += angle
        root = rng.normal(size=(x.shape[1], x.shape[1])) * 0.05
        model = p[k].diagonal() > 0.0
        p[k] += root @ root.T * np.outer(model, model)
        g = reference.rigid_motion(x[k], NODES, np.array([20.0, 20.0]))
        p[k] += g @ np.diag([0.04, 0.04, turned_rad**2 + 1e-3]) @ g.T
    these.store(x, p)
    return core


def test_distances_and_their_deviations_are_the_same_without_the_common_rotation() -> None:
    core = team(64, 0.05)
    pairs = np.array([0, 0, 1]), np.array([1, 3, 2]), np.zeros(3)
    before = core.predicted_ranges(*pairs)
    core.moments()
    after = core.predicted_ranges(*pairs)
    assert core.hypotheses.common[2, 2] > 0.05**2
    # To second order an arc is longer than its chord.
    assert after[0] == pytest.approx(before[0], abs=0.1)
    assert after[1] == pytest.approx(before[1], rel=0.1)


def test_hypotheses_that_differ_by_a_turn_of_the_team_agree_afterwards() -> None:
    core = team()
    for _ in range(3):  # Each takes out most of what is left.
        core.moments()
    x, _ = core.hypotheses.dense()
    poses = x[:, : PER_NODE * NODES].reshape(-1, NODES, PER_NODE)
    assert poses[:, :, 2].std(axis=0).max() < 1.5 * common_rotation.LEAST_RAD


def test_what_is_taken_out_is_the_largest_rigid_motion_that_a_covariance_contains() -> None:
    core = team(8, 0.0)
    these = core.hypotheses
    x, p = these.dense()
    mean, _ = these.moments()
    middle = mean[: PER_NODE * NODES].reshape(NODES, PER_NODE)[:, :2].mean(axis=0)
    core.moments()
    left = these.dense()[1]
    assert np.linalg.eigvalsh(left).min() > -1e-10
    for k in range(8):
        g = reference.rigid_motion(x[k], NODES, middle)
        regular = p[k] + np.diag(np.where(p[k].diagonal() > 0.0, 0.0, 1.0))
        s = np.linalg.inv(g.T @ np.linalg.solve(regular, g))
        s -= np.diag([common_rotation.LEFT[0]] * 2 + [common_rotation.LEFT[1]])
        assert left[k] == pytest.approx(p[k] - g @ s @ g.T, abs=1e-6)


@pytest.mark.parametrize("rounding", [1e-10, 1e-8])
def test_nothing_is_taken_out_of_a_covariance_that_rounding_has_spoiled(rounding: float) -> None:
    """Of a rigid motion alone, some kilometres wide, whose correlations are off by that much."""
    these = team(32).hypotheses
    x, p = these.dense()
    poses = (PER_NODE * np.arange(NODES)[:, None] + np.arange(3)).ravel()
    x[:, poses] *= 1e3
    rng = np.random.default_rng(1)
    for k in range(32):
        g = reference.rigid_motion(x[k], NODES, np.zeros(2))
        p[k] = g @ np.diag([1e6, 1e6, 10.0]) @ g.T
        sigmas = np.sqrt(p[k].diagonal())
        error = np.tril(rng.normal(size=p[k].shape) * rounding, -1)
        p[k] += (error + error.T) * np.outer(sigmas, sigmas)
    these.store(x, p)
    these.take_out_common_rotation()
    left = these.dense()[1]
    assert np.isfinite(left).all()
    assert (left.diagonal(axis1=1, axis2=2) >= 0.0).all()
    assert np.isfinite(these.arrays.sensitivity).all(), "it has no inverse, and projects nothing"


def test_the_mixtures_moments_are_kept_with_what_was_taken_out() -> None:
    core = team(64, 0.03)
    these = core.hypotheses
    mean, covariance = these.moments(poses_alone=True)
    now, rest, common = core.moments()
    poses = (PER_NODE * np.arange(NODES)[:, None] + np.arange(3)).ravel()
    assert now[poses] == pytest.approx(mean[poses], abs=0.02)
    both = np.ix_(poses, poses)
    assert (rest + common)[both] == pytest.approx(covariance[both], rel=0.02, abs=0.02)


def test_relative_moments_have_the_distances_and_no_rigid_motion() -> None:
    these = team(64, 0.03).hypotheses
    mean, covariance = these.moments(poses_alone=True)
    _, relative = these.relative_moments()
    poses = (PER_NODE * np.arange(NODES)[:, None] + np.arange(3)).ravel()
    assert np.linalg.eigvalsh(relative[np.ix_(poses, poses)]).min() > -1e-6
    assert np.trace(relative) < 0.5 * np.trace(covariance)
    slope = np.zeros(len(mean))
    off = mean[PER_NODE : PER_NODE + 2] - mean[:2]
    slope[PER_NODE : PER_NODE + 2], slope[:2] = off, -off
    assert slope @ relative @ slope == pytest.approx(slope @ covariance @ slope)


def test_an_absolute_heading_still_corrects_the_team() -> None:
    core = team()
    mean, covariance, common = core.moments()
    sigma_rad = float(np.sqrt((covariance + common)[2, 2]))
    for row in range(NODES):
        core.update_heading(row, float(mean[PER_NODE * row + 2]) + 0.2, 0.01)
    after, covariance, common = core.moments()
    assert sigma_rad > 0.2
    assert after[2] - mean[2] == pytest.approx(0.2, abs=0.05)
    assert np.sqrt((covariance + common)[2, 2]) < 0.5 * sigma_rad


@pytest.fixture(scope="module")
def errors_of_two() -> Floats:
    """Errors of two people's distance in twenty minutes: time (s), the pair's, the places' (m)."""
    run = relpos.simulate("mission-two-hour", 71, seconds=1200)
    true = {(t.time_s, t.node): np.array([t.x_m, t.y_m]) for t in run.truth}
    errors = []
    for e in relpos.fuse(run).estimates:
        at_s = float(round(e.time_s))
        if (at_s, 2) in true:
            true_m = np.linalg.norm(true[at_s, 1] - true[at_s, 2])
            first, second = e.nodes
            apart_m = math.hypot(second.x_m - first.x_m, second.y_m - first.y_m)
            errors.append((at_s, e.pairs[0].distance_m - true_m, apart_m - true_m))
    return np.array(errors)


@pytest.mark.parametrize("since_s", [0.0, 600.0])
def test_distances_of_two_people_do_not_shrink_in_twenty_minutes(
    errors_of_two: Floats, since_s: float
) -> None:
    time_s, pair_m, _ = errors_of_two.T
    # Chance is as great: .12 m, root mean square of twelve seeds.
    assert abs(pair_m[(time_s >= since_s) & (time_s < since_s + 600.0)].mean()) < 0.15


def test_places_of_two_people_are_as_far_apart_as_their_distance(errors_of_two: Floats) -> None:
    _, pair_m, places_m = errors_of_two.T
    assert np.sqrt((places_m**2).mean()) < 1.1 * np.sqrt((pair_m**2).mean())


def test_the_reported_deviations_in_the_worlds_frame_go_on_growing() -> None:
    estimates = relpos.fuse(relpos.simulate("mission-base", 72, seconds=200)).estimates
    first, last = (next(e for e in estimates if e.time_s > at_s) for at_s in (10.0, 190.0))
    assert last.nodes[0].sigma_heading_rad > 1.3 * first.nodes[0].sigma_heading_rad
    assert last.pairs[0].sigma_bearing_rad > 1.3 * first.pairs[0].sigma_bearing_rad


def test_one_node_alone_keeps_its_uncertainty() -> None:
    bank = relpos.fusion.make("bank", [Prior(1, 0.0, 0.0, 0.0, 0.5, 0.2)])
    core = bank.estimator.core.core  # type: ignore[attr-defined]
    _, covariance, common = core.moments()
    assert isinstance(core.hypotheses, hypothesis_set.HypothesisSet)
    assert covariance[2, 2] == pytest.approx(0.04)
    assert not common.any()
