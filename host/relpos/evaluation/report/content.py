"""The content of a report, gathered before anything is drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from relpos import tracks
from relpos.errors import DataError, RelposError
from relpos.evaluation import health, metrics, ranging, scoring, summary
from relpos.evaluation.finite import median
from relpos.evaluation.metrics import Metrics
from relpos.evaluation.result import Result, run_estimator
from relpos.fusion.estimator import NodeStatus
from relpos.measurements import Prior
from relpos.tracks import UNMOVED, Alignment, Pairs, Tracks, align, sample, whole_seconds

if TYPE_CHECKING:
    from relpos.evaluation.bounds import Bound
    from relpos.evaluation.scoring import Evaluation
    from relpos.runs import Run


@dataclass(frozen=True)
class Baseline:
    """Dead reckoning alone over the same run: its start, tracks and score."""

    words: str
    tracks: Tracks
    metrics: Metrics | None


@dataclass(frozen=True)
class Content:
    """One run and one estimate of it, with all that follows from them.

    ``fused`` are the tracks with NaN while a node was not located, ``guessed`` those with
    whatever was estimated. ``evaluation`` is None without truth, ``bound`` where the run was not
    simulated, ``baseline`` where there is no motion or dead reckoning was the estimator.
    """

    run: Run
    result: Result
    truth: Tracks
    fused: Tracks
    guessed: Tracks
    pairs: Pairs
    ranges: Sequence[ranging.PairRanges]
    heard: ranging.Heard | None
    health: Mapping[int, health.NodeHealth]
    evaluation: Evaluation | None = None
    bound: Bound | None = None
    baseline: Baseline | None = None
    words: Sequence[str] = field(default=())
    """Further sentences for the page, as the command that made it."""
    log: Sequence[Mapping[str, str]] = field(default=())
    """The session's log, as of ``log.csv``."""

    @property
    def nodes(self) -> tuple[int, ...]:
        """Every node with data."""
        return tuple(sorted({*self.run.node_ids, *self.guessed, *self.truth}))

    def name(self, node: int) -> str:
        """Return the name of a node's wearer, with the number."""
        info = self.run.nodes.get(node)
        return f"{info.name} ({node})" if info is not None and info.name else f"node {node}"

    def as_json(self) -> dict[str, Any]:
        """Return the numbers: those of ``evaluate --json``, and what needs no truth."""
        scored = self.evaluation
        numbers: dict[str, Any] = scored.as_json() if scored is not None else {"run": self.run.name}
        result = self.result
        return {
            **numbers,
            "estimator": result.estimator,
            "seed": result.seed,
            "settings": {key: str(value) for key, value in result.settings.items()},
            "estimates": len(result.estimates),
            "counters": dict(result.counters),
            "dead_reckoning": summary.figures(self.baseline.metrics)
            if self.baseline is not None and self.baseline.metrics is not None
            else None,
            "bound": None if self.bound is None else asdict(self.bound.totals()),
            "latency": summary.latency_as_json(result.latency),
            "ranges": [
                {
                    "node": one.pair[0],
                    "peer": one.pair[1],
                    "ranges": int(one.range_m.size),
                    "failed": one.failed,
                    "residual_median_m": summary.figure(median(one.residual_m)),
                    "residual_spread_m": summary.figure(ranging.spread(one.residual_m)),
                    "error_median_m": summary.figure(median(one.error_m)),
                    "error_spread_m": summary.figure(ranging.spread(one.error_m)),
                }
                for one in self.ranges
            ],
            "health": [
                {
                    "node": one.node,
                    "worst": None if one.worst is None else one.worst.name.lower(),
                    "loss": summary.figure(one.frame_loss),
                    "restarts": len(one.restarts),
                    "silences": len(one.silences),
                }
                for one in self.health.values()
            ],
            "learned": [
                {"node": p.node, "peer": p.peer, "name": p.name, "value": p.value, "sigma": p.sigma}
                for p in self.learned().values()
            ],
        }

    def learned(self) -> dict[tuple[str, int, int | None], Any]:
        """Return the last of every parameter that was learned, by name, node and peer."""
        last = {(p.name, p.node, p.peer): p for p in self.result.parameters}
        return dict(
            sorted(last.items(), key=lambda item: (item[0][0], item[0][1], item[0][2] or 0))
        )


def gather(
    run: Run,
    result: Result,
    *,
    evaluation: Evaluation | None = None,
    baseline: Baseline | None = None,
    words: Sequence[str] = (),
    log: Sequence[Mapping[str, str]] = (),
) -> Content:
    """Gather the content of a report; the parts that are not passed are computed.

    A run without truth, or with truth at no time of an estimate, gives content without an
    evaluation.
    """
    if evaluation is None and run.truth:
        with suppress(DataError):
            evaluation = scoring.evaluate(run, result)
    bound = None if evaluation is None else evaluation.bound_over_time
    truth = tracks.true_tracks(run.truth)
    fused = tracks.located_tracks(result.estimates)
    pairs = tracks.estimated_pairs(result.estimates)
    return Content(
        run,
        result,
        truth,
        fused,
        tracks.estimated_tracks(result.estimates),
        pairs,
        ranging.by_pair(run.ranges, fused, truth),
        ranging.heard(run.measurements, fused, truth, pairs),
        health.of_run(run.motions, run.statuses, run.node_ids),
        evaluation,
        bound or scoring.bound_of(run),
        baseline if baseline is not None else reckon(run, result),
        words,
        log,
    )


def reckon(run: Run, result: Result) -> Baseline | None:
    """Run dead reckoning over a run, from the same start as the estimator had where it can.

    Dead reckoning needs a start: without priors it gets the true start, which is more than the
    fusion had, and without a truth the first pose of each node that the fusion found.
    """
    from relpos import fusion
    from relpos.runs import InitialPose

    if not run.motions or (result.estimator == "deadreckoning" and not result.smoothed):
        return None
    priors: Sequence[Prior] = run.priors if result.priors is None else result.priors
    words = "dead reckoning from the same start"
    if not {motion.node for motion in run.motions} <= {prior.node for prior in priors}:
        priors = run.priors_for(InitialPose.FROM_TRUTH) if run.truth else ()
        words = "dead reckoning from the true start"
        if not priors:
            priors = _first_located(result)
            words = "dead reckoning from where the fusion first located each"
    try:
        made = run_estimator(
            fusion.make("deadreckoning", priors, {}, result.seed or 0), run.measurements
        )
    except RelposError:
        return None
    if made.failure is not None or not made.estimates:
        return None
    found = tracks.estimated_tracks(made.estimates)
    scored = metrics.evaluate(found, tracks.true_tracks(run.truth)) if run.truth else None
    return Baseline(words, found, scored if scored is not None and scored.epochs else None)


def _first_located(result: Result) -> tuple[Prior, ...]:
    first: dict[int, Prior] = {}
    for estimate in result.estimates:
        for node in estimate.nodes:
            if node.node not in first and node.status is NodeStatus.OK:
                first[node.node] = Prior(node.node, node.x_m, node.y_m, node.heading_rad)
    return tuple(first.values())


def alignment(moving: Tracks, onto: Tracks) -> Alignment:
    """Find the one rigid motion of a whole run that fits tracks on others best."""
    nodes = sorted(set(moving) & set(onto))
    at_s = whole_seconds([onto[node] for node in nodes])
    p, _ = sample([moving[node] for node in nodes], at_s)
    q, _ = sample([onto[node] for node in nodes], at_s)
    p, q = p.reshape(-1, 2), q.reshape(-1, 2)
    both = np.isfinite(p).all(axis=1) & np.isfinite(q).all(axis=1)
    if not both.any():
        return UNMOVED
    return align(p[both], q[both])
