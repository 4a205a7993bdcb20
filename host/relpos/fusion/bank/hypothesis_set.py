"""The bank's hypotheses: adding users, what the whole team shares, and resampling."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank import common_rotation, lanes, storage
from relpos.fusion.bank import variance_components as components
from relpos.fusion.bank.hypothesis_arrays import HypothesisArrays
from relpos.fusion.bank.hypothesis_models import (
    LEAST_WEIGHT,
    RETURN_SHARE,
    UNDECIDED_WEIGHT,
    USUAL_NOISE_SHARE,
    RangeErrors,
)
from relpos.fusion.bank.lanes import LANES
from relpos.fusion.bank.range_biases import RangeBiases
from relpos.fusion.bank.storage import COMMON, PER_NODE, StateIndex
from relpos.fusion.bank.variance_components import Draws
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.models.motion_variances import COMPONENTS
from relpos.fusion.models.odometry_faults import JUMP_M
from relpos.fusion.models.ranging import CLOCK_SD_S
from relpos.fusion.resampling import systematic
from relpos.fusion.rigid_motion import RIGID, about_origin, rigid_motion

JITTER = 0.1
"""Standard deviation of the log components' jitter at resampling, in units of their spread."""


class HypothesisSet(HypothesisArrays):
    """Hypotheses that users are added to, and that are resampled."""

    def __init__(
        self, settings: BankSettings, rng: np.random.Generator, counters: Counter[str]
    ) -> None:
        """Begin with no users and ``settings.hypotheses`` equal hypotheses."""
        super().__init__(settings, rng, counters)
        self.biases = RangeBiases(self)
        self.biases.begin_common(np.arange(self.count))
        self.common: Floats = np.zeros((RIGID, RIGID))
        """Covariance of the rigid motion of the whole team that has been taken out."""
        self.spread_components()

    def __setstate__(self, state: dict[str, object]) -> None:
        """Make it a copy, to which its biases belong."""
        self.__dict__.update(state)
        self.biases.belong_to(self)

    # -- the common rotation -------------------------------------------------------------------

    def take_out_common_rotation(self) -> tuple[Floats, Floats]:
        """Take the team's rigid motion out where it is large; return the poses' moments."""
        mean, covariance = self.moments(poses_alone=True)
        if self.nodes < 2:
            return mean, covariance
        gain, known = common_rotation.estimate(mean, covariance, self.nodes)
        if known[2, 2] < common_rotation.LEAST_RAD**2:
            return mean, covariance
        poses, _ = self.poses_of(*range(self.nodes))
        entries = storage.order(self.nodes, len(mean))[: poses.shape[1]]
        middle = mean[entries].reshape(-1, storage.POSE).mean(axis=0)[:2]
        weight, blocks = self.weights(), len(self.arrays.x)
        taken = lanes.empty_lines(blocks, 6)
        common_rotation.take_out(self.arrays, middle, taken)
        own = common_rotation.full(weight @ storage.of_each(taken, self.count))
        off = poses - mean[entries]
        off[:, 2::3] = np.remainder(off[:, 2::3] + math.pi, 2.0 * math.pi) - math.pi
        motion = off @ gain.T
        motion -= weight @ motion
        if self.count > 1:
            common_rotation.align(self.arrays, middle, storage.lay_out(motion))
        between = np.einsum("k,ki,kj->ij", weight, motion, motion)
        self.common += about_origin(own + between, *middle)
        return self.moments(poses_alone=True)

    def relative_moments(self) -> tuple[Floats, Floats]:
        """Return the poses' moments without the team's rigid motion, which no range corrects."""
        mean, covariance = self.moments(poses_alone=True)
        if self.nodes < 2:
            return mean, covariance
        _, known = common_rotation.estimate(mean, covariance, self.nodes)
        entries = storage.order(self.nodes, len(mean))[: storage.POSE * self.nodes]
        x_m, y_m = mean[entries[0::3]], mean[entries[1::3]]
        g = rigid_motion(x_m - x_m.mean(), y_m - y_m.mean())
        covariance[np.ix_(entries, entries)] -= g @ known @ g.T
        return mean, covariance

    def common_motion(self) -> Floats:
        """Return the covariance (3, 3) of the team's rigid motion about the origin, all of it."""
        mean, covariance = self.moments(poses_alone=True)
        if self.nodes < 2:
            return self.common
        _, known = common_rotation.estimate(mean, covariance, self.nodes)
        entries = storage.order(self.nodes, len(mean))[: storage.POSE * self.nodes]
        middle = mean[entries].reshape(-1, storage.POSE).mean(axis=0)[:2]
        return self.common + about_origin(known, *middle)

    def put_back_common_rotation(self) -> None:
        """Put back what was taken out: an absolute heading is to measure it."""
        if self.common[2, 2] > 0.0:
            common_rotation.put_back(self.arrays, self.common[np.tril_indices(3)])
            self.common[...] = 0.0

    def common_covariance(self, mean: Floats) -> Floats:
        """Return what has been taken out of the mixture's covariance (D, D), by its mean (D,)."""
        entries = storage.order(self.nodes, len(mean))[: storage.POSE * self.nodes]
        g = rigid_motion(mean[entries[0::3]], mean[entries[1::3]])
        covariance = np.zeros((len(mean), len(mean)))
        covariance[np.ix_(entries, entries)] = g @ self.common @ g.T
        return covariance

    # -- adding --------------------------------------------------------------------------------

    def add_node(self, pose: tuple[float, float, float], sigma_m: float, sigma_rad: float) -> int:
        """Add a user with a Gaussian prior, independent of the others; return its row."""
        before, spread = self.dense()
        count, old = before.shape
        row = self.nodes
        at = PER_NODE * row
        x = np.zeros((count, old + PER_NODE + 1))
        p = np.zeros((count, old + PER_NODE + 1, old + PER_NODE + 1))
        clock = at + COMMON + row
        keep = np.delete(
            np.arange(old + PER_NODE + 1), [*range(at, at + PER_NODE), PER_NODE + clock]
        )
        x[:, keep] = before
        p[np.ix_(np.arange(count), keep, keep)] = spread
        x[:, at : at + 3] = pose
        for entry, sigma in ((0, sigma_m), (1, sigma_m), (2, sigma_rad)):
            p[:, at + entry, at + entry] = sigma**2
        self.starts_uncertain |= sigma_m > 0.0
        wrong, s = self.wrong_start > 0.0, self.settings
        off = math.sqrt(0.5) * JUMP_M * self.rng.standard_normal((wrong.sum(), 2))
        x[wrong, at : at + 2] += off
        for entry in (StateIndex.X, StateIndex.Y):
            p[wrong, at + entry, at + entry] += 0.5 * JUMP_M**2
        drift, scale = at + StateIndex.DRIFT, at + StateIndex.SCALE
        models = self.models
        p[:, drift, drift] = models.constants * (1.0 - models.low_heading_noise) * s.drift_rad_s**2
        p[:, scale, scale] = models.constants * s.scale**2
        self.nodes += 1
        clock = self.clock_entry(row)
        p[:, clock, clock] = models.has_biases * CLOCK_SD_S**2
        self.store(x, p)
        self.biases.move_back(PER_NODE + 1)
        self.components.add_node()
        drawn = self.rng.standard_normal((count, COMPONENTS))
        self._normals = np.concatenate([self._normals[:, :-1], drawn, self._normals[:, -1:]], 1)
        sensitivity = lanes.empty_lines(len(self.arrays.x), self.nodes, COMPONENTS, 6)
        sensitivity[:, :-1], sensitivity[:, -1] = self.arrays.sensitivity, 0.0
        self.arrays = self.arrays._replace(sensitivity=sensitivity)
        self.spread_components()
        return row

    def place(
        self, rows: Indices, poses: Floats, covariances: Floats, log_weights: Floats,
        beside: int | None = None,
    ) -> None:  # fmt: skip
        """Put users ``rows`` (M,) at initial hypotheses; all other users stay.

        ``poses`` (H, M, 3), ``covariances`` (H, 3 M, 3 M), ``log_weights`` (H,); they are dealt
        out by weight, independently of what the hypotheses say of the others. Where the poses
        were found relative to the others, their errors contain the error of user ``beside``.
        """
        share = np.exp(log_weights - log_weights.max())
        share /= share.sum()
        chosen = self.rng.permutation(systematic(share, self.count, self.rng))
        pose = (storage.POSE * rows[:, None] + np.arange(storage.POSE)).ravel()
        x, p, place = self.arrays.x, self.arrays.p, storage.triangle_place
        x[:, pose] = storage.lay_out(poses.reshape(len(share), -1)[chosen])
        self.decorrelate(pose, covariances[chosen])
        if beside is not None:
            own = pose.reshape(-1, storage.POSE)[:, :2].ravel()
            its = np.tile(storage.POSE * beside + np.arange(2), len(rows))
            others = np.setdiff1d(np.arange(x.shape[1]), pose)
            p[:, place(own[:, None], others)] = p[:, place(its[:, None], others)]
            i, j = np.tril_indices(len(own))
            p[:, place(own[i], own[j])] += p[:, place(its[i], its[j])]

    def split_heading(self, row: int, moved_m: float) -> None:
        """Spread a user's unknown heading round the circle, one direction a hypothesis.

        ``moved_m`` is how far the user has moved without a heading.
        """
        order = self.rng.permutation(self.count)
        width = 2.0 * math.pi / self.count
        heading = self._place(row, StateIndex.HEADING)
        self.arrays.x[:, heading] = storage.lay_out(width * (order + self.rng.random(self.count)))
        variance = np.full((self.count, 1, 1), max(1.5 * width, 0.12) ** 2)
        self.decorrelate(np.array([heading]), variance)
        for entry in (StateIndex.X, StateIndex.Y):
            self.inflate(row, entry, 0.5 * moved_m**2)

    def _return_to_constants(self) -> None:
        """Let a few hypotheses without constants have them again."""
        s, p, models = self.settings, self.arrays.p, self.models
        back = self.rng.random(self.count) < RETURN_SHARE
        which = np.flatnonzero(back > models.constants)
        if s.constants > 0.0 and which.size:
            models.constants[which] = 1.0
            block, lane = self.at(which)
            drifts = (1.0 - models.low_heading_noise[which]) * s.drift_rad_s**2
            for row in range(self.nodes):
                for entry, variance in ((StateIndex.DRIFT, drifts), (StateIndex.SCALE, s.scale**2)):
                    place = self._place(row, entry)
                    p[block, storage.triangle_place(place, place), lane] = variance

    # -- resampling ----------------------------------------------------------------------------

    def resample(self, weight: Floats, count: int | None = None) -> None:
        """Draw hypotheses by their weights; log components are jittered (Liu and West 2001)."""
        count = self.count if count is None else count
        if not self.biases.pairs and not self.biases.users:
            # Without entries of pairs, all that have biases are alike.
            own = self.models.range_errors
            self.models.range_errors = np.minimum(own, RangeErrors.CONSTANT)
        kinds = self.biases.kinds()
        least = UNDECIDED_WEIGHT if self.undecided else LEAST_WEIGHT
        chosen, kind, log_weight = self.models.resample(weight, kinds, count, self.rng, least)
        self._select(chosen)
        self.biases.turn_into(kind)
        # Children of one parent differ in their components, too.
        self._normals *= math.sqrt(1.0 - JITTER**2)
        self._normals += JITTER * self.rng.standard_normal(self._normals.shape)
        if self.models.low_heading_noise.any():
            self.models.low_heading_noise *= self.rng.random(self.count) >= USUAL_NOISE_SHARE
        self._return_to_constants()
        self._equalise()
        self.log_weight[:] = log_weight
        self._counters["resampled"] += 1

    def redraw(self) -> None:
        """Draw all log components again."""
        self._normals = self.rng.standard_normal(self._normals.shape)
        self.spread_components()

    def replace_by(self, chosen: Indices, weight: Floats, x: Floats, p: Floats) -> None:
        """Go on with the hypotheses ``chosen`` (M,) at means ``x`` (M, D), covariance ``p`` (D, D).

        ``weight`` (K,) are the weights so far; the new ones are equal.
        """
        each = storage.of_each(self.arrays.sensitivity, self.count)
        sensitivity = np.einsum("k,k...->...", weight, each)
        models, count = self.models.merge(weight, len(chosen)), len(chosen)
        self._select(chosen)
        self.store(x, np.repeat(p[None], count, axis=0))
        self.arrays.sensitivity[...] = sensitivity[..., None]
        self.perturbed = np.zeros(count)
        self.models = models
        self.lay_out_models()
        if count == 1:
            self._normals = np.zeros_like(self._normals)
        self._equalise()

    def _select(self, chosen: Indices) -> None:
        """Go on with the hypotheses ``chosen`` (M,)."""
        old = self.arrays.sensitivity
        flat = storage.select_hypotheses(old.reshape(len(old), -1, LANES), chosen)
        self.arrays = self.arrays._replace(
            x=storage.select_hypotheses(self.arrays.x, chosen),
            p=storage.select_hypotheses(self.arrays.p, chosen),
            sensitivity=flat.reshape(len(flat), *old.shape[1:]),
        )
        self.count = len(chosen)
        self._normals = self._normals[chosen]
        self.models = self.models.select(chosen)
        self.lay_out_models()
        self.perturbed, self.wrong_start = self.perturbed[chosen], self.wrong_start[chosen]

    def _equalise(self) -> None:
        """Set all weights equal, and draw the components for the present number."""
        self.spread_components()
        self.arrays = self.arrays._replace(log_weight=np.zeros((len(self.arrays.x), LANES)))

    def spread_components(self) -> None:
        """Give every hypothesis its draw of what is known of the variance components."""
        blocks = lanes.blocks_of(self.count)
        if self.arrays.component.shape[:2] != (blocks, self.nodes):
            self.arrays = self.arrays._replace(
                component=lanes.empty_lines(blocks, self.nodes, COMPONENTS),
                range_variance=lanes.empty_lines(blocks),
            )
        low_noise = storage.lay_out(self.models.low_heading_noise)
        self.draws = Draws(storage.lay_out(self._normals), low_noise, self.settings.spread)
        known = self.components
        components.spread(self.draws, known.mean, known.covariance, self.arrays)
