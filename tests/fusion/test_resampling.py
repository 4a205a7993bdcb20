"""Systematic resampling."""

from __future__ import annotations

import numpy as np
import pytest

from relpos.fusion.resampling import systematic


def test_every_index_is_drawn_floor_or_ceil_of_its_expected_count_in_order() -> None:
    rng = np.random.default_rng(1)
    weight = np.array([0.05, 0.0, 0.5, 0.3, 0.15])
    for count in (1, 7, 40):
        drawn = systematic(3.0 * weight, count, rng)
        assert (np.diff(drawn) >= 0).all()
        assert np.abs(np.bincount(drawn, minlength=5) - count * weight).max() < 1.0


def test_systematic_resampling_is_unbiased() -> None:
    rng = np.random.default_rng(3)
    weight = np.array([0.5, 0.3, 0.15, 0.05, 0.0])
    times = sum(np.bincount(systematic(weight, 5, rng), minlength=5) for _ in range(4000))
    assert times / 20_000 == pytest.approx(weight, abs=0.012)


def test_nothing_is_drawn_where_nothing_is_asked_for() -> None:
    assert systematic(np.ones(3), 0, np.random.default_rng(0)).size == 0
