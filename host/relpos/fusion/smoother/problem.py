"""A run's nonlinear least-squares problem: residuals, normal equations, Levenberg-Marquardt."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.smoother import kernels
from relpos.fusion.smoother.block_solver import Equations
from relpos.fusion.smoother.graph import Graph
from relpos.fusion.smoother.kernels import State


class Weights(NamedTuple):
    """1 / variance of chords (K - 1, N, 3), ranges (M,), ``Problem.independent`` constants (G,)."""

    motion: Floats
    ranges: Floats
    constants: Floats


class Inliers(NamedTuple):
    """What ranges and reports are: as noise has them, or outliers and odometry faults."""

    ranges: Floats
    """(M,) probability of each range to be no outlier."""
    reports: Floats
    """(K - 1, N) probability of each chord to be no fault."""
    followed: float = 0.0
    """Expected number of outliers that follow another."""
    log_likelihood: float = 0.0
    """Of all ranges and reports."""

    @classmethod
    def all_of(cls, graph: Graph) -> Inliers:
        """Take everything for an inlier."""
        return cls(np.ones(graph.range_m.size), np.ones(graph.has_report.shape))


class DetectionFactors(NamedTuple):
    """What each attempt's outcome says of its distance, as a Gaussian (Q,); weight 0: nothing."""

    mean_m: Floats
    weight: Floats


class Places(NamedTuple):
    """Where ``State.constants`` and ``Problem.independent`` of them have each kind."""

    drift: slice
    common_bias: int
    growth: int
    pair_bias: slice
    first_scale: slice
    scale_step: slice
    """In ``State.constants`` the scales of the later parts."""


class Problem:
    """The factors of a graph, with what has been learned of the ranges meanwhile.

    ``range_m`` (M,) are the measured ranges with their expected signs (:meth:`resolve_signs`),
    ``detection`` is what the attempts say (:mod:`relpos.fusion.smoother.detection`).
    """

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.nodes = len(graph.node_ids)
        self.independent = graph.independent_constants()
        self.constants = len(self.independent)
        n, scales = self.nodes, int(graph.chords.scale_at[0])
        self.places = Places(
            slice(0, n), n, n + 1, slice(n + 2, scales),
            slice(scales, scales + n), slice(scales + n, None),
        )  # fmt: skip
        self.range_m = graph.range_m.copy()
        self.detection = self.no_detection()

    def no_detection(self) -> DetectionFactors:
        """Return factors that say nothing."""
        attempts = self.graph.attempts.missed.size
        return DetectionFactors(np.zeros(attempts), np.zeros(attempts))

    def first_state(self, poses: Floats) -> State:
        """Begin at these poses, constants zero."""
        return State(poses.copy(), np.zeros(self.constants))

    def motion_residuals(self, state: State) -> Floats:
        """Residuals of the chords, (K - 1, N, 3)."""
        return kernels.motion_residuals(state, self.graph.chords)

    def range_residuals(self, state: State) -> Floats:
        """Predicted less measured ranges, (M,)."""
        return kernels.range_residuals(state, self.graph.ranges, self.range_m)

    def prior_residuals(self, state: State) -> Floats:
        """Difference from the prior poses, (N, 3)."""
        difference: Floats = state.poses[0] - self.graph.prior
        return difference

    def attempt_distances(self, state: State) -> Floats:
        """Distance of every attempt, (Q,)."""
        nothing = np.zeros(self.detection.weight.size)
        return kernels.range_residuals(state, self.graph.attempts.ranges, nothing)

    def resolve_signs(self, state: State, variance_m2: float) -> None:
        """Give near ranges their expected sign.

        A chip reports no negative distance. The error of a range z between two nodes within the
        noise of each other may have been -z as well as z; with the odds of the two the
        expectation is z tanh(z d / s^2).
        """
        distance = self.range_residuals(state) + self.range_m
        measured = self.graph.range_m
        self.range_m = measured * np.tanh(measured * np.maximum(distance, 0.0) / variance_m2)

    def cost(self, state: State, weights: Weights) -> float:
        """Half the weighted sum of squares: what is minimised."""
        total = np.sum(weights.motion * self.motion_residuals(state) ** 2)
        total += np.sum(weights.ranges * self.range_residuals(state) ** 2)
        total += np.sum(self.graph.prior_weight * self.prior_residuals(state) ** 2)
        total += np.sum(weights.constants * (self.independent @ state.constants) ** 2)
        if self.detection.weight.any():
            residual = kernels.range_residuals(
                state, self.graph.attempts.ranges, self.detection.mean_m
            )
            total += np.sum(self.detection.weight * residual**2)
        return 0.5 * float(total)

    def normal_equations(self, state: State, weights: Weights) -> Equations:
        """Linearise everything at a state."""
        graph, knots, b = self.graph, self.graph.time_s.size, 3 * self.nodes
        precision = self.independent.T @ (weights.constants[:, None] * self.independent)
        equations = Equations(
            a=np.zeros((knots, b, b)),
            e=np.zeros((knots - 1, b, b)),
            border=np.zeros((knots, b, self.constants)),
            corner=precision,
            gradient=np.zeros((knots, b)),
            corner_gradient=precision @ state.constants,
        )
        kernels.add_motions(state, graph.chords, weights.motion, equations)
        kernels.add_ranges(state, graph.ranges, self.range_m, weights.ranges, equations)
        if self.detection.weight.any():
            kernels.add_ranges(state, graph.attempts.ranges, *self.detection, equations)
        diagonal = np.arange(b)
        equations.a[0, diagonal, diagonal] += graph.prior_weight.ravel()
        equations.gradient[0] += (graph.prior_weight * self.prior_residuals(state)).ravel()
        return equations

    def optimise(
        self, state: State, weights: Weights, *, steps: int = 20, tolerance: float = 1e-5
    ) -> State:
        """Levenberg-Marquardt, at most ``steps`` systems.

        Ends when a step lowers the cost by less than ``tolerance`` of itself plus one part in a
        hundred of a single residual.
        """
        cost = self.cost(state, weights)
        damping, solved = 1e-6, 0
        while solved < steps:
            equations = self.normal_equations(state, weights)
            while solved < steps:
                solved += 1
                step = equations.solve(damping)
                if step is not None:
                    moved = State(
                        state.poses - step[0].reshape(state.poses.shape), state.constants - step[1]
                    )
                    new_cost = self.cost(moved, weights)
                    if new_cost <= cost:
                        break
                damping = max(damping, 1e-7) * 30.0
                if damping > 1e8:
                    return state
            else:
                return state
            gain, state, cost = cost - new_cost, moved, new_cost
            damping = max(damping / 10.0, 1e-9)
            if gain <= tolerance * cost + 0.005:
                break
        return state
