"""Eight numbers at once are what one number at a time is."""

from __future__ import annotations

import numpy as np
import pytest

from relpos.fusion.bank import lanes
from relpos.fusion.compiled import compiled

Floats = np.ndarray
ROWS = 500


@compiled
def functions(x: Floats, table: Floats, out: Floats) -> float:
    total = 0.0
    for row in range(x.shape[0]):
        value = lanes.load(x, row)
        positive = lanes.greater(value * value, lanes.fill(1e-300))
        cosine, sine = lanes.cos_sin(value)
        index = lanes.lesser(positive, lanes.fill(6.0))
        results = (
            lanes.exp(value), lanes.log(positive), cosine, sine, lanes.sqrt(positive),
            lanes.floor(value), lanes.look_up(table, index),
            lanes.select(value < 1.0, 2.0 - value, value / 3.0),
        )  # fmt: skip
        for k, result in enumerate(results):
            lanes.store(out, row * 8 + k, result)
        total += lanes.total(value) if lanes.some(value > 0.0) else 0.0
    return total


def test_functions_of_eight_are_those_of_one() -> None:
    rng = np.random.default_rng(0)
    x = lanes.empty_lines(ROWS)
    x[...] = rng.normal(size=x.shape) * rng.choice([0.01, 1.0, 30.0], size=(ROWS, 1))
    x[0], x[1] = -800.0, 0.0
    table = rng.normal(size=7)
    out = lanes.empty_lines(ROWS, 8)
    total = functions(x, table, out)
    square = np.maximum(x * x, 1e-300)
    expected = (
        np.exp(x), np.log(square), np.cos(x), np.sin(x), np.sqrt(square), np.floor(x),
        table[np.minimum(square, 6.0).astype(int)], np.where(x < 1, 2.0 - x, x / 3.0),
    )  # fmt: skip
    for k, values in enumerate(expected):
        assert out[:, k] == pytest.approx(values, rel=1e-12, abs=1e-12), k
    assert total == pytest.approx(x[(x > 0.0).any(axis=1)].sum(), rel=1e-12)
    assert (out[0, 0] == 0.0).all()


def test_lines_begin_at_lines_of_the_cache() -> None:
    for shape in ((1,), (3, 5), (7, 2, 3)):
        lines = lanes.empty_lines(*shape)
        assert lines.shape == (*shape, lanes.LANES)
        assert lines.ctypes.data % 64 == 0
