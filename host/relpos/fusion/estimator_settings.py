"""What ``--set`` may change of each estimator; apart, so that help needs no kernels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from relpos.settings import setting


@dataclass(frozen=True, slots=True)
class BankSettings:
    """Of the bank; one set for all scenarios and recordings.

    The filter that replaces it in a large team has one hypothesis, and learns less: of these it
    uses ``scale``, ``drift_rad_s``, ``bias_m`` and ``pair_bias_m``, and the times at the end.
    """

    FORMER: ClassVar[Mapping[str, float]] = {
        "outliers_short": 0.1, "jump_m": 3.0, "jump_rad": 0.0, "jumps": 0.0
    }  # fmt: skip

    hypotheses: int = setting(200, "at most so many hypotheses (K)", 1, 100_000)
    sampled: float = setting(0.5, "share of the heading noise that is drawn", 0.0, 1.0)
    outliers: float = setting(0.1, "share of ranges that are outliers, beforehand", 0.0, 0.9)
    outlier_m: float = setting(3.0, "how far outliers are off, beforehand", 0.1, 100.0)
    jumps_most: float = setting(0.05, "share of jump hypotheses an instant, at most", 0.0, 1.0)
    wrong_starts: float = setting(0.1, "share of hypotheses that doubt the given starts", 0.0, 0.9)
    scale: float = setting(0.1, "prior standard deviation of the step scale", 0.0, 1.0)
    drift_rad_s: float = setting(0.005, "prior standard deviation of heading drift", 0.0, 1.0)
    constants: float = setting(0.5, "share of hypotheses with scale and drift", 0.0, 1.0)
    steady: float = setting(0.4, "share of hypotheses with steady headings", 0.0, 1.0)
    bias_m: float = setting(0.3, "prior standard deviation of the range bias", 0.0, 10.0)
    pair_bias_m: float = setting(
        0.1, "prior standard deviation of a pair's part, or of a tag's delay", 0.0, 10.0
    )
    biased: float = setting(0.5, "share of hypotheses with range biases", 0.0, 1.0)
    spread: float = setting(0.5, "spread of the hypotheses' levels of noise", 0.0, 3.0)
    max_lag_s: float = setting(2.5, "how long a silent node is waited for", 0.0, 60.0)
    reorder_s: float = setting(0.3, "how long everything waits for what is under way", 0.0, 60.0)
    late_s: float = setting(5.0, "how late measurements may be put in their place", 0.0, 60.0)


@dataclass(frozen=True, slots=True)
class ParticleSettings:
    """Of the particle filter; the defaults are the paper's."""

    particles: int = setting(500, "particles per node (M)", 10, 1_000_000)
    alpha: float = setting(
        0.01, "fraction of dual particles; 0 switches the dual step off", 0.0, 0.9
    )
    sigma_r_m: float = setting(2.0, "standard deviation of a range", 1e-3, 100.0)
    sigma_d: float = setting(0.2, "relative standard deviation of a displacement", 0.0, 10.0)
    sigma_theta: float = setting(0.1, "relative standard deviation of a turn", 0.0, 10.0)
    floor_d_m: float = setting(0.0, "least displacement noise, m/sqrt(s)", 0.0, 10.0)
    floor_theta_rad: float = setting(0.0, "least heading noise, rad/sqrt(s)", 0.0, 10.0)
    outliers: float = setting(0.0, "fraction of ranges that are outliers", 0.0, 0.9)
    max_lag_s: float = setting(5.0, "how long a silent node is waited for", 0.0, 60.0)
    reorder_s: float = setting(0.5, "how long measurements may be out of order", 0.0, 60.0)


@dataclass(frozen=True, slots=True)
class DeadReckoningSettings:
    """Of dead reckoning alone."""

    max_lag_s: float = setting(5.0, "how long a silent node is waited for", 0.0, 60.0)
    reorder_s: float = setting(0.5, "how long measurements may be out of order", 0.0, 60.0)


SETTINGS: Mapping[str, type] = {
    "bank": BankSettings,
    "particle": ParticleSettings,
    "deadreckoning": DeadReckoningSettings,
}
"""Estimator name -> its settings."""
