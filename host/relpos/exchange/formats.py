"""The formats, and the kinds of trajectories; light enough for a help text."""

from __future__ import annotations

from enum import StrEnum


class Format(StrEnum):
    """The formats by the names people's scripts rely on."""

    RUN = "run"
    MCAP = "mcap"
    TUM = "tum"
    GEOJSON = "geojson"
    GPX = "gpx"
    CSV = "csv"
    ROSBAG2 = "rosbag2"
    RRD = "rrd"


class Kind(StrEnum):
    """Kind of a trajectory."""

    ESTIMATE = "estimate"
    TRUTH = "truth"
