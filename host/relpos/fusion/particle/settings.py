"""Settings of the particle filter, in a module that loads no kernels: help texts stay quick."""

from __future__ import annotations

from dataclasses import dataclass

from relpos.fusion.settings import setting


@dataclass(frozen=True, slots=True)
class ParticleSettings:
    """What ``--set`` can change; the defaults are the paper's."""

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
