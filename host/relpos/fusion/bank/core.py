"""The bank's hypotheses as arrays: what :class:`~relpos.fusion.bank.estimator.Bank` works on."""

from __future__ import annotations

import math
from collections import Counter
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from relpos.fusion.bank import hypothesis_count as hypotheses
from relpos.fusion.bank import joint, lanes
from relpos.fusion.bank import kernels as bank_kernels
from relpos.fusion.bank import variance_components as noise
from relpos.fusion.bank.joint import PER_NODE, Of
from relpos.fusion.bank.lanes import LANES
from relpos.fusion.bank.settings import BankSettings
from relpos.fusion.models.detection import STEP_M, Detection
from relpos.fusion.models.motion_variances import ALONG, ALONG_M2_M, COMPONENTS
from relpos.fusion.models.odometry_faults import (
    BELIEVING,
    HEADING_CELL_RAD,
    HYPOTHESES,
    LOST_M,
    LOST_RAD,
    CusumDetector,
    perturb,
)
from relpos.fusion.resampling import systematic

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_TWO_PI = 2.0 * math.pi
_UNTOLD: Floats = np.empty((0, 3))


class BankCore:
    """K hypotheses about N users, as arrays. Nothing here knows node ids or wall time.

    Users are *rows* 0 ... N-1 in the order of ``add_node``. ``x`` (K, D) and ``p`` (K, D, D)
    give copies of the hypotheses' means and covariances, ``log_weight`` (K,) is their unnormalised
    log weights; D = 5 N + 1 + pairs: five entries a user, see
    :class:`~relpos.fusion.bank.joint.Of`,
    then the range bias that all pairs share, then that of each pair as it is first heard. They are
    kept as the kernels want them, eight hypotheses to a block (:mod:`relpos.fusion.bank.joint`).

    The order of work in one epoch: ``move`` (once or more), ``update`` (all ranges of one
    instant), ``log_weight +=`` whatever else is known (silence, ...), then ``settle`` (jumps,
    resampling). ``moments`` gives the mixture's mean and full covariance at any time.
    """

    def __init__(self, settings: BankSettings, seed: int = 0) -> None:
        """Start with no users and ``settings.hypotheses`` equal hypotheses."""
        self.settings = settings
        self.rng = np.random.default_rng(seed)
        self.counters: Counter[str] = Counter()
        count = settings.hypotheses
        self.nodes = 0
        self._set_arms(np.zeros((0, 2)))
        self.count = count
        """K, the number of hypotheses."""
        self.ceiling = count
        """Ordinarily at most so many: more than ``settings.hypotheses`` where much bends."""
        self._x, self._p = joint.pack(np.zeros((count, 1)), np.zeros((count, 1, 1)), 0)
        self._log_weight: Floats = np.zeros((lanes.blocks_of(count), LANES))
        self.levels = noise.Levels()
        self.draw: Floats = self.rng.standard_normal((count, 1))
        self._sens: Floats = lanes.empty_lines(lanes.blocks_of(count), 0, COMPONENTS, 6)
        self.level = lanes.empty_lines(0, 0, COMPONENTS)
        """How much noisier each user is than the bases of noise (B, N, 3, LANES)."""
        self.sigma2 = lanes.empty_lines(0)
        """Variance of a range (B, LANES), m^2."""
        self.steady: Floats = np.zeros(count)
        """1 where headings are taken to be those of wheels or a camera (``noise.STEADIER``)."""
        self._spread_levels()
        self.has_constants: Floats = (
            self.rng.permutation(count) < round(settings.constants * count)
        ).astype(np.float64)
        self.has_bias: Floats = (
            self.rng.permutation(count) < round(settings.biased * count)
        ).astype(np.float64)
        self.steady = (self.rng.permutation(count) < int(settings.steady * count)).astype(
            np.float64
        )
        self._some_biased = bool(self.has_bias.any())
        self._p[:, 0] = self._in_lanes(self.has_bias) * settings.bias_m**2
        self.biases: dict[tuple[int, int], int] = {}
        """Pair of rows, the lower first -> place of its range bias in the state."""
        self.surprise: Floats = np.zeros(0)
        self.since_turn_s: Floats = np.zeros(0)
        """How long each user has gone straight ahead."""
        # Whoever says where people start may be wrong of all of them at once.
        self.wrong_start: Floats = (
            self.rng.permutation(count) < int(settings.wrong_starts * count)
        ).astype(np.float64)
        self.doubtful: Floats = DOUBT_UPDATES * self.wrong_start
        self.cusum = CusumDetector.of_nobody()
        self.slipped: set[int] = set()
        """Rows whose odometry has slipped and that are not found again yet."""
        self.unplaced: dict[int, tuple[float, float]] = {}
        """Row -> how badly its place (m) and heading (rad) are known, till it is ranged."""
        self.since_slip = 0
        """Instants of ranges since the last alarm."""
        self.unambiguous = 0
        """For so many instants of ranges the picture has been so."""
        self._alarm: tuple[int, Indices, Indices, Floats] | None = None
        prior = settings.outlier_m**2
        self._outlier = np.array([0.0, prior, settings.outliers_short, 0.0, prior])
        expected = settings.outliers * OUTLIER_RANGES
        self.outlier_counts: Floats = np.array(
            [expected, OUTLIER_RANGES - expected, expected * settings.outlier_m**2]
        )

    # -- users ---------------------------------------------------------------------------------

    @property
    def x(self) -> Floats:
        """Means (K, D), a copy."""
        return joint.means(self._x, self.nodes, self.count)

    @property
    def p(self) -> Floats:
        """Covariances (K, D, D), a copy."""
        return joint.unpack(self._x, self._p, self.nodes, self.count)[1]

    @property
    def log_weight(self) -> Floats:
        """Log weights (K,), a view."""
        return self._log_weight.reshape(-1)[: self.count]

    @property
    def entries(self) -> int:
        """How many numbers all covariances have."""
        return self.count * int(self._x.shape[1]) ** 2

    @property
    def lines(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Means, covariances, log weights and sensitivities as kernels take them, to work in."""
        return self._x, self._p, self._log_weight, self._sens

    def _check(self, first: Indices, second: Indices, *values: Floats) -> None:
        """Raise ``IndexError`` or ``ValueError``: kernels look at no bounds."""
        for array in (second, *values):
            if array.shape != first.shape:
                raise ValueError(f"array of shape {array.shape} for {len(first)} rows")
        if not bank_kernels.within(first, second, self.nodes):
            raise IndexError(f"rows {first.tolist()}, {second.tolist()} of {self.nodes} users")

    def _put(self, x: Floats, p: Floats) -> None:
        """Take means (K, D) and covariances (K, D, D) of ``nodes`` users for the present ones."""
        self._x, self._p = joint.pack(x, p, self.nodes)
        self.count = len(x)

    def _in_lanes(self, values: Floats) -> Floats:
        """Lay out one number of each hypothesis (K,) as (B, LANES)."""
        laid = np.full(lanes.blocks_of(self.count) * LANES, values[0])
        laid[: self.count] = values
        return laid.reshape(-1, LANES)

    def _place(self, row: int, entry: int = 0) -> int:
        """Where an entry of a user is stored."""
        return joint.place_of(PER_NODE * row + entry, self.nodes)

    def _variance_place(self, row: int, entry: int, other: int | None = None) -> int:
        """Where the covariance of two entries of a user (or the variance of one) is stored."""
        return joint.triangle_place(
            self._place(row, entry), self._place(row, entry if other is None else other)
        )

    def _column(self, row: int, entry: int) -> Floats:
        """One entry of a user in all hypotheses (K,), a copy."""
        flat: Floats = self._x[:, self._place(row, entry)].reshape(-1)[: self.count]
        return flat.copy()

    def _shift(self, row: int, entry: int, by: Floats, which: Indices | None = None) -> None:
        """Add ``by`` (K,) to an entry of a user in all hypotheses, or in ``which`` (K,)."""
        if which is None:
            self._x[:, self._place(row, entry)] += self._in_lanes(by)
        else:
            self._x[which // LANES, self._place(row, entry), which % LANES] += by

    def _widen(self, row: int, entry: int, variance: Floats | float) -> None:
        """Add to the variance of an entry of a user; (K,) or alike in all hypotheses."""
        much = self._in_lanes(variance) if isinstance(variance, np.ndarray) else variance
        self._p[:, self._variance_place(row, entry)] += much

    def _forget(self, row: int, entry: int, which: Indices | None = None) -> None:
        """Take all covariances of an entry of a user for zero, in all hypotheses or ``which``."""
        place = self._place(row, entry)
        others = np.array([joint.triangle_place(place, q) for q in range(self._x.shape[1])])
        if which is None:
            self._p[:, others] = 0.0
        else:
            self._p[which[:, None] // LANES, others, which[:, None] % LANES] = 0.0

    def add_node(
        self,
        x_m: float,
        y_m: float,
        heading_rad: float,
        sigma_m: float,
        sigma_rad: float,
        arm_m: tuple[float, float] = (0.0, 0.0),
    ) -> int:
        """Add a user with a Gaussian prior, independent of the others; return its row."""
        self._set_arms(np.concatenate([self.arm, np.array([arm_m])]))
        before, spread = joint.unpack(self._x, self._p, self.nodes, self.count)
        count, old = before.shape
        row = self.nodes
        at = PER_NODE * row
        x = np.zeros((count, old + PER_NODE))
        p = np.zeros((count, old + PER_NODE, old + PER_NODE))
        keep = np.r_[0:at, at + PER_NODE : old + PER_NODE]
        x[:, keep] = before
        p[np.ix_(np.arange(count), keep, keep)] = spread
        x[:, at : at + 3] = (x_m, y_m, heading_rad)
        for entry, sigma in ((Of.X, sigma_m), (Of.Y, sigma_m), (Of.HEADING, sigma_rad)):
            p[:, at + entry, at + entry] = sigma**2
        wrong = self.wrong_start > 0.0
        x[wrong, at : at + 2] += (
            math.sqrt(0.5) * self.settings.jump_m * self.rng.standard_normal((wrong.sum(), 2))
        )
        for entry in (Of.X, Of.Y):
            p[wrong, at + entry, at + entry] += 0.5 * self.settings.jump_m**2
        p[:, at + Of.DRIFT, at + Of.DRIFT] = (
            self.has_constants * (1.0 - self.steady) * self.settings.drift_rad_s**2
        )
        p[:, at + Of.SCALE, at + Of.SCALE] = self.has_constants * self.settings.scale**2
        self.nodes += 1
        self._put(x, p)
        self.biases = {pair: place + PER_NODE for pair, place in self.biases.items()}
        self.levels.add_node()
        drawn = self.rng.standard_normal((count, COMPONENTS))
        self.draw = np.concatenate([self.draw[:, :-1], drawn, self.draw[:, -1:]], axis=1)
        sens = lanes.empty_lines(len(self._x), self.nodes, COMPONENTS, 6)
        sens[:, :-1], sens[:, -1] = self._sens, 0.0
        self._sens = sens
        self._spread_levels()
        self.surprise = np.append(self.surprise, 0.0)
        self.since_turn_s = np.append(self.since_turn_s, 0.0)
        self.cusum = self.cusum.with_node()
        return row

    def _set_arms(self, arm: Floats) -> None:
        self.arm = arm
        """Each user's antenna, (forward, left) of its pose, metres."""
        # Where all are on their wearers' axes kernels take the shorter way.
        self._arms = arm if arm.any() else arm[:0]

    def place(
        self,
        rows: Indices,
        poses: Floats,
        covariances: Floats,
        log_weights: Floats,
        beside: int | None = None,
    ) -> None:
        """Put users ``rows`` (M,) at start hypotheses, and leave everybody else where he is.

        ``poses`` (H, M, 3), ``covariances`` (H, 3 M, 3 M), ``log_weights`` (H,); the hypotheses
        are dealt out by weight, independently of what they say of the others. Where the places
        were found relative to the others, their errors have the error of user ``beside`` in them.
        """
        self.grow()
        share = np.exp(log_weights - log_weights.max())
        share /= share.sum()
        chosen = self.rng.permutation(systematic(share, self.count, self.rng))
        pose = (PER_NODE * rows[:, None] + np.arange(3)).ravel()
        x, p = joint.unpack(self._x, self._p, self.nodes, self.count)
        x[:, pose] = poses.reshape(len(share), -1)[chosen]
        p[:, pose, :] = 0.0
        p[:, :, pose] = 0.0
        if beside is not None:
            leader = PER_NODE * beside
            for row in rows:
                for axis in (Of.X, Of.Y):
                    at = PER_NODE * int(row) + axis
                    p[:, at, :] = p[:, leader + axis, :]
                    p[:, :, at] = p[:, :, leader + axis]
            common = p[:, leader : leader + 2, leader : leader + 2]
            for a in rows:
                for b in rows:
                    i, j = PER_NODE * int(a), PER_NODE * int(b)
                    p[:, i : i + 2, j : j + 2] = common
        p[np.ix_(np.arange(self.count), pose, pose)] += covariances[chosen]
        self._put(x, p)

    def split_heading(self, row: int, moved_m: float) -> None:
        """Give each hypothesis another direction of a user of whose heading nothing is known.

        ``moved_m`` is how far the user has gone without one.
        """
        self.grow()
        order = self.rng.permutation(self.count)
        width = _TWO_PI / self.count
        heading = width * (order + self.rng.random(self.count))
        self._x[:, self._place(row, Of.HEADING)] = self._in_lanes(heading)
        self._forget(row, Of.HEADING)
        self._widen(row, Of.HEADING, max(1.5 * width, 0.12) ** 2)
        for entry in (Of.X, Of.Y):
            self._widen(row, entry, 0.5 * moved_m**2)

    def set_scale(self, row: int, scale: float) -> None:
        """Start a user's step scale (true over reported) where it is modelled."""
        logs = self.has_constants * math.log(scale)
        self._x[:, self._place(row, Of.SCALE)] = self._in_lanes(logs)

    # -- one epoch -----------------------------------------------------------------------------

    def move(self, rows: Indices, moves: Floats, sigmas: Floats | None = None) -> None:
        """Move users ``rows`` (M,) in this order; a user may occur several times.

        ``moves`` (M, 4) are dx, dy (m), dtheta (rad), duration (s); ``sigmas`` (M, 3) the
        reported standard deviations (forward and left m, turn rad), NaN where there are none.
        """
        several = len(rows)
        if not several:
            return
        told = _UNTOLD if sigmas is None else sigmas
        self._check(rows, rows)
        if moves.shape != (several, 4) or len(told) not in (0, several):
            raise ValueError(f"displacements of shape {moves.shape} for {several} rows")
        motion, misjudged = np.empty((several, 7)), np.empty(several)
        turns = bank_kernels.prepare_motion(
            rows, moves, told, self.level, self.count, self.since_turn_s, motion, misjudged
        )
        if self.count == 1:
            drawn = np.zeros((1, several))
        else:
            drawn = self.rng.standard_normal((self.count, several))
        if turns:
            self._misjudge_turns(rows, misjudged)
        joint.advance(
            self._x,
            self._p,
            self.level,
            self._sens,
            rows,
            motion,
            drawn,
            self._sampled,
            bank_kernels.CROSS,
        )

    def _misjudge_turns(self, rows: Indices, share: Floats) -> None:
        """Let a few hypotheses take a reported turn for one of any size (``prepare_motion``)."""
        for m in np.flatnonzero(share >= 0.0):
            some = np.flatnonzero(self.rng.random(self.count) < share[m])
            much = bank_kernels.MISJUDGED_RAD * self.rng.standard_normal(some.size)
            self._shift(int(rows[m]), Of.HEADING, much, some)
            # They would make any innovation look usual, and any picture ambiguous.
            self.doubtful[some] = DOUBT_UPDATES

    @property
    def _sampled(self) -> float:
        """Share of the heading noise that is drawn; one hypothesis alone draws none."""
        s = self.settings
        return hypotheses.sampled_share(s.sampled, self.count, s.hypotheses)

    def update(
        self,
        first: Indices,
        second: Indices,
        range_m: Floats,
        dz_m: Floats,
        dz_variance_m2: Floats | None = None,
        worth: Floats | None = None,
    ) -> Floats:
        """Work in the ranges (R,) of one instant; return each one's probability to be good.

        ``dz_m`` are the antennas' differences of height, ``dz_variance_m2`` their variances (0
        by default), ``worth`` how many independent ranges each is worth (1 by default).
        """
        several = len(first)
        worth = _always(several, 1.0) if worth is None else worth
        dz_variance_m2 = _always(several, 0.0) if dz_variance_m2 is None else dz_variance_m2
        self._check(first, second, range_m, dz_m, dz_variance_m2, worth)
        bias = self._bias_places(first, second)
        s = self.settings
        outlier = self._outlier
        outlier[3] = 1.0 / (1.0 - self._sampled)
        good = np.empty(several)
        slipped, clamped = bank_kernels.take_ranges(
            self._x, self._p, self._log_weight, self.sigma2, self._sens, first, second, bias,
            range_m, dz_m, outlier, worth, dz_variance_m2, self._arms, self.doubtful,
            self.levels.mean, self.levels.covariance, self.outlier_counts, self.surprise,
            self.cusum.sums, self.cusum.base,
            self.since_slip <= OPEN_UPDATES and self.counters["slips"] > 0,
            self._draw, self._steady, s.spread, self.level, good,
        )  # fmt: skip
        if clamped:
            self.counters["levels_clamped"] += clamped
        if slipped >= 0 and s.hypotheses > 1:
            self._alarm = (slipped, first, second, range_m)
        return good

    def lose(self, row: int, sigma_m: float, sigma_rad: float) -> None:
        """Know less of a user: isotropic in place (m), and in heading (rad).

        What is lost altogether (:mod:`relpos.fusion.models.odometry_faults`) is sought when it is
        ranged next.
        """
        self.grow()
        off = math.sqrt(0.5) * sigma_m * self.rng.standard_normal((self.count, 2))
        self._shift(row, Of.X, off[:, 0])
        self._shift(row, Of.Y, off[:, 1])
        kept = min(0.5 * sigma_rad**2, HEADING_CELL_RAD**2)
        turned = math.sqrt(sigma_rad**2 - kept) * self.rng.standard_normal(self.count)
        self._shift(row, Of.HEADING, turned)
        for entry, variance in ((0, 0.5 * sigma_m**2), (1, 0.5 * sigma_m**2), (2, kept)):
            self._widen(row, entry, variance)
        self.doubtful[:] = SLIP_UPDATES
        before = self.unplaced.get(row, (0.0, 0.0))
        total = math.hypot(sigma_m, before[0]), math.hypot(sigma_rad, before[1])
        if self.settings.hypotheses > 1 and (total[0] > LOST_M or total[1] > LOST_RAD):
            self.unplaced[row] = total
            self.slipped.add(row)

    def sight(self, first: Indices, second: Indices, range_m: Floats) -> None:
        """Place users that were lost on the rings of the ranges (R,) that are to be worked in."""
        for row, (sigma_m, sigma_rad) in sorted(self.unplaced.items()):
            if (first == row).any() or (second == row).any():
                del self.unplaced[row]
                self.counters["nodes_sought_again"] += 1
                lost = (sigma_m > LOST_M, sigma_rad > LOST_RAD)
                self._doubt(row, first, second, range_m, sigma_m, lost)

    def _doubt(
        self,
        row: int,
        first: Indices,
        second: Indices,
        range_m: Floats,
        place_m: float,
        lost: tuple[bool, bool] | None = None,
    ) -> None:
        """Let most hypotheses doubt a user that has slipped (``models.odometry_faults``).

        All of them, where place or heading or both are known to be ``lost``.
        """
        self.since_slip = 0
        self.grow()
        # Of two alone either may be the one: what is between them is doubted in the same way.
        self.slipped.update([row] if self.nodes > 2 or lost else range(self.nodes))
        self.resample(self.weights(), max(self.count, HYPOTHESES))
        believing = BELIEVING if lost is None else 0.0
        which = self.rng.permutation(self.count)[round(believing * self.count) :]
        sights = np.flatnonzero((first == row) | (second == row))
        sight = sights[np.arange(len(which)) % len(sights)]
        peer = np.where(first[sight] == row, second[sight], first[sight])
        own, beside = np.array([[_POSE_PLACE * row]]), _POSE_PLACE * peer[:, None]
        block, lane = which[:, None] // LANES, which[:, None] % LANES
        old = self._x[block, own + np.arange(3), lane]
        peers = self._x[block, beside + np.arange(2), lane]
        made = perturb(old, peers, range_m[sight], place_m, self.rng)
        self._x[block, own + np.arange(3), lane] = made.poses
        # What was lost has nothing to do any more with what else is known.
        for anew, part in ((~made.kept[:, 0], (0, 1)), (~made.kept[:, 1], (2,))):
            some = which[anew]
            for entry in part:
                self._forget(row, entry, some)
            for a in part:
                for b in part:
                    place = self._variance_place(row, a, b)
                    self._p[some // LANES, place, some % LANES] = made.covariances[anew, a, b]
        # Neither those who doubt nor those who ought to tell how noisy anybody is.
        self.doubtful[:] = SLIP_UPDATES

    def find_slipped(self, covariance: Floats) -> None:
        """Forget slips of those who are found again, by the mixture's covariance (D, D)."""
        for row in list(self.slipped):
            at = PER_NODE * row
            others = PER_NODE * np.delete(np.arange(self.nodes), row)
            spread = [
                covariance[at + e, at + e] + covariance[others + e, others + e]
                - 2.0 * covariance[at + e, others + e]
                for e in (Of.X, Of.Y)
            ]  # fmt: skip
            near = float(np.min(spread[0] + spread[1], initial=math.inf))
            heading = float(covariance[at + Of.HEADING, at + Of.HEADING])
            if near < FOUND_M**2 and heading < FOUND_RAD**2:
                self.slipped.discard(row)

    def doubt_motion(self, row: int, east_m: Floats, north_m: Floats) -> None:
        """Let half the hypotheses leave out a displacement (K,) just made, world axes."""
        skip = np.flatnonzero(np.arange(self.count) % 2 == 0)
        self._shift(row, Of.X, -east_m[skip], skip)
        self._shift(row, Of.Y, -north_m[skip], skip)
        for entry in (Of.X, Of.Y):
            self._widen(row, entry, ODD_M**2)
        self.doubtful[:] = SLIP_UPDATES
        self.counters["motions_doubted"] += 1

    def places_of(self, row: int) -> tuple[Floats, Floats]:
        """Where a user is in every hypothesis: x (K,) and y (K,), metres."""
        return self._column(row, Of.X), self._column(row, Of.Y)

    def poses_of(self, row: int) -> tuple[Floats, Floats]:
        """A user's poses (K, 3) and their covariances (K, 3, 3)."""
        poses = np.stack([self._column(row, entry) for entry in range(3)], axis=1)
        spread = np.empty((self.count, 3, 3))
        for a in range(3):
            for b in range(3):
                place = self._variance_place(row, a, b)
                spread[:, a, b] = self._p[:, place].reshape(-1)[: self.count]
        return poses, spread

    def apart(self, row: int, other: int) -> tuple[Floats, Floats]:
        """Where a user is as seen from another: (K, 2) and its covariances (K, 2, 2)."""
        (from_x, from_y), (to_x, to_y) = self.places_of(row), self.places_of(other)
        i, j = self._place(row), self._place(other)
        spread = np.empty((self.count, 2, 2))
        for a in range(2):
            for b in range(2):
                own, peer, cross, back = (
                    self._p[:, joint.triangle_place(m, n)].reshape(-1)[: self.count]
                    for m, n in ((i + a, i + b), (j + a, j + b), (i + a, j + b), (j + a, i + b))
                )
                spread[:, a, b] = own + peer - cross - back
        return np.stack([to_x - from_x, to_y - from_y], axis=1), spread

    def _bias_places(self, first: Indices, second: Indices) -> Indices:
        """Where in the state the biases of ranges are; those of new pairs are added.

        A pair's bias is the common one plus its own part, so a new pair starts from what is known
        of the common one. Where there are too many pairs, only the common one is modelled.
        """
        if not self._some_biased:
            return _no_places(len(first))
        common = PER_NODE * self.nodes
        places = np.full(len(first), common, dtype=np.int64)
        for r, (a, b) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
            pair = (a, b) if a < b else (b, a)
            place = self.biases.get(pair)
            if place is None and self.nodes <= PAIR_BIASES:
                place = self._add_bias(pair)
            if place is not None:
                places[r] = place
        return places

    def _add_bias(self, pair: tuple[int, int]) -> int:
        size, common = int(self._x.shape[1]), PER_NODE * self.nodes
        old = self._p.shape[1]
        x = lanes.empty_lines(len(self._x), size + 1)
        p = lanes.empty_lines(len(self._x), old + size + 1)
        x[:, :size], x[:, size] = self._x, self._x[:, common]
        p[:, :old] = self._p
        p[:, old:-1] = self._p[:, [joint.triangle_place(common, q) for q in range(size)]]
        own = self.has_bias * self.settings.pair_bias_m**2
        p[:, -1] = self._p[:, joint.triangle_place(common, common)] + self._in_lanes(own)
        self._x, self._p = x, p
        self.biases[pair] = size
        return size

    @property
    def outlier_share(self) -> float:
        """What share of the ranges are outliers, as far as is known."""
        return float(bank_kernels.expect_outliers(self.outlier_counts, self._outlier))

    def heading(self, row: int, heading_rad: float, sigma_rad: float) -> None:
        """Work in an absolute heading of a user."""
        joint.update_heading(
            self._x, self._p, self._log_weight, self.nodes, row, heading_rad, sigma_rad**2,
            HEADING_OUTLIERS, HEADING_OUTLIER_RAD**2,
        )  # fmt: skip

    def hearing(
        self,
        first: Indices,
        second: Indices,
        dz_m: Floats,
        heard: npt.NDArray[np.bool_],
        tried: Floats,
        detection: Detection,
    ) -> None:
        """Work in which of the pairs (U,) that were tried, with probability ``tried``, were heard.

        After their ranges: it is the distances after them that decide what this tells.
        """
        before = self.log_weight.copy()
        joint.hearing(
            self._x, self._p, self._log_weight, self.nodes, first, second, dz_m, heard, tried,
            detection.weight, detection.curve, STEP_M,
        )  # fmt: skip
        bank_kernels.temper(self._log_weight, before)

    def predicted_ranges(
        self, first: Indices, second: Indices, dz_m: Floats
    ) -> tuple[Floats, Floats]:
        """Give means and standard deviations (U,) of slant distances over all hypotheses."""
        self._normalise()
        return joint.predicted_ranges(self._x, self._p, self._weight, first, second, dz_m)

    def settle(self) -> None:
        """Close an epoch: jumps, and resampling where the weights have become uneven."""
        self._resize()
        effective = self._normalise()
        self.since_slip += 1
        closed = not self.slipped or self.since_slip > OPEN_UPDATES
        if self._alarm is not None:
            self.counters["slips"] += 1
            self._doubt(*self._alarm, self.settings.jump_m)
            self._alarm = None
        elif self.count > self.ceiling and closed:
            self.resample(self.weights(), self.ceiling)
        elif effective < 0.5 * self.count:
            self.resample(self.weights())
        if self.count > 1:
            self._jump()

    def weights(self) -> Floats:
        """Normalised weights (K,); the log weights are shifted so that their greatest is 0."""
        self._normalise()
        return self._weight.reshape(-1)[: self.count]

    def _normalise(self) -> float:
        """Bring ``_weight`` (B, LANES) up to the log weights; return the effective size."""
        self._weight = np.empty_like(self._log_weight)
        return float(bank_kernels.normalise(self._log_weight, self.count, self._weight))

    def resample(self, weight: Floats, count: int | None = None) -> None:
        """Draw hypotheses anew by their weights; levels of noise are jittered (Liu, West)."""
        self._keep(systematic(weight, self.count if count is None else count, self.rng))
        # Children of one parent part in their levels, too (Liu, West).
        self.draw *= math.sqrt(1.0 - JITTER**2)
        self.draw += JITTER * self.rng.standard_normal(self.draw.shape)
        if self.steady.any():
            self.steady *= self.rng.random(self.count) >= UNSETTLED
        self._spread_levels()
        self._log_weight = np.zeros((len(self._x), LANES))
        self.counters["resampled"] += 1

    def _keep(self, chosen: Indices) -> None:
        """Go on with the hypotheses ``chosen`` (M,)."""
        self._x, self._p = joint.take(self._x, chosen), joint.take(self._p, chosen)
        self.count = len(chosen)
        self.draw = self.draw[chosen]
        flat = joint.take(self._sens.reshape(len(self._sens), -1, LANES), chosen)
        self._sens = flat.reshape(len(flat), *self._sens.shape[1:])
        self.has_constants, self.has_bias = self.has_constants[chosen], self.has_bias[chosen]
        self.steady = self.steady[chosen]
        self.doubtful = self.doubtful[chosen]
        self.wrong_start = self.wrong_start[chosen]
        self._some_biased = bool(self.has_bias.any())

    def _spread_levels(self) -> None:
        """Give every hypothesis its draw of what is known of the levels."""
        s = self.settings
        blocks = lanes.blocks_of(self.count)
        if self.level.shape[:2] != (blocks, self.nodes):
            self.level = lanes.empty_lines(blocks, self.nodes, COMPONENTS)
            self.sigma2 = lanes.empty_lines(blocks)
        laid = np.concatenate([self.draw, self.draw[[-1] * (blocks * LANES - self.count)]])
        self._draw = lanes.copy_lines(laid.reshape(blocks, LANES, -1).transpose(0, 2, 1))
        self._steady = self._in_lanes(self.steady)
        bank_kernels.spread_levels(
            self._draw, self._steady, self.levels.mean, self.levels.covariance, s.spread,
            self.level, self.sigma2,
        )  # fmt: skip

    @property
    def _usual_surprise(self) -> float:
        return max(bank_kernels.SURPRISE, bank_kernels.SURPRISE_OF_OUTLIERS * self.outlier_share)

    # -- how many (relpos.fusion.bank.hypothesis_count)
    # ---------------------------------------------------

    def _resize(self) -> None:
        """Shrink where the picture has been unambiguous for a while; grow where it is not."""
        if self.settings.hypotheses == 1 or not self.nodes:
            return
        open_ = bool(
            self._alarm or self.slipped or self.unplaced
            or bank_kernels.surprises(self.surprise, self.outlier_counts, self._outlier)
        )  # fmt: skip
        most = self.count >= self.settings.hypotheses
        if most and self.since_slip % hypotheses.LOOKED_AFTER == 0:
            self._follow_bend()
        if most and open_:
            self.unambiguous = 0
            return
        step_bend = self._step_bend()
        if most and step_bend > hypotheses.FLAT:
            self.unambiguous = 0
            return
        poses = joint.order(self.nodes, self._x.shape[1])[: _POSE_PLACE * self.nodes]
        mean, covariance = joint.moments(
            self._x, self._p, self._undoubted, self.nodes, poses, len(poses), len(poses)
        )
        sigmas = np.exp(0.5 * self.levels.mean)
        metre = math.sqrt(ALONG_M2_M) * sigmas[ALONG:-1:COMPONENTS]
        bend = hypotheses.bend(mean, covariance, float(sigmas[-1]), metre)
        if open_ or bend > hypotheses.BENT:
            self.unambiguous = 0
            self.grow()
        elif bend > hypotheses.FLAT or not self._is_even(covariance, poses, step_bend):
            self.unambiguous = 0
        else:
            self.unambiguous += 1
            fewer = [n for n in hypotheses.STEPS if n < self.count]
            if fewer and self.unambiguous >= hypotheses.HELD:
                self.unambiguous = 0
                self._shrink(fewer[0])

    def _follow_bend(self) -> None:
        """Have more than the ordinary number of hypotheses while the picture bends much."""
        usual = self.settings.hypotheses
        undoubted = np.empty_like(self._log_weight)
        bank_kernels.undoubted_weights(self._log_weight, self.doubtful, undoubted)
        mean, covariance = self._moments(undoubted, poses_alone=True)
        # How short the next metre is, is in the motion's moments: arcs alone count here.
        straight = np.full(self.nodes, np.inf)
        bend = hypotheses.bend(mean, covariance, math.exp(0.5 * self.levels.mean[-1]), straight)
        if bend < hypotheses.EASED:
            self.ceiling = usual
        elif bend > hypotheses.CURLED and self.ceiling == usual:
            self.ceiling = hypotheses.most(usual, int(self._x.shape[1]))
            if self.count < self.ceiling:
                self.resample(self.weights(), self.ceiling)

    def _step_bend(self) -> float:
        """Bend of the next metre, inf where the hypotheses are undecided; undoubted weights."""
        self._undoubted = np.empty_like(self._log_weight)
        if float(self.levels.covariance[-1, -1]) > hypotheses.KNOWN**2:
            bank_kernels.undoubted_weights(self._log_weight, self.doubtful, self._undoubted)
            return math.inf
        self._weight = np.empty_like(self._log_weight)
        return float(
            bank_kernels.step_bend(
                self._x, self._p, self._log_weight, self.doubtful, self.has_constants,
                self.has_bias, self.levels.mean, self.nodes, self._weight, self._undoubted,
            )
        )  # fmt: skip

    def _is_even(self, covariance: Floats, poses: Indices, step_bend: float) -> bool:
        """Whether the hypotheses are one cloud: no few of them count, and none lie far apart."""
        if self.count == 1:
            return True
        drawn = self._sampled / (1.0 - self._sampled)
        return step_bend < math.inf and bool(
            bank_kernels.is_even(self._p, self._undoubted, covariance, poses, len(poses), drawn)
        )

    def _moments(self, weight: Floats, poses_alone: bool) -> tuple[Floats, Floats]:
        size = self._x.shape[1]
        of = joint.order(self.nodes, size)
        places = _POSE_PLACE * self.nodes if poses_alone else size
        return joint.moments(self._x, self._p, weight, self.nodes, of, places, size)

    def _weight_lines(self, weight: Floats) -> Floats:
        """Weights (K,) as (B, LANES): what fills up the last block counts nothing."""
        laid = np.zeros(len(self._x) * LANES)
        laid[: self.count] = weight
        return laid.reshape(-1, LANES)

    def grow(self) -> None:
        """Have as many hypotheses as may be: fewer are copied, and their headings drawn."""
        most = self.settings.hypotheses
        if self.count >= most:
            return
        share = hypotheses.sampled_share(self.settings.sampled, most, most) - self._sampled
        self.resample(self.weights(), most)
        self.draw = self.rng.standard_normal(self.draw.shape)
        self._spread_levels()
        angles = PER_NODE * np.arange(self.nodes, dtype=np.int64) + Of.HEADING
        x, p = joint.unpack(self._x, self._p, self.nodes, self.count)
        self._put(*hypotheses.parted(x, p, angles, share, self.rng))
        self.counters["hypotheses_grown"] += 1

    def _shrink(self, count: int) -> None:
        """Go on with fewer hypotheses, the mixture's moments unchanged."""
        self._step_bend()
        mean, covariance = self._moments(self._undoubted, poses_alone=False)
        self.log_weight[:] -= np.where(self.doubtful > 0.0, bank_kernels.DOUBTERS, 0.0)
        angles = PER_NODE * np.arange(self.nodes, dtype=np.int64) + Of.HEADING
        before, weight = self._sampled, self.weights()
        sens = np.einsum("bl,b...l->...", self._weight_lines(weight), self._sens)
        chosen = systematic(weight, count, self.rng)
        x = self.x
        after = hypotheses.sampled_share(self.settings.sampled, count, self.settings.hypotheses)
        thinned, p = hypotheses.thinned(
            x, mean, covariance, chosen, angles, after / before if before else 0.0
        )
        constants, bias = self.has_constants.any(), self.has_bias.any()
        steady = float(weight @ self.steady)
        self._keep(chosen)
        self._put(thinned, np.repeat(p[None], count, axis=0))
        self._sens[...] = sens[..., None]
        self.doubtful = np.zeros(count)
        # The moments have something of the constants wherever any hypothesis has.
        self.has_constants = np.full(count, float(constants))
        self.has_bias = np.full(count, float(bias))
        # Between the two, where that is open: a picture that does not bend leaves it so for long.
        self.steady = np.full(count, steady)
        self._some_biased = bool(bias)
        if count == 1:
            self.draw = np.zeros_like(self.draw)
        self._spread_levels()
        self._log_weight = np.zeros((len(self._x), LANES))
        self.counters["hypotheses_shrunk"] += 1

    def _jump(self) -> None:
        """Let some hypotheses doubt a user's pose; the more, the worse its ranges fit."""
        s = self.settings
        if not self.nodes or self.count < 2:
            return
        usual, quiet = self._usual_surprise, s.jumps / self.nodes
        rate = [
            quiet + (s.jumps_most - quiet) * min(max((much - usual) / 0.35, 0.0), 1.0)
            for much in self.surprise.tolist()
        ]
        total = sum(rate)
        which = np.flatnonzero(self.rng.random(self.count) < total)
        if not which.size:
            return
        self.doubtful[which] = DOUBT_UPDATES
        edges = np.cumsum(rate) / total
        edges[-1] = 1.0
        for k in which.tolist():
            row = int(np.searchsorted(edges, self.rng.random(), side="right"))
            offset = self.rng.standard_normal(3).tolist()
            block, lane = divmod(k, LANES)
            for entry, sigma in enumerate((s.jump_m, s.jump_m, s.jump_rad)):
                self._x[block, self._place(row, entry), lane] += (
                    math.sqrt(0.5) * offset[entry] * sigma
                )
                self._p[block, self._variance_place(row, entry), lane] += 0.5 * sigma**2
        self.counters["jumps"] += len(which)

    # -- what is known -------------------------------------------------------------------------

    def moments(self, *, poses_alone: bool = False) -> tuple[Floats, Floats]:
        """Give the mixture's mean (D,) and full covariance (D, D).

        With ``poses_alone`` constants and biases have variances, and covariances of 0.
        """
        self._normalise()
        return self._moments(self._weight, poses_alone)


_POSE_PLACE = 3
"""Users' poses are stored first, three places each."""

PAIR_BIASES = 6
"""Up to so many users each pair has a bias of its own in the state: 15 of them double its size.
Of more, the common one is modelled."""

UNSETTLED = 0.06
"""Of those who take the team's headings for steady, so many give it up at each resampling. People
who walk straight on look steady; when they turn, somebody has to be left who knows better
(``paper``, seeds 9100 to 9109: 0.77 m, without it 0.82 with a worst of 1.34)."""

JITTER = 0.1
"""Standard deviation of the levels' jitter at resampling, in units of their spread."""

OPEN_UPDATES = 60
"""Many hypotheses are kept for so many instants of ranges at most: what has not told where
somebody is by then (few peers, standing) will not soon."""

FOUND_M, FOUND_RAD = 1.0, 0.4
"""Who slipped is found when his place as seen from somebody, and his heading, are known so well."""

ODD_M = 0.3
"""How far a displacement may be off that was doubted, whether it is left out or not."""

SLIP_UPDATES = 10.0
"""As ``DOUBT_UPDATES``, of all hypotheses after a slip."""

DOUBT_UPDATES = 5.0
"""For so many instants of ranges a hypothesis that has jumped teaches nothing about noise."""

OUTLIER_RANGES = 2.0
"""The share of outliers that is expected beforehand is worth so many ranges: where a third of them
are reflections that has to be known before they have moved anybody (``lab``, seeds 300 to 323:
1.07 m with 5 % worth four, 0.95 m with 10 % worth two)."""

HEADING_OUTLIERS = 0.1
HEADING_OUTLIER_RAD = 1.0


@lru_cache(maxsize=64)
def _always(count: int, value: float) -> Floats:
    """Give the same number (count,), for kernels to read; flagged so, it would be another type."""
    return np.full(count, value)


@lru_cache(maxsize=64)
def _no_places(count: int) -> Indices:
    # Not read-only: of another type, for which ``take_ranges`` would be compiled once more.
    return np.full(count, -1, dtype=np.int64)
