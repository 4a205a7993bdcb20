"""Estimates and truth as the arrays that the metrics work on."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import numpy as np

from relpos.evaluation.metrics import Pair, PairTrack, Track
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus
from relpos.measurements import Truth

Row = tuple[float, float, float, float, float]


def estimated_tracks(estimates: Iterable[Estimate]) -> dict[int, Track]:
    """Return the track of every node, whatever its status: a guess is scored as one."""
    rows: dict[int, list[Row]] = defaultdict(list)
    for estimate in estimates:
        for node in estimate.nodes:
            pose = (node.x_m, node.y_m, node.heading_rad)
            rows[node.node].append((estimate.time_s, *pose, _height(node)))
    return {node: Track(*np.array(rows[node]).T) for node in sorted(rows)}


def located_tracks(estimates: Iterable[Estimate]) -> dict[int, Track]:
    """Return the tracks for a picture: NaN while a node was ambiguous or not located.

    The mean of what is possible jumps between the possibilities; a line through it says nothing.
    """
    nowhere = (NodeStatus.AMBIGUOUS, NodeStatus.UNLOCATED)
    rows: dict[int, list[Row]] = defaultdict(list)
    for estimate in estimates:
        for node in estimate.nodes:
            pose = (node.x_m, node.y_m, node.heading_rad)
            if node.status in nowhere:
                pose = (np.nan, np.nan, np.nan)
            rows[node.node].append((estimate.time_s, *pose, _height(node)))
    return {node: Track(*np.array(rows[node]).T) for node in sorted(rows)}


def estimated_pairs(estimates: Iterable[Estimate]) -> dict[Pair, PairTrack]:
    """Return each pair's distance and sigma over time, under (node, peer) as it was reported."""
    rows: dict[Pair, list[tuple[float, float, float]]] = defaultdict(list)
    for estimate in estimates:
        for pair in estimate.pairs:
            rows[pair.node, pair.peer].append(
                (estimate.time_s, pair.distance_m, pair.sigma_distance_m)
            )
    return {pair: PairTrack(*np.array(rows[pair]).T) for pair in sorted(rows)}


def true_tracks(truth: Iterable[Truth]) -> dict[int, Track]:
    """Return the true track of every node; what was not recorded is NaN."""
    rows: dict[int, list[Row]] = defaultdict(list)
    for row in truth:
        heading_rad = np.nan if row.heading_rad is None else row.heading_rad
        z_m = np.nan if row.z_m is None else row.z_m
        rows[row.node].append((row.time_s, row.x_m, row.y_m, heading_rad, z_m))
    return {node: Track(*np.array(rows[node]).T) for node in sorted(rows)}


def _height(node: NodeEstimate) -> float:
    """Return the height over the start; 0 without any uncertainty is what nothing told."""
    return node.z_m if node.z_m or node.sigma_z_m else np.nan
