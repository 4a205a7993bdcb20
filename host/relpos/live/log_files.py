"""A session's log for other programs: rows of a table, KML for maps."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

from relpos.files import open_output, printable
from relpos.live.team_view import LogEntry
from relpos.runs.log import shielded

KML = "http://www.opengis.net/kml/2.2"
Place = tuple[float, float]


def log_row(entry: LogEntry) -> tuple[object, ...]:
    """Return an entry as a row of ``LOG_COLUMNS``."""
    return (
        f"{entry.time_s:.2f}", f"{entry.unix_s:.2f}", entry.kind, entry.node or "",
        shielded(entry.by), shielded(entry.text),
    )  # fmt: skip


def write_kml(
    path: Path,
    name: str,
    entries: Iterable[LogEntry],
    place: Callable[[LogEntry], Place | None] = lambda _: None,
) -> None:
    """Write a placemark an entry with its time; with a point where ``place`` knows one.

    ``place`` returns latitude and longitude in degrees (WGS84).
    """
    root = ElementTree.Element("kml", xmlns=KML)
    document = ElementTree.SubElement(root, "Document")
    ElementTree.SubElement(document, "name").text = name
    for entry in entries:
        mark = ElementTree.SubElement(document, "Placemark")
        ElementTree.SubElement(mark, "name").text = printable(entry.text)
        by = f", by {entry.by}" if entry.by else ""
        ElementTree.SubElement(mark, "description").text = printable(f"{entry.kind}{by}")
        stamp = ElementTree.SubElement(mark, "TimeStamp")
        at = datetime.fromtimestamp(entry.unix_s, UTC)
        ElementTree.SubElement(stamp, "when").text = at.strftime("%Y-%m-%dT%H:%M:%SZ")
        there = place(entry)
        if there is not None:
            latitude, longitude = there
            point = ElementTree.SubElement(mark, "Point")
            where = f"{longitude:.9f},{latitude:.9f}"
            ElementTree.SubElement(point, "coordinates").text = where
    with open_output(path) as file:
        ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)
