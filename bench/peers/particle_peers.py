"""particles and pfilter: the paper's filter without dual step, M particles for each user.

As in relpos, every user has a filter of its own over x, y and heading, and weighs by the ranges to
its neighbours' means before this correction.
"""

from __future__ import annotations

import numpy as np

from case import Case, Floats, Instant
from ours import particle_motion, particle_sigma


def looks(ranges: Instant, count: int) -> list[tuple[np.ndarray, Floats]]:
    """Of every user its neighbours' rows and the ranges to them."""
    result = []
    for i in range(count):
        out, back = ranges.node == i, ranges.peer == i
        rows = np.concatenate([ranges.peer[out], ranges.node[back]])
        result.append((rows, np.concatenate([ranges.range_m[out], ranges.range_m[back]])))
    return result


def squares(poses: Floats, places: Floats, measured: Floats, sigma: float) -> Floats:
    """Sum of scaled squared residuals of poses (M, 3) to ranges from places (E, 2)."""
    off = poses[:, None, :2] - places
    residual = (np.sqrt(np.einsum("mea,mea->me", off, off)) - measured) / sigma
    return np.einsum("me,me->m", residual, residual)


def stepped(poses: Floats, noisy: Floats) -> Floats:
    """Move poses (M, 3) by body-frame displacements (M, 3)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return np.stack(
        [
            poses[:, 0] + c * noisy[:, 0] - s * noisy[:, 1],
            poses[:, 1] + s * noisy[:, 0] + c * noisy[:, 1],
            poses[:, 2] + noisy[:, 2],
        ],
        axis=1,
    )


class ParticlesLibrary:
    """``particles``: a FeynmanKac model and an SMC for each user, advanced in its two halves."""

    def __init__(self, case: Case, seed: int, size: int) -> None:
        import particles

        np.random.seed(seed)  # noqa: NPY002 - the library draws from the global generator

        class User(particles.FeynmanKac):
            def __init__(self, start: Floats) -> None:
                super().__init__(T=len(case.motions) + 2)
                self.start = start
                self.motion = self.sigma = np.zeros(3)
                self.places, self.measured = np.empty((0, 2)), np.empty(0)

            def M0(self, N: int) -> Floats:  # noqa: N802, N803 - the library's names
                return np.repeat(self.start[None], N, axis=0)

            def M(self, t: int, xp: Floats) -> Floats:  # noqa: N802
                noisy = self.motion + self.sigma * np.random.standard_normal(xp.shape)  # noqa: NPY002
                return stepped(xp, noisy)

            def logG(self, t: int, xp: Floats, x: Floats) -> Floats:  # noqa: N802
                if not self.measured.size:
                    return np.zeros(len(x))
                return -0.5 * squares(x, self.places, self.measured, sigma)

        sigma = particle_sigma(case)
        self.users = [User(pose) for pose in case.truth[0]]
        self.filters = [
            particles.SMC(fk=user, N=size, resampling="multinomial", ESSrmin=0.5)
            for user in self.users
        ]
        for smc in self.filters:
            next(smc)

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """Resampling and moving; weights where no range follows are its own next step's."""
        noise = particle_motion(sigma)
        for user, smc, own, spread in zip(self.users, self.filters, motion, noise, strict=True):
            user.motion, user.sigma = own, spread
            user.places, user.measured = np.empty((0, 2)), np.empty(0)
            next(smc)

    def update(self, ranges: Instant) -> None:
        """Weigh by the neighbours' means."""
        means = self.positions()
        for user, smc, (rows, measured) in zip(
            self.users, self.filters, looks(ranges, len(self.users)), strict=True
        ):
            user.places, user.measured = means[rows], measured
            smc.wgts = smc.wgts.add(user.logG(smc.t, smc.Xp, smc.X))

    def positions(self) -> Floats:
        """Weighted means."""
        return np.array([smc.W @ smc.X[:, :2] for smc in self.filters])


class PfilterLibrary:
    """``pfilter``: a ParticleFilter for each user; prediction only is an update with None."""

    def __init__(self, case: Case, seed: int, size: int) -> None:
        from pfilter import ParticleFilter

        np.random.seed(seed)  # noqa: NPY002 - the library draws from the global generator
        self.sigma = particle_sigma(case)
        self.filters = [
            ParticleFilter(
                prior_fn=lambda n, pose=pose: np.repeat(pose[None], n, axis=0),
                observe_fn=_observe,
                n_particles=size,
                dynamics_fn=lambda x, motion, **_: x,
                noise_fn=lambda x, motion, spread, **_: stepped(
                    x,
                    motion + spread * np.random.standard_normal(x.shape),  # noqa: NPY002
                ),
                weight_fn=lambda expected, seen, **_: (
                    np.exp(-0.5 * np.sum(((expected - seen) / self.sigma) ** 2, axis=1)) + 1e-300
                ),
                resample_proportion=0.0,
                n_eff_threshold=0.5,
            )
            for pose in case.truth[0]
        ]
        self.moves: list[tuple[Floats, Floats]] = []

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """One step of prediction only."""
        for one, own, spread in zip(self.filters, motion, particle_motion(sigma), strict=True):
            one.update(None, motion=own, spread=spread, places=None)

    def update(self, ranges: Instant) -> None:
        """Weigh by the neighbours' means, without moving again."""
        means = self.positions()
        still = np.zeros(3)
        for one, (rows, measured) in zip(
            self.filters, looks(ranges, len(self.filters)), strict=True
        ):
            if measured.size:
                one.update(measured, motion=still, spread=still, places=means[rows])

    def positions(self) -> Floats:
        """Weighted means before resampling, which the library keeps."""
        return np.array([one.mean_state[:2] for one in self.filters])


def _observe(x: Floats, places: Floats | None = None, **_: object) -> Floats:
    if places is None:
        return np.zeros((len(x), 1))
    off = x[:, None, :2] - places
    return np.sqrt(np.einsum("mea,mea->me", off, off))
