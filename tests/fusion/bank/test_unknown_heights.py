"""People on several floors of whom nobody reports a height."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

import relpos
from relpos import tracks
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.hypothesis_models import RangeErrors
from relpos.fusion.bank.storage import PER_NODE
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.models.ranging import CommonIndex
from relpos.measurements import Measurement, Range
from support.plain_ranges import plain_ranges


@pytest.fixture(scope="module")
def two_floors() -> tuple[relpos.Run, relpos.Result]:
    run = relpos.simulate("mission-floors-no-heights", 83, seconds=150)
    return run, relpos.fuse(run)


def test_on_two_floors_without_heights_distances_are_as_good_as_on_one(
    two_floors: tuple[relpos.Run, relpos.Result],
) -> None:
    run, result = two_floors
    metrics = relpos.evaluate(result, run, bound=False).metrics
    assert metrics.relative_distance_rmse_m < 0.17
    assert metrics.nees_distance < 1.4
    assert metrics.ok_over_3_sigma < 0.015


def test_a_difference_of_height_is_reported_to_half_a_metre(
    two_floors: tuple[relpos.Run, relpos.Result],
) -> None:
    _check_heights_told(two_floors[1], pairs=15)


def _check_heights_told(result: relpos.Result, pairs: int) -> None:
    """Every other one is 3 m up."""
    last = result.estimates[-1].parameters
    learned = {(p.node, p.peer): p for p in last if p.name == "height_difference_m"}
    assert len(learned) == pairs
    for (node, peer), p in learned.items():
        true_m = 3.0 if peer is not None and (node - peer) % 2 else 0.0
        # Of the same floor the square is about 0, and its root is not known well.
        assert p.value == pytest.approx(true_m, abs=0.5 if true_m else 1.0)
        assert abs(p.value - true_m) < 4.0 * p.sigma


@pytest.mark.parametrize("true_m", [0.0, 3.0])
def test_a_pairs_height_is_learned_from_its_ranges_alone(true_m: float) -> None:
    core = BankCore(BankSettings(hypotheses=16, biased=1.0, constants=0.0, wrong_starts=0.0), 3)
    for x_m in (0.0, 6.0):
        core.add_node((x_m, 0.0, 0.0), 0.05, 0.05)
    pair = np.array([0]), np.array([1])
    for _ in range(8):
        core.update(*plain_ranges(*pair, np.array([np.hypot(6.0, true_m)])))
    these = core.hypotheses
    entry, x = these.biases.pairs[0, 1], these.dense()[0]
    own = these.models.range_errors == RangeErrors.HEIGHT
    assert 0 < own.sum() < len(own)
    # What is common to all ranges may be a part of it.
    common = x[own, PER_NODE * 2 + CommonIndex.BIAS]
    expected = np.hypot(6.0, true_m) - common
    assert np.sqrt(36.0 + x[own, entry]) == pytest.approx(expected, abs=0.1)


def test_where_heights_are_reported_no_hypothesis_leaves_them_open() -> None:
    core = BankCore(BankSettings(hypotheses=16, biased=1.0), 3)
    for x_m in (0.0, 6.0):
        core.add_node((x_m, 0.0, 0.0), 0.05, 0.05)
    these = core.hypotheses
    these.biases.entries(np.array([0]), np.array([1]))
    these.biases.know_heights()
    assert not these.arrays.has_heights.any()
    entry, common = these.biases.pairs[0, 1], these.common_entry(CommonIndex.BIAS)
    _, p = these.dense()
    s = these.settings
    assert p[:, entry, entry] == pytest.approx(s.bias_m**2 + s.pair_bias_m**2)
    assert p[:, entry, common] == pytest.approx(s.bias_m**2)


def test_on_one_floor_heights_are_given_up() -> None:
    result = relpos.fuse(relpos.simulate("mission-base", 85, seconds=40))
    told = {p.name for p in result.estimates[-1].parameters if p.peer is not None}
    assert told == {"range_bias_m"}


EIGHT = {"nodes": 8, "seconds": 150}


def test_a_team_of_eight_on_two_floors_without_heights_is_as_good_as_on_one() -> None:
    run = relpos.simulate("mission-floors-no-heights", 83, **EIGHT)
    result = relpos.fuse(run)
    metrics = relpos.evaluate(result, run, bound=False).metrics
    assert metrics.relative_distance_rmse_m < 0.17
    assert metrics.nees_distance < 1.4
    assert metrics.ok_over_3_sigma < 0.015
    assert "antenna_delay_m" not in {p.name for p in result.estimates[-1].parameters}
    _check_heights_told(result, pairs=28)


def test_in_a_team_of_eight_those_who_take_the_stairs_are_followed() -> None:
    run = relpos.simulate("mission-base", 84, **EIGHT)
    truth = tracks.true_tracks(run.truth)

    def height_m(node: int, time_s: float) -> float:
        storeys = node % 3 + (min(max(time_s / 10.0 - 7.0, 0.0), 1.0) if node % 4 == 0 else 0.0)
        return 3.0 * storeys

    def slanted(m: Measurement) -> Measurement:
        if not isinstance(m, Range) or m.range_m <= 0.0:
            return m
        ends = [
            [np.interp(m.time_s, truth[n].time_s, axis) for axis in (truth[n].x_m, truth[n].y_m)]
            for n in (m.node, m.peer)
        ]
        apart_m = math.dist(*ends)
        rise_m = height_m(m.node, m.time_s) - height_m(m.peer, m.time_s)
        return replace(m, range_m=m.range_m + math.hypot(apart_m, rise_m) - apart_m)

    lifted = replace(run, measurements=tuple(slanted(m) for m in run.measurements))
    metrics = relpos.evaluate(relpos.fuse(lifted), run, bound=False).metrics
    # 0.72 m and NEES 5.2 without heights.
    assert metrics.relative_distance_rmse_m < 0.25
    assert metrics.nees_distance < 1.4
    assert metrics.ok_over_3_sigma < 0.015


def test_a_range_between_unknown_heights_corrects_as_a_million_samples_do() -> None:
    settings = BankSettings(hypotheses=8, wrong_starts=0.0, biased=1.0, constants=0.0, outliers=0.0)
    core = BankCore(settings, 5)
    for n in range(7):
        core.add_node((3.0 * n, 4.0 * n * n, 0.5 * n), 0.3, 0.1)
    these = core.hypotheses
    _, *heights = these.biases.entries(np.array([1]), np.array([0]))[0].tolist()
    k = int(np.flatnonzero(these.models.range_errors == RangeErrors.HEIGHT)[0])
    x, p = these.dense()
    x[:, heights], p[:, heights, heights] = (1.0, 4.0), (0.3, 0.2)
    # What all have in common is another test's; without any, nothing of it is modelled.
    others = np.setdiff1d(np.arange(PER_NODE * 7, x.shape[1]), heights)
    x[:, others] = 0.0
    p[:, others], p[:, :, others] = 0.0, 0.0
    p[:, others[0], others[0]] = 1e-9
    these.store(x, p)
    variance = float(these.arrays.range_variance.ravel()[k])
    rng = np.random.default_rng(0)
    of = [PER_NODE, PER_NODE + 1, 0, 1, *heights]
    drawn = rng.multivariate_normal(x[k, of], p[k][np.ix_(of, of)], 1_000_000)
    ranges = np.sqrt(
        (drawn[:, 0] - drawn[:, 2]) ** 2
        + (drawn[:, 1] - drawn[:, 3]) ** 2
        + (drawn[:, 4] - drawn[:, 5]) ** 2
    )
    both = np.cov(np.column_stack([drawn, ranges]).T)
    gain = both[:-1, -1] / (both[-1, -1] + variance)
    measured_m = ranges.mean() + 0.5
    core.update(*plain_ranges(np.array([1]), np.array([0]), np.array([measured_m])))
    after_x, after_p = these.dense()
    assert after_x[k, of] - x[k, of] == pytest.approx(0.5 * gain, rel=0.05)
    shrunk = both[:-1, :-1] - np.outer(gain, both[:-1, -1])
    assert after_p[k][np.ix_(of, of)] == pytest.approx(shrunk, abs=4e-3)


def test_a_crowd_side_by_side_is_not_taken_for_a_steep_one() -> None:
    run = relpos.simulate("mission-two-abreast", 4400, nodes=10, seconds=100)
    metrics = relpos.evaluate(relpos.fuse(run), run, bound=False).metrics
    # 1.6 m and NEES 9 where heights are believed though no distance changes.
    assert metrics.relative_distance_rmse_m < 0.5
    assert metrics.nees_distance < 1.5
    assert metrics.ok_over_3_sigma < 0.015


def test_hypotheses_agree_on_who_is_above_before_they_are_merged_and_go_on_alike() -> None:
    core = BankCore(BankSettings(hypotheses=16, wrong_starts=0.0, biased=1.0, constants=0.0), 7)
    for n in range(7):
        core.add_node((3.0 * n, 4.0 * n * n, 0.5 * n), 0.3, 0.1)
    first, second = np.triu_indices(7, 1)
    range_m = np.hypot(3.0 * (second - first), 4.0 * (second**2 - first**2))
    core.update(*plain_ranges(first, second, range_m + 0.1))
    plain = deepcopy(core)
    these = core.hypotheses
    own = these.models.range_errors == RangeErrors.HEIGHT

    def heights() -> np.ndarray:
        above = these.dense()[0][own][:, list(these.biases.users.values())]
        return above - above.mean(axis=1, keepdims=True)

    best = these.weights()[own].argmax()
    assert (heights() @ heights()[best] < 0.0).any()
    these.biases.mirror_heights()
    assert (heights() @ heights()[best] > 0.0).all()
    for one in (core, plain):
        one.update(*plain_ranges(first, second, range_m - 0.1))
    (x, p), (plain_x, plain_p) = these.dense(), plain.hypotheses.dense()
    poses = slice(0, PER_NODE * 7)
    assert x[:, poses] == pytest.approx(plain_x[:, poses])
    assert p[:, poses, poses] == pytest.approx(plain_p[:, poses, poses])
