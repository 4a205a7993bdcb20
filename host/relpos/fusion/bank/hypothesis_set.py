"""The bank's hypotheses: their storage, what is read and changed in them, and resampling."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.fusion.bank import common_rotation, hypothesis_count, lanes, mixture, storage
from relpos.fusion.bank import variance_components as components
from relpos.fusion.bank.hypothesis_models import (
    LATENESS_SD_S,
    LEAST_WEIGHT,
    PAIR_BIASES,
    RETURN_SHARE,
    SHADOW_SD_M,
    STOREY_M2,
    UNDECIDED_WEIGHT,
    USUAL_NOISE_SHARE,
    Models,
    RangeErrors,
)
from relpos.fusion.bank.lanes import LANES
from relpos.fusion.bank.mixture import PERTURBED_LOSS, PERTURBED_UPDATES
from relpos.fusion.bank.storage import COMMON, PER_NODE, Hypotheses, StateIndex
from relpos.fusion.bank.variance_components import Draws, VarianceComponents
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.models.motion_variances import COMPONENTS
from relpos.fusion.models.odometry_faults import JUMP_M
from relpos.fusion.models.ranging import CLOCK_SD_S, DELAY_SHARE, GROWTH_SD_M, CommonIndex
from relpos.fusion.resampling import systematic
from relpos.fusion.rigid_motion import RIGID, about_origin, rigid_motion

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

JITTER = 0.1
"""Standard deviation of the log components' jitter at resampling, in units of their spread."""


class HypothesisSet:
    """K weighted hypotheses about N users, as arrays that kernels work on.

    Users are *rows* 0 ... N-1 in the order of ``add_node``. The state has D = 6 N + 4 + pairs
    entries: five a user (:class:`~relpos.fusion.bank.storage.StateIndex`), what ranges have in
    common (:class:`~relpos.fusion.models.ranging.CommonIndex`), each user's clock offset, and the
    range bias of each pair when it is first ranged (of more than six users, each antenna's delay).
    """

    def __init__(
        self, settings: BankSettings, rng: np.random.Generator, counters: Counter[str]
    ) -> None:
        """Begin with no users and ``settings.hypotheses`` equal hypotheses."""
        self.settings, self.rng, self._counters = settings, rng, counters
        count = settings.hypotheses
        self.nodes = 0
        self.count = count
        """K, the number of hypotheses."""
        blocks = lanes.blocks_of(count)
        x, p = storage.pack(np.zeros((count, COMMON)), np.zeros((count, COMMON, COMMON)), 0)
        self.arrays = Hypotheses(
            x, p, np.zeros((blocks, LANES)), lanes.empty_lines(blocks, 0, COMPONENTS, 6),
            lanes.empty_lines(blocks, 0, COMPONENTS), lanes.empty_lines(blocks),
            np.zeros((blocks, LANES)), np.zeros((blocks, LANES)),
        )  # fmt: skip
        self.components = VarianceComponents()
        self._normals: Floats = rng.standard_normal((count, 1))
        self.heights_known = False
        self.starts_uncertain = False
        """Whether an initial place is uncertain, given or found."""
        self.undecided = False
        """Whether the kinds of range errors cannot be told apart yet (``DECIDED_AFTER_S``)."""
        self.models = Models.draw(settings, count, rng)
        # Reported initial poses may all be wrong at once.
        many = int(settings.wrong_starts * count)
        self.wrong_start = (rng.permutation(count) < many).astype(np.float64)
        self.perturbed: Floats = PERTURBED_UPDATES * self.wrong_start
        """For so many instants of ranges a hypothesis teaches nothing about noise (K,)."""
        self.biases: dict[tuple[int, int], int] = {}
        """Pair of rows, the lower first -> entry of its range bias in the state."""
        self.delays: dict[int, int] = {}
        """Row -> entry of its antenna delay, by which each of its ranges is too long (m)."""
        self._allow_common(np.arange(count))
        self.common: Floats = np.zeros((RIGID, RIGID))
        """Covariance of the rigid motion of the whole team that has been taken out."""
        self.spread_components()

    # -- reading -------------------------------------------------------------------------------

    def dense(self) -> tuple[Floats, Floats]:
        """Means (K, D) and covariances (K, D, D), copies."""
        return storage.unpack(self.arrays.x, self.arrays.p, self.nodes, self.count)

    @property
    def log_weight(self) -> Floats:
        """Log weights (K,), a view."""
        return self.arrays.log_weight.reshape(-1)[: self.count]

    @property
    def covariance_entries(self) -> int:
        """How many numbers all covariances have."""
        return self.count * int(self.arrays.x.shape[1]) ** 2

    @property
    def sampled_share(self) -> float:
        """Share of the heading noise that is drawn; one hypothesis alone draws none."""
        s = self.settings
        return hypothesis_count.sampled_share(s.sampled, self.count, s.hypotheses)

    def weights(self) -> Floats:
        """Normalised weights (K,); the log weights are shifted so that their greatest is 0."""
        return self.normalise()[0].reshape(-1)[: self.count]

    def normalise(self) -> tuple[Floats, float]:
        """Return weights (B, LANES) and the effective sample count."""
        weight = np.empty_like(self.arrays.log_weight)
        return weight, float(mixture.normalise(self.arrays.log_weight, self.count, weight))

    def moments(
        self, weight: Floats | None = None, *, poses_alone: bool = False
    ) -> tuple[Floats, Floats]:
        """Return the mixture's mean (D,) and full covariance (D, D).

        ``weight`` (B, LANES) takes the place of the hypotheses' own. With ``poses_alone``
        constants and biases have variances, and covariances of 0. Raises RelposError where a mean
        is not finite.
        """
        x, p = self.arrays.x, self.arrays.p
        size = x.shape[1]
        weight = self.normalise()[0] if weight is None else weight
        places = storage.POSE * self.nodes if poses_alone else size
        order = storage.order(self.nodes, size)
        mean, covariance = mixture.moments(x, p, weight, self.nodes, order, places)
        if not np.isfinite(mean).all():
            raise RelposError("the estimate is no longer finite: this is an error of the program")
        return mean, covariance

    def unperturbed_weights(self) -> Floats:
        """Return weights (B, LANES), those of perturbed hypotheses next to nothing."""
        logs = self.arrays.log_weight.copy()
        logs.reshape(-1)[: self.count] -= np.where(self.perturbed > 0.0, PERTURBED_LOSS, 0.0)
        weight = np.empty_like(logs)
        mixture.normalise(logs, self.count, weight)
        return weight

    def poses_of(self, *rows: int) -> tuple[Floats, Floats]:
        """Poses (K, 3 M) of users and their covariances (K, 3 M, 3 M)."""
        places = (storage.POSE * np.array(rows)[:, None] + np.arange(storage.POSE)).ravel()
        pairs = storage.triangle_place(places[:, None], places)
        return (
            storage.of_each(self.arrays.x[:, places], self.count),
            storage.of_each(self.arrays.p[:, pairs], self.count),
        )

    def _place(self, row: int, entry: int) -> int:
        """Where an entry of a user is stored."""
        if entry < storage.POSE:
            return storage.POSE * row + entry
        constants = storage.POSE * self.nodes + storage.CONSTANTS * row
        return constants + entry - storage.POSE

    def at(self, which: Indices | None) -> tuple[Indices, Indices]:
        """Block and lane of the hypotheses ``which``, or of all."""
        which = np.arange(self.count) if which is None else which
        return which // LANES, which % LANES

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

    # -- changing one user ---------------------------------------------------------------------

    def shift(self, row: int, entry: int, by: Floats, which: Indices | None = None) -> None:
        """Add ``by`` (M,) to an entry of a user in the hypotheses ``which`` (M,), or in all."""
        block, lane = self.at(which)
        self.arrays.x[block, self._place(row, entry), lane] += by

    def inflate(self, row: int, entry: int, variance: float, which: Indices | None = None) -> None:
        """Add to the variance of an entry of a user in the hypotheses ``which``, or in all."""
        place, (block, lane) = self._place(row, entry), self.at(which)
        self.arrays.p[block, storage.triangle_place(place, place), lane] += variance

    def diffuse(self, row: int, way_m: Floats, covariance: Floats) -> None:
        """Move a user by ``way_m`` (2,), and add to the covariance (2, 2) of its place, in all."""
        first = self._place(row, StateIndex.X)
        for e in (StateIndex.X, StateIndex.Y):
            self.arrays.x[:, first + e] += way_m[e]
            for f in range(e + 1):
                at = storage.triangle_place(first + e, first + f)
                self.arrays.p[:, at] += covariance[e, f]

    def decorrelate(
        self, places: Indices, covariance: Floats, which: Indices | None = None
    ) -> None:
        """Have stored entries ``places`` (E,) independent of all others in ``which`` (M,), or all.

        ``covariance`` (M, E, E) is theirs.
        """
        p = self.arrays.p
        everything = storage.triangle_place(places[:, None], np.arange(self.arrays.x.shape[1]))
        own = storage.triangle_place(places[:, None], places)
        if which is None:
            p[:, everything], p[:, own] = 0.0, storage.lay_out(covariance)
        else:
            block, lane = (at[:, None, None] for at in self.at(which))
            p[block, everything, lane], p[block, own, lane] = 0.0, covariance

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
        self.biases = {pair: place + PER_NODE + 1 for pair, place in self.biases.items()}
        self.delays = {user: place + PER_NODE + 1 for user, place in self.delays.items()}
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

    def common_entry(self, index: CommonIndex) -> int:
        """Return the entry of the state that ranges have in common."""
        return PER_NODE * self.nodes + index

    def clock_entry(self, row: int) -> int:
        """Return the entry of the state that holds a user's clock offset."""
        return PER_NODE * self.nodes + COMMON + row

    def clock_entries(self) -> Indices:
        """Return the entries of all users' clock offsets (N,)."""
        return self.clock_entry(0) + np.arange(self.nodes)

    def _allow_common(self, which: Indices) -> None:
        """Let those of ``which`` (M,) that have biases model what ranges have in common."""
        priors = {
            self.common_entry(CommonIndex.BIAS): self.settings.bias_m,
            self.common_entry(CommonIndex.SHADOW): SHADOW_SD_M,
            self.common_entry(CommonIndex.LATENESS): LATENESS_SD_S,
            self.common_entry(CommonIndex.GROWTH): GROWTH_SD_M,
        }
        priors |= {self.clock_entry(row): CLOCK_SD_S for row in range(self.nodes)}
        priors |= dict.fromkeys(self.delays.values(), DELAY_SHARE * self.settings.pair_bias_m)
        block, lane = self.at(which)
        p, has = self.arrays.p, self.models.has_biases[which]
        for entry, sigma in priors.items():
            p[block, storage.triangle_place(entry, entry), lane] = has * sigma**2
        self._begin_pairs(which)

    def _begin_pairs(self, which: Indices) -> None:
        """Let what a pair has of its own begin anew in hypotheses ``which`` (M,).

        The bias of a pair is the common one and its own part.
        """
        block, lane = (at[:, None] for at in self.at(which))
        x, p = self.arrays.x, self.arrays.p
        inherits = 1.0 - self.models.has(RangeErrors.HEIGHT)[which, None]
        common = self.common_entry(CommonIndex.BIAS)
        own = np.array(list(self.biases.values()), dtype=np.int64)
        others = np.arange(x.shape[1])
        # Of each entry, the one that it begins as.
        before = np.where(np.isin(others, own), common, others)
        shared = inherits * p[block, storage.triangle_place(common, before), lane]
        x[block, own, lane] = inherits * x[block, common, lane]
        for entry in own:
            p[block, storage.triangle_place(entry, others), lane] = shared
        p[block, storage.triangle_place(own, own), lane] += self._own_variance(which)[:, None]
        self._lay_out_models()

    def _lay_out_models(self) -> None:
        self.arrays = self.arrays._replace(
            has_heights=storage.lay_out(self.models.has(RangeErrors.HEIGHT)),
            has_passing=storage.lay_out(self.models.has(RangeErrors.PASSING)),
        )

    def _own_variance(self, which: Indices | slice = slice(None)) -> Floats:
        """Return the prior variance of what a pair has of its own (M,), m^2 or m^4."""
        heights = self.models.has(RangeErrors.HEIGHT)[which]
        own = self.settings.pair_bias_m**2
        variance: Floats = self.models.has_biases[which] * (own + heights * (STOREY_M2**2 - own))
        return variance

    def know_heights(self) -> None:
        """Have no hypothesis any more in which heights are unknown: they are reported."""
        which = np.flatnonzero(self.models.has(RangeErrors.HEIGHT))
        self.heights_known = True
        self.models.range_errors[which] = RangeErrors.CONSTANT
        if which.size:
            self._begin_pairs(which)

    def _return_to_constants(self) -> None:
        """Let a few hypotheses without constants have them again."""
        s, p, models = self.settings, self.arrays.p, self.models
        back = self.rng.random(self.count) < RETURN_SHARE
        which = np.flatnonzero(back > models.constants)
        if s.constants > 0.0 and which.size:
            models.constants[which] = 1.0
            block, lane = self.at(which)
            for row in range(self.nodes):
                drift, scale = (
                    self._place(row, StateIndex.DRIFT),
                    self._place(row, StateIndex.SCALE),
                )
                drifts = (1.0 - models.low_heading_noise[which]) * s.drift_rad_s**2
                p[block, storage.triangle_place(drift, drift), lane] = drifts
                p[block, storage.triangle_place(scale, scale), lane] = s.scale**2

    def shift_common(self, entry: int, by: float) -> None:
        """Add to an entry of what ranges have in common in every hypothesis that models it."""
        self.arrays.x[:, entry] += by * storage.lay_out(self.models.has_biases)

    def set_scale(self, row: int, scale: float) -> None:
        """Start a user's step scale (true over reported) where it is modelled."""
        scales = storage.lay_out(self.models.constants * math.log(scale))
        self.arrays.x[:, self._place(row, StateIndex.SCALE)] = scales

    def bias_entries(self, first: Indices, second: Indices) -> Indices:
        """Entries of the state (R, 3) that hold the biases of ranges; new ones are added.

        A pair's bias is the common one plus its own part, so a new pair begins with what is known
        of the common one. Where there are too many pairs, it is the common one and both users'
        antenna delays; -1 where there is none of these.
        """
        entries = np.full((len(first), 3), -1, dtype=np.int64)
        if not self.models.has_biases.any():
            return entries
        common = self.common_entry(CommonIndex.BIAS)
        for r, (a, b) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
            pair = (a, b) if a < b else (b, a)
            if pair not in self.biases and self.nodes <= PAIR_BIASES:
                inherits = 1.0 - self.arrays.has_heights
                self.biases[pair] = self._add_bias(inherits, self._own_variance())
            if pair in self.biases:
                entries[r, 0] = self.biases[pair]
                continue
            for user in (a, b):
                if user not in self.delays:
                    sigma_m = DELAY_SHARE * self.settings.pair_bias_m
                    variance = self.models.has_biases * sigma_m**2
                    none = np.zeros_like(self.arrays.has_heights)
                    self.delays[user] = self._add_bias(none, variance)
            entries[r] = common, self.delays[a], self.delays[b]
        return entries

    def _add_bias(self, inherits: Floats, variance: Floats) -> int:
        """Add an entry for a bias, and return it: the common one where it ``inherits``, and more.

        ``inherits`` (B, LANES) is 1 or 0; ``variance`` (K,) is that of its own part, mean 0.
        """
        x0, p0 = self.arrays.x, self.arrays.p
        size, old = int(x0.shape[1]), p0.shape[1]
        common = self.common_entry(CommonIndex.BIAS)
        x = lanes.empty_lines(len(x0), size + 1)
        p = lanes.empty_lines(len(x0), old + size + 1)
        x[:, :size], x[:, size] = x0, inherits * x0[:, common]
        p[:, :old] = p0
        shared = p0[:, storage.triangle_place(common, np.arange(size))]
        p[:, old:-1] = inherits[:, None] * shared
        p[:, -1] = inherits * shared[:, common] + storage.lay_out(variance)
        self.arrays = self.arrays._replace(x=x, p=p)
        return size

    # -- resampling ----------------------------------------------------------------------------

    def store(self, x: Floats, p: Floats) -> None:
        """Replace means (K, D) and covariances (K, D, D); K may change."""
        stored_x, stored_p = storage.pack(x, p, self.nodes)
        self.arrays = self.arrays._replace(x=stored_x, p=stored_p)
        self.count = len(x)

    def resample(self, weight: Floats, count: int | None = None) -> None:
        """Draw hypotheses by their weights; log components are jittered (Liu and West 2001)."""
        count = self.count if count is None else count
        if not self.biases:
            # Without entries of pairs, all that have biases are alike.
            own = self.models.range_errors
            self.models.range_errors = np.minimum(own, RangeErrors.CONSTANT)
        kinds = self._kinds_of_range_errors()
        least = UNDECIDED_WEIGHT if self.undecided else LEAST_WEIGHT
        chosen, kind, log_weight = self.models.resample(weight, kinds, count, self.rng, least)
        self._select(chosen)
        self._turn_into(kind)
        # Children of one parent differ in their components, too.
        self._normals *= math.sqrt(1.0 - JITTER**2)
        self._normals += JITTER * self.rng.standard_normal(self._normals.shape)
        if self.models.low_heading_noise.any():
            self.models.low_heading_noise *= self.rng.random(self.count) >= USUAL_NOISE_SHARE
        self._return_to_constants()
        self._equalise()
        self.log_weight[:] = log_weight
        self._counters["resampled"] += 1

    def _kinds_of_range_errors(self) -> list[RangeErrors]:
        """Return those that are to have hypotheses; what began with biases cannot lose them."""
        if self.settings.biased == 0.0:
            return [RangeErrors.NOISE]
        kinds = [] if self.models.has_biases.all() else [RangeErrors.NOISE]
        kinds.append(RangeErrors.CONSTANT)
        if self.biases:
            kinds += [RangeErrors.PASSING] + [RangeErrors.HEIGHT] * (not self.heights_known)
        return kinds

    def _turn_into(self, kind: Indices) -> None:
        """Let hypotheses (K,) have other range errors than they have; their biases begin anew."""
        before = self.models.range_errors
        changed, noise = kind != before, before == RangeErrors.NOISE
        self.models.range_errors = kind
        if changed.any():
            self._allow_common(np.flatnonzero(changed & noise))
            self._begin_pairs(np.flatnonzero(changed & ~noise))

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
        self._lay_out_models()
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
        self._lay_out_models()
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
