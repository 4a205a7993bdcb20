"""relpos' own contenders, arrays in and out, and through its public interface."""

from __future__ import annotations

import time

import numpy as np

from case import Case, Floats, Instant, Score, score
from relpos import fusion


class Joint:
    """The bank's core with a single hypothesis, noise known; fault detection and learning go on."""

    def __init__(self, case: Case, seed: int) -> None:
        from relpos.fusion.bank.core import BankCore
        from relpos.fusion.estimator_settings import BankSettings

        alone = BankSettings(hypotheses=1, constants=0.0, outliers=0.0, biased=0.0)
        self.core = BankCore(alone, seed)
        for pose in case.truth[0]:
            x, y, heading = map(float, pose)
            self.core.add_node((x, y, heading), 1e-3, 1e-3)
        self.variance = case.sigma_range_m**2
        self.rows, self.ones = np.arange(case.nodes), np.ones(case.nodes)

    def pose(self) -> Floats:
        """Poses (N, 3)."""
        return self.core.hypotheses.poses_of(*self.rows.tolist())[0][0].reshape(-1, 3)

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """Move everybody with known noise."""
        self.core.hypotheses.arrays.component[:] = 1.0
        self.core.move(self.rows, np.column_stack([motion, self.ones]), sigma)

    def update(self, ranges: Instant) -> None:
        """Ranges one after another, to second order."""
        from relpos.fusion.models.ranging import Repeats

        count = ranges.node.size
        self.core.hypotheses.arrays.range_variance[:] = self.variance
        nought, repeats = np.zeros(count), Repeats(np.ones(count), np.zeros(count))
        no_velocity, no_outliers = np.zeros((count, 4)), np.zeros((count, 3))
        self.core.update(
            ranges.node, ranges.peer, ranges.range_m, nought, nought, repeats, no_velocity,
            no_outliers,
        )  # fmt: skip

    def positions(self) -> Floats:
        """Means."""
        return self.pose()[:, :2]


class JointAlone(Joint):
    """The same filter without watching for slips and learning of noise: its kernels alone."""

    def __init__(self, case: Case, seed: int) -> None:
        super().__init__(case, seed)
        self.arrays = self.core.hypotheses.arrays
        self.arrays.component[:], self.arrays.range_variance[:] = 1.0, self.variance
        self.outlier = np.array([1e-9, 9.0, 0.1, 1.0, 9.0])

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """Move everybody with known noise."""
        from relpos.fusion.bank import motion_update
        from relpos.fusion.models.motion_variances import base_variances

        moved = np.empty((len(motion), 7))
        moved[:, :3], moved[:, 3] = motion, self.ones
        moved[:, 4:] = base_variances(np.ascontiguousarray(moved[:, :4]), sigma)
        noise = motion_update.Noise(np.zeros((1, len(motion))), 0.0, 0.0)
        motion_update.advance(self.arrays, self.rows, moved, noise)

    def update(self, ranges: Instant) -> None:
        """Ranges one after another, to second order."""
        from relpos.fusion.bank import lanes, range_update

        count = ranges.node.size
        those = range_update.Ranges(
            ranges.node, ranges.peer, ranges.range_m, np.zeros(count), np.zeros(count),
            np.ones(count), np.zeros(count), np.full((count, 3), -1), np.zeros((count, 4)),
            np.tile([self.outlier[0], 0.0, 0.0], (count, 1)),
        )  # fmt: skip
        model = range_update.RangeModel(self.outlier, np.zeros((0, 2)))
        stats = lanes.empty_lines(count, range_update.STATS, 1)
        range_update.update(self.arrays, those, model, stats)


class Strips:
    """The filter for large teams, noise known."""

    def __init__(self, case: Case, seed: int) -> None:
        from relpos.fusion.large_teams.kernels import RangeModel
        from relpos.fusion.large_teams.sparse_filter import NeighbourhoodFilter

        longest = max(float(r.range_m.max()) for r in case.ranges if r is not None)
        self.filter = NeighbourhoodFilter(1.05 * longest, RangeModel(case.sigma_range_m))
        self.filter.add(case.truth[0].copy(), np.zeros((case.nodes, 3, 3)))
        self.rows = np.arange(case.nodes)

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """Move everybody."""
        # Noise along the way and across it, as the axes of the body see them.
        way = np.maximum(np.hypot(motion[:, 0], motion[:, 1]), 1e-9)
        share = motion[:, :2] / way[:, None]
        seen = np.hypot(share * sigma[:, :1], share[:, ::-1] * sigma[:, 1:2])
        still = np.zeros((len(motion), 1))
        self.filter.predict(self.rows, np.concatenate([motion, seen, sigma[:, 2:], still], axis=1))

    def update(self, ranges: Instant) -> None:
        """All ranges of the instant at once."""
        from relpos.fusion.large_teams.kernels import Ranges

        count, terms = ranges.node.size, len(self.filter.terms)
        level, same, no_outliers, no_slopes = (
            np.zeros(count),
            np.ones(count),
            np.zeros((count, 3)),
            np.zeros((count, terms)),
        )
        self.filter.update(
            Ranges(
                ranges.node, ranges.peer, ranges.range_m, level, same, level, no_outliers, no_slopes
            )
        )

    def positions(self) -> Floats:
        """Means."""
        return self.filter.pose[:, :2]


class Particles:
    """The paper's filter: 3 states a particle, M particles for each user."""

    def __init__(self, case: Case, seed: int, size: int, alpha: float) -> None:
        from relpos.fusion.estimator_settings import ParticleSettings
        from relpos.fusion.particle.particle_set import ParticleSet

        settings = ParticleSettings(size, alpha, particle_sigma(case))
        self.particles = ParticleSet(settings, np.random.default_rng(seed))
        for pose in case.truth[0]:
            self.particles.add(np.repeat(pose[:, None], size, axis=1))
        self.rows = np.arange(case.nodes)

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """Move every particle with its own noise."""
        self.particles.predict(self.rows, motion, particle_motion(sigma))

    def update(self, ranges: Instant) -> None:
        """Weigh by the neighbours' means, resample."""
        self.particles.update(ranges.node, ranges.peer, ranges.range_m, np.zeros(ranges.node.size))

    def positions(self) -> Floats:
        """Weighted means."""
        at: Floats = np.einsum("akm,km->ka", self.particles.poses[:2], self.particles.weights)
        return at


def particle_sigma(case: Case) -> float:
    """Range sigma for filters that take their neighbours' means as positions.

    The paper's own: it includes the errors of the means.
    """
    return max(2.0 * case.sigma_range_m, 0.5)


def particle_motion(sigma: Floats) -> Floats:
    """Noise for particles: 2 cm and a degree more than stated, against collapse of the set."""
    return np.hypot(sigma, [0.02, 0.02, 0.0175])


def through_interface(case: Case, name: str, settings: dict[str, object], seed: int) -> Score:
    """Measurement by measurement, estimates included; noise unknown."""
    made = fusion.make(name, case.priors, settings, seed)
    estimated = case.truth[1:, :, :2].copy()
    begin = time.process_time()
    estimates = [e for m in case.measurements for e in made.process(m)]
    estimates += made.finish()
    spent = time.process_time() - begin
    for e in estimates:
        t = round(e.time_s) - 1
        if 0 <= t < len(estimated):
            estimated[t] = [(n.x_m, n.y_m) for n in e.nodes]
    return score(case, estimated, 1e6 * spent / case.epochs)


def begin_of(case: Case) -> Floats:
    """Poses (T + 1, N, 3) that the smoothers begin from: the joint filter's own run."""
    filter_ = JointAlone(case, 0)
    poses = [case.truth[0]]
    for motion, sigma, ranges in case.instants():
        filter_.predict(motion, sigma)
        if ranges is not None:
            filter_.update(ranges)
        poses.append(filter_.pose().copy())
    return np.stack(poses)


def smoother(case: Case, begin_m: Floats) -> Score:
    """The smoother's optimiser on the full run, noise known, from the given poses (T + 1, N, 3)."""
    from relpos.fusion.smoother.graph import build_graph
    from relpos.fusion.smoother.problem import Problem, Weights

    def solve() -> tuple[Floats, float]:
        started = time.process_time()
        graph, _ = build_graph(case.measurements, case.priors)
        problem = Problem(graph)
        sigma = case.sigmas[:, :, [0, 1, 2]]
        weights = Weights(
            1.0 / sigma**2,
            np.full(graph.range_m.size, 1.0 / case.sigma_range_m**2),
            # The peers know no step scales, drifts or biases: here they are held at zero.
            np.full(problem.constants, 1e12),
        )
        unwrapped = begin_m.copy()
        state = problem.optimise(problem.first_state(unwrapped), weights, steps=100)
        return state.poses, time.process_time() - started

    solve()  # compiles
    poses, spent = solve()
    return score(case, poses[1:, :, :2], 1e6 * spent / case.epochs)
