"""GPX 1.1 through gpxpy: a track a node, a segment a stretch; landmarks as waypoints.

The track's ``number`` is the node's id, its ``type`` says whether it is truth or an estimate.
GPX has no time but the absolute: without the run's start the points go without.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from relpos.errors import DataError
from relpos.exchange.content import Content, Point, on_map, stretches_of
from relpos.exchange.formats import Kind
from relpos.exchange.times import time_of
from relpos.extras import missing_extra
from relpos.files import printable, write_output
from relpos.geodesy import MapFrame
from relpos.runs.landmarks import Landmark
from relpos.runs.table import read_text


def write_tracks(path: Path, content: Content, kinds: Iterable[Kind], frame: MapFrame) -> None:
    """Write all tracks and landmarks; elevations only where the pin gave an altitude."""
    gpx = _library().gpx
    document = gpx.GPX()
    document.creator = "relpos"
    document.name = printable(content.run.name)
    for mark in content.run.landmarks:
        place = Point(0.0, 0, mark.x_m, mark.y_m, math.nan if mark.z_m is None else mark.z_m)
        document.waypoints += [
            gpx.GPXWaypoint(lat, lon, elevation=height, name=printable(mark.landmark))
            for lat, lon, height in on_map([place], frame)
        ]
    start_unix_s = content.start_unix_s
    for kind in kinds:
        for node, pieces in stretches_of(content, kind).items():
            track = gpx.GPXTrack(name=printable(content.name_of(node)), number=node)
            track.type = str(kind)
            document.tracks.append(track)
            for piece in pieces:
                segment = gpx.GPXTrackSegment()
                track.segments.append(segment)
                for p, (lat, lon, height) in zip(piece, on_map(piece, frame), strict=True):
                    time = None if start_unix_s is None else time_of(start_unix_s + p.time_s)
                    segment.points.append(gpx.GPXTrackPoint(lat, lon, elevation=height, time=time))
    write_output(path, document.to_xml(version="1.1"))


def first_time(path: Path) -> float | None:
    """Return the Unix time of the file's first point in time; None where it has no times."""
    document = _parsed(path)
    times = [
        _unix_s(p.time)
        for track in document.tracks
        for segment in track.segments
        for p in segment.points
        if p.time is not None
    ]
    return min(times, default=None)


def read_tracks(
    path: Path,
    frame: MapFrame,
    start_unix_s: float | None,
    *,
    node: int | None = None,
    kind: Kind | None = None,
) -> dict[Kind, list[Point]]:
    """Read every track; ``node`` and ``kind`` say what the file does not."""
    points: dict[Kind, list[Point]] = {}
    for place, track in enumerate(_parsed(path).tracks, start=1):
        where = f"{path}: track {place}" + f" ({track.name})" * bool(track.name)
        whose = node if node is not None else track.number
        if whose is None or whose < 0:
            raise DataError(f"{where}: whose track is this? (its number, or --node N)")
        what = kind
        if what is None:
            if track.type not in list(Kind):
                raise DataError(
                    f"{where}: is this truth or an estimate? (--as truth, --as estimate)"
                )
            what = Kind(track.type)
        for segment in track.segments:
            for p in segment.points:
                if p.time is None:
                    raise DataError(f"{where}: a point has no time")
                x_m, y_m, z_m = _world(where, p, frame)
                time_s = round(_unix_s(p.time) - (start_unix_s or 0.0), 6)
                points.setdefault(what, []).append(Point(time_s, whose, x_m, y_m, z_m))
    return points


def read_landmarks(path: Path, frame: MapFrame) -> list[Landmark]:
    """Read every named waypoint as a surveyed landmark."""
    landmarks: dict[str, Landmark] = {}
    for place, waypoint in enumerate(_parsed(path).waypoints, start=1):
        where = f"{path}: waypoint {place}"
        mark = (waypoint.name or "").strip()
        if not mark:
            raise DataError(f"{where}: a landmark needs a name, which is its id")
        if mark in landmarks:
            raise DataError(f"{where}: landmark {mark!r} is there twice")
        x_m, y_m, z_m = _world(where, waypoint, frame)
        landmarks[mark] = Landmark(mark, x_m, y_m, z_m if math.isfinite(z_m) else None)
    return list(landmarks.values())


def _unix_s(time: datetime) -> float:
    return time.replace(tzinfo=time.tzinfo or UTC).timestamp()


def _world(where: str, point: Any, frame: MapFrame) -> tuple[float, float, float]:
    try:
        x_m, y_m = frame.to_world(point.latitude, point.longitude)
    except DataError as error:
        raise DataError(f"{where}: {error}") from None
    z_m = math.nan
    if point.elevation is not None and frame.altitude_m is not None:
        z_m = point.elevation - frame.altitude_m
    return float(x_m), float(y_m), z_m


def _parsed(path: Path) -> Any:
    gpxpy = _library()
    text = read_text(path)
    try:
        return gpxpy.parse(text)
    except gpxpy.gpx.GPXException as error:
        raise DataError(f"{path}: not GPX: {' '.join(str(error).split())}") from None


def _library() -> Any:
    try:
        import gpxpy.gpx
    except ImportError:
        raise missing_extra("gpxpy", "exchange") from None
    return gpxpy
