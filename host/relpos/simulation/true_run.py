"""The true paths of a simulated run with the noise levels of its measurements."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from relpos.measurements import Range
from relpos.settings import parse
from relpos.simulation.lab import LabSettings, simulate_lab
from relpos.simulation.paper import (
    PaperSettings,
    SimulatedRun,
    Start,
    by_user,
    settings_of,
    simulate_paper,
    true_poses,
)
from relpos.simulation.scenarios import LAB

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TrueRun:
    """A simulated run without errors, and the noise levels of its measurements.

    The Cramer-Rao bound (:mod:`relpos.evaluation.bounds`) is computed from it.

    N nodes on a common grid of T times; K = T - 1 chords; M ranges. Noise levels are standard
    deviations of independent Gaussian errors.
    """

    time_s: Floats
    """(T,), increasing."""
    position_m: Floats
    """(N, T, 2) true positions."""
    along: Floats
    """(N, K) relative error of a chord's reported length."""
    turn_rad: Floats
    """(N, K) error of a chord's reported turn, which turns the chord too."""
    sigma_m: Floats
    """(N, K) error of a chord in x and in y that no report contains, as of a carried node."""
    range_time_s: Floats
    """(M,) times of the measured ranges."""
    range_nodes: Integers
    """(M, 2) indices of the two nodes of each."""
    range_information: Floats
    """(M,) Fisher information about the distance, 1/m^2: 1/sigma^2 for Gaussian noise."""
    start_m: Floats = field(default_factory=lambda: np.zeros(0))
    """(N,) standard deviation of the known start in x and in y; 0 exactly known, inf unknown."""
    start_rad: Floats = field(default_factory=lambda: np.zeros(0))
    """(N,) the same of the heading."""
    drift_rad_s: Floats = field(default_factory=lambda: np.zeros(0))
    """(N,) spread of the hidden constant error of the reported turn rate; 0 where there is none."""
    log_scale: Floats = field(default_factory=lambda: np.zeros(0))
    """(N,) spread of the hidden constant logarithm of true over reported length."""
    walked_m: Floats = field(default_factory=lambda: np.zeros(0))
    """(N, K, 2) true chords that the reports are of, in world axes; without it, the differences
    of the positions."""
    drifting_s: Floats = field(default_factory=lambda: np.zeros(0))
    """(N, K) how long of each chord the drift acts; without it, the chord's duration."""

    def __post_init__(self) -> None:
        """Fill in what was not given with zeros and check the shapes."""
        count, times = self.position_m.shape[:2]
        for name in ("start_m", "start_rad", "drift_rad_s", "log_scale"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if not value.size:
                value = np.zeros(count)
            if value.shape != (count,):
                raise ValueError(f"{name} needs one value a node, not the shape {value.shape}")
            object.__setattr__(self, name, value)
        if not self.walked_m.size:
            object.__setattr__(self, "walked_m", np.diff(self.position_m, axis=1))
        if not self.drifting_s.size:
            lasting = np.broadcast_to(np.diff(self.time_s), self.along.shape)
            object.__setattr__(self, "drifting_s", lasting)
        if self.walked_m.shape != (count, times - 1, 2):
            raise ValueError(f"walked_m needs the shape {(count, times - 1, 2)}")
        if self.drifting_s.shape != (count, times - 1):
            raise ValueError(f"drifting_s needs the shape {(count, times - 1)}")
        shapes = {self.along.shape, self.turn_rad.shape, self.sigma_m.shape}
        if shapes != {(count, times - 1)}:
            raise ValueError(f"the motion noise needs the shape {(count, times - 1)}, not {shapes}")
        if self.time_s.shape != (times,) or (np.diff(self.time_s) <= 0.0).any():
            raise ValueError("the times have to increase, one for each true position")
        ranges = self.range_time_s.shape
        if self.range_nodes.shape != (*ranges, 2) or self.range_information.shape != ranges:
            raise ValueError("ranges need one time, two nodes and one information each")


def simulate_true_run(
    scenario: str, seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> TrueRun:
    """Simulate a run of any scenario and return it without its errors."""
    if scenario == LAB:
        return of_lab(seed, overrides)
    run = simulate_paper(scenario, seed, overrides)
    return of_paper(settings_of(scenario, overrides), run)


def of_paper(settings: PaperSettings, run: SimulatedRun) -> TrueRun:
    """Describe a run of the paper's simulation as its bound sees it: nodes are numbered from 1.

    What only some runs have is taken at its true spread, as if it were known: a shifted start
    is known to ``start_shift_m / sqrt(2)`` in x and y, a kidnapped user to as much of the path
    carried, the noisy user is known as such, and a range of which a fraction is too long has the
    information of that mixture.
    """
    times, walked, heading = true_poses(settings)
    turn, chord = np.diff(heading, axis=1), np.diff(walked, axis=1)
    moving = np.linalg.norm(chord, axis=-1) > 0.0
    everyone = np.ones(settings.nodes)
    hidden, positions, sigma_m = run.hidden, walked.copy(), np.zeros(moving.shape)
    if hidden.kidnapped_node is not None:
        row, when = hidden.kidnapped_node - 1, int(np.searchsorted(times, settings.kidnap_s - 1e-9))
        positions[row] = [(t.x_m, t.y_m) for t in run.truth if t.node == hidden.kidnapped_node]
        sigma_m[row, max(when, 1) - 1] = settings.kidnap_m / math.sqrt(2.0)
    position_known = settings.start in (Start.KNOWN, Start.POSITION)
    heading_known = settings.start in (Start.KNOWN, Start.HEADING)
    kept = [m for m in run.measurements if isinstance(m, Range) and 0.0 < m.time_s <= times[-1]]
    return TrueRun(
        times,
        positions,
        by_user(hidden.distance_noise) * moving,
        np.hypot(
            turn * by_user(hidden.turn_noise),
            by_user(hidden.white_heading_rad) * moving,
        ),
        sigma_m,
        np.array([r.time_s for r in kept]),
        np.array([(r.node - 1, r.peer - 1) for r in kept], dtype=np.int64).reshape(-1, 2),
        np.full(len(kept), _range_information(settings)),
        start_m=everyone * (settings.start_shift_m / math.sqrt(2.0) if position_known else np.inf),
        start_rad=everyone * (0.0 if heading_known else np.inf),
        drift_rad_s=everyone * math.radians(settings.heading_drift_deg_s),
        log_scale=everyone * settings.scale_error,
        walked_m=chord,
        drifting_s=np.diff(times) * (moving | bool(settings.drift_while_waiting)),
    )


def of_lab(seed: int, overrides: Mapping[str, str | float] | None = None) -> TrueRun:
    """Describe a run of the laboratory as its bound sees it.

    Obstructions of each range are known; the delays and which ranges are
    reflections are not: those have the information of that mixture, the delays' spread counted as
    noise. Steps' scale and headings' drift are known to their spread.
    """
    run = simulate_lab(seed, overrides)
    settings = parse(LabSettings, overrides or {}, "scenario lab")
    nodes = range(1, settings.nodes + 1)
    rows = {n: [t for t in run.truth if t.node == n] for n in nodes}
    positions = np.array([[(t.x_m, t.y_m) for t in rows[n]] for n in nodes])
    heading = np.unwrap([[t.heading_rad or 0.0 for t in rows[n]] for n in nodes], axis=1)
    moving = np.linalg.norm(np.diff(positions, axis=1), axis=-1) > 0.0

    hidden, everyone = run.hidden, np.ones(settings.nodes)
    clear = _range_information(PaperSettings(sigma_range_m=settings.sigma_range_m))
    delays = (
        settings.wall_delay_max_m - settings.wall_delay_min_m,
        settings.body_delay_max_m - settings.body_delay_min_m,
    )
    blocked = _range_information(
        PaperSettings(
            sigma_range_m=math.hypot(settings.sigma_range_m, *(d / math.sqrt(12) for d in delays)),
            nlos_probability=settings.reflection,
            nlos_min_m=settings.reflection_min_m,
            nlos_max_m=settings.reflection_max_m,
        )
    )
    kept = [m for m in run.measurements if isinstance(m, Range)]
    late = [(r.time_s, r.node, r.peer) in hidden.late_ranges for r in kept]
    return TrueRun(
        np.array([t.time_s for t in rows[1]]),
        positions,
        by_user(hidden.distance_noise) * moving,
        np.hypot(
            np.diff(heading, axis=1) * by_user(hidden.turn_noise),
            by_user(hidden.white_heading_rad) * moving,
        ),
        np.zeros(moving.shape),
        np.array([r.time_s for r in kept]),
        np.array([(r.node - 1, r.peer - 1) for r in kept], dtype=np.int64).reshape(-1, 2),
        np.where(late, blocked, clear),
        drift_rad_s=everyone * math.radians(settings.noise_scale * settings.heading_drift_deg_s),
        log_scale=everyone * settings.noise_scale * settings.scale_error,
        drifting_s=moving.astype(np.float64),
    )


_FINEST = 1e5
"""Sigmas that the largest excess may be long: finer ones need gigabytes of points."""


def _range_information(settings: PaperSettings) -> float:
    """Fisher information of one range about its distance, 1/m^2.

    With the share p of ranges that are too long by a uniform excess the density of the error e
    is f = (1 - p) N(e; 0, s^2) + p (Phi((e - min) / s) - Phi((e - max) / s)) / (max - min), and
    the information of a location is the integral of f'^2 / f.
    """
    from scipy.special import ndtr

    sigma, share = max(settings.sigma_range_m, 1e-6), settings.nlos_probability
    low, high = settings.nlos_min_m, settings.nlos_max_m
    if share <= 0.0:
        return 1.0 / sigma**2
    sigma = max(sigma, high / _FINEST)
    high = max(high, low + 1e-3 * sigma)
    error = np.arange(-8.0 * sigma, high + 8.0 * sigma, sigma / 50.0)

    def normal(x: Floats) -> Floats:
        density: Floats = np.exp(-0.5 * (x / sigma) ** 2) / (math.sqrt(2.0 * math.pi) * sigma)
        return density

    # From the nearer tail: where both are next to 1 their difference would be lost.
    tail = np.where(error < 0.5 * (low + high), 1.0, -1.0) / sigma
    excess = np.abs(ndtr(tail * (error - low)) - ndtr(tail * (error - high))) / (high - low)
    excess_slope = (normal(error - low) - normal(error - high)) / (high - low)
    density = (1.0 - share) * normal(error) + share * excess
    slope = -(1.0 - share) * error / sigma**2 * normal(error) + share * excess_slope
    return float(np.trapezoid(slope**2 / np.maximum(density, 1e-300), error))
