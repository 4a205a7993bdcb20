"""A bank of joint error-state filters: the default estimator.

Every hypothesis is one possible history: a joint filter over all users
(:mod:`relpos.fusion.joint`), levels of noise (:mod:`relpos.fusion.noise`) and a weight.
:class:`BankCore` holds them as arrays and knows neither measurements nor node ids;
:class:`Bank` is the :class:`~relpos.fusion.estimator.Estimator` around it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.fusion import hypotheses, joint, noise
from relpos.fusion.ambiguity import believe, pictures
from relpos.fusion.bank_settings import BankSettings
from relpos.fusion.detection import STEP_M, Detection, Round
from relpos.fusion.estimator import (
    ANY_ANGLE_RAD,
    Alternative,
    Estimate,
    NodeEstimate,
    NodeStatus,
    PairEstimate,
    Parameter,
    Presence,
    refuse_unmoved,
    refuse_unranged,
)
from relpos.fusion.joint import PER_NODE, Of
from relpos.fusion.motion_model import told_sigmas
from relpos.fusion.ranging_model import Mounting, Repetition
from relpos.fusion.rewind import Rewinder
from relpos.fusion.slips import (
    BELIEVING,
    HEADING_CELL_RAD,
    HYPOTHESES,
    LOST_M,
    LOST_RAD,
    VAGUE_M,
    Habit,
    Stillness,
    Watch,
    doubts,
)
from relpos.fusion.starts import SETTLED_HEADING_RAD, Found, Mixture, Starts
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Step, Timeline
from relpos.measurements import Heading, Height, Measurement, Prior, Range

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_DRIFT, _SCALE = int(Of.DRIFT), int(Of.SCALE)
_TWO_PI = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything a core needs to go back: array copies and the generator's state."""

    arrays: tuple[Floats, ...]
    random: Mapping[str, object]
    numbers: tuple[float, ...]
    biases: Mapping[tuple[int, int], int]
    counters: Mapping[str, int]
    unplaced: Mapping[int, tuple[float, float]]


class BankCore:
    """K hypotheses about N users, as arrays. Nothing here knows node ids or wall time.

    Users are *rows* 0 ... N-1 in the order of ``add_node``. ``x`` (K, D) and ``p`` (K, D, D)
    are the hypotheses' means and covariances, ``log_weight`` (K,) their unnormalised
    log weights; D = 5 N + 1 + pairs: five entries a user, see :class:`~relpos.fusion.joint.Of`,
    then the range bias that all pairs share, then that of each pair as it is first heard.

    The order of work in one epoch: ``advance`` (once or more), ``update`` (all ranges of one
    instant), ``log_weight +=`` whatever else is known (silence, ...), then ``settle`` (jumps,
    resampling). ``moments`` gives the mixture's mean and full covariance at any time.
    ``snapshot`` and ``restore`` bring everything back exactly, randomness included, so that what
    came late can be put in its place and the rest be repeated.
    """

    def __init__(self, settings: BankSettings, seed: int = 0) -> None:
        """Start with no users and ``settings.hypotheses`` equal hypotheses."""
        self.settings = settings
        self.rng = np.random.default_rng(seed)
        self.counters: Counter[str] = Counter()
        count = settings.hypotheses
        self.nodes = 0
        self.arm: Floats = np.zeros((0, 2))
        """Each user's antenna, (forward, left) of its pose, metres."""
        self.x: Floats = np.zeros((count, 1))
        self.p: Floats = np.zeros((count, 1, 1))
        self.log_weight: Floats = np.zeros(count)
        self.levels = noise.Levels()
        self.draw: Floats = self.rng.standard_normal((count, 1))
        self.sens: Floats = np.zeros((count, 0, noise.LEVELS, 6))
        self._spread_levels()
        self.has_constants: Floats = (
            self.rng.permutation(count) < round(settings.constants * count)
        ).astype(np.float64)
        self.has_bias: Floats = (
            self.rng.permutation(count) < round(settings.biased * count)
        ).astype(np.float64)
        self.p[:, 0, 0] = self.has_bias * settings.bias_m**2
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
        self.watch = Watch()
        self.slipped: set[int] = set()
        """Rows whose odometry has slipped and that are not found again yet."""
        self.unplaced: dict[int, tuple[float, float]] = {}
        """Row -> how badly its place (m) and heading (rad) are known, till it is ranged."""
        self.since_slip = 0
        """Instants of ranges since the last alarm."""
        self.unambiguous = 0
        """For so many instants of ranges the picture has been so."""
        self._alarm: tuple[int, Indices, Indices, Floats] | None = None
        self.outlier_counts: Floats = np.array([settings.outliers, 1.0 - settings.outliers]) * 20.0

    # -- users ---------------------------------------------------------------------------------

    @property
    def count(self) -> int:
        """K, the number of hypotheses."""
        return int(self.x.shape[0])

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
        self.arm = np.concatenate([self.arm, np.array([arm_m])])
        count, old = self.x.shape
        row = self.nodes
        at = PER_NODE * row
        x = np.zeros((count, old + PER_NODE))
        p = np.zeros((count, old + PER_NODE, old + PER_NODE))
        keep = np.r_[0:at, at + PER_NODE : old + PER_NODE]
        x[:, keep] = self.x
        p[np.ix_(np.arange(count), keep, keep)] = self.p
        x[:, at : at + 3] = (x_m, y_m, heading_rad)
        for entry, sigma in ((Of.X, sigma_m), (Of.Y, sigma_m), (Of.HEADING, sigma_rad)):
            p[:, at + entry, at + entry] = sigma**2
        wrong = self.wrong_start > 0.0
        x[wrong, at : at + 2] += (
            math.sqrt(0.5) * self.settings.jump_m * self.rng.standard_normal((wrong.sum(), 2))
        )
        for entry in (Of.X, Of.Y):
            p[wrong, at + entry, at + entry] += 0.5 * self.settings.jump_m**2
        p[:, at + Of.DRIFT, at + Of.DRIFT] = self.has_constants * self.settings.drift_rad_s**2
        p[:, at + Of.SCALE, at + Of.SCALE] = self.has_constants * self.settings.scale**2
        self.x, self.p = x, p
        self.nodes += 1
        self.biases = {pair: place + PER_NODE for pair, place in self.biases.items()}
        self.levels.add_node()
        drawn = self.rng.standard_normal((count, noise.LEVELS))
        self.draw = np.concatenate([self.draw[:, :-1], drawn, self.draw[:, -1:]], axis=1)
        self.sens = np.concatenate([self.sens, np.zeros((count, 1, noise.LEVELS, 6))], axis=1)
        self._spread_levels()
        self.surprise = np.append(self.surprise, 0.0)
        self.since_turn_s = np.append(self.since_turn_s, 0.0)
        self.watch.add_node()
        return row

    def remove(self, row: int) -> None:
        """Forget a user; the rows above it move down by one."""
        at = PER_NODE * row
        self.nodes -= 1
        gone = [*range(at, at + PER_NODE), *(e for pair, e in self.biases.items() if row in pair)]
        keep = np.delete(np.arange(self.x.shape[1]), gone)
        self.x = np.ascontiguousarray(self.x[:, keep])
        self.p = np.ascontiguousarray(self.p[:, keep][:, :, keep])
        place = {int(old): new for new, old in enumerate(keep)}
        self.biases = {
            (a - (a > row), b - (b > row)): place[e]
            for (a, b), e in self.biases.items()
            if row not in (a, b)
        }
        self.levels.remove(row)
        self.draw = np.delete(self.draw, noise.LEVELS * row + np.arange(noise.LEVELS), axis=1)
        self.sens = np.ascontiguousarray(np.delete(self.sens, row, axis=1))
        self._spread_levels()
        self.surprise = np.delete(self.surprise, row)
        self.since_turn_s = np.delete(self.since_turn_s, row)
        self.watch.remove(row)
        self.slipped = {r - (r > row) for r in self.slipped if r != row}
        self.unplaced = {r - (r > row): s for r, s in self.unplaced.items() if r != row}
        self.arm = np.delete(self.arm, row, axis=0)

    def seed_hypotheses(self, poses: Floats, covariances: Floats, log_weights: Floats) -> None:
        """Replace all users' poses by start hypotheses.

        ``poses`` (H, N, 3), ``covariances`` (H, 3 N, 3 N) in the order x, y, heading of user 0,
        of user 1, ...; ``log_weights`` (H,). The K hypotheses (levels of noise, constants) are
        dealt out over them by weight, each H at least once where H <= K.
        """
        self.grow()
        share = np.exp(log_weights - log_weights.max())
        share /= share.sum()
        given = len(share)
        chosen = systematic(share, max(self.count - given, 0), self.rng)
        if given <= self.count:
            chosen = np.concatenate([np.arange(given), chosen])
        else:
            chosen = systematic(share, self.count, self.rng)
        times = np.bincount(chosen, minlength=given)
        order = self.rng.permutation(self.count)
        self.x, self.p = self.x[order], self.p[order]
        self._permute_parameters(order)
        pose = (PER_NODE * np.arange(self.nodes)[:, None] + np.arange(3)).ravel()
        self.x[:, pose] = poses.reshape(given, -1)[chosen]
        self.p[:, pose, :] = 0.0
        self.p[:, :, pose] = 0.0
        self.p[np.ix_(np.arange(self.count), pose, pose)] = covariances[chosen]
        self.log_weight = np.log(share[chosen] / times[chosen])

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
        self.x[:, pose] = poses.reshape(len(share), -1)[chosen]
        self.p[:, pose, :] = 0.0
        self.p[:, :, pose] = 0.0
        if beside is not None:
            leader = PER_NODE * beside
            for row in rows:
                for axis in (Of.X, Of.Y):
                    at = PER_NODE * int(row) + axis
                    self.p[:, at, :] = self.p[:, leader + axis, :]
                    self.p[:, :, at] = self.p[:, :, leader + axis]
            common = self.p[:, leader : leader + 2, leader : leader + 2]
            for a in rows:
                for b in rows:
                    i, j = PER_NODE * int(a), PER_NODE * int(b)
                    self.p[:, i : i + 2, j : j + 2] = common
        self.p[np.ix_(np.arange(self.count), pose, pose)] += covariances[chosen]

    def split_heading(self, row: int, moved_m: float) -> None:
        """Give each hypothesis another direction of a user of whose heading nothing is known.

        ``moved_m`` is how far the user has gone without one.
        """
        self.grow()
        order = self.rng.permutation(self.count)
        at = PER_NODE * row
        width = _TWO_PI / self.count
        self.x[:, at + Of.HEADING] = width * (order + self.rng.random(self.count))
        self.p[:, at + Of.HEADING, :] = 0.0
        self.p[:, :, at + Of.HEADING] = 0.0
        self.p[:, at + Of.HEADING, at + Of.HEADING] = max(1.5 * width, 0.12) ** 2
        for entry in (Of.X, Of.Y):
            self.p[:, at + entry, at + entry] += 0.5 * moved_m**2

    def set_scale(self, row: int, scale: float) -> None:
        """Start a user's step scale (true over reported) where it is modelled."""
        self.x[:, PER_NODE * row + Of.SCALE] = self.has_constants * math.log(scale)

    # -- one epoch -----------------------------------------------------------------------------

    def advance(
        self,
        rows: Indices,
        dx_m: Floats,
        dy_m: Floats,
        dtheta_rad: Floats,
        duration_s: Floats,
        sigmas: Floats | None = None,
    ) -> None:
        """Move users ``rows`` (M,), in this order; a user may come several times.

        ``sigmas`` (M, 3) are the pieces' own standard deviations (forward and left m, turn rad)
        where the reports bring any, else NaN.
        """
        if not len(rows):
            return
        _check_rows(self.nodes, rows, rows, dx_m, dy_m, dtheta_rad, duration_s)
        told = np.full((len(rows), 3), np.nan) if sigmas is None else sigmas
        motion = np.empty((len(rows), 7))
        motion[:, 0], motion[:, 1], motion[:, 2], motion[:, 3] = dx_m, dy_m, dtheta_rad, duration_s
        # Who reports nothing at all stands: no time passes for the heading.
        motion[(motion[:, :3] == 0.0).all(axis=1), 3] = 0.0
        motion[:, 4:] = noise.motion_variances(dx_m, dy_m, dtheta_rad, duration_s, told)
        drawn = self.rng.standard_normal((self.count, len(rows)))
        self._misjudge_turns(rows, motion, told)
        joint.advance(
            self.x, self.p, self.level, self.sens, rows, motion, drawn, self._sampled, CROSS
        )

    def _misjudge_turns(self, rows: Indices, motion: Floats, told: Floats) -> None:
        """Let a few hypotheses take a reported turn for one of any size.

        A turn's noise grows with the turn, of which only the report is known: one of a right
        angle that was reported as next to nothing would pass for exact. Only what sticks out of
        the wearer's white heading noise is a turn, and only reports that bring no sigma need it;
        who turns all the time is judged by the next turn, and is left alone.
        """
        if self.count < 2:
            return
        white = motion[:, 6] * self.level[:, rows, noise.WHITE].mean(axis=0)
        turn = motion[:, 2] ** 2 > LEAST_TURN_RAD**2 + TURN_STANDS_OUT**2 * white
        turn &= np.isnan(told[:, 2])
        for m, row in enumerate(rows):
            if not turn[m]:
                self.since_turn_s[row] += motion[m, 3]
                continue
            share = MISJUDGED * min(float(self.since_turn_s[row]) / STRAIGHT_S, 1.0) ** 2
            self.since_turn_s[row] = 0.0
            some = np.flatnonzero(self.rng.random(self.count) < share)
            self.x[some, PER_NODE * row + Of.HEADING] += MISJUDGED_RAD * self.rng.standard_normal(
                some.size
            )
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
        worth = np.ones(len(first)) if worth is None else worth
        dz_variance_m2 = np.zeros(len(first)) if dz_variance_m2 is None else dz_variance_m2
        _check_rows(self.nodes, first, second, range_m, dz_m, dz_variance_m2, worth)
        bias = self._bias_places(first, second)
        stats = np.empty((self.count, len(first), joint.STATS))
        before = self.log_weight.copy()
        outlier = np.array([self.outlier_share, self.settings.outlier_m**2,
                            self.settings.outliers_short, 1.0 / (1.0 - self._sampled)])  # fmt: skip
        joint.update(
            self.x, self.p, self.log_weight, self.sigma2, self.sens, first, second, bias,
            range_m, dz_m, outlier, PER_NODE * self.nodes, worth, dz_variance_m2,
            self.arm if self.arm.any() else self.arm[:0], stats,
        )  # fmt: skip
        # Those who have just jumped would make any innovation look usual.
        prior = np.exp(before - before.max()) * np.where(self.doubtful > 0.0, 1e-3, 1.0)
        prior /= prior.sum()
        middle = prior @ stats[:, :, 0]
        variance = prior @ (stats[:, :, 1] + (stats[:, :, 0] - middle) ** 2)
        slipped = self.watch.look(
            first, second, (range_m - middle) ** 2 / variance, worth, self.outlier_share,
            wary=self.counters["slips"] > 0 and self.since_slip <= OPEN_UPDATES,
        )  # fmt: skip
        weight = self.weights()
        good: Floats = weight @ stats[:, :, 3]
        self.counters["levels_clamped"] += self.levels.learn(
            first, second, range_m, stats, before, (self.doubtful <= 0.0).astype(np.float64), worth
        )
        self.doubtful -= 1.0
        self._spread_levels()
        self.outlier_counts *= 0.998 ** len(first)
        self.outlier_counts += (float((1.0 - good).sum()), float(good.sum()))
        surprise = self.surprise.tolist()
        for row, peer, trust in zip(first.tolist(), second.tolist(), good.tolist(), strict=True):
            for one in (row, peer):
                surprise[one] += 0.2 * (1.0 - trust - surprise[one])
        self.surprise[:] = surprise
        if slipped is not None and self.settings.hypotheses > 1:
            self._alarm = (slipped, first, second, range_m)
        return good

    def lose(self, row: int, sigma_m: float, sigma_rad: float) -> None:
        """Know less of a user: isotropic in place (m), and in heading (rad).

        What is lost altogether (:mod:`relpos.fusion.slips`) is sought when it is ranged next.
        """
        self.grow()
        at = PER_NODE * row
        self.x[:, at : at + 2] += (
            math.sqrt(0.5) * sigma_m * self.rng.standard_normal((self.count, 2))
        )
        kept = min(0.5 * sigma_rad**2, HEADING_CELL_RAD**2)
        turned = math.sqrt(sigma_rad**2 - kept) * self.rng.standard_normal(self.count)
        self.x[:, at + Of.HEADING] += turned
        for entry, variance in ((0, 0.5 * sigma_m**2), (1, 0.5 * sigma_m**2), (2, kept)):
            self.p[:, at + entry, at + entry] += variance
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
        """Let most hypotheses doubt a user that has slipped (:mod:`relpos.fusion.slips`).

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
        peer = PER_NODE * np.where(first[sight] == row, second[sight], first[sight])
        at = PER_NODE * row
        peers = np.stack([self.x[which, peer], self.x[which, peer + 1]], axis=1)
        made = doubts(self.x[which, at : at + 3], peers, range_m[sight], place_m, self.rng, lost)
        self.x[which, at : at + 3] = made.poses
        # What was lost has nothing to do any more with what else is known.
        for anew, part in ((~made.kept[:, 0], (0, 1)), (~made.kept[:, 1], (2,))):
            some = which[anew]
            for entry in part:
                self.p[some, at + entry, :] = 0.0
                self.p[some, :, at + entry] = 0.0
            for a in part:
                for b in part:
                    self.p[some, at + a, at + b] = made.covariances[anew, a, b]
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
        at = PER_NODE * row
        skip = np.arange(self.count) % 2 == 0
        self.x[skip, at] -= east_m[skip]
        self.x[skip, at + 1] -= north_m[skip]
        for entry in (Of.X, Of.Y):
            self.p[:, at + entry, at + entry] += ODD_M**2
        self.doubtful[:] = SLIP_UPDATES
        self.counters["motions_doubted"] += 1

    def _bias_places(self, first: Indices, second: Indices) -> Indices:
        """Where in the state the biases of ranges are; those of new pairs are added.

        A pair's bias is the common one plus its own part, so a new pair starts from what is known
        of the common one. Where there are too many pairs, only the common one is modelled.
        """
        common = PER_NODE * self.nodes
        places = np.full(len(first), common, dtype=np.int64)
        if not self.has_bias.any():
            return places
        for r, (a, b) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
            pair = (a, b) if a < b else (b, a)
            place = self.biases.get(pair)
            if place is None and self.nodes <= PAIR_BIASES:
                place = self._add_bias(pair)
            if place is not None:
                places[r] = place
        return places

    def _add_bias(self, pair: tuple[int, int]) -> int:
        count, size = self.count, int(self.x.shape[1])
        common = PER_NODE * self.nodes
        x = np.empty((count, size + 1))
        p = np.empty((count, size + 1, size + 1))
        x[:, :size], x[:, size] = self.x, self.x[:, common]
        p[:, :size, :size] = self.p
        p[:, size, :size] = self.p[:, common]
        p[:, :size, size] = self.p[:, :, common]
        p[:, size, size] = self.p[:, common, common] + self.has_bias * self.settings.pair_bias_m**2
        self.x, self.p = x, p
        self.biases[pair] = size
        return size

    @property
    def outlier_share(self) -> float:
        """What share of the ranges are outliers, as far as is known."""
        wrong, right = self.outlier_counts
        return float(min(max(wrong / (wrong + right), 0.005), 0.5))

    def heading(self, row: int, heading_rad: float, sigma_rad: float) -> None:
        """Work in an absolute heading of a user."""
        joint.update_heading(
            self.x, self.p, self.log_weight, row, heading_rad, sigma_rad**2,
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
        joint.hearing(
            self.x, self.p, self.log_weight, first, second, dz_m, heard, tried,
            detection.weight, detection.curve, STEP_M,
        )  # fmt: skip

    def predicted_ranges(
        self, first: Indices, second: Indices, dz_m: Floats
    ) -> tuple[Floats, Floats]:
        """Give means and standard deviations (K, U) of slant distances in every hypothesis."""
        return joint.predicted_ranges(self.x, self.p, first, second, dz_m)

    def settle(self) -> None:
        """Close an epoch: jumps, and resampling where the weights have become uneven."""
        self._resize()
        weight = self.weights()
        self.since_slip += 1
        closed = not self.slipped or self.since_slip > OPEN_UPDATES
        if self._alarm is not None:
            self.counters["slips"] += 1
            self._doubt(*self._alarm, self.settings.jump_m)
            self._alarm = None
        elif self.count > self.settings.hypotheses and closed:
            self.resample(weight, self.settings.hypotheses)
        elif 1.0 / float(weight @ weight) < 0.5 * self.count:
            self.resample(weight)
        self._jump()

    def weights(self) -> Floats:
        """Normalised weights (K,); the log weights are shifted so that their greatest is 0."""
        self.log_weight -= self.log_weight.max()
        weight: Floats = np.exp(self.log_weight)
        weight /= weight.sum()
        return weight

    def resample(self, weight: Floats, count: int | None = None) -> None:
        """Draw hypotheses anew by their weights; levels of noise are jittered (Liu, West)."""
        chosen = systematic(weight, self.count if count is None else count, self.rng)
        self.x, self.p = self.x[chosen], self.p[chosen]
        self._permute_parameters(chosen)
        # Children of one parent part in their levels, too (Liu, West).
        self.draw *= math.sqrt(1.0 - JITTER**2)
        self.draw += JITTER * self.rng.standard_normal(self.draw.shape)
        self._spread_levels()
        self.log_weight = np.zeros(self.count)
        self.counters["resampled"] += 1

    def _permute_parameters(self, chosen: Indices) -> None:
        self.draw, self.sens = self.draw[chosen], self.sens[chosen]
        self.has_constants, self.has_bias = self.has_constants[chosen], self.has_bias[chosen]
        self.doubtful = self.doubtful[chosen]
        self.wrong_start = self.wrong_start[chosen]
        self._spread_levels()

    def _spread_levels(self) -> None:
        """Give every hypothesis its draw of what is known of the levels."""
        s = self.settings
        sd = s.spread * np.sqrt(self.levels.covariance.diagonal())
        log = self.levels.mean + np.minimum(sd, noise.SPREAD_MOST) * self.draw
        every = np.exp(log)
        self.level = every[:, :-1].reshape(self.count, self.nodes, noise.LEVELS)
        self.level = np.ascontiguousarray(self.level)
        self.sigma2 = np.ascontiguousarray(every[:, -1])

    @property
    def _usual_surprise(self) -> float:
        # Where outliers are common, it takes more of them to doubt a user.
        return max(0.15, 2.2 * self.outlier_share)

    # -- how many (relpos.fusion.hypotheses) ---------------------------------------------------

    def _resize(self) -> None:
        """Shrink where the picture has been unambiguous for a while; grow where it is not."""
        if self.settings.hypotheses == 1 or not self.nodes:
            return
        mean, covariance = self._undoubted_moments()
        sigmas = np.exp(0.5 * self.levels.mean)
        metre = math.sqrt(noise.ALONG_M2_M) * sigmas[noise.ALONG : -1 : noise.LEVELS]
        bend = hypotheses.bend(mean, covariance, float(sigmas[-1]), metre)
        open_ = bool(
            self._alarm or self.slipped or self.unplaced
            or self.surprise.max(initial=0.0) > self._usual_surprise
        )  # fmt: skip
        if open_ or bend > hypotheses.BENT:
            self.unambiguous = 0
            self.grow()
        elif bend > hypotheses.FLAT or not self._is_even(covariance):
            self.unambiguous = 0
        else:
            self.unambiguous += 1
            fewer = [n for n in hypotheses.STEPS if n < self.count]
            if fewer and self.unambiguous >= hypotheses.HELD:
                self.unambiguous = 0
                self._shrink(fewer[0])

    def _is_even(self, covariance: Floats) -> bool:
        """Whether the hypotheses are one cloud: no few of them count, and none lie far apart."""
        if self.count == 1:
            return True
        weight = self.weights()
        if 1.0 / float(weight @ weight) < hypotheses.EVEN * self.count:
            return False
        if float(weight @ (self.doubtful > 0.0)) > hypotheses.DOUBTED:
            return False
        for has in (self.has_constants, self.has_bias):
            share = float(weight @ has)
            if min(share, 1.0 - share) > hypotheses.UNDECIDED:
                return False
        if float(self.levels.covariance[-1, -1]) > hypotheses.KNOWN**2:
            return False
        poses = PER_NODE * np.arange(self.nodes)[:, None] + np.arange(3)
        weight = weight * np.where(self.doubtful > 0.0, math.exp(-DOUBTERS), 1.0)
        weight /= weight.sum()
        within = weight @ self.p.diagonal(axis1=1, axis2=2)[:, poses.ravel()]
        between = covariance.diagonal()[poses.ravel()] - within
        drawn = self._sampled / (1.0 - self._sampled)
        return bool((between <= hypotheses.APART * drawn * within + 1e-6).all())

    def _undoubted_moments(self) -> tuple[Floats, Floats]:
        """As ``moments``, without those who doubt: they are no part of the picture."""
        log_weight = self.log_weight - np.where(self.doubtful > 0.0, DOUBTERS, 0.0)
        weight: Floats = np.exp(log_weight - log_weight.max())
        angles = PER_NODE * np.arange(self.nodes, dtype=np.int64) + Of.HEADING
        return joint.moments(self.x, self.p, weight / weight.sum(), angles)

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
        self.x, self.p = hypotheses.parted(self.x, self.p, angles, share, self.rng)
        self.counters["hypotheses_grown"] += 1

    def _shrink(self, count: int) -> None:
        """Go on with fewer hypotheses, the mixture's moments unchanged."""
        mean, covariance = self._undoubted_moments()
        self.log_weight -= np.where(self.doubtful > 0.0, DOUBTERS, 0.0)
        angles = PER_NODE * np.arange(self.nodes, dtype=np.int64) + Of.HEADING
        before, weight = self._sampled, self.weights()
        sens = np.tensordot(weight, self.sens, axes=1)
        chosen = systematic(weight, count, self.rng)
        x = self.x
        self.x = x[:count]
        after = self._sampled
        self.x, p = hypotheses.thinned(
            x, mean, covariance, chosen, angles, after / before if before else 0.0
        )
        self.p = np.repeat(p[None], count, axis=0)
        constants, bias = self.has_constants.any(), self.has_bias.any()
        self._permute_parameters(chosen)
        self.sens = np.repeat(sens[None], count, axis=0)
        self.doubtful = np.zeros(count)
        # The moments have something of the constants wherever any hypothesis has.
        self.has_constants = np.full(count, float(constants))
        self.has_bias = np.full(count, float(bias))
        if count == 1:
            self.draw = np.zeros_like(self.draw)
        self._spread_levels()
        self.log_weight = np.zeros(count)
        self.counters["hypotheses_shrunk"] += 1

    def _jump(self) -> None:
        """Let some hypotheses doubt a user's pose; the more, the worse its ranges fit."""
        s = self.settings
        if not self.nodes or self.count < 2:
            return
        doubt = np.clip((self.surprise - self._usual_surprise) / 0.35, 0.0, 1.0)
        rate = s.jumps / self.nodes + (s.jumps_most - s.jumps / self.nodes) * doubt
        total = float(rate.sum())
        which = np.flatnonzero(self.rng.random(self.count) < total)
        self.doubtful[which] = DOUBT_UPDATES
        for k in which:
            row = int(self.rng.choice(self.nodes, p=rate / total))
            at = PER_NODE * row
            offset = self.rng.standard_normal(3) * (s.jump_m, s.jump_m, s.jump_rad)
            self.x[k, at : at + 3] += math.sqrt(0.5) * offset
            for entry, sigma in ((0, s.jump_m), (1, s.jump_m), (2, s.jump_rad)):
                self.p[k, at + entry, at + entry] += 0.5 * sigma**2
        self.counters["jumps"] += len(which)

    # -- what is known -------------------------------------------------------------------------

    def moments(self) -> tuple[Floats, Floats]:
        """Give the mixture's mean (D,) and full covariance (D, D)."""
        angles = PER_NODE * np.arange(self.nodes, dtype=np.int64) + Of.HEADING
        return joint.moments(self.x, self.p, self.weights(), angles)

    def snapshot(self) -> Snapshot:
        """Copy everything."""
        return Snapshot(
            tuple(a.copy() for a in (
                self.x, self.p, self.log_weight, self.levels.mean, self.levels.covariance,
                self.draw, self.sens, self.has_constants, self.has_bias, self.surprise,
                self.since_turn_s,
                self.outlier_counts, self.doubtful, self.wrong_start, self.arm, self.watch.sums,
                self.watch.base,
            )),
            self.rng.bit_generator.state,
            (self.nodes, self.since_slip, self.unambiguous, *self.slipped),
            dict(self.biases),
            dict(self.counters),
            dict(self.unplaced),
        )  # fmt: skip

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to a snapshot of this core; it can be restored again."""
        (
            self.x, self.p, self.log_weight, self.levels.mean, self.levels.covariance,
            self.draw, self.sens, self.has_constants, self.has_bias, self.surprise,
            self.since_turn_s,
            self.outlier_counts, self.doubtful, self.wrong_start, self.arm, self.watch.sums,
            self.watch.base,
        ) = (a.copy() for a in snapshot.arrays)  # fmt: skip
        self.rng.bit_generator.state = dict(snapshot.random)
        self.nodes = self.levels.nodes = int(snapshot.numbers[0])
        self.slipped = {int(row) for row in snapshot.numbers[3:]}
        self.since_slip = int(snapshot.numbers[1])
        self.unambiguous = int(snapshot.numbers[2])
        self.biases = dict(snapshot.biases)
        self.counters = Counter(snapshot.counters)
        self.unplaced = dict(snapshot.unplaced)
        self._spread_levels()


PAIR_BIASES = 6
"""Up to so many users each pair has a bias of its own in the state: 15 of them double its size.
Of more, the common one is modelled."""

SET_OFF_M = 0.3
"""A node without a heading has set off when it is this far from where it stood."""

CROSS = 0.04
"""Variance across the way relative to along it: steps err in length, turns err apart from that."""

JITTER = 0.1
"""Standard deviation of the levels' jitter at resampling, in units of their spread."""

SILENT_S = 10.0
"""A node whose motion is missing for longer is tracked by its ranges alone."""

WANDER_M = 0.7
"""Random walk of a person who is not heard of, m per root second: there and back in a room."""

OPEN_UPDATES = 60
"""Many hypotheses are kept for so many instants of ranges at most: what has not told where
somebody is by then (few peers, standing) will not soon."""

MOST_LISTED = 200
"""Hypotheses that alternatives are made of after a slip."""

FOUND_M, FOUND_RAD = 1.0, 0.4
"""Who slipped is found when his place as seen from somebody, and his heading, are known so well."""

ODD_M = 0.3
"""How far a displacement may be off that was doubted, whether it is left out or not."""

SLIP_UPDATES = 10.0
"""As ``DOUBT_UPDATES``, of all hypotheses after a slip."""

DOUBT_UPDATES = 5.0
"""For so many instants of ranges a hypothesis that has jumped teaches nothing about noise."""

LEAST_TURN_RAD, TURN_STANDS_OUT = 0.05, 3.5
"""A change of heading is a turn beyond both: so much, and so many deviations of white noise."""
MISJUDGED, MISJUDGED_RAD = 0.1, 1.0
"""Share of hypotheses that misjudge a turn, and by how much. In P1 one right angle in some hundred
is reported as less than 20 degrees, and cost 0.5 m for a minute: seeds 1000 to 1009 0.206 m
without, 0.214 with a share of 0.05, 0.195 with 0.1 (worst 0.27, 0.38, 0.24); seeds 500 to 515,
where it does not happen, 0.192 and 0.195."""

STRAIGHT_S = 10.0
"""After going straight for so long. Without it, robots that turn every second (exp3, exp4 of
`two_robots_vio`) lost 0.08 and 0.10 m of 0.15."""

DOUBTERS = 20.0
"""Log likelihood that is taken from those who doubt where they do not count."""

HEADING_OUTLIERS = 0.1
HEADING_OUTLIER_RAD = 1.0
HEADING_SIGMA_RAD = 0.17
"""Of an absolute heading that brings no sigma: magnetic ones indoors are 10 degrees off."""


def _check_rows(nodes: int, first: Indices, second: Indices, *values: Floats) -> None:
    """Raise ``IndexError`` or ``ValueError``: kernels look at no bounds."""
    for rows in (first, second):
        if rows.size and (min(rows.tolist()) < 0 or max(rows.tolist()) >= nodes):
            raise IndexError(f"rows {rows.tolist()} of a bank of {nodes} users")
    for array in (second, *values):
        if array.shape != first.shape:
            raise ValueError(f"array of shape {array.shape} for {len(first)} rows")


def systematic(weight: Floats, count: int, rng: np.random.Generator) -> Indices:
    """Draw ``count`` indices by ``weight`` (K,) with the least variance; sorted."""
    edges = np.cumsum(weight)
    comb = (np.arange(count) + rng.random()) / max(count, 1) * edges[-1]
    index = np.searchsorted(edges, comb, side="right")
    chosen: Indices = np.minimum(index, len(weight) - 1).astype(np.int64)
    return chosen


@dataclass(slots=True)
class _Known(Presence):
    """What is kept of a node beside its hypotheses."""

    worn_m: float = 0.0
    """Height of the tag over the floor at the start."""
    drifted_s: float = -math.inf
    """Until then it was tracked by ranges alone."""


@dataclass(frozen=True, slots=True)
class _State:
    """What :class:`Bank` is at one time, to go back to."""

    core: Snapshot
    detection: Detection
    repetition: Repetition
    habit: Habit
    stillness: Stillness
    row: dict[int, int]
    known: dict[int, _Known]
    pending: list[Advance]
    own: Counter[str]
    moved: bool
    ranges_used: int
    epoch_s: float
    starts: Starts
    standing: dict[int, complex]
    facing: dict[int, complex]


@dataclass(slots=True)
class Bank:
    """The bank as an :class:`~relpos.fusion.estimator.Estimator`.

    Whose start is unknown is sought by :mod:`relpos.fusion.starts` until it is found, and joins
    the core then.
    """

    priors: Sequence[Prior] = ()
    settings: BankSettings = field(default_factory=BankSettings)
    seed: int = 0
    mounting: Mapping[int, Mounting] = field(default_factory=dict)
    core: BankCore = field(init=False)
    detection: Detection = field(default_factory=Detection)
    repetition: Repetition = field(default_factory=Repetition)
    habit: Habit = field(default_factory=Habit)
    stillness: Stillness = field(default_factory=Stillness)
    _feed: Rewinder = field(init=False)
    starts: Starts = field(init=False)
    _row: dict[int, int] = field(default_factory=dict)
    _known: dict[int, _Known] = field(default_factory=dict)
    _standing: dict[int, complex] = field(default_factory=dict)
    """Located nodes without a heading: how far they have gone since, in their own first frame."""
    _facing: dict[int, complex] = field(default_factory=dict)
    _pending: list[Advance] = field(default_factory=list)
    _own: Counter[str] = field(default_factory=Counter)
    _moved: bool = False
    _ranges_used: int = 0
    _epoch_s: float = -math.inf

    def __post_init__(self) -> None:
        s = self.settings
        self.core = BankCore(s, self.seed)
        self.starts = Starts(seed=self.seed)
        timeline = Timeline(
            [p.node for p in self.priors], reorder_s=s.reorder_s, max_lag_s=s.max_lag_s
        )
        self._feed = Rewinder(self, timeline, s.late_s)
        for p in sorted(self.priors, key=lambda p: p.node):
            if p.node in self._known:
                raise RelposError(f"node {p.node} has two initial poses")
            self._meet(p.node)
            if math.isfinite(p.sigma_m) and math.isfinite(p.sigma_rad):
                self._row[p.node] = self.core.add_node(
                    p.x_m, p.y_m, p.heading_rad, p.sigma_m, p.sigma_rad, self._arm(p.node)
                )
            else:
                self.starts.meet(
                    p.node, (p.x_m, p.y_m, p.heading_rad), (p.sigma_m, p.sigma_m, p.sigma_rad)
                )

    # -- the estimator's interface -------------------------------------------------------------

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; return the estimates it completes."""
        return self._feed.process(measurement)

    def finish(self) -> list[Estimate]:
        """Work off what waits; RelposError where the run cannot give relative positions."""
        estimates = self._feed.finish()
        refuse_unmoved(self._moved)
        refuse_unranged(self._ranges_used, self._feed.counters())
        return estimates

    def counters(self) -> Mapping[str, int]:
        """Count everything dropped, late, reset or resampled."""
        own = self._own + self.core.counters + self.starts.counters
        return dict(self._feed.counters() + own)

    # -- steps ---------------------------------------------------------------------------------

    def take(self, step: Step) -> Estimate | None:
        """Work off one step of the timeline (:class:`~relpos.fusion.rewind.Core`)."""
        match step:
            case Advance():
                self._moved = True
                known = self._meet(step.node)
                known.heard(step.time_s)
                self.repetition.move(step.node, step.dx_m, step.dy_m, step.dtheta_rad)
                if step.node in self._row:
                    self._pending.append(step)
                    if step.node in self._standing:
                        self._set_off(step)
                else:
                    self._seek(step.node)
                    way_m = math.hypot(step.dx_m, step.dy_m)
                    odd = self.habit.is_odd(step.node, way_m, step.duration_s, step.fraction)
                    self._own["motions_doubted"] += odd
                    self.starts.advance(step, odd=odd)
            case Ranging():
                self._advance()
                self._range(step)
            case Sensed():
                self._meet(step.measurement.node)
                self._sense(step)
            case Epoch():
                self._advance()
                self._admit(self.starts.epoch(step.time_s))
                return self._estimate(step.time_s)
        return None

    def snapshot(self) -> _State:
        """Copy everything that ``take`` changes."""
        return _State(
            self.core.snapshot(), self.detection.snapshot(), self.repetition.snapshot(),
            self.habit.snapshot(), self.stillness.snapshot(), self._row.copy(),
            {node: copy(known) for node, known in self._known.items()}, self._pending[:],
            self._own.copy(), self._moved, self._ranges_used, self._epoch_s,
            self.starts.snapshot(), self._standing.copy(), self._facing.copy(),
        )  # fmt: skip

    def restore(self, snapshot: _State) -> None:
        """Be as at the time of the snapshot."""
        self.core.restore(snapshot.core)
        self.detection = snapshot.detection.snapshot()
        self.repetition = snapshot.repetition.snapshot()
        self.habit = snapshot.habit.snapshot()
        self.stillness = snapshot.stillness.snapshot()
        self._row = snapshot.row.copy()
        self._known = {node: copy(known) for node, known in snapshot.known.items()}
        self._pending, self._own = snapshot.pending[:], snapshot.own.copy()
        self._moved, self._ranges_used = snapshot.moved, snapshot.ranges_used
        self._epoch_s = snapshot.epoch_s
        self.starts = snapshot.starts.snapshot()
        self._standing, self._facing = snapshot.standing.copy(), snapshot.facing.copy()

    def _meet(self, node: int) -> _Known:
        known = self._known.get(node)
        if known is None:
            known = self._known[node] = _Known()
            worn = self.mounting.get(node)
            if worn is not None and worn.height_m is not None:
                known.worn_m = known.height_m = worn.height_m
        return known

    def _arm(self, node: int) -> tuple[float, float]:
        worn = self.mounting.get(node)
        return (0.0, 0.0) if worn is None else worn.antenna_offset_m or (0.0, 0.0)

    def _advance(self) -> None:
        """Work off the displacements since the last time."""
        steps = self._pending
        if not steps:
            return
        self._pending = []
        rows = np.array([self._row[a.node] for a in steps], dtype=np.int64)
        moves = np.array([(a.dx_m, a.dy_m, a.dtheta_rad, a.duration_s) for a in steps])
        told = None
        if any(a.sigma_x_m is not None or a.sigma_theta_rad is not None for a in steps):
            told = np.array([told_sigmas(a) for a in steps])
        begin = 0
        for k, a in enumerate(steps):
            drifted_s = self._known[a.node].drifted_s
            if drifted_s > a.time_s - a.duration_s:
                # Ranges have moved it so far already; how it turned they cannot say.
                moves[k, :2] *= max(a.time_s - drifted_s, 0.0) / max(a.duration_s, 1e-9)
            vague = _vagueness(a)
            if vague is not None:
                assert told is not None
                told[k] = math.nan
                self.core.lose(int(rows[k]), *vague)
            if self.stillness.is_still(
                a.node, a.dx_m, a.dy_m, a.dtheta_rad, a.duration_s, a.fraction
            ):
                self._own["motions_still"] += a.dx_m != 0.0 or a.dtheta_rad != 0.0
                moves[k, :3] = 0.0
                continue
            if self.habit.is_odd(a.node, math.hypot(a.dx_m, a.dy_m), a.duration_s, a.fraction):
                self._make(rows, moves, told, slice(begin, k))
                self.core.grow()
                at = PER_NODE * int(rows[k])
                east, north = self.core.x[:, at].copy(), self.core.x[:, at + 1].copy()
                self._make(rows, moves, told, slice(k, k + 1))
                self.core.doubt_motion(
                    int(rows[k]), self.core.x[:, at] - east, self.core.x[:, at + 1] - north
                )
                begin = k + 1
        self._make(rows, moves, told, slice(begin, len(steps)))

    def _make(self, rows: Indices, moves: Floats, told: Floats | None, some: slice) -> None:
        """Make some of the displacements ``rows`` (M,), ``moves`` (M, 4)."""
        dx, dy, dtheta, duration = moves[some].T
        self.core.advance(
            rows[some], dx, dy, dtheta, duration, None if told is None else told[some]
        )

    def _range(self, step: Ranging) -> None:
        for r in step.ranges:
            for node in (r.node, r.peer):
                known = self._meet(node)
                known.heard(step.time_s)
                if node not in self._row:
                    self._seek(node)
        if self.starts:
            heights = {n: k.height_m for n, k in self._known.items()}
            self.starts.ranging(step.time_s, step.ranges, self._places(), heights)
            # A search may be long; finding nobody in it is no fault of the data.
            self._ranges_used += len(step.ranges)
        ranges = [r for r in step.ranges if r.node in self._row and r.peer in self._row]
        ranges = self._heard_moving(step.time_s, ranges)
        if self.core.unplaced and ranges:
            first, second, _ = self._pairs([(r.node, r.peer) for r in ranges])
            self.core.sight(first, second, np.array([r.range_m for r in ranges]))
        rounds = self._hear(step)
        if ranges:
            pairs = [(r.node, r.peer) for r in ranges]
            variance = np.array(
                [
                    self._known[a].sigma_height_m ** 2 + self._known[b].sigma_height_m ** 2
                    for a, b in pairs
                ]
            )
            first, second, dz = self._pairs(pairs)
            measured = np.array([r.range_m for r in ranges])
            worth = self.repetition.worth(pairs)
            self.core.update(first, second, measured, dz, variance, worth)
            self._ranges_used += len(ranges)
        for done, tried in rounds:
            heard = np.arange(len(done.heard) + len(done.silent)) < len(done.heard)
            surely = np.concatenate([np.ones(len(done.heard)), tried])
            self.core.hearing(*self._pairs(done.heard + done.silent), heard, surely, self.detection)
        self.core.settle()

    def _heard_moving(self, time_s: float, ranges: list[Range]) -> list[Range]:
        """Leave out ranges of nodes whose motion is missing; let those drift who miss it long.

        A node without motion may be anywhere that it can have walked to. For a while its motion
        may still come (then the ranges are worked in after all, in their place); after
        ``SILENT_S`` it is tracked by ranges alone, as somebody who wanders.
        """
        silent = set()
        for node in {n for r in ranges for n in (r.node, r.peer)}:
            reported_s = self._feed.timeline.reported_s(node)
            if -math.inf < reported_s < time_s:
                silent.add(node)
        if not silent:
            return ranges
        for node in sorted(silent):
            known = self._known[node]
            reported_s = self._feed.timeline.reported_s(node)
            if time_s - reported_s > SILENT_S:
                since_s = max(known.drifted_s, reported_s)
                self.core.lose(self._row[node], WANDER_M * math.sqrt(time_s - since_s), 0.0)
                known.drifted_s = time_s
                self._own["drifts"] += 1
                silent.discard(node)
        kept = [r for r in ranges if r.node not in silent and r.peer not in silent]
        self._own["ranges_of_silent"] += len(ranges) - len(kept)
        return kept

    def _seek(self, node: int) -> None:
        if node not in self.starts:
            self.starts.meet(node)

    def _places(self) -> dict[int, tuple[float, float, float]]:
        """Everybody in the core: x, y (m), and the variance (m^2) relative to his nearest.

        What the team's places have in common is no error of a place found relative to them.
        """
        if not self._row:
            return {}
        mean, covariance = self.core.moments()
        at = PER_NODE * np.array(list(self._row.values()))
        own = 0.5 * (covariance[at, at] + covariance[at + 1, at + 1])
        cross = 0.5 * (covariance[np.ix_(at, at)] + covariance[np.ix_(at + 1, at + 1)])
        apart = own[:, None] + own[None, :] - 2.0 * cross
        np.fill_diagonal(apart, np.inf)
        variance = 0.5 * np.maximum(apart.min(axis=1), 0.0) if len(at) > 1 else np.zeros(1)
        return {
            node: (float(mean[i]), float(mean[i + 1]), float(v))
            for node, i, v in zip(self._row, at, variance, strict=True)
        }

    def _admit(self, found: Found | None) -> None:
        """Let those whose start has been found join the core."""
        if found is None:
            return
        mixture = found.mixture
        beside = self._nearest(mixture) if self._row else None
        rows = [self.core.add_node(0.0, 0.0, 0.0, 1.0, 1.0) for _ in mixture.nodes]
        self._row.update(zip(mixture.nodes, rows, strict=True))
        self.core.place(
            np.array(rows, dtype=np.int64), mixture.poses, mixture.covariances,
            np.log(np.maximum(mixture.weights, 1e-300)), beside,
        )  # fmt: skip
        for n, (node, row) in enumerate(zip(mixture.nodes, rows, strict=True)):
            self.core.set_scale(row, float(mixture.scales[n]))
            if mixture.heading_sigma_rad(n) > SETTLED_HEADING_RAD:
                self._standing[node] = complex(0.0)

    def _nearest(self, mixture: Mixture) -> int:
        """Row of the user of the core who is nearest to those who have been found."""
        mean, _ = self.core.moments()
        middle = mixture.poses[0, :, :2].mean(axis=0)
        rows = list(self._row.values())
        off = [np.hypot(*(mean[PER_NODE * r : PER_NODE * r + 2] - middle)) for r in rows]
        return rows[int(np.argmin(off))]

    def _set_off(self, step: Advance) -> None:
        """Watch a node that stands without a heading: where it goes, its ranges will tell."""
        gone = self._standing[step.node]
        gone += complex(step.dx_m, step.dy_m) * self._facing.get(step.node, 1.0)
        self._standing[step.node] = gone
        self._facing[step.node] = self._facing.get(step.node, 1.0) * complex(
            math.cos(step.dtheta_rad), math.sin(step.dtheta_rad)
        )
        if abs(gone) < SET_OFF_M:
            return
        self._advance()
        del self._standing[step.node], self._facing[step.node]
        self.core.split_heading(self._row[step.node], abs(gone))
        self._own["headings_sought"] += 1

    def _pairs(self, pairs: Sequence[tuple[int, int]]) -> tuple[Indices, Indices, Floats]:
        first = np.array([self._row[a] for a, _ in pairs], dtype=np.int64)
        second = np.array([self._row[b] for _, b in pairs], dtype=np.int64)
        dz = np.array([self._known[b].height_m - self._known[a].height_m for a, b in pairs])
        return first, second, dz

    def _hear(self, step: Ranging) -> list[tuple[Round, Floats]]:
        """Learn who is heard how far; give the rounds, and how surely the silent were tried."""
        rounds: list[tuple[Round, Floats]] = []
        ranges = [r for r in step.ranges if r.node in self._row and r.peer in self._row]
        for done in self.detection.rounds.take(step.time_s, ranges, self._feed.timeline.reported_s):
            pairs = done.heard + done.silent
            mean, sigma = self.core.predicted_ranges(*self._pairs(pairs))
            weight = self.core.weights()
            middle = weight @ mean
            spread = np.sqrt(weight @ (sigma**2 + (mean - middle) ** 2))
            heard = len(done.heard)
            tried = self.detection.learn(
                done, middle[:heard], spread[:heard], middle[heard:], spread[heard:]
            )
            rounds.append((done, tried))
        return rounds

    def _sense(self, step: Sensed) -> None:
        measured = step.measurement
        if isinstance(measured, Height):
            known = self._known[measured.node]
            known.height_m = known.worn_m + measured.height_m
            known.sigma_height_m = measured.sigma_m or 0.0
        elif isinstance(measured, Heading) and measured.node in self._row:
            self._advance()
            sigma = measured.sigma_rad or HEADING_SIGMA_RAD
            self.core.heading(self._row[measured.node], measured.heading_rad, sigma)
        else:
            self._own["headings_unused"] += 1

    # -- estimates -----------------------------------------------------------------------------

    def _estimate(self, time_s: float) -> Estimate:
        for known in self._known.values():
            known.close_epoch(self._epoch_s)
        self._epoch_s = time_s
        mean, covariance = self.core.moments()
        if self.core.slipped:
            self.core.find_slipped(covariance)
        mixture = self.starts.mixture
        means, variances = mean.tolist(), covariance.diagonal().tolist()
        nodes, parameters = [], []
        for node in sorted(self._known):
            known = self._known[node]
            row = self._row.get(node)
            if row is None:
                nodes.append(self._sought(node, known, mixture))
                continue
            at = PER_NODE * row
            pose = means[at : at + PER_NODE]
            if row in self.core.slipped:
                own = covariance[at : at + PER_NODE, at : at + PER_NODE]
                self._tell_mode(row, pose, own)
                variances[at : at + PER_NODE] = own.diagonal().tolist()
            nodes.append(
                NodeEstimate(
                    node, pose[0], pose[1], math.remainder(pose[2], _TWO_PI),
                    variances[at], variances[at + 1], float(covariance[at, at + 1]),
                    min(math.sqrt(variances[at + 2]), ANY_ANGLE_RAD),
                    self._status(known, row),
                    known.height_m, known.sigma_height_m,
                )
            )  # fmt: skip
            drift = math.sqrt(max(variances[at + _DRIFT], 0.0))
            scale = math.sqrt(max(variances[at + _SCALE], 0.0))
            grow = math.exp(pose[_SCALE])
            parameters += [
                Parameter(time_s, node, None, "step_scale", grow, grow * scale),
                Parameter(time_s, node, None, "heading_drift_rad_s", pose[_DRIFT], drift),
            ]
        parameters += self._bias_parameters(time_s, means, variances)
        if self.detection.known:
            # One curve for the team; every node has it.
            parameters += [
                Parameter(
                    time_s, node, None, "detection_range_m",
                    self.detection.range_m, self.detection.range_sigma_m,
                )
                for node in sorted(self._row)
            ]  # fmt: skip
        pairs = self._pair_estimates(mean, covariance)
        alternatives: tuple[Alternative, ...] = ()
        if mixture is not None:
            pairs += self._sought_pairs(mixture, mean, covariance)
            alternatives = self._alternatives(time_s, mixture, mean, covariance)
        elif self.core.slipped:
            alternatives = self._slip_alternatives(time_s)
        return Estimate(time_s, tuple(nodes), pairs, alternatives, tuple(parameters))

    def _tell_mode(self, row: int, pose: list[float], own: Floats) -> None:
        """Put the most likely place for the mean of a slipped user's places, in place."""
        at = PER_NODE * row
        belief = believe(
            self.core.weights(), self.core.x[:, at : at + 3],
            self.core.p[:, at : at + 3, at : at + 3],
        )  # fmt: skip
        pose[:3] = belief.x_m, belief.y_m, belief.heading_rad
        own[:2, :2] = belief.covariance_m2
        own[2, 2] = belief.sigma_heading_rad**2

    def _slip_alternatives(self, time_s: float) -> tuple[Alternative, ...]:
        """List the possible pictures of the team after a slip: those of the likeliest."""
        weight = self.core.weights()
        likely = np.argsort(-weight, kind="stable")[:MOST_LISTED]
        nodes = sorted(self._row)
        at = PER_NODE * np.array([self._row[n] for n in nodes])
        places = at[:, None] + np.arange(2)
        return pictures(
            time_s, nodes, weight[likely] / weight[likely].sum(),
            self.core.x[likely][:, at[:, None] + np.arange(3)],
            self.core.p[likely][:, places[:, :, None], places[:, None, :]],
        )  # fmt: skip

    def _status(self, known: _Known, row: int) -> NodeStatus:
        status = known.status
        if status is NodeStatus.OK and row in self.core.slipped:
            return NodeStatus.AMBIGUOUS
        return status

    def _sought(self, node: int, known: _Known, mixture: Mixture | None) -> NodeEstimate:
        """Say of a node whose start is unknown what the search says."""
        if mixture is None or node not in mixture.nodes:
            return NodeEstimate(
                node, 0.0, 0.0, 0.0, math.inf, math.inf, 0.0, ANY_ANGLE_RAD,
                NodeStatus.UNLOCATED, known.height_m, known.sigma_height_m,
            )  # fmt: skip
        n = mixture.nodes.index(node)
        own = slice(3 * n, 3 * n + 3)
        belief = believe(
            mixture.weights, mixture.poses[:, n], mixture.covariances[:, own, own], mixture.best
        )
        status = known.status
        if status is NodeStatus.OK and node not in self.starts.settled:
            status = NodeStatus.AMBIGUOUS
        spread = belief.covariance_m2
        return NodeEstimate(
            node, belief.x_m, belief.y_m, belief.heading_rad, float(spread[0, 0]),
            float(spread[1, 1]), float(spread[0, 1]), belief.sigma_heading_rad, status,
            known.height_m, known.sigma_height_m,
        )  # fmt: skip

    def _sought_pairs(
        self, mixture: Mixture, mean: Floats, covariance: Floats
    ) -> tuple[PairEstimate, ...]:
        """Pairs with at least one node whose start is unknown: moments over all pictures."""
        places = {n: mixture.poses[:, i, :2] for i, n in enumerate(mixture.nodes)}
        columns = {n: slice(3 * i, 3 * i + 2) for i, n in enumerate(mixture.nodes)}
        pairs = []
        everybody = sorted([*self._row, *mixture.nodes])
        for k, a in enumerate(everybody):
            for b in everybody[k + 1 :]:
                if a in self._row and b in self._row:
                    continue
                total: Floats = np.zeros((len(mixture.weights), 2, 2))
                ends = []
                for node in (a, b):
                    if node in self._row:
                        at = PER_NODE * self._row[node]
                        ends.append(mean[None, at : at + 2])
                        total = total + covariance[at : at + 2, at : at + 2]
                    else:
                        own = columns[node]
                        ends.append(places[node])
                        total = total + mixture.covariances[:, own, own]
                if a in columns and b in columns:
                    cross = mixture.covariances[:, columns[a], columns[b]]
                    total = total - cross - cross.transpose(0, 2, 1)
                pairs.append(_pair_of_pictures(a, b, mixture.weights, ends[1] - ends[0], total))
        return tuple(pairs)

    def _alternatives(
        self, time_s: float, mixture: Mixture, mean: Floats, covariance: Floats
    ) -> tuple[Alternative, ...]:
        """List the possible pictures of the whole team while somebody's start is unknown."""
        if set(mixture.nodes) <= self.starts.settled:
            return ()
        count, sought = len(mixture.weights), len(mixture.nodes)
        located = sorted(self._row)
        nodes = [*mixture.nodes, *located]
        poses = np.zeros((count, len(nodes), 3))
        spread = np.zeros((count, len(nodes), 2, 2))
        poses[:, :sought] = mixture.poses
        for i in range(sought):
            spread[:, i] = mixture.covariances[:, 3 * i : 3 * i + 2, 3 * i : 3 * i + 2]
        for i, node in enumerate(located):
            at = PER_NODE * self._row[node]
            poses[:, sought + i] = mean[at : at + 3]
            spread[:, sought + i] = covariance[at : at + 2, at : at + 2]
        return pictures(time_s, nodes, mixture.weights, poses, spread)

    def _bias_parameters(
        self, time_s: float, means: list[float], variances: list[float]
    ) -> Iterator[Parameter]:
        named = {row: node for node, row in self._row.items()}
        for (a, b), place in sorted(self.core.biases.items()):
            node, peer = named[a], named[b]
            if node > peer:
                node, peer = peer, node
            sigma = math.sqrt(max(variances[place], 0.0))
            yield Parameter(time_s, node, peer, "range_bias_m", means[place], sigma)

    def _pair_estimates(self, mean: Floats, covariance: Floats) -> tuple[PairEstimate, ...]:
        located = sorted(self._row)
        rows = np.array([self._row[node] for node in located], dtype=np.int64)
        lower, upper = _every_two(len(rows))
        i, j = PER_NODE * rows[lower], PER_NODE * rows[upper]
        off_x, off_y = mean[j] - mean[i], mean[j + 1] - mean[i + 1]
        own = covariance.diagonal()
        xx = own[i] + own[j] - 2.0 * covariance[i, j]
        yy = own[i + 1] + own[j + 1] - 2.0 * covariance[i + 1, j + 1]
        across_axes = covariance[:, 1:].diagonal()
        xy = across_axes[i] + across_axes[j] - covariance[i, j + 1] - covariance[i + 1, j]
        distance = np.hypot(off_x, off_y)
        apart = distance > 0.0
        squared = np.where(apart, distance * distance, 1.0)
        along = np.where(
            apart,
            (off_x * off_x * xx + 2.0 * off_x * off_y * xy + off_y * off_y * yy) / squared,
            0.5 * (xx + yy),
        )
        sideways = np.sqrt(np.maximum(xx + yy - along, 0.0) / squared)
        bearing = np.where(apart, np.minimum(sideways, ANY_ANGLE_RAD), ANY_ANGLE_RAD)
        pairs = list(
            map(
                PairEstimate,
                [located[n] for n in lower.tolist()],
                [located[n] for n in upper.tolist()],
                distance.tolist(),
                np.sqrt(np.maximum(along, 0.0)).tolist(),
                np.arctan2(off_y, off_x).tolist(),
                bearing.tolist(),
            )
        )
        if self.core.slipped:
            # Of these the mean of the places says nothing.
            for n, (a, b) in enumerate(
                zip(rows[lower].tolist(), rows[upper].tolist(), strict=True)
            ):
                if a in self.core.slipped or b in self.core.slipped:
                    pairs[n] = self._pair_of_hypotheses(
                        pairs[n].node, pairs[n].peer, PER_NODE * a, PER_NODE * b
                    )
        return tuple(pairs)

    def _pair_of_hypotheses(self, node: int, peer: int, i: int, j: int) -> PairEstimate:
        """Distance and bearing of a pair where the mean of the places says nothing."""
        x, p = self.core.x, self.core.p
        spread = (
            p[:, i : i + 2, i : i + 2] + p[:, j : j + 2, j : j + 2]
            - p[:, i : i + 2, j : j + 2] - p[:, j : j + 2, i : i + 2]
        )  # fmt: skip
        return _pair_of_pictures(
            node, peer, self.core.weights(), x[:, j : j + 2] - x[:, i : i + 2], spread
        )


@lru_cache(maxsize=32)
def _every_two(count: int) -> tuple[Indices, Indices]:
    """Indices (P,), (P,) of every two of so many, the lower first."""
    lower, upper = np.triu_indices(count, 1)
    return lower.astype(np.int64), upper.astype(np.int64)


def _pair_of_pictures(
    node: int, peer: int, weights: Floats, off: Floats, spread: Floats
) -> PairEstimate:
    """Distance and bearing of a pair whose difference is a mixture: (K, 2), (K, 2, 2)."""
    distance = np.hypot(off[:, 0], off[:, 1])
    unit = off / np.maximum(distance, 1e-9)[:, None]
    along = np.einsum("ka,kab,kb->k", unit, spread, unit)
    across = np.trace(spread, axis1=1, axis2=2) - along
    # To second order, as the joint filter's range: E d^2 = |off|^2 + across.
    distance = np.sqrt(distance**2 + across)
    middle = float(weights @ distance)
    variance = float(weights @ (along + (distance - middle) ** 2))
    together = complex((weights * (unit[:, 0] + 1j * unit[:, 1])).sum())
    length = min(max(abs(together), 1e-3), 1.0)
    bearing_sd = math.sqrt(
        -2.0 * math.log(length) + float(weights @ across) / max(middle, 1e-3) ** 2
    )
    return PairEstimate(
        node, peer, middle, math.sqrt(max(variance, 0.0)), float(np.angle(together)),
        min(bearing_sd, ANY_ANGLE_RAD),
    )  # fmt: skip


def _vagueness(step: Advance) -> tuple[float, float] | None:
    """Standard deviations (m, rad) of a piece whose report says to know next to nothing."""
    sigma_m, _, sigma_rad = (0.0 if math.isnan(s) else s for s in told_sigmas(step))
    sigma_m = min(sigma_m, step.sigma_y_m or 0.0)
    whole = math.sqrt(max(step.fraction, 1e-9))
    if sigma_m / whole > VAGUE_M or sigma_rad / whole > LOST_RAD:
        return sigma_m, sigma_rad
    return None
