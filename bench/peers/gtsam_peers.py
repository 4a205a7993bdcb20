"""GTSAM: the same poses and factors as relpos' smoother, in one batch or over a fixed lag."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from case import Case, Floats, Instant, Score, score


def _key(gtsam: Any, node: int, t: int) -> int:
    return int(gtsam.symbol(chr(ord("a") + node % 26), (node // 26) * 1_000_000 + t))


def _between(gtsam: Any, motion: Floats, sigma: Floats) -> Any:
    """Noise of one motion, seen from its end: a turn's error turns the step with it."""
    forward, left, turn = motion
    c, s = np.cos(turn), np.sin(turn)
    # The displacement in the frame of its end, and the direction of the step there.
    x, y = c * forward + s * left, c * left - s * forward
    along = np.arctan2(y, x)
    ca, sa = np.cos(along), np.sin(along)
    g = np.array([[ca, -sa, -y], [sa, ca, x], [0.0, 0.0, 1.0]])
    return gtsam.noiseModel.Gaussian.Covariance(g @ np.diag(sigma**2) @ g.T)


def _motion_factors(gtsam: Any, graph: Any, case: Case, t: int) -> None:
    for i in range(case.nodes):
        motion = case.motions[t, i]
        graph.add(
            gtsam.BetweenFactorPose2(
                _key(gtsam, i, t), _key(gtsam, i, t + 1), gtsam.Pose2(*motion),
                _between(gtsam, motion, case.sigmas[t, i]),
            )
        )  # fmt: skip


def _range_factors(gtsam: Any, graph: Any, ranges: Instant, t: int, noise: Any) -> None:
    for i, j, z in zip(ranges.node, ranges.peer, ranges.range_m, strict=True):
        graph.add(
            gtsam.RangeFactorPose2(
                _key(gtsam, int(i), t + 1), _key(gtsam, int(j), t + 1), float(z), noise
            )
        )


def batch(case: Case, begin_m: Floats) -> Score:
    """Levenberg-Marquardt over the whole run from poses (T + 1, N, 3)."""
    import gtsam

    started = time.process_time()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    exact = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, case.sigma_range_m)
    for i, pose in enumerate(case.truth[0]):
        graph.add(gtsam.PriorFactorPose2(_key(gtsam, i, 0), gtsam.Pose2(*pose), exact))
    for t, ranges in enumerate(case.ranges):
        _motion_factors(gtsam, graph, case, t)
        if ranges is not None:
            _range_factors(gtsam, graph, ranges, t, noise)
    for t, row in enumerate(begin_m):
        for i, pose in enumerate(row):
            values.insert(_key(gtsam, i, t), gtsam.Pose2(*pose))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    spent = time.process_time() - started
    at = np.array(
        [
            [result.atPose2(_key(gtsam, i, t)).translation() for i in range(case.nodes)]
            for t in range(1, len(case.truth))
        ]
    )
    return score(case, at, 1e6 * spent / case.epochs)


class FixedLag:
    """A fixed-lag smoother as a filter: the newest poses count."""

    def __init__(self, case: Case, seed: int, lag_s: float, incremental: bool) -> None:
        import gtsam

        self.g, self.case, self.t = gtsam, case, 0
        self.smoother = (
            gtsam.IncrementalFixedLagSmoother(lag_s)
            if incremental
            else gtsam.BatchFixedLagSmoother(lag_s)
        )
        self.noise = gtsam.noiseModel.Isotropic.Sigma(1, case.sigma_range_m)
        self.graph, self.values, self.stamps = self._empty()
        exact = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
        self.last = [gtsam.Pose2(*pose) for pose in case.truth[0]]
        for i, pose in enumerate(self.last):
            self.graph.add(gtsam.PriorFactorPose2(_key(gtsam, i, 0), pose, exact))
            self._new(i, 0, pose)

    def _empty(self) -> tuple[Any, Any, dict[int, float]]:
        return self.g.NonlinearFactorGraph(), self.g.Values(), {}

    def _new(self, node: int, t: int, pose: Any) -> None:
        key = _key(self.g, node, t)
        self.values.insert(key, pose)
        self.stamps[key] = float(t)

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """Add the poses of the next second."""
        _motion_factors(self.g, self.graph, self.case, self.t)
        self.t += 1
        for i, moved in enumerate(motion):
            self.last[i] = self.last[i].compose(self.g.Pose2(*moved))
            self._new(i, self.t, self.last[i])

    def update(self, ranges: Instant) -> None:
        """Add the ranges and optimise."""
        _range_factors(self.g, self.graph, ranges, self.t - 1, self.noise)
        self.smoother.update(self.graph, self.values, self.stamps)
        self.graph, self.values, self.stamps = self._empty()
        for i in range(self.case.nodes):
            self.last[i] = self.smoother.calculateEstimatePose2(_key(self.g, i, self.t))

    def positions(self) -> Floats:
        """Newest poses."""
        return np.array([pose.translation() for pose in self.last])
