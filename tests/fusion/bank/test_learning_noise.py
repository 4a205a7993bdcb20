"""What the innovations of one instant teach of the noise."""

from __future__ import annotations

import math
from copy import deepcopy
from itertools import combinations

import numpy as np
import pytest

from relpos.fusion.bank.core import BankCore
from relpos.fusion.estimator_settings import BankSettings
from support.plain_ranges import plain_ranges

SIGMA_M = 0.1
"""Of the ranges; a bank begins with 0.3."""


def ring(users: int) -> tuple[BankCore, np.ndarray]:
    """Users whose places are known exactly, 5 m from each other and more."""
    core = BankCore(BankSettings(), seed=3)
    angles = 2.0 * math.pi * np.arange(users) / users
    places = 5.0 * users / (2.0 * math.pi) * np.stack([np.cos(angles), np.sin(angles)], 1)
    for x_m, y_m in places:
        core.add_node((x_m, y_m, 0.0), 1e-3, 1e-3)
    return core, places


@pytest.mark.parametrize("users", [5, 10, 20])
def test_all_ranges_of_an_instant_together_teach_what_their_noise_is(users: int) -> None:
    learned = []
    unranged, places = ring(users)
    for seed in range(5):
        core = deepcopy(unranged)
        first, second = np.array(list(combinations(range(users), 2))).T.copy()
        distances = np.linalg.norm(places[first] - places[second], axis=1)
        noise = SIGMA_M * np.random.default_rng(seed).standard_normal(len(first))
        core.update(*plain_ranges(first, second, distances + noise))
        learned.append(0.5 * math.log(core.range_variance_m2 / SIGMA_M**2))
    # Of few ranges the 0.3 m that a bank begins with is left in it.
    assert -0.2 < np.mean(learned) < 0.45


def test_ranges_teach_the_same_in_one_instant_as_in_many() -> None:
    users = 10
    first, second = np.array(list(combinations(range(users), 2))).T.copy()
    noise = SIGMA_M * np.random.default_rng(1).standard_normal(len(first))
    together, places = ring(users)
    single, _ = ring(users)
    range_m = np.linalg.norm(places[first] - places[second], axis=1) + noise
    together.update(*plain_ranges(first, second, range_m))
    for k in range(len(first)):
        one = slice(k, k + 1)
        single.update(*plain_ranges(first[one], second[one], range_m[one]))
    ratio = math.sqrt(together.range_variance_m2 / single.range_variance_m2)
    assert 0.75 < ratio < 1.33
