"""GeoJSON (RFC 7946): tracks, last positions with their regions, and landmarks, on a map.

Every stretch of a track is a ``LineString`` (a single row a ``Point``) whose properties say whose
it is and, position by position, when: ``time_s``, ``course_deg`` and, where the run's start is
known, ``coordTimes``, the name that other tools look for.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from relpos.errors import DataError
from relpos.exchange.content import PLACED, Content, Point, on_map, stretches_of
from relpos.exchange.formats import Kind
from relpos.exchange.times import iso_of, unix_of
from relpos.files import write_output
from relpos.fusion.estimator import NodeEstimate
from relpos.geodesy import MapFrame
from relpos.runs.landmarks import Landmark
from relpos.runs.table import read_text

REGION = 0.95
"""The probability that a last position's region holds the wearer, where the sigmas are honest."""

_CORNERS = 36


def write_tracks(path: Path, content: Content, kinds: Iterable[Kind], frame: MapFrame) -> None:
    """Write one FeatureCollection; altitudes only where the pin gave one."""
    features: list[dict[str, Any]] = []
    for kind in kinds:
        for node, pieces in stretches_of(content, kind).items():
            who = {"of": str(kind), "node": node, "name": content.name_of(node)}
            features += [_track(piece, who, content.start_unix_s, frame) for piece in pieces]
        if kind is Kind.ESTIMATE:
            features += _last_positions(content, frame)
    for mark in content.run.landmarks:
        position = _positions([Point(0.0, 0, mark.x_m, mark.y_m, _nan(mark.z_m))], frame)[0]
        features.append(_feature("Point", position, {"kind": "landmark", "id": mark.landmark}))
    document = {"type": "FeatureCollection", "features": features}
    write_output(path, json.dumps(document, allow_nan=False, ensure_ascii=False))


def _track(
    piece: Sequence[Point], who: Mapping[str, Any], start_unix_s: float | None, frame: MapFrame
) -> dict[str, Any]:
    properties = {
        "kind": "track",
        **who,
        "time_s": [round(p.time_s, 6) for p in piece],
        "course_deg": [_course(p.heading_rad, frame) for p in piece],
    }
    if start_unix_s is not None:
        properties["coordTimes"] = [iso_of(start_unix_s + p.time_s) for p in piece]
    positions = _positions(piece, frame)
    if len(piece) == 1:
        return _feature("Point", positions[0], properties)
    return _feature("LineString", positions, properties)


def _last_positions(content: Content, frame: MapFrame) -> list[dict[str, Any]]:
    last: dict[int, tuple[float, NodeEstimate]] = {}
    for estimate in content.estimates:
        for n in estimate.nodes:
            if n.status in PLACED and math.isfinite(n.x_m + n.y_m):
                last[n.node] = (estimate.time_s, n)
    features: list[dict[str, Any]] = []
    for node, (time_s, n) in sorted(last.items()):
        who = {"node": node, "name": content.name_of(node), "time_s": round(time_s, 6)}
        figures = {
            "status": str(n.status),
            "course_deg": _course(n.heading_rad, frame),
            "sigma_major_m": _rounded(n.sigma_major_m),
            "sigma_minor_m": _rounded(n.sigma_minor_m),
            **_vertical(n),
        }
        where = _positions([Point(time_s, node, n.x_m, n.y_m, n.z_m)], frame)[0]
        features.append(_feature("Point", where, {"kind": "position", **who, **figures}))
        if math.isfinite(n.sigma_major_m) and n.sigma_major_m > 0.0:
            ring = _region(n, frame)
            about = {"kind": "region", **who, "probability": REGION}
            features.append(_feature("Polygon", [ring], about))
    return features


def _vertical(n: NodeEstimate) -> dict[str, float | int | None]:
    """Return height over the start and floor, where the estimator knows of them."""
    found: dict[str, float | int | None] = {}
    if n.z_m or n.sigma_z_m:
        # Where none is stated it is 0, which is not exact.
        sigma_m = n.sigma_z_m or math.nan
        found |= {"height_m": _rounded(n.z_m), "sigma_height_m": _rounded(sigma_m)}
    return found if n.floor is None else found | {"floor": n.floor}


def _region(n: NodeEstimate, frame: MapFrame) -> list[list[float]]:
    """Return the ellipse that holds the wearer, counter-clockwise and closed as the RFC wants."""
    reach = math.sqrt(-2.0 * math.log(1.0 - REGION))
    angle = np.linspace(0.0, 2.0 * math.pi, _CORNERS, endpoint=False)
    along, across = reach * n.sigma_major_m * np.cos(angle), reach * n.sigma_minor_m * np.sin(angle)
    c, s = math.cos(n.sigma_angle_rad), math.sin(n.sigma_angle_rad)
    x_m, y_m = n.x_m + c * along - s * across, n.y_m + s * along + c * across
    corners = zip(x_m.tolist(), y_m.tolist(), strict=True)
    ring = _positions([Point(0.0, n.node, x, y) for x, y in corners], frame)
    return [*ring, ring[0]]


def _feature(shape: str, coordinates: Any, properties: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "type": "Feature",
        "geometry": {"type": shape, "coordinates": coordinates},
        "properties": dict(properties),
    }


def _positions(points: Sequence[Point], frame: MapFrame) -> list[list[float]]:
    return [
        [lon, lat] if height is None else [lon, lat, height]
        for lat, lon, height in on_map(points, frame)
    ]


def _course(heading_rad: float, frame: MapFrame) -> float | None:
    return round(frame.course_deg(heading_rad), 3) if math.isfinite(heading_rad) else None


def _rounded(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def _nan(value: float | None) -> float:
    return math.nan if value is None else value


def read_tracks(
    path: Path,
    frame: MapFrame,
    start_unix_s: float | None,
    *,
    node: int | None = None,
    kind: Kind | None = None,
) -> dict[Kind, list[Point]]:
    """Read every track, ours or another tool's; ``node`` and ``kind`` say what the file does not.

    Times are ``time_s``, else ``coordTimes`` from ``start_unix_s`` on.
    """
    points: dict[Kind, list[Point]] = {}
    for number, feature in enumerate(_features(path), start=1):
        shape, coordinates, properties = feature
        ours = properties.get("kind")
        if (ours is not None and ours != "track") or (shape == "Point" and ours is None):
            continue
        where = f"{path}: feature {number}"
        if shape not in ("Point", "LineString"):
            raise DataError(f"{where}: a track is a LineString, not a {shape}")
        positions = [coordinates] if shape == "Point" else coordinates
        whose = node if node is not None else properties.get("node")
        if not isinstance(whose, int) or isinstance(whose, bool) or whose < 0:
            raise DataError(f"{where}: whose track is this? (property node, or --node N)")
        what = kind or _kind(where, properties.get("of"))
        times_s = _times(where, properties, len(positions), start_unix_s)
        courses = properties.get("course_deg")
        if not isinstance(courses, list) or len(courses) != len(positions):
            courses = [None] * len(positions)
        for time_s, position, course in zip(times_s, positions, courses, strict=True):
            x_m, y_m, z_m = _world(where, position, frame)
            heading_rad = (
                math.remainder(frame.bearing_rad - math.radians(course), 2.0 * math.pi)
                if _is_number(course)
                else math.nan
            )
            points.setdefault(what, []).append(Point(time_s, whose, x_m, y_m, z_m, heading_rad))
    return points


def read_landmarks(path: Path, frame: MapFrame) -> list[Landmark]:
    """Read every point with an id or a name as a surveyed landmark."""
    landmarks: dict[str, Landmark] = {}
    for number, (shape, coordinates, properties) in enumerate(_features(path), start=1):
        if shape != "Point" or properties.get("kind", "landmark") != "landmark":
            continue
        where = f"{path}: feature {number}"
        known = properties.get("id", properties.get("name"))
        mark = "" if known is None else str(known).strip()
        # Half a surrogate pair, which JSON can hold, is no text that a file can.
        if not mark or any("\ud800" <= letter <= "\udfff" for letter in mark):
            raise DataError(f"{where}: a landmark needs an id (property id or name)")
        if mark in landmarks:
            raise DataError(f"{where}: landmark {mark!r} is there twice")
        x_m, y_m, z_m = _world(where, coordinates, frame)
        landmarks[mark] = Landmark(mark, x_m, y_m, z_m if math.isfinite(z_m) else None)
    return list(landmarks.values())


def _features(path: Path) -> list[tuple[str, Any, dict[str, Any]]]:
    """Return shape, coordinates and properties of every feature that has a geometry."""
    try:
        document = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: line {error.lineno}: not JSON: {error.msg}") from None
    except (RecursionError, ValueError):  # The latter by a number of thousands of digits.
        raise DataError(f"{path}: no GeoJSON: nested too deeply, or numbers too long") from None
    kind = document.get("type") if isinstance(document, dict) else None
    features = document.get("features") if kind == "FeatureCollection" else None
    if kind == "Feature":
        features = [document]
    if not isinstance(features, list):
        raise DataError(f"{path}: neither a FeatureCollection nor a Feature of GeoJSON")
    found: list[tuple[str, Any, dict[str, Any]]] = []
    for number, feature in enumerate(features, start=1):
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise DataError(f"{path}: feature {number}: no GeoJSON feature")
        geometry, properties = feature.get("geometry"), feature.get("properties") or {}
        if geometry is None:
            continue
        if (
            not isinstance(geometry, dict)
            or not isinstance(geometry.get("coordinates"), list)
            or not isinstance(properties, dict)
        ):
            raise DataError(f"{path}: feature {number}: no GeoJSON geometry with coordinates")
        if "id" in feature and "id" not in properties:
            properties = {"id": feature["id"], **properties}
        found.append((str(geometry.get("type")), geometry["coordinates"], properties))
    return found


def _kind(where: str, text: object) -> Kind:
    try:
        return Kind(str(text))
    except ValueError:
        raise DataError(
            f"{where}: is this truth or an estimate? (--as truth, --as estimate)"
        ) from None


def _times(
    where: str, properties: Mapping[str, Any], count: int, start_unix_s: float | None
) -> list[float]:
    times = properties.get("time_s")
    if times is None and "coordTimes" in properties:
        if start_unix_s is None:
            raise DataError(f"{where}: say when the run's second 0 was (--start)")
        stamps = properties["coordTimes"]
        times = [
            unix_of(str(stamp), where) - start_unix_s
            for stamp in (stamps if isinstance(stamps, list) else [])
        ]
    if (
        not isinstance(times, list)
        or len(times) != count
        or not all(_is_number(time) for time in times)
    ):
        raise DataError(f"{where}: a time for each of its {count} positions is wanted (time_s)")
    return [float(time) for time in times]


def _world(where: str, position: Any, frame: MapFrame) -> tuple[float, float, float]:
    if (
        not isinstance(position, list)
        or len(position) < 2
        or not all(_is_number(part) for part in position)
        or abs(position[1]) > 90.0
        or abs(position[0]) > 180.0
    ):
        raise DataError(f"{where}: {position!r} is no longitude and latitude")
    try:
        x_m, y_m = frame.to_world(position[1], position[0])
    except DataError as error:
        raise DataError(f"{where}: {error}") from None
    z_m = math.nan
    if len(position) > 2 and frame.altitude_m is not None:
        z_m = float(position[2]) - frame.altitude_m
    return float(x_m), float(y_m), z_m


def _is_number(value: object) -> bool:
    """A whole number of hundreds of digits is none here: it fits no float."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
