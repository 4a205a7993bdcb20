"""Rerun recordings (``.rrd``): points, ellipses, tracks and distances on the run's clock.

Entities: ``world/node_N`` (point, ellipsoid of two standard deviations as in the page, only while
it is located), ``world/node_N/track`` (the whole way), ``world/truth/node_N``, and
``range/N_M`` and ``distance/N_M`` as scalars. The timeline is ``run``: seconds of the run, or Unix
time where the start is known.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from relpos.errors import DataError
from relpos.exchange.content import PLACED, Content, Point, stretches_of
from relpos.exchange.formats import Kind
from relpos.extras import missing_extra
from relpos.fusion.estimator import NodeEstimate

ELLIPSE_SIGMAS = 2.0
FLAT_M = 0.02
"""Thickness of an ellipse in the viewer's three dimensions."""


def write_rrd(out: Path, content: Content) -> None:
    """Write estimates, truth and ranges as one recording."""
    try:
        import rerun
    except ImportError:
        raise missing_extra("rerun-sdk", "rerun") from None
    stretches = {kind: stretches_of(content, kind) for kind in Kind}
    if not content.run.ranges and not any(stretches.values()):
        raise DataError(f"{content.run.name}: neither measurements nor estimates nor truth")
    recording = rerun.RecordingStream("relpos", recording_id=content.run.name)
    recording.save(str(out))
    _Writer(rerun, recording, content).write(stretches)
    recording.flush()
    recording.disconnect()


class _Writer:
    """Sends columns: a call an entity, whatever the length of the run."""

    def __init__(self, rerun: Any, recording: Any, content: Content) -> None:
        self._rerun = rerun
        self._recording = recording
        self._content = content

    def write(self, stretches: dict[Kind, dict[int, list[list[Point]]]]) -> None:
        self._ellipses()
        for kind, nodes in stretches.items():
            root = "world" if kind is Kind.ESTIMATE else "world/truth"
            for node, pieces in nodes.items():
                points = [p for piece in pieces for p in piece]
                columns = self._rerun.Points3D.columns(
                    positions=[_xyz(p) for p in points],
                    labels=[self._content.name_of(node)] * len(points),
                )
                self._send(f"{root}/node_{node}", [p.time_s for p in points], columns)
                strips = [[_xyz(p) for p in piece] for piece in pieces if len(piece) > 1]
                if strips:
                    entity = f"{root}/node_{node}/track"
                    way = self._rerun.LineStrips3D(strips)
                    self._recording.log(entity, way, static=True)
        rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for r in self._content.run.ranges:
            # A failed one is no distance: a gap in the plot.
            range_m = r.range_m if r.range_m > 0.0 else math.nan
            rows[f"range/{r.node}_{r.peer}"].append((r.time_s, range_m))
        for estimate in self._content.estimates:
            for pair in estimate.pairs:
                rows[f"distance/{pair.node}_{pair.peer}"].append((estimate.time_s, pair.distance_m))
        for entity, values in rows.items():
            columns = self._rerun.Scalars.columns(scalars=[value for _, value in values])
            self._send(entity, [time_s for time_s, _ in values], columns)

    def _ellipses(self) -> None:
        found: dict[int, list[tuple[float, NodeEstimate]]] = defaultdict(list)
        for estimate in self._content.estimates:
            for n in estimate.nodes:
                if n.status in PLACED and math.isfinite(n.x_m + n.y_m + n.sigma_major_m):
                    found[n.node].append((estimate.time_s, n))
        for node, rows in found.items():
            columns = self._rerun.Ellipsoids3D.columns(
                centers=[(n.x_m, n.y_m, _height(n.z_m)) for _, n in rows],
                half_sizes=[
                    (ELLIPSE_SIGMAS * n.sigma_major_m, ELLIPSE_SIGMAS * n.sigma_minor_m, FLAT_M)
                    for _, n in rows
                ],
                quaternions=[
                    (0.0, 0.0, math.sin(n.sigma_angle_rad / 2), math.cos(n.sigma_angle_rad / 2))
                    for _, n in rows
                ],
            )
            self._send(f"world/node_{node}/ellipse", [time_s for time_s, _ in rows], columns)

    def _send(self, entity: str, times_s: Sequence[float], columns: Any) -> None:
        start_s = self._content.start_unix_s
        at = (
            {"duration": times_s}
            if start_s is None
            else {"timestamp": [start_s + time_s for time_s in times_s]}
        )
        self._recording.send_columns(
            entity, indexes=[self._rerun.TimeColumn("run", **at)], columns=columns
        )


def _xyz(p: Point) -> tuple[float, float, float]:
    return p.x_m, p.y_m, _height(p.z_m)


def _height(z_m: float) -> float:
    return 0.0 if math.isnan(z_m) else z_m
