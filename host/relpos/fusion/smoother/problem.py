"""The best track of a whole run, from everything that was measured before and after each moment.

One robust factor graph over all poses and the hidden constants (:mod:`smoother_graph`), solved by
Levenberg-Marquardt on its block-tridiagonal normal equations (:mod:`smoother_kernels`). Noise
levels are not told: they are estimated by maximum marginal likelihood between the solutions.
``docs/fusion.md``, "The smoother", has the equations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.fusion.models.detection import LENGTH, STEP_M, Detection
from relpos.fusion.smoother import kernels
from relpos.fusion.smoother.graph import STILL_M, Graph

Floats = npt.NDArray[np.float64]

ALONG_WAY, ALONG_TIME, ACROSS_WAY, ACROSS_TIME, TURN_TURN, TURN_WAY, TURN_TIME = range(7)
"""Columns of ``Levels.motion``: what a chord's three variances are made of."""

AXIS = np.array([0, 0, 1, 1, 2, 2, 2])
"""Which residual of a chord each of them belongs to."""


@dataclass
class Levels:
    """Noise levels as variances; what the alternation estimates.

    ``motion`` (N, 7): along the way per squared length (1) and per second (m^2/s); across it the
    same; of the turn per squared turn (1), per second of walking (rad^2/s) and per second.
    """

    motion: Floats
    range_m2: float
    outliers: float
    scale: float
    drift_rad2_s2: float
    common_bias_m2: float
    pair_bias_m2: float
    colour: float = 1.0
    """How many times wider the ranges are taken because their errors last: (1 + r) / (1 - r) for
    a correlation r of a pair's consecutive errors."""
    calibrated: bool = False
    """Whether ranges are known to have next to no bias."""
    to_scale: bool = False
    """Whether steps are known to have their reported length but for noise."""

    def copy(self) -> Levels:
        """Return one that can be changed by itself."""
        return replace(self, motion=self.motion.copy())


FIRST_MOTION = np.array(
    [0.1**2, 0.005**2, 0.002**2, 0.003**2, 0.02**2, math.radians(1.0) ** 2, math.radians(0.1) ** 2]
)
"""Levels to begin with: between a good robot's odometry and a bad pedestrian's."""

LEAST_MOTION = np.array([0.005**2, 0.001**2, 0.002**2, 0.001**2, 0.005**2, 2e-4**2, 1e-4**2])
"""No level is believed to be less; far below all sensors, and no trouble for the digits."""

SPREAD_FIRST = 1.4
SPREAD_TEAM = 1.4
"""Standard deviations of the logarithms: of the team's mean level about the first one, and of
its nodes' levels about the mean: they carry the same device, but walk differently."""

MOST_STEP = 1.5
"""No logarithm of a level moves by more in one step."""

UNREST = 2.0
"""Standard deviations of a stride's turn beyond which it is a turn."""

HEAR_FROM = 6
"""The pass from which on who was heard is used: tracks that are still wrong by metres would teach
a wrong edge."""
HEAR_LEARNED = 4
"""Passes from one learning of the curve to the next: it hardly changes, and takes longest."""
HEAR_STEP = 0.1
"""Share of a change that an attempt's Gaussian takes at once. Hundreds of attempts of a pair tell
of nearly one distance and answer together: with 0.3 they overshot and diverged; 0.05 and 0.15 end
at the same (``paper-h``, seeds 202 to 211)."""
HEAR_SHARE = 0.2
"""What an attempt is worth beside what its own correlation in time leaves of it: the curve itself
is off by some percent, and for all attempts alike. ``paper-h``, seeds 202 to 208: 0.5 gave 1.006 x
the bound with NEES 1.30, 0.2 1.016 with 1.22; no hearing 1.10."""
HEAR_BLUR_M = 0.5
"""No edge is taken for sharper than the step of the tabulated curve."""
HEARD_MOVED = 0.1
"""Deviations; when no attempt's pull on its distance changes by more, hearing has settled."""
_NODES = np.linspace(-5.0, 5.0, 41)
_NODE_SHARES = np.exp(-0.5 * _NODES**2)
# Of unit variance to the last digit: else thousands of attempts that say nothing would add up.
_NODES /= math.sqrt(float(_NODE_SHARES @ _NODES**2 / _NODE_SHARES.sum()))
_HEARD_M = np.arange(LENGTH) * STEP_M
_BLUR = np.exp(-0.5 * (np.arange(-3, 4) * STEP_M / HEAR_BLUR_M) ** 2)
_BLUR /= _BLUR.sum()
HEARING_BLUR_M = 0.5
"""How well a distance is known when it is learned from."""

FIRST_SCALE = 0.1**2
TO_SCALE = 0.005**2
"""Of steps whose length was calibrated."""
CALIBRATED = 0.05**2
CALIBRATED_PAIR = 0.03**2
"""Of ranges whose antenna delays were calibrated: the common bias, and a pair's (m^2)."""
FIRST_DRIFT = math.radians(0.05) ** 2
FIRST_PAIR_BIAS = 0.1**2
COUNT_CONSTANTS = 1.0
"""A standing node says nothing of its scale; a wide prior would let it say anything."""

FIRST_RANGE = 0.12**2
MOST_COLOUR = 0.7
COUNT_RANGES = 20.0
"""What UWB is in the open, worth so many ranges."""

SPAN_M = 10.0
"""An outlier may be anywhere within this."""


@dataclass
class State:
    """A point of the optimisation: poses (K, N, 3) with unwrapped headings, and the constants.

    ``constants`` (2 N + 1 + P,): log of true over reported length, drift (rad/s), common bias,
    pair biases (m).
    """

    poses: Floats
    constants: Floats

    def copy(self) -> State:
        """Return one that can be changed by itself."""
        return State(self.poses.copy(), self.constants.copy())


@dataclass
class Covariance:
    """Blocks of the joint covariance: see :func:`kernels.motion_variances`."""

    diagonal: Floats
    below: Floats
    with_constants: Floats
    constants: Floats
    log_determinant: float
    """Of the whole information matrix."""


@dataclass
class Solution:
    """A smoothed run: the state, its covariance, the levels and the evidence for all of it."""

    state: State
    covariance: Covariance
    levels: Levels
    cost: float
    """Minus the logarithm of the marginal likelihood (Laplace), up to the run's own constant."""
    inliers: Floats
    steps: int


@dataclass
class Weights:
    """1 / variance of everything, at one set of levels."""

    motion: Floats
    ranges: Floats
    constants: Floats


class Problem:
    """A graph with what is computed from it once, and what has been learned of its ranging."""

    def __init__(self, graph: Graph, *, constants: bool = True) -> None:
        self.graph = graph
        self.nodes = len(graph.node_ids)
        self.constants = 2 * self.nodes + 1 + len(graph.pairs)
        self.estimate_constants = constants
        duration = graph.duration_s
        self._motion = (
            duration, graph.length_m, graph.direction_rad, graph.turn_rad, graph.follow,
        )  # fmt: skip
        self._ranges = (
            graph.slot, graph.pair, graph.share, graph.bend, graph.antenna_m, graph.rise_m,
        )  # fmt: skip
        self.range_m = graph.range_m.copy()
        """The measured ranges with the signs they are believed to have had; see ``unfold``."""
        self._tries = (
            graph.tries.slot, graph.tries.pair, graph.tries.share, graph.tries.bend,
            graph.antenna_m, graph.tries.rise_m,
        )  # fmt: skip
        self._no_bias = np.full(graph.tries.slot.size, -1, dtype=np.int64)
        self.heard_m = np.zeros(graph.tries.slot.size)
        self.heard_weight = np.zeros(graph.tries.slot.size)
        """What an attempt's outcome says of its distance, as a Gaussian: see ``hear``."""
        self.heard_curve = (np.zeros(LENGTH), self.heard_weight)
        self._walks = graph.length_m > STILL_M
        self._way = _usual_length(graph.length_m, self._walks)

    def first_levels(self) -> Levels:
        """Generic levels, the same for every run."""
        return Levels(
            np.tile(FIRST_MOTION, (self.nodes, 1)),
            range_m2=0.3**2,
            outliers=0.05,
            scale=0.1**2,
            drift_rad2_s2=math.radians(0.05) ** 2,
            common_bias_m2=0.3**2,
            pair_bias_m2=0.1**2,
        )

    def simpler_levels(self, *, calibrated: bool, to_scale: bool) -> Levels:
        """Levels to begin with where ranges have next to no bias, or steps no scale."""
        levels = replace(self.first_levels(), calibrated=calibrated, to_scale=to_scale)
        if calibrated:
            levels.common_bias_m2, levels.pair_bias_m2 = CALIBRATED, CALIBRATED_PAIR
        if to_scale:
            levels.scale = TO_SCALE
        return levels

    def first_state(self, poses: Floats) -> State:
        """Begin at these poses, constants zero."""
        return State(poses.copy(), np.zeros(self.constants))

    def bases(self, state: State, levels: Levels) -> Floats:
        """What the levels are multiplied by, (K - 1, N, 7); turns as they now are believed."""
        duration = np.broadcast_to(self.graph.duration_s[:, None], self._walks.shape)
        # A turn that was reported too small is not more certain for it; but one that was not
        # reported is not to be had by believing in it.
        turn = np.abs(np.diff(state.poses[..., 2], axis=0))
        reported = np.abs(self.graph.turn_rad)
        turn = np.clip(turn, 0.5 * reported, 2.0 * reported)
        # What is no more than a stride's own unrest is no turn, or unrest that happens to be
        # great would explain itself.
        unrest = np.sqrt(levels.motion[:, TURN_WAY] * duration * self._walks)
        turn = np.maximum(turn - UNREST * unrest, 0.0)
        square = self._way**2
        return np.stack(
            [square, duration, square, duration, turn**2, duration * self._walks, duration], axis=-1
        )

    def variances(self, bases: Floats, levels: Levels) -> Floats:
        """Variances of along, across and turn, (K - 1, N, 3)."""
        parts = bases * levels.motion
        told = self.graph.reported_m**2
        along = np.maximum(parts[..., ALONG_WAY] + parts[..., ALONG_TIME], told)
        across = parts[..., ACROSS_WAY] + parts[..., ACROSS_TIME]
        turn = parts[..., TURN_TURN] + parts[..., TURN_WAY] + parts[..., TURN_TIME]
        turn = np.maximum(turn, self.graph.reported_rad**2)
        return np.stack([along, across, turn], axis=-1)

    def told(self, bases: Floats, levels: Levels) -> npt.NDArray[np.bool_]:
        """Tell where a report's own deviation is the variance, (K - 1, N, 3)."""
        parts = bases * levels.motion
        result = np.zeros((*parts.shape[:2], 3), dtype=bool)
        result[..., 0] = parts[..., :2].sum(axis=-1) < self.graph.reported_m**2
        result[..., 2] = parts[..., 4:].sum(axis=-1) < self.graph.reported_rad**2
        return result

    def motion_residuals(self, state: State) -> Floats:
        """Residuals of the chords, (K - 1, N, 3)."""
        n = self.nodes
        return kernels.motion_residuals(
            state.poses, state.constants[:n], state.constants[n : 2 * n], *self._motion
        )

    def range_residuals(self, state: State) -> Floats:
        """Predicted minus measured ranges, (M,)."""
        return kernels.range_residuals(
            state.poses,
            state.constants[2 * self.nodes :],
            *self._ranges,
            self.range_m,
            self.graph.pair_index,
        )

    def unfold(self, state: State, variance_m2: float) -> None:
        """Give near ranges their expected sign back.

        A chip reports no negative distance. Of a range z between two who stand within the noise
        of each other the error may have been -z as well as z; with the odds of the two the
        expectation is z tanh(z d / s^2).
        """
        distance = self.range_residuals(state) + self.range_m
        measured = self.graph.range_m
        self.range_m = measured * np.tanh(measured * np.maximum(distance, 0.0) / variance_m2)

    def tried_distances(self, state: State) -> Floats:
        """Distance of every attempt, (Q,)."""
        nothing = np.zeros(self._no_bias.size)
        return kernels.range_residuals(
            state.poses, np.zeros(1), *self._tries, nothing, self._no_bias
        )

    def heard_residuals(self, state: State) -> Floats:
        """Distance of every attempt less what its outcome says of it, (Q,)."""
        return kernels.range_residuals(
            state.poses, np.zeros(1), *self._tries, self.heard_m, self._no_bias
        )

    def tried_variances(self, state: State, covariance: Covariance) -> Floats:
        """Posterior variances of the attempts' distances, (Q,)."""
        return kernels.range_variances(
            state.poses,
            *self._tries,
            self._no_bias,
            covariance.diagonal,
            covariance.below,
            covariance.with_constants,
            covariance.constants,
        )

    def start_residuals(self, state: State) -> Floats:
        """Difference from the prior poses, (N, 3)."""
        difference: Floats = state.poses[0] - self.graph.start
        return difference

    @property
    def hears(self) -> bool:
        """Tell whether any attempt's outcome says something."""
        return bool(self.heard_weight.any())

    def squares(self, state: State, weights: Weights) -> float:
        """Half the weighted sum of squares: what is made least."""
        total = np.sum(weights.motion * self.motion_residuals(state) ** 2)
        total += np.sum(weights.ranges * self.range_residuals(state) ** 2)
        total += np.sum(self.graph.start_weight * self.start_residuals(state) ** 2)
        total += np.sum(weights.constants * state.constants**2)
        if self.hears:
            total += np.sum(self.heard_weight * self.heard_residuals(state) ** 2)
        return 0.5 * float(total)

    def constant_weights(self, levels: Levels) -> Floats:
        """1 / prior variances of the constants."""
        n = self.nodes
        return 1.0 / np.concatenate(
            (
                np.full(n, levels.scale),
                np.full(n, levels.drift_rad2_s2),
                [levels.common_bias_m2],
                np.full(len(self.graph.pairs), levels.pair_bias_m2),
            )
        )

    def normal_equations(self, state: State, weights: Weights) -> Equations:
        """Linearise everything at a state."""
        knots, n, b = self.graph.time_s.size, self.nodes, 3 * self.nodes
        a, e = np.zeros((knots, b, b)), np.zeros((knots - 1, b, b))
        border, corner = np.zeros((knots, b, self.constants)), np.diag(weights.constants)
        gradient = np.zeros((knots, b))
        corner_gradient = weights.constants * state.constants
        into = (a, e, border, corner, gradient, corner_gradient)
        kernels.add_motions(
            state.poses,
            state.constants[:n],
            state.constants[n : 2 * n],
            *self._motion,
            weights.motion,
            *into,
        )
        kernels.add_ranges(
            state.poses,
            state.constants[2 * n :],
            *self._ranges,
            self.range_m,
            self.graph.pair_index,
            weights.ranges,
            *into,
        )
        if self.hears:
            kernels.add_ranges(
                state.poses,
                np.zeros(1),
                *self._tries,
                self.heard_m,
                self._no_bias,
                self.heard_weight,
                *into,
            )
        diagonal = np.arange(b)
        a[0, diagonal, diagonal] += self.graph.start_weight.ravel()
        gradient[0] += (self.graph.start_weight * self.start_residuals(state)).ravel()
        if not self.estimate_constants:
            border, corner, corner_gradient = border[:, :, :0], corner[:0, :0], corner_gradient[:0]
        return Equations(a, e, border, corner, gradient, corner_gradient)

    def optimise(
        self, state: State, weights: Weights, *, steps: int = 20, tolerance: float = 1e-5
    ) -> tuple[State, int]:
        """Levenberg-Marquardt; returns the state and how many systems were solved.

        Ends when a step lowers the cost by less than ``tolerance`` of itself plus one part in a
        hundred of a single residual.
        """
        cost = self.squares(state, weights)
        damping, solved = 1e-6, 0
        while solved < steps:
            equations = self.normal_equations(state, weights)
            while solved < steps:
                solved += 1
                step = equations.solve(damping)
                if step is not None:
                    tried = State(
                        state.poses - step[0].reshape(state.poses.shape), state.constants.copy()
                    )
                    if step[1].size:
                        tried.constants -= step[1]
                    new_cost = self.squares(tried, weights)
                    if new_cost <= cost:
                        break
                damping = max(damping, 1e-7) * 30.0
                if damping > 1e8:
                    return state, solved
            else:
                return state, solved
            gain, state, cost = cost - new_cost, tried, new_cost
            damping = max(damping / 10.0, 1e-9)
            if gain <= tolerance * cost + 0.005:
                break
        return state, solved

    def covariance(self, state: State, weights: Weights) -> Covariance:
        """Covariance blocks at a state; RelposError where the run leaves something free."""
        equations = self.normal_equations(state, weights)
        return equations.covariance()

    def level_columns(self, state: State, force: Floats) -> tuple[Floats, Floats]:
        """Change of the gradient by the levels: see :func:`kernels.add_level_columns`."""
        knots, n = self.graph.time_s.size, self.nodes
        count = n * force.shape[2]
        columns, corner = np.zeros((knots, 3 * n, count)), np.zeros((self.constants, count))
        kernels.add_level_columns(
            state.poses,
            state.constants[:n],
            state.constants[n : 2 * n],
            *self._motion,
            force,
            AXIS,
            columns,
            corner,
        )
        return columns, corner if self.estimate_constants else corner[:0]

    def motion_variances(self, state: State, covariance: Covariance) -> Floats:
        """Posterior variances of the chords' residuals, (K - 1, N, 3)."""
        n = self.nodes
        return kernels.motion_variances(
            state.poses,
            state.constants[:n],
            state.constants[n : 2 * n],
            *self._motion,
            covariance.diagonal,
            covariance.below,
            covariance.with_constants,
            covariance.constants,
        )

    def range_variances(self, state: State, covariance: Covariance) -> Floats:
        """Posterior variances of the predicted ranges, (M,)."""
        return kernels.range_variances(
            state.poses,
            *self._ranges,
            self.graph.pair_index,
            covariance.diagonal,
            covariance.below,
            covariance.with_constants,
            covariance.constants,
        )


@dataclass
class Equations:
    """Normal equations by blocks, see :mod:`smoother_kernels`."""

    a: Floats
    e: Floats
    border: Floats
    corner: Floats
    gradient: Floats
    corner_gradient: Floats

    def _factorise(
        self, damping: float, further: Floats | None = None
    ) -> tuple[Floats, Floats, Floats] | None:
        b = self.a.shape[1]
        a = self.a
        if damping > 0.0:
            diagonal = np.arange(b)
            a = a.copy()
            a[:, diagonal, diagonal] *= 1.0 + damping
        parts = [self.border, self.gradient[:, :, None]]
        right = np.concatenate(parts if further is None else [*parts, further], axis=2)
        lower, w, v = np.empty_like(a), np.empty_like(self.e), np.empty_like(right)
        if not kernels.factorise(a, self.e, right, lower, w, v):
            return None
        return lower, w, v

    def solve(self, damping: float = 0.0) -> tuple[Floats, Floats] | None:
        """Solve M x = gradient: poses (K, b) and constants (G,); None if not definite."""
        factors = self._factorise(damping)
        if factors is None:
            return None
        lower, w, v = factors
        constants: Floats = np.zeros(0)
        if self.corner.size:
            border, last = v[:, :, :-1].reshape(-1, self.corner.shape[0]), v[:, :, -1].ravel()
            schur = self.corner + damping * np.diag(np.diag(self.corner)) - border.T @ border
            try:
                solved = np.linalg.solve(schur, self.corner_gradient - border.T @ last)
                constants = solved.astype(np.float64)
            except np.linalg.LinAlgError:
                return None
            side = last - border @ constants
        else:
            side = v[:, :, -1].ravel()
        x = kernels.back_substitute(lower, w, side.reshape(*v.shape[:2], 1))
        return x[:, :, 0], constants

    def covariance(self) -> Covariance:
        """Blocks of the inverse; RelposError if it does not exist."""
        knots, b, size = self.border.shape
        return self.covariance_and_solution(np.zeros((knots, b, 0)), np.zeros((size, 0)))[0]

    def covariance_and_solution(
        self, columns: Floats, corner_columns: Floats
    ) -> tuple[Covariance, Floats, Floats]:
        """Blocks of the inverse, and the inverse times columns (K, b, R) over (G, R)."""
        factors = self._factorise(0.0, columns)
        if factors is None:
            raise RelposError("the measurements leave part of the team's way undetermined")
        lower, w, v = factors
        size = self.corner.shape[0]
        side, v = v[:, :, size + 1 :], v[:, :, : size + 1]
        diagonal, below = kernels.selected_inverse(lower, w)
        b = lower.shape[1]
        pivots = lower[:, np.arange(b), np.arange(b)]
        log_determinant = -2.0 * float(np.log(pivots).sum())
        if not size:
            nothing = np.zeros((*lower.shape[:2], 0))
            found = Covariance(diagonal, below, nothing, np.zeros((0, 0)), log_determinant)
            solved = kernels.back_substitute(lower, w, np.ascontiguousarray(side))
            return found, solved, np.zeros((0, side.shape[2]))
        flat = v[:, :, :-1].reshape(-1, size)
        schur = self.corner - flat.T @ flat
        through = kernels.back_substitute(lower, w, np.ascontiguousarray(v[:, :, :-1]))
        constants: Floats = np.linalg.inv(schur).astype(np.float64)
        log_determinant += float(np.linalg.slogdet(schur)[1])
        with_constants = -(through @ constants)
        diagonal -= with_constants @ through.transpose(0, 2, 1)
        below -= with_constants[1:] @ through[:-1].transpose(0, 2, 1)
        found = Covariance(diagonal, below, with_constants, constants, log_determinant)
        solved_constants: Floats = constants @ (
            corner_columns - np.tensordot(v[:, :, :-1], side, axes=((0, 1), (0, 1)))
        )
        side = side - v[:, :, :-1] @ solved_constants
        solved = kernels.back_substitute(lower, w, np.ascontiguousarray(side))
        return found, solved, solved_constants


def _usual_length(length_m: Floats, walks: npt.NDArray[np.bool_], half: int = 3) -> Floats:
    """Mean length of the walked chords around each, (K - 1, N); 0 for a standing one.

    A chord that happened to be reported too short is not more certain than its neighbours.
    """
    kernel = np.ones(2 * half + 1)
    total = np.empty_like(length_m)
    for i in range(length_m.shape[1]):
        count = np.convolve(walks[:, i].astype(float), kernel, mode="full")[half:-half]
        summed = np.convolve(length_m[:, i] * walks[:, i], kernel, mode="full")[half:-half]
        total[:, i] = summed / np.maximum(count, 1.0)
    return np.where(walks, total, length_m)


def smooth(
    problem: Problem,
    state: State,
    levels: Levels | None = None,
    *,
    passes: int = 21,
    learn: bool = True,
    widen_m: tuple[float, ...] = (1.0, 0.5, 0.2),
) -> Solution:
    """Alternate between the best track at given levels and the levels at a given track.

    The first passes take the ranges ``widen_m`` wider, so that a wrong beginning can slide over
    what would hold it fast.
    """
    levels = (levels or problem.first_levels()).copy()
    state = state.copy()
    solved = 0
    problem.heard_weight = np.zeros_like(problem.heard_weight)
    inliers = np.ones(problem.graph.range_m.size)
    bases = problem.bases(state, levels)
    for turn in range(passes):
        wide = widen_m[turn] if turn < len(widen_m) else 0.0
        problem.unfold(state, levels.range_m2)
        weights = weigh(problem, levels, bases, inliers, wide)
        state, count = problem.optimise(state, weights, steps=12, tolerance=1e-4)
        solved += count
        bases = problem.bases(state, levels)
        if turn >= 1:
            inliers = judge(problem, state, levels, wide)
        if learn and turn >= len(widen_m) - 1:
            weights = weigh(problem, levels, bases, inliers, wide)
            covariance, knowledge = know(problem, state, levels, bases, weights)
            change = learn_levels(problem, state, covariance, knowledge, levels, weights, inliers)
            moved = math.inf
            if turn >= HEAR_FROM:
                relearn = (turn - HEAR_FROM) % HEAR_LEARNED == 0
                moved = hear(problem, state, covariance, relearn=relearn)
            if change < 0.02 and moved < HEARD_MOVED:
                break
    weights = weigh(problem, levels, bases, inliers, 0.0)
    state, count = problem.optimise(state, weights, steps=20, tolerance=1e-7)
    covariance, knowledge = know(problem, state, levels, bases, weights)
    cost = evidence(problem, state, levels, bases, covariance)
    return Solution(
        state,
        widened(covariance, knowledge),
        levels,
        cost,
        inliers,
        solved + count,
    )


def hearing_cost(problem: Problem, state: State, sigma_m: float = HEARING_BLUR_M) -> float:
    """Minus the log probability of who was heard and who was tried in vain.

    Over which distance who is heard is learned from these very distances, which are known to
    ``sigma_m``. It tells wrong modes, in which people stand near each other unheard. The
    optimisation itself does not use it: where all is well it adds nothing to the ranges.
    """
    tries = problem.graph.tries
    detection = Detection()
    distance = problem.tried_distances(state)
    weight = np.zeros(distance.size)
    for k, done in enumerate(tries.rounds):
        first, last = tries.first[k], tries.first[k + 1]
        middle = first + len(done.received)
        weight[first:middle] = done.observable
        weight[middle:last] = detection.update(
            done, distance[first:last], np.full(last - first, sigma_m)
        )
    chance = detection.probability(distance, sigma_m)
    outcome = np.where(tries.silent, np.log1p(-chance), np.log(chance))
    return -float(detection.weight * np.sum(weight * outcome))


def _learned_curve(problem: Problem, distance_m: Floats, sigma_m: Floats) -> tuple[Floats, Floats]:
    """P(heard) over distance as ``Detection`` tabulates it, and what each attempt counts, (Q,)."""
    tries = problem.graph.tries
    detection = Detection()
    weight = np.zeros(distance_m.size)
    for k, done in enumerate(tries.rounds):
        first, last = tries.first[k], tries.first[k + 1]
        middle = first + len(done.received)
        weight[first:middle] = done.observable
        weight[middle:last] = detection.update(done, distance_m[first:last], sigma_m[first:last])
    curve = np.convolve(np.pad(detection.curve, 3, mode="edge"), _BLUR, mode="valid")
    return curve, HEAR_SHARE * detection.weight * weight


def hear(problem: Problem, state: State, covariance: Covariance, *, relearn: bool = True) -> float:
    """Turn every attempt's outcome into a Gaussian of its distance; return the greatest change.

    Expectation propagation: with the distance's posterior N(m, v) freed of what this outcome has
    said before, its product with P(outcome | distance) is matched in mean and variance. The curve
    is learned anew from the state where ``relearn`` says so.
    """
    tries = problem.graph.tries
    distance = problem.tried_distances(state)
    if not distance.size or not tries.silent.any():
        return 0.0
    variance = np.maximum(problem.tried_variances(state, covariance), 1e-6)
    sigma = np.sqrt(variance)
    if relearn:
        problem.heard_curve = _learned_curve(problem, distance, sigma)
    curve, weight = problem.heard_curve
    old, old_m = problem.heard_weight, problem.heard_m
    precision = np.maximum(1.0 / variance - old, 0.1 / variance)
    mean = (distance / variance - old * old_m) / precision
    deviation = 1.0 / np.sqrt(precision)
    place = np.maximum(mean[:, None] + deviation[:, None] * _NODES, 0.0)
    chance = np.interp(place, _HEARD_M, curve)
    outcome = np.where(tries.silent[:, None], np.log1p(-chance), np.log(chance))
    mass = _NODE_SHARES * np.exp(weight[:, None] * outcome)
    mass /= mass.sum(axis=1, keepdims=True)
    z = mass @ _NODES
    spread = np.maximum(mass @ _NODES**2 - z**2, 1e-3)
    new = np.clip(1.0 / spread - 1.0, 0.0, 20.0) * precision
    pull = (z / spread) / deviation + mean * new
    telling = (new * variance > 1e-3) | (np.abs(pull - new * distance) * sigma > 1e-2)
    new = np.where(telling, old + HEAR_STEP * (np.maximum(new, 1e-6) - old), 0.0)
    pull = np.where(telling, old * old_m + HEAR_STEP * (pull - old * old_m), 0.0)
    moved = np.abs(pull - new * distance - old * (old_m - distance)) * sigma
    problem.heard_weight = new
    problem.heard_m = np.where(telling, pull / np.where(telling, new, 1.0), 0.0)
    return float(moved.max())


def weigh(
    problem: Problem, levels: Levels, bases: Floats, inliers: Floats, wide_m: float
) -> Weights:
    """1 / variance of everything at these levels; outliers count for nothing."""
    return Weights(
        1.0 / problem.variances(bases, levels),
        inliers / (levels.colour * levels.range_m2 + wide_m**2),
        problem.constant_weights(levels),
    )


def _range_densities(
    problem: Problem, state: State, levels: Levels, wide_m: float
) -> tuple[Floats, float]:
    """Density of each range's residual as a good one, and as an outlier, by their shares."""
    variance = levels.range_m2 + wide_m**2
    measured = problem.graph.range_m
    predicted = problem.range_residuals(state) + problem.range_m
    good = np.exp(-0.5 * (predicted - measured) ** 2 / variance)
    good += np.exp(-0.5 * (predicted + measured) ** 2 / variance)
    good /= math.sqrt(2.0 * math.pi * variance)
    span = max(SPAN_M, 10.0 * math.sqrt(variance))
    return (1.0 - levels.outliers) * good, levels.outliers / span


def judge(problem: Problem, state: State, levels: Levels, wide_m: float = 0.0) -> Floats:
    """Probability of each range to be no outlier, (M,)."""
    good, outlier = _range_densities(problem, state, levels, wide_m)
    return good / (good + outlier)


@dataclass
class Knowledge:
    """What the data say of the L = 7 N motion levels' logarithms, at one state.

    ``shares`` (K - 1, N, 7) of each level in its residual's variance, ``information`` (L, L),
    ``poses`` (K, b, L) and ``constants`` (G, L) the change of the solution with each.
    """

    shares: Floats
    information: Floats
    poses: Floats
    constants: Floats


def know(
    problem: Problem, state: State, levels: Levels, bases: Floats, weights: Weights
) -> tuple[Covariance, Knowledge]:
    """Give the covariance, and by how much the levels move the solution."""
    w = weights.motion[..., AXIS]
    shares = bases * levels.motion * problem.graph.news[..., None] * w
    # Where a reported deviation is the larger one, no level matters.
    shares = np.where(problem.told(bases, levels)[..., AXIS], 0.0, shares)
    residual = problem.motion_residuals(state)[..., AXIS]
    columns, corner = problem.level_columns(state, shares * residual * w)
    equations = problem.normal_equations(state, weights)
    covariance, solved, constants = equations.covariance_and_solution(columns, corner)
    count = columns.shape[2]
    forced = shares * residual * np.sqrt(w)
    own = np.einsum("knl,knm->nlm", forced, forced) * (AXIS[:, None] == AXIS)
    information = -(columns.reshape(-1, count).T @ solved.reshape(-1, count) + corner.T @ constants)
    for n in range(problem.nodes):
        at = slice(n * AXIS.size, (n + 1) * AXIS.size)
        information[at, at] += own[n]
    return covariance, Knowledge(shares, 0.5 * information, solved, constants)


def _prior_precision(nodes: int) -> Floats:
    """Precision (7 N + 7) of the logarithms of all levels, then of the team's means."""
    count = nodes * AXIS.size
    a, first = SPREAD_TEAM**-2, SPREAD_FIRST**-2
    result = np.zeros((count + AXIS.size, count + AXIS.size))
    result[:count, :count] = a * np.eye(count)
    cross = -a * np.tile(np.eye(AXIS.size), (nodes, 1))
    result[:count, count:], result[count:, :count] = cross, cross.T
    result[count:, count:] = (nodes * a + first) * np.eye(AXIS.size)
    return result


def step_levels(
    problem: Problem,
    state: State,
    covariance: Covariance,
    knowledge: Knowledge,
    levels: Levels,
    weights: Weights,
) -> float:
    """One Newton step of the motion levels' logarithms."""
    w = weights.motion
    posterior = problem.motion_variances(state, covariance)
    square = w * problem.motion_residuals(state) ** 2
    free = np.maximum(1.0 - posterior * w, 0.0)
    slope = 0.5 * np.sum(knowledge.shares * (square - free)[..., AXIS], axis=0)
    count = slope.size
    precision = _prior_precision(problem.nodes)
    value = np.log(levels.motion)
    # The team's means are where the nodes' levels have them.
    n, a, first = problem.nodes, SPREAD_TEAM**-2, SPREAD_FIRST**-2
    mean = (a * value.sum(axis=0) + first * np.log(FIRST_MOTION)) / (n * a + first)
    gradient = np.concatenate(((slope - a * (value - mean)).ravel(), np.zeros(AXIS.size)))
    precision[:count, :count] += knowledge.information
    least = np.tile(np.log(LEAST_MOTION), n)
    stuck = (value.ravel() <= least + 1e-9) & (gradient[:count] < 0.0)
    keep = np.append(~stuck, np.ones(AXIS.size, dtype=bool))
    step = np.zeros(count + AXIS.size)
    step[keep] = np.linalg.solve(precision[np.ix_(keep, keep)], gradient[keep])
    moved = np.clip(step[:count], -MOST_STEP, MOST_STEP)
    new = np.maximum(value.ravel() + moved, least)
    important = knowledge.shares.sum(axis=0).ravel() > 1.0
    change = float(np.max(np.abs(new - value.ravel()) * important, initial=0.0))
    levels.motion = np.exp(new).reshape(value.shape)
    return change


def widened(covariance: Covariance, knowledge: Knowledge) -> Covariance:
    """Add to a covariance what the levels' own uncertainty makes of the solution."""
    count = knowledge.poses.shape[2]
    precision = _prior_precision(count // AXIS.size)
    precision[:count, :count] += knowledge.information
    unknown = np.linalg.inv(precision)[:count, :count]
    root = np.linalg.cholesky(0.5 * (unknown + unknown.T))
    poses, constants = knowledge.poses @ root, knowledge.constants @ root
    return Covariance(
        covariance.diagonal + poses @ poses.transpose(0, 2, 1),
        covariance.below + poses[1:] @ poses[:-1].transpose(0, 2, 1),
        covariance.with_constants + poses @ constants.T,
        covariance.constants + constants @ constants.T,
        covariance.log_determinant,
    )


def learn_levels(
    problem: Problem,
    state: State,
    covariance: Covariance,
    knowledge: Knowledge,
    levels: Levels,
    weights: Weights,
    inliers: Floats,
) -> float:
    """Move every level towards the greatest marginal likelihood; return the largest change.

    The fixed point of a level c whose share in a variance v is c u:

        c <- c sum(u r^2 / v^2) / sum(u (1 - p / v) / v)

    over its residuals r with posterior variances p (for the square root of the quotient, and
    with p = v - ..., Zhou et al. 2019 show ascent; the quotient itself is Foerstner's).
    """
    change = step_levels(problem, state, covariance, knowledge, levels, weights)
    if inliers.size:
        residual_m = problem.range_residuals(state)
        posterior_m = problem.range_variances(state, covariance)
        v = levels.range_m2
        # A sign that is not known adds to the error what it may have turned round.
        unsigned = problem.graph.range_m**2 - problem.range_m**2
        up = float(np.sum(inliers * (residual_m**2 + unsigned))) + COUNT_RANGES * FIRST_RANGE
        down = float(np.sum(inliers * np.maximum(1.0 - posterior_m * inliers / v, 0.0)))
        new_v = max(float(np.clip(up / (down + COUNT_RANGES), 0.1 * v, 10.0 * v)), 0.01**2)
        change = max(change, abs(math.log(new_v / v)))
        levels.range_m2 = new_v
        levels.colour = _colour(problem, state, covariance, residual_m, posterior_m, inliers)
        n = problem.nodes
        if problem.estimate_constants:
            spread = np.diag(covariance.constants)
            for name, part, first in (
                ("scale", slice(0, n), TO_SCALE if levels.to_scale else FIRST_SCALE),
                ("drift_rad2_s2", slice(n, 2 * n), FIRST_DRIFT),
                (
                    "pair_bias_m2",
                    slice(2 * n + 1, None),
                    CALIBRATED_PAIR if levels.calibrated else FIRST_PAIR_BIAS,
                ),
            ):
                old_t = getattr(levels, name)
                up = float(np.sum(state.constants[part] ** 2)) + COUNT_CONSTANTS * first
                down = float(np.sum(np.maximum(1.0 - spread[part] / old_t, 0.0)))
                new_t = float(np.clip(up / (down + COUNT_CONSTANTS), 0.1 * old_t, 10.0 * old_t))
                setattr(levels, name, min(max(new_t, 1e-4 * first), 4.0 * first))
        levels.outliers = float((np.sum(1.0 - inliers) + 0.5) / (inliers.size + 50.0))
    return change


def _colour(
    problem: Problem,
    state: State,
    covariance: Covariance,
    residual_m: Floats,
    posterior_m2: Floats,
    inliers: Floats,
) -> float:
    """How much longer than one range the errors of a pair last, as a factor of their variance.

    The product of two consecutive errors is on average that of the residuals plus the posterior
    covariance of the two predictions.
    """
    graph = problem.graph
    keeps = _kept(problem, state, covariance)
    together = apart = 0.0
    for k in range(len(graph.pairs)):
        own = np.flatnonzero((graph.pair_index == k) & (inliers > 0.5))
        r, p, slot = residual_m[own], np.sqrt(posterior_m2[own]), graph.slot[own]
        same = keeps[own[1:]] ** np.diff(slot)
        together += float(np.sum(r[1:] * r[:-1] + same * p[1:] * p[:-1]))
        apart += float(np.sum(r**2 + p**2))
    rho = min(max(together / apart, 0.0), MOST_COLOUR) if apart > 0.0 else 0.0
    return (1.0 + rho) / (1.0 - rho)


def _kept(problem: Problem, state: State, covariance: Covariance) -> Floats:
    """Posterior correlation of each range's distance with itself one knot earlier, (M,)."""
    graph, nodes = problem.graph, problem.nodes
    slot, (i, j) = graph.slot, graph.pair.T
    apart = state.poses[slot + 1, i, :2] - state.poses[slot + 1, j, :2]
    unit = apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-9)[:, None]

    def along(blocks: Floats, where: npt.NDArray[np.int64]) -> Floats:
        parts = blocks.reshape(-1, nodes, 3, nodes, 3)
        difference = parts[where, i, :2, i, :2] + parts[where, j, :2, j, :2]
        difference = difference - parts[where, i, :2, j, :2] - parts[where, j, :2, i, :2]
        result: Floats = np.einsum("ma,mab,mb->m", unit, difference, unit)
        return result

    late, early = along(covariance.diagonal, slot + 1), along(covariance.diagonal, slot)
    cross = along(covariance.below, slot)
    return np.clip(cross / np.sqrt(np.maximum(late * early, 1e-18)), 0.0, 1.0)


def evidence(
    problem: Problem, state: State, levels: Levels, bases: Floats, covariance: Covariance
) -> float:
    """Minus the log marginal likelihood by Laplace's method, up to the run's own constant."""
    variance = problem.variances(bases, levels)
    total = 0.5 * np.sum(problem.motion_residuals(state) ** 2 / variance + np.log(variance))
    good, outlier = _range_densities(problem, state, levels, 0.0)
    total -= np.sum(np.log(good + outlier))
    prior = problem.constant_weights(levels)
    if problem.estimate_constants:
        total += 0.5 * np.sum(prior * state.constants**2 - np.log(prior))
        # A chord's noise is so wide in reported metres; as a density of where it ends, in true
        # ones, it is exp(2 c) times as wide. Without this every longer team would be likelier.
        total += 2.0 * variance.shape[0] * float(np.sum(state.constants[: problem.nodes]))
    total += hearing_cost(problem, state)
    start = problem.graph.start_weight
    total += 0.5 * np.sum(start * problem.start_residuals(state) ** 2)
    return float(total + 0.5 * covariance.log_determinant)
