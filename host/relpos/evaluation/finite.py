"""Means of what is finite; NaN where nothing is."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def mean(values: Floats) -> float:
    """Mean of the values, of any shape."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else math.nan


def root_mean(squares: Floats) -> float:
    """Root of their mean."""
    return math.sqrt(mean(squares)) if np.isfinite(squares).any() else math.nan


def mean_of_rows(values: Floats) -> Floats:
    """Mean of each row, (T, P) -> (T,)."""
    count = np.isfinite(values).sum(axis=1)
    total = np.where(np.isfinite(values), values, 0.0).sum(axis=1)
    means: Floats = np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)
    return means


def median(values: Floats) -> float:
    """Median of the values."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan
