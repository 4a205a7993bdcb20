"""The filter without node ids or wall time: arrays of one epoch in, a mixture out."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank import (
    detection_update,
    heading_update,
    lanes,
    mixture,
    motion_update,
    range_update,
    sensors,
)
from relpos.fusion.bank.adaptive_count import AdaptiveCount
from relpos.fusion.bank.detection_update import Attempts
from relpos.fusion.bank.hypothesis_set import HypothesisSet
from relpos.fusion.bank.mixture import PERTURBED_UPDATES
from relpos.fusion.bank.motion_update import Noise
from relpos.fusion.bank.range_update import RangeModel, Ranges
from relpos.fusion.bank.relocalisation import OPEN_UPDATES, Relocalisation
from relpos.fusion.bank.sensors import Sensors
from relpos.fusion.bank.storage import StateIndex, every_pair
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.models.detection import Detection
from relpos.fusion.models.odometry_faults import JUMP_M, CusumDetector
from relpos.fusion.models.ranging import Repeats, slant_height

OUTLIER_RANGES = 2.0
"""The prior share of outliers counts as so many ranges. Where a third of the ranges are reflected,
that has to be learned before they have moved a user (``lab``, seeds 300 to 323: 1.07 m with 5 %
counting as four, 0.95 m with 10 % as two)."""


class BankCore:
    """Joint filters over N users (rows in the order of ``add_node``), for K hypotheses.

    The order of work in one epoch: ``move`` (once or more), ``update`` (all ranges of one
    instant), ``update_heading`` and ``update_detection`` where there is anything, then
    ``end_instant`` (resampling and perturbing), and at its end ``moments``.
    """

    def __init__(self, settings: BankSettings, seed: int = 0) -> None:
        """Begin with no users and ``settings.hypotheses`` equal hypotheses."""
        self.settings = settings
        self.rng = np.random.default_rng(seed)
        self.counters: Counter[str] = Counter()
        self.hypotheses = HypothesisSet(settings, self.rng, self.counters)
        self.adaptive = AdaptiveCount(self.hypotheses, self.counters)
        self.relocalisation = Relocalisation(self.hypotheses, self.adaptive, self.counters)
        self._lever_m: Floats = np.zeros((0, 2))
        """Each user's antenna, forward and left of its pose."""
        self._since_turn_s: Floats = np.zeros(0)
        """How long each user has gone straight ahead."""
        self._alarm: tuple[int, tuple[Indices, Indices, Floats]] | None = None
        prior, expected = settings.outlier_m**2, settings.outliers * OUTLIER_RANGES
        outlier = np.array([0.0, prior, 0.0, prior])
        counts = np.array([expected, OUTLIER_RANGES - expected, expected * prior])
        components = self.hypotheses.components
        self._sensors = Sensors(
            components.mean, components.covariance, RangeModel(outlier, self._lever_m), counts,
            np.zeros(0), CusumDetector(np.zeros(0), np.ones(1)),
        )  # fmt: skip

    def add_node(
        self,
        pose: tuple[float, float, float],
        sigma_m: float,
        sigma_rad: float,
        lever_m: tuple[float, float] = (0.0, 0.0),
    ) -> int:
        """Add a user with a Gaussian prior, independent of the others; return its row."""
        self._lever_m = np.concatenate([self._lever_m, np.array([lever_m])])
        self._since_turn_s = np.append(self._since_turn_s, 0.0)
        row = self.hypotheses.add_node(pose, sigma_m, sigma_rad)
        components, known = self.hypotheses.components, self._sensors
        cusum = known.cusum._replace(sums=np.append(known.cusum.sums, 0.0))
        # Where all antennas are on their wearers' axes kernels take the shorter way.
        levers_m = self._lever_m if self._lever_m.any() else self._lever_m[:0]
        self._sensors = known._replace(
            mean=components.mean, covariance=components.covariance,
            model=known.model._replace(lever_m=levers_m),
            surprise=np.append(known.surprise, 0.0), cusum=cusum,
        )  # fmt: skip
        return row

    @property
    def range_variance_m2(self) -> float:
        """The variance of a range, as learned."""
        return math.exp(float(self.hypotheses.components.mean[-1]))

    def _check(self, first: Indices, second: Indices, *values: Floats) -> None:
        """Raise ``IndexError`` or ``ValueError``: kernels check no bounds."""
        for array in (second, *values):
            if array.shape != first.shape:
                raise ValueError(f"array of shape {array.shape} for {len(first)} rows")
        rows, nodes = [*first.tolist(), *second.tolist()], self.hypotheses.nodes
        if rows and not 0 <= min(rows) <= max(rows) < nodes:
            raise IndexError(f"rows {rows} of {nodes} users")

    # -- one epoch -----------------------------------------------------------------------------

    def move(self, rows: Indices, moves: Floats, reported: Floats) -> None:
        """Move users ``rows`` (M,) in this order; a user may occur several times.

        ``moves`` (M, 4) are dx, dy (m), dtheta (rad), duration (s); ``reported`` (M, 3) the
        reported standard deviations (forward and left m, turn rad), NaN where there are none.
        """
        several, these = len(rows), self.hypotheses
        if not several:
            return
        self._check(rows, rows)
        if moves.shape != (several, 4) or reported.shape != (several, 3):
            raise ValueError(f"displacements of shape {moves.shape} for {several} rows")
        motion, misjudged = motion_update.prepare_motion(
            rows, moves, reported, these.arrays.component, these.count, self._since_turn_s
        )
        if these.count == 1:
            normals = np.zeros((1, several))
        else:
            normals = self.rng.standard_normal((these.count, several))
        self._misjudge_turns(rows, misjudged)
        noise = Noise(normals, these.sampled_share, motion_update.CROSS)
        motion_update.advance(these.arrays, rows, motion, noise)

    def _misjudge_turns(self, rows: Indices, share: Floats) -> None:
        """Let a few hypotheses take a reported turn for one of any size (``prepare_motion``)."""
        these = self.hypotheses
        for m in np.flatnonzero(share >= 0.0):
            some = np.flatnonzero(self.rng.random(these.count) < share[m])
            error = motion_update.MISJUDGED_RAD * self.rng.standard_normal(some.size)
            these.shift(int(rows[m]), StateIndex.HEADING, error, some)
            # They would make any innovation look usual, and any mixture ambiguous.
            these.perturbed[some] = PERTURBED_UPDATES

    def update(
        self,
        first: Indices,
        second: Indices,
        range_m: Floats,
        dz_m: Floats,
        dz_variance_m2: Floats,
        repeats: Repeats,
        velocity_m_s: Floats,
        outliers: Floats,
    ) -> tuple[Floats, Floats]:
        """Update with the ranges (R,) of one instant; return what of each is an outlier.

        That is its inlier probability (R,), and by how much it is off if it is none (m).

        ``dz_m`` are the antennas' differences of height, ``repeats`` what of the pairs' last errors
        they repeat, ``outliers`` the least of :attr:`Ranges.outliers`.
        """
        several, these = len(first), self.hypotheses
        self._check(first, second, range_m, dz_m, dz_variance_m2, repeats.sample_count)
        these.biases.watch(first, second, range_m)
        biases = these.biases.entries(first, second)
        outlier, known = self._sensors.model.outlier, self._sensors
        shares = outliers.copy()
        usual = sensors.expect_outliers(known.outlier_counts, outlier)
        shares[:, 0] = np.maximum(usual, shares[:, 0])
        slant_m = slant_height(dz_m, dz_variance_m2)
        ranges = Ranges(
            first, second, range_m, slant_m, dz_variance_m2, *repeats, biases, velocity_m_s, shares
        )
        outlier[2] = 1.0 / (1.0 - these.sampled_share)
        wary = self.relocalisation.since_fault <= OPEN_UPDATES and self.counters["slips"] > 0
        before = these.log_weight.copy()
        stats = lanes.empty_lines(several, range_update.STATS, len(these.arrays.x))
        range_update.update(these.arrays, ranges, known.model, stats)
        outlying, fault, clamped = sensors.learn(
            these.arrays, ranges, known, these.draws, these.perturbed,
            stats.reshape(several, range_update.STATS, -1), before, wary,
        )  # fmt: skip
        if clamped:
            self.counters["levels_clamped"] += clamped
        if fault >= 0 and self.settings.hypotheses > 1:
            self._alarm = (fault, (first, second, range_m))
        return outlying

    def update_heading(self, row: int, heading_rad: float, sigma_rad: float) -> None:
        """Update with an absolute heading of a user."""
        self.hypotheses.put_back_common_rotation()
        heading_update.update_heading(self.hypotheses.arrays, row, heading_rad, sigma_rad**2)

    def update_detection(self, attempts: Attempts, detection: Detection) -> None:
        """Update with which attempts were received.

        After their ranges: the detection probability depends on the distances after them.
        """
        these = self.hypotheses
        before = these.log_weight.copy()
        detection_update.update_detection(these.arrays, attempts, detection.weight, detection.curve)
        sensors.temper(these.arrays.log_weight, before)

    def moments(self) -> tuple[Floats, Floats, Floats]:
        """Return the poses' mean (D,), covariance (D, D), and what the whole team shares (D, D).

        The second is without the rigid motion of the team that no range measures, and that this
        takes out of the hypotheses (:mod:`relpos.fusion.bank.common_rotation`); the third adds it.
        """
        mean, covariance = self.hypotheses.take_out_common_rotation()
        return mean, covariance, self.hypotheses.common_covariance(mean)

    def predicted_ranges(
        self, first: Indices, second: Indices, dz_m: Floats
    ) -> tuple[Floats, Floats]:
        """Return means and standard deviations (U,) of slant distances over all hypotheses."""
        these = self.hypotheses
        weight, _ = these.normalise()
        return mixture.predicted_ranges(these.arrays.x, these.arrays.p, weight, first, second, dz_m)

    def distances(self, rows: Indices) -> tuple[Floats, Floats]:
        """Return means and standard deviations (P,) of the distances of every two of ``rows``."""
        i, k = every_pair(len(rows))
        return self.predicted_ranges(rows[i], rows[k], np.zeros(len(i)))

    @property
    def faulty_row(self) -> int | None:
        """Whose ranges of this instant have shown an odometry fault."""
        return None if self._alarm is None else self._alarm[0]

    def end_instant(self, time_s: float, *, turned: bool = True) -> None:
        """Resize, relocalise, resample where the weights are uneven, and perturb a few.

        A user with an odometry fault may have ``turned``.
        """
        these, relocalisation = self.hypotheses, self.relocalisation
        these.biases.climb(time_s)
        known = self._sensors
        share = sensors.expect_outliers(known.outlier_counts, known.model.outlier)
        usual = max(sensors.ODD_SHARE, sensors.ODD_SHARE_OF_OUTLIERS * share)
        ambiguous = bool(
            self._alarm or relocalisation.ambiguous or relocalisation.lost
            or (known.surprise > usual).any()
        )  # fmt: skip
        since_fault = relocalisation.since_fault
        self.adaptive.resize(time_s, ambiguous=ambiguous, since_fault=since_fault)
        _, effective = these.normalise()
        relocalisation.since_fault += 1
        if self._alarm is not None:
            self.counters["slips"] += 1
            row, ranges = self._alarm
            relocalisation.relocalise(row, ranges, JUMP_M, turned=turned)
            self._alarm = None
        elif these.count > self.adaptive.ceiling and not relocalisation.open:
            these.resample(these.weights(), self.adaptive.ceiling)
        elif effective < 0.5 * these.count:
            these.resample(these.weights())
        if these.count > 1:
            relocalisation.perturb_some(known.surprise.tolist(), usual)
