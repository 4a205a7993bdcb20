"""The score of one result against its run's truth, which ``evaluate`` and reports show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from relpos import tracks
from relpos.errors import DataError
from relpos.evaluation import consistency, iso18305, metrics, regions, summary, vertical

if TYPE_CHECKING:
    from relpos.evaluation.bounds import Bound, Totals
    from relpos.evaluation.result import Result
    from relpos.measurements import Prior
    from relpos.runs import Run


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Every figure of one estimate against a run's truth; ``print`` shows the main ones.

    ``metrics`` are the run format's four, per pair and over time; ``iso`` those of ISO/IEC 18305.
    ``nees_position`` and ``nees_heading`` need the start of every node, so that absolute poses can
    be compared with the truth; ``ambiguity`` is None where no node was ambiguous; ``bound`` is
    that of a simulated run, as totals and over time; ``vertical`` is None without true heights.
    """

    run: str
    metrics: metrics.Metrics
    nees_distance: consistency.Nees
    iso: iso18305.Assessment
    nees_position: consistency.Nees | None = None
    nees_heading: consistency.Nees | None = None
    ambiguity: regions.Ambiguity | None = None
    bound_over_time: Bound | None = None
    vertical: vertical.Vertical | None = None

    @property
    def bound(self) -> Totals | None:
        """The root mean square bounds over the whole run."""
        return None if self.bound_over_time is None else self.bound_over_time.totals()

    def as_json(self) -> dict[str, Any]:
        """Return what ``relpos evaluate --json`` prints; undefined figures are None."""
        return {
            "run": self.run,
            **summary.as_json(self.metrics),
            "nees_position": _nees(self.nees_position),
            "nees_heading": _nees(self.nees_heading),
            "alternatives": summary.ambiguity_as_json(self.ambiguity),
            "iso_18305": summary.iso_as_json(self.iso),
            "bound": None if (bound := self.bound) is None else asdict(bound),
            "vertical": summary.vertical_as_json(self.vertical),
        }

    def __eq__(self, other: object) -> bool:
        """Whether all figures are the same."""
        return isinstance(other, Evaluation) and self.as_json() == other.as_json()

    def __str__(self) -> str:
        """Return the main figures, one a line."""
        m, chance = self.metrics, self.nees_distance
        lines = [
            f"{self.run}: {m.epochs} whole seconds scored",
            f"  relative distance RMSE  {_metres(m.relative_distance_rmse_m)}",
            f"  aligned position RMSE   {_metres(m.relative_position_rmse_m)}",
            f"  body-frame RMSE         {_metres(m.body_frame_rmse_m)}",
            f"  NEES of the distance    {m.nees_distance:.2f} (1 is honest, {chance.low:.2f} to "
            f"{chance.high:.2f} by chance)",
        ]
        for frame, one in self.iso.frames.items():
            flat = one.horizontal
            words = f"  horizontal error        mean {_metres(flat.mean_m)}, RMS "
            words += f"{_metres(flat.rms_m)}, CE50 {_metres(flat.e50_m)}, CE95 "
            lines.append(words + f"{_metres(flat.e95_m)} ({frame.replace('_', ' ')})")
        if self.vertical is not None:
            lines.append(
                f"  vertical error          {_metres(self.vertical.relative_rmse_m)} RMSE between "
                f"two, VE95 {_metres(self.vertical.ve95_m)}"
            )
        bound = self.bound
        if bound is not None:
            lines.append(
                f"  bound, on line          {_metres(bound.filtering_distance_m)} relative "
                f"distance, {_metres(bound.filtering_position_m)} aligned"
            )
        return "\n".join(lines)


def evaluate(run: Run, result: Result, *, bound: bool = True) -> Evaluation:
    """Score a result against the truth of its run.

    The starts are those of the result, or of the run where the result has none. ``bound`` computes
    the Cramer-Rao bound of a simulated run. DataError where there is no truth, or none at a time
    of an estimate.
    """
    check_truth(run)
    estimates = result.estimates
    priors = run.priors if result.priors is None else result.priors
    truth = tracks.true_tracks(run.truth)
    estimated = tracks.estimated_tracks(estimates)
    score = metrics.evaluate(estimated, truth, tracks.estimated_pairs(estimates))
    poses = None
    # Absolute poses can only be held against the truth where every start was given.
    starts_known = bool(priors) and starts_given(run, priors)
    if starts_known:
        poses = [consistency.nees([one]) for one in consistency.of_poses(estimates, truth)]
    iso = iso18305.assess(
        estimated,
        truth,
        common_frame=starts_known,
        located=tracks.located_tracks(estimates),
        latency=result.latency,
    )
    if not score.epochs and not iso.known:
        raise DataError(f"{run.name}: no node has an estimate and a truth at the same time")
    return Evaluation(
        run.name,
        score,
        consistency.of_distances([score]),
        iso,
        poses[0] if poses else None,
        poses[1] if poses else None,
        regions.summarise(
            estimates, truth, run.ranges, starts_known=bool(priors) and not _common(run, priors)
        ),
        bound_of(run) if bound else None,
        vertical.score(estimates, truth, run.description.floors_m, run.events),
    )


def check_truth(run: Run) -> None:
    """Raise DataError where a run has no truth."""
    if not run.truth:
        raise DataError(f"{run.directory or run.name}: the run has no truth to score against")


def starts_given(run: Run, priors: Sequence[Prior]) -> bool:
    """Whether the start of every node that moves was given, in the truth's frame."""
    moving = {motion.node for motion in run.motions}
    return {prior.node for prior in priors} >= moving and not _common(run, priors)


def _common(run: Run, priors: Sequence[Prior]) -> bool:
    """Whether the priors are one common start, which is in a frame of its own."""
    from relpos.runs import InitialPose

    given = tuple(priors)
    if given != run.priors_for(InitialPose.COMMON) or given == run.description.priors:
        return False
    return not run.truth or given != run.priors_for(InitialPose.FROM_TRUTH)


MOST_BOUNDED = 50
"""Of more people the bound takes minutes and gigabytes: 30 s of a hundred half a minute."""


def bound_of(run: Run) -> Bound | None:
    """Compute the Cramer-Rao bound of a simulated run; None for other runs.

    None where a start is unknown: the first errors may then be as large as one likes. And None of
    more than ``MOST_BOUNDED`` people.
    """
    made = run.description.simulated
    if made is None or len(run.priors) > MOST_BOUNDED:
        return None
    # Not for what was recorded: the simulations take half a second to import.
    from relpos.evaluation import bounds
    from relpos.simulation.paper import Start
    from relpos.simulation.scenarios import BOUNDED

    if made.scenario not in BOUNDED or made.settings.get("start", Start.KNOWN) != Start.KNOWN:
        return None
    return bounds.of_simulated(made.scenario, made.seed, made.settings)


def _nees(nees: consistency.Nees | None) -> dict[str, Any] | None:
    return None if nees is None else summary.nees_as_json(nees)


def _metres(value: float) -> str:
    return f"{value:.2f} m" if math.isfinite(value) else "-"
