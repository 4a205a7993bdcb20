"""The formats and what each is, and the kinds of trajectories; light enough for a help text."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import NamedTuple


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


class Traits(NamedTuple):
    """What a format is: one file or a directory, for maps, written for other tools alone."""

    suffixes: tuple[str, ...] = ()
    one_file: bool = False
    on_map: bool = False
    readable: bool = True


TRAITS = {
    Format.RUN: Traits(),
    Format.MCAP: Traits((".mcap",), one_file=True),
    Format.TUM: Traits((".tum",)),
    Format.GEOJSON: Traits((".geojson", ".json"), one_file=True, on_map=True),
    Format.GPX: Traits((".gpx",), one_file=True, on_map=True),
    Format.CSV: Traits(),
    Format.ROSBAG2: Traits(readable=False),
    Format.RRD: Traits(one_file=True, readable=False),
}


def format_of(name: Path) -> Format | None:
    """Return the format that a file's suffix shows."""
    suffix = name.suffix.lower()
    return next((form for form, traits in TRAITS.items() if suffix in traits.suffixes), None)


class Kind(StrEnum):
    """Kind of a trajectory."""

    ESTIMATE = "estimate"
    TRUTH = "truth"
