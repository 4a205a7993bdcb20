"""The posterior Cramer-Rao bound of a team's relative positions.

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
from dataclasses import astuple, dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from relpos.simulation.true_run import TrueRun, simulate_true_run

Floats = npt.NDArray[np.float64]

UNKNOWN_M = 1e3
UNKNOWN_RAD = 10.0
"""Standard deviations that stand for no knowledge of a start: far above all that is learned of
it, and small enough that no digits are lost against the centimetres."""

TOGETHER_M = 1e-6
"""Nearer than this two nodes stand at one place, and their distance has no derivative: a range
then counts by the mean of its information over all directions, half of it along each axis."""


@dataclass(frozen=True)
class Bound:
    """The least possible root mean square errors at T times after the start.

    ``*_pair_m`` are (T, P): of each pair's distance, in the order of ``numpy.triu_indices``:
    sqrt(u' Cov(e_i - e_j) u) along the true direction u. Where two stand at one place their
    distance has no derivative and no bound; there it is the mean over all directions,
    sqrt(trace / 2), which is 0 while both are exactly known. ``*_position_m`` are (T,): the root
    mean over the nodes of the covariance without its three directions of rigid motion, which is
    the aligned position error to first order. ``filtering_constants`` are (N, 2): the standard
    deviations of the hidden drift (rad/s) and log scale at the end, 0 where there is none.
    """

    time_s: Floats
    filtering_pair_m: Floats
    filtering_position_m: Floats
    smoothing_pair_m: Floats
    smoothing_position_m: Floats
    filtering_constants: Floats

    @cached_property
    def filtering_distance_m(self) -> Floats:
        """Root mean square over the pairs, (T,)."""
        return _rms(self.filtering_pair_m, axis=1)

    @cached_property
    def smoothing_distance_m(self) -> Floats:
        """Root mean square over the pairs, (T,)."""
        return _rms(self.smoothing_pair_m, axis=1)

    def of(self, *, smoothed: bool) -> tuple[Floats, Floats]:
        """Return the bounds of distance and position, (T,), of smoothing or of filtering."""
        if smoothed:
            return self.smoothing_distance_m, self.smoothing_position_m
        return self.filtering_distance_m, self.filtering_position_m

    def totals(self) -> Totals:
        """Root mean squares over all times."""
        return Totals(
            *(
                float(_rms(series))
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

    def of(self, *, smoothed: bool) -> tuple[float, float]:
        """Return the bounds of distance and position, of smoothing or of filtering."""
        if smoothed:
            return self.smoothing_distance_m, self.smoothing_position_m
        return self.filtering_distance_m, self.filtering_position_m


def over_seeds(totals: Iterable[Totals]) -> Totals:
    """Return the root mean squares over runs: the scenario's bound that a ratio divides by."""
    return Totals(*_rms(np.array([astuple(one) for one in totals]), axis=0).tolist())


def of_simulated(
    scenario: str, seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> Bound:
    """Compute the bound of one run of any scenario of :mod:`relpos.simulation.scenarios`.

    The ranges are those that were measured in it.
    """
    return of_true_run(simulate_true_run(scenario, seed, overrides))


_X, _Y, _HEADING, _DRIFT, _SCALE, _OLD_X, _OLD_Y = range(7)
_PER_NODE = 7


def of_true_run(true_run: TrueRun) -> Bound:
    """Compute the bounds of filtering and smoothing at every time of the run but the first.

    Needs O(T (5 N)^3) operations; 0.1 s for six nodes over 600 s.
    """
    system = _System(true_run)
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

    where = true_run.position_m.transpose(1, 0, 2)[1:]
    filtering = _figures(system.positions(np.array(filtered)), where)
    smoothing = _figures(system.positions(np.array(smoothed)), where)
    return Bound(
        true_run.time_s[1:],
        *filtering,
        *smoothing,
        filtering_constants=system.constants(filtered[-1]),
    )


class _System:
    """The linear system of the errors, of every node (x, y, heading, drift, scale, old x, y).

    States that the true_run has no use for (drift, scale, the position at the chord's beginning)
    are left out: ``_column`` maps (node, state) to a column, or to -1.
    """

    def __init__(self, true_run: TrueRun) -> None:
        self._true_run = true_run
        count = true_run.position_m.shape[0]
        self.steps = true_run.time_s.size - 1
        # A range on the grid belongs to the chord that ends there.
        self._chord = np.clip(
            np.searchsorted(true_run.time_s, true_run.range_time_s - 1e-9) - 1, 0, self.steps - 1
        )
        begin, end = true_run.time_s[self._chord], true_run.time_s[self._chord + 1]
        self._share = np.clip((true_run.range_time_s - begin) / (end - begin), 0.0, 1.0)
        self._share[self._share > 1.0 - 1e-9] = 1.0
        wanted = np.zeros((count, _PER_NODE), dtype=bool)
        wanted[:, : _HEADING + 1] = True
        wanted[:, _DRIFT] = true_run.drift_rad_s > 0.0
        wanted[:, _SCALE] = true_run.log_scale > 0.0
        wanted[:, _OLD_X:] = bool((self._share < 1.0).any())
        self._column = np.where(wanted, np.cumsum(wanted).reshape(wanted.shape) - 1, -1)
        self._size = int(wanted.sum())
        self._chords = true_run.walked_m
        self._order = np.argsort(self._chord, kind="stable")
        self._first = np.searchsorted(self._chord[self._order], np.arange(self.steps + 1))

    def initial(self) -> Floats:
        """Return the covariance at the start.

        Where no pose at all is known, the first node's is the frame: no figure depends on it.
        """
        true_run = self._true_run
        sd_m = np.minimum(true_run.start_m, UNKNOWN_M)
        sd_rad = np.minimum(true_run.start_rad, UNKNOWN_RAD)
        if np.isinf(true_run.start_m).all() and np.isinf(true_run.start_rad).all():
            sd_m[0] = sd_rad[0] = 0.0
        deviation = np.zeros(self._size)
        for state, values in (
            (_X, sd_m),
            (_Y, sd_m),
            (_HEADING, sd_rad),
            (_DRIFT, true_run.drift_rad_s),
            (_SCALE, true_run.log_scale),
        ):
            there = self._column[:, state] >= 0
            deviation[self._column[there, state]] = values[there]
        return np.diag(deviation**2)

    def transition(self, step: int) -> Floats:
        """Return how the errors at the beginning of a chord become those at its end."""
        matrix = np.eye(self._size)
        durations = self._true_run.drifting_s[:, step]
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
        true_run = self._true_run
        columns = []
        for node, column in enumerate(self._column):
            chord = self._chords[node, step]
            x, y, heading = column[: _HEADING + 1]
            turn, along = true_run.turn_rad[node, step], true_run.along[node, step]
            if turn > 0.0:
                columns.append(np.zeros(self._size))
                columns[-1][[x, y, heading]] = turn * np.array([-chord[1], chord[0], 1.0])
            if along > 0.0:
                columns.append(np.zeros(self._size))
                columns[-1][[x, y]] = along * chord
            if true_run.sigma_m[node, step] > 0.0:
                for axis in (x, y):
                    columns.append(np.zeros(self._size))
                    columns[-1][axis] = true_run.sigma_m[node, step]
        return np.array(columns).T if columns else np.zeros((self._size, 0))

    def seen(self, step: int) -> tuple[Floats, Floats]:
        """Return the ranges' derivatives (m, states) and their information (m,)."""
        true_run = self._true_run
        rows, information = [], []
        for index in self._order[self._first[step] : self._first[step + 1]]:
            share = float(self._share[index])
            i, j = true_run.range_nodes[index]
            before, after = true_run.position_m[:, step], true_run.position_m[:, step + 1]
            apart = (1.0 - share) * (before[i] - before[j]) + share * (after[i] - after[j])
            distance = math.hypot(*apart)
            units = np.eye(2) if distance < TOGETHER_M else [apart / distance]
            for unit in units:
                row = np.zeros(self._size)
                for node, sign in ((i, 1.0), (j, -1.0)):
                    column = self._column[node]
                    row[column[:2]] += sign * share * unit
                    if share < 1.0:
                        row[column[_OLD_X:]] += sign * (1.0 - share) * unit
                rows.append(row)
                information.append(true_run.range_information[index] / len(units))
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
