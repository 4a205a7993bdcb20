"""Settings of the particle filter, apart from its kernels: help texts stay quick."""

from __future__ import annotations

from dataclasses import dataclass

from relpos.fusion.settings import setting


@dataclass(frozen=True, slots=True)
class ParticleSettings:
    """What ``--set`` may change; the defaults are the paper's."""

    particles: int = setting(500, "particles per node (M)", 10, 1_000_000)
    alpha: float = setting(0.01, "share of dual particles; 0 switches the dual step off", 0.0, 0.9)
    sigma_r_m: float = setting(2.0, "standard deviation of a range", 1e-3, 100.0)
    sigma_d: float = setting(0.2, "relative standard deviation of a displacement", 0.0, 10.0)
    sigma_theta: float = setting(0.1, "relative standard deviation of a turn", 0.0, 10.0)
    floor_d_m: float = setting(0.0, "least displacement noise, m/sqrt(s)", 0.0, 10.0)
    floor_theta_rad: float = setting(0.0, "least heading noise, rad/sqrt(s)", 0.0, 10.0)
    outliers: float = setting(0.0, "share of ranges that tell nothing", 0.0, 0.9)
    start_particles: int = setting(
        20_000, "particles of a node whose start is unknown", 100, 10_000_000
    )
    start_sigma_r_m: float = setting(
        0.5, "standard deviation of a range while a start is unknown", 1e-3, 100.0
    )
    start_outliers: float = setting(0.05, "outlier share while a start is unknown", 0.0, 0.9)
    start_sigma_d: float = setting(
        0.2, "relative displacement noise while a start is unknown", 0.0, 10.0
    )
    start_sigma_theta: float = setting(
        0.1, "relative turn noise while a start is unknown", 0.0, 10.0
    )
    start_floor_d_m: float = setting(
        0.02, "least displacement noise while a start is unknown, m/sqrt(s)", 0.0, 10.0
    )
    start_floor_theta_rad: float = setting(
        0.0175, "least heading noise while a start is unknown, rad/sqrt(s)", 0.0, 10.0
    )
    resolved_m: float = setting(
        0.7, "a start counts as found when its spread is less, m", 1e-3, 100.0
    )
    resolved_rad: float = setting(
        0.5, "a start counts as found when its heading's spread is less, rad", 1e-3, 3.0
    )
    resolved_epochs: int = setting(5, "for so many epochs in a row", 1, 1000)
    max_lag_s: float = setting(5.0, "how long a silent node is waited for", 0.0, 60.0)
    reorder_s: float = setting(0.5, "how long measurements may be out of order", 0.0, 60.0)
