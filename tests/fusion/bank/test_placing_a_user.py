"""Users are put in place within the storage; here by matrices instead."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from relpos.fusion.bank.hypothesis_set import HypothesisSet
from relpos.fusion.bank.storage import PER_NODE
from relpos.fusion.estimator_settings import BankSettings

HYPOTHESES = 12
"""One block and a half, so that some lanes stand for no hypothesis."""


@pytest.fixture
def correlated() -> HypothesisSet:
    """Four users, everything correlated with everything."""
    rng = np.random.default_rng(5)
    settings = BankSettings(hypotheses=HYPOTHESES)
    these = HypothesisSet(settings, np.random.default_rng(1), Counter())
    for k in range(4):
        these.add_node((2.0 * k, 1.0, 0.1 * k), 0.3, 0.1)
    x, _ = these.dense()
    root = rng.standard_normal((*x.shape, x.shape[1]))
    these.store(x + rng.standard_normal(x.shape), root @ root.transpose(0, 2, 1))
    return these


def test_users_placed_beside_another_share_its_error_and_nothing_else(
    correlated: HypothesisSet,
) -> None:
    _, before = correlated.dense()
    rng = np.random.default_rng(2)
    root = rng.standard_normal((1, 6, 6))
    own = root @ root.transpose(0, 2, 1)
    correlated.place(np.array([0, 2]), rng.standard_normal((1, 2, 3)), own, np.zeros(1), beside=3)
    _, after = correlated.dense()
    size = before.shape[1]
    # A placed user is at the place of user 3, plus what the search says: e = e_3 + e_own.
    errors = np.eye(size)
    placed = [PER_NODE * row + entry for row in (0, 2) for entry in range(3)]
    for at in placed:
        errors[at] = 0.0
    for row in (0, 2):
        for entry in range(2):
            errors[PER_NODE * row + entry, PER_NODE * 3 + entry] = 1.0
    expected = errors @ before @ errors.T
    expected[np.ix_(range(HYPOTHESES), placed, placed)] += own
    np.testing.assert_allclose(after, expected, rtol=1e-12, atol=1e-12)


def test_no_lane_of_a_placed_user_holds_an_impossible_covariance(
    correlated: HypothesisSet,
) -> None:
    correlated.place(np.array([1]), np.zeros((1, 1, 3)), np.eye(3)[None], np.zeros(1), beside=0)
    correlated.split_heading(2, 1.0)
    lanes = correlated.arrays.p.shape[0] * correlated.arrays.p.shape[2]
    correlated.count = lanes
    _, p = correlated.dense()
    assert np.linalg.eigvalsh(p).min() > -1e-9


def test_who_is_sought_again_is_independent_of_everybody_in_those_hypotheses_alone(
    correlated: HypothesisSet,
) -> None:
    _, before = correlated.dense()
    which, places = np.array([1, 9]), np.array([3, 4])  # user 1: x, y
    correlated.decorrelate(places, np.tile(4.0 * np.eye(2), (2, 1, 1)), which)
    _, after = correlated.dense()
    own = [PER_NODE, PER_NODE + 1]
    others = np.delete(np.arange(before.shape[1]), own)
    untouched = np.delete(np.arange(HYPOTHESES), which)
    np.testing.assert_array_equal(after[untouched], before[untouched])
    np.testing.assert_array_equal(after[:, others][:, :, others], before[:, others][:, :, others])
    assert not after[which][:, own][:, :, others].any()
    np.testing.assert_array_equal(
        after[np.ix_(which, own, own)], np.tile(4.0 * np.eye(2), (2, 1, 1))
    )
