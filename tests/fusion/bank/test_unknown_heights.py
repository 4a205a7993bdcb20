"""People on several floors of whom nobody reports a height."""

from __future__ import annotations

import numpy as np
import pytest

import relpos
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.hypothesis_models import RangeErrors
from relpos.fusion.bank.storage import PER_NODE
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.models.ranging import CommonIndex


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
    last = two_floors[1].estimates[-1].parameters
    learned = {(p.node, p.peer): p for p in last if p.name == "height_difference_m"}
    assert len(learned) == 15
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
        core.update(*pair, np.array([np.hypot(6.0, true_m)]), np.zeros(1))
    these = core.hypotheses
    entry, x = these.biases[0, 1], these.dense()[0]
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
    these.bias_entries(np.array([0]), np.array([1]))
    these.know_heights()
    assert not these.arrays.has_heights.any()
    entry, common = these.biases[0, 1], these.common_entry(CommonIndex.BIAS)
    _, p = these.dense()
    s = these.settings
    assert p[:, entry, entry] == pytest.approx(s.bias_m**2 + s.pair_bias_m**2)
    assert p[:, entry, common] == pytest.approx(s.bias_m**2)


def test_on_one_floor_heights_are_given_up() -> None:
    result = relpos.fuse(relpos.simulate("mission-base", 85, seconds=40))
    told = {p.name for p in result.estimates[-1].parameters if p.peer is not None}
    assert told == {"range_bias_m"}
