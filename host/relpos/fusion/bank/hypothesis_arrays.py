"""The bank's hypotheses as arrays that kernels work on: what is read and changed in them."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from relpos.errors import RelposError
from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank import hypothesis_count, lanes, mixture, storage
from relpos.fusion.bank.hypothesis_models import Models, RangeErrors
from relpos.fusion.bank.lanes import LANES
from relpos.fusion.bank.mixture import PERTURBED_LOSS, PERTURBED_UPDATES
from relpos.fusion.bank.storage import COMMON, PER_NODE, Hypotheses, StateIndex
from relpos.fusion.bank.variance_components import VarianceComponents
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.models.motion_variances import COMPONENTS
from relpos.fusion.models.ranging import CommonIndex


class HypothesisArrays:
    """K weighted hypotheses about N users.

    Users are *rows* 0 ... N-1, as they are added. The state has D = 6 N + 4 + pairs
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
        places = storage.POSE * np.array(rows)[:, None] + np.arange(storage.POSE)
        return self.entries_of(places.ravel())

    def entries_of(self, places: Indices) -> tuple[Floats, Floats]:
        """Return means (K, E) and covariances (K, E, E) of stored entries (E,)."""
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

    def common_entry(self, index: CommonIndex) -> int:
        """Return the entry of the state that ranges have in common."""
        return PER_NODE * self.nodes + index

    def clock_entry(self, row: int) -> int:
        """Return the entry of the state that holds a user's clock offset."""
        return PER_NODE * self.nodes + COMMON + row

    def clock_entries(self) -> Indices:
        """Return the entries of all users' clock offsets (N,)."""
        return self.clock_entry(0) + np.arange(self.nodes)

    def lay_out_models(self) -> None:
        """Tell kernels what hypotheses model, after a change."""
        self.arrays = self.arrays._replace(
            has_heights=storage.lay_out(self.models.has(RangeErrors.HEIGHT)),
            has_passing=storage.lay_out(self.models.has(RangeErrors.PASSING)),
        )

    def shift_common(self, entry: int, by: float) -> None:
        """Add to an entry of what ranges have in common in every hypothesis that models it."""
        self.arrays.x[:, entry] += by * storage.lay_out(self.models.has_biases)

    def set_scale(self, row: int, scale: float) -> None:
        """Start a user's step scale (true over reported) where it is modelled."""
        scales = storage.lay_out(self.models.constants * math.log(scale))
        self.arrays.x[:, self._place(row, StateIndex.SCALE)] = scales

    def store(self, x: Floats, p: Floats) -> None:
        """Replace means (K, D) and covariances (K, D, D); K may change."""
        stored_x, stored_p = storage.pack(x, p, self.nodes)
        self.arrays = self.arrays._replace(x=stored_x, p=stored_p)
        self.count = len(x)
