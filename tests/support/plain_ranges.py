"""Ranges of which nothing but their lengths is known, for tests of the bank's core."""

from __future__ import annotations

from typing import Any

import numpy as np

from relpos.fusion.models.ranging import Repeats


def plain_ranges(first: np.ndarray, second: np.ndarray, range_m: np.ndarray) -> tuple[Any, ...]:
    """What ``BankCore.update`` takes: on one level, of users who stand, like none before."""
    count = len(first)
    nought = np.zeros(count)
    repeats = Repeats(np.ones(count), nought)
    return (
        first, second, range_m, nought, nought, repeats, np.zeros((count, 4)), np.zeros((count, 3)),
    )  # fmt: skip
