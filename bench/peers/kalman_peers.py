"""filterpy and Stone Soup: joint filters of 3 states a user (x, y, heading), noise known."""

from __future__ import annotations

import datetime

import numpy as np

from case import Case, Floats, Instant


def moved(x: Floats, motion: Floats) -> Floats:
    """Move states (3N,) x, y, heading of every user by body-frame displacements (N, 3)."""
    pose = x.reshape(-1, 3)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return np.stack(
        [
            pose[:, 0] + c * motion[:, 0] - s * motion[:, 1],
            pose[:, 1] + s * motion[:, 0] + c * motion[:, 1],
            pose[:, 2] + motion[:, 2],
        ],
        axis=1,
    ).reshape(-1)


def jacobian_and_noise(x: Floats, motion: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """F and Q of :func:`moved`; the turn's noise enters before the displacement."""
    count = len(motion)
    heading = x.reshape(-1, 3)[:, 2]
    c, s = np.cos(heading), np.sin(heading)
    east, north = c * motion[:, 0] - s * motion[:, 1], s * motion[:, 0] + c * motion[:, 1]
    f = np.eye(3 * count)
    at = 3 * np.arange(count)
    f[at, at + 2], f[at + 1, at + 2] = -north, east
    g = np.zeros((count, 3, 3))
    # Noise of a step is along it, whatever the body's heading is: the user has turned.
    along = np.arctan2(north, east)
    ca, sa = np.cos(along), np.sin(along)
    g[:, 0, 0], g[:, 1, 0], g[:, 0, 1], g[:, 1, 1] = ca, sa, -sa, ca
    g[:, 0, 2], g[:, 1, 2], g[:, 2, 2] = -north, east, 1.0
    q = np.einsum("nij,nj,nkj->nik", g, sigma**2, g)
    whole = np.zeros((3 * count, 3 * count))
    for i in range(count):
        whole[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = q[i]
    return f, whole


def distances(x: Floats, ranges: Instant) -> Floats:
    """Expected ranges (E,)."""
    pose = x.reshape(-1, 3)
    off = pose[ranges.peer, :2] - pose[ranges.node, :2]
    result: Floats = np.hypot(off[:, 0], off[:, 1])
    return result


def range_jacobian(x: Floats, ranges: Instant) -> Floats:
    """Derivatives (E, 3N) of :func:`distances`."""
    pose = x.reshape(-1, 3)
    off = pose[ranges.peer, :2] - pose[ranges.node, :2]
    u = off / np.maximum(np.hypot(off[:, 0], off[:, 1]), 1e-9)[:, None]
    h = np.zeros((len(u), x.size))
    e = np.arange(len(u))
    for axis in range(2):
        h[e, 3 * ranges.node + axis] = -u[:, axis]
        h[e, 3 * ranges.peer + axis] = u[:, axis]
    return h


class FilterpyEKF:
    """filterpy.kalman.ExtendedKalmanFilter, predict_x replaced as its text says."""

    def __init__(self, case: Case, seed: int) -> None:
        from filterpy.kalman import ExtendedKalmanFilter

        class Motion(ExtendedKalmanFilter):
            def predict_x(self, u: Floats = 0) -> None:  # type: ignore[assignment]
                self.x = moved(self.x, u)

        self.kf = Motion(dim_x=3 * case.nodes, dim_z=1)
        self.kf.x = case.truth[0].reshape(-1).copy()
        self.kf.P = 1e-6 * np.eye(3 * case.nodes)
        self.variance = case.sigma_range_m**2

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """One step."""
        self.kf.F, self.kf.Q = jacobian_and_noise(self.kf.x, motion, sigma)
        self.kf.predict(u=motion)

    def update(self, ranges: Instant) -> None:
        """All ranges as one vector."""
        self.kf.dim_z = ranges.node.size
        self.kf.update(
            ranges.range_m, range_jacobian, distances, R=self.variance * np.eye(ranges.node.size),
            args=(ranges,), hx_args=(ranges,),
        )  # fmt: skip

    def positions(self) -> Floats:
        """Means."""
        at: Floats = self.kf.x.reshape(-1, 3)[:, :2]
        return at


class FilterpyUKF:
    """filterpy.kalman.UnscentedKalmanFilter with Merwe's points."""

    def __init__(self, case: Case, seed: int) -> None:
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

        size = 3 * case.nodes
        points = MerweScaledSigmaPoints(size, alpha=0.1, beta=2.0, kappa=3.0 - size)
        self.kf = UnscentedKalmanFilter(
            dim_x=size, dim_z=1, dt=1.0, hx=distances,
            fx=lambda x, dt, motion: moved(x, motion), points=points,
        )  # fmt: skip
        self.kf.x = case.truth[0].reshape(-1).copy()
        self.kf.P = 1e-6 * np.eye(size)
        self.variance = case.sigma_range_m**2

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """One step."""
        _, self.kf.Q = jacobian_and_noise(self.kf.x, motion, sigma)
        self.kf.predict(motion=motion)

    def update(self, ranges: Instant) -> None:
        """All ranges as one vector."""
        self.kf._dim_z = ranges.node.size
        self.kf.update(ranges.range_m, R=self.variance * np.eye(ranges.node.size), ranges=ranges)

    def positions(self) -> Floats:
        """Means."""
        at: Floats = self.kf.x.reshape(-1, 3)[:, :2]
        return at


class StoneSoupEKF:
    """Stone Soup's extended Kalman predictor and updater, models as subclasses, exact Jacobians."""

    def __init__(self, case: Case, seed: int) -> None:
        from stonesoup.base import Property
        from stonesoup.models.base import GaussianModel, TimeVariantModel
        from stonesoup.models.measurement.base import MeasurementModel
        from stonesoup.models.transition.base import TransitionModel
        from stonesoup.predictor.kalman import ExtendedKalmanPredictor
        from stonesoup.types.array import CovarianceMatrix, StateVector
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.state import GaussianState
        from stonesoup.updater.kalman import ExtendedKalmanUpdater

        size = 3 * case.nodes

        class Step(TransitionModel, GaussianModel, TimeVariantModel):
            """The motion in force; set before every prediction."""

            ndim_state = size
            motion: Floats
            sigma: Floats

            def function(self, state, noise=False, **kwargs):  # type: ignore[no-untyped-def]
                at = np.asarray(state.state_vector, dtype=float).reshape(-1)
                return StateVector(moved(at, self.motion)[:, None])

            def jacobian(self, state, **kwargs):  # type: ignore[no-untyped-def]
                at = np.asarray(state.state_vector, dtype=float).reshape(-1)
                f, q = jacobian_and_noise(at, self.motion, self.sigma)
                self.q = q
                return f

            def covar(self, **kwargs):  # type: ignore[no-untyped-def]
                return CovarianceMatrix(self.q)

        class Look(MeasurementModel, GaussianModel):
            """Ranges of one instant."""

            ranges = Property(object)
            variance = Property(float)

            @property
            def ndim_meas(self) -> int:
                return int(self.ranges.node.size)

            def function(self, state, noise=False, **kwargs):  # type: ignore[no-untyped-def]
                at = np.asarray(state.state_vector, dtype=float).reshape(-1)
                return StateVector(distances(at, self.ranges)[:, None])

            def jacobian(self, state, **kwargs):  # type: ignore[no-untyped-def]
                at = np.asarray(state.state_vector, dtype=float).reshape(-1)
                return range_jacobian(at, self.ranges)

            def covar(self, **kwargs):  # type: ignore[no-untyped-def]
                return CovarianceMatrix(self.variance * np.eye(self.ndim_meas))

            def inverse_function(self, detection, **kwargs):  # type: ignore[no-untyped-def]
                raise NotImplementedError

        self.step = Step()
        self.look = lambda ranges: Look(
            ndim_state=size,
            mapping=list(range(size)),
            ranges=ranges,
            variance=case.sigma_range_m**2,
        )
        self.predictor = ExtendedKalmanPredictor(self.step)
        self.updater = ExtendedKalmanUpdater(None)
        self.kinds = Detection, SingleHypothesis, StateVector
        self.now = datetime.datetime(2020, 1, 1)  # noqa: DTZ001 - Stone Soup's own examples
        self.state = GaussianState(
            case.truth[0].reshape(-1, 1), 1e-6 * np.eye(size), timestamp=self.now
        )

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """One step."""
        self.step.motion, self.step.sigma = motion, sigma
        self.now += datetime.timedelta(seconds=1)
        self.state = self.predictor.predict(self.state, timestamp=self.now)

    def update(self, ranges: Instant) -> None:
        """All ranges as one detection."""
        detection, hypothesis, vector = self.kinds
        seen = detection(
            vector(ranges.range_m[:, None]),
            timestamp=self.now,
            measurement_model=self.look(ranges),
        )
        self.state = self.updater.update(hypothesis(self.state, seen))

    def positions(self) -> Floats:
        """Means."""
        return np.asarray(self.state.state_vector, dtype=float).reshape(-1, 3)[:, :2]
