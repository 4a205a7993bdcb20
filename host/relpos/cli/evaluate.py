"""``relpos evaluate``: score an estimate against a run's truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from relpos.errors import DataError


def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run directory with truth.")],
    estimate: Annotated[
        Path, typer.Option("--estimate", metavar="DIR", help="Where estimate.csv lies.")
    ],
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Print the metrics of an estimate: for the team, per pair and over time."""
    from relpos.cli import output
    from relpos.evaluation import consistency, regions, summary, tracks
    from relpos.evaluation import metrics as scoring
    from relpos.runs import load_run, read_estimates

    recording = load_run(run)
    if not recording.truth:
        raise DataError(f"{run}: the run has no truth to score against")
    estimates = read_estimates(estimate)
    metrics = scoring.evaluate(
        tracks.estimated_tracks(estimates),
        tracks.true_tracks(recording.truth),
        tracks.estimated_pairs(estimates),
    )
    if not metrics.epochs:
        raise DataError(f"{estimate}: no two nodes have an estimate and a truth at the same time")
    # Absolute poses can only be held against the truth where the run gave the starts.
    known = {prior.node for prior in recording.priors}
    poses = None
    if known >= {motion.node for motion in recording.motions}:
        squares = consistency.of_poses(estimates, tracks.true_tracks(recording.truth))
        poses = [consistency.nees([one]) for one in squares]
    ambiguity = regions.summarise(
        estimates,
        tracks.true_tracks(recording.truth),
        recording.ranges,
        starts_known=bool(recording.priors),
    )
    if json:
        extra: dict[str, object] = {
            f"nees_{name}": summary.nees_as_json(poses[k]) if poses else None
            for k, name in enumerate(("position", "heading"))
        }
        extra["alternatives"] = summary.ambiguity_as_json(ambiguity)
        output.print_json({"run": recording.name, **summary.as_json(metrics), **extra})
    else:
        output.print_metrics(recording.name, metrics)
        if poses:
            output.print_nees(*poses)
        if ambiguity is not None:
            output.print_ambiguity(ambiguity)
