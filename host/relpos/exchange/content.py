"""The content of a source in any format: a run, estimates, and the start of its clock."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpos.errors import DataError
from relpos.exchange.formats import Kind
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus
from relpos.geodesy import Locate, MapFrame
from relpos.measurements import Prior, Truth
from relpos.runs.run import Run
from relpos.tracks import located_tracks, sample, true_tracks

if TYPE_CHECKING:
    from relpos.recording.reader import Recording


PLACED = (NodeStatus.OK, NodeStatus.STALE, NodeStatus.LOST)
"""With any other status the numbers are the mean of what is possible, and no position."""

MIN_JUMP_M = 3.0
FASTEST_M_S = 5.0
"""Who has gone further has been located anew: the page's figures (``view/static/js/tracks.js``)."""

_DECIMALS = 9
"""Of a degree: a tenth of a millimetre."""


@dataclass(frozen=True)
class Content:
    """A run and the estimates that belong to it, either of which may be empty.

    ``start_unix_s`` is the Unix time of the run's second 0, None where it is not known.
    ``remarks`` tell the user how it was read. ``recording`` is the MCAP
    file that the run, and all estimates, were read from, with whatever else it holds. ``priors``
    are the starts of the estimates, None where they do not say.
    """

    run: Run
    estimates: tuple[Estimate, ...] = ()
    start_unix_s: float | None = None
    remarks: tuple[str, ...] = ()
    recording: Recording | None = None
    priors: tuple[Prior, ...] | None = None

    @property
    def node_ids(self) -> tuple[int, ...]:
        """Every node that anything is known of, in order."""
        ids = set(self.run.node_ids) | {row.node for row in self.run.truth}
        return tuple(sorted(ids.union(n.node for e in self.estimates for n in e.nodes)))

    def name_of(self, node: int) -> str:
        """Return the wearer's name, or the node's number in words."""
        return self.run.description.names.get(node) or f"node {node}"

    def locate(self, kind: Kind) -> Locate:
        """Return where a node was at a time, or first, for a pin that is stuck to a node."""
        found = (
            true_tracks(self.run.truth) if kind is Kind.TRUTH else located_tracks(self.estimates)
        )

        def at(node: int, time_s: float | None) -> tuple[float, float] | None:
            track = found.get(node)
            if track is None:
                return None
            if time_s is None:
                there = np.isfinite(track.x_m) & np.isfinite(track.y_m)
                if not there.any():
                    return None
                first = int(np.argmax(there))
                return float(track.x_m[first]), float(track.y_m[first])
            x_m, y_m = sample([track], np.array([time_s]))[0][0, 0]
            return (float(x_m), float(y_m)) if math.isfinite(x_m + y_m) else None

        return at

    @property
    def one_frame(self) -> bool:
        """Whether estimates and truth have one frame, as where the starts were given."""
        if self.priors is not None:
            return bool(self.priors)
        return bool(self.run.description.priors) or self.run.description.initial_pose != "unknown"


@dataclass(frozen=True, slots=True)
class Point:
    """One pose of a trajectory; NaN where a figure is not known."""

    time_s: float
    node: int
    x_m: float
    y_m: float
    z_m: float = math.nan
    heading_rad: float = math.nan


def points_of(content: Content, kind: Kind) -> dict[int, list[Point]]:
    """Return every node's rows by time, guesses too; rows without a position are left out."""
    return {node: [p for piece in pieces for p in piece] for node, pieces in _pieces(content, kind)}


def stretches_of(content: Content, kind: Kind) -> dict[int, list[list[Point]]]:
    """Return every node's rows that are positions, cut where it was not located or located anew.

    Nobody knows the way from where somebody was believed to be to where they are found.
    """
    return {node: [p for p in pieces if p] for node, pieces in _pieces(content, kind, placed=True)}


def _pieces(
    content: Content, kind: Kind, *, placed: bool = False
) -> Iterator[tuple[int, list[list[Point]]]]:
    pieces: dict[int, list[list[Point]]] = {}
    if kind is Kind.TRUTH:
        for row in sorted(content.run.truth, key=lambda row: row.time_s):
            z_m = math.nan if row.z_m is None else row.z_m
            heading_rad = math.nan if row.heading_rad is None else row.heading_rad
            pieces.setdefault(row.node, [[]])[-1].append(
                Point(row.time_s, row.node, row.x_m, row.y_m, z_m, heading_rad)
            )
    else:
        for estimate in content.estimates:
            for n in estimate.nodes:
                cut = pieces.setdefault(n.node, [[]])
                if placed and n.status not in PLACED:
                    cut.append([])
                elif math.isfinite(n.x_m + n.y_m):
                    p = Point(estimate.time_s, n.node, n.x_m, n.y_m, n.z_m, n.heading_rad)
                    if placed and cut[-1] and _jumps(cut[-1][-1], p):
                        cut.append([])
                    cut[-1].append(p)
    return ((node, pieces[node]) for node in sorted(pieces))


def _jumps(before: Point, after: Point) -> bool:
    walked_m = FASTEST_M_S * (after.time_s - before.time_s)
    return math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) > max(MIN_JUMP_M, walked_m)


def on_map(points: Sequence[Point], frame: MapFrame) -> Iterator[tuple[float, float, float | None]]:
    """Return each point's latitude and longitude, and its height where it is known."""
    latitude, longitude = frame.to_map([p.x_m for p in points], [p.y_m for p in points])
    for p, lat, lon in zip(points, latitude.tolist(), longitude.tolist(), strict=True):
        altitude_m = frame.altitude_of(p.z_m)
        height = None if altitude_m is None else round(altitude_m, 3)
        yield round(lat, _DECIMALS), round(lon, _DECIMALS), height


def as_truth(points: Iterable[Point]) -> tuple[Truth, ...]:
    """Return poses as ground truth, by time."""

    def known(value: float) -> float | None:
        return value if math.isfinite(value) else None

    return tuple(
        Truth(p.time_s, p.node, p.x_m, p.y_m, known(p.heading_rad), known(p.z_m))
        for p in sorted(points, key=lambda p: (p.time_s, p.node))
    )


def as_estimates(points: Iterable[Point]) -> tuple[Estimate, ...]:
    """Return poses as estimates; what such a trajectory does not say, its sigmas, is NaN."""
    nan = math.nan
    by_time: dict[float, dict[int, NodeEstimate]] = {}
    for p in points:
        there = by_time.setdefault(p.time_s, {})
        if p.node in there:
            raise DataError(f"node {p.node} has two positions at {p.time_s:g} s")
        there[p.node] = NodeEstimate(
            p.node, p.x_m, p.y_m, p.heading_rad, nan, nan, nan, nan, NodeStatus.OK, p.z_m, nan
        )
    return tuple(
        Estimate(time_s, tuple(nodes[node] for node in sorted(nodes)), ())
        for time_s, nodes in sorted(by_time.items())
    )
