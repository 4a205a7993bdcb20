"""Studies: scenarios x estimators x seeds, scored and summed up.

A :class:`Case` is one line of a table: which scenario with what overrides, which estimator with
what settings. :func:`run` scores each case on every seed, on any executor
(:mod:`relpos.evaluation.executors`); an :class:`Outcome` sums up, as the run format says: means
over the runs with their standard errors, the worst run, and ratios to the scenario's bound.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from relpos import fusion, tracks
from relpos.errors import RelposError
from relpos.evaluation import bounds, metrics, vertical
from relpos.evaluation.executors import run_all
from relpos.evaluation.vertical import Vertical
from relpos.runs import NodeInfo
from relpos.simulation.scenarios import simulate

Floats = npt.NDArray[np.float64]

ESTIMATOR_SEED = 1_000_000
"""Added to a run's seed for the estimator's dice: they are not the simulation's."""

CONFIDENCE_95 = 1.96
"""Standard errors to either side of a mean that make its 95 % interval."""


@dataclass(frozen=True)
class Case:
    """One line of a study; keys and values as ``--set`` of ``simulate`` and ``fuse`` takes them."""

    label: str
    scenario: str = "paper"
    overrides: Mapping[str, str | float] = field(default_factory=dict)
    estimator: str = "particle"
    settings: Mapping[str, object] = field(default_factory=dict)
    smooth: bool = False
    """Whether the whole run is smoothed, beginning from the estimator."""


@dataclass(frozen=True)
class Score:
    """The result of one run; NaN where a figure is undefined or the estimator gave up.

    ``busy_s`` is the processor time of the estimator alone. ``time_s`` (T,) are the whole seconds
    that could be scored, ``distance_over_time_m`` and ``aligned_over_time_m`` (T,) the root mean
    squares over pairs and nodes there. ``failure`` is why the estimator gave up, if it did.
    """

    seed: int
    distance_m: float
    aligned_m: float
    body_frame_m: float
    nees: float
    busy_s: float
    time_s: Floats
    distance_over_time_m: Floats
    aligned_over_time_m: Floats
    counters: Mapping[str, int]
    failure: str = ""
    ok_over_3_sigma: float = math.nan
    ok_over_2_m: float = math.nan
    ok_wrong_side: float = math.nan
    vertical: Vertical | None = None


def score(case: Case, seed: int) -> Score:
    """Run one case on one seed."""
    run = simulate(case.scenario, seed, case.overrides)
    make = fusion.make_smoother if case.smooth else fusion.make
    nodes = {node: NodeInfo(post=True) for node in run.posts}
    estimator = make(case.estimator, run.priors, case.settings, seed + ESTIMATOR_SEED, nodes)
    started = time.process_time()
    failure = ""
    try:
        estimates = [e for m in run.measurements for e in estimator.process(m)]
        estimates += estimator.finish()
    except RelposError as error:
        estimates, failure = [], str(error)
    busy_s = time.process_time() - started
    truth = tracks.true_tracks(run.truth)
    result = metrics.evaluate(
        tracks.estimated_tracks(estimates),
        truth,
        tracks.estimated_pairs(estimates),
    )
    return Score(
        seed,
        result.relative_distance_rmse_m,
        result.relative_position_rmse_m,
        result.body_frame_rmse_m,
        result.nees_distance,
        busy_s,
        result.time_s,
        result.distance_rmse_over_time_m,
        result.position_rmse_over_time_m,
        dict(estimator.counters()),
        failure,
        result.ok_over_3_sigma,
        result.ok_over_2_m,
        result.ok_wrong_side,
        vertical.score(estimates, truth, run.floors_m, run.events),
    )


@dataclass(frozen=True, slots=True)
class Statistic:
    """A figure over seeds: mean, standard error, largest run, and how many runs gave one."""

    mean: float
    error: float
    worst: float
    count: int

    @staticmethod
    def of(values: Sequence[float]) -> Statistic:
        """Sum up the runs' figures; those that gave none (NaN) are left out and not counted."""
        finite = [float(v) for v in values if math.isfinite(v)]
        mean, error = metrics.over_seeds(finite)
        return Statistic(mean, error, max(finite, default=math.nan), len(finite))

    @property
    def half_width(self) -> float:
        """Half of the 95 % confidence interval of the mean."""
        return CONFIDENCE_95 * self.error


@dataclass(frozen=True)
class Outcome:
    """A case and its scores, in the order of the seeds."""

    case: Case
    scores: tuple[Score, ...]

    @property
    def distance_m(self) -> Statistic:
        """The relative distance's RMSE."""
        return Statistic.of([s.distance_m for s in self.scores])

    @property
    def aligned_m(self) -> Statistic:
        """The RMSE of positions after the best rigid alignment."""
        return Statistic.of([s.aligned_m for s in self.scores])

    @property
    def body_frame_m(self) -> Statistic:
        """The RMSE of peers in the body frame."""
        return Statistic.of([s.body_frame_m for s in self.scores])

    @property
    def nees(self) -> Statistic:
        """The distance NEES."""
        return Statistic.of([s.nees for s in self.scores])

    @property
    def ok_over_3_sigma(self) -> Statistic:
        """Of the pair-seconds with status ok, the share that errs by more than three sigmas."""
        return Statistic.of([s.ok_over_3_sigma for s in self.scores])

    @property
    def ok_over_2_m(self) -> Statistic:
        """Of the pair-seconds with status ok, the share that errs by more than 2 m."""
        return Statistic.of([s.ok_over_2_m for s in self.scores])

    @property
    def ok_wrong_side(self) -> Statistic:
        """Of the triangles whose pairs are ok, the share that is told mirrored."""
        return Statistic.of([s.ok_wrong_side for s in self.scores])

    @property
    def busy_s(self) -> Statistic:
        """The estimator's processor time."""
        return Statistic.of([s.busy_s for s in self.scores])

    @property
    def failures(self) -> list[str]:
        """Why the estimator gave up, of each run in which it did."""
        return [s.failure for s in self.scores if s.failure]


def run(
    cases: Sequence[Case],
    seeds: Sequence[int],
    pool: Executor,
    on_done: Callable[[int, int], None] | None = None,
) -> list[Outcome]:
    """Score every case on every seed; outcomes in the order of the cases."""
    # Seed by seed, so that all cases have some runs early and the slow ones are spread.
    jobs = [(case, seed) for seed in seeds for case in cases]
    scores = run_all(pool, score, jobs, on_done)
    width = len(cases)
    return [Outcome(case, tuple(scores[k::width])) for k, case in enumerate(cases)]


def bound(case: Case, seed: int) -> bounds.Bound:
    """Compute the bound of one run of a case's scenario."""
    return bounds.of_simulated(case.scenario, seed, case.overrides)


def totals(case: Case, seed: int) -> bounds.Totals:
    """Compute one run's root mean square bounds over the whole run."""
    return bound(case, seed).totals()


def bounds_of(
    cases: Sequence[Case],
    seeds: Sequence[int],
    pool: Executor,
    on_done: Callable[[int, int], None] | None = None,
) -> list[bounds.Totals]:
    """Each case's bound over the seeds; that of one scenario is computed once."""
    keys = [(c.scenario, tuple(sorted(c.overrides.items()))) for c in cases]
    first = dict(zip(keys, cases, strict=True))
    jobs = [(case, seed) for case in first.values() for seed in seeds]
    each = run_all(pool, totals, jobs, on_done)
    count = len(seeds)
    by_key = {
        key: bounds.over_seeds(each[k * count : (k + 1) * count]) for k, key in enumerate(first)
    }
    return [by_key[key] for key in keys]
