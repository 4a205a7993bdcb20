"""How well a team's shape can be known at all: the posterior Cramer-Rao bound.

No estimator of random states can have a smaller mean squared error than the inverse of the
posterior information (Van Trees 1968; recursively for filtering: Tichavsky, Muravchik, Nehorai
1998). Here the information is that of the problem linearised at the true path with the true noise
levels, so the bound is what an ideal estimator would reach that knows all levels and never leaves
the right mode. Because it is linearised, a real error may fall a little below it.

Nothing here is shared with the estimators: the model is written down once more, from the
equations. With the pose errors (e_x, e_y, e_h), the hidden constants b (heading drift, rad/s) and
c (logarithm of true over reported length), and a true chord D = (D_x, D_y) of length d that is
turned first and then walked,

    turn   t = b dt + turn_rad w_1                                      (w: unit white noise)
    e_h   <- e_h + t
    e_x   <- e_x - D_y (e_h + t) + D_x (c + along w_2) + sigma_m w_3
    e_y   <- e_y + D_x (e_h + t) + D_y (c + along w_2) + sigma_m w_4

and a range between i and j, off the grid by the share f of a chord, sees with the unit vector u

    u . ((1 - f) (e_i - e_j)_before + f (e_i - e_j)_after)

The covariances of filtering are the Riccati recursion of this system, those of smoothing the
modified Bryson-Frazier recursion (Bierman 1973), which inverts neither the motion noise nor a
covariance: users who wait at a known place have neither.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from relpos.fusion.settings import parse
from relpos.measurements import Range
from relpos.simulation.lab import LabSettings, simulate_lab
from relpos.simulation.paper import (
    PaperSettings,
    SimulatedRun,
    Start,
    settings_of,
    simulate_paper,
    true_poses,
)
from relpos.simulation.scenarios import LAB

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

UNKNOWN_M = 1e3
UNKNOWN_RAD = 10.0
"""Standard deviations that stand for no knowledge of a start: far above all that is learned of
it, and small enough that no digits are lost against the centimetres."""

TOGETHER_M = 1e-6
"""Nearer than this two nodes stand at one place, and their distance has no derivative."""


@dataclass(frozen=True)
class Scene:
    """A true run and the noise it is observed with: what a bound is computed from.

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
    """(N, K) error of a chord in x and in y that no report tells, as of a carried node."""
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


@dataclass(frozen=True)
class Bound:
    """The least possible root mean square errors at T times after the start.

    ``*_pair_m`` are (T, P): of each pair's distance, in the order of ``numpy.triu_indices``:
    sqrt(u' Cov(e_i - e_j) u) along the true direction u. Where two stand at one place their
    distance has no derivative and no bound; there it is the mean over all directions,
    sqrt(trace / 2), which is 0 while both are exactly known. ``*_position_m`` are (T,): the root
    mean over the nodes of the covariance without its three directions of rigid motion, which is
    the aligned position error to first order. ``*_constants`` are (N, 2): the standard
    deviations of the hidden drift (rad/s) and log scale at the end, 0 where there is none.
    """

    time_s: Floats
    filtering_pair_m: Floats
    filtering_position_m: Floats
    smoothing_pair_m: Floats
    smoothing_position_m: Floats
    filtering_constants: Floats
    smoothing_constants: Floats

    @cached_property
    def filtering_distance_m(self) -> Floats:
        """Root mean square over the pairs, (T,)."""
        return _rms(self.filtering_pair_m, axis=1)

    @cached_property
    def smoothing_distance_m(self) -> Floats:
        """Root mean square over the pairs, (T,)."""
        return _rms(self.smoothing_pair_m, axis=1)

    def totals(self, first_s: float = -math.inf, last_s: float = math.inf) -> Totals:
        """Root mean squares over the times from ``first_s`` to ``last_s``."""
        there = (self.time_s >= first_s) & (self.time_s <= last_s)
        return Totals(
            *(
                float(_rms(series[there]))
                for series in (
                    self.filtering_pair_m,
                    self.filtering_position_m,
                    self.smoothing_pair_m,
                    self.smoothing_position_m,
                )
            )
        )


@dataclass(frozen=True, slots=True)
class Totals:
    """One run's (or one scenario's) root mean square bounds."""

    filtering_distance_m: float
    filtering_position_m: float
    smoothing_distance_m: float
    smoothing_position_m: float


def over_seeds(totals: Iterable[Totals]) -> Totals:
    """Return the root mean squares over runs: the scenario's bound that a ratio divides by."""
    rows = np.array(
        [
            (
                t.filtering_distance_m,
                t.filtering_position_m,
                t.smoothing_distance_m,
                t.smoothing_position_m,
            )
            for t in totals
        ]
    )
    return Totals(*(float(value) for value in _rms(rows, axis=0)))


def of_simulated(
    scenario: str, seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> Bound:
    """Compute the bound of one run of any scenario of :mod:`relpos.simulation.scenarios`."""
    if scenario == LAB:
        return of_scene(lab_scene(seed, overrides))
    return of_paper(scenario, seed, overrides)


def of_paper(
    scenario: str = "paper", seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> Bound:
    """Compute the bound of one simulated run, given the ranges that were measured in it."""
    run = simulate_paper(scenario, seed, overrides)
    return of_scene(paper_scene(settings_of(scenario, overrides), run))


def paper_scene(settings: PaperSettings, run: SimulatedRun) -> Scene:
    """Describe a run of the paper's simulation as its bound sees it: nodes are numbered from 1.

    What only some runs have is taken at its true spread, as if it had been told: a shifted start
    is known to ``start_shift_m / sqrt(2)`` in x and y, a kidnapped user to as much of the way
    carried, the noisy user is known as such, and a range of which a share is too long has the
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

    def of_user(values: Mapping[int, float]) -> Floats:
        return np.array([values[node + 1] for node in range(settings.nodes)])[:, None]

    drifts = settings.heading_drift_deg_s > 0.0
    if drifts and not settings.drift_while_waiting:
        duration_s = np.diff(times) * moving
    else:
        duration_s = np.diff(times) * np.ones(moving.shape)
    position_known = settings.start in (Start.KNOWN, Start.POSITION)
    heading_known = settings.start in (Start.KNOWN, Start.HEADING)
    kept = [m for m in run.measurements if isinstance(m, Range) and 0.0 < m.time_s <= times[-1]]
    return Scene(
        times,
        positions,
        of_user(hidden.distance_noise) * moving,
        np.hypot(
            turn * of_user(hidden.turn_noise),
            of_user(hidden.white_heading_rad) * moving,
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
        drifting_s=duration_s,
    )


def lab_scene(seed: int, overrides: Mapping[str, str | float] | None = None) -> Scene:
    """Describe a run of the laboratory as its bound sees it.

    What is in the way of each range is told; how long the delays and which ranges are
    reflections, not: those have the information of that mixture, the delays' spread counted as
    noise. Steps' scale and headings' drift are known to their spread.
    """
    run = simulate_lab(seed, overrides)
    settings = parse(LabSettings, overrides or {}, "scenario lab")
    nodes = range(1, settings.nodes + 1)
    rows = {n: [t for t in run.truth if t.node == n] for n in nodes}
    positions = np.array([[(t.x_m, t.y_m) for t in rows[n]] for n in nodes])
    heading = np.unwrap([[t.heading_rad or 0.0 for t in rows[n]] for n in nodes], axis=1)
    moving = np.linalg.norm(np.diff(positions, axis=1), axis=-1) > 0.0

    def of_user(values: Mapping[int, float]) -> Floats:
        return np.array([values[n] for n in nodes])[:, None]

    hidden, everyone = run.hidden, np.ones(settings.nodes)
    clear = 1.0 / settings.sigma_range_m**2
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
    return Scene(
        np.array([t.time_s for t in rows[1]]),
        positions,
        of_user(hidden.distance_noise) * moving,
        np.hypot(
            np.diff(heading, axis=1) * of_user(hidden.turn_noise),
            of_user(hidden.white_heading_rad) * moving,
        ),
        np.zeros(moving.shape),
        np.array([r.time_s for r in kept]),
        np.array([(r.node - 1, r.peer - 1) for r in kept], dtype=np.int64).reshape(-1, 2),
        np.where(late, blocked, clear),
        drift_rad_s=everyone * math.radians(settings.noise_scale * settings.heading_drift_deg_s),
        log_scale=everyone * settings.noise_scale * settings.scale_error,
        drifting_s=1.0 * moving,
    )


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
    high = max(high, low + 1e-3 * sigma)
    error = np.arange(-8.0 * sigma, high + 8.0 * sigma, sigma / 50.0)

    def normal(x: Floats) -> Floats:
        density: Floats = np.exp(-0.5 * (x / sigma) ** 2) / (math.sqrt(2.0 * math.pi) * sigma)
        return density

    excess = (ndtr((error - low) / sigma) - ndtr((error - high) / sigma)) / (high - low)
    excess_slope = (normal(error - low) - normal(error - high)) / (high - low)
    density = (1.0 - share) * normal(error) + share * excess
    slope = -(1.0 - share) * error / sigma**2 * normal(error) + share * excess_slope
    return float(np.trapezoid(slope**2 / np.maximum(density, 1e-300), error))


_X, _Y, _HEADING, _DRIFT, _SCALE, _OLD_X, _OLD_Y = range(7)
_PER_NODE = 7


def of_scene(scene: Scene) -> Bound:
    """Compute the bounds of filtering and smoothing at every time of the scene but the first.

    Needs O(T (5 N)^3) operations; 0.1 s for six nodes over 600 s.
    """
    system = _System(scene)
    steps = system.steps
    covariance = system.initial()
    filtered: list[Floats] = []
    gains: list[tuple[Floats, Floats] | None] = []
    for step in range(steps):
        transition, noise = system.transition(step), system.noise(step)
        covariance = transition @ covariance @ transition.T + noise @ noise.T
        seen, information = system.seen(step)
        if information.size:
            cross = covariance @ seen.T
            # S^-1 by its Cholesky factor: S is at least the ranges' own variance.
            scatter = seen @ cross + np.diag(1.0 / information)
            weighted = np.linalg.solve(scatter, seen)
            gain = cross @ weighted
            covariance = covariance - gain @ covariance
            covariance = 0.5 * (covariance + covariance.T)
            gains.append((seen.T @ weighted, gain))
        else:
            gains.append(None)
        filtered.append(covariance)

    smoothed: list[Floats] = [covariance] * steps
    adjoint = np.zeros_like(covariance)
    for step in range(steps - 1, -1, -1):
        one = filtered[step]
        smoothed[step] = one - one @ adjoint @ one
        update = gains[step]
        if update is not None:
            learned, gain = update
            rest = np.eye(adjoint.shape[0]) - gain
            adjoint = learned + rest.T @ adjoint @ rest
        transition = system.transition(step)
        adjoint = transition.T @ adjoint @ transition
        adjoint = 0.5 * (adjoint + adjoint.T)

    where = scene.position_m.transpose(1, 0, 2)[1:]
    filtering = _figures(system.positions(np.array(filtered)), where)
    smoothing = _figures(system.positions(np.array(smoothed)), where)
    return Bound(
        scene.time_s[1:],
        *filtering,
        *smoothing,
        filtering_constants=system.constants(filtered[-1]),
        smoothing_constants=system.constants(smoothed[-1]),
    )


class _System:
    """The linear system of the errors, of every node (x, y, heading, drift, scale, old x, y).

    States that the scene has no use for (drift, scale, the position at the chord's beginning)
    are left out: ``_column`` maps (node, state) to a column, or to -1.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        count = scene.position_m.shape[0]
        self.steps = scene.time_s.size - 1
        # A range on the grid belongs to the chord that ends there.
        self._chord = np.clip(
            np.searchsorted(scene.time_s, scene.range_time_s - 1e-9) - 1, 0, self.steps - 1
        )
        begin, end = scene.time_s[self._chord], scene.time_s[self._chord + 1]
        self._share = np.clip((scene.range_time_s - begin) / (end - begin), 0.0, 1.0)
        self._share[self._share > 1.0 - 1e-9] = 1.0
        wanted = np.zeros((count, _PER_NODE), dtype=bool)
        wanted[:, : _HEADING + 1] = True
        wanted[:, _DRIFT] = scene.drift_rad_s > 0.0
        wanted[:, _SCALE] = scene.log_scale > 0.0
        wanted[:, _OLD_X:] = bool((self._share < 1.0).any())
        self._column = np.where(wanted, np.cumsum(wanted).reshape(wanted.shape) - 1, -1)
        self._size = int(wanted.sum())
        self._chords = scene.walked_m
        self._order = np.argsort(self._chord, kind="stable")
        self._first = np.searchsorted(self._chord[self._order], np.arange(self.steps + 1))

    def initial(self) -> Floats:
        """Return the covariance at the start.

        Where no pose at all is known, the first node's is the frame: no figure depends on it.
        """
        scene = self._scene
        sd_m = np.minimum(scene.start_m, UNKNOWN_M)
        sd_rad = np.minimum(scene.start_rad, UNKNOWN_RAD)
        if np.isinf(scene.start_m).all() and np.isinf(scene.start_rad).all():
            sd_m[0] = sd_rad[0] = 0.0
        deviation = np.zeros(self._size)
        for state, values in (
            (_X, sd_m),
            (_Y, sd_m),
            (_HEADING, sd_rad),
            (_DRIFT, scene.drift_rad_s),
            (_SCALE, scene.log_scale),
        ):
            there = self._column[:, state] >= 0
            deviation[self._column[there, state]] = values[there]
        return np.diag(deviation**2)

    def transition(self, step: int) -> Floats:
        """Return how the errors at the beginning of a chord become those at its end."""
        matrix = np.eye(self._size)
        durations = self._scene.drifting_s[:, step]
        for column, chord, duration_s in zip(
            self._column, self._chords[:, step], durations, strict=True
        ):
            x, y, heading, drift, scale, old_x, old_y = column
            matrix[x, heading], matrix[y, heading] = -chord[1], chord[0]
            if drift >= 0:
                matrix[heading, drift] = duration_s
                matrix[x, drift], matrix[y, drift] = -chord[1] * duration_s, chord[0] * duration_s
            if scale >= 0:
                matrix[x, scale], matrix[y, scale] = chord
            if old_x >= 0:
                matrix[old_x, old_x] = matrix[old_y, old_y] = 0.0
                matrix[old_x, x] = matrix[old_y, y] = 1.0
        return matrix

    def noise(self, step: int) -> Floats:
        """Return the motion noise of a chord, a column for each independent unit error."""
        scene = self._scene
        columns = []
        for node, column in enumerate(self._column):
            chord = self._chords[node, step]
            x, y, heading = column[: _HEADING + 1]
            turn, along = scene.turn_rad[node, step], scene.along[node, step]
            if turn > 0.0:
                columns.append(np.zeros(self._size))
                columns[-1][[x, y, heading]] = turn * np.array([-chord[1], chord[0], 1.0])
            if along > 0.0:
                columns.append(np.zeros(self._size))
                columns[-1][[x, y]] = along * chord
            if scene.sigma_m[node, step] > 0.0:
                for axis in (x, y):
                    columns.append(np.zeros(self._size))
                    columns[-1][axis] = scene.sigma_m[node, step]
        return np.array(columns).T if columns else np.zeros((self._size, 0))

    def seen(self, step: int) -> tuple[Floats, Floats]:
        """Return the ranges' derivatives (m, states) and their information (m,)."""
        scene = self._scene
        rows, information = [], []
        for index in self._order[self._first[step] : self._first[step + 1]]:
            share = float(self._share[index])
            i, j = scene.range_nodes[index]
            before, after = scene.position_m[:, step], scene.position_m[:, step + 1]
            apart = (1.0 - share) * (before[i] - before[j]) + share * (after[i] - after[j])
            distance = math.hypot(*apart)
            if distance < TOGETHER_M:
                continue
            row = np.zeros(self._size)
            for node, sign in ((i, 1.0), (j, -1.0)):
                column = self._column[node]
                row[column[:2]] += sign * share * apart / distance
                if share < 1.0:
                    row[column[_OLD_X:]] += sign * (1.0 - share) * apart / distance
            rows.append(row)
            information.append(scene.range_information[index])
        return np.array(rows).reshape(-1, self._size), np.array(information)

    def positions(self, covariances: Floats) -> Floats:
        """Pick the positions' covariances, (T, 2N, 2N), out of whole ones."""
        columns = self._column[:, :2].ravel()
        return covariances[:, columns[:, None], columns[None, :]]

    def constants(self, covariance: Floats) -> Floats:
        """Pick the standard deviations of drift and log scale, (N, 2)."""
        columns = self._column[:, [_DRIFT, _SCALE]]
        spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        return np.where(columns >= 0, spread[columns], 0.0)


def _figures(covariance: Floats, position_m: Floats) -> tuple[Floats, Floats]:
    """Pair distance deviations (T, P) and aligned position deviations (T,).

    From covariances (T, 2N, 2N) of positions (T, N, 2).
    """
    times, count = position_m.shape[:2]
    blocks = covariance.reshape(times, count, 2, count, 2).transpose(0, 1, 3, 2, 4)
    first, second = np.triu_indices(count, 1)
    own = np.arange(count)
    alone = blocks[:, own, own]
    cross = blocks[:, first, second]
    difference = alone[:, first] + alone[:, second] - cross - cross.transpose(0, 1, 3, 2)
    apart = position_m[:, first] - position_m[:, second]
    distance = np.linalg.norm(apart, axis=-1)
    together = distance < TOGETHER_M
    unit = apart / np.where(together, 1.0, distance)[..., None]
    along = np.einsum("tpa,tpab,tpb->tp", unit, difference, unit)
    mean = 0.5 * np.trace(difference, axis1=-2, axis2=-1)
    variance = np.where(together, mean, along)
    return np.sqrt(np.maximum(variance, 0.0)), aligned_deviation(covariance, position_m)


def aligned_deviation(covariance: Floats, position_m: Floats) -> Floats:
    """Root mean over nodes of the covariance without its rigid motions, (T,).

    (T, 2N, 2N), (T, N, 2). The best rigid fit takes out of a small error its part along the two
    translations and along the rotation of the whole figure.
    """
    times, count = position_m.shape[:2]
    centred = position_m - position_m.mean(axis=1, keepdims=True)
    rotation = np.stack((-centred[..., 1], centred[..., 0]), axis=-1).reshape(times, -1)
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    rotation = np.divide(rotation, length, out=np.zeros_like(rotation), where=length > TOGETHER_M)
    diagonal = np.arange(2 * count)
    total = covariance[:, diagonal, diagonal].sum(axis=1)
    for axis in (0, 1):
        total = total - covariance[:, axis::2, axis::2].sum(axis=(1, 2)) / count
    total = total - np.einsum("ti,tij,tj->t", rotation, covariance, rotation)
    result: Floats = np.sqrt(np.maximum(total, 0.0) / count)
    return result


def _rms(values: Floats, axis: int | None = None) -> Floats:
    result: Floats = np.sqrt(np.mean(np.square(values), axis=axis))
    return result
